"""Where the chunks of a deep part lie in its file, found and checked before any pixel memory is allocated.

A chunk is one row or one tile: [part number int32, in multi-part files] y int32, or tile x, tile y, level x, level y
int32; packed size of the count table u64, packed size of the samples u64, unpacked size of the samples u64; table;
samples. The chunk table lists where chunks begin; a writer that was killed leaves zeros in it, and then the rows are
found by walking through the chunks.
"""

from __future__ import annotations

import os
import struct
from dataclasses import dataclass
from operator import mul
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from deep_io.codec import MAX_RATIO
from deep_io.errors import InputError
from deep_io.header import FileHeaders, Header
from deep_io.samples import Window

_SIZES = struct.Struct("<3Q")
# Bytes between the part number and the sizes in a chunk's leader.
_COORDINATES = {"scanlineimage": 4, "deepscanline": 4, "tiledimage": 16, "deeptile": 16}
# Rows of a flat scanline part that are stored together.
_ROWS_PER_CHUNK = {"none": 1, "rle": 1, "zips": 1, "zip": 16, "piz": 32, "pxr24": 16, "b44": 32, "b44a": 32,
                   "dwaa": 32, "dwab": 256, "htj2k256": 256, "htj2k32": 32, "lj2k": 256, "zstd": 1}
_RATIO_SLACK = 64        # Streams of a few bytes unpack to a little more than the ratio allows.
MAX_CHUNK = 2**31 - 1    # OpenEXR's own limit, packed and unpacked.


@dataclass(frozen=True)
class Chunk:
    """One chunk: where its packed count table begins, and the sizes in bytes; the packed samples follow the table."""

    coordinates: tuple[int, ...]
    start: int
    table_size: int
    data_size: int
    unpacked: int


@dataclass(frozen=True)
class Tile:
    """A chunk of a tiled part and the pixels it covers, in absolute coordinates."""

    chunk: Chunk
    window: Window


def chunk_count(header: Header, where: str) -> int:
    """How many chunks the part has. Raises InputError when the header does not say and it cannot be derived."""
    height, count = header.data_window.height, header.get("chunkCount")
    if header.type == "deepscanline":
        if count is not None and count != height:
            raise InputError(f"{where}: the header promises {count} chunks for {height} rows")
        return height
    if header.type == "tiledimage":
        return _tile_count(header, where)
    if header.type == "scanlineimage" and header.compression in _ROWS_PER_CHUNK:
        return -(-height // _ROWS_PER_CHUNK[header.compression])
    if not isinstance(count, int) or count < 0:
        raise InputError(f"{where}: the header has no chunkCount")
    return count


def flat_chunk_rows(header: Header, where: str) -> int:
    """Rows that a flat part stores together: of a chunk of scanlines, or of a tile. Raises InputError."""
    if header.type == "tiledimage":
        return tile_description(header, where)[1]
    if header.type != "scanlineimage" or header.compression not in _ROWS_PER_CHUNK:
        raise InputError(f"{where}: the header's type is {header.type} and its compression {header.compression}, which "
                         f"lbmc cannot read")
    return _ROWS_PER_CHUNK[header.compression]


def tile_description(header: Header, where: str) -> tuple[int, int, int]:
    """A tile's width and height, and the byte that says which levels there are. Raises InputError."""
    tiles = header.structure.get("tiles")
    if tiles is None or tiles.type != "tiledesc" or not isinstance(tiles.value, tuple):
        raise InputError(f"{where}: the header's tiles are missing or corrupt")
    width, height, levels = tiles.value
    if not 0 < min(width, height) <= max(width, height) < 2**31:
        raise InputError(f"{where}: the header's tiles are corrupt: {width} x {height}")
    return width, height, levels


def _tile_count(header: Header, where: str) -> int:
    """Tiles of all levels: of the picture alone, of a mipmap, or of a ripmap, which has every pair of sizes."""
    *tile, levels = tile_description(header, where)
    kind, rounds_up = levels & 0xF, bool(levels >> 4)
    if kind > 2:
        raise InputError(f"{where}: the header's tiles are corrupt: levels of kind {kind}")

    def across(extent: int, size: int, largest: int) -> list[int]:
        """Tiles along one axis in each level, down to where `largest` pixels have become one."""
        count = 1 + ((largest - 1).bit_length() if rounds_up else largest.bit_length() - 1)
        extents = [max(-(-extent >> level) if rounds_up else extent >> level, 1) for level in range(count)]
        return [-(-extent // size) for extent in extents]

    width, height = header.data_window.width, header.data_window.height
    if kind == 2:
        return sum(across(width, tile[0], width)) * sum(across(height, tile[1], height))
    largest = max(width, height) if kind else 1
    return sum(map(mul, across(width, tile[0], largest), across(height, tile[1], largest)))


def read_rows(file: BinaryIO, headers: FileHeaders, part: int, path: str) -> list[Chunk]:
    """The chunks of a deep scanline part, one for each row, from the top of its data window.

    Raises InputError, naming the file and where possible the row, when the part cannot hold what its header promises,
    a row is missing, doubled or out of the window, or a size does not fit the file.
    """
    header, where = headers.parts[part], part_label(headers, part, path)
    file_size = os.fstat(file.fileno()).st_size
    offsets = _read_chunk_table(file, file_size, headers, part, path)
    if (offsets <= 0).any():
        offsets = _walk(file, file_size, headers, part, path)
    window = header.data_window
    rows: dict[int, Chunk] = {}
    for index, offset in enumerate(offsets.tolist()):
        chunk = _read_leader(file, file_size, headers, part, offset, f"{where}: row {window.ymin + index}")
        (y,) = chunk.coordinates
        if not window.ymin <= y <= window.ymax:
            raise InputError(f"{where}: row {window.ymin + index}: its chunk claims to be row {y}, outside the window")
        if y in rows:
            raise InputError(f"{where}: row {y}: stored twice")
        _check_sizes(chunk, window.width, header, file_size, f"{where}: row {y}")
        rows[y] = chunk
    return [rows[y] for y in range(window.ymin, window.ymax + 1)]


def read_tiles(file: BinaryIO, headers: FileHeaders, part: int, path: str, size: tuple[int, int]) -> list[list[Tile]]:
    """The tiles of a deep tiled part's full-resolution level, row of tiles by row of tiles; `size` is theirs in pixels.

    Raises InputError as read_rows does; an unfinished tiled file is not repaired.
    """
    header, where = headers.parts[part], part_label(headers, part, path)
    file_size = os.fstat(file.fileno()).st_size
    offsets = _read_chunk_table(file, file_size, headers, part, path)
    window = header.data_window
    across, down = -(-window.width // size[0]), -(-window.height // size[1])
    if across * down > offsets.size:
        raise InputError(f"{where}: {across} x {down} tiles do not fit the header's {offsets.size} chunks (corrupt)")
    tiles: dict[tuple[int, int], Tile] = {}
    for index, offset in enumerate(offsets.tolist()):
        chunk = _read_leader(file, file_size, headers, part, offset, f"{where}: tile {index} of {offsets.size}")
        x, y, *level = chunk.coordinates
        if level != [0, 0]:  # A smaller copy of the picture.
            continue
        if not (0 <= x < across and 0 <= y < down):
            raise InputError(f"{where}: tile {index} of {offsets.size} claims to be tile {x}, {y}, outside the window")
        left, top = window.xmin + x * size[0], window.ymin + y * size[1]
        covers = Window(left, top, min(left + size[0] - 1, window.xmax), min(top + size[1] - 1, window.ymax))
        if (y, x) in tiles:
            raise InputError(f"{where}: row {top}: tile {x}, {y} is stored twice")
        # OpenEXR stores an uncompressed count table in full length where the window's edge cuts the tile.
        spare = 4 * (size[0] * size[1] - covers.width * covers.height)
        label = f"{where}: row {top}: tile {x}, {y}"
        _check_sizes(chunk, covers.width * covers.height, header, file_size, label, spare)
        tiles[y, x] = Tile(chunk, covers)
    missing = next(((x, y) for y in range(down) for x in range(across) if (y, x) not in tiles), None)
    if missing is not None:
        x, y = missing
        raise InputError(f"{where}: row {window.ymin + y * size[1]}: tile {x}, {y} is missing (truncated or corrupt)")
    return [[tiles[y, x] for x in range(across)] for y in range(down)]


def _read_leader(file: BinaryIO, file_size: int, headers: FileHeaders, part: int, offset: int, label: str) -> Chunk:
    coordinates = _COORDINATES[headers.parts[part].type]
    before = 4 * headers.multipart
    start = offset + before + coordinates + _SIZES.size
    if not 0 < offset <= start <= file_size:
        raise InputError(f"{label}: the chunk table points outside the file (truncated or corrupt)")
    file.seek(offset)
    data = file.read(start - offset)
    if before and struct.unpack_from("<i", data)[0] != part:
        raise InputError(f"{label}: its chunk belongs to another part (corrupt)")
    return Chunk(struct.unpack_from(f"<{coordinates // 4}i", data, before), start,
                 *_SIZES.unpack_from(data, before + coordinates))


def _check_sizes(chunk: Chunk, pixels: int, header: Header, file_size: int, label: str, spare: int = 0) -> None:
    """Refuse sizes beyond the file, and contents that no packed data of that size can stand for."""
    ratio = MAX_RATIO[header.compression]
    if chunk.table_size + chunk.data_size > file_size - chunk.start:
        raise InputError(f"{label}: runs past the end of the file (truncated or corrupt)")
    if (chunk.unpacked % header.sample_bytes or max(chunk.unpacked, chunk.data_size, chunk.table_size) > MAX_CHUNK
            or chunk.table_size > 4 * pixels + spare):
        raise InputError(f"{label}: its sizes do not fit its channels (corrupt)")
    if (chunk.unpacked > ratio * chunk.data_size + _RATIO_SLACK
            or 4 * pixels > ratio * chunk.table_size + _RATIO_SLACK):
        raise InputError(f"{label}: promises more than its packed bytes can hold (corrupt)")


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
