#!/usr/bin/env python3
"""Takes the choices behind `fast` back one at a time, at reduced width and few steps, and scores each.

    python benchmarks/ablations.py DATA --work WORK --score val2=FOLDER [--only GLOB ...] [--seed N] [--steps N]

Each run is a row of docs/results/ablations.json (`--json`), from which docs/tables.py makes docs/ablations.md; see
trials.py for what a run is. All seeds of the base come first, then every change with the first seed, then with others.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

from layers_alive import measure
from reduced import OUR_RECIPE, PIXEL_FAST, SEEDS, SMALL_FAST, SMAPE, layers_of
from trials import Row, Run, Scenes, perform

from deep_io.errors import LbmcError
from model import zoo
from model.config import Config, UNetConfig
from model.losses import LossWeights
from pipelines.training.recipe import Recipe

ROWS = Path(__file__).resolve().parents[1] / "docs" / "results" / "ablations.json"
BASE, BASE_TOPIC = "base", ""
RECIPE = replace(OUR_RECIPE, steps=120, warmup=20, crop=64)
UNET = SMALL_FAST.unet
NO_POOLED = replace(RECIPE.loss, pooled=())
NOISE2NOISE = LossWeights(smape=0.0, relative=0.0, noise2noise=1.0, pooled=())
LEAKS = replace(RECIPE.loss, relative=0.15, leaks=0.15)
CLEAN_FINISH = LossWeights(smape=1.0, relative=0.1, pooled=())


@dataclass(frozen=True)
class Change:
    """One change of the base; `topic` is a heading of its rows."""

    topic: str
    name: str
    config: Config = SMALL_FAST
    recipe: Recipe = RECIPE
    one_of: int = 1
    stored: int | None = None


def times(unet: UNetConfig, factor: int) -> UNetConfig:
    """A U-Net so many times as wide."""

    def wide(widths: Sequence[int]) -> tuple[int, ...]:
        return tuple(factor * width for width in widths)

    return replace(unet, encoder=tuple(map(wide, unet.encoder)), bottleneck=wide(unet.bottleneck),
                   decoder=tuple(map(wide, unet.decoder)))


def embedding_of(width: int) -> Config:
    """The base with embeddings so wide."""
    return replace(SMALL_FAST, reducer=(*SMALL_FAST.reducer[:-1], width))


ENCODING, CONTEXT, KERNELS = "encoding and statistics", "context", "kernels"
LAYERS, TRAINING, DATA = "layers", "training", "data"
NO_PATHS = replace(SMALL_FAST, demodulation=False)
WIDE = replace(SMALL_FAST, kernel_sizes=(9, *SMALL_FAST.kernel_sizes[1:]))
CHANGES = (
    Change(ENCODING, "the paper's encoding", replace(SMALL_FAST, encoding="paper")),
    Change(ENCODING, "no statistics in the context", replace(SMALL_FAST, statistics=False)),
    Change(KERNELS, "direct kernels, 9x9", replace(NO_PATHS, kernel="direct", kernel_sizes=(9,))),
    Change(KERNELS, "no demodulation", NO_PATHS),
    Change(LAYERS, "no confidence", replace(SMALL_FAST, confidence=False)),
    Change(LAYERS, "no depth prior", replace(SMALL_FAST, depth_prior=False)),
    Change(KERNELS, "one level", replace(SMALL_FAST, kernel_sizes=(5,))),
    Change(KERNELS, "three levels", replace(SMALL_FAST, kernel_sizes=(5, 3, 3))),
    Change(CONTEXT, "full resolution", replace(SMALL_FAST, unet=replace(UNET, scale=1))),
    Change(CONTEXT, "fine convolutions", replace(SMALL_FAST, unet=replace(UNET, fine=(8, 8, 8, 8)))),
    Change(DATA, "half of the scenes", one_of=2),
    Change(DATA, "a quarter of the scenes", one_of=4),
    Change(DATA, "all scenes, 8 samples stored", stored=8),
    Change(DATA, "a third of the scenes, 24 samples stored", one_of=3),
    Change(LAYERS, "1 layer", layers_of(SMALL_FAST, 1)),
    Change(KERNELS, "3x3 finest window", replace(SMALL_FAST, kernel_sizes=(3, *SMALL_FAST.kernel_sizes[1:]))),
    Change(LAYERS, "no guard of the order", recipe=replace(RECIPE, depth_order=0.0)),
    Change(LAYERS, "pixel aggregate", PIXEL_FAST),
    Change(TRAINING, "loss without pooled terms", recipe=replace(RECIPE, loss=NO_POOLED)),
    Change(TRAINING, "loss SMAPE alone", recipe=replace(RECIPE, loss=SMAPE)),
    Change(TRAINING, "learning rate x 2", recipe=replace(RECIPE, learning_rate=2 * RECIPE.learning_rate)),
    Change(TRAINING, "learning rate x 1/2", recipe=replace(RECIPE, learning_rate=RECIPE.learning_rate / 2)),
    Change(ENCODING, "embedding of 8", embedding_of(8)),
    Change(ENCODING, "embedding of 32", embedding_of(32)),
    Change(CONTEXT, "twice as wide", replace(SMALL_FAST, unet=times(UNET, 2))),
    Change(KERNELS, "affinity, 9x9, one level, no demodulation", replace(NO_PATHS, kernel_sizes=(9,))),
    Change(TRAINING, "noise2noise, then SMAPE",
           recipe=replace(RECIPE, loss=NOISE2NOISE, finish=0.25, finish_loss=CLEAN_FINISH)),
    Change(LAYERS, "3 layers", layers_of(SMALL_FAST, 3)),
    Change(DATA, "a sixteenth of the scenes", one_of=16),
    Change(KERNELS, "a gate for each guide", replace(SMALL_FAST, guide_gates=3)),
    Change(KERNELS, "learned features of the divisor", replace(SMALL_FAST, divisor_features=4)),
    Change(LAYERS, "no guard of the entropy", recipe=replace(RECIPE, partition_entropy=0.0)),
    Change(TRAINING, "Muon", recipe=replace(RECIPE, muon=True)),
    Change(KERNELS, "9x9 finest window", WIDE),
    Change(KERNELS, "11x11 finest window", replace(SMALL_FAST, kernel_sizes=(11, *SMALL_FAST.kernel_sizes[1:]))),
    Change(KERNELS, "9x9, then 5x5", replace(SMALL_FAST, kernel_sizes=(9, 5, *SMALL_FAST.kernel_sizes[2:]))),
    Change(KERNELS, "9x9, then 5x5 at all levels", replace(SMALL_FAST, kernel_sizes=(9, 5, 5, 5, 5, 5))),
    Change(KERNELS, "9x9 at two levels", replace(SMALL_FAST, kernel_sizes=(9, 9, *SMALL_FAST.kernel_sizes[2:]))),
    Change(KERNELS, "9x9 finest window, 16 features", replace(WIDE, affinity_features=16)),
    Change(KERNELS, "9x9 finest window, filtered guides", replace(WIDE, filtered_guides=True)),
    Change(TRAINING, "loss with leaks", recipe=replace(RECIPE, loss=LEAKS)),
    Change(TRAINING, "loss with leaks and darkness", recipe=replace(RECIPE, loss=replace(LEAKS, darkness=0.3))),
    Change(KERNELS, "twice the penalty of glare", replace(SMALL_FAST, glare_per_level=1.0)),
    Change(KERNELS, "slope of texture", replace(SMALL_FAST, texture_slope=True)),
)
"""In order of importance: what a short evening gets done."""


def run_of(change: Change, seed: int) -> Run:
    """A change of the base, or the base itself, with a seed."""
    recipe = replace(change.recipe, layers=((change.config.layers, 1.0),), seed=seed)
    return Run(change.name, change.topic, change.config, recipe, change.one_of, change.stored)


def runs() -> list[Run]:
    """The base with every seed, then the changes, seed by seed."""
    return [*(run_of(Change(BASE_TOPIC, BASE), seed) for seed in SEEDS),
            *(run_of(change, seed) for seed in SEEDS for change in CHANGES)]


def order_of(weights: Path, run: Run, sets: dict[str, Scenes]) -> Row:
    """Where layers are the topic and there are two, what they do where depth mixes within a pixel: front's weight, and
    in what share of the pixels it is nearer."""
    if run.config.layers != 2 or run.group not in (BASE_TOPIC, LAYERS):
        return {}
    net = zoo.find(str(weights)).load()
    found = [measure(net, source) for scenes in sets.values() for _, source, _ in scenes]
    rows = [row["filtered"] for row in found if "filtered" in row]
    return {key: round(sum(row[key] for row in rows) / len(rows), 4) for key in ("front", "nearer_with_misses") if rows}


if __name__ == "__main__":
    try:
        perform(__doc__.splitlines()[0], runs(), ROWS, order_of)
    except LbmcError as error:
        sys.exit(f"ERROR: {error}")
