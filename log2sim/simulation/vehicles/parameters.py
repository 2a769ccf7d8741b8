"""Vehicle parameters: by category and size, and those of published vehicles.

Shares of the size are typical values of vehicles on the road; size and rear axle of the scenario take precedence.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from log2sim.datatypes import Agent
from log2sim.simulation.vehicles.vehicle import VehicleParameters

# Categories that move as bicycle models; all others are point masses that may also move sideways.
WHEELED = ("car", "truck", "bus", "motorcycle", "cyclist", "bicycle")

STEER_RATE_RADPS = 1.0  # at the road wheels: a full turn of the hand wheel in 0.4 s at a ratio of 16
STEER_LAG_S = 0.10
PEDAL_LAG_S = 0.10
MAX_JERK_MPS3 = 60.0


class VehicleProportions(NamedTuple):
    """Proportions and limits of the vehicles of a category."""

    wheelbase: float  # as a share of the length
    rear_axle: float  # likewise, behind the box center
    max_steer_rad: float
    max_throttle_mps2: float
    max_brake_mps2: float
    cg_to_rear: float  # of the wheelbase: the share of the weight on the front axle
    cg_height: float  # of the height
    front_stiffness_1prad: float  # cornering stiffness over load and friction
    rear_stiffness_1prad: float
    friction: float


# Wheelbase and axle: a 4.3 m hatchback has 2.6 m and 1.3 m; buses carry a long overhang and their engine behind the rear
# axle. Height of the center of gravity of cars: 0.38 to 0.40 of the roof's (Heydinger et al., "Measured Vehicle Inertial
# Parameters", SAE 1999-01-1336). Cornering stiffness of cars: axle compliances of 4.5 and 3.4 degrees per g, the front
# softer, so that they understeer (concept: Bundorf & Leffert, SAE 760713); of trucks about half, as of their tires (Fancher
# et al., "A Factbook of the Mechanical Properties of the Components for Single-Unit and Articulated Heavy Trucks", 1986).
# Friction of a dry road: of cars as in the published vehicles below, of truck tires less.
_CAR = VehicleProportions(0.61, 0.30, 0.65, 6.0, 10.0, 0.55, 0.38, 12.0, 16.0, 1.0489)
_CYCLE = VehicleProportions(0.60, 0.30, 0.80, 3.0, 7.0, 0.45, 0.55, 15.0, 18.0, 0.9)
_PROPORTIONS: dict[str, VehicleProportions] = {
    "car": _CAR,
    "truck": VehicleProportions(0.57, 0.28, 0.75, 4.0, 9.0, 0.50, 0.42, 7.0, 9.0, 0.9),
    "bus": VehicleProportions(0.50, 0.22, 0.85, 3.0, 8.0, 0.38, 0.38, 7.0, 9.0, 0.9),
    "motorcycle": VehicleProportions(0.66, 0.33, 0.70, 8.0, 10.0, 0.50, 0.40, 15.0, 18.0, 1.0),
    "cyclist": _CYCLE,
    "bicycle": _CYCLE,
}


class PublishedVehicle(NamedTuple):
    """A vehicle of "CommonRoad: Vehicle Models" (Althoff, Koschi & Manzinger, 2020), appendix A."""

    length_m: float
    width_m: float
    cg_to_front_m: float
    cg_to_rear_m: float
    cg_height_m: float  # of the sprung mass, as in the single-track model
    mass_kg: float
    inertia_kgm2: float
    max_steer_rad: float


# 1 is a Ford Escort, 2 a BMW 320i, 3 a Volkswagen Vanagon.
PUBLISHED: dict[int, PublishedVehicle] = {
    1: PublishedVehicle(4.298, 1.674, 0.88392, 1.50876, 0.59436, 1225.8878467253344, 1538.8533713561394, 0.910),
    2: PublishedVehicle(
        4.508, 1.610, 1.1561957064, 1.4227170936, 0.61373004, 1093.2952334674046, 1791.5995300122856, 1.066
    ),
    3: PublishedVehicle(
        4.569, 1.844, 1.1507916024, 1.3211363976, 0.804490644, 1478.8979637767998, 2473.1176915564442, 1.023
    ),
}

PUBLISHED_FRICTION = 1.0489  # tire parameter p_dy1 of all three
PUBLISHED_STIFFNESS_1PRAD = 21.92 / 1.0489  # -p_ky1 / p_dy1
PUBLISHED_STEER_RATE_RADPS = 0.4
PUBLISHED_MAX_ACCEL_MPS2 = 11.5


def rear_axle_offset(agent: Agent) -> float:
    """Return the distance in m from the rear axle forward to the box center; 0 in a scenario means unknown.

    No wheeled vehicle turns about its box center, so an unknown offset is taken from the length; points have none.
    """
    if agent.category not in WHEELED:
        return 0.0
    return agent.rear_axle_offset_m or _PROPORTIONS[agent.category].rear_axle * agent.size_m[0]


def parameters_for(agents: Sequence[Agent], *, published: bool = False) -> VehicleParameters:
    """Return parameters (A,) of wheeled agents by category and size; with `published`, cars take the nearest published vehicle.

    Yaw inertia over mass is the product of the distances from the center of gravity to the axles, which holds for the
    published vehicles within 10 %.
    """
    names = VehicleProportions._fields
    kind = np.array([_PROPORTIONS[a.category] for a in agents], dtype=np.float64).reshape(-1, len(names))
    share = dict(zip(names, kind.T))
    length_m, _, height_m = np.array([a.size_m for a in agents], dtype=np.float64).reshape(-1, 3).T
    wheelbase_m = share["wheelbase"] * length_m
    cg_to_rear_m = share["cg_to_rear"] * wheelbase_m
    same = np.ones(len(agents))
    parameters = VehicleParameters(
        wheelbase_m=wheelbase_m, rear_axle_offset_m=np.array([rear_axle_offset(a) for a in agents], dtype=np.float64),
        max_steer_rad=share["max_steer_rad"], max_steer_rate_radps=STEER_RATE_RADPS * same,
        steer_lag_s=STEER_LAG_S * same, max_throttle_mps2=share["max_throttle_mps2"],
        max_brake_mps2=share["max_brake_mps2"], max_jerk_mps3=MAX_JERK_MPS3 * same, pedal_lag_s=PEDAL_LAG_S * same,
        cg_to_rear_m=cg_to_rear_m, cg_height_m=share["cg_height"] * height_m,
        gyration_m2=cg_to_rear_m * (wheelbase_m - cg_to_rear_m), front_stiffness_1prad=share["front_stiffness_1prad"],
        rear_stiffness_1prad=share["rear_stiffness_1prad"], friction=share["friction"], understeer_s2pm2=0 * same,
    )  # fmt: skip
    if published:
        for i, agent in enumerate(agents):
            if agent.category == "car":
                nearest = min(PUBLISHED, key=lambda k: math.dist(PUBLISHED[k][:2], agent.size_m[:2]))
                one = published_parameters(nearest, rear_axle_offset_m=rear_axle_offset(agent))
                parameters.put(slice(i, i + 1), one)
    return parameters


def published_parameters(vehicle: int, *, rear_axle_offset_m: float) -> VehicleParameters:
    """Return the parameters (1,) of a published vehicle, with the actuator lags of all others."""
    v = PUBLISHED[vehicle]
    values = {
        "wheelbase_m": v.cg_to_front_m + v.cg_to_rear_m, "rear_axle_offset_m": rear_axle_offset_m,
        "max_steer_rad": v.max_steer_rad, "max_steer_rate_radps": PUBLISHED_STEER_RATE_RADPS,
        "steer_lag_s": STEER_LAG_S, "max_throttle_mps2": PUBLISHED_MAX_ACCEL_MPS2,
        "max_brake_mps2": PUBLISHED_MAX_ACCEL_MPS2, "max_jerk_mps3": MAX_JERK_MPS3, "pedal_lag_s": PEDAL_LAG_S,
        "cg_to_rear_m": v.cg_to_rear_m, "cg_height_m": v.cg_height_m, "gyration_m2": v.inertia_kgm2 / v.mass_kg,
        "front_stiffness_1prad": PUBLISHED_STIFFNESS_1PRAD, "rear_stiffness_1prad": PUBLISHED_STIFFNESS_1PRAD,
        "friction": PUBLISHED_FRICTION, "understeer_s2pm2": 0.0,  # the axles' stiffness is the same
    }  # fmt: skip
    return VehicleParameters(**{k: np.array([value], dtype=np.float64) for k, value in values.items()})
