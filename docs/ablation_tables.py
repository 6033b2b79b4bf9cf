"""The tables of docs/ablations.md, made from what benchmarks/ablations.py left in docs/results/ablations.json, and on
other scenes of losses in leaks.json."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from model.metrics import geometric_mean

HOME = Path(__file__).resolve().parent.parent
ABLATIONS, LEAKS = (HOME / "docs" / "results" / f"{name}.json" for name in ("ablations", "leaks"))
OTHER_SETS = {"watched": "20 watched", "shared": "12 further"}
BASE, LAYER_TOPICS = "base", ("", "layers")
MEANS: Mapping[str, Callable[[list[float]], float]] = {
    "relmse": geometric_mean, "trimmed": geometric_mean, "smape": lambda values: float(np.mean(values))}
"""How each error is averaged over scenes."""
TITLES = {"relmse": "relMSE", "trimmed": "trimmed", "smape": "SMAPE"}
Row = dict[str, Any]


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table whose columns, but for the first two, are numbers."""
    lines = [head, ["---", "---", *["---:"] * (len(head) - 2)], *rows]
    return "".join(f"| {' | '.join(row)} |\n" for row in lines)


def runs_of(document: Row) -> dict[str, dict[int, Row]]:
    """Rows by name and seed, with the errors over all scenes that they were scored on."""
    found: dict[str, dict[int, Row]] = {}
    for row in document["rows"].values():
        scenes = [scene for scenes in row["scenes"].values() for scene in scenes.values()]
        errors = {key: mean([scene[key] for scene in scenes]) for key, mean in MEANS.items()}
        found.setdefault(row["name"], {})[row["seed"]] = {**row, "errors": errors}
    return found


def spread(base: Mapping[int, Row], key: str) -> float:
    """The base's largest error over its smallest, among seeds; infinite for one seed, which tells nothing."""
    values = [row["errors"][key] for row in base.values()]
    return max(values) / min(values) if len(values) > 1 else float("inf")


def ratios(rows: Mapping[int, Row], base: Mapping[int, Row], key: str) -> list[float]:
    """Of a change's errors to the base's of the same seed."""
    return [rows[seed]["errors"][key] / base[seed]["errors"][key] for seed in sorted(rows) if seed in base]


def stands_out(values: Sequence[float], within: float) -> bool:
    """Whether the seeds agree that it is better, or worse, by more on average than the base's seeds differ."""
    mean = geometric_mean(list(values))
    agreed = all(value > 1 for value in values) or all(value < 1 for value in values)
    return agreed and max(mean, 1 / mean) > within


def cell(values: Sequence[float], within: float) -> str:
    """The mean ratio, bold where it stands out, and the range of several."""
    text = f"{geometric_mean(list(values)):.3f}"
    if stands_out(values, within):
        text = f"**{text}**"
    return text if len(values) == 1 else f"{text} ({min(values):.2f} to {max(values):.2f})"


def mean_of(rows: Mapping[int, Row], key: str) -> float:
    return float(np.mean([row[key] for row in rows.values()]))


def costs(rows: Mapping[int, Row]) -> list[str]:
    """Multiply-adds, CPU seconds of training and of denoising, share of pixels whose layers are in order."""
    topical = all("nearer_with_misses" in row and row["group"] in LAYER_TOPICS for row in rows.values())
    order = f"{100 * mean_of(rows, 'nearer_with_misses'):.1f} %" if topical else "–"
    return [f"{mean_of(rows, 'multiply_adds') / 1e3:.1f} k", f"{mean_of(rows, 'cpu_seconds_a_step'):.2f}",
            f"{mean_of(rows, 'cpu_seconds_a_megapixel'):.1f}", order]


def changes(document: Row, planned: Mapping[str, str] = MappingProxyType({})) -> str:
    """Every change of the base, topic by topic; of those planned, name -> topic, also the ones without a run."""
    found = runs_of(document)
    base = found.pop(BASE)
    lines = [["", "the base", str(len(base)), *["1"] * len(MEANS), *costs(base)]]
    topic_of = {**planned, **{name: row["group"] for name, rows in found.items() for row in rows.values()}}
    for topic in dict.fromkeys(topic_of.values()):
        for name in (name for name, its in topic_of.items() if its == topic):
            paired = {seed: row for seed, row in found.get(name, {}).items() if seed in base}
            if paired:
                cells = [cell(ratios(paired, base, key), spread(base, key)) for key in MEANS]
                lines.append([topic, name, str(len(paired)), *cells, *costs(paired)])
            else:
                lines.append([topic, name, "not run", *["–"] * (len(MEANS) + 4)])
    return markdown(("topic", "change", "seeds", *TITLES.values(), "multiply-adds", "CPU s a step", "CPU s a Mpx",
                     "front is nearer"), lines)


def seeds(document: Row) -> str:
    """The base, seed by seed, and its spread."""
    base = runs_of(document)[BASE]
    lines = [[f"seed {seed}", *(f"{row['errors'][key]:.4f}" for key in MEANS)] for seed, row in sorted(base.items())]
    if len(base) > 1:
        lines.append(["largest over smallest", *(f"{spread(base, key):.3f}" for key in MEANS)])
    return markdown(("the base", *TITLES.values()), lines)


def load() -> Row:
    document: Row = json.loads(ABLATIONS.read_text("utf-8"))
    return document


def planned_changes() -> dict[str, str]:
    """Name and topic of what benchmarks/ablations.py would run."""
    sys.path.append(str(HOME / "benchmarks"))
    from ablations import CHANGES

    return {change.name: change.topic for change in CHANGES}


def by_seed(path: Path) -> str:
    """Changes on other scenes, seed by seed: relMSE and SMAPE over the base's, and how far energy is off."""
    found: dict[str, list[Row]] = {}
    for row in json.loads(path.read_text("utf-8"))["rows"].values():
        found.setdefault(row["name"], []).append(row)
    head = ["of the base's, by seed", "seeds", *(f"{word}, {words}" for words in OTHER_SETS.values()
                                                 for word in ("relMSE", "SMAPE", "energy off"))]
    lines = []
    for name, rows in found.items():
        cells: list[list[float]] = []
        for scenes in OTHER_SETS:
            mine, base = ([list(row["scenes"][scenes].values()) for row in part] for part in (rows, found[BASE]))
            cells += [[MEANS[key]([scene[key] for scene in one]) / MEANS[key]([scene[key] for scene in other])
                       for one, other in zip(mine, base, strict=True)] for key in ("relmse", "smape")]
            cells.append([float(np.mean([abs(scene["energy"] - 1) for scene in one])) for one in mine])
        digits = [2, 2, 3] * len(OTHER_SETS)
        lines.append([name, str(len(rows)), *(", ".join(f"{value:.{count}f}" for value in cell)
                                              for cell, count in zip(cells, digits, strict=True))])
    return markdown(head, lines)


ABLATION_TABLES: Mapping[str, Callable[[], str]] = {
    "ablations": lambda: changes(load(), planned_changes()),
    "ablations-base": lambda: seeds(load()),
    "ablations-leaks": lambda: by_seed(LEAKS),
}
