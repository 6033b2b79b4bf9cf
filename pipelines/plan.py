"""What will be done with a frame, decided before the network runs: said by `--dry-run`, followed by the job."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from deep_io.errors import UsageError
from deep_io.roles import RoleMap
from model.denoiser import Denoiser
from model.features import FrameScale
from pipelines.aovs import Aovs
from pipelines.decisions import Decisions
from pipelines.frame_reader import FrameReader
from pipelines.ids import IdChannel
from pipelines.survey import Survey
from pipelines.tiles import Band, FrameLoad, plan_bands


@dataclass(frozen=True)
class Shot:
    """What is decided once for all frames of a job.

    decided : what its first frame, or the one that stands for it, does without
    roles : those of that frame, used by the network or not
    """

    scale: FrameScale
    layers: int
    weighting: str
    decided: Decisions = field(default_factory=Decisions)
    roles: frozenset[str] = frozenset()


@dataclass(frozen=True)
class FramePlan:
    """What will be done with one frame; `lines` say it for a reader.

    roles : those whose values the network reads
    mapping : which channels play them; shown without the unused ones that something else asks for
    held : those it is told to say nothing
    adapt : whether the cells that the survey found to have nothing to do pass through
    model : which network, in words
    light : whether the picture's light is held to that of its samples; None: no picture is made
    """

    source: Path
    survey: Survey
    shot: Shot
    roles: tuple[str, ...]
    bands: list[Band]
    memory: int
    mapping: RoleMap
    aovs: Aovs = field(default_factory=Aovs)
    ids: Sequence[IdChannel] = ()
    kept: Sequence[str] = ()
    held: frozenset[str] = frozenset()
    adapt: bool = False
    model: str = ""
    light: bool | None = True

    def without_pictures(self) -> FramePlan:
        """The same, for a report that outlives the frame."""
        seen = self.survey
        cells = seen.cells.without_pictures()
        return replace(self, survey=replace(seen, light=np.empty((0, 0), np.float32), cells=cells))

    def lines(self) -> list[str]:
        """The plan, for `--dry-run`."""
        seen = self.survey
        asked = {*self.kept, *(one.channel for one in self.ids),
                 *(name for group in self.aovs.groups for name in group.channels)}
        return [
            *replace(self.mapping, unused=tuple(name for name in self.mapping.unused if name not in asked)).lines(),
            f"weighting: {self.shot.weighting}",
            f"samples: {seen.samples} in {seen.pixels} pixels, {seen.empty_pixels} pixels without any",
            *([f"model: {self.model}"] if self.model else []),
            f"roles in use: {', '.join(self.roles)}",
            *([f"roles held, which say nothing here: {', '.join(sorted(self.held))}"] if self.held else []),
            f"exposure: {self.shot.scale.exposure:.6g}, depth scale: {self.shot.scale.depth:.6g}",
            f"layers: {self.shot.layers}",
            *([] if self.light is None else [f"light: {'held to that of the samples' if self.light else 'free'}"]),
            *([] if seen.mixed is None else [f"depth mixes in {seen.mixed:.1%} of the pixels"]),
            *(seen.cells.lines() if self.adapt else ["not adapted: no role is held, every cell is filtered"]),
            *(f"AOV: {', '.join(group.outputs)} filtered as {group.kind}" for group in self.aovs.groups),
            *([f"kept as pixel means: {' '.join(self.kept)}"] if self.kept else []),
            *(f"ids: {one.channel} ranked as {one.base}" for one in self.ids),
            f"bands: {len(self.bands)}, about {self.memory / 2**20:.0f} MiB",
        ]


def roles_of(seen: Survey) -> frozenset[str]:
    """The roles of a frame that was surveyed, but for coverage, which every frame has."""
    return frozenset({"radiance", *seen.largest, *(() if seen.mixed is None else ("depth",))})


def writers(source: str, written: Iterable[tuple[str, Iterable[str]]]) -> dict[str, str]:
    """Output channel to what writes it, from pairs of that and its channels.

    Raises UsageError for a channel that two of them would write.
    """
    found: dict[str, str] = {}
    for writer, names in written:
        for name in names:
            if name in found:
                raise UsageError(f"{source}: {name} would be written twice, by {found[name]} and by {writer}; leave "
                                 f"one of them out")
            found[name] = writer
    return found


@dataclass(frozen=True)
class Room:
    """How a frame is fitted into a memory budget."""

    bands: list[Band]
    memory: int
    keep: bool
    """Whether the decoded frame stays in memory between survey and network: only where that costs no band."""


def fit(reader: FrameReader, net: Denoiser, layers: int, memory: int, mirrored: bool = False, beside: int = 0) -> Room:
    """Plans the bands of a frame from its header and the sizes of its rows; no sample is read.

    mirrored : whether mirror images of it are denoised as well
    beside : bytes that something else takes meanwhile
    """
    load = FrameLoad(reader.header.data_window.width, reader.samples_per_row, layers, reader.carried, mirrored,
                     net.config.unet.widest)

    def planned(budget: int) -> tuple[list[Band], int]:
        bands = plan_bands(load, net.reach, net.tile_reach, net.stride, budget)
        shared = len(bands) > 1 and net.tile_reach is not None
        tallest = max(band.read1 - band.read0 for band in bands)
        return bands, load.needed_shared(tallest) if shared else load.needed(tallest)

    bands, needed = planned(memory - beside)
    if len(bands) == 1:  # its estimate holds a decoded frame already
        return Room(bands, needed + beside, keep=True)
    kept = beside + reader.kept_bytes
    tighter, more = planned(memory - kept)
    if len(tighter) == len(bands) and more + kept <= memory:
        return Room(tighter, more + kept, keep=True)
    return Room(bands, needed + beside, keep=False)
