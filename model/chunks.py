"""Samples in chunks that fit the caches, for the stages that look at one pixel at a time. At inference only.

Pixels that hold the same number of samples share a chunk, because reductions over such pixels are reshapes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from model.samples import Samples

CHUNK_SAMPLES = 16384  # about 2 MB of activations at width 32
CHUNK_PIXELS = 8192  # the same for the stages per pixel and layer, where pixels hold few samples
MAX_GROUPS = 4  # of different numbers of samples; more are left in the order they come

Index = slice | Tensor


@dataclass
class Chunk:
    """Some pixels of a batch of pictures.

    samples : theirs, as one image row; by turns where pixels hold equally many
    pixels, own : which pixels and which samples, in pixel order, of the whole they are, ranges or (n,) int64
    relative : their rows of what `Denoiser` knows of each sample's surroundings, None for nothing
    """

    samples: Samples
    pixels: Index
    own: Index
    relative: Tensor | None


def in_one_chunk(samples: Samples) -> bool:
    """Whether `chunks` of all pixels is one; always where a gradient is wanted."""
    return torch.is_grad_enabled() or samples.weight.numel() <= CHUNK_SAMPLES


def chunks(samples: Samples, relative: Tensor | None, wanted: Tensor | None = None) -> Iterator[Chunk]:
    """The pixels, or the `wanted` (P,) ones, in chunks; one chunk in order when a gradient is wanted."""
    pixels, total = samples.counts.numel(), samples.weight.numel()
    if torch.is_grad_enabled() or (wanted is None and in_one_chunk(samples)):
        yield Chunk(samples, slice(0, pixels), slice(0, total), relative)
        return
    counts = samples.counts.long()
    starts = counts.cumsum(0) - counts
    for group in _groups(counts, wanted):
        ends = counts[group].cumsum(0)
        first = done = 0
        while first < len(group):
            last = int(torch.searchsorted(ends, done + CHUNK_SAMPLES, right=True))
            last = max(first + 1, min(last, first + CHUNK_PIXELS, len(group)))
            yield _chunk(samples, relative, group[first:last], counts, starts)
            first, done = last, int(ends[last - 1])


def together(parts: Sequence[tuple[Index, Tensor]], total: int, absent: Tensor | None = None) -> Tensor:
    """Rows by chunk -> (total, ...) all rows; those that no chunk holds are `absent` (...), or 0."""
    first = parts[0][1]
    if all(isinstance(rows, slice) for rows, _ in parts) and sum(len(part) for _, part in parts) == total:
        if len(parts) == 1:
            return first
        if first.dim() == 3:
            return torch.cat([part.movedim(0, -1) for _, part in parts], -1).movedim(-1, 0)
        return torch.cat([part for _, part in parts], 0)
    whole = first.new_zeros(total, *first.shape[1:])
    if first.dim() == 3:  # layers: stored column by column, as pictures are
        whole = first.new_zeros(*first.shape[1:], total).movedim(-1, 0)
    if absent is not None:
        whole += absent
    for rows, part in parts:
        whole[rows] = part
    return whole


def _groups(counts: Tensor, wanted: Tensor | None) -> list[Tensor]:
    """(n,) int64 each: pixels with equally many samples, or all in one group where there are too many kinds."""
    kinds = torch.unique(counts)
    every = torch.arange(counts.numel(), device=counts.device)
    if len(kinds) in (1, *range(MAX_GROUPS + 1, len(kinds) + 1)):
        groups = [every]
    else:
        groups = [every[counts == kind] for kind in kinds]
    if wanted is not None:
        groups = [group[wanted[group]] for group in groups]
    return [group for group in groups if len(group)]


def _chunk(samples: Samples, relative: Tensor | None, pixels: Tensor, counts: Tensor, starts: Tensor) -> Chunk:
    first, last = int(pixels[0]), int(pixels[-1]) + 1
    if last - first == len(pixels):
        start, stop = int(starts[first]), int(starts[last - 1] + counts[last - 1])
        own = slice(start, stop)
        part = samples.pixel_range(first, last, start, stop).by_turns()
        return Chunk(part, slice(first, last), own, None if relative is None else part.like(relative[own]))
    held = counts[pixels]
    before = starts[pixels] - (held.cumsum(0) - held)  # what is between a pixel's samples here and there
    index = torch.repeat_interleave(before, held) + torch.arange(int(held.sum()), device=pixels.device)
    part = samples.picked(pixels, index).by_turns()
    return Chunk(part, pixels, index, None if relative is None else part.like(relative[index]))
