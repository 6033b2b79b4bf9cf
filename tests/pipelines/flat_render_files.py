"""Flat one-sample renders as tests of packing write them, and what comes of packing them."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from deep_io.flat import read_flat, write_flat
from deep_io.header import Header
from deep_io.path_samples import PathSamples, SampleReader

OIIOTOOL = Path(sys.executable).with_name("oiiotool")
WIDTH, HEIGHT = 13, 9
HALF = 2.0**-10  # relative rounding of a half, twice


def render(seed: int, half: bool = True, fractions: bool = True, depth: bool = True) -> dict[str, np.ndarray]:
    """One noisy render: background in the upper rows (A = 0, Z = 1e10), the same surface depth in many pixels."""
    rng = np.random.default_rng(seed)
    shape = (HEIGHT, WIDTH)
    alpha = rng.choice([0.0, 1.0, 0.25, 0.5] if fractions else [0.0, 1.0], shape)
    alpha[:2] = 0
    dtype = np.float16 if half else np.float32
    picture = {name: rng.exponential(1.0, shape).astype(dtype) for name in "RGB"}
    picture["A"] = alpha.astype(dtype)
    if depth:
        picture["Z"] = np.where(alpha > 0, rng.choice([2.0, 3.0, 5.5], shape), 1e10).astype(np.float32)
    return picture


def write_renders(folder: Path, pictures: Sequence[Mapping[str, Any]], header: Header | None = None) -> list[Path]:
    paths = [folder / f"s{index}.exr" for index in range(len(pictures))]
    for path, picture in zip(paths, pictures, strict=True):
        write_flat(path, picture, header)
    return paths


def flatten(path: Path) -> dict[str, np.ndarray]:
    """The picture that OpenImageIO composites from a deep file."""
    flat = path.with_suffix(".flat.exr")
    subprocess.run([OIIOTOOL, path, "--flatten", "-d", "float", "-o", flat], check=True)
    return {name: pixels.astype(np.float64) for name, pixels in read_flat(flat).channels.items()}


def read(path: Path, **options: Any) -> PathSamples:
    with SampleReader(path, threads=1, **options) as reader:
        return reader.read()


def mean(pictures: Sequence[Mapping[str, np.ndarray]], name: str) -> np.ndarray:
    return np.mean([picture[name].astype(np.float64) for picture in pictures], axis=0)
