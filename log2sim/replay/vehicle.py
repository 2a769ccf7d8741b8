"""Vehicle models: a kinematic bicycle about the rear axle and a point mass, as steps over all agents at once.

A step takes a state and controls and returns a new state; nothing is kept between steps. Every column has shape (A,).
The state of a vehicle is that of its rear axle, where the no-slip condition is exact: the axle moves along the heading.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.scenario import Agent

MAX_INNER_STEP_S = 0.02
"""Longest step over which the mean steering angle stands for its course; the error falls with its square."""

WHEELED = ("car", "truck", "bus", "motorcycle", "cyclist", "bicycle")
"""Categories that move as bicycles; all others are points that may also move sideways."""


@dataclass(frozen=True, eq=False)
class Columns:
    """Base of records whose fields are arrays (A,)."""

    @classmethod
    def zeros(cls, count: int) -> Self:
        """Agents whose columns are all zero."""
        return cls(*(np.zeros(count) for _ in fields(cls)))

    def take(self, index: Any) -> Self:
        """The agents at `index` (integers, a slice or a mask)."""
        return type(self)(*(getattr(self, f.name)[index] for f in fields(self)))

    def put(self, index: Any, other: Self) -> None:
        """Overwrite the agents at `index`; only the owner of the columns may do so."""
        for f in fields(self):
            getattr(self, f.name)[index] = getattr(other, f.name)


@dataclass(frozen=True, eq=False)
class VehicleState(Columns):
    """Rear axle `x_m`, `y_m`, `yaw_rad` (not wrapped), `speed_mps` (negative in reverse), and what the actuators do.

    `pedal_mps2` is throttle (positive) or brake (negative), whatever the gear. `lateral_mps`, the rear axle's velocity to
    the left, and `yaw_rate_radps` are states of the models that slip; the kinematic bicycle leaves them as they are.
    """

    x_m: Array
    y_m: Array
    yaw_rad: Array
    speed_mps: Array
    steer_rad: Array
    pedal_mps2: Array
    lateral_mps: Array
    yaw_rate_radps: Array


@dataclass(frozen=True, eq=False)
class VehicleControls(Columns):
    """Commands: `pedal_mps2` (positive throttle, negative brake), `steer_rad`, and the gear, which engages at standstill."""

    pedal_mps2: Array
    steer_rad: Array
    reverse: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class VehicleParameters(Columns):
    """Size and limits of vehicles, all positive; `rear_axle_offset_m` leads from the rear axle to the box center."""

    wheelbase_m: Array
    rear_axle_offset_m: Array
    max_steer_rad: Array
    max_steer_rate_radps: Array
    steer_lag_s: Array
    max_throttle_mps2: Array
    max_brake_mps2: Array
    max_jerk_mps3: Array
    pedal_lag_s: Array


@dataclass(frozen=True, eq=False)
class PointState(Columns):
    """Center `x_m`, `y_m` and its velocity on map axes."""

    x_m: Array
    y_m: Array
    velocity_x_mps: Array
    velocity_y_mps: Array


@dataclass(frozen=True, eq=False)
class PointControls(Columns):
    """Commanded acceleration on map axes."""

    accel_x_mps2: Array
    accel_y_mps2: Array


# Wheelbase and rear axle (behind the box center) as shares of the length, full lock, throttle and brake. Cars: a 4.3 m
# hatchback has 2.6 m and 1.3 m; buses carry a long overhang behind the rear axle; brakes reach the tire's friction limit.
_BY_CATEGORY: dict[str, tuple[float, float, float, float, float]] = {
    "car": (0.61, 0.30, 0.65, 6.0, 10.0),
    "truck": (0.57, 0.28, 0.75, 4.0, 9.0),
    "bus": (0.50, 0.22, 0.85, 3.0, 8.0),
    "motorcycle": (0.66, 0.33, 0.70, 8.0, 10.0),
    "cyclist": (0.60, 0.30, 0.80, 3.0, 7.0),
    "bicycle": (0.60, 0.30, 0.80, 3.0, 7.0),
}

STEER_RATE_RADPS = 1.0  # at the road wheels: a full turn of the hand wheel in 0.4 s at a ratio of 16
STEER_LAG_S = 0.10
PEDAL_LAG_S = 0.10
MAX_JERK_MPS3 = 60.0
POINT_MAX_ACCEL_MPS2 = 6.0  # a sprinter's start


def rear_axle_offset(agent: Agent) -> float:
    """Distance in m from the rear axle forward to the box center; 0 in a scenario means that it is not known.

    No wheeled vehicle turns about its box center, so an unknown offset is taken from the length; points have none.
    """
    if agent.category not in WHEELED:
        return 0.0
    return agent.rear_axle_offset_m or _BY_CATEGORY[agent.category][1] * agent.size_m[0]


def parameters_for(agents: Sequence[Agent]) -> VehicleParameters:
    """Parameters (A,) of wheeled agents from their category and length."""
    kind = np.array([_BY_CATEGORY[a.category] for a in agents]).reshape(-1, 5)
    length_m = np.array([a.size_m[0] for a in agents], dtype=np.float64)
    same = np.ones(len(agents))
    return VehicleParameters(
        wheelbase_m=kind[:, 0] * length_m,
        rear_axle_offset_m=np.array([rear_axle_offset(a) for a in agents], dtype=np.float64),
        max_steer_rad=kind[:, 2],
        max_steer_rate_radps=STEER_RATE_RADPS * same,
        steer_lag_s=STEER_LAG_S * same,
        max_throttle_mps2=kind[:, 3],
        max_brake_mps2=kind[:, 4],
        max_jerk_mps3=MAX_JERK_MPS3 * same,
        pedal_lag_s=PEDAL_LAG_S * same,
    )


def step_bicycle(
    state: VehicleState, controls: VehicleControls, parameters: VehicleParameters, dt_s: float
) -> VehicleState:
    """Move vehicles by `dt_s` with constant commands.

    Notes
    -----
    Actuators (first-order lag, rate and saturation limits) are solved in closed form, and so is the arc that the rear axle
    drives with the mean steering angle of the step: exact for constant steering at any acceleration, of second order in
    the step otherwise, never unstable. Braking ends at standstill; only the other gear's throttle leads on from there.
    """
    p = parameters
    pedal_target = np.minimum(np.maximum(controls.pedal_mps2, -p.max_brake_mps2), p.max_throttle_mps2)
    steer_target = np.minimum(np.maximum(controls.steer_rad, -p.max_steer_rad), p.max_steer_rad)
    count = max(1, math.ceil(dt_s / MAX_INNER_STEP_S - 1e-9))
    h = dt_s / count
    x, y, yaw, speed = state.x_m, state.y_m, state.yaw_rad, state.speed_mps
    pedal, steer = state.pedal_mps2, state.steer_rad
    standing_gear = np.where(controls.reverse, -1.0, 1.0)
    for _ in range(count):
        pedal, mean_pedal = _actuate(pedal, pedal_target, p.pedal_lag_s, p.max_jerk_mps3, h)
        steer, mean_steer = _actuate(steer, steer_target, p.steer_lag_s, p.max_steer_rate_radps, h)
        gear = np.where(speed == 0, standing_gear, np.sign(speed))
        pace, distance = _advance(np.abs(speed), mean_pedal, h)
        turn = gear * distance * np.tan(mean_steer) / p.wheelbase_m
        chord = gear * distance * _sinc(turn / 2)
        x, y = x + chord * np.cos(yaw + turn / 2), y + chord * np.sin(yaw + turn / 2)
        yaw, speed = yaw + turn, gear * pace
    return VehicleState(x, y, yaw, speed, steer, pedal, state.lateral_mps, state.yaw_rate_radps)


def step_point(state: PointState, controls: PointControls, dt_s: float) -> PointState:
    """Move points by `dt_s` with constant acceleration, limited in magnitude; exact."""
    ax, ay = controls.accel_x_mps2, controls.accel_y_mps2
    size = np.hypot(ax, ay)
    scale = np.where(size > POINT_MAX_ACCEL_MPS2, POINT_MAX_ACCEL_MPS2 / np.where(size > 0, size, 1.0), 1.0)
    ax, ay = ax * scale, ay * scale
    return PointState(
        state.x_m + (state.velocity_x_mps + ax * dt_s / 2) * dt_s,
        state.y_m + (state.velocity_y_mps + ay * dt_s / 2) * dt_s,
        state.velocity_x_mps + ax * dt_s,
        state.velocity_y_mps + ay * dt_s,
    )


def _actuate(value: Array, target: Array, lag_s: Array, max_rate: Array, h: float) -> tuple[Array, Array]:
    """Value after `h` and its mean over `h` of an actuator with lag, which moves at `max_rate` while far from the target."""
    gap = np.abs(target - value)
    sign = np.sign(target - value)
    limited_s = np.minimum(np.maximum(gap / max_rate - lag_s, 0.0), h)
    near = gap - max_rate * limited_s
    decay = np.exp((limited_s - h) / lag_s)
    mean_gap = (limited_s * (gap + near) / 2 + near * lag_s * (1 - decay)) / h
    return target - sign * near * decay, target - sign * mean_gap


def _advance(pace: Array, pedal: Array, h: float) -> tuple[Array, Array]:
    """Pace (not negative) after `h` and the distance covered; braking ends at rest, within the step too."""
    after = pace + pedal * h
    stops = after < 0
    braking = np.where(stops, pedal, -1.0)  # negative wherever the step ends at rest
    return np.where(stops, 0.0, after), np.where(stops, -(pace**2) / (2 * braking), (pace + after) * h / 2)


def _sinc(angle: Array) -> Array:
    """sin(angle) / angle, 1 at zero."""
    zero = angle == 0
    return np.where(zero, 1.0, np.sin(angle) / np.where(zero, 1.0, angle))
