"""A drawn world: a scene whose road users are made of convex polytopes, and its log with a LiDAR at each end.

Scene files are cast against meshes; here the caster of the random traffic is used, which takes a tenth of the time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Log, Scenario, Stream, Sweep
from log2sim.geometry import NS_PER_S
from log2sim.synth.actors import Actor, MovingScene
from log2sim.synth.polytope_caster import Returns, SensorState, Solid, cast_polytopes
from log2sim.synth.polytopes import Material, Polytope, box
from log2sim.synth.raycast import mount_T_lidar, sweep_stamps
from log2sim.synth.returns import LidarModel, ReturnModel
from log2sim.synth.scene import Building, LidarSpec, Scene
from log2sim.synth.synthesis import synthesize
from log2sim.synth.traffic import Surface

Array = NDArray[np.float64]
VEHICLE_LIDAR, ROAD_LIDAR = "vehicle_lidar", "road_lidar"
Parts = tuple[Polytope, ...]


@dataclass(frozen=True, eq=False)
class World:
    """One variant of a test.

    Attributes
    ----------
    test : str
        range, blind_area or overlap.
    seed : int
        From which everything is drawn.
    scene : Scene
    parts : mapping of str to tuple of Polytope
        Shape of every agent, and of the "ego".
    target : str
        The agent that the test is about.
    contact_s : float
        When the front of the ego reaches the target, if nobody brakes; NaN where it does not.
    things : tuple of Solid
        Trees, posts, bins and other things beside the road, which are no road users.
    every : int
        One in so many sweeps is recorded; the LiDARs turn as fast as they do.
    """

    test: str
    seed: int
    scene: Scene
    parts: dict[str, Parts]
    target: str
    contact_s: float = float("nan")
    things: tuple[Solid, ...] = ()
    every: int = 1

    @property
    def period_s(self) -> float:
        """Time between the sweeps of the vehicle's LiDAR."""
        return self.every / self.scene.lidar[0].rate_hz

    @property
    def moving(self) -> MovingScene:
        """The scene in motion."""
        return MovingScene.of(self.scene)


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
        step = np.diff(moving.ego.map_T_ego([t_s - 0.05, t_s + 0.05])[:, :2, 3], axis=0)[0]
        velocity = step / 0.1
    sensor = SensorState(map_T_lidar[:3, :3], map_T_lidar[:3, 3], velocity)
    solids = [_solid(actor, world.parts[actor.spec.id], t_s) for actor in moving.seen_from(spec.mount)]
    solids += [*(_house(building) for building in world.scene.building), *world.things]
    returns = cast_polytopes(
        model_of(spec), sensor, solids, _ground(world.seed), rng, ReturnModel(spec.noise_m, spec.dropout)
    )
    hit = returns.hit
    if spec.mount == "ego":
        # The ego does not see itself; its place among the hits stays free.
        hit = np.where(hit >= len(moving.actors), hit + 1, hit).astype(np.int32)
    return replace(returns, hit=hit), sensor


def model_of(spec: LidarSpec) -> LidarModel:
    """Describe a LiDAR of a scene for the caster."""
    even = np.linspace(*spec.elevation_deg, spec.channels)
    return LidarModel(
        name=spec.name,
        elevation_deg=spec.channels_deg or tuple(even.tolist()),
        azimuth_deg=spec.azimuth_deg,
        azimuth_step_deg=spec.azimuth_step_deg,
        range_m=spec.range_m,
        noise_m=spec.noise_m,
        rate_hz=spec.rate_hz,
    )


def _solid(actor: Actor, parts: Parts, t_s: float) -> Solid:
    state = actor.at([t_s])
    yaw, speed = float(state.yaw_rad[0]), float(state.speed_mps[0])
    floor = state.center_m[0] - [0.0, 0.0, actor.spec.box_m[2] / 2]
    return Solid(parts, floor, yaw, speed * np.array([np.cos(yaw), np.sin(yaw)]))


def _house(building: Building) -> Solid:
    length, width, height = building.size_m
    parts = (box((-length / 2, -width / 2, 0.0), (length / 2, width / 2, height), Material.WALL),)
    return Solid(parts, np.array([*building.center, 0.0]), float(np.deg2rad(building.yaw_deg)), np.zeros(2))


@cache
def _ground(seed: int) -> Surface:
    """Make a road that is level but for waves of a centimeter."""
    rng = np.random.default_rng([seed, 5])
    waves = np.column_stack(
        [rng.uniform(0, 0.01, 3), rng.normal(0, 0.2, 3), rng.normal(0, 0.2, 3), rng.uniform(0, 2 * np.pi, 3)]
    )
    return Surface(np.zeros(5), waves, (), 0.0)


def rigid(xy_m: Array, yaw_rad: float, xy: Array) -> Array:
    """Turn points (N, 2) and move them."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.asarray(np.asarray(xy) @ np.array([[c, s], [-s, c]]) + xy_m)
