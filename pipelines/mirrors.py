"""Mirror images of a frame: its pixels, its samples, and which of their values point somewhere on the screen.

What is averaged over them is averages.py's.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from deep_io.csr import Index, offsets_of
from deep_io.path_samples import PathSamples

Floats = npt.NDArray[np.float32]
Scalar = TypeVar("Scalar", bound=np.generic)

DIRECTIONS = {"normal": -1, "motion": 1, "lens": 1}
"""Roles that point somewhere on the screen, and the sign of their y: normals have y up where the screen has y down."""


@dataclass(frozen=True)
class Mirror:
    """A frame as it is, or mirrored left to right, top to bottom, or both. Each is its own inverse."""

    left_right: bool = False
    top_bottom: bool = False

    def picture(self, picture: npt.NDArray[Scalar], rows: int = 0) -> npt.NDArray[Scalar]:
        """(..., H, W, ...) mirrored, a view. `rows`: the axis of H, before that of W."""
        return np.flip(picture, (rows,) * self.top_bottom + (rows + 1,) * self.left_right)

    def rows(self, first: int, last: int, height: int) -> tuple[int, int]:
        """Where rows first..last (exclusive) of one of the two frames are in the other."""
        return (height - last, height - first) if self.top_bottom else (first, last)

    def directions(self, values: Floats) -> None:
        """Mirrors, in place, directions on the screen (N, 2) or normals (N, 3)."""
        if self.left_right:
            values[:, 0] *= -1
        if self.top_bottom:
            values[:, 1] *= -1

    def to(self, other: Mirror) -> Mirror:
        """What makes the other image of this one."""
        return Mirror(self.left_right != other.left_right, self.top_bottom != other.top_bottom)

    def turn(self, block: PathSamples) -> PathSamples:
        """Whole rows mirrored, in the block's own arrays, so that nothing is there twice; its window stays.

        Directions among what is merely carried along keep their values: they come back to where they were.
        """
        order = self._order(block)
        for values in (block.weight, block.coverage, block.extra, *block.roles.values()):
            if values.size:
                values[...] = values.take(order, 0)
        for role in DIRECTIONS.keys() & block.roles.keys():
            self.directions(block.roles[role])
        return replace(block, counts=np.ascontiguousarray(self.picture(block.counts)),
                       source=order if block.source is None else block.source.take(order))

    def _order(self, block: PathSamples) -> Index:
        """(N,) the sample that becomes the first, the second, ...; those of a pixel keep their order."""
        counts = block.counts
        each = int(counts.max(initial=0))
        if each and counts.min() == each:
            table = np.arange(block.total, dtype=np.int64).reshape(*counts.shape, each)
            return self.picture(table).reshape(-1)
        moved = self.picture(counts).reshape(-1)
        starts = self.picture(block.offsets[:-1].reshape(counts.shape)).reshape(-1)
        order: Index = np.repeat(starts - offsets_of(moved)[:-1], moved)
        order += np.arange(block.total, dtype=np.int64)
        return order


STRAIGHT = Mirror()
ALONE = (STRAIGHT,)
ALL_FOUR = (STRAIGHT, Mirror(True, False), Mirror(False, True), Mirror(True, True))
