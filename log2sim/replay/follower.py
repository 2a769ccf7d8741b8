"""Controllers that make agents follow their reference: feed-forward from the waypoints and PID feedback.

Gains are time constants and a damping ratio, so they hold for every control step: the error along the path and the error
across it each behave like a damped oscillator with the time constant below, whatever the speed of the vehicle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from log2sim.geometry import Array
from log2sim.replay.vehicle import (
    GRAVITY_MPS2,
    Columns,
    PointControls,
    PointState,
    VehicleControls,
    VehicleParameters,
    VehicleState,
)


@dataclass(frozen=True)
class Gains:
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


GAINS = Gains()
INTEGRAL_LIMIT_MPS2 = 1.0
CORRECTED_ALONG_M = 2.0  # how far the arc at the reference is trusted beside it


@dataclass(frozen=True, eq=False)
class Memory(Columns):
    """What the controllers of vehicles remember: integrals and the filtered derivatives of the errors, all (A,)."""

    along_integral_mps2: Array
    across_integral_1pm: Array
    along_rate_mps: Array
    across_slope: Array

    @classmethod
    def fresh(cls, count: int) -> Memory:
        return cls(*(np.zeros(count) for _ in range(4)))


def follow_vehicles(
    row: Array, state: VehicleState, memory: Memory, parameters: VehicleParameters, dt_s: float, gains: Gains = GAINS
) -> tuple[VehicleControls, Memory]:
    """Controls of vehicles that follow their references.

    Parameters
    ----------
    row : (C, A) float64
        The references now, as `VEHICLE_COLUMNS`.

    Notes
    -----
    Works on errors at the foot point: where the reference is `along` ahead, its arc is bent back by that much, so a vehicle
    that is late in a curve is not pulled inside. The correction across the path is a curvature that depends on the way
    driven and not on time, hence nothing is divided by the speed.
    """
    x, y, yaw, speed, accel, curvature, reference_gear, stands = row
    cos, sin = np.cos(yaw), np.sin(yaw)
    dx, dy = x - state.x_m, y - state.y_m
    along = cos * dx + sin * dy
    back = np.minimum(np.maximum(along, -CORRECTED_ALONG_M), CORRECTED_ALONG_M)
    across = cos * dy - sin * dx + curvature * back**2 / 2
    slope = np.sin(yaw - curvature * back - state.yaw_rad)
    blend = -np.expm1(-dt_s / gains.derivative_filter_s)
    along_rate = memory.along_rate_mps + blend * (speed - state.speed_mps - memory.along_rate_mps)
    across_slope = memory.across_slope + blend * (slope - memory.across_slope)
    gear = np.where(state.speed_mps == 0, reference_gear, np.sign(state.speed_mps))
    held = (
        (stands > 0.5)
        & (np.abs(state.speed_mps) < gains.hold_below_mps)
        & (along * reference_gear < gains.hold_within_m)
    )

    pedal, along_integral = _pedal(
        along, along_rate, accel, gear, held, memory.along_integral_mps2, parameters, dt_s, gains
    )
    steer, across_integral = _steer(
        across, gear * across_slope, curvature, state, memory.across_integral_1pm, parameters, dt_s, gains
    )
    controls = VehicleControls(pedal, steer, reference_gear < 0)
    return controls, Memory(along_integral, across_integral, along_rate, across_slope)


def _pedal(
    along: Array,
    rate: Array,
    accel: Array,
    gear: Array,
    held: Array,
    integral: Array,
    p: VehicleParameters,
    dt_s: float,
    gains: Gains,
) -> tuple[Array, Array]:
    """Pedal (A,) and the integral: PID on the error along the path; the brake is held while the reference stands."""
    wanted = accel + along / gains.along_s**2 + 2 * gains.damping * rate / gains.along_s + integral
    pedal = wanted * gear
    limited = np.minimum(np.maximum(pedal, -p.max_brake_mps2), p.max_throttle_mps2)
    # Anti-windup: an actuator at its limit learns nothing from more error of the same sign.
    windup = (pedal != limited) & (along * wanted > 0)
    grown = integral + np.where(windup, 0.0, along) * (dt_s / (gains.along_s**2 * gains.integral_s))
    grown = np.minimum(np.maximum(grown, -INTEGRAL_LIMIT_MPS2), INTEGRAL_LIMIT_MPS2)
    return np.where(held, -gains.hold_brake_mps2, limited), np.where(held, 0.0, grown)


def _steer(
    across: Array,
    slope: Array,
    curvature: Array,
    state: VehicleState,
    integral: Array,
    p: VehicleParameters,
    dt_s: float,
    gains: Gains,
) -> tuple[Array, Array]:
    """Steering angle (A,) and the integral: PID on the error across the path, as a curvature, within lock and grip."""
    pace = np.abs(state.speed_mps)
    length = np.maximum(pace * gains.across_s, gains.across_min_m)
    wanted = curvature + across / length**2 + 2 * gains.damping * slope / length + integral
    limit = np.tan(p.max_steer_rad) / p.wheelbase_m
    # The smallest radius with grip grows with the square of the speed; at standstill only the lock limits.
    grip = gains.max_lateral_accel_mps2 / np.maximum(pace**2, gains.max_lateral_accel_mps2 / limit)
    limited = np.minimum(np.maximum(wanted, -grip), grip)
    windup = (wanted != limited) & (across * wanted > 0)
    grown = integral + np.where(windup | (pace == 0), 0.0, across) * (dt_s / (length**2 * gains.integral_s))
    bound = 0.2 * grip
    steer = np.arctan(p.wheelbase_m * limited * (1 + p.understeer_s2pm2 * pace**2))
    return steer, np.minimum(np.maximum(grown, -bound), bound)


def follow_points(row: Array, state: PointState, gains: Gains = GAINS) -> PointControls:
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
    speed = np.where(stands > 0.5, 0.0, speed)
    rate = speed * curvature
    lateral = -rate * speed * np.abs(speed) / (GRAVITY_MPS2 * parameters.friction * parameters.rear_stiffness_1prad)
    return VehicleState(x.copy(), y.copy(), yaw.copy(), speed, steer, pedal, lateral, rate)


def start_points(row: Array) -> PointState:
    """States of points that are on their references `row` (C, A)."""
    return PointState(row[0].copy(), row[1].copy(), row[3].copy(), row[4].copy())
