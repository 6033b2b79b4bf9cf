"""Pictures of errors for people to look at: heat maps with their scale, panels with crops of the worst regions.

Drawing needs matplotlib (extras `bench` and `train`), imported when something is drawn. No files: PNG bytes come back.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from deep_io.errors import UsageError
from model.metrics import common_scale, relative_squared_error, tone_mapped

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap
    from matplotlib.figure import Figure

Image = NDArray[np.floating[Any]]
Float64 = NDArray[np.float64]

ERROR_RANGE = 1.0
"""Relative errors beyond this share one colour; the drawn scale says so with arrow ends."""
ERROR_LABEL = "relative error: blue too dark, red too bright"
CROPS = 3
DOTS_PER_INCH = 150
COLUMN_INCHES = 3.2
OVERVIEW = 440
"""Pixels along a side that a column of a panel has dots for; of larger errors, blocks of pixels are shown."""
HEAT_MAP_WIDTH = 600
"""Dots that a heat map is wide at least, for its title; small images are drawn in larger squares."""
HEAT_MAP_CORNER = 20, 44
"""Dots to the left of a heat map's picture and above it."""
SCALE_DOTS = 130
"""Dots to the right of a heat map's picture, where its scale is."""
MARK = "#ffd000"
MOST_OF_NAME = 40
"""Letters of a title that a column has room for."""

# Lightness, and chroma and hue of the two ends, of the diverging map in OKLab (Ottosson 2020).
MIDDLE_LIGHTNESS, END_LIGHTNESS, END_CHROMA = 0.97, 0.45, 0.16
BLUE_HUE, RED_HUE = np.radians(255.0), np.radians(30.0)


def signed_error(image: Image, reference: Image) -> Float64:
    """Signed relative error per pixel, (H, W): the root of the pixel's relMSE, negative where the image is darker.

    The mean of its square is the relMSE. Raises ValueError for a reference without light.
    """
    k = common_scale(reference)
    d, r = k * np.asarray(image, np.float64), k * np.asarray(reference, np.float64)
    signed: Float64 = np.copysign(np.sqrt(relative_squared_error(d, r).mean(-1)), (d - r).mean(-1))
    return signed


def diverging_colors(steps: int = 257) -> Float64:
    """Blue over near-white to red, (steps, 3) sRGB in 0..1: equal steps look equally large (linear in OKLab)."""
    t = np.linspace(-1.0, 1.0, steps)
    hue = np.where(t < 0.0, BLUE_HUE, RED_HUE)
    lightness = MIDDLE_LIGHTNESS + (END_LIGHTNESS - MIDDLE_LIGHTNESS) * np.abs(t)
    a, b = END_CHROMA * np.abs(t) * np.cos(hue), END_CHROMA * np.abs(t) * np.sin(hue)
    cone = np.stack(
        [
            lightness + 0.3963377774 * a + 0.2158037573 * b,
            lightness - 0.1055613458 * a - 0.0638541728 * b,
            lightness - 0.0894841775 * a - 1.2914855480 * b,
        ]
    )
    to_rgb = np.array(
        [
            [4.0767416621, -3.3077115913, 0.2309699292],
            [-1.2684380046, 2.6097574011, -0.3413193965],
            [-0.0041960863, -0.7034186147, 1.7076147010],
        ]
    )
    linear = np.clip(to_rgb @ cone**3, 0.0, 1.0).T
    colors: Float64 = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1.0 / 2.4) - 0.055)
    return colors


def worst_regions(error: Float64, size: int, count: int = CROPS) -> list[tuple[int, int]]:
    """(row, column) of the top left corners of up to `count` disjoint size x size regions with the largest error.

    Errors are clamped at 1 per pixel, so that a single firefly does not make a region the worst.
    """
    height, width = error.shape
    if size > height or size > width:
        return []
    clamped = np.minimum(np.abs(error), 1.0)
    sums = np.zeros((height + 1, width + 1))
    sums[1:, 1:] = clamped.cumsum(0).cumsum(1)
    total = sums[size:, size:] - sums[:-size, size:] - sums[size:, :-size] + sums[:-size, :-size]
    nothing = 1e-12 * sums[-1, -1]  # differences of large sums leave a rest where there is no error at all
    corners: list[tuple[int, int]] = []
    for _ in range(count):
        row, column = divmod(int(total.argmax()), total.shape[1])
        if not total[row, column] > nothing:
            break
        corners.append((row, column))
        total[max(row - size + 1, 0) : row + size, max(column - size + 1, 0) : column + size] = -1.0
    return corners


def pooled(error: Float64, block: int) -> Float64:
    """The signed error of blocks of `block` x `block` pixels, each pixel's clamped to `ERROR_RANGE`.

    As of a pixel: the root of the mean square, negative where the block is darker on the whole. A plain mean would
    show noise as no error, and a choice of pixels would lose thin lines.
    """
    clamped = np.clip(error, -ERROR_RANGE, ERROR_RANGE)
    squares, signs = _blocks(clamped**2, block), _blocks(clamped, block)
    signed: Float64 = np.copysign(np.sqrt(squares), signs)
    return signed


def _blocks(values: Float64, block: int) -> Float64:
    """Means over blocks; those at the right and lower edge may be smaller."""
    height, width = values.shape
    rows, columns = np.arange(0, height, block), np.arange(0, width, block)
    sums = np.add.reduceat(np.add.reduceat(values, rows, axis=0), columns, axis=1)
    sizes = np.diff(rows, append=height)[:, None] * np.diff(columns, append=width)
    means: Float64 = sums / sizes
    return means


def heat_map(image: Image, reference: Image) -> bytes:
    """PNG of the signed relative error, with its scale drawn beside it.

    Every pixel is a square of the same whole number of dots, at `HEAT_MAP_CORNER` (x, y) of the PNG: no pixel is left
    out, and none is wider than its neighbour.
    """
    error = signed_error(image, reference)
    height, width = error.shape
    dots = max(min(-(-HEAT_MAP_WIDTH // width), HEAT_MAP_WIDTH * 2 // height), 1)
    left, top = HEAT_MAP_CORNER
    drawn_width, drawn_height = max(width * dots, HEAT_MAP_WIDTH), max(height * dots, HEAT_MAP_WIDTH // 3)
    whole_width, whole_height = left + drawn_width + SCALE_DOTS, top + drawn_height + left
    figure = _figure(whole_width / DOTS_PER_INCH, whole_height / DOTS_PER_INCH, layout=None)
    colors = _color_map()((np.clip(error, -ERROR_RANGE, ERROR_RANGE) / ERROR_RANGE + 1.0) / 2.0)
    squares = np.repeat(np.repeat(colors, dots, axis=0), dots, axis=1)
    figure.figimage(squares, xo=left, yo=whole_height - top - height * dots, origin="upper")
    figure.text(left / whole_width, 1.0 - top / 2.0 / whole_height, ERROR_LABEL, fontsize=8, va="center")
    bar_height = min(drawn_height, HEAT_MAP_WIDTH)
    bar = figure.add_axes(((left + drawn_width + left) / whole_width, (whole_height - top - bar_height) / whole_height,
                           left / whole_width, bar_height / whole_height))
    figure.colorbar(_scale(), cax=bar, extend="both").ax.tick_params(labelsize=7)
    return _png(figure)


def panel(pictures: Mapping[str, Image], reference: Image, title: str = "") -> bytes:
    """PNG: every picture, the reference, and the last picture's signed error; below, crops of its worst regions.

    Pictures are (H, W, 3) linear RGB, shown at the common scale as G(log(1 + x)).
    """
    return _png(panel_figure(pictures, reference, title))


def panel_figure(pictures: Mapping[str, Image], reference: Image, title: str = "") -> Figure:
    """What `panel` is a PNG of."""
    k = common_scale(reference)
    shown = {**pictures, "reference": reference}
    tones = {name: tone_mapped(k * np.asarray(picture, np.float64)) for name, picture in shown.items()}
    subject = list(pictures)[-1]
    error = signed_error(pictures[subject], reference)
    height, width = error.shape
    size = max(min(height, width) // 5, 1)
    corners = worst_regions(error, size)
    ratios = [height / width] + [1.0] * len(corners)
    columns = len(tones) + 1
    figure = _figure(COLUMN_INCHES * columns + 0.6, COLUMN_INCHES * sum(ratios) + 0.3 * (1 + bool(title)))
    grid = figure.subplots(1 + len(corners), columns, squeeze=False, height_ratios=ratios)
    overview = pooled(error, -(-max(height, width) // OVERVIEW))
    whole = (-0.5, width - 0.5, height - 0.5, -0.5)  # a block's place is that of its pixels
    for column, name in enumerate([*tones, f"error of {subject}" if len(pictures) > 1 else "error"]):
        for row, corner in enumerate([None, *corners]):
            axes = grid[row][column]
            place = (slice(None), slice(None)) if corner is None else tuple(slice(c, c + size) for c in corner)
            if name in tones:
                axes.imshow(tones[name][place], interpolation=None if corner is None else "nearest")
            elif corner is None:
                _show_error(axes, overview, whole)
            else:
                _show_error(axes, error[place])
            axes.set_axis_off()
        grid[0][column].set_title(_shortened(name), fontsize=9)
        for number, corner in enumerate(corners, 1):
            _mark(grid[0][column], corner, size, number)
            grid[number][column].set_title(f"region {number}", fontsize=7)
    scale = figure.colorbar(_scale(), ax=grid[:, -1].tolist(), extend="both", fraction=0.05, pad=0.02)
    scale.ax.tick_params(labelsize=7)
    scale.set_label(ERROR_LABEL, fontsize=7)
    if title:
        figure.suptitle(title, fontsize=10)
    return figure


def _figure(width: float, height: float, layout: Literal["constrained"] | None = "constrained") -> Figure:
    try:
        from matplotlib.figure import Figure
    except ImportError as missing:
        raise UsageError(f"drawing needs matplotlib: install lbmc with its extra 'bench' ({missing})") from missing
    return Figure(figsize=(width, height), dpi=DOTS_PER_INCH, layout=layout)


def _show_error(axes: Axes, error: Float64, extent: tuple[float, float, float, float] | None = None) -> None:
    axes.imshow(error, cmap=_color_map(), vmin=-ERROR_RANGE, vmax=ERROR_RANGE, interpolation="nearest", extent=extent)


def _color_map() -> ListedColormap:
    from matplotlib.colors import ListedColormap

    return ListedColormap(diverging_colors(), name="lbmc_diverging")


def _scale() -> ScalarMappable:
    """What a colour bar of errors is drawn from."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    return ScalarMappable(Normalize(-ERROR_RANGE, ERROR_RANGE), _color_map())


def _shortened(name: str) -> str:
    """A name that fits above a column: its beginning and its end."""
    return name if len(name) <= MOST_OF_NAME else f"{name[: MOST_OF_NAME // 2]}…{name[-MOST_OF_NAME // 2 + 1 :]}"


def _mark(axes: Axes, corner: tuple[int, int], size: int, number: int) -> None:
    from matplotlib.patches import Rectangle
    from matplotlib.patheffects import withStroke

    row, column = corner
    edge = [withStroke(linewidth=2.4, foreground="black")]  # yellow alone is lost on what is bright
    axes.add_patch(Rectangle((column - 0.5, row - 0.5), size, size, fill=False, edgecolor=MARK, linewidth=1.0,
                             path_effects=edge))
    axes.annotate(str(number), (column - 0.5, row - 0.5), (3, -3), textcoords="offset points", color=MARK, fontsize=9,
                  fontweight="bold", va="top", path_effects=edge)


def _png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()
