"""The numbers that start a path: subpixel position, lens, time. Independent or stratified, one row per pixel.

Times are spread evenly over the shutter, and the order of a pixel's samples is shuffled, so that any subset is fair.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Pattern:
    """All arrays are (P, S): P pixels in row order, S samples. `jitter_*` in 0..1, lens on the unit disk, time 0..1."""

    jitter_x: Array
    jitter_y: Array
    lens_x: Array
    lens_y: Array
    time: Array


def concentric_disk(u: Array, v: Array) -> tuple[Array, Array]:
    """The unit square mapped to the unit disk with little distortion (Shirley and Chiu 1997)."""
    a, b = 2 * u - 1, 2 * v - 1
    wide = np.abs(a) > np.abs(b)
    r = np.where(wide, a, b)
    with np.errstate(divide="ignore", invalid="ignore"):
        phi = np.where(wide, np.pi / 4 * (b / a), np.pi / 2 - np.pi / 4 * (a / b))
    phi = np.where(r == 0, 0, phi)
    return (r * np.cos(phi)).astype(np.float32), (r * np.sin(phi)).astype(np.float32)


def _shuffled_strata(rng: np.random.Generator, shape: tuple[int, int]) -> Array:
    """One value in each of S equal intervals of 0..1 per row, in random order."""
    order = np.argsort(rng.random(shape, np.float32), axis=1)
    return ((order + rng.random(shape, np.float32)) / shape[1]).astype(np.float32)


def _square(rng: np.random.Generator, shape: tuple[int, int], stratified: bool) -> tuple[Array, Array]:
    """Two coordinates per sample; stratified ones form Latin hypercubes: each coordinate has one value per stratum."""
    if stratified:
        return _shuffled_strata(rng, shape), _shuffled_strata(rng, shape)
    return rng.random(shape, np.float32), rng.random(shape, np.float32)


def shutter_times(rng: np.random.Generator, shape: tuple[int, int], bins: int | None) -> Array:
    """Times (P,S), uniform in 0..1 and stratified in mirrored pairs: with an even S, the mean is 0.5 in every row.

    An odd sample falls anywhere in the stratum it has: the middle one, or with `bins` the whole shutter.
    With `bins` every time is the centre of one of `bins` equal intervals, all used equally often when S is a multiple
    of `bins`; otherwise the left-over samples take a random mirrored choice of bins.
    """
    pixels, samples = shape
    if bins is None:
        half = samples // 2
        early = (np.arange(half) + rng.random((pixels, half), np.float32)) / max(samples, 1)
        middle = (half + rng.random((pixels, samples % 2), np.float32)) / max(samples, 1)
        return np.concatenate([early, middle, 1 - early], 1).astype(np.float32)
    whole, rest = divmod(samples, bins)
    index = np.broadcast_to(np.tile(np.arange(bins), whole), (pixels, whole * bins))
    if rest:
        first = np.argsort(rng.random((pixels, bins // 2), np.float32), axis=1)[:, :rest // 2]
        index = np.concatenate([index, first, bins - 1 - first], 1)
        if rest % 2:
            index = np.concatenate([index, rng.integers(0, bins, (pixels, 1))], 1)
    return ((index + 0.5) / bins).astype(np.float32)


def join(first: Pattern, second: Pattern) -> Pattern:
    """Both patterns side by side: (P, S1 + S2)."""
    pairs = zip(vars(first).values(), vars(second).values(), strict=True)
    return Pattern(*(np.concatenate(pair, axis=1) for pair in pairs))


def make_pattern(rng: np.random.Generator, pixels: int, samples: int, stratified: bool, bins: int | None) -> Pattern:
    """A pattern of `samples` per pixel; time is stratified always, as renderers do."""
    shape = (pixels, samples)
    jitter_x, jitter_y = _square(rng, shape, stratified)
    lens_x, lens_y = concentric_disk(*_square(rng, shape, stratified))
    return Pattern(jitter_x, jitter_y, lens_x, lens_y, shutter_times(rng, shape, bins))


def shuffle_order(rng: np.random.Generator, pixels: int, samples: int) -> npt.NDArray[np.int64]:
    """Flat indices (P*S,) that put each pixel's samples in a random order of their own."""
    order = np.argsort(rng.random((pixels, samples), np.float32), axis=1)
    return (order + np.arange(pixels)[:, None] * samples).ravel()
