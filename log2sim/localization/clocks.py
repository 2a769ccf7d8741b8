"""Clocks and mounts of LiDARs on the ego, by the motions between their sweeps and the poses of the log.

Each coordinate errs as a first-order Gauss-Markov process, as poses of GNSS and IMU do. Sizes and the time constant are
estimated by restricted maximum likelihood (Patterson, Thompson, Biometrika 1971), so that standard deviations hold.

The poses at the stamps and the mount predict the motion from one sweep to another. Where the stamps are late or the mount is
turned, the prediction departs from what surfaces show, and departs otherwise where the ego goes straight, turns or speeds up:
hand-eye calibration (Park, Martin, IEEE TRA 1994) with a time offset. On a straight way at constant speed an offset shifts all
sweeps alike and does not show; turned mounts do.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.linalg import solve_triangular

from log2sim.config import CalibrationConfig, Config
from log2sim.datatypes import Finding, Log, Treatment
from log2sim.geometry import NS_PER_S, Array, inverse, transform
from log2sim.localization.choice import Progress, during_ns
from log2sim.localization.odometry import lidars_on_ego
from log2sim.localization.replaced import shift_stream
from log2sim.localization.surfaces import (
    MOTION_SPAN_NS,
    SweepPairs,
    adjoint_of,
    cross_matrix,
    exp_of,
    log_of,
    pair_sweeps,
    velocities_at,
)
from log2sim.plan import Sensors


def turn_mount(mount_T_sensor: Array, turn: Array) -> Array:
    """Rotate a mount (4, 4) about the sensor by a rotation vector (3,), rad, in the frame that it is mounted in."""
    out = mount_T_sensor.copy()
    out[:3, :3] = exp_of(np.concatenate([np.zeros(3), turn]))[:3, :3] @ mount_T_sensor[:3, :3]
    return out


# Errors of position across, of height, of yaw and of roll and pitch: components of a twist, usual sizes in m and rad, and how
# far sizes are from these in powers of e.
COMPONENTS = ((0, 1), (2,), (5,), (3, 4))
USUAL_NOISE = np.array([0.03, 0.03, np.deg2rad(0.1), np.deg2rad(0.1)])
LOG_NOISE_SIGMA = 1.0
TIMES_S = (0.5, 2.0, 8.0)
LOG_STEPS = (0.8, 0.4, 0.2)
# An offset of the clock counts as shown by the ego's motion if errors of the poses alone would show no more than this share.
MAX_NOISE_SHARE = 0.5


OFFSET, ROLL, PITCH, YAW, X, Y, Z = range(7)


class PoseNoise:
    """Motions between sweeps against those that values (7,) predict, with errors of the poses and of the registrations.

    Residuals are linear in the values and in the errors of the poses; the latter are eliminated, which takes factors of the
    size of the sweeps instead of that of the pairs. `prior_sigma` (7,): standard deviations of what is expected.
    """

    def __init__(self, seen: SweepPairs, values: Array, prior_sigma: Array) -> None:
        t_ns = seen.t_ns + round(values[OFFSET] * NS_PER_S)
        change = mount_change(values, seen.sensor_m)
        moved = seen.track.at(t_ns)[0] @ change
        velocity, _ = velocities_at(seen.track, t_ns)
        back, mount = adjoint_of(inverse(change)), np.eye(6)[:, [3, 4, 5, 0, 1, 2]]
        mount[:3, :3] = cross_matrix(seen.sensor_m)
        pairs, row = len(seen.pairs), np.arange(len(seen.pairs))
        first, second = np.array([(pair.first, pair.second) for pair in seen.pairs]).T
        predicted = inverse(moved[first]) @ moved[second]
        second_T_first = adjoint_of(inverse(predicted))
        found = np.array([pair.found.first_T_second for pair in seen.pairs])
        of_ego = velocity @ back.T
        by_offset = of_ego[second] - np.einsum("pij,pj->pi", second_T_first, of_ego[first])
        by_values = np.concatenate([by_offset[:, :, None], mount - second_T_first @ mount], axis=2)
        both: Array = np.concatenate([by_values, log_of(inverse(predicted) @ found)[:, :, None]], axis=2)
        by_poses: Array = np.zeros((pairs, len(t_ns), 6, 6))
        by_poses[row, second], by_poses[row, first] = back, -second_T_first @ back
        by_poses = by_poses.transpose(0, 2, 1, 3).reshape(pairs, 6, -1)
        information = np.linalg.inv(np.array([pair.found.covariance for pair in seen.pairs]))
        weighted = np.einsum("pij,pjk->pik", information, by_poses).reshape(6 * pairs, -1)
        weighted_both = np.einsum("pij,pjk->pik", information, both).reshape(6 * pairs, -1)
        by_poses, both = by_poses.reshape(6 * pairs, -1), both.reshape(6 * pairs, -1)
        # Components first, so that each is a block.
        order = np.arange(by_poses.shape[1]).reshape(-1, 6).T.ravel()
        self._of_poses = (by_poses.T @ weighted)[np.ix_(order, order)]
        self._mixed, self._of_both = (weighted.T @ both)[order], both.T @ weighted_both
        self._prior, self._pull = np.diag(prior_sigma**-2.0), -values * prior_sigma**-2.0
        apart_s, span = (seen.t_ns[:, None] - seen.t_ns) / NS_PER_S, 2 * MOTION_SPAN_NS / NS_PER_S
        # By time constant: the inverse and the logarithm of the determinant of the correlation of errors at the stamps, and
        # the covariance of velocities, 1/s2.
        self._shapes: dict[float, tuple[Array, float, Array]] = {}
        for tau in TIMES_S:
            alike, before, after = (np.exp(-np.abs(apart_s + d) / tau) for d in (0.0, -span, span))
            log_det = float(np.linalg.slogdet(alike)[1])
            self._shapes[tau] = np.linalg.inv(alike), log_det, (2 * alike - before - after) / span**2

    def estimate(self) -> list[tuple[float, Array, float]]:
        """Find the sizes (4,) of errors for each time constant, s: tuples of its probability, the sizes, and itself."""
        found = [(*self._descend(tau), tau) for tau in TIMES_S]
        least = min(cost for cost, _, _ in found)
        weights = np.exp([least - cost for cost, _, _ in found])
        return [(float(w), noise, tau) for w, (_, noise, tau) in zip(weights / weights.sum(), found)]

    def solve(self, noise: Array, tau: float) -> tuple[Array, Array, float]:
        """Solve for the step (7,) under errors of given sizes (4,) and time constant, s, with its covariance (7, 7).

        Also the share of the offset's information that is noise: the velocities by which a time offset shows have the errors of the
        poses in them, and what these seem to tell about the offset is taken off its information, as in regression with errors in
        the variables (Fuller, 1987, section 1.2).
        """
        both, _ = self._eliminate(noise, tau)
        information, right = both[:-1, :-1] + self._prior, both[:-1, -1] + self._pull
        own = 1 / np.linalg.inv(information)[0, 0] - self._prior[0, 0]
        false = self._information_of_noise(noise, tau)
        reduced = information.copy()
        reduced[0, 0] -= min(false, MAX_NOISE_SHARE * own)
        covariance = np.linalg.inv(reduced)
        share = false / own if own > 0 else 1.0
        return covariance @ right, covariance @ information @ covariance, share

    def _eliminate(self, noise: Array, tau: float) -> tuple[Array, float]:
        """Return the information (V + 1, V + 1) about values and residual, and the logarithm of the determinant of their covariance."""
        matrix, log_det = self._add_pose_noise(noise, tau)
        lower = np.linalg.cholesky(matrix)
        white = solve_triangular(lower, self._mixed, lower=True, check_finite=False)
        return self._of_both - white.T @ white, log_det + 2 * float(np.log(np.diag(lower)).sum())

    def _add_pose_noise(self, noise: Array, tau: float) -> tuple[Array, float]:
        """Return the information (6 K, 6 K) about errors of poses, and the logarithm of the determinant of their prior covariance."""
        (unlike, shape_log_det, _), matrix, log_det = self._shapes[tau], self._of_poses.copy(), 0.0
        k = len(unlike)
        for sigma, components in zip(noise, COMPONENTS):
            for c in components:
                matrix[c * k : c * k + k, c * k : c * k + k] += unlike / sigma**2
                log_det += 2 * k * float(np.log(sigma)) + shape_log_det
        return matrix, log_det

    def _cost(self, noise: Array, tau: float) -> float:
        """Compute the negative logarithm of the restricted likelihood, with the prior of the sizes."""
        both, log_det = self._eliminate(noise, tau)
        information, right = both[:-1, :-1] + self._prior, both[:-1, -1] + self._pull
        fitted = both[-1, -1] - right @ np.linalg.solve(information, right)
        prior = np.sum((np.log(noise / USUAL_NOISE) / LOG_NOISE_SIGMA) ** 2)
        return float(0.5 * (log_det + np.linalg.slogdet(information)[1] + fitted + prior))

    def _descend(self, tau: float) -> tuple[float, Array]:
        """Find the sizes of least cost, one after the other with smaller steps."""
        noise = USUAL_NOISE.copy()
        best = self._cost(noise, tau)
        for step in LOG_STEPS:
            for k in range(len(noise)):
                for factor in (np.exp(-step), np.exp(step)):
                    other = noise.copy()
                    other[k] *= factor
                    while (cost := self._cost(other, tau)) < best:
                        noise, best = other.copy(), cost
                        other[k] *= factor
        return best, noise

    def _information_of_noise(self, noise: Array, tau: float) -> float:
        """Compute what the errors of the velocities alone would tell about a time offset, 1/s2."""
        matrix, _ = self._add_pose_noise(noise, tau)
        left = self._of_poses - self._of_poses @ np.linalg.solve(matrix, self._of_poses)
        velocity = self._shapes[tau][2]
        k = len(velocity)
        blocks = ((sigma, slice(c * k, c * k + k)) for sigma, cs in zip(noise, COMPONENTS) for c in cs)
        return float(sum(sigma**2 * np.sum(left[rows, rows] * velocity) for sigma, rows in blocks))


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
    """Time offset and mount of a LiDAR."""

    # (7,): what stamps lack, s; rotation vector of the mount in the ego's frame about the sensor, rad, and translation,
    # m, that the mount lacks
    values: Array
    covariance: Array  # (7, 7)
    shows_offset: bool  # whether the ego's motion shows a time offset; without, that is 0 here
    pose_error_m: float  # by how much the positions of the poses err, for seconds at a time

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
    """Fit with standard deviations (7,) of what is expected, by Gauss-Newton.

    Sizes of the errors of the poses are estimated after the first steps, and the results for several time constants of these are
    weighed by their likelihood.
    """
    values = np.zeros(len(prior_sigma))
    for _ in range(FIRST_STEPS):
        values = values + PoseNoise(seen, values, prior_sigma).solve(USUAL_NOISE, FIRST_TIME_S)[0]
    problem = PoseNoise(seen, values, prior_sigma)
    errors = problem.estimate()
    # The mixture of the results.
    solved = [(weight, *problem.solve(noise, tau)) for weight, noise, tau in errors]
    step = np.sum([weight * one for weight, one, _, _ in solved], axis=0)
    covariance = sum(w * (spread + np.outer(one - step, one - step)) for w, one, spread, _ in solved)
    shows_offset = sum(weight * share for weight, _, _, share in solved) < MAX_NOISE_SHARE
    pose_error_m = float(sum(weight * noise[0] for weight, noise, _ in errors))
    return Estimate(values + step, np.asarray(covariance), shows_offset, pose_error_m)


# What is certain is reported if it matters: 0.2 m, which is how well agents are placed, at 10 m/s and to the side at 40 m; up or down, 0.7 m at 40 m, half
# of a car. Data sets are calibrated to less. Of heights only what moves the ground out of reach.
MIN_OFFSET_S = 0.02
MIN_ROTATION_RAD = {ROLL: 0.7 / 40.0, PITCH: 0.7 / 40.0, YAW: 0.2 / 40.0}
MIN_TRANSLATION_M = {X: 0.2, Y: 0.2, Z: 0.5}
# An estimate that is no better than this does not help who asks for a correction.
MAX_SIGMA_S, MAX_SIGMA_RAD = 0.05, np.deg2rad(1.0)
ANGLES = {ROLL: "roll", PITCH: "pitch", YAW: "yaw"}


@dataclass(frozen=True, eq=False)
class Findings:
    """What a LiDAR is found to lack, and what was asked for."""

    lidar: str
    found: Estimate
    seen: SweepPairs
    asked: CalibrationConfig

    @property
    def offset_s(self) -> float:
        """What stamps lack, s; 0 where that is not certain or does not matter."""
        return self.certain(OFFSET, MIN_OFFSET_S) if self.found.shows_offset else 0.0

    @property
    def turn_rad(self) -> list[float]:
        """Rotation vector (3,), rad, that the mount lacks; 0 about axes about which it is not certain or does not matter."""
        return [self.certain(row, least) for row, least in MIN_ROTATION_RAD.items()]

    @property
    def shift_m(self) -> list[float]:
        """Translation (3,), m, that the mount lacks; 0 along axes along which it is not certain or does not matter."""
        return [self.certain(row, least) for row, least in MIN_TRANSLATION_M.items()]

    def certain(self, row: int, least: float) -> float:
        """Return a value, or 0 where chance can explain it or it is below what matters."""
        value = float(self.found.values[row])
        return value if abs(value) >= max(MIN_SIGMAS * self.found.sigma[row], least) else 0.0

    def faults(self) -> list[Finding]:
        """Describe what is wrong, and what cannot be corrected although it was asked for."""
        asked, pose_error_m = self.asked, self.found.pose_error_m
        faults = unseen_faults(self.lidar, self.found, asked)
        if self.offset_s:
            values = {"offset_s": -self.offset_s, "offset_sigma_s": float(self.found.sigma[OFFSET])}
            velocity, known = velocities_at(self.seen.track, self.seen.t_ns)
            fastest = float(np.linalg.norm(velocity[known, :3], axis=1).max(initial=0))
            values |= {"pose_error_m": pose_error_m, "moved_m": abs(self.offset_s) * fastest}
            faults.append(Finding("time_offset", self.lidar, "corrected" if asked.fix_time else "kept", values=values))
        treatment: Treatment = "corrected" if asked.fix_mounts else "kept"
        off, sigma = -self.found.values, self.found.sigma
        if any(self.turn_rad):
            values = {f"{name}_deg": float(np.degrees(off[row])) for row, name in ANGLES.items()}
            values |= {f"{name}_sigma_deg": float(np.degrees(sigma[row])) for row, name in ANGLES.items()}
            course_rad, yaw_rad = course_in_ego(self.seen), self.turn_rad[2]
            values |= {"course_deg": float(np.degrees(course_rad)), "pose_error_m": pose_error_m}
            # Where the heading of the poses is turned rather than the mount, the ego drives askew by them.
            askew = yaw_rad != 0 and abs(course_rad - yaw_rad) <= abs(course_rad)
            case = "heading" if askew else "mount"
            faults.append(Finding("lidar_rotation", self.lidar, treatment, values=values, case=case))
        if any(self.shift_m):
            values = {f"{name}_m": float(off[row]) for row, name in zip((X, Y, Z), "xyz")}
            values |= {f"{name}_sigma_m": float(sigma[row]) for row, name in zip((X, Y, Z), "xyz")}
            faults.append(Finding("lidar_translation", self.lidar, treatment, values=values))
        return faults


def unseen_faults(lidar: str, found: Estimate | None, asked: CalibrationConfig) -> list[Finding]:
    """List what cannot be corrected although the settings ask for it; without an estimate, that is all of it."""
    faults = []
    if asked.fix_time and (found is None or not found.shows_offset or found.sigma[OFFSET] > MAX_SIGMA_S):
        faults.append(Finding("unknown_offset", lidar))
    if asked.fix_mounts and (found is None or found.sigma[YAW] > MAX_SIGMA_RAD):
        faults.append(Finding("unknown_rotation", lidar, case="motion"))
    return faults


def course_in_ego(seen: SweepPairs) -> float:
    """Compute the direction, rad, in which the ego moves in its own frame where it goes straight on: 0 for a car with a right heading.

    In turns, the ego's origin moves sideways by the yaw rate times its distance from the rear axle, which is left out.
    """
    velocity, known = velocities_at(seen.track, seen.t_ns)
    forward, sideways, turning = velocity[known][:, [0, 1, 5]].T
    (course, _), *_ = np.linalg.lstsq(np.stack([forward, turning], axis=1), sideways, rcond=None)
    return float(np.arctan(course))


# Poses that err by more within seconds, or that belong to other sweeps, are no base for a calibration.
MAX_POSE_ERROR_M = 0.5


def check_lidars(log: Log, config: Config, sensors: Sensors, *, progress: Progress) -> tuple[Log, tuple[Finding, ...]]:
    """Estimate time offset and mount of each LiDAR on the ego: the log, corrected where the settings ask for it, and what is wrong.

    Faults are what is certain and large enough to matter, and what cannot be corrected although it was asked for. Nothing is read
    where there is nothing to see: without a LiDAR on the ego, where it hardly moves, with poses that come from a sensor of the log.
    """
    faults: list[Finding] = []
    if log.ego is None or config.poses.source not in ("given", "auto"):
        return log, ()
    asked = config.calibration
    for lidar in lidars_on_ego(sensors.restrict(log)):
        seen = pair_sweeps(log, lidar, during_ns(log, config), partial(progress, f"check {lidar}"))
        found = None if seen is None else fit_clock_and_mount(seen)
        if seen is None or found is None or found.pose_error_m > MAX_POSE_ERROR_M:
            faults += unseen_faults(lidar, None, asked)
            continue
        findings = Findings(lidar, found, seen, asked)
        faults += findings.faults()
        if asked.fix_time and findings.offset_s:
            shifted = shift_stream(log.streams[lidar], round(findings.offset_s * NS_PER_S))
            log = log.changed(streams={**log.streams, lidar: shifted})
        if asked.fix_mounts and any((*findings.turn_rad, *findings.shift_m)):
            mount = turn_mount(log.lidars[lidar].mount_T_lidar, np.array(findings.turn_rad))
            mount[:3, 3] += findings.shift_m
            log = log.changed(lidars={**log.lidars, lidar: replace(log.lidars[lidar], mount_T_lidar=mount)})
    return log, tuple(faults)
