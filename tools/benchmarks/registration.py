"""How well roadside units are registered: random worlds, errors of poses and delays of stamps, by kind of world.

python tools/bench.py registration --first 300 --seeds 4 --lidars tilted16 --lidars level32
"""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from benchmarks.table import markdown
from log2sim.config import Config
from log2sim.datatypes import EgoVehicle, Lidar, Log, Stream, Sweep
from log2sim.geometry import NS_PER_S, Array, apply, inverse, rotation_from_rpy, transform
from log2sim.localization.given_poses import USUAL_SIGMA_M, USUAL_SIGMA_RAD
from log2sim.localization.replaced import replace_poses, shift_stream
from log2sim.localization.roadside import Findings, register_road
from log2sim.localization.surfaces import exp_of, log_of
from log2sim.plan import choose_detector, select_sensors
from log2sim.synth.polytope_caster import SensorState, Solid, cast_polytopes
from log2sim.synth.returns import LIDAR_MODELS, LidarModel
from log2sim.synth.terrain import Road
from log2sim.synth.traffic import TrafficObject, TrafficScene, draw_scene
from log2sim.synth.traffic_data import REAR_AXLE_OFFSET_M, REAR_AXLE_TO_LIDAR_M, TrafficRun, poses_of, run_of, stamps_of
from log2sim.synth.traffic_shapes import ROAD_USERS

TARGET_M, TARGET_DEG, TARGET_S = 0.1, 0.3, 0.02
RATES_HZ = (10.0, 5.0, 2.0, 20.0)
DRIFT_S = 2.0  # time constant of the errors of the ego's poses
# Put in: m and degrees, and s of delay.
NOISES, DELAYS_S = ((0.0, 0.0), (0.25, 1.0), (0.5, 2.0)), (0.0, 0.1, 0.3)
HEAD = ["world", "put in", "left m", "left deg", "within 0.1 m, 0.3 deg", "not told", "clock within 20 ms", "not told", "left out", "NEES"]  # fmt: skip


def main(first: int = 100, seeds: int = 4, lidars: list[str] = ["tilted16", "level32", "level64"]) -> None:
    """Disturb the pole of each world in several ways and print what is left, over all delays, and what of that is not told."""
    rows = defaultdict(list)
    for kind, lidar, k in itertools.product(("street", "open"), lidars, range(seeds)):
        world = draw_world(WorldSpec(kind, first + k, lidar, RATES_HZ[k % 4], RATES_HZ[(k + k // 4 + 1) % 4]))
        for noise, delay_s in itertools.product(NOISES, DELAYS_S):
            rng = np.random.default_rng([first + k, 0, *(round(100 * v) for v in noise)])
            # The poses of the ego err as registration expects them to, without which NEES would be too small.
            log = disturbed(drifting(world.log, rng), POLE, *noise, delay_s, rng)
            config = choose_detector(log, Config())
            found = register_road(log, config, select_sensors(log, config), progress=lambda *_: None)
            kinds, left = {fault.kind for fault in found.faults}, np.abs(errors_of(found.log, world.log, POLE))
            told = [kind in kinds for kind in ("unknown_road_pose", "unknown_road_clock", "wrong_road_pose")]
            rows[f"{kind} {lidar}", noise].append([*left, *told, nees(found.units[0], log, world.log, delay_s)])
    table = []
    for (name, noise), figures in rows.items():
        away, turned, late, unknown, unknown_clock, left_out, squared = np.array(figures).T
        good, clock, count = (away <= TARGET_M) & (turned <= TARGET_DEG), late <= TARGET_S, len(figures)
        silent = ~good & (unknown + left_out == 0), ~clock & (unknown_clock + left_out == 0)
        table.append([
            name, f"{noise[0]:g} m, {noise[1]:g} deg", f"{np.median(away):.3f}", f"{np.median(turned):.2f}", f"{good.sum()} of {count}",
            f"{silent[0].sum()}", f"{clock.sum()} of {count}", f"{silent[1].sum()}", f"{left_out.sum():.0f}", f"{squared.mean():.2f}",
        ])  # fmt: skip
    print(markdown(HEAD, table))


def nees(found: Findings, log: Log, true: Log, delay_s: float) -> float:
    """The squared error of the estimate of a pole and its clock by its covariance, over the seven values: 1 where that holds."""
    at = transform(np.eye(3), found.unit.site_m)
    lacks = true.lidars[POLE].mount_T_lidar @ inverse(log.lidars[POLE].mount_T_lidar)
    error = found.found.values - np.append(log_of(inverse(at) @ lacks @ at), delay_s)
    return float(error @ np.linalg.solve(found.found.covariance, error)) / len(error)


VEHICLE, POLE = "vehicle", "pole0"
POSE_RATE_HZ = 20.0
# What stays in a world with next to no structure.
TRAFFIC_SPEED_MPS = 1.0
ALONG, STANDING_SHARE = 0.9, 0.1


@dataclass(frozen=True)
class WorldSpec:
    """What a world is like.

    `kind` in {"street", "open"}: with houses, fences, trees and parked vehicles as they are drawn; or a road with nothing but
    moving traffic. `road_lidar`: "tilted16", "level32" or "level64". `azimuth_step_deg`: of all LiDARs; coarse ones are cast
    faster.
    """

    kind: str = "street"
    seed: int = 0
    road_lidar: str = "tilted16"
    vehicle_rate_hz: float = 10.0
    road_rate_hz: float = 10.0
    duration_s: float = 4.5
    azimuth_step_deg: float = 0.5


@dataclass(frozen=True, eq=False)
class World:
    """A log without errors."""

    log: Log
    spec: WorldSpec


def draw_world(spec: WorldSpec) -> World:
    """Draw a world; every sweep depends on the seed and its index alone."""
    rng = np.random.default_rng([spec.seed, 15])
    lidar = LIDAR_MODELS["hdl32e"].model_copy(
        update={"azimuth_step_deg": spec.azimuth_step_deg, "rate_hz": spec.vehicle_rate_hz}
    )
    scene = _draw_drive(lidar, rng)
    if spec.kind == "open":
        kept = tuple(
            o for o in scene.objects if (o.category and o.speed_mps > TRAFFIC_SPEED_MPS) or o.kind == "own car"
        )
        scene = replace(scene, objects=kept)
    run = run_of(scene, spec.duration_s + 0.5)
    size, _ = ego_body = _car(rng)
    ego_T_lidar = transform(np.eye(3), np.array([REAR_AXLE_TO_LIDAR_M, 0.0, float(scene.sensor.position_m[2])]))
    lidars = {VEHICLE: Lidar(VEHICLE, "ego", ego_T_lidar)}
    streams = {
        VEHICLE: _stream(VEHICLE, spec.vehicle_rate_hz, spec.duration_s, 0.0, _ego_reader(run, lidar, spec.seed))
    }
    model, map_T_lidar = _pole(spec, scene, rng)
    lidars[POLE] = Lidar(POLE, "map", map_T_lidar)
    phase_s = float(rng.uniform(0, 1 / spec.road_rate_hz))
    reader = _road_reader(run, ego_body, model, map_T_lidar, spec.seed + 1000)
    streams[POLE] = _stream(POLE, spec.road_rate_hz, spec.duration_s, phase_s, reader)
    t_pose = np.arange(int(np.ceil(spec.duration_s * POSE_RATE_HZ)) + 1) / POSE_RATE_HZ
    log = Log(
        name=f"{spec.kind}-{spec.seed}", format="synthetic", cameras={}, lidars=lidars, streams=streams,
        ego=poses_of(run, ego_T_lidar, t_pose), ego_vehicle=EgoVehicle(size, REAR_AXLE_OFFSET_M),
    )  # fmt: skip
    return World(log, spec)


def _draw_drive(lidar: LidarModel, rng: np.random.Generator) -> TrafficScene:
    """Draw a scene whose vehicle follows the road at up to 16 m/s; one in ten stands."""
    while True:
        scene = draw_scene("vehicle", rng, lidar=lidar)
        forward = scene.sensor.rotation[:2, 0] / np.linalg.norm(scene.sensor.rotation[:2, 0])
        road = scene.roads[0].yaw_rad
        if abs(forward @ [np.cos(road), np.sin(road)]) < ALONG:
            continue
        speed = 0.0 if rng.random() < STANDING_SHARE else rng.uniform(3.0, 16.0)
        own = [replace(o, speed_mps=speed) if o.kind == "own car" else o for o in scene.objects]
        return replace(scene, objects=tuple(own), sensor=replace(scene.sensor, velocity_mps=speed * forward))


def _car(rng: np.random.Generator) -> tuple[tuple[float, float, float], tuple]:
    while True:
        size, parts = ROAD_USERS["car"](rng)
        if 4.0 < size[0] < 5.0:
            return size, parts


def _pole(spec: WorldSpec, scene: TrafficScene, rng: np.random.Generator) -> tuple[LidarModel, Array]:
    """Place a LiDAR beside the main road, ahead of the vehicle."""
    road: Road = scene.roads[0]
    heading = np.arctan2(*scene.sensor.rotation[1::-1, 0])
    ahead = float(np.sign(np.cos(heading - road.yaw_rad)) or 1.0)
    side = float(rng.choice([-1, 1]))
    for _ in range(50):
        s, d = ahead * rng.uniform(5.0, 25.0), side * (road.half_width_m + rng.uniform(0.5, 2.0))
        xy, direction = road.at(s, d)
        if all(np.hypot(*(o.position_m[:2] - xy)) > 1.5 for o in scene.objects):
            break
    towards = direction - side * np.pi / 2 + rng.uniform(-0.6, 0.6)
    step = {"azimuth_step_deg": spec.azimuth_step_deg, "rate_hz": spec.road_rate_hz}
    if spec.road_lidar == "tilted16":
        model = LIDAR_MODELS["rslidar16-roadside"].model_copy(update=step)
        height, pitch = 3.6 + rng.normal(0, 0.1), np.deg2rad(model.pitch_deg + rng.normal(0, 0.6))
    else:
        lines = int(spec.road_lidar.removeprefix("level"))
        elevation = tuple(np.linspace(-25, 10, lines).tolist())
        model = LIDAR_MODELS["vlp16"].model_copy(update={**step, "elevation_deg": elevation, "noise_m": 0.02})
        height, pitch = 3.0 + rng.normal(0, 0.1), np.deg2rad(rng.normal(0, 0.6))
    z = scene.surface.elevation(xy) + height
    rotation = rotation_from_rpy(np.deg2rad(rng.normal(0, 0.6)), pitch, towards)
    return model, transform(rotation, np.array([*xy, z]))


def _stream(
    name: str, rate_hz: float, duration_s: float, phase_s: float, cast: Callable[[int, float], Sweep]
) -> Stream:
    """Make a stream whose stamps are the ends of sweeps."""
    period = 1.0 / rate_hz
    middle = np.arange(period / 2 + phase_s, duration_s - period / 2, period)
    t_ns = stamps_of(middle + period / 2)

    @lru_cache(maxsize=256)
    def read(i: int) -> Sweep:
        return cast(i, float(middle[i]))

    return Stream(name, t_ns, read)


def _solids(objects: tuple[TrafficObject, ...], seed: int) -> list[Solid]:
    rng = np.random.default_rng([seed, 3])
    passes = rng.uniform(0.3, 0.9, len(objects))
    return [
        Solid(o.parts, o.position_m, o.yaw_rad, o.speed_mps * np.array([np.cos(o.yaw_rad), np.sin(o.yaw_rad)]), glass_passes=float(p))
        for o, p in zip(objects, passes)
    ]  # fmt: skip


def _ego_reader(run: TrafficRun, model: LidarModel, seed: int) -> Callable[[int, float], Sweep]:
    period = 1 / model.rate_hz

    def cast(i: int, t_s: float) -> Sweep:
        now = run.at(t_s)
        rng = np.random.default_rng([seed, 4, i])
        returns = cast_polytopes(model, now.sensor, _solids(now.objects, seed), now.surface, rng, now.returns)
        t_ns = stamps_of(t_s + returns.t_s.astype(np.float64))
        return Sweep(int(stamps_of(np.array([t_s + period / 2]))[0]), returns.xyz_m, "map", t_ns)

    return cast


def _road_reader(
    run: TrafficRun, body: tuple[tuple[float, float, float], tuple], model: LidarModel, map_T_lidar: Array, seed: int
) -> Callable[[int, float], Sweep]:
    period, lidar_T_map = 1 / model.rate_hz, inverse(map_T_lidar)

    def cast(i: int, t_s: float) -> Sweep:
        now = run.at(t_s)
        objects = [o for o in now.objects if o.kind != "own car"]
        R, place = now.sensor.rotation, now.sensor.position_m
        yaw, speed = float(np.arctan2(R[1, 0], R[0, 0])), float(np.hypot(*now.sensor.velocity_mps))
        middle = place[:2] + 0.3 * np.array([np.cos(yaw), np.sin(yaw)])
        floor = now.surface.elevation(middle)
        objects.append(TrafficObject("car", np.append(middle, floor), yaw, body[0], body[1], speed))
        sensor = SensorState(map_T_lidar[:3, :3], map_T_lidar[:3, 3], np.zeros(2))
        rng = np.random.default_rng([seed, 4, i])
        returns = cast_polytopes(model, sensor, _solids(tuple(objects), seed), now.surface, rng, now.returns)
        t_ns = stamps_of(t_s + returns.t_s.astype(np.float64))
        return Sweep(int(stamps_of(np.array([t_s + period / 2]))[0]), apply(lidar_T_map, returns.xyz_m), "lidar", t_ns)

    return cast


def drifting(log: Log, rng: np.random.Generator) -> Log:
    """Let the poses of the ego err by their usual sigmas for seconds at a time, by a Gauss-Markov process; sweeps follow."""
    assert log.ego is not None
    keep = np.exp(-np.diff(log.ego.t_ns, prepend=log.ego.t_ns[:1]) / NS_PER_S / DRIFT_S)
    white, twist = rng.normal(size=(len(keep), 6)), np.zeros((len(keep), 6))
    for k, share in enumerate(keep):
        twist[k] = white[k] if k == 0 else share * twist[k - 1] + np.sqrt(1 - share**2) * white[k]
    off = [exp_of(one) for one in twist * np.repeat([USUAL_SIGMA_M, USUAL_SIGMA_RAD], 3)]
    return replace_poses(log, replace(log.ego, map_T_ego=log.ego.map_T_ego @ off))


def misplaced(log: Log, pole: str, shift_m: float, turn_deg: float) -> Log:
    """Put a LiDAR of the roadside elsewhere on the ground and turn it about the vertical, as by a wrong entry in a table."""
    mount = log.lidars[pole].mount_T_lidar
    turn = transform(rotation_from_rpy(0.0, 0.0, np.radians(turn_deg)), np.zeros(3)) @ mount
    turn[:3, 3] = mount[:3, 3] + [shift_m, 0.0, 0.0]
    return log.changed(lidars={**log.lidars, pole: replace(log.lidars[pole], mount_T_lidar=turn)})


def disturbed(log: Log, pole: str, shift_m: float, turn_deg: float, delay_s: float, rng: np.random.Generator) -> Log:
    """Move and turn a LiDAR of the roadside in a random direction, and let its stamps be late."""
    shift, axis = rng.normal(size=3), rng.normal(size=3)
    twist = np.concatenate(
        [shift_m * shift / np.linalg.norm(shift), np.radians(turn_deg) * axis / np.linalg.norm(axis)]
    )
    mount = log.lidars[pole].mount_T_lidar
    wrong = mount.copy()
    error = exp_of(twist)
    wrong[:3, :3], wrong[:3, 3] = error[:3, :3] @ mount[:3, :3], mount[:3, 3] + error[:3, 3]
    lidars = {**log.lidars, pole: replace(log.lidars[pole], mount_T_lidar=wrong)}
    streams = {**log.streams, pole: shift_stream(log.streams[pole], round(delay_s * NS_PER_S))}
    return log.changed(lidars=lidars, streams=streams)


def errors_of(log: Log, true: Log, pole: str) -> tuple[float, float, float]:
    """Compute how far a LiDAR's pose, m and degrees, and its clock, s, are from the truth."""
    off = log.lidars[pole].mount_T_lidar @ inverse(true.lidars[pole].mount_T_lidar)
    turned = float(np.degrees(np.linalg.norm(off[:3, :3] - np.eye(3)) / np.sqrt(2)))
    away = float(np.linalg.norm((log.lidars[pole].mount_T_lidar - true.lidars[pole].mount_T_lidar)[:3, 3]))
    late_s = float(log.streams[pole].t_ns[0] - true.streams[pole].t_ns[0]) / NS_PER_S
    return away, turned, late_s
