"""Filtered layers -> `Layers`, the one output type: what each layer visibly contributes to the beauty.

Front to back, with alpha_l = (K w_l) / (K n_l) and T_l = prod_{k<l} (1 - alpha_k):
C_l = T_l (K R_l) / (K n_l),  V_l = T_l alpha_l,  A_l = T_l (K a_l) / (K n_l).
"""

from __future__ import annotations

from collections.abc import Sequence
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
    depth : (B, L, H, W) Z_l, mean depth of the layer's hits in scene units, inf where it has none; 1 without that role
    extra : (B, L, E, H, W) what each layer adds to the extra values of the samples; E is 0 without any
    """

    color: Tensor
    weight: Tensor
    coverage: Tensor
    depth: Tensor
    extra: Tensor

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


def composite(means: Tensor, joint_mass: Tensor | None = None) -> Tensor:
    """Filtered layers -> what is visible of them.

    Parameters
    ----------
    means : (B, L, 6 + E, H, W) per unit of the filtered occupancy: radiance (3), coverage, coverage * depth, share
        w / n, extra values
    joint_mass : (B, L, H, W) log of the filtered own weight. If given, the layers are averaged by it instead of being
        composited front to back (LAYER_w), and `means` are per unit of that weight.

    Returns
    -------
    (B, L, 6 + E, H, W) visible planes, additive over layers: C (3), A, A * Z, V, extra; 0 where no sample is in reach.
    """
    alpha = means[:, :, 5].clamp(0, 1)
    if joint_mass is None:
        visible = transmittance(alpha)
        weight = visible * alpha
    else:
        reached = joint_mass.amax(1, keepdim=True) > -torch.inf
        visible = weight = torch.softmax(torch.where(reached, joint_mass, 0), 1) * reached
    planes = means[:, :, :5] * visible[:, :, None]
    color, coverage, depth = torch.split(planes, [3, 1, 1], 2)
    extra = means[:, :, 6:] * visible[:, :, None]
    return torch.cat([color, torch.minimum(coverage, weight[:, :, None]), depth, weight[:, :, None], extra], 2)


def mix_levels(finished: Sequence[Tensor], preference: Tensor) -> Tensor:
    """The paper's pyramid: out = sum_i lambda_i up(G_i), every level composited to completion.

    finished : visible planes of each level, (B, L, 6, H / 2**i, W / 2**i)
    preference : (B, levels, H, W) logits of lambda; where a level reaches no sample its lambda goes to the others
    """
    if len(finished) == 1:
        return finished[0]
    size = finished[0].shape[-2:]
    whole, reached = [], []
    for level, planes in enumerate(finished):
        weight = planes[:, :, 5].sum(1, keepdim=True)  # (B, 1, h, w): 1 where any sample is in reach, else 0
        flat = torch.cat([planes.flatten(1, 2), weight], 1)
        if level:
            flat = F.interpolate(flat, size=size, mode="bilinear", align_corners=False)
        up = flat[:, -1:]
        some = up > 0
        whole.append(torch.unflatten(flat[:, :-1] / torch.where(some, up, 1), 1, planes.shape[1:3]))
        reached.append(some)
    open_levels = torch.cat(reached, 1)  # (B, levels, H, W)
    nowhere = ~open_levels.any(1, keepdim=True)
    lam = torch.softmax(preference.masked_fill(~(open_levels | nowhere), -torch.inf), 1)
    mixed = sum(lam[:, level, None, None] * planes for level, planes in enumerate(whole))
    assert isinstance(mixed, Tensor)
    return mixed


def to_layers(visible: Tensor) -> Layers:
    """Visible planes (B, L, 6 + E, H, W), see `composite` -> `Layers`."""
    color, coverage, depth, weight = visible[:, :, :3], visible[:, :, 3], visible[:, :, 4], visible[:, :, 5]
    some = coverage > 0
    by = torch.where(some, coverage, 1)
    if torch.is_grad_enabled():  # the derivative divides by the square, which must not vanish: 0 / 0 would spread
        firm = by > torch.finfo(by.dtype).tiny ** 0.5
        by, depth = torch.where(firm, by, by.detach()), torch.where(firm, depth, depth.detach())
    return Layers(color, weight, coverage, torch.where(some, depth / by, torch.inf), visible[:, :, 6:])


def fill_holes(layers: Layers) -> Layers:
    """Fills targets that no sample reaches from weight-summed 2x2 push-pull levels, all layers together.

    Pull: sums over ever larger cells until every pixel's cell has weight; push: such a pixel takes its cell's mean.
    Nothing is changed where every target is reached, and nothing can be where no sample exists at all.
    """
    reached = layers.weight.sum(1, keepdim=True) > 0  # (B, 1, H, W)
    if bool(reached.all()) or not bool(reached.any()):
        return layers
    count, _, height, width = layers.color.shape[1:]
    depth = torch.where(layers.depth.isfinite(), layers.depth, 0) * layers.coverage
    stack = torch.cat([layers.color.flatten(1, 2), layers.weight, layers.coverage, depth, layers.extra.flatten(1, 2),
                       reached.to(depth.dtype)], 1)
    holes = torch.stack((~reached[:, 0]).nonzero(as_tuple=True))  # image, row, column
    sums, size, places, values = stack, 1, [], []
    while holes.shape[1] and size < max(height, width):
        size *= 2
        sums = F.avg_pool2d(F.pad(sums, (0, sums.shape[-1] % 2, 0, sums.shape[-2] % 2)), 2)
        cell = sums[holes[0], :, holes[1] // size, holes[2] // size]
        found = cell[:, -1] > 0
        places.append(holes[:, found])
        values.append(cell[found] / cell[found, -1:])
        holes = holes[:, ~found]
    image, row, column = torch.cat(places, 1)
    filled = stack.clone()
    filled[image, :, row, column] = torch.cat(values)
    sizes = [3 * count, count, count, count, count * layers.extra.shape[2], 1]
    color, weight, coverage, depth, extra, _ = torch.split(filled, sizes, 1)
    basic = [plane[:, :, None] for plane in (coverage, depth, weight)]
    return to_layers(torch.cat([torch.unflatten(color, 1, (count, 3)), *basic,
                                torch.unflatten(extra, 1, (count, layers.extra.shape[2]))], 2))
