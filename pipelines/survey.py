"""What a frame is like, measured before it is denoised: exposure, depth scale, mixing of depths, what says nothing.

One pass over the file in blocks of rows, so a frame larger than memory is surveyed too. What follows from it is
decisions.py's.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from deep_io.path_samples import PathSamples
from deep_io.samples import Window
from pipelines.cells import Cells, CellSurvey

EXPOSURE_BIN = 16  # pixels along a bin's side
DARKEST = 1e-30  # a radiance below is black: the inverse of a denormal number is no single-precision number
STIRRING = 1 / 16  # beyond it a role says something; in pixels, motion and blur below it are less than a filter's width
MIXED_DEPTH = 0.1  # of the depth: hits of a pixel that are closer together are one surface


@dataclass(frozen=True)
class Survey:
    """What one frame holds.

    exposure : 1 / radiance, see `exposure_of`
    depth : median over the pixels of their hits' mean depth, scene units; 1 without depth or hits
    pixels, empty_pixels, samples : counts
    mixed : share of the pixels in which depth mixes: hits further apart than MIXED_DEPTH, or hits and misses; None
        without depth
    hits : samples that hit anything
    largest : the largest magnitude of each role but radiance and depth, over all hits; of a role that varies beyond
        STIRRING anywhere, only that it does: infinity
    light : (H, W) float32, mean radiance of each pixel's samples, averaged over R, G, B; NaN where there is none
    cells : the cells with nothing to do
    repairs : non-finite values that were mended, by role
    """

    exposure: float
    depth: float
    pixels: int
    empty_pixels: int
    samples: int
    mixed: float | None
    hits: int
    largest: dict[str, float]
    light: npt.NDArray[np.float32]
    cells: Cells
    repairs: dict[str, int]


def survey(blocks: Iterable[PathSamples], display: Window | None = None) -> Survey:
    """Looks at every sample of a frame, given as blocks of whole rows from the top.

    display : the display window, where the grid of cells begins; None: the first block's corner
    """
    gathered: Surveyor | None = None
    for block in blocks:
        gathered = gathered or Surveyor(display or block.window)
        gathered.add(block)
    assert gathered is not None
    return gathered.result()


class Surveyor:
    """A survey in the making, for a caller that looks at the blocks itself."""

    def __init__(self, display: Window) -> None:
        self._bins: dict[int, npt.NDArray[np.float64]] = {}
        self._areas: dict[int, npt.NDArray[np.float64]] = {}
        self._light: list[npt.NDArray[np.float32]] = []
        self._depths: list[npt.NDArray[np.float64]] = []
        self._repairs: Counter[str] = Counter()
        self._pixels = self._empty = self._samples = self._mixed = self._hits = 0
        self._largest: dict[str, float] = {}
        self._cells = CellSurvey((display.xmin, display.ymin))
        self._top: int | None = None

    def add(self, block: PathSamples) -> None:
        """Takes in the next rows."""
        self._top = block.window.ymin if self._top is None else self._top
        luminance = _pixel_luminance(block)
        _add_bins(self._bins, self._areas, luminance, block.window.ymin - self._top)
        self._light.append(np.where(block.counts > 0, luminance, np.nan).astype(np.float32))
        if "depth" in block.roles:
            self._depths.append(pixel_depth(block))
            self._mixed += int(_mixes_depth(block).sum())
        for role in block.roles.keys() - {"radiance", "depth"}:
            self._largest[role] = _largest(block.roles[role], self._largest.get(role, 0.0))
        self._cells.add(block)
        self._repairs.update(block.repairs)
        self._pixels += block.counts.size
        self._empty += int((block.counts == 0).sum())
        self._samples += len(block.weight)
        self._hits += int((block.coverage > 0).sum())

    def result(self) -> Survey:
        """What was found, after the last row."""
        means = np.concatenate([self._bins[row] / self._areas[row] for row in sorted(self._bins)])
        return Survey(
            exposure=exposure_of_bins(means),
            depth=median_depth(self._depths),
            pixels=self._pixels,
            empty_pixels=self._empty,
            samples=self._samples,
            mixed=self._mixed / max(self._pixels, 1) if self._depths else None,
            hits=self._hits,
            largest=self._largest,
            light=np.concatenate(self._light),
            cells=self._cells.result(),
            repairs=dict(self._repairs),
        )


def exposure_of(radiance: npt.NDArray[np.float32]) -> float:
    """Exposure (1 / radiance) of a picture of mean radiance (H, W, 3): 2^-median(log2 of the positive bin means).

    Bins are EXPOSURE_BIN pixels square, the last ones smaller; 1 if all are black. Non-finite pixels count as 0.
    """
    luminance = radiance.mean(-1, dtype=np.float64)
    bins: dict[int, npt.NDArray[np.float64]] = {}
    areas: dict[int, npt.NDArray[np.float64]] = {}
    _add_bins(bins, areas, np.where(np.isfinite(luminance), luminance, 0), 0)
    return exposure_of_bins(np.concatenate([bins[row] / areas[row] for row in sorted(bins)]))


def exposure_of_bins(means: npt.NDArray[np.float64]) -> float:
    """Exposure from the bins' mean radiance."""
    positive = means[means > DARKEST]
    return float(2.0 ** -np.median(np.log2(positive))) if positive.size else 1.0


def _largest(values: npt.NDArray[np.float32], before: float) -> float:
    """The largest magnitude so far; one beyond STIRRING settles it, and nothing is looked at any more."""
    if before > STIRRING or not values.size:
        return before
    size = max(before, float(values.max()), -float(values.min()))
    return size if size <= STIRRING else np.inf


def _pixel_luminance(block: PathSamples) -> npt.NDArray[np.float64]:
    """(H, W) weighted mean of the samples' radiance, averaged over R, G, B; 0 without samples."""
    contribution = block.weight.astype(np.float64) * block.roles["radiance"].mean(1, dtype=np.float64)
    return _pixel_sums(contribution, block).reshape(block.counts.shape)


def pixel_depth(block: PathSamples) -> npt.NDArray[np.float64]:
    """(M,) mean depth of the hits of each pixel that has hits with a known depth."""
    depth = block.roles["depth"][:, 0].astype(np.float64)
    known = (block.coverage > 0) & (depth > 0)
    counts = _pixel_sums(known.astype(np.float64), block)
    sums = _pixel_sums(np.where(known, depth, 0), block)
    return sums[counts > 0] / counts[counts > 0]


def _mixes_depth(block: PathSamples) -> npt.NDArray[np.bool_]:
    """(M,) for each pixel that has samples: whether its hits are far apart in depth, or mixed with misses."""
    starts = block.offsets[:-1][block.counts.reshape(-1) > 0]
    if not starts.size:
        return np.zeros(0, np.bool_)
    depth = np.where(block.coverage > 0, block.roles["depth"][:, 0], np.float32(np.inf))
    near, far = np.minimum.reduceat(depth, starts), np.maximum.reduceat(depth, starts)
    return (far > near * np.float32(1 + MIXED_DEPTH)) & np.isfinite(near)


def median_depth(depths: list[npt.NDArray[np.float64]]) -> float:
    """The median of blocks of pixel depths; 1 without any."""
    values = np.concatenate(depths) if depths else np.empty(0)
    return float(np.median(values)) if values.size else 1.0


def _pixel_sums(values: npt.NDArray[np.float64], block: PathSamples) -> npt.NDArray[np.float64]:
    """(N,) -> (P,): sums over each pixel's samples."""
    sums = np.zeros(block.counts.size)
    some = block.counts.reshape(-1) > 0
    if values.size:
        sums[some] = np.add.reduceat(values, block.offsets[:-1][some])
    return sums


def _add_bins(
    bins: dict[int, npt.NDArray[np.float64]],
    areas: dict[int, npt.NDArray[np.float64]],
    luminance: npt.NDArray[np.float64],
    first_row: int,
) -> None:
    """Adds rows of luminance, the first of them row `first_row` of the frame, to the sums and areas of their bins."""
    height, width = luminance.shape
    cols = np.arange(0, width, EXPOSURE_BIN)
    sums = np.add.reduceat(luminance, cols, 1)
    sizes = np.diff([*cols, width]).astype(np.float64)
    for row in range(height):
        number = (first_row + row) // EXPOSURE_BIN
        if number not in bins:
            bins[number], areas[number] = np.zeros(len(cols)), np.zeros(len(cols))
        bins[number] += sums[row]
        areas[number] += sizes

