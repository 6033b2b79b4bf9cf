"""What a denoiser is made of, as data: every variant of the paper and every preset of ours is one `Config`.

Published sizes are from Munkberg & Hasselgren, "Neural Denoising with Layer Embeddings", EGSR 2020.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

from model.features import feature_groups

Variant = Literal["layer", "layer_w", "sample_splat", "pixel_gather"]
Widths = tuple[tuple[int, ...], ...]

ALL_ROLES = ("radiance", "depth", "normal", "albedo", "specular", "roughness", "motion", "coc", "lens", "time")
MAX_LAYERS = 5
DIVISOR_WINDOW = 5  # pixels; a target's own texture is that of the divisor filtered over this window


@dataclass(frozen=True)
class UNetConfig:
    """A U-Net of 3x3 convolutions: one tuple of widths per block, finest first on the way down."""

    encoder: Widths
    bottleneck: tuple[int, ...]
    decoder: Widths  # coarsest first; as many blocks as the encoder
    head: tuple[int, ...] = ()  # further convolutions at the finest resolution
    scale: int = 1  # the network works at 1/scale of the picture's resolution
    fine: tuple[int, ...] = ()  # convolutions behind it at the picture's own resolution; the first is 1x1

    def __post_init__(self) -> None:
        if self.fine and self.scale == 1:
            raise ValueError("fine convolutions are for a U-Net below the picture's resolution")

    @property
    def out_channels(self) -> int:
        """Channels of the context it returns."""
        return self.head[-1] if self.head else self.decoder[-1][-1]

    @property
    def widest(self) -> int:
        """The most channels at its own resolution: a yardstick of the memory it takes."""
        return max(*self.encoder[0], *self.decoder[-1])

    @property
    def stride(self) -> int:
        """Pictures are padded to a multiple of this many pixels."""
        return int(self.scale * 2 ** len(self.encoder))


@dataclass(frozen=True)
class Config:
    """One denoiser.

    `variant` says what is splatted and how it is put together:
    "layer" one kernel per layer, layers composited front to back (the paper's LAYER and LAYER_a);
    "layer_w" one kernel per layer, one weighted mean over all layers and taps, so the layers have no depth order;
    "sample_splat" one kernel per sample; "pixel_gather" one kernel per pixel, applied to the pixels' means.

    `kernel` "direct" predicts every tap's logit (the paper), "affinity" predicts features whose distances are the
    logits. For "direct", `kernel_sizes` has one odd size per pyramid level, each level at half the resolution of the
    one before; for "affinity", it is the window at each level, in cells of 2**level pixels.
    """

    name: str
    unet: UNetConfig
    variant: Variant = "layer"
    roles: tuple[str, ...] = ALL_ROLES
    encoding: Literal["paper", "log"] = "log"  # "paper": the roles alone; "log": also coverage, presence and products
    reducer: tuple[int, ...] = (32, 32, 32)  # widths of the sample reducer, the last is the embedding; (): no reducer
    partitioner: tuple[int, ...] = (32, 16)  # hidden widths; the logits follow
    partition_logits: int = MAX_LAYERS  # logits predicted; `layers` of them are used
    layers: int = 2  # layers when the caller does not say
    statistics: bool = True  # context also sees the spread of embeddings, effective count, pixel statistics
    depth_prior: bool = True  # partition logits start from depth relative to the neighbourhood
    confidence: bool = True  # samples are weighted by (1 + exposure L)^-gamma, gamma predicted
    kernel: Literal["direct", "affinity"] = "affinity"
    kernel_sizes: tuple[int, ...] = (3, 3, 3, 3, 3, 3)
    generator: tuple[int, ...] = (48, 48)  # hidden widths of the kernel generator
    affinity_features: int = 8
    guide_gates: Literal[1, 3] = 1  # one for all guides of a pixel, or one each for normal, depth and divisor
    demodulation: bool = True  # texture, of albedo + specular, is the target's own over what its kernel averaged
    divisor_features: int = 0  # learned features of the kernel that filters the divisor, beside the divisor itself
    texture_slope: bool = False  # how much radiance follows the divisor is also measured behind each kernel
    texture_reliability: bool = False  # and trusted where divisors are clean, whatever is predicted
    filtered_guides: bool = False  # mix guides with themselves behind the divisor's kernel, as much as is predicted
    glare_per_level: float = 0.5  # what a log unit of glare takes from a source's logit at each coarser level, gated
    glare_in_cells: float = 0.0  # and at all of these levels alike, not gated

    def __post_init__(self) -> None:
        if len(self.unet.encoder) != len(self.unet.decoder):
            raise ValueError("the U-Net needs as many decoder as encoder blocks")
        if not 1 <= self.layers <= self.partition_logits <= MAX_LAYERS:
            raise ValueError(f"{self.layers} layers with {self.partition_logits} partition logits")
        if any(size % 2 == 0 for size in self.kernel_sizes):
            raise ValueError(f"kernel sizes must be odd: {self.kernel_sizes}")
        if not self.layered and (self.partition_logits > 1 or self.confidence or self.depth_prior):
            raise ValueError(f"{self.variant} has no partitioner: one logit, no confidence, no depth prior")
        if self.kernel == "affinity" and self.variant in ("layer_w", "sample_splat"):
            raise ValueError(f"{self.variant} needs direct kernels")
        if self.kernel == "direct" and self.demodulation:
            raise ValueError("demodulation needs affinity kernels")
        if self.divisor_features and not self.demodulation:
            raise ValueError("without demodulation no divisor is filtered")
        if self.filtered_guides and not self.demodulation:
            raise ValueError("without demodulation there is no kernel to filter guides by")
        if self.texture_slope and not self.demodulation:
            raise ValueError("without demodulation nothing is measured against a divisor")
        if self.texture_reliability and not self.texture_slope:
            raise ValueError("reliability is that of a measured slope, which this network has not")
        if self.kernel == "direct" and len(self.kernel_sizes) > 1:
            if self.variant == "sample_splat":
                raise ValueError("kernels per sample work at the full resolution only")
            if self.unet.scale > 1 or len(self.kernel_sizes) > len(self.unet.decoder):
                raise ValueError("each level of direct kernels needs a decoder block of its resolution")

    @property
    def layered(self) -> bool:
        """Whether samples are partitioned over layers."""
        return self.variant in ("layer", "layer_w")

    @property
    def guide_reach(self) -> int:
        """Pixels: so far around a source lies what its guides are made of."""
        return DIVISOR_WINDOW // 2 if self.filtered_guides else 0

    @property
    def embedding(self) -> int:
        """Width of a sample embedding; without a reducer the features stand for it."""
        return self.reducer[-1] if self.reducer else sum(feature_groups(self.roles, self.encoding == "log").values())

    def to_dict(self) -> dict[str, Any]:
        """Plain data, for a weight file's metadata."""
        return dataclasses.asdict(self)

    @staticmethod
    def from_dict(data: dict[str, Any]) -> Config:
        """The inverse of `to_dict`, also after a trip through JSON (lists become tuples)."""

        def freeze(value: Any) -> Any:
            return tuple(freeze(item) for item in value) if isinstance(value, (list, tuple)) else value

        fields = {key: freeze(value) for key, value in data.items() if key != "unet"}
        unet = UNetConfig(**{key: freeze(value) for key, value in data["unet"].items()})
        return Config(unet=unet, **fields)


PAPER_UNET = UNetConfig(
    encoder=((64, 64), (128,), (256,), (512,), (512,)),
    bottleneck=(512,),
    decoder=((512, 512), (256, 256), (128, 128), (128, 128), (128, 128)),
    head=(128,),
)

# The paper's LAYER: 17,284,435 parameters. Scores there, 36 images at 8 samples: relMSE 0.0288, SMAPE 0.0350.
LAYER = Config(
    name="layer",
    unet=PAPER_UNET,
    encoding="paper",
    partition_logits=2,
    statistics=False,
    depth_prior=False,
    confidence=False,
    kernel="direct",
    kernel_sizes=(17,),
    generator=(128, 128),
    demodulation=False,
)
LAYER_W = replace(LAYER, name="layer_w", variant="layer_w")
SAMPLE_SPLAT = replace(LAYER, name="sample_splat", variant="sample_splat", partition_logits=1, layers=1)
PIXEL_GATHER = replace(LAYER, name="pixel_gather", variant="pixel_gather", reducer=(), partition_logits=1, layers=1)

# The paper's fast network: a slimmer U-Net at full resolution and small kernels at three resolutions.
OPTIMIZED = replace(
    LAYER,
    name="optimized",
    unet=UNetConfig(
        encoder=((32, 32), (128,), (256,), (512,), (512,)),
        bottleneck=(512,),
        decoder=((512, 512), (256, 256), (128, 128), (64, 64), (64, 64)),
        head=(64,),
    ),
    kernel_sizes=(5, 5, 5),
    generator=(32, 32),
)

FAST = Config(
    name="fast",
    unet=UNetConfig(
        encoder=((64, 64), (96, 96), (128, 128), (160,)),
        bottleneck=(160,),
        decoder=((160, 160), (128, 128), (96, 96), (64, 64)),
        scale=2,
        fine=(32, 32, 32, 32),
    ),
    reducer=(32, 32, 24),
    partitioner=(24, 16),
    generator=(48, 48),
    kernel_sizes=(9, 5, 3, 3, 3, 3),
    guide_gates=3,
    divisor_features=4,
    texture_slope=True,
    texture_reliability=True,
    filtered_guides=True,
    glare_per_level=1.0,
    glare_in_cells=0.25,
)

# `fast` with more channels; samples, partition and kernels stay.
HIGH = replace(
    FAST,
    name="high",
    unet=UNetConfig(
        encoder=((128, 128), (192, 192), (256, 256), (320,)),
        bottleneck=(320,),
        decoder=((320, 320), (256, 256), (192, 192), (128, 96)),
        scale=2,
        fine=(64, 64, 64, 64),
    ),
    generator=(96, 96),
)

CONFIGS: Mapping[str, Config] = {
    config.name: config for config in (LAYER, LAYER_W, SAMPLE_SPLAT, PIXEL_GATHER, OPTIMIZED, FAST, HIGH)
}
