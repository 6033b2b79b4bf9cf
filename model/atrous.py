"""The classical yardstick: the edge-avoiding a-trous wavelet filter of Dammertz, Sewtz, Hanika and Lensch, HPG 2010.

Untrained; works on NumPy arrays of linear RGB and guides, one value per pixel. No files.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.floating[Any]]
Float32 = NDArray[np.float32]

SPLINE = (1 / 16, 1 / 4, 3 / 8, 1 / 4, 1 / 16)
"""B3 spline, the wavelets' scaling function; with level i its taps are 2^i pixels apart."""
LEVELS = 5
"""Five levels reach 2 * (1 + 2 + 4 + 8 + 16) = 62 pixels, as published."""

COLOR_SIGMA = 2.0
"""Of log(1 + exposure * radiance), halved with every level: what coarse levels still see as an edge is one."""
GUIDE_SIGMAS: Mapping[str, float] = {"normal": 0.3, "depth": 0.05, "albedo": 0.15}
"""Euclidean distances at which a tap has lost 1 - 1/e of its weight; for guides within -1..1 or 0..1."""


def atrous(color: Image, guides: Mapping[str, Image], levels: int = LEVELS) -> Float32:
    """Filters noisy `color` (H, W, 3), any scale, linear; returns (H, W, 3).

    Parameters
    ----------
    color : radiance, finite and not negative
    guides : any of "normal" (H, W, 3) within -1..1, "depth" (H, W, 1) within 0..1 (`bounded_depth`), "albedo"
        (H, W, 3) within 0..1
    levels : passes, each at twice the spacing of the one before

    Raises ValueError for a guide of another name or size.

    Notes
    -----
    c_(i+1)(p) = sum_q h(p - q) w_i(p, q) c_i(q) / sum_q h(p - q) w_i(p, q), where w_i is the product of
    exp(-|x(p) - x(q)|^2 / sigma^2) over the colour of level i and all guides. Colours are compared after a common
    exposure and a logarithm, so that the filter commutes with a scale of the input.
    """
    for name, guide in guides.items():
        if name not in GUIDE_SIGMAS:
            raise ValueError(f"unknown guide {name!r}; there are {', '.join(GUIDE_SIGMAS)}")
        if guide.shape[:2] != color.shape[:2]:
            raise ValueError(f"the guide {name} has {guide.shape[:2]} pixels, the colour {color.shape[:2]}")
    scaled = [np.asarray(guide, np.float32) / np.float32(GUIDE_SIGMAS[name]) for name, guide in guides.items()]
    fixed = np.concatenate(scaled, axis=-1) if scaled else np.zeros((*color.shape[:2], 0), np.float32)
    mean = float(np.asarray(color, np.float64).mean())
    exposure = 1.0 / mean if mean > 0.0 else 1.0
    result = np.asarray(color, np.float32)
    for level in range(levels):
        seen = np.log1p(np.maximum(result * np.float32(exposure), 0.0)) * np.float32(2.0**level / COLOR_SIGMA)
        result = _smooth(result, np.concatenate([fixed, seen], axis=-1), 2**level)
    return result


def bounded_depth(depth: Image, hit: NDArray[np.bool_]) -> Float32:
    """Depths (N,) as z / (z + median of the hits), a miss as 1: within 0..1, whatever the scene's unit."""
    median = float(np.median(depth[hit])) if hit.any() else 1.0
    with np.errstate(invalid="ignore", divide="ignore"):
        bounded = np.where(hit & (depth > 0.0), depth / (depth + median), 1.0)
    return bounded.astype(np.float32)


def _smooth(values: Float32, features: Float32, step: int) -> Float32:
    """One level: values (H, W, 3), features (H, W, F) in units of their sigmas; beyond the border there is nothing."""
    sums = np.zeros_like(values)
    weights = np.zeros((*values.shape[:2], 1), np.float32)
    height, width = values.shape[:2]
    for row, row_tap in enumerate(SPLINE, -2):
        for column, column_tap in enumerate(SPLINE, -2):
            y, x = row * step, column * step
            if abs(y) >= height or abs(x) >= width:
                continue
            here = slice(max(-y, 0), height - max(y, 0)), slice(max(-x, 0), width - max(x, 0))
            there = slice(max(y, 0), height + min(y, 0)), slice(max(x, 0), width + min(x, 0))
            distance = np.square(features[here] - features[there]).sum(-1, keepdims=True)
            weight = np.float32(row_tap * column_tap) * np.exp(-distance)
            sums[here] += weight * values[there]
            weights[here] += weight
    result: Float32 = np.divide(sums, weights)  # the tap at the pixel itself weighs 9/64, so no weight is 0
    return result
