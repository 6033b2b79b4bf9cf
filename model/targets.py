"""Which targets a caller wants, as pixels: the cells that hold them, and the sources that their kernels look at."""

from __future__ import annotations

from collections.abc import Sequence

import torch.nn.functional as F
from torch import Tensor

TARGET_CELL = 64  # pixels; `affinity_filter` computes or skips targets by cells of this size


def cells_with(wanted: Tensor, size: int) -> Tensor:
    """(B, H, W) bool -> (B, ceil(H / size), ceil(W / size)) bool: whether a cell holds any wanted pixel."""
    return F.max_pool2d(wanted[:, None].float(), size, ceil_mode=True)[:, 0] > 0


def sources_of(wanted: Tensor, windows: Sequence[int], around: int = 0) -> Tensor:
    """(B, H, W) bool -> (B, H, W) bool: the pixels that affinity kernels of the wanted targets reach.

    windows : odd size of the kernel at each level, in cells of 2**level pixels
    around : and so many pixels around them
    """
    height, width = wanted.shape[-2:]
    seen = wanted
    for level, window in enumerate(windows):
        size = 2**level
        cells = F.max_pool2d(cells_with(wanted, size).float(), window, 1, window // 2) > 0
        seen = seen | cells.repeat_interleave(size, -2).repeat_interleave(size, -1)[..., :height, :width]
    return F.max_pool2d(seen.float(), 2 * around + 1, 1, around) > 0


def box_of(sources: Tensor) -> tuple[slice, slice]:
    """Rows and columns, from the grid of TARGET_CELL on, that hold all of (B, H, W) bool, some of which are true."""
    spans = []
    for axis in (1, 2):
        there = sources.any(0).any(2 - axis).nonzero()
        first, last = int(there[0]) // TARGET_CELL * TARGET_CELL, int(there[-1]) // TARGET_CELL * TARGET_CELL
        spans.append(slice(first, min(last + TARGET_CELL, sources.shape[axis])))
    return spans[0], spans[1]
