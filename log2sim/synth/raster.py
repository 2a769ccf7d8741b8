"""Z-buffered rasterization of triangle meshes with NumPy."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array

NEAR_M = 0.3
MAX_FRAGMENTS_PER_BATCH = 3_000_000


@dataclass(frozen=True, eq=False)
class Fragments:
    """The nearest surface of a mesh at each pixel that it covers.

    Attributes
    ----------
    pixel : (P,) int64
        Row-major index into the image.
    depth_m : (P,) float32, m
        Along the optical axis.
    face : (P,) int64
    weight : (P, 3) float32
        Perspective-correct barycentric weights of the face's vertices.
    """

    pixel: NDArray[np.int64]
    depth_m: NDArray[np.float32]
    face: NDArray[np.int64]
    weight: NDArray[np.float32]


def rasterize(vertices_cam: Array, faces: NDArray[np.int64], K: Array, width_px: int, height_px: int) -> Fragments:
    """Rasterize a mesh for a pinhole camera.

    Parameters
    ----------
    vertices_cam : (V, 3) float64, m, cam frame
    faces : (F, 3) int
        Counter-clockwise from outside; faces that look away are left out, and so are those nearer than `NEAR_M`.
    K : (3, 3) float64, px
        Pixel centers are whole numbers, as in OpenCV.
    """
    triangles = _on_screen(vertices_cam, faces, K, width_px, height_px)
    total = np.cumsum(triangles.count)
    parts = []
    first = 0
    while first < len(total):
        base = total[first - 1] if first else 0
        last = max(first + 1, int(np.searchsorted(total, base + MAX_FRAGMENTS_PER_BATCH)))
        parts.append(_covered(triangles.part(slice(first, last)), width_px))
        first = last
    if not parts:
        nothing = np.zeros(0, np.int64)
        return Fragments(nothing, np.zeros(0, np.float32), nothing, np.zeros((0, 3), np.float32))
    pixel, nearness, face, weight = (np.concatenate(columns) for columns in zip(*parts))
    order = np.lexsort((-nearness, pixel))
    first_of_pixel = np.ones(len(order), dtype=bool)
    first_of_pixel[1:] = pixel[order][1:] != pixel[order][:-1]
    keep = order[first_of_pixel]
    return Fragments(pixel[keep], np.float32(1.0) / nearness[keep].astype(np.float32), face[keep], weight[keep])


@dataclass(frozen=True, eq=False)
class _Triangles:
    """Faces in the image.

    Attributes
    ----------
    index : (F,) int64
        Of the face.
    u, v : (F, 3) float64, px
        Of the vertices.
    inverse_z : (F, 3) float64, 1/m
        Inverse depth of the vertices.
    area : (F,) float64, px2
        Twice the signed area.
    u0, v0 : (F,) int64, px
        First column and row of the surrounding rectangle.
    span : (F,) int64, px
        Width of the rectangle.
    count : (F,) int64
        Pixels in the rectangle.
    """

    index: NDArray[np.int64]
    u: Array
    v: Array
    inverse_z: Array
    area: Array
    u0: NDArray[np.int64]
    v0: NDArray[np.int64]
    span: NDArray[np.int64]
    count: NDArray[np.int64]

    def part(self, rows: slice | NDArray[np.bool_]) -> _Triangles:
        """Select faces."""
        return _Triangles(*(getattr(self, f.name)[rows] for f in fields(self)))


def _on_screen(vertices_cam: Array, faces: NDArray[np.int64], K: Array, width_px: int, height_px: int) -> _Triangles:
    tri = vertices_cam[faces]  # (F, 3 vertices, 3)
    outward = np.cross(tri[:, 1] - tri[:, 0], tri[:, 2] - tri[:, 0])
    keep = (np.einsum("fi,fi->f", outward, tri[:, 0]) < 0) & (tri[:, :, 2].min(1) > NEAR_M)
    tri = tri[keep]
    inverse_z = 1.0 / tri[:, :, 2]
    u = tri[:, :, 0] * inverse_z * K[0, 0] + K[0, 2]
    v = tri[:, :, 1] * inverse_z * K[1, 1] + K[1, 2]
    u0, u1 = (np.clip(x, 0, width_px).astype(np.int64) for x in (np.ceil(u.min(1)), np.floor(u.max(1)) + 1))
    v0, v1 = (np.clip(x, 0, height_px).astype(np.int64) for x in (np.ceil(v.min(1)), np.floor(v.max(1)) + 1))
    area = (u[:, 1] - u[:, 0]) * (v[:, 2] - v[:, 0]) - (u[:, 2] - u[:, 0]) * (v[:, 1] - v[:, 0])
    count = np.maximum(u1 - u0, 0) * np.maximum(v1 - v0, 0)
    triangles = _Triangles(np.flatnonzero(keep), u, v, inverse_z, area, u0, v0, u1 - u0, count)
    return triangles.part((count > 0) & (np.abs(area) > 1e-9))


def _covered(
    t: _Triangles, width_px: int
) -> tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.int64], NDArray[np.float32]]:
    """Pixel, inverse depth, face and weights of every sample inside a face."""
    row = np.repeat(np.arange(len(t.index)), t.count)
    k = np.arange(t.count.sum()) - np.repeat(np.cumsum(t.count) - t.count, t.count)
    du, dv = (x.astype(np.float32) for x in (k % t.span[row], k // t.span[row]))
    # Edge functions relative to the corner of each face's own rectangle, where float32 has digits to spare.
    ru, rv = t.u - t.u0[:, None], t.v - t.v0[:, None]
    weights = []
    for a, b in ((1, 2), (2, 0), (0, 1)):
        slope_u, slope_v = (rv[:, a] - rv[:, b]) / t.area, (ru[:, b] - ru[:, a]) / t.area
        constant = (ru[:, a] * rv[:, b] - ru[:, b] * rv[:, a]) / t.area
        c, su, sv = (x.astype(np.float32)[row] for x in (constant, slope_u, slope_v))
        weights.append(c + su * du + sv * dv)
    inside = (weights[0] >= 0) & (weights[1] >= 0) & (weights[2] >= 0)
    pixel = (t.v0[row] + k // t.span[row])[inside] * width_px + (t.u0[row] + k % t.span[row])[inside]
    row = row[inside]
    weight = np.stack([w[inside] for w in weights], 1) * t.inverse_z.astype(np.float32)[row]
    nearness = weight.sum(1)
    return pixel, nearness, t.index[row], weight / nearness[:, None]
