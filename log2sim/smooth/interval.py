"""Fixed-interval smoothing of planar positions as one banded least-squares problem."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array

# Knots stand no nearer to each other than this; in between the acceleration is taken as constant, which at 100 m/s3 of
# jerk costs 0.02 mm. The information that ties two knots grows like the fifth power of the inverse step: 1 ms apart they
# would leave no digits for the data.
KNOT_STEP_S = 0.02
ROUNDS = 8
# Tukey-like weight of the generalized t-distribution: at this many sigmas an observation counts half.
TOLERANCE_SIGMAS = 3.0
VELOCITY_PRIOR_MPS = 40.0
ACCELERATION_PRIOR_MPS2 = 4.0

# Covariance of position, velocity, acceleration after unit time of white jerk of unit density, and its inverse.
_UNIT_Q = np.array([[1 / 20, 1 / 8, 1 / 6], [1 / 8, 1 / 3, 1 / 2], [1 / 6, 1 / 2, 1.0]])
_UNIT_INFORMATION = np.linalg.inv(_UNIT_Q)


@dataclass(frozen=True, eq=False)
class Observations:
    """Positions `xy` (n, 2) with covariances `r` (n, 2, 2) at times `t_s` (n,)."""

    t_s: Array
    xy: Array
    r: Array


def smooth_interval(observed: Observations, asked_s: Array, jerk_density: float) -> tuple[Array, Array, Array, Array]:
    """Most probable trajectory given the positions, under white jerk.

    Returns
    -------
    state : (T, 6) x, y, vx, vy, ax, ay at the asked times
    covariance : (T, 2, 2) of the position
    distance : (n,) m from each observation to the trajectory
    weight : (n,) in (0, 1], what the outlier rejection left of each observation

    Notes
    -----
    The estimate is that of a Kalman filter with a Rauch-Tung-Striebel smoother for the constant-acceleration model, found
    in one go: its normal equations are block-tridiagonal, with 6 states a knot, and are solved as a band. Robustness by
    iteratively reweighted least squares. The process noise is inverted in units of the step, so steps from milliseconds
    to seconds are equally well conditioned. Cost O(n).
    """
    knots = place_knots(np.concatenate([observed.t_s, asked_s]))
    place = nearest_index(knots, observed.t_s)
    reading = _reading(observed.t_s - knots[place])
    chain = _chain_information(np.diff(knots), jerk_density)
    information = np.linalg.inv(observed.r)
    weight = np.ones(len(observed.t_s))
    state = np.zeros((len(knots), 6))
    for k in range(ROUNDS):
        diagonal, off, rhs = _normal_equations(chain, information * weight[:, None, None], place, reading, observed.xy)
        state = _solve_banded(diagonal, off, rhs)
        difference = observed.xy - np.einsum("nij,nj->ni", reading, state[place])
        squared = np.einsum("ni,nij,nj->n", difference, information, difference)
        updated = 1.0 / (1.0 + (squared / TOLERANCE_SIGMAS**2)) ** 2
        if k and np.abs(updated - weight).max() < 1e-3:
            break
        weight = updated
    rows = nearest_index(knots, asked_s)
    offset = asked_s - knots[rows]
    there = _reading(offset)
    covariance = there @ _state_covariance(diagonal, off)[rows] @ np.swapaxes(there, 1, 2)
    moved = state[rows].copy()
    moved[:, :2] = np.einsum("nij,nj->ni", there, state[rows])
    moved[:, 2:4] += offset[:, None] * state[rows, 4:]
    return moved, covariance, np.hypot(*difference.T), weight


def place_knots(t_s: Array) -> Array:
    """Times (K,) out of those given (n,), from the first on, none nearer to the one before than `KNOT_STEP_S`."""
    knots: list[float] = []
    for t in np.unique(t_s):
        if not knots or t - knots[-1] >= KNOT_STEP_S:
            knots.append(float(t))
    return np.array(knots)


def _reading(offset_s: Array) -> Array:
    """How a position at an offset (n,) from its knot is read from the knot's state: (n, 2, 6)."""
    h = np.zeros((len(offset_s), 2, 6))
    for axis in range(2):
        h[:, axis, axis] = 1.0
        h[:, axis, 2 + axis] = offset_s
        h[:, axis, 4 + axis] = offset_s**2 / 2
    return h


def nearest_index(knots: Array, t: Array) -> NDArray[np.intp]:
    """Index of the knot nearest to every time."""
    if len(knots) == 1:
        return np.zeros(len(t), dtype=np.intp)
    i = np.clip(np.searchsorted(knots, t), 1, len(knots) - 1)
    return np.where(np.abs(knots[i - 1] - t) <= np.abs(knots[i] - t), i - 1, i)


def _chain_information(dt: Array, density: float) -> tuple[Array, Array, Array]:
    """Information blocks (3, 3) a step and axis: of the earlier state, between both, and of the later state."""
    scale = np.stack([dt**-2.5, dt**-1.5, dt**-0.5], axis=-1)
    inverse = _UNIT_INFORMATION * scale[:, :, None] * scale[:, None, :] / density
    step = np.zeros((len(dt), 3, 3))
    step[:, [0, 1, 2], [0, 1, 2]] = 1.0
    step[:, 0, 1], step[:, 1, 2], step[:, 0, 2] = dt, dt, dt**2 / 2
    cross = -np.swapaxes(step, 1, 2) @ inverse
    return -cross @ step, cross, inverse


def _normal_equations(
    chain: tuple[Array, Array, Array], information: Array, place: NDArray[np.intp], reading: Array, xy: Array
) -> tuple[Array, Array, Array]:
    """Diagonal blocks (K, 6, 6), upper off-diagonal blocks (K-1, 6, 6) and right-hand side (K, 6)."""
    earlier, cross, later = chain
    count = len(earlier) + 1
    diagonal, off, rhs = np.zeros((count, 6, 6)), np.zeros((count - 1, 6, 6)), np.zeros((count, 6))
    for axis in range(2):
        rows = np.arange(3) * 2 + axis
        block = np.ix_(np.arange(count - 1), rows, rows)
        off[block] = cross
        diagonal[block] += earlier
        diagonal[np.ix_(np.arange(1, count), rows, rows)] += later
        # Vague beliefs that make a single observation, or a pair of them, have an answer.
        diagonal[0, rows[1], rows[1]] += VELOCITY_PRIOR_MPS**-2
        diagonal[0, rows[2], rows[2]] += ACCELERATION_PRIOR_MPS2**-2
    weighted = np.swapaxes(reading, 1, 2) @ information
    np.add.at(diagonal, place, weighted @ reading)
    np.add.at(rhs, place, np.einsum("nij,nj->ni", weighted, xy))
    return diagonal, off, rhs


def _solve_banded(diagonal: Array, off: Array, rhs: Array) -> Array:
    from scipy.linalg import solveh_banded

    count = len(diagonal)
    band = np.zeros((12, count, 6))  # upper form: band[11 + row - column, column]
    for column in range(6):
        for row in range(column + 1):
            band[11 + row - column, :, column] = diagonal[:, row, column]
        for row in range(6):
            band[5 + row - column, 1:, column] = off[:, row, column]
    return np.asarray(solveh_banded(band.reshape(12, -1), rhs.ravel())).reshape(count, 6)


def _state_covariance(diagonal: Array, off: Array) -> Array:
    """Diagonal blocks (K, 6, 6) of the inverse of a block-tridiagonal matrix, by elimination from both ends."""
    count = len(diagonal)
    left, right = np.zeros_like(diagonal), np.zeros_like(diagonal)
    for k in range(1, count):
        left[k] = off[k - 1].T @ np.linalg.solve(diagonal[k - 1] - left[k - 1], off[k - 1])
    for k in range(count - 2, -1, -1):
        right[k] = off[k] @ np.linalg.solve(diagonal[k + 1] - right[k + 1], off[k].T)
    return np.asarray(np.linalg.inv(diagonal - left - right), dtype=np.float64)
