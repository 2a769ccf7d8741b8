"""The feasible trajectory nearest to an agent's waypoints.

Reconstructed waypoints need not suit a vehicle: a heading is a few degrees off, a box creeps sideways, a turn is
tighter than full lock. A controller could only trade such errors against each other, and late. So a trajectory without
them is fitted beforehand, over the whole lifetime at once: box centers weigh most, headings less, and the rear axle
rolls without slip.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array, wrap_angle

KNOT_S = 0.1
MAX_KNOTS = 60_000  # 100 minutes; a longer trajectory is followed as it is

POSITION_M = 0.1  # standard deviations of the scenario's states, at every knot
YAW_RAD = 0.1
SPEED_MPS = 0.5
JERK_MPS3 = 20.0  # standard deviations of a driver's inputs
LATERAL_JERK_MPS3 = 20.0
ROLL_M, ROLL_RAD, ROLL_MPS = 1e-3, 1e-3, 1e-2  # standard deviations of rolling without slip from knot to knot
LOCK_SHARE = 0.95  # the rest of the steering range is left to the controller
LIMIT_SIGMA_SHARE = 0.002  # softness of limits, as a share of them

MAX_ITERATIONS, MAX_DAMPING_TRIALS = 40, 16
MIN_RELATIVE_GAIN = 1e-4  # relative gain at which the iteration ends
MIN_YAW_RATE_RADPS = 0.01
X, Y, YAW, SPEED, ACCEL, CURVATURE = range(6)
STATES = NEXT = 6  # columns of a knot; those of the next knot follow
DAMPING_SCALE = np.array([1 / POSITION_M, 1 / POSITION_M, 1 / YAW_RAD, 1 / SPEED_MPS, 1.0, 10.0]) ** 2


@dataclass(frozen=True)
class FeasibilityLimits:
    """What a vehicle can do."""

    offset_m: float  # from the rear axle forward to the box center
    max_curvature_1pm: float
    max_curvature_rate_1pmps: float
    max_accel_mps2: float
    max_lateral_mps2: float = 8.0  # below the 9 m/s2 of a dry road; the rest is left to the controller


@dataclass(frozen=True, eq=False)
class FeasibleTrajectory:
    """States of a rear axle that rolls without slip, at times `t_s` (K,)."""

    t_s: Array
    x_m: Array
    y_m: Array
    yaw_rad: Array  # unwrapped
    speed_mps: Array  # negative in reverse
    accel_mps2: Array
    curvature_1pm: Array  # positive to the left

    @cached_property
    def motion(self) -> tuple[Array, Array]:
        """x, y, yaw and speed as rows (4, K), and their time derivatives (4, K)."""
        cos, sin, v = np.cos(self.yaw_rad), np.sin(self.yaw_rad), self.speed_mps
        return (
            np.stack([self.x_m, self.y_m, self.yaw_rad, v]),
            np.stack([v * cos, v * sin, v * self.curvature_1pm, self.accel_mps2]),
        )


def fit_trajectory(
    t_s: Array, x_m: Array, y_m: Array, yaw_rad: Array, speed_mps: Array, limits: FeasibilityLimits
) -> FeasibleTrajectory:
    """Fit a feasible trajectory to box centers and headings at evenly spaced times (K,); a single one, or too many, as they are.

    Least squares over all knots at once, by Gauss-Newton steps with Levenberg-Marquardt damping. Rolling without slip is a
    residual as well (direct multiple shooting, Bock & Plitt, 1984), which makes every step a banded system: cost O(K).
    Headings and speeds enter by the pseudo-Huber loss, so outliers have little influence.
    """
    if not 1 < len(t_s) <= MAX_KNOTS:
        return FeasibleTrajectory(t_s, *_initial_states(t_s, x_m, y_m, yaw_rad, speed_mps, limits).T)
    axis = np.unwrap(yaw_rad, period=np.pi)
    axis = axis + np.pi if np.sum(np.cos(axis - yaw_rad)) < 0 else axis
    away = wrap_angle(yaw_rad - axis)
    logged = np.stack([x_m, y_m, axis + away, np.where(np.abs(away) > np.pi / 2, -speed_mps, speed_mps)], axis=1)
    along = np.gradient(x_m, t_s) * np.cos(axis) + np.gradient(y_m, t_s) * np.sin(axis)
    state = _initial_states(t_s, x_m, y_m, axis, along, limits)
    told = logged, float(t_s[1] - t_s[0]), limits
    terms = residual_terms(state, *told)
    cost, damping = _cost(terms), 1e-2
    for _ in range(MAX_ITERATIONS):
        band, gradient = _normal_equations(terms, len(state))
        for _ in range(MAX_DAMPING_TRIALS):
            trial = state - _solve(band, gradient, damping)
            terms = residual_terms(trial, *told)
            gain = cost - _cost(terms)
            if gain > 0:
                break
            damping *= 8
        else:
            break
        state, cost, damping = trial, cost - gain, max(damping / 4, 1e-9)
        if gain < MIN_RELATIVE_GAIN * cost:
            break
    return FeasibleTrajectory(t_s, *state.T)


def _initial_states(t_s: Array, x: Array, y: Array, yaw: Array, speed: Array, limits: FeasibilityLimits) -> Array:
    """Return the given rear axles with acceleration and curvature clipped to their limits, (K, 6)."""
    guess = np.zeros((len(t_s), STATES))
    guess[:, 0], guess[:, 1] = x - limits.offset_m * np.cos(yaw), y - limits.offset_m * np.sin(yaw)
    guess[:, 2], guess[:, 3] = yaw, speed
    if len(t_s) > 1:
        accel, turn = np.gradient(speed, t_s), np.gradient(yaw, t_s)
        guess[:, 4] = np.clip(accel, -limits.max_accel_mps2, limits.max_accel_mps2)
        # As a share of the curvature that steering and grip allow: a slow vehicle that turns on the spot gets full lock.
        pace = np.abs(speed)
        most = limits.max_lateral_mps2 / np.maximum(pace**2, limits.max_lateral_mps2 / limits.max_curvature_1pm)
        guess[:, 5] = most * np.clip(turn / np.maximum(most * pace, MIN_YAW_RATE_RADPS), -1, 1) * np.sign(speed)
    return guess


Slopes = dict[int, Array | float]


class ResidualTerm(NamedTuple):
    """Residuals of knots (K,) or of steps between knots (K - 1,) with their derivatives by state.

    A `robust` term enters by the pseudo-Huber loss, all others by their square.
    """

    residual: Array
    slopes: Slopes
    robust: bool = False


def residual_terms(state: Array, logged: Array, h: float, limits: FeasibilityLimits) -> list[ResidualTerm]:
    """Return the terms of the cost of states (K, 6) at knots `h` s apart.

    They are the scenario's states, `logged` (K, 4) as box center x, y, yaw and speed; limits; rolling; and smooth driving.
    """
    x, y, yaw, speed, accel, curvature = state.T
    log_x, log_y, log_yaw, log_speed = logged.T
    o, scale = limits.offset_m, math.sqrt(h / KNOT_S)
    cos, sin = np.cos(yaw), np.sin(yaw)
    place, turn, pace = scale / POSITION_M, scale / YAW_RAD, scale / SPEED_MPS
    hard, gentle = _limit_residual(accel, limits.max_accel_mps2, scale)
    tight, wide = _limit_residual(curvature, limits.max_curvature_1pm, scale)
    aside, grip = _limit_residual(speed**2 * curvature, limits.max_lateral_mps2, scale)
    knots = [
        ResidualTerm((x + o * cos - log_x) * place, {X: place, YAW: -o * place * sin}),
        ResidualTerm((y + o * sin - log_y) * place, {Y: place, YAW: o * place * cos}),
        ResidualTerm(hard, {ACCEL: gentle}),
        ResidualTerm(tight, {CURVATURE: wide}),
        ResidualTerm(aside, {SPEED: grip * 2 * speed * curvature, CURVATURE: grip * speed**2}),
        ResidualTerm((yaw - log_yaw) * turn, {YAW: turn}, robust=True),
        ResidualTerm((speed - log_speed) * pace, {SPEED: pace}, robust=True),
    ]
    # How fast the curvature changes is limited by the steering, and by comfort at speed.
    pace = np.maximum(np.abs(log_speed[1:]), np.abs(log_speed[:-1]))
    steering = limits.max_curvature_rate_1pmps / 2
    curvature_rate = LATERAL_JERK_MPS3 / np.maximum(pace**2, LATERAL_JERK_MPS3 / steering)
    a, b = state[:-1].T, state[1:].T
    (_, _, yaw, speed, accel, curvature), (dx, dy, turn, gain, jerk, bend) = (a + b) / 2, b - a
    cos, sin, per_speed = np.cos(yaw), np.sin(yaw), h * np.sinc(turn / (2 * np.pi))
    east, north = per_speed * cos, per_speed * sin
    smooth, straight = 1 / (math.sqrt(h * KNOT_S) * JERK_MPS3), 1 / (math.sqrt(h * KNOT_S) * curvature_rate)
    return [
        *knots,
        _transition((dx - speed * east) / ROLL_M, X, 1 / ROLL_M, {YAW: speed * north / ROLL_M, SPEED: -east / ROLL_M}),
        _transition((dy - speed * north) / ROLL_M, Y, 1 / ROLL_M, {YAW: -speed * east / ROLL_M, SPEED: -north / ROLL_M}),
        _transition(
            (turn - h * speed * curvature) / ROLL_RAD, YAW, 1 / ROLL_RAD,
            {SPEED: -h / ROLL_RAD * curvature, CURVATURE: -h / ROLL_RAD * speed},
        ),
        _transition((gain - h * accel) / ROLL_MPS, SPEED, 1 / ROLL_MPS, {ACCEL: -h / ROLL_MPS}),
        _transition(jerk * smooth, ACCEL, smooth, {}),
        _transition(bend * straight, CURVATURE, straight, {}),
    ]  # fmt: skip


def _transition(residual: Array, state: int, per_rise: Array | float, per_mean: Slopes) -> ResidualTerm:
    """Build a term of each knot and the next, from its derivatives by the difference of one state and by means of others."""
    slopes: Slopes = {state: -per_rise, NEXT + state: per_rise}
    for step in (0, NEXT):
        slopes |= {step + k: slope / 2 for k, slope in per_mean.items()}
    return ResidualTerm(residual, slopes)


def _cost(terms: list[ResidualTerm]) -> float:
    """Half the sum of squares, or of the pseudo-Huber loss for headings and speeds."""
    return float(
        sum(np.sum(np.sqrt(1 + t.residual**2) - 1) if t.robust else t.residual @ t.residual / 2 for t in terms)
    )


def _normal_equations(terms: list[ResidualTerm], count: int) -> tuple[Array, Array]:
    """Return the Hessian as a band (K, 6, 12), diagonal and below, and the gradient (K, 6)."""
    band, gradient = np.zeros((count, STATES, 2 * STATES)), np.zeros((count, STATES))
    for residual, slopes, robust in terms:
        weight = 1 / np.sqrt(1 + residual**2) if robust else 1.0
        for i, slope in slopes.items():
            weighted = weight * slope
            _state_rows(gradient, i, residual)[:] += weighted * residual
            for j, other in slopes.items():
                if j <= i:
                    _state_rows(band[:, :, i - j], j, residual)[:] += weighted * other
    return band, gradient


def _state_rows(rows: Array, state: int, residual: Array) -> Array:
    """Return the column of a state in rows (K, 6), cut to the length of a term's residual."""
    knot, column = divmod(state, STATES)
    return rows[knot : knot + len(residual), column]


def _limit_residual(value: Array, limit: float, scale: float) -> tuple[Array, Array]:
    """Return how far values (K,) exceed a limit, in units of its softness, and the derivative of that."""
    beyond, unit = value - np.minimum(np.maximum(value, -limit), limit), scale / (LIMIT_SIGMA_SHARE * limit)
    return beyond * unit, (beyond != 0) * unit


def _solve(band: Array, gradient: Array, damping: float) -> NDArray[np.float64]:
    """Solve the damped block-tridiagonal system; (K, 6)."""
    from scipy.linalg import solveh_banded

    damped = band.copy()
    damped[:, :, 0] += damping * DAMPING_SCALE
    flat = damped.reshape(gradient.size, -1).T
    solved = solveh_banded(flat, gradient.ravel(), lower=True, overwrite_ab=True)
    return np.asarray(solved).reshape(gradient.shape)
