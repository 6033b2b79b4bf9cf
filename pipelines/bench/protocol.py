"""The protocol of a bench: what runs in which order, and what is kept.

Every method runs once on every scene to be scored. Then all methods take turns on the frames that are timed, once to
warm up and `repeats` times more, of which the medians count. Errors are those of the files written, in half precision.
What one method cannot do on one scene is left out; the rest goes on.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TypeVar

import torch

from deep_io.errors import InputError
from model.denoiser import Denoiser
from pipelines.bench.attempts import Attempts
from pipelines.bench.clock import Times
from pipelines.bench.growth import SIDE, growth
from pipelines.bench.machine import machine
from pipelines.bench.memory import measurable, peak_memory
from pipelines.bench.methods import PAPER, LbmcMethod, Method, MethodSpec, make, method_specs, oidn_installed, shipped
from pipelines.bench.options import BenchOptions
from pipelines.bench.report import Gallery
from pipelines.bench.results import CurvePoint, Measurement, Results, SceneInfo
from pipelines.bench.savings import FullModel, SavingsBench
from pipelines.bench.scenes import Scene, write_thinned
from pipelines.bench.tables import unpaired_line
from pipelines.bench.timing import TimedFrame, as_it_is, enlarged, for_untrained, take_turns
from pipelines.flat_pictures import read_rgb
from pipelines.jobs import describe_error
from pipelines.progress import Progress, make_progress

Item = TypeVar("Item")
SceneScores = dict[str, dict[str, float | None]]
"""Method to its scores on one scene."""

EVERY_METHOD = "every method"
"""Whose cells are empty where a file for all of them cannot be made."""
GROWN = ("LAYER", "SAMPLESPLAT")
"""Of the paper's networks, those whose time is measured from 4 to 64 samples."""
UNTRAINED_FRAME = 256
"""Pixels along a side of the frame that untrained networks are timed on, at most: a network of a published width takes
a minute of the frame that the others have."""


class Bench:
    """One run: the methods made ready, and their results as they come."""

    def __init__(self, options: BenchOptions, scenes: list[Scene], folder: Path) -> None:
        self.options = options
        self.scenes = scenes
        self.folder = folder
        self.target = folder / "result.exr"
        torch.set_num_threads(options.threads)
        self.specs = method_specs(options.models or shipped(), oidn_installed(), options.paper)
        self.methods: dict[str, Method] = {}
        with ExitStack() as stack:
            for spec in self.specs:
                method = make(spec, options.threads, folder)
                self.methods[spec.name] = method
                stack.callback(method.close)
            self._open = stack.pop_all()
        self.full_models = {spec.name: FullModel(spec.argument, options.threads) for spec in self._ours()
                            if options.savings}
        self.contexts: tuple[FullModel, FullModel] | None = None
        if options.contexts and options.savings:
            full, half = (FullModel(model, options.threads) for model in options.contexts)
            self.contexts = full, half
        protocol = {
            "repeats": options.repeats, "warm_up": 1, "interleaved": True, "statistic": "median",
            "oidn": oidn_installed(), "growth_pixels": SIDE * SIDE,
            "frame": options.frame, "untrained_frame": min(options.frame, UNTRAINED_FRAME),
            "averaged": [spec.name for spec in self.specs if spec.family == "lbmc" and spec not in self._ours()],
        }
        self.results = Results(machine(options.threads), protocol, self.specs, [])
        self.gallery = Gallery()
        self._take(scenes)

    def _take(self, scenes: list[Scene]) -> None:
        """The scenes that are measured."""
        self.scenes = scenes
        self.results.scenes = [SceneInfo(scene.name, scene.width, scene.height, scene.samples, scene.floor)
                               for scene in scenes]
        # One scene stands for all where each run is dear: the first of the largest group.
        self.example = next(s for s in scenes if s.samples == self.results.groups()[0])
        self.results.protocol["example"] = self.example.name

    def _ours(self) -> list[MethodSpec]:
        """Of lbmc, those that run the network once for a frame: averages over mirror images save and grow alike."""
        return [spec for spec in self.specs if spec.family == "lbmc"
                and isinstance(method := self.methods[spec.name], LbmcMethod) and not method.job.weights.mirrored]

    def __enter__(self) -> Bench:
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def measure(self) -> tuple[Results, Gallery]:
        """Everything, in order. Raises InputError when no scene can be read."""
        tried = len(self.scenes)
        with make_progress(self.options.progress, tried + self._later_steps()) as progress:
            self.attempts = Attempts(self.results.gaps, progress)
            self._tell(progress)
            scores = self._scores(progress)
            progress.total = tried + self._later_steps()
            frames = self._frames()
            self._time(frames, scores, progress)
            for scene, most in self._curves():
                progress.begin(f"{scene.name} with {most} samples")
                self._curve(scene, most)
                progress.finish()
            self._save(progress)
            self._grow(progress)
            self._remember(frames, progress)
        return self.results, self.gallery

    def _tell(self, progress: Progress) -> None:
        """What of the folder is left out from the start."""
        unpaired = self.results.protocol["without_reference"]
        if unpaired:
            progress.note(unpaired_line(unpaired))
        for error in self.results.failed.values():
            progress.fail(error)

    def _later_steps(self) -> int:
        """Of the progress, after the errors."""
        frames = len(self.results.groups()) if self.options.frame else len(self.scenes)
        memory = len(self.specs) if self._with_memory() else 0
        savings = len(self.scenes) if self.full_models or self.contexts else 0
        return (frames * (1 + self.options.repeats) + len(self._curves()) + savings + len(self.options.growth)
                + memory)

    def _curves(self) -> list[tuple[Scene, int]]:
        """Each scene with each number of samples that it is thinned to."""
        if not self.options.curves:
            return []
        return [(scene, most) for scene in self.scenes for most in scene.thinned_counts()]

    def _with_memory(self) -> bool:
        return self.options.memory and measurable()

    def _run(self, spec: MethodSpec, source: Path) -> Times:
        method = self.methods[spec.name]
        try:
            method.run(source, self.target)
        finally:  # of a run that fails, nothing is charged to the next
            times = method.clock.take()
        return times

    def _scores(self, progress: Progress) -> dict[str, SceneScores]:
        """Errors of all methods, by scene. A scene that cannot be read, or does not fit, is left out from here on."""
        scores = {}
        for scene in _steps(self.scenes, progress, "errors of"):
            try:
                found = self._score(scene)
            except (InputError, MemoryError) as error:
                named = "" if isinstance(error, InputError) else f"{scene.source}: "
                self.results.failed[scene.name] = named + describe_error(error)
                progress.fail(self.results.failed[scene.name])
                found = {}
            if found:
                scores[scene.name] = found
            else:
                self._drop(scene)
        if not scores:
            raise InputError(f"{self.options.folder}: no scene is left to measure")
        self._take([scene for scene in self.scenes if scene.name in scores])
        return scores

    def _score(self, scene: Scene) -> SceneScores:
        """Errors of all methods on a scene. Raises InputError where it cannot be read."""
        self.gallery.add(scene.name, "reference", scene.reference.rgb, scene.reference.rgb)
        found: SceneScores = {}
        for spec in self.specs:
            if spec.scored:
                scores = self.attempts(spec.name, scene.name, "error", partial(self._score_one, spec, scene),
                                       fatal=(InputError,))
                if scores is not None:
                    found[spec.name] = scores
        return found

    def _score_one(self, spec: MethodSpec, scene: Scene) -> dict[str, float | None]:
        self._run(spec, scene.source)
        picture = read_rgb(self.target).rgb
        scores = asdict(scene.score(picture, with_flip=self.options.flip))
        self.gallery.add(scene.name, spec.name, picture, scene.reference.rgb)
        return scores

    def _drop(self, scene: Scene) -> None:
        """Leaves a scene out on which no method has an error."""
        self.gallery.drop(scene.name)
        gaps = [gap for gap in self.results.gaps if gap.scene == scene.name]
        for gap in gaps:
            self.results.gaps.remove(gap)
            self.results.failed.setdefault(scene.name, f"{scene.source}: {gap.why}")

    def _frames(self) -> dict[str, TimedFrame]:
        """What is timed, by the name of the scene that it is made of."""
        side = self.options.frame
        if not side:
            return {scene.name: as_it_is(scene) for scene in self.scenes}
        firsts = [next(scene for scene in self.scenes if scene.samples == samples)
                  for samples in self.results.groups()]
        made = {scene.name: self.attempts(EVERY_METHOD, scene.name, "time", partial(enlarged, scene, side, self.folder))
                for scene in firsts}
        return {name: frame for name, frame in made.items() if frame is not None}

    def _untrained(self, frames: dict[str, TimedFrame]) -> TimedFrame | None:
        """What untrained networks are timed on."""
        timed = frames.get(self.example.name)
        side: int = self.results.protocol["untrained_frame"]
        if timed is None or not self.options.paper:
            return timed
        return self.attempts("untrained networks", self.example.name, "time",
                             partial(for_untrained, self.example, timed, side, self.folder))

    def _time(self, frames: dict[str, TimedFrame], scores: dict[str, SceneScores], progress: Progress) -> None:
        self.untrained = untrained = self._untrained(frames)
        turns = {(frame.name, spec.name): timed for frame in frames.values() for spec in self.specs
                 if (timed := frame if spec.scored else untrained if frame.name == self.example.name else None)}
        by_name = {spec.name: spec for spec in self.specs}
        medians = take_turns(turns, self.options.repeats, lambda name, source: self._run(by_name[name], source),
                             self.attempts, progress)
        for scene in self.scenes:
            for spec in self.specs:
                found, times = scores[scene.name].get(spec.name), medians.get((scene.name, spec.name))
                if times is not None:
                    self.results.measurements.append(Measurement(
                        scene.name, spec.name, found, times.cpu, times.wall, turns[scene.name, spec.name].megapixels))
                elif found is not None:
                    self.results.measurements.append(Measurement(scene.name, spec.name, found, {}, {}, 0.0))

    def _curve(self, scene: Scene, most: int) -> None:
        thinned = self.attempts(EVERY_METHOD, scene.name, "samples", partial(self._thinned, scene, most))
        for spec in self.specs:
            if spec.scored and thinned is not None:
                errors = self.attempts(spec.name, scene.name, "samples", partial(self._errors, spec, scene, thinned))
                if errors is not None:
                    self.results.curve.append(CurvePoint(scene.name, spec.name, most, *errors))

    def _thinned(self, scene: Scene, most: int) -> Path:
        target = self.folder / "thinned.deep.exr"
        write_thinned(scene, most, target)
        return target

    def _errors(self, spec: MethodSpec, scene: Scene, source: Path) -> tuple[float, float]:
        """relMSE and SMAPE of a method on another file of the scene."""
        self._run(spec, source)
        return scene.errors(read_rgb(self.target).rgb)

    def _save(self, progress: Progress) -> None:
        """What each saving saves and costs."""
        if not self.full_models and not self.contexts:
            return
        savings = SavingsBench(self.full_models, self.contexts, self.options.repeats, self.target, self.attempts)
        for scene in _steps(self.scenes, progress, "savings on"):
            self.results.savings += savings.measure(scene)

    def _grow(self, progress: Progress) -> None:
        counted = dict(PAPER)
        timed = {}
        if self.options.paper:
            torch.manual_seed(0)
            timed = {name: Denoiser(PAPER[name]).eval() for name in GROWN}
        for spec in self._ours():
            method = self.methods[spec.name]
            assert isinstance(method, LbmcMethod)
            counted[spec.name] = method.job.net.config
            timed[spec.name] = method.job.net
        for per_pixel in self.options.growth:
            progress.begin(f"networks at {per_pixel} samples")
            points = self.attempts("networks", f"random samples, {per_pixel} a pixel", "time", partial(
                growth, counted, timed, [per_pixel], repeats=self.options.repeats))
            self.results.growth += growth(counted, {}, [per_pixel]) if points is None else points
            progress.finish()
        for spec in self.specs:
            self.methods[spec.name].clock.take()  # the watched networks ran outside of any measurement

    def _remember(self, frames: dict[str, TimedFrame], progress: Progress) -> None:
        """Peak memory, each method in a process of its own."""
        frame = frames.get(self.example.name)
        for spec in _steps(self.specs if self._with_memory() else [], progress, "memory of"):
            timed = frame if spec.scored else self.untrained
            if timed is not None:
                peak = self.attempts(spec.name, self.example.name, "memory", partial(
                    peak_memory, spec, timed.source, self.options.threads, self.folder))
                if peak is not None:
                    self.results.memory[spec.name] = peak


def _steps(items: Iterable[Item], progress: Progress, verb: str) -> Iterator[Item]:
    """The items, each a step of the progress."""
    for item in items:
        progress.begin(f"{verb} {getattr(item, 'name', item)}")
        yield item
        progress.finish()
