"""What a frame is like, measured before it is denoised: exposure and depth scale."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

EXPOSURE_BIN = 16  # pixels


def exposure_of(radiance: npt.NDArray[np.float32]) -> float:
    """Exposure (1 / radiance) of a picture of mean radiance (H, W, 3): 2^-median(log2 of the positive bin means).

    Bins are EXPOSURE_BIN pixels square, the last ones smaller; 1 if no bin is positive. Non-finite pixels count as 0.
    """
    luminance = radiance.mean(-1, dtype=np.float64)
    luminance = np.where(np.isfinite(luminance), luminance, 0)
    height, width = luminance.shape
    rows, cols = np.arange(0, height, EXPOSURE_BIN), np.arange(0, width, EXPOSURE_BIN)
    sums = np.add.reduceat(np.add.reduceat(luminance, rows, 0), cols, 1)
    areas = np.diff([*rows, height])[:, None] * np.diff([*cols, width])[None, :]
    return exposure_of_bins(sums / areas)


def exposure_of_bins(means: npt.NDArray[np.float64]) -> float:
    """Exposure from the bins' mean radiance."""
    positive = means[means > 0]
    return float(2.0 ** -np.median(np.log2(positive))) if positive.size else 1.0
