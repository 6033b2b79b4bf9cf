"""`lbmc pack` as a function: N flat one-sample renders of a frame into one deep sample file of weighting `packed`.

Any deep reader flattens the result to the mean of the renders; lbmc reads it back as N path samples per pixel.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deep_io.aliases import DISTANCE, VIEW, WORLD
from deep_io.atomic import Existing, Inputs, atomic_output, output_action
from deep_io.camera import Camera, parse_camera
from deep_io.conventions import DEPTH_ATTRIBUTE, NORMALS_ATTRIBUTE, Conventions, resolve
from deep_io.decoding import LARGEST_RADIANCE, Interpretation, path_samples, radiance_values
from deep_io.deep_writer import DeepWriter
from deep_io.errors import InputError, UsageError
from deep_io.flat import HALF_MAX, kept_attributes, to_half
from deep_io.header import Header, channels_of, read_headers
from deep_io.roles import MISS_DEPTH, ROLES, RoleMap
from deep_io.samples import DeepSamples
from deep_io.sequences import (
    expand,
    frame_path,
    has_pattern,
    has_range,
    is_sequence,
    parse_frames,
    require_exr,
    substitute,
)
from deep_io.weighting import ATTRIBUTE, RADIANCE_LAYERS, Packed, encode_packed
from pipelines import __version__
from pipelines.flat_renders import BAND_BYTES, RenderStack, open_renders
from pipelines.jobs import FrameSkippedError, JobReport, run_frames
from pipelines.progress import Progress, ProgressKind, make_progress

PathLike = str | os.PathLike[str]

SEED_TOKEN = "@SEED@"
# Beyond this many samples L / n in half loses its digits to underflow, so radiance is written as float.
MOST_IN_HALF = 16
_BLOCK_SAMPLES = 1 << 20
LIGHT = "_light"  # ends the name of a layer of light that is otherwise a role's
ROUNDING = 2.0**-10  # by so much an alpha may leave 0..1 without being spoken of
BEYOND = "alpha beyond 0..1"  # among the repairs
OVERFLOW = "radiance overflow"  # among the repairs: radiance beyond half, stored as Inf
_REPAIRED = {
    "depth": "whose depth is negative, not finite or too large, stored as unknown",
    "radiance": f"left out: their radiance is not finite, or beyond {LARGEST_RADIANCE:g}",
    BEYOND: "of an alpha below 0 or above 1, stored as 0 or 1",
    OVERFLOW: f"of radiance stored as Inf, which in half is an overflow: read as {HALF_MAX:g}",
}


@dataclass(frozen=True)
class PackOptions:
    """How renders become a deep sample file.

    overrides    role -> layer, as for `lbmc denoise`
    layers       further layers of light (light groups, lobes) to carry along, encoded as radiance is
    normals, depth, camera   see deep_io.conventions.resolve; what cannot be converted is kept and said
    pixel_type   "half" or "float" of the channels; depth and alpha are float always, radiance above 16 samples too
    compression  none, rle or zips
    existing     "refuse", "overwrite" or "skip"
    threads      encoding threads, None for one per core
    """

    overrides: Mapping[str, str] = field(default_factory=dict)
    layers: tuple[str, ...] = ()
    normals: str = "auto"
    depth: str = "auto"
    camera: Camera | str | None = None
    pixel_type: str = "half"
    compression: str = "zips"
    existing: Existing = "refuse"
    threads: int | None = None


@dataclass(frozen=True)
class PackJob:
    """One deep sample file to write: the renders of a frame (number None outside a sequence) and the target."""

    number: int | None
    sources: tuple[Path, ...]
    target: Path

    def __str__(self) -> str:
        return self.target.name


@dataclass(frozen=True)
class PackReport:
    """What was written. `notes` say what was assumed and left as it was; `repairs` count broken values by role."""

    target: Path
    samples: int
    mapping: RoleMap
    notes: tuple[str, ...]
    repairs: Counter[str]

    def lines(self) -> list[str]:
        """The report as text."""
        mended = [f"{self.target}: {count} samples {_REPAIRED.get(role, f'without finite {role}')}"
                  for role, count in sorted(self.repairs.items()) if count]
        held = f"{self.samples} sample{'s' if self.samples != 1 else ''} per pixel"
        return [f"{self.target}: {held}", *self.mapping.lines(), *self.notes, *mended]


def plan(sources: Sequence[PathLike], target: PathLike, seeds: str | None = None, frames: str | None = None
         ) -> list[PackJob]:
    """Which renders go into which file.

    sources  files of one frame; or patterns `shot.s1.####.exr`, one for each seed, with a pattern as target; or, with
             `seeds` ("1-8"), one name that holds @SEED@
    frames   range of a sequence; by default all that are on disk, of any seed
    Raises InputError for files or frames that are missing and when only one of sources and target is a sequence,
    UsageError for options that contradict.
    """
    require_exr(target)
    patterns = [os.fspath(source) for source in sources]
    if seeds is not None:
        if len(patterns) != 1:
            raise UsageError(f"--seeds {seeds}: takes one name with {SEED_TOKEN}, not {len(patterns)} names")
        width = len(seeds) - len(seeds.lstrip("0123456789")) if seeds.startswith("0") else 1  # 01-12: 01, 02, ...
        numbers = [str(seed).zfill(width) for seed in parse_frames(seeds, f"--seeds {seeds}")]
        patterns = substitute(patterns[0], SEED_TOKEN, numbers)
    if not patterns:
        raise UsageError("pack needs at least one render")
    for pattern in patterns:
        if SEED_TOKEN in pattern:
            raise UsageError(f"{pattern}: holds {SEED_TOKEN}; give the seeds with --seeds 1-8")
    many = [pattern for pattern in patterns if is_sequence(pattern)]
    if not many:
        if is_sequence(target):
            raise InputError(f"{os.fspath(target)}: OUT is a sequence but the renders are single files")
        if frames is not None:
            raise UsageError(f"{patterns[0]}: --frames is given, but the name has no pattern such as ####")
        return [PackJob(None, tuple(expand(pattern)[0].source for pattern in patterns), Path(target))]
    if len(many) != len(patterns):
        raise InputError(f"{next(p for p in patterns if p not in many)}: is a single file among sequences; "
                         f"name a pattern for every seed")
    if not has_pattern(target):
        raise InputError(f"{os.fspath(target)}: the renders are sequences ({many[0]}) but OUT is a single file; write "
                         f"the frame number into OUT as well, or name the files of one frame")
    if frames is None:  # those of all seeds, so that one which lacks a frame is found out
        naming = [pattern for pattern in patterns if has_range(pattern)] or patterns
        frames = ",".join(map(str, sorted({frame.number or 0 for pattern in naming for frame in expand(pattern)})))
    by_seed = [expand(pattern, frames) for pattern in patterns]
    return [PackJob(of_frame[0].number, tuple(frame.source for frame in of_frame),
                    frame_path(target, int(of_frame[0].number or 0))) for of_frame in zip(*by_seed, strict=True)]


def pack_frames(jobs: Sequence[PackJob], options: PackOptions | None = None, progress: ProgressKind = "auto"
                ) -> JobReport[PackReport]:
    """Pack every job; one that fails does not stop the others. Refused outputs raise before any work is done."""
    options = options or PackOptions()
    every_source = Inputs(source for job in jobs for source in job.sources)
    for job in jobs:
        _writes(job.target, every_source, options.existing)

    told: set[str] = set()

    def work(job: PackJob, voice: Progress) -> PackReport:
        report = pack(job.sources, job.target, options, voice)
        if report is None:
            raise FrameSkippedError(f"{job.target} exists")
        for line in report.lines():
            if line not in told:  # The frames of a sequence are alike: the mapping is said once.
                told.add(line)
                voice.note(line)
        return report

    with make_progress(progress, len(jobs)) as voice:
        return run_frames(jobs, work, voice, str)


def pack(sources: Sequence[PathLike], target: PathLike, options: PackOptions | None = None,
         progress: Progress | None = None) -> PackReport | None:
    """Pack the renders of one frame into `target`; None where it exists and is to be skipped.

    Raises InputError for renders that do not fit together, are unreadable, or hold the same picture twice; UsageError
    for a refused output; MemoryError, naming it, when a block of rows does not fit.
    """
    options = options or PackOptions()
    if options.pixel_type not in ("half", "float"):
        raise UsageError(f"--pixel-type {options.pixel_type}: must be half or float")
    if not _writes(target, sources, options.existing):
        return None
    stack = open_renders(sources, options.overrides, options.layers)
    how, repairs = _Encoding(stack, options), Counter[str]()
    try:
        _write(stack, how, target, options, repairs, progress)
    except MemoryError as error:
        raise MemoryError(f"{os.fspath(target)}: {error}") from error
    return PackReport(Path(target), len(stack.renders), stack.mapping, tuple(how.notes), repairs)


def _write(stack: RenderStack, how: _Encoding, target: PathLike, options: PackOptions, repairs: Counter[str],
           progress: Progress | None) -> None:
    """Write the whole file block by block, or none; what had to be mended is added to `repairs`."""
    window = stack.header.data_window
    with atomic_output(target) as temporary, DeepWriter(temporary, how.header, options.compression,
                                                        options.threads) as writer:
        for block in stack.blocks(_BLOCK_SAMPLES):
            writer.write(how.encode(block, repairs))
            if progress:
                progress.update((block.window.ymax + 1 - window.ymin) / window.height)


def _writes(target: PathLike, sources: Sequence[PathLike] | Inputs, existing: Existing) -> bool:
    """Whether a target is to be written, see `output_action`. A flat EXR is likelier the last render of a command
    without OUT than what was packed before, so it is never replaced."""
    writes = output_action(target, sources, existing)
    if writes and os.path.exists(target) and _is_flat(target):
        raise UsageError(f"{os.fspath(target)}: is a flat EXR, which pack does not replace; name OUT last, or remove "
                         f"it first")
    return writes


def _is_flat(path: PathLike) -> bool:
    try:
        return not any(header.is_deep for header in read_headers(path))
    except InputError:
        return False


class _Encoding:
    """How one stack is written: the conversions, the types of the channels, the header."""

    def __init__(self, stack: RenderStack, options: PackOptions) -> None:
        mapping, path = stack.mapping, stack.renders[0].file.path
        self.mapping = mapping
        self.notes = [f"assumed: {len(stack.renders)} renders of one sample per pixel each, pixel filter box"]
        if stack.pieces > 1:
            self.notes.append(f"the renders are decompressed up to {stack.pieces} times over: rows stored together, "
                              f"of all of them, are more than {BAND_BYTES >> 20} MiB; ZIP, 16 rows, is faster")
        self.light_channels = self._light_channels([name for name in stack.channels if name not in mapping.channels])
        attributes: dict[str, object] = {ATTRIBUTE: "packed", "lbmc:version": __version__}
        camera = parse_camera(options.camera) if isinstance(options.camera, str) else options.camera
        given = resolve(stack.header, mapping, path, options.normals, options.depth, camera, strict=False)
        self.conventions = self._convertible(given, attributes)
        if self.light_channels:
            attributes[RADIANCE_LAYERS] = sorted({name.rpartition(".")[0] for name in self.light_channels.values()})
        # Coverage is left out: alpha is stored as rendered, also on an opaque sky that no ray hit.
        features = RoleMap({role: source for role, source in mapping.sources.items() if role != "coverage"})
        self.how = Interpretation(stack.header, features, "uniform", True, self.conventions, path)
        self.radiance_type = self._radiance_type(stack, options)
        feature_type = np.float16 if options.pixel_type == "half" else np.float32
        types: dict[str, Any] = {name: feature_type for role in mapping.roles for name in ROLES[role].channels}
        types |= dict.fromkeys((*ROLES["radiance"].channels, *self.light_channels.values()), self.radiance_type)
        self.types = types | {"A": np.float32, "Z": np.float32}
        kept = replace(stack.header, attributes=kept_attributes(stack.header), structure={}, name="",
                       type="deepscanline", line_order="increasing", channels=channels_of(self.types))
        self.header: Header = kept.with_attributes(attributes)

    def _light_channels(self, names: Sequence[str]) -> dict[str, str]:
        """What the channels of light to carry along are called in the file: as in the renders, if no role is."""
        roles = {name for role in self.mapping.roles for name in ROLES[role].channels}
        taken = {name.rpartition(".")[0] for name in names if name in roles}
        self.notes += [f"the layer {layer} is written as {layer}{LIGHT}: {layer} is a role of the file"
                       for layer in sorted(taken)]
        return {name: f"{layer}{LIGHT if layer in taken else ''}.{suffix}"
                for name in names for layer, _, suffix in [name.rpartition(".")]}

    def _convertible(self, given: Conventions, attributes: dict[str, object]) -> Conventions:
        """What can be converted now; the rest is stored as it is, and the header and the notes say so."""
        if given.space == WORLD and "normal" in self.mapping and given.camera.world_to_camera is None:
            attributes[NORMALS_ATTRIBUTE] = WORLD
            self.notes.append("normals stay in world space: no worldToCamera; denoising needs --camera FILE")
            given = replace(given, space=VIEW)
        if given.distance and given.camera.field_of_view is None:
            attributes[DEPTH_ATTRIBUTE] = DISTANCE
            self.notes.append("depth stays the length of the ray: no field of view; denoising needs --camera DEGREES")
            given = replace(given, distance=False)
        if "depth" not in self.mapping:
            attributes[DEPTH_ATTRIBUTE] = "none"
            self.notes.append("no depth: Z only numbers the samples")
        return given

    def _radiance_type(self, stack: RenderStack, options: PackOptions) -> Any:
        if options.pixel_type == "float":
            return np.float32
        if len(stack.renders) > MOST_IN_HALF:
            self.notes.append(f"radiance is float: half underflows with more than {MOST_IN_HALF} samples")
            return np.float32
        colours = [*self.mapping["radiance"].channels, *self.light_channels]
        if stack.goes_beyond_half(colours):
            self.notes.append("radiance is float: it goes beyond the range of half")
            return np.float32
        return np.float16

    def encode(self, block: DeepSamples, repairs: Counter[str]) -> DeepSamples:
        """A block of renders as packed samples; what had to be mended is added to `repairs`."""
        block = self._without_broken(block, repairs)
        counts = block.counts.ravel()
        alpha = self._alpha(block, repairs)
        samples = path_samples(block, self.how)
        # Those without a radiance are gone already: what is mended of it are the overflows.
        repairs.update({OVERFLOW if role == "radiance" else role: count for role, count in samples.repairs.items()})
        hit = samples.coverage > 0
        alpha = np.where(hit, 1, 0).astype(np.float32) if alpha is None else alpha
        if "depth" in samples.roles:
            # A miss by its alpha may carry any depth; a hit of broken depth is stored as 0, which reads as unknown.
            depth = np.where(hit & (alpha > 0), samples.roles["depth"][:, 0], np.float32(MISS_DEPTH))
        else:
            depth = np.ones(alpha.size, np.float32)
        packed = encode_packed(counts, alpha, depth)
        channels: dict[str, NDArray[np.generic]] = {"A": packed.alpha.astype(np.float32), "Z": packed.depth}
        for role, values in samples.roles.items():
            if role != "depth":
                for index, name in enumerate(ROLES[role].channels):
                    channels[name] = self._stored(name, values[:, index], packed, role == "radiance")
        for source, name in self.light_channels.items():
            values, sound = radiance_values(block.channels[source])
            repairs[source] += int(np.count_nonzero(~sound))
            channels[name] = self._stored(name, np.where(sound, values, 0), packed, True)
        return DeepSamples(block.counts, {name: channels[name] for name in self.types}, block.window)

    def _stored(self, name: str, values: NDArray[np.float32], packed: Packed, like_radiance: bool
                ) -> NDArray[np.generic]:
        ordered = values[packed.order]
        if like_radiance:
            ordered = (ordered * packed.scale).astype(np.float32)
        return to_half(ordered)[0] if self.types[name] == np.float16 else ordered

    def _without_broken(self, block: DeepSamples, repairs: Counter[str]) -> DeepSamples:
        """The block without samples whose radiance denoising would leave out: pixels are the means of the others."""
        whole = np.ones(block.total, bool)
        for name in self.mapping["radiance"].channels:
            whole &= radiance_values(block.channels[name])[1]
        if whole.all():
            return block
        repairs["radiance"] += int(np.count_nonzero(~whole))
        counts = np.add.reduceat(whole, block.offsets[:-1]).astype(np.int32).reshape(block.counts.shape)
        return DeepSamples(counts, {name: values[whole] for name, values in block.channels.items()}, block.window)

    def _alpha(self, block: DeepSamples, repairs: Counter[str]) -> NDArray[np.float32] | None:
        if "coverage" not in self.mapping:
            return None
        alpha = np.asarray(block.channels[self.mapping["coverage"].channels[0]], np.float32)
        broken = ~np.isfinite(alpha)
        repairs["coverage"] += int(np.count_nonzero(broken))
        repairs[BEYOND] += int(np.count_nonzero(~broken & ((alpha < -ROUNDING) | (alpha > 1 + ROUNDING))))
        return np.clip(np.where(broken, 0, alpha), 0, 1).astype(np.float32)
