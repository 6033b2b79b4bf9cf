"""The page of a bench: charts, tables and a viewer of all images, in one file that needs no other and no network."""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from importlib.resources import files
from itertools import groupby
from string import Template
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deep_io.errors import UsageError
from model.metrics import common_scale, geometric_mean, tone_mapped
from pipelines.bench.charts import Line, Mark, Style, bars, lines, number, scatter
from pipelines.bench.methods import STAGES, MethodSpec
from pipelines.bench.results import Results, pareto
from pipelines.bench.tables import (
    FULL_HD,
    Table,
    all_tables,
    front_points,
    memory_frames,
    per_pixel,
    protocol_lines,
)

Image = NDArray[np.floating[Any]]

LONGEST_SIDE = 1024
"""Of the images on the page, pixels: larger ones are cut to their middle, so that each pixel stays one."""

COLORS: Mapping[str, tuple[str, ...]] = {
    "input": ("#8a8f98",),
    "classical": ("#7a9a3c", "#4c7a2e"),
    "OIDN": ("#e39b2d", "#d0702a", "#a8481f"),
    "lbmc": ("#2f7ed8", "#1b4f9c", "#35a7c4", "#5b5bd6"),
    "paper": ("#c9a0dc", "#b06ac8", "#8e44ad", "#6c3483", "#d35d9e"),
}
SHAPES = {"input": "diamond", "classical": "triangle", "OIDN": "square", "lbmc": "circle", "paper": "diamond"}
DASHES = ("", "6 3", "2 3", "8 3 2 3")
STAGE_COLORS = {
    "read": "#b9bec8", "flatten": "#d8dbe2", "survey": "#7fb3a6", "reducer": "#4a90d9", "unet": "#2c5aa0",
    "partitioner": "#8e6bbf", "generator": "#c9679b", "filter": "#e09a3e", "write": "#8d929c",
}


@dataclass
class Gallery:
    """The images of all scenes as PNGs, as they come."""

    scenes: dict[str, dict[str, bytes]] = field(default_factory=dict)
    sizes: dict[str, tuple[int, int]] = field(default_factory=dict)
    """Width and height of the images of a scene, as shown."""
    cropped: bool = False

    def add(self, scene: str, method: str, picture: Image, reference: Image) -> None:
        """Keeps a picture (H, W, 3), linear, at the scale that its scene is measured on."""
        shown = _middle(np.asarray(picture, np.float64))
        self.cropped |= shown.shape != picture.shape
        self.sizes[scene] = shown.shape[1], shown.shape[0]
        self.scenes.setdefault(scene, {})[method] = png(tone_mapped(common_scale(reference) * shown))

    def drop(self, scene: str) -> None:
        """Forgets the pictures of a scene, if there are any."""
        self.scenes.pop(scene, None)
        self.sizes.pop(scene, None)


def load_pillow() -> Any:
    """The PIL.Image module. Raises UsageError with what to install."""
    try:
        from PIL import Image as Pillow
    except ImportError as missing:
        raise UsageError(f"the report's images need Pillow: install lbmc with its extra 'bench' ({missing})"
                         ) from missing
    return Pillow


def png(tones: Image) -> bytes:
    """(H, W, 3) within 0..1 as a PNG of 8 bits. Raises UsageError without Pillow."""
    buffer = io.BytesIO()
    load_pillow().fromarray(np.round(255.0 * tones).astype(np.uint8)).save(buffer, format="PNG", optimize=True)
    return buffer.getvalue()


def html_report(results: Results, gallery: Gallery) -> str:
    """report.html."""
    page = files("pipelines.bench") / "page"
    cropped = f" Large images are cut to the {LONGEST_SIDE} pixels in their middle." if gallery.cropped else ""
    return Template((page / "report.html").read_text("utf-8")).substitute(
        style=(page / "report.css").read_text("utf-8"),
        script=(page / "viewer.js").read_text("utf-8"),
        protocol="\n".join(f"<li>{escape(line)}</li>" for line in protocol_lines(results)),
        charts=f'<div class="charts">{"".join(_charts(results))}</div>',
        tables="\n".join(_table(table) for table in all_tables(results)),
        gallery=_script_json(_images(results, gallery)),
        cropped=cropped,
    )


def styles(specs: list[MethodSpec]) -> dict[str, Style]:
    """A colour, a shape and a dash of its own for every method."""
    seen: dict[str, int] = {}
    found = {}
    for spec in specs:
        if spec.family in COLORS:
            index = seen.get(spec.family, 0)
            seen[spec.family] = index + 1
            colors = COLORS[spec.family]
            found[spec.name] = Style(colors[index % len(colors)], SHAPES[spec.family], DASHES[index % len(DASHES)])
    return found


def _charts(results: Results) -> list[str]:
    style = styles(results.methods)
    charts = []
    for samples in results.groups():
        title = f"Time against error, {_scenes(results, samples)}"
        if any(spec.family == "paper" for spec in results.methods):
            title += "; on the axis, networks without weights"
        charts.append(_figure(title, _scatter(results, samples, style)))
    for samples in results.groups():
        series = _curves(results, samples, style)
        if series:
            charts.append(_figure(f"Error against samples, {_scenes(results, samples)}",
                                  lines(series, "samples per pixel", "relMSE")))
    if results.growth:
        charts += _growth(results, style)
    charts += _stages(results)
    memory = [(name, {"filter": peak / 2**20}) for name, peak in results.memory.items()]
    if memory:
        charts.append(_figure(f"Peak memory on {memory_frames(results)}",
                              bars(memory, {"filter": "#7a8aa8"}, {"filter": "beyond the libraries"}, "MiB")))
    return charts


def _scenes(results: Results, samples: int) -> str:
    count = len(results.scenes_of(samples))
    return f"{count} scene{'s' if count != 1 else ''} with {per_pixel(samples)}"


def _scatter(results: Results, samples: int, style: Mapping[str, Style]) -> str:
    summary = results.summary(samples)
    points = front_points(results, samples)
    unscored = {spec.name for spec in results.methods if not spec.scored}
    marks = []
    for name, row in summary.items():
        if name in points:
            marks.append(Mark(name, style[name], row.own_cpu * FULL_HD, points[name][1],
                              f"{name}: {number(row.own_cpu * FULL_HD)} CPU s, relMSE {number(points[name][1])}"))
        elif name in style and row.cpu and name in unscored:
            marks.append(Mark(name.removesuffix(" (untrained)"), style[name], row.own_cpu * FULL_HD, None,
                              f"{name}: {number(row.own_cpu * FULL_HD)} CPU s; random weights, so no error"))
    return scatter(marks, pareto(points), "CPU seconds at 1920 x 1080", "relMSE")


def _curves(results: Results, samples: int, style: Mapping[str, Style]) -> list[Line]:
    """Error at 1, 2, 4, ... samples, over the scenes of one group, whose own samples end the line."""
    scenes = {scene.name for scene in results.scenes_of(samples)}
    errors: dict[str, dict[int, list[float]]] = {}
    for point in results.curve:
        if point.scene in scenes:
            errors.setdefault(point.method, {}).setdefault(point.samples, []).append(point.relmse)
    if not errors:
        return []
    for row in results.measurements:
        relmse = row.scores["relmse"] if row.scores else None
        if row.scene in scenes and row.method in errors and relmse is not None:
            errors[row.method].setdefault(samples, []).append(relmse)
    most = {count: max(len(by.get(count, ())) for by in errors.values()) for by in errors.values() for count in by}
    return [Line(name, style[name], [(float(count), geometric_mean(values)) for count, values in sorted(by.items())
                                     if len(values) == most[count]])  # of the same scenes as the other lines
            for name, by in errors.items()]


def _growth(results: Results, style: Mapping[str, Style]) -> list[str]:
    counted: dict[str, list[tuple[float, float]]] = {}
    timed: dict[str, list[tuple[float, float]]] = {}
    for point in results.growth:
        counted.setdefault(point.network, []).append((float(point.samples), point.multiply_adds))
        if point.cpu is not None:
            timed.setdefault(point.network, []).append((float(point.samples), 1e6 * point.cpu))
    paper = dict(zip(counted, COLORS["paper"], strict=False))
    looks = {name: style.get(name, style.get(f"{name} (untrained)", Style(paper.get(name, "#888"), "diamond")))
             for name in counted}
    charts = [_figure("Multiply-adds per pixel, counted", lines(
        [Line(name, looks[name], points) for name, points in counted.items()], "samples per pixel", "multiply-adds"))]
    if timed:
        charts.append(_figure("CPU time per pixel, measured on random samples", lines(
            [Line(name, looks[name], points) for name, points in timed.items()], "samples per pixel",
            "CPU microseconds per pixel")))
    return charts


def _stages(results: Results) -> list[str]:
    samples = results.groups()[0]
    kinds = {spec.name: spec.family for spec in results.methods}
    summary = results.summary(samples)
    rows = {name: {stage: seconds * FULL_HD for stage, seconds in row.cpu.items()} for name, row in summary.items()
            if row.cpu}
    ours = [(name, row) for name, row in rows.items() if kinds[name] not in ("paper", "input")]
    networks = [(name, row) for name, row in rows.items() if kinds[name] in ("paper", "lbmc")]
    charts = [_figure(f"Read, work, write, {_scenes(results, samples)}, scaled to 1920 x 1080",
                      bars(ours, STAGE_COLORS, STAGES, "CPU s"))]
    if networks:
        inside = [(name, {stage: seconds for stage, seconds in row.items() if stage not in ("read", "write")})
                  for name, row in networks]
        charts.append(_figure("The networks' stages, scaled to 1920 x 1080",
                              bars(inside, STAGE_COLORS, STAGES, "CPU s")))
    return charts


def _figure(title: str, drawing: str) -> str:
    return f"<figure><figcaption>{escape(title)}</figcaption>{drawing}</figure>"


def _table(table: Table) -> str:
    head = _cells(table.head, "th", table.names)
    if table.names == 1:
        body = "<tbody>" + "".join(f"<tr>{_cells(row, 'td', 1)}</tr>" for row in table.rows) + "</tbody>"
    else:  # what the rows of a group share stands once beside them
        body = "".join(f"<tbody>{_group(list(rows), table.names - 1)}</tbody>"
                       for _, rows in groupby(table.rows, lambda row: row[0]))
    return (f'<section><h2>{escape(table.title)}</h2><div class="wide"><table><thead><tr>{head}</tr></thead>{body}'
            f'</table></div><p class="note">{escape(table.note)}</p></section>')


def _group(rows: Sequence[Sequence[str]], names: int) -> str:
    """Rows with their first cell in common."""
    shared = f'<th scope="rowgroup" class="word" rowspan="{len(rows)}">{escape(rows[0][0])}</th>'
    lines = [_cells(row[1:], "td", names) for row in rows]
    return "".join(f"<tr>{shared if index == 0 else ''}{line}</tr>" for index, line in enumerate(lines))


def _cells(cells: Sequence[str], tag: str, names: int) -> str:
    """The first `names` of them words, the others numbers."""
    opening = [f'<{tag} class="word">'] * names + [f"<{tag}>"] * (len(cells) - names)
    return "".join(f"{start}{escape(cell)}</{tag}>" for start, cell in zip(opening, cells, strict=True))


def _images(results: Results, gallery: Gallery) -> dict[str, Any]:
    errors = {(row.scene, row.method): row.scores for row in results.measurements}
    scenes: dict[str, Any] = {}
    for scene, images in gallery.scenes.items():
        width, height = gallery.sizes[scene]
        listed = []
        for method, data in images.items():
            scores = errors.get((scene, method))
            label = method if scores is None else f"{method}: relMSE {number(scores['relmse'] or 0.0)}"
            if scores and (free := scores.get("relmse_unbiased")) is not None:
                label += f", {number(free)} free of the reference's noise"
            source = "data:image/png;base64," + base64.b64encode(data).decode("ascii")
            listed.append({"method": method, "label": label, "src": source})
        scenes[scene] = {"width": width, "height": height, "images": listed}
    return scenes


def _script_json(value: Any) -> str:
    """JSON that can stand in a script element: no text in it ends the element."""
    return json.dumps(value, ensure_ascii=False).replace("<", "\\u003c")


def _middle(picture: NDArray[np.float64]) -> NDArray[np.float64]:
    height, width = picture.shape[:2]
    top, left = max(height - LONGEST_SIDE, 0) // 2, max(width - LONGEST_SIDE, 0) // 2
    return picture[top : top + LONGEST_SIDE, left : left + LONGEST_SIDE]
