"""A scene under construction: placed meshes with materials and motions, an environment, and camera suggestions.

Layouts (interiors, outdoors, tabletops) fill a Stage; the tracer turns it into a Mitsuba scene.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from pipelines.rendering import textures
from pipelines.rendering.camera import Camera
from pipelines.rendering.geometry import Mesh, rotation
from pipelines.rendering.materials import SLOT_KINDS, Material
from pipelines.rendering.tracer import Motion

Vector = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Placed:
    """One object: a mesh in world space, its material slot, its motion if it may move."""

    mesh: Mesh
    slot: int
    motion: Motion | None = None
    movable: bool = False


@dataclass
class Stage:
    """Collects a scene. `camera` draws a plausible view of it."""

    rng: np.random.Generator
    kind: str = ""
    placed: list[Placed] = field(default_factory=list)
    materials: dict[int, Material] = field(default_factory=dict)
    environment: npt.NDArray[np.float32] | None = None
    camera: Callable[[np.random.Generator], Camera] | None = None
    tags: list[str] = field(default_factory=list)

    def material(self, kind: str, **values: Any) -> int:
        """The slot of a new material of `kind`, or of a random existing one when the kind's slots are all taken."""
        slots = [i for i, k in enumerate(SLOT_KINDS) if k == kind]
        free = [i for i in slots if i not in self.materials]
        if not free:
            return int(self.rng.choice(slots))
        self.materials[free[0]] = Material(kind, **values)
        return free[0]

    def textured(self, name: str | None = None) -> npt.NDArray[np.float32]:
        """A random (or the named) texture from this stage's generator."""
        return textures.make_texture(self.rng, name)

    def surface_material(self, shiny: float = 0.5, texture: str | None = None) -> int:
        """A random opaque material: glossy with probability `shiny`, else matte."""
        rng = self.rng
        alpha = float(np.exp(rng.uniform(np.log(0.02), np.log(0.4))))
        if rng.random() > shiny:
            if rng.random() < 0.35 and texture is None:
                return self.material("colored")
            return self.material("matte", texture=self.textured(texture))
        kind = str(rng.choice(["plastic", "roughplastic", "metal", "mirror", "principled"],
                              p=[0.2, 0.27, 0.2, 0.05, 0.28]))
        if texture is not None and kind in ("metal", "mirror"):
            kind = "roughplastic"
        if kind in ("metal", "mirror"):
            tint = rng.choice(np.array([[0.95, 0.93, 0.88], [1.0, 0.78, 0.34], [0.95, 0.64, 0.54], [0.56, 0.57, 0.58],
                                        [0.91, 0.92, 0.92]]))
            return self.material(kind, alpha=alpha, tint=tuple(float(x) for x in tint))
        return self.material(kind, texture=self.textured(texture), alpha=alpha,
                             metallic=float(rng.choice([0.0, 0.0, 1.0, rng.uniform()])),
                             clearcoat=float(rng.choice([0.0, 1.0])))

    def any_material(self) -> int:
        """A random material for clutter: opaque mostly, glass and translucent sometimes."""
        u = self.rng.random()
        if u < 0.10:
            return self.glass()
        if u < 0.14:
            return self.material("frosted", alpha=float(self.rng.uniform(0.05, 0.4)))
        if u < 0.20:
            return self.material("translucent", texture=self.textured())
        return self.surface_material()

    def bold_material(self) -> int:
        """An opaque material: matte, metal and principled each twice as likely as the others; metals in any colour."""
        rng = self.rng
        kind = str(rng.choice(["matte", "matte", "colored", "plastic", "roughplastic", "metal", "metal", "mirror",
                               "principled", "principled"]))
        if kind == "colored":
            return self.material(kind)
        alpha = float(np.exp(rng.uniform(np.log(0.01), np.log(0.6))))
        if kind in ("metal", "mirror"):
            return self.material(kind, alpha=alpha, tint=tuple(float(x) for x in textures.random_color(rng, 0.3, 0.95)))
        return self.material(kind, texture=self.textured(), alpha=alpha, metallic=float(rng.integers(2)),
                             clearcoat=float(rng.integers(2)))

    def glass(self) -> int:
        """Clear or lightly tinted smooth glass."""
        tint = (1.0, 1.0, 1.0) if self.rng.random() < 0.6 else tuple(
            float(x) for x in 0.5 + 0.5 * textures.random_color(self.rng, 0.9, 0.95))
        return self.material("glass", tint=tint)

    def light(self, radiance: npt.ArrayLike) -> int:
        """An area light of the given RGB radiance, black otherwise."""
        r, g, b = (float(x) for x in np.asarray(radiance))
        return self.material("light", emission=(r, g, b))

    def warm_or_cool(self, power: float) -> Vector:
        """A lamp colour between candle and daylight with mean `power`."""
        t = self.rng.random()
        color = (1 - t) * np.array([1.0, 0.55, 0.22]) + t * np.array([0.8, 0.95, 1.15])
        return np.asarray(color / color.mean() * power)

    def add(self, mesh: Mesh, slot: int, at: npt.ArrayLike | None = None, turn: float | None = None,
            movable: bool = False) -> None:
        """Place `mesh`, turned about y by `turn` and moved to `at`, with a random colour for vertex-colour slots."""
        if turn is not None:
            mesh = mesh.transformed(rotation([0, 1, 0], turn))
        if at is not None:
            mesh = mesh.transformed(offset=at)
        if SLOT_KINDS[slot] == "colored" and np.ptp(mesh.color) == 0:
            mesh = mesh.with_color(textures.random_color(self.rng, 0.05, 0.85))
        self.placed.append(Placed(mesh, slot, None, movable))

    def set_motions(self, motions: dict[int, Motion]) -> None:
        """Give the objects at these indices of `placed` a motion, and the others none."""
        self.placed = [replace(thing, motion=motions.get(index)) for index, thing in enumerate(self.placed)]
