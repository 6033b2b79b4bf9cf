"""The flat one-sample renders that `lbmc pack` takes: their parts merged, checked against each other, read row by row.

What is written from them is pack.py's business.
"""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from deep_io.attributes import Attribute
from deep_io.decoding import LARGEST_RADIANCE
from deep_io.errors import InputError
from deep_io.flat import HALF_MAX
from deep_io.flat_rows import FlatRows
from deep_io.header import Header, channels_of
from deep_io.role_matching import map_roles
from deep_io.roles import RoleMap
from deep_io.samples import DeepSamples, Window
from pipelines.channel_names import id_channels, is_colored, layers_of

PathLike = str | os.PathLike[str]
Pixels = NDArray[np.generic]
Places = dict[str, tuple[int, str]]  # channel of the render -> its part, and its name there

# Rows of all renders that are held at a time: enough for few calls, or a whole chunk where that is more.
BAND_ROWS = 64
# At most this much of them: chunks of 256 rows, the tallest there are, of 32 HD renders of 20 half channels.
BAND_BYTES = 640 << 20


@dataclass(frozen=True)
class Render:
    """One render: its file, all its parts' channels under unique names in one header, and where they are."""

    file: FlatRows
    header: Header
    places: Places

    @classmethod
    def open(cls, path: str) -> Render:
        """Raises InputError when the file is unreadable or deep, or when its parts cannot be merged."""
        file = FlatRows(path)
        return cls(file, *merge_parts(file.headers, path))

    def read(self, names: Sequence[str], y0: int, y1: int) -> dict[str, Pixels]:
        """Channels -> (y1 - y0, W) in rows y0 to y1 exclusive, in absolute coordinates. Raises InputError."""
        found: dict[str, Pixels] = {}
        for part in sorted({self.places[name][0] for name in names}):
            mine = {name: self.places[name][1] for name in names if self.places[name][0] == part}
            pixels = self.file.read(part, y0, y1, set(mine.values()))
            found |= {name: pixels[own] for name, own in mine.items()}
        return {name: found[name] for name in names}

    def rows_together(self, names: Sequence[str]) -> int:
        """Rows of these channels, from the top of the data window, that no chunk crosses the edges of."""
        return math.lcm(*(self.file.rows_together(self.places[name][0]) for name in names))


@dataclass
class RenderStack:
    """N renders of one frame.

    header    the merged header of the first: all its channels under unique names, its windows and attributes
    mapping   which of the channels play which role
    renders   the files
    channels  the channels that are needed
    """

    header: Header
    mapping: RoleMap
    renders: Sequence[Render]
    channels: Sequence[str]

    @property
    def pieces(self) -> int:
        """How many bands the rows that are stored together make: each of them decodes all these rows."""
        return -(-self._rows_together // self._most_rows)

    @property
    def _rows_together(self) -> int:
        return min(math.lcm(*(render.rows_together(self.channels) for render in self.renders)),
                   self.header.data_window.height)

    @property
    def _most_rows(self) -> int:
        """Rows of all renders that BAND_BYTES hold."""
        sample_bytes = sum(channel.dtype.itemsize for channel in self.header.channels if channel.name in self.channels)
        return max(BAND_BYTES // (self.header.data_window.width * len(self.renders) * sample_bytes), 1)

    def bands(self) -> list[tuple[int, int]]:
        """The rows that are read at a time, from the top: y0 to y1 exclusive, in absolute coordinates.

        Whole chunks, so that each is decoded once, unless one of every render is more than BAND_BYTES.
        """
        window, together = self.header.data_window, self._rows_together
        chunks = max(min(self._most_rows, BAND_ROWS) // together, 1)
        step = -(-together // self.pieces)
        bands = []
        for top in range(window.ymin, window.ymax + 1, chunks * together):
            bottom = min(top + chunks * together, window.ymax + 1)
            cuts = [top, *range(top + step, bottom, step), bottom] if self.pieces > 1 else [top, bottom]
            bands += list(pairwise(cuts))
        return bands

    def blocks(self, most_samples: int) -> Iterator[DeepSamples]:
        """The frame as deep samples from top to bottom: one of each render in every pixel.

        A block is one row, or more of `most_samples` samples at most. Raises InputError.
        """
        rows = max(1, most_samples // (self.header.data_window.width * len(self.renders)))
        for band in self.bands():
            yield from self._blocks_of(*band, rows)

    def _blocks_of(self, top: int, bottom: int, rows: int) -> Iterator[DeepSamples]:
        window = self.header.data_window
        band = [render.read(self.channels, top, bottom) for render in self.renders]
        for y0 in range(top, bottom, rows):
            y1 = min(y0 + rows, bottom)
            channels = {name: np.stack([pixels[name][y0 - top:y1 - top] for pixels in band], axis=-1).ravel()
                        for name in self.channels}
            counts = np.full((y1 - y0, window.width), len(band), np.int32)
            yield DeepSamples(counts, channels, window.rows(y0, y1))

    def goes_beyond_half(self, names: Sequence[str]) -> bool:
        """Whether the named channels of light have a value beyond half's range; what is no light does not count.

        Half channels have none and are not read. Raises InputError.
        """
        for render in self.renders:
            types = {channel.name: channel.dtype for channel in render.header.channels}
            wide = [name for name in names if types[name] != np.float16]
            for band in self.bands() if wide else ():
                for values in render.read(wide, *band).values():
                    magnitudes = np.abs(values, dtype=np.float32)
                    if ((magnitudes > HALF_MAX) & (magnitudes <= LARGEST_RADIANCE)).any():
                        return True
        return False


def open_renders(sources: Sequence[PathLike], overrides: Mapping[str, str] | None = None,
                 layers: Sequence[str] = ()) -> RenderStack:
    """Renders of the same frame made with different seeds, checked, and read later.

    overrides  role -> layer, as for a deep file
    layers     further layers of light to carry along, by name
    Raises InputError when a file is unreadable or deep, has no R, G, B or two layers for one role, or lacks a layer to
    carry along, when windows, pixel aspects or channels differ between files, and when two files hold the same picture.
    """
    if not sources:
        raise InputError("there is no render to pack")
    name = os.fspath(sources[0])
    first = Render.open(name)
    dtypes = {channel.name: channel.dtype for channel in first.header.channels}
    mapping = map_roles(first.places, overrides, attributes=first.header.attributes, dtypes=dtypes, source=name)
    wanted = [*mapping.channels, *_layer_channels(first.header, layers, mapping, name)]
    renders = [first]
    for source in sources[1:]:
        renders.append(Render.open(os.fspath(source)))
        _same_layout(first.header, name, renders[-1].header, renders[-1].file.path)
    stack = RenderStack(first.header, mapping, renders, tuple(dict.fromkeys(wanted)))
    _refuse_same_picture(stack)
    return stack


def merge_parts(parts: Sequence[Header], path: str) -> tuple[Header, Places]:
    """The channels of all parts under unique names: the beauty's bare R, G, B, A stay, others get their part's name.

    Blender repeats the part's name in its channels, which then stay as they are. Attributes are the first part's and
    what the others add. Raises InputError when the parts' windows differ, and when two channels end up as one.
    """
    first = parts[0]
    if len(parts) == 1:
        return first, {name: (0, name) for name in first.channel_names}
    beauty = _beauty_part(parts)
    places: Places = {}
    dtypes: dict[str, np.dtype[np.generic]] = {}
    attributes: dict[str, Attribute] = {}
    for index, part in enumerate(parts):
        if (part.data_window, part.display_window) != (first.data_window, first.display_window):
            raise InputError(f"{path}: the windows of parts {first.name!r} and {part.name!r} differ; render all of "
                             f"them with one window")
        attributes = {**part.attributes, **attributes}
        for channel in part.channels:
            own = part is beauty or channel.name.startswith(f"{part.name}.")
            full = channel.name if own and channel.name not in places else f"{part.name}.{channel.name}"
            if full in places:
                raise InputError(f"{path}: part {part.name!r} and another one both hold the channel {full!r}; rename "
                                 f"one of the parts")
            places[full], dtypes[full] = (index, channel.name), channel.dtype
    header = Header(channels_of(dtypes), first.data_window, first.display_window, type=first.type,
                    pixel_aspect=first.pixel_aspect, attributes=attributes)
    return header, places


def _beauty_part(parts: Sequence[Header]) -> Header | None:
    """The part with bare R, G, B that is the beauty by its name, such as `rgba`; else the only one whose name is not
    that of another role's layer, such as `albedo`, or of these the only one with A, or the only one without a name."""
    colored = [part for part in parts if {"R", "G", "B"} <= set(part.channel_names)]
    roles = {part.name: _role_of(part.name) for part in colored}
    named = [part for part in colored if part.name and roles[part.name] == "radiance"]
    others = [part for part in colored if roles[part.name] in ("", "radiance")]
    for candidates in (named, others, [part for part in others if "A" in part.channel_names],
                       [part for part in others if not part.name]):
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


def _refuse_same_picture(stack: RenderStack) -> None:
    """Two renders with one seed are the same sample twice. Pictures of one constant colour may well be alike.

    Renders are compared band by band, from the middle, where least is background, until all are told apart.
    """
    colours, window = stack.mapping["radiance"].channels, stack.header.data_window
    groups = [list(stack.renders)]
    for y0, y1 in sorted(stack.bands(), key=lambda band: abs(sum(band) - window.ymin - window.ymax)):
        groups = [alike for group in groups if len(group) > 1 for alike in _split(group, colours, y0, y1)]
    twins = [group for group in groups if len(group) > 1 and not _is_constant(group[0], colours, stack.bands())]
    if twins:
        first, second = min((group[:2] for group in twins), key=lambda pair: stack.renders.index(pair[1]))
        raise InputError(f"{second.file.path}: holds the same picture as {first.file.path}; render every frame with "
                         f"another seed")


def _split(group: Sequence[Render], names: Sequence[str], y0: int, y1: int) -> list[list[Render]]:
    """The group as groups of renders that are alike in rows y0 to y1 exclusive."""
    alike: dict[bytes, list[Render]] = {}
    for render in group:
        digest = hashlib.blake2b(digest_size=16)
        for pixels in render.read(names, y0, y1).values():
            digest.update(np.ascontiguousarray(pixels).view(np.uint8).data)
        alike.setdefault(digest.digest(), []).append(render)
    return list(alike.values())


def _is_constant(render: Render, names: Sequence[str], bands: Sequence[tuple[int, int]]) -> bool:
    """Whether each of the channels holds one value."""
    found: dict[str, np.generic] = {}
    for band in bands:
        for name, pixels in render.read(names, *band).items():
            if not (pixels == found.setdefault(name, pixels.flat[0])).all():
                return False
    return True
