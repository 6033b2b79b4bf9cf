"""What a network costs at 4 to 64 samples per pixel, as in the paper's Figure 10: multiply-adds and seconds.

The samples are random numbers: the time of a network does not depend on them.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping, Sequence

import torch

from model.config import Config
from model.cost import count
from model.denoiser import Denoiser
from model.features import FrameScale
from model.samples import ROLE_WIDTHS, Samples
from pipelines.bench.clock import Clock
from pipelines.bench.results import GrowthPoint

SAMPLES = (4, 8, 16, 32, 64)
SIDE = 64
"""Pixels along a side of the measured picture: a multiple of every network's stride, so nothing is padded."""


def random_samples(per_pixel: int, side: int, roles: Sequence[str], seed: int = 0) -> Samples:
    """One picture with `per_pixel` samples in every pixel, all of them hits."""
    generator = torch.Generator().manual_seed(seed)
    total = side * side * per_pixel
    values = {role: torch.rand(total, ROLE_WIDTHS[role], generator=generator) + 0.5 for role in roles}
    counts = torch.full((side * side,), per_pixel, dtype=torch.int32)
    return Samples((1, side, side), counts, torch.full((total,), 1.0 / per_pixel), torch.ones(total), values)


def growth(
    counted: Mapping[str, Config], timed: Mapping[str, Denoiser], samples: Sequence[int] = SAMPLES, side: int = SIDE,
    repeats: int = 3, update: Callable[[], None] = lambda: None,
) -> list[GrowthPoint]:
    """Multiply-adds of every network, and the median seconds of those that are `timed`, per pixel.

    Runs are interleaved, after one that warms up. `update` is called after each number of samples.
    """
    points = []
    for per_pixel in samples:
        times = _measure(timed, per_pixel, side, repeats)
        for name, config in counted.items():
            products = sum(count(config).multiply_adds(per_pixel, config.layers).values())
            cpu, wall = times.get(name, (None, None))
            points.append(GrowthPoint(name, per_pixel, products, cpu, wall))
        update()
    return points


@torch.inference_mode()
def _measure(networks: Mapping[str, Denoiser], per_pixel: int, side: int, repeats: int
             ) -> dict[str, tuple[float, float]]:
    pictures = {name: random_samples(per_pixel, side, net.config.roles) for name, net in networks.items()}
    clock = Clock()
    runs: dict[str, list[tuple[float, float]]] = {name: [] for name in networks}
    for _ in range(repeats + 1):
        for name, net in networks.items():
            with clock.stage("network"):
                net(pictures[name], FrameScale(1.0, 1.0), net.config.layers)
            times = clock.take()
            runs[name].append((times.cpu["network"], times.wall["network"]))
    pixels = side * side
    return {
        name: (statistics.median(cpu for cpu, _ in rows[1:]) / pixels,
               statistics.median(wall for _, wall in rows[1:]) / pixels)
        for name, rows in runs.items()
    }
