"""The affinity kernels' stage: what is splatted besides radiance, how kernels are predicted, whose texture is kept.

Features for the affinity are predicted per layer and pixel; guides (normal, log depth, divisor) are added to them with
a learned matrix, so that the kernel is a joint bilateral filter before any training. Guides of a few samples are noisy
where motion or defocus mixes surfaces within a pixel, so they may be filtered first. Glare is a feature of its own.
`affinity.py` has the filter.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from model.affinity import affinity_filter
from model.config import DIVISOR_WINDOW, Config
from model.features import FrameScale, divisor, log_depth, log_radiance
from model.networks import Mlp
from model.partition import BASIC_COLUMNS, FILTERED, hit_depth, share_of, window_sums
from model.samples import Samples, columns

GUIDE_SCALES = (2.0, 2.0, 2.0, 3.0, 1.5, 1.5, 1.5)  # normal, log depth, divisor: the joint bilateral filter at step 0
GUIDE_WIDTHS = (3, 1, 3)
DIVISOR = slice(4, 7)  # of the guides
GLARE_SCALE = 2.0  # of glare as a feature
GLARE_START = 3.0  # log(1 + exposure L): radiance about 20 times the frame's middle
BLACK = 1e-6  # of the frame's middle
FLAT = 1e-3  # variance of the divisor, over its square, that says little about the radiance
NOISE_WINDOW = 3  # pixels; so far around a target the noise of divisors is measured
ROUNDING = 1e-6  # of a divisor's mean square: what single precision may leave of a spread that is none
KNOWN = 1e-3  # less than this of a window's samples but the first of each pixel: no spread was seen
DIVISOR_GUIDE_SCALE = 6.0  # the divisor's own, sharper kernel

# Columns of a splat: log n, log w, then per unit of occupancy those of `basic_values`, of `guide_values`, embedding,
# of `noise_values` if the network measures it.
RADIANCE = slice(2, 5)
GUIDES = slice(BASIC_COLUMNS, 14)  # normal, log depth, divisor
GUIDED_COLUMNS = 14
NOISE_COLUMNS = 2


def guide_values(samples: Samples, scale: FrameScale) -> Tensor:
    """(N, 7) normal, log depth, divisor; 0 where a role is absent."""
    hit, depth = hit_depth(samples, scale)
    normal = torch.zeros_like(samples.roles["radiance"])
    if "normal" in samples.roles:
        normal = torch.where(hit, samples.roles["normal"], normal)
    return columns([normal, log_depth(depth, scale.depth), divisor(samples)])


def noise_values(samples: Samples) -> Tensor:
    """(N, NOISE_COLUMNS) what the noise of a pixel's divisor is measured by: its square, mean over the colours, and the
    sample's weight, or that of each of those it stands for."""
    weight = samples.weight
    if samples.squares is not None:
        weight = samples.squares / torch.where(weight > 0, weight, 1)
    return columns([divisor(samples).square().mean(1, keepdim=True), weight[:, None]])


def glare(radiance: Tensor, exposure: float) -> Tensor:
    """Radiance (B, 3, H, W) -> (B, 1, H, W): log units beyond GLARE_START, else 0.

    As a feature it keeps lamps, a thousand times their surroundings, from leaking out of their edges; radiance below
    is no guide, since its differences are mostly noise. A gate is learned: a lamp out of focus is noisy, too.
    """
    return (log_radiance(radiance.amax(1, keepdim=True), exposure) - GLARE_START).clamp_min(0)


def generator_sizes(config: Config) -> tuple[int, ...]:
    """What the generator predicts per layer: features, bias and preference per level, gates of guides and glare;
    with demodulation also the mix; gate, bias and features of the divisor's kernel; how much of each guide is to be
    its filtered self; and how much of the mix the measured slope is to be."""
    levels = len(config.kernel_sizes)
    sizes = (config.affinity_features, levels, levels, config.guide_gates, 1)
    if not config.demodulation:
        return sizes
    filtered_guides = len(GUIDE_WIDTHS) if config.filtered_guides else 0
    return (*sizes, 1, 1, 1, config.divisor_features, filtered_guides, int(config.texture_slope))


def initial_guides(config: Config) -> Tensor:
    """(features, guides): each guide starts in one feature, scaled by GUIDE_SCALES."""
    guides = torch.zeros(config.affinity_features, len(GUIDE_SCALES))
    for k, value in enumerate(GUIDE_SCALES):
        guides[k % config.affinity_features, k] = value
    return guides


def predict(generator: Mlp, layer_bias: Tensor, planes: Tensor, context: Tensor) -> Tensor:
    """Rows of the splat (P, L, K), context (P, C), layer_bias (L, hidden) -> (P, L, sum(generator_sizes)).

    The generator sees the layer's mean embedding, its share w / n and its occupancy n.
    """
    log_n, log_w, values = planes[..., :1], planes[..., 1:2], planes[..., GUIDED_COLUMNS:]  # embedding
    share = share_of(log_n, log_w)
    embedding = values / torch.where(share > 0, share, 1)
    weight = torch.exp(log_n)  # below 1 where confidence is low or layers in front took the weight
    shared = generator.first(0, context)[:, None]  # (P, 1, hidden)
    mine = generator.first(1, columns([embedding, share, weight]))
    return generator.rest(shared + mine + layer_bias).to(planes.dtype)


def filter_guided(planes: Tensor, predictions: Tensor, guide_matrix: nn.Parameter, config: Config, scale: FrameScale,
                  lights: int, active: Tensor | None = None) -> Tensor:
    """Filters each layer by affinity; with `config.demodulation` the texture of radiance is the target's own.

    active : which cells of targets are computed, see `affinity_filter`

    planes (B*L, GUIDED_COLUMNS + E, H, W), with `config.texture_reliability` NOISE_COLUMNS more before the E extra
    values, of which the first `lights` are parts of the radiance;
    predictions (B*L, sum(generator_sizes), H, W) -> (B*L, 6 + E, H, W) per unit of filtered occupancy: radiance,
    coverage, coverage * depth, share, extra values; 0 where no source is in reach.
    """
    log_n, log_w = planes[:, 0], planes[:, 1]
    share = share_of(log_n, log_w)[:, None]
    own = torch.where(share > 0, share, 1)  # values per unit of the layer's own weight: divide by this
    features, bias, preference, gate, glare_gate, *divided = torch.split(predictions, list(generator_sizes(config)), 1)
    guides = planes[:, GUIDES] / own
    if config.demodulation:
        mix, *kernel, amounts, trust = divided
        guides, factor = _filtered_guides(guides, log_w, kernel, amounts, config, active)
    bright = glare(planes[:, RADIANCE] / own, scale.exposure)
    beyond = bright * (0.5 + torch.sigmoid(glare_gate))
    # A cell that holds a corner of a lamp is hardly farther from its dark pixels, and a thousand times brighter.
    level = torch.arange(bias.shape[1], device=bias.device)[:, None, None]
    bias = bias - beyond * config.glare_per_level * level - bright * config.glare_in_cells * level.clamp_max(1)
    gates = 2 * torch.sigmoid(gate)
    if config.guide_gates > 1:
        gates = _for_each_guide(gates)
    features = features + torch.einsum("bghw,fg->bfhw", guides * gates, guide_matrix)
    features = torch.cat([features, GLARE_SCALE * beyond], 1)
    textures = []
    if config.demodulation:
        by = planes[:, GUIDES][:, DIVISOR]
        textures = [by, *(_products(planes[:, RADIANCE], by, own) if config.texture_slope else [])]
    extra = GUIDED_COLUMNS + NOISE_COLUMNS * config.texture_reliability
    values = torch.cat([planes[:, FILTERED], share, *textures, planes[:, extra:]], 1)
    out = affinity_filter(features, bias, preference, log_n, values, config.kernel_sizes, active)
    if not config.demodulation:
        return out
    rest = out.shape[1] - 9 - lights - 2 * config.texture_slope
    color, coverage, share, averaged, products, light, data = torch.split(
        out, [3, 2, 1, 3, 2 * config.texture_slope, lights, rest], 1)
    amount = torch.sigmoid(mix)
    if config.texture_slope:
        trusted = torch.sigmoid(trust)
        if config.texture_reliability:
            noise = _noise(planes[:, GUIDES][:, DIVISOR] / own, planes[:, GUIDED_COLUMNS:extra] / own, log_w)
            trusted = torch.lerp(trusted, torch.ones_like(trusted), _reliability(noise, averaged, products, share))
        amount = torch.lerp(amount, _slope(color, averaged, products, share, scale.exposure), trusted)
    gain = torch.lerp(torch.ones_like(factor), _texture(factor, share, averaged), amount)
    return torch.cat([color * gain, coverage, share, light * gain.repeat(1, lights // 3, 1, 1), data], 1)


def _products(radiance: Tensor, by: Tensor, own: Tensor) -> list[Tensor]:
    """[radiance times divisor, divisor squared], (B*L, 1, H, W) each, per unit of occupancy as both of these are."""
    return [_mean_product(radiance, by / own), _mean_product(by, by / own)]


def _slope(radiance: Tensor, averaged: Tensor, products: Tensor, share: Tensor, exposure: float) -> Tensor:
    """(B*L, 1, H, W) 0..1: how much radiance follows the divisor among the sources of a kernel, 1 if in proportion.

    Less than 1 where both light and texture are coloured: products are of the colours' means. The slope of a local
    linear regression, as of the guided filter (He et al. 2010), over that of a line through 0. All planes are behind
    the kernel, per unit of occupancy. Over a flat divisor, and where it is black, it is 0.
    """
    some, per_weight = _per_weight(share)
    light, by = radiance * per_weight, averaged * per_weight
    together, squared = (products * per_weight).split(1, 1)
    covariance = together - _mean_product(light, by)
    variance = squared - _mean_product(by, by)
    one = torch.ones_like(by)
    bright = _mean_product(light, one)
    lit = (bright * exposure > BLACK) & some  # the derivative divides by it
    line = bright * (variance.clamp_min(0) + FLAT * squared)
    return torch.where(lit, covariance * _mean_product(by, one) / torch.where(lit, line, 1), 0).clamp(0, 1)


def _per_weight(share: Tensor) -> tuple[Tensor, Tensor]:
    """Where a kernel reached a layer's own weight, and what brings means per unit of occupancy to that of weight."""
    some = share > torch.finfo(share.dtype).tiny ** 0.5
    return some, torch.where(some, 1 / torch.where(some, share, 1), 0)


@torch.no_grad()
def _noise(by: Tensor, measured: Tensor, log_w: Tensor) -> Tensor:
    """(B*L, 1, H, W) variance of the divisor of a pixel's mean, mean over the colours; inf where nothing tells it.

    The variance among a pixel's samples over their number, unbiased, mean over NOISE_WINDOW pixels. Where samples are
    stratified it is an upper bound. `by` (B*L, 3, H, W) and `measured`, of `noise_values`, per unit of own weight.
    """
    squared, weight = measured.split(1, 1)
    spread = (squared * (1 - ROUNDING) - _mean_product(by, by)).clamp_min(0)
    there = weight > 0
    # one over the number of samples: 1 says nothing of the spread
    lone = torch.where(there, (weight / torch.exp(log_w)[:, None].clamp_min(1e-30)).clamp(0, 1), 1)
    sums = window_sums(torch.cat([spread * lone, 1 - lone], 1), NOISE_WINDOW)
    noise, known = sums.split(1, 1)
    return torch.where(known > KNOWN, noise / known.clamp_min(KNOWN), torch.inf)


@torch.no_grad()
def _reliability(noise: Tensor, averaged: Tensor, products: Tensor, share: Tensor) -> Tensor:
    """(B*L, 1, H, W) 0..1: how far a slope is to be trusted whatever is predicted; `noise` is that at the target.

    The square of the reliability ratio of a regression on what was measured with errors (Fuller 1987, "Measurement
    Error Models", section 1.1), which is the part of the divisor's variance among the sources of a kernel that is not
    noise. It is measured itself, and by its square no scene but one lost more than 1.5 % by it, the ratio's own 2 %.
    """
    _, per_weight = _per_weight(share)
    by, squared = averaged * per_weight, products[:, 1:] * per_weight
    variance = squared - _mean_product(by, by)
    varied = variance > 0
    total = torch.where(varied, variance + FLAT * squared, 1)
    return torch.where(varied, (variance - noise) / total, 0).clamp(0, 1).square()


def _mean_product(first: Tensor, second: Tensor) -> Tensor:
    """Two (B, 3, H, W) -> (B, 1, H, W): mean over the colours of their product."""
    return (first * (second / 3)).sum(1, keepdim=True)


def _texture(factor: Tensor, share: Tensor, averaged: Tensor) -> Tensor:
    """(B*L, 3, H, W): by how much a target is lighter or darker than what its kernel averaged; 1 where that is unknown.

    The filtered radiance over the divisor behind the same kernel is the light that falls in, whichever surfaces it
    averages; over every sample's own divisor, dark surfaces would count most, and add light where surfaces mix.

    factor : the target's divisor, per unit of its own weight, 0 if unknown; share (B*L, 1, H, W) and averaged: own
        weight and divisor behind the kernel, per unit of occupancy
    """
    known = (averaged > torch.finfo(averaged.dtype).tiny ** 0.5) & _known(factor)
    return torch.where(known, factor * share / torch.where(known, averaged, 1), 1)


def _filtered_guides(guides: Tensor, log_w: Tensor, kernel: list[Tensor], amounts: Tensor, config: Config,
                     active: Tensor | None) -> tuple[Tensor, Tensor]:
    """The guides (B*L, 7, H, W) mixed with themselves behind the divisor's kernel, and the divisor behind it, 0 where
    there is no own weight near.

    kernel : gate, bias and learned features; amounts : (B*L, 3 or 0, H, W) logits of how much is mixed in
    """
    gate, bias, learned = kernel
    sharp = torch.cat([guides[:, DIVISOR] * (DIVISOR_GUIDE_SCALE * torch.sigmoid(gate)), learned], 1)
    window, no_preference = (DIVISOR_WINDOW,), torch.zeros_like(bias)
    if not config.filtered_guides:
        return guides, affinity_filter(sharp, bias, no_preference, log_w, guides[:, DIVISOR], window, active)
    # not of `active` targets alone: their sources need it, too
    smooth = affinity_filter(sharp, bias, no_preference, log_w, guides, window)
    factor = smooth[:, DIVISOR]
    return torch.lerp(guides, smooth, _for_each_guide(torch.sigmoid(amounts)) * _known(factor)), factor


def _known(factor: Tensor) -> Tensor:
    """(B*L, 1, H, W) bool: whether a divisor (B*L, 3, H, W) was filtered from anything."""
    return factor.amax(1, keepdim=True) > 0


def _for_each_guide(values: Tensor) -> Tensor:
    """(B*L, 3, H, W), one for normal, depth and divisor -> (B*L, 7, H, W), one for each of the guides' columns."""
    return values.repeat_interleave(torch.tensor(GUIDE_WIDTHS, device=values.device), 1)
