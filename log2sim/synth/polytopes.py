"""Convex polytopes that road users and clutter of random traffic are made of, and their meshes.

A ray meets a convex polytope where it has entered all of its half-spaces, so one product of matrices serves all parts of
an object and all rays (Kay & Kajiya, "Ray Tracing Complex Scenes", SIGGRAPH 1986).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.synth.shapes import Mesh, cross_products


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
    """Points p with normals @ p <= offsets, in the frame of an object (x forward, y left, z up from the middle of its floor)."""

    normals: NDArray[np.float32]  # (K, 3): outward unit normals
    offsets: NDArray[np.float32]  # (K,), m
    low: Array  # (3,), m: bounds
    high: Array  # (3,), m: bounds
    material: Material


Shape = tuple[tuple[float, float, float], tuple[Polytope, ...]]
"""Length, width, height in m of an object, and its parts."""


def _made(normals: Array, offsets: Array, low: Sequence[float], high: Sequence[float], material: Material) -> Polytope:
    planes = np.asarray(normals, np.float32), np.asarray(offsets, np.float32)
    return Polytope(*planes, np.array(low, np.float64), np.array(high, np.float64), material)


def prism(profile: Sequence[tuple[float, float]], width: float, material: Material, *, taper: float = 0.0) -> Polytope:
    """Extrude a convex side profile over the width.

    `profile`: (x, z), m, counter-clockwise. `width`, m: at its lowest point. `taper`: lean of the sides inward, m per m.
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
    (x0, z0), (x1, z1) = points.min(axis=0), points.max(axis=0)
    bounds = (x0, -width / 2, z0), (x1, width / 2, z1)
    return _made(np.vstack([normals, sides]), np.append(offsets, ends), *bounds, material)


def box(low: Sequence[float], high: Sequence[float], material: Material) -> Polytope:
    """Make a box from its lowest and highest corner (3,), m."""
    return _made(_FACES, np.array([*high, -low[0], -low[1], -low[2]]), low, high, material)


def block(x: float, y: float, along: float, across: float, z: tuple[float, float], material: Material) -> Polytope:
    """Make a box about x, y that reaches as far along x and y to both sides, between two heights, m."""
    return box((x - along, y - across, z[0]), (x + along, y + across, z[1]), material)


def column(
    radius: float, z: tuple[float, float], material: Material, *, at: tuple[float, float] = (0.0, 0.0)
) -> Polytope:
    """Make an upright prism of six sides around a circle of a radius at x, y, between two heights, m."""
    sides = 6
    angles = np.arange(sides) * 2 * np.pi / sides
    around = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(sides)])
    normals = np.vstack([around, [[0, 0, 1], [0, 0, -1]]])
    offsets = np.append(radius + around[:, 0] * at[0] + around[:, 1] * at[1], [z[1], -z[0]])
    # Where the sides meet they are farther out than the inscribed circle.
    reach = radius / np.cos(np.pi / sides)
    return _made(normals, offsets, (at[0] - reach, at[1] - reach, z[0]), (at[0] + reach, at[1] + reach, z[1]), material)


def tube(radius: float, x: tuple[float, float], z: float) -> Polytope:
    """Make a lying prism of metal with eight sides around a circle of a radius at height z, between two x, m."""
    sides = 8
    angles = (np.arange(sides) + 0.5) * 2 * np.pi / sides
    around = np.column_stack([np.zeros(sides), np.cos(angles), np.sin(angles)])
    normals = np.vstack([around, [[1, 0, 0], [-1, 0, 0]]])
    offsets = np.append(radius + around[:, 2] * z, [x[1], -x[0]])
    reach = radius / np.cos(np.pi / sides)
    return _made(normals, offsets, (x[0], -reach, z - reach), (x[1], reach, z + reach), Material.METAL)


_ROUND = (np.arange(8) + 0.5) * np.pi / 4
# Normals of a wheel: eight around its axle, two along it.
_TREAD = np.vstack([np.column_stack([np.cos(_ROUND), np.zeros(8), np.sin(_ROUND)]), [[0, 1, 0], [0, -1, 0]]])
_FACES = np.vstack([np.eye(3), -np.eye(3)])


def wheel(radius: float, width: float, x: float, y: float) -> Polytope:
    """Make a wheel, standing on the ground, that rolls along x, m."""
    offsets = radius + _TREAD[:, 0] * x + _TREAD[:, 2] * radius
    offsets[8:] = y + width / 2, width / 2 - y
    reach = radius / np.cos(np.pi / 8)
    low, high = (x - reach, y - width / 2, radius - reach), (x + reach, y + width / 2, radius + reach)
    return _made(_TREAD, offsets, low, high, Material.DARK)


_GOLDEN = (1 + 5**0.5) / 2
_TWELVE = np.array([np.roll((0.0, s, t * _GOLDEN), shift) for shift in range(3) for s in (1, -1) for t in (1, -1)])
_TWELVE /= np.linalg.norm(_TWELVE, axis=1)[:, None]


def ellipsoid(radii: Sequence[float], center: Sequence[float], material: Material) -> Polytope:
    """Make the dodecahedron around an ellipsoid of three radii, m."""
    extents, middle = np.array(radii, np.float64), np.array(center, np.float64)
    normals = _TWELVE / extents
    length = np.linalg.norm(normals, axis=1)
    normals /= length[:, None]
    reach = extents * 1.2584  # circumradius of a dodecahedron over its inradius
    return _made(normals, 1 / length + normals @ middle, (middle - reach).tolist(), (middle + reach).tolist(), material)


INSIDE_M = 1e-4  # rounding of float32 planes
MIN_AREA_M2 = 1e-7
MIN_VOLUME = 1e-5  # of three unit normals that meet in a point


def meshes_of(objects: Sequence[Sequence[Polytope]], center_z_m: Sequence[float]) -> list[Mesh]:
    """Make the meshes of objects, flat-shaded.

    `objects`: parts of each, in its frame, which has its origin on the floor. `center_z_m`: height of each mesh's
    origin in that frame. Returns `part` holds the index of the part of each face.

    Corners are where triples of planes meet inside all others; around each face they are ordered by angle. Polytopes with
    equally many faces are worked on together.
    """
    flat = [polytope for parts in objects for polytope in parts]
    owner = np.repeat(np.arange(len(objects)), [len(parts) for parts in objects])
    local = np.concatenate([np.arange(len(parts)) for parts in objects]) if flat else np.zeros(0, np.int64)
    by_count: dict[int, list[int]] = {}
    for index, polytope in enumerate(flat):
        by_count.setdefault(len(polytope.offsets), []).append(index)
    corners, normals, polytopes = [np.zeros((0, 3, 3))], [np.zeros((0, 3))], [np.zeros(0, np.int64)]
    for rows in by_count.values():
        planes = np.array([flat[k].normals for k in rows], dtype=np.float64)
        offsets = np.array([flat[k].offsets for k in rows], dtype=np.float64)
        corner, normal, row = _faces(planes, offsets)
        corners.append(corner)
        normals.append(normal)
        polytopes.append(np.array(rows)[row])
    corner, normal, polytope_of = np.concatenate(corners), np.concatenate(normals), np.concatenate(polytopes)
    order = np.argsort(owner[polytope_of], kind="stable")
    ends = np.cumsum(np.bincount(owner[polytope_of], minlength=len(objects)))[:-1]
    out = []
    for k, z in zip(np.split(order, ends), center_z_m):
        vertices = corner[k].reshape(-1, 3) - [0.0, 0.0, z]
        faces = np.arange(len(vertices)).reshape(-1, 3)
        out.append(Mesh(vertices, np.repeat(normal[k], 3, axis=0), faces, local[polytope_of[k]]))
    return out


def _faces(planes: Array, offsets: Array) -> tuple[Array, Array, NDArray[np.int64]]:
    """Triangles (F, 3, 3) of polytopes with planes (B, K, 3) and offsets (B, K), their normals (F, 3) and polytopes (F,)."""
    count = planes.shape[1]
    triples = np.array(list(combinations(range(count), 3)))
    a, b, c = (planes[:, triples[:, i]] for i in range(3))
    da, db, dc = (offsets[:, triples[:, i], None] for i in range(3))
    bc = cross_products(b, c)
    volume = np.einsum("bti,bti->bt", a, bc)
    meets = np.abs(volume) > MIN_VOLUME
    point = da * bc + db * cross_products(c, a) + dc * cross_products(a, b)
    point /= np.where(meets, volume, 1.0)[..., None]
    outside = np.einsum("bki,bti->btk", planes, point) > offsets[:, None, :] + INSIDE_M
    corner = meets & ~outside.any(2)
    on_face = [np.flatnonzero((triples == k).any(1)) for k in range(count)]
    out = zip(*(_fan(planes[:, k], point[:, on], corner[:, on]) for k, on in enumerate(on_face)))
    triangles, normals, owners = (np.concatenate(parts) for parts in out)
    return triangles, normals, owners


def _fan(normal: Array, point: Array, corner: NDArray[np.bool_]) -> tuple[Array, Array, NDArray[np.int64]]:
    """Triangles of one face of each polytope: normals (B, 3), points (B, M, 3) and which are its corners (B, M)."""
    weight = corner / np.maximum(corner.sum(1, keepdims=True), 1)
    middle = np.einsum("bm,bmi->bi", weight, point)
    side = np.where(np.abs(normal[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    u = cross_products(side, normal)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = cross_products(normal, u)
    off = point - middle[:, None]
    angle = np.arctan2(np.einsum("bmi,bi->bm", off, v), np.einsum("bmi,bi->bm", off, u))
    order = np.argsort(np.where(corner, angle, np.inf), axis=1)
    ring = np.take_along_axis(point, order[..., None], 1)
    # What is no corner repeats the first one, which makes triangles without area.
    ring = np.where(np.take_along_axis(corner, order, 1)[..., None], ring, ring[:, :1])
    first = np.broadcast_to(ring[:, :1], ring[:, 1:-1].shape)
    triangles = np.stack([first, ring[:, 1:-1], ring[:, 2:]], 2)
    area = np.linalg.norm(cross_products(triangles[..., 1, :] - first, triangles[..., 2, :] - first), axis=2)
    owner, kept = np.nonzero((area > MIN_AREA_M2) & (corner.sum(1) >= 3)[:, None])
    return triangles[owner, kept], normal[owner], owner
