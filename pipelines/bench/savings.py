"""What a frame may do without: each saving by itself beside the full model, on every scene.

The survey chooses some savings on some scenes (pipelines/decisions.py). Here each is also forced where it does not, so
that its price is seen. The full model has nothing adapted: its own layers, every role, every cell, single precision.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from statistics import median

from model.config import Config
from pipelines.bench.attempts import Attempts
from pipelines.bench.methods import LbmcMethod
from pipelines.bench.results import SavingPoint, own
from pipelines.bench.scenes import Scene
from pipelines.decisions import decide, zero_roles
from pipelines.denoise import Job
from pipelines.flat_pictures import read_rgb
from pipelines.frame_reader import FrameReader
from pipelines.network import product_dtype
from pipelines.options import Precision
from pipelines.plan import FramePlan
from pipelines.survey import Survey

ANYWHERE = "on all: not for the survey to choose"


@dataclass(frozen=True)
class Saving:
    """One thing to do without.

    layers : so many instead of the network's own number
    held, dropped : roles that are told to say nothing, or are absent
    cells : those with nothing to do pass through
    all_chosen : everything that the survey chooses, as `lbmc denoise` does
    there, others : what is said of the scenes on which the survey chooses it, and of those on which it does not
    """

    name: str
    layers: int | None = None
    held: frozenset[str] = frozenset()
    dropped: frozenset[str] = frozenset()
    cells: bool = False
    all_chosen: bool = False
    precision: Precision = "auto"
    there: str = "chosen by the survey"
    others: str = "forced: they need the full model"

    @property
    def of_scenes(self) -> bool:
        """Whether it is the survey's to choose, scene by scene."""
        return bool(self.layers or self.held or self.dropped or self.cells or self.all_chosen)

    def applies(self, plan: FramePlan) -> bool:
        """Whether there is anything to save in a frame whose full plan this is."""
        if roles := self.held | self.dropped:  # of a frame that hits nothing, no role is read
            return bool(roles & {*plan.roles} and plan.survey.hits)
        return self.layers is None or self.layers < plan.shot.layers

    def chosen(self, seen: Survey) -> bool | None:
        """Whether the survey decides so; None where that is not the survey's to decide."""
        if not self.of_scenes:
            return None
        decided, passing = decide(seen), bool(seen.cells.passed.any() or seen.cells.alike.any())
        if self.all_chosen:
            return bool(decided.one_layer or decided.held or zero_roles(seen) or passing)
        return decided.one_layer if self.layers else passing if self.cells else self.held | self.dropped <= decided.held

    def applied(self, plan: FramePlan) -> FramePlan:
        """A full plan with this saved."""
        layers, held, cells = self.layers, self.held, self.cells
        if self.all_chosen:
            decided = decide(plan.survey)
            layers, held, cells = 1 if decided.one_layer else None, decided.held | zero_roles(plan.survey), True
        return replace(
            plan, shot=replace(plan.shot, layers=layers or plan.shot.layers), adapt=cells,
            roles=tuple(role for role in plan.roles if role not in held | self.dropped),
            held=plan.held | (held & {*plan.roles}),
        )


BLUR, MOTION = frozenset({"coc", "lens"}), frozenset({"motion", "time"})
HELD_INSTEAD = "held instead by the survey"
SAVINGS: Sequence[Saving] = (
    Saving("nothing: the noise of the clock"),
    Saving("all that the survey chooses", all_chosen=True, others="nothing is chosen"),
    Saving("1 layer", layers=1),
    Saving("coc and lens held", held=BLUR),
    Saving("coc and lens dropped", dropped=BLUR, there=HELD_INSTEAD),
    Saving("motion and time held", held=MOTION),
    Saving("motion and time dropped", dropped=MOTION, there=HELD_INSTEAD),
    Saving("cells passed through", cells=True, others="nothing passes, nor is forced to"),
    Saving("products in bf16", precision="bf16"),
)
CONTEXT = Saving("context at half resolution")
"""Two networks, since it is part of one."""
BY_NAME: Mapping[str, Saving] = {saving.name: saving for saving in (*SAVINGS, CONTEXT)}


class SavingJob(Job):
    """`lbmc denoise` with one saving in place of what the survey chooses; `full` is the plan without it."""

    saving: Saving | None = None
    full: FramePlan

    def plan(self, source: Path, reader: FrameReader, update: Callable[[float], None]) -> FramePlan:
        """The frame's plan with the saving."""
        self.full = super().plan(source, reader, update)
        return self.full if self.saving is None else self.saving.applied(self.full)


class FullModel(LbmcMethod):
    """`lbmc denoise --no-adapt`, and with one saving after another."""

    job: SavingJob

    def __init__(self, model: str, threads: int) -> None:
        super().__init__(model, threads, {"adapt": False}, SavingJob)

    @property
    def config(self) -> Config:
        """Of the network."""
        return self.job.net.config

    def seconds(self, saving: Saving | None, scene: Scene, target: Path) -> float:
        """Denoises a scene; returns the CPU seconds of the model's own work, without reading and writing."""
        job = self.job
        job.saving = saving
        job.net.set_product_dtype(product_dtype("auto" if saving is None else saving.precision, job.device))
        try:
            self.run(scene.source, target)
        finally:
            times = self.clock.take()
        return own(times.cpu)


class SavingsBench:
    """Every saving of every model, and that between two contexts, scene after scene."""

    def __init__(self, models: Mapping[str, FullModel], contexts: tuple[FullModel, FullModel] | None, repeats: int,
                 target: Path, attempts: Attempts) -> None:
        self.models = models
        self.contexts = contexts
        self.repeats = repeats
        self.target = target
        self.attempts = attempts

    def measure(self, scene: Scene) -> Iterator[SavingPoint]:
        """The savings that apply to a scene."""
        for name, model in self.models.items():
            yield from self._beside(name, scene, model, model, SAVINGS)
        if self.contexts:
            full, half = self.contexts
            yield from self._beside(f"{full.name}, {half.name}", scene, full, half, (CONTEXT,))

    def _beside(self, name: str, scene: Scene, full: FullModel, other: FullModel, savings: Sequence[Saving]
                ) -> Iterator[SavingPoint]:
        """Each once for the errors, which warms up, then all in turns for the time."""
        plain = self.attempts(name, scene.name, "saving", lambda: self._errors(full, None, scene))
        if plain is None:
            return
        plan = full.job.full
        found = {}
        for saving in savings:
            if saving.applies(plan):
                errors = self.attempts(f"{name}, {saving.name}", scene.name, "saving",
                                       partial(self._errors, other, saving, scene))
                if errors is not None:
                    found[saving] = errors
        before: list[float] = []
        after: dict[Saving, list[float]] = {saving: [] for saving in found}
        for _ in range(self.repeats):
            seconds = self.attempts(name, scene.name, "saving", lambda: full.seconds(None, scene, self.target))
            if seconds is None:
                return
            before.append(seconds)
            for saving, runs in tuple(after.items()):
                seconds = self.attempts(f"{name}, {saving.name}", scene.name, "saving",
                                        partial(other.seconds, saving, scene, self.target))
                if seconds is None:
                    del after[saving]
                else:
                    runs.append(seconds)
        for saving, runs in after.items():
            (plain_relmse, plain_smape), (relmse, smape) = plain, found[saving]
            yield SavingPoint(name, saving.name, scene.name, saving.chosen(plan.survey), median(before), median(runs),
                              (plain_relmse, relmse), (plain_smape, smape))

    def _errors(self, model: FullModel, saving: Saving | None, scene: Scene) -> tuple[float, float]:
        """relMSE and SMAPE of the file written."""
        model.seconds(saving, scene, self.target)
        return scene.errors(read_rgb(self.target).rgb)
