"""Visibility of boxes: LiDAR points inside them and the share of their outline in an image."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import MIN_DEPTH_M, Array, Camera, apply, box_corners, outline, points_in_box, project

CELL_M = 2.0
SAMPLES_PER_SIDE = 32


class PointGrid:
    """Points (N, 3) sorted into cells of 2 x 2 m, to count those in a box without testing all."""

    def __init__(self, points: NDArray[np.floating]) -> None:
        self._corner = points[:, :2].min(axis=0) if len(points) else np.zeros(2)
        cell = ((points[:, :2] - self._corner) / CELL_M).astype(np.int64)
        self._rows = int(cell[:, 1].max()) + 1 if len(points) else 1
        key = cell[:, 0] * self._rows + cell[:, 1]
        order = np.argsort(key, kind="stable")
        self._key, self._points = key[order], points[order].astype(np.float64)

    def count(self, center_m: Array, size_m: Array, yaw_rad: float) -> int:
        """Count the points inside one upright box."""
        reach = np.hypot(size_m[0], size_m[1]) / 2
        low = np.floor((center_m[:2] - reach - self._corner) / CELL_M).astype(np.int64)
        high = np.floor((center_m[:2] + reach - self._corner) / CELL_M).astype(np.int64)
        # A key outside 0 .. rows - 1 would spill into the neighboring column of cells.
        bottom, top = max(int(low[1]), 0), min(int(high[1]), self._rows - 1)
        if top < bottom:
            return 0
        columns = np.arange(low[0], high[0] + 1) * self._rows
        begin = np.searchsorted(self._key, columns + bottom)
        end = np.searchsorted(self._key, columns + top, side="right")
        inside = (points_in_box(self._points[b:e], center_m, size_m, yaw_rad) for b, e in zip(begin, end) if e > b)
        return int(sum(np.count_nonzero(mask) for mask in inside))


def image_shares(camera: Camera, cam_T_map: Array, center_m: Array, size_m: Array, yaw_rad: Array) -> Array:
    """Compute the share (M,) of the outline of each box of the map frame that lies inside the image.

    Notes
    -----
    The outline is the convex hull of the part of the box in front of the camera on the plane at depth 1, where edges are
    straight for any lens. The share is that of a grid of samples, accurate to 1 or 2 %: exact clipping would need the
    image border on that plane, which does not exist for every strong distortion.
    """
    corners = box_corners(center_m, size_m, yaw_rad)
    in_cam = apply(cam_T_map, corners.reshape(-1, 3))
    _, in_image = project(camera, in_cam)
    corner_inside = in_image.reshape(-1, 8)
    in_cam = in_cam.reshape(-1, 8, 3)
    shares = np.where(corner_inside.all(1), 1.0, 0.0)
    for k in np.flatnonzero(~corner_inside.all(1) & (in_cam[..., 2] > MIN_DEPTH_M).any(1)):
        samples = _samples(convex_hull(outline(in_cam[k])))
        if len(samples):
            _, inside = project(camera, np.column_stack([samples, np.ones(len(samples))]))
            shares[k] = inside.mean()
    return shares


def image_samples(camera: Camera, cam_T_map: Array, center_m: Array, size_m: Array, yaw_rad: Array) -> list[Array]:
    """Sample pixels (S, 2) evenly over the part of each box's outline inside the image; none for a box outside.

    Notes
    -----
    As in `image_shares`, but with a grid over the view only: next to the camera an outline on the plane at depth 1 can be
    so wide that a grid over all of it has no sample inside the image.
    """
    corners = apply(cam_T_map, box_corners(center_m, size_m, yaw_rad).reshape(-1, 3)).reshape(-1, 8, 3)
    low, high = _view(camera)
    found = []
    for box in corners:
        rays = _samples(convex_hull(outline(box)), low, high)
        uv, inside = project(camera, np.column_stack([rays, np.ones(len(rays))]))
        found.append(uv[inside])
    return found


def _view(camera: Camera) -> tuple[Array, Array]:
    """Bound the view on the plane at depth 1 by corners (2,), (2,); exact without distortion."""
    size, focal = np.array([camera.width_px, camera.height_px]), np.diag(camera.K)[:2]
    low, high = -camera.K[:2, 2] / focal, (size - camera.K[:2, 2]) / focal
    # Distortion widens a view on this plane to at most three times that of a pinhole.
    return (low, high) if camera.distortion_model == "none" else (3 * low, 3 * high)


def _samples(polygon: Array, lowest: Array | float = -np.inf, highest: Array | float = np.inf) -> Array:
    """Make a regular grid of points (S, 2) inside a convex polygon (K, 2), counter-clockwise, and between two corners (2,)."""
    if len(polygon) < 3:
        return np.zeros((0, 2))
    low, high = np.maximum(polygon.min(axis=0), lowest), np.minimum(polygon.max(axis=0), highest)
    if np.any(low >= high):
        return np.zeros((0, 2))
    steps = (np.arange(SAMPLES_PER_SIDE) + 0.5) / SAMPLES_PER_SIDE
    x, y = np.meshgrid(*(low + steps[:, None] * (high - low)).T)
    points = np.stack([x.ravel(), y.ravel()], -1)
    edge = np.roll(polygon, -1, axis=0) - polygon
    to = points[:, None] - polygon[None]
    return points[np.all(edge[:, 0] * to[..., 1] - edge[:, 1] * to[..., 0] >= 0, axis=1)]


def convex_hull(points: Array) -> Array:
    """Compute the convex hull (K, 2), counter-clockwise, of points (N, 2).

    Notes
    -----
    Andrew's monotone chain (1979). Points on one line give a polygon without area.
    """
    ordered = np.unique(points, axis=0).tolist()
    if len(ordered) < 3:
        return np.array(ordered)
    chains = []
    for run in (ordered, ordered[::-1]):
        chain: list[list[float]] = []
        for p in run:
            while len(chain) >= 2 and _turn(chain[-2], chain[-1], p) <= 0:
                chain.pop()
            chain.append(p)
        chains += chain[:-1]
    return np.array(chains)


def _turn(a: list[float], b: list[float], c: list[float]) -> float:
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
