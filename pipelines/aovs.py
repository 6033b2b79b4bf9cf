"""`--aov`: which channels of the input are filtered as the radiance is, and what they are called in the output.

What is part of the radiance (a light group, a lobe) takes every path the radiance takes, so that such parts still sum
to the beauty; anything else is averaged by the same kernels. Ids are neither: see ids.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from deep_io.errors import InputError
from deep_io.header import Header
from deep_io.roles import MISS_DEPTH, ROLES, RoleMap
from pipelines.channel_names import id_channels, is_colored, layers_of
from pipelines.inference import FrameLayers

FloatArray = npt.NDArray[np.float32]
BEAUTY = ("R", "G", "B", "A")  # what the beauty is called in an output, whatever it is called in the input
LAYER_DEPTH = "Z"  # what the layers' own depth is called


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
    channels, for ids and for a name that the output has already.
    """
    groups: list[Aov] = []
    ids = id_channels(header)
    written: dict[str, str] = {}  # output channel -> the --aov that it is
    for name in dict.fromkeys(names):
        group = _group(name, header.channel_names, mapping)
        if group is None:
            raise InputError(f"{source}: no AOV {name!r}; there are {', '.join(_there_are(header, mapping)) or 'none'}")
        channels, outputs = group
        owner = next((ids[channel] for channel in channels if channel in ids), None)
        if owner is not None:
            raise InputError(f"{source}: {name!r} holds ids, and a filtered id is no id; --ids {owner} writes ranked "
                             f"pairs of id and weight")
        own = {*mapping["radiance"].channels, *(mapping["coverage"].channels if "coverage" in mapping else ())}
        if own & set(channels):
            raise InputError(f"{source}: {name!r} is the beauty itself, which is written in any case")
        aov = Aov(channels, outputs, _kind(channels, mapping))
        _refuse_taken(name, aov, written, source)
        written |= dict.fromkeys(_written_by(aov), name)
        groups.append(aov)
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
    return "light" if is_colored(channels) and not roles & set(channels) else "data"


def _there_are(header: Header, mapping: RoleMap) -> list[str]:
    own = {*mapping["radiance"].channels, *(mapping["coverage"].channels if "coverage" in mapping else ())}
    others = [name for name in header.channel_names if name not in own]
    ids = id_channels(header)
    layers = [layer for layer, channels in layers_of(others).items() if not ids.keys() & set(channels)]
    return [*layers, *(name for name in others if "." not in name and name not in ids)]


def _refuse_taken(name: str, aov: Aov, written: Mapping[str, str], source: str) -> None:
    """Raises InputError where a channel that an AOV writes is the beauty's, the layers' depth or another AOV's."""
    for output in _written_by(aov):
        if output in BEAUTY or (output == LAYER_DEPTH and aov.kind != "depth"):
            whose = "beauty" if output in BEAUTY else "depth"
            raise InputError(f"{source}: --aov {name}: {output} is the {whose}'s name in an output; leave it out")
        if output in written:
            raise InputError(f"{source}: --aov {name}: {output} is written by --aov {written[output]} already; leave "
                             f"one of them out")


def _written_by(aov: Aov) -> tuple[str, ...]:
    """The output channels that belong to an AOV alone. There is one depth, so two would be LAYER_DEPTH twice."""
    return (*aov.outputs, LAYER_DEPTH) if aov.kind == "depth" else aov.outputs
