"""What a user's own driver of the ego sees and answers.

All positions are box centers on the map's axes in m, yaw is counter-clockwise from +x in rad within [-pi, pi), speed is
along the heading in m/s (negative in reverse gear), time is in s on the scenario's clock. All arrays are read-only.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from log2sim.datatypes import Scenario
from log2sim.errors import ConfigError
from log2sim.geometry import Array

SIGHT_M = 100.0
ROUTE_AHEAD_S = 10.0
ROUTE_STEP_S = 0.1
PATH_AHEAD_M = 100.0


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
    """The ego: where it is, what its actuators do now (`accel_mps2` along the heading, `steer_rad` at the wheels), its size.

    The rear axle, about which a vehicle turns, is `rear_axle_offset_m` behind the box center, the front one
    `wheelbase_m` ahead of that. A curvature c takes a steering angle of atan(wheelbase c (1 + understeer speed^2)).
    """

    x_m: float
    y_m: float
    z_m: float
    yaw_rad: float
    speed_mps: float
    accel_mps2: float
    steer_rad: float
    length_m: float
    width_m: float
    height_m: float
    wheelbase_m: float
    rear_axle_offset_m: float
    understeer_s2pm2: float


@dataclass(frozen=True, eq=False)
class Others:
    """Agents whose box center is within sight, nearest first, as columns (A,): parked ones too, the ego not.

    `velocity_x_mps`, `velocity_y_mps` are on the map's axes; `id` and `category` are strings. Who is on another level, as
    `z_m` and `height_m` tell, is in nobody's way.
    """

    id: NDArray[Any]
    category: NDArray[Any]
    x_m: Array
    y_m: Array
    z_m: Array
    yaw_rad: Array
    speed_mps: Array
    velocity_x_mps: Array
    velocity_y_mps: Array
    length_m: Array
    width_m: Array
    height_m: Array

    def __len__(self) -> int:
        return len(self.x_m)


@dataclass(frozen=True, eq=False)
class Route:
    """Where the recorded ego is in the next 10 s, as columns (T,): every 0.1 s from now to the end of the log."""

    t_s: Array
    x_m: Array
    y_m: Array
    yaw_rad: Array
    speed_mps: Array


@dataclass(frozen=True, eq=False)
class PathAhead:
    """The recorded ego's way from the place beside the ego, whenever it was there, as columns (P,): 100 m, one row a meter.

    `distance_m` is counted from the first row, the nearest to the ego. `yaw_rad` is the direction of travel, `speed_mps`
    the pace of the log at that place, `t_s` when the log was there. Beyond the end of the log the way goes straight on with
    the last pace, and `t_s` is NaN. `progress_m` is the way up to the first row.
    """

    progress_m: float
    distance_m: Array
    x_m: Array
    y_m: Array
    yaw_rad: Array
    speed_mps: Array
    t_s: Array


@dataclass(frozen=True, eq=False)
class Observation:
    """What a policy sees at `t_s`; its controls then hold for `dt_s`."""

    t_s: float
    dt_s: float
    ego: EgoState
    others: Others
    route: Route
    path: PathAhead


Policy = Callable[[Observation], Controls]
"""A function, or an object with `__call__` and, if it keeps something between steps, `reset(scenario)`."""


def reset_policy(policy: Policy, scenario: Scenario) -> None:
    """Call a policy's `reset(scenario)` if it has one, so that it can be used for one replay after the other."""
    reset = getattr(policy, "reset", None)
    if reset is None:
        return
    try:
        reset(scenario)
    except Exception as error:
        raise ConfigError(f"policy: reset raised {type(error).__name__}: {error}") from error


def query_policy(policy: Policy, observation: Observation) -> Controls:
    """Call a policy and check its answer."""
    where = f"policy at {observation.t_s:g} s"
    try:
        answer = policy(observation)
    except Exception as error:
        # Whatever a user's policy raises is the policy's, and the traceback tells its author where.
        raise ConfigError(f"{where}: raised {type(error).__name__}: {error}") from error
    if not isinstance(answer, Controls):
        raise ConfigError(
            f"{where}: answered {type(answer).__name__}, expected log2sim.simulation.policy.Controls(accel_mps2, steer_rad)"
        )
    try:
        finite = math.isfinite(answer.accel_mps2) and math.isfinite(answer.steer_rad)
    except TypeError:
        finite = False
    if not finite:
        raise ConfigError(f"{where}: answered {answer}, expected finite numbers")
    return answer
