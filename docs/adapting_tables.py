"""The tables of docs/adapting.md, made from docs/results/adapting.json, which benchmarks/bench_adapting.py writes."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from paper_tables import listed, paragraph
from result_tables import markdown

from model.metrics import geometric_mean

RESULTS = Path(__file__).resolve().parent / "results" / "adapting.json"


def savings() -> str:
    """Rows of each saving together: time saved, error added, where the survey chooses it and where it is forced."""
    rows = json.loads(RESULTS.read_text("utf-8"))["rows"]
    labels = list(dict.fromkeys(row["label"] for row in rows))
    head = ("saving", "scenes", "number", "network's time saved", "relMSE (worst)", "largest change elsewhere")
    return markdown(head, (_line(row) for row in sorted(rows, key=lambda row: labels.index(row["label"]))))


def _line(row: Mapping[str, Any]) -> list[str]:
    saved = 1 - sum(row["after"]) / sum(row["before"])
    errors = row["errors"]
    error = f"{100 * (geometric_mean(errors) - 1):+.1f} % ({100 * (max(errors) - 1):+.1f} %)" if errors else "–"
    change = f"{max(row['change']):.0e}" if row["change"] else "–"
    return [row["label"], row["scenes"], str(len(row["before"])), f"{100 * saved:.0f} %", error, change]


def halves() -> str:
    """How much less of the network's time a frame takes whose upper half holds nothing to do: a sentence."""
    against = ", against a full frame"
    saved = {row["scenes"].removesuffix(against): 1 - sum(row["after"]) / sum(row["before"])
             for row in json.loads(RESULTS.read_text("utf-8"))["rows"] if row["scenes"].endswith(against)}
    told = [f"{100 * share:.0f} % with {name.removesuffix(' above')}" for name, share in saved.items()]
    return paragraph("Against a full frame of 768 x 768 pixels, one whose upper half holds nothing to do takes less of "
                     f"the network's time by {listed(told)}.")


ADAPTING_TABLES: Mapping[str, Callable[[], str]] = {"adapting": savings, "adapting-halves": halves}
