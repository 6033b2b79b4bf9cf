"""The light of a picture, held to that of its samples.

A network that is trained to err little in every pixel loses light where few samples carry much of it. What a frame's
light is as a whole, its samples know better than any one pixel's: what they say is missing is given back, what they
say is too much is taken, as far as their own noise lets them tell. It is spread over all that is noisy; where picture
and samples agree, nothing changes. Only the mean of the colours is held: a pixel's colours are scaled alike.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F

from pipelines.inference import FrameLayers

CELL = 8  # pixels along a side, more or less; noise is told by the 5 x 5 cells around one
ROWS = 32  # of cells, gathered at a time
NOISY = 0.01  # relative squared difference of a pixel's samples and the picture; beyond it, all takes alike
USUAL = 0.015  # of the light: what a network usually loses or adds, root mean square
MOST = 4.0  # times the share that the whole picture lacks, added to a pixel

FloatArray = npt.NDArray[np.float32]
DoubleArray = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]


def hold_light(layers: FrameLayers, samples: FloatArray, settled: Mask, lights: int = 0) -> None:
    """Scales, in place, radiance and the first `lights` extra values of all layers of a pixel alike.

    samples : (H, W) mean radiance of each pixel's samples, averaged over R, G, B; NaN where there is none
    settled : (H, W) pixels that are left as they are, and not counted
    """
    seen = _gather(layers, samples, np.isfinite(samples) & ~settled)
    count, light, lost = seen.count.sum(), seen.light.sum(), seen.lost.sum()
    if count < 2 or not 0 < light < np.inf:
        return
    variance = seen.squared.sum() - lost**2 / count  # of `lost`, which is a sum
    wanted = lost / (1 + variance / (USUAL * light) ** 2)
    noise = seen.noise()
    noisy = (seen.light * noise).sum()
    if wanted == 0 or not noisy > 0:
        return
    share = MOST * abs(wanted) / light
    gain = 1 + _enlarged(noise * np.clip(wanted / noisy, -share, share), samples.shape)
    gain[settled] = 1
    layers.color *= gain
    layers.extra[:, :lights] *= gain


@dataclass
class _Cells:
    """Sums over the counted pixels of each cell, (rows, columns): their number, the light of the picture, what of that
    of the samples it lacks, and the square of that."""

    count: DoubleArray
    light: DoubleArray
    lost: DoubleArray
    squared: DoubleArray

    def noise(self) -> DoubleArray:
        """(rows, columns) 0..1: mean square of what is lost over the square of the light, by NOISY."""
        light = _smooth(self.light)
        lit = light > 0
        relative = _smooth(self.squared) * _smooth(self.count) / np.square(np.where(lit, light, 1))
        noise: DoubleArray = np.where(lit, np.minimum(relative / NOISY, 1), 0)
        return noise


def _gather(layers: FrameLayers, samples: FloatArray, counted: Mask) -> _Cells:
    """Some rows at a time, so that what is made of them takes little memory."""
    parts = []
    down, along = _edges(samples.shape[0]), _edges(samples.shape[1])
    for first in range(0, len(down) - 1, ROWS):
        tall = down[first : first + ROWS + 1]
        rows = slice(tall[0], tall[-1])
        known = counted[rows]
        shown = layers.color[:, :, rows].mean(1, dtype=np.float64).sum(0)
        lost = np.where(known, samples[rows] - shown, 0)
        parts.append([_sums(plane, tall - tall[0], along)
                      for plane in (known, np.where(known, shown, 0), lost, np.square(lost))])
    return _Cells(*(np.concatenate(planes) for planes in zip(*parts, strict=True)))


def _edges(size: int) -> npt.NDArray[np.int64]:
    """(cells + 1,) where cells of about CELL pixels begin and end; the same from either side, as in a mirror."""
    count = -(-size // CELL)
    count += size % 2 and 1 - count % 2  # an odd size has no middle between two cells
    half = np.arange(count // 2 + 1) * size // count
    return np.concatenate([half, (size - half[::-1])[1 - count % 2 :]])


def _sums(plane: npt.NDArray[np.generic], down: npt.NDArray[np.int64], along: npt.NDArray[np.int64]) -> DoubleArray:
    """(H, W) -> sums over the cells between these edges."""
    return np.add.reduceat(np.add.reduceat(plane, along[:-1], 1, dtype=np.float64), down[:-1], 0)


def _smooth(cells: DoubleArray) -> DoubleArray:
    """Means over 3 x 3 cells, taken twice; fewer at the border."""
    plane = torch.from_numpy(cells)[None, None]
    for _ in range(2):
        plane = F.avg_pool2d(plane, 3, 1, 1, count_include_pad=False)
    smooth: DoubleArray = plane[0, 0].numpy()
    return smooth


def _enlarged(cells: DoubleArray, size: tuple[int, int]) -> FloatArray:
    """(rows, columns) -> (H, W), bilinear."""
    plane = torch.from_numpy(cells.astype(np.float32))[None, None]
    picture: FloatArray = F.interpolate(plane, size=size, mode="bilinear", align_corners=False)[0, 0].numpy()
    return picture
