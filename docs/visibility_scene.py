"""A picture whose only noise is visibility: flat colours seen through a lens and a shutter, traced with NumPy.

Leaves close to the camera, far out of focus; a disc that moves; a sharp, textured wall behind. Every surface point has
one radiance, so a pixel is noisy only where its samples see different surfaces, as in the paper's Figure 4.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LEAF_DEPTH, DISC_DEPTH, WALL_DEPTH = 1.5, 4.0, 8.0
LEAF_COC, DISC_COC = -9.0, 0.0  # pixels; the focus is from the disc to the wall
DISC_MOTION = 26.0  # pixels over the shutter, to the right
SUN, LEAF, DISC = (1.6, 1.5, 1.2), (0.10, 0.42, 0.07), (0.85, 0.12, 0.06)  # light, and albedos
BRICKS, JOINT = ((0.62, 0.34, 0.25), (0.45, 0.22, 0.17), (0.72, 0.50, 0.36)), (0.75, 0.74, 0.70)
BRICK, GAP = (22.0, 9.0), 1.6  # pixels


@dataclass
class Traced:
    """Samples of a picture, pixel after pixel: roles (N, width) as in the deep sample file; every ray hits."""

    height: int
    width: int
    per_pixel: int
    roles: dict[str, Array]

    def mean(self) -> Array:
        """(H, W, 3) mean radiance."""
        mean: Array = self.roles["radiance"].reshape(self.height, self.width, self.per_pixel, 3).mean(2)
        return mean

    def shares(self) -> Array:
        """(H, W, 3) the part of each pixel's samples that sees leaves, the disc, the wall."""
        shares: Array = self.surfaces().reshape(self.height, self.width, self.per_pixel, 3).mean(2)
        return shares

    def surfaces(self) -> NDArray[np.bool_]:
        """(N, 3) whether a sample sees leaves, the disc, the wall."""
        seen: NDArray[np.bool_] = self.roles["depth"] == np.array([LEAF_DEPTH, DISC_DEPTH, WALL_DEPTH])
        return seen


def trace(height: int, width: int, per_pixel: int, seed: int) -> Traced:
    """The scene with so many independent samples in every pixel."""
    rng = np.random.default_rng(seed)
    y, x = (axis.repeat(per_pixel) + rng.random(height * width * per_pixel)
            for axis in (np.indices((height, width)).reshape(2, -1).astype("f8")))
    angle, radius = 2 * np.pi * rng.random(len(x)), np.sqrt(rng.random(len(x)))
    lens = np.stack([radius * np.cos(angle), radius * np.sin(angle)], 1)
    time = rng.random(len(x))
    # a surface's pinhole projection is the pixel plus its circle of confusion times the lens position
    leaf = _leaves(x + LEAF_COC * lens[:, 0], y + LEAF_COC * lens[:, 1], height, width)
    disc = _disc(x + DISC_COC * lens[:, 0] - DISC_MOTION * (time - 0.5), y + DISC_COC * lens[:, 1], height, width)
    surface = np.where(leaf, 0, np.where(disc, 1, 2))

    def by_surface(leaves: object, disc_: object, wall: object) -> Array:
        columns = [np.broadcast_to(np.asarray(v, "f8"), (len(x), np.size(v) if np.ndim(v) < 2 else np.shape(v)[1]))
                   for v in (leaves, disc_, wall)]
        return np.choose(surface[:, None], columns)

    albedo = by_surface(LEAF, DISC, _bricks(x, y))
    normal = by_surface((0.3, 0.5, 0.81), (0.0, 0.0, 1.0), (0.0, 0.0, 1.0))
    motion = by_surface((0.0, 0.0), (DISC_MOTION, 0.0), (0.0, 0.0))
    roles = {
        "radiance": albedo * np.array(SUN), "depth": by_surface(LEAF_DEPTH, DISC_DEPTH, WALL_DEPTH), "normal": normal,
        "albedo": albedo, "specular": np.zeros_like(albedo), "roughness": np.ones((len(x), 1)), "motion": motion,
        "coc": by_surface(LEAF_COC, DISC_COC, 0.0), "lens": lens, "time": time[:, None],
    }
    return Traced(height, width, per_pixel, roles)


def _leaves(x: Array, y: Array, height: int, width: int) -> NDArray[np.bool_]:
    """Slender ellipses that fan out from the lower left corner, and a twig across the top."""
    found = np.zeros(len(x), bool)
    for angle, length in ((-0.15, 0.75), (-0.55, 0.85), (-0.95, 0.8), (-1.35, 0.7)):
        along = (x - 0.02 * width) * np.cos(angle) + (y - 1.0 * height) * np.sin(angle)
        across = -(x - 0.02 * width) * np.sin(angle) + (y - 1.0 * height) * np.cos(angle)
        share = along / (length * width)
        found |= (share > 0) & (share < 1) & (np.abs(across) < 0.055 * width * np.sin(np.pi * np.clip(share, 0, 1)))
    found |= np.abs(y - 0.16 * height - 0.10 * x) < 0.016 * height
    return found


def _disc(x: Array, y: Array, height: int, width: int) -> NDArray[np.bool_]:
    inside: NDArray[np.bool_] = np.hypot(x - 0.70 * width, y - 0.50 * height) < 0.13 * width
    return inside


def _bricks(x: Array, y: Array) -> Array:
    """(N, 3) albedo of the wall."""
    row = np.floor(y / BRICK[1])
    shifted = x + 0.5 * BRICK[0] * (row % 2)
    column = np.floor(shifted / BRICK[0])
    color = np.array(BRICKS)[((7 * row + 5 * column + row * column) % 3).astype(int)]
    joint = (shifted - column * BRICK[0] < GAP) | (y - row * BRICK[1] < GAP)
    return np.where(joint[:, None], np.array(JOINT), color)
