"""The yaw of a camera against a LiDAR, from edges that both see.

Where the range jumps from one LiDAR ray to the next, the image has an edge as well (Levinson & Thrun, "Automatic online
calibration of cameras and lasers", RSS 2013). Edges of sweeps are projected into images for a series of yaw angles of the
camera, and the strength of the image edges there is added up over the log.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from log2sim.calibration.corrections import turn_mount
from log2sim.geometry import Array, Camera, inverse, project

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
    """One frame of a camera and the depth edges of the sweep that is nearest in time.

    Attributes
    ----------
    gray : (H, W) uint8
        The image.
    scale : float
        Pixels of `gray` per pixel of the camera.
    points_mount : (N, 3) float64, m
        Depth edges in the frame that the camera is fixed in, at the time of the image.
    left : (N,) bool
        See `DepthEdges`.
    """

    gray: NDArray[np.uint8]
    scale: float
    points_mount: Array
    left: NDArray[np.bool_]

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
    """How well a frame and its depth edges agree.

    Attributes
    ----------
    scores : (2, D) float64
        Sum of the strength of the image at edges on the left and on the right of what is near, for every yaw angle.
    edges : (2,) int64
        Numbers of edges in the image at yaw 0.
    squares : float
        Sum of the squared numbers of edges on one upright line, over the lines: the variance of `scores` by chance.
    """

    scores: Array
    edges: NDArray[np.int64]
    squares: float


@dataclass(frozen=True)
class YawEstimate:
    """How far a camera is turned about the upright axis of what it is fixed in.

    Attributes
    ----------
    yaw_rad : float
        From its calibration to what the edges show, counter-clockwise seen from above.
    sigma_rad : float
        Standard deviation.
    gain : float
        Strength of the image at a depth edge, in units of the edges around, above that at other angles.
    edges : int
        Depth edges in the images.
    """

    yaw_rad: float
    sigma_rad: float
    gain: float
    edges: int


def find_image_edges(gray: NDArray[np.uint8], *, sideways: bool) -> NDArray[np.float32]:
    """Compute the strength (H, W) of edges that are upright in the world; `sideways` for a camera lying on its side."""
    import cv2

    smooth = cv2.GaussianBlur(gray.astype(np.float32), (0, 0), 1.0)
    across, along = (np.abs(cv2.Sobel(smooth, cv2.CV_32F, dx, dy, ksize=3)) for dx, dy in ((1, 0), (0, 1)))
    upright = np.maximum(along - across if sideways else across - along, 0)
    around = cv2.blur(upright, AROUND_PX[::-1] if sideways else AROUND_PX) + MIN_GRADIENT
    return np.asarray(np.minimum(upright / around, MAX_STRENGTH), dtype=np.float32)


def is_sideways(mount_T_cam: Array) -> bool:
    """Return whether the rows of a camera's image are closer to upright than its columns."""
    return bool(abs(mount_T_cam[2, 0]) > abs(mount_T_cam[2, 1]))


def score_angles(camera: Camera, view: EdgeView) -> FrameScores:
    """Add up the strength of image edges at the depth edges of a view, for every yaw angle."""
    points, left = _near_image(camera, view)
    angles = yaw_angles()
    c, s = np.cos(angles)[:, None], np.sin(angles)[:, None]
    x, y, z = (points - camera.mount_T_cam[:3, 3]).T
    # Turning the camera by an angle turns what it sees by the opposite one.
    moved = np.stack(np.broadcast_arrays(c * x + s * y, c * y - s * x, z), axis=-1).reshape(-1, 3)
    uv, inside = project(camera, moved @ camera.mount_T_cam[:3, :3])
    image = view.level if is_sideways(camera.mount_T_cam) else view.upright
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
    return FrameScores(
        scores, np.array([(shown & left).sum(), (shown & ~left).sum()]), float((on_line.astype(np.float64) ** 2).sum())
    )


def yaw_angles() -> Array:
    """Return the yaw angles (D,), rad, that are tried."""
    half = round(REACH_RAD / STEP_RAD)
    return np.asarray(np.arange(-half, half + 1) * STEP_RAD)


def _near_image(camera: Camera, view: EdgeView) -> tuple[Array, NDArray[np.bool_]]:
    """Select the edges that are in the image at some angle, at most `MAX_EDGES`."""
    near = np.zeros(len(view.left), dtype=bool)
    for angle in np.linspace(-REACH_RAD, REACH_RAD, 3).tolist():
        cam_T_mount = inverse(turn_mount(camera.mount_T_cam, np.array([0.0, 0.0, angle])))
        near |= project(camera, view.points_mount @ cam_T_mount[:3, :3].T + cam_T_mount[:3, 3])[1]
    rows = np.flatnonzero(near)
    rows = rows[:: max(-(-len(rows) // MAX_EDGES), 1)]
    return view.points_mount[rows], view.left[rows]


def estimate_yaw(frames: Sequence[FrameScores]) -> YawEstimate | None:
    """Find the yaw angle at which depth edges and image edges agree, over frames in the order of time.

    None where no angle stands out, or parts of the log disagree.

    Notes
    -----
    Surfaces end somewhat beyond their last point, or before it, which moves edges on the left and on the right in opposite
    ways: the overhang is found along with the angle. Sigma is that of the block jackknife over successive frames, which
    share errors, with `SYSTEMATIC_RAD`.
    """
    if len(frames) < MIN_FRAMES:
        return None
    scores = np.stack([frame.scores for frame in frames])
    sides = np.sum([frame.edges for frame in frames], axis=0)
    count, chance = int(sides.sum()), float(np.sqrt(sum(frame.squares for frame in frames)))
    best = _highest(scores.sum(axis=0))
    if sides.min() < MIN_EDGES_A_SIDE or _count_supporting(scores, best.angle_rad) < MIN_FRAMES:
        return None
    gain = best.height / count
    if best.ratio < MIN_RATIO or gain < MIN_GAIN or best.height < MIN_CHANCES * chance:
        return None
    block = np.arange(len(scores)) * BLOCKS // len(scores)
    others = np.array([_highest(scores[block != b].sum(axis=0)).angle_rad for b in range(BLOCKS)])
    scatter = float(np.sqrt((BLOCKS - 1) * others.var()))
    if scatter > MAX_SCATTER_RAD:
        return None
    return YawEstimate(best.angle_rad, float(np.hypot(scatter, SYSTEMATIC_RAD)), gain, count)


def _count_supporting(scores: Array, angle_rad: float) -> float:
    """Count the frames that support an angle: as many as would, if all did alike, give a sum of that spread."""
    near = np.abs(yaw_angles() - angle_rad) <= MAX_OVERHANG_RAD
    height = (scores - np.median(scores, axis=2, keepdims=True)).sum(axis=1)[:, near].max(axis=1).clip(min=0.0)
    return float(height.sum() ** 2 / (height**2).sum()) if height.any() else 0.0


@dataclass(frozen=True)
class _Maximum:
    """The maximum over all angles: where, how high above the median, and that relative to the next one."""

    angle_rad: float
    height: float
    ratio: float


def _highest(scores: Array) -> _Maximum:
    """Find the maximum of scores (2, D) over angle and overhang."""
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
    return _Maximum(float(angles[k]) + _offset_of_vertex(joint, k) * STEP_RAD, height, ratio)


def _offset_of_vertex(values: Array, k: int) -> float:
    """Return how far, in steps, the maximum of a parabola through three values is from the middle one; 0 at the ends."""
    if not 0 < k < len(values) - 1:
        return 0.0
    before, middle, after = values[k - 1 : k + 2]
    bend = before - 2 * middle + after
    return float((before - after) / bend / 2) if bend < 0 else 0.0
