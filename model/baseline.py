"""The untrained baseline that every network must beat: clamp the brightest samples, average, blur a little.

Works on NumPy arrays of linear RGB; no files.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

CLAMP_PERCENTILE = 99.5
SIGMA = 1.0
RADIUS = 4
"""In pixels, four sigmas: what lies beyond weighs under 1e-4."""


def clamp_and_blur(
    counts: NDArray[np.integer[Any]], weight: NDArray[np.floating[Any]], radiance: NDArray[np.floating[Any]]
) -> NDArray[np.float64]:
    """The baseline's picture, (H, W, 3).

    `counts` (H, W) samples per pixel, their `weight` (N,) summing to 1 in a pixel, their `radiance` (N, 3). Every
    value is clamped at the 99.5th percentile of all sample values of the frame; the pixels' means are then blurred.
    """
    if radiance.size == 0:
        return np.zeros((*counts.shape, 3))
    return blur(pixel_means(counts, weight, np.minimum(radiance, np.percentile(radiance, CLAMP_PERCENTILE))))


def pixel_means(
    counts: NDArray[np.integer[Any]], weight: NDArray[np.floating[Any]], values: NDArray[np.floating[Any]]
) -> NDArray[np.float64]:
    """Weighted mean of `values` (N, C) over the samples of each pixel: (H, W, C); 0 where there are none."""
    pixel = np.repeat(np.arange(counts.size), counts.ravel())
    sums = [np.bincount(pixel, weight * channel.astype(np.float64), counts.size) for channel in values.T]
    means: NDArray[np.float64] = np.stack(sums, axis=-1, dtype=np.float64).reshape(*counts.shape, values.shape[1])
    return means


def blur(image: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """Gaussian of sigma 1 pixel on (H, W, C); beyond the border the picture is mirrored, its edge pixel repeated."""
    offsets = np.arange(-RADIUS, RADIUS + 1)
    taps = np.exp(-0.5 * (offsets / SIGMA) ** 2)
    taps /= taps.sum()
    height, width = image.shape[:2]
    padded = np.pad(image.astype(np.float64), ((RADIUS, RADIUS), (RADIUS, RADIUS), (0, 0)), mode="symmetric")
    rows = np.stack([tap * padded[i : i + height] for i, tap in enumerate(taps)]).sum(axis=0)
    blurred: NDArray[np.float64] = np.stack([tap * rows[:, i : i + width] for i, tap in enumerate(taps)]).sum(axis=0)
    return blurred
