"""Flat EXRs, single- and multi-part, read and written through the OpenEXR library.

Attributes do not go through the library: headers are read and written by header.py, so that a user attribute of any
type survives byte for byte. How the library is made to read is library.py's business, that a file appears whole or
not at all atomic.py's.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, BinaryIO

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from deep_io.attributes import Attribute
from deep_io.errors import InputError
from deep_io.header import FileHeaders, Header, channels_of, open_input, parse_headers
from deep_io.library import read_with_library
from deep_io.reheading import last_flat_chunk_end, read_chunk_table, reheaded
from deep_io.samples import Window

PathLike = str | os.PathLike[str]
Pixels = NDArray[np.generic]

COMPRESSIONS = {
    "none": OpenEXR.NO_COMPRESSION, "rle": OpenEXR.RLE_COMPRESSION, "zips": OpenEXR.ZIPS_COMPRESSION,
    "zip": OpenEXR.ZIP_COMPRESSION, "piz": OpenEXR.PIZ_COMPRESSION, "pxr24": OpenEXR.PXR24_COMPRESSION,
    "b44": OpenEXR.B44_COMPRESSION, "b44a": OpenEXR.B44A_COMPRESSION, "dwaa": OpenEXR.DWAA_COMPRESSION,
    "dwab": OpenEXR.DWAB_COMPRESSION,
}  # fmt: skip

# Attributes that describe an input's pixels or our own job, not the picture: an output does not inherit them.
_NOT_KEPT = ("preview", "deepImageState")
_NOT_KEPT_PREFIX = "lbmc:"
HALF_MAX = 65504.0
_NOT_WHOLE = "the disk took only a part of it; is it full?"


@dataclass(frozen=True)
class FlatImage:
    """One flat part: channels name -> (H, W) float16, float32 or uint32, rows from the top; and its header."""

    channels: dict[str, Pixels]
    header: Header

    @property
    def window(self) -> Window:
        """The pixels' place: the data window."""
        return self.header.data_window

    @classmethod
    def of(cls, channels: Mapping[str, Pixels], like: Header | None = None, name: str = "",
           attributes: Mapping[str, object] | None = None) -> FlatImage:
        """Channels with windows, pixel aspect and kept attributes of `like`, e.g. the header of the input.

        Without `like` the window begins at 0, 0. Raises ValueError when shapes differ from it or each other.
        """
        shapes = {pixels.shape for pixels in channels.values()}
        if len(shapes) != 1 or len(next(iter(shapes))) != 2:
            raise ValueError(f"channels must be of one shape (H, W), not {sorted(shapes)}")
        height, width = next(iter(shapes))
        window = like.data_window if like else Window(0, 0, width - 1, height - 1)
        if (window.height, window.width) != (height, width):
            raise ValueError(f"channels of {width} x {height} pixels do not fit the data window {window}")
        header = Header(channels_of({key: pixels.dtype for key, pixels in channels.items()}), window,
                        like.display_window if like else window, name, "scanlineimage",
                        pixel_aspect=like.pixel_aspect if like else 1.0,
                        attributes=kept_attributes(like) if like else {})
        return cls(dict(channels), header.with_attributes(attributes or {}))


def kept_attributes(header: Header) -> dict[str, Attribute]:
    """The attributes that an output inherits from an input: all but previews, deepImageState and lbmc:*.

    What belongs to the file (type, version, name, chunkCount, tiles, compression, lineOrder, channels,
    maxSamplesPerPixel) is not among a Header's attributes in the first place.
    """
    return {name: value for name, value in header.attributes.items()
            if name not in _NOT_KEPT and not name.startswith(_NOT_KEPT_PREFIX)}


def to_half(values: NDArray[np.floating[Any]]) -> tuple[NDArray[np.float16], int]:
    """Values as half, clamped to its range, and how many had to be. NaN stays NaN."""
    beyond = int(np.count_nonzero(np.abs(values) > HALF_MAX))
    return np.clip(values, -HALF_MAX, HALF_MAX).astype(np.float16), beyond


def read_flat(path: PathLike, part: int | str | None = None) -> FlatImage:
    """One part of a flat EXR; without `part` the first that has R, G and B, else the first.

    Raises InputError when the file is unreadable, corrupt or deep, or has no such part.
    """
    images = read_flat_parts(path)
    if part is None:
        return next((image for image in images if {"R", "G", "B"} <= set(image.channels)), images[0])
    for index, image in enumerate(images):
        if part in (image.header.name, index, str(index)):
            return image
    names = ", ".join(image.header.name or str(index) for index, image in enumerate(images))
    raise InputError(f"{os.fspath(path)}: has no part {part!r}; its parts are {names}")


def read_flat_parts(path: PathLike) -> list[FlatImage]:
    """All parts of a flat EXR.

    Raises InputError when the file is unreadable, corrupt, deep or subsampled, MemoryError when it does not fit.
    """
    name = os.fspath(path)
    with open_input(path) as file:
        headers, _ = parse_flat(file, name)
        parts = read_with_library(file, headers, name)
    images = []
    for header, channels in zip(headers.parts, parts, strict=True):
        shape = (header.data_window.height, header.data_window.width)
        if any(np.shape(pixels) != shape for pixels in channels.values()):
            raise InputError(f"{name}: the pixels are truncated or corrupt")
        images.append(FlatImage(channels, header))
    return images


def parse_flat(file: BinaryIO, path: str) -> tuple[FileHeaders, NDArray[np.uint64]]:
    """A flat EXR's headers and chunk table, checked as far as they can be without decoding a pixel.

    Raises InputError when the file is unreadable, truncated, deep or subsampled.
    """
    headers = parse_headers(file, path)
    if any(header.is_deep for header in headers.parts):
        raise InputError(f"{path}: is a deep EXR where a flat one is needed")
    if any(channel.sampling != (1, 1) for header in headers.parts for channel in header.channels):
        raise InputError(f"{path}: has subsampled channels; convert it to full resolution")
    table = read_chunk_table(file, headers, path)
    if last_flat_chunk_end(file, headers, table) > os.fstat(file.fileno()).st_size:
        raise InputError(f"{path}: the pixels are truncated or corrupt: they run past the end of the file")
    return headers, table


def write_flat(path: PathLike, channels: Mapping[str, Pixels], header: Header | None = None, compression: str = "zip",
               attributes: Mapping[str, object] | None = None) -> None:
    """Write one flat part.

    channels     name -> (H, W) float16, float32 or uint32
    header       of the input: windows, pixel aspect and attributes are kept (see kept_attributes)
    compression  a key of COMPRESSIONS
    attributes   more attributes, plain Python values or deep_io.attributes.Attribute
    Raises ValueError for channels or a compression that cannot be written, OSError from the disk.
    """
    write_flat_parts(path, [FlatImage.of(channels, header, attributes=attributes)], compression)


def write_flat_parts(path: PathLike, images: Sequence[FlatImage], compression: str = "zip") -> None:
    """Write flat parts into one file; several need distinct names. The same input gives the same bytes.

    Raises ValueError for parts that cannot be written, OSError from the disk.
    """
    if compression not in COMPRESSIONS:
        raise ValueError(f"flat files are written with {', '.join(COMPRESSIONS)}, not {compression!r}")
    names = [image.header.name for image in images]
    if not images or (len(images) > 1 and (len(set(names)) != len(names) or "" in names)):
        raise ValueError(f"the parts of a file need distinct names, not {names}")
    parts = [OpenEXR.Part(_library_header(image.header, compression),
                          {name: np.ascontiguousarray(pixels) for name, pixels in image.channels.items()},
                          image.header.name) for image in images]
    try:
        OpenEXR.File(parts).write(os.fspath(path))
    except RuntimeError as error:
        raise OSError(f"{os.fspath(path)}: {error}") from error
    _set_attributes(path, images)


def _library_header(header: Header, compression: str) -> dict[str, Any]:
    def box(window: Window) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        return np.array([window.xmin, window.ymin], np.int32), np.array([window.xmax, window.ymax], np.int32)

    return {"compression": COMPRESSIONS[compression], "type": OpenEXR.scanlineimage,
            "dataWindow": box(header.data_window), "displayWindow": box(header.display_window),
            "pixelAspectRatio": float(header.pixel_aspect)}


def _set_attributes(path: PathLike, images: Sequence[FlatImage]) -> None:
    """Give the headers of a finished file all the attributes of `images`. Raises OSError where it is not whole.

    The library does not notice when the disk takes no more while it flushes its last bytes.
    """
    name = os.fspath(path)
    with open(path, "r+b") as file:
        try:
            written = parse_headers(file, name)
            table = read_chunk_table(file, written, name)
        except InputError as error:
            raise OSError(_NOT_WHOLE) from error
        if last_flat_chunk_end(file, written, table) != os.fstat(file.fileno()).st_size:
            raise OSError(_NOT_WHOLE)
        headers = [replace(mine, attributes={**mine.attributes, **image.header.attributes})
                   for mine, image in zip(written.parts, images, strict=True)]
        file.seek(written.end + table.nbytes)
        chunks = file.read()
        file.seek(0)
        file.write(reheaded(written, table, headers))
        file.write(chunks)
        file.truncate()
