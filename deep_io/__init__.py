"""Files to arrays and back: deep and flat EXRs, roles, weighting, sequences. Never networks."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from deep_io.deep_reader import DeepReader, PathLike
from deep_io.deep_writer import LINE_ORDERS, DeepWriter
from deep_io.errors import InputError, LbmcError, MemoryCostWarning, UsageError
from deep_io.header import Channel, Header, read_headers
from deep_io.samples import DeepSamples, Window

__all__ = [
    "Channel",
    "DeepReader",
    "DeepSamples",
    "DeepWriter",
    "Header",
    "InputError",
    "LbmcError",
    "MemoryCostWarning",
    "UsageError",
    "Window",
    "read_deep",
    "read_headers",
    "write_deep",
]


def read_deep(path: PathLike, part: int | str | None = None, channels: Iterable[str] | None = None,
              threads: int | None = None) -> tuple[DeepSamples, Header]:
    """A whole deep part and its header; see DeepReader for the arguments. Raises InputError."""
    with DeepReader(path, part, threads) as reader:
        return reader.read(channels=channels), reader.header


def write_deep(path: PathLike, samples: DeepSamples, header: Header | None = None, compression: str = "zips",
               threads: int | None = None) -> None:
    """Write samples as a single-part deep scanline file; without a header one is made from the samples.

    A header that was read can be written again: rows have no random order, which tiles may have, so they increase.
    Raises ValueError when samples and header do not fit, OSError from the disk.
    """
    header = header or Header.of_samples(samples)
    if header.line_order not in LINE_ORDERS:
        header = replace(header, line_order="increasing")
    with DeepWriter(path, header, compression, threads) as writer:
        writer.write(samples)
