"""Parameters and multiply-adds of a `Config`, counted from its widths alone.

A stage has work per sample, per pixel, per layer (and pixel), and per sample and layer. At s samples per pixel and L
layers a pixel takes    pixel + s * sample + L * layer + s * L * sample_layer    multiply-adds.
Counted are matrix products, convolutions and filter taps; activations, exponentials and encodings are not. Affinity
kernels are computed in blocks, which takes half as many again (`model/affinity.py`).

By hand, for LAYER (20 features, embedding 32, context 128, 17 x 17 taps):
    reducer      20*32 + 32*32 + 32*32 = 2688 per sample; with 3*32 biases 2784 parameters
    statistics   the mean embedding, 32 per sample
    U-Net        9*in*out per 3x3 convolution, and 1/4 of it per pixel for every level down:
                 9*(32*64 + 64*64) = 55296, 9*64*128/4 = 18432, 9*128*256/16 = 18432, 9*256*512/64 = 18432,
                 9*512*512/256 = 9216, 9*512*512/1024 = 2304, then up
                 9*(1024*512 + 512*512)/256 = 27648, 9*(768*256 + 256*256)/64 = 36864,
                 9*(384*128 + 128*128)/16 = 36864, 9*(192*128 + 128*128)/4 = 92160,
                 9*(160*128 + 128*128) = 331776, head 9*128*128 = 147456: together 794880 per pixel
    partitioner  128*32 = 4096 per pixel, 32*32 + 32*16 + 16*2 = 1568 per sample
    splat        5 filtered planes, embedding and weight: 38 per sample and layer
    generator    128*128 = 16384 per pixel, 32*128 + 128*128 + 128*289 = 57472 per layer
    filter       289 taps * 6 planes = 1734 per layer
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from model.config import DIVISOR_WINDOW, Config, UNetConfig
from model.features import feature_groups
from model.guided import GUIDE_SCALES, GUIDED_COLUMNS, NOISE_COLUMNS, generator_sizes
from model.partition import BASIC_COLUMNS
from model.reducer import context_inputs

BASIC = BASIC_COLUMNS - 2  # planes every variant filters: radiance (3), coverage, coverage * depth
DIVISOR = 3  # planes of the divisor
SLOPE = 2  # and of the products that its slope is measured by


@dataclass(frozen=True)
class Stage:
    """One stage of a network.

    parameters : how many it has
    sample, pixel, layer, sample_layer : multiply-adds, see the module's equation
    """

    name: str
    parameters: int = 0
    sample: float = 0.0
    pixel: float = 0.0
    layer: float = 0.0
    sample_layer: float = 0.0


@dataclass(frozen=True)
class Cost:
    """The stages of a network, in the order they run."""

    stages: tuple[Stage, ...]

    @property
    def parameters(self) -> int:
        """Of the whole network."""
        return sum(stage.parameters for stage in self.stages)

    def multiply_adds(self, samples: float, layers: int) -> dict[str, float]:
        """Multiply-adds per pixel of each stage at that many samples per pixel."""
        return {
            stage.name: stage.pixel + samples * stage.sample + layers * (stage.layer + samples * stage.sample_layer)
            for stage in self.stages
        }


def _mlp(widths: Sequence[int]) -> tuple[int, int]:
    """Products and biases of an MLP, its input's width first."""
    return sum(a * b for a, b in pairwise(widths)), sum(widths[1:])


def _block(inputs: int, widths: Sequence[int], resolution: float) -> tuple[int, float]:
    """Parameters and multiply-adds per pixel of 3x3 convolutions at 1/resolution of the picture's pixels."""
    products, biases = _mlp([inputs, *widths])
    return 9 * products + biases, 9 * products / resolution


def _unet(inputs: int, unet: UNetConfig) -> Stage:
    skips = [inputs, *(widths[-1] for widths in unet.encoder[:-1])]
    resolution = float(unet.scale**2)
    blocks = []
    for skip, widths in zip(skips, unet.encoder, strict=True):
        blocks.append(_block(skip, widths, resolution))
        resolution *= 4
    below = unet.encoder[-1][-1]
    for skip, widths in zip([0, *reversed(skips)], [unet.bottleneck, *unet.decoder], strict=True):
        blocks.append(_block(below + skip, widths, resolution))
        below, resolution = widths[-1], resolution / 4
    blocks.append(_block(below, unet.head, resolution * 4))
    if unet.fine:
        blocks.append(_fine(inputs, unet))
    return Stage("unet", sum(block[0] for block in blocks), pixel=sum(block[1] for block in blocks))


def _fine(inputs: int, unet: UNetConfig) -> tuple[int, float]:
    """Parameters and multiply-adds per pixel of the convolutions behind a U-Net at a lower resolution."""
    first, last, context = unet.fine[0], unet.fine[-1], unet.out_channels
    parameters, products = _block(first, unet.fine[1:], 1.0)
    return (parameters + (inputs + context + 1) * first + (last + 1) * context,
            products + inputs * first + context * first / unet.scale**2 + last * context)


def _split_mlp(shared: int, own: int, widths: Sequence[int]) -> tuple[int, float, float]:
    """Parameters, products of the shared part of the first layer, and all other products of an MLP."""
    products, biases = _mlp([shared + own, *widths])
    once = shared * widths[0]
    return products + biases, once, products - once


def count(config: Config) -> Cost:
    """What every stage of this network takes, in the order they run."""
    features = sum(feature_groups(config.roles, config.encoding == "log").values())
    stages = []
    if config.reducer:
        products, biases = _mlp([features, *config.reducer])
        presence = len(feature_groups(config.roles, True)) * config.reducer[0] if config.encoding == "log" else 0
        stages.append(Stage("reducer", products + biases + presence, sample=products))
    stages.append(Stage("statistics", sample=_statistics(config)))
    stages.append(_unet(context_inputs(config), config.unet))
    if config.layered:
        outputs = config.partition_logits + int(config.confidence)
        priors = int(config.depth_prior) + int(config.confidence)  # inputs, and parameters of their own
        own = config.embedding + priors
        parameters, pixel, sample = _split_mlp(config.unet.out_channels, own, (*config.partitioner, outputs))
        stages.append(Stage("partitioner", parameters + priors, sample=sample, pixel=pixel))
    if config.kernel == "affinity":
        stages += _affinity(config)
    elif config.variant == "sample_splat":
        stages += _per_sample(config)
    else:
        stages += _direct(config)
    return Cost(tuple(stages))


def _statistics(config: Config) -> int:
    """Means, and variances if the context sees them."""
    if config.statistics:
        return 2 * (config.embedding + 5)  # radiance (3), luminance, relative depth
    return config.embedding if config.reducer else 2 * config.embedding


def _affinity(config: Config) -> list[Stage]:
    outputs = sum(generator_sizes(config))
    hidden = config.generator[0]
    own = config.embedding + 2
    parameters, pixel, layer = _split_mlp(config.unet.out_channels, own, (*config.generator, outputs))
    guides = config.affinity_features * len(GUIDE_SCALES)
    taps = sum(size * size for size in config.kernel_sizes)
    planes = BASIC + 1 + (DIVISOR if config.demodulation else 0) + (SLOPE if config.texture_slope else 0)
    distances = DIVISOR + config.divisor_features
    noise = NOISE_COLUMNS if config.texture_reliability else 0
    smoothed = len(GUIDE_SCALES) if config.filtered_guides else DIVISOR
    by_divisor = DIVISOR_WINDOW**2 * (distances + smoothed) if config.demodulation else 0
    return [
        Stage("splat", sample_layer=GUIDED_COLUMNS - 2 + config.embedding + noise + 1),
        Stage("generator", parameters + config.partition_logits * hidden, pixel=pixel, layer=layer),
        Stage("guides", guides, layer=guides),
        Stage("filter", layer=taps * (config.affinity_features + 1 + planes) + by_divisor),
    ]


def _direct(config: Config) -> list[Stage]:
    stages = [Stage("splat", sample_layer=BASIC + config.embedding + 1)]
    levels = len(config.kernel_sizes)
    contexts = [config.unet.out_channels, *(widths[-1] for widths in reversed(config.unet.decoder[:-1]))]
    for level, size in enumerate(config.kernel_sizes):
        outputs = size * size + (levels if level == 0 and levels > 1 else 0)
        parameters, pixel, layer = _split_mlp(contexts[level], config.embedding, (*config.generator, outputs))
        area = 4.0**level
        suffix = f" 1/{2**level}" if level else ""
        stages.append(Stage(f"generator{suffix}", parameters, pixel=pixel / area, layer=layer / area))
        stages.append(Stage(f"filter{suffix}", layer=size * size * (BASIC + 1) / area))
    return stages


def _per_sample(config: Config) -> list[Stage]:
    taps = config.kernel_sizes[0] ** 2
    widths = (*config.generator, taps)
    parameters, pixel, sample = _split_mlp(config.unet.out_channels, config.embedding, widths)
    return [
        Stage("generator", parameters, sample=sample, pixel=pixel),
        Stage("splat", sample=taps * (BASIC + 1)),
        Stage("filter", pixel=taps * BASIC),
    ]
