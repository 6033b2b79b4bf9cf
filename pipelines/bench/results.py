"""What a bench measured, as plain data: what goes to JSON, and the means over scenes that tables and charts show."""

from __future__ import annotations

import dataclasses
import platform
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from deep_io.cores import usable_cores
from model.metrics import bootstrap_interval, geometric_mean
from pipelines import __version__
from pipelines.bench.methods import OUTSIDE, MethodSpec

FORMAT = 1
MEANS = ("smape", "psnr", "ssim", "flip", "energy")
"""Scores averaged over scenes as plain means; relMSEs as geometric ones."""
FEWEST_TO_RESAMPLE = 5
"""Scenes below which a bootstrap interval of 95 % is nearly or exactly their range."""
LEAST_GAIN = 0.02
"""A method on the Pareto front has less error than every faster one by this share: less is not worth the wait."""


@dataclass(frozen=True)
class SceneInfo:
    """A scene; `samples` per pixel."""

    name: str
    width: int
    height: int
    samples: int

    @property
    def megapixels(self) -> float:
        return self.width * self.height / 1e6


@dataclass(frozen=True)
class Measurement:
    """One method on one scene: its scores (None for random weights), and its median seconds by stage.

    megapixels : of the frame that was timed, which may be the scene enlarged; 0, and no seconds, where none was
    """

    scene: str
    method: str
    scores: Mapping[str, float | None] | None
    cpu: Mapping[str, float]
    wall: Mapping[str, float]
    megapixels: float


@dataclass(frozen=True)
class CurvePoint:
    """The error of one method on one scene that was thinned to `samples` per pixel."""

    scene: str
    method: str
    samples: int
    relmse: float
    smape: float


@dataclass(frozen=True)
class GrowthPoint:
    """The cost of a network per pixel at so many samples; seconds are None where only the count was made."""

    network: str
    samples: int
    multiply_adds: float
    cpu: float | None = None
    wall: float | None = None


@dataclass
class Results:
    """Everything a bench found."""

    machine: dict[str, Any]
    protocol: dict[str, Any]
    methods: list[MethodSpec]
    scenes: list[SceneInfo]
    measurements: list[Measurement] = field(default_factory=list)
    curve: list[CurvePoint] = field(default_factory=list)
    growth: list[GrowthPoint] = field(default_factory=list)
    memory: dict[str, int] = field(default_factory=dict)
    failed: dict[str, str] = field(default_factory=dict)
    """Scene that was left out, since it cannot be read -> why."""

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {"format": FORMAT, **dataclasses.asdict(self)}

    @staticmethod
    def from_dict(data: Mapping[str, Any]) -> Results:
        """The inverse of `to_dict`, also after a trip through JSON. Raises ValueError for another format."""
        if data.get("format") != FORMAT:
            raise ValueError(f"bench results of format {data.get('format')}, not {FORMAT}; run lbmc bench again")
        return Results(
            data["machine"], data["protocol"], [MethodSpec(**row) for row in data["methods"]],
            [SceneInfo(**row) for row in data["scenes"]], [Measurement(**row) for row in data["measurements"]],
            [CurvePoint(**row) for row in data["curve"]], [GrowthPoint(**row) for row in data["growth"]],
            dict(data["memory"]), dict(data.get("failed", {})),
        )

    def groups(self) -> list[int]:
        """Samples per pixel of the scenes; the largest group of scenes first."""
        counts = [scene.samples for scene in self.scenes]
        return sorted(set(counts), key=lambda samples: (-counts.count(samples), samples))

    def scenes_of(self, samples: int) -> list[SceneInfo]:
        """The scenes of a group."""
        return [scene for scene in self.scenes if scene.samples == samples]

    def summary(self, samples: int) -> dict[str, Summary]:
        """The means of each method that was measured over the scenes of a group."""
        scenes = {scene.name for scene in self.scenes_of(samples)}
        found: dict[str, Summary] = {}
        for spec in self.methods:
            rows = [row for row in self.measurements if row.method == spec.name and row.scene in scenes]
            if rows:
                found[spec.name] = summarize(rows)
        return found


@dataclass(frozen=True)
class Summary:
    """One method over the scenes of a group. Seconds are per megapixel, by stage."""

    scores: Mapping[str, float | None]
    interval: tuple[float, float] | None
    """Of the relMSE, see `spread`."""
    cpu: Mapping[str, float]
    wall: Mapping[str, float]

    @property
    def own_cpu(self) -> float:
        """CPU seconds per megapixel of the method's own work, without reading, flattening and writing."""
        return own(self.cpu)

    @property
    def own_wall(self) -> float:
        """The same in wall seconds."""
        return own(self.wall)


def own(stages: Mapping[str, float]) -> float:
    """The seconds of the stages that are a method's own work."""
    return sum(seconds for stage, seconds in stages.items() if stage not in OUTSIDE)


def summarize(rows: list[Measurement]) -> Summary:
    """The rows of one method, over scenes."""
    megapixels = sum(row.megapixels for row in rows)
    scores: dict[str, float | None] = {}
    interval = None
    scored = [row.scores for row in rows if row.scores is not None]
    if scored:
        for name in scored[0]:
            values = [value for row in scored if (value := row[name]) is not None]
            if len(values) == len(scored):
                scores[name] = float(np.mean(values)) if name in MEANS else geometric_mean(values)
        interval = spread([row["relmse"] or 0.0 for row in scored])
    return Summary(scores, interval, _per(rows, "cpu", megapixels), _per(rows, "wall", megapixels))


def spread(errors: Sequence[float]) -> tuple[float, float] | None:
    """95 % bootstrap interval of the errors' geometric mean; of few scenes their range, of one nothing."""
    if len(errors) < FEWEST_TO_RESAMPLE:
        return (min(errors), max(errors)) if len(errors) > 1 else None
    return bootstrap_interval(errors)


def spread_name(scenes: int) -> str:
    """What `spread` is of so many scenes."""
    return "range" if scenes < FEWEST_TO_RESAMPLE else "interval"


def _per(rows: Iterable[Measurement], kind: str, megapixels: float) -> dict[str, float]:
    sums: dict[str, float] = {}
    for row in rows:
        for stage, seconds in getattr(row, kind).items():
            sums[stage] = sums.get(stage, 0.0) + seconds / megapixels
    return sums


def pareto(points: Mapping[str, tuple[float, float]]) -> list[str]:
    """Names of the points (time, error) whose error is below that of every faster one by `LEAST_GAIN`; by time."""
    front: list[str] = []
    best = float("inf")
    for name, (_, error) in sorted(points.items(), key=lambda item: item[1]):
        if error < best * (1.0 - LEAST_GAIN):
            front.append(name)
        best = min(best, error)
    return front


def machine(threads: int) -> dict[str, Any]:
    """The processor, the system, the versions and the threads of this run."""
    packages = {}
    for name in ("torch", "numpy", "OpenEXR", "pyoidn", "flip-evaluator"):
        try:
            packages[name] = version(name)
        except PackageNotFoundError:
            packages[name] = "not installed"
    return {
        "processor": processor(),
        "cores": usable_cores(),
        "threads": threads,
        "system": platform.platform(),
        "python": platform.python_version(),
        "lbmc": __version__,
        **packages,
    }


def processor() -> str:
    """The processor's name as the system tells it."""
    path = Path("/proc/cpuinfo")
    if path.is_file():
        for line in path.read_text("utf-8", "replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
