"""Convex polytopes: what road users and clutter of random traffic are made of.

A ray meets a convex polytope where it has entered all of its half-spaces, so one product of matrices serves all parts of
an object and all rays (Kay & Kajiya, "Ray Tracing Complex Scenes", SIGGRAPH 1986).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array


class Material(IntEnum):
    """What a surface is made of; reflectances are in `log2sim.synth.returns`."""

    GROUND = 0
    PAINT = 1
    GLASS = 2
    DARK = 3
    CLOTH = 4
    WALL = 5
    LEAVES = 6
    METAL = 7
    MESH = 8
    WOOD = 9


@dataclass(frozen=True, eq=False)
class Polytope:
    """Points p with normals @ p <= offsets, in the frame of an object (x forward, y left, z up from the middle of its floor).

    Attributes
    ----------
    normals : (K, 3) float32
        Outward unit normals.
    offsets : (K,) float32, m
    low, high : (3,) float64, m
        Bounds.
    material : Material
    """

    normals: NDArray[np.float32]
    offsets: NDArray[np.float32]
    low: Array
    high: Array
    material: Material

    def vertices(self) -> Array:
        """Corners (V, 3) float64, m, by intersecting triples of faces."""
        n, c = self.normals.astype(np.float64), self.offsets.astype(np.float64)
        i, j, k = np.array([(a, b, d) for a in range(len(n)) for b in range(a) for d in range(b)]).T
        triples = np.stack([n[i], n[j], n[k]], axis=1)
        regular = np.abs(np.linalg.det(triples)) > 1e-6
        points = np.linalg.solve(triples[regular], np.stack([c[i], c[j], c[k]], axis=1)[regular][..., None])[..., 0]
        inside = (points @ n.T <= c + 1e-5).all(axis=1)
        return np.unique(points[inside].round(6), axis=0)


Shape = tuple[tuple[float, float, float], tuple[Polytope, ...]]
"""Length, width, height in m of an object, and its parts."""


def _made(normals: Array, offsets: Array, low: Sequence[float], high: Sequence[float], material: Material) -> Polytope:
    return Polytope(
        np.asarray(normals, np.float32),
        np.asarray(offsets, np.float32),
        np.array(low, np.float64),
        np.array(high, np.float64),
        material,
    )


def prism(profile: Sequence[tuple[float, float]], width: float, material: Material, *, taper: float = 0.0) -> Polytope:
    """Extrude a convex side profile over the width.

    Parameters
    ----------
    profile : sequence of (x, z), m
        Counter-clockwise.
    width : float, m
        At the lowest point of the profile.
    taper : float
        Lean of the sides inward, m per m of height.
    """
    points = np.asarray(profile, np.float64)
    edges = points[np.r_[1 : len(points), 0]] - points
    normals = np.zeros((len(edges), 3))
    normals[:, 0], normals[:, 2] = edges[:, 1], -edges[:, 0]
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    offsets = normals[:, 0] * points[:, 0] + normals[:, 2] * points[:, 1]
    k = 1 / np.hypot(1, taper)
    sides = np.array([[0, k, taper * k], [0, -k, taper * k]])
    z0 = points[:, 1].min()
    ends = np.full(2, (width / 2 + taper * z0) * k)
    low, high = points.min(axis=0), points.max(axis=0)
    return _made(
        np.vstack([normals, sides]),
        np.append(offsets, ends),
        (low[0], -width / 2, low[1]),
        (high[0], width / 2, high[1]),
        material,
    )


def box(low: Sequence[float], high: Sequence[float], material: Material) -> Polytope:
    """Make a box from its lowest and highest corner (3,), m."""
    return _made(_FACES, np.array([*high, -low[0], -low[1], -low[2]]), low, high, material)


def column(
    radius: float, z: tuple[float, float], material: Material, *, at: tuple[float, float] = (0.0, 0.0), sides: int = 6
) -> Polytope:
    """Make an upright prism around a circle of a radius at x, y, between two heights, m."""
    angles = np.arange(sides) * 2 * np.pi / sides
    around = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(sides)])
    normals = np.vstack([around, [[0, 0, 1], [0, 0, -1]]])
    offsets = np.append(radius + around[:, 0] * at[0] + around[:, 1] * at[1], [z[1], -z[0]])
    # Where the sides meet they are farther out than the inscribed circle.
    reach = radius / np.cos(np.pi / sides)
    return _made(normals, offsets, (at[0] - reach, at[1] - reach, z[0]), (at[0] + reach, at[1] + reach, z[1]), material)


def tube(radius: float, x: tuple[float, float], z: float, material: Material, *, sides: int = 8) -> Polytope:
    """Make a lying prism around a circle of a radius at height z, between two x, m."""
    angles = (np.arange(sides) + 0.5) * 2 * np.pi / sides
    around = np.column_stack([np.zeros(sides), np.cos(angles), np.sin(angles)])
    normals = np.vstack([around, [[1, 0, 0], [-1, 0, 0]]])
    offsets = np.append(radius + around[:, 2] * z, [x[1], -x[0]])
    reach = radius / np.cos(np.pi / sides)
    return _made(normals, offsets, (x[0], -reach, z - reach), (x[1], reach, z + reach), material)


def _tread() -> Array:
    """Return the normals (10, 3) of a wheel: eight around its axle, two along it."""
    angles = (np.arange(8) + 0.5) * np.pi / 4
    around = np.column_stack([np.cos(angles), np.zeros(8), np.sin(angles)])
    return np.vstack([around, [[0, 1, 0], [0, -1, 0]]])


_TREAD = _tread()
_FACES = np.vstack([np.eye(3), -np.eye(3)])


def wheel(radius: float, width: float, x: float, y: float) -> Polytope:
    """Make a wheel, standing on the ground, that rolls along x, m."""
    offsets = radius + _TREAD[:, 0] * x + _TREAD[:, 2] * radius
    offsets[8:] = y + width / 2, width / 2 - y
    reach = radius / np.cos(np.pi / 8)
    return _made(
        _TREAD,
        offsets,
        (x - reach, y - width / 2, radius - reach),
        (x + reach, y + width / 2, radius + reach),
        Material.DARK,
    )


def _ellipsoid_normals() -> Array:
    golden = (1 + 5**0.5) / 2
    points = [(0.0, s, t * golden) for s in (1, -1) for t in (1, -1)]
    normals = np.array([np.roll(p, shift) for shift in range(3) for p in points])
    return np.asarray(normals / np.linalg.norm(normals, axis=1)[:, None])


_TWELVE = _ellipsoid_normals()


def ellipsoid(radii: Sequence[float], center: Sequence[float], material: Material) -> Polytope:
    """Make the dodecahedron around an ellipsoid of three radii, m."""
    extents, middle = np.array(radii, np.float64), np.array(center, np.float64)
    normals = _TWELVE / extents
    length = np.linalg.norm(normals, axis=1)
    normals /= length[:, None]
    reach = extents * 1.2584  # circumradius of a dodecahedron over its inradius
    return _made(normals, 1 / length + normals @ middle, (middle - reach).tolist(), (middle + reach).tolist(), material)
