"""An EXR under other headers: its chunk table is moved along, its chunks stay as they are.

What the headers hold is the business of those who change them; where deep chunks lie is chunks.py's.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from deep_io.attributes import COMPRESSIONS, LINE_ORDERS, attribute
from deep_io.chunks import chunk_count, part_label
from deep_io.errors import InputError
from deep_io.header import FORMAT_VERSION, LONG_NAMES, MAGIC, FileHeaders, Header, encode_header, needs_long_names

_UNDECODED = ("\udc80", "\udcff")  # how the bytes that are not UTF-8 look in a name, see header.py


def read_chunk_table(file: BinaryIO, headers: FileHeaders, path: str) -> NDArray[np.uint64]:
    """The offsets of all parts' chunks, part after part. Raises InputError when the file is shorter than that."""
    size = 8 * sum(chunk_count(part, part_label(headers, index, path)) for index, part in enumerate(headers.parts))
    file_size = os.fstat(file.fileno()).st_size
    if size > file_size - headers.end:
        raise InputError(f"{path}: the headers promise {size // 8} chunks, more than the file's {file_size} bytes "
                         f"can hold: truncated or corrupt")
    file.seek(headers.end)
    return np.frombuffer(file.read(size), "<u8")


def reheaded(headers: FileHeaders, table: NDArray[np.uint64], parts: Sequence[Header]) -> bytes:
    """The start of the file with the headers `parts`, up to where the chunks begin. Raises ValueError for a bad name.

    Zeros in the table, which the writer did not come to fill in, stay.
    """
    flags = headers.flags | (LONG_NAMES if any(map(needs_long_names, parts)) else 0)
    start = np.array([MAGIC, flags & ~0xFF | FORMAT_VERSION], "<u4").tobytes()
    encoded = b"".join([start, *map(encode_header, parts), b"\0" if headers.multipart else b""])
    # Unsigned arithmetic wraps around, so a header that got shorter is fine too.
    moved = np.where(table > 0, table + np.uint64((len(encoded) - headers.end) % 2**64), np.uint64(0))
    return encoded + moved.astype("<u8").tobytes()


def bare_header(headers: FileHeaders, index: int, path: str) -> Header:
    """A part's header with what decoding its pixels takes, and nothing that could keep a library from it.

    Channels whose names are not all UTF-8 get names that are and sort and split at dots the same: DWA goes by that.
    Raises InputError for a part whose pixels cannot be told.
    """
    header, where = headers.parts[index], part_label(headers, index, path)
    for what, value, known in (("compression", header.compression, COMPRESSIONS),
                               ("lineOrder", header.line_order, LINE_ORDERS)):
        if value not in known:
            raise InputError(f"{where}: the header's {what} is {value}, which lbmc cannot read")
    structure = {"chunkCount": attribute(chunk_count(header, where))}
    if header.type in ("tiledimage", "deeptile"):
        structure["tiles"] = header.structure["tiles"]
    if header.is_deep:
        structure["version"] = attribute(1)
    channels = header.channels
    if any(_UNDECODED[0] <= letter <= _UNDECODED[1] for letter in "".join(header.channel_names)):
        channels = tuple(replace(channel, name=channel.name.encode("utf-8", "surrogateescape").decode("latin-1"))
                         for channel in channels)
    return replace(header, channels=channels, name=str(index) if headers.multipart else "", attributes={},
                   structure=structure)


def last_flat_chunk_end(file: BinaryIO, headers: FileHeaders, table: NDArray[np.uint64]) -> int:
    """Where the flat chunk ends that lies last in the file: beyond the file where the table points there, 0 without."""
    last = int(table.max(initial=0))
    if not last or last >= os.fstat(file.fileno()).st_size:
        return last + bool(last)
    file.seek(last)
    number = int.from_bytes(file.read(4), "little") if headers.multipart else 0
    tiled = headers.parts[number].type == "tiledimage" if number < len(headers.parts) else False
    file.seek(16 if tiled else 4, os.SEEK_CUR)  # tile and level, or y
    packed = int.from_bytes(file.read(4), "little")
    return file.tell() + packed
