"""`lbmc export-layers` as a function: the learned layers as files whose composite is the denoised beauty.

The frames, the network and the decisions are denoise.py's job; here is what it writes instead of the beauty. How
layers become over form is deep_io/layer_encoding.py's.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from deep_io.atomic import atomic_output
from deep_io.attributes import Attribute, attribute
from deep_io.deep_writer import DeepWriter
from deep_io.errors import InputError, UsageError
from deep_io.flat import FlatImage, kept_attributes, write_flat_parts
from deep_io.header import Header, channels_of
from deep_io.layer_encoding import OverLayers, deep_samples, encode_layers
from deep_io.roles import MISS_DEPTH
from deep_io.sequences import Frame
from deep_io.weighting import ATTRIBUTE as WEIGHTING_ATTRIBUTE
from pipelines.aovs import Aovs
from pipelines.denoise import DenoisedFrame, Job, run_job, to_pixel_type
from pipelines.export_options import ExportOptions
from pipelines.export_samples import SamplesJob
from pipelines.frame_reader import FrameReader
from pipelines.ids import IdChannel
from pipelines.inference import FrameLayers
from pipelines.jobs import JobReport
from pipelines.plan import FramePlan
from pipelines.progress import Progress

LAYERS_ATTRIBUTE, FORM_ATTRIBUTE, ORDER_ATTRIBUTE = "lbmc:layers", "lbmc:form", "lbmc:layerOrder"
BLOCK_PIXELS = 1 << 17  # encoded at a time: the planes of two layers fit the caches
UNORDERED = "the layers of a layer_w network have no depth order: which is in front means nothing; their sum is right"

Channels = dict[str, npt.NDArray[Any]]


class ExportJob(Job):
    """A denoising job that writes layers."""

    options: ExportOptions

    def __init__(self, options: ExportOptions) -> None:
        super().__init__(options)
        self.ordered = self.net.config.variant != "layer_w"
        self._told_order = False

    def plan(self, source: Path, reader: FrameReader, update: Callable[[float], None]) -> FramePlan:
        """As for the beauty. The deep form needs depth: InputError for a file, UsageError for a network without."""
        if self.options.form == "deep" and "depth" not in reader.mapping:
            raise InputError(f"{source}: has no depth, which deep layers need; name the layer that holds it with "
                             f"--map depth=LAYER, or write flat layers with --form parts")
        plan = super().plan(source, reader, update)
        if self.options.form == "deep" and "depth" not in plan.roles:
            raise UsageError(f"--model {self.weights.name}: was trained without depth, so its layers have none; choose "
                             f"another model, or write flat layers with --form parts")
        return plan

    def frame(self, frame: Frame, progress: Progress) -> DenoisedFrame:
        """Denoises and writes one frame; says once if the layers have no order."""
        if not self.ordered and not self._told_order:
            progress.note(UNORDERED)
            self._told_order = True
        return super().frame(frame, progress)

    def targets(self, frame: Frame) -> list[Path]:
        """OUT itself, or for the files form one file per layer."""
        assert frame.target is not None
        if self.options.form != "files":
            return [frame.target]
        return [layer_path(frame.target, layer) for layer in range(self.layers)]

    def written(self, aovs: Aovs, ids: Sequence[IdChannel]) -> list[tuple[str, Iterable[str]]]:
        """The layers' own channels too, where they are in one part with the beauty."""
        there = super().written(aovs, ids)
        if self.options.form == "channels":
            names = ("R", "G", "B", *aovs.outputs, "A", "Z")
            there.append(("the layers", [f"layer{layer}.{name}" for layer in range(self.layers) for name in names]))
        return there

    @property
    def layers(self) -> int:
        """How many layers are written, whatever the survey finds that a frame needs: comps count on it."""
        return self.options.layers or self.net.config.layers

    def write(self, frame: Frame, wanted: list[Path], plan: FramePlan, layers: FrameLayers, header: Header) -> int:
        """Writes the layers in the form asked for; returns how many values were clamped to half's range."""
        layers = layers.padded(self.layers)
        if self.options.form == "deep":
            return self._write_deep(wanted[0], plan, layers, header)
        pictures, clamped = self._pictures(layers, ("R", "G", "B", *plan.aovs.outputs), "depth" in plan.roles)
        attributes = self._attributes(len(pictures), "contributions" if self.options.contributions else "over")

        def image(channels: Channels, name: str = "", more: Mapping[str, object] | None = None) -> FlatImage:
            return FlatImage.of(channels, header, name, {**attributes, **(more or {})})

        if self.options.form == "files":
            files = {path: [image(picture)] for path, picture in zip(self.targets(frame), pictures, strict=True)}
        else:
            beauty, more, clamped_too = self.beauty(frame, plan, layers)
            clamped += clamped_too
            if self.options.form == "channels":
                named = {f"layer{number}.{name}": plane for number, picture in enumerate(pictures)
                         for name, plane in picture.items()}
                files = {wanted[0]: [image({**beauty, **named}, more=more)]}
            else:
                parts = [image(picture, f"layer{number}") for number, picture in enumerate(pictures)]
                files = {wanted[0]: [image(beauty, "beauty", more), *parts]}
        with ExitStack() as stack:  # several files appear together, after the last of them is written
            for path in wanted:
                write_flat_parts(stack.enter_context(atomic_output(path)), files[path], self.options.compression)
        return clamped

    def _write_deep(self, target: Path, plan: FramePlan, layers: FrameLayers, header: Header) -> int:
        names = ("R", "G", "B", *plan.aovs.outputs)
        # No deepImageState: the OpenEXR module for Python cannot open a file that has it.
        attributes = {**kept_attributes(header), **self._attributes(len(layers.weight), "over"),
                      WEIGHTING_ATTRIBUTE: attribute("over")}
        dtypes: dict[str, Any] = {**dict.fromkeys((*names, "A"), self._dtype), "Z": np.float32}
        deep = Header(channels_of(dtypes), header.data_window, header.display_window, pixel_aspect=header.pixel_aspect,
                      attributes=attributes)
        clamped, window = 0, header.data_window
        with atomic_output(target) as temporary, DeepWriter(temporary, deep, self.options.compression,
                                                            self.options.threads, small=True) as writer:
            for rows in _row_blocks(*layers.weight.shape[1:]):
                block = encode_rows(layers, rows, self._dtype, by_depth=True)
                here = window.rows(window.ymin + rows.start, window.ymin + rows.stop)
                writer.write(deep_samples(block, here, names))
                clamped += block.clamped
        return clamped

    def _pictures(self, layers: FrameLayers, names: Sequence[str], with_depth: bool) -> tuple[list[Channels], int]:
        """One set of channels per layer, over form or contributions, and how many values were clamped."""
        number, height, width = layers.weight.shape
        pictures: list[Channels] = [
            {**{name: np.empty((height, width), self._dtype) for name in (*names, "A")},
             **({"Z": np.empty((height, width), np.float32)} if with_depth else {})} for _ in range(number)]
        clamped = 0
        for rows in _row_blocks(height, width):
            if self.options.contributions:
                block = contribution_rows(layers, rows, self.options.pixel_type)
            else:
                block = encode_rows(layers, rows, self._dtype, by_depth=False)
            clamped += block.clamped
            for picture, color, alpha, depth in zip(pictures, block.color, block.alpha, block.depth, strict=True):
                for name, plane in (*zip(names, color, strict=True), ("A", alpha), ("Z", depth)):
                    if name in picture:
                        picture[name][rows] = plane.reshape(-1, width)
        return pictures, clamped

    @property
    def _dtype(self) -> type[np.float16] | type[np.float32]:
        return np.float16 if self.options.pixel_type == "half" else np.float32

    def _attributes(self, layers: int, form: str) -> dict[str, Attribute]:
        values: dict[str, object] = {**self.provenance(), LAYERS_ATTRIBUTE: layers, FORM_ATTRIBUTE: form,
                                     ORDER_ATTRIBUTE: "front to back" if self.ordered else "none"}
        return {name: attribute(value) for name, value in values.items()}


def export_frames(options: ExportOptions, frames: Sequence[Frame] | None = None) -> JobReport[DenoisedFrame]:
    """Writes the layers of a file or a sequence; failed frames do not stop the others. `frames`: where they were found
    already.

    Raises InputError or UsageError for what concerns the whole job, before any frame is touched.
    """
    return run_job(SamplesJob if options.samples else ExportJob, options, frames)


def encode_rows(layers: FrameLayers, rows: slice, dtype: npt.DTypeLike, by_depth: bool) -> OverLayers:
    """Some rows of the layers in over form, pixels row by row; see `deep_io.layer_encoding.encode_layers`."""
    weight, coverage, depth = (plane[:, rows].reshape(len(plane), -1) for plane in (
        layers.weight, layers.coverage, layers.depth))
    return encode_layers(_color_rows(layers, rows), weight, coverage, depth, dtype, by_depth)


def contribution_rows(layers: FrameLayers, rows: slice, pixel_type: str) -> OverLayers:
    """Some rows of the layers as what each adds to the beauty and its alpha: their plain sum is the beauty."""
    number = len(layers.weight)
    color, clamped = to_pixel_type(_color_rows(layers, rows), pixel_type)
    alpha, _ = to_pixel_type(layers.coverage[:, rows].reshape(number, -1), pixel_type)
    depth = layers.depth[:, rows].reshape(number, -1)
    return OverLayers(color, alpha, np.where(np.isfinite(depth), depth, np.float32(MISS_DEPTH)),
                      layers.weight[:, rows].reshape(number, -1) > 0, clamped)


def _color_rows(layers: FrameLayers, rows: slice) -> npt.NDArray[np.float32]:
    """(L, 3 + E, P) radiance and AOVs of some rows."""
    planes = [layers.color, layers.extra] if layers.extra.size else [layers.color]
    flat = [plane[:, :, rows].reshape(*plane.shape[:2], -1) for plane in planes]
    return np.concatenate(flat, axis=1) if len(flat) > 1 else flat[0]


def layer_path(target: Path, layer: int) -> Path:
    """The file of one layer: shot.1001.exr becomes shot.layer0.1001.exr, still.exr still.layer0.exr."""
    head, dot, number = target.stem.rpartition(".")
    if dot and number.lstrip("-").isdigit():
        return target.with_name(f"{head}.layer{layer}.{number}{target.suffix}")
    return target.with_name(f"{target.stem}.layer{layer}{target.suffix}")


def _row_blocks(height: int, width: int) -> Iterator[slice]:
    step = max(1, BLOCK_PIXELS // width)
    for start in range(0, height, step):
        yield slice(start, min(start + step, height))
