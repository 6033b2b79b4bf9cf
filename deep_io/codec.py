"""Compression of one scanline's bytes: NONE, RLE and ZIPS of OpenEXR, in whole-array NumPy and libdeflate/ISA-L.

RLE and ZIPS first transform the bytes: the even-numbered bytes, then the odd-numbered ones, then each byte as its
difference to the one before, plus 128. Data whose packed form is not smaller than its raw form is stored raw.
Chunks and files are elsewhere; nothing here knows a path, so errors are ValueError.
"""

from __future__ import annotations

import threading
from itertools import pairwise
from typing import Any

import deflate
import numpy as np
from isal import isal_zlib
from numpy.typing import NDArray

from deep_io import rle

Bytes = NDArray[np.uint8]

COMPRESSIONS = ("none", "rle", "zips")
ISAL_LEVEL = 1  # 384 MB/s at a ratio of .54; zlib 4, OpenEXR's default, 30 MB/s at .49.
SMALL_LEVEL = 4  # libdeflate's: 5 % smaller for 0.3 CPU seconds more on the two layers of a 1080p frame

# The most bytes that one packed byte can stand for: deflate's longest match is 258 bytes in 2 bits, RLE's longest
# run 128 bytes in 2 bytes, ZSTD's largest block 128 KiB in 4 bytes.
MAX_RATIO = {"none": 1, "rle": 64, "zips": 1032, "zstd": 32768}

# Below this many bytes NumPy's own cumsum is faster than the doubling scan.
_SCAN_MIN_BYTES = 16384
# The doubling scan's row: a power of two so that a line has 16 to 32 rows, where passes and row steps balance.
_SCAN_ROWS = 16
_SCRATCH_MAX_BYTES = 16 << 20

_scratch = threading.local()


def decode(packed: bytes | memoryview, size: int, compression: str) -> NDArray[np.uint16]:
    """Undo `compression` on one line's bytes; `size`, even, is the number of bytes that must come out.

    Returns (size/2,) uint16: the line's bytes in pairs, little endian. It may be scratch memory of the calling thread,
    valid until this thread's next call. Raises ValueError for data that is corrupt or of another size; never inflates
    more than `size` bytes.
    """
    if len(packed) == size or compression == "none":
        if len(packed) != size:
            raise ValueError(f"{len(packed)} bytes stored, {size} expected")
        return np.frombuffer(packed, np.uint16)
    if compression == "zips":
        try:
            raw = np.frombuffer(deflate.zlib_decompress(packed, size), np.uint8)
        except (deflate.DeflateError, ValueError) as error:
            raise ValueError("the compressed data is corrupt") from error
        if raw.size != size:
            raise ValueError(f"{raw.size} bytes inflated, {size} expected")
    else:
        raw = rle.decode(np.frombuffer(packed, np.uint8), size)
    halves = _undo_differences(raw)
    line = _buffer("line", size // 2, np.dtype(np.uint16))
    np.left_shift(halves[size // 2:], np.uint16(8), out=line, dtype=np.uint16)
    np.bitwise_or(line, halves[:size // 2], out=line)
    return line


def encode(line: NDArray[np.uint16], compression: str, small: bool = False) -> bytes:
    """Compress one line's bytes, given as little-endian pairs (n,) uint16; raw where that is not longer.

    `small` takes more time to make zips smaller.
    """
    if compression == "none" or line.size == 0:
        return line.tobytes()
    halves = np.empty(2 * line.size, np.uint8)
    halves[:line.size] = line.astype(np.uint8)
    halves[line.size:] = np.right_shift(line, 8).astype(np.uint8)
    differences = np.empty_like(halves)
    differences[0] = halves[0]
    np.subtract(halves[1:], halves[:-1], out=differences[1:])
    np.bitwise_xor(differences[1:], 0x80, out=differences[1:])  # + 128 modulo 256
    packed: bytes
    if compression == "rle":
        packed = rle.encode(differences)
    elif small:
        packed = bytes(deflate.zlib_compress(differences, SMALL_LEVEL))
    else:
        packed = isal_zlib.compress(differences, ISAL_LEVEL)
    return packed if len(packed) < 2 * line.size else line.tobytes()


def _undo_differences(raw: Bytes) -> Bytes:
    """The running sum, modulo 256, of each byte minus 128; the first byte counts whole. In scratch memory.

    np.cumsum adds bytes one by one (470 MB/s). Here sums over windows of 1, 2, 4 ... W bytes are doubled with
    whole-vector additions, and then rows of W bytes are added to each other: 1600 MB/s for a line of 320 kB.
    """
    size = raw.size
    if size < _SCAN_MIN_BYTES:
        sums = _buffer("small", size, np.dtype(np.uint8))
        np.bitwise_xor(raw, 0x80, out=sums)
        sums[:1] ^= 0x80
        return np.cumsum(sums, dtype=np.uint8, out=sums)
    width = 1 << (size // _SCAN_ROWS).bit_length() - 1
    rows = -(-size // width)
    here = _buffer("ping", rows * width, np.dtype(np.uint8))
    there = _buffer("pong", rows * width, np.dtype(np.uint8))
    np.bitwise_xor(raw, 0x80, out=here[:size])
    here[0] ^= 0x80
    here[size:] = 0
    span = 1
    while span < width:  # here[i] is the sum of the `span` bytes that end at i.
        np.add(here[span:], here[:-span], out=there[span:])
        there[:span] = here[:span]
        here, there = there, here
        span *= 2
    table = here.reshape(rows, width)
    for above, row in pairwise(table):
        np.add(row, above, out=row)
    return here[:size]


def _buffer(name: str, size: int, dtype: np.dtype[Any]) -> NDArray[Any]:
    """Scratch memory of this thread: fresh pages would cost more than the arithmetic on them.

    Not kept for a line of unusual size, or a single one would hold on to its memory for good.
    """
    if size * dtype.itemsize > _SCRATCH_MAX_BYTES:
        return np.empty(size, dtype)
    held: NDArray[Any] | None = getattr(_scratch, name, None)
    if held is None or held.size < size:
        held = np.empty(size, dtype)
        setattr(_scratch, name, held)
    return held[:size]
