"""Pixel windows and deep samples in memory: flat (CSR) arrays, never one object per pixel.

What the samples mean (roles, weights) lives in roles.py and weighting.py.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from deep_io.csr import offsets_of, pixels_of


@dataclass(frozen=True)
class Window:
    """A rectangle of pixels, all four bounds inclusive as in the EXR header; y grows downwards."""

    xmin: int
    ymin: int
    xmax: int
    ymax: int

    @property
    def width(self) -> int:
        return self.xmax - self.xmin + 1

    @property
    def height(self) -> int:
        return self.ymax - self.ymin + 1

    def rows(self, y0: int, y1: int) -> Window:
        """The same columns, rows y0 to y1 exclusive, in absolute pixel coordinates."""
        return Window(self.xmin, y0, self.xmax, y1 - 1)


@dataclass
class DeepSamples:
    """A block of whole pixel rows and all their samples.

    counts      int32 (H, W)    samples in each pixel, 0 or more
    channels    name -> (N,)    float16, float32 or uint32, in the order of the pixels (row by row, left to right) and
                                in stored order within a pixel; N = counts.sum()
    window      Window          the pixels' place in the frame; H, W = window.height, window.width

    Raises ValueError when the shapes do not fit each other.
    """

    counts: NDArray[np.int32]
    channels: dict[str, NDArray[np.generic]]
    window: Window

    def __post_init__(self) -> None:
        if self.counts.shape != (self.window.height, self.window.width):
            raise ValueError(f"counts {self.counts.shape} do not fit a window of {self.window.height} rows of "
                             f"{self.window.width} pixels")
        total = self.total
        for name, values in self.channels.items():
            if values.shape != (total,):
                raise ValueError(f"channel {name!r} has shape {values.shape}, the counts sum to {total}")

    @property
    def total(self) -> int:
        """N, the number of samples in the block."""
        return int(self.counts.sum(dtype=np.int64))

    @property
    def offsets(self) -> NDArray[np.int64]:
        """(H*W+1,) where each pixel's samples begin; pixel p owns the slice offsets[p]:offsets[p+1]."""
        return offsets_of(self.counts)

    @property
    def pixel_index(self) -> NDArray[np.int64]:
        """(N,) the flat pixel number (row * W + column) of each sample."""
        return pixels_of(self.counts)


def concatenate(blocks: list[DeepSamples]) -> DeepSamples:
    """Blocks of consecutive rows, from top to bottom, as one block.

    Raises ValueError when there is no block, a row is missing or the channels differ.
    """
    if not blocks:
        raise ValueError("no block to concatenate")
    first, last = blocks[0], blocks[-1]
    names = list(first.channels)
    for above, below in pairwise(blocks):
        if below.window != above.window.rows(above.window.ymax + 1, below.window.ymax + 1):
            raise ValueError(f"rows {below.window} do not follow {above.window}")
        if list(below.channels) != names:
            raise ValueError(f"channels {list(below.channels)} differ from {names}")
    channels: Mapping[str, NDArray[np.generic]] = {
        name: np.concatenate([block.channels[name] for block in blocks]) for name in names}
    return DeepSamples(np.concatenate([block.counts for block in blocks]), dict(channels),
                       first.window.rows(first.window.ymin, last.window.ymax + 1))
