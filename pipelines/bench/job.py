"""The protocol of a bench: what runs in which order, what is kept, and the three files that come out.

Every method runs once on every scene to be scored. Then all methods take turns on the frames that are timed, once to
warm up and `repeats` times more, of which the medians count. Errors are those of the files written, in half precision.
"""

from __future__ import annotations

import json
import math
import statistics
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeVar

import torch

from deep_io.atomic import atomic_output, output_action
from deep_io.errors import InputError
from model import zoo
from model.denoiser import Denoiser
from model.metrics import common_scale, relmse, score, smape
from pipelines.bench.clock import Times
from pipelines.bench.growth import SAMPLES, SIDE, growth
from pipelines.bench.memory import measurable, peak_memory
from pipelines.bench.methods import PAPER, LbmcMethod, Method, MethodSpec, make, method_specs, oidn_installed
from pipelines.bench.report import Gallery, html_report, load_pillow
from pipelines.bench.results import CurvePoint, Measurement, Results, SceneInfo, machine
from pipelines.bench.scenes import Scene, find_pairs, open_scenes, without_reference, write_enlarged, write_thinned
from pipelines.bench.tables import markdown_report, unpaired_line
from pipelines.flat_pictures import read_rgb
from pipelines.jobs import describe_error
from pipelines.progress import Progress, ProgressKind, make_progress

Item = TypeVar("Item")

RESULTS, TABLE, REPORT = "results.json", "results.md", "report.html"
GROWN = ("LAYER", "SAMPLESPLAT")
"""Of the paper's networks, those whose time is measured from 4 to 64 samples."""
UNTRAINED_FRAME = 256
"""Pixels along a side of the frame that untrained networks are timed on, at most: a network of a published width takes
a minute of the frame that the others have."""


@dataclass(frozen=True)
class BenchOptions:
    """What a bench is told.

    models : presets or weight files; none: the presets that ship
    frame : pixels along a side of the frames that are timed: the first scene of each number of samples, repeated in
        mirror image; 0: every scene as it is, with what small frames cost on top
    match : only scenes whose name matches this glob
    paper : also time the paper's networks, which have random weights and no error
    curves : also thin the scenes to 1, 2, 4, ... samples per pixel
    savings : also lbmc otherwise configured, to see what each saving saves and costs
    memory : also peak memory, each method in a process of its own
    growth : samples per pixel at which the cost of networks is counted and timed; none: leave that out
    """

    folder: Path
    out: Path
    models: tuple[str, ...] = ()
    match: str = "*"
    threads: int = 1
    repeats: int = 3
    frame: int = 512
    paper: bool = True
    curves: bool = True
    savings: bool = True
    memory: bool = True
    growth: tuple[int, ...] = SAMPLES
    flip: bool = True
    overwrite: bool = False
    progress: ProgressKind = "auto"


def bench(options: BenchOptions) -> Results:
    """Measures, and writes results.json, results.md and report.html into `options.out`, which is made if need be.

    A scene that cannot be read is told at once and left out; `Results.failed` has it. So are deep files without a
    reference. Raises InputError for what is wrong with the folder or with every scene, UsageError without Pillow, for
    outputs that exist and for models that do not.
    """
    load_pillow()
    scenes, failed = open_scenes(find_pairs(options.folder, options.match))
    unpaired = without_reference(options.folder, options.match)
    targets = [options.out / name for name in (RESULTS, TABLE, REPORT)]
    if options.out.is_dir():
        for target in targets:
            output_action(target, [scene.source for scene in scenes], "overwrite" if options.overwrite else "refuse",
                          can_skip=False)
    with tempfile.TemporaryDirectory(prefix="lbmc-bench-") as folder, Bench(options, scenes, Path(folder)) as run:
        run.results.failed.update(failed)
        run.results.protocol["without_reference"] = unpaired
        try:  # only now, when every model was found, but before any work
            options.out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{options.out}: cannot be made a folder ({error.strerror}); name another --out"
                             ) from error
        results, gallery = run.measure()
    texts = (json.dumps(_plain(results.to_dict()), indent=1, ensure_ascii=False) + "\n", markdown_report(results),
             html_report(results, gallery))
    for target, text in zip(targets, texts, strict=True):
        with atomic_output(target) as path:
            path.write_text(text, "utf-8")
    return results


@dataclass(frozen=True)
class TimedFrame:
    """A file that is timed."""

    name: str
    source: Path
    megapixels: float


class Bench:
    """One run: the methods made ready, and their results as they come."""

    def __init__(self, options: BenchOptions, scenes: list[Scene], folder: Path) -> None:
        self.options = options
        self.scenes = scenes
        self.folder = folder
        self.target = folder / "result.exr"
        torch.set_num_threads(options.threads)
        models = options.models or tuple(zoo.presets())
        self.specs = method_specs(models, oidn_installed(), options.paper, options.savings)
        self.methods: dict[str, Method] = {}
        with ExitStack() as stack:
            for spec in self.specs:
                method = make(spec, options.threads, folder)
                self.methods[spec.name] = method
                stack.callback(method.close)
            self._open = stack.pop_all()
        protocol = {
            "repeats": options.repeats, "warm_up": 1, "interleaved": True, "statistic": "median",
            "oidn": oidn_installed(), "growth_pixels": SIDE * SIDE,
            "frame": options.frame, "untrained_frame": min(options.frame, UNTRAINED_FRAME),
        }
        self.results = Results(machine(options.threads), protocol, self.specs, [])
        self.gallery = Gallery()
        self._take(scenes)

    def _take(self, scenes: list[Scene]) -> None:
        """The scenes that are measured."""
        self.scenes = scenes
        self.results.scenes = [SceneInfo(scene.name, scene.width, scene.height, scene.samples) for scene in scenes]
        # One scene stands for all where each run is dear: the first of the largest group.
        self.example = next(s for s in scenes if s.samples == self.results.groups()[0])
        self.results.protocol["example"] = self.example.name

    def __enter__(self) -> Bench:
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def measure(self) -> tuple[Results, Gallery]:
        """Everything, in order. Raises InputError when no scene can be read."""
        options = self.options
        tried = len(self.scenes)
        with make_progress(options.progress, tried + self._later_steps()) as progress:
            self._tell(progress)
            scores = self._scores(progress)
            progress.total = tried + self._later_steps()
            frames = self._frames()
            self.untrained = self._untrained(frames[self.example.name])
            self._time(frames, scores, progress)
            for scene, most in self._curves():
                progress.begin(f"{scene.name} with {most} samples")
                self._curve(scene, most)
                progress.finish()
            self._grow(progress)
            if self._with_memory():
                for spec in _steps(self.specs, progress, "memory of"):
                    self.results.memory[spec.name] = peak_memory(
                        spec, frames[self.example.name].source if spec.scored else self.untrained.source,
                        options.threads, self.folder)
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
        return frames * (1 + self.options.repeats) + len(self._curves()) + len(self.options.growth) + memory

    def _curves(self) -> list[tuple[Scene, int]]:
        """Each scene with each number of samples that it is thinned to."""
        if not self.options.curves:
            return []
        return [(scene, most) for scene in self.scenes for most in scene.thinned_counts()]

    def _with_memory(self) -> bool:
        return self.options.memory and measurable()

    def _run(self, spec: MethodSpec, source: Path) -> Times:
        method = self.methods[spec.name]
        method.run(source, self.target)
        return method.clock.take()

    def _scores(self, progress: Progress) -> dict[str, dict[str, dict[str, float | None]]]:
        """Errors of all methods, by scene. A scene that cannot be read, or does not fit, is left out from here on."""
        scores = {}
        for scene in _steps(self.scenes, progress, "errors of"):
            try:
                scores[scene.name] = dict(self._score(scene))
            except (InputError, MemoryError) as error:
                self.gallery.drop(scene.name)
                self.results.failed[scene.name] = describe_error(error)
                progress.fail(self.results.failed[scene.name])
        if not scores:
            raise InputError(f"{self.options.folder}: no scene is left to measure")
        self._take([scene for scene in self.scenes if scene.name in scores])
        return scores

    def _score(self, scene: Scene) -> Iterator[tuple[str, dict[str, float | None]]]:
        """Errors of all methods on a scene."""
        reference = scene.reference.rgb
        self.gallery.add(scene.name, "reference", reference, reference)
        for spec in self.specs:
            if not spec.scored:
                continue
            self._run(spec, scene.source)
            picture = read_rgb(self.target).rgb
            yield spec.name, asdict(score(picture, reference, with_flip=self.options.flip))
            if spec.family != "saving":
                self.gallery.add(scene.name, spec.name, picture, reference)

    def _frames(self) -> dict[str, TimedFrame]:
        """What is timed, by the name of the scene that it is made of."""
        if not self.options.frame:
            return {scene.name: TimedFrame(scene.name, scene.source, scene.megapixels) for scene in self.scenes}
        frames = {}
        for samples in self.results.groups():
            scene = next(scene for scene in self.scenes if scene.samples == samples)
            frames[scene.name] = self._enlarged(scene, self.options.frame)
        return frames

    def _untrained(self, timed: TimedFrame) -> TimedFrame:
        """What untrained networks are timed on: the frame that the others have, or a smaller one."""
        side: int = self.results.protocol["untrained_frame"]
        if not side or not self.options.paper or timed.megapixels <= side * side / 1e6:
            return timed
        source = self.folder / f"{self.example.name}.untrained.exr"
        return TimedFrame(self.example.name, source, write_enlarged(self.example, side, source, exact=True))

    def _enlarged(self, scene: Scene, side: int) -> TimedFrame:
        source = self.folder / f"{scene.name}.{side}.exr"
        return TimedFrame(scene.name, source, write_enlarged(scene, side, source))

    def _time(self, frames: dict[str, TimedFrame], scores: dict[str, dict[str, dict[str, float | None]]],
              progress: Progress) -> None:
        runs: dict[tuple[str, str], list[Times]] = {}
        for _ in range(1 + self.options.repeats):
            for frame in _steps(frames.values(), progress, "times of"):
                for spec in self.specs:
                    if spec.scored or frame.name == self.example.name:
                        source = frame.source if spec.scored else self.untrained.source
                        runs.setdefault((frame.name, spec.name), []).append(self._run(spec, source))
        for scene in self.scenes:
            for spec in self.specs:
                times = runs.get((scene.name, spec.name), [])[1:]
                found = scores[scene.name].get(spec.name)
                if times or found:
                    timed = frames[scene.name] if spec.scored and times else self.untrained
                    self.results.measurements.append(Measurement(
                        scene.name, spec.name, found,
                        _median([run.cpu for run in times]), _median([run.wall for run in times]),
                        timed.megapixels if times else 0.0,
                    ))

    def _curve(self, scene: Scene, most: int) -> None:
        thinned = self.folder / "thinned.deep.exr"
        write_thinned(scene, most, thinned)
        k = common_scale(scene.reference.rgb)
        reference = k * scene.reference.rgb.astype("f8")
        for spec in self.specs:
            if spec.scored and spec.family != "saving":
                self._run(spec, thinned)
                picture = k * read_rgb(self.target).rgb.astype("f8")
                self.results.curve.append(CurvePoint(
                    scene.name, spec.name, most, relmse(picture, reference), smape(picture, reference)))

    def _grow(self, progress: Progress) -> None:
        counted = dict(PAPER)
        timed = {}
        if self.options.paper:
            torch.manual_seed(0)
            timed = {name: Denoiser(PAPER[name]).eval() for name in GROWN}
        for spec in self.specs:
            method = self.methods[spec.name]
            if spec.family == "lbmc" and isinstance(method, LbmcMethod):
                counted[spec.name] = method.job.net.config
                timed[spec.name] = method.job.net
        for per_pixel in self.options.growth:
            progress.begin(f"networks at {per_pixel} samples")
            self.results.growth += growth(counted, timed, [per_pixel], repeats=self.options.repeats)
            progress.finish()
        for spec in self.specs:
            self.methods[spec.name].clock.take()  # the watched networks ran outside of any measurement


def _steps(items: Iterable[Item], progress: Progress, verb: str) -> Iterator[Item]:
    """The items, each a step of the progress."""
    for item in items:
        progress.begin(f"{verb} {getattr(item, 'name', item)}")
        yield item
        progress.finish()


def _median(runs: list[dict[str, float]]) -> dict[str, float]:
    """Stage by stage; a stage that some run did not reach took no time there."""
    stages = dict.fromkeys(stage for run in runs for stage in run)
    return {stage: statistics.median(run.get(stage, 0.0) for run in runs) for stage in stages}


def _plain(value: Any) -> Any:
    """JSON knows no infinity and no NaN: they become null."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value if not isinstance(value, float) or math.isfinite(value) else None
