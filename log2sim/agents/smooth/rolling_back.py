"""Removal of false backward motion: smoothed velocities oscillate about zero at standstill and overshoot at a stop."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from log2sim.agents.motion_evidence import VIEW_S
from log2sim.agents.smooth.heading import yaw_of_motion
from log2sim.agents.smooth.likelihood import zero_motion
from log2sim.agents.smooth.motion_prior import NoisyPositions
from log2sim.agents.smooth.quadratic import Quadratic
from log2sim.agents.spans import spans_of
from log2sim.geometry import Array
from log2sim.tracking.gates import CHI2_2DOF_99

# A longer way backward is one.
MAX_ROLL_M = 2.0
# Standard deviation of the velocity of what is held, and rounds in which its neighbors may have to be held too.
HELD_SIGMA_MPS, MAX_HOLDING_ROUNDS = 0.02, 4


def backward_runs(state: Array, known: NDArray[np.bool_], heading_rad: float | None) -> list[NDArray[np.intp]]:
    """Return the knots of each short way backward of a vehicle.

    Parameters
    ----------
    state : (K, 3, 2) float64
    known : (K,) bool
        Where the course is known.
    heading_rad : float, optional
        Heading where the motion does not give one.
    """
    velocity = state[:, 1]
    if heading_rad is None and not known.any():
        return []
    yaw = yaw_of_motion(state[:, 0], velocity, hint_rad=heading_rad, known=known)
    forward = velocity[:, 0] * np.cos(yaw) + velocity[:, 1] * np.sin(yaw)
    runs = spans_of(forward < -2 * HELD_SIGMA_MPS)
    return [run for run in runs if np.hypot(*np.diff(state[run, 0], axis=0).T).sum() < MAX_ROLL_M]


def max_misfit(observed: NoisyPositions) -> float:
    """Return by how much the squared residuals in sigmas may grow where a vehicle is held.

    A vehicle stands instead of moving backward if that explains the positions within the 99 % quantile. Errors that repeat for
    `VIEW_S` count once.
    """
    if not observed.correlated or len(observed.t_s) < 2:
        return CHI2_2DOF_99
    return CHI2_2DOF_99 * max(1.0, VIEW_S / float(np.median(np.diff(observed.t_s))))


def held_at(state: Array, rows: NDArray[np.intp]) -> Quadratic:
    """Pseudo-measurements of zero velocity at some knots of a state (K, 3, 2)."""
    information = np.zeros((len(state), 2, 2))
    information[rows] = np.eye(2) / HELD_SIGMA_MPS**2
    return zero_motion(state, information, np.zeros_like(information))
