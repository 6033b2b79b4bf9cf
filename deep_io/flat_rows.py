"""Rows of flat EXRs read as they are needed, without the rest of the picture.

The library decodes whole files only. So it gets a small one in memory, with bare headers whose data window is the rows
asked for, and the chunks of these rows as they are stored. What is wrong with a file is told as flat.py tells it.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from io import BytesIO
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from deep_io.attributes import attribute
from deep_io.chunks import chunk_count, flat_chunk_rows, part_label, tile_description
from deep_io.errors import InputError
from deep_io.flat import PathLike, Pixels, parse_flat
from deep_io.header import TILED, FileHeaders, Header, open_input
from deep_io.library import decode_with_library
from deep_io.reheading import bare_header, reheaded


@dataclass(frozen=True)
class _Chunk:
    """A chunk: its part, its coordinates (y; or tile x, y, level x, y), and where its packed pixels lie."""

    part: int
    coordinates: tuple[int, ...]
    start: int
    size: int


@dataclass(frozen=True)
class _Grid:
    """How a part's full-resolution pixels are cut: `down` times `across` chunks, each of `rows` rows."""

    rows: int
    down: int
    across: int
    tiled: bool
    ymin: int

    @classmethod
    def of(cls, header: Header, where: str) -> _Grid:
        window, rows, tiled = header.data_window, flat_chunk_rows(header, where), header.type == "tiledimage"
        across = -(-window.width // tile_description(header, where)[0]) if tiled else 1
        return cls(rows, -(-window.height // rows), across, tiled, window.ymin)

    def coordinates(self, row: int, column: int) -> tuple[int, ...]:
        """What the chunk's leader holds."""
        return (column, row, 0, 0) if self.tiled else (self.ymin + row * self.rows,)

    def index(self, coordinates: tuple[int, ...]) -> int | None:
        """The chunk's place in the table; None for one of no place, or of a smaller copy of the picture."""
        column, row, *level = coordinates if self.tiled else (0, (coordinates[0] - self.ymin) // self.rows, 0, 0)
        inside = 0 <= column < self.across and 0 <= row < self.down and not any(level)
        return row * self.across + column if inside else None


class FlatRows:
    """A flat EXR whose rows are decoded when they are asked for; the file is open only meanwhile.

    path     the file's name
    headers  of its parts

    Raises InputError when the file is unreadable, truncated, deep or subsampled, or lacks rows.
    """

    def __init__(self, path: PathLike) -> None:
        self.path = os.fspath(path)
        with open_input(path) as file:
            self._headers, table = parse_flat(file, self.path)
            self.headers = self._headers.parts
            self._where = [part_label(self._headers, part, self.path) for part in range(len(self.headers))]
            self._grids = [_Grid.of(*of_part) for of_part in zip(self.headers, self._where, strict=True)]
            self._offsets = self._by_part(table)
            if not all(offsets.all() for offsets in self._offsets):  # by a writer that was killed
                self._offsets = _walk(file, self._headers, self._grids, self._headers.end + table.nbytes)
                self._require_all_rows()
            self._state = _state(file)

    def _by_part(self, table: NDArray[np.uint64]) -> list[NDArray[np.uint64]]:
        """The full-resolution chunks' offsets, which come first in a part's table."""
        counts = [chunk_count(*of_part) for of_part in zip(self.headers, self._where, strict=True)]
        starts = np.cumsum([0, *counts])
        return [table[start:start + grid.down * grid.across] for start, grid in zip(starts, self._grids, strict=False)]

    def _require_all_rows(self) -> None:
        for where, grid, offsets in zip(self._where, self._grids, self._offsets, strict=True):
            if not offsets.all():
                row = grid.ymin + int(np.argmin(offsets > 0)) // grid.across * grid.rows
                raise InputError(f"{where}: row {row}: missing; the file's writer was stopped, or it is truncated")

    def rows_together(self, part: int) -> int:
        """Rows that are stored together, counted from the top of the data window: reading fewer decodes all."""
        return self._grids[part].rows

    def read(self, part: int, y0: int, y1: int, names: Collection[str]) -> dict[str, Pixels]:
        """Channels of a part in rows y0 to y1 exclusive, in absolute coordinates: name -> (y1 - y0, W).

        Raises InputError when the pixels are corrupt or the file changed, MemoryError when they do not fit.
        """
        window, grid = self.headers[part].data_window, self._grids[part]
        first, last = ((y - window.ymin) // grid.rows for y in (y0, y1 - 1))
        top, bottom = window.ymin + first * grid.rows, min(window.ymin + (last + 1) * grid.rows, window.ymax + 1)
        header = replace(self.headers[part], name="", line_order="increasing", data_window=window.rows(top, bottom))
        if grid.tiled:
            header = replace(header, structure={"tiles": attribute((*header.get("tiles")[:2], 0), "tiledesc")})
        headers = FileHeaders((header,), TILED if grid.tiled else 0, 0)
        (channels,) = decode_with_library(self._small_file(headers, part, range(first, last + 1)), headers, self.path)
        if any(np.shape(channels[name]) != (bottom - top, window.width) for name in names):
            raise InputError(f"{self.path}: the pixels are truncated or corrupt")
        whole = (top, bottom) == (y0, y1)
        return {name: channels[name] if whole else channels[name][y0 - top:y1 - top].copy() for name in names}

    def _small_file(self, headers: FileHeaders, part: int, rows: range) -> BytesIO:
        """An EXR of the one part that `headers` describe, with these rows of chunks of the file's part."""
        where, chunks = self._where[part], []
        grid = _Grid.of(headers.parts[0], where)
        with open_input(self.path) as file:
            if _state(file) != self._state:
                raise InputError(f"{self.path}: was changed while it was read; begin again when its renderer is done")
            for row in rows:
                for column in range(grid.across):
                    leader = np.array(grid.coordinates(row - rows.start, column), "<i4").tobytes()
                    packed = self._packed(file, part, row, column)
                    chunks.append(leader + struct.pack("<I", len(packed)) + packed)
        ends = np.cumsum([0, *map(len, chunks)], dtype=np.uint64)
        table = ends[:-1] + np.uint64(8 * len(chunks))  # as if the table began at byte 0, see FileHeaders.end
        try:
            start = reheaded(headers, table, [bare_header(headers, 0, where)])
        except ValueError as error:
            raise InputError(f"{self.path}: {error}") from error
        return BytesIO(b"".join([start, *chunks]))

    def _packed(self, file: BinaryIO, part: int, row: int, column: int) -> bytes:
        """A chunk's packed pixels. Raises InputError unless they are where the table says."""
        grid = self._grids[part]
        try:
            chunk = _read_leader(file, self._headers, int(self._offsets[part][row * grid.across + column]))
            if chunk is None or (chunk.part, chunk.coordinates) != (part, grid.coordinates(row, column)):
                raise InputError(f"{self._where[part]}: row {grid.ymin + row * grid.rows}: the pixels are truncated or "
                                 f"corrupt: the chunk table is wrong")
            file.seek(chunk.start)
            return file.read(chunk.size)
        except OSError as error:
            raise InputError(f"{self.path}: cannot be read: {error.strerror or error}") from error


def _state(file: BinaryIO) -> tuple[int, ...]:
    """What changes when a file is replaced or written to."""
    found = os.fstat(file.fileno())
    return found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns


def _read_leader(file: BinaryIO, headers: FileHeaders, offset: int) -> _Chunk | None:
    """The chunk that begins at a byte of the file; None where none does that the file holds to its end."""
    file_size = os.fstat(file.fileno()).st_size
    if offset >= file_size:
        return None
    file.seek(offset)
    part = int.from_bytes(file.read(4), "little") if headers.multipart else 0
    if part >= len(headers.parts):
        return None
    layout = struct.Struct("<4iI" if headers.parts[part].type == "tiledimage" else "<iI")
    leader = file.read(layout.size)
    if len(leader) < layout.size:
        return None
    *coordinates, size = layout.unpack(leader)
    start = offset + 4 * headers.multipart + layout.size
    return _Chunk(part, tuple(coordinates), start, size) if size <= file_size - start else None


def _walk(file: BinaryIO, headers: FileHeaders, grids: Sequence[_Grid], position: int) -> list[NDArray[np.uint64]]:
    """The offsets of all parts' full-resolution chunks, found from chunk to chunk; 0 for those that are missing."""
    offsets = [np.zeros(grid.down * grid.across, np.uint64) for grid in grids]
    while chunk := _read_leader(file, headers, position):
        index = grids[chunk.part].index(chunk.coordinates)
        if index is not None:
            offsets[chunk.part][index] = position
        position = chunk.start + chunk.size
    return offsets
