"""One frame through a network: path samples to the model's tensors, band by band, and layers back to arrays.

The only place where deep_io's arrays become the model's tensors. Which files, and what is written, is denoise.py's.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt
import torch

from deep_io.path_samples import PathSamples
from model.compositing import Layers, fill_holes
from model.denoiser import Denoiser
from model.features import FrameScale
from model.samples import Samples
from pipelines.averages import MeanLayers
from pipelines.cells import Cells, merged
from pipelines.frame_context import frame_context, strips
from pipelines.frame_reader import FrameReader
from pipelines.mirrors import ALONE, STRAIGHT, Mirror
from pipelines.tiles import Band, narrowed, within_reach

FloatArray = npt.NDArray[np.float32]


@dataclass
class FrameLayers:
    """A denoised frame's layers, float32, front layer first: see `model.compositing.Layers`.

    color (L, 3, H, W), weight (L, H, W), coverage (L, H, W), depth (L, H, W), inf where a layer has no hit,
    extra (L, E, H, W) what each layer adds to the channels that the reader carries
    """

    color: FloatArray
    weight: FloatArray
    coverage: FloatArray
    depth: FloatArray
    extra: FloatArray

    def beauty(self) -> FloatArray:
        """(H, W, 3) radiance."""
        beauty: FloatArray = np.moveaxis(self.color.sum(0), 0, -1)
        return beauty

    def alpha(self) -> FloatArray:
        """(H, W) coverage, 0..1."""
        alpha: FloatArray = np.clip(self.coverage.sum(0), 0, 1)
        return alpha

    def padded(self, count: int) -> FrameLayers:
        """At least `count` layers: those that are absent are transparent ones in front."""
        absent = max(count - len(self.weight), 0)

        def pad(planes: FloatArray, value: float = 0.0) -> FloatArray:
            front = np.full((absent, *planes.shape[1:]), value, np.float32)
            return np.concatenate([front, planes]) if absent else planes

        return FrameLayers(pad(self.color), pad(self.weight), pad(self.coverage), pad(self.depth, np.inf),
                           pad(self.extra))


def to_model(block: PathSamples, roles: tuple[str, ...], depth: float, device: torch.device, lights: int = 0,
             held: frozenset[str] = frozenset(), squares: FloatArray | None = None) -> Samples:
    """A block of decoded samples as the model's input, with those of the roles that the block has.

    The first `lights` of the block's extra columns are parts of the radiance. `held` and `squares` as in `Samples`.
    A depth of 0 is an unknown one and becomes `depth`, the frame's scale, which tells the network nothing.
    """
    height, width = block.counts.shape
    values = {role: values for role, values in block.roles.items() if role in roles}
    if "depth" in values:
        values["depth"] = np.where(values["depth"] <= 0, np.float32(depth), values["depth"])

    def tensor(array: npt.NDArray[np.generic]) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(array)).to(device)

    return Samples(
        shape=(1, height, width),
        counts=tensor(block.counts.reshape(-1)),
        weight=tensor(block.weight),
        coverage=tensor(block.coverage),
        roles={role: tensor(array) for role, array in values.items()},
        extra=tensor(block.extra) if block.extra.shape[1] else None,
        lights=lights,
        squares=None if squares is None else tensor(squares),
        held=held,
    )


@dataclass(frozen=True)
class BandInput:
    """What the network gets of a band: its samples, halo included, and of a context that bands share its part.

    block : the samples as they were read, and mirrored; its `source` numbers those of the file's rows
    """

    band: Band
    block: PathSamples
    samples: Samples
    decoded: torch.Tensor | None


def read_bands(
    reader: FrameReader,
    net: Denoiser,
    scale: FrameScale,
    roles: tuple[str, ...],
    bands: list[Band],
    update: Callable[[float], None] = lambda _: None,
    held: frozenset[str] = frozenset(),
    cells: Cells | None = None,
    mirror: Mirror = STRAIGHT,
) -> Iterator[BandInput]:
    """The input of band after band; their halos, and a context that several share, make cuts invisible.

    cells : rows without pixels to filter are left out of the bands, and what they alone see is not even read
    mirror : the frame is mirrored; the bands are cut from what comes of that
    """
    window = reader.header.data_window
    device = next(net.parameters()).device
    rows = reader.read if mirror == STRAIGHT else partial(reader.read_mirrored, mirror=mirror)

    def read(first: int, last: int) -> tuple[PathSamples, Samples]:
        block, squares = rows(window.ymin + first, window.ymin + last), None
        if cells is not None:
            block, squares = merged(block, mirror.picture(cells.alike)[first:last])
        return block, to_model(block, roles, scale.depth, device, reader.carried_lights, held, squares)

    busy = np.ones(window.height, np.bool_)
    if cells is not None:
        busy = np.logical_not(mirror.picture(cells.mask).all(1))
    halo, looks = net.reach, []
    if len(bands) > 1 and net.tile_reach is not None:
        halo, tallest = net.tile_reach, max(band.read1 - band.read0 for band in bands)
        looks = strips(*within_reach(busy, net.reach, net.stride), window.height, tallest, net.stride)
    bands = narrowed(bands, busy, window.height, halo, net.stride)
    done = itertools.count(1)

    def step() -> None:
        update(next(done) / (len(looks) + len(bands)))

    context = frame_context(net, scale, lambda *rows: read(*rows)[1], looks, step) if looks else None
    for band in bands:
        yield BandInput(band, *read(band.read0, band.read1), None if context is None else context.of(band))
        step()


@torch.inference_mode()
def denoise_bands(
    reader: FrameReader,
    net: Denoiser,
    scale: FrameScale,
    roles: tuple[str, ...],
    layers: int,
    bands: list[Band],
    update: Callable[[float], None] = lambda _: None,
    held: frozenset[str] = frozenset(),
    cells: Cells | None = None,
    mirrors: Sequence[Mirror] = ALONE,
) -> FrameLayers:
    """Denoises a frame band by band.

    cells : those that pass through are not filtered. None: everything is filtered
    mirrors : the mirror images of the frame, itself among them, that are denoised and averaged
    """
    window = reader.header.data_window
    size = (window.height, window.width)
    mean = MeanLayers(size, layers, reader.carried)
    passing = np.zeros(size, np.bool_) if cells is None else cells.mask
    for run, mirror in enumerate(mirrors):
        filtered = np.logical_not(mirror.picture(passing))

        def progress(done: float, run: int = run) -> None:
            update((run + done) / len(mirrors))

        for item in read_bands(reader, net, scale, roles, bands, progress, held, cells, mirror):
            band = item.band
            wanted = torch.zeros(1, band.read1 - band.read0, window.width, dtype=torch.bool)
            wanted[0, band.y0 - band.read0 : band.y1 - band.read0] = torch.from_numpy(filtered[band.y0 : band.y1])
            wanted = wanted.to(item.samples.weight.device)
            mean.add(net(item.samples, scale, layers, fill=False, wanted=wanted, decoded=item.decoded), band, mirror)
            del item  # or it would be there beside the next one
    frame = mean.result()
    if cells is not None and cells.means is not None:
        _pass_through(frame, cells, cells.means, passing)
    return FrameLayers(*(plane[0].numpy() for plane in _planes(fill_holes(frame))))


def _pass_through(frame: Layers, cells: Cells, means: FloatArray, passing: npt.NDArray[np.bool_]) -> None:
    """Writes the pixels' means into the passing cells, as the background layer; unknown pixels are holes."""
    where = torch.from_numpy(passing)
    known = torch.from_numpy((passing & cells.known)[passing]).float()
    color, extra = torch.from_numpy(means[passing].T).split([3, means.shape[2] - 3])
    for plane, empty in zip(_planes(frame), (0.0, 0.0, 0.0, torch.inf, 0.0), strict=True):
        plane[..., where] = empty
    frame.color[0, -1][:, where] = color
    frame.extra[0, -1][:, where] = extra
    frame.weight[0, -1][where] = known


def _planes(layers: Layers) -> tuple[torch.Tensor, ...]:
    return layers.color, layers.weight, layers.coverage, layers.depth, layers.extra
