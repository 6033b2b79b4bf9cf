"""The colour of flat EXRs that are measured: three channels of a part or layer, and where they stand in the frame."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deep_io.errors import InputError
from deep_io.flat import read_flat
from deep_io.header import read_headers
from deep_io.samples import Window
from pipelines.channel_names import is_colored, layers_of

PathLike = str | os.PathLike[str]

RGB = ("R", "G", "B")


@dataclass(frozen=True)
class FlatPicture:
    """The colour of a flat EXR: `rgb` (H, W, 3) and where its pixels stand in the frame."""

    path: str
    rgb: NDArray[np.floating[Any]]
    window: Window


def read_rgb(path: PathLike, part: str | None = None, layer: str | None = None) -> FlatPicture:
    """The colour of a flat EXR: float32, linear.

    part : name, or number from 0, of a part of a multi-part file; None: the first with the colour asked for
    layer : the layer whose colour it is; None: R, G, B
    A file that holds one picture alone is that picture, whatever is asked for: one with a single part for `part`, one
    whose only colour is R, G, B for `layer`.
    Raises InputError for a file that is missing, not an EXR, deep, or without that part or colour.
    """
    name = os.fspath(path)
    headers = read_headers(path)
    if any(header.is_deep for header in headers):
        raise InputError(f"{name}: is a deep EXR where a flat one is needed; lbmc denoise {name} OUT makes a flat "
                         "one of deep samples")
    chosen: int | str | None = part if len(headers) > 1 else None
    if chosen is None and layer is not None:
        chosen = next((index for index, header in enumerate(headers) if _colour(header.channel_names, layer)), None)
    flat = read_flat(path, chosen)
    channels = tuple(flat.channels)
    colour = _colour(channels, layer)
    if not colour and len(headers) == 1 and not _coloured_layers(channels):
        colour = _colour(channels)
    if not colour:
        raise InputError(f"{name}: {_lack(channels, layer)}")
    rgb = np.stack([flat.channels[channel].astype(np.float32) for channel in colour], axis=-1)
    return FlatPicture(name, rgb, flat.window)


def check_window(picture: FlatPicture, other: FlatPicture) -> None:
    """Raises InputError, with both windows, where two pictures that are compared are not of one window."""
    if other.window != picture.window:
        raise InputError(f"{placed(picture.path, picture.window)}, but {placed(other.path, other.window)}; compare "
                         "images of one window")


def check_finite(pictures: Iterable[FlatPicture]) -> None:
    """Raises InputError for the first picture with values that are not finite."""
    for picture in pictures:
        bad = int(np.count_nonzero(~np.isfinite(picture.rgb).all(axis=-1)))
        if bad:
            raise InputError(f"{picture.path}: {bad} pixels are not finite, so no error can be measured")


def check_halves(one: FlatPicture, other: FlatPicture) -> None:
    """Raises InputError where the two halves of a reference are one and the same picture."""
    if np.array_equal(one.rgb, other.rgb):
        raise InputError(f"{one.path} and {other.path} are the same picture; two independent renderings are needed")


def mean_of_halves(one: FlatPicture, other: FlatPicture) -> NDArray[np.float64]:
    """(H, W, 3) the reference that two independent renderings of one picture make together."""
    mean: NDArray[np.float64] = (one.rgb.astype(np.float64) + other.rgb) / 2.0
    return mean


def placed(path: PathLike, window: Window) -> str:
    """A file and where its pixels stand, for a reader."""
    return f"{os.fspath(path)} is {window.width} x {window.height} at ({window.xmin}, {window.ymin})"


def _colour(channels: Sequence[str], layer: str | None = None) -> tuple[str, ...]:
    """The three channels of the colour; none where it is not there."""
    if layer is None:
        return RGB if set(RGB) <= set(channels) else ()
    return _coloured_layers(channels).get(layer, ())


def _coloured_layers(channels: Sequence[str]) -> dict[str, tuple[str, ...]]:
    return {layer: names for layer, names in layers_of(channels).items() if is_colored(names)}


def _lack(channels: Sequence[str], layer: str | None) -> str:
    """What a file lacks, and what it has instead."""
    layers = _coloured_layers(channels)
    if layer is not None:
        return f"no layer {layer!r} with a colour; " + (f"its layers are {', '.join(layers)}" if layers else
                                                        f"its channels are {', '.join(channels)}")
    cure = f"; lbmc compare --layer {next(iter(layers))} takes those of a layer" if layers else ""
    return f"no R, G, B channels (its channels: {', '.join(channels)}){cure}"
