"""Motion of the ego from the images of one camera whose height above the ground is known.

Points are followed from image to image and give the rotation (essential matrix, Nister, PAMI 2004). The path in meters comes
from the road before the camera, seen from above: where it lies in the image follows from the mount of the camera. From above
the texture of the road moves as a rigid picture, whereas in the image it grows, which biases tracked points towards slower motion.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Log
from log2sim.errors import LogError
from log2sim.geometry import (
    NS_PER_S,
    Array,
    Camera,
    apply,
    inverse,
    nearest_rotation,
    project,
    rotation_from_rpy,
    transform,
    undistort,
    yaw_of,
)
from log2sim.localization.odometry import MAX_SPEED_MPS, Progress, is_during, share_of_motion
from log2sim.perception.records import RecordSource

MIN_CORNER = 1e-4
# Followed forward and back, a point ends where it began.
MAX_RETURN_PX = 0.7
# The road is seen from above over this rectangle before the camera; one pixel of the image is 0.1 m at 12 m with f = 700 px and
# a height of 1.5 m, and the rectangle has so many of its own pixels a meter.
MIN_ROAD_M, MAX_ROAD_M, ROAD_SIDE_M, ROAD_PX_PER_M = 3.0, 16.0, 6.0, 20.0
ROAD_POINTS, ROAD_WINDOW_PX, ROAD_SPACING_PX = 400, 15, 4
# Few levels: parts of the rectangle outside the image are constant and bias the coarse ones to no motion; motions are found within half a meter of a
# guess, and guesses are this far apart where the last motion does not help.
ROAD_LEVELS, GUESS_STEP_M = 2, 0.8
MIN_SHOWN_SHARE = 0.2


class RoadView:
    """The road before a camera, seen from above: `map_uv` (H, W, 2) are pixels of the image to look at, for each of the view.

    `shown` (H, W) uint8: 1 where the image shows the road, away from its border.
    """

    def __init__(self, camera: Camera, height_m: float, scale: float) -> None:
        ego_T_cam = camera.mount_T_cam
        ahead = ego_T_cam[:2, 2] / np.linalg.norm(ego_T_cam[:2, 2])
        self.axes = np.stack([-ahead, [ahead[1], -ahead[0]]])  # of rows, downward, and of columns, to the right
        self.corner = ego_T_cam[:2, 3] + ahead * MAX_ROAD_M - self.axes[1] * ROAD_SIDE_M
        rows, columns = ((np.array([MAX_ROAD_M - MIN_ROAD_M, 2 * ROAD_SIDE_M])) * ROAD_PX_PER_M).astype(int)
        j, i = np.meshgrid(np.arange(columns), np.arange(rows))
        xy = self.in_ego(np.column_stack([j.ravel(), i.ravel()]).astype(np.float64))
        points = np.column_stack([xy, np.full(len(xy), ego_T_cam[2, 3] - height_m)])
        uv, valid = project(camera, apply(inverse(ego_T_cam), points))
        valid &= (uv >= 0).all(axis=1) & (uv[:, 0] < camera.width_px) & (uv[:, 1] < camera.height_px)
        uv = np.where(valid[:, None], (uv + 0.5) * scale - 0.5, -1.0).astype(np.float32)
        self.map_uv = uv.reshape(rows, columns, 2)
        margin = np.ones((ROAD_WINDOW_PX, ROAD_WINDOW_PX), dtype=np.uint8)
        shown = valid.reshape(rows, columns).astype(np.uint8)
        self.shown = np.asarray(cv2.erode(shown, margin, borderType=cv2.BORDER_CONSTANT, borderValue=0), dtype=np.uint8)

    def in_ego(self, px: Array) -> Array:
        """Convert pixels (N, 2), column and row, to positions (N, 2), m, ego frame."""
        return np.asarray(self.corner + (px[:, 1:] * self.axes[0] + px[:, :1] * self.axes[1]) / ROAD_PX_PER_M)

    def view(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Look at the road of an image from above."""
        return np.asarray(cv2.remap(image, self.map_uv[..., 0], self.map_uv[..., 1], cv2.INTER_LINEAR), dtype=np.uint8)

    def followed(self, first: NDArray[np.uint8], second: NDArray[np.uint8], guess_m: Array) -> tuple[Array, Array]:
        """Follow the texture of the road from one view to the next: positions (N, 2), m, in the ego's frame at both."""
        if self.shown.mean() < MIN_SHOWN_SHARE:
            return np.zeros((0, 2)), np.zeros((0, 2))
        start = cv2.goodFeaturesToTrack(first, ROAD_POINTS, MIN_CORNER, ROAD_SPACING_PX, mask=self.shown)
        rows, columns = -self.axes @ guess_m * ROAD_PX_PER_M
        how: Any = {"window_px": ROAD_WINDOW_PX, "levels": ROAD_LEVELS, "guess_px": np.array([columns, rows])}
        begin, end = follow_points(first, second, start, **how)
        inside = np.clip(np.round(end).astype(int), 0, np.array(self.shown.shape)[::-1] - 1)
        good = self.shown[inside[:, 1], inside[:, 0]] > 0
        return self.in_ego(begin[good]), self.in_ego(end[good])


def follow_points(
    first: Any, second: Any, start: Any, *, window_px: int, levels: int, guess_px: Array | None = None
) -> tuple[Array, Array]:
    """Follow points (N, 1, 2), or None, to the next image and back: pixels (M, 2) of those that return.

    They move by about `guess_px` (2,), patches around them are `window_px` wide, and motion is searched in the image halved `levels`
    times first.
    """
    if start is None:
        return np.zeros((0, 2)), np.zeros((0, 2))
    shift = np.zeros(2, np.float32) if guess_px is None else guess_px.astype(np.float32)
    how: Any = {"winSize": (window_px, window_px), "maxLevel": levels, "flags": cv2.OPTFLOW_USE_INITIAL_FLOW}
    ahead, found, _ = cv2.calcOpticalFlowPyrLK(first, second, start, start + shift, **how)
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(second, first, ahead, np.asarray(ahead) - shift, **how)
    returned = np.linalg.norm((np.asarray(back) - start)[:, 0], axis=1) < MAX_RETURN_PX
    good = (np.asarray(found)[:, 0] == 1) & (np.asarray(found_back)[:, 0] == 1) & returned
    return np.asarray(start[good, 0], dtype=np.float64), np.asarray(np.asarray(ahead)[good, 0], dtype=np.float64)


MIN_HEIGHT_M = 0.4
# Brightness, 0 to 255, below which an image shows noise only; night under street lights has 20 or more.
MIN_BRIGHTNESS = 8.0
MAX_WIDTH_PX = 1000
MAX_POINTS, SPACING_PX = 900, 9
WINDOW_PX, LEVELS = 21, 4
MIN_FOLLOWED, MIN_ON_ROAD = 30, 12
TOLERANCE_PX = 0.7
STANDING_PX = 0.25
ROTATION_ROUNDS, MIN_ROTATION_SHARE = 8, 0.5
# Yaw rates of vehicles are below 1 rad/s; a steeper turn of two images is a wrong essential matrix.
MAX_YAW_RATE_RADPS = 1.5


@dataclass(frozen=True, eq=False)
class CameraPath:
    """Poses of the ego on a plane, in the ego's frame at the first image."""

    camera: str
    t_ns: NDArray[np.int64]  # (P,): increasing stamps
    start_T_ego: Array  # (P, 4, 4)
    # (P,): whether an image showed too little, so that the pose is predicted by constant velocity
    predicted: NDArray[np.bool_]
    frames: int  # number of images
    on_road: float  # median number of points on the road that agree on the motion


def motion_camera(log: Log) -> str:
    """Choose the camera on the ego to follow: the log's reference where it is one, else the one that looks ahead most.

    Raises `LogError` where no camera is on the ego, or the height of none is known.
    """
    names = [
        n for n, c in log.cameras.items() if c.mount == "ego" and n in log.streams and len(log.streams[n].t_ns) > 1
    ]
    if not names:
        raise LogError(
            f"{log.name}: the log has no ego poses, no LiDAR and no camera on the ego that show how it moves"
        )
    high = [n for n in names if height_m(log, log.cameras[n]) >= MIN_HEIGHT_M]
    if not high:
        low = height_m(log, log.cameras[names[0]])
        raise LogError(
            f"{log.name}: camera motion has no scale: camera '{names[0]}' is mounted {low:.2f} m above the ground; expected "
            f"at least {MIN_HEIGHT_M} m, so state the mount, or give poses"
        )
    ahead = max(high, key=lambda n: float(log.cameras[n].mount_T_cam[0, 2]))
    return log.reference_camera if log.reference_camera in high else ahead


def height_m(log: Log, camera: Camera) -> float:
    """Return the height of a camera above the road, m."""
    return float(camera.mount_T_cam[2, 3]) - log.ground_z_ego_m


def follow_camera(
    log: Log, name: str, *, during_ns: tuple[int, int] | None = None, progress: Progress | None = None
) -> CameraPath:
    """Estimate the path of the ego from the images of a camera; `LogError` where these are too dark or show too little of the road.

    The road is taken for a plane, to which the ego is level on average. Scale and heading drift: expect some percent of the path.
    """
    stream = log.streams[name]
    index = np.flatnonzero(is_during(stream.t_ns, during_ns))
    follower, records = _Follower(log, log.cameras[name]), RecordSource(log)
    t_ns, poses, predicted = [], [np.eye(4)], [False]
    last, motion, motion_s, dark = None, np.eye(4), 1.0, 0
    for done, i in enumerate(index.tolist(), 1):
        image = records.get(name, i)
        if image is not None:
            gray = follower.prepare(image)
            dark += float(gray.mean()) < MIN_BRIGHTNESS
            t_ns.append(int(stream.t_ns[i]))
            if last is not None:
                dt_s = (t_ns[-1] - t_ns[-2]) / NS_PER_S
                found = follower.motion(last, gray, dt_s)
                predicted.append(found is None)
                motion = share_of_motion(motion, np.array([dt_s / motion_s]))[0] if found is None else found
                motion_s = dt_s
                poses.append(poses[-1] @ motion)
            last = gray
        if progress is not None:
            progress(done, len(index))
    where = f"{log.name}: camera motion by '{name}'"
    if len(t_ns) < 2:
        raise LogError(f"{where}: {len(t_ns)} of {len(index)} images can be read; expected two at least")
    if dark > len(t_ns) / 2:
        raise LogError(f"{where}: {dark} of {len(t_ns)} images are too dark to show motion; give poses")
    if np.mean(predicted[1:]) > 0.5:
        raise LogError(
            f"{where}: {sum(predicted)} of {len(t_ns)} images show too little of the road to tell how far the ego moves; give poses"
        )
    on_road = float(np.median(follower.agreed)) if follower.agreed else 0.0
    stamps = np.array(t_ns, dtype=np.int64)
    return CameraPath(name, stamps, np.stack(poses), np.array(predicted), len(index), on_road)


class _Follower:
    """Motion between two images of one camera; `agreed`: numbers of points on the road that agreed on each motion."""

    def __init__(self, log: Log, camera: Camera) -> None:
        self.camera, self.height_m = camera, height_m(log, camera)
        self.scale = min(1.0, MAX_WIDTH_PX / camera.width_px)
        self.road = RoadView(camera, self.height_m, self.scale)
        self.agreed: list[int] = []
        self.last_mps = np.zeros(2)

    def prepare(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return an image in shades of gray, at most `MAX_WIDTH_PX` wide."""
        small = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        if self.scale < 1:
            small = cv2.resize(small, None, fx=self.scale, fy=self.scale, interpolation=cv2.INTER_AREA)
        return np.asarray(small, dtype=np.uint8)

    def motion(self, first: NDArray[np.uint8], second: NDArray[np.uint8], dt_s: float) -> Array | None:
        """Estimate the pose (4, 4) of the ego at the second image in its frame at the first; None where too little is seen."""
        corners = cv2.goodFeaturesToTrack(first, MAX_POINTS, MIN_CORNER, SPACING_PX)
        from_px, to_px = follow_points(first, second, corners, window_px=WINDOW_PX, levels=LEVELS)
        if len(from_px) < MIN_FOLLOWED:
            return None
        if np.median(np.linalg.norm(to_px - from_px, axis=1)) < STANDING_PX:
            return np.eye(4)
        from_xy, to_xy = (undistort(self.camera, px / self.scale) for px in (from_px, to_px))
        turn = self._turn(from_xy, to_xy)
        if turn is None or abs(float(yaw_of(turn))) > MAX_YAW_RATE_RADPS * dt_s:
            return None
        shift = self._shift(first, second, turn, dt_s)
        self.last_mps = self.last_mps if shift is None else shift / dt_s
        return None if shift is None else transform(rotation_from_rpy(0.0, 0.0, yaw_of(turn)), np.append(shift, 0.0))

    def _turn(self, from_xy: Array, to_xy: Array) -> Array | None:
        """Estimate the rotation (3, 3) of the ego at the second image in its frame at the first, from normalized points (N, 2)."""
        threshold = TOLERANCE_PX / self.scale / float(self.camera.K[0, 0])
        ego_R_cam = self.camera.mount_T_cam[:3, :3]
        only = _pure_rotation(from_xy, to_xy, threshold)
        if only is not None:
            return ego_R_cam @ only.T @ ego_R_cam.T
        essential, mask = cv2.findEssentialMat(from_xy, to_xy, np.eye(3), cv2.RANSAC, 0.999, threshold)
        if essential is None or essential.shape != (3, 3):
            return None
        _, second_R_first, _, _ = cv2.recoverPose(essential, from_xy, to_xy, np.eye(3), mask=mask)
        return np.asarray(ego_R_cam @ second_R_first.T @ ego_R_cam.T)

    def _shift(self, first: NDArray[np.uint8], second: NDArray[np.uint8], turn: Array, dt_s: float) -> Array | None:
        """Estimate the translation (2,), m, from the texture of the road, near the last motion or else from several guesses."""
        views = self.road.view(first), self.road.view(second)
        found = self._shift_near(*views, turn, self.last_mps * dt_s)
        if found is None:
            steps = np.arange(0.0, MAX_SPEED_MPS * dt_s, GUESS_STEP_M)
            tried = [self._shift_near(*views, turn, np.array([step, 0.0])) for step in steps.tolist()]
            found = max((t for t in tried if t is not None), key=lambda t: t[1], default=None)
        if found is None:
            return None
        self.agreed.append(found[1])
        return found[0]

    def _shift_near(
        self, first: NDArray[np.uint8], second: NDArray[np.uint8], turn: Array, guess_m: Array
    ) -> tuple[Array, int] | None:
        """Find the translation (2,), m, that most points of two views of the road agree on, and their number."""
        begin, end = self.road.followed(first, second, guess_m)
        if len(begin) < MIN_ON_ROAD:
            return None
        # A car nods by some tenths of a degree, which moves the road at 8 m by as many decimeters: what the rotation says of
        # it is taken out of the second view.
        mount = self.camera.mount_T_cam[:2, 3]
        rays = np.column_stack([end - mount, np.full(len(end), -self.height_m)]) @ turn.T
        shifts = begin - mount - rays[:, :2] * (self.height_m / -rays[:, 2])[:, None]
        shifts = shifts + mount - rotation_from_rpy(0.0, 0.0, yaw_of(turn))[:2, :2] @ mount
        # A pixel moves the point where a ray meets the road by its squared distance over the height.
        away = np.hypot(*(begin - mount).T)
        sigma = TOLERANCE_PX * (1 / ROAD_PX_PER_M + away**2 / (float(self.camera.K[0, 0]) * self.scale * self.height_m))
        apart = np.linalg.norm(shifts[:, None] - shifts[None], axis=2)
        agree = apart < 2 * np.hypot(sigma[:, None], sigma[None])
        best = agree[int(np.argmax((agree / sigma[None] ** 2).sum(axis=1)))]
        if best.sum() < MIN_ON_ROAD:
            return None
        weight = 1 / sigma[best] ** 2
        return (shifts[best] * weight[:, None]).sum(axis=0) / weight.sum(), int(best.sum())


def _pure_rotation(from_xy: Array, to_xy: Array, tolerance: float) -> Array | None:
    """Fit `second_R_first` (3, 3) to normalized image points (N, 2) without translation; None where it does not explain most.

    The essential matrix of an ego that hardly moves is undetermined. By iteratively reweighted least squares.
    """
    first, second = (np.column_stack([xy, np.ones(len(xy))]) for xy in (from_xy, to_xy))
    first, second = (rays / np.linalg.norm(rays, axis=1)[:, None] for rays in (first, second))
    weight, off = np.ones(len(first)), np.zeros(len(first))
    rotation = np.eye(3)
    for _ in range(ROTATION_ROUNDS):
        rotation = nearest_rotation((second * weight[:, None]).T @ first)
        off = np.linalg.norm(second - first @ rotation.T, axis=1)
        weight = 1 / (1 + (off / tolerance) ** 2) ** 2
    return rotation if np.mean(off < tolerance) > MIN_ROTATION_SHARE else None
