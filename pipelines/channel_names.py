"""What the names of channels tell: which of them hold ids, and the layers that they form. Reads headers, no samples."""

from __future__ import annotations

import re
from collections.abc import Sequence

from deep_io.header import Header

CRYPTOMATTE = "cryptomatte/"
_COLOR_SUFFIXES = (("R", "G", "B"), ("r", "g", "b"), ("red", "green", "blue"))
_OTHER_SUFFIXES = (("X", "Y", "Z"), ("x", "y", "z"), ("X", "Y"), ("x", "y"), ("u", "v"))


def id_channels(header: Header) -> dict[str, str]:
    """The channels of ids, and what --ids calls each: integers, and the ranks of the Cryptomattes of the metadata.

    A Cryptomatte's are its name's layers and those of its name and a number, NAME00.R; their floats are the bits of
    hashes. No mean of ids is an id.
    """
    owners = {channel.name: channel.name for channel in header.channels if channel.dtype.kind == "u"}
    for name in cryptomatte_names(header):
        rank = re.compile(re.escape(name) + r"\d*(?:\..*)?", re.DOTALL)
        owners |= {channel: name for channel in header.channel_names if rank.fullmatch(channel)}
    return {channel: owners[channel] for channel in header.channel_names if channel in owners}


def cryptomatte_names(header: Header) -> tuple[str, ...]:
    """The names of the Cryptomattes that a header's metadata describe."""
    return tuple(str(header.get(key)) for key in header.attributes
                 if key.startswith(CRYPTOMATTE) and key.endswith("/name"))


def is_colored(channels: Sequence[str]) -> bool:
    """Whether the suffixes of channels are those of a colour."""
    return tuple(channel.rpartition(".")[2] for channel in channels) in _COLOR_SUFFIXES


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
