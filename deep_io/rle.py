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
_DOUBLINGS = 3    # Run starts are found 2^3 at a time.

# How far the next run begins after a count byte, for each value of that byte.
_STEP = np.array([2] * 128 + [1 + literal for literal in range(128, 0, -1)], np.int32)


def decode(packed: Bytes, size: int) -> Bytes:
    """The `size` bytes that `packed` stands for. Raises ValueError when it is cut short or has another size."""
    starts = _run_starts(packed)
    counts = packed[starts].view(np.int8).astype(np.int32)
    runs = counts >= 0
    if starts.size and starts[-1] + _STEP[packed[starts[-1]]] != packed.size:
        raise ValueError("the run-length data is cut short")
    # Count bytes stand for nothing, the byte of a run for several, all others for themselves.
    repeats = np.ones(packed.size, np.int32)
    repeats[starts] = 0
    repeats[starts[runs] + 1] = counts[runs] + 1
    total = int(repeats.sum(dtype=np.int64))
    if total != size:
        raise ValueError(f"the run-length data stands for {total} bytes, {size} expected")
    return np.repeat(packed, repeats)


def _run_starts(packed: Bytes) -> NDArray[np.int32]:
    """Where runs begin. Each byte, taken for a count, points to the next run; every eighth of these is followed."""
    end = packed.size
    jump = np.full(end + 1, end, np.int32)
    np.minimum(_STEP[packed] + np.arange(end, dtype=np.int32), end, out=jump[:end])
    jumps = [jump]
    for _ in range(_DOUBLINGS):
        jumps.append(jumps[-1][jumps[-1]])
    far, heads, at = jumps.pop().data, [], 0
    while at < end:
        heads.append(at)
        at = far[at]
    starts = np.array(heads, np.int32)
    for jump in reversed(jumps):
        starts = np.stack((starts, jump[starts]), axis=1).ravel()
    return starts[:np.searchsorted(starts, end)]


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
    heads = np.cumsum(stored + 1) - stored - 1
    kept = np.repeat(~run, lengths)
    kept[starts] = True
    packed = np.empty(heads.size + int(stored.sum()), np.uint8)
    place = np.ones(packed.size, bool)
    place[heads] = False
    packed[place] = data[kept]
    packed[heads] = np.where(run, lengths - 1, -lengths).astype(np.int8).view(np.uint8)
    return packed.tobytes()
