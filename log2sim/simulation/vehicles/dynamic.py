"""The single-track model whose tires saturate: it understeers, slides and spins. Steps over all agents.

As in `single_track`, each step solves for the slips at its end, in a form that stays regular at standstill.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array, cos_sin
from log2sim.simulation.vehicles.single_track import (
    GAMMA,
    STAGE_WEIGHT,
    Chassis,
    LinearPair,
    Slips,
    axle_grips,
    inner_steps,
)
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
    sinc,
)

ANTILOCK_SHARE = 0.95
"""Share of the friction limit that drive and brakes may use: wheels that do not lock keep a third of it for steering."""


def step_dynamic(
    state: VehicleState, controls: VehicleControls, parameters: VehicleParameters, dt_s: float
) -> VehicleState:
    """Move vehicles by `dt_s` with constant commands by a single-track model whose tires saturate.

    Notes
    -----
    Angles are exact. Lateral force of an axle: the magic formula of Pacejka ("Tire and Vehicle Dynamics", 2012, chapter 4)
    with shape factor 1 and no curvature, D sin(arctan(C s)) = D C s / sqrt(1 + (C s)^2) with s the tangent of the slip
    angle: stiffness C at first, D at most. D is friction times load, less what drive and brakes take of it (friction
    ellipse). The pedal accelerates the rear axle: the drive compensates for the loss of rolling along a curve, so that without
    slip this is the kinematic bicycle, while without friction the momentum is conserved. This compensation is not part of the
    friction limit: at full lock, while the yaw rate changes, the sum of forces can exceed the limit by a seventh.
    """
    p, chassis = parameters, Chassis.of(parameters)
    count, h = inner_steps(dt_s)
    actuators, target, lag_s, max_rate = actuation(state, controls, p)
    grip = ANTILOCK_SHARE * GRAVITY_MPS2 * p.friction
    body = BodyState(state.x_m, state.y_m, state.yaw_rad, state.speed_mps, state.lateral_mps, state.yaw_rate_radps)
    bend = np.tan(state.steer_rad)
    for _ in range(count):
        bend0 = bend
        actuators, (mean_pedal, mean_steer) = actuate(actuators, target, lag_s, max_rate, h)
        bend = np.tan(actuators[1])
        gear = engaged_gear(body.speed_mps, controls.reverse)
        drive = DriveInput(clamp(mean_pedal, -grip, grip), gear, bend0, np.tan(mean_steer), bend)
        body = step_body(body, drive, p, chassis, h)
    b, (pedal, steer) = body, actuators
    return VehicleState(b.x_m, b.y_m, b.yaw_rad, b.speed_mps, steer, pedal, b.lateral_mps, b.yaw_rate_radps)


@dataclass(frozen=True, eq=False)
class DriveInput:
    """Inputs of one step of the saturating model.

    Attributes
    ----------
    pedal_mps2, gear : (A,) float64
    bend0, mean_bend, bend1 : (A,) float64
        Tangent of the steering angle at the begin, on average and at the end.
    """

    pedal_mps2: Array
    gear: Array
    bend0: Array
    mean_bend: Array
    bend1: Array


@dataclass(frozen=True, eq=False)
class BodyState:
    """State of the rear axle.

    Attributes
    ----------
    x_m, y_m, yaw_rad : (A,) float64
    speed_mps : (A,) float64
        Along the heading.
    lateral_mps : (A,) float64
        To the left of the heading.
    yaw_rate_radps : (A,) float64
    """

    x_m: Array
    y_m: Array
    yaw_rad: Array
    speed_mps: Array
    lateral_mps: Array
    yaw_rate_radps: Array


def step_body(body: BodyState, drive: DriveInput, p: VehicleParameters, c: Chassis, h: float) -> BodyState:
    """Compute one step of the saturating model.

    Notes
    -----
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
    system = _slip_equations(mean_speed, accel, start, d, p, c, h / 2)
    middle = system.solve(rear + (begin + end) / 4, front + (begin + end) / 4 + swing / 2)

    # To the end of the step. The slips depend on the speed and the speed on the slips: it is predicted and then corrected.
    rate = (mean_speed * d.mean_bend + middle.front - middle.rear) / p.wheelbase_m
    speed1, _, accel = _longitudinal_step(
        speed, _slip_speed_gain(middle, rate, 2 * (middle.rear - rear), d, p, h), d, h
    )
    begin, end, swing = _rolling_slip_growth(speed, speed1, d, p, h)
    system = _slip_equations((speed + speed1) / 2, accel, middle, d, p, c, GAMMA * h)
    pull = GAMMA * (begin + GAMMA * (end - begin))
    first = system.solve(rear + pull, front + pull + GAMMA * swing)
    pull = GAMMA * end
    last = system.solve(
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
    return BodyState(x, y, body.yaw_rad + turn, speed1, last.rear, rate1)


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
) -> LinearPair:
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
    return LinearPair.of(
        rear_scale + tau * (c.rear * by_rear - rear_turn),
        tau * (c.cross * by_front + front_turn),
        tau * (c.cross * by_rear - rear_turn),
        front_scale + tau * (c.front * by_front + front_turn),
        Slips(rear_scale, front_scale),
    )
