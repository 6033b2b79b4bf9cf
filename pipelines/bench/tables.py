"""The tables of a bench, as rows of text: Markdown for results.md, and the same rows for the page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isnan, nan
from typing import Any

from model.metrics import geometric_mean
from pipelines.bench.charts import number
from pipelines.bench.methods import FAMILIES, OUTSIDE, STAGES
from pipelines.bench.results import LEAST_GAIN, Results, SavingPoint, Summary, pareto, spread_name
from pipelines.bench.savings import ANYWHERE, BY_NAME, CONTEXT

SMALL_FRAME = 0.2
"""Megapixels of a timed frame below which the page warns of costs that do not grow with it."""
FULL_HD = 1920 * 1080 / 1e6
"""Megapixels of the frame that times per megapixel are scaled to for a reader."""

STAR = ("★ is on the Pareto front of CPU time and relMSE: its relMSE is at least "
        f"{100 * LEAST_GAIN:.0f} % below that of every faster method.")
SPREADS = {"interval": "its 95 % bootstrap interval", "range": "the range of theirs"}
"""What `spread_name` says, for a reader."""
INSTALL_OIDN = "OIDN is left out: pyoidn is not installed; install lbmc with its extra 'bench'."
PUBLISHED = {
    "PIXELGATHER": (0.0352, 0.0353),
    "SAMPLESPLAT": (0.0298, 0.0344),
    "LAYER": (0.0288, 0.0350),
    "LAYER_w": (0.0295, 0.0350),
    "OPTIMIZED": (0.0351, 0.0361),
}
"""relMSE and SMAPE as published (Munkberg and Hasselgren 2020): 36 images of theirs at 8 samples per pixel."""


@dataclass(frozen=True)
class Table:
    """A table with a title; the first columns, as many as `names`, are words, the others are numbers.

    With several of words, rows that share the first one follow each other: a group.
    """

    title: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""
    names: int = 1

    def markdown(self) -> str:
        """A Markdown section."""
        rule = "|---" * self.names + "|---:" * (len(self.head) - self.names) + "|"
        lines = ["| " + " | ".join(self.head) + " |", rule]
        lines += ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in self.rows]
        note = f"\n\n{self.note}" if self.note else ""
        return f"## {self.title}\n\n" + "\n".join(lines) + note + "\n"


def per_pixel(samples: int) -> str:
    """The words "8 samples per pixel"."""
    return f"{samples} sample{'s' if samples != 1 else ''} per pixel"


def all_tables(results: Results) -> list[Table]:
    """Every table that the results fill, in the order of the page."""
    tables = []
    for samples in results.groups():
        tables += [methods_table(results, samples), unbiased_table(results, samples)]
    tables.append(stages_table(results, results.groups()[0]))
    tables += [savings_table(results), growth_table(results), published_table(results)]
    return [table for table in tables if table.rows]


def methods_table(results: Results, samples: int) -> Table:
    """Errors, times and memory of every method over the scenes of a group; a star on the Pareto front."""
    summary = results.summary(samples)
    front = pareto(front_points(results, samples))
    rows = []
    for spec in results.methods:
        if spec.name not in summary:
            continue
        row = summary[spec.name]
        idle = spec.family == "input" or not row.cpu
        time = ["–", "–"] if idle else [number(row.own_cpu * FULL_HD), number(row.own_wall * FULL_HD)]
        memory = results.memory.get(spec.name)
        rows.append([spec.name + (" ★" if spec.name in front else ""), *_errors(row), *time,
                     "–" if memory is None else f"{memory / 2**20:.0f}"])
    count = len(results.scenes_of(samples))
    note = (f"relMSE is the geometric mean over the scenes with {SPREADS[spread_name(count)]}, the other errors are "
            "means. ")
    note += (f"Times are of the method's own work (all but {', '.join(OUTSIDE)}), scaled by pixels to 1920 x 1080. "
             f"{STAR} Untrained networks have random weights, so they have a time but no error.")
    if results.memory:
        note += f" MiB is peak memory on {memory_frames(results)}."
    errors = ("relMSE", spread_name(count), "trimmed", "SMAPE", "PSNR", "SSIM", "FLIP", "energy")
    head = ("method", *errors, "CPU s", "wall s", "MiB")
    return Table(f"{count} scene{'s' if count != 1 else ''} with {per_pixel(samples)}", head, rows, note)


def unbiased_table(results: Results, samples: int) -> Table:
    """relMSE on every scene whose reference has two halves: plain, and free of the reference's noise."""
    found = results.unbiased(samples)
    names = [spec.name for spec in results.methods if spec.scored]
    scores = {(row.scene, row.method): row.scores for row in results.measurements if row.scores}
    floors = {scene.name: scene.floor for scene in results.scenes_of(samples) if scene.floor is not None}
    rows = []
    for scene, floor in floors.items():
        cells = [scores.get((scene, name)) for name in names]
        pairs = [None if cell is None else (cell["relmse"], cell["relmse_unbiased"]) for cell in cells]
        rows.append([scene, f"{floor:.4f}", *map(_pair, pairs)])
    if found and len(floors) > 1:
        rows.append(["mean", f"{found.floor:.4f}", *(_pair(found.methods.get(name)) for name in names)])
    note = ("relMSE against the mean of both halves of the reference / free of the noise of that mean, as two "
            "independent halves give it (it may be slightly negative). Means are arithmetic for both. The floor is "
            "what the reference's own noise adds: below it, plain relMSE tells no image from a perfect one.")
    return Table(f"relMSE free of the reference's noise, {per_pixel(samples)}", ("scene", "floor", *names), rows,
                 note)


def _pair(errors: tuple[float | None, float | None] | None) -> str:
    """relMSE, plain and unbiased."""
    return "–" if errors is None or None in errors else f"{errors[0]:.4f} / {errors[1]:.4f}"


def front_points(results: Results, samples: int) -> dict[str, tuple[float, float]]:
    """(CPU seconds per megapixel, relMSE) of the methods that compete: those with an error that do something."""
    summary = results.summary(samples)
    points = {}
    for spec in results.methods:
        row = summary.get(spec.name)
        error = row.scores.get("relmse") if row else None
        if row and row.cpu and error is not None and spec.family != "input":
            points[spec.name] = (row.own_cpu, error)
    return points


def stages_table(results: Results, samples: int) -> Table:
    """CPU milliseconds per megapixel by stage, as in the paper's Table 3."""
    summary = results.summary(samples)
    stages = [stage for stage in STAGES if any(row.cpu.get(stage, 0.0) > 0.0 for row in summary.values())]
    rows = [
        [name, *(number(1e3 * row.cpu[stage]) if stage in row.cpu else "–" for stage in stages),
         number(1e3 * sum(row.cpu.values()))]
        for name, row in summary.items() if row.cpu
    ]
    note = ("CPU milliseconds per megapixel, medians. Methods that are no network have their whole work under "
            f"{STAGES['filter']!r}. Flattening stands for what a renderer would have handed over, so it counts for no "
            "method. The paper, at 1080p with 8 samples on an RTX 2080 Ti, OPTIMIZED: reducer 3.9 ms, U-Net 18.8, "
            "partitioner 10.2, filtering 5.3.")
    return Table(f"Where the time goes, at {per_pixel(samples)}",
                 ("method", *(STAGES[stage] for stage in stages), "all"), rows, note)


def savings_table(results: Results) -> Table:
    """Time saved beside error added, saving by saving: where the survey chooses it, and where it is forced."""
    models = dict.fromkeys(point.model for point in results.savings if point.saving != CONTEXT.name)
    rows = []
    for name in dict.fromkeys(point.saving for point in results.savings):
        for model in dict.fromkeys(point.model for point in results.savings if point.saving == name):
            label = name if [model] == [*models] else f"{name}: {model}"
            points = [point for point in results.savings if (point.saving, point.model) == (name, model)]
            saving = BY_NAME[name]
            kinds = {saving.there: True, saving.others: False} if saving.of_scenes else {ANYWHERE: None}
            rows += [[label, words, *_saved([point for point in points if point.chosen is chosen])]
                     for words, chosen in kinds.items()]
    head = ("saving", "scenes", "number", "time saved", "relMSE added", "worst scene", "SMAPE added")
    note = (f"Each saving by itself beside the full model ({', '.join(models) or 'a network'} with nothing adapted), "
            "on every scene as it is: CPU time of the model's own work, medians of "
            f"{results.protocol.get('repeats')} runs that take turns, and ratios of errors, geometric means. Below 0 % "
            "is slower, or better. The survey chooses a saving where the scene does not need what it leaves out. On "
            "the others it was forced, to show what it would cost; cells are never forced. Saving nothing at all shows "
            "the noise of the clock: less than that is no time saved. A role that is held is told to say nothing, as "
            "the survey does it; one that is dropped is unknown to the network. ")
    if CONTEXT.name not in {point.saving for point in results.savings}:
        note += ("The context at half resolution is part of a network, so that no single one can tell what it saves: "
                 "--contexts FULL HALF adds it, from two that differ in that alone.")
    return Table("What a scene does not need: time saved, error added", head, rows, note.strip(), names=2)


def _saved(points: Sequence[SavingPoint]) -> list[str]:
    """Number of scenes, time saved, and errors added: relMSE on average and at worst, SMAPE on average."""
    if not points:
        return ["0", *["–"] * 4]
    time = 1.0 - sum(point.after for point in points) / sum(point.before for point in points)
    relmse, smape = ([after / before for before, after in pairs if before > 0.0] for pairs in (
        [point.relmse for point in points], [point.smape for point in points]))
    added = (geometric_mean(relmse), max(relmse, default=nan), geometric_mean(smape))
    return [str(len(points)), f"{100.0 * time:.1f} %",
            *("–" if isnan(ratio) else f"{100.0 * (ratio - 1.0):+.1f} %" for ratio in added)]


def growth_table(results: Results) -> Table:
    """Multiply-adds and measured time from 4 to 64 samples per pixel, as in the paper's Figure 10."""
    counts = sorted({point.samples for point in results.growth})
    by_network: dict[str, dict[int, list[str]]] = {}
    for point in results.growth:
        time = "" if point.cpu is None else f" / {1e6 * point.cpu:.3g}"
        by_network.setdefault(point.network, {})[point.samples] = [f"{point.multiply_adds / 1e3:,.0f}{time}"]
    rows = [[name, *(row[samples][0] for samples in counts)] for name, row in by_network.items()]
    return Table("Cost against samples per pixel", ("network", *(f"{samples} samples" for samples in counts)), rows,
                 "Thousand multiply-adds per pixel, counted from the networks' widths; after the bar, where measured, "
                 "CPU microseconds per pixel on random samples.")


def published_table(results: Results) -> Table:
    """The paper's errors, where its networks were timed."""
    timed = [spec for spec in results.methods if spec.family == "paper"]
    rows = [[spec.argument, *(f"{value:.4f}" for value in PUBLISHED[spec.argument])] for spec in timed]
    return Table("As published, not measured here", ("network", "relMSE", "SMAPE"), rows,
                 "36 images of the authors at 8 samples per pixel, trained by them. Other scenes and other training, "
                 "so these do not compare with the errors above.")


def protocol_lines(results: Results) -> list[str]:
    """What was run, on what, and how: one statement a line."""
    machine, protocol = results.machine, results.protocol
    versions = {key: value for key, value in machine.items() if key not in ("processor", "cores", "threads", "system")}
    lines = [
        f"{machine['processor']}; {machine['cores']} cores to run on; {machine['threads']} "
        f"thread{'s' if machine['threads'] != 1 else ''} used; {machine['system']}.",
        "Versions: " + ", ".join(f"{name} {value}" for name, value in versions.items()) + ".",
        _timed(protocol["frame"]) + f", where all methods take turns: once to warm up, then {protocol['repeats']} "
        f"time{'s' if protocol['repeats'] != 1 else ''}, of which the median counts. CPU seconds are of all threads.",
        "Errors are those of the files written (half), on linear RGB at the common scale.",
    ]
    if results.memory or any(spec.family == "paper" for spec in results.methods):
        size = protocol.get("untrained_frame")
        lines.append(f"Untrained networks and memory are measured on {protocol['example']} alone"
                     + (f", untrained networks on {size} x {size} pixels of it" if size else "")
                     + "; memory is what a fresh process takes at its peak beyond its libraries.")
    if max(row.megapixels for row in results.measurements) < SMALL_FRAME:
        lines.append("The frames are small, so that what a run costs at any size (opening files, starting a filter) "
                     "weighs more than in a film frame; compare methods, do not predict frames.")
    if protocol.get("averaged"):
        lines.append(f"{', '.join(protocol['averaged'])}: the mean of several runs of a network on the frame and its "
                     "mirror images; what savings save and what samples cost is measured on one run.")
    if results.curve:
        lines.append("For fewer samples, each pixel draws its own at random; 2 hold the 1, 4 the 2, and so on.")
    if protocol.get("without_reference"):
        lines.append(unpaired_line(protocol["without_reference"]))
    halves = [scene.name for scene in results.scenes if scene.floor is not None]
    if halves:
        lines.append(f"Of {len(halves)} of {len(results.scenes)} scenes the reference is the mean of two independent "
                     "halves, NAME.ref.exr and NAME.ref2.exr.")
    if results.failed:
        lines.append(f"Left out, since they cannot be read: {'; '.join(results.failed.values())}.")
    if results.gaps:
        lines.append("Not measured, – in the tables, where means are of methods measured on every scene: "
                     + "; ".join(f"{gap.cell}: {gap.why}" for gap in results.gaps) + ".")
    if not protocol["oidn"]:
        lines.append(INSTALL_OIDN)
    if not any(spec.family == "lbmc" for spec in results.methods):
        lines.append("No weights of lbmc ship with this build; name some with --model.")
    return lines


def unpaired_line(names: Sequence[str]) -> str:
    """What is said of deep files without a reference."""
    return f"Left out, without a NAME.ref.exr beside NAME.deep.exr: {', '.join(names)}."


def markdown_report(results: Results) -> str:
    """results.md."""
    families = ", ".join(dict.fromkeys(FAMILIES[spec.family] for spec in results.methods))
    head = f"# Speed against error\n\nMeasured by `lbmc bench`: {families}.\n\n"
    return head + "\n".join(f"- {line}" for line in protocol_lines(results)) + "\n\n" + "\n".join(
        table.markdown() for table in all_tables(results))


def memory_frames(results: Results) -> str:
    """What memory was measured on: not the same for all, and memory grows with the frame."""
    example, frame, small = (results.protocol[key] for key in ("example", "frame", "untrained_frame"))
    scene = next(scene for scene in results.scenes if scene.name == example)
    width, height = max(scene.width, frame), max(scene.height, frame)
    unlike = 0 < small * small < width * height and any(spec.family == "paper" for spec in results.methods)
    return f"{example}, {width} x {height}" + (f", of untrained networks on {small} x {small}" if unlike else "")


def _timed(frame: int) -> str:
    if not frame:
        return "Times are of every scene as it is"
    return ("Times are of the first scene of each number of samples, repeated in mirror image to "
            f"{frame} x {frame} pixels unless larger")


def _errors(row: Summary) -> list[str]:
    scores: Mapping[str, Any] = row.scores
    interval = "–" if row.interval is None else f"{row.interval[0]:.4f} to {row.interval[1]:.4f}"
    digits = {"relmse": 4, "relmse_trimmed": 4, "smape": 4, "psnr": 2, "ssim": 4, "flip": 4, "energy": 3}
    cells = {name: "–" if scores.get(name) is None else f"{scores[name]:.{places}f}" for name, places in digits.items()}
    return [cells.pop("relmse"), interval, *cells.values()]
