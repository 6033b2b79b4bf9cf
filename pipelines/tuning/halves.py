"""Crops of a frame whose samples are dealt into two halves: one to denoise, the other to hold the result against.

A half is independent of the other, so its mean is a reference with noise of its own (Lehtinen et al. 2018). The halves
are dealt anew each time, pixel by pixel, one sample of each pair to either. Where a renderer spreads a pixel's samples
evenly over the shutter, pairs are neighbours in time, so that both halves see all of it; else they are any two.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from torch import Tensor

from deep_io.csr import offsets_of, pixels_of
from deep_io.path_samples import PathSamples
from deep_io.samples import Window
from model.losses import EPSILON
from pipelines.mirrors import Mirror

NEAR = 9  # pixels: noise is told by the samples of so wide a neighbourhood
BRIGHTEST = 1e15  # in the common scale; the square of what is brighter would be no single-precision number
UNTOLD = 1e6  # variance, over the square of the picture, where no pixel near holds two samples
EVEN = 0.16  # mean square distance of times from even ones, in intervals: 1/12 if stratified, above 1/2 if independent
FEW = 4  # samples of a pixel, of which fewer do not tell whether they are even

Floats = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Halves:
    """A crop, its samples dealt and the picture mirrored.

    given : the samples to denoise
    held : (1, 3, H, W) means of the others, in the common scale; 0 where there are none
    variance : (1, 3, H, W) of `held`, as the neighbourhood tells it
    start : (1, 3, H, W) what the network made of all samples before it was tuned, in the common scale
    known : (1, 1, H, W) bool, whether `held` is known
    """

    given: PathSamples
    held: Tensor
    variance: Tensor
    start: Tensor
    known: Tensor


class Crop:
    """The samples of some pixels of a frame, equally weighted in each.

    samples : all of them, see `cut`
    start : (H, W, 3) what the network makes of them, in the common scale
    scale : brings radiance to the metrics' common scale
    """

    def __init__(self, samples: PathSamples, start: Floats, scale: float) -> None:
        self.scale = scale
        self.samples, self.start = samples, start
        self._even = evenly_timed(samples)
        self._spread = self._variance()

    @property
    def size(self) -> tuple[int, int]:
        """Height and width."""
        height, width = self.samples.counts.shape
        return height, width

    def deal(self, rng: np.random.Generator, mirror: Mirror) -> Halves:
        """Two halves, drawn from `rng`; the odd sample of a pixel goes to those that are given."""
        samples = self.samples
        held = self._held(rng)
        counts = samples.counts.reshape(-1) // 2
        some = counts > 0
        means = np.zeros((counts.size, 3), np.float32)
        if held.any():
            means[some] = np.add.reduceat(self._radiance()[held], offsets_of(counts)[:-1][some]) / counts[some, None]
        variance = self._spread / np.maximum(counts, 1)[:, None]
        planes = (means, variance, self.start.reshape(-1, 3), some[:, None])
        pictures = mirror.picture(np.concatenate(planes, 1, dtype=np.float32).reshape(*self.size, 10)).copy()
        mean, spread, start, known = torch.from_numpy(pictures).permute(2, 0, 1)[None].split([3, 3, 3, 1], 1)
        return Halves(mirror.turn(_kept(samples, ~held)), mean, spread, start, known > 0)

    def _held(self, rng: np.random.Generator) -> npt.NDArray[np.bool_]:
        """(N,) which samples are held back: one of each pair."""
        samples, counts = self.samples, self.samples.counts.reshape(-1)
        key = rng.random(samples.total, np.float32)
        if self._even:  # of a miss the time is not known
            key = np.where(samples.coverage > 0, samples.roles["time"][:, 0], key)
        order = np.lexsort((key, pixels_of(samples.counts)))
        place = np.arange(samples.total, dtype=np.int64) - np.repeat(offsets_of(counts)[:-1], counts)
        drawn = rng.integers(0, 2, samples.total)[np.arange(samples.total) - place % 2]  # one draw for both of a pair
        held = np.zeros(samples.total, np.bool_)
        held[order] = (place < np.repeat(counts // 2 * 2, counts)) & ((place + drawn) % 2 == 1)
        return held

    def _radiance(self) -> npt.NDArray[np.float64]:
        """(N, 3) in the common scale."""
        scaled: npt.NDArray[np.float64] = self.samples.roles["radiance"].astype(np.float64) * self.scale
        return np.clip(scaled, -BRIGHTEST, BRIGHTEST)

    def _variance(self) -> Floats:
        """(P, 3) variance of one sample's radiance: relative to what the network makes of the pixel, the mean over the
        NEAR x NEAR pixels around that hold two.

        Relative, or a lamp's edge would hide what the dark beside it tells. To the network's picture, not to the
        samples' mean, or a firefly would be noise of its own size and tell as much as any other.
        """
        counts, pixel = self.samples.counts.reshape(-1).astype(np.int64), pixels_of(self.samples.counts)
        radiance, some = self._radiance(), counts > 1
        sums = np.stack([np.bincount(pixel, values, counts.size) for values in radiance.T], 1)
        apart = radiance - (sums / np.maximum(counts, 1)[:, None])[pixel]
        squares = np.stack([np.bincount(pixel, values, counts.size) for values in np.square(apart).T], 1)
        variance = squares * (some / np.maximum(counts - 1, 1))[:, None]
        size = np.square(self.start.astype(np.float64)).reshape(-1, 3) + EPSILON
        planes = torch.from_numpy(np.concatenate([variance / size, some[:, None]], 1).reshape(*self.size, 4))
        near = F.avg_pool2d(planes.permute(2, 0, 1), NEAR, 1, NEAR // 2)
        told = near[3:] > 0
        means = torch.where(told, near[:3] / torch.where(told, near[3:], 1), UNTOLD)
        result = means.permute(1, 2, 0).reshape(-1, 3).numpy() * size
        return np.minimum(result, BRIGHTEST**2).astype(np.float32)


def cut(block: PathSamples, x0: int, x1: int, roles: Collection[str]) -> PathSamples:
    """Columns x0 to x1, exclusive, of a block of rows, copied, with these roles; nothing is carried along."""
    inside = np.zeros(block.counts.shape, np.bool_)
    inside[:, x0:x1] = True
    window = block.window
    part = PathSamples(block.counts, block.weight, block.coverage,
                       {role: values for role, values in block.roles.items() if role in roles}, window)
    return _picked(part, np.repeat(inside.reshape(-1), block.counts.reshape(-1)),
                   np.ascontiguousarray(block.counts[:, x0:x1]),
                   Window(window.xmin + x0, window.ymin, window.xmin + x1 - 1, window.ymax))


def evenly_timed(samples: PathSamples) -> bool:
    """Whether the times of a pixel's samples are spread evenly over the shutter, as stratified ones are.

    By the pixels with FEW samples or more that all hit something: others' times are not known.
    """
    if "time" not in samples.roles:
        return False
    counts, pixel = samples.counts.reshape(-1), pixels_of(samples.counts)
    hits = np.bincount(pixel, samples.coverage > 0, counts.size)
    tells = ((hits == counts) & (counts >= FEW))[pixel]
    if not tells.any():
        return False
    time = samples.roles["time"][:, 0]
    order = np.lexsort((time, pixel))
    place = np.arange(samples.total) - np.repeat(offsets_of(counts)[:-1], counts)
    apart = time[order] * np.repeat(counts, counts) - (place + 0.5)  # in intervals; pixels stay in their order
    return bool(np.square(apart)[tells].mean() < EVEN)


def _kept(samples: PathSamples, chosen: npt.NDArray[np.bool_]) -> PathSamples:
    """Some samples of each pixel, weighted equally again."""
    counts = np.bincount(pixels_of(samples.counts)[chosen], minlength=samples.counts.size)
    result = _picked(samples, chosen, counts.reshape(samples.counts.shape).astype(np.int32), samples.window)
    result.weight = np.repeat(1 / np.maximum(counts, 1), counts).astype(np.float32)
    return result


def _picked(samples: PathSamples, chosen: npt.NDArray[np.bool_], counts: npt.NDArray[np.int32], window: Window
            ) -> PathSamples:
    return PathSamples(counts, samples.weight[chosen], samples.coverage[chosen],
                       {role: values[chosen] for role, values in samples.roles.items()}, window, Counter())
