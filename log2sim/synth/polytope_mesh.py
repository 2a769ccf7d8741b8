"""Triangle meshes of convex polytopes, for pictures of what the fast LiDAR casts."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.synth.polytopes import Polytope
from log2sim.synth.shapes import Mesh, cross_products

INSIDE_M = 1e-4  # rounding of float32 planes
MIN_AREA_M2 = 1e-7
MIN_VOLUME = 1e-5  # of three unit normals that meet in a point


def meshes_of(objects: Sequence[Sequence[Polytope]], center_z_m: Sequence[float]) -> list[Mesh]:
    """Make the meshes of objects, flat-shaded.

    Parameters
    ----------
    objects
        Parts of each, in its frame, which has its origin on the floor.
    center_z_m
        Height of each mesh's origin in that frame.

    Returns
    -------
    list of Mesh
        `part` holds the index of the part of each face.

    Notes
    -----
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
    out = [_fan(planes[:, k], point[:, on], corner[:, on]) for k, on in enumerate(_triples_with(triples, count))]
    return (
        np.concatenate([t for t, _, _ in out]),
        np.concatenate([n for _, n, _ in out]),
        np.concatenate([o for _, _, o in out]),
    )


def _triples_with(triples: NDArray[np.int64], count: int) -> list[NDArray[np.intp]]:
    return [np.flatnonzero((triples == k).any(1)) for k in range(count)]


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
