"""Chooses the model of each vehicle: the simplest that is adequate for its maneuver."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from log2sim.datatypes import Agent
from log2sim.geometry import Array
from log2sim.simulation.reference import GRID_S, REFERENCE_HOLD_MPS, VEHICLE_COLUMNS, Reference
from log2sim.simulation.vehicles.single_track import Chassis, axle_grips
from log2sim.simulation.vehicles.vehicle import GRAVITY_MPS2, VehicleParameters, VehicleState

YAW, SPEED, ACCEL, CURVATURE = map(VEHICLE_COLUMNS.index, ("yaw", "speed", "accel_ahead", "curvature_ahead"))

AUTO = "auto"
TWO_WHEELERS = ("motorcycle", "cyclist", "bicycle")

SLIP_TOLERANCE_RAD = 0.02
"""Slip angle of the rear tires up to which the kinematic model is adequate: 1.1 degrees, the error of headings in a scenario.

A car reaches it at 3.3 m/s2 of lateral acceleration, a third of its tires' limit. Polack et al. ("The kinematic bicycle
model: a consistent model for planning feasible trajectories for autonomous vehicles?", 2017) use it up to half the limit.
"""

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
