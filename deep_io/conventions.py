"""From a file's conventions to the project's: normals into view space, ray lengths into planar depth.

`resolve` decides once per file what has to be done and complains about what is missing; the functions do it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from deep_io.aliases import CAMERA_Z_FORWARD, DISTANCE, PLANAR, VIEW, WORLD
from deep_io.camera import Camera, camera_of
from deep_io.errors import InputError, UsageError
from deep_io.header import Header
from deep_io.roles import MISS_DEPTH, RoleMap
from deep_io.samples import Window

NORMALS_ATTRIBUTE, DEPTH_ATTRIBUTE = "lbmc:normals", "lbmc:depth"


@dataclass(frozen=True)
class Conventions:
    """What a file's normals and depths are, and the camera that converts them.

    space         of the normals: "view", "camera-z-forward" or "world"
    distance      whether depth is the length of the ray
    zero_is_miss  whether depth 0, and not only 1e10 and more, is a miss
    """

    space: str = VIEW
    distance: bool = False
    zero_is_miss: bool = False
    camera: Camera = field(default_factory=Camera)

    def to_view(self, normals: NDArray[np.float32]) -> None:
        """Turn normals (N, 3) into view space, in place."""
        if self.space == CAMERA_Z_FORWARD:
            np.negative(normals[:, 2], out=normals[:, 2])
        elif self.space == WORLD:
            turned = normals @ self.camera.view_normals().astype(np.float32)
            length = np.sqrt(np.einsum("ij,ij->i", turned, turned))[:, None]
            np.divide(turned, length, out=normals, where=length > 0)

    def is_miss(self, depth: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Whether each depth says that the camera ray hit nothing."""
        miss = depth >= np.float32(MISS_DEPTH)
        return miss | (depth == 0) if self.zero_is_miss else miss

    def planar_factor(self, header: Header, window: Window) -> NDArray[np.float32] | None:
        """(H, W) what turns ray lengths into planar depth, None where depth is planar already."""
        return self.camera.planar_factor(window, header.display_window, header.pixel_aspect) if self.distance else None


def resolve(header: Header, mapping: RoleMap, path: str, normals: str = "auto", depth: str = "auto",
            camera: Camera | None = None, strict: bool = True) -> Conventions:
    """The conventions of a file, from the alias table, the header and the options.

    Parameters
        normals  "auto": as the header's lbmc:normals or the alias table says; "world", "view": whatever they say
        depth    "auto": as the header's lbmc:depth or the alias table says; "z" (planar), "distance" (the ray's
                 length): whatever they say
        camera   takes precedence over the header's worldToCamera
        strict   False leaves a conversion that lacks its camera to the caller, who checks `camera`
    Raises InputError when world normals have no worldToCamera or ray lengths no field of view; UsageError for an
    unknown option.
    """
    if normals not in ("auto", "world", "view"):
        raise UsageError(f"--normals {normals}: must be auto, world or view")
    if depth not in ("auto", PLANAR, DISTANCE):
        raise UsageError(f"--depth {depth}: must be auto, z or distance")
    space = normals
    if normals == "auto":
        space = str(header.get(NORMALS_ATTRIBUTE, mapping["normal"].space)) if "normal" in mapping else VIEW
    source = mapping.sources.get("depth")
    kind = depth
    if depth == "auto":
        kind = str(header.get(DEPTH_ATTRIBUTE, source.depth)) if source is not None else PLANAR
    found = (camera or Camera()).merged(camera_of(header.attributes))
    conventions = Conventions(space, source is not None and kind == DISTANCE,
                              source is not None and source.zero_is_miss, found)
    if strict and conventions.space == WORLD and "normal" in mapping and found.world_to_camera is None:
        raise InputError(f"{path}: the normals ({mapping['normal'].layer}) are in world space and the header has no "
                         f"worldToCamera; give the camera with --camera FILE, pass --normals view if they are in view "
                         f"space, or leave them out with --map normal=none")
    if strict and conventions.distance and found.field_of_view is None:
        raise InputError(f"{path}: the depth ({mapping['depth'].layer}) is the length of the ray, and planar depth "
                         f"needs the field of view; give it with --camera DEGREES, pass --depth z if it is planar, "
                         f"or leave depth out with --map depth=none")
    if conventions.space == WORLD and found.world_to_camera is not None:
        try:
            found.view_normals()
        except ValueError as error:
            raise InputError(f"{path}: {error}; give another with --camera FILE") from error
    return conventions
