"""Deep files and samples for the tests: random samples, and what OpenEXR and OpenImageIO make of them.

The libraries serve as the independent opinion; nothing here goes through deep_io's reader or writer.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import OpenImageIO as oiio
from hypothesis import HealthCheck, settings

from deep_io import DeepSamples, Window

# The same examples every time; no deadline, for the machine may be busy. Examples overwrite each other's files.
seeded = settings(derandomize=True, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
COMPRESSIONS = {"none": OpenEXR.NO_COMPRESSION, "rle": OpenEXR.RLE_COMPRESSION, "zips": OpenEXR.ZIPS_COMPRESSION,
                "zstd": OpenEXR.ZSTD_COMPRESSION}
CHANNELS = {"A": np.float16, "R": np.float16, "Z": np.float32, "id": np.uint32}
OIIO_TYPES = {np.dtype(np.float16): oiio.HALF, np.dtype(np.float32): oiio.FLOAT, np.dtype(np.uint32): oiio.UINT32}
WINDOW = Window(-3, 5, 12, 14)
NUMPY_TYPES = {kind: dtype for dtype, kind in OIIO_TYPES.items()}


def random_samples(seed: int = 0, window: Window = WINDOW, most: int = 5,
                   channels: Mapping[str, Any] = CHANNELS, smooth: bool = False) -> DeepSamples:
    """0 to `most` samples per pixel of every finite and non-finite bit pattern, or of few values that pack well."""
    rng = np.random.default_rng(seed)
    counts = rng.integers(0, most + 1, (window.height, window.width)).astype(np.int32)
    return DeepSamples(counts, {name: values_of(rng, int(counts.sum()), dtype, smooth)
                                for name, dtype in channels.items()}, window)


def values_of(rng: np.random.Generator, size: int, dtype: Any, smooth: bool = False) -> np.ndarray:
    if smooth:
        return np.repeat(rng.integers(0, 7, size // 9 + 1), 9)[:size].astype(dtype)
    return rng.integers(0, 256, size * np.dtype(dtype).itemsize).astype(np.uint8).view(dtype)


def same_bits(left: np.ndarray, right: np.ndarray) -> bool:
    return left.dtype == right.dtype and left.tobytes() == right.tobytes()


def assert_same(left: DeepSamples, right: DeepSamples) -> None:
    """Equal windows, counts and channels, bit for bit."""
    assert left.window == right.window
    assert np.array_equal(left.counts, right.counts)
    assert sorted(left.channels) == sorted(right.channels)
    for name, values in left.channels.items():
        assert same_bits(values, right.channels[name]), name


def split_rows(samples: DeepSamples, rows: int) -> list[DeepSamples]:
    """Blocks of `rows` rows, the last one maybe of fewer."""
    window, ends = samples.window, np.concatenate(([0], np.cumsum(samples.counts.sum(axis=1))))
    cuts = [*range(0, window.height, rows), window.height]
    return [DeepSamples(samples.counts[a:b], {name: v[ends[a]:ends[b]] for name, v in samples.channels.items()},
                        window.rows(window.ymin + a, window.ymin + b)) for a, b in pairwise(cuts)]


def openexr_part(samples: DeepSamples, compression: str = "zips", tile: tuple[int, int] | None = None, name: str = "",
                 **header: Any) -> OpenEXR.Part:
    """An OpenEXR.Part; `tile` makes it tiled."""
    window = samples.window
    box = (np.array([window.xmin, window.ymin], np.int32), np.array([window.xmax, window.ymax], np.int32))
    header = {"compression": COMPRESSIONS[compression], "type": OpenEXR.deepscanline, "dataWindow": box,
              "displayWindow": box, **header}
    if tile:
        description = OpenEXR.TileDescription()
        description.xSize, description.ySize = tile
        header.update(type=OpenEXR.deeptile, tiles=description)
    return OpenEXR.Part(header, {channel: _objects(values, samples.counts)
                                 for channel, values in samples.channels.items()}, name)


def _objects(values: np.ndarray, counts: np.ndarray) -> np.ndarray:
    pixels = np.empty(counts.size, object)
    # A strided array would be written wrong without an error, so every pixel gets a copy.
    for index, piece in enumerate(np.split(values, np.cumsum(counts.ravel())[:-1])):
        pixels[index] = piece.copy()
    return pixels.reshape(counts.shape)


def write_openexr(path: Path, *parts: OpenEXR.Part) -> None:
    with OpenEXR.File(list(parts)) as file:
        file.write(str(path))


def read_openexr(path: Path, part: int = 0) -> DeepSamples:
    """What OpenEXR.File sees in a deep part."""
    found = OpenEXR.File(str(path), separate_channels=True).parts[part]
    low, high = found.header["dataWindow"]
    window = Window(int(low[0]), int(low[1]), int(high[0]), int(high[1]))
    counts, channels = np.zeros((window.height, window.width), np.int32), {}
    for name, channel in found.channels.items():
        pixels = channel.pixels.ravel()
        counts = np.array([0 if p is None else len(p) for p in pixels], np.int32).reshape(channel.pixels.shape)
        held = [p for p in pixels if p is not None and len(p)]
        # Without any sample its objects do not know the channel's type.
        channels[name] = np.concatenate(held) if held else np.empty(0, _types(path, part)[name])
    return DeepSamples(counts, channels, window)


def _types(path: Path, part: int) -> dict[str, Any]:
    spec = oiio.ImageInput.open(str(path)).spec(part)
    return {name: NUMPY_TYPES[spec.channelformat(index).basetype] for index, name in enumerate(spec.channelnames)}


def write_oiio(path: Path, parts: Sequence[DeepSamples], compression: str = "zips",
               tile: tuple[int, int] | None = None) -> None:
    """A deep file, one subimage per part, through OpenImageIO; `tile` makes it tiled."""
    specs, datas = [], []
    for index, samples in enumerate(parts):
        window = samples.window
        kinds = [OIIO_TYPES[values.dtype] for values in samples.channels.values()]
        spec = oiio.ImageSpec(window.width, window.height, len(kinds), kinds[0])
        spec.x, spec.y = window.xmin, window.ymin
        # OpenEXR wants one display window for all parts.
        spec.full_x, spec.full_y = parts[0].window.xmin, parts[0].window.ymin
        spec.full_width, spec.full_height = parts[0].window.width, parts[0].window.height
        spec.channelnames = tuple(samples.channels)
        spec.channelformats = tuple(oiio.TypeDesc(kind) for kind in kinds)
        spec.deep = True
        if tile:
            spec.tile_width, spec.tile_height = tile
        spec.attribute("compression", compression)
        spec.attribute("oiio:subimagename", f"part{index}")
        specs.append(spec)
        datas.append(_deep_data(spec, samples))
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), tuple(specs) if len(specs) > 1 else specs[0]), output.geterror()
    for index, data in enumerate(datas):
        assert not index or output.open(str(path), specs[index], "AppendSubimage"), output.geterror()
        assert output.write_deep_image(data), output.geterror()
    assert output.close(), output.geterror()


def _deep_data(spec: oiio.ImageSpec, samples: DeepSamples) -> oiio.DeepData:
    data = oiio.DeepData()
    data.init(spec)
    counts, offsets = samples.counts.ravel(), samples.offsets
    for pixel, count in enumerate(counts.tolist()):
        data.set_samples(pixel, count)
    for channel, values in enumerate(samples.channels.values()):
        put = data.set_deep_value_uint if values.dtype == np.uint32 else data.set_deep_value
        plain = values.tolist()
        for pixel, count in enumerate(counts.tolist()):
            for sample in range(count):
                put(pixel, channel, sample, plain[offsets[pixel] + sample])
    return data


def read_oiio(path: Path, subimage: int = 0) -> DeepSamples:
    """What OpenImageIO's DeepData holds of a subimage."""
    source = oiio.ImageInput.open(str(path))
    assert source is not None, oiio.geterror()
    spec = source.spec(subimage)
    data = source.read_native_deep_image(subimage, 0)
    counts = np.array([data.samples(p) for p in range(data.pixels)], np.int32).reshape(spec.height, spec.width)
    channels = {}
    for index, (name, kind) in enumerate(_types(path, subimage).items()):
        get = data.deep_value_uint if kind == np.uint32 else data.deep_value
        channels[name] = np.array([get(pixel, index, sample) for pixel, count in enumerate(counts.ravel().tolist())
                                   for sample in range(count)], kind)
    source.close()
    window = Window(spec.x, spec.y, spec.x + spec.width - 1, spec.y + spec.height - 1)
    return DeepSamples(counts, channels, window)
