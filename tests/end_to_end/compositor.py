"""Putting layers together with OpenImageIO, as a compositor would. Not a test itself; no code of ours is used."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenImageIO as oiio

RGBA = ("R", "G", "B", "A")


def picture(path: Path, part: int | str = 0, layer: str = "") -> oiio.ImageBuf:
    """R, G, B, A of a part (by number or name), or of a layer's channels, in float."""
    image = oiio.ImageBuf(str(path), part if isinstance(part, int) else part_names(path).index(part), 0)
    names = [f"{layer}.{name}" if layer else name for name in RGBA]
    # Not ImageBufAlgo.channels: it mixes up channels of different types (half colour, float depth).
    pixels = image.get_pixels(oiio.FLOAT)[..., [image.spec().channelnames.index(name) for name in names]]
    chosen = oiio.ImageBuf(oiio.ImageSpec(pixels.shape[1], pixels.shape[0], len(RGBA), oiio.FLOAT))
    assert chosen.set_pixels(chosen.roi, np.ascontiguousarray(pixels)), chosen.geterror()
    return chosen


def part_names(path: Path) -> list[str]:
    """The names of all parts of a file."""
    count = oiio.ImageBuf(str(path)).nsubimages
    return [oiio.ImageBuf(str(path), part, 0).spec().get_string_attribute("name") for part in range(count)]


def over(pictures: list[oiio.ImageBuf]) -> np.ndarray:
    """(H, W, 4) of pictures composited one over the other, the first one in front."""
    result = pictures[-1]
    for image in reversed(pictures[:-1]):
        result = oiio.ImageBufAlgo.over(image, result)
        assert not result.has_error, result.geterror()
    return np.asarray(result.get_pixels(oiio.FLOAT))


def plus(pictures: list[oiio.ImageBuf]) -> np.ndarray:
    """(H, W, 4) sum of pictures."""
    result = pictures[0]
    for image in pictures[1:]:
        result = oiio.ImageBufAlgo.add(result, image)
        assert not result.has_error, result.geterror()
    return np.asarray(result.get_pixels(oiio.FLOAT))


def flatten(deep: Path | oiio.ImageBuf) -> np.ndarray:
    """(H, W, 4) of a deep picture composited front to back."""
    flat = oiio.ImageBufAlgo.flatten(deep if isinstance(deep, oiio.ImageBuf) else oiio.ImageBuf(str(deep)))
    assert not flat.has_error, flat.geterror()
    names = list(flat.spec().channelnames)
    return np.asarray(flat.get_pixels(oiio.FLOAT))[..., [names.index(name) for name in RGBA]]
