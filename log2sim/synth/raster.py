"""Z-buffered rasterization of triangle meshes, and rays against them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.synth.shapes import cross_products

MAX_PAIRS_PER_BATCH = 400_000
MIN_TRIANGLES_PER_GROUP, MAX_GROUPS = 16, 32  # measured on the meshes of road users
SPHERE_MARGIN_M = 1e-5


def first_hit(origin: Array, ray: Array, triangles: Array) -> Array:
    """Distance (N,) along rays (N, 3) to the nearest of triangles (F, 3 vertices, 3), inf where there is none.

    Moeller and Trumbore, Fast, Minimum Storage Ray/Triangle Intersection (1997); both sides of a triangle count. Triangles that
    lie together share a sphere around them, and only rays that meet the sphere are tested against them, in batches of
    bounded size.
    """
    out = np.full(len(ray), np.inf)
    if len(ray) == 0 or len(triangles) == 0:
        return out
    # Divided at medians into groups that lie together.
    means, groups = triangles.mean(1), [np.arange(len(triangles))]
    while len(groups[0]) > MIN_TRIANGLES_PER_GROUP and len(groups) < MAX_GROUPS:
        halves = []
        for rows in groups:
            axis = int(np.ptp(means[rows], axis=0).argmax())
            order = rows[np.argsort(means[rows, axis], kind="stable")]
            halves += [order[: len(order) // 2], order[len(order) // 2 :]]
        groups = halves
    ordered = triangles[np.concatenate(groups)]
    ends = np.cumsum([len(rows) for rows in groups])
    starts = np.concatenate([[0], ends[:-1]])
    low, high = np.minimum.reduceat(ordered.min(1), starts), np.maximum.reduceat(ordered.max(1), starts)
    # Spheres are larger by more than the rounding of the distances between rays and centers.
    centers, radii = (low + high) / 2, np.linalg.norm(high - low, axis=1) / 2 + SPHERE_MARGIN_M
    # Of each triangle the normal, not of unit length, the offset of its plane along it, second and first edge, for both
    # coordinates within it, and their products with its first vertex.
    a = ordered[:, 0]
    e1, e2 = ordered[:, 1] - a, ordered[:, 2] - a
    normal, edges = cross_products(e1, e2), np.stack([e2, e1])
    offset, moments = np.einsum("fi,fi->f", a, normal), cross_products(a[None], edges)
    moment, along_origin = cross_products(origin, ray), np.einsum("ni,ni->n", origin, ray)
    square_origin = np.einsum("ni,ni->n", origin, origin)
    for center, radius, rows, end in zip(centers, radii, groups, ends.tolist()):
        along = ray @ center - along_origin
        square = square_origin - 2 * (origin @ center) + center @ center
        near = np.flatnonzero((square - along**2 <= radius**2) & (along >= -radius))
        own, step = slice(end - len(rows), end), max(1, MAX_PAIRS_PER_BATCH // len(rows))
        for k in range(0, len(near), step):  # each ray against each triangle
            some = near[k : k + step]
            o, d, m = origin[some], ray[some], moment[some]
            determinant = -(d @ normal[own].T)
            # (o - a) . (d x e) from the moments o x d of the rays and a x e of the edges.
            u = m @ edges[0, own].T + d @ moments[0, own].T
            v = -(m @ edges[1, own].T + d @ moments[1, own].T)
            t = o @ normal[own].T - offset[own]
            solid = np.abs(determinant) > 1e-12
            scale = np.divide(1.0, determinant, out=np.zeros_like(determinant), where=solid)
            u, v, t = u * scale, v * scale, t * scale
            inside = solid & (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1 + 1e-9) & (t > 0)
            out[some] = np.minimum(out[some], np.where(inside, t, np.inf).min(1, initial=np.inf))
    return out


NEAR_M = 0.3
MIN_VOLUME_M3 = 1e-12  # of the tetrahedron of a face and the camera, below which the face is seen edge-on

Index = NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class Fragments:
    """The nearest surface of a mesh at each pixel that it covers, by ascending row and column."""

    u: Index  # (P,) int32: column and row
    v: Index
    depth_m: NDArray[np.float32]  # (P,), m: along the optical axis
    face: Index  # (P,) int32
    # (F, 3 vertices, 3): for each face and each of its vertices the coefficients of u, v and 1 of a linear function of the
    # image: the barycentric weight of the vertex divided by the depth
    planes: Array

    def pixel(self, width_px: int) -> Index:
        """Row-major indices (P,) into an image."""
        return self.v * np.int32(width_px) + self.u

    def part(self, rows: NDArray[Any]) -> Fragments:
        """Select fragments."""
        return Fragments(self.u[rows], self.v[rows], self.depth_m[rows], self.face[rows], self.planes)

    def interpolated(self, values: Array, faces: NDArray[np.int64]) -> NDArray[np.float32]:
        """Interpolate values (V, 3) of the vertices with the right perspective: (P, 3), each divided by its depth."""
        by_face = np.einsum("fik,fic->kcf", self.planes, values[faces]).astype(np.float32)
        u, v = self.u.astype(np.float32), self.v.astype(np.float32)
        out = np.empty((len(u), 3), np.float32)
        for c in range(3):
            out[:, c] = by_face[0, c][self.face] * u + by_face[1, c][self.face] * v + by_face[2, c][self.face]
        return out


@dataclass(frozen=True, eq=False)
class Samples:
    """All pixels that the faces of a mesh cover, row by row of each face."""

    pixel: Index  # (P,) int32: row-major index into the image
    nearness: NDArray[np.float32]  # (P,), 1/m: inverse depth
    row: Index  # (P,) int32: which row of which face
    row_face: Index  # (R,) int32: face and row of the image of each row
    row_v: Index
    planes: Array  # (F, 3 vertices, 3): as in `Fragments`
    width_px: int

    @classmethod
    def of(
        cls, vertices_cam: Array, faces: NDArray[np.int64], K: Array, width_px: int, height_px: int,
        passes: NDArray[np.float32] | None = None,
    ) -> Samples:  # fmt: skip
        """Cover the faces of a mesh for a pinhole camera; `passes` (F,) is the share of samples to leave out of each.

        `vertices_cam` (V, 3), m, cam frame. `faces` (F, 3): counter-clockwise from outside; those that look away are left
        out, and so is what is nearer than `NEAR_M`. `K` (3, 3), px: pixel centers are whole numbers, as in OpenCV.

        Edge functions in homogeneous coordinates, so that faces which reach behind the camera need no clipping: Olano &
        Greer, Triangle Scan Conversion using 2D Homogeneous Coordinates (Graphics Hardware 1997).
        """
        triangles = vertices_cam[faces]  # (F, 3 vertices, 3)
        # Weights over depth as linear functions of u, v, 1: (F, 3, 3); and whether a face looks at the camera (F,).
        a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
        normals = np.stack([cross_products(b, c), cross_products(c, a), cross_products(a, b)], 1)
        volume = np.einsum("fi,fi->f", a, normals[:, 0])
        facing = volume < -MIN_VOLUME_M3
        by_ray = normals / np.where(facing, volume, -1.0)[:, None, None]
        slope_u, slope_v = by_ray[..., 0] / K[0, 0], by_ray[..., 1] / K[1, 1]
        planes = np.stack([slope_u, slope_v, by_ray[..., 2] - slope_u * K[0, 2] - slope_v * K[1, 2]], 2)
        # Rows that faces can touch, from (F,) to before (F,); all rows where a face reaches behind the near plane.
        z = triangles[:, :, 2]
        ahead = z.min(1) > NEAR_M
        at = triangles[:, :, 1] / np.where(ahead[:, None], z, 1.0) * K[1, 1] + K[1, 2]
        low = np.where(ahead, np.clip(np.ceil(at.min(1)), 0, height_px), 0).astype(np.int32)
        high = np.where(ahead, np.clip(np.floor(at.max(1)) + 1, 0, height_px), height_px).astype(np.int32)
        kept = np.flatnonzero(facing & (high > low) & (triangles[:, :, 2].max(1) > NEAR_M)).astype(np.int32)
        # Near faces last, so that they are written over far ones.
        kept = kept[np.argsort(-triangles[kept, :, 2].sum(1))]
        height = (high - low)[kept]
        face = np.repeat(kept, height)
        v = _counted(height) + np.repeat(low[kept], height)
        first, length, constant, slope = _spans(planes, face, v, width_px)
        along = _counted(length)
        begin = (constant + slope * first).astype(np.float32)
        nearness = np.repeat(begin, length) + np.repeat(slope.astype(np.float32), length) * along.astype(np.float32)
        pixel = np.repeat(v * np.int32(width_px) + first, length) + along
        row = np.repeat(np.arange(len(face), dtype=np.int32), length)
        out = cls(pixel, nearness, row, face, v, planes, width_px)
        if passes is None:
            return out
        # Numbers in [0, 1) that look random and depend on the pixel alone.
        mixed = pixel.astype(np.uint32) * np.uint32(2654435761)
        mixed = (mixed ^ (mixed >> np.uint32(15))) * np.uint32(1274126177)
        stopped = (mixed >> np.uint32(16)).astype(np.float32) / 65536 >= passes[face][row]
        return cls(pixel[stopped], nearness[stopped], row[stopped], face, v, planes, width_px)

    def fragments(self, rows: Index) -> Fragments:
        """Select samples that are seen."""
        row = self.row[rows]
        v = self.row_v[row]
        u = self.pixel[rows] - v * np.int32(self.width_px)
        return Fragments(u, v, np.reciprocal(self.nearness[rows]), self.row_face[row], self.planes)


class ZBuffer:
    """The nearest of all samples that were added, and which one it is.

    `nearness` (N,) float32, 1/m: inverse depth of the background of each pixel; changed in place.
    """

    def __init__(self, nearness: NDArray[np.float32]) -> None:
        self.nearness = nearness
        self._winner = np.full(len(nearness), -1, np.int32)
        self._count = 0

    def add(self, samples: Samples) -> tuple[Fragments, Index, int]:
        """Add samples: those that are the nearest so far, their pixels, and the number of the first of them."""
        won = _win(self.nearness, samples.pixel, samples.nearness)
        pixel, first = samples.pixel[won], self._count
        self._count += len(won)
        self._winner[pixel] = np.arange(first, self._count, dtype=np.int32)
        return samples.fragments(won), pixel, first

    def still_seen(self, pixel: Index, first: int) -> NDArray[np.intp]:
        """Which of added samples (P,), given by their pixels and the number of the first, nothing has hidden since."""
        return np.flatnonzero(self._winner[pixel] == np.arange(first, first + len(pixel), dtype=np.int32))


def nearest_of(samples: Samples) -> Fragments:
    """Select the nearest sample of each pixel, by ascending pixel."""
    if len(samples.pixel) == 0:
        return samples.fragments(np.zeros(0, np.int32))
    at = samples.pixel - samples.pixel.min()
    best = np.zeros(int(at.max()) + 1, np.float32)
    winners = _win(best, at, samples.nearness)
    slot = np.full(len(best), -1, np.int32)
    slot[at[winners]] = winners
    return samples.fragments(slot[slot >= 0])


def _counted(counts: Index) -> Index:
    """0, 1, 2 ... within each of several runs."""
    ends = np.cumsum(counts, dtype=np.int32)
    total = int(ends[-1]) if len(ends) else 0
    return np.arange(total, dtype=np.int32) - np.repeat(ends - counts, counts)


def _spans(planes: Array, face: Index, v: Index, width_px: int) -> tuple[Index, Index, Array, Array]:
    """First column and number of columns of faces on rows (R,), and 1 / depth as a constant and a slope along each row."""
    low, high = np.zeros(len(v)), np.full(len(v), width_px - 1.0)
    constant, slope = np.zeros(len(v)), np.zeros(len(v))
    for vertex in range(3):
        coefficients = planes[:, vertex].T
        a, b = coefficients[0][face], coefficients[1][face] * v + coefficients[2][face]
        _narrow(low, high, a, b)
        constant += b
        slope += a
    _narrow(low, high, -slope, 1 / NEAR_M - constant)
    first = np.ceil(low).astype(np.int32)
    length = np.maximum(np.floor(high).astype(np.int32) - first + 1, 0)
    return first, length, constant, slope


def _narrow(low: Array, high: Array, slope: Array, constant: Array) -> None:
    """Narrow ranges (R,) in place to where slope * u + constant >= 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        root = np.clip(-constant / slope, -1.0, 1e7)  # within what an int32 holds
    np.maximum(low, root, out=low, where=slope > 0)
    np.minimum(high, root, out=high, where=slope < 0)
    high[(slope == 0) & (constant < 0)] = -1.0


def _win(best: NDArray[np.float32], at: Index, nearness: NDArray[np.float32]) -> Index:
    """Bring values (N,) up to those of samples (P,) and return the samples that have them then.

    Where several samples fall on one place, NumPy keeps the last; what is greater than that tries again.
    """
    left = np.flatnonzero(nearness > best[at]).astype(np.int32)
    candidates = left
    while len(left):
        places, values = at[left], nearness[left]
        best[places] = values
        left = left[values > best[places]]
    return np.asarray(candidates[nearness[candidates] == best[at[candidates]]])
