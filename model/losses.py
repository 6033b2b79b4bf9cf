"""Training losses on pictures (B, 3, H, W), in the common scale of the metrics (`k * radiance`, see metrics.py).

The target is noisy, too. Squared errors whose divisor depends on the prediction alone have the clean picture as their
minimum whatever the target's noise (Lehtinen et al. 2018, "Noise2Noise", section 3): `relative_error`. SMAPE and errors
of tone-mapped pictures do not, their minimum lies nearer to the median, so they want clean targets, or their low
frequencies only, where the noise is averaged away.

Every term is a mean over the crops, so the loss of a batch is the mean of the losses of its parts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import torch
import torch.nn.functional as F
from torch import Tensor

EPSILON = 0.01  # of both SMAPE and relative error, the metrics' own
OUTLIER = 100.0  # relative squared errors saturate here: one firefly in a target must not own a step
BEYOND = 4.0  # times a target that a prediction is measured by its own size; above that noise is no excuse
LEAK_CUT = 30.0  # the same of `leaks`, for fireflies in a reference: a leak stays below 1 / SMALLER^2
SMALLER = 0.25  # times a prediction that a reference counts as at least: leaks are errors, not infinite ones
GLARE = 2.0  # in the common scale, four times the mean: what is brighter counts as much for `darkness`
SMOOTHING_WINDOW, SMOOTHING_SPREAD = 5, 0.4  # pixels, log units: what of a noisy reference is one surface
LOG_FLOOR = 1e-3  # added to a crop's relative error before its logarithm
SRGB_LINEAR, SRGB_SLOPE, SRGB_SCALE, SRGB_OFFSET, SRGB_POWER = 0.0031308, 12.92, 1.055, 0.055, 2.4


@dataclass(frozen=True)
class LossWeights:
    """How much each term counts; a term of weight 0 is not computed."""

    smape: Annotated[float, "SMAPE, the paper's loss: |d - y| / (|d| + |y| + 0.01)"] = 0.5
    relative: Annotated[
        float, "log of a crop's squared error relative to the prediction, or to 4 times the reference where that is "
               "less, outliers cut: a hard crop counts no more than an easy one"
    ] = 0.2
    leaks: Annotated[
        float, "log of a crop's squared error relative to the reference, smoothed between edges, or to a quarter of "
               "the prediction where that is more, outliers cut: what is too bright in the dark counts by the dark"
    ] = 0.0
    darkness: Annotated[
        float, "share of a crop's light that is lost, less what is won, against terms that would rather be too dark: "
               "linear up to twice the reference. What is brighter than four times the mean counts as just that: "
               "otherwise making lamps larger would pay"
    ] = 0.0
    noise2noise: Annotated[
        float, "squared error relative to the prediction, (d - y)^2 / (d^2 + 0.01), uncut: safe for noisy references"
    ] = 0.0
    tone_mapped: Annotated[float, "squared error of the pictures as sRGB of log(1 + x)"] = 0.0
    pooled: Annotated[
        tuple[tuple[int, float], ...],
        "pairs of a cell size in pixels, up to that of a crop, and the weight of the SMAPE of pictures averaged over "
        "such cells"
    ] = ((8, 0.5), (32, 0.5))


def smape(prediction: Tensor, target: Tensor) -> Tensor:
    """|d - y| / (|d| + |y| + 0.01), mean over everything."""
    return ((prediction - target).abs() / (prediction.abs() + target.abs() + EPSILON)).mean()


def relative_error(prediction: Tensor, target: Tensor) -> Tensor:
    """(d - y)^2 / (stopgrad(d)^2 + 0.01) per value."""
    return (prediction - target).square() / (prediction.detach().square() + EPSILON)


def noise2noise(prediction: Tensor, target: Tensor) -> Tensor:
    """Mean of `relative_error`: its gradient vanishes, on average over noisy targets, at their mean."""
    return relative_error(prediction, target).mean()


def log_relative(prediction: Tensor, target: Tensor) -> Tensor:
    """Mean over crops of log(mean((d - y)^2 / (m^2 + 0.01)) + 1e-3), m = min(|d|, 4 |y| + 0.1), outliers saturated.

    The logarithm gives an easy crop and a hard one the same say, as the geometric mean over scenes does. Relative to
    the prediction alone, a lamp that leaks into the dark beside it would be an error of 1, however bright it is.
    """
    scale = torch.minimum(prediction.detach().abs(), BEYOND * target.abs() + EPSILON**0.5)
    error = (prediction - target).square() / (scale.square() + EPSILON)
    error = error / (1 + error.detach() / OUTLIER)
    return torch.log(error.mean((1, 2, 3)) + LOG_FLOOR).mean()


def leaks(prediction: Tensor, target: Tensor) -> Tensor:
    """Mean over crops of log(mean((d - y)^2 / (m^2 + 0.01)) + 1e-3), m = max(smooth(|y|), |d| / 4), outliers saturated.

    The reference's own noise must not divide: what is dark by chance would count most, and the minimum be too dark.
    """
    scale = torch.maximum(smoothed(target), SMALLER * prediction.detach().abs())
    error = (prediction - target).square() / (scale.square() + EPSILON)
    error = error / (1 + error.detach() / LEAK_CUT)
    return torch.log(error.mean((1, 2, 3)) + LOG_FLOOR).mean()


def darkness(prediction: Tensor, target: Tensor) -> Tensor:
    """Mean over crops and colours of 1 - mean(d) / mean(y), at least -1; 0 for a colour that should be black.

    d and y are clipped at GLARE: a lamp that is made larger by its edge is no light won.
    """
    light = target.clamp_max(GLARE).mean((2, 3))
    lit = light > EPSILON
    lost = 1 - prediction.clamp_max(GLARE).mean((2, 3)) / torch.where(lit, light, 1)
    return (lost.clamp_min(-1) * lit).mean()


def smoothed(picture: Tensor) -> Tensor:
    """(B, 3, H, W): bilateral mean of |picture| over SMOOTHING_WINDOW pixels; edges are of the colours' mean log."""
    radius = SMOOTHING_WINDOW // 2
    height, width = picture.shape[-2:]
    picture = picture.abs()
    brightness = torch.log(picture + EPSILON).mean(1, keepdim=True)
    padded = F.pad(torch.cat([picture, brightness], 1), (radius,) * 4, mode="replicate")
    sums, weights = torch.zeros_like(picture), torch.zeros_like(brightness)
    for dy in range(SMOOTHING_WINDOW):
        for dx in range(SMOOTHING_WINDOW):
            near = padded[..., dy : dy + height, dx : dx + width]
            weight = torch.exp(-0.5 * ((near[:, 3:] - brightness) / SMOOTHING_SPREAD).square())
            sums += weight * near[:, :3]
            weights += weight
    return sums / weights


def held_error(prediction: Tensor, held: Tensor, variance: Tensor, known: Tensor) -> Tensor:
    """Mean of (d - y)^2 / (stopgrad(d)^2 + 0.01 + variance) over the known pixels, a scalar.

    y are means of a few samples that the prediction was not made of, `variance` (B, 3, H, W) that of these means: where
    they are so noisy that they tell nothing, they count for little. known (B, 1, H, W) bool. 0 if none is.

    The minimum is the clean picture as far as the variance is not told by y itself; else it is darker.
    """
    error = (prediction - held).square() / (prediction.detach().square() + EPSILON + variance)
    return (error * known).sum() / (3 * known.sum().clamp_min(1))


def drift(prediction: Tensor, start: Tensor, variance: Tensor) -> Tensor:
    """Mean of (d - s)^2 / (s^2 + 0.01), where the samples are so noisy that they tell nothing, a scalar.

    s is what the network made of all samples before it was changed. Weighted by variance / (s^2 + 0.01 + variance),
    what `held_error` leaves uncounted.
    """
    size = start.square() + EPSILON
    return ((prediction - start).square() / size * (variance / (size + variance))).mean()


def tone_map(picture: Tensor) -> Tensor:
    """sRGB transfer function of log(1 + max(x, 0)), not clamped above."""
    y = torch.log1p(picture.clamp_min(0))
    curve = SRGB_SCALE * y.clamp_min(SRGB_LINEAR) ** (1 / SRGB_POWER) - SRGB_OFFSET
    return torch.where(y <= SRGB_LINEAR, SRGB_SLOPE * y, curve)


def tone_mapped(prediction: Tensor, target: Tensor) -> Tensor:
    """Mean squared error of the tone-mapped pictures."""
    return (tone_map(prediction) - tone_map(target)).square().mean()


def total_loss(prediction: Tensor, target: Tensor, weights: LossWeights) -> Tensor:
    """The weighted sum, a scalar; prediction and target (B, 3, H, W) in the common scale."""
    loss = prediction.new_zeros(())
    for term in (smape, leaks, darkness, noise2noise, tone_mapped):
        weight = getattr(weights, term.__name__)
        if weight:
            loss = loss + weight * term(prediction, target)
    if weights.relative:
        loss = loss + weights.relative * log_relative(prediction, target)
    for size, weight in weights.pooled:
        size = min(size, *prediction.shape[-2:])
        loss = loss + weight * smape(F.avg_pool2d(prediction, size), F.avg_pool2d(target, size))
    return loss
