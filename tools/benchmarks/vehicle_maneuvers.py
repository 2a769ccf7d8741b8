"""Maneuvers of the vehicle benchmark, and the equations that everyone integrates there.

The published single-track model of vehicle 2, a BMW 320i, and the kinematic bicycle, with steering rate and acceleration
as functions of time.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from log2sim.simulation.vehicles.parameters import published_parameters
from log2sim.simulation.vehicles.single_track import Chassis
from log2sim.simulation.vehicles.vehicle import GRAVITY_MPS2

VEHICLE = published_parameters(2, rear_axle_offset_m=1.4)
CHASSIS = Chassis.of(VEHICLE)
SWITCH_MPS = 0.1  # below, the published equations are the kinematic ones
STANDSTILL_MPS = 1e-9  # stands for zero where the equations divide by the speed

Inputs = Callable[[Any, Callable[[Any], Any]], tuple[Any, Any]]
Rates = Callable[[float, Any], Any]


@dataclass(frozen=True)
class Case:
    """A maneuver: speed and steering angle at its begin, and inputs(t, exp) -> steering rate, acceleration."""

    name: str
    speed_mps: float
    steer_rad: float
    duration_s: float
    inputs: Inputs


def bump(t: Any, at_s: float, over_s: float, exp: Callable[[Any], Any]) -> Any:
    return exp(-(((t - at_s) / over_s) ** 2))


def rise(t: Any, at_s: float, over_s: float, exp: Callable[[Any], Any]) -> Any:
    return 1 / (1 + exp(-(t - at_s) / over_s))


def swing(size: float, at_s: tuple[float, float, float], over_s: float) -> Callable[[Any, Callable[[Any], Any]], Any]:
    """Steering rate of a lane change: to one side, over to the other, and back."""

    def rate(t: Any, exp: Callable[[Any], Any]) -> Any:
        first, second, third = (bump(t, at, over_s, exp) for at in at_s)
        return size * (first - 2 * second + third)

    return rate


def stop_and_go(t: Any, exp: Callable[[Any], Any]) -> tuple[Any, Any]:
    braking = rise(t, 0.5, 0.05, exp) * rise(-t, -3.14, 0.02, exp)
    return 0.05 * bump(t, 5.5, 0.5, exp), 2.0 * rise(t, 5.0, 0.05, exp) - 3.0 * braking


CASES = (
    Case("swerve and brake, 25 m/s", 25.0, 0.0, 4.0,
         lambda t, exp: (swing(0.28, (0.8, 1.5, 2.2), 0.25)(t, exp), -5.0 * rise(t, 1.2, 0.05, exp))),
    Case("lane change, 15 m/s", 15.0, 0.0, 6.0, lambda t, exp: (swing(0.06, (1.5, 2.6, 3.7), 0.35)(t, exp), 0 * t)),
    Case("brake to stop, wait, go", 8.0, 0.0, 8.0, stop_and_go),
    Case("from rest at 0.2 rad", 0.0, 0.2, 5.0, lambda t, exp: (0 * t, 1.5 + 0 * t)),
)  # fmt: skip


def single_track_rates(case: Case, switch_mps: float) -> Rates:
    """The published equations; states x, y, steering angle, speed, yaw, yaw rate, slip angle of the center of gravity."""
    to_rear, to_front, wheelbase = (
        float(v[0]) for v in (VEHICLE.cg_to_rear_m, CHASSIS.cg_to_front_m, VEHICLE.wheelbase_m)
    )
    inertia, height = float(VEHICLE.gyration_m2[0]), float(VEHICLE.cg_height_m[0])
    stiffness = float(VEHICLE.friction[0] * VEHICLE.front_stiffness_1prad[0]) / wheelbase

    def rates(t: float, state: Any) -> list[float]:
        _, _, steer, speed, yaw, yaw_rate, slip = state
        turned, accel = case.inputs(t, math.exp)
        if abs(speed) < switch_mps:
            bend, share = math.tan(steer), to_rear / wheelbase
            slip = math.atan(share * bend)
            slip_rate = share * turned / (math.cos(steer) ** 2 * (1 + (share * bend) ** 2))
            grown = accel * math.cos(slip) * bend - speed * math.sin(slip) * slip_rate * bend
            grown += speed * math.cos(slip) * turned / math.cos(steer) ** 2
            rolled = speed * math.cos(slip) * bend / wheelbase
            course = yaw + slip
            return [
                speed * math.cos(course),
                speed * math.sin(course),
                turned,
                accel,
                rolled,
                grown / wheelbase,
                slip_rate,
            ]
        pace = speed if abs(speed) > STANDSTILL_MPS else STANDSTILL_MPS
        front = stiffness * (GRAVITY_MPS2 * to_rear - accel * height) * (steer - slip - to_front * yaw_rate / pace)
        rear = stiffness * (GRAVITY_MPS2 * to_front + accel * height) * (to_rear * yaw_rate / pace - slip)
        twist = (to_front * front - to_rear * rear) / inertia
        course = yaw + slip
        return [
            speed * math.cos(course), speed * math.sin(course), turned, accel,
            yaw_rate, twist, (front + rear) / pace - yaw_rate,
        ]  # fmt: skip

    return rates


def kinematic_rates(case: Case) -> Rates:
    """The kinematic bicycle; states x, y of the rear axle, steering angle, speed, yaw."""
    wheelbase = float(VEHICLE.wheelbase_m[0])

    def rates(t: float, state: Any) -> list[float]:
        _, _, steer, speed, yaw = state
        turned, accel = case.inputs(t, math.exp)
        return [speed * math.cos(yaw), speed * math.sin(yaw), turned, accel, speed * math.tan(steer) / wheelbase]

    return rates


def start_of(case: Case, model: str) -> list[float]:
    share = float(VEHICLE.cg_to_rear_m[0] / VEHICLE.wheelbase_m[0])
    state = [0.0, 0.0, case.steer_rad, case.speed_mps, 0.0]
    return state if model == "kinematic" else [*state, 0.0, math.atan(share * math.tan(case.steer_rad))]
