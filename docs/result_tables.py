"""The tables of measured results: made from the JSON that benchmarks left in the repository, checked by docs/tables.py.

results.json is `lbmc bench examples/scenes`; docs/results/samples.json is `lbmc bench` on scenes of 32 samples;
docs/results/paper.json is benchmarks/paper.py's, docs/results/layers_alive.json benchmarks/layers_alive.py's.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from model.metrics import geometric_mean
from pipelines.bench.charts import number
from pipelines.bench.results import Results, own, pareto
from pipelines.bench.tables import FULL_HD, PUBLISHED, front_points

HOME = Path(__file__).resolve().parent.parent
BENCH, SAMPLES = HOME / "results.json", HOME / "docs" / "results" / "samples.json"
PAPER, ALIVE = HOME / "docs" / "results" / "paper.json", HOME / "docs" / "results" / "layers_alive.json"
PUBLISHED_LAYERS = {2: 0.0288, 3: 0.0315, 4: 0.0313, 5: 0.0332}
"""relMSE of LAYER with so many layers as published; the paper's figure for one layer is not at hand."""
SETS = {"val2": "14 of our own", "shared": "12 further"}
"""Sets of scenes in the JSON, and what the tables call them."""
BLURRED, STILL = "defocus or motion", "neither"
Row = dict[str, Any]


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table whose columns, but for the first, are numbers."""
    lines = [head, ["---", *["---:"] * (len(head) - 1)], *rows]
    return "".join(f"| {' | '.join(row)} |\n" for row in lines)


def load(path: Path) -> Any:
    return json.loads(path.read_text("utf-8"))


# --- lbmc bench ----------------------------------------------------------------------------------------------------


def bench() -> str:
    """README.md: every method's error and time, beside OIDN's time in the same run."""
    results = Results.from_dict(load(BENCH))
    samples = results.groups()[0]
    summary, front = results.summary(samples), pareto(front_points(results, samples))
    oidn = next((row.own_cpu for name, row in summary.items() if name.startswith("OIDN +")), None)
    rows = []
    for spec in results.methods:
        if spec.name not in summary or spec.family == "saving":
            continue
        row = summary[spec.name]
        error = [("–" if row.scores.get(key) is None else f"{row.scores[key]:.4f}") for key in ("relmse", "smape")]
        time = ["–"] * 3
        if spec.family != "input":
            ratio = "–" if oidn is None else f"{row.own_cpu / oidn:.2f}"
            time = [number(row.own_cpu * FULL_HD), number(row.own_wall * FULL_HD), ratio]
        rows.append([spec.name + (" ★" if spec.name in front else ""), *error, *time])
    head = ("method", "relMSE", "SMAPE", "CPU s at 1080p", "wall s", "CPU time of OIDN's")
    return markdown(head, rows)


def stages() -> str:
    """Where the time goes: read, the method's own work, write; CPU seconds of a frame of 1920 x 1080."""
    results = Results.from_dict(load(BENCH))
    rows = []
    for name, row in results.summary(results.groups()[0]).items():
        cells = [row.cpu.get("read", 0.0), row.cpu.get("flatten", 0.0), own(row.cpu), row.cpu.get("write", 0.0)]
        rows.append([name, *(number(FULL_HD * seconds) if seconds else "–" for seconds in cells)])
    return markdown(("method", "read", "flatten", "own work", "write"), rows)


def growth() -> str:
    """The paper's Figure 10 in numbers: million multiply-adds and CPU microseconds per pixel."""
    results = Results.from_dict(load(BENCH))
    counts = sorted({point.samples for point in results.growth})
    rows = []
    for name in dict.fromkeys(point.network for point in results.growth):
        points = {point.samples: point for point in results.growth if point.network == name}
        if points[counts[0]].cpu is None:
            continue
        products = [points[n].multiply_adds for n in counts]
        seconds = [points[n].cpu or 0.0 for n in counts]
        rows.append([f"{name}, multiply-adds", *(number(1e-6 * value) for value in products),
                     f"{products[-1] / products[0]:.2f}"])
        rows.append([f"{name}, CPU time", *(number(1e6 * value) for value in seconds),
                     f"{seconds[-1] / seconds[0]:.2f}"])
    return markdown(("", *(f"{n} samples" for n in counts), f"{counts[-1]} over {counts[0]}"), rows)


def samples() -> str:
    """relMSE at 1 to 32 samples per pixel."""
    results = Results.from_dict(load(SAMPLES))
    full = results.groups()[0]
    errors: dict[str, dict[int, list[float]]] = {}
    for point in results.curve:
        errors.setdefault(point.method, {}).setdefault(point.samples, []).append(point.relmse)
    for row in results.measurements:
        if row.scores and row.method in errors:
            errors[row.method].setdefault(full, []).append(float(row.scores["relmse"] or 0.0))
    counts = sorted({n for by in errors.values() for n in by})
    rows = [[name, *(f"{geometric_mean(by[n]):.4f}" for n in counts)] for name, by in errors.items()]
    return markdown(("relMSE with samples per pixel:", *map(str, counts)), rows)


# --- the paper's comparisons ---------------------------------------------------------------------------------------


def mean_errors(row: Row, name: str) -> tuple[float, float]:
    """Geometric mean of relMSE and mean SMAPE over a set of scenes."""
    scenes = row["scenes"][name].values()
    return geometric_mean([scene["relmse"] for scene in scenes]), float(np.mean([scene["smape"] for scene in scenes]))


def errors_of(row: Row) -> list[str]:
    return [f"{value:.4f}" for name in SETS for value in mean_errors(row, name)]


ERRORS = tuple(f"{word}, {scenes}" for scenes in SETS.values() for word in ("relMSE", "SMAPE"))


def paper_rows(names: Sequence[str]) -> list[Row]:
    """The rows of the paper's group by name, those that are there."""
    rows = {row["name"]: row for row in load(PAPER)["rows"].values() if row["group"] == "paper"}
    return [rows[name] for name in names if name in rows]


def variants() -> str:
    """Table 1, and with it Table 4: OPTIMIZED against LAYER."""
    rows = [[row["name"], *errors_of(row), f"{row['multiply_adds'] / 1e3:.0f} k", f"{row['cpu_seconds_a_step']:.2f}",
             *(f"{value:.4f}" for value in PUBLISHED[row["name"]])] for row in paper_rows(list(PUBLISHED))]
    return markdown(("network", *ERRORS, "multiply-adds per pixel", "CPU s a step", "relMSE as published",
                     "SMAPE as published"), rows)


def layer_counts() -> str:
    """Table 2."""
    names = {1: "LAYER, 1 layer", 2: "LAYER", **{n: f"LAYER, {n} layers" for n in (3, 4, 5)}}
    rows = [[str(row["layers"]), *errors_of(row), f"{PUBLISHED_LAYERS[row['layers']]:.4f}"
             if row["layers"] in PUBLISHED_LAYERS else "–"] for row in paper_rows(list(names.values()))]
    return markdown(("layers", *ERRORS, "relMSE as published"), rows)


def losses() -> str:
    """Table 5."""
    names = {"LAYER": "SMAPE", "LAYER, tone-mapped L2": "squared error, tone-mapped"}
    rows = [[names[row["name"]], *errors_of(row)] for row in paper_rows(list(names))]
    return markdown(("trained by", *ERRORS), rows)


# --- the layers are alive ------------------------------------------------------------------------------------------


def blurred_scenes() -> dict[tuple[str, str], bool]:
    """(set, scene) -> whether it has defocus or motion."""
    return {(name, scene): row["blurred"] for name, scenes in load(ALIVE)["sets"].items()
            for scene, row in scenes.items()}


def pairs() -> str:
    """`fast` against others at equal steps, data and seed: ratios of relMSE, seed by seed."""
    rows = [row for row in load(PAPER)["rows"].values() if row["group"] == "ours"]
    by_key = {(row["name"], row["seed"]): row for row in rows}
    blurred = blurred_scenes()
    lines = []
    for other in dict.fromkeys(row["name"] for row in rows if row["name"] != "fast"):
        for name, label in SETS.items():
            for is_blurred, word in ((True, BLURRED), (False, STILL)):
                ratios = {}
                for seed in sorted({row["seed"] for row in rows}):
                    if ("fast", seed) not in by_key or (other, seed) not in by_key:
                        continue
                    mine, theirs = (by_key[key, seed]["scenes"][name] for key in ("fast", other))
                    logs = [math.log(mine[scene]["relmse"] / theirs[scene]["relmse"]) for scene in mine
                            if blurred[name, scene] == is_blurred]
                    ratios[seed] = math.exp(float(np.mean(logs)))
                    count = len(logs)
                if ratios:
                    lines.append([f"against {other}: {word}, {count} of {label}",
                                  *(f"{ratio:.3f}" for ratio in ratios.values()),
                                  f"{geometric_mean(list(ratios.values())):.3f}"])
    seeds = sorted({row["seed"] for row in rows})
    return markdown(("relMSE of `fast`, as a share of the other's", *(f"seed {seed}" for seed in seeds), "mean"),
                    [line for line in lines if len(line) == 2 + len(seeds)])


def alive() -> str:
    """What the layers of the shipped network do where depth mixes within a pixel."""
    lines = []
    for name, scenes in load(ALIVE)["sets"].items():
        for scene, row in sorted(scenes.items(), key=lambda item: not item[1]["blurred"]):
            if "filtered" not in row:
                continue
            found = row["filtered"]
            lines.append([f"{scene} ({BLURRED if row['blurred'] else STILL})", SETS.get(name, name).split()[0],
                          f"{row['mixed']:.1%}", f"{found['front']:.2f}", f"{found['both']:.1%}",
                          f"{row['samples']['nearer']:.1%}", f"{found['nearer']:.1%}"])
    return markdown(("scene", "of the", "depth mixes in", "front layer's weight there", "10 to 90 % in",
                     "front is nearer, samples", "front is nearer, filtered"), lines)


RESULT_TABLES: Mapping[str, Callable[[], str]] = {
    "bench": bench,
    "stages": stages,
    "growth": growth,
    "samples": samples,
    "paper-variants": variants,
    "paper-layers": layer_counts,
    "paper-losses": losses,
    "pairs": pairs,
    "layers-alive": alive,
}
