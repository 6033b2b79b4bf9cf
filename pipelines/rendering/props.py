"""Things to put into scenes: furniture, vessels, plants, wires, fences, clutter of every scale.

Each function adds one thing to a Stage, standing on `at` (its foot) and about `size` metres high.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pipelines.rendering import geometry as g
from pipelines.rendering.stage import Stage
from pipelines.rendering.textures import make_opacity, random_color

Vector = npt.NDArray[np.float64]
UP = np.array([0.0, 1.0, 0.0])


def vessel(stage: Stage, at: Vector, size: float) -> None:
    """A lathed vase, bottle, bowl or drinking glass, open at the top; glass ones often hold a liquid-like body."""
    rng = stage.rng
    k = int(rng.integers(5, 9))
    t = np.linspace(0, 1, 16)
    radius = np.interp(t, np.linspace(0, 1, k), rng.uniform(0.12, 0.4, k))
    smooth = np.convolve(np.pad(radius, 3, mode="edge"), np.ones(7) / 7, "valid")
    outer = np.stack([smooth * size, t * size], 1)
    inner = np.stack([smooth * size * 0.9, np.maximum(t * size, 0.04 * size)], 1)[::-1]
    profile = np.concatenate([[[0, 0]], outer, inner, [[0, 0.04 * size]]])
    slot = stage.glass() if rng.random() < 0.4 else stage.surface_material(0.8)
    stage.add(g.lathe(profile, 28), slot, at, movable=True)


def solid(stage: Stage, at: Vector, size: float, slot: int | None = None) -> None:
    """A random smooth or boxy body, of the material in `slot` or of any."""
    rng = stage.rng
    shape = rng.choice(["ball", "soft box", "box", "ring", "cone", "knot", "blob"])
    slot = stage.any_material() if slot is None else slot
    if shape == "ball":
        mesh = g.superellipsoid([size] * 3, 1.0, 26)
    elif shape == "soft box":
        mesh = g.superellipsoid(size * rng.uniform(0.4, 1, 3), rng.uniform(0.25, 0.7), 26)
    elif shape == "box":
        mesh = g.box(size * rng.uniform(0.3, 1, 3), 1 / size)
    elif shape == "ring":
        mesh = g.torus(size * 0.35, size * rng.uniform(0.05, 0.15))
    elif shape == "cone":
        top = size * rng.uniform(0, 0.3)
        mesh = g.lathe([[0, -size / 2], [size * 0.35, -size / 2], [top, size / 2], [0, size / 2]])
    elif shape == "knot":
        a = np.linspace(0, 2 * np.pi, 90)
        p, q = rng.choice([2, 3]), rng.choice([3, 5, 7])
        r = 0.3 + 0.12 * np.cos(q * a)
        mesh = g.tube(size * np.stack([r * np.cos(p * a), 0.15 * np.sin(q * a), r * np.sin(p * a)], 1),
                      size * rng.uniform(0.02, 0.07), 6)
    else:
        ball = g.superellipsoid([size] * 3, 1.0, 34)
        bumps = sum(np.sin(ball.vertices @ (rng.normal(size=3) * f / size) + rng.uniform(0, 6))[:, None] / f
                    for f in (4, 7, 12))
        mesh = g.Mesh((ball.vertices * (1 + 0.5 * bumps)).astype(np.float32), ball.faces, ball.uv, ball.color)
    mesh = mesh.transformed(g.random_rotation(rng) if rng.random() < 0.6 else g.rotation(UP, rng.uniform(0, 6.28)))
    lift = -float(mesh.vertices[:, 1].min())
    stage.add(mesh, slot, at + UP * lift, movable=True)


def books(stage: Stage, at: Vector, size: float) -> None:
    """A row or a leaning stack of books in many colours."""
    rng = stage.rng
    slot = stage.material("colored")
    text = stage.material("matte", texture=stage.textured("poster"))
    upright, offset = rng.random() < 0.6, 0.0
    for _ in range(int(rng.integers(3, 14))):
        w, h, d = size * rng.uniform(0.06, 0.2), size * rng.uniform(0.6, 1), size * rng.uniform(0.5, 0.7)
        where = np.array([offset + w / 2, h / 2, 0]) if upright else np.array([0, offset + w / 2, 0])
        mesh = g.box([w, h, d] if upright else [h, w, d], 2 / size)
        if not upright:
            mesh = mesh.transformed(g.rotation(UP, rng.normal(0, 0.2)))
        stage.add(mesh.with_color(random_color(rng)), text if rng.random() < 0.25 else slot, at + where)
        offset += w * 1.03


def table(stage: Stage, at: Vector, width: float, depth: float, height: float) -> None:
    """A top on four legs; its surface is at `at` + `height`."""
    rng = stage.rng
    slot = stage.surface_material(0.6, str(rng.choice(["wood", "marble", "plain", "checker"])))
    stage.add(g.box([width, 0.04, depth]), slot, at + UP * (height - 0.02))
    legs = slot if rng.random() < 0.5 else stage.surface_material(0.8)
    thick = rng.uniform(0.012, 0.035)
    for x in (-1, 1):
        for z in (-1, 1):
            foot = at + np.array([x * (width / 2 - 0.05), 0, z * (depth / 2 - 0.05)])
            stage.add(g.tube(np.linspace(foot, foot + UP * height, 3), thick, 10), legs)


def chair(stage: Stage, at: Vector, size: float) -> None:
    """A seat, four thin legs and a slatted back."""
    rng = stage.rng
    slot = stage.surface_material(0.5)
    seat, turn = 0.45 * size, rng.uniform(0, 6.28)
    parts = [g.box([0.42 * size, 0.04, 0.42 * size]).transformed(offset=[0, seat, 0])]
    for x in (-0.19, 0.19):
        for z in (-0.19, 0.19):
            top = size * 0.95 if z < 0 else seat
            parts.append(g.tube(np.linspace([x * size, 0, z * size], [x * size, top, z * size], 3), 0.015, 8))
    for k in range(int(rng.integers(2, 7))):
        y = seat + (size * 0.95 - seat) * (k + 1) / 8 + 0.1
        parts.append(g.tube(np.linspace([-0.19 * size, y, -0.19 * size], [0.19 * size, y, -0.19 * size], 3), 0.01, 6))
    stage.add(g.merge(parts), slot, at, turn)


def shelf(stage: Stage, at: Vector, width: float, height: float, turn: float) -> None:
    """A bookcase against a wall, filled with books and things; `turn` about y, back toward -z."""
    rng = stage.rng
    rows = int(rng.integers(2, 6))
    slot = stage.surface_material(0.4, "wood" if rng.random() < 0.6 else None)
    spin = g.rotation(UP, turn)
    parts = [g.box([0.03, height, 0.3]).transformed(offset=[x * width / 2, height / 2, 0]) for x in (-1, 1)]
    parts += [g.box([width, 0.03, 0.3]).transformed(offset=[0, height * k / rows, 0]) for k in range(rows + 1)]
    stage.add(g.merge(parts), slot, at, turn)
    for k in range(rows):
        x = -width / 2 + 0.1
        while x < width / 2 - 0.25:
            spot = at + spin @ np.array([x, height * k / rows + 0.016, 0])
            size = min(0.8 * height / rows, 0.3) * rng.uniform(0.5, 1)
            (vessel, solid, solid, vessel)[int(rng.integers(4))](stage, spot, size)
            x += size * rng.uniform(0.7, 1.8)


def plant(stage: Stage, at: Vector, size: float) -> None:
    """A pot with stems and many leaves: cut-out cards, real leaf polygons or long blades."""
    rng = stage.rng
    pot = size * 0.25
    profile = [[0, 0], [pot * 0.4, 0], [pot * 0.55, pot], [pot * 0.5, pot], [pot * 0.45, pot * 0.8], [0, pot * 0.8]]
    stage.add(g.lathe(profile), stage.surface_material(0.5), at)
    base = at + UP * pot * 0.8
    foliage(stage, base, size * 0.75, int(rng.integers(40, 300)))


def foliage(stage: Stage, at: Vector, size: float, count: int) -> None:
    """`count` leaves or blades growing from `at`, `size` metres high."""
    rng = stage.rng
    style = rng.choice(["blades", "leaves", "cards"])
    green = random_color(rng, 0.15, 0.5) * np.array([0.5, 1.0, 0.3])
    texture = np.clip(stage.textured("gradient") * 0.3 + green, 0.02, 0.9).astype(np.float32)
    if style == "cards":
        slot = stage.material("cutout", texture=texture, opacity=make_opacity(rng))
    else:
        slot = stage.material("translucent" if rng.random() < 0.6 else "matte", texture=texture)
    if style == "blades":
        direction = rng.normal(size=(count, 3)) * 0.45 + UP
        tips = at + direction * size * rng.uniform(0.5, 1, (count, 1))
        roots = np.broadcast_to(at, tips.shape) + rng.normal(size=tips.shape) * np.array([0.04, 0, 0.04]) * size
        mesh = g.ribbons(roots.astype(np.float32), tips.astype(np.float32), size * rng.uniform(0.01, 0.06),
                         (rng.normal(size=tips.shape) * 0.3 * size).astype(np.float32), 4)
    else:
        centres = at + UP * size * 0.6 + rng.normal(size=(count, 3)) * size * np.array([0.22, 0.2, 0.22])
        leaf = size * rng.uniform(0.08, 0.2) * (1.5 if style == "cards" else 1)
        mesh = g.cards(centres.astype(np.float32), leaf, rng, pointed=style == "leaves")
        stems = [g.tube(np.linspace(at, c, 4) + rng.normal(size=(4, 3)) * 0.01 * size, 0.004 * size + 0.001, 5)
                 for c in centres[:12]]
        stage.add(g.merge(stems), stage.material("matte", texture=texture))
    stage.add(mesh, slot, movable=True)


def wires(stage: Stage, start: Vector, end: Vector, count: int, sag: float) -> None:
    """Thin cables hanging between two ends."""
    rng = stage.rng
    slot = stage.surface_material(0.6)
    t = np.linspace(0, 1, 24)[:, None]
    for _ in range(count):
        a, b = start + rng.normal(size=3) * 0.1 * sag, end + rng.normal(size=3) * 0.1 * sag
        path = a * (1 - t) + b * t - UP * sag * rng.uniform(0.5, 1.5) * 4 * t * (1 - t)
        stage.add(g.tube(path, float(np.exp(rng.uniform(np.log(0.001), np.log(0.008)))) * max(1.0, sag), 5), slot,
                  movable=True)


def hairball(stage: Stage, at: Vector, size: float) -> None:
    """A tuft of many fine strands on a ball: fur, brush, wool."""
    rng = stage.rng
    count = int(rng.integers(300, 1500))
    d = rng.normal(size=(count, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    centre = at + UP * size / 2
    roots = centre + d * size * 0.3
    tips = centre + d * size * rng.uniform(0.4, 0.55, (count, 1)) + rng.normal(size=(count, 3)) * 0.05 * size
    slot = stage.surface_material(0.3)
    stage.add(g.superellipsoid([size * 0.6] * 3), slot, centre)
    stage.add(g.ribbons(roots.astype(np.float32), tips.astype(np.float32), size * rng.uniform(0.004, 0.015),
                        (rng.normal(size=(count, 3)) * size * 0.15).astype(np.float32), 4), slot, movable=True)


def fence(stage: Stage, start: Vector, end: Vector, height: float) -> None:
    """Upright bars with two rails, or a cut-out mesh panel."""
    rng = stage.rng
    length = float(np.linalg.norm(end - start))
    if rng.random() < 0.3:
        slot = stage.material("cutout", texture=stage.textured("plain"), opacity=make_opacity(rng))
        stage.add(g.quad(start, end - start, UP * height, 1.0), slot)
        return
    slot = stage.surface_material(0.6)
    pitch, radius = rng.uniform(0.08, 0.35), rng.uniform(0.008, 0.03)
    bars = [g.tube(np.linspace(p, p + UP * height, 2), radius, 6)
            for p in np.linspace(start, end, max(3, int(length / pitch)))]
    bars += [g.tube(np.linspace(start + UP * y * height, end + UP * y * height, 2), radius * 1.3, 6)
             for y in (0.2, 0.9)]
    stage.add(g.merge(bars), slot)


def lamp(stage: Stage, at: Vector, size: float, power: float) -> None:
    """A small bright bulb, bare, inside a glass globe or half hidden by an opaque shade: sources of fireflies."""
    rng = stage.rng
    radius = size * rng.uniform(0.04, 0.15)
    emitted = stage.warm_or_cool(power / (4 * np.pi**2 * radius**2))
    stage.add(g.superellipsoid([2 * radius] * 3, 1.0, 12), stage.light(emitted), at)
    style = rng.choice(["bare", "globe", "shade", "frosted"], p=[0.58, 0.08, 0.28, 0.06])
    if style in ("globe", "frosted"):
        slot = stage.glass() if style == "globe" else stage.material("frosted", alpha=0.2)
        stage.add(g.superellipsoid([size * 0.5] * 3, 1.0, 24), slot, at)
    elif style == "shade":
        shade = g.lathe([[size * 0.45, -size * 0.25], [size * 0.25, size * 0.3]], 32)
        stage.add(shade, stage.surface_material(0.3), at)


PROPS = (vessel, vessel, solid, solid, solid, solid, books, plant, hairball)


def clutter(stage: Stage, centre: Vector, extent: tuple[float, float], count: int, size: float) -> None:
    """`count` things of sizes spread over a factor of eight, scattered on the level of `centre`."""
    rng = stage.rng
    for _ in range(count):
        where = centre + np.array([rng.uniform(-0.5, 0.5) * extent[0], 0, rng.uniform(-0.5, 0.5) * extent[1]])
        prop = PROPS[int(rng.integers(len(PROPS)))] if rng.random() < 0.6 else solid
        prop(stage, where, size * float(np.exp(rng.uniform(np.log(0.25), np.log(2.0)))))
