"""Channels of the input that travel to the output as they are: unfiltered pixel means, for `--keep`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from typing import Any

import numpy as np
import numpy.typing as npt

from deep_io.deep_reader import DeepReader
from deep_io.errors import InputError, UsageError
from deep_io.header import Header
from deep_io.samples import DeepSamples
from pipelines.channel_names import id_channels

Pixels = npt.NDArray[Any]
BEAUTY = "the beauty"
WRITTEN: Mapping[str, str] = dict.fromkeys("RGBA", BEAUTY)


def matching_channels(header: Header, wanted: Sequence[str], source: str, written: Mapping[str, str]) -> list[str]:
    """Channels that a request names: a channel, a layer (all its channels) or a glob, which passes ids and what is
    written already by; `written` has the names of that, and what writes them.

    Raises InputError for a request that matches nothing; the message lists what there is. UsageError for a channel that
    is written already.
    """
    names, ids = header.channel_names, id_channels(header)
    found: list[str] = []
    for request in wanted:
        matches = [name for name in names if name == request or name.startswith(f"{request}.")
                   or (fnmatchcase(name, request) and name not in ids)]
        if not matches:
            raise InputError(f"{source}: no channel or layer {request!r} to keep; there are {', '.join(names)}")
        twice = next((name for name in matches if name in written and (name == request
                                                                       or name.startswith(f"{request}."))), None)
        if twice is not None and written[twice] == BEAUTY:
            raise UsageError(f"--keep {request}: is the beauty's own channel, written denoised; leave it out of --keep")
        if twice is not None:
            raise UsageError(f"--keep {request}: {twice} is written by {written[twice]} already; leave one of them out")
        found += [name for name in matches if name not in found and name not in written]
    return found


def find_kept(header: Header, weighting: str, wanted: Sequence[str], source: str,
              written: Mapping[str, str] = WRITTEN) -> list[str]:
    """The names of the channels asked for, checked before any work is done; `written` as for `matching_channels`.

    Raises InputError for a request that matches nothing or an id (an average of ids is no id), UsageError for a channel
    that is written already, and unless every sample weighs the same.
    """
    if not wanted:
        return []
    if weighting != "uniform":
        raise UsageError(f"{source}: --keep averages samples of equal weight, these are weighted {weighting}")
    names = matching_channels(header, wanted, source, written)
    for channel, owner in id_channels(header).items():
        if channel in names:
            raise InputError(f"{source}: channel {channel} holds ids, which cannot be averaged; leave it out of "
                             f"--keep, and pass --ids {owner} to have them ranked")
    return names


def kept_channels(path: str, part: int | str | None, names: Sequence[str], max_bytes: int) -> dict[str, Pixels]:
    """Pixel means (H, W), in the file's type, of channels that `find_kept` found; 0 where a pixel has no finite value.
    """
    with DeepReader(path, part) as reader:
        channels = {channel.name: channel.dtype for channel in reader.header.channels}
        window = reader.header.data_window
        out = {name: np.zeros((window.height, window.width), channels[name]) for name in names}
        for block in reader.blocks(max_bytes, names):
            first = block.window.ymin - window.ymin
            for name in names:
                out[name][first : first + block.window.height] = _pixel_means(block, name)
    return out


def _pixel_means(block: DeepSamples, name: str) -> npt.NDArray[np.float64]:
    """(H, W) means of the finite values of each pixel."""
    values = block.channels[name].astype(np.float64)
    finite = np.isfinite(values)
    some = block.counts.reshape(-1) > 0
    starts = block.offsets[:-1][some]
    means = np.zeros(block.counts.size)
    if starts.size:
        sums = np.add.reduceat(np.where(finite, values, 0), starts)
        counts = np.add.reduceat(finite.astype(np.float64), starts)
        means[some] = sums / np.maximum(counts, 1)
    return means.reshape(block.counts.shape)
