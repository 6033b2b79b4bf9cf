#!/usr/bin/env python3
"""Trains the paper's networks and ours at reduced width, on equal steps and equal data, and scores them.

    python benchmarks/paper.py DATA --work WORK --score NAME=FOLDER [--score ...] [--only NAME] [--steps N]

DATA is a folder of training scenes; its cache is built beside it, as by `lbmc train`. Every FOLDER of scenes is scored
at 8 samples per pixel. Each network that is done is a row of docs/results/paper.json (`--json`), from which
docs/tables.py makes the tables of docs/results.md; rows that exist are kept, and a run that was stopped resumes from
its checkpoint in WORK. The scenes that the first run trains on are those of all later ones.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import time
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import torch

sys.path.insert(0, str(Path(__file__).resolve().parent))

from reduced import Run, runs

from deep_io.errors import LbmcError
from model import zoo
from model.cost import count
from model.metrics import common_scale, relmse, relmse_trimmed, smape
from pipelines.allocator import keep_freed_memory
from pipelines.bench.methods import LbmcMethod
from pipelines.bench.scenes import find_scenes, write_thinned
from pipelines.compare import read_rgb
from pipelines.training.batches import random_batch
from pipelines.training.cache import SampleCache
from pipelines.training.job import open_cache
from pipelines.training.loop import Trainer

HOME = Path(__file__).resolve().parents[1]
ROWS = HOME / "docs" / "results" / "paper.json"
SAMPLES = 8
SAVE_EVERY = 100  # steps
Row = dict[str, Any]


def train(run: Run, cache: SampleCache, names: list[str], folder: Path) -> tuple[Trainer, float]:
    """Trains or resumes; returns the trainer and the CPU seconds a step took, batches included."""
    entries = [entry for entry in cache.entries if entry.name in names]
    trainer = Trainer(run.config, run.recipe, folder)
    begun, first = time.process_time(), trainer.step
    while trainer.step < run.recipe.steps:
        trainer.advance(random_batch(cache, run.recipe, trainer.step, entries=entries))
        if trainer.step % SAVE_EVERY == 0:
            trainer.save()
    return trainer, (time.process_time() - begun) / max(trainer.step - first, 1)


def thinned(sets: dict[str, Path], folder: Path) -> dict[str, list[tuple[str, Path, Path]]]:
    """Name, file of at most SAMPLES samples per pixel, and reference, of every scene of every set; made once."""
    found: dict[str, list[tuple[str, Path, Path]]] = {}
    for name, source in sets.items():
        (folder / name).mkdir(parents=True, exist_ok=True)
        for scene in find_scenes(source):
            if ".32spp" in scene.name:  # the same scene as another of its set
                continue
            file = scene.source
            if scene.samples > SAMPLES:
                file = folder / name / scene.source.name
                if not file.exists():
                    write_thinned(scene, SAMPLES, file)
            reference = scene.source.with_name(scene.source.name.replace(".deep.exr", ".ref.exr"))
            found.setdefault(name, []).append((scene.name, file, reference))
    return found


def scores(weights: Path, sets: dict[str, list[tuple[str, Path, Path]]], folder: Path) -> Row:
    """Errors on every scene, through the same door as the command."""
    method = LbmcMethod(str(weights), torch.get_num_threads(), {"adapt": False})
    found: Row = {}
    for name, scenes in sets.items():
        for scene, source, reference in scenes:
            method.run(source, folder / "scored.exr")
            clean = read_rgb(reference).rgb.astype("f8")
            k = common_scale(clean)
            d, r = k * read_rgb(folder / "scored.exr").rgb.astype("f8"), k * clean
            found.setdefault(name, {})[scene] = {
                "relmse": round(relmse(d, r), 6), "trimmed": round(relmse_trimmed(d, r), 6),
                "smape": round(smape(d, r), 6)}
    return found


def row_of(run: Run, seconds: float, found: Row) -> Row:
    """What the tables are made of."""
    cost = count(run.config)
    return {
        "name": run.name, "group": run.group, "seed": run.recipe.seed, "steps": run.recipe.steps,
        "batch": run.recipe.batch, "crop": run.recipe.crop, "layers": run.config.layers,
        "loss": dataclasses.asdict(run.recipe.loss), "parameters": cost.parameters,
        "multiply_adds": round(sum(cost.multiply_adds(SAMPLES, run.config.layers).values())),
        "cpu_seconds_a_step": round(seconds, 3), "scenes": found,
    }


def write(path: Path, document: Row) -> None:
    """Whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".part")
    part.write_text(json.dumps(document, indent=1) + "\n", "utf-8")
    part.replace(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--work", type=Path, required=True, help="checkpoints, weights and thinned scenes")
    parser.add_argument("--score", action="append", default=[], required=True, metavar="NAME=FOLDER")
    parser.add_argument("--only", default="*", metavar="GLOB", help="only networks whose name matches")
    parser.add_argument("--seed", type=int, help="only this one")
    parser.add_argument("--steps", type=int, help="instead of the recipe's, to try it out")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--json", type=Path, default=ROWS)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    keep_freed_memory()
    cache = open_cache(options.data, print)
    sets = thinned({name: Path(folder) for name, _, folder in (word.partition("=") for word in options.score)},
                   options.work / "scenes")
    document: Row = {"scenes": [], "rows": {}}
    if options.json.exists():
        document = json.loads(options.json.read_text("utf-8"))
    document["scenes"] = document["scenes"] or [entry.name for entry in cache.entries]
    for run in runs():
        if run.key in document["rows"] or not fnmatch(run.name, options.only):
            continue
        if options.seed not in (None, run.recipe.seed):
            continue
        if options.steps:
            run = dataclasses.replace(run, recipe=dataclasses.replace(run.recipe, steps=options.steps))
        trainer, seconds = train(run, cache, document["scenes"], options.work / run.key)
        weights = options.work / f"{run.key}{zoo.SUFFIX}"
        zoo.save(trainer.averaged, weights, {"description": f"{run.name}, reduced width", "steps": run.recipe.steps})
        begun = time.process_time()
        row = row_of(run, seconds, scores(weights, sets, options.work))
        document["rows"][run.key] = row
        write(options.json, document)
        print(f"{run.key}: {seconds:.2f} CPU s a step, scored in {time.process_time() - begun:.0f}", flush=True)


if __name__ == "__main__":
    try:
        main()
    except LbmcError as error:
        sys.exit(f"ERROR: {error}")
