"""`--aov`: which channels of the input are filtered as the radiance is, and what they are called in the output.

What is part of the radiance (a light group, a lobe) takes every path the radiance takes, so that such parts still sum
to the beauty; anything else is averaged by the same kernels. Ids are neither: see ids.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from deep_io.errors import InputError
from deep_io.header import Header
from deep_io.roles import MISS_DEPTH, ROLES, RoleMap
from pipelines.inference import FrameLayers

FloatArray = npt.NDArray[np.float32]
_COLOR_SUFFIXES = (("R", "G", "B"), ("r", "g", "b"), ("red", "green", "blue"))
_OTHER_SUFFIXES = (("X", "Y", "Z"), ("x", "y", "z"), ("X", "Y"), ("x", "y"), ("u", "v"))
CRYPTOMATTE = "cryptomatte/"


@dataclass(frozen=True)
class Aov:
    """One channel group to filter.

    channels  its names in the input, one or more
    outputs   what they are called in the output
    kind      "light": a part of the radiance; "data": anything else; "depth": what the layers' own depth is
    """

    channels: tuple[str, ...]
    outputs: tuple[str, ...]
    kind: str


@dataclass(frozen=True)
class Aovs:
    """All channel groups of a job's frame, each once."""

    groups: tuple[Aov, ...] = ()

    def channels(self, kind: str) -> list[str]:
        """Input channels of a kind, as the reader carries them."""
        return [name for group in self.groups if group.kind == kind for name in group.channels]

    @property
    def outputs(self) -> list[str]:
        """Output names in the order of `FrameLayers.extra`."""
        return [name for kind in ("light", "data") for group in self.groups if group.kind == kind
                for name in group.outputs]

    @property
    def depth(self) -> str | None:
        """The output name of the depth, if asked for."""
        return next((group.outputs[0] for group in self.groups if group.kind == "depth"), None)


def find_aovs(names: Sequence[str], header: Header, mapping: RoleMap, source: str) -> Aovs:
    """The groups that names ask for: a layer, a single channel or a role.

    Raises InputError for a name that is none of them (the message lists those there are), for the beauty's own
    channels and for ids.
    """
    groups = []
    for name in dict.fromkeys(names):
        group = _group(name, header.channel_names, mapping)
        if group is None:
            raise InputError(f"{source}: no AOV {name!r}; there are {', '.join(_there_are(header, mapping)) or 'none'}")
        channels, outputs = group
        _refuse_ids(name, channels, header, source)
        own = {*mapping["radiance"].channels, *(mapping["coverage"].channels if "coverage" in mapping else ())}
        if own & set(channels):
            raise InputError(f"{source}: {name!r} is the beauty itself, which is written in any case")
        groups.append(Aov(channels, outputs, _kind(channels, mapping)))
    return Aovs(tuple(groups))


def beauty_channels(aovs: Aovs, layers: FrameLayers) -> dict[str, FloatArray]:
    """The AOVs of the beauty, (H, W) each: sums over the layers; depth is their mean over what is covered."""
    summed = layers.extra.sum(0)
    planes = {name: summed[number] for number, name in enumerate(aovs.outputs)}
    if aovs.depth is not None:
        planes[aovs.depth] = mean_depth(layers)
    return planes


def mean_depth(layers: FrameLayers) -> FloatArray:
    """(H, W) sum A_l Z_l / sum A_l, MISS_DEPTH where nothing covers the pixel."""
    coverage = layers.coverage.sum(0)
    depth = (np.where(np.isfinite(layers.depth), layers.depth, 0) * layers.coverage).sum(0)
    mean: FloatArray = np.where(coverage > 0, depth / np.where(coverage > 0, coverage, 1), np.float32(MISS_DEPTH))
    return mean


def cryptomatte_names(header: Header) -> tuple[str, ...]:
    """The names of the Cryptomattes that a header's metadata describe."""
    return tuple(str(header.get(key)) for key in header.attributes
                 if key.startswith(CRYPTOMATTE) and key.endswith("/name"))


def layers_of(channels: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Layer name -> its channels: R, G, B or X, Y, Z in that order where it has them, else all as they come."""
    suffixes: dict[str, list[str]] = {}
    for channel in channels:
        layer, dot, suffix = channel.rpartition(".")
        if dot:
            suffixes.setdefault(layer, []).append(suffix)
    found = {}
    for layer, there in suffixes.items():
        order = next((order for order in (*_COLOR_SUFFIXES, *_OTHER_SUFFIXES) if set(order) <= set(there)), there)
        found[layer] = tuple(f"{layer}.{suffix}" for suffix in order)
    return found


def _group(name: str, channels: Sequence[str], mapping: RoleMap) -> tuple[tuple[str, ...], tuple[str, ...]] | None:
    if name in channels:
        return (name,), (name,)
    layer = layers_of(channels).get(name)
    if layer is not None:
        return layer, layer
    if name in mapping:
        return mapping[name].channels, ROLES[name].channels
    return None


def _kind(channels: tuple[str, ...], mapping: RoleMap) -> str:
    if "depth" in mapping and channels == mapping["depth"].channels:
        return "depth"
    roles = {name for source in mapping.sources.values() for name in source.channels}
    colored = tuple(channel.rpartition(".")[2] for channel in channels) in _COLOR_SUFFIXES
    return "light" if colored and not roles & set(channels) else "data"


def _there_are(header: Header, mapping: RoleMap) -> list[str]:
    own = {*mapping["radiance"].channels, *(mapping["coverage"].channels if "coverage" in mapping else ())}
    others = [name for name in header.channel_names if name not in own]
    layers = [layer for layer, channels in layers_of(others).items() if not _id_channels(channels, header)]
    single = [name for name in others if "." not in name and not _id_channels((name,), header)]
    return [*layers, *single]


def _id_channels(channels: tuple[str, ...], header: Header) -> bool:
    types: Mapping[str, Any] = {channel.name: channel.dtype for channel in header.channels}
    cryptomattes = cryptomatte_names(header)
    return any(types[name].kind == "u" or name.startswith(cryptomattes) for name in channels)


def _refuse_ids(name: str, channels: tuple[str, ...], header: Header, source: str) -> None:
    if _id_channels(channels, header):
        raise InputError(f"{source}: {name!r} holds ids, and a filtered id is no id; --ids {name} writes ranked pairs "
                         f"of id and weight")
