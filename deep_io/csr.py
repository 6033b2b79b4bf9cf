"""Walking the pixels of flat (CSR) sample arrays without a Python loop over pixels or samples.

`counts` (P,) or (H, W) int32 holds the samples of each pixel; samples lie pixel after pixel.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Counts: TypeAlias = NDArray[np.int32]
Index: TypeAlias = NDArray[np.int64]
Selection: TypeAlias = Index | slice


def offsets_of(counts: Counts) -> Index:
    """(P+1,) where each pixel's samples begin; pixel p owns offsets[p]:offsets[p+1]."""
    offsets = np.zeros(counts.size + 1, np.int64)
    np.cumsum(counts.ravel(), dtype=np.int64, out=offsets[1:])
    return offsets


def pixels_of(counts: Counts) -> Index:
    """(N,) the pixel of each sample."""
    return np.repeat(np.arange(counts.size, dtype=np.int64), counts.ravel())


def by_rank(counts: Counts) -> Iterator[tuple[Selection, Selection]]:
    """For rank 0, 1, 2, ... within a pixel: the samples of that rank, and the pixels they belong to.

    For recurrences along a pixel: each step is vectorised over all pixels that have so many samples. Frames with the
    same number in every pixel, the common case, get plain slices.
    """
    flat = counts.ravel()
    most = int(flat.max(initial=0))
    if most and flat.min() == most:
        for rank in range(most):
            yield slice(rank, None, most), slice(None)
        return
    start = offsets_of(counts)[:-1]
    live = np.argsort(-flat.astype(np.int64), kind="stable")
    deeper = flat.size - np.cumsum(np.bincount(flat, minlength=most + 1))  # pixels with more than k samples
    for rank in range(most):
        live = live[: deeper[rank]]
        yield start[live] + rank, live


def depth_order(counts: Counts, depth: NDArray[np.floating[Any]] | None) -> Index | None:
    """(N,) the stable order that sorts every pixel's samples by depth, or None where they are sorted already.

    Without depth the stored order counts. NaN sorts last. Only pixels that are out of order are sorted.
    """
    if depth is None or depth.size < 2:
        return None
    offsets = offsets_of(counts)
    ascends = depth[1:] >= depth[:-1]
    borders = offsets[1:-1]
    ascends[borders[(borders > 0) & (borders < depth.size)] - 1] = True
    if ascends.all():
        return None
    unsorted = np.unique(np.searchsorted(offsets, np.flatnonzero(~ascends), side="right") - 1)
    order = np.arange(depth.size, dtype=np.int64)
    sizes = counts.ravel()[unsorted]
    for size in np.unique(sizes).tolist():  # pixels of one size make a table, and tables sort fast
        places = offsets[unsorted[sizes == size]][:, None] + np.arange(size)
        order[places] = np.take_along_axis(places, np.argsort(depth[places], axis=1, kind="stable"), axis=1)
    return order


def strictly_increasing(counts: Counts, depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """(N,) sorted depths with equal neighbours of a pixel moved apart by the least step float32 has."""
    result = depth.copy()
    last = np.full(counts.size, -np.inf, np.float32)
    for here, pixels in by_rank(counts):
        result[here] = np.maximum(result[here], np.nextafter(last[pixels], np.float32(np.inf)))
        last[pixels] = result[here]
    return result
