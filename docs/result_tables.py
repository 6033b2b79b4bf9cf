"""The tables of measured results: made from the JSON that benchmarks left in the repository, checked by docs/tables.py.

results.json is `lbmc bench examples/scenes`; docs/results/samples.json is `lbmc bench` on scenes of 32 samples;
docs/results/layers_alive.json is benchmarks/layers_alive.py's, docs/results/visibility.json docs/layer_images.py's.
Networks of reduced width are paper_tables.py's.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

from model.config import LAYER
from model.cost import count
from model.metrics import geometric_mean
from pipelines.bench.charts import number
from pipelines.bench.methods import OUTSIDE, STAGES
from pipelines.bench.results import Results, own, pareto
from pipelines.bench.tables import FULL_HD, front_points

HOME = Path(__file__).resolve().parent.parent
BENCH, SAMPLES = HOME / "results.json", HOME / "docs" / "results" / "samples.json"
ALIVE, VISIBILITY = (HOME / "docs" / "results" / name for name in ("layers_alive.json", "visibility.json"))
SETS = {"val2": "14 of our own", "shared": "12 further"}
ALIVE_SETS = {"watched": "20 of our own", "shared": "12 further"}
"""Sets of scenes in the JSON of networks of reduced width and in that of layers, and what the tables call them."""
LEAST = 0.1
"""The front layer is to have this share of the weight at least, and at most one less it."""
NETWORK_STAGES = {stage: words for stage, words in STAGES.items() if stage not in OUTSIDE}
YARDSTICK = "OIDN + albedo, normal"
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
        if spec.name not in summary:
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


def scenes() -> str:
    """relMSE / SMAPE / PSNR / energy of every scored method on every scene."""
    results = Results.from_dict(load(BENCH))
    names = [spec.name for spec in results.methods if spec.scored]
    scores = {(row.scene, row.method): row.scores for row in results.measurements if row.scores}
    rows = []
    for name in names:
        cells = []
        for scene in results.scenes:
            found = scores[scene.name, name]
            values = [(found[key] or 0.0, digits) for key, digits in
                      (("relmse", 4), ("smape", 4), ("psnr", 2), ("energy", 3))]
            cells.append(" / ".join(f"{value:.{digits}f}" for value, digits in values))
        rows.append([name, *cells])
    return markdown(("relMSE / SMAPE / PSNR / energy", *(scene.name for scene in results.scenes)), rows)


def stages() -> str:
    """Where the time goes: read, the method's own work, write; CPU seconds of a frame of 1920 x 1080."""
    results = Results.from_dict(load(BENCH))
    rows = []
    for name, row in results.summary(results.groups()[0]).items():
        cells = [row.cpu.get("read", 0.0), row.cpu.get("flatten", 0.0), own(row.cpu), row.cpu.get("write", 0.0)]
        rows.append([name, *(number(FULL_HD * seconds) if seconds else "–" for seconds in cells)])
    return markdown(("method", "read", "flatten", "own work", "write"), rows)


def network_stages() -> str:
    """The paper's Table 3: CPU seconds of a frame of 1920 x 1080 by stage of each network, and the whole in OIDN's."""
    results = Results.from_dict(load(BENCH))
    summary = results.summary(results.groups()[0])
    kinds = ("lbmc", "paper")
    rows = []
    for name in (spec.name for spec in results.methods if spec.family in kinds and spec.name in summary):
        row = summary[name]
        cells = [number(FULL_HD * row.cpu[stage]) if stage in row.cpu else "–" for stage in NETWORK_STAGES]
        oidn = summary[YARDSTICK].own_cpu if YARDSTICK in summary else None
        rows.append([name, *cells, number(FULL_HD * row.own_cpu), f"{row.own_cpu / oidn:.2f}" if oidn else "–"])
    return markdown(("CPU s at 1080p", *NETWORK_STAGES.values(), "all", "CPU time of OIDN's"), rows)


def memory() -> str:
    """Peak memory of every method beyond its libraries, and what it was measured on."""
    results = Results.from_dict(load(BENCH))
    protocol = results.protocol
    scene = next(scene for scene in results.scenes if scene.name == protocol["example"])
    large = [max(size, protocol["frame"]) for size in (scene.width, scene.height)]
    small = [protocol["untrained_frame"]] * 2
    rows = []
    for spec in results.methods:
        if spec.name in results.memory:
            width, height = large if spec.scored else small
            taken = results.memory[spec.name]
            rows.append([spec.name, f"{width} x {height}", f"{taken / 2**20:,.0f}", f"{taken / (width * height):,.0f}"])
    return markdown(("method", "frame", "MiB", "bytes per pixel"), rows)


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


def layer_cost() -> str:
    """The multiply-adds of the paper's LAYER, stage by stage."""
    rows = []
    for stage in count(LAYER).stages:
        parts = [stage.pixel, stage.sample, stage.layer, stage.sample_layer]
        total = stage.pixel + 8 * stage.sample + 2 * (stage.layer + 8 * stage.sample_layer)
        rows.append([stage.name, f"{stage.parameters:,}" if stage.parameters else "–",
                     *(f"{value:,.0f}" if value else "–" for value in parts), f"{total:,.0f}"])
    whole = sum(count(LAYER).multiply_adds(8, 2).values())
    rows.append(["**all**", f"{count(LAYER).parameters:,}", "", "", "", "", f"{whole:,.0f}"])
    return markdown(("LAYER", "parameters", "per pixel", "per sample", "per layer", "per sample and layer",
                     "8 samples, 2 layers"), rows)


# --- the layers are alive ------------------------------------------------------------------------------------------


def alive() -> str:
    """What the layers of the shipped network do where depth mixes within a pixel."""

    def nearer(found: Row) -> str:
        return f"{100 * found['nearer']:.0f} / {100 * found['nearer_with_misses']:.0f} %"

    lines = []
    for name, scenes in load(ALIVE)["sets"].items():
        for scene, row in sorted(scenes.items(), key=lambda item: not item[1]["blurred"]):
            if "filtered" in row:
                found, what = row["filtered"], BLURRED if row["blurred"] else STILL
                lines.append([f"{scene} ({what})", ALIVE_SETS.get(name, name).split()[0], f"{row['mixed']:.0%}",
                              f"{found['front']:.2f}", f"{found['both']:.0%}", nearer(row["samples"]), nearer(found)])
    return markdown(("scene", "set of", "depth mixes in", "front layer's weight there", "10 to 90 % in",
                     "front is nearer, samples", "front is nearer, filtered"), lines)


def alive_count() -> str:
    """On how many scenes the layers of the shipped network are what was asked for."""
    lines = []
    for (name, scenes), is_blurred in product(load(ALIVE)["sets"].items(), (True, False)):
        rows = [row["filtered"] for row in scenes.values() if row["blurred"] == is_blurred and "filtered" in row]
        if rows:
            lines.append([f"{len(rows)} of {ALIVE_SETS.get(name, name)}, {BLURRED if is_blurred else STILL}",
                          str(sum(LEAST <= row["front"] <= 1 - LEAST for row in rows)),
                          *(str(sum(row[key] >= 1 - LEAST for row in rows))
                            for key in ("nearer", "nearer_with_misses"))])
    return markdown(("scenes", "front layer's weight 10 to 90 % on", "nearer in 90 % of the pixels, by hits, on",
                     "with misses, on"), lines)


def visibility() -> str:
    """Errors on a scene with no noise but visibility, and where networks put the samples of its surfaces."""
    found = load(VISIBILITY)
    lines = []
    for name, row in found["rows"].items():
        shares = [f"{100 * value:.0f} %" for value in row.get("in_front", {}).values()]
        lines.append([name, *(f"{row['relmse'][key]:.4f}" for key in ("all", *found["parts"])),
                      *(shares or ["–"] * 3)])
    mixed, wall = (f"{100 * value:.0f} %" for value in found["parts"].values())
    head = ("network", "relMSE", f"where surfaces mix ({mixed})", f"where the wall is alone ({wall})",
            "leaves in front", "disc in front", "wall in front")
    return markdown(head, lines)


RESULT_TABLES: Mapping[str, Callable[[], str]] = {
    "bench": bench,
    "scenes": scenes,
    "stages": stages,
    "network-stages": network_stages,
    "memory": memory,
    "layer-cost": layer_cost,
    "growth": growth,
    "samples": samples,
    "visibility": visibility,
    "layers-alive": alive,
    "layers-alive-count": alive_count,
}
