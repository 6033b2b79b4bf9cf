"""Folders of deep sample files with references, checked and decoded once into a cache (see cache.py)."""

from __future__ import annotations

import json
import math
import zlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from deep_io.atomic import atomic_output
from deep_io.csr import offsets_of, pixels_of
from deep_io.errors import InputError
from deep_io.path_samples import PathSamples, SampleReader
from deep_io.samples import Window
from model.metrics import common_scale
from pipelines.flat_pictures import FlatPicture, check_halves, mean_of_halves, read_rgb
from pipelines.scene_names import DEEP, REFERENCE, other_half_of, reference_of, scene_name
from pipelines.survey import survey
from pipelines.training.cache import (
    CACHE_VERSION,
    CHANNEL_COUNT,
    CHANNELS,
    INDEX,
    SampleCache,
    SceneEntry,
    array_path,
    is_whole,
    read_index,
)
from pipelines.training.recipe import SMALLEST_CROP

HALF_LIMIT = 60000.0

Report = Callable[[str], None]
FloatArray = npt.NDArray[np.float32]


@dataclass(frozen=True)
class SceneFiles:
    """One scene of a data folder."""

    name: str
    deep: Path
    references: tuple[Path, ...]  # one, or two independent halves

    def stamp(self) -> tuple[int, ...]:
        """Sizes and times of the files: they change when a scene is rendered again."""
        stats = [path.stat() for path in (self.deep, *self.references)]
        return tuple(number for stat in stats for number in (stat.st_size, stat.st_mtime_ns))


def scene_files(folder: Path, fewest: int = 1) -> list[SceneFiles]:
    """The scenes of a folder, sorted. Raises InputError: no folder, a file without its partner, fewer than `fewest`."""
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; it must hold NAME{DEEP} and NAME{REFERENCE} files")
    files = []
    for deep in sorted(folder.glob(f"*{DEEP}")):
        reference = reference_of(deep)
        if not reference.exists():
            raise InputError(f"{deep}: its reference {reference.name} is missing; render it or move the deep file away")
        other = other_half_of(deep)
        files.append(SceneFiles(scene_name(deep), deep, (reference, other) if other.exists() else (reference,)))
    if not files:
        raise InputError(f"{folder}: no *{DEEP} files with *{REFERENCE} references in it")
    if len(files) < fewest:
        raise InputError(f"{folder}: {len(files)} scene{'s'[:len(files) > 1]}; {fewest} or more are needed, "
                         f"each NAME{DEEP} with NAME{REFERENCE}")
    return files


def build_cache(source: Path, folder: Path, report: Report = lambda _: None, threads: int | None = None
                ) -> SampleCache:
    """Decodes into `folder` every scene of `source` that is not there, whole, or has changed. Returns the open cache.

    Arrays are replaced whole, so that a training that has them mapped goes on undisturbed.
    Raises InputError, naming the file: see `scene_files` and `cache_scene`.
    """
    files = scene_files(source)
    folder.mkdir(parents=True, exist_ok=True)
    known = {name: entry for name, entry in read_index(folder).items() if is_whole(folder, entry)}
    done: dict[str, SceneEntry] = {}
    missing = [item for item in files if item.name not in known or known[item.name].stamp != item.stamp()]
    for number, item in enumerate(missing, 1):
        done[item.name] = cache_scene(item, folder, threads)
        report(f"cached {item.name} ({number} of {len(missing)})")
        there = {**read_index(folder), **done}  # another run may be filling the same cache
        _write_index(folder, [there[f.name] for f in files if f.name in there])
    _write_index(folder, [{**known, **done}[item.name] for item in files])
    return SampleCache(folder)


def _write_index(folder: Path, entries: list[SceneEntry]) -> None:
    document = {"version": CACHE_VERSION, "channels": CHANNEL_COUNT, "scenes": [asdict(entry) for entry in entries]}
    with atomic_output(folder / INDEX) as path:
        path.write_text(json.dumps(document, indent=1), "utf-8")


def cache_scene(files: SceneFiles, folder: Path, threads: int | None = None) -> SceneEntry:
    """Writes one scene's arrays, block by block of its rows.

    Raises InputError, naming the file: a deep file that cannot be read or is too small, a reference that cannot be
    read, has another data window, is not finite or black, halves of one that are the same.
    """
    with SampleReader(files.deep, threads=threads) as reader, ExitStack() as outputs:
        window = reader.header.data_window
        height, width = window.height, window.width
        if min(height, width) < SMALLEST_CROP:
            raise InputError(f"{files.deep}: {width}x{height} pixels; training needs {SMALLEST_CROP}x{SMALLEST_CROP} "
                             f"or more")
        reference, *other = (read_reference(path, window, files.deep.name) for path in files.references)
        target = reference.rgb
        if other:
            check_halves(reference, *other)
            target = mean_of_halves(reference, *other).astype(np.float32)
        counts: list[npt.NDArray[np.int32]] = []
        seen = survey(_noting(reader.blocks(), counts))
        offsets = offsets_of(np.concatenate([block.ravel() for block in counts]))
        held = np.diff(offsets)
        if not held.any():
            raise InputError(f"{files.deep}: no sample in it is finite")
        over = reader.weighting == "over"
        uniform = not over and held.min() == held.max()
        exposed = target * np.float32(seen.exposure)
        if not np.isfinite(exposed).all():
            raise InputError(f"{files.references[0]}: values too large for its deep file; render it again")

        def write(kind: str, shape: tuple[int, ...], dtype: Any) -> npt.NDArray[Any]:
            path = outputs.enter_context(atomic_output(array_path(folder, files.name, kind)))
            return np.lib.format.open_memmap(path, "w+", dtype, shape)

        shape = (height, width, int(held[0])) if uniform else (int(offsets[-1]),)
        samples = write("samples", (*shape, CHANNEL_COUNT), np.float16).reshape(-1, CHANNEL_COUNT)
        weights = write("weight", samples.shape[:1], np.float32) if over else None
        if not uniform:
            write("offsets", offsets.shape, np.int64)[:] = offsets
        write("target", exposed.shape, np.float32)[:] = exposed
        rng = np.random.default_rng(zlib.crc32(files.name.encode()))
        start = 0
        roles: tuple[str, ...] = ()
        for block in reader.blocks():
            stop = start + block.total
            order = np.arange(block.total) if over else _shuffled(block, rng)
            samples[start:stop] = _halves(block, seen.exposure, seen.depth)[order]
            if weights is not None:
                weights[start:stop] = block.weight
            roles, start = tuple(block.roles), stop
    return SceneEntry(
        files.name, height, width, math.ceil(held.sum() / np.count_nonzero(held)), not uniform,
        "over" if over else "uniform", roles, seen.exposure, seen.depth, common_scale(exposed), files.stamp(),
    )


def _noting(blocks: Iterator[PathSamples], counts: list[npt.NDArray[np.int32]]) -> Iterator[PathSamples]:
    """The blocks, their counts noted."""
    for block in blocks:
        counts.append(block.counts)
        yield block


def _shuffled(block: PathSamples, rng: np.random.Generator) -> npt.NDArray[np.int64]:
    """(N,) the block's samples with those of each pixel in random order: renderers and depth sorts order them."""
    keys = rng.random(block.total, np.float32)
    most = int(block.counts.max(initial=0))
    if most and int(block.counts.min()) == most:
        within = np.argsort(keys.reshape(-1, most), 1)
        order: npt.NDArray[np.int64] = (within + np.arange(0, block.total, most)[:, None]).ravel()
        return order
    return np.lexsort((keys, pixels_of(block.counts)))


def _halves(block: PathSamples, exposure: float, depth: float) -> npt.NDArray[np.float16]:
    """(N, C): the block's samples in the cache's units; an unknown depth is the median, which tells nothing."""
    half = np.zeros((block.total, CHANNEL_COUNT), np.float16)
    for role, values in {**block.roles, "coverage": block.coverage[:, None]}.items():
        if role == "depth":
            values = np.where(values > 0, values / np.float32(depth), np.float32(1))
        elif role == "radiance":
            values = values * np.float32(exposure)
        half[:, CHANNELS[role]] = np.clip(values, -HALF_LIMIT, HALF_LIMIT)
    return half


def read_reference(path: Path, window: Window, deep: str) -> FlatPicture:
    """The reference of the file named `deep`, whose data window is `window`. Raises InputError naming `path`."""
    picture = read_rgb(path)
    if picture.window != window:
        raise InputError(f"{path}: {_place(picture.window)}, but {deep} has {_place(window)}; render both alike")
    if not np.isfinite(picture.rgb).all():
        raise InputError(f"{path}: NaN or Inf in the reference; render it again")
    try:
        common_scale(picture.rgb)
    except ValueError as error:
        raise InputError(f"{path}: {error}; move the scene away") from None
    return picture


def _place(window: Window) -> str:
    return f"{window.width}x{window.height} pixels at ({window.xmin}, {window.ymin})"
