"""The training cache: decoded scenes as memory-mapped half floats, and how one is read. caching.py writes it.

One folder per data set. `index.json` lists the scenes; each has NAME.target.npy (H, W, 3) float32 and

    every pixel holds S samples     NAME.samples.npy (H, W, S, C) float16
    their numbers differ            NAME.samples.npy (N, C) float16, pixel after pixel, and
                                    NAME.offsets.npy (H*W+1,) int64: where each pixel's samples begin
    weighting is `over`             as above, and NAME.weight.npy (N,) float32, which sums to 1 in a pixel

C are the canonical channels of CHANNELS. Radiance and target are stored times the scene's exposure, depth divided by
its median hit depth, so that halves hold them. The samples of a pixel lie in random order, so that any run of
consecutive ones is a random subset; only those weighted by `over` keep theirs, since they are only ever used together.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from deep_io.errors import InputError
from model.samples import ROLE_WIDTHS

INDEX = "index.json"
CACHE_VERSION = 2

CHANNELS: dict[str, slice] = {}
_start = 0
for _role, _width in ROLE_WIDTHS.items():
    CHANNELS[_role] = slice(_start, _start + _width)
    _start += _width
CHANNEL_COUNT = _start


@dataclass(frozen=True)
class SceneEntry:
    """One scene of the cache.

    samples : per pixel; where the pixels differ, the mean of those that have any, rounded up
    ragged : whether the pixels hold different numbers of samples
    weighting : "uniform" (also of `packed` files) or "over"
    exposure, depth : what radiance was multiplied and depth divided by
    target_scale : brings the cached target to the metrics' common scale (mean about 0.5)
    stamp : sizes and times of the files it was made from
    """

    name: str
    height: int
    width: int
    samples: int
    ragged: bool
    weighting: str
    roles: tuple[str, ...]
    exposure: float
    depth: float
    target_scale: float
    stamp: tuple[int, ...]


@dataclass
class SceneArrays:
    """A scene's arrays, mapped from disk; shapes as in the module's description. `offsets` None: S in every pixel."""

    samples: npt.NDArray[np.float16]
    target: npt.NDArray[np.float32]
    offsets: npt.NDArray[np.int64] | None = None
    weight: npt.NDArray[np.float32] | None = None


@dataclass
class SampleCache:
    """A data set: its scenes, and their arrays, mapped on first use. Raises InputError where `folder` holds none."""

    folder: Path
    entries: list[SceneEntry] = field(init=False)

    def __post_init__(self) -> None:
        found = read_index(self.folder)
        if not found:
            raise InputError(f"{self.folder}: no training cache here; build one from deep sample files")
        self.entries = list(found.values())
        self._arrays: dict[str, SceneArrays] = {}

    def arrays(self, entry: SceneEntry) -> SceneArrays:
        """The arrays of one of `entries`, in exposure and depth units."""
        if entry.name not in self._arrays:
            def mapped(kind: str) -> npt.NDArray[np.generic]:
                array: npt.NDArray[np.generic] = np.load(array_path(self.folder, entry.name, kind), mmap_mode="r")
                return array

            self._arrays[entry.name] = SceneArrays(
                mapped("samples").view(np.float16),
                mapped("target").view(np.float32),
                mapped("offsets").view(np.int64) if entry.ragged else None,
                mapped("weight").view(np.float32) if entry.weighting == "over" else None,
            )
        return self._arrays[entry.name]


def is_whole(folder: Path, entry: SceneEntry) -> bool:
    """Whether all arrays of a scene are there: somebody may have made room on a disk."""
    kinds = ("samples", "target", *("offsets",) * entry.ragged, *("weight",) * (entry.weighting == "over"))
    return all(array_path(folder, entry.name, kind).is_file() for kind in kinds)


def array_path(folder: Path, name: str, kind: str) -> Path:
    """Where the cache keeps one of a scene's arrays: samples, target, offsets or weight."""
    return folder / f"{name}.{kind}.npy"


def read_index(folder: Path) -> dict[str, SceneEntry]:
    """The scenes of a cache by name, in its order; none where there is no cache, or one of another version."""
    try:
        index = json.loads((folder / INDEX).read_text("utf-8"))
        if index["version"] != CACHE_VERSION:
            return {}
        entries = (SceneEntry(**{**e, "roles": tuple(e["roles"]), "stamp": tuple(e["stamp"])}) for e in index["scenes"])
        return {entry.name: entry for entry in entries}
    except (OSError, ValueError, KeyError, TypeError):
        return {}
