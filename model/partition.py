"""Samples -> layers: the depth prior, the partition of each sample over layers, and the splat of samples to layers.

The splat is exact in the log domain: a sample of weight 1e-30 counts as 1e-30, and no epsilon enters a denominator.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from model.features import FrameScale, log_depth, log_radiance
from model.samples import Samples, Segments, columns

PRIOR_WINDOW = 9  # pixels; the neighbourhood that depth is compared with
OUTLIER_WINDOWS = (3, 9)  # pixels; the neighbourhoods that a sample's radiance is compared with
OWN_SHARE = 0.8  # all of it would hide a bright sample that has its pixel to itself
RARE = 4.0  # log units above the mean radiance around: seen in less than about 2 % of the samples
RADIANCE_LIMIT = 1e18  # in exposure units; sums over a window of such radiance are finite in float32
OUTLIER_START = 4.0  # log units above the surroundings from which a sample's confidence falls by itself
PRIOR_SPREAD = 0.1  # log units: depth differences well under this are one surface
PRIOR_LIMIT = 4.0  # standard deviations

# A splat's columns: log n, log w, then per unit of occupancy those of `basic_values`; what a variant adds follows.
FILTERED = slice(2, 7)
BASIC_COLUMNS = 7


def kept_logits(layers: int, logits: int) -> list[int]:
    """Which of `logits` partition logits make `layers` layers: the first ones and the last (the background)."""
    if not 1 <= layers <= logits:
        raise ValueError(f"{layers} layers asked of a network that has up to {logits}")
    return [*range(layers - 1), logits - 1]


def layer_positions(logits: int, like: Tensor) -> Tensor:
    """(logits,) positions of the layers in depth, -1 (front) to 1 (back), in the type of `like`."""
    return torch.linspace(-1.0, 1.0, logits).to(like) if logits > 1 else like.new_ones(1)


def relative_depth(samples: Samples, segments: Segments, scale: FrameScale) -> Tensor:
    """(N, 1): log depth against its neighbourhood, in spreads, - in front, + behind, +-PRIOR_LIMIT.

    (log z - mean) / (spread + PRIOR_SPREAD), mean and spread weighted over PRIOR_WINDOW pixels around the sample's
    pixel. A miss is PRIOR_LIMIT behind, also where nothing is in front of it: the sky is the background everywhere.
    """
    batch, height, width = samples.shape
    hit = (samples.coverage > 0)[:, None]
    depth = torch.where(hit, samples.roles["depth"], scale.depth)
    zeta = log_depth(depth, scale.depth)
    weight = samples.weight[:, None] * hit
    moments = segments.sum(columns([weight, weight * zeta, weight * zeta * zeta]))  # (P, 3)
    around = window_sums(moments.T.reshape(3, batch, height, width), PRIOR_WINDOW).view(3, -1, 1)
    total, first, second = around
    some = total > 0
    safe = torch.where(some, total, 1)
    mean = first / safe
    spread = (second / safe - mean * mean).clamp_min(0).sqrt()
    scaled = some / (spread + PRIOR_SPREAD)  # where nothing is around, nothing is known
    relative = (zeta - segments.expand(mean)) * segments.expand(scaled)
    return torch.where(hit, relative.clamp(-PRIOR_LIMIT, PRIOR_LIMIT), PRIOR_LIMIT)


def window_sums(picture: Tensor, window: int) -> Tensor:
    """(..., H, W) -> (..., H, W): sums over window x window (odd) pixels around each pixel, along axis by axis."""
    for axis in (-1, -2):
        radius, length = window // 2, picture.shape[axis]
        padded = F.pad(picture, (radius, radius) if axis == -1 else (0, 0, radius, radius))
        picture = padded.narrow(axis, 0, length).clone()
        for shift in range(1, window):
            picture += padded.narrow(axis, shift, length)
    return picture


@dataclass
class LayerSplat:
    """What the samples of each pixel put into each layer, (P, L) and (P, L, C), per unit of occupancy.

    log_n : log of the occupancy n_l = sum_{k>=l} w_k, -inf where nothing is in this layer or behind it
    log_w : log of the layer's own weight w_l
    values : sum_i w_i p_il value_i / n_l, 0 where n_l is 0
    """

    log_n: Tensor
    log_w: Tensor
    values: Tensor


def hit_depth(samples: Samples, scale: FrameScale) -> tuple[Tensor, Tensor]:
    """(N, 1) whether a sample hit anything, and its depth: the median on a miss; without the role 1 on a hit."""
    hit = (samples.coverage > 0)[:, None]
    if "depth" not in samples.roles:
        return hit, hit.to(samples.weight.dtype)
    return hit, torch.where(hit, samples.roles["depth"], scale.depth)


def basic_values(samples: Samples, scale: FrameScale) -> Tensor:
    """(N, 5) what every variant filters: radiance, coverage, coverage * depth."""
    coverage = samples.coverage[:, None]
    return columns([samples.roles["radiance"], coverage, coverage * hit_depth(samples, scale)[1]])


def extra_values(samples: Samples) -> list[Tensor]:
    """[(N, E)] what the caller wants filtered besides, or nothing."""
    return [] if samples.extra is None else [samples.extra]


def share_of(log_n: Tensor, log_w: Tensor) -> Tensor:
    """w / n in 0..1, 0 where next to nothing is: what is divided by it has a derivative over its square."""
    share = torch.exp(log_w - torch.where(log_n == -torch.inf, 0, log_n))
    return torch.where(share > torch.finfo(share.dtype).tiny ** 0.5, share, 0)


def splat(log_weight: Tensor, log_partition: Tensor, values: Tensor, segments: Segments) -> LayerSplat:
    """Splats samples to the layers of their pixel.

    Parameters
    ----------
    log_weight : (N, 1) log of the samples' weights, confidence included; -inf is allowed
    log_partition : (N, L) log of the partition, rows sum to 1 in the linear domain
    values : (N, C) per sample
    """
    log_occupancy = log_weight + log_sum_behind(log_partition)
    peak = segments.max(log_occupancy)  # (P, L)
    empty = peak == -torch.inf
    peak = torch.where(empty, 0, peak)
    at_samples = segments.expand(peak)
    occupancy = segments.sum(torch.exp(log_occupancy - at_samples))  # >= 1 unless empty
    own = torch.exp(log_weight + log_partition - at_samples)  # (N, L) <= 1
    sums, weight = segments.weighted_sum(own, values), segments.sum(own)  # (P, L, C), (P, L)
    safe = torch.where(empty, 1, occupancy)
    tiny = torch.finfo(weight.dtype).tiny
    log_w = torch.where(weight > 0, torch.log(weight.clamp_min(tiny)) + peak, -torch.inf)
    return LayerSplat(
        log_n=torch.where(empty, -torch.inf, torch.log(safe) + peak),
        log_w=log_w,
        values=sums / safe[..., None],
    )


def log_sum_behind(log_partition: Tensor) -> Tensor:
    """(N, L) -> (N, L): log sum_{k>=l} p_k."""
    *others, last = log_partition.split(1, 1)
    behind = [last]
    for layer in reversed(others):
        behind.append(torch.logaddexp(layer, behind[-1]))
    return columns(behind[::-1])


def outlierness(samples: Samples, segments: Segments, scale: FrameScale) -> Tensor:
    """(N, 1): how far above its surroundings a sample is, in log radiance, as far as it is also rare there.

    With b = log(1 + exposure L) it is the smaller of two: b less the largest of its mean over each of OUTLIER_WINDOWS
    pixels around and OWN_SHARE of its mean over the sample's own pixel; and r + (r - RARE), r being b less the log of
    the mean radiance around, which is about -log(share of the samples that are so bright). A lone bright sample is far
    above all of them, also where its pixel has no other; a small lamp, bright in all samples of its pixels, is not,
    and neither is a lamp out of focus that many pixels around see.
    """
    batch, height, width = samples.shape
    radiance = samples.roles["radiance"].amax(1, keepdim=True)
    brightness = log_radiance(radiance, scale.exposure)
    weight = samples.weight[:, None]
    exposed = (radiance * scale.exposure).clamp(0, RADIANCE_LIMIT)
    sums = segments.sum(columns([weight, weight * brightness, weight * exposed]))  # (P, 3)
    picture = sums.T.reshape(3, batch, height, width)
    around = OWN_SHARE * sums[:, 1:2]
    for window in OUTLIER_WINDOWS:
        total, bright, mean = window_sums(picture, window).view(3, -1, 1)
        safe = torch.where(total > 0, total, 1)
        around = torch.maximum(around, bright / safe)
    above = brightness - segments.expand(around)
    rarity = brightness - segments.expand(torch.log1p(mean / safe))  # against the mean of the widest window
    return torch.minimum(above, 2 * rarity - RARE)


def initial_logits(relative: Tensor | None, strength: Tensor, keep: Sequence[int], logits: int) -> Tensor | float:
    """What the depth prior adds to the kept ones of `logits` partition logits: front samples towards front layers."""
    if relative is None:
        return 0.0
    return strength * relative * layer_positions(logits, relative)[list(keep)]


def mixture(log_weight: Tensor, values: Tensor, segments: Segments) -> tuple[Tensor, Tensor]:
    """Weighted means over each pixel's samples, for T columns of weights at once.

    log_weight (N, T), values (N, C) -> log of the summed weights (P, T), -inf for none, and means (P, T, C).
    """
    peak = segments.max(log_weight)  # (P, T)
    peak = torch.where(peak == -torch.inf, 0, peak)
    weight = torch.exp(log_weight - segments.expand(peak))
    sums = segments.weighted_sum(weight, torch.cat([values, torch.ones_like(values[:, :1])], 1))
    total = sums[..., -1]
    some = total > 0
    safe = torch.where(some, total, 1)
    return torch.where(some, torch.log(safe) + peak, -torch.inf), sums[..., :-1] / safe[..., None]
