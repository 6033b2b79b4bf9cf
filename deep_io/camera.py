"""What little of the camera the features need: a rotation for world-space normals, a field of view for ray lengths.

Screen geometry only: no clipping planes, no lens.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from deep_io.attributes import Attribute
from deep_io.errors import InputError, UsageError
from deep_io.header import read_headers
from deep_io.samples import Window


@dataclass(frozen=True)
class Camera:
    """A pinhole camera; each part is None where unknown.

    world_to_camera  (4, 4) float64, the EXR attribute's convention: row vectors, p_camera = p_world @ M, and a camera
                     space with x right, y up, z along the view direction (left-handed)
    field_of_view    horizontal angle over the width of the display window, degrees, 0 to 180 exclusive
    """

    world_to_camera: NDArray[np.float64] | None = None
    field_of_view: float | None = None

    def view_normals(self) -> NDArray[np.float64]:
        """(3, 3) M with n_view = n_world @ M up to length; view space has z toward the camera.

        Normals go with the inverse transpose of the points' matrix, which also holds for a scaled camera.
        Raises ValueError when the matrix is unknown, singular or not finite.
        """
        if self.world_to_camera is None:
            raise ValueError("the camera has no worldToCamera matrix")
        rotation = self.world_to_camera[:3, :3]
        if not np.isfinite(rotation).all():
            raise ValueError("the worldToCamera matrix is not finite")
        if abs(np.linalg.det(rotation)) < 1e-12 * max(1e-300, float(np.abs(rotation).max()) ** 3):
            raise ValueError("the worldToCamera matrix is singular")
        return np.asarray(np.linalg.inv(rotation).T * np.array([1.0, 1.0, -1.0]), np.float64)

    def planar_factor(self, window: Window, display: Window, pixel_aspect: float = 1.0) -> NDArray[np.float32]:
        """(H, W) planar depth over ray length at the pixel centres of `window`, in (0, 1].

        Raises ValueError when the field of view is unknown.
        """
        if self.field_of_view is None:
            raise ValueError("the camera has no field of view")
        focal = display.width / 2 / math.tan(math.radians(self.field_of_view) / 2)  # pixels
        x = (np.arange(window.xmin, window.xmax + 1) + 0.5 - display.xmin - display.width / 2) / focal
        # A pixel of aspect a is a times as wide as high, so y counts in units of 1 / a.
        y = (np.arange(window.ymin, window.ymax + 1) + 0.5 - display.ymin - display.height / 2) / (focal * pixel_aspect)
        return np.asarray(1 / np.sqrt(1 + x[None, :] ** 2 + y[:, None] ** 2), np.float32)

    def merged(self, other: Camera) -> Camera:
        """This camera with what it lacks taken from `other`."""
        return Camera(self.world_to_camera if self.world_to_camera is not None else other.world_to_camera,
                      self.field_of_view if self.field_of_view is not None else other.field_of_view)


def camera_of(attributes: Mapping[str, Attribute]) -> Camera:
    """The camera that a header's worldToCamera attribute describes; a header does not tell the field of view."""
    attribute = attributes.get("worldToCamera")
    if attribute is None or not isinstance(attribute.value, tuple) or len(attribute.value) != 16:
        return Camera()
    return Camera(np.asarray(attribute.value, np.float64).reshape(4, 4))


def parse_camera(text: str) -> Camera:
    """The camera of `--camera`: a horizontal field of view in degrees, or a file.

    The file is an EXR with a worldToCamera attribute, a JSON object {"worldToCamera": 16 numbers in row order,
    "fieldOfView": degrees} of which either may be left out, or text of 16 numbers in row order.
    Raises InputError when the file is none of these, UsageError when a value makes no sense.
    """
    with suppress(ValueError):
        return _checked(text, None, float(text))
    if text.lower().endswith(".exr"):
        found = [camera_of(header.attributes) for header in read_headers(text)]
        matrices = [camera for camera in found if camera.world_to_camera is not None]
        if not matrices:
            raise InputError(f"{text}: the header has no worldToCamera; give another --camera")
        return matrices[0]
    try:
        content = Path(text).read_text("utf-8")
        values = json.loads(content) if content.lstrip().startswith("{") else {"worldToCamera": content.split()}
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise InputError(f"{text}: no camera: {reason}; --camera takes degrees, an EXR, JSON or 16 numbers") from error
    unknown = set(values) - {"worldToCamera", "fieldOfView"}
    if unknown or not values:
        raise UsageError(f'{text}: a camera has "worldToCamera" and "fieldOfView", not {sorted(unknown) or "nothing"}')
    return _checked(text, values.get("worldToCamera"), values.get("fieldOfView"))


def _checked(text: str, matrix: object, angle: object) -> Camera:
    if isinstance(angle, bool) or (angle is not None and not (isinstance(angle, int | float) and 0 < angle < 180)):
        raise UsageError(f"--camera {text}: the field of view must lie between 0 and 180 degrees")
    if matrix is None:
        return Camera(None, angle)
    try:
        values = np.array(matrix, np.float64).reshape(4, 4)
    except (TypeError, ValueError) as error:
        raise UsageError(f"--camera {text}: worldToCamera must be 16 numbers in row order") from error
    if not np.isfinite(values).all():
        raise UsageError(f"--camera {text}: worldToCamera must be finite")
    return Camera(values, angle)
