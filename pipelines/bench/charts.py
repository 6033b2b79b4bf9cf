"""Charts as inline SVG, made by hand so that a page needs nothing else: a scatter with its front, lines, stacked bars.

Knows no methods: points and series come with their label, colour and shape.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape

WIDTH, HEIGHT = 640, 400
LEFT, RIGHT, TOP, BOTTOM = 62, 170, 16, 48
"""Margins; the right one holds the labels at the ends of lines."""
LETTER, LINE = 6.1, 14
"""Estimated width of a letter and height of a line of the labels, pixels at 11 px type."""
RADIUS = 5.0


@dataclass(frozen=True)
class Style:
    """How a method looks in all charts."""

    color: str
    shape: str = "circle"
    dash: str = ""


@dataclass(frozen=True)
class Mark:
    """A labelled point of a scatter; without `y`, a tick on the axis of times."""

    label: str
    style: Style
    x: float
    y: float | None
    title: str


@dataclass(frozen=True)
class Line:
    """A labelled line through (x, y), x ascending."""

    label: str
    style: Style
    points: Sequence[tuple[float, float]]


class _Log:
    """A logarithmic axis from pixel `start` to pixel `end`."""

    def __init__(self, values: Iterable[float], start: float, end: float, room: float = 0.06) -> None:
        positive = [value for value in values if value > 0.0 and math.isfinite(value)] or [1.0]
        low, high = math.log10(min(positive)), math.log10(max(positive))
        spare = max((high - low) * room, 0.06)
        self.low, self.high, self.start, self.end = low - spare, high + spare, start, end

    def at(self, value: float) -> float:
        share = (math.log10(max(value, 1e-30)) - self.low) / (self.high - self.low)
        return self.start + min(max(share, 0.0), 1.0) * (self.end - self.start)

    def ticks(self) -> list[float]:
        decades = range(math.floor(self.low), math.ceil(self.high) + 1)
        steps = (1, 2, 5) if self.high - self.low < 2.5 else (1,)
        values = [step * 10.0**decade for decade in decades for step in steps]
        return [value for value in values if self.low <= math.log10(value) <= self.high]


def number(value: float) -> str:
    """Three significant digits, short, without exponents where they can be avoided."""
    if value == 0.0 or not math.isfinite(value):
        return "0" if value == 0.0 else "–"
    if 1e-4 <= abs(value) < 1e3:
        text = f"{value:.3g}"
        return text if "e" not in text else f"{value:.0f}"
    if 1e3 <= abs(value) < 1e5:
        return f"{value:,.0f}"
    for unit, size in (("G", 1e9), ("M", 1e6), ("k", 1e3)):
        if abs(value) >= size:
            return f"{value / size:.3g} {unit}"
    return f"{value:.2g}"


def scatter(marks: Sequence[Mark], front: Sequence[str], x_label: str, y_label: str) -> str:
    """Points on logarithmic axes; those named in `front` are joined by a line of steps."""
    placed = [mark for mark in marks if mark.y is not None]
    x = _Log((mark.x for mark in marks), LEFT, WIDTH - 24, 0.12)
    longest = max((len(mark.label) for mark in marks if mark.y is None), default=0)
    floor = HEIGHT - BOTTOM - (longest * LETTER + 24 if longest else 0)  # ticks and their labels stand below it
    y = _Log((mark.y for mark in placed if mark.y is not None), floor, TOP)
    parts = _axes(x, y, x_label, y_label, WIDTH - 24)
    steps = sorted((x.at(mark.x), y.at(mark.y)) for mark in placed if mark.label in front and mark.y is not None)
    if len(steps) > 1:
        path = f"M{steps[0][0]:.1f} {steps[0][1]:.1f}" + "".join(f"H{px:.1f}V{py:.1f}" for px, py in steps[1:])
        parts.append(f'<path class="front" d="{path}"><title>Pareto front</title></path>')
    boxes = [(x.at(m.x) - RADIUS, y.at(m.y) - RADIUS, x.at(m.x) + RADIUS, y.at(m.y) + RADIUS)
             for m in placed if m.y is not None]
    for mark in placed:
        px, py = x.at(mark.x), y.at(mark.y or 0.0)
        lx, ly, anchor = _place(mark.label, px, py, boxes)
        parts.append(f'<g class="mark">{_shape(mark.style, px, py)}<text x="{lx:.1f}" y="{ly:.1f}" '
                     f'text-anchor="{anchor}">{escape(mark.label)}</text><title>{escape(mark.title)}</title></g>')
    ticks = sorted((mark for mark in marks if mark.y is None), key=lambda mark: mark.x)
    bottom = HEIGHT - BOTTOM
    for mark, text_x in zip(ticks, _spread([x.at(mark.x) for mark in ticks], LEFT, WIDTH - 24), strict=True):
        parts.append(f'<g class="mark"><path d="M{x.at(mark.x):.1f} {bottom}v-10L{text_x:.1f} {bottom - 16}" '
                     f'stroke="{mark.style.color}" stroke-width="2" fill="none"/><text x="{text_x:.1f}" '
                     f'y="{bottom - 20}" transform="rotate(-90 {text_x:.1f} {bottom - 20})" dy="4">'
                     f"{escape(mark.label)}</text><title>{escape(mark.title)}</title></g>")
    return _svg(parts, f"{y_label} against {x_label}")


def lines(series: Sequence[Line], x_label: str, y_label: str) -> str:
    """Lines on logarithmic axes, each labelled at its end."""
    series = [line for line in series if line.points]
    x = _Log((px for line in series for px, _ in line.points), LEFT, WIDTH - RIGHT, 0.02)
    y = _Log((py for line in series for _, py in line.points), HEIGHT - BOTTOM, TOP)
    counts = sorted({px for line in series for px, _ in line.points})
    parts = _axes(x, y, x_label, y_label, WIDTH - RIGHT, counts)
    wanted = [y.at(line.points[-1][1]) for line in series]
    for line, label_y in zip(series, _spread(wanted, TOP, HEIGHT - BOTTOM), strict=True):
        places = [(x.at(px), y.at(py)) for px, py in line.points]
        path = "M" + "L".join(f"{px:.1f} {py:.1f}" for px, py in places)
        dash = f' stroke-dasharray="{line.style.dash}"' if line.style.dash else ""
        dots = "".join(
            f"<g>{_shape(line.style, px, py, 3.2)}<title>{escape(line.label)}: {number(vy)} at {number(vx)}</title></g>"
            for (px, py), (vx, vy) in zip(places, line.points, strict=True))
        end_x, end_y = places[-1]
        parts.append(
            f'<g class="mark"><path class="line" d="{path}" stroke="{line.style.color}"{dash}/>{dots}'
            f'<path class="lead" d="M{end_x + 5:.1f} {end_y:.1f}L{WIDTH - RIGHT + 20:.1f} {label_y:.1f}"/>'
            f'<text x="{WIDTH - RIGHT + 24}" y="{label_y + 4:.1f}">{escape(line.label)}</text></g>')
    return _svg(parts, f"{y_label} against {x_label}")


def bars(rows: Sequence[tuple[str, Mapping[str, float]]], colors: Mapping[str, str], names: Mapping[str, str],
         unit: str) -> str:
    """One horizontal bar per row, stacked from its stages in the order of `colors`; on a linear scale from 0."""
    left, row_height = 190, 26
    longest = max((sum(stages.values()) for _, stages in rows), default=1.0) or 1.0
    scale = (WIDTH - left - 74) / longest
    parts = []
    used = [stage for stage in colors if any(stages.get(stage, 0.0) > 0.0 for _, stages in rows)]
    legend_x, legend_y = 4.0, 4
    for stage in used:
        size = 26 + LETTER * len(names[stage])
        if legend_x + size > WIDTH:
            legend_x, legend_y = 4.0, legend_y + 18
        parts.append(f'<rect x="{legend_x:.1f}" y="{legend_y}" width="10" height="10" fill="{colors[stage]}"/>'
                     f'<text x="{legend_x + 14:.1f}" y="{legend_y + 9}">{escape(names[stage])}</text>')
        legend_x += size
    top = legend_y + 30
    for index, (label, stages) in enumerate(rows):
        y = top + index * row_height
        parts.append(f'<text x="{left - 8}" y="{y + 13}" text-anchor="end">{escape(label)}</text>')
        x = float(left)
        for stage in used:
            width = stages.get(stage, 0.0) * scale
            if width > 0.0:
                title = f"{label}, {names[stage]}: {number(stages[stage])} {unit}"
                parts.append(f'<rect x="{x:.1f}" y="{y}" width="{max(width, 0.3):.1f}" height="18" '
                             f'fill="{colors[stage]}"><title>{escape(title)}</title></rect>')
                x += width
        parts.append(f'<text x="{x + 6:.1f}" y="{y + 13}">{number(sum(stages.values()))} {escape(unit)}</text>')
    return _svg(parts, f"stages in {unit}", top + row_height * len(rows) + 12)


def _svg(parts: Sequence[str], label: str, height: int = HEIGHT) -> str:
    return (f'<svg viewBox="0 0 {WIDTH} {height}" role="img" aria-label="{escape(label, quote=True)}">'
            + "".join(parts) + "</svg>")


def _axes(x: _Log, y: _Log, x_label: str, y_label: str, right: float, x_ticks: Sequence[float] = ()) -> list[str]:
    bottom = HEIGHT - BOTTOM
    parts = []
    for value in x_ticks or x.ticks():
        at = x.at(value)
        parts.append(f'<path class="grid" d="M{at:.1f} {TOP}V{bottom}"/>'
                     f'<text class="tick" x="{at:.1f}" y="{bottom + 16}" text-anchor="middle">{number(value)}</text>')
    for value in y.ticks():
        at = y.at(value)
        parts.append(f'<path class="grid" d="M{LEFT} {at:.1f}H{right}"/>'
                     f'<text class="tick" x="{LEFT - 6}" y="{at + 4:.1f}" text-anchor="end">{number(value)}</text>')
    parts.append(f'<path class="axis" d="M{LEFT} {TOP}V{bottom}H{right}"/>')
    parts.append(f'<text class="name" x="{(LEFT + right) / 2:.0f}" y="{HEIGHT - 10}" text-anchor="middle">'
                 f"{escape(x_label)}</text>")
    middle = (TOP + bottom) / 2
    parts.append(f'<text class="name" x="14" y="{middle:.0f}" text-anchor="middle" '
                 f'transform="rotate(-90 14 {middle:.0f})">{escape(y_label)}</text>')
    return parts


def _shape(style: Style, x: float, y: float, radius: float = RADIUS) -> str:
    r = radius
    paths = {
        "square": f"M{x - r:.1f} {y - r:.1f}h{2 * r}v{2 * r}h{-2 * r}z",
        "triangle": f"M{x:.1f} {y - r:.1f}L{x + r:.1f} {y + r:.1f}H{x - r:.1f}z",
        "diamond": f"M{x:.1f} {y - r:.1f}L{x + r:.1f} {y:.1f}L{x:.1f} {y + r:.1f}L{x - r:.1f} {y:.1f}z",
    }
    if style.shape in paths:
        return f'<path d="{paths[style.shape]}" fill="{style.color}"/>'
    return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{r}" fill="{style.color}"/>'


def _place(label: str, x: float, y: float, boxes: list[tuple[float, float, float, float]]) -> tuple[float, float, str]:
    """Where a point's label hides nothing: beside, above or below it; its box joins `boxes`."""
    width = LETTER * len(label)
    choices = [(x + 7, y - 6, "start"), (x + 9, y + 4, "start"), (x - 9, y + 4, "end"), (x, y - 9, "middle"),
               (x, y + 17, "middle")]
    choices += [(x + 9, y + 4 + LINE * k, "start") for k in (-1, 1, -2, 2, -3, 3)]
    choices += [(x - 9, y + 4 + LINE * k, "end") for k in (-1, 1, -2, 2, -3, 3)]
    for lx, ly, anchor in choices:
        left = lx - {"start": 0.0, "middle": 0.5, "end": 1.0}[anchor] * width
        box = left, ly - 10, left + width, ly + 3
        inside = left >= LEFT and box[2] <= WIDTH and box[1] >= 0 and box[3] <= HEIGHT - BOTTOM
        if inside and not any(box[0] < b[2] and b[0] < box[2] and box[1] < b[3] and b[1] < box[3] for b in boxes):
            break
    else:
        lx, ly, anchor = choices[0]
        left = lx
        box = left, ly - 10, left + width, ly + 3
    boxes.append(box)
    return lx, ly, anchor


def _spread(wanted: Sequence[float], start: float, end: float) -> list[float]:
    """Places of labels near those wanted, a line apart from each other and within the chart."""
    order = sorted(range(len(wanted)), key=lambda i: wanted[i])
    result = list(wanted)
    last = start - LINE + 6.0
    for i in order:
        last = result[i] = max(wanted[i], last + LINE)
    limit = end
    for i in reversed(order):
        limit = result[i] = min(result[i], limit)
        limit -= LINE
    return result
