"""Measures images against references: single files or sequences, as scores, heat maps and panels."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from importlib.util import find_spec
from math import isfinite, isnan
from pathlib import Path
from typing import Any

import numpy as np
from fileseq.frameset import FrameSet
from numpy.typing import NDArray

from deep_io.atomic import atomic_output, output_action
from deep_io.errors import InputError, UsageError
from deep_io.sequences import Frame, expand, frame_path, has_range, is_sequence
from model.metrics import Scores, geometric_mean, score
from pipelines.flat_pictures import (
    FlatPicture,
    PathLike,
    check_finite,
    check_halves,
    check_window,
    mean_of_halves,
    read_rgb,
)
from pipelines.jobs import JobReport, run_frames
from pipelines.pictures import heat_map, panel
from pipelines.progress import Progress, ProgressKind, make_progress

TITLES = {
    "relmse": "relMSE",
    "relmse_trimmed": "relMSE, worst 0.1 % of pixels left out",
    "relmse_small_epsilon": "relMSE, epsilon 0.0001",
    "relmse_unbiased": "relMSE, free of the reference's noise",
    "floor": "relMSE of the reference itself",
    "smape": "SMAPE",
    "psnr": "PSNR (tone-mapped), dB",
    "ssim": "SSIM (tone-mapped)",
    "flip": "FLIP (HDR)",
    "energy": "mean of image / mean of reference",
}
"""Field of Scores to its name for a reader, in the order shown."""
GEOMETRIC = ("relmse", "relmse_trimmed", "relmse_small_epsilon")
"""Averaged over images as geometric means; the others as means."""


@dataclass(frozen=True)
class Comparison:
    """One image against its reference."""

    image: FlatPicture
    reference: FlatPicture
    other_half: FlatPicture | None
    scores: Scores

    @property
    def target(self) -> NDArray[np.floating[Any]]:
        """The reference, or the mean of its two halves."""
        if self.other_half is None:
            return self.reference.rgb
        return mean_of_halves(self.reference, self.other_half)

    def heat_map(self) -> bytes:
        """PNG of the signed relative error with its scale."""
        return heat_map(self.image.rgb, self.target)

    def panel(self) -> bytes:
        """PNG of image, reference, error, and crops of the worst regions."""
        name = os.path.basename(self.image.path)
        return panel({name: self.image.rgb}, self.target)


@dataclass(frozen=True)
class CompareOptions:
    """What a comparison is told; every path may be a sequence pattern."""

    image: str
    reference: str
    """A single reference serves all frames of a sequence."""
    other_half: str | None = None
    """`reference` and this are independent renderings of one picture."""
    frames: str | None = None
    """Fileseq range. None: the frames that all sequences have; the others are told, and as good as failed."""
    part: str | None = None
    """Of multi-part files, see `read_rgb`."""
    layer: str | None = None
    heat_map: str | None = None
    """PNG to write; a pattern for sequences."""
    panel: str | None = None
    overwrite: bool = False
    flip: bool = True
    progress: ProgressKind = "auto"


def compare_frames(options: CompareOptions) -> JobReport[Comparison]:
    """Compares a file or all frames of a sequence and writes the pictures asked for.

    Raises InputError when no frame is in common, UsageError for outputs that are refused. What is wrong with one frame
    fails that frame only; see `compare`. Frames that not all sequences have are left out, told, and in the report.
    """
    selection = _select(options)
    frames = selection.frames
    pictures = _pictures(options, frames)

    def work(frame: Frame, progress: Progress) -> Comparison:
        comparison = compare(*_inputs(options, frame), part=options.part, layer=options.layer, with_flip=options.flip)
        for pattern, draw in pictures.items():
            with atomic_output(_of_frame(pattern, frame)) as path:
                path.write_bytes(draw(comparison))
        return comparison

    with make_progress(options.progress if len(frames) > 1 else "none", len(frames)) as progress:
        if options.flip and not flip_installed():
            progress.note("FLIP is left out: flip-evaluator is not installed; install lbmc with its extra 'bench'")
        if selection.missing:
            progress.note(selection.note())
        return replace(run_frames(frames, work, progress), left_out=selection.left_out(options.image))


def flip_installed() -> bool:
    """Whether `flip_evaluator` can be imported."""
    return find_spec("flip_evaluator") is not None


@dataclass(frozen=True)
class _Selection:
    """The frames to compare.

    missing : sequence -> numbers of the frames that another has and it lacks, ascending
    """

    frames: list[Frame]
    missing: dict[str, list[int]] = field(default_factory=dict)

    def note(self) -> str:
        """What is left out, for a reader."""
        left_out = len(set().union(*self.missing.values()))
        lacks = "; ".join(f"{pattern} lacks {FrameSet(numbers)}" for pattern, numbers in self.missing.items())
        return (f"{left_out} of {left_out + len(self.frames)} frames are left out: {lacks}; "
                "pass --frames to name those to compare")

    def left_out(self, image: str) -> dict[str, str]:
        """Name of the image of each frame that is left out -> the files that are missing."""
        found: dict[str, str] = {}
        for number in sorted(set().union(*self.missing.values())):
            lacking = [pattern for pattern, numbers in self.missing.items() if number in numbers]
            files = " and ".join(str(frame_path(pattern, number)) for pattern in lacking)
            found[frame_path(image, number).name] = f"{files}: no such file"
        return found


def _select(options: CompareOptions) -> _Selection:
    """Raises InputError for what is missing, a folder, or a sequence without a frame that all others have."""
    others = [other for other in (options.reference, options.other_half) if other is not None]
    for path in (options.image, *others):
        if os.path.isdir(path):
            raise InputError(f"{path}: is a folder; name a sequence in it, such as {Path(path, 'NAME.####.exr')}, or "
                             "use lbmc bench DIR for deep files with references")
    frames = expand(options.image, options.frames)
    many = is_sequence(options.image)
    for other in others:
        if is_sequence(other):
            if not many:
                raise InputError(f"{other}: is a sequence, but {options.image} is a single file; name one frame of it")
        elif not Path(other).exists():
            raise InputError(f"{other}: no such file")
    if not many or options.frames is not None or has_range(options.image):
        return _Selection(frames)
    numbers = {pattern: {frame.number or 0 for frame in expand(pattern)}
               for pattern in (options.image, *others) if is_sequence(pattern)}
    every, common = set().union(*numbers.values()), set.intersection(*numbers.values())
    if not common:
        raise InputError(f"{' and '.join([options.image, *others])} have no frame in common")
    missing = {pattern: sorted(every - there) for pattern, there in numbers.items() if every - there}
    return _Selection([frame for frame in frames if frame.number in common], missing)


def _pictures(options: CompareOptions, frames: list[Frame]) -> dict[str, Callable[[Comparison], bytes]]:
    """What to draw, by the path or pattern it goes to, checked before any work. Raises UsageError."""
    if options.panel is not None and options.panel == options.heat_map:
        raise UsageError(f"{options.panel}: is to be both heat map and panel; give each a name of its own")
    asked = {options.heat_map: Comparison.heat_map, options.panel: Comparison.panel}
    pictures: dict[str, Callable[[Comparison], bytes]] = {
        pattern: draw for pattern, draw in asked.items() if pattern is not None
    }
    for pattern in pictures:
        if Path(pattern).suffix.lower() != ".png":
            raise UsageError(f"{pattern}: a PNG is written; give it a name that ends in .png")
        if is_sequence(pattern) != is_sequence(options.image):
            raise UsageError(f"{pattern}: write one picture per frame, such as error.####.png, for a sequence only")
        for frame in frames:
            inputs = [path for path in _inputs(options, frame) if path is not None]
            output_action(_of_frame(pattern, frame), inputs, "overwrite" if options.overwrite else "refuse",
                          can_skip=False)
    return pictures


def _inputs(options: CompareOptions, frame: Frame) -> tuple[Path, Path, Path | None]:
    half = None if options.other_half is None else _of_frame(options.other_half, frame)
    return frame.source, _of_frame(options.reference, frame), half


def _of_frame(pattern: str, frame: Frame) -> Path:
    return frame_path(pattern, frame.number) if frame.number is not None and is_sequence(pattern) else Path(pattern)


def compare(
    image: PathLike, reference: PathLike, other_half: PathLike | None = None, *, part: str | None = None,
    layer: str | None = None, with_flip: bool = True,
) -> Comparison:
    """Measures one image; with `other_half`, the reference is the mean of two independent renderings.

    `part` and `layer` say which colour of the files, see `read_rgb`. Raises InputError for files that cannot be read as
    flat RGB, windows that differ (both are named), values that are not finite, halves that are one and the same picture
    and a reference without light.
    """
    paths = (image, reference, *([other_half] if other_half is not None else []))
    pictures = [read_rgb(path, part, layer) for path in paths]
    for other in pictures[1:]:
        check_window(pictures[0], other)
    check_finite(pictures)
    half = pictures[2] if other_half is not None else None
    if half:
        check_halves(pictures[1], half)
    try:
        scores = score(pictures[0].rgb, pictures[1].rgb, half.rgb if half else None, with_flip=with_flip)
    except ValueError as error:
        raise InputError(f"{pictures[1].path}: {error}") from error
    return Comparison(pictures[0], pictures[1], half, scores)


def mean_scores(rows: Sequence[Scores]) -> dict[str, float | None]:
    """Geometric means of the relMSEs, means of the others; None where a metric is missing in some image."""
    means: dict[str, float | None] = {}
    for name in TITLES:
        values = [getattr(row, name) for row in rows]
        if not values or any(value is None for value in values):
            means[name] = None
        else:
            means[name] = geometric_mean(values) if name in GEOMETRIC else float(np.mean(values))
    return means


def scores_as_dict(scores: Scores) -> dict[str, float | None]:
    """For JSON: what is missing or not finite is None."""
    return _finite(asdict(scores))


def score_lines(scores: Scores) -> list[str]:
    """One line per metric that was measured."""
    measured = {field.name: getattr(scores, field.name) for field in fields(scores)}
    return [
        f"{measured[name]:>12.6g}  {title}"
        for name, title in TITLES.items()
        if measured[name] is not None and not isnan(measured[name])
    ]


def comparison_as_dict(report: JobReport[Comparison]) -> dict[str, Any]:
    """All images and their means as plain values, and the frames that failed or were left out, for JSON."""
    rows = report.values
    return {
        "images": [{"image": row.image.path, "reference": row.reference.path, **scores_as_dict(row.scores)}
                   for row in rows],
        "mean": _finite(mean_scores([row.scores for row in rows])),
        "failed": [{"frame": frame.label, "error": frame.told} for frame in report.failed],
        "left_out": [{"frame": label, "error": why} for label, why in report.left_out.items()],
    }


def comparison_lines(rows: Sequence[Comparison]) -> list[str]:
    """One image: a line per metric. Several: a table that ends with their means, the geometric ones in a row apart."""
    if len(rows) == 1:
        return score_lines(rows[0].scores)
    means = mean_scores([row.scores for row in rows])
    shown = {os.path.basename(row.image.path): asdict(row.scores) for row in rows}
    shown["geometric mean"] = {name: means[name] for name in GEOMETRIC}
    shown["mean"] = {name: value for name, value in means.items() if name not in GEOMETRIC}
    width = max(map(len, shown))
    columns = [name for name in TITLES if means[name] is not None]
    head = f"{'':{width}}" + "".join(f"{name.removeprefix('relmse_') or name:>15}" for name in columns)
    return [head, *(f"{name:{width}}" + "".join(_cell(row.get(column)) for column in columns)
                    for name, row in shown.items())]


def _cell(value: float | None) -> str:
    return f"{'–':>15}" if value is None else f"{value:15.5g}"


def _finite(values: dict[str, float | None]) -> dict[str, float | None]:
    """What is missing or not finite as None, since JSON knows no infinity."""
    return {name: value if value is not None and isfinite(value) else None for name, value in values.items()}
