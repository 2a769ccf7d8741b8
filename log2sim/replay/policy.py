"""What a user's own driver of the ego sees and answers."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from log2sim.errors import ConfigError
from log2sim.geometry import Array

SIGHT_M = 100.0
ROUTE_AHEAD_S = 10.0
ROUTE_STEP_S = 0.1


@dataclass(frozen=True)
class Controls:
    """Answer of a policy: `accel_mps2` (positive throttle, negative brake), `steer_rad` at the wheels, positive left.

    Braking ends at standstill. `reverse` engages at standstill; throttle then drives backward.
    """

    accel_mps2: float
    steer_rad: float
    reverse: bool = False


@dataclass(frozen=True)
class EgoState:
    """The ego: box center in the map in m, yaw in [-pi, pi), speed along the heading, what its actuators do, its size."""

    x_m: float
    y_m: float
    yaw_rad: float
    speed_mps: float
    accel_mps2: float
    steer_rad: float
    length_m: float
    width_m: float
    wheelbase_m: float
    rear_axle_offset_m: float


@dataclass(frozen=True, eq=False)
class Others:
    """Agents within `SIGHT_M` of the ego, nearest first, as columns (A,): box centers in the map, sizes in m."""

    id: NDArray[Any]
    category: NDArray[Any]
    x_m: Array
    y_m: Array
    yaw_rad: Array
    speed_mps: Array
    length_m: Array
    width_m: Array


@dataclass(frozen=True, eq=False)
class Route:
    """Where the recorded ego goes in the next 10 s, as columns (T,): box centers in the map, every 0.1 s from now."""

    t_s: Array
    x_m: Array
    y_m: Array
    yaw_rad: Array
    speed_mps: Array


@dataclass(frozen=True, eq=False)
class Observation:
    """What a policy sees at `t_s`; its controls then hold for `dt_s`."""

    t_s: float
    dt_s: float
    ego: EgoState
    others: Others
    route: Route


Policy = Callable[[Observation], Controls]


def load_policy(name: str) -> Policy:
    """The callable that "module:attribute" names; dots in the attribute are followed.

    Raises
    ------
    ConfigError
        When the name has another form, or what it names cannot be imported or called.
    """
    module_name, colon, attribute = name.partition(":")
    if not (module_name and colon and attribute):
        raise ConfigError(f"policy '{name}': expected module:attribute, such as my_driver:brake_late")
    try:
        target: Any = importlib.import_module(module_name)
    except Exception as error:  # a user's module may raise anything while it is imported
        raise ConfigError(
            f"policy '{name}': module '{module_name}' cannot be imported: {type(error).__name__}: {error}"
        ) from error
    for part in attribute.split("."):
        if not hasattr(target, part):
            raise ConfigError(f"policy '{name}': '{part}' is not in {target!r}")
        target = getattr(target, part)
    if not callable(target):
        raise ConfigError(
            f"policy '{name}': is a {type(target).__name__}, expected a callable policy(observation) -> Controls"
        )
    return target


def ask(policy: Policy, observation: Observation) -> Controls:
    """Call a policy and check its answer."""
    try:
        answer = policy(observation)
    except Exception as error:
        # Whatever a user's policy raises is the policy's, and the traceback tells its author where.
        raise ConfigError(f"policy at {observation.t_s:g} s: raised {type(error).__name__}: {error}") from error
    if not isinstance(answer, Controls):
        raise ConfigError(
            f"policy at {observation.t_s:g} s: answered {type(answer).__name__}, expected log2sim.replay.Controls(accel_mps2, steer_rad)"
        )
    if not (math.isfinite(answer.accel_mps2) and math.isfinite(answer.steer_rad)):
        raise ConfigError(f"policy at {observation.t_s:g} s: answered {answer}, expected finite numbers")
    return answer
