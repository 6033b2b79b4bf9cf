"""Small random networks of every variant and random path samples, for the property tests of this folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from model.config import CONFIGS, Config, UNetConfig
from model.denoiser import Denoiser
from model.samples import ROLE_WIDTHS, Samples

UNET = UNetConfig(
    encoder=((5, 5), (6,), (6,)), bottleneck=(6,), decoder=((6,), (6, 6), (5,)), head=(4,)
)
HALF_UNET = UNetConfig(encoder=((5, 5), (6,)), bottleneck=(6,), decoder=((6,), (6, 5)), scale=2, fine=(4, 3))


def _small(name: str, kernel_sizes: tuple[int, ...], **changes: Any) -> Config:
    config = CONFIGS[name]
    small: dict[str, Any] = {
        "unet": HALF_UNET if config.unet.scale == 2 else UNET,
        "kernel_sizes": kernel_sizes,
        "reducer": (6, 5) if config.reducer else (),
        "partitioner": (6,),
        "generator": (7,),
        **changes,
    }
    return replace(config, **small)


_ABLATION = {"statistics": True, "depth_prior": True, "confidence": True, "encoding": "log", "partition_logits": 3}

# Every variant at small widths, and two mixtures that only an ablation would use.
SMALL: dict[str, Config] = {
    "layer": _small("layer", (5,)),
    "layer_w": _small("layer_w", (5,), partition_logits=5),
    "sample_splat": _small("sample_splat", (5,)),
    "pixel_gather": _small("pixel_gather", (5,)),
    "optimized": _small("optimized", (3, 3, 3), partition_logits=5),
    "fast": _small("fast", (3, 3, 3, 3), guide_gates=3, divisor_features=2, filtered_guides=True),
    "layer with our encodings": _small("layer", (5,), **_ABLATION),
    "pixel means with affinity": _small("fast", (3, 3), variant="pixel_gather", reducer=(), partition_logits=1,
                                        layers=1, confidence=False, depth_prior=False, demodulation=False,
                                        divisor_features=0, texture_slope=False, texture_reliability=False,
                                        filtered_guides=False),
}


def random_network(config: Config, seed: int, dtype: torch.dtype = torch.float64) -> Denoiser:
    """A network with random weights and biases, larger than an untrained one's, so that every output matters."""
    torch.manual_seed(seed)
    net = Denoiser(config)
    with torch.no_grad():
        for parameter in net.parameters():
            parameter.add_(torch.randn_like(parameter) * 0.2)
    return net.to(dtype)


def random_counts(seed: int, pixels: int, most: int, empty: float) -> Tensor:
    """(P,) samples per pixel, 1 to `most`, a share `empty` of the pixels without any."""
    draw = torch.Generator().manual_seed(seed)
    counts = torch.randint(1, most + 1, (pixels,), generator=draw)
    return torch.where(torch.rand(pixels, generator=draw) < empty, 0, counts).to(torch.int32)


def random_samples(
    seed: int,
    shape: tuple[int, int, int],
    counts: Tensor | int = 3,
    without: Sequence[str] = (),
    dtype: torch.dtype = torch.float64,
) -> Samples:
    """Path samples with a wide range of everything; about a quarter of them are misses."""
    pixels = shape[0] * shape[1] * shape[2]
    if isinstance(counts, int):
        counts = torch.full((pixels,), counts, dtype=torch.int32)
    draw = torch.Generator().manual_seed(seed)
    total = int(counts.sum())

    def uniform(width: int) -> Tensor:
        return torch.rand(total, width, generator=draw, dtype=torch.float64)

    weight = uniform(1)[:, 0] + 0.2
    pixel = torch.repeat_interleave(torch.arange(pixels), counts.long())
    weight = weight / torch.zeros(pixels, dtype=torch.float64).index_add(0, pixel, weight)[pixel]
    coverage = (uniform(1)[:, 0] > 0.25).double()
    hit = coverage[:, None] > 0
    roles = {
        "radiance": torch.exp(uniform(3) * 6 - 3),
        "depth": torch.where(hit, torch.exp(uniform(1) * 2), 1e10),
        "normal": uniform(3) * 2 - 1,
        "albedo": uniform(3) * 0.6,
        "specular": uniform(3) * 0.3,
        "roughness": uniform(1),
        "motion": uniform(2) * 20 - 10,
        "coc": uniform(1) * 12 - 6,
        "lens": uniform(2) * 1.4 - 0.7,
        "time": uniform(1),
    }
    assert set(roles) | {"coverage"} == set(ROLE_WIDTHS)
    kept = {role: values.to(dtype) for role, values in roles.items() if role not in without}
    return Samples(shape, counts, weight.to(dtype), coverage.to(dtype), kept)


def with_roles(samples: Samples, **roles: Tensor) -> Samples:
    """The same samples with some roles replaced."""
    return replace(samples, roles={**samples.roles, **roles})
