"""The published single-track model with linear tires, and the one whose tires saturate; and which vehicles need it.

Slip angles relax at a rate of about 200 / v per second, so equations with 1 / v are stiff at walking pace and singular
at standstill. Here they are multiplied by the speed, and each step solves for the slips at its end: at standstill the
equation of the slips becomes "no slip", which is the kinematic bicycle, and no threshold speed is needed.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Agent
from log2sim.geometry import Array, cos_sin
from log2sim.simulation.reference import GRID_S, REFERENCE_HOLD_MPS, VEHICLE_COLUMNS, Reference
from log2sim.simulation.vehicles.vehicle import (
    GRAVITY_MPS2,
    VehicleControls,
    VehicleParameters,
    VehicleState,
    actuate,
    actuation,
    advance_speed,
    clamp,
    engaged_gear,
    equal_steps,
    sinc,
)

MAX_INNER_STEP_S = 0.01  # longest step of the integrator; the error is of second order
# Of the singly diagonally implicit Runge-Kutta method of two stages, L-stable and of second order (Alexander, 1977).
GAMMA = 1 - math.sqrt(0.5)
STAGE_WEIGHT = (1 - GAMMA) / GAMMA

MAX_LOAD_TRANSFER_SHARE = 0.9  # largest share of an axle's load that acceleration and braking may transfer


def step_single_track(
    state: VehicleState, controls: VehicleControls, parameters: VehicleParameters, dt_s: float
) -> VehicleState:
    """Move vehicles by `dt_s` with constant commands by the published single-track model with linear tires.

    Equations: Althoff, Koschi & Manzinger, "CommonRoad: Vehicle Models", 2020, section "Single-Track Model", with the load
    transfer of braking and driving, small angles and no limit of friction. They have the speed of the center of gravity as
    `speed_mps`, and `lateral_mps` is speed times slip angle less what the yaw rate adds at the rear axle. They are published
    for forward motion; backward, each tire's force opposes its slip as well. Actuators as in `step_bicycle`.
    """
    p, chassis = parameters, Chassis.of(parameters)
    count, h = equal_steps(dt_s, MAX_INNER_STEP_S)
    actuators, target, lag_s, max_rate = actuation(state, controls, p)
    yaw, speed, steer = state.yaw_rad, state.speed_mps, state.steer_rad
    cos, sin = cos_sin(yaw)
    x, y = state.x_m + p.cg_to_rear_m * cos, state.y_m + p.cg_to_rear_m * sin
    still = speed == 0
    per_speed = np.where(still, 0.0, 1 / np.where(still, 1.0, speed))
    rear = state.lateral_mps * per_speed
    slips = Slips(rear, np.where(still, 0.0, rear + p.wheelbase_m * state.yaw_rate_radps * per_speed - steer))
    for _ in range(count):
        speed0, steer0 = speed, steer
        actuators, (mean_pedal, mean_steer) = actuate(actuators, target, lag_s, max_rate, h)
        steer = actuators[1]
        gear = engaged_gear(speed, controls.reverse)
        pace, distance = advance_speed(np.abs(speed), mean_pedal, h)
        speed = gear * pace
        motion = StepInput(speed0, speed, gear * distance, steer0, mean_steer, steer)
        before, slips = slips, linear_slips(slips, motion, p, chassis, h)
        chord, angle, turn = linear_displacement(before, slips, motion, p)
        cos, sin = cos_sin(yaw + angle)
        x, y, yaw = x + chord * cos, y + chord * sin, yaw + turn
    cos, sin = cos_sin(yaw)
    x, y = x - p.cg_to_rear_m * cos, y - p.cg_to_rear_m * sin
    yaw_rate = speed * (slips.front - slips.rear + steer) / p.wheelbase_m
    return VehicleState(x, y, yaw, speed, steer, actuators[0], speed * slips.rear, yaw_rate)


@dataclass(frozen=True, eq=False)
class Chassis:
    """Lateral acceleration of the axles per lateral force and mass: of the rear by the rear, of either by the other, of the front."""

    rear: Array  # all (A,)
    cross: Array
    front: Array
    cg_to_front_m: Array

    @classmethod
    def of(cls, p: VehicleParameters) -> Chassis:
        """Compute the coefficients from vehicle parameters."""
        to_rear, to_front = p.cg_to_rear_m, p.wheelbase_m - p.cg_to_rear_m
        rear, front = 1 + to_rear**2 / p.gyration_m2, 1 + to_front**2 / p.gyration_m2
        return cls(rear, 1 - to_front * to_rear / p.gyration_m2, front, to_front)


@dataclass(frozen=True, eq=False)
class StepInput:
    """Inputs of one step of the linear model, all (A,)."""

    speed0_mps: Array  # at the begin and the end
    speed1_mps: Array
    distance_m: Array
    steer0_rad: Array
    mean_steer_rad: Array
    steer1_rad: Array


class Slips(NamedTuple):
    """Slip angles of the axles in rad, or their velocities in m/s to the left of the heading beyond those of rolling."""

    rear: Array
    front: Array


def _solver(
    a: Array, b: Array, c: Array, d: Array, rear_unit: Array | float = 1.0, front_unit: Array | float = 1.0
) -> Callable[[Array, Array], Slips]:
    """Return what solves two linear equations, a and b above c and d, for slips in units of their own, which may be zero."""
    factor = 1 / (a * d - b * c)
    rear_factor, front_factor = rear_unit * factor, front_unit * factor
    return lambda rear, front: Slips(rear_factor * (d * rear - b * front), front_factor * (a * front - c * rear))


def linear_slips(slips: Slips, motion: StepInput, p: VehicleParameters, c: Chassis, h: float) -> Slips:
    """Return the slip angles (rad, positive to the left) after a step of the published model.

    Linear in the slips while speed and acceleration are the mean ones of the step, hence solved without iteration:
    |v| slips' = -(chassis) (stiffness) slips + (turn) (yaw rate / v) - |v| (0, steer').
    """
    m, wheelbase = motion, p.wheelbase_m
    speed, accel = (m.speed0_mps + m.speed1_mps) / 2, (m.speed1_mps - m.speed0_mps) / h
    pace, gear = np.abs(speed), np.copysign(1.0, speed)
    rear_grip, front_grip = axle_grips(accel, p, c)
    by_rear, by_front = rear_grip * p.rear_stiffness_1prad, front_grip * p.front_stiffness_1prad
    # The yaw rate is speed * (front - rear + steer) / wheelbase; it and its growth with the speed move both axles.
    rear_turn = (p.cg_to_rear_m * gear * accel - pace * speed) / wheelbase
    front_turn = -(c.cg_to_front_m * gear * accel + pace * speed) / wheelbase
    tau, turned = GAMMA * h, m.steer1_rad - m.steer0_rad
    solve = _solver(
        pace + tau * (c.rear * by_rear + rear_turn),
        tau * (c.cross * by_front - rear_turn),
        tau * (c.cross * by_rear + front_turn),
        pace + tau * (c.front * by_front - front_turn),
    )

    def stage(rear: Array, front: Array, steer: Array) -> Slips:
        push = tau * steer
        return solve(pace * rear + rear_turn * push, pace * (front - GAMMA * turned) + front_turn * push)

    rear, front = slips
    first = stage(rear, front, m.steer0_rad + GAMMA * turned)
    return stage(rear + STAGE_WEIGHT * (first.rear - rear), front + STAGE_WEIGHT * (first.front - front), m.steer1_rad)


def linear_displacement(
    slips0: Slips, slips1: Slips, motion: StepInput, p: VehicleParameters
) -> tuple[Array, Array, Array]:
    """Return the motion of the center of gravity in a step of the published model: chord, its angle to the old heading, turn."""
    (rear, front), (rear1, front1), share = slips0, slips1, p.cg_to_rear_m / p.wheelbase_m
    turn = motion.distance_m * ((front + front1 - rear - rear1) / 2 + motion.mean_steer_rad) / p.wheelbase_m
    before = rear + share * (front - rear + motion.steer0_rad)
    after = rear1 + share * (front1 - rear1 + motion.steer1_rad)
    half = (turn + after - before) / 2
    return motion.distance_m * sinc(half), before + half, turn


def axle_grips(accel: Array, p: VehicleParameters, c: Chassis) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the force per mass that rear and front axle can bear: friction times load, which `accel` transfers to the rear."""
    lever = p.cg_height_m / GRAVITY_MPS2
    shift = clamp(lever * accel, -MAX_LOAD_TRANSFER_SHARE * c.cg_to_front_m, MAX_LOAD_TRANSFER_SHARE * p.cg_to_rear_m)
    whole = p.friction * GRAVITY_MPS2 / p.wheelbase_m
    return whole * (c.cg_to_front_m + shift), whole * (p.cg_to_rear_m - shift)


# Share of the friction limit that drive and brakes may use: wheels that do not lock keep a third of it for steering.
ANTILOCK_SHARE = 0.95


def step_dynamic(
    state: VehicleState, controls: VehicleControls, parameters: VehicleParameters, dt_s: float
) -> VehicleState:
    """Move vehicles by `dt_s` with constant commands by a single-track model whose tires saturate.

    Angles are exact. Lateral force of an axle: the magic formula of Pacejka ("Tire and Vehicle Dynamics", 2012, chapter 4)
    with shape factor 1 and no curvature, D sin(arctan(C s)) = D C s / sqrt(1 + (C s)^2) with s the tangent of the slip
    angle: stiffness C at first, D at most. D is friction times load, less what drive and brakes take of it (friction
    ellipse). The pedal accelerates the rear axle: the drive compensates for the loss of rolling along a curve, so that without
    slip this is the kinematic bicycle, while without friction the momentum is conserved. This compensation is not part of the
    friction limit: at full lock, while the yaw rate changes, the sum of forces can exceed the limit by a seventh.
    """
    p, chassis = parameters, Chassis.of(parameters)
    count, h = equal_steps(dt_s, MAX_INNER_STEP_S)
    actuators, target, lag_s, max_rate = actuation(state, controls, p)
    body, bend, grip = state, np.tan(state.steer_rad), ANTILOCK_SHARE * GRAVITY_MPS2 * p.friction
    for _ in range(count):
        bend0 = bend
        actuators, (mean_pedal, mean_steer) = actuate(actuators, target, lag_s, max_rate, h)
        bend = np.tan(actuators[1])
        gear = engaged_gear(body.speed_mps, controls.reverse)
        drive = DriveInput(clamp(mean_pedal, -grip, grip), gear, bend0, np.tan(mean_steer), bend)
        body = step_body(body, drive, p, chassis, h)
    return replace(body, pedal_mps2=actuators[0], steer_rad=actuators[1])


@dataclass(frozen=True, eq=False)
class DriveInput:
    """Inputs of one step of the saturating model, all (A,)."""

    pedal_mps2: Array
    gear: Array
    bend0: Array  # tangent of the steering angle at the begin, on average and at the end
    mean_bend: Array
    bend1: Array


def step_body(body: VehicleState, drive: DriveInput, p: VehicleParameters, c: Chassis, h: float) -> VehicleState:
    """Compute one step of the saturating model.

    The unknowns are the lateral velocities at which the axles slip. Tires act by their secant stiffness, so a step of any
    length is dissipative; the stiffness is that at the middle of the step, from half a step of implicit Euler: second order.
    """
    d, speed, rear = drive, body.speed_mps, body.lateral_mps
    front = rear + p.wheelbase_m * body.yaw_rate_radps - speed * d.bend0
    start = Slips(rear, front)

    # To the middle of the step.
    speed1, _, accel = _longitudinal_step(speed, _slip_speed_gain(start, body.yaw_rate_radps, 0.0, d, p, h), d, h)
    mean_speed = (speed + speed1) / 2
    begin, end, swing = _rolling_slip_growth(speed, speed1, d, p, h)
    solve = _slip_equations(mean_speed, accel, start, d, p, c, h / 2)
    middle = solve(rear + (begin + end) / 4, front + (begin + end) / 4 + swing / 2)

    # To the end of the step. The slips depend on the speed and the speed on the slips: it is predicted and then corrected.
    rate = (mean_speed * d.mean_bend + middle.front - middle.rear) / p.wheelbase_m
    speed1, _, accel = _longitudinal_step(
        speed, _slip_speed_gain(middle, rate, 2 * (middle.rear - rear), d, p, h), d, h
    )
    begin, end, swing = _rolling_slip_growth(speed, speed1, d, p, h)
    solve = _slip_equations((speed + speed1) / 2, accel, middle, d, p, c, GAMMA * h)
    pull = GAMMA * (begin + GAMMA * (end - begin))
    first = solve(rear + pull, front + pull + GAMMA * swing)
    pull = GAMMA * end
    last = solve(
        rear + STAGE_WEIGHT * (first.rear - rear) + pull,
        front + STAGE_WEIGHT * (first.front - front) + pull + GAMMA * swing,
    )
    rate1 = (speed1 * d.bend1 + last.front - last.rear) / p.wheelbase_m
    speed1, distance, _ = _longitudinal_step(speed, _slip_speed_gain(middle, rate, last.rear - rear, d, p, h), d, h)

    # Along an arc.
    turn = (distance * d.mean_bend + h * (front + last.front - rear - last.rear) / 2) / p.wheelbase_m
    shrink = sinc(turn / 2)
    ahead, aside = distance * shrink, h * (rear + last.rear) / 2 * shrink
    cos, sin = cos_sin(body.yaw_rad + turn / 2)
    x, y = body.x_m + ahead * cos - aside * sin, body.y_m + ahead * sin + aside * cos
    moved = (x, y, body.yaw_rad + turn, speed1, body.steer_rad, body.pedal_mps2, last.rear, rate1)
    return VehicleState(*moved)


def _slip_speed_gain(
    slips: Slips, rate: Array, grown: Array | float, d: DriveInput, p: VehicleParameters, h: float
) -> NDArray[np.float64]:
    """Return the speed gained by slipping within a step in which the lateral velocity of the rear axle grows by `grown`."""
    slip_rate = (slips.front - slips.rear) / p.wheelbase_m
    return h * rate * (slips.rear + p.cg_to_rear_m * slip_rate) - p.cg_to_rear_m * d.mean_bend / p.wheelbase_m * grown


def _rolling_slip_growth(
    speed: Array, speed1: Array, d: DriveInput, p: VehicleParameters, h: float
) -> tuple[Array, Array, Array]:
    """Return the growth of slip in a step due to rolling: by the yaw rate at begin and end, and by its change."""
    rolling, rolling1 = speed * d.bend0, speed1 * d.bend1
    each = -h / p.wheelbase_m
    return each * speed * rolling, each * speed1 * rolling1, rolling - rolling1


def _longitudinal_step(speed: Array, gain: Array, d: DriveInput, h: float) -> tuple[Array, Array, Array]:
    """Return speed after a step, distance, and acceleration of the tires; `gain` is the speed gained by slipping.

    Throttle acts in the direction of the gear, brakes act against the motion and end at rest.
    """
    push = h * np.maximum(d.pedal_mps2, 0.0) * d.gear
    free = speed + gain + push
    sign = np.sign(free)
    pace, distance = advance_speed(np.abs(free), np.minimum(d.pedal_mps2, 0.0), h)
    return sign * pace, sign * distance - (gain + push) * (h / 2), (sign * pace - speed - gain) / h


def _slip_equations(
    speed: Array, accel: Array, slips: Slips, d: DriveInput, p: VehicleParameters, c: Chassis, tau: float
) -> Callable[[Array, Array], Slips]:
    """Build the equations of an implicit step `tau` for slip velocities (m/s), linearized about `slips`.

    Secant stiffness is a force over a scale that vanishes at standstill; with the scales as units, nothing is divided
    by them.
    """
    rear, front = slips.rear, slips.front
    use = accel / (GRAVITY_MPS2 * p.friction)
    rear_grip, front_grip = axle_grips(accel, p, c)
    ellipse = np.sqrt(np.maximum(1 - use * use, 0.0))
    cos2 = 1 / (1 + d.mean_bend**2)
    rear_scale = np.sqrt(speed**2 + (p.rear_stiffness_1prad * rear) ** 2)
    along, across = speed + front * d.mean_bend * cos2, p.front_stiffness_1prad * cos2 * front
    front_scale = np.sqrt(along**2 + across**2)
    by_rear = p.rear_stiffness_1prad * rear_grip * ellipse
    by_front = p.front_stiffness_1prad * front_grip * ellipse * cos2 * np.sqrt(cos2)
    rear_turn, front_turn = (speed / p.wheelbase_m * scale for scale in (rear_scale, front_scale))
    return _solver(
        rear_scale + tau * (c.rear * by_rear - rear_turn),
        tau * (c.cross * by_front + front_turn),
        tau * (c.cross * by_rear - rear_turn),
        front_scale + tau * (c.front * by_front + front_turn),
        rear_scale,
        front_scale,
    )


YAW, SPEED, ACCEL, CURVATURE = map(VEHICLE_COLUMNS.index, ("yaw", "speed", "accel_ahead", "curvature_ahead"))

AUTO = "auto"
TWO_WHEELERS = ("motorcycle", "cyclist", "bicycle")

# Slip angle of the rear tires up to which the kinematic model is adequate: 1.1 degrees, the error of headings in a
# scenario.  A car reaches it at 3.3 m/s2 of lateral acceleration, a third of its tires' limit. Polack et al. ("The
# kinematic bicycle model: a consistent model for planning feasible trajectories for autonomous vehicles?", 2017) use it
# up to half the limit.
SLIP_TOLERANCE_RAD = 0.02

# Beyond this speed in reverse the models with slip follow worse than the kinematic one: the steered axle trails.
FAST_REVERSE_MPS = 3.0

LOAD_ITERATIONS = 4  # passes until slips, the drag of slips and the load transfer agree
MAX_FRICTION_USE = 0.95  # share of the friction limit beyond which slips are not predicted: they grow without bound


class ModelChoice(NamedTuple):
    """The model of a vehicle, and the reason for it."""

    model: str
    reason: str


def choose_model(
    agent: Agent, reference: Reference, parameters: VehicleParameters, wanted: str, *, free: bool
) -> ModelChoice:
    """Choose the model of a vehicle (`parameters` of shape (1,)) by the user's wish; `free` ones leave their trajectory."""
    if wanted != AUTO:
        return ModelChoice(wanted, "asked for")
    if agent.category in TWO_WHEELERS:
        return ModelChoice("kinematic", "leans into its curves, which slip does not describe")
    if free:
        return ModelChoice("dynamic", "what a policy drives is not known beforehand")
    speed, curvature = reference.columns[:, SPEED], reference.columns[:, CURVATURE]
    if speed.min() < -FAST_REVERSE_MPS:
        return ModelChoice(
            "kinematic", f"reverses at up to {-speed.min():.1f} m/s, and slips are followed up to {FAST_REVERSE_MPS:g}"
        )
    aside_mps2 = speed**2 * curvature
    # In steady cornering both axles use the same share of their friction, whatever the place of the center of gravity.
    slip = np.abs(_slip_angle(aside_mps2 / (GRAVITY_MPS2 * parameters.friction), parameters.rear_stiffness_1prad))
    worst = int(np.argmax(slip))
    found = f"{slip[worst]:.3f} rad at {abs(aside_mps2[worst]):.1f} m/s2 sideways, {SLIP_TOLERANCE_RAD:g} are tolerated"
    return ModelChoice("dynamic" if slip[worst] > SLIP_TOLERANCE_RAD else "kinematic", f"rear tires slip up to {found}")


def understeer(p: VehicleParameters) -> Array:
    """Return the steering angle (A,) beyond that of rolling, per lateral acceleration and wheelbase in s2/m2, at small slip."""
    compliance = 1 / p.front_stiffness_1prad - 1 / p.rear_stiffness_1prad
    return compliance / (GRAVITY_MPS2 * p.friction * p.wheelbase_m)


def slipping_reference(reference: Reference, p: VehicleParameters, model: str, ahead_s: float) -> Reference:
    """Add slip to the reference of a vehicle (`p` of shape (1,)); its curvature column is that of `ahead_s` later.

    Inverse dynamics of the single-track model: the forces that move the vehicle along the trajectory, the slips of these
    forces, the heading that these slips add, and the steering angle; the latter as the curvature from which the controller
    computes that angle.
    """
    if len(reference.columns) < 3:
        return replace(reference, slips=True)
    later_nose, bend, drag = _inverse_dynamics(reference.columns, p, saturates=model != "single-track")
    t_s = np.arange(reference.first_row, reference.first_row + len(bend), dtype=np.float64) * GRID_S
    nose = np.interp(t_s, t_s + ahead_s, later_nose)

    def slipped(columns: Array, at_s: Array) -> Array:
        out = columns.copy()
        for column, more in ((YAW, nose), (CURVATURE, bend), (ACCEL, drag)):
            out[:, column] += np.interp(at_s, t_s, more)
        return out

    def exact(at_s: Array) -> Array:
        return slipped(reference.exact(at_s), at_s)

    return replace(reference, columns=slipped(reference.columns, t_s), exact=exact, slips=True)


def set_slip_states(state: VehicleState, reference: Callable[[float], Array], t_s: float) -> VehicleState:
    """Set the lateral velocity and the yaw rate to those of the reference's rows (C, A) at a time."""
    before, after = reference(t_s), reference(t_s + GRID_S)
    (dx, dy), turn = (after - before)[:2] / GRID_S, (after - before)[YAW]
    yaw = (before + after)[YAW] / 2
    return replace(state, lateral_mps=np.cos(yaw) * dy - np.sin(yaw) * dx, yaw_rate_radps=turn / GRID_S)


def _inverse_dynamics(columns: Array, p: VehicleParameters, *, saturates: bool) -> tuple[Array, Array, Array]:
    """Return what slip adds to heading, curvature and acceleration, (K,) each, for the rows of a table."""
    speed, curvature, to_rear, chassis = columns[:, SPEED], columns[:, CURVATURE], p.cg_to_rear_m, Chassis.of(p)
    twist = np.gradient(speed * curvature, GRID_S)
    aside = speed**2 * curvature + to_rear * twist  # acceleration of the center of gravity
    front_force = (p.gyration_m2 * twist + to_rear * aside) / p.wheelbase_m
    drag, bend = np.zeros_like(speed), p.wheelbase_m * curvature
    for _ in range(LOAD_ITERATIONS if saturates else 1):
        accel = columns[:, ACCEL] + drag
        rear_grip, front_grip = axle_grips(accel, p, chassis)
        share = np.clip(accel / (GRAVITY_MPS2 * p.friction), -MAX_FRICTION_USE, MAX_FRICTION_USE)
        ellipse, cos2 = (np.sqrt(1 - share**2), 1 / (1 + bend**2)) if saturates else (1.0, 1.0)
        front_use, rear_use = front_force / (front_grip * ellipse), (aside - front_force) / (rear_grip * ellipse)
        front = _slip_angle(front_use / np.sqrt(cos2), p.front_stiffness_1prad, saturates=saturates) / cos2
        rear = _slip_angle(rear_use, p.rear_stiffness_1prad, saturates=saturates)
        bend = p.wheelbase_m * curvature + front - rear
        if saturates:
            slip = rear + to_rear / p.wheelbase_m * (front - rear)  # of the center of gravity, beyond that of rolling
            drag = speed * np.abs(speed) * curvature * slip
    nose = np.sign(speed) * rear
    moving = np.abs(speed) > REFERENCE_HOLD_MPS
    swing = np.where(moving, np.gradient(nose, GRID_S) / np.where(moving, speed, 1.0), 0.0)
    return nose, (bend / p.wheelbase_m + swing) / (1 + understeer(p) * speed**2) - curvature, drag


def _slip_angle(use: Array, stiffness_1prad: Array, *, saturates: bool = True) -> Array:
    """Return the slip angle at a share of the friction limit, of tires that saturate or, as published, do not."""
    if not saturates:
        return use / stiffness_1prad
    use = np.clip(use, -MAX_FRICTION_USE, MAX_FRICTION_USE)
    return use / np.sqrt(1 - use**2) / stiffness_1prad
