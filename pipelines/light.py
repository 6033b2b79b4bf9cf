"""The light of a picture, held to that of its samples.

A network that is trained to err little in every pixel loses light where few samples carry much of it. What a frame's
light is as a whole, its samples know better than any one pixel's: what they say is missing is given back, as far as
their own noise lets them tell. It goes where samples are noisy and the network had to guess; where they agree, the
picture is what it was.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F

from pipelines.inference import FrameLayers

WIDE, NEAR = 49, 9  # pixels; noise is that of such a neighbourhood, and none where there is next to none near by
LEAST_NEAR = 0.25  # of the wide neighbourhood's
USUAL = 0.015  # of the light: what a network usually loses or adds, root mean square
BLOCK_PIXELS = 1 << 20
MOST = 0.5  # of a pixel's light may be added or taken
BRIGHTEST = 1e3  # times the frame's mean: beyond it, noise is not told apart

FloatArray = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]


def hold_light(layers: FrameLayers, samples: FloatArray, settled: Mask, lights: int = 0) -> None:
    """Scales, in place, radiance and the first `lights` extra values of all layers of a pixel alike.

    samples : (H, W) mean radiance of each pixel's samples, averaged over R, G, B; NaN where there is none
    settled : (H, W) pixels that are left as they are, and not counted
    """
    shown, known = np.empty_like(samples), np.isfinite(samples)
    counted = known & ~settled
    light = lost = squared = noisy_light = 0.0
    for rows in _blocks(samples.shape):
        shown[rows] = np.where(known[rows], layers.color[:, :, rows].mean(1).sum(0), 0)
        missing = _missing(samples[rows], shown[rows])[counted[rows]]
        light += float(shown[rows][counted[rows]].sum(dtype=np.float64))
        lost += float(missing.sum(dtype=np.float64))
        squared += float(np.square(missing, dtype=np.float64).sum())
    count = int(counted.sum())
    if count < 2 or not 0 < light < np.inf:
        return
    usual, error = USUAL * light, squared - lost**2 / count  # of sums over the frame, the second squared
    wanted = lost * usual**2 / (usual**2 + error)
    noise = np.empty_like(samples)
    for rows in _blocks(samples.shape):
        noise[rows] = np.where(settled[rows], 0, _noise(samples, shown, rows, light / count))
        noisy_light += float((shown[rows] * noise[rows]).sum(dtype=np.float64))
    if wanted == 0 or not noisy_light > 0:
        return
    for rows in _blocks(samples.shape):
        gain = 1 + np.clip(np.float32(wanted / noisy_light) * noise[rows], -MOST, MOST)
        layers.color[:, :, rows] *= gain
        layers.extra[:, :lights, rows] *= gain


def _blocks(shape: tuple[int, ...]) -> Iterator[slice]:
    """Rows of a picture, some at a time, so that what is made of them takes little memory."""
    step = max(1, BLOCK_PIXELS // shape[1])
    for start in range(0, shape[0], step):
        yield slice(start, min(start + step, shape[0]))


def _missing(samples: FloatArray, shown: FloatArray) -> FloatArray:
    """What the samples have and the picture has not; 0 without samples."""
    missing: FloatArray = np.where(np.isfinite(samples), samples - shown, np.float32(0))
    return missing


def _noise(samples: FloatArray, shown: FloatArray, rows: slice, mean: float) -> FloatArray:
    """(rows, W) 0..1: mean square of what samples miss over that of the light, of the neighbourhood's known pixels."""
    near_by = slice(max(rows.start - WIDE, 0), rows.stop + WIDE)  # half a window on either side, twice
    inside = slice(rows.start - near_by.start, rows.stop - near_by.start)
    there, here = samples[near_by], shown[near_by]
    far, bright = (np.clip(picture / np.float32(mean), -BRIGHTEST, BRIGHTEST)
                   for picture in (_missing(there, here), here))
    wide, near = (_relative_square(far, bright, np.isfinite(there), size)[inside] for size in (WIDE, NEAR))
    noise: FloatArray = np.minimum(wide, near / LEAST_NEAR).clip(0, 1)
    return noise


def _relative_square(far: FloatArray, bright: FloatArray, known: Mask, size: int) -> FloatArray:
    around = _smooth(bright, size)
    lit = around > 0
    share = _smooth(known.astype(np.float32), size)
    return np.where(lit, _smooth(far * far, size) * share / np.square(np.where(lit, around, 1)), 0)


def _smooth(picture: FloatArray, size: int) -> FloatArray:
    """Means over size x size pixels, taken twice; fewer at the border."""
    plane = torch.from_numpy(picture)[None, None]
    for height, width in ((1, size), (size, 1)) * 2:
        plane = F.avg_pool2d(plane, (height, width), 1, (height // 2, width // 2), count_include_pad=False)
    result: FloatArray = plane[0, 0].numpy()
    return result
