"""Controllers that make agents follow their references: feed-forward from the trajectory and PID feedback.

Gains are time constants and a damping ratio, so they hold for every control step: the errors along and across the path
each behave like a damped oscillator with the time constant below, at any speed of the vehicle.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from log2sim.geometry import Array, cos_sin
from log2sim.simulation.vehicles import vehicle


@dataclass(frozen=True)
class ControllerGains:
    """Gains of the controllers. The defaults are stable with actuator lags of 0.1 s and steps of up to 0.1 s."""

    along_s: float = 0.6  # time constants of the errors along and across the path
    across_s: float = 0.6
    across_min_m: float = 1.5  # at walking pace errors decay over this distance, since a car cannot move sideways
    integral_s: float = 4.0
    derivative_filter_s: float = 0.05
    damping: float = 1.0
    point_s: float = 0.3  # time constant of point masses
    # The brake holds a vehicle below this speed that has stopped within this distance; one that stopped earlier drives up.
    hold_below_mps: float = 0.05
    hold_brake_mps2: float = 2.0
    hold_within_m: float = 0.1
    max_lateral_accel_mps2: float = 9.0  # grip of a dry road
    integral_limit_mps2: float = 1.0
    integral_share: float = 0.2  # limit of the lateral integral, of the curvature that steering and grip allow
    max_along_m: float = 3.0  # longest extrapolation along the arc at the reference; limits catching up to 2.5 m/s


GAINS = ControllerGains()
# Longest time for which controls are held: a third of the shortest time in which an error decays.
MAX_CONTROL_STEP_S = 0.1


def control_step(dt_s: float) -> float:
    """Return the part of a simulation step for which controls are held."""
    return dt_s / max(1, math.ceil(dt_s / MAX_CONTROL_STEP_S - 1e-9))


@dataclass(frozen=True, eq=False)
class ControllerMemory(vehicle.Columns):
    """State of the controllers of vehicles, rows along and across the path, (2, A) each."""

    integral: Array  # (2, A) in m/s2 and 1/m
    rate: Array  # (2, A) filtered derivatives of the errors: a speed in m/s, and the slope toward the path

    @classmethod
    def fresh(cls, count: int) -> ControllerMemory:
        """Return the state of `count` controllers that have not run yet."""
        return cls(np.zeros((2, count)), np.zeros((2, count)))


def follow_vehicles(
    row: Array,
    state: vehicle.VehicleState,
    memory: ControllerMemory,
    parameters: vehicle.VehicleParameters,
    dt_s: float,
) -> tuple[vehicle.VehicleControls, ControllerMemory]:
    """Compute the controls of vehicles that follow their references.

    `row` (C, A): the references now, as `VEHICLE_COLUMNS`.

    Two PID controllers with feed-forward, along and across the path, are the rows of (2, A) arrays: with up to a thousand
    agents the overhead of a NumPy call is as large as the computation. The correction across the path is a curvature that
    depends on distance and not on time, so nothing is divided by the speed.
    """
    p, gains, reference_gear, stands = parameters, GAINS, row[6], row[7]
    pace = np.abs(state.speed_mps)
    moves, square = pace > 0, pace * pace
    gear = np.sign(state.speed_mps + vehicle.TINY * reference_gear)
    # Errors along and across the path in m (2, A), and their derivatives: speed difference, slope toward the path.
    x, y, yaw, speed, _, curvature, _, _ = row
    cos, sin = cos_sin(yaw)
    dx, dy = x - state.x_m, y - state.y_m
    along = cos * dx + sin * dy
    along = np.minimum(np.maximum(along, -gains.max_along_m), gains.max_along_m)
    turn = curvature * along
    across = cos * dy - sin * dx + turn * along / 2
    _, slope = cos_sin(yaw - turn - state.yaw_rad)
    error, raw_rate = vehicle.rows(along, across), vehicle.rows(speed - state.speed_mps, slope)
    rate = memory.rate - math.expm1(-dt_s / gains.derivative_filter_s) * (raw_rate - memory.rate)
    damping = 2 * gains.damping * rate
    damping[1] *= gear  # in reverse, turning to the left leads to the right

    stiffness = vehicle.rows(1 / gains.along_s, 1 / np.maximum(pace * gains.across_s, gains.across_min_m))
    pull = error * stiffness**2
    wanted = row[4:6] + pull + damping * stiffness + memory.integral
    # The smallest radius with grip grows with the square of the speed; at standstill only the lock limits.
    grip = np.minimum(gains.max_lateral_accel_mps2 / np.maximum(square, 1.0), p.max_curvature_1pm)
    asked = vehicle.rows(wanted[0] * gear, wanted[1])
    given = np.minimum(
        np.maximum(asked, vehicle.rows(-p.max_brake_mps2, -grip)), vehicle.rows(p.max_throttle_mps2, grip)
    )

    # Anti-windup: the integral does not grow while an actuator is at its limit, while a vehicle far behind catches up, or
    # at standstill.
    integrates = (given == asked) | (error * wanted <= 0)
    integrates[0] &= np.abs(error[0]) < gains.max_along_m
    integrates[1] &= moves
    bound = vehicle.rows(gains.integral_limit_mps2, gains.integral_share * grip)
    integral = memory.integral + (dt_s / gains.integral_s) * pull * integrates
    integral = np.minimum(np.maximum(integral, -bound), bound)

    held = (stands > 0.5) & (pace < gains.hold_below_mps) & (error[0] * reference_gear < gains.hold_within_m)
    np.copyto(given[0], -gains.hold_brake_mps2, where=held)
    np.copyto(integral[0], 0.0, where=held)
    steer = np.arctan(p.wheelbase_m * given[1] * (1 + p.understeer_s2pm2 * square))
    controls = vehicle.VehicleControls(given[0], steer, reference_gear < 0)
    return controls, ControllerMemory(integral, rate)


def follow_points(row: Array, state: vehicle.PointState, gains: ControllerGains = GAINS) -> vehicle.PointControls:
    """Compute the controls of points that follow their references `row` (C, A), as `POINT_COLUMNS`, in any direction."""
    x, y, _, vx, vy, ax, ay, _ = row
    p, d = 1 / gains.point_s**2, 2 * gains.damping / gains.point_s
    return vehicle.PointControls(
        ax + p * (x - state.x_m) + d * (vx - state.velocity_x_mps),
        ay + p * (y - state.y_m) + d * (vy - state.velocity_y_mps),
    )


def start_vehicles(row: Array, parameters: vehicle.VehicleParameters) -> vehicle.VehicleState:
    """Return states of vehicles on their references `row` (C, A)."""
    x, y, yaw, speed, accel, curvature, gear, stands = row
    angle = np.arctan(parameters.wheelbase_m * curvature * (1 + parameters.understeer_s2pm2 * speed**2))
    steer = np.minimum(np.maximum(angle, -parameters.max_steer_rad), parameters.max_steer_rad)
    pedal = np.minimum(np.maximum(accel * gear, -parameters.max_brake_mps2), parameters.max_throttle_mps2)
    speed, pedal = np.where(stands > 0.5, 0.0, [speed, pedal])
    still = np.zeros(len(x))
    return vehicle.VehicleState(x.copy(), y.copy(), yaw.copy(), speed, steer, pedal, still, still)
