"""Deep EXRs into flat arrays, by blocks of rows, any subset of the channels, on several threads.

Deep scanline parts compressed with NONE, RLE or ZIPS are decoded here. Tiled parts and ZSTD go through the OpenEXR
library (library_reader.py), which needs the memory of the whole frame many times over.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from types import TracebackType
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from deep_io import codec
from deep_io.chunks import part_label, read_row_table
from deep_io.errors import InputError
from deep_io.header import FileHeaders, Header, open_input, parse_headers
from deep_io.library_reader import LibraryRows
from deep_io.samples import DeepSamples

DEFAULT_BLOCK_BYTES = 64 << 20
MAX_THREADS = 8  # More only wait for each other: NumPy's calls on one line are short.
_ROWS_PER_TASK = 8

PathLike = str | os.PathLike[str]


class _Rows(Protocol):
    """What decodes rows; `samples` is (H,) int64, the samples in each row of the data window."""

    samples: NDArray[np.int64]

    def decode(self, row: int, counts: NDArray[np.int32], channels: Sequence[tuple[int, NDArray[np.generic]]]) -> None:
        """Write row's counts (W,) and, for (channel index, destination) pairs, its samples. Raises InputError."""

    def close(self) -> None: ...


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

    def _open_rows(self, headers: FileHeaders) -> _Rows:
        header = self.header
        if any(channel.sampling != (1, 1) for channel in header.channels) or not header.channels:
            raise InputError(f"{self.path}: deep channels must exist and not be subsampled")
        if header.compression in codec.COMPRESSIONS and header.type == "deepscanline":
            return _ScanlineRows(self, headers)
        if header.compression in (*codec.COMPRESSIONS, "zstd"):
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

        def decode(rows: range) -> None:
            for row in rows:
                begin, end = offsets[row - first], offsets[row - first + 1]
                self._rows.decode(row, counts[row - first],
                                  [(wanted[name], values[begin:end]) for name, values in arrays.items()])

        self._for_rows(decode, first, last)
        return DeepSamples(counts, arrays, window.rows(y0, y1))

    def blocks(self, max_bytes: int = DEFAULT_BLOCK_BYTES, channels: Iterable[str] | None = None
               ) -> Iterator[DeepSamples]:
        """The part in blocks of whole rows from the top, each of at most `max_bytes` (a larger row stands alone)."""
        wanted = list(self._wanted(channels))
        sample_bytes = sum(self.header.channels[index].dtype.itemsize for index in self._wanted(wanted).values())
        window = self.header.data_window
        row_bytes = self._rows.samples * sample_bytes + 4 * window.width
        first, held = 0, 0
        for row, size in enumerate(row_bytes.tolist()):
            if held and held + size > max_bytes:
                yield self.read(window.ymin + first, window.ymin + row, wanted)
                first, held = row, 0
            held += size
        yield self.read(window.ymin + first, window.ymax + 1, wanted)

    def _wanted(self, channels: Iterable[str] | None) -> dict[str, int]:
        index = {name: position for position, name in enumerate(self.header.channel_names)}
        return index if channels is None else {name: index[name] for name in channels}

    def _for_rows(self, work: Callable[[range], None], first: int, last: int) -> None:
        tasks = [range(row, min(row + _ROWS_PER_TASK, last)) for row in range(first, last, _ROWS_PER_TASK)]
        for _ in (self._pool.map(work, tasks) if self._pool else map(work, tasks)):
            pass

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


class _ScanlineRows:
    """Rows of a deep scanline part, decoded straight into the caller's arrays."""

    def __init__(self, reader: DeepReader, headers: FileHeaders) -> None:
        self._file = reader._file
        self._lock = threading.Lock()  # Seek and read must stay together; reading is a few percent of the work.
        self._where = part_label(headers, reader.part, reader.path)
        self._header = reader.header
        self._table = read_row_table(reader._file, headers, reader.part, reader.path)
        self.samples = self._table.samples
        # Where each channel begins in a row's uint16 pairs, per sample.
        self._pairs = np.cumsum([0] + [channel.dtype.itemsize // 2 for channel in self._header.channels]).tolist()

    def decode(self, row: int, counts: NDArray[np.int32], channels: Sequence[tuple[int, NDArray[np.generic]]]) -> None:
        table_size, data_size = int(self._table.table_size[row]), int(self._table.data_size[row])
        total = int(self.samples[row])
        try:
            with self._lock:
                self._file.seek(int(self._table.start[row]))
                chunk = memoryview(self._file.read(table_size + data_size))
            if len(chunk) != table_size + data_size:
                raise ValueError("the file ends within the row")
            _decode_counts(chunk[:table_size], counts, total, self._header.compression)
            if not channels or not total:
                return
            line = codec.decode(chunk[table_size:], total * self._header.sample_bytes, self._header.compression)
            for index, values in channels:
                values.view(np.uint16)[:] = line[self._pairs[index] * total:self._pairs[index + 1] * total]
        except (ValueError, OSError) as error:
            y = self._header.data_window.ymin + row
            raise InputError(f"{self._where}: row {y}: {error}") from error

    def close(self) -> None:
        """Nothing to release: the reader owns the file."""


def _decode_counts(packed: memoryview, counts: NDArray[np.int32], total: int, compression: str) -> None:
    """A row's count table, which holds running sums, into counts (W,). Raises ValueError unless they sum to `total`."""
    sums = codec.decode(packed, 4 * counts.size, compression).view("<i4")
    counts[0] = sums[0]
    np.subtract(sums[1:], sums[:-1], out=counts[1:])
    if int(sums[-1]) != total or sums[0] < 0 or (sums[1:] < sums[:-1]).any():
        raise ValueError(f"the sample counts are corrupt: they must rise to {total}")


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


def default_threads() -> int:
    """The number of cores this process may use, at most 8."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(MAX_THREADS, cores)
