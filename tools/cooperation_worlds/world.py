"""A drawn world: a scene whose road users are made of convex polytopes, and its log with a LiDAR at each end.

Scene files are cast against meshes; here the caster of the random traffic is used, which takes a tenth of the time.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Log, Scenario, Stream, Sweep
from log2sim.geometry import NS_PER_S, rectangles_overlap, rotation_from_rpy, transform, wrap_angle
from log2sim.localization.replaced import shift_stream
from log2sim.synth.actors import Actor, MovingScene
from log2sim.synth.polytope_caster import Returns, SensorState, Solid, cast_polytopes
from log2sim.synth.polytopes import Material, Polytope, Shape, box
from log2sim.synth.raycast import mount_T_lidar, slab_distance, sweep_stamps
from log2sim.synth.returns import LidarModel, ReturnModel
from log2sim.synth.scene import LidarSpec, Scene
from log2sim.synth.synthesis import synthesize
from log2sim.synth.terrain import Surface
from log2sim.synth.traffic_shapes import SMALL, draw_user

Array = NDArray[np.float64]
VEHICLE_LIDAR, ROAD_LIDAR = "vehicle_lidar", "road_lidar"
Parts = tuple[Polytope, ...]


@dataclass(frozen=True, eq=False)
class World:
    """One variant of a test."""

    test: str  # range, blind_area or overlap
    seed: int  # from which everything is drawn
    scene: Scene
    parts: dict[str, Parts]  # shape of every agent, and of the "ego"
    target: str  # the agent that the test is about
    contact_s: float = np.nan  # when the front of the ego reaches the target, if nobody brakes; NaN where it does not
    things: tuple[Solid, ...] = ()  # trees, posts, bins and other things beside the road, which are no road users
    every: int = 1  # one in so many sweeps is recorded; the LiDARs turn as fast as they do

    @property
    def period_s(self) -> float:
        """Time between the sweeps of the vehicle's LiDAR."""
        return self.every / self.scene.lidar[0].rate_hz

    @property
    def moving(self) -> MovingScene:
        return MovingScene.of(self.scene)

    @property
    def target_actor(self) -> Actor:
        return next(a for a in self.moving.actors if a.spec.id == self.target)

    def distances_m(self, t_s: Array) -> Array:
        """Distances (T,) between the centers of the ego and the target."""
        body = self.moving.ego
        assert body is not None
        return np.linalg.norm((self.target_actor.at(t_s).center_m - body.at(t_s).center_m)[:, :2], axis=1)


def log_of(world: World) -> tuple[Log, Scenario]:
    """Make the log of a world, whose sweeps are cast once when they are read, and its exact truth."""
    log, truth = synthesize(world.scene, seed=world.seed, observe=False)
    moving, streams = world.moving, {}
    for index, spec in enumerate(world.scene.lidar):
        stamps = sweep_stamps(spec, world.scene)[:: world.every]
        streams[spec.name] = Stream(spec.name, stamps, _reader(world, moving, spec, index, stamps))
    return log.changed(streams=streams), truth


def _reader(
    world: World, moving: MovingScene, spec: LidarSpec, index: int, stamps: NDArray[np.int64]
) -> Callable[[int], Sweep]:
    @cache
    def read(i: int) -> Sweep:
        returns, sensor = cast(world, moving, spec, int(stamps[i]), np.random.default_rng([world.seed, 4, index, i]))
        middle_ns = int(stamps[i]) - round(NS_PER_S / spec.rate_hz / 2)
        t_ns = middle_ns + np.rint(returns.t_s.astype(np.float64) * NS_PER_S).astype(np.int64)
        # Back into the frame of the sensor at the time of each point, as a driver gives them.
        start = sensor.position_m + returns.t_s[:, None] * np.append(sensor.velocity_mps, 0.0)
        xyz = ((returns.xyz_m - start) @ sensor.rotation).astype(np.float32)
        return Sweep(int(stamps[i]), np.asfortranarray(xyz), "lidar", t_ns)

    return read


def cast(
    world: World, moving: MovingScene, spec: LidarSpec, stamp_ns: int, rng: np.random.Generator
) -> tuple[Returns, SensorState]:
    """Cast the sweep of a LiDAR that ends at a stamp; hits count the agents in their order, then the ego, then the rest."""
    middle_ns = stamp_ns - round(NS_PER_S / spec.rate_hz / 2)
    t_s = moving.seconds(middle_ns)
    map_T_lidar = moving.map_T_mount(spec.mount, np.array([middle_ns]))[0] @ mount_T_lidar(spec)
    velocity = np.zeros(2)
    if spec.mount == "ego" and moving.ego is not None:
        step = np.diff(moving.ego.map_T_axle([t_s - 0.05, t_s + 0.05])[:, :2, 3], axis=0)[0]
        velocity = step / 0.1
    sensor = SensorState(map_T_lidar[:3, :3], map_T_lidar[:3, 3], velocity)
    solids = [_solid(actor, world.parts[actor.spec.id], t_s) for actor in moving.seen_from(spec.mount)]
    for house in world.scene.building:
        half = np.array(house.size_m[:2]) / 2
        part = box((*-half, 0.0), (*half, house.size_m[2]), Material.WALL)
        solids.append(Solid((part,), np.array([*house.center, 0.0]), float(np.deg2rad(house.yaw_deg)), np.zeros(2)))
    solids += world.things
    noise = ReturnModel(spec.noise_m, spec.dropout)
    returns = cast_polytopes(model_of(spec), sensor, solids, _ground(world.seed), rng, noise)
    hit = returns.hit
    if spec.mount == "ego":
        # The ego does not see itself; its place among the hits stays free.
        hit = np.where(hit >= len(moving.actors), hit + 1, hit).astype(np.int32)
    return replace(returns, hit=hit), sensor


def model_of(spec: LidarSpec) -> LidarModel:
    """Describe a LiDAR of a scene for the caster."""
    even = np.linspace(*spec.elevation_deg, spec.channels)
    alike = ("name", "azimuth_deg", "azimuth_step_deg", "range_m", "noise_m", "rate_hz")
    lines = spec.channels_deg or tuple(even.tolist())
    return LidarModel(elevation_deg=lines, **{key: getattr(spec, key) for key in alike})


def _solid(actor: Actor, parts: Parts, t_s: float) -> Solid:
    state = actor.at([t_s])
    yaw, speed = float(state.yaw_rad[0]), float(state.speed_mps[0])
    floor = state.center_m[0] - [0.0, 0.0, actor.spec.box_m[2] / 2]
    return Solid(parts, floor, yaw, speed * np.array([np.cos(yaw), np.sin(yaw)]))


@cache
def _ground(seed: int) -> Surface:
    """Make a road that is level but for waves of a centimeter."""
    rng = np.random.default_rng([seed, 5])
    waves = np.column_stack(
        [rng.uniform(0, 0.01, 3), rng.normal(0, 0.2, 3), rng.normal(0, 0.2, 3), rng.uniform(0, 2 * np.pi, 3)]
    )
    return Surface(np.zeros(5), waves, (), 0.0)


# The sensors of the paper: at 2 m with a range of 20 m on the vehicle, at 3 m with 40 m at the road.
VEHICLE_HEIGHT_M, VEHICLE_RANGE_M = 2.0, 20.0
ROAD_HEIGHT_M, ROAD_RANGE_M = 3.0, 40.0
# Lines and steps of sensors on the market; at crossings denser ones are mounted than on cars (DAIR-V2X: 300 lines and 40).
VEHICLE_LINES, ROAD_LINES = (32, 40, 64), (40, 64, 80)
STEPS_DEG = (0.25, 0.3, 0.4)
LIDAR_AHEAD_M = 1.2  # of the rear axle
MAX_TRIES = 400


def first_that_keeps(
    test: str, number: int, seed: int, draw: Callable[[Builder], World | None], keeps: Callable[[World], bool]
) -> World:
    """The first variant of a test, drawn from a seed, that keeps what the test promises."""
    for attempt in range(MAX_TRIES):
        world = draw(Builder(test, seed, np.random.default_rng([seed, number, attempt])))
        if world is not None and keeps(world):
            return world
    raise RuntimeError(f"{test}, seed {seed}: no variant within {MAX_TRIES} tries keeps what the test promises")


@dataclass(eq=False)
class Builder:
    """What has been put into a world, in a frame with right-hand traffic."""

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

    def drive_ego(self, waypoints: Any) -> None:
        """Let the ego, a car of random shape, drive along waypoints (W, 3: x, y, speed) of its box's center at time 0."""
        size, parts = self.draw_shape("car")
        while size[0] > 5.2 or size[2] > VEHICLE_HEIGHT_M - 0.1:
            size, parts = self.draw_shape("car")
        self.parts["ego"] = parts
        self.ego = {"waypoints": waypoints, "size_m": _rounded(size), "rear_axle_offset_m": round(0.3 * size[0], 3)}

    def add(self, name: str, shape: Shape, category: str, **place: Any) -> None:
        """Add a road user of a shape, parked at `pose` (x, y, degrees) or moving along `waypoints`."""
        size, parts = shape
        self.parts[name] = parts
        self.agents.append({"id": name, "category": category, "size_m": _rounded(size), **place})

    def draw_shape(self, category: str) -> Shape:
        return draw_user(category, self.rng)[1]

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
        side = -1 if rng.random() < 0.3 else 1
        turn, origin = float(rng.uniform(-np.pi, np.pi)), rng.uniform(-30, 30, 2)
        c, s = np.cos(turn), np.sin(turn)

        def points(xy: Any) -> Array:
            return np.asarray(np.asarray(xy, np.float64) * [1, side] @ np.array([[c, s], [-s, c]]) + origin)

        def degrees(angle_deg: float) -> float:
            return float(np.rad2deg(wrap_angle(np.deg2rad(side * angle_deg) + turn)))

        def waypoints(rows: Any) -> list[list[float]]:
            rows = np.asarray(rows, np.float64)
            return np.column_stack([points(rows[:, :2]), rows[:, 2]]).tolist()  # type: ignore[no-any-return]

        def laid(one: dict[str, Any]) -> dict[str, Any]:
            """What of a table is a place or an angle, in the map."""
            out = dict(one)
            if "waypoints" in one:
                out["waypoints"] = waypoints(one["waypoints"])
            if "pose" in one:
                out["pose"] = [*points([one["pose"][:2]])[0].tolist(), degrees(one["pose"][2])]
            if one.get("mount") == "map":
                x, y, z = one["position_m"]
                out |= {"position_m": [*points([[x, y]])[0].tolist(), z], "yaw_deg": degrees(one["yaw_deg"])}
            if "center" in one:
                out |= {"center": points([one["center"]])[0].tolist(), "yaw_deg": degrees(0.0)}
            return out

        table = {
            "name": f"{self.test}_{self.seed}", "duration_s": duration_s, "ego": {**laid(self.ego), "poses": "poses"},
            "road": [{**road, "line": points(road["line"]).tolist()} for road in self.roads],
            "building": list(map(laid, self.houses)), "agent": list(map(laid, self.agents)), "lidar": list(map(laid, self.lidars)),
        }  # fmt: skip
        things = tuple(
            Solid(parts, np.append(points([xy])[0], 0.0), np.deg2rad(degrees(np.rad2deg(yaw))), np.zeros(2))
            for parts, xy, yaw in self.things
        )
        return World(self.test, self.seed, Scene.model_validate(table), self.parts, target, contact_s, things)


def _rounded(size: Sequence[float]) -> list[float]:
    return [round(float(v), 3) for v in size]


MAX_OFFSET_M, MAX_TURN_DEG, MAX_DELAY_S = 0.5, 2.0, 0.3
LEANS_DEG = 0.3  # roll and pitch of a pole are leveled better than its yaw is known
SINKS_M = 0.1


def disturb(log: Log, seed: int, share: float, *, delayed: bool) -> Log:
    """Return a log whose road's LiDAR is off by up to a share of 0.5 m, 2 degrees and 0.3 s, uniform in size and direction.

    Its points and their times stay.
    """
    rng = np.random.default_rng([seed, 9])
    angle, size = rng.uniform(-np.pi, np.pi), share * MAX_OFFSET_M * rng.random()
    offset_m = [size * np.cos(angle), size * np.sin(angle), share * SINKS_M * rng.uniform(-1, 1)]
    lean_deg = share * LEANS_DEG * rng.uniform(-1, 1, 2)
    turn_deg = [*lean_deg, share * MAX_TURN_DEG * rng.uniform(-1, 1)]
    delay_s = round(share * MAX_DELAY_S * rng.random(), 3) * delayed
    lidar = log.lidars[ROAD_LIDAR]
    pose = np.array(lidar.mount_T_lidar)
    # Turned about itself, not about the origin of the map.
    turned = transform(rotation_from_rpy(*np.deg2rad(turn_deg)) @ pose[:3, :3], pose[:3, 3] + offset_m)
    late = shift_stream(log.streams[ROAD_LIDAR], round(delay_s * NS_PER_S))
    lidars = {**log.lidars, ROAD_LIDAR: replace(lidar, mount_T_lidar=turned)}
    return log.changed(lidars=lidars, streams={**log.streams, ROAD_LIDAR: late})


# Points on the target's axis and sides, at shares of its half length, half width and height.
ALONG, ACROSS, UP = (-0.8, 0.0, 0.8), (-0.8, 0.0, 0.8), (0.15, 0.4, 0.65, 0.9)


def visible_share(world: World, lidar: str, t_s: Array) -> Array:
    """Share (T,) of points in the target's box that lie within the range of a LiDAR and that no other box hides, at times (T,)."""
    moving, spec = world.moving, next(s for s in world.scene.lidar if s.name == lidar)
    seen = {actor.spec.id: actor for actor in moving.seen_from(spec.mount)}
    actor = seen.pop(world.target)
    stamps = world.scene.start_ns + np.rint(np.asarray(t_s) * 1e9).astype(np.int64)
    eye = (moving.map_T_mount(spec.mount, stamps) @ mount_T_lidar(spec))[:, :3, 3]
    shares = np.array([(x, y, z) for x in ALONG for y in ACROSS for z in UP])
    states, out = actor.at(t_s), np.zeros(len(t_s))
    boxes = [(np.array(other.spec.box_m), other.at(t_s)) for other in seen.values()]
    # What stands for good: rotation, center and size of the box around each building, and each part of a thing.
    standing = []
    for house in world.scene.building:
        back = rotation_from_rpy(0, 0, np.deg2rad(house.yaw_deg))
        standing.append((back, np.array([*house.center, house.size_m[2] / 2]), np.array(house.size_m)))
    for thing in world.things:
        back = rotation_from_rpy(0, 0, thing.yaw_rad)
        for part in thing.parts:
            middle = thing.position_m + back @ (part.low + part.high) / 2
            standing.append((back, middle, np.asarray(part.high - part.low)))
    for k in range(len(t_s)):
        local = shares * np.array(actor.spec.box_m) * [0.5, 0.5, 1.0] - [0, 0, actor.spec.box_m[2] / 2]
        points = local @ rotation_from_rpy(0, 0, states.yaw_rad[k]).T + states.center_m[k]
        ray = points - eye[k]
        free = np.linalg.norm(ray, axis=1) < spec.range_m
        moved = [(rotation_from_rpy(0, 0, at.yaw_rad[k]), at.center_m[k], size) for size, at in boxes]
        for back, middle, size in [*moved, *standing]:
            origin = np.tile((eye[k] - middle) @ back, (len(ray), 1))
            free &= ~(slab_distance(size, origin, ray @ back) < 1.0)
        out[k] = free.mean()
    return out


def agents_touch(world: World, t_s: Array, gap_m: float) -> bool:
    """Return whether two road users, the ego among them, come nearer to each other than a gap at times (T,)."""
    states = [(actor.at(t_s), np.tile(np.array(actor.spec.box_m[:2]) + gap_m, (len(t_s), 1))) for actor in _all(world)]
    for (other, other_size), (one, size) in itertools.combinations(states, 2):
        apart = (other.center_m - one.center_m)[:, :2].T
        if rectangles_overlap(*apart, one.yaw_rad, other.yaw_rad, size, other_size).any():
            return True
    return False


def things_touch(world: World, t_s: Array, gap_m: float) -> bool:
    """Return whether a road user may come nearer to the middle of a thing than a gap: circles around the boxes decide."""
    places = np.array([thing.position_m[:2] for thing in world.things]).reshape(-1, 2)
    for actor in _all(world):
        away = np.linalg.norm(actor.at(t_s).center_m[:, None, :2] - places, axis=2)
        if (away < np.hypot(*actor.spec.box_m[:2]) / 2 + gap_m).any():
            return True
    return False


def _all(world: World) -> tuple[Actor, ...]:
    moving = world.moving
    assert moving.ego is not None
    return (*moving.actors, moving.ego)
