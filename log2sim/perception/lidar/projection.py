"""Projection of clouds into images, and the projected points inside detection boxes."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Log
from log2sim.geometry import (
    MIN_DEPTH_M,
    NS_PER_S,
    Array,
    Camera,
    ProjectedBoxes,
    fold_radius,
    inverse,
    line_time_s,
    project,
    project_boxes,
    project_moving,
    transform,
    undistort,
)

BORDER_SAMPLES = 33
# Margin for the curvature of the image border between its samples, and the widest frustum, both as tangents.
SLACK, WIDEST = 0.01, 20.0
# By how much, as a tangent, a point may move in the image while it is read: 0.05 s at 1 rad/s and 30 m/s past what is 10 m away.
READOUT_SLACK = 0.25


@dataclass(frozen=True, eq=False)
class View:
    """A camera frame: camera, stamp and pose."""

    camera: Camera
    t_ns: int
    map_T_cam: Array  # (4, 4): pose at the stamp
    # Transforms (K, 4, 4) at times (K,), s, relative to the stamp, for an image whose lines are exposed one after the other
    cam_T_map_at: Callable[[Array], Array] | None = None


@dataclass(frozen=True, eq=False)
class ProjectedPoints:
    """Points inside an image."""

    index: NDArray[np.intp]  # (n,): rows among the points that were projected
    u: NDArray[np.float32]  # `u`, `v`: (n,): pixels, u right, v down
    v: NDArray[np.float32]
    depth: NDArray[np.float32]  # (n,): m along the optical axis


def view_of(log: Log, camera: str, t_ns: int) -> View | None:
    """Return the view of a camera's frame at its stamp; None where its pose is not known."""
    map_T_cam, known = log.map_T_sensor(camera, t_ns)
    if not known[0]:
        return None
    sensor = log.cameras[camera]
    moves = sensor.rolling_shutter is not None and sensor.mount == "ego"
    return View(sensor, t_ns, map_T_cam[0], poses_around(log, camera, t_ns) if moves else None)


def poses_around(log: Log, camera: str, t_ns: int) -> Callable[[Array], Array]:
    """Return a function of times (K,), s, relative to a stamp: transforms (K, 4, 4) of the map to a camera.

    Where no pose is known it is that of the stamp, which must be known.
    """

    def cam_T_map_at(t_s: Array) -> Array:
        stamps = t_ns + np.round(np.append(t_s, 0.0) * NS_PER_S).astype(np.int64)
        map_T_cam, known = log.map_T_sensor(camera, stamps)
        return inverse(np.where(known[:-1, None, None], map_T_cam[:-1], map_T_cam[-1]))

    return cam_T_map_at


class _Workspace(threading.local):
    """Working memory of a thread, reused between frames: allocating pages costs more than the projection itself."""

    def __init__(self) -> None:
        self._numbers = np.empty(0, dtype=np.float32)
        self._marks = np.empty(0, dtype=np.bool_)

    def take(self, count: int) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Return uninitialized numbers (4, count) and marks (2, count)."""
        if len(self._numbers) < 4 * count:
            self._numbers, self._marks = np.empty(4 * count, dtype=np.float32), np.empty(2 * count, dtype=np.bool_)
        return self._numbers[: 4 * count].reshape(4, count), self._marks[: 2 * count].reshape(2, count)


_workspace = _Workspace()


def project_points(view: View, origin: Array, columns: NDArray[np.float32]) -> ProjectedPoints:
    """Project points given as rows x, y, z (3, N) float32, relative to `origin` (3,) in the map frame.

    One product in single precision rotates the points and applies the intrinsics; points outside the frustum are dropped
    before the division by depth. With a lens distortion the remaining points are projected in double precision; so they are
    where the camera moves while its lines are read, each point by the pose at the time of its line.
    """
    camera, cam_R_map, cam_T_map_at = view.camera, view.map_T_cam[:3, :3].T, view.cam_T_map_at
    offset = cam_R_map @ (origin - view.map_T_cam[:3, 3])
    if cam_T_map_at is not None:
        rough = cam_R_map.astype(np.float32) @ columns + offset.astype(np.float32)[:, None]
        first, last = (edge.astype(np.float32)[:, None] for edge in _frustum(camera))
        near = (rough[:2] >= (first - READOUT_SLACK) * rough[2]) & (rough[:2] <= (last + READOUT_SLACK) * rough[2])
        index = np.flatnonzero(near.all(axis=0) & (rough[2] > MIN_DEPTH_M))
        map_T_origin, points = transform(np.eye(3), origin), columns[:, index].T.astype(np.float64)
        uv, depth_m, inside = project_moving(camera, points, lambda t_s: cam_T_map_at(t_s) @ map_T_origin)
        u, v = uv[inside].T.astype(np.float32)
        return ProjectedPoints(index[inside], u, v, depth_m[inside].astype(np.float32))
    lens = camera.distortion_model != "none"
    K = np.eye(3) if lens else camera.K
    low, high = _frustum(camera) if lens else (np.zeros(2), np.array([camera.width_px, camera.height_px], dtype=float))
    numbers, (mark, other) = _workspace.take(columns.shape[1])
    turned, bound = numbers[:3], numbers[3]
    np.matmul((K @ cam_R_map).astype(np.float32), columns, out=turned)
    turned += (K @ offset).astype(np.float32)[:, None]
    z = turned[2]
    np.greater(z, np.float32(MIN_DEPTH_M), out=mark)
    for axis in (0, 1):
        # The lower bounds of a pinhole's image are zero.
        edge = np.multiply(z, np.float32(low[axis]), out=bound) if lens else np.float32(0.0)
        mark &= np.greater_equal(turned[axis], edge, out=other)
        np.multiply(z, np.float32(high[axis]), out=bound)
        mark &= np.less(turned[axis], bound, out=other)
    index = np.flatnonzero(mark)
    depth = z[index]
    if not lens:
        return ProjectedPoints(index, turned[0][index] / depth, turned[1][index] / depth, depth)
    uv, inside = project(camera, turned[:, index].T)
    u, v = uv[inside].T.astype(np.float32)
    return ProjectedPoints(index[inside], u, v, depth[inside])


def project_boxes_in_view(view: View, center_m: Array, size_m: Array, yaw_rad: Array) -> ProjectedBoxes:
    """Project upright boxes (L, 3), (L, 3), (L,) of the map frame into a frame; see `log2sim.geometry.project_boxes`.

    Where the camera moves while its lines are read, each box takes the pose at the time of the line that shows its middle.
    """
    projected = project_boxes(center_m, size_m, yaw_rad, view.camera, inverse(view.map_T_cam))
    if view.cam_T_map_at is None or not projected.valid.any():
        return projected
    box, valid, range_m = projected.box_px.copy(), projected.valid.copy(), projected.range_m.copy()
    rows = np.flatnonzero(valid)
    middle_px = (box[rows, :2] + box[rows, 2:]) / 2
    for i, cam_T_map in zip(rows, view.cam_T_map_at(line_time_s(view.camera, middle_px))):
        one = project_boxes(center_m[i : i + 1], size_m[i : i + 1], yaw_rad[i : i + 1], view.camera, cam_T_map)
        valid[i], box[i], range_m[i] = one.valid[0], one.box_px[0], one.range_m[0]
    return ProjectedBoxes(valid, box, range_m)


@lru_cache(maxsize=64)
def _frustum(camera: Camera) -> tuple[Array, Array]:
    """Bound x / z and y / z, (2,) and (2,), of the rays that reach the image, from samples of its border."""
    along = np.linspace(0.0, 1.0, BORDER_SAMPLES)
    zero, one = np.zeros(BORDER_SAMPLES), np.ones(BORDER_SAMPLES)
    border = np.stack([np.r_[along, along, zero, one], np.r_[zero, one, along, along]], axis=1)
    rays = undistort(camera, border * [camera.width_px, camera.height_px])
    if np.isnan(rays).any():
        # No ray reaches some border pixels: the lens model folds inside the image, so the fold radius is the bound.
        reach = min(fold_radius(camera), WIDEST)
        return np.full(2, -reach), np.full(2, reach)
    return rays.min(axis=0) - SLACK, rays.max(axis=0) + SLACK


def points_in_image_boxes(points: ProjectedPoints, box_px: Array, margin: float = 0.0) -> list[NDArray[np.intp]]:
    """Find the rows of projected points inside each box (M, 4), in rising order.

    `margin`: share of its sides by which a box is widened to the left, right and top.

    Points are sorted by integer pixel column once; only those in the columns of a box are compared with it.
    """
    if len(box_px) == 0:
        return []
    column = points.u.astype(np.uint16)
    order = np.argsort(column, kind="stable")
    column, u, v = column[order], points.u[order], points.v[order]
    wide, tall = margin * (box_px[:, 2:] - box_px[:, :2]).T
    left, top = box_px[:, 0] - wide, box_px[:, 1] - tall
    right, bottom = box_px[:, 2] + wide, box_px[:, 3]
    # Boxes may extend beyond the image; boxes of NaN contain no points.
    first, last = (np.clip(np.nan_to_num(edge), 0, 65535).astype(np.uint16) for edge in (left, right))
    first, last = np.searchsorted(column, first, "left"), np.searchsorted(column, last, "right")
    edges = np.stack([left, top, right, bottom], axis=1).tolist()
    found = []
    for a, b, (u0, v0, u1, v1) in zip(first.tolist(), last.tolist(), edges, strict=True):
        us, vs = u[a:b], v[a:b]
        found.append(np.sort(order[a:b][(us >= u0) & (us <= u1) & (vs >= v0) & (vs <= v1)]))
    return found
