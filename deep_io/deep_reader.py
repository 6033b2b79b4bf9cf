"""Deep EXRs into flat arrays, by blocks of rows, any subset of the channels, on several threads.

Scanline and tiled parts compressed with NONE, RLE or ZIPS are decoded by rows.py. ZSTD goes through the OpenEXR library
(library_reader.py), which needs the memory of the whole frame many times over.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from deep_io import codec
from deep_io.cores import usable_cores
from deep_io.errors import InputError
from deep_io.header import FileHeaders, Header, open_input, parse_headers
from deep_io.library_reader import LibraryRows
from deep_io.rows import RowDecoder, ScanlineRows, TileRows
from deep_io.samples import DeepSamples

DEFAULT_BLOCK_BYTES = 64 << 20
MAX_THREADS = 8  # More only wait for each other: NumPy's calls on one line are short.

PathLike = str | os.PathLike[str]


class DeepReader:
    """An open deep part of an EXR file.

    part        name or index of the part; None for the file's only deep part
    threads     decoding threads; None for one per available core, at most 8. The result never depends on it.

    Opening reads the header and the size of every row, and checks both against the file, so that nothing is allocated
    for a file that cannot hold what it promises. Raises InputError for a file that is missing, not an EXR, flat,
    truncated or corrupt, a compression that is not known, and a part that does not exist.
    """

    def __init__(self, path: PathLike, part: int | str | None = None, threads: int | None = None) -> None:
        self.path = os.fspath(path)
        self._file = open_input(path)
        try:
            headers = parse_headers(self._file, self.path)
            self.part = _select(headers, part, self.path)
            self.header: Header = headers.parts[self.part]
            self._rows = self._open_rows(headers)
        except BaseException:
            self._file.close()
            raise
        self.threads = threads or default_threads()
        self._pool = ThreadPoolExecutor(self.threads) if self.threads > 1 else None

    def _open_rows(self, headers: FileHeaders) -> RowDecoder:
        header = self.header
        if any(channel.sampling != (1, 1) for channel in header.channels) or not header.channels:
            raise InputError(f"{self.path}: deep channels must exist and not be subsampled")
        if header.compression in codec.COMPRESSIONS:
            decoder = TileRows if header.type == "deeptile" else ScanlineRows
            return decoder(self._file, headers, self.part, self.path)
        if header.compression == "zstd":
            return LibraryRows(self._file, headers, self.part, self.path)
        raise InputError(f"{self.path}: deep data cannot be compressed with {header.compression}; write it with ZIPS")

    @property
    def samples_per_row(self) -> NDArray[np.int64]:
        """(H,) samples in each row of the data window, known without decoding."""
        return self._rows.samples

    @property
    def total(self) -> int:
        """Samples in the part."""
        return int(self._rows.samples.sum())

    def read(self, y0: int | None = None, y1: int | None = None,
             channels: Iterable[str] | None = None) -> DeepSamples:
        """Rows y0 to y1 exclusive, in absolute pixel coordinates (default: all), of the named channels (default: all).

        Raises ValueError for rows outside the data window, KeyError for a channel that does not exist and InputError,
        naming the row, for corrupt pixels.
        """
        window = self.header.data_window
        y0 = window.ymin if y0 is None else y0
        y1 = window.ymax + 1 if y1 is None else y1
        if not window.ymin <= y0 < y1 <= window.ymax + 1:
            raise ValueError(f"rows {y0} to {y1} are not within {window.ymin} to {window.ymax + 1}")
        wanted = self._wanted(channels)
        first, last = y0 - window.ymin, y1 - window.ymin
        offsets = np.concatenate(([0], np.cumsum(self._rows.samples[first:last]))).tolist()
        counts = np.empty((y1 - y0, window.width), np.int32)
        arrays = {name: np.empty(offsets[-1], self.header.channels[index].dtype) for name, index in wanted.items()}

        targets = [(wanted[name], values) for name, values in arrays.items()]

        def decode(rows: range) -> None:
            here = slice(rows.start - first, rows.stop - first)
            self._rows.decode(rows, counts[here], targets, offsets[here])

        tasks = _pieces(first, last, self._rows.task)
        for _ in self._pool.map(decode, tasks) if self._pool else map(decode, tasks):
            pass  # Waits, and raises what a thread raised.
        return DeepSamples(counts, arrays, window.rows(y0, y1))

    def blocks(self, max_bytes: int = DEFAULT_BLOCK_BYTES, channels: Iterable[str] | None = None
               ) -> Iterator[DeepSamples]:
        """The part in blocks of whole rows from the top, each of at most `max_bytes`.

        A larger row, or row of tiles, is a block by itself.
        """
        wanted = list(self._wanted(channels))
        sample_bytes = sum(self.header.channels[index].dtype.itemsize for index in self._wanted(wanted).values())
        window = self.header.data_window
        row_bytes = self._rows.samples * sample_bytes + 4 * window.width
        first, held = 0, 0
        for piece in _pieces(0, window.height, self._rows.block):
            size = int(row_bytes[piece.start:piece.stop].sum())
            if held and held + size > max_bytes:
                yield self.read(window.ymin + first, window.ymin + piece.start, wanted)
                first, held = piece.start, 0
            held += size
        yield self.read(window.ymin + first, window.ymax + 1, wanted)

    def _wanted(self, channels: Iterable[str] | None) -> dict[str, int]:
        index = {name: position for position, name in enumerate(self.header.channel_names)}
        return index if channels is None else {name: index[name] for name in channels}

    def close(self) -> None:
        """Close the file; the reader is of no use afterwards."""
        if self._pool:
            self._pool.shutdown(cancel_futures=True)
        self._rows.close()
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self.close()


def _select(headers: FileHeaders, part: int | str | None, path: str) -> int:
    """The number of the part asked for. Raises InputError unless there is exactly one such part and it is deep."""
    names = [header.name or str(index) for index, header in enumerate(headers.parts)]
    deep = [index for index, header in enumerate(headers.parts) if header.is_deep]
    if not deep:
        raise InputError(f"{path}: is a flat EXR, without deep samples; make a deep sample file from several "
                         f"renders with different seeds: lbmc pack FRAMES... OUT")
    if part is None:
        if len(deep) > 1:
            choices = ", ".join(names[index] for index in deep)
            raise InputError(f"{path}: has {len(deep)} deep parts; choose one with --part: {choices}")
        return deep[0]
    matches = [index for index, header in enumerate(headers.parts) if part in (index, header.name)]
    if not matches and isinstance(part, str) and part.isdecimal():
        matches = [int(part)] if int(part) < len(names) else []
    if len(matches) != 1:
        raise InputError(f"{path}: has no part {part!r}; its parts are {', '.join(names)}")
    if matches[0] not in deep:
        raise InputError(f"{path}: part {part!r} is flat; the deep parts are {', '.join(names[i] for i in deep)}")
    return matches[0]


def _pieces(first: int, last: int, size: int) -> list[range]:
    """Rows first to last exclusive, cut at the multiples of `size`."""
    cuts = [first, *range((first // size + 1) * size, last, size), last]
    return [range(begin, end) for begin, end in pairwise(cuts)]


def default_threads() -> int:
    """The number of cores this process may use, at most 8."""
    return min(MAX_THREADS, usable_cores())
