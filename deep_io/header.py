"""EXR headers: parsed without touching pixels and encoded again, for single- and multi-part files.

Works for every kind of EXR, flat ones too. Attribute values are attributes.py; chunks and pixels are chunks.py and
the readers.
"""

from __future__ import annotations

import math
import os
import stat
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import DTypeLike

from deep_io.attributes import COMPRESSIONS, LINE_ORDERS, Attribute, attribute
from deep_io.errors import InputError
from deep_io.samples import DeepSamples, Window

MAGIC = 20000630
FORMAT_VERSION = 2
TILED, LONG_NAMES, NON_IMAGE, MULTI_PART = 0x200, 0x400, 0x800, 0x1000
FARTHEST = 2**30 - 1  # OpenEXR's own limit of a window's bounds
SHORT_NAME_BYTES, LONG_NAME_BYTES = 31, 255

PIXEL_TYPES = (np.dtype("<u4"), np.dtype("<f2"), np.dtype("<f4"))
DEEP_TYPES = ("deepscanline", "deeptile")

# Attributes that say how the file is laid out; they never travel from an input to an output.
STRUCTURE = ("chunkCount", "version", "maxSamplesPerPixel", "tiles")


@dataclass(frozen=True)
class Channel:
    """One channel of a part: its full name ("ViewLayer.Depth.Z"), type (float16, float32, uint32) and subsampling."""

    name: str
    dtype: np.dtype[Any]
    sampling: tuple[int, int] = (1, 1)
    linear: bool = False


@dataclass(frozen=True)
class Header:
    """One part's header.

    type is "scanlineimage", "tiledimage", "deepscanline" or "deeptile"; compression and line_order are the names of
    attributes.py ("unknown(N)" for a number without a name). `attributes` holds everything that describes the
    picture, `structure` what describes the file (chunkCount, version, maxSamplesPerPixel, tiles).
    """

    channels: tuple[Channel, ...]
    data_window: Window
    display_window: Window
    name: str = ""
    type: str = "deepscanline"
    compression: str = "zips"
    pixel_aspect: float = 1.0
    line_order: str = "increasing"
    attributes: Mapping[str, Attribute] = field(default_factory=dict)
    structure: Mapping[str, Attribute] = field(default_factory=dict)

    @property
    def is_deep(self) -> bool:
        return self.type in DEEP_TYPES

    @property
    def channel_names(self) -> tuple[str, ...]:
        return tuple(channel.name for channel in self.channels)

    @property
    def sample_bytes(self) -> int:
        """Bytes of one sample, all channels together."""
        return sum(channel.dtype.itemsize for channel in self.channels)

    def get(self, name: str, default: Any = None) -> Any:
        """The Python value of an attribute, or `default` where the header has none of that name."""
        found = self.attributes.get(name, self.structure.get(name))
        return default if found is None else found.value

    def with_attributes(self, values: Mapping[str, object]) -> Header:
        """A copy with attributes added or replaced; plain Python values take their natural EXR type."""
        return replace(self, attributes={**self.attributes, **{name: attribute(v) for name, v in values.items()}})

    @classmethod
    def of_samples(cls, samples: DeepSamples, display_window: Window | None = None,
                   attributes: Mapping[str, object] | None = None) -> Header:
        """A deep scanline header for samples held in memory; the display window defaults to the data window."""
        return cls(channels_of({name: values.dtype for name, values in samples.channels.items()}), samples.window,
                   display_window or samples.window).with_attributes(attributes or {})


@dataclass(frozen=True)
class FileHeaders:
    """All headers of a file, and where they end: the chunk tables begin at byte `end`."""

    parts: tuple[Header, ...]
    flags: int
    end: int

    @property
    def multipart(self) -> bool:
        return bool(self.flags & MULTI_PART)


def channels_of(dtypes: Mapping[str, DTypeLike]) -> tuple[Channel, ...]:
    """Channels for names and types, in the order of the file: sorted by the bytes of the name.

    Raises ValueError for a type other than float16, float32 and uint32.
    """
    for name, dtype in dtypes.items():
        if np.dtype(dtype) not in PIXEL_TYPES:
            raise ValueError(f"channel {name!r} is {np.dtype(dtype)}; EXR holds float16, float32 and uint32")
    return tuple(Channel(name, np.dtype(dtypes[name])) for name in sorted(dtypes, key=_encode))


def read_headers(path: str | os.PathLike[str]) -> list[Header]:
    """The headers of all parts of an EXR, without reading pixels. Raises InputError."""
    with open_input(path) as file:
        return list(parse_headers(file, os.fspath(path)).parts)


def open_input(path: str | os.PathLike[str]) -> BinaryIO:
    """Open a file for reading, with an InputError in place of an OSError and for what cannot be read back and forth."""
    try:
        # Opening a pipe would wait for its writer, for ever if there is none.
        if not stat.S_ISREG(os.stat(path).st_mode):
            if os.path.isdir(path):
                raise InputError(f"{os.fspath(path)}: is a folder; name an EXR file")
            raise InputError(f"{os.fspath(path)}: is a pipe or a device, but an EXR is read back and forth; write it "
                             f"to a file first")
        return open(path, "rb")  # The caller closes it.
    except OSError as error:
        raise InputError(f"{os.fspath(path)}: cannot be opened: {error.strerror or error}") from error


def parse_headers(file: BinaryIO, path: str) -> FileHeaders:
    """Parse magic, version and all part headers from the start of `file`. Raises InputError naming `path`."""
    cursor = _Cursor(file, path)
    start = cursor.take(8) if cursor.size >= 8 else b""
    if len(start) < 8 or struct.unpack("<i", start[:4])[0] != MAGIC:
        raise InputError(f"{path}: not an EXR file")
    flags = struct.unpack("<I", start[4:])[0]
    known = TILED | LONG_NAMES | NON_IMAGE | MULTI_PART
    if flags & 0xFF != FORMAT_VERSION or flags & ~(0xFF | known):
        raise InputError(f"{path}: EXR version field {flags:#x} is not known to lbmc")
    parts: list[Header] = []
    while True:
        raw = _raw_attributes(cursor)
        if not raw and flags & MULTI_PART and parts:
            break
        parts.append(_header(raw, flags, path, len(parts)))
        if not flags & MULTI_PART:
            break
    return FileHeaders(tuple(parts), flags, cursor.position)


class _Cursor:
    """Reads forward through a file and never asks for more than the file holds."""

    def __init__(self, file: BinaryIO, path: str) -> None:
        self.file, self.path = file, path
        self.size = os.fstat(file.fileno()).st_size
        self.position = 0
        file.seek(0)

    def take(self, count: int) -> bytes:
        if count < 0 or count > self.size - self.position:
            raise InputError(f"{self.path}: the header is truncated or corrupt at byte {self.position}")
        data = self.file.read(count)
        if len(data) != count:
            raise InputError(f"{self.path}: cannot be read at byte {self.position}")
        self.position += count
        return data

    def name(self) -> str:
        """A null-terminated name of at most 255 bytes."""
        window = self.file.read(LONG_NAME_BYTES + 1)
        end = window.find(b"\0")
        if end < 0:
            raise InputError(f"{self.path}: the header is corrupt: a name at byte {self.position} does not end")
        self.position += end + 1
        self.file.seek(self.position)
        return _decode(window[:end])


def _raw_attributes(cursor: _Cursor) -> dict[str, Attribute]:
    found: dict[str, Attribute] = {}
    while name := cursor.name():
        kind = cursor.name()
        (size,) = struct.unpack("<i", cursor.take(4))
        if name in found:
            raise InputError(f"{cursor.path}: the header is corrupt: attribute {name!r} appears twice")
        found[name] = Attribute(kind, cursor.take(size))
    return found


def _header(raw: dict[str, Attribute], flags: int, path: str, index: int) -> Header:
    where = f"{path}: part {index}" if flags & MULTI_PART else path

    def required(name: str, kind: str) -> Any:
        found = raw.pop(name, None)
        if found is None:
            raise InputError(f"{where}: the header has no {name}")
        if found.type != kind or (kind != "chlist" and isinstance(found.value, bytes)):
            raise InputError(f"{where}: the header's {name} is corrupt")
        return found.data if kind == "chlist" else found.value

    def window(name: str) -> Window:
        box = Window(*required(name, "box2i"))
        if box.width < 1 or box.height < 1:
            raise InputError(f"{where}: the header's {name} is empty: {box}")
        if min(box.xmin, box.ymin) <= -FARTHEST or max(box.xmax, box.ymax) >= FARTHEST:
            raise InputError(f"{where}: the header's {name} is beyond what EXR allows: {box}")
        return box

    pixel_aspect = float(required("pixelAspectRatio", "float"))
    if not 0 < pixel_aspect < math.inf:
        raise InputError(f"{where}: the header's pixelAspectRatio is {pixel_aspect}; it must be positive and finite")
    kind = raw.pop("type").value if "type" in raw else ("tiledimage" if flags & TILED else "scanlineimage")
    if flags & NON_IMAGE and not flags & MULTI_PART and kind not in DEEP_TYPES:
        raise InputError(f"{where}: the file says it is deep and its header's type is {kind!r}")
    return Header(
        channels=_channels(required("channels", "chlist"), where),
        data_window=window("dataWindow"),
        display_window=window("displayWindow"),
        name=str(raw.pop("name").value) if "name" in raw else "",
        type=str(kind),
        compression=_named(COMPRESSIONS, required("compression", "compression")),
        pixel_aspect=pixel_aspect,
        line_order=_named(LINE_ORDERS, required("lineOrder", "lineOrder")),
        structure={name: raw.pop(name) for name in STRUCTURE if name in raw},
        attributes=raw,
    )


def _named(names: tuple[str, ...], number: int) -> str:
    return names[number] if number < len(names) else f"unknown({number})"


def _channels(data: bytes, where: str) -> tuple[Channel, ...]:
    """A chlist: per channel name, type int32, linear uint8, 3 spare bytes, x and y sampling int32; then a null."""
    channels: list[Channel] = []
    at = 0
    while True:
        end = data.find(b"\0", at)
        if end == at and end == len(data) - 1:
            break
        if end <= at or end + 17 > len(data) or end - at > LONG_NAME_BYTES:
            raise InputError(f"{where}: the header's channel list is corrupt")
        kind, linear, xs, ys = struct.unpack_from("<iB3x2i", data, end + 1)
        if kind not in range(len(PIXEL_TYPES)) or xs < 1 or ys < 1:
            raise InputError(f"{where}: the header's channel list is corrupt")
        channels.append(Channel(_decode(data[at:end]), PIXEL_TYPES[kind], (xs, ys), bool(linear)))
        at = end + 17
    channels.sort(key=lambda channel: _encode(channel.name))  # Pixel data is in this order whatever the list's.
    if len({channel.name for channel in channels}) != len(channels):
        raise InputError(f"{where}: the header names a channel twice")
    return tuple(channels)


def encode_header(header: Header) -> bytes:
    """A header's bytes, terminating null included; attributes in alphabetical order. Raises ValueError."""
    box = "box2i"
    table: dict[str, Attribute] = {**header.attributes, **header.structure}
    table.setdefault("screenWindowCenter", attribute((0.0, 0.0), "v2f"))
    table.setdefault("screenWindowWidth", attribute(1.0, "float"))
    table.update({
        "channels": Attribute("chlist", _chlist(header.channels)),
        "compression": attribute(COMPRESSIONS.index(header.compression), "compression"),
        "dataWindow": attribute(_corners(header.data_window), box),
        "displayWindow": attribute(_corners(header.display_window), box),
        "lineOrder": attribute(LINE_ORDERS.index(header.line_order), "lineOrder"),
        "pixelAspectRatio": attribute(header.pixel_aspect, "float"),
        "type": attribute(header.type, "string"),
    })
    if header.name:
        table["name"] = attribute(header.name, "string")
    parts = []
    for name in sorted(table):
        stored = table[name]
        parts += [_terminated(name), _terminated(stored.type), struct.pack("<i", len(stored.data)), stored.data]
    return b"".join(parts) + b"\0"


def needs_long_names(header: Header) -> bool:
    """Whether any name in the header is longer than old readers allow (the file's LONG_NAMES flag)."""
    names = [*header.channel_names, *header.attributes, *(stored.type for stored in header.attributes.values())]
    return any(len(_encode(name)) > SHORT_NAME_BYTES for name in names)


def _chlist(channels: tuple[Channel, ...]) -> bytes:
    ordered = sorted(channels, key=lambda channel: _encode(channel.name))
    return b"".join(_terminated(channel.name) + struct.pack("<iB3x2i", PIXEL_TYPES.index(channel.dtype),
                                                            channel.linear, *channel.sampling)
                    for channel in ordered) + b"\0"


def _corners(window: Window) -> tuple[int, int, int, int]:
    return window.xmin, window.ymin, window.xmax, window.ymax


def _terminated(name: str) -> bytes:
    data = _encode(name)
    if not 0 < len(data) <= LONG_NAME_BYTES or b"\0" in data:
        raise ValueError(f"{name!r} cannot be a name in an EXR header: 1 to {LONG_NAME_BYTES} bytes, no null")
    return data + b"\0"


def _encode(name: str) -> bytes:
    return name.encode("utf-8", "surrogateescape")


def _decode(data: bytes) -> str:
    return data.decode("utf-8", "surrogateescape")
