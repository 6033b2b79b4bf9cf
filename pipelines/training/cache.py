"""The training cache: deep sample files and their references, decoded once into memory-mapped half floats.

One folder per data set: `index.json`, and for each scene `NAME.samples.npy` (H, W, S, C) float16 and
`NAME.target.npy` (H, W, 3) float32. C are the canonical channels of CHANNELS, S the samples of every pixel. Radiance is
stored relative to the scene's exposure and depth relative to its median hit depth, so that halves hold both.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from deep_io.errors import InputError
from deep_io.flat import read_flat
from deep_io.path_samples import SampleReader
from model.samples import ROLE_WIDTHS
from pipelines.survey import exposure_of, median_depth, pixel_depth

DEEP_SUFFIX, REFERENCE_SUFFIX = ".deep.exr", ".ref.exr"
HALF_LIMIT = 60000.0
CACHE_VERSION = 1

CHANNELS: dict[str, slice] = {}
_start = 0
for _role, _width in ROLE_WIDTHS.items():
    CHANNELS[_role] = slice(_start, _start + _width)
    _start += _width
CHANNEL_COUNT = _start


@dataclass(frozen=True)
class SceneEntry:
    """One scene of the cache. `target_scale` brings the cached target to the metrics' common scale (mean about 0.5)."""

    name: str
    height: int
    width: int
    samples: int
    roles: tuple[str, ...]
    exposure: float
    depth: float
    target_scale: float


class SampleCache:
    """A data set: entries, and their arrays mapped from disk on first use."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        try:
            index = json.loads((folder / "index.json").read_text())
        except (OSError, ValueError) as error:
            raise InputError(f"{folder}: no training cache here ({error}); build one from deep sample files") from None
        self.entries = [SceneEntry(**{**entry, "roles": tuple(entry["roles"])}) for entry in index["scenes"]]
        self._arrays: dict[str, tuple[npt.NDArray[np.float16], npt.NDArray[np.float32]]] = {}

    def arrays(self, entry: SceneEntry) -> tuple[npt.NDArray[np.float16], npt.NDArray[np.float32]]:
        """samples (H, W, S, C) float16 and target (H, W, 3) float32, both in exposure units."""
        if entry.name not in self._arrays:
            samples = np.load(self.folder / f"{entry.name}.samples.npy", mmap_mode="r")
            target = np.load(self.folder / f"{entry.name}.target.npy", mmap_mode="r")
            self._arrays[entry.name] = samples, target
        return self._arrays[entry.name]


def scene_files(folder: Path) -> Iterator[tuple[str, Path, Path]]:
    """Names, deep files and references of a folder, sorted; InputError names a deep file without its reference."""
    for deep in sorted(folder.glob(f"*{DEEP_SUFFIX}")):
        name = deep.name.removesuffix(DEEP_SUFFIX)
        reference = folder / f"{name}{REFERENCE_SUFFIX}"
        if not reference.exists():
            raise InputError(f"{deep}: its reference {reference.name} is missing; render it or move the deep file away")
        yield name, deep, reference


def build_cache(source: Path, folder: Path, report: Callable[[str], None] = lambda _: None) -> SampleCache:
    """Decodes every scene of `source` into `folder`; scenes already there are kept. Returns the open cache.

    Raises InputError, naming the file: a missing, mismatched or non-finite reference, pixels with different numbers of
    samples, no scene at all.
    """
    folder.mkdir(parents=True, exist_ok=True)
    index = folder / "index.json"
    known: dict[str, dict[str, object]] = {}
    if index.exists():
        data = json.loads(index.read_text())
        if data.get("version") == CACHE_VERSION:
            known = {entry["name"]: entry for entry in data["scenes"]}
    scenes: list[dict[str, object]] = []
    for name, deep, reference in scene_files(source):
        if name not in known:
            known[name] = asdict(_cache_scene(name, deep, reference, folder))
            report(f"cached {name}")
            _write_index(index, [*scenes, known[name]])
        scenes.append(known[name])
    if not scenes:
        raise InputError(f"{source}: no *{DEEP_SUFFIX} files with *{REFERENCE_SUFFIX} references in it")
    _write_index(index, scenes)
    return SampleCache(folder)


def _write_index(path: Path, scenes: list[dict[str, object]]) -> None:
    temporary = path.with_suffix(".json.part")
    temporary.write_text(json.dumps({"version": CACHE_VERSION, "channels": CHANNEL_COUNT, "scenes": scenes}, indent=1))
    temporary.replace(path)


def _cache_scene(name: str, deep: Path, reference: Path, folder: Path) -> SceneEntry:
    with SampleReader(deep) as reader:
        path_samples = reader.read()
    height, width = path_samples.counts.shape
    count = int(path_samples.counts.flat[0])
    if count == 0 or np.any(path_samples.counts != count):
        raise InputError(f"{deep}: pixels hold different numbers of samples; training needs the same number everywhere")
    target = read_reference(reference)
    if target.shape[:2] != (height, width):
        raise InputError(f"{reference}: {target.shape[1]}x{target.shape[0]} pixels, but {deep.name} has "
                         f"{width}x{height}")
    if not np.isfinite(target).all():
        raise InputError(f"{reference}: NaN or Inf in the reference; render it again")
    roles = path_samples.roles
    radiance = roles["radiance"].reshape(height, width, count, 3)
    exposure = exposure_of(radiance.mean(2))
    depth = median_depth([pixel_depth(path_samples)]) if "depth" in roles else 1.0
    block = np.zeros((height, width, count, CHANNEL_COUNT), np.float16)
    for role, values in {**roles, "coverage": path_samples.coverage[:, None]}.items():
        scaled = values * np.float32({"radiance": exposure, "depth": 1 / depth}.get(role, 1.0))
        np.clip(scaled, -HALF_LIMIT, HALF_LIMIT, out=scaled)
        block[..., CHANNELS[role]] = scaled.reshape(height, width, count, -1)
    np.save(folder / f"{name}.samples.npy", block)
    exposed = target * np.float32(exposure)
    np.save(folder / f"{name}.target.npy", exposed)
    ceiling = np.percentile(exposed, 99)
    scale = 0.5 / max(float(np.minimum(exposed, ceiling).mean()), 1e-6)
    return SceneEntry(name, height, width, count, tuple(roles), exposure, depth, scale)


def read_reference(path: Path) -> npt.NDArray[np.float32]:
    """(H, W, 3) float32 linear radiance of a flat reference picture."""
    channels = read_flat(path).channels
    missing = [name for name in "RGB" if name not in channels]
    if missing:
        raise InputError(f"{path}: no channel {missing[0]}; a reference needs R, G and B")
    return np.stack([channels[name] for name in "RGB"], -1).astype(np.float32)
