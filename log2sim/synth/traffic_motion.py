"""Random traffic over seconds: everybody keeps to his arc and keeps his distance to what is ahead."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from log2sim.geometry import Array, rotation_from_rpy
from log2sim.synth.polytope_hits import SensorState
from log2sim.synth.traffic import TrafficObject, TrafficScene

STEP_S = 0.1
# Intelligent driver model (Treiber, Hennecke, Helbing 2000): usual values for city traffic.
ACCELERATION_MPS2, DECELERATION_MPS2, HEADWAY_S, STANDSTILL_M = 1.5, 2.5, 1.2, 1.5
MAX_BRAKING_MPS2 = 9.0
SIDE_MARGIN_M = 0.25
MAX_ROAD_ANGLE_RAD = 0.2  # between the sensor's car and a road that it follows
CAR_SIZE_M = (4.4, 1.8, 1.5)
CAR_AHEAD_M = 0.3  # of the car's middle before its LiDAR


@dataclass(frozen=True, eq=False)
class TrafficRun:
    """A random scene over time.

    Attributes
    ----------
    scene : TrafficScene
        At time 0.
    ego : TrafficObject or None
        The sensor's car; None at the roadside.
    distance_m : (S, M) float64, m
        Way that each object, and as the last the sensor's car, has gone after each `STEP_S`.
    """

    scene: TrafficScene
    ego: TrafficObject | None
    distance_m: Array

    def at(self, t_s: float) -> TrafficScene:
        """Return the scene at a time since its begin."""
        distance, speed = self._gone(t_s)
        objects = [_moved(o, d, v, self.scene) for o, d, v in zip(self.scene.objects, distance, speed)]
        if self.ego is None:
            return replace(self.scene, objects=tuple(objects))
        start = self.scene.sensor
        ego = _moved(self.ego, distance[-1], speed[-1], self.scene)
        turned = rotation_from_rpy(0.0, 0.0, ego.yaw_rad - self.ego.yaw_rad)
        heading = np.array([np.cos(ego.yaw_rad), np.sin(ego.yaw_rad)])
        xy = ego.position_m[:2] - CAR_AHEAD_M * heading
        # Springs take waves and kerbs, so the sensor follows the slope alone.
        x, y = np.append(xy, start.position_m[:2]).astype(np.float32).reshape(2, 2).T
        rise = np.diff(self.scene.surface.height(x, y))[0]
        sensor = SensorState(turned @ start.rotation, np.append(xy, start.position_m[2] - rise), speed[-1] * heading)
        kept = [replace(o, position_m=np.append(xy, -rise), yaw_rad=ego.yaw_rad, speed_mps=speed[-1]) if o.kind == "own car" else o
                for o in objects]  # fmt: skip
        return replace(self.scene, objects=tuple(kept), sensor=sensor)

    def _gone(self, t_s: float) -> tuple[Array, Array]:
        position = min(max(t_s / STEP_S, 0.0), len(self.distance_m) - 1.000001)
        k = int(position)
        step = self.distance_m[k + 1] - self.distance_m[k]
        return self.distance_m[k] + (position - k) * step, step / STEP_S


def run_of(scene: TrafficScene, duration_s: float) -> TrafficRun:
    """Let a scene run: arcs as at time 0, speeds by the intelligent driver model."""
    ego = None if scene.mount == "roadside" else _own_car(scene)
    movers = [*scene.objects, *([] if ego is None else [ego])]
    count = int(np.ceil(duration_s / STEP_S)) + 2
    distance = np.zeros((count, len(movers)))
    wish = np.array([o.speed_mps for o in movers])
    speed = wish.copy()
    users = np.flatnonzero([bool(o.category) for o in movers])
    for k in range(1, count):
        distance[k] = distance[k - 1] + speed * STEP_S
        places = [_moved(movers[i], distance[k, i], speed[i], None) for i in users]
        rate = _acceleration(places, speed[users], wish[users])
        speed[users] = np.clip(speed[users] + rate * STEP_S, 0.0, np.maximum(wish[users], 0.0))
    return TrafficRun(scene, ego, distance)


def _own_car(scene: TrafficScene) -> TrafficObject:
    R, position = scene.sensor.rotation, scene.sensor.position_m
    yaw = float(np.arctan2(R[1, 0], R[0, 0]))
    speed = float(np.hypot(*scene.sensor.velocity_mps))
    middle = np.append(position[:2] + CAR_AHEAD_M * np.array([np.cos(yaw), np.sin(yaw)]), 0.0)
    along = np.cos(yaw - scene.roads[0].yaw_rad)
    follows = abs(along) > np.cos(MAX_ROAD_ANGLE_RAD)
    turn = speed * scene.roads[0].curvature_per_m * float(np.sign(along)) if follows else 0.0
    return TrafficObject("car", middle, yaw, CAR_SIZE_M, (), speed, turn)


def _moved(item: TrafficObject, distance_m: float, speed_mps: float, scene: TrafficScene | None) -> TrafficObject:
    """Move an object along its arc; with a scene also up and down with the ground."""
    if item.speed_mps == 0 or item.kind == "own car":
        return item
    position, yaw = item.pose_at(distance_m / item.speed_mps)
    if scene is not None and item.category:
        position[2] = scene.surface.elevation(position)
    turn = item.turn_radps * speed_mps / item.speed_mps
    return replace(item, position_m=position, yaw_rad=yaw, speed_mps=speed_mps, turn_radps=turn)


def _acceleration(places: list[TrafficObject], speed: Array, wish: Array) -> Array:
    """Accelerations (M,) of road users that keep their distance to what is in their way."""
    xy = np.array([o.position_m[:2] for o in places]).reshape(-1, 2)
    yaw = np.array([o.yaw_rad for o in places])
    size = np.array([o.size_m[:2] for o in places]).reshape(-1, 2)
    heading = np.stack([np.cos(yaw), np.sin(yaw)], 1)
    offset = xy[None] - xy[:, None]
    ahead = np.einsum("ijk,ik->ij", offset, heading)
    aside = np.abs(offset[..., 1] * heading[:, None, 0] - offset[..., 0] * heading[:, None, 1])
    c, s = np.abs(np.cos(yaw[None] - yaw[:, None])), np.abs(np.sin(yaw[None] - yaw[:, None]))
    half_along, half_across = (c * size[:, 0] + s * size[:, 1]) / 2, (s * size[:, 0] + c * size[:, 1]) / 2
    gap = ahead - half_along - size[:, None, 0] / 2
    in_way = (ahead > 0) & (aside < half_across + size[:, None, 1] / 2 + SIDE_MARGIN_M)
    np.fill_diagonal(in_way, val=False)
    closing = speed[:, None] - speed[None] * np.cos(yaw[None] - yaw[:, None])
    approach = speed[:, None] * closing / (2 * np.sqrt(ACCELERATION_MPS2 * DECELERATION_MPS2))
    wanted = STANDSTILL_M + speed[:, None] * HEADWAY_S + approach
    pressure = np.where(in_way, (np.maximum(wanted, 0.0) / np.maximum(gap, 0.2)) ** 2, 0.0).max(1, initial=0.0)
    free = 1 - (speed / np.maximum(wish, 0.1)) ** 4
    return np.asarray(np.maximum(ACCELERATION_MPS2 * (free - pressure), -MAX_BRAKING_MPS2))
