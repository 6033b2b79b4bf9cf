"""Random views of a scene: which camera shows most, where it focuses, what moves how far over the shutter."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from pipelines.rendering.camera import Camera
from pipelines.rendering.tracer import Motion, SceneTracer, Vector

CANDIDATES = 6
SURVEY = 48  # pixels, square
LEAST_COVER = 0.15  # of the picture shows surfaces
NEAR = 0.06  # of the median depth: nearer things stand before the lens

COC_RANGE = 2.0, 16.0  # pixels, the 95th percentile of |coc| over the picture
CAMERA_MOTION_RANGE = 2.0, 30.0  # pixels over the shutter, in the middle of the scene
OBJECT_MOTION_RANGE = 2.0, 40.0
MOVED = 1, 7  # how many objects move, at least and below


@dataclass(frozen=True)
class View:
    """A camera with its lens and motion, and the depths (K,) of what it sees."""

    camera: Camera
    depths: npt.NDArray[np.float32]
    defocus: bool = False
    camera_motion: bool = False
    object_motion: bool = False


def log_uniform(rng: np.random.Generator, bounds: tuple[float, float]) -> float:
    """A number between two positive bounds, every factor equally likely."""
    return float(np.exp(rng.uniform(*np.log(bounds))))


def choose_view(tracer: SceneTracer, rng: np.random.Generator, size: int) -> View:
    """The most telling of several random cameras: many surfaces, depths well spread, nothing before the lens.

    When none of them is fit, the last one drawn.
    """
    best, best_score = View(Camera.look_at([0, 0, 1], [0, 0, 0], 45.0), np.ones(1, np.float32)), -np.inf
    for _ in range(CANDIDATES):
        camera = tracer.draw_camera(rng)
        depth, shape = tracer.survey(camera.resized(SURVEY))
        hit = (shape >= 0) & (depth > 0)
        if best_score == -np.inf:
            best = View(camera.resized(size), depth[hit] if hit.any() else np.ones(1, np.float32))
        if hit.mean() < LEAST_COVER:
            continue
        closest, near, middle, high = np.quantile(depth[hit], [0.02, 0.1, 0.5, 0.9])
        if closest < NEAR * middle:
            continue
        share = np.bincount(shape[hit].astype(int)) / hit.sum()
        share = share[share > 0]
        score = float(-(share * np.log(share)).sum()) + 0.5 * min(float(np.log(high / near)), 1.5)
        if score > best_score:
            best, best_score = View(camera.resized(size), depth[hit]), score
    return best


def add_defocus(view: View, rng: np.random.Generator) -> View:
    """Focus on a random visible depth, with a lens wide enough for circles of confusion in COC_RANGE."""
    focus = float(np.quantile(view.depths, rng.uniform(0.05, 0.9)))
    widest = float(np.quantile(np.abs(view.depths - focus) / view.depths, 0.95))  # if infinity blurs by one pixel
    at_infinity = log_uniform(rng, COC_RANGE) / max(widest, 0.02)
    return replace(view, camera=view.camera.with_lens(at_infinity, focus), defocus=True)


def add_camera_motion(view: View, rng: np.random.Generator) -> View:
    """Move and turn the camera so that what is at middling depth moves by CAMERA_MOTION_RANGE, roll apart."""
    camera, depth = view.camera, float(np.median(view.depths))
    pixels = log_uniform(rng, CAMERA_MOTION_RANGE)
    angle, share = rng.uniform(0, 2 * np.pi), rng.uniform()
    along = np.cos(angle) * camera.right + np.sin(angle) * camera.up
    metres = pixels * depth / camera.focal
    shift = along * share * metres + camera.forward * rng.normal() * 0.1 * metres
    # Toward `along` as well: the picture moves the same way by both, or they would cancel.
    turn = np.cross(camera.forward, along) * (1 - share) * pixels / camera.focal
    turn = turn + camera.forward * rng.normal() * pixels / camera.size
    return replace(view, camera=replace(camera, shift=shift, turn=turn), camera_motion=True)


def draw_object_motions(view: View, centres: dict[int, Vector], rng: np.random.Generator) -> dict[int, Motion]:
    """Motions of OBJECT_MOTION_RANGE for a few of the objects in view, by their number; none where none is in view."""
    camera = view.camera
    far = float(np.quantile(view.depths, 0.95))
    visible: list[tuple[int, Vector, float]] = []
    for number, centre in centres.items():
        v = centre - camera.origin
        depth = float(v @ camera.forward)
        aside = max(abs(float(v @ camera.right)), abs(float(v @ camera.up)))
        if 0 < depth < far and aside * camera.focal < 0.5 * camera.size * depth:
            visible.append((number, centre, depth))
    motions = {}
    for k in rng.permutation(len(visible))[:int(rng.integers(*MOVED))]:
        number, centre, depth = visible[k]
        direction = rng.normal(size=3)
        direction /= np.linalg.norm(direction)
        turn = rng.normal(size=3) * (rng.uniform(0, 0.5) if rng.random() < 0.6 else 0.0)
        metres = log_uniform(rng, OBJECT_MOTION_RANGE) * depth / camera.focal
        motions[number] = Motion(direction * metres, turn, centre)
    return motions
