"""Vehicle models: a kinematic bicycle about the rear axle and a point mass, as steps over all agents at once.

A step takes a state and controls and returns a new state; the models keep no state between steps. Every column has
shape (A,). The state of a vehicle is that of its rear axle, where the no-slip condition is exact: the axle moves along
the heading.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array, cos_sin

MAX_INNER_STEP_S = 0.02  # longest step over which the mean steering angle is used; the error is of second order
GRAVITY_MPS2 = 9.81

TINY = 1e-300  # added where zero would divide: it changes no other number, and takes a third of the time of a mask


@dataclass(frozen=True, eq=False)
class Columns:
    """Base of records whose fields are arrays (A,) or (..., A)."""

    @classmethod
    def zeros(cls, count: int) -> Self:
        """Return records of agents whose columns are all zero."""
        return cls(*(np.zeros(count) for _ in fields(cls)))

    def take(self, index: Any) -> Self:
        """Return the agents at `index` (integers, a slice or a mask)."""
        return type(self)(*(getattr(self, f.name)[..., index] for f in fields(self)))

    def put(self, index: Any, other: Self) -> None:
        """Overwrite the agents at `index`; only the owner of the columns may do so."""
        for f in fields(self):
            getattr(self, f.name)[..., index] = getattr(other, f.name)


@dataclass(frozen=True, eq=False)
class VehicleState(Columns):
    """State of vehicles: rear axle and actuators."""

    x_m: Array
    y_m: Array
    yaw_rad: Array  # (A,) not wrapped
    speed_mps: Array  # (A,) negative in reverse
    steer_rad: Array  # (A,)
    pedal_mps2: Array  # (A,) throttle (positive) or brake (negative), in either gear
    lateral_mps: (
        Array  # (A,) velocity of the rear axle to the left; likewise `yaw_rate_radps`, of models with slip only
    )
    yaw_rate_radps: Array


@dataclass(frozen=True, eq=False)
class VehicleControls(Columns):
    """Commands of vehicles."""

    pedal_mps2: Array  # (A,) positive throttle, negative brake
    steer_rad: Array  # (A,)
    reverse: NDArray[np.bool_]  # (A,) the gear, which engages at standstill


VehicleStep = Callable[["VehicleState", "VehicleControls", "VehicleParameters", float], "VehicleState"]
"""Moves vehicles for so many s with constant controls; no argument is changed."""


class Actuators(NamedTuple):
    """Limits, lags and rate limits of actuators, arrays of one shape."""

    low: Array
    high: Array
    lag_s: Array
    max_rate: Array


@dataclass(frozen=True, eq=False)
class VehicleParameters(Columns):
    """Size and limits of vehicles, all positive and (A,)."""

    wheelbase_m: Array
    rear_axle_offset_m: Array  # from the rear axle forward to the box center
    max_steer_rad: Array
    max_steer_rate_radps: Array
    steer_lag_s: Array
    max_throttle_mps2: Array
    max_brake_mps2: Array
    max_jerk_mps3: Array
    pedal_lag_s: Array
    cg_to_rear_m: Array  # place of the center of gravity
    cg_height_m: Array
    gyration_m2: Array  # yaw inertia over mass
    front_stiffness_1prad: Array  # cornering stiffness over the friction limit
    rear_stiffness_1prad: Array
    friction: Array
    understeer_s2pm2: Array  # for the controller: by how much lateral acceleration widens the curve, 0 without slip

    @cached_property
    def max_curvature_1pm(self) -> Array:
        """Curvature at full lock."""
        return np.tan(self.max_steer_rad) / self.wheelbase_m

    @cached_property
    def actuators(self) -> Actuators:
        """Limits of pedal and steering, as rows (2, A)."""
        return Actuators(
            rows(-self.max_brake_mps2, -self.max_steer_rad),
            rows(self.max_throttle_mps2, self.max_steer_rad),
            rows(self.pedal_lag_s, self.steer_lag_s),
            rows(self.max_jerk_mps3, self.max_steer_rate_radps),
        )


@dataclass(frozen=True, eq=False)
class PointState(Columns):
    """Centers of point masses and their velocities on map axes."""

    x_m: Array
    y_m: Array
    velocity_x_mps: Array
    velocity_y_mps: Array


@dataclass(frozen=True, eq=False)
class PointControls(Columns):
    """Commanded acceleration on map axes."""

    accel_x_mps2: Array
    accel_y_mps2: Array


POINT_MAX_ACCEL_MPS2 = 6.0  # a sprinter's start


def step_bicycle(
    state: VehicleState, controls: VehicleControls, parameters: VehicleParameters, dt_s: float
) -> VehicleState:
    """Move vehicles by `dt_s` with constant commands.

    Actuators (first-order lag, rate and saturation limits) are solved in closed form, and so is the arc of the rear axle at
    the mean steering angle of the step: exact for constant steering at any acceleration, of second order in the step
    otherwise, unconditionally stable. Braking ends at standstill; to reverse, the gear must change.
    """
    actuators, target, lag_s, max_rate = actuation(state, controls, parameters)
    count = max(1, math.ceil(dt_s / MAX_INNER_STEP_S - 1e-9))
    h = dt_s / count
    x, y, yaw, speed = state.x_m, state.y_m, state.yaw_rad, state.speed_mps
    for _ in range(count):
        actuators, (mean_pedal, mean_steer) = actuate(actuators, target, lag_s, max_rate, h)
        gear = engaged_gear(speed, controls.reverse)
        pace, distance = advance_speed(np.abs(speed), mean_pedal, h)
        turn = gear * distance * (np.tan(mean_steer) / parameters.wheelbase_m)
        chord = gear * distance * sinc(turn / 2)
        cos, sin = cos_sin(yaw + turn / 2)
        x, y, yaw, speed = x + chord * cos, y + chord * sin, yaw + turn, gear * pace
    pedal, steer = actuators
    return VehicleState(x, y, yaw, speed, steer, pedal, state.lateral_mps, state.yaw_rate_radps)


def step_point(state: PointState, controls: PointControls, dt_s: float) -> PointState:
    """Move points by `dt_s` with constant acceleration, limited in magnitude; exact."""
    size = np.hypot(controls.accel_x_mps2, controls.accel_y_mps2)
    scale = np.where(size > POINT_MAX_ACCEL_MPS2, POINT_MAX_ACCEL_MPS2 / np.where(size > 0, size, 1.0), 1.0)
    ax, ay = controls.accel_x_mps2 * scale, controls.accel_y_mps2 * scale
    return PointState(
        state.x_m + (state.velocity_x_mps + ax * dt_s / 2) * dt_s,
        state.y_m + (state.velocity_y_mps + ay * dt_s / 2) * dt_s,
        state.velocity_x_mps + ax * dt_s,
        state.velocity_y_mps + ay * dt_s,
    )


def clamp(value: Array, low: Array | float, high: Array | float) -> Array:
    """Clip values to limits; `np.clip` takes twice as long on short arrays."""
    return np.minimum(np.maximum(value, low), high)


def rows(first: Array | float, second: Array) -> Array:
    """Stack two columns (A,) to one array (2, A); `np.stack` takes three times as long."""
    both = np.empty((2, len(second)))
    both[0], both[1] = first, second
    return both


def engaged_gear(speed: Array, reverse: NDArray[np.bool_]) -> Array:
    """Return the gear: the sign of the motion, at rest that of the selector."""
    return np.sign(speed + TINY * (0.5 - reverse))


def actuation(
    state: VehicleState, controls: VehicleControls, parameters: VehicleParameters
) -> tuple[Array, Array, Array, Array]:
    """Return pedal and steering (2, A), then their clipped targets, lags and rate limits."""
    low, high, lag_s, max_rate = parameters.actuators
    target = clamp(rows(controls.pedal_mps2, controls.steer_rad), low, high)
    return rows(state.pedal_mps2, state.steer_rad), target, lag_s, max_rate


def actuate(value: Array, target: Array, lag_s: Array, max_rate: Array, h: float) -> tuple[Array, Array]:
    """Return value after `h` and mean over `h` of an actuator with lag, which moves at `max_rate` while far from the target."""
    gap = target - value
    far = np.abs(gap) - max_rate * lag_s
    if not (far > 0).any():  # the same numbers as below, in half the time
        decay = np.exp(-h / lag_s)
        return target - gap * decay, target - gap * (lag_s * (1 - decay) / h)
    limited_s = clamp(far / max_rate, 0.0, h)
    decay = np.exp((limited_s - h) / lag_s)
    near = gap - np.copysign(max_rate * limited_s, gap)
    mean_gap = limited_s * (gap + near) / (2 * h) + near * (lag_s * (1 - decay) / h)
    return target - near * decay, target - mean_gap


def advance_speed(pace: Array, pedal: Array, h: float) -> tuple[Array, Array]:
    """Return speed (not negative) after `h` and distance covered; braking ends at rest, also within the step."""
    after = pace + pedal * h
    distance = (pace + after) * (h / 2)
    stops = np.flatnonzero(after < 0)
    if len(stops):
        after[stops], distance[stops] = 0.0, -(pace[stops] ** 2) / (2 * pedal[stops])
    return after, distance


def sinc(angle: Array) -> Array:
    """sin(angle) / angle, 1 at zero."""
    half = angle / 2 + TINY
    t = np.tan(half)
    return np.asarray(t / (half * (1 + t * t)))
