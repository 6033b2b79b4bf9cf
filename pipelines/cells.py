"""Cells with nothing to do: where every pixel's samples are misses alike, their means are the picture already.

Cells are a fixed grid of the display window, whatever the data window, bands or blocks of rows. A cell passes through
if each of its pixels is quiet: without samples, or with misses alone whose radiance hardly differs. Such pixels still
feed their neighbours. Where all samples of a pixel are the very same, one of them may stand for all (`merged`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from deep_io.path_samples import PathSamples

CELL = 64  # pixels along a cell's side
ALIKE = 1 / 64  # of the largest radiance of a pixel: its samples differ less, so their mean is off by 0.5 % at most
FEW_MERGED = 0.05  # of a frame's samples: fewer are not worth sorting pixels by their number of samples

Floats = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Cells:
    """Which cells of a frame pass through, and what their pixels are.

    passed : (rows, columns) bool; cells in the data window, those at its border may be cut
    row_of, column_of : (H,), (W,) the cell row and cell column of each pixel row and column
    known : (H, W) pixels that hold samples, of those that could pass
    alike : (H, W) pixels whose samples are all the same miss, in any cell
    means : (H, W, 3 + E) mean radiance and mean carried channels of the known pixels; None where no cell passes
    """

    passed: Mask
    row_of: npt.NDArray[np.int64]
    column_of: npt.NDArray[np.int64]
    known: Mask
    alike: Mask
    means: Floats | None

    @property
    def mask(self) -> Mask:
        """(H, W) the pixels that pass through."""
        return self.passed[self.row_of][:, self.column_of]

    def without_pictures(self) -> Cells:
        """Only which cells pass."""
        nothing = np.empty((0, 0), np.bool_)
        return replace(self, known=nothing, alike=nothing, means=None)

    def lines(self) -> list[str]:
        """For a reader: nothing where no cell passes."""
        count = int(self.passed.sum())
        return [f"cells: {count} of {self.passed.size} pass through, with nothing to do"] if count else []


class CellSurvey:
    """Gathers what `Cells` needs from a frame's blocks of rows.

    origin : (x, y) of the display window's first pixel, where the grid of cells begins
    """

    def __init__(self, origin: tuple[int, int]) -> None:
        self.origin = origin
        self._quiet: list[Mask] = []
        self._known: list[Mask] = []
        self._alike: list[Mask] = []
        self._means: list[Floats] = []
        self._corner: tuple[int, int] | None = None
        self._samples = self._saved = 0

    def add(self, block: PathSamples) -> None:
        """Takes in the next rows."""
        self._corner = self._corner or (block.window.xmin, block.window.ymin)
        some = block.counts.reshape(-1) > 0
        missed = _missed(block)
        quiet, alike = ~some, np.zeros(block.counts.size, np.bool_)
        means = np.empty((0, 3 + block.extra.shape[1]), np.float32)
        if missed.any():
            near, same, values = _backgrounds(block, missed)
            quiet[missed], alike[missed] = near, same
            means = values[near]
        counts = block.counts.reshape(-1)
        self._samples += block.total
        self._saved += int(counts[alike].sum()) - int(alike.sum())
        shape = block.counts.shape
        self._quiet.append(quiet.reshape(shape))
        self._known.append((quiet & some).reshape(shape))
        self._alike.append(alike.reshape(shape))
        self._means.append(means)

    def result(self) -> Cells:
        """Which cells pass, after the last row."""
        assert self._corner is not None
        quiet, known, alike = (np.concatenate(masks) for masks in (self._quiet, self._known, self._alike))
        height, width = quiet.shape
        row_of, column_of = (
            (np.arange(size) + corner - first) // CELL - (corner - first) // CELL
            for size, corner, first in zip((height, width), self._corner[::-1], self.origin[::-1], strict=True)
        )
        starts = [np.flatnonzero(np.diff(numbers, prepend=-1)) for numbers in (row_of, column_of)]
        passed = np.logical_and.reduceat(np.logical_and.reduceat(quiet, starts[0], 0), starts[1], 1)
        if self._saved < FEW_MERGED * self._samples:
            alike[:] = False
        cells = Cells(passed, row_of, column_of, known, alike, None)
        return replace(cells, means=self._picture(known)) if passed.any() else cells

    def _picture(self, known: Mask) -> Floats:
        values = np.concatenate(self._means)
        means = np.zeros((*known.shape, values.shape[1]), np.float32)
        means[known] = values
        return means


def merged(block: PathSamples, alike: Mask) -> tuple[PathSamples, Floats]:
    """The block with one sample in each pixel of `alike` (H, W), and each sample's share of the sum of squared weights.

    The one has the weight of all and the mean of what is carried; everything else is the same in all.
    """
    offsets, flat = block.offsets, alike.reshape(-1)
    squares = block.weight * block.weight
    first = offsets[:-1][flat]
    if not first.size:
        return block, squares
    inside = np.repeat(flat, block.counts.reshape(-1))
    kept = ~inside
    kept[first] = True
    starts = np.cumsum(block.counts.reshape(-1)[flat]) - block.counts.reshape(-1)[flat]
    weight, extra = block.weight.copy(), block.extra
    totals = np.add.reduceat(block.weight[inside], starts)
    weight[first], squares[first] = totals, np.add.reduceat(squares[inside], starts)
    if extra.shape[1]:
        extra = extra.copy()
        shares = block.weight[inside][:, None] * block.extra[inside]
        extra[first] = np.add.reduceat(shares, starts, 0) / np.where(totals > 0, totals, 1)[:, None]
    counts = np.where(alike, np.int32(1), block.counts)
    index = np.flatnonzero(kept)  # several times faster than the mask, for rows
    roles = {role: values.take(index, 0) for role, values in block.roles.items()}
    extra = extra.take(index, 0) if extra.shape[1] else extra
    less = PathSamples(counts, weight[index], block.coverage[index], roles, block.window, block.repairs, extra)
    return less, squares[index]


def _missed(block: PathSamples) -> Mask:
    """(P,) pixels that hold samples, all of them misses."""
    some = block.counts.reshape(-1) > 0
    if not block.total or block.coverage.min() > 0:
        return np.zeros(block.counts.size, np.bool_)
    highest = np.maximum.reduceat(block.coverage, block.offsets[:-1][some])
    some[some] = highest <= 0
    return some


def _backgrounds(block: PathSamples, missed: Mask) -> tuple[Mask, Mask, Floats]:
    """(M,) whether the samples of each missed pixel are nearly, and exactly alike, and their means (M, 3 + E)."""
    counts = block.counts.reshape(-1)
    inside = np.flatnonzero(np.repeat(missed, counts))
    starts = np.cumsum(counts[missed]) - counts[missed]
    radiance = block.roles["radiance"].take(inside, 0)
    low, high = np.minimum.reduceat(radiance, starts, 0), np.maximum.reduceat(radiance, starts, 0)
    spread, size = (high - low).max(1), np.maximum(np.abs(high), np.abs(low)).max(1)
    columns = [radiance, block.extra[inside]] if block.extra.shape[1] else [radiance]
    values = np.concatenate(columns, 1, dtype=np.float64)
    weight = block.weight[inside].astype(np.float64)[:, None]
    means = np.add.reduceat(values * weight, starts, 0) / np.add.reduceat(weight, starts, 0)
    return spread <= ALIKE * size, spread == 0, means.astype(np.float32)
