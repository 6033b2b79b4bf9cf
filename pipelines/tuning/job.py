"""`lbmc tune` as a function: frames in, weights fitted to them out.

A network that was trained on other scenes is fitted to this one by what its own samples tell: half of them are
denoised, and held against the other half. No reference is needed, and none is used.
"""

from __future__ import annotations

import copy
import math
import os
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from deep_io.atomic import Inputs, atomic_output, output_action
from deep_io.errors import InputError, LbmcError
from deep_io.path_samples import PathSamples
from deep_io.sequences import Frame
from model import zoo
from model.compositing import Layers
from model.losses import drift, held_error
from model.metrics import common_scale
from model.weight_files import MIRRORED_KEY
from pipelines.denoise import Job, tell_repairs
from pipelines.frame_reader import FrameReader
from pipelines.frames import exposure_frame, find_sources
from pipelines.inference import to_model
from pipelines.mirrors import ALL_FOUR
from pipelines.plan import FramePlan
from pipelines.progress import Progress, make_progress
from pipelines.signals import raise_if_stopped
from pipelines.training.recipe import SMALLEST_CROP
from pipelines.tuning.halves import Crop, cut
from pipelines.tuning.options import TuneOptions, steps_for

CROP = 128  # pixels along a side, as in training
CROPS = 4  # a step
MOST_SAMPLES = 1 << 23  # of all crops together; about 0.8 GB
MOST_OF_A_CROP = 1 << 20  # samples; denoising them, forward and back, takes about 2.5 GB
RATE, MOMENTUM = 1e-2, 0.9
CLIP = 0.25  # of the gradient's norm, usually 0.05 to 0.3: one bright sample, held back from the dark, has 20
AVERAGE = 0.9  # what the averaged weights, which are written, keep each step; less of the first ones
STAY = 1.0  # how much `drift` counts
CHECKED, LIGHT = 8, 0.03  # crops whose light is compared at the end, and how far its logarithm may be off
SHARES = (1.0, 0.7, 0.5, 0.35, 0.25)  # of what was changed; the largest that keeps the light is written
READING_SHARE = 0.2  # of the progress


@dataclass(frozen=True)
class Tuned:
    """What became of it: the file written, frames and crops that were looked at, steps made."""

    path: Path
    frames: int
    crops: int
    steps: int


@dataclass(frozen=True)
class _Place:
    """A crop, and how its frame is read."""

    crop: Crop
    plan: FramePlan


def tune(options: TuneOptions, frames: Sequence[Frame] | None = None) -> Tuned | None:
    """Fits weights to the frames and writes them; None where the file exists and may stay.

    Raises InputError and UsageError, naming the file, for what cannot be read or tells nothing. The weights appear
    whole or not at all. On a CPU the same frames, seed, machine and threads give the same bytes.
    """
    reading = options.reading
    frames = find_sources(reading) if frames is None else frames
    sources = [frame.source for frame in frames]
    target = Path(reading.target)
    if not output_action(target, Inputs(sources), options.existing):
        return None
    job = Job(reading)
    job.sources = sources
    job.decide_by(exposure_frame(reading))
    with make_progress(options.progress, 1) as progress:
        progress.begin(str(target))
        rng = np.random.default_rng(options.seed)
        places = _gather(job, _spread(sources, options.most_frames), rng, progress)
        steps = options.steps or steps_for(_area(places))
        share = _keep(job, places, _descend(job, places, steps, rng, progress))
        frames_used = len({place.plan.source for place in places})
        made = {"from": job.weights.name, "weights": job.weights.digest, "frames": frames_used, "crops": len(places),
                "steps": steps, "seed": options.seed, "share": share}
        with atomic_output(target) as temporary:
            zoo.save(job.net.cpu(), temporary, _info(job.weights, os.path.basename(reading.source), made))
        progress.finish()
    return Tuned(target, frames_used, len(places), steps)


def _info(parent: zoo.Weights, source: str, made: dict[str, Any]) -> dict[str, Any]:
    """What the file says of itself; scores of the weights that it started from are not its own."""
    info = {key: value for key, value in parent.info.items() if key in ("data", "recipe", "steps")}
    info |= {"description": f"{parent.name}, tuned to {source}", "tuned": made}
    return info | ({MIRRORED_KEY: True} if parent.mirrored else {})


def _spread(sources: Sequence[Path], most: int) -> list[Path]:
    """At most so many, evenly spread, the first among them."""
    numbers = np.unique(np.linspace(0, len(sources) - 1, min(most, len(sources))).round().astype(int))
    return [sources[number] for number in numbers]


def _gather(job: Job, sources: Sequence[Path], rng: np.random.Generator, progress: Progress) -> list[_Place]:
    """Crops of all frames, as many of each; all of a frame's where they are few. A frame that tells nothing is passed
    over, and named; if all are, that of the first is the error."""
    places: list[_Place] = []
    failures: list[LbmcError] = []
    for number, source in enumerate(sources):
        try:
            places += _of_frame(job, source, MOST_SAMPLES // len(sources), rng, progress)
        except LbmcError as error:
            failures.append(error)
            if len(sources) > 1:
                progress.note(f"{error} (passed over)")
        progress.update(READING_SHARE * (number + 1) / len(sources))
    if not places:
        raise failures[0]
    return [places[number] for number in rng.permutation(len(places))]


def _of_frame(job: Job, source: Path, room: int, rng: np.random.Generator, progress: Progress) -> list[_Place]:
    """Crops of one frame, at least one. Raises LbmcError where none tells anything."""
    with job.open(source) as reader:
        if reader.weighting == "over":
            raise InputError(f"{source}: its samples are composited over each other, so they cannot be dealt into "
                             f"independent halves; tune on path samples, of equal weight")
        plan = job.plan(source, reader, lambda _: None)
        tell_repairs(source, plan.survey.repairs, progress)
        light = plan.survey.light
        try:
            scale = common_scale(light[np.isfinite(light)])
        except ValueError as error:
            raise InputError(f"{source}: nothing to learn from: {error}; name other frames") from None
        plan, places = plan.without_pictures(), []
        for samples in _cuts(reader, plan.roles, room, rng):
            if samples.counts.max() > 1:
                start = _start(job, plan, samples) * np.float32(scale)
                places.append(_Place(Crop(samples, start, scale), plan))
            raise_if_stopped()
    if not places:
        raise InputError(f"{source}: no pixel holds two samples, so none can be held against the others; render more "
                         f"samples per pixel")
    return places


def _area(places: Sequence[_Place]) -> float:
    """How many crops of full size the pixels looked at would fill; those of crops that overlap count once."""
    filled = sum(place.crop.size[0] * place.crop.size[1] for place in places)
    frames = {place.plan.source: place.plan.survey.pixels for place in places}
    return min(filled, sum(frames.values())) / CROP**2


def _cuts(reader: FrameReader, roles: Collection[str], room: int, rng: np.random.Generator) -> Iterator[PathSamples]:
    """Crops of one frame, drawn from those that cover it, which together hold about `room` samples at most; at least
    one. With many samples per pixel they are smaller."""
    window = reader.header.data_window
    dense = max(reader.total / (window.width * window.height), 1)
    side = max(int(min(CROP, (MOST_OF_A_CROP / dense) ** 0.5)) // SMALLEST_CROP, 1) * SMALLEST_CROP
    rows, columns = _edges(window.height, side), _edges(window.width, side)
    corners = [(y, x) for y in rows for x in columns]
    each = dense * min(window.height, side) * min(window.width, side)
    count = max(min(len(corners), int(room / each)), 1)
    for index in np.sort(rng.permutation(len(corners))[:count]):
        y, x = corners[index]
        block = reader.read(window.ymin + y, window.ymin + min(y + side, window.height))
        yield cut(block, x, min(x + side, window.width), roles)


@torch.inference_mode()
def _start(job: Job, plan: FramePlan, samples: PathSamples) -> npt.NDArray[np.float32]:
    """(H, W, 3) what the network makes of all samples of a crop."""
    picture: npt.NDArray[np.float32] = _beauty(job, plan, samples)[0].permute(1, 2, 0).cpu().numpy()
    return picture


def _beauty(job: Job, plan: FramePlan, samples: PathSamples) -> torch.Tensor:
    """(1, 3, H, W)."""
    given = to_model(samples, plan.roles, plan.shot.scale.depth, job.device, held=plan.held)
    layers: Layers = job.net(given, plan.shot.scale, plan.shot.layers)
    return layers.beauty()


def _edges(size: int, side: int) -> list[int]:
    """Where crops of `side` pixels begin that cover `size`, evenly; they overlap where it is no multiple."""
    count = -(-size // side)
    return [round(place) for place in np.linspace(0, max(size - side, 0), count)]


def _descend(job: Job, places: Sequence[_Place], steps: int, rng: np.random.Generator, progress: Progress
             ) -> dict[str, torch.Tensor]:
    """Gradient descent on the network of the job; returns the averaged weights.

    Plain, not Adam: a few steps on a few noisy crops may move weights only where the gradient is large for all of them.
    """
    net = job.net.train().requires_grad_(True)
    averaged = copy.deepcopy(net.state_dict())
    optimizer = torch.optim.SGD(net.parameters(), RATE, MOMENTUM)
    batch, order = min(CROPS, len(places)), _cycle(len(places), rng)
    for step in range(steps):
        optimizer.zero_grad()
        for _ in range(batch):
            (_loss(job, places[next(order)], rng) / batch).backward()
        norm = torch.nn.utils.clip_grad_norm_(net.parameters(), CLIP)
        if bool(norm.isfinite()):
            optimizer.step()
        kept = min(AVERAGE, (step + 1) / (step + 4))
        for name, values in net.state_dict().items():
            averaged[name].lerp_(values, 1 - kept)
        raise_if_stopped()
        progress.update(READING_SHARE + (1 - READING_SHARE) * (step + 1) / steps)
    return averaged


def _keep(job: Job, places: Sequence[_Place], found: dict[str, torch.Tensor]) -> float:
    """Gives the network as much of what was found as keeps the light of the crops; returns how much, a share.

    Light that few samples carry is the first thing that descent gives up. Raises InputError where no share will do.
    """
    start = job.weights.load().to(job.device).state_dict()
    for share in SHARES:
        state = {name: torch.lerp(values, found[name], share) for name, values in start.items()}
        job.net.load_state_dict(state)
        finite = all(bool(values.half().isfinite().all()) for values in state.values())
        if finite and _changed_light(job, places) <= LIGHT:
            return share
    raise InputError(f"{places[0].plan.source}: tuning went astray, its samples are too wild to learn from; denoise "
                     f"with {job.weights.name} as it is")


def _changed_light(job: Job, places: Sequence[_Place]) -> float:
    """|log| of the light of these crops over what it was at the start; infinite where it is not a number."""
    places = places[:CHECKED]
    light = [float(_start(job, place.plan, place.crop.samples).sum(dtype=np.float64)) * place.crop.scale
             for place in places]
    before = sum(float(place.crop.start.sum(dtype=np.float64)) for place in places)
    ratio = sum(light) / before if before > 0 else math.nan
    return abs(math.log(ratio)) if ratio > 0 else math.inf


def _cycle(count: int, rng: np.random.Generator) -> Iterator[int]:
    """All numbers below `count` in some order, then in another, and so on."""
    while True:
        yield from rng.permutation(count).tolist()


def _loss(job: Job, place: _Place, rng: np.random.Generator) -> torch.Tensor:
    halves = place.crop.deal(rng, ALL_FOUR[int(rng.integers(len(ALL_FOUR)))])
    beauty = _beauty(job, place.plan, halves.given) * place.crop.scale
    held, variance, start, known = (
        plane.to(job.device) for plane in (halves.held, halves.variance, halves.start, halves.known))
    return held_error(beauty, held, variance, known) + STAY * drift(beauty, start, variance)
