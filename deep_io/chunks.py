"""Where the rows of a deep scanline part lie in its file, found and checked before any pixel memory is allocated.

A chunk is one row: [part number int32, in multi-part files] y int32, packed size of the count table u64, packed size
of the samples u64, unpacked size of the samples u64, table, samples. The chunk table lists where chunks begin; a
writer that was killed leaves zeros in it, and then the chunks are found by walking through them.
"""

from __future__ import annotations

import os
import struct
from dataclasses import dataclass
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from deep_io.codec import MAX_RATIO
from deep_io.errors import InputError
from deep_io.header import FileHeaders, Header

_SIZES = struct.Struct("<3Q")
# Bytes between the part number and the sizes in a chunk's leader: y for lines; tile x, y, level x, y for tiles.
_COORDINATES = {"scanlineimage": 4, "deepscanline": 4, "tiledimage": 16, "deeptile": 16}
_RATIO_SLACK = 64  # Streams of a few bytes unpack to a little more than the ratio allows.


@dataclass(frozen=True)
class RowTable:
    """One entry per row of the part, from the top of its data window, all (H,).

    start       int64   where the packed count table begins; the packed samples follow it
    table_size  int64   bytes of the packed count table
    data_size   int64   bytes of the packed samples
    samples     int64   samples in the row
    """

    start: NDArray[np.int64]
    table_size: NDArray[np.int64]
    data_size: NDArray[np.int64]
    samples: NDArray[np.int64]


def chunk_count(header: Header, where: str) -> int:
    """How many chunks the part has. Raises InputError when the header does not say and it cannot be derived."""
    if header.type == "deepscanline":
        height = header.data_window.height
        if header.get("chunkCount", height) != height:
            raise InputError(f"{where}: the header promises {header.get('chunkCount')} chunks for {height} rows")
        return height
    count = header.get("chunkCount")
    if not isinstance(count, int) or count < 0:
        raise InputError(f"{where}: the header has no chunkCount")
    return count


def read_row_table(file: BinaryIO, headers: FileHeaders, part: int, path: str) -> RowTable:
    """Find and check every row of deep scanline part number `part`.

    Raises InputError, naming the file and where possible the row, when the part cannot hold what its header promises,
    a row is missing, doubled or out of the window, or a size does not fit the file.
    """
    file_size = os.fstat(file.fileno()).st_size
    offsets = _read_chunk_table(file, file_size, headers, part, path)
    if (offsets <= 0).any():
        offsets = _walk(file, file_size, headers, part, path)
    leader = 4 * headers.multipart + 4 + _SIZES.size
    return _read_leaders(file, file_size, headers.parts[part], offsets, leader, part_label(headers, part, path))


def check_chunks(file: BinaryIO, headers: FileHeaders, part: int, path: str) -> int:
    """Check the chunk sizes of any deep part, also tiled and ZSTD, against the file; the bytes they unpack to.

    Raises InputError when the part cannot hold what its header promises or a chunk does not fit the file.
    """
    file_size = os.fstat(file.fileno()).st_size
    offsets = _read_chunk_table(file, file_size, headers, part, path)
    header, where = headers.parts[part], part_label(headers, part, path)
    before = 4 * headers.multipart + _COORDINATES[header.type]
    total = 0
    for chunk, offset in enumerate(offsets.tolist()):
        if not 0 < offset <= file_size - before - _SIZES.size:
            raise InputError(f"{where}: chunk {chunk} of {offsets.size} is missing (truncated or corrupt)")
        file.seek(offset + before)
        table_size, data_size, unpacked = _SIZES.unpack(file.read(_SIZES.size))
        if table_size + data_size > file_size - offset - before - _SIZES.size:
            raise InputError(f"{where}: chunk {chunk} runs past the end of the file (truncated or corrupt)")
        if unpacked > MAX_RATIO[header.compression] * data_size + _RATIO_SLACK:
            raise InputError(f"{where}: chunk {chunk} promises more than its packed bytes can hold (corrupt)")
        total += unpacked
    return total


def part_label(headers: FileHeaders, part: int, path: str) -> str:
    """How messages call a part: the file, and the part where there are several."""
    return f"{path}: part {part}" if headers.multipart else path


def _read_chunk_table(file: BinaryIO, file_size: int, headers: FileHeaders, part: int, path: str) -> NDArray[np.int64]:
    """The part's chunk table as stored. Raises InputError when the file cannot hold the pixels the header promises."""
    header, where = headers.parts[part], part_label(headers, part, path)
    position = headers.end
    for index in range(part):
        position += 8 * chunk_count(headers.parts[index], part_label(headers, index, path))
    window, chunks = header.data_window, chunk_count(header, where)
    # The count tables hold 4 bytes per pixel, packed at best at the compression's largest ratio.
    leaders = chunks * (8 + 4 * headers.multipart + _COORDINATES[header.type] + _SIZES.size)
    tables = (4 * window.width * window.height - chunks * _RATIO_SLACK) // MAX_RATIO[header.compression]
    if position + leaders + max(tables, 0) > file_size:
        raise InputError(f"{where}: the header promises {window.width} x {window.height} pixels, more than the file's "
                         f"{file_size} bytes can hold: truncated or corrupt")
    file.seek(position)
    return np.frombuffer(file.read(8 * chunks), "<i8")


def _read_leaders(file: BinaryIO, file_size: int, header: Header, offsets: NDArray[np.int64], leader: int,
                  where: str) -> RowTable:
    window, rows = header.data_window, offsets.size
    table = RowTable(*(np.full(rows, -1, np.int64) for _ in range(4)))
    ratio, sample_bytes = MAX_RATIO[header.compression], header.sample_bytes
    for index, offset in enumerate(offsets.tolist()):
        if not 0 < offset <= file_size - leader:
            raise InputError(f"{where}: row {window.ymin + index}: the chunk table points outside the file "
                             f"(truncated or corrupt)")
        file.seek(offset)
        data = file.read(leader)
        y = struct.unpack_from("<i", data, leader - 28)[0]
        table_size, data_size, unpacked = _SIZES.unpack_from(data, leader - 24)
        row = y - window.ymin
        if not 0 <= row < rows:
            raise InputError(f"{where}: row {window.ymin + index}: its chunk claims to be row {y}, outside the window")
        if table.start[row] >= 0:
            raise InputError(f"{where}: row {y}: stored twice")
        if table_size + data_size > file_size - offset - leader:
            raise InputError(f"{where}: row {y}: runs past the end of the file (truncated or corrupt)")
        if unpacked % sample_bytes or table_size > 4 * window.width:
            raise InputError(f"{where}: row {y}: its sizes do not fit its channels (corrupt)")
        if 4 * window.width > ratio * table_size + _RATIO_SLACK or unpacked > ratio * data_size + _RATIO_SLACK:
            raise InputError(f"{where}: row {y}: promises more than its packed bytes can hold (corrupt)")
        table.start[row], table.table_size[row], table.data_size[row] = offset + leader, table_size, data_size
        table.samples[row] = unpacked // sample_bytes
    return table


def _walk(file: BinaryIO, file_size: int, headers: FileHeaders, part: int, path: str) -> NDArray[np.int64]:
    """The chunk offsets of one part, in file order, by stepping from chunk to chunk behind the chunk tables.

    Raises InputError unless every row of the part is there.
    """
    position = headers.end + 8 * sum(chunk_count(header, part_label(headers, index, path))
                                     for index, header in enumerate(headers.parts))
    window = headers.parts[part].data_window
    found: dict[int, int] = {}
    while len(found) < window.height:
        begin, number = position, 0
        file.seek(position)
        if headers.multipart:
            number = struct.unpack("<i", file.read(4).ljust(4, b"\xff"))[0]
            position += 4
        if not 0 <= number < len(headers.parts):
            break
        header = headers.parts[number]
        coordinates = _COORDINATES.get(header.type, file_size)
        sizes = file.read(coordinates + (_SIZES.size if header.is_deep else 4))
        position += len(sizes)
        if len(sizes) < coordinates + 4 or (header.is_deep and len(sizes) < coordinates + _SIZES.size):
            break
        packed = (sum(_SIZES.unpack_from(sizes, coordinates)[:2]) if header.is_deep
                  else struct.unpack_from("<I", sizes, coordinates)[0])
        if packed > file_size - position:
            break
        position += packed
        y = struct.unpack_from("<i", sizes)[0]
        if number == part:
            if y in found or not window.ymin <= y <= window.ymax:
                break
            found[y] = begin
    missing = next((y for y in range(window.ymin, window.ymax + 1) if y not in found), None)
    if missing is not None:
        raise InputError(f"{path}: row {missing}: missing; the file has {len(found)} of {window.height} rows "
                         f"(its writer was stopped, or it is truncated)")
    return np.fromiter(found.values(), np.int64, len(found))
