"""`lbmc export-layers --samples`: the input's samples as they are, each with its share in every layer.

The copy stays a file of path samples: a compositor multiplies a sample by layer0.weight to keep what layer 0 has of it,
and lbmc denoises it as before.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from deep_io.atomic import atomic_output
from deep_io.deep_reader import DeepReader
from deep_io.deep_writer import DeepWriter
from deep_io.errors import InputError
from deep_io.header import Channel, Header
from deep_io.path_samples import PathSamples
from deep_io.samples import DeepSamples
from deep_io.sequences import Frame
from pipelines.denoise import VERSION_ATTRIBUTE, Job
from pipelines.export_options import ExportOptions
from pipelines.frame_reader import FrameReader
from pipelines.inference import read_bands
from pipelines.mirrors import ALONE, Mirror
from pipelines.plan import FramePlan

Floats = npt.NDArray[np.float32]

PARTITION_ATTRIBUTE = "lbmc:partition"  # not lbmc:model, which says that a file is denoised


@dataclass(frozen=True)
class RowShares:
    """Shares of some of a file's rows.

    y0, y1 : the rows, y1 exclusive, from the frame's first
    shares : (stored, L) float32 of all their stored samples, in the order of the file
    """

    y0: int
    y1: int
    shares: Floats


class SamplesJob(Job):
    """A job that partitions the samples and writes them back with their shares."""

    options: ExportOptions

    @property
    def light(self) -> None:
        """Shares are no picture."""
        return None

    @torch.inference_mode()
    def produce(self, frame: Frame, wanted: list[Path], plan: FramePlan, reader: FrameReader,
                update: Callable[[float], None]) -> int:
        """Band by band, so that a frame larger than memory passes too. Nothing is clamped."""
        options, layers = self.options, plan.shot.layers
        count = max(options.layers or self.net.config.layers, layers)  # those the survey does without take nothing
        names = [f"layer{layer}.weight" for layer in range(count)]
        dtype: np.dtype[Any] = np.dtype(np.float16 if options.pixel_type == "half" else np.float32)
        with (DeepReader(frame.source, options.part, options.threads) as raw, atomic_output(wanted[0]) as temporary,
              DeepWriter(temporary, self._header(raw.header, names, dtype, raw.path), options.compression,
                         options.threads) as writer):
            top = raw.header.data_window.ymin
            for rows in self._shares(plan, reader, update):
                deep = raw.read(top + rows.y0, top + rows.y1)
                own = np.pad(rows.shares, ((0, 0), (count - layers, 0))).astype(dtype)
                added = {name: np.ascontiguousarray(own[:, layer]) for layer, name in enumerate(names)}
                writer.write(DeepSamples(deep.counts, {**deep.channels, **added}, deep.window))
        return 0

    def beside(self, reader: FrameReader) -> int:
        """All shares, where they are averaged: bands of one mirror image are not those of another."""
        layers = self.options.layers or self.net.config.layers
        return reader.total * layers * np.dtype(np.float32).itemsize if self.weights.mirrored else 0

    def _shares(self, plan: FramePlan, reader: FrameReader, update: Callable[[float], None]) -> Iterator[RowShares]:
        """Those of the frame's rows from top to bottom, averaged over its mirror images."""
        if self.mirrors == ALONE:
            yield from self._shares_of(ALONE[0], plan, reader, update)
            return
        before = np.concatenate([[0], np.cumsum(reader.samples_per_row)])
        mean = np.zeros((reader.total, plan.shot.layers), np.float32)
        for run, mirror in enumerate(self.mirrors):

            def progress(done: float, run: int = run) -> None:
                update((run + done) / len(self.mirrors))

            for rows in self._shares_of(mirror, plan, reader, progress):
                mean[before[rows.y0] : before[rows.y1]] += rows.shares
        mean /= len(self.mirrors)
        for band in plan.bands:
            yield RowShares(band.y0, band.y1, mean[before[band.y0] : before[band.y1]])

    def _shares_of(self, mirror: Mirror, plan: FramePlan, reader: FrameReader, update: Callable[[float], None]
                   ) -> Iterator[RowShares]:
        """Those that one mirror image gives, in its own order of rows."""
        row_samples = reader.samples_per_row
        for item in read_bands(reader, self.net, plan.shot.scale, plan.roles, plan.bands, update, plan.held,
                               mirror=mirror):
            partition = self.net.partition(item.samples, plan.shot.scale, plan.shot.layers, item.decoded)
            read0, read1 = mirror.rows(item.band.read0, item.band.read1, len(row_samples))
            y0, y1 = mirror.rows(item.band.y0, item.band.y1, len(row_samples))
            stored = stored_shares(item.block, partition.float().cpu().numpy(), int(row_samples[read0:read1].sum()))
            first = int(row_samples[read0:y0].sum())
            yield RowShares(y0, y1, stored[first : first + int(row_samples[y0:y1].sum())])

    def _header(self, header: Header, names: list[str], dtype: np.dtype[Any], path: str) -> Header:
        there = set(names) & set(header.channel_names)
        if there:
            raise InputError(f"{path}: has a channel {min(there)} already; give the file that it was made from")
        return replace(
            header.with_attributes({VERSION_ATTRIBUTE: self.provenance()[VERSION_ATTRIBUTE],
                                    PARTITION_ATTRIBUTE: f"{self.weights.name} {self.weights.digest}"}),
            channels=(*header.channels, *(Channel(name, dtype) for name in names)), line_order="increasing", name="")


def stored_shares(block: PathSamples, shares: Floats, stored: int) -> Floats:
    """(stored, L) shares in the order of the file; a sample that the network never saw is the last layer's."""
    out = np.zeros((stored, shares.shape[1]), np.float32)
    out[:, -1] = 1
    if block.source is None:
        out[:] = shares
    else:
        real = block.source >= 0
        out[block.source[real]] = shares[real]
    return out
