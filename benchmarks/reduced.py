"""The paper's networks and ours at reduced width: what benchmarks/paper.py trains and its tables name.

Reduced means: U-Nets a quarter as wide, the small networks half as wide, kernels of half the radius (17x17 becomes 9x9,
5x5 becomes 3x3). Everything else is as published. `fast` has a finest window of 5x5 and a U-Net of 16 to 48 channels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from trials import Run

from model.config import FAST, LAYER, LAYER_W, OPTIMIZED, PIXEL_GATHER, SAMPLE_SPLAT, Config, UNetConfig
from model.losses import LossWeights
from pipelines.training.recipe import Augmentation, Recipe

SMAPE = LossWeights(smape=1.0, relative=0.0, pooled=())
TONE_MAPPED = LossWeights(smape=0.0, relative=0.0, tone_mapped=1.0, pooled=())
PLAIN = Augmentation(permute_colors=False, drop_roles=0.0, fireflies=0.0)
"""Flips, quarter turns and random exposure, no more."""
PAPER_RECIPE = Recipe(steps=3000, batch=2, crop=64, samples=((8, 1.0),), loss=SMAPE, augmentation=PLAIN,
                      partition_entropy=0.0)
OUR_RECIPE = Recipe(steps=200, batch=2, crop=96, samples=((8, 1.0),), augmentation=PLAIN)


def reduced(config: Config) -> Config:
    """A published network at reduced width."""

    def part(widths: Sequence[int], divisor: int) -> tuple[int, ...]:
        return tuple(width // divisor for width in widths)

    unet = config.unet
    return replace(
        config,
        unet=replace(
            unet,
            encoder=tuple(part(block, 4) for block in unet.encoder),
            bottleneck=part(unet.bottleneck, 4),
            decoder=tuple(part(block, 4) for block in unet.decoder),
            head=part(unet.head, 4),
        ),
        reducer=part(config.reducer, 2),
        partitioner=part(config.partitioner, 2),
        generator=part(config.generator, 2),
        kernel_sizes=tuple(2 * (size // 4) + 1 for size in config.kernel_sizes),
    )


def layers_of(config: Config, layers: int) -> Config:
    """The network made for so many layers and no others, as in the paper."""
    return replace(config, layers=layers, partition_logits=layers)


SMALL_FAST = replace(
    FAST,
    unet=UNetConfig(encoder=((16, 16), (24, 24), (32, 32), (48,)), bottleneck=(48,),
                    decoder=((48, 48), (32, 32), (24, 24), (16, 16)), scale=2),
    reducer=(16, 16, 16),
    partitioner=(16, 8),
    generator=(24, 24),
    kernel_sizes=(5, 3, 3, 3, 3, 3),
    guide_gates=1,
    divisor_features=0,
    texture_slope=False,
    texture_reliability=False,
    filtered_guides=False,
    glare_per_level=0.5,
    glare_in_cells=0.0,
)
PIXEL_FAST = replace(SMALL_FAST, variant="pixel_gather", reducer=(), partition_logits=1, layers=1, confidence=False,
                     depth_prior=False)
"""`fast` without samples: it sees mean and variance of the features of each pixel, and filters pixel means."""

PAPER_NETWORKS = {
    "PIXELGATHER": reduced(PIXEL_GATHER),
    "SAMPLESPLAT": reduced(SAMPLE_SPLAT),
    "LAYER": reduced(LAYER),
    "LAYER_w": reduced(LAYER_W),
    "OPTIMIZED": reduced(OPTIMIZED),
    **{f"LAYER, {count} layer{'s' if count > 1 else ''}": layers_of(reduced(LAYER), count) for count in (1, 3, 4, 5)},
}
OUR_NETWORKS = {"fast": SMALL_FAST, "pixel aggregate": PIXEL_FAST, "fast, 1 layer": layers_of(SMALL_FAST, 1)}
PAIRED = ("fast", "pixel aggregate")
TONE_MAPPED_LAYER = "LAYER, tone-mapped L2"
SEEDS = (1, 2, 3)


def runs() -> list[Run]:
    """All of them, the published first; of ours the pairs, seed by seed, before the rest."""
    found = [Run(name, "paper", config, replace(PAPER_RECIPE, layers=((config.layers, 1.0),)))
             for name, config in PAPER_NETWORKS.items()]
    layer = next(run for run in found if run.name == "LAYER")
    found.append(replace(layer, name=TONE_MAPPED_LAYER, recipe=replace(layer.recipe, loss=TONE_MAPPED)))
    others = [name for name in OUR_NETWORKS if name not in PAIRED]
    for name, seed in [*((name, seed) for seed in SEEDS for name in PAIRED),
                       *((name, seed) for seed in SEEDS for name in others)]:
        config = OUR_NETWORKS[name]
        recipe = replace(OUR_RECIPE, layers=((config.layers, 1.0),), seed=seed)
        found.append(Run(name, "ours", config, recipe))
    return found
