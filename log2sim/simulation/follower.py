"""Controllers that make agents follow their reference: feed-forward from the waypoints and PID feedback.

Gains are time constants and a damping ratio, so they hold for every control step: the error along the path and the error
across it each behave like a damped oscillator with the time constant below, whatever the speed of the vehicle.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from log2sim.geometry import Array, cos_sin
from log2sim.simulation.vehicles.vehicle import (
    TINY,
    Columns,
    PointControls,
    PointState,
    VehicleControls,
    VehicleParameters,
    VehicleState,
    rows,
)


@dataclass(frozen=True)
class ControllerGains:
    """Time constants in s, lengths in m. Defaults stay stable with actuator lags of 0.1 s and steps of up to 0.1 s."""

    along_s: float = 0.6
    across_s: float = 0.6
    across_min_m: float = 1.5  # at walking pace errors decay over this way, since a car cannot move sideways
    integral_s: float = 4.0
    derivative_filter_s: float = 0.05
    damping: float = 1.0
    point_s: float = 0.3
    hold_below_mps: float = 0.05
    hold_brake_mps2: float = 2.0
    hold_within_m: float = 0.1  # a vehicle that stopped shorter than this drives up
    max_lateral_accel_mps2: float = 9.0  # grip of a dry road


GAINS = ControllerGains()
INTEGRAL_LIMIT_MPS2 = 1.0
INTEGRAL_SHARE = 0.2  # of the curvature that lock and grip allow
MAX_CONTROL_STEP_S = 0.1
"""Longest time for which controls are held: a third of the shortest time in which an error decays."""

MAX_ALONG_M = 3.0  # how far the arc at the reference is trusted, and what is made up for at once: at 2.5 m/s


def control_step(dt_s: float) -> float:
    """The part of a simulation step for which controls are held."""
    return dt_s / max(1, math.ceil(dt_s / MAX_CONTROL_STEP_S - 1e-9))


@dataclass(frozen=True, eq=False)
class ControllerMemory(Columns):
    """What the controllers of vehicles remember of the errors along the path and across it, (2, A) each.

    `integral` in m/s2 and 1/m; `rate` the filtered derivatives, which are a speed in m/s and the slope toward the path.
    """

    integral: Array
    rate: Array

    @classmethod
    def fresh(cls, count: int) -> ControllerMemory:
        return cls(np.zeros((2, count)), np.zeros((2, count)))


def follow_vehicles(
    row: Array,
    state: VehicleState,
    memory: ControllerMemory,
    parameters: VehicleParameters,
    dt_s: float,
    gains: ControllerGains = GAINS,
) -> tuple[VehicleControls, ControllerMemory]:
    """Controls of vehicles that follow their references.

    Parameters
    ----------
    row : (C, A) float64
        The references now, as `VEHICLE_COLUMNS`.

    Notes
    -----
    Two PID controllers with feed-forward, along the path and across it, are the rows of (2, A) arrays: for a thousand
    agents a call of numpy costs as much as what it computes. The correction across the path is a curvature that depends on
    the way driven and not on time, hence nothing is divided by the speed.
    """
    p, reference_gear, stands = parameters, row[6], row[7]
    pace = np.abs(state.speed_mps)
    moves, square = pace > 0, pace * pace
    gear = np.sign(state.speed_mps + TINY * reference_gear)
    error, raw_rate = _errors(row, state)
    rate = memory.rate - math.expm1(-dt_s / gains.derivative_filter_s) * (raw_rate - memory.rate)
    damping = 2 * gains.damping * rate
    damping[1] *= gear  # in reverse, turning to the left leads to the right

    stiffness = rows(1 / gains.along_s, 1 / np.maximum(pace * gains.across_s, gains.across_min_m))
    pull = error * stiffness**2
    wanted = row[4:6] + pull + damping * stiffness + memory.integral
    # The smallest radius with grip grows with the square of the speed; at standstill only the lock limits.
    grip = np.minimum(gains.max_lateral_accel_mps2 / np.maximum(square, 1.0), p.max_curvature_1pm)
    asked = rows(wanted[0] * gear, wanted[1])
    given = np.minimum(np.maximum(asked, rows(-p.max_brake_mps2, -grip)), rows(p.max_throttle_mps2, grip))

    # Anti-windup: nothing is learned from more error of the same sign while an actuator is at its limit, from a vehicle
    # that is far behind and makes up for it, or from wheels that stand.
    learns = (given == asked) | (error * wanted <= 0)
    learns[0] &= np.abs(error[0]) < MAX_ALONG_M
    learns[1] &= moves
    bound = rows(INTEGRAL_LIMIT_MPS2, INTEGRAL_SHARE * grip)
    integral = memory.integral + (dt_s / gains.integral_s) * pull * learns
    integral = np.minimum(np.maximum(integral, -bound), bound)

    held = (stands > 0.5) & (pace < gains.hold_below_mps) & (error[0] * reference_gear < gains.hold_within_m)
    np.copyto(given[0], -gains.hold_brake_mps2, where=held)
    np.copyto(integral[0], 0.0, where=held)
    steer = np.arctan(p.wheelbase_m * given[1] * (1 + p.understeer_s2pm2 * square))
    controls = VehicleControls(given[0], steer, reference_gear < 0)
    return controls, ControllerMemory(integral, rate)


def _errors(row: Array, state: VehicleState) -> tuple[Array, Array]:
    """Errors along and across the path in m (2, A), and their derivatives: difference in speed, slope toward the path.

    They are those at the foot point: where the reference is `along` ahead, its arc is bent back by that much, so a vehicle
    that is late in a curve is not pulled inside.
    """
    x, y, yaw, speed, _, curvature, _, _ = row
    cos, sin = cos_sin(yaw)
    dx, dy = x - state.x_m, y - state.y_m
    along = cos * dx + sin * dy
    along = np.minimum(np.maximum(along, -MAX_ALONG_M), MAX_ALONG_M)
    turn = curvature * along
    across = cos * dy - sin * dx + turn * along / 2
    _, slope = cos_sin(yaw - turn - state.yaw_rad)
    return rows(along, across), rows(speed - state.speed_mps, slope)


def follow_points(row: Array, state: PointState, gains: ControllerGains = GAINS) -> PointControls:
    """Controls of points that follow their references `row` (C, A), as `POINT_COLUMNS`; they may go any way."""
    x, y, _, vx, vy, ax, ay, _ = row
    p, d = 1 / gains.point_s**2, 2 * gains.damping / gains.point_s
    return PointControls(
        ax + p * (x - state.x_m) + d * (vx - state.velocity_x_mps),
        ay + p * (y - state.y_m) + d * (vy - state.velocity_y_mps),
    )


def start_vehicles(row: Array, parameters: VehicleParameters) -> VehicleState:
    """States of vehicles that are on their references `row` (C, A)."""
    x, y, yaw, speed, accel, curvature, gear, stands = row
    angle = np.arctan(parameters.wheelbase_m * curvature * (1 + parameters.understeer_s2pm2 * speed**2))
    steer = np.minimum(np.maximum(angle, -parameters.max_steer_rad), parameters.max_steer_rad)
    pedal = np.minimum(np.maximum(accel * gear, -parameters.max_brake_mps2), parameters.max_throttle_mps2)
    speed, pedal = np.where(stands > 0.5, 0.0, [speed, pedal])
    still = np.zeros(len(x))
    return VehicleState(x.copy(), y.copy(), yaw.copy(), speed, steer, pedal, still, still)


def start_points(row: Array) -> PointState:
    """States of points that are on their references `row` (C, A)."""
    return PointState(row[0].copy(), row[1].copy(), row[3].copy(), row[4].copy())
