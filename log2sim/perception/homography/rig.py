"""Cameras of a rig over one ground plane: their correspondences, and the plane by RANSAC over all of them.

All cameras of a rig see the same ground, and one detector finds their boxes. So the plane of the ground relative to the rig
and the systematic error of the boxes' feet are parameters of the rig; a camera has a rotation of its mount of its own.

A ray of a calibrated camera passes over the ground position that it shows at a height, which is linear in the plane. So
correspondences of different cameras serve one hypothesis, three determine it, and all of them judge it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array, Camera, inverse, shift_poses
from log2sim.perception.homography.correspondences import Correspondences
from log2sim.perception.homography.normalized import scaled

# Ground ahead of a camera at which the errors of its homography are predicted.
PROBE_M = 20.0


@dataclass(frozen=True, eq=False)
class Rig:
    """Cameras that see one ground plane."""

    cameras: Mapping[str, Camera]
    # (4, 4) each: the rig frame is the ground frame of the correspondences with its origin on the ground below the cameras' mean
    cam_T_rig: Mapping[str, Array]
    origin_m: Array  # (3,): origin of the rig frame in the ground frame of the correspondences

    @classmethod
    def of(cls, cameras: Mapping[str, Camera], ground_z_m: float) -> Rig:
        """Make the rig of cameras whose mounts are poses in one frame, in which the ground is at `ground_z_m`."""
        places = np.array([c.mount_T_cam[:3, 3] for c in cameras.values()])
        origin = np.array([*places[:, :2].mean(axis=0), ground_z_m])
        poses = {name: inverse(shift_poses(camera.mount_T_cam, origin)) for name, camera in cameras.items()}
        return cls(cameras, poses, origin)


@dataclass(frozen=True, eq=False)
class RigState:
    """What is fitted on top of the calibration of a rig."""

    # (3,): height of the ground in the rig frame: its slopes along x and along y, and its height at the origin, m
    plane: Array
    below_px: float  # how far below the lower edge of its box an obstacle touches the ground
    # Height above the road at which the feet of boxes in a camera seem to lie: boxes end at the tires, which stand behind
    # the nearest side of a vehicle, by more where a camera sees its ends than where it sees its sides
    lift_m: Mapping[str, float]
    # Mapping of str to (3,) float64: rotation of each camera against its calibration that the feet of boxes ask for, rad,
    # camera frame
    feet: Mapping[str, Array]

    @classmethod
    def calibrated(cls, rig: Rig, plane: Array) -> RigState:
        """Make the state of a rig that is as its calibration says, over a plane (3,)."""
        return cls(plane, 0.0, dict.fromkeys(rig.cameras, 0.0), {name: np.zeros(3) for name in rig.cameras})


def rotation_of(vector: Array) -> Array:
    """Compute the rotation matrices (..., 3, 3) of rotation vectors (..., 3), rad (Rodrigues)."""
    v = np.asarray(vector, dtype=np.float64)
    angle = np.linalg.norm(v, axis=-1)[..., None, None]
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    cross = np.zeros((*v.shape[:-1], 3, 3))
    cross[..., 2, 1], cross[..., 0, 2], cross[..., 1, 0] = x, y, z
    cross -= np.swapaxes(cross, -1, -2)
    return np.asarray(np.eye(3) + np.sinc(angle / np.pi) * cross + np.sinc(angle / 2 / np.pi) ** 2 / 2 * cross @ cross)


def cam_of_ground(cam_T_rig: Array, plane: Array, turn: Array) -> Array:
    """Compute the matrices (..., 3, 3) from ground positions (x, y, 1), rig frame, to points in a camera (4, 4).

    `plane`: (..., 3). `turn`: (3, 3): rotation of the camera against its calibration.
    """
    r, t = turn @ cam_T_rig[:3, :3], turn @ cam_T_rig[:3, 3]
    rise = r[:, 2, None] * np.asarray(plane)[..., None, :]
    return np.asarray(np.column_stack([r[:, :2], t]) + rise)


def foot_homography(rig: Rig, state: RigState, name: str, plane: Array | None = None) -> Array:
    """Compute `ground_H_image` (..., 3, 3) of the feet of boxes at the nearest sides of obstacles.

    px and m, in the ground frame of the correspondences; `plane` (..., 3) replaces that of the state, as that of a tick does.
    """
    lifted = (state.plane if plane is None else plane) + [0.0, 0.0, state.lift_m[name]]
    image_H_ground = rig.cameras[name].K @ cam_of_ground(rig.cam_T_rig[name], lifted, rotation_of(state.feet[name]))
    back, below = np.eye(3), np.eye(3)
    back[:2, 2], below[1, 2] = rig.origin_m[:2], state.below_px
    return scaled(scaled(back @ np.linalg.inv(image_H_ground)) @ below)


# Steps at which the change of a homography by the parameters of the feet is read: px, m and rad.
STEPS = np.array([1e-3, 1e-5, 1e-7, 1e-7, 1e-7])


def foot_covariance(rig: Rig, state: RigState, name: str, covariance: Array) -> Array:
    """Compute the covariance (9, 9) of the elements of `foot_homography`, row by row.

    `covariance` (5, 5) is that of `below_px`, and of `lift_m` and the rotation `feet` of the camera.
    """
    columns = []
    for k, step in enumerate(STEPS):
        d = step * np.eye(len(STEPS))[k]
        ends = [
            replace(
                state,
                below_px=state.below_px + sign * d[0],
                lift_m={**state.lift_m, name: state.lift_m[name] + sign * d[1]},
                feet={**state.feet, name: state.feet[name] + sign * d[2:]},
            )
            for sign in (1.0, -1.0)
        ]
        after, before = (foot_homography(rig, end, name) for end in ends)
        columns.append((after - before).ravel() / (2 * step))
    by_parameter = np.column_stack(columns)
    return np.asarray(by_parameter @ covariance @ by_parameter.T)


def probe_of(rig: Rig, state: RigState, name: str) -> Array | None:
    """Return the pixel (1, 2) that shows the ground `PROBE_M` ahead of a camera; None where it does not see so far."""
    axis, place = rig.cam_T_rig[name][2, :2], inverse(rig.cam_T_rig[name])[:2, 3]
    if not np.hypot(*axis) > 0:
        return None
    at = place + PROBE_M * axis / np.hypot(*axis) + rig.origin_m[:2]
    point = np.linalg.inv(foot_homography(rig, state, name)) @ [*at, 1.0]
    return np.asarray(point[None, :2] / point[2]) if point[2] > 0 else None


# Parameters of feet: one that all cameras share, then of each camera the height of feet above the road, m, and its rotation.
SHARED, OF_CAMERA = 1, 4


@dataclass(frozen=True, eq=False)
class RigRows:
    """Correspondences of all cameras of a rig, sorted by tick."""

    camera: NDArray[np.int64]  # (N,): number of the camera within the rig
    ray: Array  # (N, 2): normalized image coordinates
    xy: Array  # (N, 2): ground positions, m, rig frame
    tick: NDArray[np.int64]  # (N,): tick of the log
    focal_px: Array  # (N,): of the cameras
    sigma_px: Array  # `sigma_px`, `sigma_m`: (N,): standard deviations of pixels and of ground positions
    sigma_m: Array

    @classmethod
    def of(cls, rig: Rig, found: Mapping[str, Correspondences], sigma_px: float, sigma_m: float) -> RigRows:
        """Join the correspondences of the cameras; rows that are not finite are left out."""
        parts = []
        for k, (name, camera) in enumerate(rig.cameras.items()):
            rows = found.get(name) or Correspondences.join([])
            rows = rows.take(np.isfinite(np.column_stack([rows.uv, rows.xy_ego])).all(axis=1))
            K, one = camera.K, np.ones(len(rows))
            ray = (rows.uv - K[:2, 2]) @ np.linalg.inv(K[:2, :2]).T
            focal = float(np.sqrt(K[0, 0] * K[1, 1])) * one
            xy = rows.xy_ego - rig.origin_m[:2]
            parts.append(cls(k * one.astype(np.int64), ray, xy, rows.tick, focal, sigma_px * one, sigma_m * one))
        return cls.join(parts)

    @classmethod
    def join(cls, parts: list[RigRows]) -> RigRows:
        """Concatenate several tables."""
        out = cls(*(np.concatenate(column) for column in zip(*(vars(part).values() for part in parts))))
        return out.take(np.argsort(out.tick, kind="stable"))

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.camera)

    def take(self, index: Any) -> RigRows:
        """Select rows by integers or a mask."""
        return RigRows(*(column[index] for column in vars(self).values()))


def heights_of(rig: Rig, rows: RigRows) -> tuple[Array, Array]:
    """Compute how high the rays of rows pass over their ground positions, by the calibration: (N,) m, and sigmas (N,) m."""
    rig_T_cam = inverse(np.array(list(rig.cam_T_rig.values())))[rows.camera]
    rotation, place = rig_T_cam[:, :3, :3], rig_T_cam[:, :3, 3]
    direction = np.einsum("nij,nj->ni", rotation, np.column_stack([rows.ray, np.ones(len(rows))]))
    level = (direction[:, :2] ** 2).sum(axis=1)
    reach = ((rows.xy - place[:, :2]) * direction[:, :2]).sum(axis=1) / level
    height = place[:, 2] + reach * direction[:, 2]
    # A pixel turns the ray, and a ground position that is farther is passed lower.
    by_pixel = reach * np.sqrt(level + direction[:, 2] ** 2 * (1 + direction[:, 2] ** 2 / level)) / rows.focal_px
    sigma = np.hypot(by_pixel * rows.sigma_px, direction[:, 2] / np.sqrt(level) * rows.sigma_m)
    return height, np.where(reach > 0, sigma, np.inf)


@dataclass(frozen=True, eq=False)
class FootErrors:
    """Errors of the feet of boxes with the state of a rig, linearized."""

    squared: Array  # (N,): squared whitened errors; infinite behind the camera
    error: Array  # (N, 2): whitened errors
    slope: Array  # (N, 2, 5): their derivatives by `below_px` and by `lift_m` and rotation of the row's camera
    pixels: Array  # (N,): distances in the image, px


def linearize_feet(rig: Rig, rows: RigRows, state: RigState, planes: Array | None = None) -> FootErrors:
    """Linearize the errors of feet; `planes` (N, 3) replaces the plane of the state, as each tick has its own."""
    turns = rotation_of(np.array([state.feet[n] for n in rig.cameras]))
    poses = turns @ np.array([pose[:3] for pose in rig.cam_T_rig.values()])
    flat = np.concatenate([poses[:, :, :2], poses[:, :, 3:]], axis=2)[rows.camera]
    up = poses[rows.camera, :, 2]
    lift = np.array([state.lift_m[name] for name in rig.cameras])[rows.camera]
    plane = (state.plane if planes is None else planes) + np.column_stack([0 * lift, 0 * lift, lift])
    matrices = flat + up[:, :, None] * plane[:, None, :]
    point = np.einsum("nij,nj->ni", matrices, np.column_stack([rows.xy, np.ones(len(rows))]))
    front = point[:, 2] > 0
    scale = rows.focal_px / np.where(front, point[:, 2], 1.0)
    ray = point[:, :2] * (scale / rows.focal_px)[:, None]
    # Derivatives of the pixel by the point in the camera, and by the ground position, px a meter.
    by_point = np.zeros((len(rows), 2, 3))
    by_point[:, 0, 0] = by_point[:, 1, 1] = scale
    by_point[:, :, 2] = -ray * scale[:, None]
    by_xy = by_point @ matrices[:, :, :2]
    slope = np.zeros((len(rows), 2, SHARED + OF_CAMERA))
    slope[:, 1, 0] = -1.0
    slope[:, :, 1] = np.einsum("nij,nj->ni", by_point, up)
    slope[:, :, 2:] = -by_point @ _cross(point)
    error = (ray - rows.ray) * rows.focal_px[:, None] - [0.0, state.below_px]
    pixels = np.where(front, np.hypot(*error.T), np.inf)
    covariance = (rows.sigma_m**2)[:, None, None] * by_xy @ by_xy.swapaxes(1, 2)
    covariance[:, [0, 1], [0, 1]] += (rows.sigma_px**2)[:, None]
    whiten = np.linalg.inv(np.linalg.cholesky(covariance))
    error, slope = (whiten @ error[:, :, None])[:, :, 0], whiten @ slope
    squared = np.where(front, (error**2).sum(axis=1), np.inf)
    return FootErrors(squared, error, slope, pixels)


def _cross(v: Array) -> Array:
    """Build the matrices (N, 3, 3) of cross products with vectors (N, 3)."""
    (x, y, z), zero = v.T, np.zeros(len(v))
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(-1, 3, 3)


# 99 % quantile of chi-squared with 1 degree of freedom, at which the bounded loss is cut.
CHI2_1DOF_99 = 6.63
SAMPLES, JUDGED_BY_ALL, FIRST_ROWS = 400, 12, 500
# Of three positions: twice the area of their triangle, m2.
MIN_TRIANGLE_M2 = 10.0
# Steeper than any road (the steepest streets have a third).
MAX_SLOPE = 0.5
REFINEMENTS = 6
TILT_ROUNDS = 4
# Tilt of a body on its springs against the road, before it is estimated: about a degree at most.
TILT_SIGMA = 0.01


@dataclass(frozen=True, eq=False)
class HeightRows:
    """Heights of the ground at positions, by all cameras and ticks."""

    xy1: Array  # (N, 3): positions, m, rig frame, homogeneous
    height: Array  # `height`, `sigma`: (N,): heights and their standard deviations, m
    sigma: Array
    tick: NDArray[np.int64]  # (N,): ascending

    def losses(self, planes: Array) -> Array:
        """Compute the bounded losses (K,) of planes (K, 3)."""
        squared = ((planes @ self.xy1.T - self.height) / self.sigma) ** 2
        return np.asarray(np.minimum(squared, CHI2_1DOF_99).mean(axis=1))

    def inlier_share(self, plane: Array) -> float:
        """Compute the share of rows that agree with a plane (3,)."""
        return float(np.mean(((self.xy1 @ plane - self.height) / self.sigma) ** 2 < CHI2_1DOF_99))

    def take(self, index: NDArray[np.int64] | NDArray[np.bool_]) -> HeightRows:
        """Select rows."""
        return HeightRows(self.xy1[index], self.height[index], self.sigma[index], self.tick[index])


def find_plane(rows: HeightRows, rng: np.random.Generator, samples: int = SAMPLES) -> Array | None:
    """Find the plane (3,) that most rows agree with; None where no three rows span one.

    Notes
    -----
    As for a single camera, one half of the samples come from single ticks and one half from all, and hypotheses are judged
    over all cameras and ticks by a bounded loss (MSAC, Torr & Zisserman, 2000); then least squares over what agrees.
    """
    planes = _hypotheses(rows, rng, samples)
    if len(planes) == 0:
        return None
    if len(rows.tick) > 2 * FIRST_ROWS and len(planes) > JUDGED_BY_ALL:
        some = rows.take(np.sort(rng.permutation(len(rows.tick))[:FIRST_ROWS]))
        planes = planes[np.argsort(some.losses(planes), kind="stable")[:JUDGED_BY_ALL]]
    plane = planes[int(np.argmin(rows.losses(planes)))]
    for _ in range(REFINEMENTS):
        residual = (rows.height - rows.xy1 @ plane) / rows.sigma
        use = residual**2 < CHI2_1DOF_99
        weighted = rows.xy1[use] / rows.sigma[use, None]
        normal = weighted.T @ weighted
        if use.sum() < 3 or np.linalg.matrix_rank(normal) < 3:
            return None
        step = np.linalg.solve(normal, weighted.T @ residual[use])
        plane = plane + step
        if np.abs(step).max() < 1e-7:
            break
    return np.asarray(plane)


def _hypotheses(rows: HeightRows, rng: np.random.Generator, samples: int) -> Array:
    """Draw planes (K, 3) through three rows each, half of them from single ticks."""
    count, half = len(rows.tick), samples // 2
    if count < 3:
        return np.zeros((0, 3))
    start = np.searchsorted(rows.tick, rows.tick)
    end = np.searchsorted(rows.tick, rows.tick, side="right")
    drawn = rng.integers(count, size=half)
    of_tick = start[drawn] + (rng.random((3, half)) * (end - start)[drawn]).astype(np.int64)
    three = np.concatenate([of_tick, rng.integers(count, size=(3, samples - half))], axis=1).T
    matrices = rows.xy1[three]
    spread = np.abs(np.linalg.det(matrices)) > MIN_TRIANGLE_M2
    planes = np.linalg.solve(matrices[spread], rows.height[three[spread], None])[:, :, 0]
    return np.asarray(planes[np.hypot(planes[:, 0], planes[:, 1]) < MAX_SLOPE])


def tilt_of_ticks(rows: HeightRows, plane: Array) -> tuple[NDArray[np.int64], Array]:
    """Estimate the slopes of each tick's ground against the plane: ticks (T,), and slopes (T, 2).

    Notes
    -----
    The slopes have a zero-mean normal prior whose standard deviations are estimated from all ticks (empirical Bayes), so that a
    tick with few rows keeps the plane of all.
    """
    ticks, start = np.unique(rows.tick, return_index=True)
    number = np.searchsorted(ticks, rows.tick)
    sigma, tilt = np.full(2, TILT_SIGMA), np.zeros((len(ticks), 2))
    for _ in range(TILT_ROUNDS):
        residual = rows.height - rows.xy1 @ plane
        left = residual - (rows.xy1[:, :2] * tilt[number]).sum(axis=1)
        # A tilted tick is off as a whole: rows are judged against the middle of their tick's own noise.
        weight = ((left / rows.sigma) ** 2 < CHI2_1DOF_99) / rows.sigma**2
        x, y = rows.xy1[:, 0], rows.xy1[:, 1]
        sums = [np.add.reduceat(weight * v, start) for v in (x * x, x * y, y * y, x * residual, y * residual)]
        normal = np.stack([sums[0] + sigma[0] ** -2, sums[1], sums[1], sums[2] + sigma[1] ** -2], axis=-1)
        normal = normal.reshape(-1, 2, 2)
        tilt = np.linalg.solve(normal, np.stack(sums[3:], axis=-1)[:, :, None])[:, :, 0]
        variance = np.diagonal(np.linalg.inv(normal), axis1=1, axis2=2)
        sigma = np.sqrt(np.maximum((tilt**2 + variance).mean(axis=0), sigma**2 / 25))
    return ticks, tilt
