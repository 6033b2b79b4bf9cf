"""What is timed, and how: scenes as they are, or the first of each number of samples made larger; methods in turns."""

from __future__ import annotations

import statistics
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from pipelines.bench.attempts import Attempts
from pipelines.bench.clock import Times
from pipelines.bench.scenes import Scene, write_enlarged
from pipelines.progress import Progress

Turn = tuple[str, str]
"""Names of the scene that a frame is made of, and of the method that runs on it."""


@dataclass(frozen=True)
class TimedFrame:
    """A file that is timed, and the name of the scene that it is made of."""

    name: str
    source: Path
    megapixels: float


def as_it_is(scene: Scene) -> TimedFrame:
    """The scene itself."""
    return TimedFrame(scene.name, scene.source, scene.megapixels)


def enlarged(scene: Scene, side: int, folder: Path) -> TimedFrame:
    """Repeated in mirror image to `side` x `side` pixels, unless it is larger."""
    source = folder / f"{scene.name}.{side}.exr"
    return TimedFrame(scene.name, source, write_enlarged(scene, side, source))


def for_untrained(scene: Scene, timed: TimedFrame, side: int, folder: Path) -> TimedFrame:
    """What untrained networks are timed on: what the others are, or `side` x `side` pixels of it where that is less."""
    if not side or timed.megapixels <= side * side / 1e6:
        return timed
    source = folder / f"{scene.name}.untrained.exr"
    return TimedFrame(scene.name, source, write_enlarged(scene, side, source, exact=True))


def take_turns(turns: dict[Turn, TimedFrame], repeats: int, run: Callable[[str, Path], Times], attempts: Attempts,
               progress: Progress) -> dict[Turn, Times]:
    """Medians of `repeats` rounds over all turns, after one round to warm up; without the turns that fail.

    run : a method's name and a file to the seconds it takes
    """
    runs: dict[Turn, list[Times]] = {turn: [] for turn in turns}
    for _ in range(1 + repeats):
        for name in dict.fromkeys(name for name, _ in turns):
            progress.begin(f"times of {name}")
            for turn in [turn for turn in runs if turn[0] == name]:
                times = attempts(turn[1], name, "time", partial(run, turn[1], turns[turn].source))
                if times is None:
                    del runs[turn]
                else:
                    runs[turn].append(times)
            progress.finish()
    return {turn: Times(_median([one.cpu for one in found[1:]]), _median([one.wall for one in found[1:]]))
            for turn, found in runs.items()}


def _median(runs: list[dict[str, float]]) -> dict[str, float]:
    """Stage by stage; a stage that some run did not reach took no time there."""
    stages = dict.fromkeys(stage for run in runs for stage in run)
    return {stage: statistics.median(run.get(stage, 0.0) for run in runs) for stage in stages}
