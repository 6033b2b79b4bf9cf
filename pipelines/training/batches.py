"""Training batches from a cache: crops of random scenes and random subsets of their samples, as the model's `Samples`.

What the crops of a batch must agree on (scenes, number of samples, layers, roles) comes from (seed, step), everything
else of a crop from (seed, step, its number): processes that share a batch make their crops without a word between them,
and any number of processes makes the same ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from model.samples import Samples
from pipelines.training.augment import Turn, relight
from pipelines.training.cache import CHANNELS, SampleCache, SceneArrays, SceneEntry
from pipelines.training.recipe import Odds, Recipe

FloatArray = npt.NDArray[np.float32]
IndexArray = npt.NDArray[np.int64]

MOST_SAMPLES = 1 << 20

# Roles that may be missing from real files; radiance never is.
DROPPABLE = ("depth", "normal", "albedo", "specular", "roughness", "motion", "coc", "lens", "time")


@dataclass
class Crop:
    """Some pixels of a scene: counts (P,) samples of each, values (N, C) float32, weight (N,), 1 over each pixel."""

    counts: IndexArray
    values: FloatArray
    weight: FloatArray


@dataclass
class Batch:
    """samples of B crops; target (B, 3, H, W) and `scale` (B,) that brings both to the metrics' common scale."""

    samples: Samples
    target: Tensor
    scale: Tensor
    layers: int

    def to(self, device: torch.device) -> Batch:
        """The batch on a device."""
        return Batch(move(self.samples, device), self.target.to(device), self.scale.to(device), self.layers)


def move(samples: Samples, device: torch.device) -> Samples:
    """Samples on a device."""
    if device == samples.weight.device:
        return samples
    return replace(samples, counts=samples.counts.to(device), weight=samples.weight.to(device),
                   coverage=samples.coverage.to(device), roles={k: v.to(device) for k, v in samples.roles.items()})


def take(arrays: SceneArrays, y: slice, x: slice, turn: Turn, count: int, share: float,
         rng: np.random.Generator | None = None, even: bool = False) -> Crop:
    """A crop, turned, with `count` samples in every pixel; where pixels differ, with `share` of those each one has.

    Samples of a scene weighted by `over` are all taken: they only mean something together. Which others, is drawn
    from `rng`; without one, the first. `even`: spread over the shutter instead, one in each of as many intervals; any
    in its interval, or without `rng` the middle one. The directions in the values are still those of the file.
    """
    if arrays.offsets is not None:
        width = arrays.target.shape[1]
        rows = np.arange(y.start, y.stop)[:, None]
        pixels = turn.picture(rows * width + np.arange(x.start, x.stop)).ravel()
        return _take_ragged(arrays, arrays.offsets, pixels, share, rng, even)
    held = arrays.samples.shape[2]
    first = 0 if rng is None else int(rng.integers(0, held))
    block = turn.picture(arrays.samples[y, x])
    if even:
        order = np.argsort(block[..., CHANNELS["time"].start], axis=2, kind="stable")
        counts = np.full(order[..., 0].size, count)
        picked = spread(np.full_like(counts, held), counts, rng).reshape(*order.shape[:2], count)
        chosen = np.take_along_axis(block, np.take_along_axis(order, picked, 2)[..., None], 2)
    elif first + count > held:  # samples lie in a circle
        chosen = block[:, :, (first + np.arange(count)) % held]
    else:
        chosen = block[:, :, first : first + count]
    values = chosen.astype(np.float32, order="C").reshape(-1, chosen.shape[-1])
    return Crop(np.full(len(values) // count, count, np.int64), values, np.full(len(values), 1 / count, np.float32))


def spread(held: IndexArray, counts: IndexArray, rng: np.random.Generator | None) -> IndexArray:
    """(N,) ascending places: in each pixel `counts` (P,) of 0 .. `held` - 1 (P,), evenly spread, none twice.

    One is drawn from each of `counts` intervals, whose bounds are drawn for each pixel; without `rng` its middle one.
    """
    step, number = np.repeat(held / np.maximum(counts, 1), counts), _within(counts)
    shift = np.repeat(np.full(counts.size, 0.5) if rng is None else rng.random(counts.size), counts)
    last = number == np.repeat(counts, counts) - 1
    start = np.where(number == 0, 0, np.floor(number * step + shift)).astype(np.int64)
    stop = np.where(last, np.repeat(held, counts), np.floor((number + 1) * step + shift)).astype(np.int64)
    place = (0.5 if rng is None else rng.random(number.size)) * (stop - start)
    return start + place.astype(np.int64)


def _within(counts: IndexArray) -> IndexArray:
    """(N,) 0, 1, ... `counts` - 1 for each pixel."""
    places: IndexArray = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    return places


def _take_ragged(arrays: SceneArrays, offsets: IndexArray, pixels: IndexArray, share: float,
                 rng: np.random.Generator | None, even: bool) -> Crop:
    """The pixels of these numbers; the share is rounded at random, and no pixel that has samples loses them all."""
    start = offsets[pixels]
    held = offsets[pixels + 1] - start
    if arrays.weight is not None:
        counts, first = held, np.zeros_like(held)
    else:
        rounding = 0.5 if rng is None else rng.random(pixels.size)
        counts = np.clip(np.floor(held * share + rounding).astype(np.int64), np.minimum(held, 1), held)
        first = np.zeros_like(held) if rng is None else (rng.random(pixels.size) * held).astype(np.int64)
    if even and arrays.weight is None:
        there = np.repeat(start, held) + _within(held)
        time = arrays.samples[there, CHANNELS["time"].start]
        by_time = there[np.lexsort((time, np.repeat(np.arange(held.size), held)))]
        index = by_time[np.repeat(np.cumsum(held) - held, counts) + spread(held, counts, rng)]
    else:
        circle = (_within(counts) + np.repeat(first, counts)) % np.repeat(held, counts)
        index = np.repeat(start, counts) + circle
    if arrays.weight is not None:
        weight = arrays.weight[index]
    else:
        weight = np.repeat(1 / np.maximum(counts, 1), counts).astype(np.float32)
    return Crop(counts, arrays.samples[index].astype(np.float32), weight)


def to_samples(crops: Sequence[Crop], roles: Sequence[str], height: int, width: int) -> Samples:
    """Crops of one size -> the model's input with the roles asked for."""
    flat = torch.from_numpy(np.concatenate([crop.values for crop in crops]))
    return Samples(
        shape=(len(crops), height, width),
        counts=torch.from_numpy(np.concatenate([crop.counts for crop in crops]).astype(np.int32)),
        weight=torch.from_numpy(np.concatenate([crop.weight for crop in crops])),
        coverage=flat[:, CHANNELS["coverage"]][:, 0].contiguous(),
        roles={role: flat[:, CHANNELS[role]].contiguous() for role in roles},
    )


def common_roles(entries: Sequence[SceneEntry]) -> list[str]:
    """Roles that every entry has, in canonical order, coverage apart."""
    return [role for role in CHANNELS if role != "coverage" and all(role in entry.roles for entry in entries)]


def crop_size(entries: Sequence[SceneEntry], recipe: Recipe) -> int:
    """Pixels along the side of the crops that all of these scenes are large enough for."""
    return min(recipe.crop, *(min(entry.height, entry.width) for entry in entries))


def random_batch(cache: SampleCache, recipe: Recipe, step: int, part: slice = slice(None),
                 entries: Sequence[SceneEntry] | None = None) -> Batch:
    """The crops `part` of the batch of a step, the same whatever the other parts are; `entries` None: all scenes."""
    entries = cache.entries if entries is None else entries
    common = np.random.default_rng((recipe.seed, step))
    chosen = [entries[int(k)] for k in common.integers(0, len(entries), recipe.batch)]
    # the same number in every pixel where that can be, which the network is much faster on
    count = min(_draw(common, recipe.samples), *(entry.samples for entry in chosen if not entry.ragged), MOST_SAMPLES)
    layers = _draw(common, recipe.layers)
    roles, how = common_roles(chosen), recipe.augmentation
    if common.random() < how.drop_roles:
        roles = [role for role in roles if role not in DROPPABLE or common.random() >= how.drop_each]
    size = crop_size(entries, recipe)
    crops, targets, scales = [], [], []
    for number in range(recipe.batch)[part]:
        # +1, since NumPy takes (seed, step) and (seed, step, 0) for the same seed
        rng = np.random.default_rng((recipe.seed, step, number + 1))
        entry = chosen[number]
        arrays = cache.arrays(entry)
        y, x = (slice(c, c + size) for c in (int(rng.integers(0, e - size + 1)) for e in (entry.height, entry.width)))
        turn = Turn.draw(rng) if how.symmetries else Turn()
        even = "time" in entry.roles and rng.random() < recipe.even_times
        crop = take(arrays, y, x, turn, count, count / entry.samples, rng, even)
        turn.directions(crop.values)
        target, gain = relight(rng, crop.values, turn.picture(arrays.target[y, x]), how)
        crops.append(crop)
        targets.append(target)
        scales.append(entry.target_scale / gain)
    stacked = torch.from_numpy(np.ascontiguousarray(np.stack(targets))).permute(0, 3, 1, 2).contiguous()
    return Batch(to_samples(crops, roles, size, size), stacked, torch.tensor(scales), layers)


def _draw(rng: np.random.Generator, odds: Odds) -> int:
    values, weights = zip(*odds, strict=True)
    return int(rng.choice(values, p=np.asarray(weights) / sum(weights)))
