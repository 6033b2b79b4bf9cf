"""What a bench is told: one frozen dataclass, filled by the command line or by a caller's own code."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pipelines.bench.growth import SAMPLES
from pipelines.progress import ProgressKind


@dataclass(frozen=True)
class BenchOptions:
    """What a bench is told.

    models : presets or weight files; none: the presets that ship
    frame : pixels along a side of the frames that are timed: the first scene of each number of samples, repeated in
        mirror image; 0: every scene as it is, with what small frames cost on top
    match : only scenes whose name matches this glob
    paper : also time the paper's networks, which have random weights and no error
    curves : also thin the scenes to 1, 2, 4, ... samples per pixel
    savings : also what each saving saves and costs, on every scene as it is
    contexts : two weight files that differ in the resolution of the context alone, the full one first: a saving more
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
    contexts: tuple[str, str] | None = None
    memory: bool = True
    growth: tuple[int, ...] = SAMPLES
    flip: bool = True
    overwrite: bool = False
    progress: ProgressKind = "auto"
