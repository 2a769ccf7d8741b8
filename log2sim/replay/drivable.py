"""The course nearest to an agent's waypoints that a vehicle can drive.

Reconstructed waypoints need not fit a vehicle: a heading that is a few degrees off, a box that creeps sideways, a turn
tighter than full lock. A controller can only trade such faults against each other, with a delay. So they are settled
beforehand, over the whole life at once: the box centers bind, the headings advise, and the rear axle rolls.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array, wrap_angle

KNOT_S = 0.1
MAX_KNOTS = 60_000  # 100 minutes; a longer life is followed as logged

POSITION_M = 0.1  # standard deviations of what the log says, at every knot
YAW_RAD = 0.1
SPEED_MPS = 0.5
JERK_MPS3 = 20.0  # and of what a driver does
LATERAL_JERK_MPS3 = 20.0
ROLL_M, ROLL_RAD, ROLL_MPS = 1e-3, 1e-3, 1e-2  # how exactly the wheels roll from knot to knot
LOCK_SHARE = 0.95  # the rest of the lock is left to the controller
BOUND = 0.002  # softness of limits, as a share of them

ITERATIONS, TRIALS = 40, 16
DONE = 1e-4  # relative gain at which the iteration ends
SLOWEST_RADPS = 0.01
STATES = 6  # x, y, yaw, speed, acceleration, curvature
DAMPED = np.array([1 / POSITION_M, 1 / POSITION_M, 1 / YAW_RAD, 1 / SPEED_MPS, 1.0, 10.0]) ** 2


@dataclass(frozen=True)
class Limits:
    """What a vehicle can do: curvature and its rate in time, acceleration ahead and sideways; and where its box center is."""

    offset_m: float
    max_curvature_1pm: float
    max_curvature_rate_1pmps: float
    max_accel_mps2: float
    max_lateral_mps2: float = 8.0  # of a dry road's grip of 9 m/s2; the rest is left to the controller


@dataclass(frozen=True, eq=False)
class Course:
    """Rear axle at times `t_s` (K,): position in m, yaw in rad (unwrapped), signed speed, acceleration, curvature, all (K,)."""

    t_s: Array
    x_m: Array
    y_m: Array
    yaw_rad: Array
    speed_mps: Array
    accel_mps2: Array
    curvature_1pm: Array

    @cached_property
    def motion(self) -> tuple[Array, Array]:
        """x, y, yaw and speed as rows (4, K), and their derivatives in time (4, K)."""
        cos, sin, v = np.cos(self.yaw_rad), np.sin(self.yaw_rad), self.speed_mps
        return (
            np.stack([self.x_m, self.y_m, self.yaw_rad, v]),
            np.stack([v * cos, v * sin, v * self.curvature_1pm, self.accel_mps2]),
        )


def nearest_course(t_s: Array, x_m: Array, y_m: Array, yaw_rad: Array, speed_mps: Array, limits: Limits) -> Course:
    """Fit a course to box centers and headings at evenly spaced times (K,), K >= 2.

    Notes
    -----
    Least squares over all knots at once, by Gauss-Newton steps with Levenberg-Marquardt damping. Rolling without slip is a
    residual as well (direct multiple shooting, Bock & Plitt, 1984), which makes every step a banded system: cost O(K).
    Headings and speeds enter by the pseudo-Huber loss, so a few that are far off are outvoted.
    """
    axis = _axis(yaw_rad)
    away = wrap_angle(yaw_rad - axis)
    logged = np.stack([x_m, y_m, axis + away, np.where(np.abs(away) > np.pi / 2, -speed_mps, speed_mps)], axis=1)
    along = np.gradient(x_m, t_s) * np.cos(axis) + np.gradient(y_m, t_s) * np.sin(axis)
    state = _first_guess(t_s, x_m, y_m, axis, along, limits)
    problem = _Problem(float(t_s[1] - t_s[0]), logged, limits)
    residuals = problem.residuals(state)
    cost, damping = _cost(residuals), 1e-2
    for _ in range(ITERATIONS):
        diagonal, beside, gradient = _normal_equations(residuals)
        for _ in range(TRIALS):
            trial = state - _solve(diagonal, beside, gradient, damping)
            residuals = problem.residuals(trial)
            gain = cost - _cost(residuals)
            if gain > 0:
                break
            damping *= 8
        else:
            break
        state, cost, damping = trial, cost - gain, max(damping / 4, 1e-9)
        if gain < DONE * cost:
            break
    return Course(t_s, *state.T)


def as_logged(t_s: Array, x_m: Array, y_m: Array, yaw_rad: Array, speed_mps: Array, limits: Limits) -> Course:
    """The course as the log has it, at times (K,), K >= 1: of a moment, or of a life too long to be fitted."""
    return Course(t_s, *_first_guess(t_s, x_m, y_m, yaw_rad, speed_mps, limits).T)


def _axis(yaw: Array) -> Array:
    """Headings (K,) without turns of more than a quarter from knot to knot, back to front where the log is so less often."""
    axis = np.unwrap(yaw, period=np.pi)
    return axis + np.pi if np.sum(np.cos(axis - yaw)) < 0 else axis


def _first_guess(t_s: Array, x: Array, y: Array, yaw: Array, speed: Array, limits: Limits) -> Array:
    """Rear axles as the log has them, acceleration and curvature within their limits; (K, 6)."""
    guess = np.zeros((len(t_s), STATES))
    guess[:, 0], guess[:, 1] = x - limits.offset_m * np.cos(yaw), y - limits.offset_m * np.sin(yaw)
    guess[:, 2], guess[:, 3] = yaw, speed
    if len(t_s) > 1:
        accel, turn = np.gradient(speed, t_s), np.gradient(yaw, t_s)
        guess[:, 4] = np.clip(accel, -limits.max_accel_mps2, limits.max_accel_mps2)
        # As a share of the curvature that lock and grip allow, which leaves slow vehicles that turn on the spot at the lock.
        pace = np.abs(speed)
        most = limits.max_lateral_mps2 / np.maximum(pace**2, limits.max_lateral_mps2 / limits.max_curvature_1pm)
        guess[:, 5] = most * np.clip(turn / np.maximum(most * pace, SLOWEST_RADPS), -1, 1) * np.sign(speed)
    return guess


@dataclass(frozen=True, eq=False)
class _Problem:
    """`logged` (K, 4): center x, y, yaw and speed at knots `h_s` apart."""

    h_s: float
    logged: Array
    limits: Limits

    def residuals(self, state: Array) -> Residuals:
        """Residuals and their derivatives, of the knots and of the ways between them."""
        return *self._knots(state), *self._rolls(state)

    def _knots(self, state: Array) -> tuple[Array, Array]:
        """Residuals (K, 7) against the log and the limits, and their derivatives (K, 7, 6)."""
        x, y, yaw, speed, accel, curvature = state.T
        o, scale = self.limits.offset_m, np.sqrt(self.h_s / KNOT_S)
        cos, sin = np.cos(yaw), np.sin(yaw)
        residual = np.zeros((len(state), 7))
        jacobian = np.zeros((len(state), 7, STATES))
        residual[:, 0] = (x + o * cos - self.logged[:, 0]) / POSITION_M
        residual[:, 1] = (y + o * sin - self.logged[:, 1]) / POSITION_M
        jacobian[:, 0, 0] = jacobian[:, 1, 1] = 1 / POSITION_M
        jacobian[:, 0, 2], jacobian[:, 1, 2] = -o * sin / POSITION_M, o * cos / POSITION_M
        limits = self.limits
        residual[:, 2], jacobian[:, 2, 4] = _beyond(accel, limits.max_accel_mps2)
        residual[:, 3], jacobian[:, 3, 5] = _beyond(curvature, limits.max_curvature_1pm)
        residual[:, 4], slope = _beyond(speed**2 * curvature, limits.max_lateral_mps2)
        jacobian[:, 4, 3], jacobian[:, 4, 5] = slope * 2 * speed * curvature, slope * speed**2
        residual[:, 5], jacobian[:, 5, 2] = (yaw - self.logged[:, 2]) / YAW_RAD, 1 / YAW_RAD
        residual[:, 6], jacobian[:, 6, 3] = (speed - self.logged[:, 3]) / SPEED_MPS, 1 / SPEED_MPS
        return residual * scale, jacobian * scale

    def _rolls(self, state: Array) -> tuple[Array, Array]:
        """Residuals (K - 1, 6) of rolling and of the driver's smoothness, and their derivatives (K - 1, 6, 12)."""
        h, (a, b) = self.h_s, (state[:-1], state[1:])
        mean, rise = (a + b) / 2, b - a
        cos, sin = np.cos(mean[:, 2]), np.sin(mean[:, 2])
        way = h * mean[:, 3] * np.sinc(rise[:, 2] / (2 * np.pi))
        per_speed = h * np.sinc(rise[:, 2] / (2 * np.pi)) / 2
        residual = np.stack(
            [
                (rise[:, 0] - way * cos) / ROLL_M,
                (rise[:, 1] - way * sin) / ROLL_M,
                (rise[:, 2] - h * mean[:, 3] * mean[:, 5]) / ROLL_RAD,
                (rise[:, 3] - h * mean[:, 4]) / ROLL_MPS,
                rise[:, 4] / np.sqrt(h * KNOT_S) / JERK_MPS3,
                rise[:, 5] / np.sqrt(h * KNOT_S) / self._curvature_rate,
            ],
            axis=1,
        )
        jacobian = np.zeros((len(a), 6, 2 * STATES))
        for end, sign in ((0, -1.0), (STATES, 1.0)):
            for row, scale in ((0, ROLL_M), (1, ROLL_M), (2, ROLL_RAD), (3, ROLL_MPS)):
                jacobian[:, row, end + row] = sign / scale
            jacobian[:, 0, end + 2], jacobian[:, 0, end + 3] = way * sin / 2 / ROLL_M, -per_speed * cos / ROLL_M
            jacobian[:, 1, end + 2], jacobian[:, 1, end + 3] = -way * cos / 2 / ROLL_M, -per_speed * sin / ROLL_M
            jacobian[:, 2, end + 3], jacobian[:, 2, end + 5] = (
                -h * mean[:, 5] / 2 / ROLL_RAD,
                -h * mean[:, 3] / 2 / ROLL_RAD,
            )
            jacobian[:, 3, end + 4] = -h / 2 / ROLL_MPS
            jacobian[:, 4, end + 4] = sign / np.sqrt(h * KNOT_S) / JERK_MPS3
            jacobian[:, 5, end + 5] = sign / np.sqrt(h * KNOT_S) / self._curvature_rate
        return residual, jacobian

    @cached_property
    def _curvature_rate(self) -> Array:
        """Standard deviation (K - 1,) of the rate of curvature: by the steering, and by the passengers when fast."""
        pace = np.maximum(np.abs(self.logged[1:, 3]), np.abs(self.logged[:-1, 3]))
        steering = self.limits.max_curvature_rate_1pmps / 2
        return LATERAL_JERK_MPS3 / np.maximum(pace**2, LATERAL_JERK_MPS3 / steering)


Residuals = tuple[Array, Array, Array, Array]
PLAIN, ROBUST = slice(5), slice(5, 7)  # of a knot's residuals; heading and speed count by the pseudo-Huber loss


def _cost(residuals: Residuals) -> float:
    """Half the sum of squares, the pseudo-Huber loss for headings and speeds."""
    knot, _, roll, _ = residuals
    plain = np.sum(roll**2) + np.sum(knot[:, PLAIN] ** 2)
    return float(plain / 2 + np.sum(np.sqrt(1 + knot[:, ROBUST] ** 2) - 1))


def _normal_equations(residuals: Residuals) -> tuple[Array, Array, Array]:
    """Blocks on the diagonal (K, 6, 6), below it (K - 1, 6, 6) and the gradient (K, 6) of the cost."""
    knot, knot_slopes, roll, roll_slopes = residuals
    weight = np.ones_like(knot)
    weight[:, ROBUST] = 1 / np.sqrt(1 + knot[:, ROBUST] ** 2)
    weighted = (weight[:, :, None] * knot_slopes).transpose(0, 2, 1)
    diagonal, gradient = weighted @ knot_slopes, (weighted @ knot[:, :, None])[:, :, 0]
    turned = roll_slopes.transpose(0, 2, 1)
    both, push = turned @ roll_slopes, (turned @ roll[:, :, None])[:, :, 0]
    diagonal[:-1] += both[:, :STATES, :STATES]
    diagonal[1:] += both[:, STATES:, STATES:]
    gradient[:-1] += push[:, :STATES]
    gradient[1:] += push[:, STATES:]
    return diagonal, both[:, STATES:, :STATES], gradient


def _beyond(value: Array, limit: float) -> tuple[Array, Array]:
    """How far values (K,) are beyond a limit of their size, in units of its softness, and the derivative of that."""
    beyond = value - np.minimum(np.maximum(value, -limit), limit)
    return beyond / (BOUND * limit), (beyond != 0) / (BOUND * limit)


def _solve(diagonal: Array, beside: Array, gradient: Array, damping: float) -> NDArray[np.float64]:
    """Solve the damped block-tridiagonal system; (K, 6)."""
    from scipy.linalg import solveh_banded

    count = len(diagonal)
    band = np.zeros((2 * STATES, count, STATES))
    i, j = np.tril_indices(STATES)
    band[i - j, :, j] = diagonal[:, i, j].T
    band[0] += damping * DAMPED
    i, j = np.indices((STATES, STATES)).reshape(2, -1)
    band[STATES + i - j, :-1, j] = beside[:, i, j].T
    return solveh_banded(band.reshape(2 * STATES, -1), gradient.ravel(), lower=True).reshape(count, STATES)
