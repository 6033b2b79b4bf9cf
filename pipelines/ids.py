"""`--ids`: per-sample ids as ranked pairs of id and weight, as Cryptomatte stores them. Nothing is filtered.

Per pixel the weight of an id is the summed weight * coverage of its samples; the heaviest come first, two to a layer:
NAME00.R, G = first id, its weight; NAME00.B, A = the second; NAME01 ... Ids that are already Cryptomatte's float32
hashes keep their bits; plain numbers (uint) become the hashes of their decimal names, with a manifest that says so.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from deep_io.deep_reader import DeepReader
from deep_io.errors import InputError
from deep_io.header import Header
from deep_io.path_samples import SampleReader
from pipelines.channel_names import CRYPTOMATTE, cryptomatte_names, id_channels, layers_of

RANKS = 6  # ids kept in a pixel: Cryptomatte's usual depth
FIRST_RANK = "00.R"  # what a Cryptomatte's name is followed by in the channel of its heaviest ids
Bits = npt.NDArray[np.uint32]
Channels = dict[str, npt.NDArray[np.float32]]


@dataclass(frozen=True)
class IdChannel:
    """One id channel: `base` names its output, `hashed` says that its bits are Cryptomatte ids already."""

    channel: str
    base: str
    hashed: bool

    @property
    def outputs(self) -> list[str]:
        """The channels that are written: of each rank its id and its weight."""
        return [f"{self.base}{number // 2:02d}.{name}" for number in range(RANKS) for name in
                ("RG", "BA")[number % 2]]


def find_ids(names: Sequence[str], header: Header, source: str) -> list[IdChannel]:
    """The id channels that names ask for: a channel, a layer of a single one, or a Cryptomatte (its first rank).

    Raises InputError for a name that is none of them, or that cannot hold ids (half).
    """
    types = {channel.name: channel.dtype for channel in header.channels}
    layers = layers_of(list(types))
    found = []
    for name in dict.fromkeys(names):
        alone = layers.get(name, ())
        choices = [name, name + FIRST_RANK, *(alone if len(alone) == 1 else ())]
        channel = next((choice for choice in choices if choice in types), None)
        if channel is None:
            there = ", ".join(dict.fromkeys(id_channels(header).values()))
            raise InputError(f"{source}: no id channel {name!r}; there are {there or 'none'}")
        if types[channel].itemsize != 4:
            raise InputError(f"{source}: {channel} is half, which cannot hold ids; they are uint or Cryptomatte floats")
        hashed = types[channel].kind == "f"
        of_rank = hashed and channel.endswith(FIRST_RANK)
        base = channel.removesuffix(FIRST_RANK) if of_rank else name.removesuffix(".R")
        found.append(IdChannel(channel, base, hashed))
    return list(dict.fromkeys(found))


def ranked_ids(reader: SampleReader, part: int | str | None, wanted: Sequence[IdChannel], block_rows: int = 64
               ) -> tuple[Channels, dict[str, str]]:
    """Channels (H, W) of ranked pairs, and the Cryptomatte header attributes that the input lacks."""
    window = reader.header.data_window
    ranks = {one.channel: np.zeros((RANKS, 2, window.height, window.width), np.float32) for one in wanted}
    manifests: dict[str, dict[str, str]] = {one.channel: {} for one in wanted}
    with DeepReader(reader.path, part) as raw:
        for y0 in range(window.ymin, window.ymax + 1, block_rows):
            y1 = min(y0 + block_rows, window.ymax + 1)
            block = reader.read(y0, y1)
            stored = raw.read(y0, y1, [one.channel for one in wanted])
            pixel = np.repeat(np.arange(block.counts.size), block.counts.ravel())
            weight = block.weight * block.coverage
            origin = np.arange(block.total) if block.source is None else block.source
            used = (origin >= 0) & (weight > 0)
            for one in wanted:
                bits = np.ascontiguousarray(stored.channels[one.channel]).view(np.uint32)[origin[used]]
                if not one.hashed:
                    bits = _hashed(bits, manifests[one.channel])
                ids, weights = rank(pixel[used], bits, weight[used], block.counts.size)
                rows = slice(y0 - window.ymin, y1 - window.ymin)
                shape = (RANKS, y1 - y0, window.width)
                ranks[one.channel][:, 0, rows] = ids.view(np.float32).reshape(shape)
                ranks[one.channel][:, 1, rows] = weights.reshape(shape)
    channels: Channels = {}
    attributes: dict[str, str] = {}
    for one in wanted:
        channels |= zip(one.outputs, ranks[one.channel].reshape(-1, window.height, window.width), strict=True)
        attributes |= _metadata(one, reader.header, manifests[one.channel])
    return channels, attributes


def rank(pixel: npt.NDArray[np.int64], ids: Bits, weight: npt.NDArray[np.float32], pixels: int
         ) -> tuple[Bits, npt.NDArray[np.float32]]:
    """(RANKS, P) the heaviest ids of each pixel and their summed weights, heaviest first; 0 where there are fewer."""
    out_ids, out_weights = np.zeros((RANKS, pixels), np.uint32), np.zeros((RANKS, pixels), np.float32)
    if not ids.size:
        return out_ids, out_weights
    order = np.lexsort((ids, pixel))
    pixel, ids = pixel[order], ids[order]
    first = np.flatnonzero(np.concatenate([[True], (pixel[1:] != pixel[:-1]) | (ids[1:] != ids[:-1])]))
    total = np.add.reduceat(weight[order].astype(np.float64), first)
    pixel, ids = pixel[first], ids[first]
    order = np.lexsort((ids, -total, pixel))  # equal weights by id, so that the same input gives the same bytes
    pixel, ids, total = pixel[order], ids[order], total[order]
    starts = np.flatnonzero(np.concatenate([[True], pixel[1:] != pixel[:-1]]))
    place = np.arange(pixel.size) - np.repeat(starts, np.diff([*starts, pixel.size]))
    kept = place < RANKS
    out_ids[place[kept], pixel[kept]] = ids[kept]
    out_weights[place[kept], pixel[kept]] = total[kept]
    return out_ids, out_weights


def cryptomatte_hash(name: str) -> int:
    """Cryptomatte's id of a name: MurmurHash3 (x86, 32 bits, seed 0), its exponent kept off denormals, Inf and NaN."""
    data = name.encode()
    value = 0
    whole = len(data) // 4 * 4
    for start in range(0, whole, 4):
        value ^= _scrambled(int.from_bytes(data[start : start + 4], "little"))
        value = (_rotated(value, 13) * 5 + 0xE6546B64) & 0xFFFFFFFF
    if whole < len(data):
        value ^= _scrambled(int.from_bytes(data[whole:], "little"))
    value ^= len(data)
    for shift, factor in ((16, 0x85EBCA6B), (13, 0xC2B2AE35)):
        value = ((value ^ (value >> shift)) * factor) & 0xFFFFFFFF
    value ^= value >> 16
    exponent = value >> 23 & 0xFF
    return value ^ (1 << 23) if exponent in (0, 255) else value


def _scrambled(block: int) -> int:
    return _rotated(block * 0xCC9E2D51 & 0xFFFFFFFF, 15) * 0x1B873593 & 0xFFFFFFFF


def _rotated(value: int, bits: int) -> int:
    return (value << bits | value >> (32 - bits)) & 0xFFFFFFFF


def _hashed(numbers: Bits, manifest: dict[str, str]) -> Bits:
    """Plain numbers as the hashes of their decimal names, which go into the manifest."""
    unique, inverse = np.unique(numbers, return_inverse=True)
    hashes = np.array([cryptomatte_hash(str(number)) for number in unique.tolist()], np.uint32)
    manifest |= {str(number): f"{value:08x}" for number, value in zip(unique.tolist(), hashes.tolist(), strict=True)}
    return hashes[inverse.ravel()]


def _metadata(one: IdChannel, header: Header, manifest: dict[str, str]) -> dict[str, str]:
    if one.base in cryptomatte_names(header):
        return {}  # kept from the input
    key = f"{CRYPTOMATTE}{hashlib.sha256(one.base.encode()).hexdigest()[:7]}/"
    values = {"name": one.base, "hash": "MurmurHash3_32", "conversion": "uint32_to_float32"}
    if manifest:
        values["manifest"] = json.dumps(dict(sorted(manifest.items(), key=lambda item: int(item[0]))))
    return {key + name: value for name, value in values.items()}
