"""The road users of a scene in motion along smooth paths: their states, shapes and appearance at any time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from log2sim.errors import ConfigError
from log2sim.geometry import NS_PER_S, Array, Mount, rotation_from_rpy, transform, wrap_angle
from log2sim.synth import shapes
from log2sim.synth.scene import AgentSpec, Ego, Scene
from log2sim.synth.shapes import Mesh

STEP_M = 0.05  # sampling of the polyline that is smoothed
MAX_CURVATURE_1PM = 0.25
MAX_ACCELERATION_MPS2 = 3.0
FIRST_LEG_S = -1e4  # begin of the leg before the first waypoint


class PathStates(NamedTuple):
    """States of the guided point at asked times."""

    xy_m: Array  # (T, 2), m
    yaw_rad: Array  # (T,), rad
    speed_mps: Array  # (T,), m/s
    distance_m: Array  # (T,), m: arc length from the first waypoint


class RoundedPath:
    """A smooth curve along waypoints (W, 2), parametrized by arc length and straight beyond its ends.

    The polyline is averaged twice over a window of `rounding_m`: corners become curves whose curvature grows and falls
    linearly, like a pair of clothoids, straight parts stay straight, and nothing overshoots. A turn by 90 degrees peaks at
    a curvature of about 5.7 / rounding_m.
    """

    def __init__(self, waypoints: Array, rounding_m: float) -> None:
        from scipy.interpolate import CubicSpline

        chord = np.linalg.norm(np.diff(waypoints, axis=0), axis=1)
        at = np.concatenate([[0.0], np.cumsum(chord)])
        s = np.arange(-rounding_m - 1.0, at[-1] + rounding_m + 1.0, STEP_M)
        first, last = ((waypoints[k + 1] - waypoints[k]) / (at[k + 1] - at[k]) for k in (0, len(at) - 2))
        line = np.stack([np.interp(s, at, column) for column in waypoints.T], 1)
        line = line + first * np.minimum(s - at[0], 0)[:, None] + last * np.maximum(s - at[-1], 0)[:, None]
        window = max(1, round(rounding_m / 2 / STEP_M) | 1)
        kernel = np.convolve(np.ones(window), np.ones(window))
        if window > 1:
            line = np.stack([np.convolve(line[:, k], kernel / kernel.sum(), "valid") for k in (0, 1)], 1)
            s = s[window - 1 : -(window - 1)]
        length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
        length -= np.interp(0.0, s, length)
        self.at_waypoint_m = np.interp(at, s, length)
        self._spline = CubicSpline(length[::4], line[::4])
        self._ends = (length[0], length[::4][-1])
        self.length_m = float(self.at_waypoint_m[-1])

    def at(self, distance_m: ArrayLike) -> tuple[Array, Array]:
        """Points (T, 2) and headings (T,) at arc lengths `distance_m` (T,) from the first waypoint."""
        distance = np.asarray(distance_m, dtype=np.float64)
        inside = np.clip(distance, *self._ends)
        tangent = self._spline(inside, 1)
        tangent /= np.linalg.norm(tangent, axis=-1, keepdims=True)
        return self._spline(inside) + tangent * (distance - inside)[:, None], np.arctan2(tangent[:, 1], tangent[:, 0])

    def curvature_1pm(self) -> Array:
        """Curvature each 0.1 m."""
        s = np.arange(self._ends[0], self._ends[1], 0.1)
        d, dd = self._spline(s, 1), self._spline(s, 2)
        return np.asarray((d[:, 0] * dd[:, 1] - d[:, 1] * dd[:, 0]) / np.linalg.norm(d, axis=1) ** 3)


class TimedPath:
    """A path with a timetable; between waypoints the speed is a smoothstep, so the acceleration is continuous.

    `waypoints` (W, 3): x, y in m and the speed there in m/s. `wait_s`: how long to stand at a waypoint, by its index;
    its speed must be 0. `start_s`: time at the first waypoint; before that the agent stands (speed 0) or comes
    straight. `where`: names the agent in messages.
    """

    def __init__(
        self,
        waypoints: ArrayLike,
        *,
        rounding_m: float,
        wait_s: Sequence[tuple[int, float]] = (),
        start_s: float = 0.0,
        where: str,
        vehicle: bool = True,
    ) -> None:
        w = np.asarray(waypoints, dtype=np.float64)
        if w.ndim != 2 or w.shape[1] != 3 or len(w) < 2:
            raise ConfigError(
                f"{where}: waypoints must be two or more rows [x, y, speed]; for a static agent give 'pose'"
            )
        step = np.linalg.norm(np.diff(w[:, :2], axis=0), axis=1)
        if np.any(step < 1e-3):
            raise ConfigError(
                f"{where}: waypoints {int(step.argmin())} and {int(step.argmin()) + 1} are the same point; use 'wait_s' to stand"
            )
        if np.any(w[:, 2] < 0):
            raise ConfigError(f"{where}: waypoint {int(w[:, 2].argmin())} has a negative speed")
        for index, _ in wait_s:
            if not 0 <= index < len(w) or w[index, 2] != 0:
                raise ConfigError(f"{where}: wait_s names waypoint {index}, which must exist and have speed 0")
        self.path = RoundedPath(w[:, :2], rounding_m)
        if vehicle:
            peak = float(np.abs(self.path.curvature_1pm()).max())
            if peak > MAX_CURVATURE_1PM:
                raise ConfigError(
                    f"{where}: the path bends with {peak:.2f} 1/m, a vehicle manages {MAX_CURVATURE_1PM}; "
                    "raise rounding_m or spread the waypoints of the turn"
                )
        # Legs (L, 5): begin in s, duration in s (inf: constant speed from here on), arc length in m, speeds at begin and end.
        at_m, speed, waits, now = self.path.at_waypoint_m, w[:, 2], dict(wait_s), start_s
        legs = [(FIRST_LEG_S, np.inf, at_m[0] - speed[0] * (start_s - FIRST_LEG_S), speed[0], speed[0])]
        for k in range(len(at_m) - 1):
            if k in waits:
                legs.append((now, waits[k], at_m[k], 0.0, 0.0))
                now += waits[k]
            v0, v1, length = speed[k], speed[k + 1], at_m[k + 1] - at_m[k]
            if v0 + v1 <= 0:
                raise ConfigError(
                    f"{where}: waypoints {k} and {k + 1} both have speed 0, so the path between them takes forever"
                )
            span = 2 * length / (v0 + v1)
            peak = 1.5 * abs(v1 - v0) / span
            if peak > MAX_ACCELERATION_MPS2 * (1 + 1e-9):
                raise ConfigError(
                    f"{where}: from waypoint {k} to {k + 1} the speed changes with {peak:.1f} m/s2, at most "
                    f"{MAX_ACCELERATION_MPS2:g} is allowed; give the change more distance"
                )
            legs.append((now, span, at_m[k], v0, v1))
            now += span
        self._legs = np.array([*legs, (now, np.inf, at_m[-1], speed[-1], speed[-1])])

    def at(self, t_s: ArrayLike) -> PathStates:
        """States at times (T,) in s since the start of the log."""
        t = np.atleast_1d(np.asarray(t_s, dtype=np.float64))
        begin, span, start_m, v0, v1 = (self._legs[:, k] for k in range(5))
        i = np.clip(np.searchsorted(begin, t, side="right") - 1, 0, len(begin) - 1)
        finite = np.isfinite(span[i])
        u = np.where(finite, (t - begin[i]) / np.where(finite, span[i], 1.0), 0.0)
        dv = v1[i] - v0[i]
        speed = np.where(finite, v0[i] + dv * (3 * u**2 - 2 * u**3), v0[i])
        timed = np.where(finite, span[i], 0.0) * (v0[i] * u + dv * (u**3 - u**4 / 2))
        moved = np.where(finite, timed, v0[i] * (t - begin[i]))
        distance = start_m[i] + moved
        xy, yaw = self.path.at(distance)
        return PathStates(xy, wrap_angle(yaw), speed, distance)


EGO_COLOR = (198, 200, 204)  # as sensors at the roadside see it


@dataclass(frozen=True, eq=False)
class ActorStates:
    """States of an actor at T times."""

    center_m: Array  # (T, 3): box centers
    yaw_rad: Array
    speed_mps: Array  # along the heading
    distance_m: Array  # covered

    def map_T_agent(self) -> Array:
        """Poses (T, 4, 4) of the box center."""
        return transform(rotation_from_rpy(0.0, 0.0, self.yaw_rad), self.center_m)


@dataclass(frozen=True, eq=False)
class Actor:
    """One road user of a scene."""

    spec: AgentSpec
    path: TimedPath | None  # None for a parked one
    parked: tuple[float, float, float] = (0.0, 0.0, 0.0)  # x, y in m and heading in rad of a parked one
    offset_m: float = 0.0  # distance from the guided point forward to the box center
    seed: int = 0  # of its steps and of the folds of its clothes

    def at(self, t_s: ArrayLike) -> ActorStates:
        """States at times (T,) in s since the start of the log."""
        t = np.atleast_1d(np.asarray(t_s, dtype=np.float64))
        if self.path is not None:
            xy, yaw, speed, distance = self.path.at(t)
        else:
            x, y, heading = self.parked
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
        size, category = self.spec.box_m, self.spec.category
        if category == "car":
            return shapes.car(size, self.spec.shape)
        if category in ("truck", "bus"):
            return shapes.truck(size) if category == "truck" else shapes.bus(size)
        stride_m = shapes.PEDAL_M if category == "cyclist" else shapes.STRIDE_M * size[2] / 1.75
        turn = self.at(t_s).distance_m[0] / stride_m + self.seed / 7
        phase = int(np.floor(turn * shapes.PHASES)) % shapes.PHASES
        standing = self.path is None
        return shapes.cyclist(size, phase) if category == "cyclist" else shapes.pedestrian(size, phase, standing)


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
            ego = Actor(spec, path, offset_m=offset_m)
        actors = []
        for index, spec in enumerate(scene.agent):
            if spec.pose is not None:
                x, y, yaw_deg = spec.pose
                actors.append(Actor(spec, None, (x, y, float(wrap_angle(np.deg2rad(yaw_deg)))), seed=index))
                continue
            rounding = spec.rounding_m if spec.rounding_m is not None else (25.0 if spec.vehicle else 3.0)
            path = _path(spec, rounding, f"agent '{spec.id}'", vehicle=spec.vehicle)
            actors.append(Actor(spec, path, offset_m=spec.rear_axle_offset_m, seed=index))
        return cls(scene, ego, tuple(actors))

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
