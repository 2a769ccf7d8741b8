"""Vehicle models: a kinematic bicycle about the rear axle and a point mass, as steps over all agents at once; and parameters.

A step takes a state and controls and returns a new state; the models keep no state between steps. Every column has
shape (A,). The state of a vehicle is that of its rear axle, where the no-slip condition is exact: the axle moves along
the heading.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Agent
from log2sim.geometry import Array, cos_sin

MAX_INNER_STEP_S = 0.02  # longest step over which the mean steering angle is used; the error is of second order
GRAVITY_MPS2 = 9.81

TINY = 1e-300  # added where zero would divide: it changes no other number, and takes a third of the time of a mask


@dataclass(frozen=True, eq=False)
class Columns:
    """Base of records whose fields are arrays (A,) or (..., A)."""

    @classmethod
    def zeros(cls, count: int) -> Self:
        """Return records of agents whose columns are all zero."""
        return cls(*(np.zeros(count) for _ in fields(cls)))

    def take(self, index: Any) -> Self:
        """Return the agents at `index` (integers, a slice or a mask)."""
        return type(self)(*(getattr(self, f.name)[..., index] for f in fields(self)))

    def put(self, index: Any, other: Self) -> None:
        """Overwrite the agents at `index`; only the owner of the columns may do so."""
        for f in fields(self):
            getattr(self, f.name)[..., index] = getattr(other, f.name)


@dataclass(frozen=True, eq=False)
class VehicleState(Columns):
    """State of vehicles: rear axle and actuators."""

    x_m: Array
    y_m: Array
    yaw_rad: Array  # (A,) not wrapped
    speed_mps: Array  # (A,) negative in reverse
    steer_rad: Array  # (A,)
    pedal_mps2: Array  # (A,) throttle (positive) or brake (negative), in either gear
    lateral_mps: (
        Array  # (A,) velocity of the rear axle to the left; likewise `yaw_rate_radps`, of models with slip only
    )
    yaw_rate_radps: Array


@dataclass(frozen=True, eq=False)
class VehicleControls(Columns):
    """Commands of vehicles."""

    pedal_mps2: Array  # (A,) positive throttle, negative brake
    steer_rad: Array  # (A,)
    reverse: NDArray[np.bool_]  # (A,) the gear, which engages at standstill


VehicleStep = Callable[["VehicleState", "VehicleControls", "VehicleParameters", float], "VehicleState"]
"""Moves vehicles for so many s with constant controls; no argument is changed."""


@dataclass(frozen=True, eq=False)
class VehicleParameters(Columns):
    """Size and limits of vehicles, all positive and (A,)."""

    wheelbase_m: Array
    rear_axle_offset_m: Array  # from the rear axle forward to the box center
    max_steer_rad: Array
    max_steer_rate_radps: Array
    steer_lag_s: Array
    max_throttle_mps2: Array
    max_brake_mps2: Array
    max_jerk_mps3: Array
    pedal_lag_s: Array
    cg_to_rear_m: Array  # place of the center of gravity
    cg_height_m: Array
    gyration_m2: Array  # yaw inertia over mass
    front_stiffness_1prad: Array  # cornering stiffness over the friction limit
    rear_stiffness_1prad: Array
    friction: Array
    understeer_s2pm2: Array  # for the controller: by how much lateral acceleration widens the curve, 0 without slip

    @cached_property
    def max_curvature_1pm(self) -> Array:
        """Curvature at full lock."""
        return np.tan(self.max_steer_rad) / self.wheelbase_m

    @cached_property
    def actuators(self) -> tuple[Array, Array, Array, Array]:
        """Lower and upper limits, lags and rate limits of pedal and steering, as rows (2, A)."""
        return (
            rows(-self.max_brake_mps2, -self.max_steer_rad),
            rows(self.max_throttle_mps2, self.max_steer_rad),
            rows(self.pedal_lag_s, self.steer_lag_s),
            rows(self.max_jerk_mps3, self.max_steer_rate_radps),
        )


@dataclass(frozen=True, eq=False)
class PointState(Columns):
    """Centers of point masses and their velocities on map axes."""

    x_m: Array
    y_m: Array
    velocity_x_mps: Array
    velocity_y_mps: Array


@dataclass(frozen=True, eq=False)
class PointControls(Columns):
    """Commanded acceleration on map axes."""

    accel_x_mps2: Array
    accel_y_mps2: Array


POINT_MAX_ACCEL_MPS2 = 6.0  # a sprinter's start


def step_bicycle(
    state: VehicleState, controls: VehicleControls, parameters: VehicleParameters, dt_s: float
) -> VehicleState:
    """Move vehicles by `dt_s` with constant commands.

    Actuators (first-order lag, rate and saturation limits) are solved in closed form, and so is the arc of the rear axle at
    the mean steering angle of the step: exact for constant steering at any acceleration, of second order in the step
    otherwise, unconditionally stable. Braking ends at standstill; to reverse, the gear must change.
    """
    actuators, target, lag_s, max_rate = actuation(state, controls, parameters)
    count, h = equal_steps(dt_s, MAX_INNER_STEP_S)
    x, y, yaw, speed = state.x_m, state.y_m, state.yaw_rad, state.speed_mps
    for _ in range(count):
        actuators, (mean_pedal, mean_steer) = actuate(actuators, target, lag_s, max_rate, h)
        gear = engaged_gear(speed, controls.reverse)
        pace, distance = advance_speed(np.abs(speed), mean_pedal, h)
        turn = gear * distance * (np.tan(mean_steer) / parameters.wheelbase_m)
        chord = gear * distance * sinc(turn / 2)
        cos, sin = cos_sin(yaw + turn / 2)
        x, y, yaw, speed = x + chord * cos, y + chord * sin, yaw + turn, gear * pace
    pedal, steer = actuators
    return VehicleState(x, y, yaw, speed, steer, pedal, state.lateral_mps, state.yaw_rate_radps)


def step_point(state: PointState, controls: PointControls, dt_s: float) -> PointState:
    """Move points by `dt_s` with constant acceleration, limited in magnitude; exact."""
    size = np.hypot(controls.accel_x_mps2, controls.accel_y_mps2)
    scale = np.where(size > POINT_MAX_ACCEL_MPS2, POINT_MAX_ACCEL_MPS2 / np.where(size > 0, size, 1.0), 1.0)
    ax, ay = controls.accel_x_mps2 * scale, controls.accel_y_mps2 * scale
    return PointState(
        state.x_m + (state.velocity_x_mps + ax * dt_s / 2) * dt_s,
        state.y_m + (state.velocity_y_mps + ay * dt_s / 2) * dt_s,
        state.velocity_x_mps + ax * dt_s,
        state.velocity_y_mps + ay * dt_s,
    )


def equal_steps(dt_s: float, longest_s: float) -> tuple[int, float]:
    """Return number and length of the fewest equal steps in `dt_s` of which none is longer than a limit."""
    count = max(1, math.ceil(dt_s / longest_s - 1e-9))
    return count, dt_s / count


def clamp(value: Array, low: Array | float, high: Array | float) -> Array:
    """Clip values to limits; `np.clip` takes twice as long on short arrays."""
    return np.minimum(np.maximum(value, low), high)


def rows(first: Array | float, second: Array) -> Array:
    """Stack two columns (A,) to one array (2, A); `np.stack` takes three times as long."""
    both = np.empty((2, len(second)))
    both[0], both[1] = first, second
    return both


def engaged_gear(speed: Array, reverse: NDArray[np.bool_]) -> Array:
    """Return the gear: the sign of the motion, at rest that of the selector."""
    return np.sign(speed + TINY * (0.5 - reverse))


def actuation(
    state: VehicleState, controls: VehicleControls, parameters: VehicleParameters
) -> tuple[Array, Array, Array, Array]:
    """Return pedal and steering (2, A), then their clipped targets, lags and rate limits."""
    low, high, lag_s, max_rate = parameters.actuators
    target = clamp(rows(controls.pedal_mps2, controls.steer_rad), low, high)
    return rows(state.pedal_mps2, state.steer_rad), target, lag_s, max_rate


def actuate(value: Array, target: Array, lag_s: Array, max_rate: Array, h: float) -> tuple[Array, Array]:
    """Return value after `h` and mean over `h` of an actuator with lag, which moves at `max_rate` while far from the target."""
    gap = target - value
    far = np.abs(gap) - max_rate * lag_s
    if not (far > 0).any():  # the same numbers as below, in half the time
        decay = np.exp(-h / lag_s)
        return target - gap * decay, target - gap * (lag_s * (1 - decay) / h)
    limited_s = clamp(far / max_rate, 0.0, h)
    decay = np.exp((limited_s - h) / lag_s)
    near = gap - np.copysign(max_rate * limited_s, gap)
    mean_gap = limited_s * (gap + near) / (2 * h) + near * (lag_s * (1 - decay) / h)
    return target - near * decay, target - mean_gap


def advance_speed(pace: Array, pedal: Array, h: float) -> tuple[Array, Array]:
    """Return speed (not negative) after `h` and distance covered; braking ends at rest, also within the step."""
    after = pace + pedal * h
    distance = (pace + after) * (h / 2)
    stops = np.flatnonzero(after < 0)
    if len(stops):
        after[stops], distance[stops] = 0.0, -(pace[stops] ** 2) / (2 * pedal[stops])
    return after, distance


def sinc(angle: Array) -> Array:
    """sin(angle) / angle, 1 at zero."""
    half = angle / 2 + TINY
    t = np.tan(half)
    return np.asarray(t / (half * (1 + t * t)))


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
