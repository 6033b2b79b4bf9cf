"""Filtered layers -> `Layers`, the one output type: what each layer visibly contributes to the beauty.

Front to back, with alpha_l = (K w_l) / (K n_l) and T_l = prod_{k<l} (1 - alpha_k):
C_l = T_l (K R_l) / (K n_l),  V_l = T_l alpha_l,  A_l = T_l (K a_l) / (K n_l).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor


@dataclass
class Layers:
    """Visible contributions, additive over layers: the beauty is `color.sum(1)`, its alpha `coverage.sum(1)`.

    color : (B, L, 3, H, W) C_l, radiance times visible weight
    weight : (B, L, H, W) V_l >= 0, sums to 1 over layers wherever any sample reaches
    coverage : (B, L, H, W) A_l, 0 <= A_l <= V_l
    depth : (B, L, H, W) Z_l, mean depth of the layer's hits in scene units, inf where it has none
    """

    color: Tensor
    weight: Tensor
    coverage: Tensor
    depth: Tensor

    def beauty(self) -> Tensor:
        """(B, 3, H, W) denoised radiance."""
        return self.color.sum(1)

    def alpha(self) -> Tensor:
        """(B, H, W) denoised coverage."""
        return self.coverage.sum(1)


def transmittance(alpha: Tensor) -> Tensor:
    """alpha (B, L, H, W) in 0..1 -> T (B, L, H, W): what the layers in front of each layer let through; T_0 = 1."""
    through = torch.cumprod(1 - alpha, 1)
    return torch.cat([torch.ones_like(alpha[:, :1]), through[:, :-1]], 1)


def fill_holes(layers: Layers) -> Layers:
    """Fills targets that no sample reaches from weight-summed 2x2 push-pull levels, all layers together.

    Pull: sums over ever larger cells until every pixel's cell has weight; push: such a pixel takes its cell's mean.
    Nothing is changed where every target is reached, and nothing can be where no sample exists at all.
    """
    reached = layers.weight.sum(1, keepdim=True) > 0  # (B, 1, H, W)
    if bool(reached.all()) or not bool(reached.any()):
        return layers
    batch, count, _, height, width = layers.color.shape
    depth = torch.where(layers.depth.isfinite(), layers.depth, 0) * layers.coverage
    stack = torch.cat([layers.color.flatten(1, 2), layers.weight, layers.coverage, depth, reached.to(depth.dtype)], 1)
    filled, known, size = stack, reached, 1
    while not bool(known.all()) and size < max(height, width):
        size *= 2
        pad = (0, -width % size, 0, -height % size)
        sums = F.avg_pool2d(F.pad(stack, pad), size)
        up = sums.repeat_interleave(size, 2).repeat_interleave(size, 3)[..., :height, :width]
        found = ~known & (up[:, -1:] > 0)
        filled = torch.where(found, up / torch.where(up[:, -1:] > 0, up[:, -1:], 1), filled)
        known = known | found
    color, weight, coverage, depth, _ = filled.split((3 * count, count, count, count, 1), 1)
    return Layers(
        color=color.unflatten(1, (count, 3)),
        weight=weight,
        coverage=coverage,
        depth=torch.where(coverage > 0, depth / torch.where(coverage > 0, coverage, 1), torch.inf),
    )
