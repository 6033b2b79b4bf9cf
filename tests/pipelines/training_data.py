"""Small scenes, networks and recipes for the tests of training. Not a test itself."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import numpy.typing as npt

from deep_io import DeepSamples, Window, write_deep
from deep_io.flat import write_flat
from deep_io.header import Header
from model.config import FAST, UNetConfig
from pipelines.training.recipe import Recipe

SIZE, COUNT = 40, 6
SMALL = dataclasses.replace(
    FAST,
    unet=UNetConfig(encoder=((8,), (8,)), bottleneck=(8,), decoder=((8,), (8,)), scale=2),
    reducer=(8, 8),
    partitioner=(8,),
    generator=(8,),
    kernel_sizes=(3, 3, 3),
)
QUICK = Recipe(steps=6, batch=3, crop=32, warmup=2, validate_every=3, bfloat16=False)

Counts = npt.NDArray[np.int32]


def write_example(folder: Path, name: str, seed: int, counts: Counts | None = None,
                  attributes: dict[str, str] | None = None, fading: bool = False) -> None:
    """A tilted plane under noise, COUNT samples a pixel or `counts`, and its exact mean as the reference.

    The time of a pixel's samples rises from 0 to 1 in their order, as where a renderer goes through the shutter.
    `fading`: alpha is fractional, for the weighting `over`.
    """
    rng = np.random.default_rng(seed)
    counts = np.full((SIZE, SIZE), COUNT, np.int32) if counts is None else counts
    rows, columns = (np.repeat(index.ravel(), counts.ravel()) for index in np.indices((SIZE, SIZE)))
    clean = np.stack([0.2 + rows / SIZE, 0.5 + columns / SIZE, np.full(rows.size, 0.3)], -1)
    noisy = clean * rng.gamma(1.0, 1.0, (rows.size, 1))
    rank = np.concatenate([np.arange(count) for count in counts.ravel()])
    held = np.repeat(counts.ravel(), counts.ravel())
    channels = {
        **{c: noisy[:, k].astype(np.float16) for k, c in enumerate("RGB")},
        "A": rng.uniform(0.2, 0.6, rows.size).astype(np.float16) if fading else np.ones(rows.size, np.float16),
        "Z": (2 + rows / SIZE + 0.01 * rank).astype(np.float32),
        "time": (rank / np.maximum(held - 1, 1)).astype(np.float16),
    }
    deep = DeepSamples(counts, channels, Window(0, 0, SIZE - 1, SIZE - 1))
    write_deep(folder / f"{name}.deep.exr", deep, Header.of_samples(deep, attributes=attributes))
    y, x = np.indices((SIZE, SIZE), np.float32) / SIZE
    write_flat(folder / f"{name}.ref.exr", {"R": 0.2 + y, "G": 0.5 + x, "B": np.full_like(x, 0.3)})


def uneven(seed: int) -> Counts:
    """0 to 12 samples in a pixel, a tenth of them empty."""
    rng = np.random.default_rng(seed)
    counts: Counts = rng.integers(1, 13, (SIZE, SIZE)).astype(np.int32)
    counts[rng.random(counts.shape) < 0.1] = 0
    return counts
