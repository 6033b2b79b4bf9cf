"""How far an image is from its reference: the metrics of the docs, in float64, on NumPy arrays.

Images are linear RGB, (H, W, 3), of any float type. All metrics but the energy ratio are taken after one common scale
(`common_scale`), so that they do not depend on the exposure of a picture. No files, no pictures.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.floating[Any]]
Float64 = NDArray[np.float64]

EPSILON = 0.01
"""Keeps dark pixels from ruling relMSE and SMAPE; published figures use it."""
SMALL_EPSILON = 0.0001
"""The stricter relMSE: dark regions count almost as much as bright ones."""
TRIMMED_SHARE = 0.001
"""Share of the pixels, the worst ones, that the trimmed relMSE leaves out: one firefly can be half of the mean."""
MID_GREY = 0.5
SCALE_PERCENTILE = 99.0

SSIM_SIGMA = 1.5
SSIM_RADIUS = 5
SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2


@dataclass(frozen=True)
class Scores:
    """One image against its reference. Errors are 0 for equal images, SSIM 1, PSNR infinite."""

    relmse: float
    relmse_trimmed: float
    relmse_small_epsilon: float
    smape: float
    psnr: float
    """Decibels, on tone-mapped values."""
    ssim: float
    """On tone-mapped values; NaN for images under 11 x 11."""
    energy: float
    """Mean of the image over mean of the reference."""
    flip: float | None = None
    """HDR-FLIP; None where flip-evaluator is not installed."""
    relmse_unbiased: float | None = None
    """relMSE free of the reference's own noise; None without a second half. May be slightly negative."""
    floor: float | None = None
    """relMSE that the reference itself has, so that no image can be told from a perfect one below it."""


def score(image: Image, reference: Image, other_half: Image | None = None, *, with_flip: bool = True) -> Scores:
    """All metrics of `image` (H, W, 3) against `reference` (H, W, 3).

    With `other_half`, `reference` and `other_half` are two independent renderings; their mean is the reference.
    Raises ValueError for shapes that differ, values that are not finite and a reference whose mean is not positive.
    """
    d = _checked(image, "the image")
    r = _checked(reference, "the reference")
    halves: tuple[Float64, Float64] | None = None
    if other_half is not None:
        halves = r, _same_shape(_checked(other_half, "the other half"), r)
        r = (halves[0] + halves[1]) / 2.0
    _same_shape(d, r)
    k = common_scale(r)
    energy = float(d.mean() / r.mean())
    d, r = k * d, k * r
    unbiased = floor = None
    if halves is not None:
        a, b = k * halves[0], k * halves[1]
        unbiased, floor = relmse_unbiased(d, a, b), reference_floor(a, b)
    return Scores(
        relmse=relmse(d, r),
        relmse_trimmed=relmse_trimmed(d, r),
        relmse_small_epsilon=relmse(d, r, SMALL_EPSILON),
        smape=smape(d, r),
        psnr=psnr(d, r),
        ssim=ssim(d, r),
        energy=energy,
        flip=flip(d, r) if with_flip else None,
        relmse_unbiased=unbiased,
        floor=floor,
    )


def common_scale(reference: Image) -> float:
    """k = 0.5 / mean(min(reference, its 99th percentile)): the reference's mean, fireflies apart, becomes mid grey.

    Raises ValueError when that mean is not positive, and says whether for lack of light or for negative values.
    """
    r = np.asarray(reference, dtype=np.float64)
    mean = float(np.minimum(r, np.percentile(r, SCALE_PERCENTILE)).mean())
    if not mean > 0.0:
        why = f"the reference's mean is {mean:g}, its brightest 1 % clipped: negative values outweigh its light"
        if not (r > 0.0).any():
            why = "the reference has no light in it: no value is above 0"
        elif not (r < 0.0).any():
            why = "99 % of the reference's values are black"
        raise ValueError(f"{why}, so there is no scale to measure on")
    return MID_GREY / mean


def relative_squared_error(d: Float64, r: Float64, epsilon: float = EPSILON) -> Float64:
    """(d - r)^2 / (r^2 + epsilon) per value, on images already scaled."""
    error: Float64 = (d - r) ** 2 / (r**2 + epsilon)
    return error


def relmse(d: Float64, r: Float64, epsilon: float = EPSILON) -> float:
    """mean((d - r)^2 / (r^2 + epsilon)), on images already scaled."""
    return float(relative_squared_error(d, r, epsilon).mean())


def relmse_trimmed(d: Float64, r: Float64, share: float = TRIMMED_SHARE) -> float:
    """relMSE without the `share` of pixels (rounded up) that are worst; NaN when none is left."""
    pixels = np.sort(relative_squared_error(d, r).mean(axis=-1), axis=None)
    kept = pixels[: pixels.size - math.ceil(share * pixels.size)]
    return float(kept.mean()) if kept.size else math.nan


def relmse_unbiased(d: Float64, a: Float64, b: Float64) -> float:
    """mean((d - a)(d - b) / (r^2 + 0.01)), r = (a + b) / 2: the noise of independent a and b cancels on average.

    Only r in the denominator keeps some of it, which matters where the reference itself is very noisy.
    """
    return float(((d - a) * (d - b) / (((a + b) / 2.0) ** 2 + EPSILON)).mean())


def reference_floor(a: Float64, b: Float64) -> float:
    """relMSE of the mean of two independent halves against the truth: its variance is mean((a - b)^2) / 4."""
    return float(((a - b) ** 2 / 4.0 / (((a + b) / 2.0) ** 2 + EPSILON)).mean())


def smape(d: Float64, r: Float64) -> float:
    """mean(|d - r| / (|d| + |r| + 0.01)), on images already scaled."""
    return float((np.abs(d - r) / (np.abs(d) + np.abs(r) + EPSILON)).mean())


def tone_mapped(scaled: Image) -> Float64:
    """G(log(1 + x)) clamped to [0, 1], G the sRGB transfer function; negative values count as 0."""
    y = np.log1p(np.maximum(np.asarray(scaled, dtype=np.float64), 0.0))
    encoded = np.where(y <= 0.0031308, 12.92 * y, 1.055 * np.maximum(y, 0.0031308) ** (1.0 / 2.4) - 0.055)
    result: Float64 = np.clip(encoded, 0.0, 1.0)
    return result


def psnr(d: Float64, r: Float64) -> float:
    """-10 log10 of the mean squared error of the tone-mapped images, in decibels; infinite for equal ones."""
    error = float(((tone_mapped(d) - tone_mapped(r)) ** 2).mean())
    return -10.0 * math.log10(error) if error > 0.0 else math.inf


def ssim(d: Float64, r: Float64) -> float:
    """Mean structural similarity of the tone-mapped images (Wang 2004: Gaussian window of sigma 1.5, 11 x 11).

    Averaged over all whole windows and the three channels; NaN when not one window fits.
    """
    x, y = tone_mapped(d), tone_mapped(r)
    if min(x.shape[:2]) < 2 * SSIM_RADIUS + 1:
        return math.nan
    mean_x, mean_y = _window_mean(x), _window_mean(y)
    variance_x = _window_mean(x * x) - mean_x**2
    variance_y = _window_mean(y * y) - mean_y**2
    covariance = _window_mean(x * y) - mean_x * mean_y
    similarity = ((2.0 * mean_x * mean_y + SSIM_C1) * (2.0 * covariance + SSIM_C2)) / (
        (mean_x**2 + mean_y**2 + SSIM_C1) * (variance_x + variance_y + SSIM_C2)
    )
    return float(similarity.mean())


def flip(d: Float64, r: Float64) -> float | None:
    """Mean HDR-FLIP of scaled images, or None where flip-evaluator (extra `bench`) is not installed."""
    try:
        import flip_evaluator
    except ImportError:
        return None
    reference, test = (np.ascontiguousarray(np.maximum(image, 0.0), dtype=np.float32) for image in (r, d))
    _, mean, _ = flip_evaluator.evaluate(reference, test, "HDR", applyMagma=False)
    return float(mean)


def geometric_mean(values: Sequence[float]) -> float:
    """exp(mean(log(values))): how relMSE is averaged over images. 0 if any value is 0; NaN for no values."""
    if len(values) == 0:
        return math.nan
    with np.errstate(divide="ignore"):
        return float(np.exp(np.mean(np.log(np.asarray(values, dtype=np.float64)))))


def bootstrap_interval(
    values: Sequence[float],
    statistic: Callable[[Sequence[float]], float] = geometric_mean,
    confidence: float = 0.95,
    resamples: int = 2000,
    seed: int = 0,
) -> tuple[float, float]:
    """Percentile bootstrap interval of `statistic` over images: (low, high). The same values give the same interval."""
    array = np.asarray(values, dtype=np.float64)
    if array.size == 0:
        return math.nan, math.nan
    picks = np.random.default_rng(seed).integers(array.size, size=(resamples, array.size))
    statistics = [statistic(array[pick].tolist()) for pick in picks]
    low, high = np.percentile(statistics, [50.0 * (1.0 - confidence), 50.0 * (1.0 + confidence)])
    return float(low), float(high)


def _window_mean(image: Float64) -> Float64:
    """Gaussian-weighted mean of every whole 11 x 11 window: (H, W, C) -> (H - 10, W - 10, C)."""
    offsets = np.arange(-SSIM_RADIUS, SSIM_RADIUS + 1)
    taps = np.exp(-0.5 * (offsets / SSIM_SIGMA) ** 2)
    taps /= taps.sum()
    height, width = image.shape[0] - 2 * SSIM_RADIUS, image.shape[1] - 2 * SSIM_RADIUS
    rows: Float64 = sum((t * image[i : i + height] for i, t in enumerate(taps)), np.zeros((height, *image.shape[1:])))
    return sum((t * rows[:, i : i + width] for i, t in enumerate(taps)), np.zeros((height, width, image.shape[2])))


def _checked(image: Image, name: str) -> Float64:
    array = np.asarray(image, dtype=np.float64)
    if array.ndim != 3 or array.shape[2] != 3 or array.size == 0:
        raise ValueError(f"{name} must have the shape (H, W, 3), not {array.shape}")
    bad = int(np.count_nonzero(~np.isfinite(array).all(axis=-1)))
    if bad:
        raise ValueError(f"{name} has {bad} pixels that are not finite")
    return array


def _same_shape(one: Float64, other: Float64) -> Float64:
    if one.shape != other.shape:
        raise ValueError(f"sizes differ: {one.shape[1]} x {one.shape[0]} and {other.shape[1]} x {other.shape[0]}")
    return one
