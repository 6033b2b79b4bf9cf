"""The context of a frame that is denoised in bands: what sees farthest, the U-Net, runs once and not once a band.

The samples are looked at in strips, row by row of which little is left: the U-Net's input at its own resolution.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch

from model.config import UNetConfig
from model.denoiser import Denoiser
from model.features import FrameScale
from model.samples import Samples
from pipelines.tiles import Band

SamplesOfRows = Callable[[int, int], Samples]


@dataclass(frozen=True)
class FrameContext:
    """What the U-Net decoded of the rows of a frame from `first` on, (1, C, h, w)."""

    unet: UNetConfig
    first: int
    decoded: torch.Tensor

    def of(self, band: Band) -> torch.Tensor:
        """The part of the rows that a band reads, padded to the stride."""
        start = (band.read0 - self.first) // self.unet.scale
        return self.decoded[:, :, start : start + _padded(band.read1 - band.read0, self.unet)]


def _padded(rows: int, unet: UNetConfig) -> int:
    """Rows of the U-Net's resolution for so many of the frame, padded to the stride."""
    return -(-rows // unet.stride) * unet.stride // unet.scale


def strips(first: int, last: int, height: int, rows: int, stride: int) -> list[Band]:
    """Bands of about `rows` rows, halos included, that cover a frame's rows from `first`, on the grid, to `last`.

    One stride above and below is halo enough for what is looked at of a pixel's surroundings.
    """
    step = max(rows // stride - 2, 1) * stride
    return [Band(y, min(y + step, last), max(y - stride, 0), min(y + step + stride, height))
            for y in range(first, last, step)]


def frame_context(net: Denoiser, scale: FrameScale, read: SamplesOfRows, bands: list[Band],
                  update: Callable[[], None]) -> FrameContext:
    """The context of the rows of `bands`, which `strips` made.

    read : the samples of the frame's rows from the first to the second, exclusive
    update : called after each of the bands
    """
    unet, first, last = net.config.unet, bands[0].y0, bands[-1].y1
    parts = []
    for band in bands:
        inputs = net.unet_inputs(read(band.read0, band.read1), scale)
        start = (band.y0 - band.read0) // unet.scale
        parts.append(inputs[:, :, start : start + _padded(band.y1 - band.y0, unet)].clone())
        update()
    assert sum(part.shape[2] for part in parts) == _padded(last - first, unet)
    return FrameContext(unet, first, net.decoded_context(torch.cat(parts, 2)))
