"""What is known of how an object moves: limits of road vehicles, headings from motion, and what smoothing gives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Finding
from log2sim.datatypes.categories import MAX_ACCELERATION_MPS2, MAX_CURVATURE_1PM, MAX_LATERAL_MPS2
from log2sim.geometry import Array, wrap_angle

# Brakes need some 0.2 s to build up their full deceleration.
MAX_JERK_MPS3 = 50.0
# A limit counts as broken where the motion is beyond it by as many of its own standard deviations.
SIGNIFICANT_SIGMAS = 2.0


MOST = {"acceleration": "most_mps2", "lateral_acceleration": "most_mps2", "curvature": "radius_m", "jerk": "most_mps3"}


def broken_limits(
    t_s: Array, acceleration_mps2: Array, yaw_rad: Array, curvature_1pm: Array, sigma: Mapping[str, Array] | None = None
) -> tuple[Finding, ...]:
    """Find the limits that a motion breaks anywhere.

    `t_s`: (T,), s. `acceleration_mps2`: (T, 2), m/s2. `yaw_rad`: (T,), rad. `curvature_1pm`: (T,), 1/m. `sigma`: (T,) each:
    standard deviations of the limited quantities by the names of the limits; 0 where none is given.
    """
    lateral = acceleration_mps2[:, 1] * np.cos(yaw_rad) - acceleration_mps2[:, 0] * np.sin(yaw_rad)
    jerk = np.hypot(*np.diff(acceleration_mps2, axis=0).T) / np.diff(t_s)
    limited = {
        "acceleration": (np.hypot(*acceleration_mps2.T), MAX_ACCELERATION_MPS2),
        "lateral_acceleration": (np.abs(lateral), MAX_LATERAL_MPS2),
        "curvature": (np.abs(curvature_1pm), MAX_CURVATURE_1PM),
        "jerk": (jerk, MAX_JERK_MPS3),
    }
    found = []
    for name, (values, limit) in limited.items():
        margin = SIGNIFICANT_SIGMAS * (sigma or {}).get(name, np.zeros(len(values)))
        broken = np.flatnonzero(values - margin > limit)
        if len(broken):
            worst = int(broken[np.argmax(values[broken])])
            # A difference of two waypoints holds for both of them.
            last = int(broken[-1]) + len(t_s) - len(values)
            at_s, start_s, end_s = (float(t_s[k]) for k in (worst, int(broken[0]), last))
            most = 1.0 / float(values[worst]) if name == "curvature" else float(values[worst])
            found.append(Finding(name, start_s=start_s, end_s=end_s, values={MOST[name]: most, "at_s": at_s}))
    return tuple(found)


# Below these speeds of vehicles and pedestrians the direction of a smoothed velocity is noise.
MIN_MOVING_MPS = 1.0
MIN_WALKING_MPS = 0.4
# A course is known where the speed is this many of its own standard deviations, that is to some ten degrees; by whether
# the object is holonomic. One that may turn on the spot has no heading to hold, so less will do.
MIN_COURSE_SIGMAS = {False: 5.0, True: 2.5}
MIN_COURSE_MPS = {False: 0.5, True: 0.3}
# What is covered at a lower speed is noise of a standing object.
MIN_PROGRESS_MPS = 0.2
# Without a known course, the displacement from end to end gives one if it is longer.
MIN_DISPLACEMENT_M = 1.0
# Standard deviation of the curvature of a way on which no course is known: a turn at a crossing has a radius of some 15 m.
WAY_CURVATURE_1PM = 0.06
# Of a heading of which nothing is known: uniform over half a turn.
UNKNOWN_YAW_RAD = float(np.pi / np.sqrt(12.0))


def course_is_known(
    xy_m: Array,
    velocity_mps: Array,
    covariance: Array,
    *,
    holonomic: bool = False,
    correlated: bool = False,
    max_curvature_1pm: float = MAX_CURVATURE_1PM,
) -> NDArray[np.bool_]:
    """Where (T,) the direction of the velocity gives the heading.

    `xy_m`: (T, 2), m. `velocity_mps`: (T, 2), m/s. `covariance`: (T, 2, 2), m2/s2: of the velocity. `correlated`: whether the
    errors of the positions repeat. The covariances are too small then, so the speed alone decides. `max_curvature_1pm`: 1/m: of
    a path that is not holonomic. Courses that a vehicle could not turn between are not both known.
    """
    speed = np.hypot(*velocity_mps.T)
    if correlated:
        known = np.asarray(speed > (MIN_WALKING_MPS if holonomic else MIN_MOVING_MPS))
    else:
        sigma = np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 2)
        known = np.asarray(speed > np.maximum(MIN_COURSE_SIGMAS[holonomic] * sigma, MIN_COURSE_MPS[holonomic]))
    rows = np.flatnonzero(known)
    if holonomic or len(rows) < 2 or np.isinf(max_curvature_1pm):
        return known
    course = np.arctan2(velocity_mps[rows, 1], velocity_mps[rows, 0])
    sigma = np.sqrt(_course_variance(velocity_mps[rows], covariance[rows]))
    distance_m = _distance_covered(xy_m, speed)[rows]
    turned = np.abs(wrap_angle(2 * np.diff(course))) / 2
    if np.all(turned <= max_curvature_1pm * np.diff(distance_m)):  # then it holds between any two
        return known
    # A smoothed velocity swings round where an object comes to rest or is seen for the first time. A course counts if it differs
    # from the surer ones that count by no more than the distance driven times the largest curvature, plus the standard deviation
    # of the difference. Forward and backward are the same.
    counts, reach_m = (
        np.zeros(len(rows), dtype=bool),
        np.pi / 2 / max_curvature_1pm,
    )  # within which any turn is feasible
    first = np.searchsorted(distance_m, distance_m - reach_m)
    last = np.searchsorted(distance_m, distance_m + reach_m, side="right")
    for k in np.argsort(sigma, kind="stable").tolist():
        near = slice(first[k], last[k])
        turned = np.abs(wrap_angle(2 * (course[near] - course[k]))) / 2
        feasible = max_curvature_1pm * np.abs(distance_m[near] - distance_m[k])
        feasible += np.hypot(sigma[near], sigma[k])
        counts[k] = np.all((turned <= feasible) | ~counts[near])
    known[rows] = counts
    return known


def _course_variance(velocity_mps: Array, covariance: Array) -> Array:
    """Return the variance (n,) in rad2 of the directions of velocities (n, 2) with covariances (n, 2, 2)."""
    across = np.stack([-velocity_mps[:, 1], velocity_mps[:, 0]], axis=-1)
    squared = (velocity_mps**2).sum(axis=1)
    return np.asarray(np.einsum("ka,kab,kb->k", across, covariance, across) / squared**2)


def yaw_of_motion(
    xy_m: Array,
    velocity_mps: Array,
    *,
    hint_rad: float | None = None,
    holonomic: bool = False,
    known: NDArray[np.bool_] | None = None,
) -> Array:
    """Heading (T,) in rad of a trajectory.

    Between two moving parts the heading changes with the distance covered, so a standing object does not turn.

    `xy_m`: (T, 2), m. `velocity_mps`: (T, 2), m/s. `hint_rad`: heading before the first motion; it also decides between driving
    forward and reversing. Without motion and hint the heading is 0. `holonomic`: true for pedestrians, who turn round instead
    of moving backward. `known`: (T,): where the course is known; by default where it is fast enough.
    """
    speed = np.hypot(*velocity_mps.T)
    moving = speed > (MIN_WALKING_MPS if holonomic else MIN_MOVING_MPS) if known is None else known
    if not moving.any():
        displacement = xy_m[-1] - xy_m[0]
        far = np.hypot(*displacement) > MIN_DISPLACEMENT_M
        overall = float(np.arctan2(displacement[1], displacement[0])) if far else 0.0
        return np.full(len(xy_m), overall if hint_rad is None else hint_rad)
    course = np.arctan2(velocity_mps[:, 1], velocity_mps[:, 0])
    distance = _distance_covered(xy_m, speed)
    course = course[moving]
    if not holonomic:
        # A jump by more than a right angle is a change of gear, not a turn on the spot.
        first = course[0]
        if hint_rad is not None and abs(float(wrap_angle(first - hint_rad))) > np.pi / 2:
            first = first + np.pi
        jumps = np.abs(wrap_angle(np.diff(course))) > np.pi / 2
        backward = np.concatenate([[0], np.cumsum(jumps)]) % 2
        course = wrap_angle(course + (first - course[0]) + np.pi * backward)
    return wrap_angle(np.interp(distance, distance[moving], unwrap(course)))


def yaw_sigma(
    xy_m: Array,
    velocity_mps: Array,
    covariance: Array,
    known: NDArray[np.bool_],
    *,
    hint_sigma_rad: float = UNKNOWN_YAW_RAD,
) -> Array:
    """Return the standard deviation (T,) in rad of `yaw_of_motion`, given where the course is `known` (T,).

    There it is that of the direction of the velocity; elsewhere it grows with the distance from the nearest known course.

    `xy_m`: (T, 2), m. `velocity_mps`: (T, 2), m/s. `covariance`: (T, 2, 2), m2/s2: of the velocity. `known`: (T,).
    `hint_sigma_rad`: of the heading that is taken without any known course.
    """
    rows = np.flatnonzero(known)
    if len(rows) == 0:
        return np.full(len(xy_m), min(hint_sigma_rad, UNKNOWN_YAW_RAD))
    speed = np.hypot(*velocity_mps.T)
    variance = _course_variance(velocity_mps[rows], covariance[rows])
    distance = _distance_covered(xy_m, speed)
    after = np.clip(np.searchsorted(rows, np.arange(len(xy_m))), 0, len(rows) - 1)
    both = after, np.maximum(after - 1, 0)
    nearest = [variance[k] + (WAY_CURVATURE_1PM * (distance - distance[rows[k]])) ** 2 for k in both]
    return np.asarray(np.minimum(np.sqrt(np.minimum(*nearest)), UNKNOWN_YAW_RAD))


def speed_sigma(yaw_rad: Array, covariance: Array) -> Array:
    """Return the standard deviation (T,) in m/s of the speed along headings (T,), from covariances (T, 2, 2) of the velocity."""
    along = np.stack([np.cos(yaw_rad), np.sin(yaw_rad)], axis=-1)
    return np.asarray(np.sqrt(np.einsum("ta,tab,tb->t", along, covariance, along)))


def _distance_covered(xy_m: Array, speed_mps: Array) -> Array:
    """Distance (T,) in m along a trajectory, less what is noise of a standing object."""
    advancing = speed_mps > MIN_PROGRESS_MPS
    step = np.hypot(*np.diff(xy_m, axis=0).T) * (advancing[1:] | advancing[:-1])
    return np.concatenate([[0.0], np.cumsum(step)])


def unwrap(angles: Array) -> Array:
    """Angles (n,) without jumps by full turns between neighbors."""
    return np.concatenate([angles[:1], angles[0] + np.cumsum(wrap_angle(np.diff(angles)))])


@dataclass(frozen=True)
class MotionModel:
    """What is known of how an object moves."""

    jerk_density: float | None = None  # spectral density of the jerk in m2/s5; None to estimate it
    holonomic: bool = False  # whether it may move in any direction, as pedestrians do
    heading_rad: float | None = None  # heading where the motion does not give one
    heading_sigma_rad: float = UNKNOWN_YAW_RAD  # its standard deviation
    max_curvature_1pm: float = MAX_CURVATURE_1PM  # of its way, unless it is holonomic

    @property
    def density_by_direction(self) -> bool:
        """Whether the jerk densities along and across the path are estimated separately."""
        return self.jerk_density is None and not self.holonomic


@dataclass(frozen=True, eq=False)
class Smoothed:
    """A smoothed trajectory at the asked times and what was found out about the observations."""

    state: Array  # (T, 3, 2): position in m, velocity in m/s, acceleration in m/s2
    covariance: Array  # (T, 6, 6)
    yaw_rad: Array  # `yaw_rad`, `sigma_yaw_rad`: (T,)
    sigma_yaw_rad: Array
    residual_m: Array  # (n,): distance of each observation from the trajectory
    weight: Array  # (n,): weight of each observation in [0, 1]
    jerk_density: tuple[float, float]  # along and across the path, m2/s5
