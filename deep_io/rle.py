"""OpenEXR's run-length coding of bytes, without a Python loop over runs.

A run is a signed count byte c and, for c >= 0, one byte that stands for c + 1 equal ones; for c < 0, -c bytes that
stand for themselves.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]

_MIN_RUN = 3      # A shorter run of equal bytes is cheaper inside a literal.
_MAX_RUN = 128
_MAX_LITERAL = 127
_JUMPS = 6        # Run starts are found 2^6 at a time.


def decode(packed: Bytes, size: int) -> Bytes:
    """The `size` bytes that `packed` stands for. Raises ValueError when it is cut short or has another size."""
    starts = _run_starts(packed)
    counts = packed[starts].view(np.int8).astype(np.int64)
    literal = counts < 0
    lengths = np.where(literal, -counts, counts + 1)
    total = int(lengths.sum())
    last_byte = int(starts[-1] + (lengths[-1] if literal[-1] else 1)) if starts.size else -1
    if total != size or last_byte != packed.size - 1:
        raise ValueError(f"the run-length data stands for {total} bytes, {size} expected")
    ends = np.cumsum(lengths)
    # Source of output byte i: starts + 1, plus its place within the run for a literal.
    base = np.repeat(starts + 1 - np.where(literal, ends - lengths, 0), lengths)
    source = base + np.where(np.repeat(literal, lengths), np.arange(size), 0)
    return packed[source]


def _run_starts(packed: Bytes) -> NDArray[np.int64]:
    """Where runs begin. Each byte taken as a count points to the next run; chains of 64 such steps are followed."""
    end = packed.size
    counts = packed.view(np.int8).astype(np.int64)
    step = np.arange(end, dtype=np.int64) + np.where(counts < 0, 1 - counts, 2)
    jumps = [np.append(np.minimum(step, end), end)]
    for _ in range(_JUMPS):
        jumps.append(jumps[-1][jumps[-1]])
    heads, far = [], jumps.pop()
    at = 0
    while at < end:
        heads.append(at)
        at = int(far[at])
    starts = np.array(heads, np.int64)
    for jump in reversed(jumps):
        starts = np.stack((starts, jump[starts]), axis=1).ravel()
    return starts[starts < end]


def encode(data: Bytes) -> bytes:
    """The run-length form of `data` (n,), n >= 1."""
    changes = np.flatnonzero(data[1:] != data[:-1]) + 1
    starts = np.concatenate(([0], changes))
    lengths = np.diff(np.append(starts, data.size))
    run = lengths >= _MIN_RUN
    # Neighbouring short runs become one literal.
    first = np.ones(starts.size, bool)
    first[1:] = run[1:] | run[:-1]
    starts, run = starts[first], run[first]
    lengths = np.diff(np.append(starts, data.size))
    # Pieces no longer than a count byte can say.
    limit = np.where(run, _MAX_RUN, _MAX_LITERAL)
    pieces = -(-lengths // limit)
    index = np.repeat(np.arange(starts.size), pieces)
    nth = np.arange(index.size) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    starts = starts[index] + nth * limit[index]
    lengths = np.minimum(lengths[index] - nth * limit[index], limit[index])
    run = run[index]
    # One count byte, then one byte of a run or all bytes of a literal.
    stored = np.where(run, 1, lengths)
    ends = np.cumsum(stored + 1)
    heads = ends - stored - 1
    packed = np.empty(int(ends[-1]), np.uint8)
    source = np.arange(packed.size) + np.repeat(starts - heads - 1, stored + 1)
    packed[:] = data[np.maximum(source, 0)]
    packed[heads] = np.where(run, lengths - 1, -lengths).astype(np.int8).view(np.uint8)
    return packed.tobytes()
