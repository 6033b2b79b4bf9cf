"""Triangle meshes as NumPy arrays: primitives, thin geometry, transforms and merging.

Everything is y-up, in metres, and carries normals and texture coordinates, because the renderer's kernels are cached
per combination of mesh attributes. Flat faces own their vertices, so recomputed vertex normals stay flat.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float32]
Faces = npt.NDArray[np.uint32]


@dataclass(frozen=True)
class Mesh:
    """Triangles: `vertices` (V,3), `faces` (F,3) indices, `uv` (V,2), `color` (V,3) linear reflectance in 0..1."""

    vertices: Array
    faces: Faces
    uv: Array
    color: Array

    def transformed(self, matrix: npt.ArrayLike | None = None, offset: npt.ArrayLike = (0.0, 0.0, 0.0)) -> Mesh:
        """The mesh with every vertex v at `matrix @ v + offset`; `matrix` (3,3) or a scalar scale."""
        vertices = self.vertices
        if matrix is not None:
            m = np.asarray(matrix, np.float32)
            vertices = vertices * m if m.ndim == 0 else vertices @ m.T
        return replace(self, vertices=(vertices + np.asarray(offset, np.float32)).astype(np.float32))

    def with_uv_scale(self, scale: float) -> Mesh:
        """The mesh with its texture repeated `scale` times as often."""
        return replace(self, uv=self.uv * np.float32(scale))

    def with_color(self, color: npt.ArrayLike) -> Mesh:
        """The mesh in one colour, read only by the vertex-colour material."""
        return replace(self, color=np.broadcast_to(np.asarray(color, np.float32), self.vertices.shape).copy())


def mesh_from(vertices: Any, faces: Any, uv: Any) -> Mesh:
    """A mesh in middle grey from anything array-like of the shapes of `Mesh`."""
    v = np.asarray(vertices, np.float32).reshape(-1, 3)
    return Mesh(v, np.asarray(faces, np.uint32).reshape(-1, 3), np.asarray(uv, np.float32).reshape(-1, 2),
                np.full_like(v, 0.5))


def merge(meshes: list[Mesh]) -> Mesh:
    """One mesh holding all triangles, in order."""
    starts = np.cumsum([0] + [len(m.vertices) for m in meshes[:-1]])
    return Mesh(np.concatenate([m.vertices for m in meshes]),
                np.concatenate([m.faces + np.uint32(s) for m, s in zip(meshes, starts, strict=True)]),
                np.concatenate([m.uv for m in meshes]), np.concatenate([m.color for m in meshes]))


def surface(points: npt.ArrayLike, uv_scale: tuple[float, float] = (1.0, 1.0)) -> Mesh:
    """The smooth sheet through a grid of `points` (R,C,3); u runs along columns, v along rows."""
    p = np.asarray(points, np.float32)
    rows, cols = p.shape[:2]
    v, u = np.meshgrid(np.linspace(0, uv_scale[1], rows), np.linspace(0, uv_scale[0], cols), indexing="ij")
    index = np.arange(rows * cols, dtype=np.uint32).reshape(rows, cols)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], -2)
    return mesh_from(p, faces, np.stack([u, v], -1))


def quad(origin: npt.ArrayLike, edge_u: npt.ArrayLike, edge_v: npt.ArrayLike, uv_per_metre: float = 1.0) -> Mesh:
    """A parallelogram whose texture repeats `uv_per_metre` times per metre."""
    o, eu, ev = (np.asarray(x, np.float32) for x in (origin, edge_u, edge_v))
    lu, lv = float(np.linalg.norm(eu)) * uv_per_metre, float(np.linalg.norm(ev)) * uv_per_metre
    return mesh_from([o, o + eu, o + eu + ev, o + ev], [[0, 1, 2], [0, 2, 3]], [[0, 0], [lu, 0], [lu, lv], [0, lv]])


def box(size: npt.ArrayLike, uv_per_metre: float = 1.0) -> Mesh:
    """An axis-aligned box of `size` (3,), centred on the origin, six separate faces."""
    half = np.asarray(size, np.float32) / 2
    sides = []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        for sign in (-1.0, 1.0):
            origin, eu, ev = -half.copy(), np.zeros(3), np.zeros(3)
            origin[axis] = sign * half[axis]
            eu[u], ev[v] = 2 * half[u], 2 * half[v]
            sides.append(quad(origin, eu, ev, uv_per_metre) if sign > 0 else quad(origin, ev, eu, uv_per_metre))
    return merge(sides)


def superellipsoid(size: npt.ArrayLike, squareness: float = 1.0, segments: int = 20) -> Mesh:
    """A smooth closed body of full `size` (3,): a sphere at `squareness` 1, a rounded box towards 0.2."""
    lat, lon = np.meshgrid(np.linspace(-np.pi / 2, np.pi / 2, segments // 2 + 1),
                           np.linspace(0, 2 * np.pi, segments + 1), indexing="ij")

    def power(x: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        return np.asarray(np.sign(x) * np.abs(x) ** squareness)

    p = np.stack([power(np.cos(lat)) * power(np.sin(lon)), power(np.sin(lat)),
                  power(np.cos(lat)) * power(np.cos(lon))], -1)
    return surface(p * np.asarray(size) / 2, (2.0, 1.0))


def lathe(profile: Any, segments: int = 32) -> Mesh:
    """The surface of revolution about y of a `profile` (K,2) of (radius, height), from bottom to top."""
    prof = np.asarray(profile, np.float32)
    angle = np.linspace(0, 2 * np.pi, segments + 1)
    r, y = prof[:, :1], prof[:, 1:]
    p = np.stack([r * np.sin(angle), np.broadcast_to(y, (len(prof), segments + 1)), r * np.cos(angle)], -1)
    return surface(p, (2.0, 1.0))


def tube(path: npt.ArrayLike, radius: float | npt.NDArray[np.float64], sides: int = 6) -> Mesh:
    """A round tube of `radius` (a number or one per point) along `path` (K,3): wires, legs, hair."""
    p = np.asarray(path, np.float64)
    tangent = np.gradient(p, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True) + 1e-12
    helper = np.where(np.abs(tangent[:, 1:2]) > 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    side = np.cross(tangent, helper)
    side /= np.linalg.norm(side, axis=1, keepdims=True) + 1e-12
    other = np.cross(tangent, side)  # this way round, the faces look outwards
    angle = np.linspace(0, 2 * np.pi, sides + 1)[None, :, None]
    r = np.broadcast_to(np.asarray(radius, np.float64), (len(p),))[:, None, None]
    length = float(np.linalg.norm(np.diff(p, axis=0), axis=1).sum())
    return surface(p[:, None] + r * (np.cos(angle) * side[:, None] + np.sin(angle) * other[:, None]),
                   (1.0, max(1.0, 4 * length)))


def torus(major: float, minor: float, segments: int = 32, sides: int = 10) -> Mesh:
    """A ring about y."""
    a = np.linspace(0, 2 * np.pi, segments + 1)[:, None]
    b = np.linspace(2 * np.pi, 0, sides + 1)[None]  # this way round, the faces look outwards
    r = major + minor * np.cos(b)
    return surface(np.stack([r * np.sin(a), minor * np.sin(b) + 0 * a, r * np.cos(a)], -1), (1.0, 4.0))


def ribbons(roots: Array, tips: Array, width: float, bend: Array, segments: int = 4) -> Mesh:
    """M tapering flat blades from `roots` (M,3) to `tips` (M,3), bowed by `bend` (M,3): grass, hair, feathers."""
    t = np.linspace(0, 1, segments + 1)[None, :, None]
    spine = roots[:, None] * (1 - t) + tips[:, None] * t + bend[:, None] * (4 * t * (1 - t)) / 4
    across = np.cross(tips - roots, bend + np.array([1e-4, 0.0, 2e-4]))
    across /= np.linalg.norm(across, axis=1, keepdims=True) + 1e-9
    half = across[:, None] * (width / 2) * (1 - 0.9 * t)
    vertices = np.stack([spine - half, spine + half], 2)  # (M, segments+1, 2, 3)
    base = (np.arange(len(roots)) * 2 * (segments + 1))[:, None] + 2 * np.arange(segments)[None]
    faces = np.stack([np.stack([base, base + 1, base + 3], -1), np.stack([base, base + 3, base + 2], -1)], -2)
    uv = np.broadcast_to(np.stack(np.broadcast_arrays(
        np.array([0.0, 1.0])[None], np.linspace(0, 1, segments + 1)[:, None]), -1), vertices.shape[:3] + (2,))
    return mesh_from(vertices, faces, uv)


def cards(centres: Array, size: float, rng: np.random.Generator, pointed: bool = False) -> Mesh:
    """One randomly turned square (or pointed leaf) of side `size` per centre (M,3), texture 0..1 on each."""
    m = len(centres)
    u = rng.normal(size=(m, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(u, rng.normal(size=(m, 3)))
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    if pointed:
        corners = np.array([[0.0, -1.0], [0.45, -0.2], [0.0, 1.0], [-0.45, -0.2]])
    else:
        corners = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    scale = size / 2 * rng.uniform(0.6, 1.3, (m, 1, 1))
    vertices = centres[:, None] + scale * (corners[None, :, :1] * u[:, None] + corners[None, :, 1:] * v[:, None])
    faces = (np.arange(m) * 4)[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])[None]
    return mesh_from(vertices, faces, np.broadcast_to((corners + 1) / 2, (m, 4, 2)))


def heightfield(heights: npt.NDArray[np.float64], extent: float, uv_per_metre: float = 0.5) -> Mesh:
    """A square terrain of side `extent` centred on the origin from `heights` (R,R) in metres."""
    n = heights.shape[0]
    axis = np.linspace(-extent / 2, extent / 2, n)
    x, z = np.meshgrid(axis, axis, indexing="ij")
    return surface(np.stack([x, heights, z], -1), (extent * uv_per_metre, extent * uv_per_metre))


def rotation(axis: npt.ArrayLike, angle: float) -> npt.NDArray[np.float64]:
    """The (3,3) rotation by `angle` radians about `axis` (Rodrigues)."""
    k = np.asarray(axis, np.float64) / (np.linalg.norm(axis) + 1e-12)
    cross = np.array([[0, -k[2], k[1]], [k[2], 0, -k[0]], [-k[1], k[0], 0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)


def random_rotation(rng: np.random.Generator) -> npt.NDArray[np.float64]:
    """A rotation drawn uniformly."""
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return np.asarray(q if np.linalg.det(q) > 0 else -q)
