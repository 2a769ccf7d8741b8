"""Drivers for the ego, as examples of a policy.

    log2sim edit scenario.json --lateral car-2=3 --out blocked.json
    log2sim replay blocked.json --ego samples/egos.py:BrakeLate --out late.json
    log2sim replay blocked.json --ego samples/egos.py:BrakeInTime --out in_time.json
    log2sim replay scenario.json --ego samples/egos.py:ChangeLane --agents reactive --out change.json
    log2sim replay blocked.json --ego samples/egos.py:BrakeForPoints --log samples/crossing --recorded scenario.json --out seen.json

In the scenario of samples/crossing the first line puts a parked car into the lane of the ego. `BrakeLate` hits it, `BrakeInTime`
stops behind it. `BrakeForPoints` knows of no agent: it brakes for the points that the LiDAR would see.

A policy is called once a step with an `Observation` and answers with `Controls`. These drivers take all they need from what
they see, so they drive any scenario that has an ego.
"""

from __future__ import annotations

import numpy as np

from log2sim.datatypes import Scenario
from log2sim.geometry import Array
from log2sim.simulation.policy import Controls, EgoState, Observation, Others, PathAhead

FULL_BRAKE_MPS2 = 12.0
"""More than dry tires hold."""


class BrakeInTime:
    """Drives the way of the scenario, yet does not slow down with it: it brakes hard, and only when it must.

    It is in a hurry: `hurry` times the highest speed that the scenario has on the next 30 m. What stands or moves on
    its way is ignored until `brake_at_mps2` would be needed to stop `room_m` short of it, or to get as slow as it is.
    """

    def __init__(self, brake_at_mps2: float = 5.0, room_m: float = 1.5, hurry: float = 1.5) -> None:
        self.brake_at_mps2, self.room_m, self.hurry = brake_at_mps2, room_m, hurry
        self.braking = False

    def reset(self, scenario: Scenario) -> None:
        self.braking = False

    def __call__(self, seen: Observation) -> Controls:
        ego = seen.ego
        gap_m, pace_mps = leader(ego, seen.others, seen.path)
        left_m = max(gap_m - self.room_m, 0.1)
        closing = max(ego.speed_mps - pace_mps, 0.0)
        needed_mps2 = closing**2 / (2 * left_m)
        # Once it brakes it goes on until it is as slow as the leader.
        self.braking = needed_mps2 > self.brake_at_mps2 or (self.braking and closing > 0 and np.isfinite(gap_m))
        if self.braking:
            accel = -min(max(needed_mps2, self.brake_at_mps2), FULL_BRAKE_MPS2)
        else:
            cruise_mps = self.hurry * float(seen.path.speed_mps[:30].max())
            close = gap_m < 2 * self.room_m + 0.5 * ego.speed_mps
            accel = hold_speed(ego, min(cruise_mps, pace_mps) if close else cruise_mps)
        return Controls(accel, steer_along(ego, seen.path))


class BrakeLate(BrakeInTime):
    """The same driver, who does not brake before more than dry tires hold would be needed, which is too late."""

    def __init__(self) -> None:
        super().__init__(brake_at_mps2=15.0, room_m=0.3)


class ChangeLane:
    """Drives at the speed of the scenario (walking on where it stopped) and changes to a lane that is free beside it, as soon as there is one.

    The move to the side is the course of least jerk over `over_s` seconds at the speed at which it begins.
    """

    def __init__(self, lane_m: float = 3.5, over_s: float = 4.0) -> None:
        self.lane_m, self.over_s = lane_m, over_s
        self.side, self.done_m, self.length_m = 0.0, 0.0, 1.0

    def reset(self, scenario: Scenario) -> None:
        self.side, self.done_m, self.length_m = 0.0, 0.0, 1.0

    def __call__(self, seen: Observation) -> Controls:
        ego, path = seen.ego, seen.path
        if self.side == 0.0 and ego.speed_mps > 3.0:
            self.side = next((s for s in (1.0, -1.0) if self._is_free(seen, s * self.lane_m)), 0.0)
            self.length_m = ego.speed_mps * self.over_s
        elif self.side != 0.0:
            self.done_m += ego.speed_mps * seen.dt_s
        share = np.clip((self.done_m + path.distance_m) / self.length_m, 0.0, 1.0)
        left_m = self.side * self.lane_m * share**3 * (10 - 15 * share + 6 * share**2)
        return Controls(hold_speed(ego, max(float(path.speed_mps[0]), 1.0)), steer_along(ego, path, left_m))

    def _is_free(self, seen: Observation, left_m: float) -> bool:
        """Whether nobody is or soon will be in the lane that is so far left of the way."""
        ahead_m, beside_m, pace_mps = along_path(seen.others, seen.path)
        in_lane = np.abs(beside_m - left_m) < self.lane_m / 2 + seen.others.width_m / 2 - 0.5
        soon_m = ahead_m + (pace_mps - seen.ego.speed_mps) * self.over_s
        near = (np.minimum(ahead_m, soon_m) < 20.0) & (np.maximum(ahead_m, soon_m) > -10.0)
        return not np.any(in_lane & near)


class BrakeForPoints:
    """Drives the way of the scenario and brakes for points of a LiDAR before it; it looks `every_s` seconds.

    `lidar`: of the log. `height_m`, `front_m`: the LiDAR above the ground, and the bumper ahead of it.
    """

    def __init__(
        self, lidar: str = "lidar_top", height_m: float = 1.9, front_m: float = 2.5, every_s: float = 0.2
    ) -> None:
        self.lidar, self.height_m, self.front_m, self.every_s = lidar, height_m, front_m, every_s
        self.looked_s, self.gap_m = -np.inf, np.inf

    def reset(self, scenario: Scenario) -> None:
        self.looked_s, self.gap_m = -np.inf, np.inf

    def __call__(self, seen: Observation) -> Controls:
        ego, path = seen.ego, seen.path
        if seen.t_s - self.looked_s > self.every_s - 1e-6:
            x, y, z = seen.sweep(self.lidar).xyz_m.T
            # The way, as the LiDAR sees it.
            c, s = np.cos(ego.yaw_rad), np.sin(ego.yaw_rad)
            dx, dy = path.x_m - ego.x_m, path.y_m - ego.y_m
            ahead_m, left_m = c * dx + s * dy, c * dy - s * dx
            on_way = np.abs(y - np.interp(x, ahead_m, left_m)) < ego.width_m / 2 + 0.2
            on_way &= (x > self.front_m) & (x < 40) & (z > 0.3 - self.height_m) & (z < 0.3)
            near = np.sort(x[on_way] - self.front_m)
            # One point alone may be noise.
            self.looked_s, self.gap_m = seen.t_s, float(near[2]) if len(near) > 2 else np.inf
        left_m = max(self.gap_m - 2.0 - (seen.t_s - self.looked_s) * ego.speed_mps, 0.1)
        needed_mps2 = ego.speed_mps**2 / (2 * left_m)
        accel = hold_speed(ego, float(path.speed_mps[0]))
        return Controls(-min(needed_mps2, FULL_BRAKE_MPS2) if needed_mps2 > 2.0 else accel, steer_along(ego, path))


def hold_speed(ego: EgoState, speed_mps: float) -> float:
    """Acceleration in m/s2 that brings the ego to a speed; the brake at rest."""
    if speed_mps < 0.1 and ego.speed_mps < 0.1:
        return -2.0
    return float(np.clip((speed_mps - ego.speed_mps) / 0.5, -4.0, 2.5))


def steer_along(ego: EgoState, path: PathAhead, left_m: Array | float = 0.0) -> float:
    """Steering angle in rad that leads along the way, or along one that is `left_m` (P,) to its left.

    The curvature of the way a bit ahead, for the wheels take their time, and what brings offset and heading back to it as
    a critically damped oscillator does, in the way driven within 0.6 s.
    """
    x = path.x_m - left_m * np.sin(path.yaw_rad)
    y = path.y_m + left_m * np.cos(path.yaw_rad)
    yaw = np.unwrap(np.arctan2(np.gradient(y), np.gradient(x)))
    ahead = int(0.25 * ego.speed_mps)
    way_m = np.hypot(np.diff(x), np.diff(y))[ahead : ahead + 4].sum()
    curvature = (yaw[ahead + 4] - yaw[ahead]) / way_m if way_m > 0 else 0.0  # a way that ends has no more of it
    offset_m = (y[0] - ego.y_m) * np.cos(yaw[0]) - (x[0] - ego.x_m) * np.sin(yaw[0])
    length_m = max(3.0, 0.6 * ego.speed_mps)
    curvature += offset_m / length_m**2 + 2 * np.sin(yaw[0] - ego.yaw_rad) / length_m
    return float(np.arctan(ego.wheelbase_m * curvature * (1 + ego.understeer_s2pm2 * ego.speed_mps**2)))


def along_path(others: Others, path: PathAhead) -> tuple[Array, Array, Array]:
    """How far ahead on the way, how far left of it, and how fast along it others are: (A,), (A,), (A,)."""
    dx, dy = others.x_m[:, None] - path.x_m, others.y_m[:, None] - path.y_m
    k = np.argmin(np.hypot(dx, dy), axis=1)
    row = np.arange(len(k))
    cos, sin = np.cos(path.yaw_rad[k]), np.sin(path.yaw_rad[k])
    dx, dy = dx[row, k], dy[row, k]
    pace = others.velocity_x_mps * cos + others.velocity_y_mps * sin
    return path.distance_m[k] + dx * cos + dy * sin, dy * cos - dx * sin, pace


def leader(ego: EgoState, others: Others, path: PathAhead) -> tuple[float, float]:
    """Gap in m to the nearest agent on the way and its speed along it; inf and 0 where the way is free."""
    ahead_m, beside_m, pace_mps = along_path(others, path)
    heading = others.yaw_rad - path.yaw_rad[0]
    half_length = (others.length_m * np.abs(np.cos(heading)) + others.width_m * np.abs(np.sin(heading))) / 2
    half_width = (others.length_m * np.abs(np.sin(heading)) + others.width_m * np.abs(np.cos(heading))) / 2
    on_way = (np.abs(beside_m) < half_width + ego.width_m / 2 + 0.2) & (ahead_m > 0)
    if not on_way.any():
        return np.inf, 0.0
    gap_m = np.where(on_way, ahead_m - half_length - ego.length_m / 2, np.inf)
    k = int(np.argmin(gap_m))
    return float(gap_m[k]), float(max(pace_mps[k], 0.0))
