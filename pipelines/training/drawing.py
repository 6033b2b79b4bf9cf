"""Pictures of a training: its curves, and panels of validation scenes. PNG bytes come back; files are the loop's.

Needs the extra `train` (matplotlib, Pillow); `can_draw` says whether it is there.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from importlib.util import find_spec

import numpy as np
import numpy.typing as npt

from model.metrics import relative_squared_error, tone_mapped
from pipelines.pictures import ERROR_RANGE, diverging_colors
from pipelines.training.validation import Shown

PANEL_PIXELS = 192  # the middle of larger scenes is shown
MARGIN, LINE = 4, 14  # pixels between pictures; for a line of text
BACKGROUND = 24

CHARTS = (
    ("loss", "training loss", False, None),
    ("relmse", "validation relMSE", True, "noisy_relmse"),
    ("smape", "validation SMAPE", False, "noisy_smape"),
    ("energy", "energy: |mean / reference - 1|", False, None),
    ("front", "front layer's share of the weight", False, None),
    ("rate", "learning rate", False, None),
)
"""Column of the curve, its title, whether the axis is logarithmic, and the column of a level to compare with."""

TITLES = ("noisy", "denoised", "reference", "error: blue dark, red bright", "weight of the front layer")
"""Over the columns of a panel; each must be narrower than PANEL_PIXELS."""

Byte = npt.NDArray[np.uint8]


def can_draw() -> bool:
    """Whether what drawing needs is installed."""
    return all(find_spec(name) is not None for name in ("matplotlib", "PIL"))


def curve_png(rows: Sequence[Mapping[str, float]]) -> bytes:
    """The columns of CHARTS against steps; rows as in curve.csv, at least one."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import FormatStrFormatter, MaxNLocator

    figure = Figure(figsize=(11, 5.6), dpi=100, layout="constrained")
    steps = [row["step"] for row in rows]
    for axes, (column, title, logarithmic, level) in zip(figure.subplots(2, 3).flat, CHARTS, strict=True):
        values = [row[column] for row in rows]
        axes.plot(steps, values, color="#1f5fa8", linewidth=1.4, marker="o" if len(rows) < 30 else None, markersize=3)
        if logarithmic and min(values) > 0:
            axes.set_yscale("log")
            axes.yaxis.set_major_formatter(FormatStrFormatter("%g"))
            axes.yaxis.set_minor_formatter(FormatStrFormatter("%g") if max(values) < 5 * min(values) else "")
        if level is not None:
            axes.axhline(rows[-1][level], color="#b0632a", linestyle="--", linewidth=1, label="noisy input")
            axes.legend(fontsize=7, frameon=False)
        if column == "front":
            axes.set_ylim(0, 1)
        axes.set_title(title, fontsize=9)
        axes.tick_params(labelsize=7, which="both")
        axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
        axes.grid(alpha=0.25, which="both")
        axes.set_xlabel("steps", fontsize=7)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


def panel_png(scenes: Sequence[Shown], step: int) -> bytes:
    """One row a scene: noisy, denoised, reference, signed relative error (blue too dark), the front layer's weight."""
    from PIL import Image, ImageDraw

    rows = [_row(scene) for scene in scenes]
    width = max(sum(picture.shape[1] + MARGIN for picture in row) for row in rows)
    height = sum(row[0].shape[0] + 2 * LINE for row in rows)
    canvas = np.full((height, width, 3), BACKGROUND, np.uint8)
    words, top = [], 0
    for scene, row in zip(scenes, rows, strict=True):
        words.append((MARGIN, top + 1, f"{scene.name}, step {step}"))
        left, top = 0, top + 2 * LINE
        for title, picture in zip(TITLES, row, strict=True):
            words.append((left + MARGIN, top + 1 - LINE, title))
            canvas[top : top + picture.shape[0], left : left + picture.shape[1]] = picture
            left += picture.shape[1] + MARGIN
        top += row[0].shape[0]
    image = Image.fromarray(canvas)
    draw = ImageDraw.Draw(image)
    for x, y, text in words:
        draw.text((x, y), text, fill=(220, 220, 220))
    buffer = io.BytesIO()
    image.save(buffer, format="PNG", optimize=True)
    return buffer.getvalue()


def _row(scene: Shown) -> list[Byte]:
    """The pictures of one scene, (h, w, 3) each; what is not finite is black. Small ones are enlarged."""
    extents = scene.front.shape
    place = tuple(slice(start, start + PANEL_PIXELS) for start in (max(e - PANEL_PIXELS, 0) // 2 for e in extents))
    noisy, image, clean = (np.nan_to_num(p[place].astype(np.float64), posinf=0.0, neginf=0.0)
                           for p in (scene.noisy, scene.denoised, scene.reference))
    signed = np.copysign(np.sqrt(relative_squared_error(image, clean).mean(-1)), (image - clean).mean(-1))
    colors = diverging_colors()
    error = colors[(np.clip((signed / ERROR_RANGE + 1) / 2, 0, 1) * (len(colors) - 1)).round().astype(int)]
    front = np.repeat(np.nan_to_num(scene.front[place])[..., None], 3, -1)
    times = max(PANEL_PIXELS // max(extents), 1)
    return [(np.clip(p, 0, 1) * 255).round().astype(np.uint8).repeat(times, 0).repeat(times, 1)
            for p in (*(tone_mapped(picture) for picture in (noisy, image, clean)), error, front)]
