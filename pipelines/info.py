"""What `lbmc info` shows: a file's headers, how its samples would be read, and statistics of every role.

Streams the file by blocks of rows; nothing is written.
"""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deep_io.csr import pixels_of
from deep_io.deep_reader import DeepReader
from deep_io.errors import LbmcError
from deep_io.header import Header, read_headers
from deep_io.path_samples import PathSamples, SampleReader
from deep_io.role_matching import map_roles
from deep_io.sequences import expand, is_sequence
from pipelines.decisions import decide, zero_roles
from pipelines.options import DepthKind, NormalSpace, WeightingName
from pipelines.survey import Survey, Surveyor

ROLES_OF_A_MISS = ("radiance", "coverage")
"""What a miss has too; the statistics of the other roles are over samples that hit something."""


@dataclass
class Range:
    """Smallest, mean and largest of the values seen so far, each a list with one number per component."""

    count: int = 0
    low: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    total: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    high: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))

    def add(self, values: NDArray[Any]) -> None:
        """Takes in `values` (N, width)."""
        if len(values) == 0:
            return
        low, high = values.min(0).astype(np.float64), values.max(0).astype(np.float64)
        total = values.sum(0, dtype=np.float64)
        if self.count:
            low, high, total = np.minimum(self.low, low), np.maximum(self.high, high), self.total + total
        self.count, self.low, self.total, self.high = self.count + len(values), low, total, high

    def as_dict(self) -> dict[str, list[float]] | None:
        """min, mean and max, or None when nothing was seen."""
        if not self.count:
            return None
        return {"min": self.low.tolist(), "mean": (self.total / self.count).tolist(), "max": self.high.tolist()}


@dataclass
class SampleStatistics:
    """Statistics of a part's samples, gathered block by block."""

    pixels: int = 0
    empty_pixels: int = 0
    samples: int = 0
    misses: int = 0
    per_pixel: Range = field(default_factory=Range)
    roles: dict[str, Range] = field(default_factory=dict)
    repairs: Counter[str] = field(default_factory=Counter)

    def add(self, block: PathSamples) -> None:
        """Takes in a block; the virtual misses that decoding adds behind `over` are no samples of the file."""
        stored = np.ones(block.total, np.bool_) if block.source is None else block.source >= 0
        counts = np.bincount(pixels_of(block.counts)[stored], minlength=block.counts.size)
        self.pixels += counts.size
        self.empty_pixels += int(np.count_nonzero(counts == 0))
        self.samples += int(counts.sum())
        self.per_pixel.add(counts[:, None])
        hit = stored & (block.coverage > 0)
        self.misses += int(np.count_nonzero(stored & ~hit))
        for role, values in {"coverage": block.coverage[:, None], **block.roles}.items():
            self.roles.setdefault(role, Range()).add(values[stored if role in ROLES_OF_A_MISS else hit])
        self.repairs.update(block.repairs)

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers, for JSON."""
        return {
            "pixels": self.pixels,
            "empty_pixels": self.empty_pixels,
            "samples": self.samples,
            "misses": self.misses,
            "samples_per_pixel": self.per_pixel.as_dict(),
            "roles": {role: values.as_dict() for role, values in self.roles.items()},
            "repairs": dict(self.repairs),
        }


@dataclass(frozen=True)
class FileInfo:
    """All that is shown of one file."""

    path: str
    headers: tuple[Header, ...]
    part: int
    """The deep part that was read."""
    mapping: tuple[str, ...]
    """One line per role."""
    sources: Mapping[str, tuple[str, ...]]
    """Role to the channels it comes from."""
    weighting: str
    statistics: SampleStatistics
    survey: Survey

    def as_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        return {
            "path": self.path,
            "parts": [header_as_dict(header) for header in self.headers],
            "part": self.part,
            "mapping": {role: list(channels) for role, channels in self.sources.items()},
            "weighting": self.weighting,
            "decisions": decisions_as_dict(self.survey),
            **self.statistics.as_dict(),
        }

    def lines(self) -> list[str]:
        """The same for a reader."""
        text = [self.path, *_header_lines(self.headers, self.part)]
        text += ["roles", *(f"  {line}" for line in self.mapping), f"weighting   {self.weighting}"]
        statistics = self.statistics
        text.append(f"pixels      {statistics.pixels}, {statistics.empty_pixels} without samples")
        text.append(f"samples     {statistics.samples}, {statistics.misses} of them misses")
        per_pixel = statistics.per_pixel.as_dict()
        if per_pixel:
            low, mean, high = (per_pixel[name][0] for name in ("min", "mean", "max"))
            text.append(f"per pixel   min {low:.0f}  mean {mean:.2f}  max {high:.0f}")
        text.append(f"{'role':<12}{'min':>32}{'mean':>32}{'max':>32}")
        for role, values in statistics.roles.items():
            shown = values.as_dict()
            cells = [_numbers(shown[name]) for name in ("min", "mean", "max")] if shown else ["no hits"]
            text.append(f"  {role:<10}" + "".join(f"{cell:>32}" for cell in cells))
        if statistics.repairs:
            text.append("repaired    " + ", ".join(f"{count} x {what}" for what, count in statistics.repairs.items()))
        else:
            text.append("repaired    nothing: no value is broken")
        return [*text, "a denoising job on this frame", *(f"  {line}" for line in decision_lines(self.survey))]


@dataclass(frozen=True)
class RefusedFile:
    """What is known of a file that a denoising job would refuse: its headers, and the mapping where there is one."""

    path: str
    headers: tuple[Header, ...]
    mapping: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        return {"path": self.path, "parts": [header_as_dict(header) for header in self.headers], "refused": True}

    def lines(self) -> list[str]:
        """The same for a reader."""
        roles = ["roles", *(f"  {line}" for line in self.mapping)] if self.mapping else []
        return [self.path, *_header_lines(self.headers, None), *roles, "a denoising job would refuse it"]


def first_file(source: str | os.PathLike[str]) -> Path:
    """The file itself; of a sequence its first frame, by which a job decides. Raises what `expand` does."""
    return expand(source)[0].source if is_sequence(source) else Path(source)


def refused_file(
    path: str | os.PathLike[str], part: str | int | None = None, overrides: Mapping[str, str] | None = None
) -> RefusedFile:
    """What can be said of a file that `file_info` refuses. Raises InputError where not even its headers can be read."""
    headers = read_headers(path)
    mapping: list[str] = []
    with suppress(LbmcError), DeepReader(path, part) as reader:
        header = reader.header
        mapping = map_roles(header.channel_names, overrides, attributes=header.attributes).lines()
    return RefusedFile(os.fspath(path), tuple(headers), tuple(mapping))


def file_info(
    path: str | os.PathLike[str],
    *,
    part: str | int | None = None,
    overrides: Mapping[str, str] | None = None,
    weighting: WeightingName | None = None,
    normals: NormalSpace = "auto",
    depth: DepthKind = "auto",
    camera: str | None = None,
) -> FileInfo:
    """Reads all of one deep sample file, as a denoising job would, and says what is in it.

    Raises InputError for what a denoising job would refuse, UsageError for options that do not fit the file.
    """
    headers = read_headers(path)
    statistics, surveyor = SampleStatistics(), None
    with SampleReader(
        path, part=part, overrides=overrides, weighting=weighting, normals=normals, depth=depth, camera=camera
    ) as reader:
        for block in reader.blocks():
            surveyor = surveyor or Surveyor(reader.header.display_window)
            statistics.add(block)
            surveyor.add(block)
        assert surveyor is not None
        return FileInfo(
            path=os.fspath(path),
            headers=tuple(headers),
            part=reader.part,
            mapping=tuple(reader.mapping.lines()),
            sources={role: source.channels for role, source in reader.mapping.sources.items()},
            weighting=reader.weighting,
            statistics=statistics,
            survey=surveyor.result(),
        )


def decision_lines(seen: Survey) -> list[str]:
    """What a job that this frame decides for would do without, for a reader; see docs/adapting.md."""
    decided, zeros = decide(seen), sorted(zero_roles(seen) - decide(seen).held)
    mixed = "" if seen.mixed is None else f": depth mixes in {seen.mixed:.1%} of the pixels"
    return [
        f"exposure {seen.exposure:.6g}, depth scale {seen.depth:.6g}",
        f"layers {'1, nothing is hit' if decided.one_layer else f'as many as the network has{mixed}'}",
        *decided.lines(),
        *([f"held, 0 in every sample: {' '.join(zeros)}"] if zeros else []),
        *seen.cells.lines(),
    ]


def decisions_as_dict(seen: Survey) -> dict[str, Any]:
    """The same in plain values; `layers` is null where it is the network's own number."""
    decided = decide(seen)
    return {
        "exposure": seen.exposure,
        "depth_scale": seen.depth,
        "layers": 1 if decided.one_layer else None,
        "mixed_depth": seen.mixed,
        "held_roles": sorted(decided.held | zero_roles(seen)),
        "cells": int(seen.cells.passed.size),
        "cells_passed": int(seen.cells.passed.sum()),
    }


def _header_lines(headers: Sequence[Header], part: int | None) -> list[str]:
    """All parts' headers; the part that is read is marked."""
    text = []
    for number, header in enumerate(headers):
        mark = "*" if number == part else " "
        text.append(f"{mark} part {number} {header.name!r}: {header.type}, {header.compression}")
        text.append(f"    data window     {_window(header.data_window)}")
        text.append(f"    display window  {_window(header.display_window)}, pixel aspect {header.pixel_aspect:g}")
        text.append("    channels        " + " ".join(f"{c.name}:{c.dtype.name}" for c in header.channels))
        text += [f"    {name:<15} {_short(stored.value)}" for name, stored in header.attributes.items()]
    return text


def header_as_dict(header: Header) -> dict[str, Any]:
    """A header in plain values: None for what is not finite, their type's name for attributes not known to lbmc."""
    return {
        "name": header.name,
        "type": header.type,
        "compression": header.compression,
        "line_order": header.line_order,
        "pixel_aspect": header.pixel_aspect,
        "data_window": list(_corners(header)[0]),
        "display_window": list(_corners(header)[1]),
        "channels": {channel.name: channel.dtype.name for channel in header.channels},
        "attributes": {name: _plain(stored.value, stored.type) for name, stored in header.attributes.items()},
    }


def _corners(header: Header) -> tuple[tuple[int, int, int, int], tuple[int, int, int, int]]:
    windows = (header.data_window, header.display_window)
    data, display = ((w.xmin, w.ymin, w.xmax, w.ymax) for w in windows)
    return data, display


def _plain(value: Any, kind: str) -> Any:
    if isinstance(value, bytes):
        return f"<{kind}, {len(value)} bytes>"
    if isinstance(value, float) and not math.isfinite(value):
        return None  # which JSON has no word for
    if isinstance(value, (tuple, list)):
        return [_plain(item, kind) for item in value]
    return value if isinstance(value, (str, int, float, bool)) or value is None else str(value)


def _window(window: Any) -> str:
    return f"{window.width} x {window.height}, ({window.xmin}, {window.ymin}) to ({window.xmax}, {window.ymax})"


def _short(value: Any, limit: int = 100) -> str:
    text = " ".join(str(value).split())
    return text if len(text) <= limit else text[: limit - 3] + "..."


def _numbers(values: list[float]) -> str:
    return " ".join(f"{value:.4g}" for value in values)
