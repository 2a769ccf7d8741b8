"""The road users of a scene in motion: their states, shapes and appearance at any time."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from log2sim.geometry import NS_PER_S, Array, Mount, rotation_from_rpy, transform, wrap_angle
from log2sim.synth import shapes
from log2sim.synth.motion import PathStates, TimedPath
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
    # x, y in m and heading in rad of a parked one
    parked: tuple[float, float, float] | None = None
    offset_m: float = field(default=0.0)  # distance from the guided point forward to the box center

    def at(self, t_s: ArrayLike) -> ActorStates:
        """States at times (T,) in s since the start of the log."""
        t = np.atleast_1d(np.asarray(t_s, dtype=np.float64))
        motion = self._motion(t)
        heading = np.stack([np.cos(motion.yaw_rad), np.sin(motion.yaw_rad)], 1)
        xy = motion.xy_m + self.offset_m * heading
        center = np.column_stack([xy, np.full(len(t), self.spec.box_m[2] / 2)])
        return ActorStates(center, motion.yaw_rad, motion.speed_mps, motion.distance_m)

    def _motion(self, t: Array) -> PathStates:
        if self.path is not None:
            return self.path.at(t)
        x, y, yaw = self.parked or (0.0, 0.0, 0.0)
        n = len(t)
        return PathStates(np.tile([x, y], (n, 1)), np.full(n, yaw), np.zeros(n), np.zeros(n))

    def mesh(self, t_s: float) -> Mesh:
        """Return the shape at a time, agent frame."""
        size, category = self.spec.box_m, self.spec.category
        if category == "car":
            return shapes.car(size, self.spec.shape)
        if category == "truck":
            return shapes.truck(size)
        if category == "bus":
            return shapes.bus(size)
        state = self.at(t_s)
        if category == "cyclist":
            turn = state.distance_m[0] / shapes.PEDAL_M + self.appearance.seed / 7
            return shapes.cyclist(size, int(np.floor(turn * shapes.PHASES)) % shapes.PHASES)
        turn = state.distance_m[0] / (shapes.STRIDE_M * size[2] / 1.75) + self.appearance.seed / 7
        phase = int(np.floor(turn * shapes.PHASES)) % shapes.PHASES
        return shapes.pedestrian(size, phase, self.path is None)


def _actor(spec: AgentSpec, index: int) -> Actor:
    appearance = Appearance(
        spec.category, spec.box_m, spec.color, spec.shape, spec.second_color, spec.skin, spec.hair, seed=index
    )
    if spec.pose is not None:
        x, y, yaw_deg = spec.pose
        return Actor(spec, appearance, None, (x, y, float(wrap_angle(np.deg2rad(yaw_deg)))))
    rounding = spec.rounding_m if spec.rounding_m is not None else (25.0 if spec.vehicle else 3.0)
    path = TimedPath(
        spec.waypoints,
        rounding_m=rounding,
        wait_s=[(int(k), s) for k, s in spec.wait_s],
        start_s=spec.start_s,
        where=f"agent '{spec.id}'",
        vehicle=spec.vehicle,
    )
    return Actor(spec, appearance, path, offset_m=spec.rear_axle_offset_m)


class EgoMotion:
    """The exact motion of the recording vehicle."""

    def __init__(self, ego: Ego, start_ns: int) -> None:
        self._start_ns = start_ns
        self.path = TimedPath(
            ego.waypoints,
            rounding_m=ego.rounding_m,
            wait_s=[(int(k), s) for k, s in ego.wait_s],
            start_s=ego.start_s,
            where="ego",
        )

    def map_T_ego(self, t_s: ArrayLike) -> Array:
        """Poses (T, 4, 4) of the rear axle on the ground at times (T,) in s since the start."""
        motion = self.path.at(t_s)
        position = np.column_stack([motion.xy_m, np.zeros(len(motion.xy_m))])
        return transform(rotation_from_rpy(0.0, 0.0, motion.yaw_rad), position)

    def map_T_ego_ns(self, t_ns: NDArray[np.int64]) -> Array:
        """Poses (T, 4, 4) at absolute stamps (T,)."""
        return self.map_T_ego((np.asarray(t_ns, np.int64) - self._start_ns) / NS_PER_S)


@dataclass(frozen=True, eq=False)
class MovingScene:
    """A scene with the motion of everything in it."""

    scene: Scene
    ego: EgoMotion | None
    actors: tuple[Actor, ...]  # without the ego
    ego_body: Actor | None  # the ego as others see it

    @classmethod
    def of(cls, scene: Scene) -> MovingScene:
        """Set a scene in motion."""
        motion = None if scene.ego is None else EgoMotion(scene.ego, scene.start_ns)
        body = None
        if scene.ego is not None and motion is not None:
            # The id "ego" is refused in scene files, so nothing is validated here.
            size, offset_m = scene.ego.size_m, scene.ego.rear_axle_offset_m
            spec = AgentSpec.model_construct(id="ego", category="car", size_m=size, color=EGO_COLOR, shape="sedan")
            body = Actor(spec, Appearance("car", size, EGO_COLOR, "sedan"), motion.path, offset_m=offset_m)
        return cls(scene, motion, tuple(_actor(spec, i) for i, spec in enumerate(scene.agent)), body)

    def map_T_mount(self, mount: Mount, t_ns: NDArray[np.int64]) -> Array:
        """Poses (T, 4, 4) of what a sensor is fixed to, at absolute stamps (T,)."""
        if mount == "map" or self.ego is None:
            return np.repeat(np.eye(4)[None], len(t_ns), axis=0)
        return self.ego.map_T_ego_ns(t_ns)

    def seen_from(self, mount: Mount) -> tuple[Actor, ...]:
        """List all that a sensor can see: the actors, and as the last the ego where the sensor is not on it."""
        return self.actors if mount == "ego" or self.ego_body is None else (*self.actors, self.ego_body)

    def seconds(self, t_ns: int) -> float:
        """Time in s since the start of the log."""
        return (int(t_ns) - self.scene.start_ns) / NS_PER_S
