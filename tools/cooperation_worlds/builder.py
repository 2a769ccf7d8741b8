"""Puts a world together in a frame of its own and lays it anywhere in the map, for right-hand and left-hand traffic."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cooperation_worlds.world import ROAD_LIDAR, VEHICLE_LIDAR, Array, Parts, World, rigid
from log2sim.geometry import wrap_angle
from log2sim.synth.polytope_caster import Solid
from log2sim.synth.polytopes import Shape
from log2sim.synth.scene import Scene
from log2sim.synth.traffic_shapes import ROAD_USERS, SMALL

# The sensors of the paper: at 2 m with a range of 20 m on the vehicle, at 3 m with 40 m at the road.
VEHICLE_HEIGHT_M, VEHICLE_RANGE_M = 2.0, 20.0
ROAD_HEIGHT_M, ROAD_RANGE_M = 3.0, 40.0
# Lines and steps of sensors on the market; at crossings denser ones are mounted than on cars (DAIR-V2X: 300 lines and 40).
VEHICLE_LINES, ROAD_LINES = (32, 40, 64), (40, 64, 80)
STEPS_DEG = (0.25, 0.3, 0.4)
LIDAR_AHEAD_M = 1.2  # of the rear axle
MAX_TRIES = 400


@dataclass(eq=False)
class Builder:
    """What has been put into a world, in a frame with right-hand traffic.

    Attributes
    ----------
    test : str
    seed : int
    rng : Generator
    """

    test: str
    seed: int
    rng: np.random.Generator
    agents: list[dict[str, Any]] = field(default_factory=list)
    roads: list[dict[str, Any]] = field(default_factory=list)
    houses: list[dict[str, Any]] = field(default_factory=list)
    lidars: list[dict[str, Any]] = field(default_factory=list)
    parts: dict[str, Parts] = field(default_factory=dict)
    ego: dict[str, Any] = field(default_factory=dict)
    things: list[tuple[Parts, Array, float]] = field(default_factory=list)

    def drive_ego(self, waypoints: Array, **more: Any) -> None:
        """Let the ego, a car of random shape, drive along waypoints (W, 3: x, y, speed) of its box's center at time 0."""
        (length, width, height), parts = ROAD_USERS["car"](self.rng)
        while length > 5.2 or height > VEHICLE_HEIGHT_M - 0.1:
            (length, width, height), parts = ROAD_USERS["car"](self.rng)
        self.parts["ego"] = parts
        self.ego = {
            "waypoints": waypoints,
            "size_m": _rounded((length, width, height)),
            "rear_axle_offset_m": round(0.3 * length, 3),
            **more,
        }

    def add(self, name: str, shape: Shape, category: str, **place: Any) -> None:
        """Add a road user of a shape, parked at `pose` (x, y, degrees) or moving along `waypoints`."""
        size, parts = shape
        self.parts[name] = parts
        self.agents.append({"id": name, "category": category, "size_m": _rounded(size), **place})

    def draw_shape(self, category: str) -> Shape:
        """Draw the shape of a road user."""
        return ROAD_USERS[category](self.rng)

    def scatter(self, line: Any, edge_m: float) -> None:
        """Put trees, posts, bins and the like beside both sides of a line (P, 2), farther from it than `edge_m`."""
        rng, line = self.rng, np.asarray(line, np.float64)
        kinds, shares = list(SMALL), np.array([v[0] for v in SMALL.values()])
        length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
        for _ in range(int(rng.poisson(length[-1] / 5.0))):
            s = float(rng.uniform(0, length[-1]))
            k = int(np.clip(np.searchsorted(length, s) - 1, 0, len(line) - 2))
            along = (line[k + 1] - line[k]) / (length[k + 1] - length[k])
            kind = str(rng.choice(kinds, p=shares / shares.sum()))
            side = float(rng.choice([-1, 1])) * (edge_m + SMALL[kind][1] + float(rng.exponential(3.0)))
            xy = line[k] + along * (s - length[k]) + side * np.array([-along[1], along[0]])
            # Nothing stands on another road or path.
            if np.linalg.norm(line - xy, axis=1).min() > min(edge_m, abs(side)) - 1.0:
                self.things.append((SMALL[kind][2](rng), xy, float(np.arctan2(along[1], along[0]))))

    def add_sensors(self, pole_xy: Sequence[float], looks_to: Sequence[float]) -> None:
        """Mount a LiDAR on the ego and one on a pole."""
        rng = self.rng
        self.lidars = [
            {
                "name": VEHICLE_LIDAR, "position_m": [LIDAR_AHEAD_M, 0.0, VEHICLE_HEIGHT_M], "range_m": VEHICLE_RANGE_M,
                "channels": int(rng.choice(VEHICLE_LINES)), "elevation_deg": [-25.0, 5.0],
                "azimuth_step_deg": float(rng.choice(STEPS_DEG)),
            },
            {
                "name": ROAD_LIDAR, "mount": "map", "position_m": [*pole_xy, ROAD_HEIGHT_M], "range_m": ROAD_RANGE_M,
                "yaw_deg": float(np.rad2deg(np.arctan2(looks_to[1] - pole_xy[1], looks_to[0] - pole_xy[0]))),
                "channels": int(rng.choice(ROAD_LINES)), "elevation_deg": [-25.0, 5.0],
                "azimuth_step_deg": float(rng.choice(STEPS_DEG)),
                "offset_s": round(float(rng.uniform(0.0, 0.1)), 3),
            },
        ]  # fmt: skip

    def world(self, duration_s: float, target: str, contact_s: float = float("nan")) -> World:
        """Lay everything in the map: mirrored for left-hand traffic in three of ten worlds, turned and moved."""
        rng = np.random.default_rng([self.seed, 6])
        lay = _Placement(bool(rng.random() < 0.3), float(rng.uniform(-np.pi, np.pi)), rng.uniform(-30, 30, 2))
        table = {
            "name": f"{self.test}_{self.seed}",
            "duration_s": duration_s,
            "ego": {**self.ego, "waypoints": lay.waypoints(self.ego["waypoints"]), "poses": "poses"},
            "road": [{**road, "line": lay.points(road["line"]).tolist()} for road in self.roads],
            "building": [
                {**h, "center": lay.points([h["center"]])[0].tolist(), "yaw_deg": lay.degrees(h.get("yaw_deg", 0.0))}
                for h in self.houses
            ],
            "agent": [lay.agent(agent) for agent in self.agents],
            "lidar": [lay.lidar(lidar) for lidar in self.lidars],
        }
        things = tuple(
            Solid(parts, np.append(lay.points([xy])[0], 0.0), np.deg2rad(lay.degrees(np.rad2deg(yaw))), np.zeros(2))
            for parts, xy, yaw in self.things
        )
        return World(self.test, self.seed, Scene.model_validate(table), self.parts, target, contact_s, things)


@dataclass(frozen=True, eq=False)
class _Placement:
    """Where a world lies in the map."""

    mirrored: bool
    yaw_rad: float
    xy_m: Array

    def points(self, xy: Any) -> Array:
        return rigid(self.xy_m, self.yaw_rad, np.asarray(xy, np.float64) * [1, -1 if self.mirrored else 1])

    def degrees(self, angle_deg: float) -> float:
        turned = np.deg2rad(-angle_deg if self.mirrored else angle_deg) + self.yaw_rad
        return float(np.rad2deg(wrap_angle(turned)))

    def waypoints(self, rows: Any) -> list[list[float]]:
        rows = np.asarray(rows, np.float64)
        return np.column_stack([self.points(rows[:, :2]), rows[:, 2]]).tolist()  # type: ignore[no-any-return]

    def agent(self, agent: dict[str, Any]) -> dict[str, Any]:
        if "pose" in agent:
            x, y, yaw = agent["pose"]
            return {**agent, "pose": [*self.points([[x, y]])[0].tolist(), self.degrees(yaw)]}
        return {**agent, "waypoints": self.waypoints(agent["waypoints"])}

    def lidar(self, lidar: dict[str, Any]) -> dict[str, Any]:
        if lidar.get("mount") != "map":
            return lidar
        x, y, z = lidar["position_m"]
        return {
            **lidar,
            "position_m": [*self.points([[x, y]])[0].tolist(), z],
            "yaw_deg": self.degrees(lidar["yaw_deg"]),
        }


def _rounded(size: Sequence[float]) -> list[float]:
    return [round(float(v), 3) for v in size]
