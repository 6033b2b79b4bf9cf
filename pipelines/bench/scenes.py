"""The scenes of a bench: deep sample files with references, checked before any time is spent, and thinned copies."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deep_io import DeepSamples, Window, read_deep, write_deep
from deep_io.errors import InputError
from deep_io.path_samples import SampleReader
from model.metrics import Scores, common_scale, reference_floor, relmse, score, smape
from pipelines.flat_pictures import (
    FlatPicture,
    check_finite,
    check_halves,
    check_window,
    mean_of_halves,
    placed,
    read_rgb,
)
from pipelines.scene_names import DEEP, REFERENCE, other_half_of, reference_of, scene_name

Image = NDArray[np.floating[Any]]

SEED = 20100623
"""Of the order in which samples are left out, the same in every run."""


@dataclass(frozen=True)
class Scene:
    """One deep sample file and its reference.

    reference : the mean of both halves, where there are two
    samples : per pixel, on average, rounded
    halves : two independent renderings (H, W, 3) whose mean the reference is; None where there is only one
    floor : relMSE of the reference itself, by its halves
    """

    name: str
    source: Path
    reference: FlatPicture
    samples: int
    weighting: str
    halves: tuple[Image, Image] | None = None
    floor: float | None = None

    @property
    def width(self) -> int:
        return self.reference.window.width

    @property
    def height(self) -> int:
        return self.reference.window.height

    @property
    def megapixels(self) -> float:
        return self.width * self.height / 1e6

    def score(self, picture: Image, *, with_flip: bool = True) -> Scores:
        """All metrics of a picture (H, W, 3) of this scene."""
        one, other = self.halves or (self.reference.rgb, None)
        return score(picture, one, other, with_flip=with_flip)

    def errors(self, picture: Image) -> tuple[float, float]:
        """relMSE and SMAPE alone, which take a fraction of the time."""
        k = common_scale(self.reference.rgb)
        scaled, reference = k * picture.astype(np.float64), k * self.reference.rgb.astype(np.float64)
        return relmse(scaled, reference), smape(scaled, reference)

    def thinned_counts(self) -> list[int]:
        """1, 2, 4, ... below the file's own samples per pixel; none where samples are not simply averaged."""
        if self.weighting != "uniform":
            return []
        return [2**k for k in range(self.samples.bit_length()) if 2**k < self.samples]


def find_scenes(folder: Path, match: str = "*") -> list[Scene]:
    """The scenes of `find_pairs`, opened. Raises InputError, as `find_pairs` and `open_scene` do."""
    return [open_scene(*pair) for pair in find_pairs(folder, match)]


def find_pairs(folder: Path, match: str = "*") -> list[tuple[Path, Path]]:
    """Every NAME.deep.exr of `folder` that has a NAME.ref.exr, with it, and whose NAME matches the glob, by name.

    Raises InputError when there is no such folder or no such pair.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder")
    deep = {scene_name(path) for path in folder.glob(f"*{DEEP}")}
    references = {path.name.removesuffix(REFERENCE) for path in folder.glob(f"*{REFERENCE}")}
    names = [name for name in sorted(deep & references) if fnmatch(name, match)]
    if not names:
        raise InputError(
            f"{folder}: no name in common between {len(deep)} files NAME{DEEP} and {len(references)} NAME{REFERENCE} "
            f"that matches {match!r}; a scene is such a pair"
        )
    return [(folder / f"{name}{DEEP}", folder / f"{name}{REFERENCE}") for name in names]


def without_reference(folder: Path, match: str = "*") -> list[str]:
    """The names of the files NAME.deep.exr of `folder` that have no NAME.ref.exr, and whose NAME matches the glob."""
    return sorted(path.name for path in folder.glob(f"*{DEEP}")
                  if fnmatch(scene_name(path), match) and not reference_of(path).exists())


def open_scenes(pairs: Iterable[tuple[Path, Path]]) -> tuple[list[Scene], dict[str, str]]:
    """The scenes of pairs, and of those that cannot be opened name and error. Raises InputError where none can."""
    scenes: list[Scene] = []
    failed: dict[str, str] = {}
    for source, reference in pairs:
        try:
            scenes.append(open_scene(source, reference))
        except InputError as error:
            failed[scene_name(source)] = str(error)
    if not scenes:
        raise InputError("; ".join(failed.values()))
    return scenes, failed


def open_scene(source: Path, reference: Path) -> Scene:
    """One pair, checked, with the other half of the reference where NAME.ref2.exr is there.

    Raises InputError for files that cannot be read, windows that differ (both are named), halves that are one and the
    same picture, a reference without light or with values that are not finite.
    """
    picture, other = read_rgb(reference), other_half_of(source)
    pictures = [picture, read_rgb(other)] if other.exists() else [picture]
    with SampleReader(source) as reader:
        window = reader.header.data_window
        if window != picture.window:
            raise InputError(f"{placed(source, window)}, but {placed(reference, picture.window)}; a scene is a pair of "
                             "one window")
        samples = max(round(reader.total / (window.width * window.height)), 1)
        weighting = reader.weighting
    for half in pictures[1:]:
        check_window(picture, half)
    check_finite(pictures)
    halves = None
    if len(pictures) == 2:
        check_halves(*pictures)
        halves = pictures[0].rgb, pictures[1].rgb
        picture = replace(picture, rgb=mean_of_halves(*pictures))
    try:
        k = common_scale(picture.rgb)
    except ValueError as error:
        raise InputError(f"{reference}: {error}") from error
    floor = None if halves is None else reference_floor(*(k * half.astype(np.float64) for half in halves))
    return Scene(scene_name(source), source, picture, samples, weighting, halves, floor)


def thin(samples: DeepSamples, most: int, seed: int = SEED) -> DeepSamples:
    """At most `most` samples of every pixel, drawn without replacement, in stored order.

    Each pixel draws for itself, since a renderer's sample number and its shutter time go together. With one seed the
    draws are nested: what is kept for 2 is among what is kept for 4.
    """
    pixel = samples.pixel_index
    order = np.lexsort((np.random.default_rng(seed).random(samples.total), pixel))
    rank = np.empty(samples.total, np.int64)
    rank[order] = np.arange(samples.total) - samples.offsets[pixel]
    kept = rank < most
    channels = {name: values[kept] for name, values in samples.channels.items()}
    return DeepSamples(np.minimum(samples.counts, most).astype(np.int32), channels, samples.window)


def enlarge(samples: DeepSamples, side: int, *, exact: bool = False) -> DeepSamples:
    """The frame repeated in mirror image, to `side` pixels along each side that has fewer, at the origin.

    With `exact`, of a side that has more only the middle is left.
    """
    height, width = samples.counts.shape
    rows, columns = (_mirrored(size, side if exact else max(size, side)) for size in (height, width))
    pixels = (rows[:, None] * width + columns).ravel()
    counts = samples.counts.ravel()[pixels]
    ends = np.cumsum(counts, dtype=np.int64)
    start = np.repeat(samples.offsets[pixels] - (ends - counts), counts)
    chosen = start + np.arange(start.size)
    channels = {name: values[chosen] for name, values in samples.channels.items()}
    window = Window(0, 0, len(columns) - 1, len(rows) - 1)
    return DeepSamples(counts.reshape(len(rows), len(columns)), channels, window)


def _mirrored(size: int, length: int) -> NDArray[np.int64]:
    """0 .. size-1, back to 0, and so on: (length,); the middle of it where `length` is less."""
    place = (np.arange(length) + max(size - length, 0) // 2) % (2 * size)
    return np.minimum(place, 2 * size - 1 - place)


def write_enlarged(scene: Scene, side: int, target: Path, *, exact: bool = False) -> float:
    """Writes the scene enlarged to `side` x `side` pixels or more, or exactly that; returns its megapixels."""
    samples, header = read_deep(scene.source)
    large = enlarge(samples, side, exact=exact)
    write_deep(target, large, replace(header, data_window=large.window, display_window=large.window))
    return large.counts.size / 1e6


def write_thinned(scene: Scene, most: int, target: Path) -> None:
    """Writes the scene with at most `most` samples in every pixel, its header otherwise as it was."""
    samples, header = read_deep(scene.source)
    write_deep(target, thin(samples, most), header)
