"""Rays against meshes of triangles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.synth.shapes import cross_products

MAX_PAIRS_PER_BATCH = 400_000
MIN_TRIANGLES_PER_GROUP, MAX_GROUPS = 16, 32  # measured on the meshes of road users
SPHERE_MARGIN_M = 1e-5


def first_hit(origin: Array, ray: Array, triangles: Array) -> Array:
    """Distance (N,) along rays (N, 3) to the nearest of triangles (F, 3 vertices, 3), inf where there is none.

    Notes
    -----
    Moeller and Trumbore, Fast, Minimum Storage Ray/Triangle Intersection (1997); both sides of a triangle count. Triangles that
    lie together share a sphere around them, and only rays that meet the sphere are tested against them, in batches of
    bounded size.
    """
    out = np.full(len(ray), np.inf)
    if len(ray) == 0 or len(triangles) == 0:
        return out
    groups = _groups_of(triangles)
    ordered = triangles[np.concatenate(groups)]
    ends = np.cumsum([len(rows) for rows in groups])
    planes, (centers, radii) = _Planes.of(ordered), _spheres_around(ordered, ends)
    moment, along_origin = cross_products(origin, ray), np.einsum("ni,ni->n", origin, ray)
    square_origin = np.einsum("ni,ni->n", origin, origin)
    for center, radius, rows, end in zip(centers, radii, groups, ends.tolist()):
        along = ray @ center - along_origin
        square = square_origin - 2 * (origin @ center) + center @ center
        near = np.flatnonzero((square - along**2 <= radius**2) & (along >= -radius))
        own = planes.part(end - len(rows), end)
        step = max(1, MAX_PAIRS_PER_BATCH // len(rows))
        for k in range(0, len(near), step):
            some = near[k : k + step]
            out[some] = np.minimum(out[some], own.nearest_hit(origin[some], ray[some], moment[some]))
    return out


def _groups_of(triangles: Array) -> list[NDArray[np.intp]]:
    """Divide triangles (F, 3, 3) at medians into groups that lie together: the indices of each."""
    middle, groups = triangles.mean(1), [np.arange(len(triangles))]
    while len(groups[0]) > MIN_TRIANGLES_PER_GROUP and len(groups) < MAX_GROUPS:
        halves = []
        for rows in groups:
            axis = int(np.ptp(middle[rows], axis=0).argmax())
            order = rows[np.argsort(middle[rows, axis], kind="stable")]
            halves += [order[: len(order) // 2], order[len(order) // 2 :]]
        groups = halves
    return groups


def _spheres_around(triangles: Array, ends: NDArray[np.int64]) -> tuple[Array, Array]:
    """Centers (G, 3) and radii (G,) of spheres around groups of triangles (F, 3, 3) that end at `ends` (G,)."""
    starts = np.concatenate([[0], ends[:-1]])
    low, high = np.minimum.reduceat(triangles.min(1), starts), np.maximum.reduceat(triangles.max(1), starts)
    # Larger by more than the rounding of the distances between rays and centers.
    return (low + high) / 2, np.linalg.norm(high - low, axis=1) / 2 + SPHERE_MARGIN_M


@dataclass(frozen=True, eq=False)
class _Planes:
    """Triangles as what products with rays need.

    Attributes
    ----------
    normal : (F, 3) float64
        Product of the edges, not of unit length.
    offset : (F,) float64
        Of the planes along their normals.
    edges : (2, F, 3) float64
        Second and first edge, for both coordinates within a triangle.
    moments : (2, F, 3) float64
        Products of these edges with the first vertex.
    """

    normal: Array
    offset: Array
    edges: Array
    moments: Array

    @classmethod
    def of(cls, triangles: Array) -> _Planes:
        """Compute the planes of triangles (F, 3, 3)."""
        a = triangles[:, 0]
        e1, e2 = triangles[:, 1] - a, triangles[:, 2] - a
        normal = cross_products(e1, e2)
        edges = np.stack([e2, e1])
        return cls(normal, np.einsum("fi,fi->f", a, normal), edges, cross_products(a[None], edges))

    def part(self, start: int, end: int) -> _Planes:
        """Take some of them."""
        rows = slice(start, end)
        return _Planes(self.normal[rows], self.offset[rows], self.edges[:, rows], self.moments[:, rows])

    def nearest_hit(self, o: Array, d: Array, moment: Array) -> Array:
        """Distance (N,) along rays to the nearest triangle, each tested against each; inf without one."""
        determinant = -(d @ self.normal.T)
        # (o - a) . (d x e) from the moments o x d of the rays and a x e of the edges.
        u = moment @ self.edges[0].T + d @ self.moments[0].T
        v = -(moment @ self.edges[1].T + d @ self.moments[1].T)
        t = o @ self.normal.T - self.offset
        solid = np.abs(determinant) > 1e-12
        scale = np.divide(1.0, determinant, out=np.zeros_like(determinant), where=solid)
        u, v, t = u * scale, v * scale, t * scale
        inside = solid & (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1 + 1e-9) & (t > 0)
        return np.asarray(np.where(inside, t, np.inf).min(1, initial=np.inf))
