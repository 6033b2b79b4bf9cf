"""Deep parts that rows.py does not decode (ZSTD), read whole through the OpenEXR library.

The library makes a Python object per pixel and channel: many times the memory of the samples and ten times the time
of the flat path. A MemoryCostWarning says so before it begins.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from deep_io.chunks import check_chunks, part_label
from deep_io.errors import InputError, MemoryCostWarning
from deep_io.header import FileHeaders
from deep_io.rows import Targets

# What the library holds per pixel and channel besides the values: a NumPy array object and its reference, measured.
_OBJECT_BYTES = 210
# The library's own frame, the arrays made of it and the flat arrays.
_VALUE_COPIES = 3


class LibraryRows:
    """All rows of a deep part, read by the library when it is opened; a RowDecoder of rows.py.

    Raises InputError for a part the file cannot hold or the library cannot read.
    """

    block, task = 1, 64

    def __init__(self, file: BinaryIO, headers: FileHeaders, part: int, path: str) -> None:
        header = headers.parts[part]
        window = header.data_window
        where = part_label(headers, part, path)
        estimate = (check_chunks(file, headers, part, path) * _VALUE_COPIES
                    + window.width * window.height * len(header.channels) * _OBJECT_BYTES)
        warnings.warn(f"{where}: ZSTD deep data is read through the OpenEXR library, the whole frame at once: slow, "
                      f"and takes about {max(estimate >> 20, 1)} MiB of memory; ZIPS would stream",
                      MemoryCostWarning, stacklevel=4)
        arrays = _read(path, part, where)
        if sorted(arrays) != sorted(header.channel_names):
            raise InputError(f"{where}: the OpenEXR library cannot read its pixels (corrupt?)")
        self._counts: NDArray[np.int32] | None = None
        self._values: list[NDArray[np.generic]] = []
        for channel in header.channels:
            objects = arrays.pop(channel.name)
            if objects.shape != (window.height, window.width):
                raise InputError(f"{where}: the OpenEXR library read {objects.shape} pixels of channel {channel.name}")
            counts = np.array([0 if pixel is None else len(pixel) for pixel in objects.ravel()], np.int32)
            if self._counts is None:
                self._counts = counts.reshape(objects.shape)
            elif not np.array_equal(self._counts.ravel(), counts):
                raise InputError(f"{where}: channel {channel.name} has other sample counts than the first channel")
            held = [pixel for pixel in objects.ravel() if pixel is not None and len(pixel)]
            self._values.append(np.concatenate(held).astype(channel.dtype, copy=False) if held
                                else np.empty(0, channel.dtype))
        assert self._counts is not None  # A part has at least one channel.
        self.samples = self._counts.sum(axis=1, dtype=np.int64)
        self._starts = np.concatenate(([0], np.cumsum(self.samples))).tolist()

    def decode(self, rows: range, counts: NDArray[np.int32], targets: Targets, starts: Sequence[int]) -> None:
        """Copy rows out; see rows.RowDecoder."""
        assert self._counts is not None
        counts[:] = self._counts[rows.start:rows.stop]
        begin, end = self._starts[rows.start], self._starts[rows.stop]
        for channel, values in targets:
            values[starts[0]:starts[0] + end - begin] = self._values[channel][begin:end]

    def close(self) -> None:
        """Release the frame."""
        self._counts, self._values = None, []


def _read(path: str, part: int, where: str) -> dict[str, NDArray[Any]]:
    """Channel name -> (H, W) object array of one array per pixel. Raises InputError."""
    import OpenEXR  # 70 ms of start-up that flat files and the scanline path do not need.

    try:
        parts = OpenEXR.File(path, separate_channels=True).parts
        return {name: channel.pixels for name, channel in parts[part].channels.items()}
    except Exception as error:  # The library raises RuntimeError and others of its own; corrupt files leave no parts.
        raise InputError(f"{where}: the OpenEXR library cannot read it: {' '.join(str(error).split())}") from error
