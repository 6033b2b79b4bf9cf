"""Deep scanline EXRs from flat arrays, row by row: one part, compression NONE, RLE or ZIPS.

Writes to the path it is given; that a file appears whole or not at all is atomic.py's business.
"""

from __future__ import annotations

import os
import struct
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from types import TracebackType
from typing import BinaryIO, Self

import numpy as np

from deep_io import codec
from deep_io.attributes import attribute
from deep_io.chunks import MAX_CHUNK
from deep_io.deep_reader import PathLike, default_threads
from deep_io.header import (
    FORMAT_VERSION,
    LONG_NAMES,
    MAGIC,
    NON_IMAGE,
    PIXEL_TYPES,
    Header,
    encode_header,
    needs_long_names,
)
from deep_io.samples import DeepSamples

_DEEP_DATA_VERSION = 1
_ROWS_AHEAD = 32  # Encoded rows waiting to be written, per call of the thread pool.


class DeepWriter:
    """Writes one deep scanline part.

    header      channels, windows, line order and attributes; its type, structure and compression are replaced
    compression "none", "rle" or "zips"
    threads     encoding threads; None for one per available core, at most 8. The bytes never depend on it.

    Rows come in blocks that follow each other: downwards from the top of the data window, or upwards from the bottom
    where header.line_order is "decreasing". Closing without an error completes the chunk table; it raises ValueError
    when rows are missing. Raises ValueError for headers and blocks that cannot be written, OSError from the disk.
    """

    def __init__(self, path: PathLike, header: Header, compression: str = "zips", threads: int | None = None) -> None:
        if compression not in codec.COMPRESSIONS:
            raise ValueError(f"deep files are written with {', '.join(codec.COMPRESSIONS)}, not {compression!r}")
        if header.line_order not in ("increasing", "decreasing"):
            raise ValueError(f"deep scanlines have no {header.line_order} line order")
        _check_channels(header)
        height = header.data_window.height
        self.header = replace(header, type="deepscanline", compression=compression, structure={
            "chunkCount": attribute(height), "version": attribute(_DEEP_DATA_VERSION),
            "maxSamplesPerPixel": attribute(0)})
        self._channels = sorted(header.channels, key=lambda channel: channel.name.encode("utf-8", "surrogateescape"))
        self._upwards = header.line_order == "decreasing"
        self._rows = np.zeros(height, np.int64)
        self._written = 0
        self._max_count = 0
        self._pool: ThreadPoolExecutor | None = None
        encoded = self._encode_start()
        self._file = _create(path)
        self._file.write(encoded + self._rows.tobytes())
        threads = threads or default_threads()
        if threads > 1:
            self._pool = ThreadPoolExecutor(threads)

    def _encode_start(self) -> bytes:
        flags = FORMAT_VERSION | NON_IMAGE | (LONG_NAMES if needs_long_names(self.header) else 0)
        return struct.pack("<iI", MAGIC, flags) + encode_header(self.header)

    def write(self, samples: DeepSamples) -> None:
        """The next rows, with at least the channels of the header, in their types. Raises ValueError."""
        window, whole = samples.window, self.header.data_window
        last = whole.ymax - self._written if self._upwards else whole.ymin + self._written + window.height - 1
        expected = whole.rows(last - window.height + 1, last + 1)
        if window != expected or not whole.ymin <= window.ymin <= window.ymax <= whole.ymax:
            raise ValueError(f"rows {window} are not the next of {whole}: {self._written} rows were written")
        for channel in self._channels:
            if channel.name not in samples.channels or samples.channels[channel.name].dtype != channel.dtype:
                raise ValueError(f"the samples need a {channel.dtype} channel {channel.name!r}")
        if (samples.counts < 0).any():
            raise ValueError("sample counts must not be negative")
        row_ends = np.cumsum(samples.counts.sum(axis=1, dtype=np.int64))
        order = range(window.height - 1, -1, -1) if self._upwards else range(window.height)
        compression = self.header.compression
        pairs = [np.ascontiguousarray(samples.channels[channel.name]).view(np.uint16) for channel in self._channels]
        widths = [channel.dtype.itemsize // 2 for channel in self._channels]

        def encode(row: int) -> tuple[bytes, bytes, int]:
            begin, end = int(row_ends[row - 1]) if row else 0, int(row_ends[row])
            if 2 * sum(widths) * (end - begin) > MAX_CHUNK:
                raise ValueError(f"row {window.ymin + row} has {end - begin} samples, more than a chunk of 2 GiB holds")
            line = np.concatenate([values[begin * width:end * width]
                                   for values, width in zip(pairs, widths, strict=True)])
            sums = np.cumsum(samples.counts[row], dtype="<i4")
            return (codec.encode(sums.view(np.uint16), compression), codec.encode(line, compression), line.nbytes)

        for start in range(0, window.height, _ROWS_AHEAD):
            rows = order[start:start + _ROWS_AHEAD]
            encoded = self._pool.map(encode, rows) if self._pool else map(encode, rows)
            for row, chunk in zip(rows, encoded, strict=True):
                self._write_chunk(window.ymin + row, *chunk)
        self._written += window.height
        self._max_count = max(self._max_count, int(samples.counts.max()))

    def _write_chunk(self, y: int, table: bytes, data: bytes, unpacked: int) -> None:
        self._rows[y - self.header.data_window.ymin] = self._file.tell()
        self._file.write(struct.pack("<i3Q", y, len(table), len(data), unpacked))
        self._file.write(table)
        self._file.write(data)

    def close(self) -> None:
        """Write the chunk table and close. Raises ValueError when rows are missing; the file is closed all the same."""
        if self._file.closed:
            return
        try:
            if self._written != self._rows.size:
                raise ValueError(f"{os.fspath(self._file.name)}: {self._written} of {self._rows.size} rows written")
            self.header = replace(self.header, structure={**self.header.structure,
                                                          "maxSamplesPerPixel": attribute(self._max_count)})
            self._file.seek(0)
            self._file.write(self._encode_start() + self._rows.tobytes())
        finally:
            self._abandon()

    def _abandon(self) -> None:
        if self._pool:
            self._pool.shutdown(cancel_futures=True)
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        if kind is None:
            self.close()
        else:
            self._abandon()


def _create(path: PathLike) -> BinaryIO:
    return open(path, "wb")


def _check_channels(header: Header) -> None:
    if not header.channels:
        raise ValueError("a deep file needs at least one channel")
    if len(set(header.channel_names)) != len(header.channels):
        raise ValueError("a channel is named twice")
    for channel in header.channels:
        if channel.dtype not in PIXEL_TYPES or channel.sampling != (1, 1):
            raise ValueError(f"deep channel {channel.name!r} must be float16, float32 or uint32 and not subsampled")


