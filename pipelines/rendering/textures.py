"""Procedural, seamlessly repeating textures as NumPy images (SIZE, SIZE, 3), linear reflectance in 0.02..0.95.

All have one size, because the renderer's kernels are cached by their text. Also opacity images for cut-outs.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.float32]
SIZE = 256


def noise(rng: np.random.Generator, slope: float = 1.5, size: int = SIZE) -> npt.NDArray[np.float64]:
    """Periodic noise (size,size) in 0..1 whose amplitude falls as frequency**-slope."""
    f = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None]) * size
    f[0, 0] = 1.0
    spectrum = np.fft.rfft2(rng.normal(size=(size, size))) * f ** -slope
    spectrum[0, 0] = 0.0
    n = np.fft.irfft2(spectrum, (size, size))
    n = n / (3 * n.std()) * 0.5 + 0.5
    return np.asarray(np.clip(n, 0, 1))


def random_color(rng: np.random.Generator, low: float = 0.03, high: float = 0.85) -> npt.NDArray[np.float64]:
    """A linear colour (3,), from greyish to saturated, its largest component log-uniform in low..high."""
    hue = rng.uniform(0, 1, 3)
    grey = rng.uniform(0, 1) ** 0.5
    c = hue / hue.max() * (1 - grey) + grey
    return np.asarray(np.clip(c * np.exp(rng.uniform(np.log(low), np.log(high))), 0.01, 0.95))


def mix(mask: npt.ArrayLike, a: npt.ArrayLike, b: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """`a` where `mask` (H,W) is 0, `b` where it is 1; both broadcast to (H,W,3)."""
    m = np.asarray(mask, np.float64)[..., None]
    return np.asarray(np.asarray(a) * (1 - m) + np.asarray(b) * m)


def _grid() -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    axis = (np.arange(SIZE) + 0.5) / SIZE
    y, x = np.meshgrid(axis, axis, indexing="ij")
    return x, y


def plain(rng: np.random.Generator) -> npt.NDArray[np.float64]:
    """One colour with faint mottling, like paint or plaster."""
    mottling = 1 + rng.uniform(0, 0.25) * (noise(rng, 1.0) - 0.5)
    return np.asarray(random_color(rng, 0.1) * mottling[..., None])


def checker(rng: np.random.Generator) -> npt.NDArray[np.float64]:
    """Two colours in squares."""
    x, y = _grid()
    n = int(rng.choice([1, 2, 4, 8]))
    return mix((np.floor(x * 2 * n) + np.floor(y * 2 * n)) % 2, random_color(rng), random_color(rng, 0.3))


def stripes(rng: np.random.Generator) -> npt.NDArray[np.float64]:
    """Parallel bands of random widths."""
    x, y = _grid()
    along = x if rng.random() < 0.5 else y
    colors = np.array([random_color(rng) for _ in range(4)])
    edges = np.sort(rng.uniform(0, 1, int(rng.integers(4, 24))))
    return np.asarray(colors[np.searchsorted(edges, along) % 4])


def wood(rng: np.random.Generator) -> npt.NDArray[np.float64]:
    """Planks with grain."""
    x, y = _grid()
    planks = int(rng.choice([2, 4, 6]))
    plank = np.floor(y * planks).astype(int)
    warp = noise(rng, 2.2) + rng.uniform(0, 1, planks)[plank]
    rings = 0.5 + 0.5 * np.sin(2 * np.pi * (warp * rng.uniform(5, 14) + y * planks * 2))
    fibre = np.roll(noise(rng, 0.7), 3, 1)
    fibre = np.repeat(fibre[:, ::16], 16, 1)
    base = random_color(rng, 0.15, 0.5) * np.array([1.0, 0.62, 0.36])
    tone = rng.uniform(0.6, 1.3, planks)[plank] * (0.6 + 0.4 * rings) * (0.8 + 0.4 * fibre)
    seam = (np.abs((y * planks) % 1 - 0.5) > 0.485) | (np.abs((x + 0.37 * plank) % 1) < 0.006)
    return np.asarray(base * np.where(seam, 0.15, tone)[..., None] * 1.4)


def brick(rng: np.random.Generator) -> npt.NDArray[np.float64]:
    """Running-bond bricks or tiles with mortar."""
    x, y = _grid()
    rows = int(rng.choice([4, 8, 12]))
    per_row = max(2, rows // 2) if rng.random() < 0.7 else rows
    shift = 0.5 if rng.random() < 0.7 else 0.0
    row = np.floor(y * rows).astype(int)
    u = x * per_row + shift * (row % 2)
    column = np.floor(u).astype(int) % per_row
    joint = rng.uniform(0.02, 0.07)
    mortar = (np.minimum(u % 1, 1 - u % 1) * rows / per_row < joint) | (
        np.minimum((y * rows) % 1, 1 - (y * rows) % 1) < joint)
    tone = rng.uniform(0.5, 1.3, (rows, per_row))[row, column] * (0.7 + 0.6 * noise(rng, 0.8))
    base = random_color(rng, 0.1, 0.6)
    return mix(mortar, base * tone[..., None], random_color(rng, 0.2, 0.7) * np.ones((SIZE, SIZE, 1)))


def text_like(rng: np.random.Generator) -> npt.NDArray[np.float64]:
    """Lines of small dark glyph-like marks on paper, or light on dark."""
    cell = int(rng.choice([8, 16]))
    n = SIZE // cell
    glyphs = (rng.random((n, n, cell // 2, cell // 2)) < 0.5).astype(float)
    glyphs[:, :, -1] = 0
    glyphs[:, :, :, -1] = 0
    glyphs *= (rng.random((n, n)) < 0.85)[..., None, None]
    glyphs[:: int(rng.integers(2, 4))] = 0
    ink = np.kron(glyphs.transpose(0, 2, 1, 3).reshape(SIZE // 2, SIZE // 2), np.ones((2, 2)))
    dark, light = random_color(rng, 0.02, 0.08), random_color(rng, 0.5, 0.9)
    return mix(ink, light, dark) if rng.random() < 0.7 else mix(ink, dark, light)


def fabric(rng: np.random.Generator) -> npt.NDArray[np.float64]:
    """A weave of two yarns, plain or plaid."""
    x, y = _grid()
    n = int(rng.choice([16, 32, 64]))
    warp = np.abs(np.sin(np.pi * n * x)) * ((np.floor(x * n) + np.floor(y * n)) % 2)
    weft = np.abs(np.sin(np.pi * n * y)) * ((np.floor(x * n) + np.floor(y * n) + 1) % 2)
    a, b = random_color(rng), random_color(rng)
    cloth = a * warp[..., None] + b * weft[..., None] + 0.02
    if rng.random() < 0.5:
        bands = rng.random(8) < 0.4
        cloth = cloth * np.where(bands[np.floor(x * 8).astype(int)] ^ bands[np.floor(y * 8).astype(int)],
                                 0.35, 1.0)[..., None]
    return np.asarray(cloth)


def marble(rng: np.random.Generator) -> npt.NDArray[np.float64]:
    """Veins in stone."""
    v = np.abs(2 * noise(rng, 1.6) - 1) ** rng.uniform(0.3, 0.8)
    return mix(v, random_color(rng), random_color(rng, 0.3))


def terrazzo(rng: np.random.Generator) -> npt.NDArray[np.float64]:
    """Chips of several colours: quantised fine noise, also gravel and soil."""
    n = np.argsort(np.argsort(noise(rng, rng.uniform(0.9, 1.6)).ravel())).reshape(SIZE, SIZE) / SIZE**2
    colors = np.array([random_color(rng) for _ in range(12)])
    return np.asarray(colors[np.floor(n * 24).astype(int) % 12])


def dots(rng: np.random.Generator) -> npt.NDArray[np.float64]:
    """A regular pattern of discs or rings."""
    x, y = _grid()
    n = int(rng.choice([3, 6, 12]))
    r = np.hypot((x * n) % 1 - 0.5, (y * n) % 1 - 0.5)
    inside = r < 0.35 if rng.random() < 0.5 else np.abs(r - 0.3) < 0.1
    return mix(inside, random_color(rng), random_color(rng))


def poster(rng: np.random.Generator) -> npt.NDArray[np.float64]:
    """Overlapping coloured rectangles and discs with a block of text."""
    x, y = _grid()
    image = np.ones((SIZE, SIZE, 3)) * random_color(rng)
    for _ in range(int(rng.integers(4, 14))):
        cx, cy, rx, ry = rng.uniform(0, 1, 2).tolist() + rng.uniform(0.03, 0.35, 2).tolist()
        if rng.random() < 0.5:
            inside = (np.abs(x - cx) < rx) & (np.abs(y - cy) < ry)
        else:
            inside = np.hypot(x - cx, y - cy) < rx
        image[inside] = random_color(rng)
    if rng.random() < 0.6:
        half = SIZE // 2
        image[half:] = text_like(rng)[half:]
    return image


def gradient(rng: np.random.Generator) -> npt.NDArray[np.float64]:
    """A smooth periodic ramp between two colours."""
    x, y = _grid()
    return mix(0.5 + 0.5 * np.sin(2 * np.pi * (x + rng.integers(0, 2) * y)), random_color(rng), random_color(rng))


TEXTURES: dict[str, Callable[[np.random.Generator], npt.NDArray[np.float64]]] = {
    "plain": plain, "checker": checker, "stripes": stripes, "wood": wood, "brick": brick, "text": text_like,
    "fabric": fabric, "marble": marble, "terrazzo": terrazzo, "dots": dots, "poster": poster, "gradient": gradient,
}


def make_texture(rng: np.random.Generator, name: str | None = None) -> Image:
    """The named texture, or a random one: (SIZE, SIZE, 3) float32, clipped to 0.02..0.95."""
    chosen = name or str(rng.choice(list(TEXTURES)))
    return np.clip(TEXTURES[chosen](rng), 0.02, 0.95).astype(np.float32)


def make_opacity(rng: np.random.Generator) -> Image:
    """A binary cut-out (SIZE, SIZE, 1): leaves, chain link or lace; the image's border is transparent."""
    x, y = _grid()
    style = rng.choice(["leaves", "mesh", "lace"])
    if style == "leaves":
        opaque = np.zeros((SIZE, SIZE), bool)
        for _ in range(int(rng.integers(6, 20))):
            cx, cy = rng.uniform(0.2, 0.8, 2)
            a = rng.uniform(0, np.pi)
            u = (x - cx) * np.cos(a) + (y - cy) * np.sin(a)
            v = -(x - cx) * np.sin(a) + (y - cy) * np.cos(a)
            opaque |= (np.abs(v) < 0.05 * (1 - (u / 0.17) ** 2)) & (np.abs(u) < 0.17)
    elif style == "mesh":
        n = int(rng.choice([6, 10]))
        u, v = ((x + y) * n) % 1, ((x - y) * n) % 1
        opaque = (np.abs(u - 0.5) < 0.09) | (np.abs(v - 0.5) < 0.09)
    else:
        opaque = np.abs(noise(rng, 1.3) - 0.5) < 0.09
    return opaque.astype(np.float32)[..., None]
