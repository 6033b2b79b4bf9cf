"""The flat one-sample renders that `lbmc pack` takes: read, merged over their parts, and checked against each other.

What is written from them is pack.py's business.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deep_io.attributes import Attribute
from deep_io.decoding import LARGEST_RADIANCE
from deep_io.errors import InputError
from deep_io.flat import FlatImage, read_flat_parts
from deep_io.header import Header, channels_of
from deep_io.role_matching import map_roles
from deep_io.roles import RoleMap
from deep_io.samples import DeepSamples, Window
from pipelines.channel_names import id_channels, is_colored, layers_of

PathLike = str | os.PathLike[str]
Pixels = NDArray[np.generic]


@dataclass
class RenderStack:
    """N renders of one frame.

    header    the merged header of the first: all its channels under unique names, its windows and attributes
    mapping   which of the channels play which role
    sources   the files
    frames    per render: channel -> (H, W), only the channels that are needed
    """

    header: Header
    mapping: RoleMap
    sources: tuple[str, ...]
    frames: list[dict[str, Pixels]]

    def block(self, y0: int, y1: int) -> DeepSamples:
        """Rows y0 to y1 exclusive, in absolute coordinates, as deep samples: one of each render in every pixel."""
        window = self.header.data_window
        rows = slice(y0 - window.ymin, y1 - window.ymin)
        counts = np.full((y1 - y0, window.width), len(self.frames), np.int32)
        channels = {name: np.stack([frame[name][rows] for frame in self.frames], axis=-1).ravel()
                    for name in self.frames[0]}
        return DeepSamples(counts, channels, window.rows(y0, y1))

    def largest(self, names: Iterable[str]) -> float:
        """The largest magnitude in the named channels of light, what is no light left out."""
        magnitudes = (np.abs(frame[name], dtype=np.float32) for frame in self.frames for name in names)
        return max(float(np.max(values, initial=0.0, where=values <= LARGEST_RADIANCE)) for values in magnitudes)


def read_renders(sources: Sequence[PathLike], overrides: Mapping[str, str] | None = None,
                 layers: Sequence[str] = ()) -> RenderStack:
    """Read renders of the same frame made with different seeds.

    overrides  role -> layer, as for a deep file
    layers     further layers of light to carry along, by name
    Raises InputError when a file is unreadable or deep, has no R, G, B or two layers for one role, or lacks a layer to
    carry along, when windows, pixel aspects or channels differ between files, and when two files hold the same picture.
    """
    names = [os.fspath(source) for source in sources]
    first: Header | None = None
    mapping = RoleMap({})
    frames: list[dict[str, Pixels]] = []
    pictures: dict[bytes, str] = {}
    for name in names:
        merged = merge_parts(read_flat_parts(name), name)
        if first is None:
            first = merged.header
            mapping = map_roles(merged.channels, overrides, attributes=first.attributes,
                                dtypes={key: pixels.dtype for key, pixels in merged.channels.items()}, source=name)
            wanted = [*mapping.channels, *_layer_channels(merged.header, layers, mapping, name)]
        else:
            _same_layout(first, names[0], merged.header, name)
        _refuse_same_picture(merged.channels, mapping, name, pictures)
        frames.append({key: merged.channels[key] for key in dict.fromkeys(wanted)})
    if first is None:
        raise InputError("there is no render to pack")
    return RenderStack(first, mapping, tuple(names), frames)


def merge_parts(parts: Sequence[FlatImage], path: str) -> FlatImage:
    """The channels of all parts under unique names: the beauty's bare R, G, B, A stay, others get their part's name.

    Blender repeats the part's name in its channels, which then stay as they are. Attributes are the first part's and
    what the others add. Raises InputError when the parts' windows differ, and when two channels end up as one.
    """
    if len(parts) == 1:
        return parts[0]
    beauty = _beauty_part(parts)
    channels: dict[str, Pixels] = {}
    attributes: dict[str, Attribute] = {}
    for part in parts:
        if (part.header.data_window, part.header.display_window) != (parts[0].window, parts[0].header.display_window):
            raise InputError(f"{path}: the windows of parts {parts[0].header.name!r} and {part.header.name!r} differ; "
                             f"render all of them with one window")
        attributes = {**part.header.attributes, **attributes}
        for name, pixels in part.channels.items():
            own = part is beauty or name.startswith(f"{part.header.name}.")
            full = name if own and name not in channels else f"{part.header.name}.{name}"
            if full in channels:
                raise InputError(f"{path}: part {part.header.name!r} and another one both hold the channel {full!r}; "
                                 f"rename one of the parts")
            channels[full] = pixels
    first = parts[0].header
    header = Header(channels_of({name: pixels.dtype for name, pixels in channels.items()}), first.data_window,
                    first.display_window, type=first.type, pixel_aspect=first.pixel_aspect, attributes=attributes)
    return FlatImage(channels, header)


def _beauty_part(parts: Sequence[FlatImage]) -> FlatImage | None:
    """The part with bare R, G, B that is the beauty by its name, such as `rgba`; else the only one whose name is not
    that of another role's layer, such as `albedo`, or of these the only one with A, or the only one without a name."""
    colored = [part for part in parts if {"R", "G", "B"} <= set(part.channels)]
    roles = {part.header.name: _role_of(part.header.name) for part in colored}
    named = [part for part in colored if part.header.name and roles[part.header.name] == "radiance"]
    others = [part for part in colored if roles[part.header.name] in ("", "radiance")]
    for candidates in (named, others, [part for part in others if "A" in part.channels],
                       [part for part in others if not part.header.name]):
        if len(candidates) == 1:
            return candidates[0]
    return None


def _role_of(layer: str) -> str:
    """The role that a layer of three colours plays by its name, "" for none."""
    beside = map_roles(["R", "G", "B", *(f"{layer}.{letter}" for letter in "RGB")], {"radiance": "RGB"})
    others = [role for role in beside.roles if role != "radiance"]
    if others or not layer:
        return others[0] if others else "radiance"
    try:
        alone = map_roles([f"{layer}.{letter}" for letter in "RGB"])
    except InputError:
        return ""
    return "radiance" if "radiance" in alone.roles else ""


def _layer_channels(header: Header, layers: Sequence[str], mapping: RoleMap, path: str) -> list[str]:
    there, ids = layers_of(header.channel_names), id_channels(header)
    lights = {layer: names for layer, names in there.items()
              if is_colored(names) and not {*ids, *mapping.channels} & set(names)}
    for layer in layers:
        if layer not in lights:
            why = f"{' '.join(there[layer])} are no part of the light" if layer in there else "there is no such layer"
            raise InputError(f"{path}: --layer {layer}: {why}; layers with R, G, B that play no role: "
                             f"{', '.join(lights) or 'none'}")
    return [name for layer in layers for name in lights[layer]]


def _same_layout(first: Header, first_name: str, other: Header, name: str) -> None:
    def words(window: Window) -> str:
        return f"{window.width}x{window.height} at {window.xmin},{window.ymin}"

    for what, mine, its in (("data window", first.data_window, other.data_window),
                            ("display window", first.display_window, other.display_window)):
        if mine != its:
            raise InputError(f"{name}: its {what} is {words(its)}, that of {first_name} is {words(mine)}; "
                             f"pack renders of one frame only")
    if first.pixel_aspect != other.pixel_aspect:
        raise InputError(f"{name}: its pixel aspect is {other.pixel_aspect}, that of {first_name} {first.pixel_aspect}")
    mine_only = sorted(set(first.channel_names) - set(other.channel_names))
    its_only = sorted(set(other.channel_names) - set(first.channel_names))
    if mine_only or its_only:
        difference = "; ".join(filter(None, (f"{' '.join(mine_only)} only in {first_name}" if mine_only else "",
                                             f"{' '.join(its_only)} only in {name}" if its_only else "")))
        raise InputError(f"{name}: its channels differ: {difference}; pack renders with the same AOVs")


def _refuse_same_picture(channels: Mapping[str, Pixels], mapping: RoleMap, name: str, seen: dict[bytes, str]) -> None:
    """Two renders with one seed are the same sample twice. Pictures of one constant colour may well be alike."""
    radiance = [np.ascontiguousarray(channels[key]) for key in mapping["radiance"].channels]
    if all((pixels == pixels.flat[0]).all() for pixels in radiance):
        return
    digest = hashlib.blake2b(digest_size=16)
    for pixels in radiance:
        digest.update(pixels.view(np.uint8).data)
    if digest.digest() in seen:
        raise InputError(f"{name}: holds the same picture as {seen[digest.digest()]}; render every frame with another "
                         f"seed")
    seen[digest.digest()] = name
