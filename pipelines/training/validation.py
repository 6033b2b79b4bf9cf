"""Validation: held-out scenes denoised whole and scored, and what a panel shows of some of them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from model.denoiser import Denoiser
from model.features import FrameScale
from model.losses import EPSILON, smape
from model.samples import Samples, Segments
from pipelines.training.augment import Turn
from pipelines.training.batches import common_roles, move, take, to_samples
from pipelines.training.cache import SampleCache
from pipelines.training.recipe import Recipe

UNIT = FrameScale()  # cached scenes are stored in exposure and depth units
SHOWN = 3  # scenes of a panel

FloatArray = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Score:
    """Means over the validation scenes; relMSE as a geometric mean."""

    relmse: float
    smape: float
    energy: float  # of |mean(output) / mean(reference) - 1|
    front: float  # visible weight of the first layer, mean over the pixels
    noisy_relmse: float  # of the input's pixel means
    noisy_smape: float


@dataclass(frozen=True)
class Shown:
    """One scene for a panel: pictures (H, W, 3) in the metrics' common scale, the front layer's weight (H, W)."""

    name: str
    noisy: FloatArray
    denoised: FloatArray
    reference: FloatArray
    front: FloatArray


@torch.no_grad()
def validate(net: Denoiser, cache: SampleCache, recipe: Recipe, stopped: Callable[[], object] = lambda: False
             ) -> tuple[Score, list[Shown]] | None:
    """Scores a network on every scene, on the same samples each time; None if `stopped` says so between two."""
    device = next(net.parameters()).device
    rows: list[list[float]] = []
    chosen = set(np.linspace(0, len(cache.entries) - 1, min(SHOWN, len(cache.entries))).astype(int).tolist())
    shown = []
    for number, entry in enumerate(cache.entries):
        if stopped():
            return None
        arrays = cache.arrays(entry)
        y, x = (_middle(extent, recipe.validation_size) for extent in (entry.height, entry.width))
        count = min(recipe.validation_samples, entry.samples)
        crop = take(arrays, y, x, Turn(), count, count / entry.samples, even="time" in entry.roles)
        samples = move(to_samples([crop], common_roles([entry]), y.stop - y.start, x.stop - x.start), device)
        target = torch.from_numpy(np.array(arrays.target[y, x])).to(device).permute(2, 0, 1)[None]
        layers = net(samples, UNIT)
        image, clean, noisy = (p * entry.target_scale for p in (layers.beauty(), target, pixel_means(samples)))
        rows.append([
            relative(image, clean), float(smape(image, clean)), abs(float(image.mean() / clean.mean()) - 1),
            float(layers.weight[:, 0].mean()), relative(noisy, clean), float(smape(noisy, clean)),
        ])
        if number in chosen:
            seen, made, true = (picture[0].permute(1, 2, 0).cpu().numpy() for picture in (noisy, image, clean))
            shown.append(Shown(entry.name, seen, made, true, layers.weight[0, 0].cpu().numpy()))
    table = np.array(rows)
    means = table.mean(0)
    for column in (0, 4):
        means[column] = math.exp(np.log(table[:, column]).mean())
    return Score(*means.tolist()), shown


def relative(image: Tensor, clean: Tensor) -> float:
    """relMSE of pictures in the common scale."""
    return float(((image - clean) ** 2 / (clean**2 + EPSILON)).mean())


def pixel_means(samples: Samples) -> Tensor:
    """(B, 3, H, W) the weighted means of the samples' radiance; black where there are none."""
    weighted = samples.roles["radiance"] * samples.weight[:, None]
    return Segments(samples.counts).sum(weighted).view(*samples.shape, 3).permute(0, 3, 1, 2)


def _middle(extent: int, size: int) -> slice:
    start = max(extent - size, 0) // 2
    return slice(start, start + min(extent, size))
