"""The direct kernels' stage: generators that predict every tap, one kernel per layer, per pixel or per sample.

Kernels are large (289 numbers per layer and pixel for 17 x 17), so without a gradient they are made for a block of rows
at a time, used and dropped. `splatting.py` has the filter.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from model.affinity import pool_cells
from model.compositing import composite, mix_levels
from model.config import Config
from model.networks import Mlp
from model.partition import BASIC_COLUMNS, mixture, share_of
from model.samples import Samples, Segments
from model.splatting import RowMerger, kernel_filter

BLOCK_LOGITS = 2**24  # logits made at a time at inference: 64 MB


def make_generators(config: Config, contexts: Sequence[int]) -> nn.ModuleList:
    """One generator per level of `kernel_sizes`; the first one's output ends in one logit per level, if several."""
    levels = len(config.kernel_sizes)
    generators = nn.ModuleList()
    for number, size in enumerate(config.kernel_sizes):
        outputs = size * size + (levels if number == 0 and levels > 1 else 0)
        generators.append(Mlp([contexts[number], config.embedding], (*config.generator, outputs)))
    return generators


def filter_direct(planes: Tensor, contexts: Sequence[Tensor], generators: nn.ModuleList, config: Config) -> Tensor:
    """Filters and composites every level, and mixes the levels.

    planes (B, L, K, H, W): columns log n, log w, per unit of occupancy those of `basic_values`, embedding, extra.
    contexts (B, C, H / 2**i, W / 2**i), H and W rounded up to the network's stride.
    Returns (B, L, 6 + E, H, W) visible planes, see `compositing.composite`.
    """
    height, width = planes.shape[-2:]
    coarsest = 2 ** (len(generators) - 1)
    pad = (0, -width % coarsest, 0, -height % coarsest)
    log_n, log_w = (F.pad(planes[:, :, k], pad, value=-torch.inf).flatten(0, 1) for k in range(2))
    values = F.pad(planes[:, :, 2:], pad).flatten(0, 1)  # (B*L, C, H, W)
    if config.variant == "layer_w":  # normalised by the layers' own weights
        share = share_of(log_n, log_w)[:, None]
        values = values / torch.where(share > 0, share, 1)
        log_n = log_w
    values = torch.cat([values, share_of(log_n, log_w)[:, None]], 1)
    batch, layers = planes.shape[:2]
    finished, preference = [], None

    def by_layer(pictures: Tensor) -> Tensor:
        return pictures.view(batch, layers, *pictures.shape[1:])

    for number, generator in enumerate(generators):
        assert isinstance(generator, Mlp)
        occupancy, cells = pool_cells(log_n, values, 2**number)
        fixed = BASIC_COLUMNS - 2 + config.embedding + 1
        basic, embedding, extra, share = torch.split(
            cells, [BASIC_COLUMNS - 2, config.embedding, cells.shape[1] - fixed, 1], 1)
        embedding = embedding * torch.exp(occupancy)[:, None]  # E_l, a sum over the samples, as published
        context = contexts[number][..., : occupancy.shape[-2], : occupancy.shape[-1]]
        means, mass, beyond = _filter_level(
            generator, context, by_layer(embedding), occupancy,
            torch.cat([basic, share, extra], 1), config.kernel_sizes[number], config.variant == "pixel_gather",
        )
        finished.append(composite(by_layer(means), by_layer(mass) if config.variant == "layer_w" else None))
        if number == 0:
            preference = by_layer(beyond)[:, 0]  # (B, levels, H, W) of the first layer
    assert preference is not None
    return mix_levels(finished, preference)[..., :height, :width]


def _filter_level(generator: Mlp, context: Tensor, embedding: Tensor, log_n: Tensor, values: Tensor, size: int,
                  gather: bool) -> tuple[Tensor, Tensor, Tensor]:
    """context (B, C, h, w), embedding (B, L, E, h, w); the rest (B*L, ..., h, w).

    Returns the filtered means and masses, and what the generator predicts besides the kernel, (B*L, extra, h, w).
    """
    taps = size * size
    height, width = log_n.shape[-2:]
    rows = height if torch.is_grad_enabled() else max(BLOCK_LOGITS // (len(log_n) * taps * width), size)
    if rows >= height:
        kernels = _generate(generator, context, embedding)
        means, mass = kernel_filter(kernels[:, :taps], log_n, values, gather)
        return means, mass, kernels[:, taps:]
    merger = RowMerger(torch.empty_like(values), torch.empty_like(log_n))
    extras = []
    for first in range(0, height, rows):
        block = slice(first, first + rows)
        kernels = _generate(generator, context[:, :, block], embedding[..., block, :])
        extras.append(kernels[:, taps:])
        if gather:
            merger.gather(first, kernels[:, :taps], log_n, values)
        else:
            merger.splat(first, kernels[:, :taps], log_n[:, block], values[:, :, block])
    return merger.means, merger.mass, torch.cat(extras, 2)


def _generate(generator: Mlp, context: Tensor, embedding: Tensor) -> Tensor:
    """context (B, C, h, w), embedding (B, L, E, h, w) -> (B*L, outputs, h, w)."""
    shared = generator.first(0, context.permute(0, 2, 3, 1))[:, None]  # (B, 1, h, w, hidden)
    mine = generator.first(1, embedding.permute(0, 1, 3, 4, 2))
    outputs = generator.rest(shared + mine).to(embedding.dtype).flatten(0, 1)
    return outputs.permute(0, 3, 1, 2).contiguous()  # one plane per tap, as the filter reads them


def splat_samples(samples: Samples, values: Tensor, embedding: Tensor, context: Tensor, generator: Mlp) -> Tensor:
    """One splat kernel per sample: values (N, 5 or more) of `basic_values`, extra; embedding (N, E), context (P, C).

    The samples of a pixel are summed tap by tap before they are spread. Returns (B, 1, 6 or more, H, W) visible planes.
    """
    batch, height, width = samples.shape
    means = values.new_zeros(batch, values.shape[1], height, width)
    mass = values.new_full((batch, height, width), -torch.inf)
    shared = generator.first(0, context)  # (P, hidden)
    log_weight = torch.log(samples.weight[:, None])
    outputs = generator.layers[-1]
    assert isinstance(outputs, nn.Linear)
    results = []
    budget = None if torch.is_grad_enabled() else BLOCK_LOGITS // 2 // outputs.out_features
    for image in range(batch):
        merger = None if budget is None else RowMerger(means[image : image + 1], mass[image : image + 1])
        for first, last, counts, span in row_blocks(samples, image, budget):
            segments = Segments(counts)
            pixels = slice((image * height + first) * width, (image * height + last) * width)
            mine = generator.first(1, embedding[span])
            logits = generator.rest(segments.expand(shared[pixels]) + mine).to(values.dtype)
            log_n, mixed = mixture(logits + log_weight[span], values[span], segments)  # (p, T), (p, T, C)
            log_n = log_n.view(1, last - first, width, -1).permute(0, 3, 1, 2).contiguous()  # (1, T, h, w)
            mixed = mixed.view(1, last - first, width, *mixed.shape[1:]).permute(0, 3, 4, 1, 2).contiguous()
            unit = torch.zeros_like(log_n[:, 0])
            if merger is None:
                results.append(kernel_filter(log_n, unit, mixed))
            else:
                merger.splat(first, log_n, unit, mixed)
    if results:
        means, mass = torch.cat([part for part, _ in results]), torch.cat([log for _, log in results])
    share = (mass > -torch.inf).to(means.dtype)[:, None]
    basic = BASIC_COLUMNS - 2
    return composite(torch.cat([means[:, :basic], share, means[:, basic:]], 1)[:, None])


def row_blocks(samples: Samples, image: int, budget: int | None) -> Iterator[tuple[int, int, Tensor, slice]]:
    """Cuts an image's samples into blocks of about `budget` (one block if None): whole rows, or parts of a long row.

    Yields first and last row (exclusive), counts of the block's pixels, and the block's samples.
    """
    batch, height, width = samples.shape
    counts = samples.counts.view(batch, height, width)
    start = int(counts[:image].sum())
    rows = counts[image].long().sum(1).tolist()
    first = total = 0
    for row, size in enumerate([*rows, None]):
        if size is None or (budget is not None and total + size > budget and total > 0):
            if total > 0:
                yield from _parts(counts[image, first:row].flatten(), first, row, start, budget)
            start, first, total = start + total, row, 0
        total += size or 0


def _parts(counts: Tensor, first: int, last: int, start: int,
           budget: int | None) -> Iterator[tuple[int, int, Tensor, slice]]:
    ends = counts.long().cumsum(0)
    total = int(ends[-1])
    step = budget or total
    if total <= step:
        yield first, last, counts, slice(start, start + total)
        return
    for low in range(0, total, step):
        high = min(low + step, total)
        part = ends.clamp(low, high) - (ends - counts).clamp(low, high)
        yield first, last, part, slice(start + low, start + high)
