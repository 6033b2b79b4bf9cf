"""Filtering by affinity over a pyramid: kernels whose logits come from distances between learned features.

At level i a target pixel sees a small window of cells of 2^i x 2^i pixels. With f the features, u the sources' bias
and v the targets' preference for a level, the logit of cell s for target t is

    logit = u_s + v_t + log n_s + log B(t - s) - E|f_t - f_s|^2

where the mean is over the pixels of the cell, so that a cell that straddles an edge is far from both sides, B is the
quadratic B-spline over three cells (nothing for level 0), so that no cell boundary shows, and n_s the occupancy. One
normalisation per target over all taps of all levels: out_t = sum_s softmax(logit)_s value_s. Targets keep their full
resolution at every level, so coarse levels respect edges too.

It is computed as attention: a block of targets shares the union of their windows, so that logits and means are products
of small matrices, and what lies outside a target's own window has a logit of -inf. On a CPU that is four to five times
as fast as one tap after the other, though only two thirds of the products count.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

ACTIVE_CELL = 64  # pixels; targets are filtered, or left out, in cells of this size at inference
BLOCK = 4  # pixels; targets of a square of this side share their sources
CHUNK = {"cpu": 64, "cuda": 4096}  # blocks filtered at once: what fits the caches, or fills a GPU
BACKWARD_CHUNK = 256  # blocks whose gradients are added up at once


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


@dataclass(frozen=True)
class _Windows:
    """Which rows of the table of all levels' cells the blocks of a picture see, and their windows' fixed logits.

    The table holds the cells of the finest level, row by row, then those of the next; each level with a border of its
    windows' radius. A block sees S of them, the union of its targets' windows, at the same offsets from where it starts
    in each level.

    sizes, pitches, firsts : (levels,) pixels along a cell, cells along a row of the table, the table's first cell
    level, offset : (S,) each source's level, and its offset from the block's start there
    splines : (phases^2, BLOCK^2, S) log of each source's B-spline weight for each target, -inf outside its window; a
        block's phase along an axis is where it lies in a cell of the coarsest level
    rows : of the table
    """

    sizes: Tensor
    pitches: Tensor
    firsts: Tensor
    level: Tensor
    offset: Tensor
    splines: Tensor
    phases: int
    rows: int

    @staticmethod
    def of(windows: Sequence[int], height: int, width: int, like: Tensor) -> _Windows:
        """Of pictures of height x width pixels, multiples of BLOCK and of the coarsest cells; in the type of `like`."""
        device = like.device
        phases = max(1, 2 ** (len(windows) - 1) // BLOCK)
        sizes = [2**number for number in range(len(windows))]
        pitches, firsts, level, offset, splines, rows = [], [], [], [], [], 0
        for number, (size, window) in enumerate(zip(sizes, windows, strict=True)):
            pitch = width // size + window - 1
            span = torch.arange(max(1, BLOCK // size) + window - 1, device=device)
            along = _axis_logs(size, window, phases, span, like)
            both = along[:, None, :, None, :, None] + along[None, :, None, :, None, :]
            pitches.append(pitch)
            firsts.append(rows)
            offset.append((span[:, None] * pitch + span).flatten())
            level.append(torch.full_like(offset[-1], number))
            splines.append(both.reshape(phases**2, BLOCK**2, -1))
            rows += (height // size + window - 1) * pitch
        return _Windows(torch.tensor(sizes, device=device), torch.tensor(pitches, device=device),
                        torch.tensor(firsts, device=device), torch.cat(level), torch.cat(offset),
                        torch.cat(splines, -1), phases, rows)

    def sources(self, image: Tensor, y: Tensor, x: Tensor) -> Tensor:
        """(N, S) rows of the table, each image's behind the other's, that blocks number y, x see."""
        down, right = (torch.div(number[:, None] * BLOCK, self.sizes, rounding_mode="floor") for number in (y, x))
        start = self.firsts + down * self.pitches + right + (image * self.rows)[:, None]
        return start[:, self.level] + self.offset

    def phase(self, y: Tensor, x: Tensor) -> Tensor:
        """(N,) which of `splines` holds for blocks number y, x."""
        return y % self.phases * self.phases + x % self.phases


def _axis_logs(size: int, window: int, phases: int, span: Tensor, like: Tensor) -> Tensor:
    """(phases, BLOCK, sources) along one axis: log B-spline weights of the cells a block sees, `span` from its start,
    for each of its targets; -inf where a cell is outside a target's window."""
    pixel = (torch.arange(phases, device=like.device) * BLOCK)[:, None] + torch.arange(BLOCK, device=like.device)
    start = torch.div(pixel[:, :1], size, rounding_mode="floor")
    tap = start[..., None] + span - torch.div(pixel, size, rounding_mode="floor")[..., None]
    logs = spline_logs(size, window, like)[tap.clamp(0, window - 1), (pixel % size)[..., None].expand_as(tap)]
    return torch.where((tap >= 0) & (tap < window), logs, -torch.inf)


class _BlockFilter(torch.autograd.Function):
    """Attention of blocks of targets, with a derivative that computes its weights anew: all of them would fill memory.

    queries (N, BLOCK^2, K): twice a target's features, 1, its preference of each level; table (rows, K + C): a cell's
    features, its own logit, 1 at its level and 0 at the others, then its values. A logit is the product of a query and
    a key less the square of the key's features, plus `splines`. Blocks are numbered y, x in their image, all (N,).
    -> (N, BLOCK^2, C)
    """

    @staticmethod
    def forward(ctx: Any, queries: Tensor, table: Tensor, blocks: Sequence[Tensor], windows: _Windows) -> Tensor:
        keys = queries.shape[2]
        out = queries.new_empty(len(queries), table.shape[1] - keys, BLOCK**2)
        for part in _parts(queries):
            _, sources, weights = _attend(queries[part], table, [number[part] for number in blocks], windows)
            # this way round, for with a dozen values the other takes more than twice the time
            torch.bmm(sources[..., keys:].transpose(1, 2), weights.transpose(1, 2), out=out[part])
        out = out.transpose(1, 2)
        ctx.save_for_backward(queries, table, out, *blocks)
        ctx.windows = windows
        return out

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Any:
        queries, table, out, *blocks = ctx.saved_tensors
        windows, keys = ctx.windows, queries.shape[2]
        own = keys - len(windows.sizes) - 1  # the column of a source's own logit, behind its features
        common = (grad * out).sum(2, keepdim=True)  # subtracted by the softmax's derivative
        to_queries, to_table = torch.empty_like(queries), torch.zeros_like(table)
        for large in _chunks(len(queries), BACKWARD_CHUNK):
            rows = windows.sources(*(number[large] for number in blocks))
            to_sources = table.new_empty(*rows.shape, table.shape[1])
            for small in _parts(queries[large]):
                part = slice(large.start + small.start, large.start + small.stop)
                asked, sources, weights = _attend(queries[part], table, [number[part] for number in blocks], windows)
                torch.bmm(weights.transpose(1, 2), grad[part], out=to_sources[small, :, keys:])
                inner = torch.baddbmm(-common[part].expand_as(weights), grad[part],
                                      sources[..., keys:].transpose(1, 2)).mul_(weights)  # d loss / d logit
                # own logits of empty cells are -inf; no weight, no derivative
                torch.bmm(inner, sources[..., :keys].nan_to_num_(neginf=0.0), out=to_queries[part])
                torch.bmm(inner.transpose(1, 2), asked, out=to_sources[small, :, :keys])
                to_sources[small, :, :own].addcmul_(sources[..., :own], to_sources[small, :, own : own + 1], value=-2.0)
            first, last = int(rows.min()), int(rows.max()) + 1
            summed = torch.ops.aten.embedding_dense_backward(to_sources, rows - first, last - first, -1, False)
            to_table[first:last] += summed
        return to_queries, to_table, None, None


def _chunks(count: int, size: int) -> Iterator[slice]:
    return (slice(start, min(start + size, count)) for start in range(0, count, size))


def _parts(queries: Tensor) -> Iterator[slice]:
    return _chunks(len(queries), CHUNK.get(queries.device.type, CHUNK["cuda"]))


def _attend(queries: Tensor, table: Tensor, blocks: Sequence[Tensor], windows: _Windows
            ) -> tuple[Tensor, Tensor, Tensor]:
    """Queries (N, BLOCK^2, K) and sources (N, S, K + C) of some blocks, both with features relative to the mean of
    their block's targets, so that digits go where they count; and weights (N, BLOCK^2, S) that sum to 1, all 0 where
    no source is in reach."""
    image, y, x = blocks
    rows = windows.sources(image, y, x)
    sources = table.index_select(0, rows.flatten()).view(*rows.shape, -1)
    keys = queries.shape[2]
    width = keys - len(windows.sizes) - 1
    centre = queries[..., :width].mean(1, keepdim=True)  # twice that of the features
    queries = torch.cat([queries[..., :width] - centre, queries[..., width:]], 2)
    features = sources[..., :width].sub_(centre, alpha=0.5)
    sources[..., width] -= features.square().sum(2)
    logits = windows.splines.index_select(0, windows.phase(y, x))
    logits.baddbmm_(queries, sources[..., :keys].transpose(1, 2))
    weights = torch.softmax(logits, 2)
    return queries, sources, weights.nan_to_num_(0.0) if bool(weights[..., 0].isnan().any()) else weights


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
        targets of others are left out and 0, their sources count. Not with a gradient.

    Returns
    -------
    (B, C, H, W) means over the reached sources; 0 where no source is in reach.
    """
    batch, height, width = log_n.shape
    if active is not None:
        shape = (batch, *(math.ceil(side / ACTIVE_CELL) for side in (height, width)))
        if torch.is_grad_enabled() or active.shape != shape:
            raise ValueError(f"active cells {tuple(active.shape)}, expected {shape}, no gradient")
    size = max(BLOCK, 2 ** (len(windows) - 1))
    pad = (0, -width % size, 0, -height % size)
    if any(pad):
        features, values = F.pad(features, pad), F.pad(values, pad)
        source_bias, target_preference = F.pad(source_bias, pad), F.pad(target_preference, pad)
        log_n = F.pad(log_n, pad, value=-torch.inf)
    layout = _Windows.of(windows, log_n.shape[1], log_n.shape[2], features)
    table = _table(features, source_bias, log_n, values, windows)
    queries = _blocks(torch.cat([2 * features, torch.ones_like(features[:, :1]), target_preference], 1))
    down, right = (side // BLOCK for side in log_n.shape[1:])
    wanted = torch.ones(batch, down, right, dtype=torch.bool, device=log_n.device)
    if active is not None:
        cell = ACTIVE_CELL // BLOCK
        shown = active.repeat_interleave(cell, 1).repeat_interleave(cell, 2)[:, :down, :right]
        wanted = F.pad(shown, (0, right - shown.shape[2], 0, down - shown.shape[1]))
    all_of_them = bool(wanted.all())
    apply: Callable[..., Tensor] = _BlockFilter.apply
    chosen = queries if all_of_them else queries[wanted.flatten()]
    means = apply(chosen, table, wanted.nonzero(as_tuple=True), layout)
    if not all_of_them:
        found, means = means, means.new_zeros(len(queries), *means.shape[1:])
        means[wanted.flatten()] = found
    return _picture(means, batch, down, right)[..., :height, :width]


def _table(features: Tensor, source_bias: Tensor, log_n: Tensor, values: Tensor, windows: Sequence[int]) -> Tensor:
    """(B * rows, K + C): what `_Windows` numbers the rows of; columns as in `_BlockFilter`.

    E|f_t - f_s|^2 over a cell is the square of what its mean is off, and its variance, which is part of its own logit.
    """
    planes = torch.cat([features, values, features.square().sum(1, keepdim=True)], 1)
    tables = []
    for number, window in enumerate(windows):
        bias, means = pool_cells(log_n + source_bias[:, number], planes, 2**number)
        feature, value, norm = torch.split(means, [features.shape[1], values.shape[1], 1], 1)
        level = torch.zeros_like(source_bias[..., : bias.shape[1], : bias.shape[2]])
        level[:, number] = 1
        border = [window // 2] * 4
        variance = norm - feature.square().sum(1, keepdim=True)
        own = F.pad(bias[:, None] - variance, border, value=-torch.inf)
        first, *rest = (F.pad(plane, border) for plane in (feature, level, value))
        tables.append(torch.cat([first, own, *rest], 1).flatten(2))
    return torch.cat(tables, 2).transpose(1, 2).reshape(-1, features.shape[1] + 1 + len(windows) + values.shape[1])


def _blocks(picture: Tensor) -> Tensor:
    """(B, C, H, W) -> (B * H / BLOCK * W / BLOCK, BLOCK^2, C)."""
    batch, channels, height, width = picture.shape
    split = picture.view(batch, channels, height // BLOCK, BLOCK, width // BLOCK, BLOCK)
    return split.permute(0, 2, 4, 3, 5, 1).reshape(-1, BLOCK**2, channels)


def _picture(blocks: Tensor, batch: int, down: int, right: int) -> Tensor:
    """The inverse of `_blocks`."""
    split = blocks.view(batch, down, right, BLOCK, BLOCK, blocks.shape[-1])
    return split.permute(0, 5, 1, 3, 2, 4).reshape(batch, -1, down * BLOCK, right * BLOCK)
