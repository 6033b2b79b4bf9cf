"""The untrained baseline that every network must beat: clamp the brightest pixels, blur a little.

Works on finished pictures, (H, W, 3) NumPy arrays of linear RGB.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

CLAMP_PERCENTILE = 99.5
SIGMA = 1.0
RADIUS = 4
"""In sigmas of 1 pixel: what lies beyond weighs under 1e-4."""


def clamp_and_blur(image: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """Clamps at the picture's 99.5th percentile, then blurs with a Gaussian of sigma 1 pixel; (H, W, 3) to the same.

    Beyond the border the picture is mirrored, the edge pixel repeated.
    """
    clamped = np.minimum(image, np.percentile(image, CLAMP_PERCENTILE)).astype(np.float64)
    offsets = np.arange(-RADIUS, RADIUS + 1)
    taps = np.exp(-0.5 * (offsets / SIGMA) ** 2)
    taps /= taps.sum()
    height, width = clamped.shape[:2]
    padded = np.pad(clamped, ((RADIUS, RADIUS), (RADIUS, RADIUS), (0, 0)), mode="symmetric")
    rows = np.stack([tap * padded[i : i + height] for i, tap in enumerate(taps)]).sum(axis=0)
    blurred: NDArray[np.float64] = np.stack([tap * rows[:, i : i + width] for i, tap in enumerate(taps)]).sum(axis=0)
    return blurred
