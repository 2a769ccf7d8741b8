"""Heading from motion: where it goes while it goes, held while it stands."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array, wrap_angle

# Below this the direction of a smoothed velocity is noise.
MOVING_MPS = 1.0
WALKING_MPS = 0.4
# A course counts where its speed is this many of its own standard deviations: it is known to some ten degrees then. Who
# may turn on the spot has no heading to hold on to, so less will do.
COURSE_SIGMAS = {False: 5.0, True: 2.5}
SLOWEST_COURSE_MPS = {False: 0.5, True: 0.3}
# Without a course anywhere, the way from end to end tells one if it is longer than this.
LEAST_WAY_M = 1.0


def course_is_known(
    velocity_mps: Array, covariance: Array, *, sideways: bool = False, wary: bool = False
) -> NDArray[np.bool_]:
    """Where (T,) the direction of velocities (T, 2) with covariances (T, 2, 2) tells a heading.

    `wary` where the covariances say too little of what repeats from tick to tick: then by speed alone.
    """
    speed = np.hypot(*velocity_mps.T)
    if wary:
        return np.asarray(speed > (WALKING_MPS if sideways else MOVING_MPS))
    sigma = np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 2)
    return np.asarray(speed > np.maximum(COURSE_SIGMAS[sideways] * sigma, SLOWEST_COURSE_MPS[sideways]))


def yaw_of_motion(
    xy_m: Array,
    velocity_mps: Array,
    *,
    hint_rad: float | None = None,
    sideways: bool = False,
    known: NDArray[np.bool_] | None = None,
) -> Array:
    """Heading (T,) in rad of a trajectory (T, 2) with velocities (T, 2), whose course is `known` (T,).

    `hint_rad` is where the vehicle points when it has not moved yet; it also tells driving from reversing. Between two
    moving parts the heading changes with the distance covered, so what stands does not turn. Without motion and hint: 0.
    """
    speed = np.hypot(*velocity_mps.T)
    moving = speed > (WALKING_MPS if sideways else MOVING_MPS) if known is None else known
    if not moving.any():
        way = xy_m[-1] - xy_m[0]
        overall = float(np.arctan2(way[1], way[0])) if np.hypot(*way) > LEAST_WAY_M else 0.0
        return np.full(len(xy_m), overall if hint_rad is None else hint_rad)
    course = np.arctan2(velocity_mps[:, 1], velocity_mps[:, 0])
    # Noise of a standing object adds up as distance; only what is covered at some speed counts.
    creeping = speed > 0.2
    step = np.hypot(*np.diff(xy_m, axis=0).T) * (creeping[1:] | creeping[:-1])
    progress = np.concatenate([[0.0], np.cumsum(step)])
    # Who walks turns round; only what steers goes backward.
    angles = unwrapped(course[moving] if sideways else _without_reversals(course[moving], hint_rad))
    return wrap_angle(np.interp(progress, progress[moving], angles))


def unwrapped(angles: Array) -> Array:
    """Angles (n,) without leaps between neighbors."""
    return np.concatenate([angles[:1], angles[0] + np.cumsum(wrap_angle(np.diff(angles)))])


def _without_reversals(course: Array, hint_rad: float | None) -> Array:
    """Turn courses (n,) into headings: a jump by more than a right angle is a change of gear, not a turn on the spot."""
    first = course[0]
    if hint_rad is not None and abs(float(wrap_angle(first - hint_rad))) > np.pi / 2:
        first = first + np.pi
    jumps = np.abs(wrap_angle(np.diff(course))) > np.pi / 2
    backward = np.concatenate([[0], np.cumsum(jumps)]) % 2
    return wrap_angle(course + (first - course[0]) + np.pi * backward)
