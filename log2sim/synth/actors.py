"""The road users of a scene in motion: their states, shapes and looks at any time."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from log2sim.geometry import NS_PER_S, Array, rotation_from_rpy, transform, wrap_angle
from log2sim.synth import people, vehicles
from log2sim.synth.motion import Motion, Trajectory
from log2sim.synth.paint import Look
from log2sim.synth.scene import AgentSpec, Scene
from log2sim.synth.shapes import Mesh


@dataclass(frozen=True, eq=False)
class States:
    """Box centers (T, 3), headings (T,), speeds along the heading (T,) and ways gone (T,)."""

    center_m: Array
    yaw_rad: Array
    speed_mps: Array
    way_m: Array

    def map_T_agent(self) -> Array:
        """Poses (T, 4, 4) of the box center."""
        return transform(rotation_from_rpy(0.0, 0.0, self.yaw_rad), self.center_m)


@dataclass(frozen=True, eq=False)
class Actor:
    """One road user of a scene."""

    spec: AgentSpec
    look: Look
    trajectory: Trajectory | None
    parked: tuple[float, float, float] | None = None
    offset_m: float = field(default=0.0)

    def at(self, t_s: ArrayLike) -> States:
        """States at times (T,) in s since the start of the log."""
        t = np.atleast_1d(np.asarray(t_s, dtype=np.float64))
        motion = self._motion(t)
        heading = np.stack([np.cos(motion.yaw_rad), np.sin(motion.yaw_rad)], 1)
        xy = motion.xy_m + self.offset_m * heading
        center = np.column_stack([xy, np.full(len(t), self.spec.box_m[2] / 2)])
        return States(center, motion.yaw_rad, motion.speed_mps, motion.way_m)

    def _motion(self, t: Array) -> Motion:
        if self.trajectory is not None:
            return self.trajectory.at(t)
        x, y, yaw = self.parked or (0.0, 0.0, 0.0)
        n = len(t)
        return Motion(np.tile([x, y], (n, 1)), np.full(n, yaw), np.zeros(n), np.zeros(n))

    def mesh(self, t_s: float) -> Mesh:
        """The shape at a time, agent frame."""
        size, category = self.spec.box_m, self.spec.category
        if category == "car":
            return vehicles.car(size, self.spec.shape)
        if category == "truck":
            return vehicles.truck(size)
        if category == "bus":
            return vehicles.bus(size)
        state = self.at(t_s)
        if category == "cyclist":
            turn = state.way_m[0] / people.PEDAL_M + self.look.seed / 7
            return people.cyclist(size, int(np.floor(turn * people.PHASES)) % people.PHASES)
        turn = state.way_m[0] / (people.STRIDE_M * size[2] / 1.75) + self.look.seed / 7
        phase = int(np.floor(turn * people.PHASES)) % people.PHASES
        return people.pedestrian(size, phase, self.trajectory is None)


def actors_of(scene: Scene) -> tuple[Actor, ...]:
    """The actors of a scene in its order."""
    return tuple(_actor(spec, i) for i, spec in enumerate(scene.agent))


def _actor(spec: AgentSpec, index: int) -> Actor:
    look = Look(spec.category, spec.box_m, spec.color, spec.shape, spec.second_color, spec.skin, spec.hair, seed=index)
    if spec.pose is not None:
        x, y, yaw_deg = spec.pose
        return Actor(spec, look, None, (x, y, float(wrap_angle(np.deg2rad(yaw_deg)))))
    rounding = spec.rounding_m if spec.rounding_m is not None else (25.0 if spec.vehicle else 3.0)
    trajectory = Trajectory(
        spec.waypoints,
        rounding_m=rounding,
        wait_s=[(int(k), s) for k, s in spec.wait_s],
        start_s=spec.start_s,
        where=f"agent '{spec.id}'",
        vehicle=spec.vehicle,
    )
    return Actor(spec, look, trajectory, offset_m=spec.rear_axle_offset_m)


class EgoMotion:
    """The exact motion of the recording vehicle."""

    def __init__(self, scene: Scene) -> None:
        ego = scene.ego
        self._start_ns = scene.start_ns
        self.trajectory = Trajectory(
            ego.waypoints,
            rounding_m=ego.rounding_m,
            wait_s=[(int(k), s) for k, s in ego.wait_s],
            start_s=ego.start_s,
            where="ego",
        )

    def map_T_ego(self, t_s: ArrayLike) -> Array:
        """Poses (T, 4, 4) of the rear axle on the ground at times (T,) in s since the start."""
        motion = self.trajectory.at(t_s)
        position = np.column_stack([motion.xy_m, np.zeros(len(motion.xy_m))])
        return transform(rotation_from_rpy(0.0, 0.0, motion.yaw_rad), position)

    def map_T_ego_ns(self, t_ns: NDArray[np.int64]) -> Array:
        """The same at absolute stamps."""
        return self.map_T_ego((np.asarray(t_ns, np.int64) - self._start_ns) / NS_PER_S)
