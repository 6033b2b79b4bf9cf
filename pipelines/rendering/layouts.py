"""Whole scenes, each a function that fills a Stage: outdoors, tabletops, clutter in the air, abstract and bright ones.

Interiors are in interiors.py; LAYOUTS lists them all with their shares.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from pipelines.rendering import environment, props
from pipelines.rendering import geometry as g
from pipelines.rendering.camera import ROLL, Camera
from pipelines.rendering.interiors import interior
from pipelines.rendering.stage import Stage
from pipelines.rendering.textures import noise

Vector = npt.NDArray[np.float64]
UP = np.array([0.0, 1.0, 0.0])


def outdoor(stage: Stage) -> None:
    """Terrain with grass, trees, fences, buildings, rocks and clutter under a sky, or at night under lamps."""
    rng = stage.rng
    stage.kind = "outdoor"
    night = rng.random() < 0.25
    stage.tags.append("night" if night else "day")
    stage.environment = environment.spots(rng) if night else environment.sky(rng)
    extent, relief = 60.0, rng.uniform(0, 2.5) * (rng.random() < 0.7)
    heights = (noise(rng, 2.2, 96) - 0.5) * 2 * relief
    ground = stage.surface_material(0.25, str(rng.choice(["terrazzo", "brick", "checker", "marble", "plain", "wood"])))
    stage.add(g.heightfield(heights, extent), ground)

    def level(x: float, z: float) -> float:
        i, k = (int(np.clip((c + extent / 2) / extent * 95, 0, 95)) for c in (x, z))
        return float(heights[i, k])

    def spot(spread: float) -> Vector:
        x, z = rng.normal(size=2) * spread
        return np.array([x, level(x, z) - 0.02, z])

    if rng.random() < 0.7:
        _grass(stage, spot, int(rng.integers(1500, 9000)))
    for _ in range(int(rng.integers(0, 7))):
        _tree(stage, spot(8), rng.uniform(2, 6))
    for _ in range(int(rng.integers(0, 4))):
        size = rng.uniform(2, 7, 3)
        walls = stage.surface_material(0.3, str(rng.choice(["brick", "checker", "stripes", "dots"])))
        stage.add(g.box(size, 0.4), walls, spot(14) + UP * size[1] / 2, rng.uniform(0, 6.28))
    for _ in range(int(rng.integers(0, 3))):
        a, b = spot(5), spot(5)
        props.fence(stage, a, b, rng.uniform(0.6, 1.8))
    if rng.random() < 0.5:
        poles = [spot(6) for _ in range(3)]
        metal = stage.surface_material(0.8)
        for p in poles:
            stage.add(g.tube(np.linspace(p, p + UP * 4, 3), 0.05, 8), metal)
        for p, q in pairwise(poles):
            props.wires(stage, p + UP * 4, q + UP * 4, int(rng.integers(1, 6)), 0.6)
    if night or rng.random() < 0.2:
        for _ in range(int(rng.integers(1, 6))):
            props.lamp(stage, spot(4) + UP * rng.uniform(0.5, 3.5), rng.uniform(0.2, 0.5), rng.uniform(5, 60))
    for _ in range(int(rng.integers(8, 40))):
        props.solid(stage, spot(3.5), float(np.exp(rng.uniform(np.log(0.08), np.log(1.4)))))
    for _ in range(int(rng.integers(0, 6))):
        (props.vessel, props.hairball, props.plant)[int(rng.integers(3))](stage, spot(3), rng.uniform(0.3, 1.0))

    def camera(draw: np.random.Generator) -> Camera:
        angle, radius = draw.uniform(0, 6.28), draw.uniform(1.5, 9)
        x, z = radius * np.cos(angle), radius * np.sin(angle)
        origin = np.array([x, level(x, z) + float(np.exp(draw.uniform(np.log(0.2), np.log(2.5)))), z])
        target = np.array([draw.normal(), level(0, 0) + draw.uniform(0, 1.2), draw.normal()])
        return Camera.look_at(origin, target, draw.uniform(22, 70), draw.normal() * ROLL)

    stage.camera = camera


def _grass(stage: Stage, spot: Callable[[float], Vector], count: int) -> None:
    rng = stage.rng
    clumps = np.array([spot(4) for _ in range(min(count, 900))])
    roots = clumps[rng.integers(0, len(clumps), count)] + rng.normal(size=(count, 3)) * np.array([0.15, 0, 0.15])
    tall = rng.uniform(0.08, 0.6)
    tips = roots + (UP + rng.normal(size=(count, 3)) * 0.3) * tall * rng.uniform(0.5, 1.2, (count, 1))
    kind = "translucent" if rng.random() < 0.5 else "matte"
    texture = np.clip(stage.textured("gradient") * np.array([0.5, 0.9, 0.3]), 0.02, 0.8).astype(np.float32)
    stage.add(g.ribbons(roots.astype(np.float32), tips.astype(np.float32), rng.uniform(0.004, 0.015),
                        (rng.normal(size=(count, 3)) * 0.2 * tall).astype(np.float32), 3),
              stage.material(kind, texture=texture), movable=True)


def _tree(stage: Stage, at: Vector, size: float) -> None:
    rng = stage.rng
    bark = stage.material("matte", texture=stage.textured("wood"))
    path = np.cumsum(np.vstack([at, (UP + rng.normal(size=(5, 3)) * 0.15) * size / 9]), 0)
    stage.add(g.tube(path, np.linspace(0.05, 0.02, 6) * size, 8), bark)
    for _ in range(int(rng.integers(2, 6))):
        props.foliage(stage, path[-1] + rng.normal(size=3) * size * 0.15 - UP * size * 0.3, size * 0.6,
                      int(rng.integers(60, 400)))


def tabletop(stage: Stage) -> None:
    """A close-up of things on a surface, under studio lights, small hard lamps or an environment with bright spots."""
    rng = stage.rng
    stage.kind = "tabletop"
    extent = float(np.exp(rng.uniform(np.log(0.3), np.log(1.5))))
    if rng.random() < 0.85:
        side = extent * rng.uniform(1.5, 8)
        stage.add(g.quad([-side / 2, 0, -side / 2], [0, 0, side], [side, 0, 0], 1 / extent), stage.surface_material(
            0.6, str(rng.choice(["wood", "checker", "marble", "text", "fabric", "terrazzo", "poster", "brick"]))))
    if rng.random() < 0.4:
        back = stage.surface_material(0.4)
        stage.add(g.quad([-4 * extent, -0.01, -2 * extent], [8 * extent, 0, 0], [0, 5 * extent, 0], 1 / extent), back)
    _sky_or_studio(stage, extent)
    props.clutter(stage, np.zeros(3), (extent, extent), int(rng.integers(6, 36)), extent * 0.22)
    if rng.random() < 0.3:
        props.wires(stage, np.array([-extent, extent * 0.4, 0.1]), np.array([extent, extent * 0.4, -0.1]),
                    int(rng.integers(2, 10)), extent * 0.5)

    def camera(draw: np.random.Generator) -> Camera:
        angle, lift = draw.uniform(0, 6.28), draw.uniform(0.08, 1.1)
        distance = extent * draw.uniform(0.8, 2.4)
        origin = distance * np.array([np.cos(angle) * np.cos(lift), np.sin(lift), np.sin(angle) * np.cos(lift)])
        target = draw.normal(size=3) * extent * 0.15 + UP * extent * 0.1
        return Camera.look_at(origin, target, draw.uniform(22, 55), draw.normal() * ROLL)

    stage.camera = camera


def _sky_or_studio(stage: Stage, extent: float) -> None:
    rng = stage.rng
    style = str(rng.choice(["studio", "spots", "sky", "lamps"], p=[0.25, 0.3, 0.15, 0.3]))
    stage.tags.append(style)
    if style == "lamps":
        stage.environment = environment.uniform(rng, float(rng.choice([0.0, 0.01, 0.05])))
        for _ in range(int(rng.integers(1, 5))):
            d = rng.normal(size=3) + UP
            props.lamp(stage, d / np.linalg.norm(d) * extent * rng.uniform(0.8, 3), extent * rng.uniform(0.1, 0.4),
                       rng.uniform(3, 20) * extent**2)
    else:
        maps = {"studio": environment.studio, "spots": environment.spots, "sky": environment.sky}
        stage.environment = maps[style](rng)


def floating(stage: Stage) -> None:
    """Clutter hanging in space at many depths and scales, with an empty or distant background."""
    rng = stage.rng
    stage.kind = "floating"
    _sky_or_studio(stage, 3.0)
    for _ in range(int(rng.integers(20, 90))):
        where = rng.uniform(-1, 1, 3) * np.array([4, 2.5, 8])
        size = float(np.exp(rng.uniform(np.log(0.1), np.log(1.6))))
        (props.solid, props.solid, props.solid, props.vessel, props.hairball)[int(rng.integers(5))](stage, where, size)
    for _ in range(int(rng.integers(0, 4))):
        props.wires(stage, rng.uniform(-4, 4, 3), rng.uniform(-4, 4, 3), int(rng.integers(1, 12)), 0.7)

    def camera(draw: np.random.Generator) -> Camera:
        origin = np.array([draw.normal(), draw.normal(), 8 + draw.uniform(-2, 4)])
        return Camera.look_at(origin, draw.normal(size=3), draw.uniform(25, 60), draw.normal() * ROLL)

    stage.camera = camera


def abstract(stage: Stage) -> None:
    """A few large bodies, any material on any of them and on the walls, under lights of every size."""
    rng = stage.rng
    stage.kind = "abstract"
    w, d, h = rng.uniform(3, 8, 3)
    closed = rng.random() < 0.5
    stage.tags.append("closed" if closed else "open")
    scale = float(np.exp(rng.uniform(np.log(0.15), np.log(1.5))))
    stage.add(g.quad([-w, 0, -d], [0, 0, 2 * d], [2 * w, 0, 0], scale), stage.bold_material())
    if closed:
        stage.environment = environment.uniform(rng, 0.0)
        walls = [([-w, h, -d], [2 * w, 0, 0], [0, 0, 2 * d]), ([-w, 0, -d], [2 * w, 0, 0], [0, h, 0]),
                 ([w, 0, d], [-2 * w, 0, 0], [0, h, 0]), ([-w, 0, d], [0, 0, -2 * d], [0, h, 0]),
                 ([w, 0, -d], [0, 0, 2 * d], [0, h, 0])]
        for corner, along, up in walls:
            stage.add(g.quad(corner, along, up, scale), stage.bold_material())
    else:
        maps = (environment.studio, environment.spots, environment.sky, environment.sky)
        stage.environment = maps[int(rng.integers(4))](rng)
        if rng.random() < 0.4:
            stage.add(g.quad([-w, 0, -d], [2 * w, 0, 0], [0, h, 0], scale), stage.bold_material())
    if closed or rng.random() < 0.4:
        _lights_of_every_size(stage, w, d, h)
    for _ in range(int(rng.integers(3, 25))):
        at = np.array([rng.uniform(-0.7, 0.7) * w, rng.uniform(0, 0.5) * h * (rng.random() < 0.3),
                       rng.uniform(-0.7, 0.7) * d])
        slot = stage.bold_material() if rng.random() < 0.85 else stage.any_material()
        props.solid(stage, at, float(np.exp(rng.uniform(np.log(0.3), np.log(3.0)))), slot)

    def camera(draw: np.random.Generator) -> Camera:
        side = draw.choice([-1.0, 1.0])
        origin = np.array([draw.uniform(-0.9, 0.9) * w, draw.uniform(0.3, 0.8) * h, side * draw.uniform(0.5, 0.95) * d])
        target = np.array([draw.uniform(-0.4, 0.4) * w, draw.uniform(0.05, 0.5) * h, draw.uniform(-0.4, 0.4) * d])
        return Camera.look_at(origin, target, draw.uniform(30, 75), draw.normal() * ROLL)

    stage.camera = camera


def _lights_of_every_size(stage: Stage, w: float, d: float, h: float) -> None:
    """Panels under the ceiling and balls in the air, from a hand's width to most of the room, all of like power."""
    rng = stage.rng
    for _ in range(int(rng.integers(1, 5))):
        size = float(np.exp(rng.uniform(np.log(0.1), np.log(3.0))))
        at = np.array([rng.uniform(-0.7, 0.7) * w, h * rng.uniform(0.6, 0.97), rng.uniform(-0.7, 0.7) * d])
        light = stage.light(stage.warm_or_cool(rng.uniform(3, 30) / size**2))
        if rng.random() < 0.6:
            stage.add(g.quad(at - np.array([size / 2, 0, size / 2]), [size, 0, 0], [0, 0, size]), light)
        else:
            stage.add(g.superellipsoid([size / 2] * 3, 1.0, 16), light, at - UP * size / 4)


def bright(stage: Stage) -> None:
    """A few bodies on a wide floor in even, soft light: smooth shading, strong colours and coarse textures.

    Little noise, where every blotch, lost edge or smeared gradient shows.
    """
    rng = stage.rng
    stage.kind = "bright"
    closed = rng.random() < 0.4
    stage.tags.append("closed" if closed else "open")
    extent = rng.uniform(3, 7) if closed else float(np.exp(rng.uniform(np.log(4), np.log(40))))
    h = rng.uniform(2.5, 5)
    floor = g.quad([-extent, 0, -extent], [0, 0, 2 * extent], [2 * extent, 0, 0], _coarse(rng))
    stage.add(floor, _vivid(stage, 0.3))
    walls = [([-extent, 0, -extent], [2 * extent, 0, 0]), ([-extent, 0, extent], [0, 0, -2 * extent]),
             ([extent, 0, -extent], [0, 0, 2 * extent]), ([extent, 0, extent], [-2 * extent, 0, 0])]
    for corner, along in walls[:4 if closed else int(rng.integers(0, 3))]:
        stage.add(g.quad(corner, along, [0, h, 0], _coarse(rng)), _vivid(stage, 0.15))
    if closed:
        stage.environment = environment.uniform(rng, 0.0)
        stage.add(g.quad([-extent, h, -extent], [2 * extent, 0, 0], [0, 0, 2 * extent]), stage.material(
            "matte", texture=stage.textured("plain")))
        for _ in range(int(rng.integers(1, 4))):
            size = extent * rng.uniform(0.3, 1.0)
            at = np.array([rng.uniform(-0.5, 0.5) * extent, h * 0.97, rng.uniform(-0.5, 0.5) * extent])
            stage.add(g.quad(at - np.array([size / 2, 0, size / 2]), [size, 0, 0], [0, 0, size]),
                      stage.light(stage.warm_or_cool(rng.uniform(2, 10) / size)))
    else:
        maps = (environment.sky, environment.sky, environment.uniform, environment.studio)
        stage.environment = maps[int(rng.integers(4))](rng)
    for _ in range(int(rng.integers(2, 12))):
        at = np.array([rng.uniform(-2.5, 2.5), rng.uniform(0, 0.4) * (rng.random() < 0.2), rng.uniform(-2.5, 2.5)])
        size = float(np.exp(rng.uniform(np.log(0.3), np.log(2.2))))
        if rng.random() < 0.12:
            props.vessel(stage, at, size)
        else:
            props.solid(stage, at, size, stage.any_material() if rng.random() < 0.25 else _vivid(stage, 0.5))
    if rng.random() < 0.15:
        _rods(stage, int(rng.integers(10, 60)))

    def camera(draw: np.random.Generator) -> Camera:
        angle, radius = draw.uniform(0, 6.28), draw.uniform(1.5, 0.9 * min(extent, 5))
        origin = np.array([radius * np.cos(angle), draw.uniform(0.3, 0.8 * h), radius * np.sin(angle)])
        target = np.array([draw.normal() * 0.8, draw.uniform(0, 0.9), draw.normal() * 0.8])
        return Camera.look_at(origin, target, draw.uniform(30, 65), draw.normal() * ROLL)

    stage.camera = camera


def _coarse(rng: np.random.Generator) -> float:
    """Repeats of a texture per metre: patterns of 0.1 m to several metres."""
    return float(np.exp(rng.uniform(np.log(0.08), np.log(0.8))))


def _vivid(stage: Stage, shiny: float) -> int:
    """Matte, or with probability `shiny` any opaque material, in a tint that is saturated more often than not."""
    rng = stage.rng
    if rng.random() < shiny:
        return stage.bold_material()
    hue = rng.uniform(0.05, 1, 3)
    tint = 1 + (hue / hue.max() - 1) * rng.uniform() ** 0.5
    texture = stage.textured(str(rng.choice(["plain", "plain", "checker", "brick", "marble", "stripes", "dots",
                                             "terrazzo", "poster", "gradient", "wood"])))
    return stage.material("matte", texture=np.clip(texture * tint, 0.02, 0.95).astype(np.float32))


def _rods(stage: Stage, count: int) -> None:
    """Thin rods that stand and lean, all of one material."""
    rng = stage.rng
    slot = _vivid(stage, 0.3)
    for _ in range(count):
        foot = np.array([rng.uniform(-3, 3), 0, rng.uniform(-3, 3)])
        top = foot + UP * rng.uniform(1, 4) + rng.normal(size=3) * 0.5
        stage.add(g.tube(np.linspace(foot, top, 2), rng.uniform(0.01, 0.08), 8), slot, movable=True)


LAYOUTS: dict[str, tuple[float, Callable[[Stage], None]]] = {
    "interior": (0.52, interior),
    "outdoor": (0.22, outdoor),
    "tabletop": (0.17, tabletop),
    "floating": (0.09, floating),
    "abstract": (0.0, abstract),
    "bright": (0.0, bright),
}
"""Name -> share of the scenes, function. What came later has none, so that every seed keeps its scene."""
