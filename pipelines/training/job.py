"""`lbmc train` as a function: caches the data, trains or resumes, and writes the averaged weights as a preset file."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path

import torch

from deep_io.errors import UsageError
from model import zoo
from model.config import CONFIGS
from pipelines.network import find_weights, load_network
from pipelines.training.cache import SampleCache, build_cache
from pipelines.training.loop import Trainer
from pipelines.training.recipe import Recipe

FEWEST_SCENES = 2


def train(
    data: Path,
    validation: Path,
    folder: Path,
    preset: str,
    recipe: Recipe,
    start: Path | None = None,
    threads: int | None = None,
    seconds: float = math.inf,
    report: Callable[[str], None] = print,
) -> Path:
    """Trains `preset` on the scenes of `data` and returns the weight file it wrote into `folder`.

    Parameters
    ----------
    preset : a name of model.config.CONFIGS
    data, validation : folders of NAME.deep.exr with NAME.ref.exr; decoded caches are kept beside them
    folder : checkpoints, curve and weights; a checkpoint in it is resumed
    start : weight file to start from instead of random weights
    seconds : stop after this long, resumable

    Raises InputError naming the file for data that cannot be trained on, before training starts.
    """
    if preset not in CONFIGS:
        raise UsageError(f"no network {preset!r}; there are {', '.join(CONFIGS)}")
    if threads is not None:
        torch.set_num_threads(threads)
    training = open_cache(data, report)
    held_out = open_cache(validation, report)
    if len(training.entries) < FEWEST_SCENES:
        raise UsageError(f"{data}: {len(training.entries)} scene; training needs {FEWEST_SCENES} or more")
    initial = load_network(find_weights(str(start))).state_dict() if start is not None else None
    trainer = Trainer(CONFIGS[preset], recipe, folder, initial)
    report(f"{len(training.entries)} scenes, {len(held_out.entries)} held out, from step {trainer.step}")
    trainer.run(training, held_out, report, seconds)
    info = {
        "description": f"{preset}, trained by lbmc train",
        "data": {"scenes": len(training.entries), "validation": len(held_out.entries)},
        "recipe": dataclasses.asdict(recipe),
        "steps": trainer.step,
        "scores": trainer.rows[-1] if trainer.rows else {},
    }
    path = folder / f"{preset}{zoo.SUFFIX}"
    zoo.save(trainer.averaged, path, info)
    return path


def open_cache(source: Path, report: Callable[[str], None]) -> SampleCache:
    """The cache beside a folder of scenes (`FOLDER.cache`), brought up to date."""
    return build_cache(source, source.with_name(source.name + ".cache"), report)
