"""The table of whole folders in docs/results.md, made from what `benchmarks/quality.py --json` left in docs/results."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from result_tables import markdown

from model.metrics import bootstrap_interval, geometric_mean

RESULTS = Path(__file__).resolve().parent / "results"
SETS = {"shared": "12 of another generator", "unseen": "20 of our own, unseen", "watched": "20 of our own, watched"}
"""docs/results/quality-NAME.json, and what the table calls it."""
METHODS = {"noisy": "noisy", "baseline": "clamp and blur", "OIDN color": "OIDN colour",
           "OIDN aux": "OIDN + albedo, normal", "OIDN prefiltered": "OIDN prefiltered", "lbmc fast": "lbmc fast",
           "lbmc high": "lbmc high", "lbmc best": "lbmc best"}
MINE, YARDSTICK = ("lbmc fast", "lbmc high", "lbmc best"), "OIDN aux"
MANY = ".32spp"  # the same scenes as others of their set


def scores(name: str) -> list[Mapping[str, Any]]:
    """Method -> scores, for every scene of a set."""
    document = json.loads((RESULTS / f"quality-{name}.json").read_text("utf-8"))
    return [row for scene, row in document.items() if MANY not in scene]


def quality() -> str:
    """relMSE with its interval, SMAPE, energy, of every method on every set; then ours as a share of OIDN's."""
    sets = {name: scores(name) for name in SETS}
    head = ["", *(cell for words in SETS.values() for cell in (f"relMSE, {words}", "SMAPE", "energy"))]
    rows = [[label, *(cell for scenes in sets.values() for cell in _cells(scenes, method))]
            for method, label in METHODS.items()]
    rows += [[f"{METHODS[mine]} : {METHODS[YARDSTICK]}", *(cell for scenes in sets.values()
              for cell in _ratios(scenes, mine))] for mine in MINE]
    return markdown(head, rows)


def _cells(scenes: list[Mapping[str, Any]], method: str) -> list[str]:
    errors = [scene[method]["relmse"] for scene in scenes]
    low, high = bootstrap_interval(errors)
    means = [float(np.mean([scene[method][name] for scene in scenes])) for name in ("smape", "energy")]
    return [f"{geometric_mean(errors):.4f} [{low:.4f}, {high:.4f}]", f"{means[0]:.4f}", f"{means[1]:.3f}"]


def _ratios(scenes: list[Mapping[str, Any]], mine: str) -> list[str]:
    """Paired, scene by scene, so that the interval says how sure the comparison is."""
    errors = [scene[mine]["relmse"] / scene[YARDSTICK]["relmse"] for scene in scenes]
    low, high = bootstrap_interval(errors)
    smape = [float(np.mean([scene[method]["smape"] for scene in scenes])) for method in (mine, YARDSTICK)]
    return [f"{geometric_mean(errors):.2f} [{low:.2f}, {high:.2f}]", f"{smape[0] / smape[1]:.2f}", ""]


QUALITY_TABLES: Mapping[str, Callable[[], str]] = {"quality": quality}
