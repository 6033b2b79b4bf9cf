"""Training losses on pictures (B, 3, H, W), in the common scale of the metrics (`k * radiance`, see metrics.py).

The target is noisy, too. Squared errors whose divisor depends on the prediction alone have the clean picture as their
minimum whatever the target's noise (Lehtinen et al. 2018, "Noise2Noise", section 3); SMAPE does not, its minimum lies
nearer to the median, so it enters with a small weight and only its low frequencies, where the noise is averaged away,
with a large one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

EPSILON = 0.01  # of both SMAPE and relative error, the metrics' own
OUTLIER = 100.0  # relative squared errors saturate here: one firefly in a target must not own a step


@dataclass(frozen=True)
class LossWeights:
    """How much each term counts. `pooled` are pairs of cell size in pixels and weight."""

    smape: float = 0.5
    relative: float = 0.2  # log of the crop's relative squared error
    pooled: Sequence[tuple[int, float]] = ((8, 0.5), (32, 0.5))


def smape(prediction: Tensor, target: Tensor) -> Tensor:
    """|d - y| / (|d| + |y| + 0.01), mean over everything."""
    return ((prediction - target).abs() / (prediction.abs() + target.abs() + EPSILON)).mean()


def log_relative(prediction: Tensor, target: Tensor) -> Tensor:
    """Mean over crops of log(mean((d - y)^2 / (stopgrad(d)^2 + 0.01)) + 1e-3), outliers saturated.

    The logarithm gives an easy crop and a hard one the same say, as the geometric mean over scenes does.
    """
    error = (prediction - target).square() / (prediction.detach().square() + EPSILON)
    error = error / (1 + error.detach() / OUTLIER)
    return torch.log(error.mean((1, 2, 3)) + 1e-3).mean()


def total_loss(prediction: Tensor, target: Tensor, weights: LossWeights) -> Tensor:
    """The weighted sum; prediction and target (B, 3, H, W) in the common scale."""
    loss = weights.smape * smape(prediction, target) + weights.relative * log_relative(prediction, target)
    for size, weight in weights.pooled:
        loss = loss + weight * smape(F.avg_pool2d(prediction, size), F.avg_pool2d(target, size))
    return loss
