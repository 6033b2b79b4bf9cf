"""From a loaded Mitsuba scene and a Camera to path samples.

Rays, lens and motion are our own, so the sample features agree with the picture by construction. Where scenes come
from (procedural stages, files) lives in stage_scene.py and file_scene.py.
"""

from __future__ import annotations

import gc
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from pipelines.rendering.backend import load_mitsuba
from pipelines.rendering.camera import Camera, CameraRig
from pipelines.rendering.geometry import rotation
from pipelines.rendering.patterns import Pattern

Array = npt.NDArray[np.float32]
Vector = npt.NDArray[np.float64]

MAX_DEPTH = 5  # segments, so four bounces: a sixth cheaper than six, and hardly darker
NO_ROULETTE = 1000
# Transparent surfaces that a camera ray may cross; the next one counts as hit. The path itself reaches no further.
CUTOUT_STEPS = MAX_DEPTH - 1
MISS_DEPTH = 1e10
MOTION_LIMIT = 512.0  # pixels; points that cross the camera plane project to infinity
# Paths per launch: enough to fill many cores, about 1 GB; 32 samples of 192 x 192 pixels fit.
LAUNCH = 1_200_000
MULTIJITTER = 16  # that sampler's strata need a square number
SEEDS = 2**31
EMISSION = ("emission.R", "emission.G", "emission.B")


@dataclass(frozen=True)
class SurfaceLook:
    """What the first-hit features say of a shape's material.

    albedo = diffuse reflectance * `albedo_gain`; specular = `specular` + `specular_by_base` * diffuse reflectance.
    `diffuse`: whether the BSDF reports a diffuse reflectance; `cutout`: whether camera rays may pass through.
    """

    albedo_gain: float = 1.0
    specular: tuple[float, float, float] = (0.0, 0.0, 0.0)
    specular_by_base: float = 0.0
    roughness: float = 1.0
    diffuse: bool = True
    cutout: bool = False

    def row(self) -> list[float]:
        """The numbers in the order in which the tracer's tables hold them."""
        return [self.albedo_gain, *self.specular, self.specular_by_base, self.roughness, float(self.diffuse),
                float(self.cutout)]


@dataclass(frozen=True)
class Motion:
    """Rigid motion over the shutter about the pose at time 0.5: `shift` metres, `turn` axis * radians about `pivot`."""

    shift: Vector
    turn: Vector
    pivot: Vector

    def at(self, vertices: Array, time: float) -> Array:
        """`vertices` (V,3) as they stand at `time` in 0..1."""
        s = time - 0.5
        matrix = rotation(self.turn, float(np.linalg.norm(self.turn)) * s)
        return np.asarray((vertices - self.pivot) @ matrix.T + self.pivot + s * self.shift, np.float32)


@dataclass(frozen=True)
class MovingMesh:
    """A mesh that moves over the shutter: its name in the scene, index among the shapes, faces (F,3), vertices at t."""

    name: str
    shape: int
    faces: npt.NDArray[np.uint32]
    vertices_at: Callable[[float], Array]


class SceneTracer(ABC):
    """Path samples of one Mitsuba scene. `close` frees it before the next one is loaded.

    Subclasses know where the scene came from: what a good view of it is, what in it may move, and what it is called.
    """

    @abstractmethod
    def draw_camera(self, rng: np.random.Generator) -> Camera:
        """A random plausible pinhole view."""

    @abstractmethod
    def movable(self) -> dict[int, Vector]:
        """The centres (3,) of the objects that may move, by a number of the subclass's own."""

    @abstractmethod
    def set_motions(self, motions: dict[int, Motion]) -> None:
        """Let these objects, by the numbers of `movable`, move over the shutter, and no others."""

    @abstractmethod
    def describe(self) -> dict[str, Any]:
        """What is in the scene, for its JSON."""

    def __init__(self, scene: Any, looks: list[SurfaceLook], threads: int = 0) -> None:
        """`looks` has one entry per shape of `scene.shapes()`, in that order."""
        self.mi = load_mitsuba(threads)
        import drjit

        self.dr = drjit
        self.scene = scene
        self.params = self.mi.traverse(scene)
        self.integrator = self._integrator(MAX_DEPTH)
        self._seen_emission = self._integrator(1)
        # Shapes are told apart by the number Dr.Jit gives them, which need not start at 0.
        numbers = np.array(drjit.reinterpret_array(self.mi.UInt32, self.mi.ShapePtr(scene.shapes())))
        table = np.zeros((int(numbers.max()) + 1, len(SurfaceLook().row()) + 1), np.float32)
        for index, (number, look) in enumerate(zip(numbers, looks, strict=True)):
            table[number] = [*look.row(), index]
        self._numbers = numbers
        self._table = [self.mi.Float(np.ascontiguousarray(column)) for column in table.T]
        self._has_cutouts = any(look.cutout for look in looks)
        self._moving: list[MovingMesh] = []
        self.set_moving([])

    def _integrator(self, depth: int) -> Any:
        return self.mi.load_dict({"type": "path", "max_depth": depth, "rr_depth": NO_ROULETTE})

    @property
    def moving(self) -> bool:
        """Whether objects move, so that samples must share few times: each rebuilds the scene."""
        return bool(self._moving)

    def set_moving(self, meshes: list[MovingMesh]) -> None:
        """Let these meshes move over the shutter, and no others."""
        self._moving = meshes
        mi = self.mi
        # First face of each moving shape, and both ends of the shutter for the motion vectors; one idle triangle
        # keeps the arrays of a still scene from being empty.
        starts = np.full(int(self._numbers.max()) + 1, -1, np.int32)
        faces, ends = [np.zeros((1, 3), np.uint32)], ([np.zeros((1, 3), np.float32)], [np.zeros((1, 3), np.float32)])
        for mesh in meshes:
            starts[self._numbers[mesh.shape]] = sum(len(f) for f in faces)
            faces.append(mesh.faces + np.uint32(sum(len(v) for v in ends[0])))
            for end, time in zip(ends, (0.0, 1.0), strict=True):
                end.append(mesh.vertices_at(time))
        self._face_start = mi.Int32(starts)
        self._faces = mi.UInt32(np.concatenate(faces).ravel())
        self._shutter_ends = [mi.Float(np.concatenate(end).ravel()) for end in ends]

    def _move_to(self, time: float) -> None:
        """Put every moving mesh where it is at `time` and rebuild the acceleration structure."""
        for mesh in self._moving:
            self.params[f"{mesh.name}.vertex_positions"] = self.mi.Float(mesh.vertices_at(time).ravel())
        self.params.update()

    def survey(self, camera: Camera) -> tuple[Array, Array]:
        """Planar depth and shape index (-1 on a miss) at the pixel centres of a pinhole picture; no light transport."""
        pixel = np.arange(camera.size**2)
        middle = np.zeros(len(pixel), np.float32)
        rig = CameraRig(self.mi, self.dr, camera)
        time = self.mi.Float(middle + 0.5)
        ray = rig.ray(self.mi.Float((pixel % camera.size).astype(np.float32) + 0.5),
                      self.mi.Float((pixel // camera.size).astype(np.float32) + 0.5),
                      self.mi.Float(middle), self.mi.Float(middle), time)
        self.dr.eval(ray)
        hit = self._first_hit(rig, ray, time)
        self.dr.eval(hit["Z"], hit["shape"])
        return np.array(hit["Z"]), np.array(hit["shape"])

    def trace(self, camera: Camera, pattern: Pattern, seed: int, multijitter: bool = False,
              features: Literal["all", "coverage"] = "all") -> dict[str, Array]:
        """The pattern's N = P * S paths, pixel-major: canonical channel name -> (N,), P = camera.size ** 2.

        `features` "coverage" gives R, G, B, EMISSION and A only. EMISSION is the part of R, G, B that
        the surface or sky in view emits itself. When objects move, every different time of the pattern rebuilds
        the scene. `multijitter` stratifies the paths' own numbers too, where nothing moves.
        """
        pixels, samples = pattern.time.shape
        rig = CameraRig(self.mi, self.dr, camera)
        out: dict[str, Array] = {}
        for number, (index, time) in enumerate(self._launches(pattern, multijitter)):
            if time is not None:
                self._move_to(time)
            jittered = multijitter and time is None and len(index) == MULTIJITTER * pixels
            sampler = self._sampler(len(index), (seed * 1009 + number) % SEEDS, jittered)
            part = self._launch(rig, pattern, index, camera.size, sampler, features)
            for name, values in part.items():
                out.setdefault(name, np.empty(pixels * samples, np.float32))[index] = values
        return out

    def _launches(self, pattern: Pattern, multijitter: bool) -> Iterator[tuple[npt.NDArray[np.int64], float | None]]:
        """Flat sample indices of each launch, with the time they share when objects move."""
        pixels, samples = pattern.time.shape
        if self.moving:
            times = pattern.time.ravel()
            for time in np.unique(times):
                index = np.nonzero(times == time)[0]
                for start in range(0, len(index), LAUNCH):
                    yield index[start:start + LAUNCH], float(time)
            return
        step = min(max(1, LAUNCH // pixels), MULTIJITTER if multijitter else samples)
        flat = np.arange(pixels * samples).reshape(pixels, samples)
        for start in range(0, samples, step):
            yield flat[:, start:start + step].ravel(), None

    def _sampler(self, paths: int, seed: int, jittered: bool) -> Any:
        if jittered:
            sampler = self.mi.load_dict({"type": "multijitter", "sample_count": MULTIJITTER})
            sampler.set_samples_per_wavefront(MULTIJITTER)
        else:
            sampler = self.mi.load_dict({"type": "independent"})
        sampler.seed(seed, paths)
        return sampler

    def _launch(self, rig: CameraRig, pattern: Pattern, index: npt.NDArray[np.int64], size: int, sampler: Any,
                features: str) -> dict[str, Array]:
        mi, dr = self.mi, self.dr
        pixel = index // pattern.time.shape[1]
        px = (pixel % size).astype(np.float32) + pattern.jitter_x.ravel()[index]
        py = (pixel // size).astype(np.float32) + pattern.jitter_y.ravel()[index]
        lens_x, lens_y, time = (a.ravel()[index] for a in (pattern.lens_x, pattern.lens_y, pattern.time))
        ray = rig.ray(mi.Float(px), mi.Float(py), mi.Float(lens_x), mi.Float(lens_y), mi.Float(time))
        dr.eval(ray)
        radiance, _, _ = self.integrator.sample(self.scene, sampler, mi.RayDifferential3f(ray))
        dr.eval(radiance)  # else the path is traced once per channel
        emission, _, _ = self._seen_emission.sample(self.scene, sampler, mi.RayDifferential3f(ray))
        dr.eval(emission)
        out = {name: np.array(values) for name, values in zip(("R", "G", "B", *EMISSION), (*radiance, *emission),
                                                              strict=True)}
        if features == "coverage" and not self._has_cutouts:
            return out | {"A": np.array(self.scene.ray_test(ray), dtype=np.float32)}
        hit = self._first_hit(rig, ray, mi.Float(time))
        if features == "coverage":
            return out | {"A": np.array(hit["A"])}
        dr.eval(hit)
        out |= {name: np.array(values, dtype=np.float32) for name, values in hit.items() if name != "shape"}
        return out | {"lens.X": lens_x, "lens.Y": lens_y, "time": time}

    def _first_surface(self, ray: Any) -> tuple[Any, Any]:
        """The first intersection that a camera ray does not pass through: preliminary and full."""
        mi, dr = self.mi, self.dr
        ray = mi.Ray3f(ray)
        pi = self.scene.ray_intersect_preliminary(ray, coherent=True)
        si = pi.compute_surface_interaction(ray)
        for _ in range(CUTOUT_STEPS if self._has_cutouts else 0):
            number = dr.reinterpret_array(mi.UInt32, si.shape)
            through = si.is_valid() & (dr.gather(mi.Float, self._table[7], number, si.is_valid()) > 0)
            through &= dr.mean(si.bsdf().eval_null_transmission(si, through)) > 0.5
            ray.o = dr.select(through, si.spawn_ray(ray.d).o, ray.o)
            pi = dr.select(through, self.scene.ray_intersect_preliminary(ray, active=through), pi)
            si = pi.compute_surface_interaction(ray)
        return pi, si

    def _first_hit(self, rig: CameraRig, ray: Any, time: Any) -> dict[str, Any]:
        """The features of the first hit, canonical names, and `shape`, the index of the shape hit or -1."""
        mi, dr = self.mi, self.dr
        pi, si = self._first_surface(ray)
        valid = si.is_valid()
        number = dr.reinterpret_array(mi.UInt32, si.shape)
        gain, f0r, f0g, f0b, by_base, roughness, diffuse, _, shape = (
            dr.gather(mi.Float, column, number, valid) for column in self._table)
        base = si.bsdf().eval_diffuse_reflectance(si, valid & (diffuse > 0))
        base = dr.select(valid & (diffuse > 0) & dr.isfinite(base), dr.clip(base, 0, 1), 0)
        normal = si.sh_frame.n
        normal = rig.to_view(dr.select(dr.dot(normal, ray.d) > 0, -normal, normal), time)
        z = rig.project(si.p, time)[2]
        motion_x, motion_y = self._motion(rig, pi, si.p, number, valid)
        found = {
            "A": mi.Float(1), "N.X": normal.x, "N.Y": normal.y, "N.Z": normal.z,
            "albedo.R": base.x * gain, "albedo.G": base.y * gain, "albedo.B": base.z * gain,
            "specular.R": f0r + by_base * base.x, "specular.G": f0g + by_base * base.y,
            "specular.B": f0b + by_base * base.z, "roughness": roughness, "motion.X": motion_x, "motion.Y": motion_y,
            "coc": rig.coc(dr.maximum(z, 1e-4)),
        }
        return {name: dr.select(valid, value, 0) for name, value in found.items()} | {
            "Z": dr.select(valid, z, MISS_DEPTH), "shape": dr.select(valid, shape, -1)}

    def _motion(self, rig: CameraRig, pi: Any, point: Any, number: Any, valid: Any) -> tuple[Any, Any]:
        """Screen motion of the hit points over the whole shutter, pixels."""
        mi, dr = self.mi, self.dr
        start = dr.gather(mi.Int32, self._face_start, number, valid)
        moves = valid & (start >= 0)
        face = mi.UInt32(dr.maximum(start, 0)) + pi.prim_index
        corners = [dr.gather(mi.UInt32, self._faces, face * 3 + k, moves) for k in range(3)]
        b1, b2 = pi.prim_uv.x, pi.prim_uv.y
        ends = []
        for vertices, time in zip(self._shutter_ends, (0.0, 1.0), strict=True):
            p0, p1, p2 = (dr.gather(mi.Point3f, vertices, corner, moves) for corner in corners)
            there = dr.select(moves, p0 * (1 - b1 - b2) + p1 * b1 + p2 * b2, point)
            ends.append(rig.project(there, dr.opaque(mi.Float, time)))
        return (dr.clip(ends[1][0] - ends[0][0], -MOTION_LIMIT, MOTION_LIMIT),
                dr.clip(ends[1][1] - ends[0][1], -MOTION_LIMIT, MOTION_LIMIT))

    def close(self) -> None:
        """Free the scene; two of them at once would change the compiled kernels and double the memory."""
        del self.scene, self.params, self.integrator, self._table, self._faces, self._face_start, self._shutter_ends
        gc.collect()
