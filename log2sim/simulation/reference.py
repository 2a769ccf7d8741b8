"""Reference tables, and the controllers that make agents follow them: feed-forward from the trajectory and PID feedback.

References are, for vehicles, the rear axle of their feasible trajectory; for points, the smoothed trajectory. Gains are time
constants and a damping ratio, so they hold for every control step: the errors along and across the path each behave like a
damped oscillator with the time constant below, at any speed of the vehicle.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Agent, Trajectory
from log2sim.datatypes.agent import hermite
from log2sim.datatypes.categories import MAX_ACCELERATION_MPS2, MAX_CURVATURE_1PM
from log2sim.geometry import Array, cos_sin
from log2sim.simulation.feasible_trajectory import (
    KNOT_S,
    LOCK_SHARE,
    FeasibilityLimits,
    FeasibleTrajectory,
    fit_trajectory,
)
from log2sim.simulation.vehicles import vehicle
from log2sim.simulation.vehicles.vehicle import PEDAL_LAG_S, STEER_LAG_S, parameters_for


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
    return vehicle.equal_steps(dt_s, MAX_CONTROL_STEP_S)[1]


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
    along = vehicle.clamp(cos * dx + sin * dy, -gains.max_along_m, gains.max_along_m)
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
    given = vehicle.clamp(asked, vehicle.rows(-p.max_brake_mps2, -grip), vehicle.rows(p.max_throttle_mps2, grip))

    # Anti-windup: the integral does not grow while an actuator is at its limit, while a vehicle far behind catches up, or
    # at standstill.
    integrates = (given == asked) | (error * wanted <= 0)
    integrates[0] &= np.abs(error[0]) < gains.max_along_m
    integrates[1] &= moves
    bound = vehicle.rows(gains.integral_limit_mps2, gains.integral_share * grip)
    integral = vehicle.clamp(memory.integral + (dt_s / gains.integral_s) * pull * integrates, -bound, bound)

    held = (stands > 0.5) & (pace < gains.hold_below_mps) & (error[0] * reference_gear < gains.hold_within_m)
    np.copyto(given[0], -gains.hold_brake_mps2, where=held)
    np.copyto(integral[0], 0.0, where=held)
    steer = np.arctan(p.wheelbase_m * given[1] * (1 + p.understeer_s2pm2 * square))
    controls = vehicle.VehicleControls(given[0], steer, reference_gear < 0)
    return controls, ControllerMemory(integral, rate)


def follow_points(row: Array, state: vehicle.PointState) -> vehicle.PointControls:
    """Compute the controls of points that follow their references `row` (C, A), as `POINT_COLUMNS`, in any direction."""
    x, y, _, vx, vy, ax, ay, _ = row
    p, d = 1 / GAINS.point_s**2, 2 * GAINS.damping / GAINS.point_s
    return vehicle.PointControls(
        ax + p * (x - state.x_m) + d * (vx - state.velocity_x_mps),
        ay + p * (y - state.y_m) + d * (vy - state.velocity_y_mps),
    )


def start_vehicles(row: Array, parameters: vehicle.VehicleParameters) -> vehicle.VehicleState:
    """Return states of vehicles on their references `row` (C, A)."""
    x, y, yaw, speed, accel, curvature, gear, stands = row
    angle = np.arctan(parameters.wheelbase_m * curvature * (1 + parameters.understeer_s2pm2 * speed**2))
    steer = vehicle.clamp(angle, -parameters.max_steer_rad, parameters.max_steer_rad)
    pedal = vehicle.clamp(accel * gear, -parameters.max_brake_mps2, parameters.max_throttle_mps2)
    speed, pedal = np.where(stands > 0.5, 0.0, [speed, pedal])
    still = np.zeros(len(x))
    return vehicle.VehicleState(x.copy(), y.copy(), yaw.copy(), speed, steer, pedal, still, still)


GRID_S = 0.02  # spacing of the tables; linear interpolation errs by at most a h^2 / 8 = 0.5 mm at 10 m/s2
SMOOTHING_S = 0.12  # standard deviation of the Gaussian over the velocity of points: one waypoint at 10 Hz
# The brake holds while the reference is slower: below `STANDSTILL_MPS`, so that a start is not delayed.
REFERENCE_HOLD_MPS = 0.08

MIN_RUN_M, MIN_RUN_MPS = 0.3, 0.5  # a movement that is both shorter and slower is noise of a standing agent
MAX_TWO_WHEELER_CURVATURE_1PM = 1.0  # not in Waymax; a bicycle turns within a meter
MAX_DEPARTURE_M = 0.3  # larger than the errors of boxes


@dataclass(frozen=True, eq=False)
class Reference:
    """An agent's reference table: row k of `columns` holds for the time (first_row + k) * GRID_S."""

    trajectory: Trajectory  # the box centers in the scenario
    first_row: int
    columns: Array  # (K, C) `VEHICLE_COLUMNS`, `POINT_COLUMNS`, or x, y, yaw, speed
    exact: Callable[[Array], Array]  # rows (N, C) at any times (N,), without blending across rows
    offset_m: float = 0.0  # from the reference point forward to the box center
    flags: tuple[str, ...] = ()  # what in the scenario cannot be driven
    slips: bool = False  # whether the reference holds slip angles, so that it does not move along its yaw


VEHICLE_COLUMNS = ("x", "y", "yaw", "speed", "accel_ahead", "curvature_ahead", "gear_ahead", "stands_ahead")
POINT_COLUMNS = ("x", "y", "yaw", "velocity_x", "velocity_y", "accel_x", "accel_y", "stands")


def vehicle_reference(
    trajectory: Trajectory,
    limits: FeasibilityLimits,
    *,
    accel_ahead_s: float,
    curvature_ahead_s: float,
    max_curvature_1pm: float = MAX_CURVATURE_1PM,
) -> Reference:
    """Build the table of a vehicle. Columns "..._ahead" are of a later time, to compensate for the lag of the actuators."""
    course, departure_m = feasible_trajectory_of(trajectory, limits)
    first, t = _grid_times(trajectory)
    motion = _interpolated(course, t)
    # For every row the gear, +1 or -1, of the present or next movement, and whether the agent stands.
    speed = motion[3]
    direction = np.where(np.abs(speed) < REFERENCE_HOLD_MPS, 0, np.sign(speed)).astype(int)
    runs: list[NDArray[np.intp]] = np.split(np.arange(len(speed)), np.flatnonzero(np.diff(direction)) + 1)
    gear, stands, begin = np.ones(len(speed)), np.ones(len(speed)), 0
    for run in runs:
        distance_m, peak_mps = np.abs(speed[run]).sum() * GRID_S, np.abs(speed[run]).max()
        if direction[run[0]] != 0 and (distance_m >= MIN_RUN_M or peak_mps >= MIN_RUN_MPS):
            gear[begin:] = direction[run[0]]
            stands[run] = 0.0
            begin = run[-1] + 1

    def rows_at(at_s: Array, motion: Array) -> Array:
        rows = np.empty((len(VEHICLE_COLUMNS), len(at_s)))
        rows[:4] = motion
        rows[4] = np.interp(at_s + accel_ahead_s, course.t_s, course.accel_mps2)
        rows[5] = np.interp(at_s + curvature_ahead_s, course.t_s, course.curvature_1pm)
        k = np.minimum(np.searchsorted(t, at_s + accel_ahead_s), len(t) - 1)
        rows[6], rows[7] = gear[k], stands[k]
        return rows.T

    def exact(at_s: Array) -> Array:
        return rows_at(at_s, _interpolated(course, at_s))

    flags = _discontinuity_flags(trajectory)
    for name, values, limit, unit in (
        ("acceleration", course.accel_mps2, MAX_ACCELERATION_MPS2, "m/s2"),
        ("curvature", course.curvature_1pm, max_curvature_1pm, "1/m"),
        ("distance from what can be driven", departure_m, MAX_DEPARTURE_M, "m"),
    ):
        worst = int(np.argmax(np.abs(values)))
        if abs(values[worst]) > limit:
            flags += (f"{name} of {values[worst]:.2f} {unit} at {course.t_s[worst]:.2f} s, limit {limit:g}",)
    return Reference(trajectory, first, rows_at(t, motion), exact, limits.offset_m, flags)


def feasible_trajectory_of(trajectory: Trajectory, limits: FeasibilityLimits) -> tuple[FeasibleTrajectory, Array]:
    """Return the feasible trajectory of the rear axle, and its distance in m (K,) from the box centers in the scenario.

    Pieces between discontinuities of the scenario are fitted one by one.
    """
    edges = np.concatenate([[0], np.flatnonzero(trajectory.discontinuous) + 1, [len(trajectory.t_s)]])
    pieces, departures = [], []
    for begin, end in pairwise(edges.tolist()):
        # A piece before a discontinuity goes on as it was, and ends just before the time of the next waypoint.
        begin_s, until_s = trajectory.t_s[begin], trajectory.t_s[end - 1]
        if end < len(trajectory.t_s):
            until_s = np.nextafter(trajectory.t_s[end], begin_s)
        count = max(int(np.ceil((until_s - begin_s) / KNOT_S - 1e-6)), 1) + 1 if until_s > begin_s else 1
        t = np.linspace(begin_s, until_s, count)
        x, y, yaw, speed = trajectory.relative(t)
        course = fit_trajectory(t, x, y, yaw, speed, limits)
        pieces.append(course)
        o = limits.offset_m
        center_x, center_y = course.x_m + o * np.cos(course.yaw_rad), course.y_m + o * np.sin(course.yaw_rad)
        departures.append(np.hypot(center_x - x, center_y - y))
    columns = (np.concatenate([getattr(p, f.name) for p in pieces]) for f in fields(FeasibleTrajectory))
    return FeasibleTrajectory(*columns), np.concatenate(departures)


def _interpolated(course: FeasibleTrajectory, t_s: Array) -> Array:
    """Interpolate x, y, yaw, speed (4, N) at times (N,) by cubics; straight on before the begin and after the end."""
    inside = np.minimum(np.maximum(t_s, course.t_s[0]), course.t_s[-1])
    values, rates = course.motion
    if len(course.t_s) == 1:
        motion = np.repeat(values, len(t_s), axis=1)
    else:
        i = np.minimum(np.searchsorted(course.t_s, inside, side="right") - 1, len(course.t_s) - 2)
        motion = hermite(values, rates, i, inside - course.t_s[i], course.t_s[i + 1] - course.t_s[i])
    beyond_m = (t_s - inside) * motion[3]
    motion[0] += beyond_m * np.cos(motion[2])
    motion[1] += beyond_m * np.sin(motion[2])
    return motion


def point_reference(trajectory: Trajectory) -> Reference:
    """Build the table of a point mass: velocity and acceleration of the smoothed trajectory, on map axes."""
    first, t = _grid_times(trajectory)
    x, y, yaw, logged_speed = _extrapolated(trajectory, t)
    vx, vy, ax, ay = logged_speed * np.cos(yaw), logged_speed * np.sin(yaw), np.zeros(len(t)), np.zeros(len(t))
    for piece in np.split(np.arange(len(t)), np.searchsorted(t, trajectory.discontinuity_times())):
        if len(piece) > 1:
            vx[piece], vy[piece] = (_smooth(np.gradient(c[piece], GRID_S)) for c in (x, y))
            ax[piece], ay[piece] = np.gradient(vx[piece], GRID_S), np.gradient(vy[piece], GRID_S)
    stands = (np.hypot(vx, vy) < REFERENCE_HOLD_MPS).astype(np.float64)

    def exact(at_s: Array) -> Array:
        smoothed = (np.interp(at_s, t, c) for c in (vx, vy, ax, ay, stands))
        return np.stack([*_extrapolated(trajectory, at_s)[:3], *smoothed], axis=1)

    return Reference(trajectory, first, exact(t), exact, flags=_discontinuity_flags(trajectory))


def log_reference(trajectory: Trajectory) -> Reference:
    """Build the table of an agent that is placed on its trajectory in the scenario: x, y, yaw, speed."""
    first, t = _grid_times(trajectory)

    def exact(at_s: Array) -> Array:
        return np.stack(_extrapolated(trajectory, at_s), axis=1)

    return Reference(trajectory, first, exact(t), exact)


def _extrapolated(trajectory: Trajectory, t_s: Array) -> tuple[Array, Array, Array, Array]:
    """Evaluate a trajectory at times (N,), straight on before its begin and after its end, for the rows just outside."""
    x, y, yaw, speed = trajectory.relative(t_s)
    before, after = np.minimum(t_s - trajectory.t_s[0], 0.0), np.maximum(t_s - trajectory.t_s[-1], 0.0)
    x = x + before * trajectory.velocity_x_mps[0] + after * trajectory.velocity_x_mps[-1]
    y = y + before * trajectory.velocity_y_mps[0] + after * trajectory.velocity_y_mps[-1]
    return x, y, yaw, speed


def _grid_times(trajectory: Trajectory) -> tuple[int, Array]:
    """Return the first row and the times of all rows that cover the lifetime of a trajectory."""
    first = int(np.floor(trajectory.t_s[0] / GRID_S))
    last = int(np.ceil(trajectory.t_s[-1] / GRID_S))
    return first, np.arange(first, last + 1, dtype=np.float64) * GRID_S


def _smooth(values: Array) -> Array:
    """Apply Gaussian smoothing; the ends are mirrored in a point, so that a straight line is unchanged."""
    if len(values) < 3:
        return values
    reach = min(int(np.ceil(3 * SMOOTHING_S / GRID_S)), len(values) - 1)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) * GRID_S / SMOOTHING_S) ** 2)
    padded = np.pad(values, reach, mode="reflect", reflect_type="odd")
    return np.convolve(padded, kernel / kernel.sum(), mode="valid")


def _discontinuity_flags(trajectory: Trajectory) -> tuple[str, ...]:
    return tuple(f"the scenario is discontinuous at {at:.2f} s" for at in trajectory.discontinuity_times())


def vehicle_limits(agent: Agent) -> FeasibilityLimits:
    """Return the limits of a wheeled agent, from its category and length."""
    p = parameters_for([agent])
    wheelbase_m = float(p.wheelbase_m[0])
    return FeasibilityLimits(
        offset_m=float(p.rear_axle_offset_m[0]),
        max_curvature_1pm=LOCK_SHARE * math.tan(p.max_steer_rad[0]) / wheelbase_m,
        max_curvature_rate_1pmps=float(p.max_steer_rate_radps[0]) / wheelbase_m,
        max_accel_mps2=float(p.max_brake_mps2[0]),
    )


def vehicle_reference_of(agent: Agent, dt_s: float) -> Reference:
    """Build a vehicle's table; feed-forward is ahead by the lag of the actuator and half a control step."""
    limits, half_s = vehicle_limits(agent), control_step(dt_s) / 2
    bends = MAX_CURVATURE_1PM if agent.category in ("car", "truck", "bus") else MAX_TWO_WHEELER_CURVATURE_1PM
    return vehicle_reference(
        Trajectory.through(agent.waypoints, limits.offset_m), limits, accel_ahead_s=PEDAL_LAG_S + half_s,
        curvature_ahead_s=STEER_LAG_S + half_s, max_curvature_1pm=bends,
    )  # fmt: skip
