"""Short trainings of equal budget, scored alike: what benchmarks/paper.py and benchmarks/ablations.py share.

A table of runs, one after the other: each is trained or resumed, scored on thinned scenes, and becomes a row of a JSON
file. Rows that are there are kept. The scenes that the first run of a file trains on are those of all its later ones.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from fnmatch import fnmatch
from functools import partial
from pathlib import Path
from typing import Any

import torch
from layers_alive import blurred

from deep_io.atomic import atomic_output
from deep_io.errors import InputError
from model import zoo
from model.config import Config
from model.cost import count
from model.metrics import common_scale, relmse, relmse_trimmed, smape
from pipelines.allocator import keep_freed_memory
from pipelines.bench.methods import BlurMethod, FlatMethod, LbmcMethod, Method, OidnMethod, oidn_installed
from pipelines.bench.results import own
from pipelines.bench.scenes import find_scenes, write_thinned
from pipelines.flat_pictures import read_rgb
from pipelines.scene_names import DEEP, reference_of
from pipelines.training.batches import random_batch
from pipelines.training.cache import SampleCache, SceneArrays, SceneEntry
from pipelines.training.job import open_cache
from pipelines.training.loop import Trainer
from pipelines.training.recipe import Recipe

SAMPLES = 8
"""Samples per pixel at which everything is scored."""
SAVE_EVERY = 100  # steps
Row = dict[str, Any]
Scenes = list[tuple[str, Path, Path]]
"""Name, deep file, reference."""
YARDSTICK = "OIDN + albedo, normal"
UNTRAINED: Mapping[str, Callable[[int], Method]] = {
    "samples' mean": FlatMethod,
    "clamp and blur": BlurMethod,
    **({YARDSTICK: partial(OidnMethod, "guided")} if oidn_installed() else {}),
}
"""What is not trained here, made for so many threads: what a network stands beside."""


@dataclass(frozen=True)
class Run:
    """One network to be trained.

    name : of the network, as tables have it
    group : runs of one group had the same crops in the same order, but for those with other data
    one_of : every so many scenes, one is trained on
    stored : samples of each pixel that are trained on; None: all
    """

    name: str
    group: str
    config: Config
    recipe: Recipe
    one_of: int = 1
    stored: int | None = None

    @property
    def key(self) -> str:
        """Of its row, and of its files."""
        words = "".join(letter if letter.isalnum() or letter in "-_" else " " for letter in self.name.replace(",", ""))
        return f"{'-'.join(words.split())}.{self.recipe.seed}"


class FewerSamples(SampleCache):
    """A cache of which only the first samples of each pixel are known. Raises InputError where pixels differ."""

    def __init__(self, whole: SampleCache, stored: int) -> None:
        super().__init__(whole.folder)
        for entry in self.entries:
            if entry.ragged:
                raise InputError(f"{entry.name}: its pixels hold different numbers of samples; leave it out")
        self.entries = [dataclasses.replace(e, samples=min(e.samples, stored)) for e in self.entries]
        self.stored = stored

    def arrays(self, entry: SceneEntry) -> SceneArrays:
        """See SampleCache."""
        found = super().arrays(entry)
        return dataclasses.replace(found, samples=found.samples[:, :, : self.stored])


def train(run: Run, cache: SampleCache, names: list[str], folder: Path) -> tuple[Trainer, float]:
    """Trains or resumes; returns the trainer and the CPU seconds a step took, batches included."""
    if run.stored is not None:
        cache = FewerSamples(cache, run.stored)
    chosen = set(names[:: run.one_of])
    entries = [entry for entry in cache.entries if entry.name in chosen]
    trainer = Trainer(run.config, run.recipe, folder)
    begun, first = time.process_time(), trainer.step
    while trainer.step < run.recipe.steps:
        trainer.advance(random_batch(cache, run.recipe, trainer.step, entries=entries))
        if trainer.step % SAVE_EVERY == 0:
            trainer.save()
    return trainer, (time.process_time() - begun) / max(trainer.step - first, 1)


def thinned(sets: dict[str, Path], folder: Path) -> dict[str, Scenes]:
    """Every scene of every set, its file with at most SAMPLES samples per pixel, made once."""
    found: dict[str, Scenes] = {}
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
            reference = reference_of(scene.source)
            found.setdefault(name, []).append((scene.name, file, reference))
    return found


def network(weights: Path) -> LbmcMethod:
    """The network of a weight file, through the same door as the command."""
    return LbmcMethod(str(weights), torch.get_num_threads(), {"adapt": False})


def untrained(name: str, sets: dict[str, Scenes], folder: Path) -> Row:
    """Errors of one of UNTRAINED."""
    method = UNTRAINED[name](torch.get_num_threads())
    try:
        return {"scenes": scores(method, sets, folder)[0]}
    finally:
        method.close()


def scores(method: Method, sets: dict[str, Scenes], folder: Path) -> tuple[Row, float]:
    """Errors on every scene, and the method's own CPU seconds a megapixel."""
    found: Row = {}
    pixels = 0
    for name, scenes in sets.items():
        for scene, source, reference in scenes:
            method.run(source, folder / "scored.exr")
            clean = read_rgb(reference).rgb.astype("f8")
            pixels += clean.shape[0] * clean.shape[1]
            k = common_scale(clean)
            d, r = k * read_rgb(folder / "scored.exr").rgb.astype("f8"), k * clean
            found.setdefault(name, {})[scene] = {
                "relmse": round(relmse(d, r), 6), "trimmed": round(relmse_trimmed(d, r), 6),
                "smape": round(smape(d, r), 6), "energy": round(float(d.mean() / r.mean()), 6)}
    return found, own(method.clock.take().cpu) / pixels * 1e6


def row_of(run: Run, seconds: float, found: Row, seconds_a_megapixel: float) -> Row:
    """What the tables are made of."""
    cost = count(run.config)
    return {
        "name": run.name, "group": run.group, "seed": run.recipe.seed, "steps": run.recipe.steps,
        "batch": run.recipe.batch, "crop": run.recipe.crop, "layers": run.config.layers,
        "loss": dataclasses.asdict(run.recipe.loss), "parameters": cost.parameters,
        "multiply_adds": round(sum(cost.multiply_adds(SAMPLES, run.config.layers).values())),
        "cpu_seconds_a_step": round(seconds, 3), "cpu_seconds_a_megapixel": round(seconds_a_megapixel, 2),
        "scenes": found,
    }


def write(path: Path, document: Row) -> None:
    """Whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_output(path) as part:
        part.write_text(json.dumps(document, indent=1) + "\n", "utf-8")


def nothing_more(weights: Path, run: Run, sets: dict[str, Scenes]) -> Row:
    """Adds nothing to a row."""
    return {}


def perform(description: str, runs: Iterable[Run], rows: Path,
            more: Callable[[Path, Run, dict[str, Scenes]], Row] = nothing_more) -> None:
    """The command of a script: reads its words and makes the rows that are missing. `more` adds to a row."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("data", type=Path)
    parser.add_argument("--work", type=Path, required=True, help="checkpoints, weights and thinned scenes")
    parser.add_argument("--score", action="append", default=[], required=True, metavar="NAME=FOLDER")
    parser.add_argument("--only", action="append", metavar="GLOB", help="only networks whose name matches one of these")
    parser.add_argument("--seed", type=int, help="only this one")
    parser.add_argument("--steps", type=int, help="instead of the recipe's, to try it out")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--json", type=Path, default=rows)
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
    for name, scenes in sets.items():
        document.setdefault("blurred", {})[name] = [
            scene for scene, _, reference in scenes if blurred(reference.with_name(f"{scene}{DEEP}"))]
    for name in UNTRAINED:
        if name not in document.setdefault("untrained", {}):
            document["untrained"][name] = untrained(name, sets, options.work)
            write(options.json, document)
    for run in runs:
        wanted = any(fnmatch(run.name, glob) for glob in options.only or ["*"])
        if run.key in document["rows"] or not wanted or options.seed not in (None, run.recipe.seed):
            continue
        if options.steps:
            run = dataclasses.replace(run, recipe=dataclasses.replace(run.recipe, steps=options.steps))
        trainer, seconds = train(run, cache, document["scenes"], options.work / run.key)
        weights = options.work / f"{run.key}{zoo.SUFFIX}"
        zoo.save(trainer.averaged, weights, {"description": f"{run.name}, reduced width", "steps": run.recipe.steps})
        begun = time.process_time()
        row = {**row_of(run, seconds, *scores(network(weights), sets, options.work)), **more(weights, run, sets)}
        document["rows"][run.key] = row
        write(options.json, document)
        print(f"{run.key}: {seconds:.2f} CPU s a step, scored in {time.process_time() - begun:.0f}", flush=True)
