"""`lbmc export-layers --samples`: the input's samples as they are, each with its share in every layer.

The copy stays a file of path samples: a compositor multiplies a sample by layer0.weight to keep what layer 0 has of it,
and lbmc denoises it as before.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
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
from pipelines.plan import FramePlan

PARTITION_ATTRIBUTE = "lbmc:partition"  # not lbmc:model, which says that a file is denoised


class SamplesJob(Job):
    """A job that partitions the samples and writes them back with their shares."""

    options: ExportOptions

    @torch.inference_mode()
    def produce(self, frame: Frame, wanted: list[Path], plan: FramePlan, reader: FrameReader,
                update: Callable[[float], None]) -> int:
        """Band by band, so that a frame larger than memory passes too. Nothing is clamped."""
        options, layers = self.options, plan.shot.layers
        count = max(options.layers or self.net.config.layers, layers)  # those the survey does without take nothing
        names = [f"layer{layer}.weight" for layer in range(count)]
        dtype: np.dtype[Any] = np.dtype(np.float16 if options.pixel_type == "half" else np.float32)
        row_samples = reader.samples_per_row
        with (DeepReader(frame.source, options.part, options.threads) as raw, atomic_output(wanted[0]) as temporary,
              DeepWriter(temporary, self._header(raw.header, names, dtype, raw.path), options.compression,
                         options.threads) as writer):
            top = raw.header.data_window.ymin
            for item in read_bands(reader, self.net, plan.shot.scale, plan.roles, plan.bands, update, plan.held):
                band = item.band
                shares = self.net.partition(item.samples, plan.shot.scale, layers, item.decoded).float().cpu().numpy()
                shares = np.pad(shares, ((0, 0), (count - layers, 0)))
                stored = stored_shares(item.block, shares, int(row_samples[band.read0 : band.read1].sum()))
                first = int(row_samples[band.read0 : band.y0].sum())
                deep = raw.read(top + band.y0, top + band.y1)
                own = stored[first : first + deep.total].astype(dtype)
                added = {name: np.ascontiguousarray(own[:, layer]) for layer, name in enumerate(names)}
                writer.write(DeepSamples(deep.counts, {**deep.channels, **added}, deep.window))
        return 0

    def _header(self, header: Header, names: list[str], dtype: np.dtype[Any], path: str) -> Header:
        there = set(names) & set(header.channel_names)
        if there:
            raise InputError(f"{path}: has a channel {min(there)} already; give the file that it was made from")
        return replace(
            header.with_attributes({VERSION_ATTRIBUTE: self.provenance()[VERSION_ATTRIBUTE],
                                    PARTITION_ATTRIBUTE: f"{self.weights.name} {self.weights.digest}"}),
            channels=(*header.channels, *(Channel(name, dtype) for name in names)), line_order="increasing", name="")


def stored_shares(block: PathSamples, shares: npt.NDArray[np.float32], stored: int) -> npt.NDArray[np.float32]:
    """(stored, L) shares in the order of the file; a sample that the network never saw is the last layer's."""
    out = np.zeros((stored, shares.shape[1]), np.float32)
    out[:, -1] = 1
    if block.source is None:
        out[:] = shares
    else:
        real = block.source >= 0
        out[block.source[real]] = shares[real]
    return out
