"""The tables and counted sentences of docs/results.md on networks of reduced width, made from docs/results/paper.json.

benchmarks/paper.py trains and scores the rows, benchmarks/paper_times.py times their networks. What a sentence says of
numbers is counted here, so that other rows need no other text. `blurred` in the JSON names, for each set, the scenes
with defocus or motion.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import product

import numpy as np
from result_tables import BLURRED, HOME, SETS, STILL, Row, load, markdown

from model.metrics import geometric_mean
from pipelines.bench.charts import number
from pipelines.bench.tables import PUBLISHED

PAPER = HOME / "docs" / "results" / "paper.json"
LAYERS = {1: "LAYER, 1 layer", 2: "LAYER", **{n: f"LAYER, {n} layers" for n in (3, 4, 5)}}
PUBLISHED_LAYERS = {2: 0.0288, 3: 0.0315, 4: 0.0313, 5: 0.0332}
"""relMSE of LAYER with so many layers as published; the paper's figure for one layer is not at hand."""
LOSSES = {"LAYER": "SMAPE", "LAYER, tone-mapped L2": "squared error, tone-mapped"}
BASE = "LAYER"
BLUR = "clamp and blur"
WIDTH = 120  # columns of a paragraph
ERRORS = tuple(f"{word}, {scenes}" for scenes in SETS.values() for word in ("relMSE", "trimmed", "SMAPE"))
TIMES = ("CPU s a megapixel", "CPU time of OIDN's")


# --- rows -----------------------------------------------------------------------------------------------------------


def mean_errors(row: Row, name: str) -> list[float]:
    """Over a set of scenes: geometric means of relMSE, plain and without its worst 0.1 % of pixels; mean SMAPE."""
    scenes = row["scenes"][name].values()
    return [*(geometric_mean([scene[key] for scene in scenes]) for key in ("relmse", "trimmed")),
            float(np.mean([scene["smape"] for scene in scenes]))]


def blurred_scenes() -> dict[tuple[str, str], bool]:
    """(set, scene) -> whether it has defocus or motion."""
    document = load(PAPER)
    some = next(iter(document["rows"].values()))
    return {(name, scene): scene in document["blurred"][name]
            for name, scenes in some["scenes"].items() for scene in scenes}


def errors_of(row: Row) -> list[str]:
    return [f"{value:.4f}" for name in SETS for value in mean_errors(row, name)]


def group(name: str) -> list[Row]:
    """The rows of a group, in the order in which they were made."""
    return [row for row in load(PAPER)["rows"].values() if row["group"] == name]


def paper_rows(names: Iterable[str]) -> list[Row]:
    """The rows of the paper's group by name, those that are there."""
    rows = {row["name"]: row for row in group("paper")}
    return [rows[name] for name in names if name in rows]


def trained_seconds(row: Row) -> float:
    """CPU seconds of training."""
    seconds: float = row["steps"] * row["cpu_seconds_a_step"]
    return seconds


def seconds_of(name: str) -> float | None:
    """CPU seconds per megapixel of a network, or of what is not trained; None where it was not timed."""
    found: float | None = load(PAPER).get("times", {}).get("cpu_seconds_a_megapixel", {}).get(name)
    return found


def times_of(name: str) -> list[str]:
    """The cells of TIMES."""
    seconds = seconds_of(name)
    if seconds is None:
        return ["–"] * len(TIMES)
    unit = seconds_of(load(PAPER)["times"]["yardstick"])
    return [number(seconds), "–" if unit is None else f"{seconds / unit:.2f}"]


def untrained_rows(columns: int) -> list[list[str]]:
    """What is not trained here, before the networks of a table with so many columns: errors, then times."""
    found = [[name, *errors_of(row), *times_of(name)] for name, row in load(PAPER)["untrained"].items()]
    return [row + ["–"] * (columns - len(row)) for row in found]


def paragraph(*sentences: str) -> str:
    return textwrap.fill(" ".join(sentences), WIDTH, break_long_words=False, break_on_hyphens=False) + "\n"


def listed(names: Sequence[str]) -> str:
    """Names as a sentence has them."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def span(values: Sequence[float]) -> str:
    """The least and the largest, with two digits."""
    low, high = (f"{float(f'{value:.2g}'):,.0f}" for value in (min(values), max(values)))
    return low if low == high else f"{low} to {high}"


def common(rows: Sequence[Row], key: str) -> int:
    """What all rows have. Raises ValueError where they differ, for then no table may compare them."""
    found = {row[key] for row in rows}
    if len(found) != 1:
        raise ValueError(f"docs/results/paper.json: rows of group {rows[0]['group']} differ in {key}: {sorted(found)}")
    return int(found.pop())


# --- the paper's tables ---------------------------------------------------------------------------------------------


def training() -> str:
    """How long the networks were trained, and whether that makes them better than a filter that was not."""
    rows = group("paper")
    steps, batch, crop = (common(rows, key) for key in ("steps", "batch", "crop"))
    blur = load(PAPER)["untrained"][BLUR]
    ahead = [f"{sum(mean_errors(row, name)[0] < mean_errors(blur, name)[0] for row in rows)} on {words}"
             for name, words in SETS.items()]
    seconds = span([trained_seconds(row) for row in rows])
    return paragraph(
        "Munkberg and Hasselgren trained each network for 30 to 60 hours of a GPU, 1000 epochs of 4352 frames with "
        f"references of 4096 samples. Here each had {steps:,} steps of {batch} crops of {crop} x {crop} pixels, "
        f"{seconds} CPU seconds, on {len(load(PAPER)['scenes'])} procedural scenes of 192 x 192 pixels with references "
        "of 64 samples. Clamping and blurring, which needs no training, is a bar that training should pass: of the "
        f"{len(rows)} networks, {' and '.join(ahead)} have a lower relMSE than it.")


def variants() -> str:
    """Table 1, and with it Table 4: OPTIMIZED against LAYER."""
    head = ("network", *ERRORS, *TIMES, "multiply-adds per pixel", "CPU s of training", "relMSE as published",
            "SMAPE as published")
    rows = [[row["name"], *errors_of(row), *times_of(row["name"]), f"{row['multiply_adds'] / 1e3:.0f} k",
             f"{trained_seconds(row):,.0f}", *(f"{value:.4f}" for value in PUBLISHED[row["name"]])]
            for row in paper_rows(PUBLISHED)]
    return markdown(head, [*untrained_rows(len(head)), *rows])


def layer_counts() -> str:
    """Table 2."""
    rows = [[str(row["layers"]), *errors_of(row), *times_of(row["name"]), f"{PUBLISHED_LAYERS[row['layers']]:.4f}"
             if row["layers"] in PUBLISHED_LAYERS else "–"] for row in paper_rows(LAYERS.values())]
    return markdown(("layers", *ERRORS, *TIMES, "relMSE as published"), rows)


def losses() -> str:
    """Table 5."""
    return markdown(("trained by", *ERRORS), ([LOSSES[row["name"]], *errors_of(row)] for row in paper_rows(LOSSES)))


# --- against the published figures ------------------------------------------------------------------------------------


def published_ratios() -> dict[str, tuple[float, float | None] | None]:
    """By name, relMSE and SMAPE over those of LAYER as published; None where no figure is at hand."""
    base = PUBLISHED[BASE]
    found: dict[str, tuple[float, float | None] | None] = {
        name: (relmse / base[0], smape / base[1]) for name, (relmse, smape) in PUBLISHED.items() if name != BASE}
    for count, name in LAYERS.items():
        if name != BASE:
            known = PUBLISHED_LAYERS.get(count)
            found[name] = None if known is None else (known / PUBLISHED_LAYERS[2], None)
    return found | {name: None for name in LOSSES if name != BASE}


def ratios(row: Row, base: Row, name: str) -> list[float]:
    """A row's relMSE over another's on a set of scenes: all, those with defocus or motion, the others; then SMAPE."""
    blurred = blurred_scenes()
    scenes = list(row["scenes"][name])
    parts = [scenes, *([scene for scene in scenes if blurred[name, scene] is kind] for kind in (True, False))]
    smape = mean_errors(row, name)[2] / mean_errors(base, name)[2]
    return [*(ratio(row, base, name, part) for part in parts), smape]


def ratio(row: Row, base: Row, name: str, scenes: Sequence[str]) -> float:
    """A row's relMSE over another's, a geometric mean; NaN of no scenes."""
    found = [row["scenes"][name][scene]["relmse"] / base["scenes"][name][scene]["relmse"] for scene in scenes]
    return geometric_mean(found) if found else math.nan


def against_published() -> str:
    """Every network's errors over LAYER's, here and as published."""
    (base,) = paper_rows([BASE])
    head = ["over LAYER's", "relMSE as published",
            *(f"{word}, {scenes}" for scenes in SETS.values() for word in ("relMSE", BLURRED, STILL)),
            "SMAPE as published", *(f"SMAPE, {scenes}" for scenes in SETS.values())]
    lines = []
    for name, known in published_ratios().items():
        for row in paper_rows([name]):
            here = [ratios(row, base, name) for name in SETS]
            relmse, smape = (None, None) if known is None else known
            values = [relmse, *(value for part in here for value in part[:3]), smape, *(part[3] for part in here)]
            lines.append([name, *("–" if value is None else f"{value:.2f}" for value in values)])
    return markdown(head, lines)


def agreement() -> str:
    """Which networks are on the published side of LAYER, by relMSE, and which are not."""
    (base,) = paper_rows([BASE])
    found: dict[int, list[str]] = {}
    for name, known in published_ratios().items():
        for row in paper_rows([name] if known is not None else []):
            assert known is not None
            same = sum((ratios(row, base, scenes)[0] > 1) == (known[0] > 1) for scenes in SETS)
            found.setdefault(same, []).append(name if "," not in name else f"LAYER with {name.split(', ')[1]}")
    words = {2: "on both sets of scenes", 1: "on one of the two", 0: "on neither"}
    told = [f"{words[same]} {listed(found[same])}" for same in words if same in found]
    return paragraph(f"On the same side of LAYER as published, by relMSE, are {'; '.join(told)}.")


def losses_sentence() -> str:
    """What the loss does to either error."""
    rows = {row["name"]: row for row in paper_rows(LOSSES)}
    base, other = (rows[name] for name in LOSSES)
    found = [ratios(other, base, name) for name in SETS]
    told = [f"{100 * (part[3] - 1):+.0f} % SMAPE and {100 * (part[0] - 1):+.0f} % relMSE on {words}"
            for part, words in zip(found, SETS.values(), strict=True)]
    return paragraph(f"Trained by the tone-mapped squared error instead of SMAPE: {'; '.join(told)}.",
                     "In the paper, SMAPE is the better loss; its figures of this table are not at hand, and its tone "
                     "mapping is not ours (here: sRGB of log(1 + x)).")


# --- ours at reduced width ------------------------------------------------------------------------------------------


def ours() -> str:
    """Errors over seeds, and time, of `fast` at reduced width and of what it is compared with."""
    rows = group("ours")
    lines = []
    for name in dict.fromkeys(row["name"] for row in rows):
        seeds = [row for row in rows if row["name"] == name]
        errors = [geometric_mean([mean_errors(row, scenes)[k] for row in seeds]) for scenes in SETS for k in range(3)]
        lines.append([name, *(f"{value:.4f}" for value in errors), *times_of(name),
                      f"{seeds[0]['multiply_adds'] / 1e3:.0f} k"])
    return markdown(("network", *ERRORS, *TIMES, "multiply-adds per pixel"), lines)


def pairs() -> str:
    """`fast` against others at equal steps, data and seed: ratios of relMSE, seed by seed."""
    rows = {(row["name"], row["seed"]): row for row in group("ours")}
    others = [name for name in dict.fromkeys(name for name, _ in rows) if name != "fast"]
    seeds = sorted(seed for name, seed in rows if name == "fast")
    blurred = blurred_scenes()
    lines = []
    for other, name, is_blurred in product(others, SETS, (True, False)):
        scenes = [scene for (group, scene), value in blurred.items() if group == name and value == is_blurred]
        ratios = {seed: ratio(rows["fast", seed], rows[other, seed], name, scenes) for seed in seeds
                  if (other, seed) in rows}
        lines.append([f"{other}; {len(scenes)} of {SETS[name]}, {BLURRED if is_blurred else STILL}",
                      *(f"{ratios[seed]:.3f}" if seed in ratios else "–" for seed in seeds),
                      f"{geometric_mean(list(ratios.values())):.3f}"])
    return markdown(("relMSE of `fast` over that of", *(f"seed {seed}" for seed in seeds), "mean"), lines)


# --- time -------------------------------------------------------------------------------------------------------------


def timing() -> str:
    """How the times of all these tables were measured."""
    times = load(PAPER)["times"]
    machine, threads, frame = times["machine"], times["machine"]["threads"], times["frame"]
    guides = times["yardstick"].partition(" + ")[2].replace(", ", " and ")
    return paragraph(
        f"Times are CPU seconds per megapixel of the network alone at {times['samples']} samples per pixel, on "
        f"{frame} x {frame} pixels of the example `{times['scene']}` in mirror image: all networks and Open Image "
        f"Denoise (with {guides}) taking turns in one run, {threads} thread{'s' if threads > 1 else ''} of "
        f"{machine['processor']}, torch {machine['torch']}, medians of {times['repeats']} after one to warm up.")


def points(name: str) -> dict[str, tuple[float, float]]:
    """(CPU seconds per megapixel, relMSE over a set of scenes) of all that has both; of several seeds the mean."""
    rows: dict[str, list[Row]] = {name: [row] for name, row in load(PAPER)["untrained"].items()}
    for row in [*group("paper"), *group("ours")]:
        rows.setdefault(row["name"], []).append(row)
    found = {}
    for label, seeds in rows.items():
        seconds = seconds_of(label)
        if seconds is not None:
            found[label] = (seconds, geometric_mean([mean_errors(row, name)[0] for row in seeds]))
    return found


PAPER_TABLES: Mapping[str, Callable[[], str]] = {
    "paper-training": training,
    "paper-variants": variants,
    "paper-layers": layer_counts,
    "paper-losses": losses,
    "paper-losses-told": losses_sentence,
    "paper-published": against_published,
    "paper-agreement": agreement,
    "paper-timing": timing,
    "paper-ours": ours,
    "pairs": pairs,
}
