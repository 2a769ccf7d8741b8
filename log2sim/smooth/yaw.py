"""Heading from motion: where it goes while it goes, held while it stands."""

from __future__ import annotations

import numpy as np

from log2sim.geometry import Array, wrap_angle

# Below this the direction of a smoothed velocity is noise.
MOVING_MPS = 1.0
WALKING_MPS = 0.4


def yaw_of_motion(xy_m: Array, velocity_mps: Array, *, hint_rad: float | None = None, sideways: bool = False) -> Array:
    """Heading (T,) in rad of a trajectory (T, 2) with velocities (T, 2).

    `hint_rad` is where the vehicle points when it has not moved yet; it also tells driving from reversing. Between two
    moving parts the heading changes with the distance covered, so what stands does not turn. Without motion and hint: 0.
    """
    speed = np.hypot(*velocity_mps.T)
    moving = speed > (WALKING_MPS if sideways else MOVING_MPS)
    if not moving.any():
        return np.full(len(xy_m), 0.0 if hint_rad is None else hint_rad)
    course = np.arctan2(velocity_mps[:, 1], velocity_mps[:, 0])
    covered = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(xy_m, axis=0).T))])
    # Noise of a standing object adds up as distance; only what is covered at some speed counts.
    creeping = speed > 0.2
    step = np.diff(covered) * (creeping[1:] | creeping[:-1])
    progress = np.concatenate([[0.0], np.cumsum(step)])
    # Who walks turns round; only what steers goes backward.
    angles = np.unwrap(course[moving] if sideways else _without_reversals(course[moving], hint_rad))
    return wrap_angle(np.interp(progress, progress[moving], angles))


def _without_reversals(course: Array, hint_rad: float | None) -> Array:
    """Turn courses (n,) into headings: a jump by more than a right angle is a change of gear, not a turn on the spot."""
    heading = course.copy()
    reference = hint_rad if hint_rad is not None else course[0]
    for k in range(len(course)):
        if abs(float(wrap_angle(course[k] - reference))) > np.pi / 2:
            heading[k] = wrap_angle(course[k] + np.pi)
        reference = heading[k]
    return heading
