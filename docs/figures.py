#!/usr/bin/env python3
"""Draws the charts of README.md and docs/results.md from measured results; computes nothing itself.

    python docs/figures.py [RESULTS.json] [--out FOLDER]

RESULTS.json is what `lbmc bench` wrote, results.json of this repository if none is named. Charts go to docs/images:
speed.png (time against error), growth.png (cost from 4 to 64 samples per pixel); from docs/results/samples.json,
samples.png (error against samples per pixel); and from docs/results/paper.json, paper.png (time against error of
networks of reduced width). Needs the extra `bench`.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib

matplotlib.use("agg")

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullLocator

sys.path.insert(0, str(Path(__file__).resolve().parent))

import paper_tables

from model.metrics import geometric_mean
from pipelines.bench.charts import Style, number
from pipelines.bench.report import styles
from pipelines.bench.results import Results, pareto
from pipelines.bench.tables import FULL_HD, front_points

HOME = Path(__file__).resolve().parents[1]
MARKERS = {"circle": "o", "square": "s", "triangle": "^", "diamond": "D"}
GROWING = {"LAYER": "#2c5aa0", "SAMPLESPLAT": "#c0504d"}
"""The networks of the paper's Figure 10, and their colours."""
PLAIN = Style("#8a8f98", "diamond")
REDUCED = {
    "clamp and blur": ("^", "#4c7a2e"), "OIDN + albedo, normal": ("s", "#d0702a"), "PIXELGATHER": ("v", "#8e44ad"),
    "SAMPLESPLAT": ("P", "#8e44ad"), "LAYER": ("D", "#8e44ad"), "LAYER_w": ("D", "#d35d9e"),
    "LAYER, tone-mapped L2": ("d", "#c9a0dc"), "OPTIMIZED": ("X", "#8e44ad"), "pixel aggregate": ("v", "#2f7ed8"),
    "fast, 1 layer": ("p", "#2f7ed8"), "fast": ("o", "#2f7ed8"),
}
"""Markers and colours of paper.png; LAYER of other numbers of layers is on its line."""


LABELS = ((8, 8), (-20, -24), (14, 26), (4, -36))
"""Where a label stands from its point, and where if one, two or three neighbours on the left have labels; points."""
NEAR = (3.0, 1.3)
"""Points that differ by less than these factors, in time and in error, are neighbours."""


def load(path: Path) -> Results:
    """What `lbmc bench` wrote."""
    return Results.from_dict(json.loads(path.read_text("utf-8")))


def speed(results: Results) -> Figure:
    """Time against error over the largest group of scenes, both logarithmic, with the Pareto front."""
    samples = results.groups()[0]
    points = {name: (seconds * FULL_HD, error) for name, (seconds, error) in front_points(results, samples).items()}
    looks = styles(results.methods)
    noisy = next((row.scores["relmse"] for name, row in results.summary(samples).items() if name == "noisy"), None)
    figure, axes = plt.subplots(figsize=(8, 4.6), dpi=110)
    front = [points[name] for name in pareto(points)]
    stairs = [(x, y) for (x0, y0), (x1, _) in zip(front, front[1:], strict=False) for x, y in ((x0, y0), (x1, y0))]
    axes.plot(*zip(*stairs, front[-1], strict=True), color="#c9ced6", lw=2, zorder=1, label="Pareto front")
    if noisy is not None:
        axes.axhline(noisy, color=PLAIN.color, lw=1, ls=":", label="noisy")
    for name, (seconds, error) in points.items():
        look = looks[name]
        axes.plot(seconds, error, MARKERS[look.shape], color=look.color, ms=9, zorder=3)
        axes.annotate(name, (seconds, error), xytext=LABELS[crowded(points, name) % len(LABELS)],
                      textcoords="offset points", fontsize=9, arrowprops={"arrowstyle": "-", "color": PLAIN.color,
                                                                          "lw": 0.6, "shrinkB": 5})
    _log_axes(axes, "CPU seconds at 1920 x 1080 (one thread)" if results.machine["threads"] == 1 else
              "CPU seconds at 1920 x 1080", "relMSE")
    axes.set_xlim(right=max(x for x, _ in points.values()) * 2.5)
    axes.set_ylim(bottom=min(y for _, y in points.values()) / 1.5)
    count = len(results.scenes_of(samples))
    axes.set_title(f"Time against error: {count} scenes, {samples} samples per pixel", fontsize=11, loc="left")
    axes.legend(frameon=False, fontsize=9, loc="center right")
    return figure


def crowded(points: Mapping[str, tuple[float, float]], name: str) -> int:
    """How many neighbours in a row stand so close to the left that their labels would cover that of `name`."""
    x, y = points[name]
    left = [(other, at) for other, at in points.items()
            if at[0] < x < NEAR[0] * at[0] and max(at[1], y) < NEAR[1] * min(at[1], y)]
    return 1 + max(crowded(points, other) for other, _ in left) if left else 0


def growth(results: Results) -> Figure:
    """Multiply-adds and measured time per pixel, 4 to 64 samples: the paper's networks, and ours."""
    figure, (counted, timed) = plt.subplots(1, 2, figsize=(10, 4.2), dpi=110)
    ours = [spec.name for spec in results.methods if spec.family == "lbmc"]
    looks = {**GROWING, **dict(zip(ours, ("#2f9e6e", "#7a5bd6", "#e39b2d"), strict=False))}
    for name, color in looks.items():
        rows = sorted((point.samples, point.multiply_adds, point.cpu) for point in results.growth
                      if point.network == name)
        _line(counted, name, color, [(n, 1e-6 * products) for n, products, _ in rows])
        _line(timed, name, color, [(n, 1e6 * seconds) for n, _, seconds in rows if seconds is not None])
    for axes, label, title in ((counted, "million multiply-adds per pixel", "Counted"),
                               (timed, "CPU microseconds per pixel", "Measured")):
        _log_axes(axes, "samples per pixel", label, sorted({point.samples for point in results.growth}))
        axes.set_title(title, fontsize=11, loc="left")
        axes.legend(frameon=False, fontsize=9)
    return figure


def reduced() -> Figure:
    """Time against error of the networks of reduced width, on either set of scenes."""
    figure, panels = plt.subplots(1, len(paper_tables.SETS), figsize=(12, 5.4), dpi=110, layout="constrained")
    rows = paper_tables.load(paper_tables.PAPER)["rows"].values()
    ours = {row["name"]: f"{row['name']}, {row['steps']} steps" for row in rows if row["group"] == "ours"}
    for axes, (name, words) in zip(panels, paper_tables.SETS.items(), strict=True):
        points = paper_tables.points(name)
        layers = {count: points[label] for count, label in paper_tables.LAYERS.items() if label in points}
        axes.plot(*zip(*layers.values(), strict=True), ".-", color="#c9a0dc", lw=1, ms=6, zorder=1,
                  label=f"LAYER, {min(layers)} to {max(layers)} layers")
        for count, point in layers.items():
            axes.annotate(str(count), point, xytext=(6, -3), textcoords="offset points", fontsize=8, color="#8e44ad")
        for label, (marker, color) in REDUCED.items():
            if label in points:
                axes.plot(*points[label], marker, color=color, ms=8, zorder=3, mec="white", mew=0.6,
                          label=ours.get(label, label))
        _log_axes(axes, "CPU seconds per megapixel", "relMSE")
        axes.set_title(f"{words}, {paper_tables.load(paper_tables.PAPER)['times']['samples']} samples per pixel",
                       fontsize=11, loc="left")
    figure.legend(*panels[0].get_legend_handles_labels(), frameon=False, fontsize=9, ncol=4, loc="outside lower center")
    return figure


def by_samples(results: Results) -> Figure:
    """Error against samples per pixel, geometric means over the scenes of the largest group."""
    figure, axes = plt.subplots(figsize=(8, 4.6), dpi=110)
    looks = styles(results.methods)
    for name, points in error_by_samples(results).items():
        look = looks[name]
        axes.plot(*zip(*points.items(), strict=True), MARKERS[look.shape] + "-", color=look.color, ms=6, label=name)
    counts = sorted({n for points in error_by_samples(results).values() for n in points})
    _log_axes(axes, "samples per pixel", "relMSE", counts)
    axes.set_title(f"Error against samples per pixel: {len(results.scenes)} scenes, nested subsets", fontsize=11,
                   loc="left")
    axes.legend(frameon=False, fontsize=9)
    return figure


def error_by_samples(results: Results) -> dict[str, dict[int, float]]:
    """relMSE of each method at 1, 2, 4, ... samples and at the scenes' own number: geometric means over scenes."""
    own = results.groups()[0]
    errors: dict[str, dict[int, list[float]]] = {}
    for point in results.curve:
        errors.setdefault(point.method, {}).setdefault(point.samples, []).append(point.relmse)
    for row in results.measurements:
        if row.scores and row.method in errors:
            errors[row.method].setdefault(own, []).append(float(row.scores["relmse"] or 0.0))
    return {name: {n: geometric_mean(values) for n, values in sorted(by.items())} for name, by in errors.items()}


def _line(axes: Axes, name: str, color: str, points: Sequence[tuple[float, float]]) -> None:
    if points:
        axes.plot(*zip(*points, strict=True), "o-", color=color, ms=5, label=name)


def _log_axes(axes: Axes, x: str, y: str, ticks: Sequence[float] = ()) -> None:
    """Both logarithmic, with ticks that read as numbers."""
    axes.set_xscale("log")
    axes.set_yscale("log")
    plain = FuncFormatter(lambda value, _: number(value))
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(plain)
        axis.set_minor_formatter(FuncFormatter(lambda value, _: number(value) if f"{value:e}"[0] in "25" else ""))
        axis.set_tick_params(which="both", labelsize=8)
    if ticks:
        axes.set_xticks(list(ticks))
        axes.xaxis.set_minor_locator(NullLocator())
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.grid(True, which="both", color="#eceef2", lw=0.8)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def save(figures: Mapping[str, Figure], folder: Path) -> None:
    """As PNGs that depend on the data alone."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, figure in figures.items():
        if figure.get_layout_engine() is None:
            figure.tight_layout()
        figure.savefig(folder / f"{name}.png", metadata={"Software": None})
        plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("results", nargs="?", type=Path, default=HOME / "results.json")
    parser.add_argument("--out", type=Path, default=HOME / "docs" / "images")
    options = parser.parse_args()
    results = load(options.results)
    figures = {"speed": speed(results)}
    if results.growth:
        figures["growth"] = growth(results)
    samples = HOME / "docs" / "results" / "samples.json"
    if samples.exists():
        figures["samples"] = by_samples(load(samples))
    if "times" in paper_tables.load(paper_tables.PAPER):
        figures["paper"] = reduced()
    save(figures, options.out)


if __name__ == "__main__":
    main()
