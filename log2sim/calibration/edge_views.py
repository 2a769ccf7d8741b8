"""Frames of cameras with the depth edges of the sweeps that are nearest in time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.calibration.depth_edges import DepthEdges, keep_standing, read_depth_edges
from log2sim.calibration.edge_alignment import EdgeView
from log2sim.calibration.gray_images import read_gray
from log2sim.datatypes import Log
from log2sim.geometry import NS_PER_S, Array, Camera, apply, inverse, line_time_s, nearest_index, project

# Frames of a camera that are looked at: more make the estimate no better than its systematic part.
MAX_FRAMES = 12
# Between records of 10 Hz; what moves is left out.
MAX_APART_NS = 60_000_000
# From farther away other edges of an object are seen.
MAX_CAMERA_TO_LIDAR_M = 5.0


@dataclass(frozen=True, eq=False)
class Moments:
    """The sweeps that are looked at.

    Attributes
    ----------
    lidar : str
    sweeps : (S,) int64
        Rows of its stream.
    t_ns : (S,) int64
    """

    lidar: str
    sweeps: NDArray[np.int64]
    t_ns: NDArray[np.int64]


def choose_moments(log: Log, lidar: str, reference: str, during_ns: tuple[int, int] | None) -> Moments:
    """Choose up to `MAX_FRAMES` sweeps, evenly spaced, that are near in time to frames of a reference camera."""
    frames, sweeps = log.streams[reference].t_ns, log.streams[lidar].t_ns
    if during_ns is not None:
        frames = frames[(frames >= during_ns[0]) & (frames <= during_ns[1])]
    if not len(frames) or not len(sweeps):
        return Moments(lidar, np.zeros(0, np.int64), np.zeros(0, np.int64))
    # Away from the ends, where poses are extrapolated.
    share = (np.arange(MAX_FRAMES) + 0.5) / MAX_FRAMES
    chosen = frames[np.unique(np.floor(share * len(frames)).astype(np.int64))]
    rows = np.unique(nearest_index(sweeps, chosen))
    return Moments(lidar, rows, sweeps[rows])


class EdgeViews:
    """The views of all cameras at the moments that are looked at; every sweep and every frame is read once, when it is asked for.

    Parameters
    ----------
    log : Log
    moments : Moments
    progress : callable
        Called as `progress(done, total)` for every sweep.
    """

    def __init__(self, log: Log, moments: Moments, progress: Callable[[int, int], None]) -> None:
        self._log, self._moments, self._progress = log, moments, progress
        self._edges: dict[int, DepthEdges | None] = {}
        self._views: dict[tuple[str, int], EdgeView | None] = {}

    def of_camera(self, name: str, *, every: int = 1) -> list[EdgeView]:
        """Return the views of a camera at every moment, or at every second, third, ..., in the order of time."""
        if not len(self._log.streams[name].t_ns):
            return []
        for k in range(0, len(self._moments.t_ns), every):
            if (name, k) not in self._views:
                self._views[name, k] = self._view(name, k)
        chosen = (self._views[name, k] for k in range(0, len(self._moments.t_ns), every))
        return [view for view in chosen if view is not None]

    def _view(self, name: str, k: int) -> EdgeView | None:
        log, stamps, t_ns = self._log, self._log.streams[name].t_ns, int(self._moments.t_ns[k])
        if k not in self._edges:
            self._edges[k] = _standing_edges(log, self._moments.lidar, int(self._moments.sweeps[k]))
            self._progress(len(self._edges), len(self._moments.sweeps))
        edges, frame = self._edges[k], int(nearest_index(stamps, np.array([t_ns]))[0])
        if edges is None or abs(int(stamps[frame]) - t_ns) > MAX_APART_NS:
            return None
        points = points_in_mount(log, log.cameras[name], int(stamps[frame]), edges.points_map)
        gray = None if points is None else read_gray(log.streams[name], frame, log.cameras[name])
        if points is None or gray is None:
            return None
        return EdgeView(gray, gray.shape[1] / log.cameras[name].width_px, points, edges.left)


def is_near(log: Log, name: str, lidar: str) -> bool:
    """Return whether a camera is fixed beside a LiDAR."""
    camera, sensor = log.cameras[name], log.lidars[lidar]
    apart_m = np.linalg.norm(camera.mount_T_cam[:3, 3] - sensor.mount_T_lidar[:3, 3])
    return camera.mount == sensor.mount and bool(apart_m < MAX_CAMERA_TO_LIDAR_M)


def points_in_mount(log: Log, camera: Camera, t_ns: int, points_map: Array) -> Array | None:
    """Transform points (N, 3) to the frame that a camera is fixed in, at the times when their lines are exposed.

    None where the ego's pose is not known.
    """
    if camera.mount == "map":
        return points_map
    if log.ego is None:
        return None
    map_T_ego, known = log.ego.at(t_ns)
    if not known[0]:
        return None
    points = apply(inverse(map_T_ego[0]), points_map)
    if camera.rolling_shutter is None:
        return points
    uv, _ = project(camera, apply(inverse(camera.mount_T_cam), points))
    exposed_ns = t_ns + np.round(line_time_s(camera, uv) * NS_PER_S).astype(np.int64)
    poses, known = log.ego.at(exposed_ns)
    return apply(inverse(np.where(known[:, None, None], poses, map_T_ego)), points_map)


def _standing_edges(log: Log, lidar: str, row: int) -> DepthEdges | None:
    """Find the edges of a sweep that are there in the next one too, or in the one before the last."""
    edges = read_depth_edges(log, lidar, row)
    next_row = row + 1 if row + 1 < len(log.streams[lidar].t_ns) else row - 1
    others = None if edges is None or next_row < 0 else read_depth_edges(log, lidar, next_row)
    return None if edges is None or others is None else keep_standing(edges, others)
