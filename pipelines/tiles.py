"""Bands: how a frame is cut into full-width strips so that a job stays within its memory budget.

A band is read with a halo as wide as the network's reach and starts on the network's grid, so that where the cuts lie
changes nothing in the result.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

BYTES_PER_SAMPLE = 160  # decoded roles in float32, and what the network holds per sample
BYTES_PER_PIXEL = 3600  # planes, predictions and context of two layers at their peak
CARRIED_PER_SAMPLE, CARRIED_PER_PIXEL = 16, 128  # more of both for each channel filtered besides the radiance
BYTES_BASE = 500 << 20  # the process with its libraries
DEFAULT_MEMORY = 4 << 30


@dataclass(frozen=True)
class Band:
    """Rows y0..y1 (exclusive) of the result, made from rows read0..read1; all count from the frame's first row."""

    y0: int
    y1: int
    read0: int
    read1: int


def memory_needed(rows: int, width: int, samples_per_pixel: float, carried: int = 0) -> int:
    """Estimated peak bytes of denoising so many full rows, with so many further channels, at once."""
    pixel = BYTES_PER_PIXEL + carried * CARRIED_PER_PIXEL
    return BYTES_BASE + round(rows * width * (pixel + (BYTES_PER_SAMPLE + carried * CARRIED_PER_SAMPLE)
                                              * samples_per_pixel))


def plan_bands(height: int, width: int, samples_per_pixel: float, reach: int, stride: int, memory: int,
               carried: int = 0) -> list[Band]:
    """The fewest equal bands that fit the budget; where none fits, bands of one stride, the smallest there are."""
    if memory_needed(height, width, samples_per_pixel, carried) <= memory:
        return [Band(0, height, 0, height)]
    per_row = memory_needed(1, width, samples_per_pixel, carried) - BYTES_BASE
    halo = 2 * reach + stride  # above, below, and down to the grid
    fitting = max((memory - BYTES_BASE) // per_row - halo, stride) // stride * stride
    rows = -(-height // -(-height // fitting))  # as many bands, but equal ones
    rows = -(-rows // stride) * stride
    return [_band(y, min(y + rows, height), height, reach, stride) for y in range(0, height, rows)]


def narrowed(bands: list[Band], busy: npt.NDArray[np.bool_], height: int, reach: int, stride: int) -> list[Band]:
    """The bands without rows of the frame that nothing is wanted of: busy (H,) says of which something is.

    What goes is whole bands, and rows above the first and below the last busy row of a band.
    """
    some = []
    for band in bands:
        rows = np.flatnonzero(busy[band.y0 : band.y1])
        if rows.size:
            first = band.y0 + int(rows[0]) // stride * stride
            some.append(_band(first, band.y0 + int(rows[-1]) + 1, height, reach, stride))
    return some


def _band(y0: int, y1: int, height: int, reach: int, stride: int) -> Band:
    read0 = max(y0 - reach, 0) // stride * stride
    return Band(y0, y1, read0, min(y1 + reach, height))
