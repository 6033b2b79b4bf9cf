"""Environment maps: procedural skies, studios, and nights with tiny bright spots, as (HEIGHT, WIDTH, 3) radiance.

Row 0 is straight up (+y). Every map has the same size, so that one set of compiled kernels serves all scenes.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pipelines.rendering.textures import noise, random_color

Image = npt.NDArray[np.float32]
HEIGHT, WIDTH = 512, 1024


def _directions() -> npt.NDArray[np.float64]:
    """World directions (HEIGHT, WIDTH, 3) of the texels in Mitsuba's `envmap` convention, y up."""
    theta = (np.arange(HEIGHT) + 0.5) / HEIGHT * np.pi
    phi = (np.arange(WIDTH) + 0.5) / WIDTH * 2 * np.pi
    t, p = np.meshgrid(theta, phi, indexing="ij")
    return np.stack([np.sin(p) * np.sin(t), np.cos(t), -np.cos(p) * np.sin(t)], -1)


def _clouds(rng: np.random.Generator) -> npt.NDArray[np.float64]:
    tile = noise(rng, 1.7, 512)
    return np.concatenate([tile, tile], 1)[:HEIGHT, :WIDTH]


def sky(rng: np.random.Generator, sun_direction: npt.ArrayLike | None = None) -> Image:
    """A clear or cloudy day: gradient, haze, clouds, a sun of about half a degree and a ground half.

    `sun_direction` (3,) points to the sun; drawn at random if not given. The sun's share of the light is random, down
    to none (overcast).
    """
    d = _directions()
    if sun_direction is None:
        elevation, azimuth = rng.uniform(0.1, 1.3), rng.uniform(0, 2 * np.pi)
        sun_direction = [np.cos(elevation) * np.sin(azimuth), np.sin(elevation), np.cos(elevation) * np.cos(azimuth)]
    sun = np.asarray(sun_direction, np.float64)
    sun = sun / np.linalg.norm(sun)
    up = np.clip(d[..., 1], 0, 1)[..., None]
    zenith = np.array([0.12, 0.28, 0.75]) * rng.uniform(0.4, 1.2)
    horizon = np.array([0.75, 0.8, 0.95]) * rng.uniform(0.5, 1.2)
    image = zenith + (horizon - zenith) * (1 - up) ** rng.uniform(2, 6)
    cosine = np.clip(d @ sun, -1, 1)
    warm = np.array([1.0, 0.85, 0.6]) if sun[1] > 0.3 else np.array([1.0, 0.6, 0.3])
    image = image + warm * (0.4 * np.exp((cosine - 1) * 8) + 1.5 * np.exp((cosine - 1) * 120))[..., None]
    cover = _clouds(rng)
    cloud = np.clip((cover - rng.uniform(0.35, 0.8)) * 5, 0, 1) * (up[..., 0] > 0)
    image = image * (1 - cloud[..., None]) + cloud[..., None] * rng.uniform(0.5, 1.4)
    ground = random_color(rng, 0.05, 0.3)
    image = np.where(d[..., 1:2] < 0, ground * horizon.mean(), image)
    if rng.random() < 0.8:
        # A texel is a third of a degree, so this sun of 0.7 to 1.7 degrees is larger and softer than ours of 0.5.
        radius = rng.uniform(0.006, 0.015)
        disc = cosine > np.cos(radius)
        if not disc.any():
            disc = cosine >= cosine.max()
        strength = rng.uniform(0.5, 5.0) * np.pi / (2 * np.pi * (1 - np.cos(radius)))
        image = image + warm * (disc * strength)[..., None]
    return image.astype(np.float32)


def studio(rng: np.random.Generator) -> Image:
    """A dim surround with a few rectangular soft boxes, some small and bright."""
    d = _directions()
    image = np.ones((HEIGHT, WIDTH, 3)) * random_color(rng, 0.01, 0.3)
    image *= (0.6 + 0.4 * d[..., 1:2])
    for _ in range(int(rng.integers(1, 6))):
        axis = rng.normal(size=3) + np.array([0, 0.7, 0])
        axis /= np.linalg.norm(axis)
        side = np.cross(axis, rng.normal(size=3))
        side /= np.linalg.norm(side)
        front = d @ axis
        u, v = (d @ side) / np.maximum(front, 1e-3), (d @ np.cross(axis, side)) / np.maximum(front, 1e-3)
        wide, high = np.exp(rng.uniform(np.log(0.03), np.log(0.6), 2))
        inside = (front > 0) & (np.abs(u) < wide) & (np.abs(v) < high)
        power = np.exp(rng.uniform(np.log(0.3), np.log(3.0)))
        image[inside] += random_color(rng, 0.6, 0.9) * power / (wide * high)
    return image.astype(np.float32)


def spots(rng: np.random.Generator) -> Image:
    """Night or dusk: dark with a band of many tiny bright coloured lights, which give sharp bokeh and fireflies."""
    d = _directions()
    image = np.ones((HEIGHT, WIDTH, 3)) * random_color(rng, 0.005, 0.08) * (0.3 + np.clip(d[..., 1:2], 0, 1))
    for _ in range(int(rng.integers(3, 60))):
        row = int(np.clip(rng.normal(0.42, 0.12), 0.02, 0.97) * HEIGHT)
        column, size = int(rng.integers(0, WIDTH - 6)), int(rng.integers(1, 6))
        image[row:row + size, column:column + size] += random_color(rng, 0.5, 0.9) * np.exp(
            rng.uniform(np.log(20), np.log(8000))) / size**2
    return image.astype(np.float32)


def uniform(rng: np.random.Generator, level: float | None = None) -> Image:
    """One colour everywhere, at `level` or a random one; 0 gives empty black space."""
    value = rng.uniform(0.05, 1.0) if level is None else level
    return (np.ones((HEIGHT, WIDTH, 3)) * random_color(rng, 0.9, 0.95) * value).astype(np.float32)


def facing(image: Image, outward: list[npt.NDArray[np.float64]]) -> Image:
    """The map with every direction black that cannot enter through windows in walls of these `outward` normals.

    A room sees no difference; light sampling no longer wastes most of its rays on them.
    """
    d = _directions()
    seen = np.zeros((HEIGHT, WIDTH), bool)
    for normal in outward:
        seen |= d @ normal > 0.03
    return (image * seen[..., None]).astype(np.float32)
