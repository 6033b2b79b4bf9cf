"""The `over` weighting: ordinary compositing deep read as weighted samples, and weighted samples written as over.

With the samples of a pixel sorted by depth and a their alpha:
    T_i = prod_{j<i} (1 - a_j);  weight w_i = a_i T_i;  contribution c_i = RGB_i T_i;  radiance c_i / w_i
and the weight that is left is one virtual miss of coverage 0, last in its pixel.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from deep_io.csr import Counts, Index, by_rank, depth_order, pixels_of, strictly_increasing
from deep_io.weighting import Floats, Packed, Weighted

_LARGEST = float(np.finfo(np.float32).max)
_SMALLEST = float(np.finfo(np.float32).tiny)  # a weight below is none: float32 would lose its digits


def decode_over(counts: Counts, radiance: Floats, alpha: Floats, depth: Floats | None) -> Weighted:
    """Ordinary deep samples as weighted ones that have the same flattened colour and alpha.

    radiance (N, 3 or more), alpha (N,), depth (N,) or None for samples stored front to back.

    Samples of equal depth act as one of joint alpha 1 - prod(1 - a_j), shared in proportion to -log1p(-a_j); opaque
    ones among them share it alone. A sample without weight (emissive, or hidden) hands its contribution to the next
    sample behind it that has weight, else to the virtual miss, and drops out. A pixel without samples is empty: one
    virtual miss of weight 1.
    """
    order = depth_order(counts, depth)
    opacity, colour = np.clip(np.asarray(alpha, np.float64), 0, 1), np.asarray(radiance, np.float64)
    if order is None:
        order = np.arange(opacity.size, dtype=np.int64)
    else:
        opacity, colour = opacity[order], colour[order]
    pixel = pixels_of(counts)
    group = _groups(pixel, None if depth is None else np.asarray(depth)[order])
    share, joint = _shares(group, opacity)
    in_front, left = _transmittance(counts, pixel, group, joint)
    weight = in_front * share
    # Within a group each sample is seen in proportion to its share of the joint alpha; an emissive one is seen whole.
    seen = np.divide(share, opacity, out=np.ones_like(share), where=opacity > 0)
    contribution = colour * (in_front * seen)[:, None]
    # A contribution too bright for its own tiny weight in float32 is handed on like that of an emissive sample.
    holds = (weight > _SMALLEST) & (np.abs(contribution).max(axis=1) < weight * (_LARGEST / 2))
    left += np.bincount(pixel[~holds], weight[~holds], counts.size)
    return _hand_on(counts, order, pixel, holds, weight, contribution, left)


def encode_over(counts: Counts, weight: Floats, coverage: Floats, depth: Floats) -> Packed:
    """Weighted samples in over form: alpha_i = w_i A_i / T_i, colour = radiance * scale with scale_i = w_i / T_i.

    weight (N,) sums to 1 per pixel, coverage (N,) in 0..1, depth (N,) finite. T_i = 1 - sum_{j<i} w_j A_j, never
    below w_i. Composited front to back the result is sum w_i radiance_i with alpha sum w_i A_i.
    """
    order = depth_order(counts, depth)
    order = np.arange(depth.size, dtype=np.int64) if order is None else order
    weights, opacity = np.asarray(weight, np.float64)[order], np.asarray(coverage, np.float64)[order]
    reach = np.empty(depth.size)
    remaining = np.ones(counts.size)
    for here, pixels in by_rank(counts):
        reach[here] = np.maximum(remaining[pixels], weights[here])
        remaining[pixels] -= weights[here] * opacity[here]
    scale = np.divide(weights, reach, out=np.zeros_like(reach), where=reach > 0)
    return Packed(order, strictly_increasing(counts, np.asarray(depth, np.float32)[order]), scale * opacity, scale)


def _groups(pixel: Index, depth: Floats | None) -> Index:
    """(N,) running number of each run of equal depth within a pixel."""
    if depth is None or not pixel.size:
        return np.arange(pixel.size, dtype=np.int64)
    starts = (pixel[1:] != pixel[:-1]) | (depth[1:] != depth[:-1])
    return np.concatenate([np.zeros(1, np.int64), np.cumsum(starts, dtype=np.int64)])


def _shares(group: Index, opacity: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Each sample's part of its group's joint alpha (N,), and the joint alpha (G,)."""
    groups = int(group[-1]) + 1 if group.size else 0
    if groups == group.size:  # every sample alone: its alpha to the last bit
        return opacity, opacity
    opaque = opacity == 1
    extinction = -np.log1p(-np.where(opaque, 0, opacity))
    opaque_in = np.bincount(group, opaque, groups)
    extinction_in = np.bincount(group, extinction, groups)
    joint = np.where(opaque_in > 0, 1.0, -np.expm1(-extinction_in))
    alone = np.bincount(group, minlength=groups) == 1
    joint[alone] = opacity[alone[group]]
    share = np.divide(joint[group] * extinction, extinction_in[group], out=np.zeros_like(opacity),
                      where=extinction_in[group] > 0)
    blocked = opaque_in[group] > 0
    share[blocked] = opaque[blocked] / opaque_in[group][blocked]
    return np.where(alone[group], opacity, share), joint


def _transmittance(counts: Counts, pixel: Index, group: Index, joint: NDArray[np.float64]
                   ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """What reaches the depth of each sample (N,), and what is left behind the last of each pixel (P,)."""
    starts = np.ones(pixel.size, bool)
    starts[1:] = group[1:] != group[:-1]
    groups_of = np.bincount(pixel[starts], minlength=counts.size).astype(np.int32)
    left, in_front = np.ones(counts.size), np.empty(joint.size)
    for here, pixels in by_rank(groups_of):
        in_front[here] = left[pixels]
        left[pixels] *= 1 - joint[here]
    return in_front[group], left


def _hand_on(counts: Counts, order: Index, pixel: Index, holds: NDArray[np.bool_], weight: NDArray[np.float64],
             contribution: NDArray[np.float64], left: NDArray[np.float64]) -> Weighted:
    """Drop the samples that hold no weight, hand their contributions on and append each pixel's virtual miss."""
    has_miss = left > _SMALLEST
    kept_counts = np.bincount(pixel[holds], minlength=counts.size)
    new_counts = (kept_counts + has_miss).astype(np.int32)
    ends = np.cumsum(new_counts, dtype=np.int64)
    is_miss = np.zeros(int(ends[-1]) if ends.size else 0, bool)
    is_miss[ends[has_miss] - 1] = True

    source = np.full(is_miss.size, -1, np.int64)
    weights, colour = np.zeros(is_miss.size), np.zeros((is_miss.size, contribution.shape[1]))
    source[~is_miss], weights[~is_miss], colour[~is_miss] = order[holds], weight[holds], contribution[holds]
    weights[is_miss] = left[has_miss]

    giving = np.flatnonzero(~holds & contribution.any(axis=1))
    # Where the next holder behind i sits in the output: as many samples of its pixel before it as holders before i.
    # Behind the last holder that is the miss; a pixel without a miss gives to its last holder.
    holders_before = np.cumsum(holds)[giving] - (np.cumsum(kept_counts) - kept_counts)[pixel[giving]]
    first = (ends - new_counts)[pixel[giving]]
    receiver = first + np.minimum(holders_before, new_counts[pixel[giving]] - 1)
    for channel in range(contribution.shape[1]):
        colour[:, channel] += np.bincount(receiver, contribution[giving, channel], is_miss.size)
    value = colour / weights[:, None]
    return Weighted(new_counts, source, weights.astype(np.float32), (~is_miss).astype(np.float32),
                    np.clip(value, -_LARGEST, _LARGEST).astype(np.float32))
