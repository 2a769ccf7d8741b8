"""The homographies of all cameras of a rig over one ground plane, and the feet of boxes in them, solved together.

All cameras of a rig see the same ground, and one detector finds their boxes. So the plane of the ground relative to the rig
and the systematic error of the boxes' feet are parameters of the rig; a camera has a rotation of its mount of its own.

A ray of a calibrated camera passes over the ground position that it shows at a height, which is linear in the plane. So
correspondences of different cameras and ticks serve one hypothesis, three determine it, and all of them judge it (RANSAC). The
ego's pitch and roll against the plane are those of all cameras, and are kept at each tick if they lower held-out errors. Then
one bundle over the feet of boxes in all cameras finds where boxes end, and how each camera is turned.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from log2sim.files.arrays import Columns
from log2sim.geometry import CHI2_2DOF_99, Array, Camera, apply_homography, inverse, shift_poses
from log2sim.perception.boxes import subsample
from log2sim.perception.homography.correspondences import Correspondences
from log2sim.perception.homography.estimate import (
    FOOT_SIGMA_M,
    FOOT_SIGMA_PX,
    GROUND_SIGMA_M,
    GROUND_SIGMA_PX,
    MIN_TESTED_FEET,
)
from log2sim.perception.homography.fit import (
    MIN_INLIER_SHARE,
    MIN_INLIERS,
    HomographyFit,
    ground_covariances,
    refused_fit,
)
from log2sim.perception.homography.normalized import MAX_NOISE_FACTOR, NOISE_PRIOR_ROWS, scaled
from log2sim.perception.homography.pitch_roll import CHI2_2DOF_50, HeldOutErrors

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
    # (3,): rotation of each camera against its calibration that the feet of boxes ask for, rad, camera frame
    feet: Mapping[str, Array]


def rotation_of(vector: Array) -> Array:
    """Compute the rotation matrices (..., 3, 3) of rotation vectors (..., 3), rad (Rodrigues)."""
    v = np.asarray(vector, dtype=np.float64)
    angle = np.linalg.norm(v, axis=-1)[..., None, None]
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    cross = np.zeros((*v.shape[:-1], 3, 3))
    cross[..., 2, 1], cross[..., 0, 2], cross[..., 1, 0] = x, y, z
    cross -= np.swapaxes(cross, -1, -2)
    return np.asarray(np.eye(3) + np.sinc(angle / np.pi) * cross + np.sinc(angle / 2 / np.pi) ** 2 / 2 * cross @ cross)


def foot_homography(rig: Rig, state: RigState, name: str, plane: Array | None = None) -> Array:
    """Compute `ground_H_image` (..., 3, 3) of the feet of boxes at the nearest sides of obstacles.

    px and m, in the ground frame of the correspondences; `plane` (..., 3) replaces that of the state, as that of a tick does.
    """
    lifted = (state.plane if plane is None else plane) + [0.0, 0.0, state.lift_m[name]]
    turn, cam_T_rig = rotation_of(state.feet[name]), rig.cam_T_rig[name]
    r, t = turn @ cam_T_rig[:3, :3], turn @ cam_T_rig[:3, 3]
    # From ground positions (x, y, 1), rig frame, to points in the camera.
    cam_of_ground = np.column_stack([r[:, :2], t]) + r[:, 2, None] * lifted[..., None, :]
    image_H_ground = rig.cameras[name].K @ cam_of_ground
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


# Parameters of feet: one that all cameras share, then of each camera the height of feet above the road, m, and its rotation.
SHARED, OF_CAMERA = 1, 4


@dataclass(frozen=True, eq=False)
class RigRows(Columns):
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
    def join(cls, parts: Sequence[RigRows]) -> RigRows:
        """Concatenate several tables, by tick."""
        out = super().join(parts)
        return out.take(np.argsort(out.tick, kind="stable"))


def heights_of(rig: Rig, rows: RigRows) -> HeightRows:
    """Compute how high the rays of rows pass over their ground positions, by the calibration; without those that never do."""
    rig_T_cam = inverse(np.array(list(rig.cam_T_rig.values())))[rows.camera]
    rotation, place = rig_T_cam[:, :3, :3], rig_T_cam[:, :3, 3]
    direction = np.einsum("nij,nj->ni", rotation, np.column_stack([rows.ray, np.ones(len(rows))]))
    level = (direction[:, :2] ** 2).sum(axis=1)
    reach = ((rows.xy - place[:, :2]) * direction[:, :2]).sum(axis=1) / level
    height = place[:, 2] + reach * direction[:, 2]
    # A pixel turns the ray, and a ground position that is farther is passed lower.
    by_pixel = reach * np.sqrt(level + direction[:, 2] ** 2 * (1 + direction[:, 2] ** 2 / level)) / rows.focal_px
    sigma = np.hypot(by_pixel * rows.sigma_px, direction[:, 2] / np.sqrt(level) * rows.sigma_m)
    kept = np.isfinite(sigma) & (reach > 0)
    xy1 = np.column_stack([rows.xy, np.ones(len(rows))])
    return HeightRows(xy1[kept], height[kept], np.hypot(sigma, ROAD_SIGMA_M)[kept], rows.tick[kept])


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
    (x, y, z), zero = point.T, np.zeros(len(rows))
    slope[:, :, 2:] = -by_point @ np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(-1, 3, 3)
    error = (ray - rows.ray) * rows.focal_px[:, None] - [0.0, state.below_px]
    pixels = np.where(front, np.hypot(*error.T), np.inf)
    covariance = (rows.sigma_m**2)[:, None, None] * by_xy @ by_xy.swapaxes(1, 2)
    covariance[:, [0, 1], [0, 1]] += (rows.sigma_px**2)[:, None]
    whiten = np.linalg.inv(np.linalg.cholesky(covariance))
    error, slope = (whiten @ error[:, :, None])[:, :, 0], whiten @ slope
    squared = np.where(front, (error**2).sum(axis=1), np.inf)
    return FootErrors(squared, error, slope, pixels)


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
class HeightRows(Columns):
    """Heights of the ground at positions, by all cameras and ticks."""

    xy1: Array  # (N, 3): positions, m, rig frame, homogeneous
    height: Array  # `height`, `sigma`: (N,): heights and their standard deviations, m
    sigma: Array
    tick: NDArray[np.int64]  # (N,): ascending

    def losses(self, planes: Array) -> Array:
        """Compute the bounded losses (K,) of planes (K, 3)."""
        squared = ((planes @ self.xy1.T - self.height) / self.sigma) ** 2
        return np.asarray(np.minimum(squared, CHI2_1DOF_99).mean(axis=1))


def find_plane(rows: HeightRows, rng: np.random.Generator, samples: int = SAMPLES) -> Array | None:
    """Find the plane (3,) that most rows agree with; None where no three rows span one.

    As for a single camera, one half of the samples come from single ticks and one half from all, and hypotheses are judged
    over all cameras and ticks by a bounded loss (MSAC, Torr & Zisserman, 2000); then least squares over what agrees.
    """
    count, half = len(rows.tick), samples // 2
    if count < 3:
        return None
    start, end = (np.searchsorted(rows.tick, rows.tick, side=side) for side in ("left", "right"))
    drawn = rng.integers(count, size=half)
    of_tick = start[drawn] + (rng.random((3, half)) * (end - start)[drawn]).astype(np.int64)
    three = np.concatenate([of_tick, rng.integers(count, size=(3, samples - half))], axis=1).T
    spread = np.abs(np.linalg.det(rows.xy1[three])) > MIN_TRIANGLE_M2
    planes = np.linalg.solve(rows.xy1[three[spread]], rows.height[three[spread], None])[:, :, 0]
    planes = planes[np.hypot(planes[:, 0], planes[:, 1]) < MAX_SLOPE]
    if len(planes) == 0:
        return None
    if count > 2 * FIRST_ROWS and len(planes) > JUDGED_BY_ALL:
        some = rows.take(np.sort(rng.permutation(count)[:FIRST_ROWS]))
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


def tilt_of_ticks(rows: HeightRows, plane: Array) -> tuple[NDArray[np.int64], Array]:
    """Estimate the slopes of each tick's ground against the plane: ticks (T,), and slopes (T, 2).

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


# Standard deviations before anything is fitted. A box ends within some pixels of its object. Overhangs of cars are
# 0.7 to 1 m, which is as much as 0.1 m in height where a camera 1.6 m high sees them 12 m away.
LIFT_SIGMA_M = 0.1
# Mounts that are not calibrated to each other at the same time differ by some tenths of a degree.
MOUNT_SIGMA_RAD = np.deg2rad(0.5)
# Gates on the squared error while it is fitted, then until nothing changes.
GATES = (16 * CHI2_2DOF_99, 6 * CHI2_2DOF_99, 2 * CHI2_2DOF_99, CHI2_2DOF_99, CHI2_2DOF_99, CHI2_2DOF_99)
LAST_GATES = 4
# Of the shifts that single feet of a camera ask for so many are tried.
MAX_CANDIDATES = 48


@dataclass(frozen=True, eq=False)
class FeetFit:
    """What the feet of boxes say about a rig."""

    state: RigState
    errors: FootErrors  # of all rows, by the assumed noise
    noise: float  # factor by which the noise exceeds that
    covariance: Array  # (P, P): of the shared parameters of feet, m and px, then of the rotation of each camera, rad

    @property
    def inliers(self) -> NDArray[np.bool_]:
        """Mask (N,) of the rows that agree."""
        return np.asarray(self.errors.squared < CHI2_2DOF_99 * self.noise**2)


def fit_feet(
    rig: Rig, rows: RigRows, state: RigState, planes: Array | None = None, *, is_start: bool = True
) -> FeetFit:
    """Fit the two parameters of feet and the rotation of each camera that they ask for, over all cameras and ticks.

    Gauss-Newton on whitened errors with a bounded loss, from the shift that most feet of a camera agree with. Normal priors
    keep what is not observed at the calibration, such as a camera without feet. With `is_start` False the state is that of an
    earlier fit to the same rows, from which fewer steps lead on.
    """
    names, scale = list(rig.cameras), 1.0
    if is_start:
        linear, feet = linearize_feet(rig, rows, state, planes), dict(state.feet)
        for k, name in enumerate(names):
            own = np.flatnonzero((rows.camera == k) & np.isfinite(linear.squared))
            if len(own) < 2:
                continue
            some = subsample(own, MAX_CANDIDATES)
            # Rotations about x and y of the camera alone: two equations of a foot, two unknowns.
            slope = linear.slope[some][:, :, 2:4]
            usable = np.abs(np.linalg.det(slope)) > 1e-9
            asked = -np.linalg.solve(slope[usable], linear.error[some][usable][:, :, None])[:, :, 0]
            candidates = np.concatenate([np.zeros((1, 2)), asked])
            moved = linear.error[own] + np.einsum("nij,kj->kni", linear.slope[own][:, :, 2:4], candidates)
            loss = np.minimum((moved**2).sum(axis=2), CHI2_2DOF_99).sum(axis=1)
            best = candidates[int(np.argmin(loss + (candidates**2).sum(axis=1) / MOUNT_SIGMA_RAD**2))]
            feet[name] = feet[name] + np.append(best, 0.0)
        state = replace(state, feet=feet)
    covariance = np.zeros((SHARED + OF_CAMERA * len(names),) * 2)
    for gate in GATES if is_start else GATES[-LAST_GATES:]:
        linear = linearize_feet(rig, rows, state, planes)
        step, covariance = _step(rig, rows, linear, state, gate=gate * scale**2, scale=scale)
        of_camera = step[SHARED:].reshape(-1, OF_CAMERA)
        lift = {name: state.lift_m[name] + float(s[0]) for name, s in zip(names, of_camera)}
        turned = {name: state.feet[name] + s[1:] for name, s in zip(names, of_camera)}
        state = replace(state, below_px=state.below_px + float(step[0]), lift_m=lift, feet=turned)
        if gate <= 2 * CHI2_2DOF_99:
            # By which factor the noise exceeds the assumed one, from the median error of the rows within the gate.
            near = linear.squared[linear.squared < gate * scale**2]
            median = float(np.median(near)) if len(near) else 0.0
            variance = (median / CHI2_2DOF_50 * len(near) + NOISE_PRIOR_ROWS) / (len(near) + NOISE_PRIOR_ROWS)
            scale = float(np.clip(np.sqrt(variance), 1 / MAX_NOISE_FACTOR, MAX_NOISE_FACTOR))
    linear = linearize_feet(rig, rows, state, planes)
    return FeetFit(state, linear, scale, covariance)


def _step(
    rig: Rig, rows: RigRows, linear: FootErrors, state: RigState, *, gate: float, scale: float
) -> tuple[Array, Array]:
    """Compute a Gauss-Newton step (P,) and the covariance (P, P)."""
    use = linear.squared < gate
    slope, error = linear.slope[use] / scale, linear.error[use] / scale
    count = len(rig.cameras)
    size = SHARED + OF_CAMERA * count
    normal, right = np.zeros((size, size)), np.zeros(size)
    for k in range(count):
        own = rows.camera[use] == k
        block = slope[own].reshape(-1, SHARED + OF_CAMERA)
        place = np.r_[0:SHARED, SHARED + OF_CAMERA * k : SHARED + OF_CAMERA * (k + 1)]
        normal[np.ix_(place, place)] += block.T @ block
        right[place] += block.T @ error[own].ravel()
    of_camera = np.array([LIFT_SIGMA_M, *[MOUNT_SIGMA_RAD] * 3]) ** -2.0
    prior = np.concatenate([[FOOT_SIGMA_PX**-2.0], np.tile(of_camera, count)])
    value = np.array([state.below_px, *(v for n in rig.cameras for v in (state.lift_m[n], *state.feet[n]))])
    covariance = np.asarray(np.linalg.inv(normal + np.diag(prior)), dtype=np.float64)
    return np.asarray(-covariance @ (right + prior * value)), covariance


# Crossfall of 2.5 % over the width of a lane, and the depth of ruts: the road is this far from a plane.
ROAD_SIGMA_M = 0.05
# Fewer correspondences of all cameras together do not tell the ground from what else they may be on.
MIN_ROWS = 30


@dataclass(frozen=True, eq=False)
class RigFit:
    """The homographies of the cameras of a rig, fitted together."""

    reason: str  # why nothing was fitted, "" otherwise
    rig: Rig
    # From the feet of boxes to the ground, by camera; refused ones state why
    fits: Mapping[str, HomographyFit] = field(default_factory=dict)
    state: RigState | None = None
    # (T,): ticks with a plane of their own, ascending
    ticks: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    planes: Array = field(default_factory=lambda: np.zeros((0, 3)))  # (T, 3)


def fit_rig(
    rig: Rig,
    feet: Mapping[str, Correspondences],
    ground: Mapping[str, Correspondences],
    *,
    rng: np.random.Generator,
    samples: int = SAMPLES,
) -> RigFit:
    """Fit the homographies of all cameras of a rig.

    `feet`, `ground`: of obstacles and of LiDAR ground points, by camera. `samples`: planes that RANSAC draws for all.
    """
    foot_rows = RigRows.of(rig, feet, FOOT_SIGMA_PX, FOOT_SIGMA_M)
    ground_rows = RigRows.of(rig, ground, GROUND_SIGMA_PX, GROUND_SIGMA_M)
    heights = heights_of(rig, RigRows.join([foot_rows, ground_rows]))
    plane = find_plane(heights, rng, samples) if len(heights.tick) >= MIN_ROWS else None
    if plane is None:
        return RigFit(f"{len(heights.tick)} correspondences of all cameras do not determine the ground", rig)
    share = float(np.mean(((heights.xy1 @ plane - heights.height) / heights.sigma) ** 2 < CHI2_1DOF_99))
    if share < MIN_INLIER_SHARE:
        return RigFit(f"only {share:.0%} of the correspondences of all cameras agree on a ground", rig)
    names = list(rig.cameras)
    start = RigState(plane, 0.0, dict.fromkeys(names, 0.0), {name: np.zeros(3) for name in names})
    fit = fit_feet(rig, foot_rows, start)
    ticks, planes, decision = np.zeros(0, dtype=np.int64), np.zeros((0, 3)), None
    if len(ground_rows) and len(foot_rows) >= MIN_TESTED_FEET:
        ticks, tilt = tilt_of_ticks(heights_of(rig, ground_rows), plane)
        planes = plane + np.column_stack([tilt, np.zeros(len(ticks))])
        # The plane of all ticks where a tick has none of its own.
        index = np.clip(np.searchsorted(ticks, foot_rows.tick), 0, len(ticks) - 1)
        own = np.where((ticks[index] == foot_rows.tick)[:, None], planes[index], plane)
        moving = fit_feet(rig, foot_rows, fit.state, own, is_start=False)
        # By the errors of the feet, since ground points gave the tilts.
        squared, pixels = (np.stack([getattr(of.errors, k) for of in (fit, moving)]) for k in ("squared", "pixels"))
        pitch, roll = np.degrees((planes - plane)[:, :2].std(axis=0)).tolist()
        errors, moves = HeldOutErrors(foot_rows.tick, squared, pixels), bool(np.abs(planes - plane).max() > 0)
        decision = errors.decide("ground points", (pitch, roll), moves=moves)
        if decision.per_tick:
            fit = moving
        else:
            ticks, planes = ticks[:0], planes[:0]
    result = RigFit("", rig, {}, fit.state, ticks, planes)
    found = {name: feet.get(name) or Correspondences.join([]) for name in rig.cameras}
    fits = {name: _fit_of_camera(result, fit, foot_rows, name, data) for name, data in found.items()}
    fits = {name: replace(f, pitch_roll=decision) if f.ok else f for name, f in fits.items()}
    return replace(result, fits=fits)


def _fit_of_camera(result: RigFit, fit: FeetFit, rows: RigRows, name: str, data: Correspondences) -> HomographyFit:
    """Make the result of one camera of a rig, refused where its feet contradict the rig; `rows` are all feet."""
    number = list(result.rig.cameras).index(name)
    own = rows.camera == number
    count, agree = int(own.sum()), int((own & fit.inliers).sum())
    needed = max(MIN_INLIERS, int(np.ceil(MIN_INLIER_SHARE * count)))
    if count >= MIN_INLIERS and agree < needed:
        reason = f"{agree} of {count} feet of its obstacles agree with the rig, at least {needed} are needed"
        return refused_fit(reason, len(data))
    h = foot_homography(result.rig, fit.state, name)
    # The rows of the rig are sorted by tick, and finite.
    inliers = np.zeros(len(data), dtype=bool)
    usable = np.flatnonzero(np.isfinite(np.column_stack([data.uv, data.xy_ego])).all(axis=1))
    inliers[usable[np.argsort(data.tick[usable], kind="stable")]] = fit.inliers[own]
    distance = np.hypot(*(apply_homography(h, data.uv[inliers])[0] - data.xy_ego[inliers]).T)
    known = distance[np.isfinite(distance)]
    error_m, s = float(np.median(known)) if len(known) else float("nan"), np.linalg.svd(h, compute_uv=False)
    per_tick = foot_homography(result.rig, fit.state, name, result.planes) if len(result.ticks) else None
    place = [*range(SHARED), *range(SHARED + OF_CAMERA * number, SHARED + OF_CAMERA * (number + 1))]
    covariance = foot_covariance(result.rig, fit.state, name, fit.covariance[np.ix_(place, place)])
    # Where the picture shows the ground ahead, if the camera sees so far.
    cam_T_rig, sigma_m = result.rig.cam_T_rig[name], float("nan")
    ahead, probe = cam_T_rig[2, :2], np.full(3, np.nan)
    if np.hypot(*ahead) > 0:
        at = inverse(cam_T_rig)[:2, 3] + PROBE_M * ahead / np.hypot(*ahead) + result.rig.origin_m[:2]
        probe = np.linalg.inv(h) @ [*at, 1.0]
    if probe[2] > 0:
        of_probe = ground_covariances(h, covariance, probe[None, :2] / probe[2])[0]
        sigma_m = float(np.sqrt(np.linalg.eigvalsh(of_probe)[-1]))
    condition = float(s[0] / s[-1])
    return HomographyFit(True, "", h, inliers, error_m, condition, result.ticks, per_tick, sigma_m, covariance)
