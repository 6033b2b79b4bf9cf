"""Any Mitsuba scene file as a source of examples: random cameras near its own or inside its box, random motion.

The light transport is the path tracer's: surfaces, environment and area lights; media are not traced. Features of
materials are read from their parameters, textures by their mean, except the diffuse albedo, which is exact.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from deep_io.errors import InputError
from pipelines.rendering.backend import load_mitsuba
from pipelines.rendering.camera import ROLL, Camera
from pipelines.rendering.materials import DIELECTRIC_F0
from pipelines.rendering.tracer import Motion, MovingMesh, SceneTracer, SurfaceLook, Vector

NEAR_SENSOR_SHARE = 0.6  # of the views start from the file's own camera
LARGEST_MOVABLE = 0.35  # of the scene's diagonal
INSTANCE = "Instance"  # Mitsuba's name of the class


class FileTracer(SceneTracer):
    """Path samples of a scene file. Loaded once: `close` only puts moved objects back, for the next example."""

    def __init__(self, path: Path, threads: int = 0) -> None:
        """Raises InputError where Mitsuba cannot load the file, or where nothing in it is visible or shines."""
        mi = load_mitsuba(threads)
        self.path = path
        try:
            scene = mi.load_file(str(path), optimize=False)
        except (RuntimeError, ValueError) as error:
            reason = " ".join(str(error).split())
            raise InputError(f"{path}: not a scene that Mitsuba can load: {reason}") from error
        if not scene.shapes() or not scene.emitters():
            missing = "lights" if scene.shapes() else "shapes"
            raise InputError(f"{path}: has no {missing}; add some to render it")
        for index, shape in enumerate(scene.shapes()):
            if shape.class_name() == INSTANCE:
                # Rays hit the shapes of its group, whose materials are not among those of the scene's own shapes.
                raise InputError(f"{path}: has instances of shape groups, which cannot be rendered; make them meshes")
            if not shape.id():
                # Shapes are moved by name, and few files name theirs.
                shape.set_id(f"shape {index} of lbmc")
        super().__init__(scene, [surface_look(mi, shape.bsdf()) for shape in scene.shapes()], threads)
        box = scene.bbox()
        self._low, self._high = (np.array(corner, np.float64).ravel() for corner in (box.min, box.max))
        self._read_sensor()
        self._rest = self._movable_meshes()
        # Normals that the file gives are lost when a mesh moves: Mitsuba works them out anew.
        names = (f"{name}.vertex_normals" for name, _, _ in self._rest.values())
        self._rest_normals = {name: self.mi.Float(self.params[name]) for name in names if name in self.params}

    def _read_sensor(self) -> None:
        mi, sensor = self.mi, self.scene.sensors()[0]
        pose = sensor.world_transform()

        def world(value: Any) -> Vector:
            return np.array(pose @ value, np.float64).ravel()

        self._origin, self._forward = world(mi.Point3f(0, 0, 0)), world(mi.Vector3f(0, 0, 1))
        up = world(mi.Vector3f(0, 1, 0))
        axis = int(np.argmax(np.abs(up)))
        self._up = np.eye(3)[axis] * np.sign(up[axis])
        fov = dict(mi.traverse(sensor)).get("x_fov", 45.0)
        self._fov = float(np.clip(np.array(fov).ravel()[0], 10.0, 100.0))

    def _movable_meshes(self) -> dict[int, tuple[str, npt.NDArray[np.uint32], npt.NDArray[np.float32]]]:
        diagonal = float(np.linalg.norm(self._high - self._low))
        found = {}
        for index, shape in enumerate(self.scene.shapes()):
            if not shape.is_mesh() or shape.is_emitter() or f"{shape.id()}.vertex_positions" not in self.params:
                continue
            vertices = np.array(self.params[f"{shape.id()}.vertex_positions"], np.float32).reshape(-1, 3)
            if np.linalg.norm(np.ptp(vertices, axis=0)) < LARGEST_MOVABLE * diagonal:
                faces = np.array(self.params[f"{shape.id()}.faces"], np.uint32).reshape(-1, 3)
                found[index] = shape.id(), faces, vertices
        return found

    def draw_camera(self, rng: np.random.Generator) -> Camera:
        size = self._high - self._low
        roll = float(rng.normal()) * ROLL
        if rng.random() < NEAR_SENSOR_SHARE:
            distance = max(float(np.linalg.norm((self._low + self._high) / 2 - self._origin)), 1e-3)
            origin = self._origin + rng.normal(size=3) * 0.08 * distance
            target = self._origin + self._forward * distance + rng.normal(size=3) * 0.15 * distance
            return Camera.look_at(origin, target, self._fov * rng.uniform(0.5, 1.2), roll, self._up)
        origin, target = (self._low + size * rng.uniform(0.1, 0.9, 3) for _ in range(2))
        return Camera.look_at(origin, target, rng.uniform(25, 80), roll, self._up)

    def movable(self) -> dict[int, Vector]:
        return {index: vertices.mean(0).astype(np.float64) for index, (_, _, vertices) in self._rest.items()}

    def set_motions(self, motions: dict[int, Motion]) -> None:
        self.set_moving([MovingMesh(self._rest[index][0], index, self._rest[index][1],
                                    partial(motion.at, self._rest[index][2])) for index, motion in motions.items()])

    def describe(self) -> dict[str, Any]:
        return {"kind": "file", "tags": [self.path.name], "objects": len(self.scene.shapes())}

    def close(self) -> None:
        self._move_to(0.5)
        for mesh in self._moving:
            name = f"{mesh.name}.vertex_normals"
            if name in self._rest_normals:
                self.params[name] = self.mi.Float(self._rest_normals[name])
        self.params.update()
        self.set_moving([])


def surface_look(mi: Any, bsdf: Any) -> SurfaceLook:
    """The first-hit features of a BSDF of any kind, from its flags and the names of its parameters."""
    values = {name: np.array(value, np.float64) for name, value in dict(mi.traverse(bsdf)).items()
              if name.rsplit(".", 1)[-1] not in ("to_uv", "resolution")}

    def mean(*names: str) -> npt.NDArray[np.float64] | None:
        """The mean colour (3,) of the first parameter whose path holds one of these names."""
        for path, value in values.items():
            if any(part in names for part in path.split(".")):
                flat = value.reshape(-1, value.shape[-1] if value.ndim == 3 else max(value.size, 1))
                color = flat.mean(0)
                return np.asarray(color[:3] if color.size >= 3 else np.repeat(color.mean(), 3))
        return None

    flags = mi.BSDFFlags
    diffuse = mi.has_flag(bsdf.flags(), flags.DiffuseReflection) or mi.has_flag(
        bsdf.flags(), flags.DiffuseTransmission)
    smooth = mi.has_flag(bsdf.flags(), flags.DeltaReflection) or mi.has_flag(bsdf.flags(), flags.DeltaTransmission)
    glossy = smooth or mi.has_flag(bsdf.flags(), flags.GlossyReflection)
    alpha, rough, metallic = mean("alpha", "alpha_u"), mean("roughness"), mean("metallic")
    roughness = float(rough[0]) if rough is not None else float(alpha[0]) ** 0.5 if alpha is not None else (
        0.0 if smooth else 1.0)
    metal = float(np.clip(metallic[0], 0, 1)) if metallic is not None else 0.0
    eta, k = mean("eta"), mean("k")
    specular = np.full(3, DIELECTRIC_F0 if glossy else 0.0)
    if eta is not None and glossy:
        squared = np.zeros(3) if k is None else k**2
        specular = ((eta - 1) ** 2 + squared) / ((eta + 1) ** 2 + squared)
    if k is not None:
        tint = mean("specular_reflectance")
        specular = specular * (1.0 if tint is None else tint)
    r, g, b = (float(x) for x in np.clip(specular * (1 - metal), 0, 1))
    return SurfaceLook(albedo_gain=1 - metal, specular=(r, g, b), specular_by_base=metal,
                       roughness=float(np.clip(roughness, 0, 1)), diffuse=bool(diffuse),
                       cutout=bool(mi.has_flag(bsdf.flags(), flags.Null)))
