"""Random training batches from a cache: crops, sample subsets, augmentation, as the model's `Samples`.

Samples of a pixel were stored in random order, so any run of consecutive ones is a random subset.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from model.samples import Samples
from pipelines.training.cache import CHANNELS, SampleCache, SceneEntry
from pipelines.training.recipe import Augmentation, Recipe

HalfArray = npt.NDArray[np.float16]
FloatArray = npt.NDArray[np.float32]

# Roles that may be missing from real files; radiance never is.
DROPPABLE = ("depth", "normal", "albedo", "specular", "roughness", "motion", "coc", "lens", "time")
DROP_EACH = 0.35  # of the roles, in a batch that loses some


@dataclass
class Batch:
    """samples of B crops; target (B, 3, H, W) and `scale` (B,) that brings both to the metrics' common scale."""

    samples: Samples
    target: Tensor
    scale: Tensor
    layers: int


def _choose(rng: np.random.Generator, options: Sequence[tuple[int, float]]) -> int:
    values, weights = zip(*options, strict=True)
    return int(rng.choice(values, p=np.asarray(weights) / sum(weights)))


def _mirror(samples: FloatArray) -> None:
    """Negates the x of everything that has a direction on screen; the caller flips the columns."""
    for role in ("normal", "motion", "lens"):
        samples[..., CHANNELS[role].start] *= -1


def _transpose(samples: FloatArray) -> None:
    """Swaps screen x and y. Normals have y up where the screen has y down: (nx, ny) -> (-ny, -nx)."""
    for role, sign in (("normal", -1), ("motion", 1), ("lens", 1)):
        x = CHANNELS[role].start
        samples[..., [x, x + 1]] = sign * samples[..., [x + 1, x]]


def _turn(rng: np.random.Generator, samples: FloatArray, target: FloatArray) -> tuple[FloatArray, FloatArray]:
    """One of the eight symmetries of the square."""
    if rng.random() < 0.5:
        samples, target = samples.swapaxes(0, 1), target.swapaxes(0, 1)
        _transpose(samples)
    if rng.random() < 0.5:
        samples, target = samples[:, ::-1], target[:, ::-1]
        _mirror(samples)
    if rng.random() < 0.5:  # a vertical flip is a horizontal one between two transpositions
        samples, target = samples[::-1], target[::-1]
        for role in ("normal", "motion", "lens"):
            samples[..., CHANNELS[role].start + 1] *= -1
    return samples, target


def _augment(
    rng: np.random.Generator, samples: FloatArray, target: FloatArray, how: Augmentation
) -> tuple[FloatArray, FloatArray, float]:
    """Turns, recolours, rescales and litters one crop; returns it with the factor its radiance was multiplied by."""
    if how.symmetries:
        samples, target = _turn(rng, samples, target)
    if how.permute_colors:
        order = rng.permutation(3)
        for role in ("radiance", "albedo", "specular"):
            samples[..., CHANNELS[role]] = samples[..., CHANNELS[role]][..., order]
        target = target[..., order]
    gain = float(2.0 ** (rng.normal() * how.exposure_stops))
    samples[..., CHANNELS["radiance"]] *= gain
    if rng.random() < how.fireflies:
        hit = rng.random(samples.shape[:3]) < 10 ** rng.uniform(-4.5, -3)
        samples[hit, CHANNELS["radiance"]] *= 10 ** rng.uniform(1, 4.5, (int(hit.sum()), 1)).astype(np.float32)
    return samples, target * np.float32(gain), gain


def crop_samples(block: HalfArray, y: int, x: int, size: int, first: int, count: int) -> FloatArray:
    """(size, size, count, C) float32: `count` consecutive samples from index `first` on, cyclically."""
    part = block[y : y + size, x : x + size]
    total = block.shape[2]
    index = (first + np.arange(count)) % total
    wrapped = first + count > total
    chosen = part[:, :, index] if wrapped else part[:, :, first : first + count]
    return chosen.astype(np.float32)


def to_samples(crops: Sequence[FloatArray], roles: Sequence[str]) -> Samples:
    """Crops (H, W, n, C) of one size and one n -> the model's input with the roles asked for."""
    stacked = torch.from_numpy(np.ascontiguousarray(np.stack(crops)))  # (B, H, W, n, C)
    batch, height, width, count, channels = stacked.shape
    flat = stacked.view(-1, channels)
    return Samples(
        shape=(batch, height, width),
        counts=torch.full((batch * height * width,), count, dtype=torch.int32),
        weight=torch.full((flat.shape[0],), 1 / count),
        coverage=flat[:, CHANNELS["coverage"]][:, 0].contiguous(),
        roles={role: flat[:, CHANNELS[role]].contiguous() for role in roles},
    )


def common_roles(entries: Sequence[SceneEntry]) -> list[str]:
    """Roles that every entry has, in canonical order, coverage apart."""
    return [role for role in CHANNELS if role != "coverage" and all(role in entry.roles for entry in entries)]


def random_batch(cache: SampleCache, entries: Sequence[SceneEntry], recipe: Recipe, seed: Sequence[int]) -> Batch:
    """The batch that this seed names: crops of random scenes with one number of samples and one set of roles."""
    rng = np.random.default_rng(seed)
    chosen = [entries[int(k)] for k in rng.integers(0, len(entries), recipe.batch)]
    count = min(_choose(rng, recipe.samples), min(entry.samples for entry in chosen))
    layers = _choose(rng, recipe.layers)
    roles = common_roles(chosen)
    if rng.random() < recipe.augmentation.drop_roles:
        roles = [role for role in roles if role not in DROPPABLE or rng.random() >= DROP_EACH]
    crops, targets, scales = [], [], []
    for entry in chosen:
        block, target = cache.arrays(entry)
        size = min(recipe.crop, entry.height, entry.width)
        y, x = (int(rng.integers(0, extent - size + 1)) for extent in (entry.height, entry.width))
        first = int(rng.integers(0, entry.samples))
        samples = crop_samples(block, y, x, size, first, count)
        clean = np.array(target[y : y + size, x : x + size])
        samples, clean, gain = _augment(rng, samples, clean, recipe.augmentation)
        crops.append(samples)
        targets.append(clean)
        scales.append(entry.target_scale / gain)
    stacked = torch.from_numpy(np.ascontiguousarray(np.stack(targets))).permute(0, 3, 1, 2).contiguous()
    return Batch(to_samples(crops, roles), stacked, torch.tensor(scales), layers)
