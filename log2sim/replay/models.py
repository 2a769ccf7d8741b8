"""Which model moves each vehicle: the simplest that is good enough for its maneuver, and why."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from log2sim.geometry import Array
from log2sim.replay.reference import GRID_S, STANDSTILL_MPS, VEHICLE_COLUMNS, Reference
from log2sim.replay.vehicle import GRAVITY_MPS2, VehicleParameters
from log2sim.scenario import Agent

YAW, SPEED, CURVATURE = (VEHICLE_COLUMNS.index(name) for name in ("yaw", "speed", "curvature_ahead"))

MODELS = ("auto", "kinematic", "dynamic", "single-track")
SLIPPING = ("dynamic", "single-track")
TWO_WHEELERS = ("motorcycle", "cyclist", "bicycle")

SLIP_TOLERANCE_RAD = 0.02
"""Slip angle of the rear tires up to which rolling without slip is good enough: 1.1 degrees, as much as headings in a log err.

A car has it at 3.3 m/s2 sideways, a third of what its tires bear. Polack et al. ("The kinematic bicycle model: a consistent
model for planning feasible trajectories for autonomous vehicles?", 2017) take the kinematic model as valid up to half.
"""

MAX_FRICTION_USE = 0.95
"""Share of the friction limit beyond which slips are not predicted: they grow without bound."""


class Choice(NamedTuple):
    """The model of a vehicle, and the reason for it."""

    model: str
    reason: str


def choose(agent: Agent, reference: Reference, parameters: VehicleParameters, wanted: str, *, free: bool) -> Choice:
    """The model for a vehicle (`parameters` of shape (1,)) when the user wants `wanted`; `free` vehicles leave their log."""
    if wanted != "auto":
        return Choice(wanted, "asked for")
    if agent.category in TWO_WHEELERS:
        return Choice("kinematic", "leans into its curves, which slip does not describe")
    if free:
        return Choice("dynamic", "what a policy drives is not known beforehand")
    slip = np.abs(predicted_slips(reference.columns, parameters)[1])
    worst = int(np.argmax(slip))
    found = f"rear tires slip up to {slip[worst]:.3f} rad, {SLIP_TOLERANCE_RAD:g} are tolerated"
    return Choice("dynamic" if slip[worst] > SLIP_TOLERANCE_RAD else "kinematic", found)


def predicted_slips(columns: Array, p: VehicleParameters) -> tuple[Array, Array]:
    """Slip angles (K,), (K,) of the front and rear tires that a reference's rows (K, C) need in steady cornering.

    Both axles use the same share of their friction then, whatever the place of the center of gravity.
    """
    speed, curvature = columns[:, SPEED], columns[:, CURVATURE]
    use = speed**2 * curvature / (GRAVITY_MPS2 * p.friction)
    return _slip(use, p.front_stiffness_1prad), _slip(use, p.rear_stiffness_1prad)


def understeer(p: VehicleParameters) -> Array:
    """Steering angle (A,) beyond that of rolling, per lateral acceleration and wheelbase in s2/m2, while slips are small."""
    compliance = 1 / p.front_stiffness_1prad - 1 / p.rear_stiffness_1prad
    return compliance / (GRAVITY_MPS2 * p.friction * p.wheelbase_m)


def slipping_reference(reference: Reference, p: VehicleParameters, model: str, ahead_s: float) -> Reference:
    """The reference of a vehicle that slips (`p` of shape (1,)), its curvature being that of `ahead_s` later.

    Notes
    -----
    The equations of the single-track model solved for what drives them (inverse dynamics): the forces that turn and move
    the vehicle as the course does, the slips of these forces, the heading that these slips add to the course, and the
    steering angle; as a curvature of which the follower makes this angle again.
    """
    if len(reference.columns) < 3:
        return reference
    later_nose, bend = _inverse(reference.columns, p, saturates=model != "single-track")
    t_s = np.arange(reference.first_row, reference.first_row + len(bend), dtype=np.float64) * GRID_S
    nose = np.interp(t_s, t_s + ahead_s, later_nose)

    def slipped(columns: Array, at_s: Array) -> Array:
        out = columns.copy()
        out[:, YAW] += np.interp(at_s, t_s, nose)
        out[:, CURVATURE] += np.interp(at_s, t_s, bend)
        return out

    def exact(at_s: Array) -> Array:
        return slipped(reference.exact(at_s), at_s)

    return replace(reference, columns=slipped(reference.columns, t_s), exact=exact)


def _inverse(columns: Array, p: VehicleParameters, *, saturates: bool) -> tuple[Array, Array]:
    """What slip adds to the heading (K,) in rad and to the curvature (K,) in 1/m of rows of a table, at their own time."""
    speed, curvature = columns[:, SPEED], columns[:, CURVATURE]
    to_rear, whole = p.cg_to_rear_m, GRAVITY_MPS2 * p.friction
    twist = np.gradient(speed * curvature, GRID_S)
    accel = speed**2 * curvature + to_rear * twist  # of the center of gravity
    front_force = (p.gyration_m2 * twist + to_rear * accel) / p.wheelbase_m
    front_use = front_force * p.wheelbase_m / (whole * to_rear)
    rear_use = (accel - front_force) * p.wheelbase_m / (whole * (p.wheelbase_m - to_rear))
    front = _slip(front_use, p.front_stiffness_1prad, saturates=saturates)
    rear = _slip(rear_use, p.rear_stiffness_1prad, saturates=saturates)
    nose = np.sign(speed) * rear
    moving = np.abs(speed) > STANDSTILL_MPS
    swing = np.where(moving, np.gradient(nose, GRID_S) / np.where(moving, speed, 1.0), 0.0)
    gain = 1 + understeer(p) * speed**2
    return nose, (curvature + swing + (front - rear) / p.wheelbase_m) / gain - curvature


def _slip(use: Array, stiffness_1prad: Array, *, saturates: bool = True) -> Array:
    """Slip angle at a share of the friction limit, of tires that saturate there or, published, do not."""
    if not saturates:
        return use / stiffness_1prad
    use = np.clip(use, -MAX_FRICTION_USE, MAX_FRICTION_USE)
    return use / np.sqrt(1 - use**2) / stiffness_1prad
