"""The road users of a scene in motion: their states, shapes and appearance at any time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from log2sim.geometry import NS_PER_S, Array, Mount, rotation_from_rpy, transform, wrap_angle
from log2sim.synth import shapes
from log2sim.synth.motion import TimedPath
from log2sim.synth.paint import Appearance
from log2sim.synth.scene import AgentSpec, Ego, Scene
from log2sim.synth.shapes import Mesh

EGO_COLOR = (198, 200, 204)  # as sensors at the roadside see it


@dataclass(frozen=True, eq=False)
class ActorStates:
    """States of an actor at some times."""

    center_m: Array  # (T, 3), m: box centers
    yaw_rad: Array  # (T,), rad
    speed_mps: Array  # (T,), m/s: along the heading
    distance_m: Array  # (T,), m: distance covered

    def map_T_agent(self) -> Array:
        """Poses (T, 4, 4) of the box center."""
        return transform(rotation_from_rpy(0.0, 0.0, self.yaw_rad), self.center_m)


@dataclass(frozen=True, eq=False)
class Actor:
    """One road user of a scene."""

    spec: AgentSpec
    appearance: Appearance
    path: TimedPath | None  # None for a parked one
    parked: tuple[float, float, float] | None = None  # x, y in m and heading in rad of a parked one
    offset_m: float = 0.0  # distance from the guided point forward to the box center

    def at(self, t_s: ArrayLike) -> ActorStates:
        """States at times (T,) in s since the start of the log."""
        t = np.atleast_1d(np.asarray(t_s, dtype=np.float64))
        if self.path is not None:
            xy, yaw, speed, distance = self.path.at(t)
        else:
            x, y, heading = self.parked or (0.0, 0.0, 0.0)
            xy, yaw = np.tile([x, y], (len(t), 1)), np.full(len(t), heading)
            speed, distance = np.zeros(len(t)), np.zeros(len(t))
        xy = xy + self.offset_m * np.stack([np.cos(yaw), np.sin(yaw)], 1)
        center = np.column_stack([xy, np.full(len(t), self.spec.box_m[2] / 2)])
        return ActorStates(center, yaw, speed, distance)

    def map_T_axle(self, t_s: ArrayLike) -> Array:
        """Poses (T, 4, 4) of the guided point of what moves, the rear axle of vehicles, on the ground."""
        assert self.path is not None
        motion = self.path.at(t_s)
        position = np.column_stack([motion.xy_m, np.zeros(len(motion.xy_m))])
        return transform(rotation_from_rpy(0.0, 0.0, motion.yaw_rad), position)

    def mesh(self, t_s: float) -> Mesh:
        """Return the shape at a time, agent frame."""
        size, category, seed = self.spec.box_m, self.spec.category, self.appearance.seed
        if category == "car":
            return shapes.car(size, self.spec.shape)
        if category in ("truck", "bus"):
            return shapes.truck(size) if category == "truck" else shapes.bus(size)
        stride_m = shapes.PEDAL_M if category == "cyclist" else shapes.STRIDE_M * size[2] / 1.75
        turn = self.at(t_s).distance_m[0] / stride_m + seed / 7
        phase = int(np.floor(turn * shapes.PHASES)) % shapes.PHASES
        return (
            shapes.cyclist(size, phase) if category == "cyclist" else shapes.pedestrian(size, phase, self.path is None)
        )


def _actor(spec: AgentSpec, index: int) -> Actor:
    appearance = Appearance(
        spec.category, spec.box_m, spec.color, spec.shape, spec.second_color, spec.skin, spec.hair, seed=index
    )
    if spec.pose is not None:
        x, y, yaw_deg = spec.pose
        return Actor(spec, appearance, None, (x, y, float(wrap_angle(np.deg2rad(yaw_deg)))))
    rounding = spec.rounding_m if spec.rounding_m is not None else (25.0 if spec.vehicle else 3.0)
    path = _path(spec, rounding, f"agent '{spec.id}'", vehicle=spec.vehicle)
    return Actor(spec, appearance, path, offset_m=spec.rear_axle_offset_m)


def _path(spec: Ego | AgentSpec, rounding_m: float, where: str, *, vehicle: bool) -> TimedPath:
    waits = [(int(k), s) for k, s in spec.wait_s]
    return TimedPath(
        spec.waypoints, rounding_m=rounding_m, wait_s=waits, start_s=spec.start_s, where=where, vehicle=vehicle
    )


@dataclass(frozen=True, eq=False)
class MovingScene:
    """A scene with the motion of everything in it."""

    scene: Scene
    ego: Actor | None
    actors: tuple[Actor, ...]  # without the ego

    @classmethod
    def of(cls, scene: Scene) -> MovingScene:
        """Set a scene in motion."""
        ego = None
        if scene.ego is not None:
            path = _path(scene.ego, scene.ego.rounding_m, "ego", vehicle=True)
            # The id "ego" is refused in scene files, so nothing is validated here.
            size, offset_m = scene.ego.size_m, scene.ego.rear_axle_offset_m
            spec = AgentSpec.model_construct(id="ego", category="car", size_m=size, color=EGO_COLOR, shape="sedan")
            ego = Actor(spec, Appearance("car", size, EGO_COLOR, "sedan"), path, offset_m=offset_m)
        return cls(scene, ego, tuple(_actor(spec, i) for i, spec in enumerate(scene.agent)))

    def map_T_mount(self, mount: Mount, t_ns: NDArray[np.int64]) -> Array:
        """Poses (T, 4, 4) of what a sensor is fixed to, at absolute stamps (T,)."""
        if mount == "map" or self.ego is None:
            return np.repeat(np.eye(4)[None], len(t_ns), axis=0)
        return self.ego.map_T_axle((np.asarray(t_ns, np.int64) - self.scene.start_ns) / NS_PER_S)

    def seen_from(self, mount: Mount) -> tuple[Actor, ...]:
        """List all that a sensor can see: the actors, and as the last the ego where the sensor is not on it."""
        return self.actors if mount == "ego" or self.ego is None else (*self.actors, self.ego)

    def seconds(self, t_ns: int) -> float:
        """Time in s since the start of the log."""
        return (int(t_ns) - self.scene.start_ns) / NS_PER_S
