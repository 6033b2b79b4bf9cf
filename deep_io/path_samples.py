"""Deep sample files as the denoiser sees them: weighted path samples with roles, in the project's own conventions.

The last stop of deep_io on the way in. What the channels mean is decoding.py, bytes and compression deep_reader.py.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
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


# A block's samples at most: decoding `over` takes about 200 bytes for each while it runs.
MAX_BLOCK_SAMPLES = 1 << 21


class SampleReader:
    """An open deep sample file, read as path samples.

    The file: a deep EXR in which every deep sample is one path sample; a pixel may hold any number, also none. What
    `lbmc` itself writes, and what it reads without any option:

        channel            type        role and meaning
        R G B              half/float  radiance    linear, of the path; the only one required
        A                  half/float  coverage    1 hit, 0 miss, fractions for opacity; without A: 1 where Z < 1e10
        Z                  float       depth       planar, camera space; a miss has 1e10 or more, also under A = 1
        N.X N.Y N.Z        half/float  normal      shading normal, view space: x right, y up, z toward the camera
        albedo.R .G .B     half/float  albedo      diffuse albedo
        specular.R .G .B   half/float  specular    specular colour (F0)
        roughness          half/float  roughness   0..1
        motion.X motion.Y  half/float  motion      over the whole shutter, pixels, x right, y down
        coc                half/float  coc         signed circle-of-confusion radius, pixels, + behind the focus plane
        lens.X lens.Y      half/float  lens        on the unit disk; pixel = pinhole projection - coc * lens
        time               half/float  time        0..1 within the shutter

        attribute           value
        lbmc:weighting      "uniform" (the default), "packed" or "over"; see weighting.py and over.py
        lbmc:normals        "world" where N could not be turned into view space; worldToCamera or --camera is needed
        lbmc:depth          "distance" where Z is the length of the ray; "none" where Z only orders the samples
        lbmc:radianceLayers the layers of a packed file that are encoded as radiance is

    Other channel names are understood through aliases.py. Features of a miss are never read.

    Parameters
        path       the file
        part       name or index of the deep part; None for the only one
        overrides  role -> layer, see role_matching.map_roles
        weighting  "uniform", "packed" or "over"; None: the header's lbmc:weighting, else uniform as long as every
                   alpha is 0 or 1
        normals, depth, camera   see conventions.resolve; camera also as the text of `--camera`
        threads    decoding threads, None for one per core
    Raises InputError when the file is unreadable, flat, without R, G, B or without any sample (but under "over", where
    that is an empty picture), when two layers match one role, when alpha is fractional (on reading) or missing for the
    weighting, and when a conversion lacks its camera. UsageError for options that make no sense.
    """

    def __init__(self, path: PathLike, part: int | str | None = None, overrides: Mapping[str, str] | None = None,
                 weighting: str | None = None, normals: str = "auto", depth: str = "auto",
                 camera: Camera | str | None = None, threads: int | None = None) -> None:
        self._reader = DeepReader(path, part, threads)
        try:
            self._interpretation = interpretation(
                self._reader.header, self._reader.path, overrides, weighting, normals, depth,
                parse_camera(camera) if isinstance(camera, str) else camera)
            if self._reader.total == 0 and self.weighting != "over":
                raise InputError(f"{self._reader.path}: there is no sample anywhere")
        except BaseException:
            self._reader.close()
            raise

    @property
    def path(self) -> str:
        return self._reader.path

    @property
    def part(self) -> int:
        """The number of the part that is read."""
        return self._reader.part

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

    def carry(self, lights: Iterable[str] = (), data: Iterable[str] = ()) -> None:
        """Channels to read into PathSamples.extra from now on: parts of the radiance, then anything else.

        Raises KeyError for a channel that does not exist.
        """
        lights, data = tuple(lights), tuple(data)
        types = {channel.name: channel.dtype for channel in self.header.channels}
        for name in (*lights, *data):
            types[name]
        self._interpretation = replace(self._interpretation, lights=lights, data=data)

    @property
    def carried(self) -> int:
        """How many channels are carried along."""
        return len(self._interpretation.lights) + len(self._interpretation.data)

    @property
    def carried_lights(self) -> int:
        """How many of them, the first ones, are parts of the radiance."""
        return len(self._interpretation.lights)

    @property
    def _channels(self) -> tuple[str, ...]:
        how = self._interpretation
        return tuple(dict.fromkeys((*self.mapping.channels, *how.lights, *how.data)))

    def read(self, y0: int | None = None, y1: int | None = None) -> PathSamples:
        """Rows y0 to y1 exclusive in absolute pixel coordinates (default: all).

        Raises ValueError for rows outside the data window, InputError for corrupt or unsuitable samples.
        """
        return self._decode(self._reader.read(y0, y1, self._channels))

    def blocks(self, max_bytes: int = DEFAULT_BLOCK_BYTES) -> Iterator[PathSamples]:
        """The frame in blocks of whole rows from the top.

        `max_bytes` bounds the stored samples of a block, MAX_BLOCK_SAMPLES their number (a larger row stands alone).
        """
        types = {channel.name: channel.dtype.itemsize for channel in self.header.channels}
        sample_bytes = sum(types[name] for name in self._channels)
        max_bytes = min(max_bytes, MAX_BLOCK_SAMPLES * sample_bytes)
        for block in self._reader.blocks(max_bytes, self._channels):
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
