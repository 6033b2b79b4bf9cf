"""Decoding of deep chunks into flat arrays: rows of scanline parts and rows of tiles, whichever channels are wanted.

deep_reader.py decides what is read and allocates; the decoders here fill. library_reader.py is a third one.
"""

from __future__ import annotations

import itertools
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import BinaryIO, Protocol

import numpy as np
from numpy.typing import NDArray

from deep_io import codec
from deep_io.chunks import Chunk, Tile, part_label, read_rows, read_tiles, tile_description
from deep_io.errors import InputError
from deep_io.header import FileHeaders, Header

_SCANLINES_PER_TASK = 8

# Channel index in the header, and the array its samples go to.
Targets = Sequence[tuple[int, NDArray[np.generic]]]


class RowDecoder(Protocol):
    """A deep part whose rows, counted from the top of the data window, can be decoded in any order by any thread.

    samples     int64 (H,)  samples in each row
    block       rows that are stored together: reading fewer decodes all of them
    task        rows one thread does at a time
    """

    samples: NDArray[np.int64]
    block: int
    task: int

    def decode(self, rows: range, counts: NDArray[np.int32], targets: Targets, starts: Sequence[int]) -> None:
        """Fill counts (len(rows), W) and, in each target array, the samples of row rows[i] from starts[i] on.

        Raises InputError for corrupt data, naming the row.
        """

    def close(self) -> None:
        """Release what the decoder holds besides the file."""


class _ChunkDecoder:
    """What scanlines and tiles share: reading a chunk and undoing its compression."""

    def __init__(self, file: BinaryIO, headers: FileHeaders, part: int, path: str) -> None:
        self._file = file
        self._lock = threading.Lock()  # Seek and read must stay together; reading is a few percent of the work.
        self._where = part_label(headers, part, path)
        self._header: Header = headers.parts[part]
        # A channel's place in a sample, in uint16 pairs of bytes.
        self._pairs: list[int] = np.cumsum(
            [0] + [channel.dtype.itemsize // 2 for channel in self._header.channels]).tolist()

    def _read(self, position: int, size: int) -> memoryview:
        with self._lock:
            self._file.seek(position)
            data = self._file.read(size)
        if len(data) != size:
            raise ValueError("the file ends within it")
        return memoryview(data)

    def _counts(self, packed: memoryview, counts: NDArray[np.int32]) -> None:
        """A chunk's count table, which holds running sums along each line, into counts (lines, width)."""
        size = 4 * counts.size
        sums = codec.decode(packed[:size], size, self._header.compression).view("<i4").reshape(counts.shape)
        counts[:, 0] = sums[:, 0]
        np.subtract(sums[:, 1:], sums[:, :-1], out=counts[:, 1:])
        if (sums[:, 0] < 0).any() or (sums[:, 1:] < sums[:, :-1]).any():
            raise ValueError("the sample counts are corrupt: they must not fall along a row")

    def _samples(self, packed: memoryview, chunk: Chunk) -> NDArray[np.uint16]:
        return codec.decode(packed, chunk.unpacked, self._header.compression)

    def _expect(self, total: int, chunk: Chunk) -> None:
        if total * self._header.sample_bytes != chunk.unpacked:
            raise ValueError(f"the sample counts are corrupt: they sum to {total}, the stored samples are "
                             f"{chunk.unpacked // self._header.sample_bytes}")

    def close(self) -> None:
        """Nothing to release: the reader owns the file."""


class ScanlineRows(_ChunkDecoder):
    """Rows of a deep scanline part (NONE, RLE, ZIPS). Raises InputError when the file cannot hold them."""

    block, task = 1, _SCANLINES_PER_TASK

    def __init__(self, file: BinaryIO, headers: FileHeaders, part: int, path: str) -> None:
        super().__init__(file, headers, part, path)
        self._chunks = read_rows(file, headers, part, path)
        self.samples = np.array([chunk.unpacked for chunk in self._chunks], np.int64) // self._header.sample_bytes

    def decode(self, rows: range, counts: NDArray[np.int32], targets: Targets, starts: Sequence[int]) -> None:
        """See RowDecoder."""
        for index, row in enumerate(rows):
            try:
                self._decode_row(self._chunks[row], counts[index:index + 1], targets, starts[index])
            except (ValueError, OSError) as error:
                raise InputError(f"{self._where}: row {self._header.data_window.ymin + row}: {error}") from error

    def _decode_row(self, chunk: Chunk, counts: NDArray[np.int32], targets: Targets, start: int) -> None:
        packed = self._read(chunk.start, chunk.table_size + chunk.data_size)
        self._counts(packed[:chunk.table_size], counts)
        total = int(counts.sum(dtype=np.int64))
        self._expect(total, chunk)
        if not targets or not total:
            return
        line = self._samples(packed[chunk.table_size:], chunk)
        for channel, values in targets:
            values[start:start + total].view(np.uint16)[:] = line[self._pairs[channel] * total:
                                                                  self._pairs[channel + 1] * total]


class TileRows(_ChunkDecoder):
    """Rows of a deep tiled part's full-resolution level (NONE, RLE, ZIPS).

    Tiles do not say how many samples each of their rows has, so all count tables are decoded when the part is opened
    and kept: 4 bytes per pixel. Raises InputError when the file cannot hold the tiles or a count table is corrupt.
    """

    def __init__(self, file: BinaryIO, headers: FileHeaders, part: int, path: str) -> None:
        super().__init__(file, headers, part, path)
        width, height, _ = tile_description(self._header, self._where)
        self._tiles = read_tiles(file, headers, part, path, (width, height))
        self.block = self.task = height
        window = self._header.data_window
        self._table = np.empty((window.height, window.width), np.int32)
        for tile in itertools.chain.from_iterable(self._tiles):
            with self._naming(tile):
                packed = self._read(tile.chunk.start, tile.chunk.table_size)
                counts = np.empty((tile.window.height, tile.window.width), np.int32)
                self._counts(packed, counts)
                self._expect(int(counts.sum(dtype=np.int64)), tile.chunk)
                self._table[self._place(tile)] = counts
        self.samples = self._table.sum(axis=1, dtype=np.int64)

    @contextmanager
    def _naming(self, tile: Tile) -> Iterator[None]:
        """Errors in here get the file's name and the tile's place."""
        try:
            yield
        except (ValueError, OSError) as error:
            x, y = tile.chunk.coordinates[:2]
            raise InputError(f"{self._where}: row {tile.window.ymin}: tile {x}, {y}: {error}") from error

    def _place(self, tile: Tile) -> tuple[slice, slice]:
        window, covers = self._header.data_window, tile.window
        return (slice(covers.ymin - window.ymin, covers.ymax + 1 - window.ymin),
                slice(covers.xmin - window.xmin, covers.xmax + 1 - window.xmin))

    def decode(self, rows: range, counts: NDArray[np.int32], targets: Targets, starts: Sequence[int]) -> None:
        """See RowDecoder."""
        counts[:] = self._table[rows.start:rows.stop]
        if not targets:
            return
        filled = list(starts)  # Where the next tile to the right continues each row.
        for band in self._tiles[rows.start // self.block:(rows.stop - 1) // self.block + 1]:
            for tile in band:
                with self._naming(tile):
                    self._decode_tile(tile, rows, targets, filled)

    def _decode_tile(self, tile: Tile, rows: range, targets: Targets, filled: list[int]) -> None:
        """A tile holds its lines one after the other, each channel by channel like a scanline."""
        lines, columns = self._place(tile)
        totals = self._table[lines, columns].sum(axis=1, dtype=np.int64).tolist()
        if not any(totals):
            return
        chunk = tile.chunk
        pairs = self._samples(self._read(chunk.start + chunk.table_size, chunk.data_size), chunk)
        begin = 0  # Of the line, in pairs.
        for row, total in zip(range(lines.start, lines.stop), totals, strict=True):
            if row in rows:
                start = filled[row - rows.start]
                filled[row - rows.start] += total
                for channel, values in targets:
                    values[start:start + total].view(np.uint16)[:] = pairs[begin + self._pairs[channel] * total:
                                                                           begin + self._pairs[channel + 1] * total]
            begin += self._pairs[-1] * total
