"""The light of a picture, held to that of its samples.

A network that is trained to err little in every pixel loses light where few samples carry much of it. What a frame's
light is as a whole, its samples know better than any one pixel's: what they say is missing is given back, as far as
their own noise lets them tell. It is spread over all that is noisy; where picture and samples agree, nothing changes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F

from pipelines.inference import FrameLayers

CELL = 8  # pixels along a side; noise is told for three such cells
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
    for top in range(0, len(samples), ROWS * CELL):
        rows = slice(top, top + ROWS * CELL)
        known = counted[rows]
        shown = layers.color[:, :, rows].mean(1, dtype=np.float64).sum(0)
        lost = np.where(known, samples[rows] - shown, 0)
        parts.append([_sums(plane) for plane in (known, np.where(known, shown, 0), lost, np.square(lost))])
    return _Cells(*(np.concatenate(planes) for planes in zip(*parts, strict=True)))


def _sums(plane: npt.NDArray[np.generic]) -> DoubleArray:
    """(H, W) -> sums over cells, those at the end smaller."""
    height, width = plane.shape
    along = np.add.reduceat(plane, np.arange(0, width, CELL), 1, dtype=np.float64)
    return np.add.reduceat(along, np.arange(0, height, CELL), 0)


def _smooth(cells: DoubleArray) -> DoubleArray:
    """Means over 3 x 3 cells, taken twice; fewer at the border."""
    plane = torch.from_numpy(cells)[None, None]
    for _ in range(2):
        plane = F.avg_pool2d(plane, 3, 1, 1, count_include_pad=False)
    smooth: DoubleArray = plane[0, 0].numpy()
    return smooth


def _enlarged(cells: DoubleArray, size: tuple[int, ...]) -> FloatArray:
    """Bilinear, cell by cell CELL x CELL pixels, cut to the size."""
    plane = torch.from_numpy(cells.astype(np.float32))[None, None]
    picture: FloatArray = F.interpolate(plane, scale_factor=CELL, mode="bilinear", align_corners=False)[0, 0].numpy()
    return picture[: size[0], : size[1]]
