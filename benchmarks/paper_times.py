#!/usr/bin/env python3
"""Times the networks of benchmarks/paper.py beside Intel OIDN: what they cost where they are used, not where trained.

    python benchmarks/paper_times.py [--frame 512] [--repeats 3] [--threads 1] [--json docs/results/paper.json]

Needs no trained weights: the time of a network does not depend on them. All methods take turns on one frame of 8
samples per pixel, the example `defocus-motion` in mirror image, once to warm up and `--repeats` times more, of which
the medians count. CPU seconds are of all threads and of the network alone, without the survey, reading and writing.
`--json` gets them as its `times`; all else there stays. benchmarks/keep_paper.py makes tables and charts of it.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))

import torch
from paper import ROWS
from reduced import runs
from trials import SAMPLES, UNTRAINED, YARDSTICK, write

from deep_io.errors import InputError, LbmcError
from model import zoo
from model.config import Config
from model.denoiser import Denoiser
from pipelines.allocator import keep_freed_memory
from pipelines.bench.attempts import Attempts
from pipelines.bench.clock import Times
from pipelines.bench.machine import machine
from pipelines.bench.methods import OUTSIDE, LbmcMethod, Method
from pipelines.bench.results import Gap
from pipelines.bench.scenes import open_scene
from pipelines.bench.timing import TimedFrame, enlarged, take_turns
from pipelines.progress import make_progress
from pipelines.scene_names import DEEP, REFERENCE

SCENE = Path(__file__).resolve().parents[1] / "examples" / "scenes" / "defocus-motion"
NOT_THE_NETWORK = (*OUTSIDE, "survey")
IDLE = "samples' mean"  # takes no time of its own


def networks() -> dict[str, Config]:
    """Of every run by name; a loss makes no other network, so what is only trained otherwise is left to `same`."""
    found: dict[str, Config] = {}
    for run in runs():
        if run.config not in found.values():
            found[run.name] = run.config
    return found


def same(measured: Mapping[str, float]) -> dict[str, float]:
    """The times of all runs, by name, from those of their networks."""
    name_of = [(config, name) for name, config in networks().items()]
    return {run.name: next(measured[name] for config, name in name_of if config == run.config) for run in runs()}


def untrained_network(config: Config, folder: Path, threads: int) -> LbmcMethod:
    """A network with random weights, through the same door as the command, with nothing adapted to the frame."""
    weights = folder / f"random{zoo.SUFFIX}"
    torch.manual_seed(0)
    zoo.save(Denoiser(config), weights, {"description": "random weights"})
    return LbmcMethod(str(weights), threads, {"adapt": False})


def measure(methods: Mapping[str, Method], frame: TimedFrame, target: Path, repeats: int) -> dict[str, float]:
    """CPU seconds per megapixel of each network on a frame, by turns. Raises LbmcError where one fails."""

    def run(name: str, source: Path) -> Times:
        methods[name].run(source, target)
        return methods[name].clock.take()

    gaps: list[Gap] = []
    with make_progress("plain", 1 + repeats) as progress:
        found = take_turns({(frame.name, name): frame for name in methods}, repeats, run, Attempts(gaps, progress),
                           progress)
    if gaps:
        raise LbmcError(f"{gaps[0].cell}: {gaps[0].why}")
    return {name: sum(seconds for stage, seconds in times.cpu.items() if stage not in NOT_THE_NETWORK)
            / frame.megapixels for (_, name), times in found.items()}


def times(frame: int, repeats: int, threads: int) -> dict[str, Any]:
    """What goes into the JSON: `cpu_seconds_a_megapixel` by name, and how it was measured."""
    torch.set_num_threads(threads)
    keep_freed_memory()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        scene = open_scene(SCENE.with_name(SCENE.name + DEEP), SCENE.with_name(SCENE.name + REFERENCE))
        if scene.samples != SAMPLES:
            raise InputError(f"{scene.source}: {scene.samples} samples per pixel, not {SAMPLES}")
        methods: dict[str, Method] = {name: kind(threads) for name, kind in UNTRAINED.items() if name != IDLE}
        methods |= {name: untrained_network(config, folder, threads) for name, config in networks().items()}
        found = measure(methods, enlarged(scene, frame, folder), folder / "out.exr", repeats)
        for method in methods.values():
            method.close()
    found = {**{name: found[name] for name in UNTRAINED if name in found}, **same(found)}
    return {"machine": machine(threads), "scene": scene.name, "frame": frame, "samples": SAMPLES, "repeats": repeats,
            "warm_up": 1, "interleaved": True, "statistic": "median", "yardstick": YARDSTICK,
            "cpu_seconds_a_megapixel": {name: round(seconds, 4) for name, seconds in found.items()}}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frame", type=int, default=512, help="pixels along a side")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--json", type=Path, default=ROWS)
    options = parser.parse_args()
    document = json.loads(options.json.read_text("utf-8")) if options.json.exists() else {"scenes": [], "rows": {}}
    document["times"] = times(options.frame, options.repeats, options.threads)
    write(options.json, document)
    for name, seconds in document["times"]["cpu_seconds_a_megapixel"].items():
        print(f"{name}: {seconds:.2f} CPU s a megapixel")


if __name__ == "__main__":
    try:
        main()
    except LbmcError as error:
        sys.exit(f"ERROR: {error}")
