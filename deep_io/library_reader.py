"""Deep parts that rows.py does not decode (ZSTD), read whole through the OpenEXR library.

The library makes a Python object per pixel and channel: many times the memory of the samples and ten times the time
of the flat path. A MemoryCostWarning says so before it begins.
"""

from __future__ import annotations

import os
import struct
import sys
import warnings
from collections.abc import Sequence
from contextlib import suppress
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from deep_io.chunks import Chunk, part_label, read_rows, read_tiles, tile_description
from deep_io.errors import InputError, MemoryCostWarning
from deep_io.header import FileHeaders
from deep_io.library import read_with_library
from deep_io.rows import Targets

# What the library holds per pixel and channel besides the values: references to an array, and where there are samples
# a NumPy array object, measured.
_REFERENCE_BYTES = 16
_OBJECT_BYTES = 194
# The library's own frame, the arrays made of it and the flat arrays.
_VALUE_COPIES = 3
# OpenEXR's wrapping of a ZSTD frame: magic, format and flags, size of the frame, and the frame's own magic.
_PREFIX = struct.Struct("<8s8sQ4s")
_MAGIC, _FRAME_MAGIC = b"zstd-exr", b"\x28\xb5\x2f\xfd"


class LibraryRows:
    """All rows of a deep part, read by the library when it is opened; a RowDecoder of rows.py.

    Raises InputError for a part the file cannot hold or the library cannot read.
    """

    block, task = 1, 64

    def __init__(self, file: BinaryIO, headers: FileHeaders, part: int, path: str) -> None:
        header = headers.parts[part]
        window = header.data_window
        where = part_label(headers, part, path)
        unpacked = _check_chunks(file, headers, part, path)
        pixels = window.width * window.height
        estimate = unpacked * _VALUE_COPIES + len(header.channels) * (
            pixels * _REFERENCE_BYTES + min(pixels, unpacked // header.sample_bytes) * _OBJECT_BYTES)
        if estimate > _machine_memory():
            raise InputError(f"{where}: reading its ZSTD deep data takes about {estimate >> 20} MiB of memory, more "
                             f"than this machine has; write it with ZIPS, which streams")
        warnings.warn(f"{where}: ZSTD deep data is read through the OpenEXR library, the whole frame at once: slow, "
                      f"and takes about {max(estimate >> 20, 1)} MiB of memory; ZIPS would stream",
                      MemoryCostWarning, stacklevel=4)
        arrays = read_with_library(file, headers, path)[part]
        self._counts: NDArray[np.int32] | None = None
        self._values: list[NDArray[np.generic]] = []
        for channel in header.channels:
            objects = arrays.pop(channel.name)
            if objects.shape != (window.height, window.width):
                raise InputError(f"{where}: the OpenEXR library read {objects.shape} pixels of channel {channel.name}")
            counts = np.array([0 if pixel is None else len(pixel) for pixel in objects.ravel()], np.int32)
            if self._counts is None:
                self._counts = counts.reshape(objects.shape)
            elif not np.array_equal(self._counts.ravel(), counts):
                raise InputError(f"{where}: channel {channel.name} has other sample counts than the first channel")
            held = [pixel for pixel in objects.ravel() if pixel is not None and len(pixel)]
            self._values.append(np.concatenate(held).astype(channel.dtype, copy=False) if held
                                else np.empty(0, channel.dtype))
        assert self._counts is not None  # A part has at least one channel.
        self.samples = self._counts.sum(axis=1, dtype=np.int64)
        self._starts = np.concatenate(([0], np.cumsum(self.samples))).tolist()

    def decode(self, rows: range, counts: NDArray[np.int32], targets: Targets, starts: Sequence[int]) -> None:
        """Copy rows out; see rows.RowDecoder."""
        assert self._counts is not None
        counts[:] = self._counts[rows.start:rows.stop]
        begin, end = self._starts[rows.start], self._starts[rows.stop]
        for channel, values in targets:
            values[starts[0]:starts[0] + end - begin] = self._values[channel][begin:end]

    def close(self) -> None:
        """Release the frame."""
        self._counts, self._values = None, []


def _check_chunks(file: BinaryIO, headers: FileHeaders, part: int, path: str) -> int:
    """Check what can be told of a ZSTD part's chunks without inflating them; the bytes that its samples unpack to.

    Raises InputError, naming the row or the tile's row, when the part cannot hold what its header promises.
    """
    header, where = headers.parts[part], part_label(headers, part, path)
    if header.type == "deeptile":
        width, height, _ = tile_description(header, where)
        chunks = [(tile.chunk, tile.window) for band in read_tiles(file, headers, part, path, (width, height))
                  for tile in band]
    else:
        window = header.data_window
        chunks = [(chunk, window.rows(y, y + 1)) for y, chunk
                  in enumerate(read_rows(file, headers, part, path), window.ymin)]
    for chunk, covers in chunks:
        if not _is_packed(file, chunk, 4 * covers.width * covers.height):
            raise InputError(f"{where}: row {covers.ymin}: the compressed data is corrupt")
    return sum(chunk.unpacked for chunk, _ in chunks)


def _is_packed(file: BinaryIO, chunk: Chunk, table_bytes: int) -> bool:
    """Whether a chunk's count table and samples are ZSTD frames, as OpenEXR wraps them, or stored raw."""
    places = ((chunk.start, chunk.table_size, table_bytes),
              (chunk.start + chunk.table_size, chunk.data_size, chunk.unpacked))
    for start, size, unpacked in places:
        if size >= unpacked:
            continue
        file.seek(start)
        prefix = file.read(_PREFIX.size)
        if len(prefix) < _PREFIX.size or size < _PREFIX.size:
            return False
        magic, _, packed, frame = _PREFIX.unpack(prefix)
        if (magic, frame) != (_MAGIC, _FRAME_MAGIC) or packed != size - _PREFIX.size + len(_FRAME_MAGIC):
            return False
    return True


def _machine_memory() -> int:
    """Bytes that the machine has; no limit where the system does not tell."""
    with suppress(AttributeError, ValueError, OSError):
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return sys.maxsize
