"""Filtering by affinity over a pyramid: kernels whose logits come from distances between learned features.

At level i a target pixel sees a small window of cells of 2^i x 2^i pixels. With f the features, u the sources' bias
and v the targets' preference for a level, the logit of cell s for target t is

    logit = u_s + v_t + log n_s + log B(t - s) - E|f_t - f_s|^2

where the mean is over the pixels of the cell, so that a cell that straddles an edge is far from both sides, B is the
quadratic B-spline over three cells (nothing for level 0), so that no cell boundary shows, and n_s the occupancy. One
normalisation per target over all taps of all levels: out_t = sum_s softmax(logit)_s value_s. Targets keep their full
resolution at every level, so coarse levels respect edges too.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from copy import copy
from itertools import groupby
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

ACTIVE_CELL = 64  # pixels; targets are filtered, or left out, in cells of this size at inference


def pool_cells(log_n: Tensor, planes: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Occupancy-weighted means over size x size cells, exact in the log domain.

    log_n (B, H, W), planes (B, C, H, W) -> mean occupancy's log (B, h, w), means (B, C, h, w); H and W multiples of
    size. An empty cell has -inf and 0.
    """
    if size == 1:
        return log_n, planes
    with torch.no_grad():
        peak = F.max_pool2d(log_n[:, None], size)  # (B, 1, h, w)
        peak = torch.where(peak == -torch.inf, 0, peak)
        spread = peak.repeat_interleave(size, 2).repeat_interleave(size, 3)
    relative = torch.exp(log_n[:, None] - spread)
    sums = F.avg_pool2d(torch.cat([relative * planes, relative], 1), size)
    total = sums[:, -1:]
    some = total > 0
    safe = torch.where(some, total, 1)
    return torch.where(some, torch.log(safe) + peak, -torch.inf)[:, 0], sums[:, :-1] / safe


def spline_logs(size: int, window: int, like: Tensor) -> Tensor:
    """(window, size): log of the B-spline weight of each cell of the window, for each pixel position in a cell.

    The spline's support is three cells; a window of one cell has weight 1; wider windows scale it.
    """
    if size == 1 or window == 1:
        return like.new_zeros(window, size)
    position = (torch.arange(size, dtype=like.dtype, device=like.device) + 0.5) / size - 0.5  # within the own cell
    offsets = torch.arange(window, dtype=like.dtype, device=like.device) - window // 2
    distance = (position[None, :] - offsets[:, None]).abs() * 3 / window
    inner = 0.75 - distance**2
    outer = 0.5 * (1.5 - distance).clamp_min(0) ** 2
    return torch.log(torch.where(distance <= 0.5, inner, outer))


class _Level:
    """One level's cells, padded by the window's radius and repeated along x to the picture's width."""

    def __init__(self, size: int, window: int, bias: Tensor, features: Tensor, values: Tensor) -> None:
        self.size, self.window, radius = size, window, window // 2
        self.rows, self.cols = bias.shape[-2], bias.shape[-1]
        self.bias = F.pad(bias, (radius, radius, radius, radius), value=-torch.inf)
        self.features = F.pad(features, (radius, radius, radius, radius))
        self.values = F.pad(values, (radius, radius, radius, radius))
        self.log_spline = spline_logs(size, window, bias)
        self.wide = [self._widen(plane) for plane in (self.bias, self.features, self.values)]

    def tile(self, image: int, rows: slice, cols: slice) -> _Level:
        """The same level with only these targets of one image; rows and columns are multiples of the level's size."""
        part = copy(self)
        top, left = rows.start // self.size, cols.start // self.size * self.size
        part.rows, part.cols = (rows.stop - rows.start) // self.size, (cols.stop - cols.start) // self.size
        down = slice(top, top + part.rows + self.window - 1)
        along = slice(left, left + (part.cols + self.window - 1) * self.size)
        part.wide = [plane[image : image + 1, ..., down, along] for plane in self.wide]
        return part

    def _widen(self, plane: Tensor) -> Tensor:
        return plane if self.size == 1 else plane.repeat_interleave(self.size, -1)

    def narrow(self, wide: Tensor) -> Tensor:
        """The adjoint of padding and widening: (B, C, rows + 2r, (cols + 2r) * size) -> (B, C, rows, cols)."""
        radius = self.window // 2
        if self.size > 1:
            wide = torch.unflatten(wide, -1, (-1, self.size)).sum(-1)
        return wide[..., radius : radius + self.rows, radius : radius + self.cols]

    def taps(self) -> Iterator[tuple[int, int, slice, slice]]:
        """Every tap (dy, dx) of the window with the rows and columns of the padded, widened cells that it reads."""
        for dy in range(self.window):
            for dx in range(self.window):
                start = dx * self.size
                yield dy, dx, slice(dy, dy + self.rows), slice(start, start + self.cols * self.size)

    def spline(self, dy: int, dx: int) -> Tensor:
        """(1, size, W): log B-spline weights of this tap over the pixels of a row of cells."""
        along_x = self.log_spline[dx].repeat(self.cols)
        return self.log_spline[dy][:, None] + along_x[None, :]


def _filter(levels: Sequence[_Level], target: Tensor, preference: Tensor) -> tuple[Tensor, Tensor]:
    """Means (B, C, H, W) over all taps of all levels, and the taps' weights (taps, B, H, W), which sum to 1."""
    batch, _, height, width = target.shape
    logits = target.new_empty(sum(level.window**2 for level in levels), batch, height, width)
    tap = 0
    for number, level in enumerate(levels):
        aim = torch.unflatten(target, 2, (level.rows, level.size))
        wish = torch.unflatten(preference[:, number], 1, (level.rows, level.size))
        bias, features, _ = level.wide
        for dy, dx, rows, cols in level.taps():
            logit = logits[tap].view(batch, level.rows, level.size, width)
            torch.add(wish, level.spline(dy, dx), out=logit)
            logit += bias[:, rows, None, cols]
            source = features[:, :, rows, None, cols]
            for k in range(source.shape[1]):
                logit.addcmul_(aim[:, k], source[:, k], value=2.0)
            tap += 1
    peak = logits.amax(0)
    peak = torch.where(peak == -torch.inf, 0, peak)
    logits.sub_(peak).exp_()
    total = logits.sum(0)
    logits.div_(torch.where(total > 0, total, 1))
    out = target.new_zeros(batch, levels[0].values.shape[1], height, width)
    tap = 0
    for level in levels:
        result = out.view(batch, -1, level.rows, level.size, width)
        values = level.wide[2]
        for _, _, rows, cols in level.taps():
            weight = logits[tap].view(batch, level.rows, level.size, width)
            for k in range(result.shape[1]):
                result[:, k].addcmul_(weight, values[:, k, rows, None, cols])
            tap += 1
    return out, logits


class _AffinityFilter(torch.autograd.Function):
    """The tap loop with a hand-written derivative: intermediate products of 50 taps would not fit the caches."""

    @staticmethod
    def forward(ctx: Any, target: Tensor, preference: Tensor, sizes: Sequence[int], windows: Sequence[int],
                *cells: Tensor) -> Tensor:
        levels = _levels(sizes, windows, cells)
        out, logits = _filter(levels, target, preference)
        ctx.save_for_backward(target, logits, out, *cells)
        ctx.sizes, ctx.windows = sizes, windows
        return out

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Any:
        target, weights, out, *cells = ctx.saved_tensors
        levels = _levels(ctx.sizes, ctx.windows, cells)
        batch, _, height, width = target.shape
        grad = grad.contiguous()
        common = (grad * out).sum(1)  # (B, H, W): subtracted by the softmax's derivative
        grad_target = torch.zeros_like(target)
        grad_preference = target.new_zeros(batch, len(levels), height, width)
        grad_cells: list[Tensor] = []
        tap = 0
        for number, level in enumerate(levels):
            shape = (batch, -1, level.rows, level.size, width)
            aim, pull, back = target.view(shape), grad.view(shape), grad_target.view(shape)
            base = common.view(batch, level.rows, level.size, width)
            wish = grad_preference[:, number].view(batch, level.rows, level.size, width)
            features, values = level.wide[1:]
            to_bias, to_features, to_values = (torch.zeros_like(plane) for plane in level.wide)
            for _, _, rows, cols in level.taps():
                weight = weights[tap].view(batch, level.rows, level.size, width)
                inner = -base
                for k in range(values.shape[1]):
                    inner.addcmul_(pull[:, k], values[:, k, rows, None, cols])
                    to_values[:, k, rows, cols] += (weight * pull[:, k]).sum(2)
                inner *= weight  # d loss / d logit
                wish += inner
                to_bias[:, rows, cols] += inner.sum(2)
                for k in range(features.shape[1]):
                    back[:, k].addcmul_(inner, features[:, k, rows, None, cols], value=2.0)
                    to_features[:, k, rows, cols] += (inner * aim[:, k]).sum(2).mul_(2.0)
                tap += 1
            grad_cells += [level.narrow(to_bias), level.narrow(to_features), level.narrow(to_values)]
        return grad_target, grad_preference, None, None, *grad_cells


def _levels(sizes: Sequence[int], windows: Sequence[int], cells: Sequence[Tensor]) -> list[_Level]:
    triples = zip(cells[0::3], cells[1::3], cells[2::3], strict=True)
    return [_Level(s, w, *planes) for s, w, planes in zip(sizes, windows, triples, strict=True)]


def affinity_filter(
    features: Tensor,
    source_bias: Tensor,
    target_preference: Tensor,
    log_n: Tensor,
    values: Tensor,
    windows: Sequence[int],
    active: Tensor | None = None,
) -> Tensor:
    """Filters values over a pyramid with affinity kernels.

    Parameters
    ----------
    features : (B, D, H, W), source_bias and target_preference : (B, levels, H, W)
    log_n : (B, H, W) log occupancy of each source, -inf for none
    values : (B, C, H, W) per unit of occupancy
    windows : odd window size of each level, in cells of 2**level pixels
    active : (B, ceil(H / 64), ceil(W / 64)) bool, which cells of ACTIVE_CELL pixels are wanted; default all. The
        targets of others are left out and 0, their sources count. Not with a gradient, nor above 7 levels.

    Returns
    -------
    (B, C, H, W) means over the reached sources; 0 where no source is in reach.
    """
    if active is not None:
        shape = (len(log_n), *(math.ceil(side / ACTIVE_CELL) for side in log_n.shape[-2:]))
        if torch.is_grad_enabled() or len(windows) > 7 or active.shape != shape:
            raise ValueError(f"active cells {tuple(active.shape)}, expected {shape}, at most 7 levels, no gradient")
    # Only differences of features count, and |f_t - f_s|^2 is computed as |f_t|^2 - 2 f_t f_s + |f_s|^2: what all
    # features have in common would only cost digits.
    features = features - features.detach().mean((2, 3), keepdim=True)
    height, width = log_n.shape[-2:]
    size = 2 ** (len(windows) - 1)
    pad = (0, math.ceil(width / size) * size - width, 0, math.ceil(height / size) * size - height)
    if any(pad):
        features, values = F.pad(features, pad), F.pad(values, pad)
        source_bias, target_preference = F.pad(source_bias, pad), F.pad(target_preference, pad)
        log_n = F.pad(log_n, pad, value=-torch.inf)
    cells: list[Tensor] = []
    sizes = [2**number for number in range(len(windows))]
    planes = torch.cat([features, values, features.square().sum(1, keepdim=True)], 1)
    for number, cell in enumerate(sizes):
        biased = log_n + source_bias[:, number]
        bias, means = pool_cells(biased, planes, cell)
        feature, value, norm = torch.split(means, [features.shape[1], values.shape[1], 1], 1)
        cells += [bias - norm[:, 0], feature, value]
    if torch.is_grad_enabled():
        apply: Callable[..., Tensor] = _AffinityFilter.apply
        return apply(features, target_preference, sizes, tuple(windows), *cells)[..., :height, :width]
    levels = _levels(sizes, windows, cells)
    out = torch.zeros_like(values)
    for image, rows, cols in _tiles(out, active, size):
        tile = [level.tile(image, rows, cols) for level in levels]
        here = (slice(image, image + 1), slice(None), rows, cols)
        out[here] = _filter(tile, features[here], target_preference[here])[0]
    return out[..., :height, :width]


def _tiles(picture: Tensor, active: Tensor | None, size: int) -> Iterator[tuple[int, slice, slice]]:
    """Images, rows and columns that cover the active cells of a picture (B, C, H, W): runs of cells along a row."""
    batch, _, height, width = picture.shape
    step = max(ACTIVE_CELL, size)
    for image in range(batch):
        for row in range(math.ceil(height / step)):
            rows = slice(row * step, min((row + 1) * step, height))
            wanted = [True] * math.ceil(width / step) if active is None else active[image, row].tolist()
            start = 0
            for on, run in groupby(wanted):
                stop = start + len(list(run))
                if on:
                    yield image, rows, slice(start * step, min(stop * step, width))
                start = stop
