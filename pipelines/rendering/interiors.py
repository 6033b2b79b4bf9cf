"""Interiors: furnished rooms lit through windows, by small lamps, or only indirectly."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import numpy.typing as npt

from pipelines.rendering import environment, props
from pipelines.rendering import geometry as g
from pipelines.rendering.camera import ROLL, Camera
from pipelines.rendering.stage import Stage
from pipelines.rendering.textures import make_opacity

Vector = npt.NDArray[np.float64]
UP = np.array([0.0, 1.0, 0.0])
Opening = tuple[float, float, float, float]
"""A rectangle in a wall: x0, y0, x1, y1 in metres along the wall and up."""


def _wall(stage: Stage, slot: int, corner: Vector, along: Vector, length: float, height: float,
          openings: list[Opening]) -> None:
    """A wall from `corner` along the unit vector `along`, with rectangular (x0, y0, x1, y1) `openings`."""
    xs = sorted({0.0, length, *(o[0] for o in openings), *(o[2] for o in openings)})
    ys = sorted({0.0, height, *(o[1] for o in openings), *(o[3] for o in openings)})
    for x0, x1 in pairwise(xs):
        for y0, y1 in pairwise(ys):
            x, y = (x0 + x1) / 2, (y0 + y1) / 2
            if not any(a < x < c and b < y < d for a, b, c, d in openings):
                mesh = g.quad(corner + along * x0 + UP * y0, along * (x1 - x0), UP * (y1 - y0))
                uv = (mesh.uv + np.array([x0, y0])).astype(np.float32)
                stage.add(g.Mesh(mesh.vertices, mesh.faces, uv, mesh.color).with_uv_scale(0.7), slot)


def _window_dressing(stage: Stage, corner: Vector, along: Vector, inward: Vector,
                     opening: Opening) -> None:
    """Frame bars, and sometimes a pane, blinds, a curtain or a lace cut-out before an opening."""
    rng = stage.rng
    x0, y0, x1, y1 = opening
    frame = stage.material("matte", texture=stage.textured("plain"))

    def point(x: float, y: float, depth: float = 0.0) -> Vector:
        return np.asarray(corner + along * x + UP * y + inward * depth)

    bars = [g.tube(np.linspace(point(x, y0), point(x, y1), 2), 0.02, 4)
            for x in np.linspace(x0, x1, int(rng.integers(2, 5)))]
    bars += [g.tube(np.linspace(point(x0, y), point(x1, y), 2), 0.02, 4)
             for y in np.linspace(y0, y1, int(rng.integers(2, 5)))]
    stage.add(g.merge(bars), frame)
    style = rng.random()
    if style < 0.15:
        stage.add(g.quad(point(x0, y0, 0.03), along * (x1 - x0), UP * (y1 - y0)), stage.material("pane"))
    elif style < 0.4:
        tilt = rng.uniform(-0.9, 0.9)
        slats = [g.quad(point(x0, y, 0.05), along * (x1 - x0), 0.05 * (np.cos(tilt) * inward + np.sin(tilt) * UP))
                 for y in np.arange(y0, y1, 0.06)]
        stage.add(g.merge(slats), frame)
    elif style < 0.55:
        u = np.linspace(x0 - 0.1, x0 + (x1 - x0) * rng.uniform(0.3, 1.0), 60)
        rows = [[point(x, y, 0.12 + 0.04 * np.sin(x * 40)) for x in u] for y in (y0 - 0.2, y1 + 0.1)]
        slot = stage.material("translucent" if rng.random() < 0.6 else "matte", texture=stage.textured("fabric"))
        stage.add(g.surface(np.array(rows), (4.0, 4.0)), slot)
    elif style < 0.65:
        slot = stage.material("cutout", texture=stage.textured("plain"), opacity=make_opacity(rng))
        stage.add(g.quad(point(x0, y0, 0.08), along * (x1 - x0), UP * (y1 - y0)), slot)


def glowing_window(stage: Stage, corner: Vector, along: Vector, inward: Vector,
                    opening: Opening) -> None:
    """An evenly bright panel outside an opening, as lighters put there in place of a sky."""
    x0, y0, x1, y1 = opening
    slot = stage.light(stage.warm_or_cool(stage.rng.uniform(5, 20)))
    # Lights shine along the cross product of their edges, which must be `inward`.
    stage.add(g.quad(corner + along * (x0 - 0.3) + UP * (y0 - 0.3) - inward * 0.4, along * (x1 - x0 + 0.6),
                     UP * (y1 - y0 + 0.6)), slot)


def interior(stage: Stage) -> None:
    """A furnished room lit through windows, by many small lamps, or only indirectly."""
    rng = stage.rng
    stage.kind = "interior"
    w, d, h = rng.uniform(3, 8), rng.uniform(3, 9), rng.uniform(2.3, 3.6)
    lighting = str(rng.choice(["window", "lamps", "indirect", "window and lamps"], p=[0.42, 0.25, 0.15, 0.18]))
    stage.tags.append(lighting)
    wall = stage.material("matte", texture=stage.textured(str(rng.choice(
        ["plain", "plain", "brick", "stripes", "marble", "text", "dots", "wood"]))))
    floor = stage.surface_material(0.6, str(rng.choice(["wood", "checker", "brick", "marble", "terrazzo", "fabric"])))
    ceiling = stage.material("matte", texture=stage.textured("plain"))
    stage.add(g.quad([-w / 2, 0, -d / 2], [0, 0, d], [w, 0, 0], 0.6), floor)
    stage.add(g.quad([-w / 2, h, -d / 2], [w, 0, 0], [0, 0, d], 0.6), ceiling)
    sides = [(np.array([-w / 2, 0, -d / 2]), np.array([1.0, 0, 0]), w, np.array([0, 0, 1.0])),
             (np.array([w / 2, 0, -d / 2]), np.array([0, 0, 1.0]), d, np.array([-1.0, 0, 0])),
             (np.array([w / 2, 0, d / 2]), np.array([-1.0, 0, 0]), w, np.array([0, 0, -1.0])),
             (np.array([-w / 2, 0, d / 2]), np.array([0, 0, -1.0]), d, np.array([1.0, 0, 0]))]
    windowed = set(rng.choice(4, int(rng.integers(1, 3)), replace=False).tolist()) if "window" in lighting else set()
    for number, (corner, along, length, inward) in enumerate(sides):
        openings: list[Opening] = []
        if number in windowed:
            count = int(rng.integers(1, 4))
            pitch = length / count
            for k in range(count):
                wide = pitch * rng.uniform(0.25, 0.85)
                low, high = rng.uniform(0.1, 1.2), h * rng.uniform(0.7, 0.95)
                openings.append((pitch * (k + 0.5) - wide / 2, low, pitch * (k + 0.5) + wide / 2, high))
        _wall(stage, wall, corner, along, length, h, openings)
        glowing = rng.random() < 0.6
        for opening in openings:
            if glowing:
                glowing_window(stage, corner, along, inward, opening)
            _window_dressing(stage, corner, along, inward, opening)
    if windowed:
        inward = sides[min(windowed)][3]
        sun = -inward + UP * rng.uniform(0.2, 1.2) + rng.normal(size=3) * 0.4
        bright = rng.uniform(2, 10)
        stage.environment = environment.facing(environment.sky(rng, sun) * np.float32(bright),
                                               [-sides[k][3] for k in windowed])
        if rng.random() < 0.5:
            stage.add(g.quad([-60, -3, -60], [0, 0, 120], [120, 0, 0], 0.3), stage.material(
                "matte", texture=stage.textured("terrazzo")))
    if "lamps" in lighting:
        for _ in range(int(rng.integers(1, 9))):
            where = np.array([rng.uniform(-0.45, 0.45) * w, rng.uniform(0.4, 0.95) * h, rng.uniform(-0.45, 0.45) * d])
            props.lamp(stage, where, rng.uniform(0.15, 0.45), rng.uniform(3, 30))
    if lighting == "indirect":
        _indirect_light(stage, w, d, h)
    _furnish(stage, sides, w, d, h)

    def camera(draw: np.random.Generator) -> Camera:
        x, z = draw.uniform(-0.46, 0.46) * w, draw.uniform(-0.46, 0.46) * d
        origin = np.array([x, draw.uniform(0.4, min(2.0, h - 0.2)), z])
        target = np.array([draw.uniform(-0.4, 0.4) * w, draw.uniform(0.2, 1.3), draw.uniform(-0.4, 0.4) * d])
        return Camera.look_at(origin, target, draw.uniform(28, 85), draw.normal() * ROLL)

    stage.camera = camera


def _indirect_light(stage: Stage, w: float, d: float, h: float) -> None:
    """Strong lamps that no wall sees except one: up-lighters, coves and a lamp behind a screen."""
    rng = stage.rng
    for _ in range(int(rng.integers(1, 4))):
        where = np.array([rng.uniform(-0.45, 0.45) * w, 0, rng.uniform(-0.45, 0.45) * d])
        size = rng.uniform(0.08, 0.3)
        light = stage.light(stage.warm_or_cool(rng.uniform(5, 30) / size**2))
        if rng.random() < 0.5:
            top = where + UP * h * rng.uniform(0.45, 0.8)
            stage.add(g.quad(top, [0, 0, size], [size, 0, 0]), light)
            stage.add(g.lathe([[0, -0.06], [size, -0.05], [size * 1.5, 0.12]], 24), stage.surface_material(0.6),
                      top + np.array([size / 2, 0, size / 2]))
        else:
            wall_x = np.sign(where[0] + 1e-9) * w / 2
            strip = np.array([wall_x * 0.97, h * 0.8, -d * 0.35])
            stage.add(g.box([0.03, 0.02, d * 0.7 * rng.uniform(0.2, 1)]), light, strip + np.array([0, 0.03, d * 0.35]))
            stage.add(g.box([0.2, 0.02, d * 0.72]), stage.surface_material(0.2), strip + np.array([0, -0.02, d * 0.35]))
            stage.add(g.box([0.02, 0.12, d * 0.72]), stage.surface_material(0.2),
                      strip + np.array([-np.sign(wall_x) * 0.1, 0.02, d * 0.35]))


def _furnish(stage: Stage, sides: list[tuple[Vector, Vector, float, Vector]], w: float, d: float, h: float) -> None:
    """Tables with clutter, chairs, shelves, plants, pictures, a rug, cables, a mirror."""
    rng = stage.rng
    for _ in range(int(rng.integers(1, 4))):
        at = np.array([rng.uniform(-0.35, 0.35) * w, 0, rng.uniform(-0.35, 0.35) * d])
        wide, deep, high = rng.uniform(0.6, 2.0), rng.uniform(0.5, 1.1), rng.uniform(0.4, 0.8)
        props.table(stage, at, wide, deep, high)
        props.clutter(stage, at + UP * high, (wide * 0.9, deep * 0.9), int(rng.integers(3, 16)), 0.2)
        for _ in range(int(rng.integers(0, 4))):
            beside = at + np.array([rng.normal() * wide * 0.7, 0, rng.normal() * deep])
            props.chair(stage, beside, rng.uniform(0.8, 1.1))
    for corner, along, length, inward in sides:
        if rng.random() < 0.4:
            where = corner + along * length * rng.uniform(0.3, 0.7) + inward * 0.18
            turn = float(np.arctan2(inward[0], inward[2]))
            props.shelf(stage, where, rng.uniform(0.6, 1.4), rng.uniform(0.8, h * 0.85), turn)
        for _ in range(int(rng.integers(0, 4))):
            x, y, a, b = rng.uniform(0.1, 0.8) * length, rng.uniform(1.0, h * 0.6), *rng.uniform(0.3, 0.9, 2)
            slot = stage.material("mirror", tint=(0.9, 0.9, 0.9)) if rng.random() < 0.15 else stage.surface_material(
                0.3, str(rng.choice(["poster", "text", "gradient"])))
            picture = g.quad(corner + along * x + UP * y + inward * 0.02, along * a, UP * b)
            span = np.maximum(picture.uv.max(0), 1e-3)
            uv = (picture.uv / span).astype(np.float32)
            stage.add(g.Mesh(picture.vertices, picture.faces, uv, picture.color), slot)
    if rng.random() < 0.5:
        rug = stage.material("matte", texture=stage.textured("fabric"))
        stage.add(g.box([rng.uniform(1, 2.5), 0.02, rng.uniform(1, 2.5)]), rug,
                  [rng.uniform(-0.2, 0.2) * w, 0.01, rng.uniform(-0.2, 0.2) * d], rng.uniform(0, 6.28))
    for _ in range(int(rng.integers(0, 4))):
        at = np.array([rng.uniform(-0.45, 0.45) * w, 0, rng.uniform(-0.45, 0.45) * d])
        props.plant(stage, at, rng.uniform(0.4, 1.6))
    props.clutter(stage, np.zeros(3), (w * 0.9, d * 0.9), int(rng.integers(2, 12)), 0.35)
    if rng.random() < 0.4:
        props.wires(stage, np.array([-w / 2, h * 0.95, rng.uniform(-0.4, 0.4) * d]),
                    np.array([w / 2, h * 0.95, rng.uniform(-0.4, 0.4) * d]), int(rng.integers(1, 6)), 0.4)
