"""How the samples of a pixel share its weight: `uniform` and `packed`, decoded and encoded; see also over.py.

Path samples are averaged; ordinary deep is composited with over. Everything here works on flat (CSR) arrays. No file
access, and of the roles only radiance, coverage and depth.

With the samples of a pixel sorted by depth, n their number, A coverage, L radiance:
    uniform   weight 1/n each
    packed    S_k = sum_{j<k} A_j;  alpha_k = A_k / (n - S_k);  RGB_k = L_k / (n - S_k);  weight 1/n each
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from deep_io.csr import Counts, Index, by_rank, depth_order, strictly_increasing

ATTRIBUTE = "lbmc:weighting"
RADIANCE_LAYERS = "lbmc:radianceLayers"
WEIGHTINGS = ("uniform", "packed", "over")

Floats: TypeAlias = NDArray[np.floating[Any]]

# An alpha this close to 0 or 1 is 0 or 1: renderers divide by sums of filter weights in float32.
BINARY_TOLERANCE = 1e-6
# A decoded coverage this close to 1 is 1; by the type of the stored alpha, with room for a second rounding.
_ONE_TOLERANCE = {2: 2.0**-9, 4: 2.0**-20}


@dataclass
class Weighted:
    """Decoded samples of P pixels.

    counts    int32 (P,)       samples per pixel, virtual misses included
    order     int64 (M,)       which stored sample each decoded one is, -1 for a virtual miss; None: all, in place
    weight    float32 (M,)     sums to 1 in every pixel that has samples
    coverage  float32 (M,)     alpha of each sample, 0..1
    radiance  float32 (M, 3)   linear radiance of each sample, and what was decoded with it in further columns
    """

    counts: Counts
    order: Index | None
    weight: NDArray[np.float32]
    coverage: NDArray[np.float32]
    radiance: NDArray[np.float32]


def uniform_weights(counts: Counts) -> NDArray[np.float32]:
    """(N,) 1/n for every sample of a pixel with n samples."""
    flat = counts.ravel()
    with np.errstate(divide="ignore"):
        return np.repeat((1.0 / flat).astype(np.float32), flat)


def has_fractions(alpha: Floats) -> bool:
    """Whether any alpha is neither 0 nor 1, so that the samples may be ordinary deep. NaN and Inf do not count."""
    if alpha.dtype == np.float16:
        bits = alpha.view(np.uint16)
        if (((bits & 0x7FFF) == 0) | (bits == 0x3C00)).all():  # all +-0 or 1
            return False
    values = alpha.astype(np.float32, copy=False)
    binary = (np.abs(values) <= BINARY_TOLERANCE) | (np.abs(values - 1) <= BINARY_TOLERANCE)
    return bool((~binary & np.isfinite(values)).any())


def decode_uniform(counts: Counts, radiance: Floats, alpha: Floats | None) -> Weighted:
    """Samples as stored, each of weight 1/n. radiance (N, 3 or more); alpha (N,), or None for 1 everywhere."""
    colour = np.asarray(radiance, np.float32)
    coverage = np.ones(len(colour), np.float32) if alpha is None else np.asarray(alpha, np.float32)
    return Weighted(counts.ravel(), None, uniform_weights(counts), coverage, colour)


@dataclass
class Packed:
    """Samples in packed form, in the order they are written.

    order  int64 (N,)      which input sample each one is
    depth  float32 (N,)    strictly increasing within a pixel
    alpha  float64 (N,)    A_k / (n - S_k), 0..1
    scale  float64 (N,)    1 / (n - S_k): multiplies radiance and every radiance-like AOV
    """

    order: Index
    depth: NDArray[np.float32]
    alpha: NDArray[np.float64]
    scale: NDArray[np.float64]


def encode_packed(counts: Counts, coverage: Floats, depth: Floats) -> Packed:
    """Encode samples of weight 1/n so that a front-to-back over gives their mean.

    coverage (N,) in 0..1; depth (N,) finite. With S_k the coverage in front, over reaches sample k with transmittance
    (n - S_k) / n, so RGB_k adds exactly L_k / n. n - S_k is never below 1.
    """
    order = depth_order(counts, depth)
    order = np.arange(depth.size, dtype=np.int64) if order is None else order
    opacity = np.asarray(coverage, np.float64)[order]
    left = np.empty(depth.size)
    remaining = counts.ravel().astype(np.float64)
    for here, pixels in by_rank(counts):
        left[here] = remaining[pixels]
        remaining[pixels] -= opacity[here]
    return Packed(order, strictly_increasing(counts, np.asarray(depth, np.float32)[order]), opacity / left, 1 / left)


def decode_packed(counts: Counts, radiance: Floats, alpha: Floats, depth: Floats | None) -> Weighted:
    """Packed samples back to averaged ones: A_k = alpha_k (n - S_k), L_k = RGB_k (n - S_k), weight 1/n.

    A coverage within rounding of 1 becomes 1, so that the rounding of many samples in front does not add up.
    """
    order = depth_order(counts, depth)
    stored = np.asarray(alpha, np.float64)
    colour = np.asarray(radiance, np.float32)
    if order is not None:
        stored, colour = stored[order], colour[order]
    nearly_one = 1 - _ONE_TOLERANCE[alpha.dtype.itemsize]
    left, coverage = np.empty(stored.size), np.empty(stored.size)
    remaining = counts.ravel().astype(np.float64)
    for here, pixels in by_rank(counts):
        before = remaining[pixels]
        share = np.clip(stored[here] * before, 0, 1)
        share = np.where(share > nearly_one, 1, share)
        left[here], coverage[here] = before, share
        # Every sample still to come may have coverage 1, so no less than 1 is left for it.
        remaining[pixels] = np.maximum(before - share, 1)
    return Weighted(counts.ravel(), order, uniform_weights(counts), coverage.astype(np.float32),
                    colour * left[:, None].astype(np.float32))
