"""Slow float64 oracles, one pixel and one sample at a time, and random deep pixels for the tests of this folder."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st

seeded = settings(derandomize=True, deadline=None)  # the machine may be busy: no deadline

Sample = tuple[float, float, float]  # depth, alpha, radiance of one channel

ALPHAS = st.one_of(st.sampled_from([0.0, 1.0]), st.floats(2.0**-10, 1.0, width=32))
DEPTHS = st.one_of(st.sampled_from([1.0, 2.0, 3.0]), st.floats(0.125, 1e6, width=32))
RADIANCES = st.floats(0.0, 1e4, width=32)
PIXELS = st.lists(st.lists(st.tuples(DEPTHS, ALPHAS, RADIANCES), max_size=6), min_size=1, max_size=12)


def flat_arrays(pixels: Sequence[Sequence[Sample]]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """counts (P,), depth (N,), alpha (N,), radiance (N, 3) float32; the channels are 1, 2 and 4 times the sample's."""
    counts = np.array([len(pixel) for pixel in pixels], np.int32)
    rows = np.array([sample for pixel in pixels for sample in pixel], np.float32).reshape(-1, 3)
    return counts, rows[:, 0].copy(), rows[:, 1].copy(), rows[:, 2:] * np.array([1, 2, 4], np.float32)


def flattened(pixel: Sequence[Sample]) -> tuple[float, float]:
    """Colour and alpha of an ordinary deep pixel composited front to back, equal depths as one (see over.py)."""
    colour, transmittance = 0.0, 1.0
    for depth in sorted({sample[0] for sample in pixel}):
        group = [sample for sample in pixel if sample[0] == depth]
        colour += transmittance * sum(value for _, alpha, value in group if alpha == 0)
        solid = [sample for sample in group if sample[1] > 0]
        opaque = [sample for sample in solid if sample[1] == 1]
        if opaque:
            colour += transmittance * sum(value for _, _, value in opaque) / len(opaque)
            transmittance = 0.0
        elif solid:
            extinction = [-np.log1p(-alpha) for _, alpha, _ in solid]
            joint = -np.expm1(-sum(extinction))
            if len(solid) == 1:
                colour += transmittance * solid[0][2]
            else:
                colour += transmittance * joint * sum(
                    e / sum(extinction) * value / alpha for e, (_, alpha, value) in zip(extinction, solid, strict=True))
            transmittance *= 1 - joint
    return colour, 1 - transmittance


def per_pixel(counts: np.ndarray, values: np.ndarray) -> list[np.ndarray]:
    """The values of each pixel."""
    return np.split(values, np.cumsum(counts)[:-1])
