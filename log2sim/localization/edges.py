"""The yaw of a camera against a LiDAR, from edges that both see.

Where the range jumps from one LiDAR ray to the next, the image has an edge as well (Levinson & Thrun, "Automatic online
calibration of cameras and lasers", RSS 2013). Edges of sweeps are projected into images for a series of yaw angles of the
camera, and the strength of the image edges there is added up over the log.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from log2sim.datatypes import Log, Sweep
from log2sim.geometry import NS_PER_S, Array, Camera, apply, inverse, line_time_s, nearest_index, project
from log2sim.localization.clocks import turn_mount
from log2sim.localization.odometry import is_during
from log2sim.perception.lidar.cloud import sweep_to_map
from log2sim.perception.records import RecordSource

# A pixel is then some hundredths of a degree in most cameras.
MIN_WIDTH_PX = 800


# Nearer edges lie elsewhere in a camera's view when its position is off by centimeters; farther ones have few rays.
MIN_RANGE_M, MAX_RANGE_M = 5.0, 60.0
# What stands before a wall or a street stands out by a meter; far away rays along the road are farther apart than that.
MIN_JUMP_M, MIN_JUMP_SHARE = 1.0, 0.05
# The ray on the other side is on the same surface.
MAX_STEP_SHARE = 0.3
# An edge of what stands is at the same place in another sweep, but for the distance of rays; most of what moves is not.
MAX_SHIFT_M, MAX_SHIFT_RAD = 0.2, np.deg2rad(0.5)
# Neighboring rays of one laser are 0.1 to 0.4 degrees apart; those of one band of elevation belong to one or two lasers.
BAND_RAD, MAX_APART_RAD = np.deg2rad(0.2), np.deg2rad(0.8)
# More than the azimuths of a band differ.
WHOLE_TURN_RAD = 8.0


@dataclass(frozen=True, eq=False)
class DepthEdges:
    """Edges in one sweep."""

    points_map: Array  # (N, 3), m: the last points on the near side of each edge, map frame
    range_m: Array  # (N,): their distances from the LiDAR
    # (N,): whether the edge is the left one of what is near, seen from the LiDAR; else the right one
    left: NDArray[np.bool_]


def read_depth_edges(log: Log, lidar: str, index: int) -> DepthEdges | None:
    """Find the edges in a sweep of a log; None where it cannot be read or its pose is not known."""
    sweep: Sweep | None = RecordSource(log).get(lidar, index)
    mapped = None if sweep is None else sweep_to_map(log, lidar, sweep, compensate=True)
    if sweep is None or mapped is None or len(mapped[0]) < 2:
        return None
    rays = np.asarray(sweep.xyz_m, dtype=np.float64)
    if sweep.frame == "map":
        map_T_lidar, known = log.map_T_sensor(lidar, sweep.stamp_ns + round(float(np.median(mapped[1])) * NS_PER_S))
        if not known[0]:
            return None
        rays = apply(inverse(map_T_lidar[0]), rays)
    index_of, left = find_depth_edges(rays)
    return DepthEdges(mapped[0][index_of], np.linalg.norm(rays[index_of], axis=1), left)


def keep_standing(edges: DepthEdges, others: DepthEdges) -> DepthEdges:
    """Keep the edges that are at the same place, seen from above, in another sweep: what moves is elsewhere by then.

    A camera and a LiDAR see what moves at different times, which would turn one against the other.
    """
    stands = np.zeros(len(edges.left), dtype=bool)
    for side in (True, False):
        rows, there = np.flatnonzero(edges.left == side), others.points_map[others.left == side, :2]
        if len(rows) and len(there):
            apart_m, _ = cKDTree(there).query(edges.points_map[rows, :2])
            stands[rows] = apart_m < np.maximum(MAX_SHIFT_M, MAX_SHIFT_RAD * edges.range_m[rows])
    return DepthEdges(edges.points_map[stands], edges.range_m[stands], edges.left[stands])


def find_depth_edges(points: Array) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Find the points (n,) at which a near surface ends on its left, counter-clockwise, or right, and which of the two.

    `points` (N, 3), m: around the sensor, z along the axis that it turns about.
    """
    x, y, z = points.T
    range_m = np.sqrt(x * x + y * y + z * z)
    azimuth = np.arctan2(y, x)
    band = np.floor(np.arcsin(z / np.maximum(range_m, MIN_RANGE_M / 100)) / BAND_RAD)
    # By band, then azimuth, in one sort.
    order = np.argsort(band * WHOLE_TURN_RAD + azimuth, kind="stable")
    range_m, azimuth, band = range_m[order], azimuth[order], band[order]
    neighbors = (band[1:] == band[:-1]) & (np.diff(azimuth) < MAX_APART_RAD)
    inner = slice(1, -1)
    near = range_m[inner]
    jump = np.maximum(MIN_JUMP_M, MIN_JUMP_SHARE * near)
    usable = neighbors[:-1] & neighbors[1:] & (near > MIN_RANGE_M) & (near < MAX_RANGE_M)
    to_right, to_left = range_m[:-2] - near, range_m[2:] - near
    left = usable & (to_left > jump) & (np.abs(to_right) < MAX_STEP_SHARE * jump)
    right = usable & (to_right > jump) & (np.abs(to_left) < MAX_STEP_SHARE * jump)
    found = np.flatnonzero(left | right)
    return order[inner][found], left[found]


# Range of yaw angles that are tried, and their distance, which is half a pixel or less.
REACH_RAD, STEP_RAD = np.deg2rad(3.0), np.deg2rad(0.05)
# Errors of the range and the width of image edges spread what one edge says by this much.
SPREAD_RAD = np.deg2rad(0.12)
# A surface ends up to one ray after its last point, or before it where the beam is wide: half the largest distance of rays.
MAX_OVERHANG_RAD = np.deg2rad(0.3)
# Image edges count relative to those around them, over some degrees; noise of images stays below the floor.
AROUND_PX, MIN_GRADIENT, MAX_STRENGTH = (81, 31), 10.0, 6.0
MAX_EDGES = 1000
# A second maximum counts as another one if it is this far away.
APART_RAD = np.deg2rad(0.8)
BLOCKS, MIN_EDGES_A_SIDE = 5, 15
# One object that moves with the ego, or a row of posts, does not decide.
MIN_FRAMES = 4.0
# With the mount of another camera, in renderings and recorded drives, edges gain up to 0.15 at the best angle, and at most 5.3
# times as much as independent upright lines do by chance; with their own mount 0.2 and 7 times at least.
MIN_GAIN, MIN_CHANCES = 0.15, 6.0
LINE_RAD = np.deg2rad(0.25)
# Fences and rows of windows have several angles that fit alike.
MIN_RATIO = 1.7
MAX_SCATTER_RAD = np.deg2rad(0.25)
# Cameras see edges from other places than the LiDAR does, and their principal points are known to a pixel or two.
SYSTEMATIC_RAD = np.deg2rad(0.1)


@dataclass(frozen=True, eq=False)
class EdgeView:
    """One frame of a camera and the depth edges of the sweep that is nearest in time."""

    gray: NDArray[np.uint8]  # (H, W) uint8: the image
    scale: float  # pixels of `gray` per pixel of the camera
    points_mount: Array  # (N, 3), m: depth edges in the frame that the camera is fixed in, at the time of the image
    left: NDArray[np.bool_]  # (N,): see `DepthEdges`

    @cached_property
    def upright(self) -> NDArray[np.float32]:
        """Strength (H, W) of edges along the columns."""
        return find_image_edges(self.gray, sideways=False)

    @cached_property
    def level(self) -> NDArray[np.float32]:
        """Strength (H, W) of edges along the rows, which are upright for a camera that lies on its side."""
        return find_image_edges(self.gray, sideways=True)


@dataclass(frozen=True, eq=False)
class FrameScores:
    """How well a frame and its depth edges agree."""

    # (2, D): sum of the image's strength at edges on the left and on the right of what is near, for every yaw angle
    scores: Array
    edges: NDArray[np.int64]  # (2,): numbers of edges in the image at yaw 0
    # Sum of the squared numbers of edges on one upright line, over the lines: the variance of `scores` by chance
    squares: float


@dataclass(frozen=True)
class YawEstimate:
    """How far a camera is turned about the upright axis of what it is fixed in."""

    yaw_rad: float  # from its calibration to what the edges show, counter-clockwise seen from above
    sigma_rad: float  # standard deviation
    gain: float  # strength of the image at a depth edge, in units of the edges around, above that at other angles
    edges: int  # depth edges in the images


def find_image_edges(gray: NDArray[np.uint8], *, sideways: bool) -> NDArray[np.float32]:
    """Compute the strength (H, W) of edges that are upright in the world; `sideways` for a camera lying on its side."""
    smooth = cv2.GaussianBlur(gray.astype(np.float32), (0, 0), 1.0)
    across, along = (np.abs(cv2.Sobel(smooth, cv2.CV_32F, dx, dy, ksize=3)) for dx, dy in ((1, 0), (0, 1)))
    upright = np.maximum(along - across if sideways else across - along, 0)
    around = cv2.blur(upright, AROUND_PX[::-1] if sideways else AROUND_PX) + MIN_GRADIENT
    return np.asarray(np.minimum(upright / around, MAX_STRENGTH), dtype=np.float32)


def score_angles(camera: Camera, view: EdgeView) -> FrameScores:
    """Add up the strength of image edges at the depth edges of a view, for every yaw angle."""
    points, left = _near_image(camera, view)
    angles = yaw_angles()
    c, s = np.cos(angles)[:, None], np.sin(angles)[:, None]
    x, y, z = (points - camera.mount_T_cam[:3, 3]).T
    # Turning the camera by an angle turns what it sees by the opposite one.
    moved = np.stack(np.broadcast_arrays(c * x + s * y, c * y - s * x, z), axis=-1).reshape(-1, 3)
    uv, inside = project(camera, moved @ camera.mount_T_cam[:3, :3])
    lies_on_side = abs(camera.mount_T_cam[2, 0]) > abs(camera.mount_T_cam[2, 1])
    image = view.level if lies_on_side else view.upright
    rows = np.flatnonzero(inside)
    u, v = (
        np.clip(np.round((uv[rows, axis] + 0.5) * view.scale - 0.5), 0, image.shape[1 - axis] - 1).astype(np.int64)
        for axis in (0, 1)
    )
    # Relative to its surroundings an edge has strength 1 by chance, so edges that leave the image neither gain nor lose.
    flat = np.zeros(len(uv), dtype=image.dtype)
    flat[rows] = image[v, u] - 1.0
    strength = flat.reshape(len(angles), -1)
    shown = inside.reshape(len(angles), -1)[len(angles) // 2]
    scores = np.stack([strength[:, left].sum(axis=1), strength[:, ~left].sum(axis=1)])
    line = 2 * np.floor(np.arctan2(y, x) / LINE_RAD) + left
    _, on_line = np.unique(line[shown], return_counts=True)
    return FrameScores(scores, np.array([(shown & left).sum(), (shown & ~left).sum()]), float((on_line**2).sum()))


def yaw_angles() -> Array:
    """Return the yaw angles (D,), rad, that are tried."""
    half = round(REACH_RAD / STEP_RAD)
    return np.asarray(np.arange(-half, half + 1) * STEP_RAD)


def _near_image(camera: Camera, view: EdgeView) -> tuple[Array, NDArray[np.bool_]]:
    """Select the edges that are in the image at some angle, at most `MAX_EDGES`."""
    near = np.zeros(len(view.left), dtype=bool)
    for angle in np.linspace(-REACH_RAD, REACH_RAD, 3).tolist():
        cam_T_mount = inverse(turn_mount(camera.mount_T_cam, np.array([0.0, 0.0, angle])))
        near |= project(camera, apply(cam_T_mount, view.points_mount))[1]
    rows = np.flatnonzero(near)
    rows = rows[:: max(-(-len(rows) // MAX_EDGES), 1)]
    return view.points_mount[rows], view.left[rows]


def estimate_yaw(frames: Sequence[FrameScores]) -> YawEstimate | None:
    """Find the yaw angle at which depth edges and image edges agree, over frames in the order of time.

    None where no angle stands out, or parts of the log disagree. Surfaces end somewhat beyond their last point, or before it, which
    moves edges on the left and on the right in opposite ways: the overhang is found along with the angle. Sigma is that of the block
    jackknife over successive frames, which share errors, with `SYSTEMATIC_RAD`.
    """
    if len(frames) < MIN_FRAMES:
        return None
    scores = np.stack([frame.scores for frame in frames])
    sides = np.sum([frame.edges for frame in frames], axis=0)
    count, chance = int(sides.sum()), float(np.sqrt(sum(frame.squares for frame in frames)))
    angle_rad, height, ratio = _highest(scores.sum(axis=0))
    # As many frames support the angle as would, if all did alike, give a sum of this spread.
    near = np.abs(yaw_angles() - angle_rad) <= MAX_OVERHANG_RAD
    each = (scores - np.median(scores, axis=2, keepdims=True)).sum(axis=1)[:, near].max(axis=1).clip(min=0.0)
    supporting = float(each.sum() ** 2 / (each**2).sum()) if each.any() else 0.0
    if sides.min() < MIN_EDGES_A_SIDE or supporting < MIN_FRAMES:
        return None
    gain = height / count
    if ratio < MIN_RATIO or gain < MIN_GAIN or height < MIN_CHANCES * chance:
        return None
    block = np.arange(len(scores)) * BLOCKS // len(scores)
    others = np.array([_highest(scores[block != b].sum(axis=0))[0] for b in range(BLOCKS)])
    scatter = float(np.sqrt((BLOCKS - 1) * others.var()))
    if scatter > MAX_SCATTER_RAD:
        return None
    return YawEstimate(angle_rad, float(np.hypot(scatter, SYSTEMATIC_RAD)), gain, count)


def _highest(scores: Array) -> tuple[float, float, float]:
    """Find the maximum of scores (2, D) over angle and overhang: its angle, rad, height above the median, and that over the next one's."""
    angles, steps = yaw_angles(), round(MAX_OVERHANG_RAD / STEP_RAD)
    reach = round(2 * SPREAD_RAD / STEP_RAD)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) * STEP_RAD / SPREAD_RAD) ** 2)
    left, right = (np.convolve(side, kernel / kernel.sum(), mode="same") for side in scores)
    joint = np.max([np.roll(left, k) + np.roll(right, -k) for k in range(-steps, steps + 1)], axis=0)
    joint, angles = joint[reach + steps : -reach - steps], angles[reach + steps : -reach - steps]
    joint = joint - np.median(joint)
    k = int(np.argmax(joint))
    height, next_one = float(joint[k]), float(joint[np.abs(angles - angles[k]) > APART_RAD].max())
    ratio = height / max(next_one, height / 1000) if height > 0 else 0.0
    offset = 0.0
    if 0 < k < len(joint) - 1:
        # The vertex of a parabola through three values.
        before, middle, after = joint[k - 1 : k + 2]
        bend = before - 2 * middle + after
        offset = float((before - after) / bend / 2) if bend < 0 else 0.0
    return float(angles[k]) + offset * STEP_RAD, height, ratio


# Frames of a camera that are looked at: more make the estimate no better than its systematic part.
MAX_FRAMES = 12
# Between records of 10 Hz; what moves is left out.
MAX_APART_NS = 60_000_000
# From farther away other edges of an object are seen.
MAX_CAMERA_TO_LIDAR_M = 5.0


@dataclass(frozen=True, eq=False)
class Moments:
    """The sweeps that are looked at: rows (S,) of the stream of a LiDAR and their stamps (S,)."""

    lidar: str
    sweeps: NDArray[np.int64]
    t_ns: NDArray[np.int64]


def choose_moments(log: Log, lidar: str, reference: str, during_ns: tuple[int, int] | None) -> Moments:
    """Choose up to `MAX_FRAMES` sweeps, evenly spaced, that are near in time to frames of a reference camera."""
    frames, sweeps = log.streams[reference].t_ns, log.streams[lidar].t_ns
    frames = frames[is_during(frames, during_ns)]
    if not len(frames) or not len(sweeps):
        return Moments(lidar, np.zeros(0, np.int64), np.zeros(0, np.int64))
    # Away from the ends, where poses are extrapolated.
    share = (np.arange(MAX_FRAMES) + 0.5) / MAX_FRAMES
    chosen = frames[np.unique(np.floor(share * len(frames)).astype(np.int64))]
    rows = np.unique(nearest_index(sweeps, chosen))
    return Moments(lidar, rows, sweeps[rows])


class EdgeViews:
    """The views of all cameras at the moments that are looked at; every sweep and every frame is read once, when it is asked for."""

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
            row = int(self._moments.sweeps[k])
            # Edges that are there in the next sweep too, or in the one before the last.
            next_row = row + 1 if row + 1 < len(log.streams[self._moments.lidar].t_ns) else row - 1
            own = read_depth_edges(log, self._moments.lidar, row)
            others = None if own is None or next_row < 0 else read_depth_edges(log, self._moments.lidar, next_row)
            self._edges[k] = None if own is None or others is None else keep_standing(own, others)
            self._progress(len(self._edges), len(self._moments.sweeps))
        edges, frame = self._edges[k], int(nearest_index(stamps, np.array([t_ns]))[0])
        if edges is None or abs(int(stamps[frame]) - t_ns) > MAX_APART_NS:
            return None
        points = points_in_mount(log, log.cameras[name], int(stamps[frame]), edges.points_map)
        gray = None if points is None else RecordSource(log).picture(name, frame, MIN_WIDTH_PX, gray=True)
        if points is None or gray is None:
            return None
        return EdgeView(gray, gray.shape[1] / log.cameras[name].width_px, points, edges.left)


def is_near(log: Log, name: str, lidar: str) -> bool:
    """Return whether a camera is fixed beside a LiDAR."""
    camera, sensor = log.cameras[name], log.lidars[lidar]
    apart_m = np.linalg.norm(camera.mount_T_cam[:3, 3] - sensor.mount_T_lidar[:3, 3])
    return camera.mount == sensor.mount and bool(apart_m < MAX_CAMERA_TO_LIDAR_M)


def points_in_mount(log: Log, camera: Camera, t_ns: int, points_map: Array) -> Array | None:
    """Transform points (N, 3) to the frame that a camera is fixed in, when their lines are exposed; None without the ego's pose."""
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
