"""The table of docs/tuning.md, made from what `benchmarks/quality.py --tune --json` left in docs/results."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from result_tables import markdown

from model.metrics import bootstrap_interval, geometric_mean

RESULTS = Path(__file__).resolve().parent / "results"
SETS = {"fresh": "10 of our own, fresh", "shared": "12 of another generator"}
"""docs/results/tuning-NAME.json, and what the table calls it."""
METHODS = {"OIDN aux": "OIDN + albedo, normal", "OIDN prefiltered": "OIDN prefiltered", "lbmc fast": "lbmc fast",
           "lbmc fast tuned": "lbmc fast, tuned"}
PAIRS = (("lbmc fast tuned", "lbmc fast"), ("lbmc fast tuned", "OIDN aux"))
Scenes = list[Mapping[str, Any]]


def scenes(name: str) -> Scenes:
    """Method -> scores, for every scene of a set; what was measured in the run of results.md is put beside it."""
    document, whole = (_read(RESULTS / f"{kind}-{name}.json") for kind in ("tuning", "quality"))
    return [{**whole.get(scene, {}), **row} for scene, row in sorted(document.items())]


def _read(path: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(path.read_text("utf-8")) if path.exists() else {}
    return found


def tuning() -> str:
    """relMSE, SMAPE and how far the energy is off, of every method on every set; then ratios, scene by scene."""
    sets = {name: scenes(name) for name in SETS}
    head = ["", *(cell for words in SETS.values() for cell in (f"relMSE, {words}", "SMAPE", "energy off"))]
    rows = [[label, *(cell for rows in sets.values() for cell in _cells(rows, method))]
            for method, label in METHODS.items()]
    rows += [[f"{METHODS[mine]} : {METHODS[other].removeprefix('lbmc ')}",
              *(cell for rows in sets.values() for cell in _ratios(rows, mine, other))] for mine, other in PAIRS]
    return markdown(head, rows)


def _cells(rows: Scenes, method: str) -> list[str]:
    off = float(np.mean([abs(row[method]["energy"] - 1) for row in rows]))
    smape = float(np.mean([row[method]["smape"] for row in rows]))
    return [f"{geometric_mean([row[method]['relmse'] for row in rows]):.4f}", f"{smape:.4f}", f"{100 * off:.1f} %"]


def _ratios(rows: Scenes, mine: str, other: str) -> list[str]:
    """Paired, with intervals that say how sure the comparison is."""
    cells = []
    for metric in ("relmse", "smape"):
        ratios = [row[mine][metric] / row[other][metric] for row in rows]
        low, high = bootstrap_interval(ratios)
        cells.append(f"{geometric_mean(ratios):.3f} [{low:.3f}, {high:.3f}]")
    return [*cells, ""]


TUNING_TABLES: Mapping[str, Callable[[], str]] = {"tuning": tuning}
