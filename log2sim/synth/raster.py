"""Z-buffered rasterization of triangle meshes with NumPy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array

NEAR_M = 0.3
FRAGMENTS_AT_ONCE = 3_000_000


@dataclass(frozen=True, eq=False)
class Fragments:
    """The nearest surface of a mesh at each pixel (P,) that it covers.

    `pixel` row-major index into the image, `depth_m` along the optical axis, `face` index, `weight` (P, 3) of the face's
    vertices, right in space and not only on the screen.
    """

    pixel: NDArray[np.int64]
    depth_m: NDArray[np.float32]
    face: NDArray[np.int64]
    weight: NDArray[np.float32]


def rasterize(
    vertices_cam: Array, faces: NDArray[np.int64], K: Array, width_px: int, height_px: int
) -> Fragments:
    """Find what a pinhole camera sees of a mesh alone.

    Parameters
    ----------
    vertices_cam : (V, 3) float64, m, cam frame
    faces : (F, 3) int
        Counter-clockwise from outside; faces that look away are left out, and so are those nearer than `NEAR_M`.
    K : (3, 3) float64, px
        Pixel centers are whole numbers, as in OpenCV.
    """
    tri = vertices_cam[faces]  # (F, 3 vertices, 3)
    outward = np.cross(tri[:, 1] - tri[:, 0], tri[:, 2] - tri[:, 0])
    keep = (np.einsum("fi,fi->f", outward, tri[:, 0]) < 0) & (tri[:, :, 2].min(1) > NEAR_M)
    index = np.flatnonzero(keep)
    tri = tri[index]
    inverse_z = 1.0 / tri[:, :, 2]
    u = tri[:, :, 0] * inverse_z * K[0, 0] + K[0, 2]
    v = tri[:, :, 1] * inverse_z * K[1, 1] + K[1, 2]
    u0, u1 = np.clip(np.ceil(u.min(1)), 0, width_px), np.clip(np.floor(u.max(1)) + 1, 0, width_px)
    v0, v1 = np.clip(np.ceil(v.min(1)), 0, height_px), np.clip(np.floor(v.max(1)) + 1, 0, height_px)
    area = (u[:, 1] - u[:, 0]) * (v[:, 2] - v[:, 0]) - (u[:, 2] - u[:, 0]) * (v[:, 1] - v[:, 0])
    count = (np.maximum(u1 - u0, 0) * np.maximum(v1 - v0, 0)).astype(np.int64)
    some = (count > 0) & (np.abs(area) > 1e-9)
    index, inverse_z, u, v, area, count = index[some], inverse_z[some], u[some], v[some], area[some], count[some]
    u0, v0, span = u0[some].astype(np.int64), v0[some].astype(np.int64), (u1[some] - u0[some]).astype(np.int64)
    parts = []
    first, total = 0, np.cumsum(count)
    while first < len(index):
        base = total[first - 1] if first else 0
        last = max(first + 1, int(np.searchsorted(total, base + FRAGMENTS_AT_ONCE)))
        part = slice(first, last)
        parts.append(_fragments(index[part], u[part], v[part], inverse_z[part], area[part], u0[part], v0[part], span[part], count[part], width_px))
        first = last
    if not parts:
        return Fragments(np.zeros(0, np.int64), np.zeros(0, np.float32), np.zeros(0, np.int64), np.zeros((0, 3), np.float32))
    pixel, near, face, weight = (np.concatenate(columns) for columns in zip(*parts))
    return _nearest(pixel, near, face, weight)


def _fragments(index, u, v, inverse_z, area, u0, v0, span, count, width_px):  # type: ignore[no-untyped-def]
    row = np.repeat(np.arange(len(index)), count)
    k = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    du, dv = k % span[row], k // span[row]
    # Edge functions relative to the corner of each face's own rectangle, where float32 has digits to spare.
    ru, rv = u - u0[:, None], v - v0[:, None]
    weights = []
    for a, b in ((1, 2), (2, 0), (0, 1)):
        slope_u, slope_v = (rv[:, a] - rv[:, b]) / area, (ru[:, b] - ru[:, a]) / area
        constant = (ru[:, a] * rv[:, b] - ru[:, b] * rv[:, a]) / area
        weights.append((constant.astype(np.float32)[row] + slope_u.astype(np.float32)[row] * du + slope_v.astype(np.float32)[row] * dv).astype(np.float32))
    inside = (weights[0] >= 0) & (weights[1] >= 0) & (weights[2] >= 0)
    row = row[inside]
    weight = np.stack([w[inside] for w in weights], 1) * inverse_z.astype(np.float32)[row]
    near = weight.sum(1)
    pixel = (v0[row] + dv[inside]) * width_px + u0[row] + du[inside]
    return pixel, near, index[row], weight / near[:, None]


def _nearest(pixel, near, face, weight) -> Fragments:  # type: ignore[no-untyped-def]
    order = np.lexsort((-near, pixel))
    first = np.ones(len(order), dtype=bool)
    first[1:] = pixel[order][1:] != pixel[order][:-1]
    keep = order[first]
    return Fragments(pixel[keep], 1.0 / near[keep], face[keep], weight[keep])
