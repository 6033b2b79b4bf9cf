"""A procedural Stage loaded into Mitsuba so that a new stage compiles nothing.

Dr.Jit caches kernels by their text. So every stage has the same slots (one mesh, one BSDF and, for lights, one
emitter each), meshes and bitmaps of one kind, one environment map, and every number is opaque to the compiler.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from pipelines.rendering.backend import load_mitsuba
from pipelines.rendering.camera import Camera
from pipelines.rendering.environment import uniform
from pipelines.rendering.geometry import Mesh, merge, mesh_from
from pipelines.rendering.materials import SLOT_KINDS, Material, bsdf_dict, surface_look
from pipelines.rendering.stage import Placed, Stage
from pipelines.rendering.tracer import Motion, MovingMesh, SceneTracer, Vector

Array = npt.NDArray[np.float32]


class StageTracer(SceneTracer):
    """Path samples of a Stage."""

    def __init__(self, stage: Stage, threads: int = 0) -> None:
        mi = load_mitsuba(threads)
        if stage.camera is None:
            raise ValueError("a stage needs a camera")
        self.stage, self._camera = stage, stage.camera
        materials = [stage.materials.get(i, Material(kind)) for i, kind in enumerate(SLOT_KINDS)]
        members = _by_slot(stage)
        self._meshes = [merge([p.mesh for p in placed]) if placed else _unseen(stage) for placed in members]
        scene = mi.load_dict(_environment(mi, stage) | {
            _name(i): _shape(mi, _name(i), mesh, material)
            for i, (mesh, material) in enumerate(zip(self._meshes, materials, strict=True))}, optimize=False)
        _hide_numbers(mi, scene)
        # Slots that no object uses cannot be hit, so their cut-outs need no walk.
        looks = {_name(i): surface_look(material, bool(members[i])) for i, material in enumerate(materials)}
        # Mitsuba keeps its own order of shapes.
        self._shape_of = {shape.id(): k for k, shape in enumerate(scene.shapes())}
        super().__init__(scene, [looks[name] for name in self._shape_of], threads)

    def draw_camera(self, rng: np.random.Generator) -> Camera:
        return self._camera(rng)

    def movable(self) -> dict[int, Vector]:
        return {index: thing.mesh.vertices.mean(0).astype(np.float64)
                for index, thing in enumerate(self.stage.placed) if thing.movable}

    def describe(self) -> dict[str, Any]:
        return {"kind": self.stage.kind, "tags": self.stage.tags, "objects": len(self.stage.placed),
                "triangles": sum(len(mesh.faces) for mesh in self._meshes)}

    def set_motions(self, motions: dict[int, Motion]) -> None:
        self.stage.set_motions(motions)
        self.set_moving([
            MovingMesh(_name(i), self._shape_of[_name(i)], self._meshes[i].faces, partial(_vertices_at, placed))
            for i, placed in enumerate(_by_slot(self.stage)) if any(p.motion for p in placed)])


def _name(slot: int) -> str:
    return f"slot{slot:02d}"


def _by_slot(stage: Stage) -> list[list[Placed]]:
    members: list[list[Placed]] = [[] for _ in SLOT_KINDS]
    for placed in stage.placed:
        members[placed.slot].append(placed)
    return members


def _vertices_at(members: list[Placed], time: float) -> Array:
    return np.concatenate([p.motion.at(p.mesh.vertices, time) if p.motion else p.mesh.vertices for p in members])


def _unseen(stage: Stage) -> Mesh:
    """A mesh for an unused slot: a hundredth of a millimetre, under everything."""
    low = min((float(p.mesh.vertices[:, 1].min()) for p in stage.placed), default=0.0)
    corners = np.array([[0, 0, 0], [1e-5, 0, 0], [0, 0, 1e-5]]) + np.array([0, low - 1e-3, 0])
    return mesh_from(corners, [[0, 1, 2]], [[0, 0], [1, 0], [0, 1]])


def _environment(mi: Any, stage: Stage) -> dict[str, Any]:
    image = uniform(np.random.default_rng(0), 0.0) if stage.environment is None else stage.environment
    return {"type": "scene", "environment": {
        "type": "envmap", "bitmap": mi.Bitmap(np.ascontiguousarray(image)),
        "sampling_weight": 1.0 if image.max() > 0 else 0.0}}


def _shape(mi: Any, name: str, mesh: Mesh, material: Material) -> Any:
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(bsdf_dict(mi, material), optimize=False)
    if material.kind == "light":
        props["emitter"] = mi.load_dict({
            "type": "area", "radiance": {"type": "rgb", "value": list(material.emission)},
            "sampling_weight": 1.0 if max(material.emission) > 0 else 0.0}, optimize=False)
    shape = mi.Mesh(name, len(mesh.vertices), len(mesh.faces), props, has_vertex_normals=True,
                    has_vertex_texcoords=True)
    shape.add_attribute("vertex_color", 3, mesh.color.ravel())
    params = mi.traverse(shape)
    params["vertex_positions"] = mi.Float(mesh.vertices.ravel())
    params["vertex_texcoords"] = mi.Float(mesh.uv.ravel())
    params["faces"] = mi.UInt32(mesh.faces.ravel())
    params.update()
    return shape


def _hide_numbers(mi: Any, scene: Any) -> None:
    """Make every scalar and colour of the scene opaque, so that its value is data and not code."""
    import drjit

    params = mi.traverse(scene)
    names = list(params.keys())
    for name in names:
        value = params[name]
        if isinstance(value, (mi.Float, mi.Color3f)) and drjit.width(value) == 1:
            drjit.make_opaque(value)
            params[name] = value
    params.update()
