"""Time offset and mount of a LiDAR, fitted to the motions between its sweeps and to the poses of the ego.

The poses at the stamps and the mount predict the motion from one sweep to another. Where the stamps are late or the mount is
turned, the prediction departs from what surfaces show, and departs otherwise where the ego goes straight, turns or speeds up:
hand-eye calibration (Park, Martin, IEEE TRA 1994) with a time offset. On a straight way at constant speed an offset shifts all
sweeps alike and does not show; turned mounts do.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from log2sim.calibration.pose_noise import MAX_NOISE_SHARE, USUAL_NOISE, Linearized, PoseNoise, Solution
from log2sim.calibration.sweep_pairs import SweepPairs
from log2sim.calibration.twists import adjoint_of, cross_matrix, exp_of, log_of, velocities_at
from log2sim.geometry import NS_PER_S, Array, inverse, transform

OFFSET, ROLL, PITCH, YAW, X, Y, Z = range(7)
VALUES = 7
# Of stamps, s, of rotation, rad, and translation, m, of a mount: what a mistake that nobody sees can be.
PRIOR_SIGMA = np.array([0.3, 0.05, 0.05, 0.05, 0.3, 0.3, 0.3])
# A result by chance is farther off once in 2,000 times.
MIN_SIGMAS = 3.5
# Mounts are measured to centimeters.
MEASURED_SIGMA_M = 0.05
# An offset that the motion does not show is taken for none.
UNSEEN_OFFSET_SIGMA_S = 0.005
# Steps until the size of the errors of the poses is estimated, from what is usual.
FIRST_TIME_S, FIRST_STEPS = 2.0, 2


@dataclass(frozen=True, eq=False)
class Estimate:
    """Time offset and mount of a LiDAR.

    Attributes
    ----------
    values : (7,) float64
        What stamps lack, s; rotation vector of the mount in the ego's frame about the sensor, rad, and translation, m, that the
        mount lacks.
    covariance : (7, 7) float64
    shows_offset : bool
        Whether the ego's motion shows a time offset; without, that is 0 here.
    pose_error_m : float, m
        By how much the positions of the poses err, for seconds at a time.
    """

    values: Array
    covariance: Array
    shows_offset: bool
    pose_error_m: float

    @property
    def sigma(self) -> Array:
        """Standard deviations (7,)."""
        return np.sqrt(np.diag(self.covariance))


def mount_change(values: Array, sensor_m: Array) -> Array:
    """Compute how points move in the ego's frame (4, 4) by rotation about the sensor and translation of its mount."""
    turn = exp_of(np.concatenate([np.zeros(3), values[1:4]]))[:3, :3]
    return transform(turn, sensor_m - turn @ sensor_m + values[4:])


def fit_clock_and_mount(seen: SweepPairs) -> Estimate:
    """Fit the time offset and the mount to motions between sweeps.

    A translation that is not certain is taken for as small as mounts are measured, and an offset that the ego's motion does not
    show for none, so that neither blurs the rest.
    """
    prior = PRIOR_SIGMA.copy()
    found = _fit(seen, prior)
    if (np.abs(found.values[X:]) < MIN_SIGMAS * found.sigma[X:]).all():
        prior[X:] = MEASURED_SIGMA_M
        found = _fit(seen, prior)
    if not found.shows_offset:
        prior[OFFSET] = UNSEEN_OFFSET_SIGMA_S
        found = replace(_fit(seen, prior), shows_offset=False)
    return found


def _fit(seen: SweepPairs, prior_sigma: Array) -> Estimate:
    """Fit with standard deviations (7,) of what is expected.

    Notes
    -----
    Gauss-Newton; sizes of the errors of the poses are estimated after the first steps, and the results for several time
    constants of these are weighed by their likelihood.
    """
    values = np.zeros(VALUES)
    for _ in range(FIRST_STEPS):
        values = values + PoseNoise(_linearize(seen, values, prior_sigma)).solve(USUAL_NOISE, FIRST_TIME_S).step
    problem = PoseNoise(_linearize(seen, values, prior_sigma))
    errors = problem.estimate()
    solved = [(weight, problem.solve(noise, tau)) for weight, noise, tau in errors]
    step, covariance = _mean(solved)
    shows_offset = sum(weight * s.noise_share for weight, s in solved) < MAX_NOISE_SHARE
    pose_error_m = float(sum(weight * noise[0] for weight, noise, _ in errors))
    return Estimate(values + step, covariance, shows_offset, pose_error_m)


def _mean(solved: list[tuple[float, Solution]]) -> tuple[Array, Array]:
    """Return mean (V,) and covariance (V, V) of a mixture."""
    step = np.sum([w * s.step for w, s in solved], axis=0)
    covariance = sum(w * (s.covariance + np.outer(s.step - step, s.step - step)) for w, s in solved)
    return step, np.asarray(covariance)


def _linearize(seen: SweepPairs, values: Array, prior_sigma: Array) -> Linearized:
    """Compare predicted motions with those found, at given values (7,)."""
    t_ns = seen.t_ns + round(values[OFFSET] * NS_PER_S)
    change = mount_change(values, seen.sensor_m)
    moved = seen.track.at(t_ns)[0] @ change
    velocity, _ = velocities_at(seen.track, t_ns)
    back, mount = adjoint_of(inverse(change)), np.eye(6)[:, [3, 4, 5, 0, 1, 2]]
    mount[:3, :3] = cross_matrix(seen.sensor_m)
    first, second = np.array([(pair.first, pair.second) for pair in seen.pairs]).T
    predicted = inverse(moved[first]) @ moved[second]
    second_T_first = adjoint_of(inverse(predicted))
    found = np.array([pair.found.first_T_second for pair in seen.pairs])
    of_ego = velocity @ back.T
    by_offset = of_ego[second] - np.einsum("pij,pj->pi", second_T_first, of_ego[first])
    by_poses = np.zeros((len(seen.pairs), len(t_ns), 6, 6))
    row = np.arange(len(seen.pairs))
    by_poses[row, second], by_poses[row, first] = back, -second_T_first @ back
    return Linearized(
        seen.t_ns,
        log_of(inverse(predicted) @ found).ravel(),
        np.concatenate([by_offset[:, :, None], mount - second_T_first @ mount], axis=2).reshape(-1, VALUES),
        by_poses.transpose(0, 2, 1, 3).reshape(6 * len(seen.pairs), -1),
        [np.asarray(np.linalg.inv(pair.found.covariance), np.float64) for pair in seen.pairs],
        prior_sigma**-2.0,
        -values * prior_sigma**-2.0,
    )
