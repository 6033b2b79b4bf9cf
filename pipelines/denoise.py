"""`lbmc denoise` as a function: frames in, denoised beauties out, each whole or not at all.

Per frame: survey, plan, network, write. The decisions of a sequence (exposure, depth scale, number of layers) are made
on its first frame and hold for all, so that nothing flickers.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from deep_io import sequences
from deep_io.atomic import Inputs, atomic_output, output_action
from deep_io.errors import InputError, LbmcError, UsageError
from deep_io.flat import to_half, write_flat
from deep_io.header import Header
from deep_io.path_samples import PathSamples
from model.denoiser import Denoiser
from model.features import FrameScale
from pipelines import __version__
from pipelines.aovs import Aovs, beauty_channels, find_aovs
from pipelines.decisions import Decisions, decide, surprises, zero_roles
from pipelines.frame_reader import FrameReader
from pipelines.frames import exposure_frame, find_frames
from pipelines.ids import IdChannel, find_ids, ranked_ids
from pipelines.inference import FrameLayers, denoise_bands
from pipelines.jobs import FrameSkippedError, JobReport, run_frames
from pipelines.keep import BEAUTY, WRITTEN, find_kept, kept_channels
from pipelines.light import hold_light
from pipelines.mirrors import ALL_FOUR, ALONE
from pipelines.network import choose_device, find_weights, load_network, product_dtype
from pipelines.options import DenoiseOptions
from pipelines.plan import FramePlan, Shot, fit, roles_of, writers
from pipelines.progress import Progress, make_progress
from pipelines.survey import Survey, survey
from pipelines.tiles import default_memory

KEEP_BLOCK_BYTES = 64 << 20
SURVEY_SHARE = 0.15  # of a frame's progress
LESS_MEMORY = "pass a smaller --memory, or run on a machine with more"
MODEL_ATTRIBUTE, WEIGHTS_ATTRIBUTE, VERSION_ATTRIBUTE = "lbmc:model", "lbmc:weights", "lbmc:version"


@dataclass(frozen=True)
class DenoisedFrame:
    """What became of one frame; a dry run writes no target."""

    target: Path | None
    plan: FramePlan


class Job:
    """The options of a job made concrete: the network on its device, and what the first frame decided."""

    def __init__(self, options: DenoiseOptions) -> None:
        self.options = options
        self.weights = find_weights(options.model)
        self.mirrors = ALL_FOUR if self.weights.mirrored else ALONE
        self.device = choose_device(options.device)
        if options.threads is not None:
            torch.set_num_threads(options.threads)
        self.net: Denoiser = load_network(self.weights).to(self.device)
        self.net.set_product_dtype(product_dtype(options.precision, self.device))
        self.memory = options.memory or default_memory()
        if options.layers is not None and options.layers > self.net.config.partition_logits:
            raise UsageError(f"--layers {options.layers}: {self.weights.name} has up to "
                             f"{self.net.config.partition_logits}")
        self.shot: Shot | None = None
        self.key: Survey | None = None
        self.sources: list[Path] = []
        self._told: set[str] = set()

    def open(self, source: Path) -> FrameReader:
        """Opens an input with the reading options. Refuses what lbmc wrote unless forced."""
        options = self.options
        reader = FrameReader(
            source,
            part=options.part,
            overrides=options.overrides,
            weighting=options.weighting,
            normals=options.normals,
            depth=options.depth,
            camera=options.camera,
            threads=options.threads,
        )
        if MODEL_ATTRIBUTE in reader.header.attributes and not options.force:
            reader.close()
            raise InputError(f"{source}: written by lbmc, so denoised already; pass --force to denoise it again")
        return reader

    def plan(self, source: Path, reader: FrameReader, update: Callable[[float], None]) -> FramePlan:
        """Surveys a frame and decides; the first frame that holds samples decides for the shot."""
        window, name = reader.header.data_window, os.fspath(source)
        aovs = find_aovs(self.options.aovs, reader.header, reader.mapping, name)
        ids = find_ids(self.options.ids, reader.header, name)
        written = writers(name, self.written(aovs, ids))
        kept = find_kept(reader.header, reader.weighting, self.options.keep, name, written)
        reader.carry(aovs.channels("light"), aovs.channels("data"))
        room = fit(reader, self.net, self.options.layers or self.net.config.layers, self.memory,
                   self.weights.mirrored, self.beside(reader))
        if room.keep and not self.options.dry_run:
            reader.keep()
        rows = 0

        def counted() -> Any:
            nonlocal rows
            for block in reader.blocks():
                rows += block.window.height
                yield block
                update(SURVEY_SHARE * rows / window.height)

        seen = surveyed(source, counted(), reader)
        shot = self.shot or self._decide(source, seen, reader.weighting)
        if reader.total:  # a frame without samples is like none other of the shot
            self.shot = shot
        if reader.weighting != shot.weighting:
            raise InputError(f"{source}: weighting {reader.weighting}, but the first frame has {shot.weighting}; "
                             f"pass --weighting for the whole sequence")
        held = shot.decided.held | (zero_roles(seen) if self.options.adapt else frozenset())
        present = tuple(role for role in self.net.config.roles if role in reader.mapping)
        roles = tuple(role for role in present if role not in held)
        if aovs.depth is not None and "depth" not in roles:
            raise UsageError(f"--aov {aovs.depth}: {self.weights.name} was trained without depth; choose another model")
        reader.forget(reader.mapping.sources.keys() - {*roles, "coverage"})
        return FramePlan(source, seen, shot, roles, room.bands, room.memory, reader.mapping, aovs, ids,
                         kept, held & {*present}, self.options.adapt, self.model, self.light)

    @property
    def light(self) -> bool | None:
        """Whether the picture's light is held; None where the job makes no picture."""
        return self.options.light

    @property
    def model(self) -> str:
        """For a reader."""
        weights = self.weights
        runs = f", the mean of {len(self.mirrors)} runs of {weights.path.stem} on the frame and its mirror images"
        return f"{weights.name}{runs if weights.mirrored else ''}"

    def beside(self, reader: FrameReader) -> int:
        """Bytes that a frame takes besides what every job holds of one."""
        return 0

    def _decide(self, source: Path, seen: Survey, weighting: str) -> Shot:
        """The shot's scale, both numbers of it, comes from one frame: chunks of a shot that name it agree exactly."""
        options = self.options
        key = self.key or self._first_survey(source, seen)
        scale = FrameScale(options.exposure or key.exposure, key.depth)
        decided = decide(key) if options.adapt else Decisions()
        needed = 1 if decided.one_layer else self.net.config.layers
        return Shot(scale, options.layers or needed, weighting, decided, roles_of(key))

    def _first_survey(self, source: Path, seen: Survey) -> Survey:
        """That of the job's first readable frame: a job resumed past frames that exist decides as it did at first."""
        for earlier in self.sources[:self.sources.index(source)] if source in self.sources else ():
            with suppress(LbmcError):
                return self.survey_of(earlier)
        return seen

    def decide_by(self, source: Path | None) -> None:
        """Makes a frame, if any is named, decide for the shot. All frames depend on it: what is wrong with it fails the
        job, once."""
        if source is not None:
            self.key = self.survey_of(source)

    def survey_of(self, source: Path) -> Survey:
        """What another frame of the shot is like. Raises LbmcError, also for a frame that says nothing of the shot."""
        with self.open(source) as reader:
            if not reader.total:
                raise InputError(f"{source}: there is no sample anywhere, so it cannot decide for others; name another "
                                 f"frame")
            return surveyed(source, reader.blocks(), reader)

    def frame(self, frame: sequences.Frame, progress: Progress) -> DenoisedFrame:
        """Denoises one frame. Raises FrameSkippedError, LbmcError."""
        targets = self.targets(frame)
        if not self.options.dry_run:
            targets = [path for path in targets if output_action(path, [frame.source], self.options.existing)]
            if not targets:
                raise FrameSkippedError(f"{frame.target} exists")
        with self.open(frame.source) as reader:
            plan = self.plan(frame.source, reader, progress.update)
            self._tell_memory(plan, progress)
            if self.options.dry_run:
                head = f"{frame.source} -> {', '.join(map(str, targets))}"
                print(head, *(f"  {line}" for line in plan.lines()), sep="\n", flush=True)
                return DenoisedFrame(None, plan.without_pictures())
            tell_repairs(frame.source, plan.survey.repairs, progress)
            self._tell_surprises(plan, progress)
            clamped = self.produce(frame, targets, plan, reader, lambda done: progress.update(
                SURVEY_SHARE + (1 - SURVEY_SHARE) * done))
        if clamped:
            progress.note(f"{frame.target}: {clamped} values beyond half's range were clamped; "
                          f"--pixel-type float keeps them")
        return DenoisedFrame(frame.target, plan.without_pictures())

    def _tell_surprises(self, plan: FramePlan, progress: Progress) -> None:
        """Once for each thing that a frame has and the shot was decided to do without, and for each role that only one
        of the two has."""
        for what, line in surprises(plan.shot.decided, plan.survey).items():
            if what not in self._told:
                self._told.add(what)
                progress.note(f"{plan.source}: {line}; if it matters, pass --exposure-from with a frame that has it, "
                              f"or --no-adapt")
        if not plan.survey.hits:
            return
        here, there = roles_of(plan.survey), plan.shot.roles
        for word, other, roles in (("lacks", "has", there - here), ("has", "lacks", here - there)):
            new = [role for role in self.net.config.roles if role in roles and f"{word} {role}" not in self._told]
            if new:
                self._told |= {f"{word} {role}" for role in new}
                drop = " ".join(f"--map {role}=none" for role in new)
                progress.note(f"{plan.source}: {word} {', '.join(new)}, which the frame that decided for the shot "
                              f"{other}, so they may differ visibly; render all frames with the same channels, or pass "
                              f"{drop} for all of them")

    def _tell_memory(self, plan: FramePlan, progress: Progress) -> None:
        """Once for a job, where a frame takes more than its budget however it is cut."""
        if plan.memory > self.memory and "memory" not in self._told:
            self._told.add("memory")
            progress.note(f"{plan.source}: needs about {plan.memory / 2**30:.3g} GiB even in its smallest bands, more "
                          f"than the {self.memory / 2**30:.3g} GiB of --memory; have that much free")

    def produce(self, frame: sequences.Frame, wanted: list[Path], plan: FramePlan, reader: FrameReader,
                update: Callable[[float], None]) -> int:
        """Denoises a frame and writes the files wanted; returns how many values were clamped to half's range."""
        layers = denoise_bands(reader, self.net, plan.shot.scale, plan.roles, plan.shot.layers, plan.bands, update,
                               plan.held, plan.survey.cells if plan.adapt else None, self.mirrors)
        if self.options.light:
            hold_light(layers, plan.survey.light, plan.survey.cells.mask, reader.carried_lights)
        return self.write(frame, wanted, plan, layers, reader.header)

    def written(self, aovs: Aovs, ids: Sequence[IdChannel]) -> list[tuple[str, Iterable[str]]]:
        """What writes which channels beside the beauty, pixel means to be kept left out."""
        depth = () if aovs.depth is None else (aovs.depth,)
        return [(BEAUTY, WRITTEN), ("--aov", (*aovs.outputs, *depth)),
                *((f"--ids {one.channel}", one.outputs) for one in ids)]

    def targets(self, frame: sequences.Frame) -> list[Path]:
        """The files that a frame becomes."""
        assert frame.target is not None
        return [frame.target]

    def write(self, frame: sequences.Frame, wanted: list[Path], plan: FramePlan, layers: FrameLayers, header: Header
              ) -> int:
        """Writes those of a frame's files that are wanted; returns how many values were clamped to half's range."""
        channels, attributes, clamped = self.beauty(frame, plan, layers)
        if self.options.keep:
            channels |= kept_channels(os.fspath(frame.source), self.options.part, plan.kept, KEEP_BLOCK_BYTES)
        for target in wanted:
            with atomic_output(target) as temporary:
                write_flat(temporary, channels, header, self.options.compression,
                           {**self.provenance(), **attributes})
        return clamped

    def beauty(self, frame: sequences.Frame, plan: FramePlan, layers: FrameLayers
               ) -> tuple[dict[str, npt.NDArray[Any]], dict[str, str], int]:
        """R, G, B, A, AOVs and ids to be written, attributes for them, and how many values were clamped."""
        beauty = layers.beauty()
        planes = {**beauty_channels(plan.aovs, layers), **{name: beauty[..., k] for k, name in enumerate("RGB")},
                  "A": layers.alpha()}
        channels: dict[str, npt.NDArray[Any]] = {}
        clamped = 0
        for name, plane in planes.items():
            kind = "float" if name == plan.aovs.depth else self.options.pixel_type
            values, beyond = to_pixel_type(np.ascontiguousarray(plane), kind)
            channels[name] = values
            clamped += beyond
        if not plan.ids:
            return channels, {}, clamped
        with self.open(frame.source) as reader:
            ids, attributes = ranked_ids(reader, self.options.part, plan.ids)
        return {**channels, **ids}, attributes, clamped

    def provenance(self) -> dict[str, str]:
        """Header attributes that say what made a file; no times, so that the same input gives the same bytes."""
        return {
            VERSION_ATTRIBUTE: __version__,
            MODEL_ATTRIBUTE: self.weights.name,
            WEIGHTS_ATTRIBUTE: self.weights.digest,
        }


def denoise_frames(options: DenoiseOptions, frames: Sequence[sequences.Frame] | None = None
                   ) -> JobReport[DenoisedFrame]:
    """Denoises a file or a sequence; failed frames do not stop the others. `frames`: where they were found already.

    Raises InputError or UsageError for what concerns the whole job, before any frame is touched.
    """
    return run_job(Job, options, frames)


def run_job(kind: type[Job], options: DenoiseOptions, frames: Sequence[sequences.Frame] | None = None
            ) -> JobReport[DenoisedFrame]:
    """Runs a job of some kind on the frames that its options name; raises what `denoise_frames` does."""
    frames = find_frames(options) if frames is None else frames
    job = kind(options)
    job.sources = [frame.source for frame in frames]
    to_do = options.dry_run
    if not options.dry_run:
        inputs = Inputs(job.sources)
        for frame in frames:  # a refused output is found before hours of work, not after
            for target in job.targets(frame):
                to_do |= output_action(target, inputs, options.existing)
    if to_do:
        job.decide_by(exposure_frame(options))
    progress = make_progress(options.progress, len(frames))
    with progress:
        if options.frames is None and (gaps := sequences.gaps(frames)) and not sequences.has_range(options.source):
            progress.note(f"{options.source}: frames not on disk, skipped: {gaps} (name them with --frames to make "
                          f"this an error)")
        return run_frames(frames, job.frame, progress, str, cure=LESS_MEMORY)


def surveyed(source: Path, blocks: Iterable[PathSamples], reader: FrameReader) -> Survey:
    """What a frame is like, of which `blocks` are all samples. Raises InputError where none of them has a radiance."""
    seen = survey(blocks, reader.header.display_window)
    if seen.samples == 0:
        raise InputError(f"{source}: no sample has a finite radiance; render the frame again")
    return seen


def to_pixel_type(values: npt.NDArray[np.float32], pixel_type: str) -> tuple[npt.NDArray[Any], int]:
    """Values in the type to be written, and how many were clamped to half's range."""
    return (values, 0) if pixel_type == "float" else to_half(values)


def tell_repairs(source: Path, repairs: dict[str, int], progress: Progress) -> None:
    """One line on what was broken in the input: not finite, or too large to be true."""
    if repairs:
        listed = ", ".join(f"{count} {role}" for role, count in sorted(repairs.items()))
        progress.note(f"{source}: broken values, not finite or too large, are left out or replaced: {listed}")
