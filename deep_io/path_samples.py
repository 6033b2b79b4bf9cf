"""Deep sample files as the denoiser sees them: weighted path samples with roles, in the project's own conventions.

The last stop of deep_io on the way in. What the channels mean is decoding.py, bytes and compression deep_reader.py.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from deep_io.camera import Camera, parse_camera
from deep_io.decoding import PathSamples, decode_block, interpretation
from deep_io.deep_reader import DEFAULT_BLOCK_BYTES, DeepReader, PathLike
from deep_io.errors import InputError
from deep_io.header import Header
from deep_io.roles import RoleMap
from deep_io.samples import DeepSamples

__all__ = ["PathSamples", "SampleReader"]


class SampleReader:
    """An open deep sample file, read as path samples.

    Parameters
        path       the file
        part       name or index of the deep part; None for the only one
        overrides  role -> layer, see roles.map_roles
        weighting  "uniform", "packed" or "over"; None: the header's lbmc:weighting, else uniform as long as every
                   alpha is 0 or 1
        normals, depth, camera   see conventions.resolve; camera also as the text of `--camera`
        threads    decoding threads, None for one per core
    Raises InputError when the file is unreadable, flat, without R, G, B or without any sample, when two layers match
    one role, when alpha is fractional (on reading) or missing for the weighting, and when a conversion lacks its
    camera. UsageError for options that make no sense.
    """

    def __init__(self, path: PathLike, part: int | str | None = None, overrides: Mapping[str, str] | None = None,
                 weighting: str | None = None, normals: str = "auto", depth: str = "z",
                 camera: Camera | str | None = None, threads: int | None = None) -> None:
        self._reader = DeepReader(path, part, threads)
        try:
            if self._reader.total == 0:
                raise InputError(f"{self._reader.path}: there is no sample anywhere")
            self._interpretation = interpretation(
                self._reader.header, self._reader.path, overrides, weighting, normals, depth,
                parse_camera(camera) if isinstance(camera, str) else camera)
        except BaseException:
            self._reader.close()
            raise

    @property
    def path(self) -> str:
        return self._reader.path

    @property
    def header(self) -> Header:
        return self._reader.header

    @property
    def mapping(self) -> RoleMap:
        """Which channels play which role."""
        return self._interpretation.mapping

    @property
    def weighting(self) -> str:
        """uniform, packed or over."""
        return self._interpretation.weighting

    @property
    def samples_per_row(self) -> NDArray[np.int64]:
        """(H,) stored samples in each row, known without decoding."""
        return self._reader.samples_per_row

    @property
    def total(self) -> int:
        """Stored samples in the file."""
        return self._reader.total

    def read(self, y0: int | None = None, y1: int | None = None) -> PathSamples:
        """Rows y0 to y1 exclusive in absolute pixel coordinates (default: all).

        Raises ValueError for rows outside the data window, InputError for corrupt or unsuitable samples.
        """
        return self._decode(self._reader.read(y0, y1, self.mapping.channels))

    def blocks(self, max_bytes: int = DEFAULT_BLOCK_BYTES) -> Iterator[PathSamples]:
        """The frame in blocks of whole rows from the top; `max_bytes` bounds a block's stored samples."""
        for block in self._reader.blocks(max_bytes, self.mapping.channels):
            yield self._decode(block)

    def _decode(self, deep: DeepSamples) -> PathSamples:
        return decode_block(deep.counts, deep.channels, deep.window, self._interpretation)

    def close(self) -> None:
        """Close the file; the reader is of no use afterwards."""
        self._reader.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self.close()
