"""Triangle meshes and the primitives that road users are composed of.

A mesh lives in the agent frame: x forward, y left, z up, origin at the center of its box.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from log2sim.geometry import Array


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh.

    Attributes
    ----------
    vertices_m : (V, 3) float64, m
    normals : (V, 3) float64
        Outward unit normals of the vertices.
    faces : (F, 3) int64
        Indices of vertices, counter-clockwise from outside.
    part : (F,) int64
        Material of each face.
    """

    vertices_m: Array
    normals: Array
    faces: NDArray[np.int64]
    part: NDArray[np.int64]

    def fitted(self, size_m: ArrayLike, low: Array | None = None, high: Array | None = None) -> Mesh:
        """Scale and shift each axis so that the extents `low`..`high` (default: its own) become a centered box."""
        size = np.asarray(size_m, dtype=np.float64)
        low = self.vertices_m.min(0) if low is None else low
        high = self.vertices_m.max(0) if high is None else high
        scale = size / (high - low)
        normals = self.normals / scale
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return Mesh((self.vertices_m - (low + high) / 2) * scale, normals, self.faces, self.part)


def cross_products(a: Array, b: Array) -> Array:
    """Cross products (..., 3), several times faster for small arrays than NumPy's."""
    x = a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1]
    y = a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2]
    return np.stack([x, y, a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]], -1)


def merged(meshes: Sequence[Mesh]) -> Mesh:
    """Concatenate meshes."""
    offsets = np.cumsum([0, *(len(m.vertices_m) for m in meshes)])
    return Mesh(
        np.concatenate([m.vertices_m for m in meshes]),
        np.concatenate([m.normals for m in meshes]),
        np.concatenate([m.faces + o for m, o in zip(meshes, offsets)]),
        np.concatenate([m.part for m in meshes]),
    )


def surface(vertices: Array, faces: NDArray[np.int64], part: int) -> Mesh:
    """Make a smooth mesh: vertex normals are area-weighted means of the face normals."""
    cross = cross_products(vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]])
    solid = np.linalg.norm(cross, axis=1) > 1e-12
    faces, cross = faces[solid], cross[solid]
    corners = faces.T.ravel()
    normals: Array = np.stack([np.bincount(corners, np.tile(c, 3), len(vertices)) for c in cross.T], 1).astype(float)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.where(length > 0, normals / np.where(length > 0, length, 1.0), [0.0, 0.0, 1.0])
    return Mesh(vertices, normals, faces, np.full(len(faces), part))


def loft(rings: Array, part: int, *, caps: bool = True) -> Mesh:
    """Skin over closed rings (S, K, 3), each counter-clockwise when seen from the far end, with flat ends."""
    s, k = rings.shape[:2]
    i, j = np.meshgrid(np.arange(s - 1), np.arange(k), indexing="ij")
    a, b = (i * k + j).ravel(), (i * k + (j + 1) % k).ravel()
    faces = np.concatenate([np.stack([a, b, b + k], 1), np.stack([a, b + k, a + k], 1)])
    skin = surface(rings.reshape(-1, 3), faces, part)
    if not caps:
        return skin
    return merged([skin, _fan(rings[0][::-1], part), _fan(rings[-1], part)])


def _fan(ring: Array, part: int) -> Mesh:
    vertices = np.concatenate([ring, ring.mean(0, keepdims=True)])
    k = np.arange(len(ring))
    return surface(vertices, np.stack([k, (k + 1) % len(ring), np.full(len(ring), len(ring))], 1), part)


def _across(axis: Array) -> Array:
    """Find a unit vector perpendicular to `axis`."""
    side = np.array([0.0, 1.0, 0.0]) if abs(axis[1]) < 0.9 * np.linalg.norm(axis) else np.array([1.0, 0.0, 0.0])
    across = cross_products(side, axis)
    return np.asarray(across / np.linalg.norm(across))


def limb(points: ArrayLike, radii: Sequence[float], part: int, *, count: int = 10, flat: float = 1.0) -> Mesh:
    """Make a round-ended tube along points (P, 3) with a radius at each; `flat` scales its second axis."""
    p = np.asarray(points, dtype=np.float64)
    tangent = np.gradient(p, axis=0) if len(p) > 2 else np.repeat(p[1:] - p[:1], 2, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    angle = np.arange(count) * 2 * np.pi / count
    rings = []
    u = _across(p[-1] - p[0])
    stations = [(p[0] - tangent[0] * radii[0] * h, radii[0] * c, tangent[0]) for h, c in ((1.0, 0.05), (0.8, 0.6))]
    stations += [(p[i], radii[i], tangent[i]) for i in range(len(p))]
    stations += [
        (p[-1] + tangent[-1] * radii[-1] * h, radii[-1] * c, tangent[-1]) for h, c in ((0.8, 0.6), (1.0, 0.05))
    ]
    for center, radius, axis in stations:
        across = u - axis * np.dot(u, axis)
        across /= np.linalg.norm(across)
        over = cross_products(axis, across)
        rings.append(center + radius * (np.cos(angle)[:, None] * across * flat + np.sin(angle)[:, None] * over))
    return loft(np.array(rings), part, caps=False)


def ellipsoid(center: ArrayLike, radii: ArrayLike, part: int, *, count: int = 14) -> Mesh:
    """Make an ellipsoid with axes along x, y, z."""
    height = np.linspace(-np.pi / 2, np.pi / 2, count // 2 + 2)
    angle = np.arange(count) * 2 * np.pi / count
    c, r = np.asarray(center, dtype=np.float64), np.asarray(radii, dtype=np.float64)
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], 1)
    rings = [c + r * (ring * max(np.cos(h), 1e-3) + np.array([0, 0, np.sin(h)])) for h in height]
    return loft(np.array(rings), part, caps=False)


def block(low: ArrayLike, high: ArrayLike, part: int, *, bevel_m: float = 0.0) -> Mesh:
    """Make an upright box with flat sides; `bevel_m` chamfers the upright edges and the upper rim."""
    (x0, y0, z0), (x1, y1, z1) = np.asarray(low, float), np.asarray(high, float)
    if bevel_m <= 0:
        ring = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
        sides = [_quad(ring[i], ring[(i + 1) % 4], z0, z1, part) for i in range(4)]
        bottom = np.column_stack([ring, np.full(4, z0)])
        top = np.column_stack([ring, np.full(4, z1)])
        return merged([*sides, _fan(bottom[::-1], part), _fan(top, part)])
    b = bevel_m
    outline = [
        (x0 + b, y0),
        (x1 - b, y0),
        (x1, y0 + b),
        (x1, y1 - b),
        (x1 - b, y1),
        (x0 + b, y1),
        (x0, y1 - b),
        (x0, y0 + b),
    ]
    ring = np.array(outline)
    center = np.array([(x0 + x1) / 2, (y0 + y1) / 2])
    inner = center + (ring - center) * (1 - b / np.array([(x1 - x0) / 2, (y1 - y0) / 2]))
    sides = [_quad(ring[i], ring[(i + 1) % 8], z0, z1 - b, part) for i in range(8)]
    rim = loft(np.stack([np.column_stack([ring, np.full(8, z1 - b)]), np.column_stack([inner, np.full(8, z1)])]), part)
    return merged([*sides, rim, _fan(np.column_stack([ring, np.full(8, z0)])[::-1], part)])


def _quad(a: Array, b: Array, z0: float, z1: float, part: int) -> Mesh:
    vertices = np.array([[*a, z0], [*b, z0], [*b, z1], [*a, z1]])
    return surface(vertices, np.array([[0, 1, 2], [0, 2, 3]]), part)


def disc_wheel(center: ArrayLike, radius_m: float, width_m: float, part: int, *, count: int = 20) -> Mesh:
    """Make a wheel with its axle along y."""
    x, y, z = np.asarray(center, dtype=np.float64)
    angle = -np.arange(count) * 2 * np.pi / count
    rings = []
    for side, scale in ((-0.5, 0.93), (-0.38, 1.0), (0.38, 1.0), (0.5, 0.93)):
        rings.append(
            np.stack(
                [
                    x + radius_m * scale * np.cos(angle),
                    np.full(count, y + side * width_m),
                    z + radius_m * scale * np.sin(angle),
                ],
                1,
            )
        )
    return loft(np.array(rings), part)


def hoop(center: ArrayLike, radius_m: float, thickness_m: float, part: int, *, count: int = 28) -> Mesh:
    """Make a thin tire around an axle along y."""
    c = np.asarray(center, dtype=np.float64)
    angle = -np.arange(count) * 2 * np.pi / count
    out = np.stack([np.cos(angle), np.zeros(count), np.sin(angle)], 1)
    rings = [
        c + out * (radius_m - thickness_m + thickness_m * np.cos(t)) + np.array([0, thickness_m * np.sin(t), 0])
        for t in np.arange(7) * np.pi / 3
    ]
    return loft(np.array(rings), part, caps=False)
