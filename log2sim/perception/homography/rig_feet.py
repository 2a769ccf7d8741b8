"""The feet of boxes in all cameras of a rig, fitted together: where boxes end, and how each camera is turned."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.perception.homography.normalized import CHI2_2DOF_99
from log2sim.perception.homography.rig import Rig, RigState
from log2sim.perception.homography.rig_rows import OF_CAMERA, SHARED, FootErrors, RigRows, linearize_feet
from log2sim.perception.homography.stabilization import CHI2_2DOF_50

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
# The assumed noise counts as a prior worth this many feet; an estimate departs from it by this factor at most.
NOISE_PRIOR_ROWS, MAX_NOISE_FACTOR = 20.0, 4.0


@dataclass(frozen=True, eq=False)
class FeetFit:
    """What the feet of boxes say about a rig.

    Attributes
    ----------
    state : RigState
    errors : FootErrors
        Of all rows, by the assumed noise.
    noise : float
        Factor by which the noise exceeds that.
    covariance : (P, P) float64
        Of the shared parameters of feet, m and px, then of the rotation of each camera, rad.
    """

    state: RigState
    errors: FootErrors
    noise: float
    covariance: Array

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
        state = _with_consensus(rig, rows, state, planes)
    names, scale = list(rig.cameras), 1.0
    covariance = np.zeros((SHARED + OF_CAMERA * len(names),) * 2)
    for gate in GATES if is_start else GATES[-LAST_GATES:]:
        linear = linearize_feet(rig, rows, state, planes)
        step, covariance = _step(rig, rows, linear, state, gate * scale**2, scale)
        of_camera = step[SHARED:].reshape(-1, OF_CAMERA)
        lift = {name: state.lift_m[name] + float(s[0]) for name, s in zip(names, of_camera)}
        turned = {name: state.feet[name] + s[1:] for name, s in zip(names, of_camera)}
        state = replace(state, below_px=state.below_px + float(step[0]), lift_m=lift, feet=turned)
        if gate <= 2 * CHI2_2DOF_99:
            scale = _noise_factor(linear.squared, gate * scale**2)
    linear = linearize_feet(rig, rows, state, planes)
    return FeetFit(state, linear, scale, covariance)


def _step(
    rig: Rig, rows: RigRows, linear: FootErrors, state: RigState, gate: float, scale: float
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


def _with_consensus(rig: Rig, rows: RigRows, state: RigState, planes: Array | None) -> RigState:
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
