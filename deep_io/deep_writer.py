"""Deep scanline EXRs from flat arrays, row by row, of one part or several, compressed with NONE, RLE or ZIPS.

Writes to the path it is given; that a file appears whole or not at all is atomic.py's business.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Sequence
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
    MULTI_PART,
    NON_IMAGE,
    PIXEL_TYPES,
    Header,
    encode_header,
    needs_long_names,
)
from deep_io.samples import DeepSamples, Window

LINE_ORDERS = ("increasing", "decreasing")  # of scanlines; tiles know "random", too
_DEEP_DATA_VERSION = 1
_ROWS_AHEAD = 32  # Encoded rows waiting to be written, per call of the thread pool.


class DeepWriter:
    """Writes the deep scanline parts of one file.

    header      channels, windows, line order and attributes of the part, or a sequence of headers for a multi-part
                file, each with a name of its own; type, structure and compression are replaced
    compression "none", "rle" or "zips"
    threads     encoding threads; None for one per available core, at most 8. The bytes never depend on it.
    small       zips: a smaller file for more time, for files that are kept rather than passed on

    Rows come in blocks that follow each other: downwards from the top of the data window, or upwards from the bottom
    where the header's line_order is "decreasing". Closing without an error completes the chunk tables; it raises
    ValueError when rows are missing. Raises ValueError for headers and blocks that cannot be written, OSError from the
    disk.
    """

    def __init__(self, path: PathLike, header: Header | Sequence[Header], compression: str = "zips",
                 threads: int | None = None, small: bool = False) -> None:
        headers = [header] if isinstance(header, Header) else list(header)
        self._multipart = not isinstance(header, Header)
        if compression not in codec.COMPRESSIONS:
            raise ValueError(f"deep files are written with {', '.join(codec.COMPRESSIONS)}, not {compression!r}")
        if self._multipart:
            _check_parts(headers)
        self._parts = [_Part(header, compression, small) for header in headers]
        self._pool: ThreadPoolExecutor | None = None
        start = self._encode_start()
        self._file = _create(path)
        self._file.write(start)
        threads = threads or default_threads()
        if threads > 1:
            self._pool = ThreadPoolExecutor(threads)

    @property
    def headers(self) -> tuple[Header, ...]:
        """The headers as they are written."""
        return tuple(part.header for part in self._parts)

    def write(self, samples: DeepSamples, part: int = 0) -> None:
        """The next rows of a part, with at least the channels of its header, in their types. Raises ValueError."""
        target = self._parts[part]
        encode = target.encoder(samples)
        rows = target.order(samples.window)
        for start in range(0, len(rows), _ROWS_AHEAD):
            ahead = rows[start:start + _ROWS_AHEAD]
            encoded = self._pool.map(encode, ahead) if self._pool else map(encode, ahead)
            for y, (table, data, unpacked) in zip(ahead, encoded, strict=True):
                target.offsets[y - target.header.data_window.ymin] = self._file.tell()
                number = struct.pack("<i", part) if self._multipart else b""
                self._file.write(number + struct.pack("<i3Q", y, len(table), len(data), unpacked))
                self._file.write(table)
                self._file.write(data)
        target.advance(samples)

    def _encode_start(self) -> bytes:
        """Everything before the chunks; always of the same length."""
        flags = FORMAT_VERSION | NON_IMAGE | (MULTI_PART if self._multipart else 0)
        if any(needs_long_names(header) for header in self.headers):
            flags |= LONG_NAMES
        end = b"\0" if self._multipart else b""
        return (struct.pack("<iI", MAGIC, flags) + b"".join(encode_header(header) for header in self.headers) + end
                + b"".join(part.offsets.tobytes() for part in self._parts))

    def close(self) -> None:
        """Write the chunk tables and close. Raises ValueError when rows are missing; the file is closed even then."""
        if self._file.closed:
            return
        try:
            for part in self._parts:
                rows = part.offsets.size
                if part.written != rows:
                    raise ValueError(f"{os.fspath(self._file.name)}: {part.written} of {rows} rows written")
            self._file.seek(0)
            self._file.write(self._encode_start())
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


class _Part:
    """A part being written: its header, which rows are done and how the next ones are encoded."""

    def __init__(self, header: Header, compression: str, small: bool) -> None:
        if header.line_order not in LINE_ORDERS:
            raise ValueError(f"deep scanlines have no {header.line_order} line order")
        _check_channels(header)
        height = header.data_window.height
        self.header = replace(header, type="deepscanline", compression=compression, structure={
            "chunkCount": attribute(height), "version": attribute(_DEEP_DATA_VERSION),
            "maxSamplesPerPixel": attribute(0)})
        self._channels = sorted(header.channels, key=lambda channel: channel.name.encode("utf-8", "surrogateescape"))
        self._upwards = header.line_order == "decreasing"
        self._small = small
        self.offsets = np.zeros(height, np.int64)
        self.written = 0

    def order(self, window: Window) -> range:
        """The block's rows in the order of the file."""
        return range(window.ymax, window.ymin - 1, -1) if self._upwards else range(window.ymin, window.ymax + 1)

    def encoder(self, samples: DeepSamples) -> Callable[[int], tuple[bytes, bytes, int]]:
        """A function from a row, y, to its packed count table, packed samples and their unpacked size.

        Raises ValueError when the block is not the part's next.
        """
        self._check(samples)
        window, compression = samples.window, self.header.compression
        ends = np.cumsum(samples.counts.sum(axis=1, dtype=np.int64)).tolist()
        pairs = [np.ascontiguousarray(samples.channels[channel.name]).view(np.uint16) for channel in self._channels]
        widths = [channel.dtype.itemsize // 2 for channel in self._channels]

        def encode(y: int) -> tuple[bytes, bytes, int]:
            row = y - window.ymin
            begin, end = ends[row - 1] if row else 0, ends[row]
            if self.header.sample_bytes * (end - begin) > MAX_CHUNK:
                raise ValueError(f"row {y} has {end - begin} samples, more than a chunk of 2 GiB holds")
            line = np.concatenate([values[begin * width:end * width]
                                   for values, width in zip(pairs, widths, strict=True)])
            sums = np.cumsum(samples.counts[row], dtype="<i4")
            table = codec.encode(sums.view(np.uint16), compression, self._small)
            return table, codec.encode(line, compression, self._small), line.nbytes

        return encode

    def _check(self, samples: DeepSamples) -> None:
        window, whole = samples.window, self.header.data_window
        last = whole.ymax - self.written if self._upwards else whole.ymin + self.written + window.height - 1
        expected = whole.rows(last - window.height + 1, last + 1)
        if window != expected or not whole.ymin <= window.ymin <= window.ymax <= whole.ymax:
            raise ValueError(f"rows {window} are not the next of {whole}: {self.written} rows were written")
        for channel in self._channels:
            if channel.name not in samples.channels or samples.channels[channel.name].dtype != channel.dtype:
                raise ValueError(f"the samples need a {channel.dtype} channel {channel.name!r}")
        if (samples.counts < 0).any():
            raise ValueError("sample counts must not be negative")

    def advance(self, samples: DeepSamples) -> None:
        """Count the block's rows as written."""
        self.written += samples.window.height
        most = max(self.header.get("maxSamplesPerPixel"), int(samples.counts.max()))
        self.header = replace(self.header, structure={**self.header.structure, "maxSamplesPerPixel": attribute(most)})


def _create(path: PathLike) -> BinaryIO:
    return open(path, "wb")


def _check_parts(headers: list[Header]) -> None:
    names = [header.name for header in headers]
    if not headers or "" in names or len(set(names)) != len(names):
        raise ValueError(f"the parts of a multi-part file need names, each its own: {names}")
    if len({(header.display_window, header.pixel_aspect) for header in headers}) > 1:
        raise ValueError("the parts of a multi-part file share one display window and one pixel aspect")


def _check_channels(header: Header) -> None:
    if not header.channels:
        raise ValueError("a deep file needs at least one channel")
    if len(set(header.channel_names)) != len(header.channels):
        raise ValueError("a channel is named twice")
    for channel in header.channels:
        if channel.dtype not in PIXEL_TYPES or channel.sampling != (1, 1):
            raise ValueError(f"deep channel {channel.name!r} must be float16, float32 or uint32 and not subsampled")


