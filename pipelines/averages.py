"""A frame's layers averaged over runs of the network on its mirror images; of one run, that run's layers as they are.

Bands are added as they come, so that averaging takes no memory but the result's.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch

from model.compositing import Layers
from pipelines.mirrors import Mirror, Scalar
from pipelines.tiles import Band


class MeanLayers:
    """Gathers the layers of runs over a frame of `size` (H, W) pixels.

    Radiance, weight, coverage and extra are what a layer adds to a pixel, so their plain means are right; depth is a
    mean over a layer's hits and counts by its coverage. A run that reaches no sample at a pixel has no say there.
    """

    def __init__(self, size: tuple[int, int], layers: int, carried: int) -> None:
        self._color = np.zeros((layers, 3, *size), np.float32)
        self._weight, self._coverage, self._depth = (np.zeros((layers, *size), np.float32) for _ in range(3))
        self._extra = np.zeros((layers, carried, *size), np.float32)
        self._runs = np.zeros(size, np.uint8)

    def add(self, layers: Layers, band: Band, mirror: Mirror) -> None:
        """What a run on the mirrored frame found for the rows that a band of it reads; its halo is left out."""
        own = slice(band.y0 - band.read0, band.y1 - band.read0)
        color, weight, coverage, depth, extra = (
            plane[0, ..., own, :].cpu().numpy()
            for plane in (layers.color, layers.weight, layers.coverage, layers.depth, layers.extra))

        def here(whole: npt.NDArray[Scalar]) -> npt.NDArray[Scalar]:
            return mirror.picture(whole, -2)[..., band.y0 : band.y1, :]

        hits = here(self._coverage)
        hits += coverage
        share = np.divide(coverage, hits, out=np.zeros_like(coverage), where=coverage > 0)
        mean = here(self._depth)
        mean += np.where(coverage > 0, depth - mean, 0) * share
        for whole, part in ((self._color, color), (self._weight, weight), (self._extra, extra)):
            here(whole)[...] += part
        here(self._runs)[...] += weight.sum(0) > 0

    def result(self) -> Layers:
        """The means; to be called once."""
        runs = np.maximum(self._runs, 1).astype(np.float32)
        for plane in (self._color, self._weight, self._coverage, self._extra):
            plane /= runs
        self._depth[self._coverage <= 0] = np.inf
        planes = (self._color, self._weight, self._coverage, self._depth, self._extra)
        return Layers(*(torch.from_numpy(plane)[None] for plane in planes))
