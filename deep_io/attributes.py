"""EXR header attributes: the standard types as Python values, every type as its exact bytes.

An `Attribute` keeps the bytes of the file, so that what is not understood is still written back unchanged. How
attributes are strung into a header is header.py's business.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

# Structures of fixed size: the attribute's type -> struct format, little endian.
_PLAIN = {
    "int": "<i", "float": "<f", "double": "<d",
    "v2i": "<2i", "v2f": "<2f", "v2d": "<2d", "v3i": "<3i", "v3f": "<3f", "v3d": "<3d",
    "m33f": "<9f", "m33d": "<9d", "m44f": "<16f", "m44d": "<16d",
    "box2i": "<4i", "box2f": "<4f", "chromaticities": "<8f", "rational": "<iI",
    "keycode": "<7i", "timecode": "<2I", "tiledesc": "<2IB",
    "compression": "<B", "lineOrder": "<B", "envmap": "<B", "deepImageState": "<B",
}
_ARRAYS = {"floatvector": "<f4"}

COMPRESSIONS = ("none", "rle", "zips", "zip", "piz", "pxr24", "b44", "b44a", "dwaa", "dwab", "htj2k256", "htj2k32",
                "lj2k", "zstd")
LINE_ORDERS = ("increasing", "decreasing", "random")


def _strings(data: bytes) -> list[str]:
    """A stringvector: each string follows its length."""
    texts, at = [], 0
    while at < len(data):
        (size,) = struct.unpack_from("<i", data, at)
        if size < 0 or at + 4 + size > len(data):
            raise struct.error("string runs past the attribute")
        texts.append(_text(data[at + 4:at + 4 + size]))
        at += 4 + size
    return texts


def _text(data: bytes) -> str:
    # Bytes that are not UTF-8 survive the round trip as surrogates.
    return data.decode("utf-8", "surrogateescape")


def _bytes(text: str) -> bytes:
    return text.encode("utf-8", "surrogateescape")


_READERS: dict[str, Callable[[bytes], Any]] = {"string": _text, "stringvector": _strings}


@dataclass(frozen=True)
class Attribute:
    """One header attribute: its EXR type name and the bytes of its value exactly as stored."""

    type: str
    data: bytes

    @property
    def value(self) -> Any:
        """The value in Python: numbers, tuples of numbers, str, list of str, or the bytes of a type not known here.

        A matrix is a flat tuple in row order. Bytes too short for their type come back as bytes.
        """
        try:
            if self.type in _PLAIN:
                values = struct.unpack(_PLAIN[self.type], self.data)
                return values[0] if len(values) == 1 else values
            if self.type in _ARRAYS:
                return tuple(np.frombuffer(self.data, _ARRAYS[self.type]).tolist())
            return _READERS[self.type](self.data) if self.type in _READERS else self.data
        except (struct.error, ValueError):
            return self.data


def attribute(value: object, kind: str | None = None) -> Attribute:
    """An Attribute holding `value`, of EXR type `kind`, or the natural one for a Python value.

    str -> string, bool and int -> int, float -> float, list of str -> stringvector, 2 or 3 numbers -> v2i/v2f/v3i/v3f,
    9 or 16 numbers -> m33f/m44f, other tuples of floats -> floatvector. Raises TypeError for anything else.
    """
    if isinstance(value, Attribute):
        return value
    if isinstance(value, np.ndarray | np.generic):
        value = value.ravel().tolist() if isinstance(value, np.ndarray) else value.item()
    kind = kind or _natural_type(value)
    if kind in _PLAIN:
        return Attribute(kind, struct.pack(_PLAIN[kind], *(value if isinstance(value, tuple | list) else (value,))))
    if kind in _ARRAYS:
        return Attribute(kind, np.asarray(value, _ARRAYS[kind]).tobytes())
    if kind == "string" and isinstance(value, str):
        return Attribute(kind, _bytes(value))
    if kind == "stringvector" and isinstance(value, tuple | list):
        texts = [_bytes(text) for text in value]
        return Attribute(kind, b"".join(struct.pack("<i", len(text)) + text for text in texts))
    if isinstance(value, bytes):
        return Attribute(kind, value)
    raise TypeError(f"cannot store {value!r} as an EXR attribute of type {kind!r}")


def _natural_type(value: object) -> str:
    if isinstance(value, str):
        return "string"
    if isinstance(value, int):
        return "int"
    if isinstance(value, float):
        return "float"
    if isinstance(value, tuple | list) and value:
        if all(isinstance(item, str) for item in value):
            return "stringvector"
        if all(isinstance(item, int | float) for item in value):
            suffix = "i" if all(isinstance(item, int) for item in value) else "f"
            return {2: f"v2{suffix}", 3: f"v3{suffix}", 9: "m33f", 16: "m44f"}.get(len(value), "floatvector")
    raise TypeError(f"no EXR attribute type for {value!r}; give its kind")
