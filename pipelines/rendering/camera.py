"""The thin-lens camera: its numbers (Camera), and its rays, projection and blur on the device (CameraRig).

Camera space is x right, y up, z forward (planar depth); pixels are x right, y down. Signs follow the deep sample file:
coc is positive behind the focus plane, and pixel = pinhole projection - coc * lens.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

Vector = npt.NDArray[np.float64]
ROLL = 0.08  # radians, one sigma: nobody levels a camera exactly


@dataclass(frozen=True)
class Camera:
    """A square image of `size` pixels. `shift` (m) and `turn` (axis * radians) are its motion over the whole shutter.

    `aperture` is the lens radius in metres, `focus` the planar distance of the focus plane.
    """

    origin: Vector
    right: Vector
    up: Vector
    forward: Vector
    focal: float  # in pixels: size / 2 / tan(fov / 2)
    size: int
    aperture: float = 0.0
    focus: float = 1.0
    shift: Vector = field(default_factory=lambda: np.zeros(3))
    turn: Vector = field(default_factory=lambda: np.zeros(3))

    @classmethod
    def look_at(cls, origin: npt.ArrayLike, target: npt.ArrayLike, fov_degrees: float, roll: float = 0.0,
                world_up: npt.ArrayLike = (0.0, 1.0, 0.0)) -> Camera:
        """A pinhole camera of one pixel at `origin` looking at `target`, turned by `roll` radians about its axis."""
        o = np.asarray(origin, np.float64)
        forward = np.asarray(target, np.float64) - o
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, np.asarray(world_up, np.float64))
        if np.linalg.norm(right) < 1e-3:
            right = np.cross(forward, np.roll(np.asarray(world_up, np.float64), 1))
        right /= np.linalg.norm(right)
        up = np.cross(right, forward)
        right, up = np.cos(roll) * right + np.sin(roll) * up, np.cos(roll) * up - np.sin(roll) * right
        return cls(o, right, up, forward, 0.5 / np.tan(np.radians(fov_degrees) / 2), 1)

    def resized(self, size: int) -> Camera:
        """The same view and lens in `size` x `size` pixels."""
        return replace(self, size=size, focal=self.focal * size / self.size)

    def with_lens(self, coc_at_infinity: float, focus: float) -> Camera:
        """The same view focused at `focus` metres, whose infinitely far points blur to a radius of so many pixels."""
        return replace(self, focus=focus, aperture=coc_at_infinity * focus / self.focal)


class CameraRig:
    """A camera's numbers on the device, opaque to the compiler, so that a new pose needs no new kernel."""

    def __init__(self, mi: Any, dr: Any, camera: Camera) -> None:
        self._dr, self._mi = dr, mi

        def vector(v: Vector) -> Any:
            return mi.Vector3f(*(dr.opaque(mi.Float, float(x)) for x in v))

        self.origin, self.shift = vector(camera.origin), vector(camera.shift)
        self.basis = [vector(v) for v in (camera.right, camera.up, camera.forward)]
        angle = float(np.linalg.norm(camera.turn))
        self.axis = vector(camera.turn / angle if angle else np.array([0.0, 1.0, 0.0]))
        self.angle, self.focal, self.half, self.aperture, self.focus = (
            dr.opaque(mi.Float, float(x))
            for x in (angle, camera.focal, camera.size / 2, camera.aperture, camera.focus))

    def _pose(self, time: Any) -> tuple[Any, list[Any]]:
        """Origin and turned basis at `time` 0..1; the given pose is at 0.5."""
        dr = self._dr
        theta = self.angle * (time - 0.5)
        sin, cos = dr.sincos(theta)
        basis = [v * cos + dr.cross(self.axis, v) * sin + self.axis * (dr.dot(self.axis, v) * (1 - cos))
                 for v in self.basis]
        return self.origin + self.shift * (time - 0.5), basis

    def ray(self, pixel_x: Any, pixel_y: Any, lens_x: Any, lens_y: Any, time: Any) -> Any:
        """World rays through pixel positions and `lens` on the unit disk (signs as stored: x left, y up)."""
        origin, (right, up, forward) = self._pose(time)
        focal_point = self.focus * (forward + right * ((pixel_x - self.half) / self.focal)
                                    - up * ((pixel_y - self.half) / self.focal))
        lens = self.aperture * (up * lens_y - right * lens_x)
        # The time is already in the ray; the renderer's own must be one value, or kernels differ.
        return self._mi.Ray3f(origin + lens, self._dr.normalize(focal_point - lens))

    def project(self, point: Any, time: Any) -> tuple[Any, Any, Any]:
        """Pinhole projection of a world point: pixel x, pixel y, planar depth."""
        origin, (right, up, forward) = self._pose(time)
        v = point - origin
        z = self._dr.dot(v, forward)
        safe = self._dr.maximum(z, 1e-4)
        return (self.half + self.focal * self._dr.dot(v, right) / safe,
                self.half - self.focal * self._dr.dot(v, up) / safe, z)

    def to_view(self, direction: Any, time: Any) -> Any:
        """A world direction in view space: x right, y up, z toward the camera."""
        _, (right, up, forward) = self._pose(time)
        dot = self._dr.dot
        return self._mi.Vector3f(dot(direction, right), dot(direction, up), -dot(direction, forward))

    def coc(self, z: Any) -> Any:
        """Signed circle-of-confusion radius in pixels at planar depth `z`."""
        return self.aperture * self.focal * (z - self.focus) / (z * self.focus)
