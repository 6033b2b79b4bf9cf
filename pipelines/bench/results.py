"""What a bench measured, as plain data: what goes to JSON, and the means over scenes that tables and charts show."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from model.metrics import bootstrap_interval, geometric_mean
from pipelines.bench.methods import OUTSIDE, MethodSpec

FORMAT = 1
MEANS = ("smape", "psnr", "ssim", "flip", "energy", "relmse_unbiased", "floor")
"""Scores averaged over scenes as plain means; relMSEs that cannot be negative as geometric ones."""
FEWEST_TO_RESAMPLE = 5
"""Scenes below which a bootstrap interval of 95 % is nearly or exactly their range."""
LEAST_GAIN = 0.02
"""A method on the Pareto front has less error than every faster one by this share: less is not worth the wait."""


What = Literal["error", "time", "samples", "saving", "memory"]
WHAT: Mapping[What, str] = {
    "error": "no error",
    "time": "no time",
    "samples": "no error with fewer samples",
    "saving": "not among the savings",
    "memory": "no memory",
}
"""What can be missing, for a reader."""


@dataclass(frozen=True)
class SceneInfo:
    """A scene; `samples` per pixel.

    floor : relMSE of the reference itself, by the noise of its two halves; None where it has no halves
    """

    name: str
    width: int
    height: int
    samples: int
    floor: float | None = None

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


@dataclass(frozen=True)
class SavingPoint:
    """One saving on one scene, beside the full model: nothing adapted, its own number of layers, single precision.

    model : name of the method whose weights these are
    saving : a name of savings.py
    chosen : whether the survey decides so on this scene; None where that is not the survey's to decide
    before, after : CPU seconds of the model's own work without and with the saving, medians
    relmse, smape : without and with the saving
    """

    model: str
    saving: str
    scene: str
    chosen: bool | None
    before: float
    after: float
    relmse: tuple[float, float]
    smape: tuple[float, float]


@dataclass(frozen=True)
class Gap:
    """What could not be measured of one method on one scene, and why."""

    method: str
    scene: str
    what: What
    why: str

    @property
    def cell(self) -> str:
        """Which cell is empty, for a reader."""
        return f"{self.method} on {self.scene}, {WHAT[self.what]}"


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
    savings: list[SavingPoint] = field(default_factory=list)
    failed: dict[str, str] = field(default_factory=dict)
    """Scene that was left out, since it cannot be read -> why."""
    gaps: list[Gap] = field(default_factory=list)

    def missing(self) -> dict[str, str]:
        """Scenes that were left out, and what else could not be measured -> why. Empty where all went well."""
        return {**self.failed, **{gap.cell: gap.why for gap in self.gaps}}

    def to_dict(self) -> dict[str, Any]:
        """For JSON. "unbiased", the means free of the reference's noise by samples per pixel, follows from the rest."""
        unbiased = {str(samples): dataclasses.asdict(found) for samples in self.groups()
                    if (found := self.unbiased(samples)) is not None}
        return {"format": FORMAT, **dataclasses.asdict(self), "unbiased": unbiased}

    @staticmethod
    def from_dict(data: Mapping[str, Any]) -> Results:
        """The inverse of `to_dict`, also after a trip through JSON. Raises ValueError for another format."""
        if data.get("format") != FORMAT:
            raise ValueError(f"bench results of format {data.get('format')}, not {FORMAT}; run lbmc bench again")
        return Results(
            data["machine"], data["protocol"], [MethodSpec(**row) for row in data["methods"]],
            [SceneInfo(**row) for row in data["scenes"]], [Measurement(**row) for row in data["measurements"]],
            [CurvePoint(**row) for row in data["curve"]], [GrowthPoint(**row) for row in data["growth"]],
            dict(data["memory"]),
            [SavingPoint(**{**row, "relmse": tuple(row["relmse"]), "smape": tuple(row["smape"])})
             for row in data["savings"]],
            dict(data["failed"]), [Gap(**row) for row in data["gaps"]],
        )

    def groups(self) -> list[int]:
        """Samples per pixel of the scenes; the largest group of scenes first."""
        counts = [scene.samples for scene in self.scenes]
        return sorted(set(counts), key=lambda samples: (-counts.count(samples), samples))

    def scenes_of(self, samples: int) -> list[SceneInfo]:
        """The scenes of a group."""
        return [scene for scene in self.scenes if scene.samples == samples]

    def summary(self, samples: int) -> dict[str, Summary]:
        """The means of each method that was measured over the scenes of a group.

        A method that lacks an error, or a time, on one of the scenes has no mean of it: that of the others would be
        of other scenes than its neighbours in the table.
        """
        scenes = {scene.name for scene in self.scenes_of(samples)}
        lacks = {(gap.method, gap.what) for gap in self.gaps if gap.scene in scenes}
        found: dict[str, Summary] = {}
        for spec in self.methods:
            rows = [row for row in self.measurements if row.method == spec.name and row.scene in scenes]
            if rows:
                whole = summarize(rows)
                if (spec.name, "error") in lacks:
                    whole = dataclasses.replace(whole, scores={}, interval=None)
                if (spec.name, "time") in lacks:
                    whole = dataclasses.replace(whole, cpu={}, wall={})
                found[spec.name] = whole
        return found

    def unbiased(self, samples: int) -> Unbiased | None:
        """Of those scenes of a group whose reference has two halves; None where none has."""
        floors = {scene.name: scene.floor for scene in self.scenes_of(samples) if scene.floor is not None}
        if not floors:
            return None
        methods: dict[str, tuple[float, float]] = {}
        for spec in self.methods:
            rows = [row.scores for row in self.measurements
                    if row.method == spec.name and row.scene in floors and row.scores]
            if len(rows) == len(floors):
                plain, free = (float(np.mean([row[key] for row in rows])) for key in ("relmse", "relmse_unbiased"))
                methods[spec.name] = plain, free
        return Unbiased(list(floors), float(np.mean(list(floors.values()))), methods)


@dataclass(frozen=True)
class Unbiased:
    """Errors free of the reference's own noise: arithmetic means over scenes, since such an error may be negative.

    floor : relMSE of the references themselves
    methods : name -> relMSE, plain and free of the reference's noise; of methods that have it on all of the scenes
    """

    scenes: list[str]
    floor: float
    methods: dict[str, tuple[float, float]]


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
