"""The homographies of all cameras of a rig, and the feet of boxes in them, solved together.

One RANSAC finds the ground under the rig from the correspondences of all cameras and ticks. The ego's pitch and roll against
it are those of all cameras, and are kept at each tick if they lower held-out errors. Then one bundle over the feet of boxes
in all cameras finds where boxes end, and how each camera is turned.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import CHI2_2DOF_99, Array, apply_homography
from log2sim.perception.homography.correspondences import Correspondences
from log2sim.perception.homography.estimate import (
    FOOT_SIGMA_M,
    FOOT_SIGMA_PX,
    GROUND_SIGMA_M,
    GROUND_SIGMA_PX,
    MIN_TESTED_FEET,
)
from log2sim.perception.homography.fit import MIN_INLIER_SHARE, MIN_INLIERS, HomographyFit, PitchRoll, refused_fit
from log2sim.perception.homography.normalized import MAX_NOISE_FACTOR, NOISE_PRIOR_ROWS
from log2sim.perception.homography.pitch_roll import CHI2_2DOF_50, HeldOutErrors
from log2sim.perception.homography.rig import (
    OF_CAMERA,
    SAMPLES,
    SHARED,
    FootErrors,
    HeightRows,
    Rig,
    RigRows,
    RigState,
    find_plane,
    foot_homography,
    foot_sigma_m,
    heights_of,
    linearize_feet,
    tilt_of_ticks,
)

# Standard deviations before anything is fitted. A box ends within some pixels of its object. Overhangs of cars are
# 0.7 to 1 m, which is as much as 0.1 m in height where a camera 1.6 m high sees them 12 m away.
BELOW_SIGMA_PX, LIFT_SIGMA_M = 4.0, 0.1
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

    def covariance_of(self, camera: int) -> Array:
        """Return the covariance (5, 5) of the parameters of the feet in a camera, given by its number."""
        place = [*range(SHARED), *range(SHARED + OF_CAMERA * camera, SHARED + OF_CAMERA * (camera + 1))]
        return np.asarray(self.covariance[np.ix_(place, place)])

    @property
    def inliers(self) -> NDArray[np.bool_]:
        """Mask (N,) of the rows that agree."""
        return np.asarray(self.errors.squared < CHI2_2DOF_99 * self.noise**2)


def fit_feet(
    rig: Rig, rows: RigRows, state: RigState, planes: Array | None = None, *, is_start: bool = True
) -> FeetFit:
    """Fit the two parameters of feet and the rotation of each camera that they ask for, over all cameras and ticks.

    Notes
    -----
    Gauss-Newton on whitened errors with a bounded loss, from the shift that most feet of a camera agree with. Normal priors
    keep what is not observed at the calibration, such as a camera without feet. With `is_start` False the state is that of an
    earlier fit to the same rows, from which fewer steps lead on.
    """
    if is_start:
        state = _turn_by_consensus(rig, rows, state, planes)
    names, scale = list(rig.cameras), 1.0
    covariance = np.zeros((SHARED + OF_CAMERA * len(names),) * 2)
    for gate in GATES if is_start else GATES[-LAST_GATES:]:
        linear = linearize_feet(rig, rows, state, planes)
        step, covariance = _step(rig, rows, linear, state, gate=gate * scale**2, scale=scale)
        of_camera = step[SHARED:].reshape(-1, OF_CAMERA)
        lift = {name: state.lift_m[name] + float(s[0]) for name, s in zip(names, of_camera)}
        turned = {name: state.feet[name] + s[1:] for name, s in zip(names, of_camera)}
        state = replace(state, below_px=state.below_px + float(step[0]), lift_m=lift, feet=turned)
        if gate <= 2 * CHI2_2DOF_99:
            scale = _noise_factor(linear.squared, gate * scale**2)
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
    prior = np.concatenate([[BELOW_SIGMA_PX**-2.0], np.tile(of_camera, count)])
    value = np.array([state.below_px, *(v for n in rig.cameras for v in (state.lift_m[n], *state.feet[n]))])
    covariance = np.asarray(np.linalg.inv(normal + np.diag(prior)), dtype=np.float64)
    return np.asarray(-covariance @ (right + prior * value)), covariance


def _noise_factor(squared: Array, gate: float) -> float:
    """Estimate by which factor the noise exceeds the assumed one, from the median error of the rows within the gate."""
    near = squared[squared < gate]
    if not len(near):
        return 1.0
    variance = (float(np.median(near)) / CHI2_2DOF_50 * len(near) + NOISE_PRIOR_ROWS) / (len(near) + NOISE_PRIOR_ROWS)
    return float(np.clip(np.sqrt(variance), 1 / MAX_NOISE_FACTOR, MAX_NOISE_FACTOR))


def _turn_by_consensus(rig: Rig, rows: RigRows, state: RigState, planes: Array | None) -> RigState:
    """Turn each camera by the shift in the image that most of its feet agree with, among those that single feet ask for."""
    linear = linearize_feet(rig, rows, state, planes)
    feet = dict(state.feet)
    for k, name in enumerate(rig.cameras):
        own = np.flatnonzero((rows.camera == k) & np.isfinite(linear.squared))
        if len(own) < 2:
            continue
        some = own[np.linspace(0, len(own) - 1, min(len(own), MAX_CANDIDATES)).round().astype(np.intp)]
        # Rotations about x and y of the camera alone: two equations of a foot, two unknowns.
        slope = linear.slope[some][:, :, 2:4]
        usable = np.abs(np.linalg.det(slope)) > 1e-9
        asked = -np.linalg.solve(slope[usable], linear.error[some][usable][:, :, None])[:, :, 0]
        candidates = np.concatenate([np.zeros((1, 2)), asked])
        moved = linear.error[own] + np.einsum("nij,kj->kni", linear.slope[own][:, :, 2:4], candidates)
        loss = np.minimum((moved**2).sum(axis=2), CHI2_2DOF_99).sum(axis=1)
        best = candidates[int(np.argmin(loss + (candidates**2).sum(axis=1) / MOUNT_SIGMA_RAD**2))]
        feet[name] = feet[name] + np.append(best, 0.0)
    return replace(state, feet=feet)


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

    `feet`, `ground`: of obstacles and of LiDAR ground points, by camera. `samples`: planes that RANSAC draws for the whole
    rig.
    """
    foot_rows = RigRows.of(rig, feet, FOOT_SIGMA_PX, FOOT_SIGMA_M)
    ground_rows = RigRows.of(rig, ground, GROUND_SIGMA_PX, GROUND_SIGMA_M)
    heights = _heights(rig, RigRows.join([foot_rows, ground_rows]))
    plane = find_plane(heights, rng, samples) if len(heights.tick) >= MIN_ROWS else None
    if plane is None:
        reason = f"{len(heights.tick)} correspondences of all cameras do not determine the ground"
        return RigFit(reason, rig)
    share = heights.inlier_share(plane)
    if share < MIN_INLIER_SHARE:
        return RigFit(f"only {share:.0%} of the correspondences of all cameras agree on a ground", rig)
    fit = fit_feet(rig, foot_rows, RigState.calibrated(rig, plane))
    ticks, planes, decision = np.zeros(0, dtype=np.int64), np.zeros((0, 3)), None
    if len(ground_rows) and len(foot_rows) >= MIN_TESTED_FEET:
        ticks, tilt = tilt_of_ticks(_heights(rig, ground_rows), plane)
        planes = plane + np.column_stack([tilt, np.zeros(len(ticks))])
        # The plane of all ticks where a tick has none of its own.
        index = np.clip(np.searchsorted(ticks, foot_rows.tick), 0, len(ticks) - 1)
        own = np.where((ticks[index] == foot_rows.tick)[:, None], planes[index], plane)
        moving = fit_feet(rig, foot_rows, fit.state, own, is_start=False)
        decision = _decide(foot_rows, fit, moving, planes - plane)
        if decision.per_tick:
            fit = moving
        else:
            ticks, planes = ticks[:0], planes[:0]
    result = RigFit("", rig, {}, fit.state, ticks, planes)
    found = {name: feet.get(name) or Correspondences.join([]) for name in rig.cameras}
    fits = {name: _fit_of_camera(result, fit, foot_rows, name, data) for name, data in found.items()}
    fits = {name: replace(f, pitch_roll=decision) if f.ok else f for name, f in fits.items()}
    return replace(result, fits=fits)


def _heights(rig: Rig, rows: RigRows) -> HeightRows:
    height, sigma = heights_of(rig, rows)
    kept = np.isfinite(sigma)
    xy1 = np.column_stack([rows.xy, np.ones(len(rows))])
    return HeightRows(xy1[kept], height[kept], np.hypot(sigma, ROAD_SIGMA_M)[kept], rows.tick[kept])


def _decide(rows: RigRows, fixed: FeetFit, moving: FeetFit, tilt: Array) -> PitchRoll:
    """Accept or refuse the tilt of each tick, which ground points gave, by the errors of the feet."""
    squared = np.stack([fixed.errors.squared, moving.errors.squared])
    errors = HeldOutErrors(rows.tick, squared, np.stack([fixed.errors.pixels, moving.errors.pixels]))
    pitch, roll = np.degrees(tilt[:, :2].std(axis=0)).tolist()
    return errors.decide("ground points", (pitch, roll), moves=bool(np.abs(tilt).max() > 0))


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
    sigma_m = foot_sigma_m(result.rig, fit.state, name, fit.covariance_of(number))
    return HomographyFit(True, "", h, inliers, error_m, float(s[0] / s[-1]), result.ticks, per_tick, sigma_m)
