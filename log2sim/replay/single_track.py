"""Single-track models whose tires slip: the published linear one, and one whose tires saturate. Steps over all agents.

Both are integrated in a form without 1 / v. Slip angles relax at a rate of about 200 / v per second, so the equations are
multiplied by the speed and each step solves for the slips at its end: at standstill the equation for the slips turns into
"no slip" by itself, which is the kinematic bicycle, and no threshold speed is needed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from log2sim.geometry import Array
from log2sim.replay.vehicle import (
    GRAVITY_MPS2,
    VehicleControls,
    VehicleParameters,
    VehicleState,
    actuate,
    advance,
    clamp,
    sinc,
)

MAX_INNER_STEP_S = 0.01
"""Longest step of the integrator; its error falls with the square."""

GAMMA = 1 - math.sqrt(0.5)
"""Of the two-stage singly diagonally implicit Runge-Kutta method that is L-stable and of second order (Alexander, 1977)."""

ANTILOCK_SHARE = 0.95
"""Share of the friction limit that drive and brakes may use: wheels that do not lock keep a third of it for steering."""

LIFT_SHARE = 0.9
"""Share of an axle's load that drive and brakes may take off it."""


def step_single_track(
    state: VehicleState, controls: VehicleControls, parameters: VehicleParameters, dt_s: float
) -> VehicleState:
    """Move vehicles by `dt_s` with constant commands by the published single-track model with linear tires.

    Notes
    -----
    Equations: Althoff, Koschi & Manzinger, "CommonRoad: Vehicle Models", 2020, section "Single-Track Model", with the load
    transfer of braking and driving, small angles and no limit of friction. They have the speed of the center of gravity as
    `speed_mps`, and `lateral_mps` is speed times slip angle less what the yaw rate adds at the rear axle. They are published
    for forward motion; backward, each tire's force opposes its slip as well. Actuators as in `step_bicycle`.
    """
    p, chassis = parameters, Chassis.of(parameters)
    count, h = _inner_steps(dt_s)
    pedal_target = clamp(controls.pedal_mps2, -p.max_brake_mps2, p.max_throttle_mps2)
    steer_target = clamp(controls.steer_rad, -p.max_steer_rad, p.max_steer_rad)
    x, y, yaw, speed = state.x_m, state.y_m, state.yaw_rad, state.speed_mps
    pedal, steer = state.pedal_mps2, state.steer_rad
    moving = np.where(speed == 0, 1.0, speed)
    rear = np.where(speed == 0, 0.0, state.lateral_mps / moving)
    front = np.where(speed == 0, 0.0, rear + p.wheelbase_m * state.yaw_rate_radps / moving - steer)
    x, y = x + p.cg_to_rear_m * np.cos(yaw), y + p.cg_to_rear_m * np.sin(yaw)
    standing_gear = np.where(controls.reverse, -1.0, 1.0)
    for _ in range(count):
        begin, before = steer, speed
        pedal, mean_pedal = actuate(pedal, pedal_target, p.pedal_lag_s, p.max_jerk_mps3, h)
        steer, mean_steer = actuate(steer, steer_target, p.steer_lag_s, p.max_steer_rate_radps, h)
        gear = np.where(before == 0, standing_gear, np.sign(before))
        pace, distance = advance(np.abs(before), mean_pedal, h)
        speed = gear * pace
        motion = Motion(before, speed, gear * distance, begin, mean_steer, steer)
        x, y, yaw, rear, front = drive_linear(x, y, yaw, rear, front, motion, p, chassis, h)
    x, y = x - p.cg_to_rear_m * np.cos(yaw), y - p.cg_to_rear_m * np.sin(yaw)
    yaw_rate = speed * (front - rear + steer) / p.wheelbase_m
    return VehicleState(x, y, yaw, speed, steer, pedal, speed * rear, yaw_rate)


def step_dynamic(
    state: VehicleState, controls: VehicleControls, parameters: VehicleParameters, dt_s: float
) -> VehicleState:
    """Move vehicles by `dt_s` with constant commands by a single-track model whose tires saturate.

    Notes
    -----
    Angles are exact. Lateral force of an axle: the magic formula of Pacejka ("Tire and Vehicle Dynamics", 2012, chapter 4)
    with shape factor 1 and no curvature, D sin(arctan(C s)) = D C s / sqrt(1 + (C s)^2) with s the tangent of the slip
    angle: stiffness C at first, D at most. D is friction times load, less what drive and brakes take of it (friction
    ellipse). The pedal accelerates the rear axle: the drive makes up for what rolling along a curve costs, so that without
    slip this is the kinematic bicycle, while without friction the momentum stays what it is.
    """
    p, chassis = parameters, Chassis.of(parameters)
    count, h = _inner_steps(dt_s)
    pedal_target = clamp(controls.pedal_mps2, -p.max_brake_mps2, p.max_throttle_mps2)
    steer_target = clamp(controls.steer_rad, -p.max_steer_rad, p.max_steer_rad)
    x, y, yaw, speed = state.x_m, state.y_m, state.yaw_rad, state.speed_mps
    pedal, steer, lateral, yaw_rate = state.pedal_mps2, state.steer_rad, state.lateral_mps, state.yaw_rate_radps
    standing_gear = np.where(controls.reverse, -1.0, 1.0)
    grip = ANTILOCK_SHARE * GRAVITY_MPS2 * p.friction
    bend = np.tan(steer)
    for _ in range(count):
        before = bend
        pedal, mean_pedal = actuate(pedal, pedal_target, p.pedal_lag_s, p.max_jerk_mps3, h)
        steer, mean_steer = actuate(steer, steer_target, p.steer_lag_s, p.max_steer_rate_radps, h)
        bend = np.tan(steer)
        drive = Drive(clamp(mean_pedal, -grip, grip), standing_gear, before, np.tan(mean_steer), bend)
        x, y, yaw, speed, lateral, yaw_rate = slide(x, y, yaw, speed, lateral, yaw_rate, drive, p, chassis, h)
    return VehicleState(x, y, yaw, speed, steer, pedal, lateral, yaw_rate)


@dataclass(frozen=True, eq=False)
class Chassis:
    """How forces at the axles accelerate the axles sideways, per force and mass: rear by rear, either by the other, front."""

    rear: Array
    cross: Array
    front: Array
    cg_to_front_m: Array

    @classmethod
    def of(cls, p: VehicleParameters) -> Chassis:
        to_rear, to_front = p.cg_to_rear_m, p.wheelbase_m - p.cg_to_rear_m
        return cls(
            1 + to_rear**2 / p.gyration_m2,
            1 - to_front * to_rear / p.gyration_m2,
            1 + to_front**2 / p.gyration_m2,
            to_front,
        )


@dataclass(frozen=True, eq=False)
class Motion:
    """What one step of the linear model is given: speed and steering angle at its ends, distance, mean steering angle."""

    speed0_mps: Array
    speed1_mps: Array
    distance_m: Array
    steer0_rad: Array
    mean_steer_rad: Array
    steer1_rad: Array


@dataclass(frozen=True, eq=False)
class Drive:
    """What one step of the saturating model is given: the pedal, the gear at rest, and the tangents of the steering angle."""

    pedal_mps2: Array
    standing_gear: Array
    bend0: Array
    mean_bend: Array
    bend1: Array


def drive_linear(
    x: Array,
    y: Array,
    yaw: Array,
    rear: Array,
    front: Array,
    motion: Motion,
    p: VehicleParameters,
    c: Chassis,
    h: float,
) -> tuple[Array, Array, Array, Array, Array]:
    """One step of the published model: center of gravity, yaw and the axles' slip angles (rad, positive to the left)."""
    m, wheelbase = motion, p.wheelbase_m
    speed, accel = (m.speed0_mps + m.speed1_mps) / 2, (m.speed1_mps - m.speed0_mps) / h
    pace, gear = np.abs(speed), np.where(speed < 0, -1.0, 1.0)
    rear_grip, front_grip = _grips(accel, p, c, 1.0)
    rear_stiffness, front_stiffness = rear_grip * p.rear_stiffness_1prad, front_grip * p.front_stiffness_1prad
    # The yaw rate is speed * (front - rear + steer) / wheelbase; it and its growth with the speed move both axles.
    by_rear = (p.cg_to_rear_m * gear * accel - pace * speed) / wheelbase
    by_front = -(c.cg_to_front_m * gear * accel + pace * speed) / wheelbase
    tau = GAMMA * h
    system = Pair(
        pace + tau * (c.rear * rear_stiffness + by_rear),
        tau * (c.cross * front_stiffness - by_rear),
        tau * (c.cross * rear_stiffness + by_front),
        pace + tau * (c.front * front_stiffness - by_front),
    )
    turned = m.steer1_rad - m.steer0_rad
    middle = m.steer0_rad + GAMMA * turned
    swing = GAMMA * pace * turned
    rear_, front_ = system.solve(pace * rear + tau * by_rear * middle, pace * front + tau * by_front * middle - swing)
    again = (1 - GAMMA) / GAMMA
    rear1, front1 = system.solve(
        pace * (rear + again * (rear_ - rear)) + tau * by_rear * m.steer1_rad,
        pace * (front + again * (front_ - front)) + tau * by_front * m.steer1_rad - swing,
    )
    turn = m.distance_m * ((front + front1 - rear - rear1) / 2 + m.mean_steer_rad) / wheelbase
    share = p.cg_to_rear_m / wheelbase
    slip0 = rear + share * (front - rear + m.steer0_rad)
    slip1 = rear1 + share * (front1 - rear1 + m.steer1_rad)
    bend = turn + slip1 - slip0
    chord, course = m.distance_m * sinc(bend / 2), yaw + slip0 + bend / 2
    return x + chord * np.cos(course), y + chord * np.sin(course), yaw + turn, rear1, front1


def slide(
    x: Array, y: Array, yaw: Array, speed: Array, rear: Array, yaw_rate: Array,
    drive: Drive, p: VehicleParameters, c: Chassis, h: float,
) -> tuple[Array, Array, Array, Array, Array, Array]:  # fmt: skip
    """One step of the saturating model: rear axle, yaw, speed, lateral velocity of the rear axle and yaw rate."""
    d, wheelbase, to_rear = drive, p.wheelbase_m, p.cg_to_rear_m
    rolling = speed * d.bend0 / wheelbase  # the yaw rate without slip
    front = rear + wheelbase * (yaw_rate - rolling)
    push = h * np.maximum(d.pedal_mps2, 0.0) * np.where(speed == 0, d.standing_gear, np.sign(speed))
    brake = np.minimum(d.pedal_mps2, 0.0)
    mean_rear, mean_front, mean_rate, grown = rear, front, yaw_rate, np.zeros_like(rear)
    for tau, last in ((h / 2, False), (GAMMA * h, True)):
        gain = h * (mean_rate * mean_rear + to_rear * mean_rate * (mean_front - mean_rear) / wheelbase)
        gain = gain - to_rear * d.mean_bend / wheelbase * grown
        free = speed + gain + push
        pace, distance = advance(np.abs(free), brake, h)
        speed1, way = np.sign(free) * pace, np.sign(free) * distance - (gain + push) * h / 2
        mean_speed = (speed + speed1) / 2
        rolling1 = speed1 * d.bend1 / wheelbase
        system, rear_scale, front_scale = _slips(
            mean_speed, (speed1 - speed - gain) / h, mean_rear, mean_front, d, p, c, tau
        )
        swing = -wheelbase * (rolling1 - rolling)
        pull0, pull1 = -speed * rolling * h, -speed1 * rolling1 * h
        if last:
            break
        half_rear, half_front = system.solve(rear + (pull0 + pull1) / 4, front + (pull0 + pull1) / 4 + swing / 2)
        mean_rear, mean_front = rear_scale * half_rear, front_scale * half_front
        mean_rate = (rolling + rolling1) / 2 + (mean_front - mean_rear) / wheelbase
        grown = 2 * (mean_rear - rear)
    pull = GAMMA * (pull0 + GAMMA * (pull1 - pull0))
    first_rear, first_front = system.solve(rear + pull, front + pull + GAMMA * swing)
    again = (1 - GAMMA) / GAMMA
    last_rear, last_front = system.solve(
        rear + again * (rear_scale * first_rear - rear) + GAMMA * pull1,
        front + again * (front_scale * first_front - front) + GAMMA * (pull1 + swing),
    )
    rear1, front1 = rear_scale * last_rear, front_scale * last_front
    turn = way * d.mean_bend / wheelbase + h * (front + front1 - rear - rear1) / (2 * wheelbase)
    chord, aside, course = way * sinc(turn / 2), (rear + rear1) / 2 * h * sinc(turn / 2), yaw + turn / 2
    cos, sin = np.cos(course), np.sin(course)
    rate1 = rolling1 + (front1 - rear1) / wheelbase
    return x + chord * cos - aside * sin, y + chord * sin + aside * cos, yaw + turn, speed1, rear1, rate1


@dataclass(frozen=True, eq=False)
class Pair:
    """Two linear equations for two unknowns, for every agent: a b, c d."""

    a: Array
    b: Array
    c: Array
    d: Array

    def solve(self, rear: Array, front: Array) -> tuple[Array, Array]:
        """The unknowns for right-hand sides (A,), (A,), by Cramer's rule."""
        determinant = self.a * self.d - self.b * self.c
        return (self.d * rear - self.b * front) / determinant, (self.a * front - self.c * rear) / determinant


def _slips(
    speed: Array, accel: Array, rear: Array, front: Array, d: Drive, p: VehicleParameters, c: Chassis, tau: float
) -> tuple[Pair, Array, Array]:
    """Equations for the lateral slip velocities (m/s) after `tau`, divided by the scales (A,), (A,) that come with them.

    Tires act by their secant stiffness at the slips given, so every step is dissipative whatever its length. With the
    scales as units the equations stay regular at standstill, where both scales vanish.
    """
    use = accel / (GRAVITY_MPS2 * p.friction)
    rear_grip, front_grip = _grips(accel, p, c, np.sqrt(np.maximum(1 - use**2, 0.0)))
    cos2 = 1 / (1 + d.mean_bend**2)
    rear_scale = np.sqrt(speed**2 + (p.rear_stiffness_1prad * rear) ** 2)
    along = speed + front * d.mean_bend * cos2
    front_scale = np.sqrt(along**2 + (p.front_stiffness_1prad * cos2 * front) ** 2)
    by_rear = p.rear_stiffness_1prad * rear_grip
    by_front = p.front_stiffness_1prad * front_grip * cos2 * np.sqrt(cos2)
    turn = speed / p.wheelbase_m
    system = Pair(
        rear_scale + tau * (c.rear * by_rear - turn * rear_scale),
        tau * (c.cross * by_front + turn * front_scale),
        tau * (c.cross * by_rear - turn * rear_scale),
        front_scale + tau * (c.front * by_front + turn * front_scale),
    )
    return system, rear_scale, front_scale


def _grips(accel: Array, p: VehicleParameters, c: Chassis, share: Array | float) -> tuple[Array, Array]:
    """Lateral force per mass that rear and front axle can bear: friction times load, which moves to the rear with `accel`."""
    lift = p.cg_height_m / GRAVITY_MPS2
    shift = lift * clamp(accel, -LIFT_SHARE * c.cg_to_front_m / lift, LIFT_SHARE * p.cg_to_rear_m / lift)
    whole = share * p.friction * GRAVITY_MPS2 / p.wheelbase_m
    return whole * (c.cg_to_front_m + shift), whole * (p.cg_to_rear_m - shift)


def _inner_steps(dt_s: float) -> tuple[int, float]:
    """Number and length of the steps that make up `dt_s`."""
    count = max(1, math.ceil(dt_s / MAX_INNER_STEP_S - 1e-9))
    return count, dt_s / count
