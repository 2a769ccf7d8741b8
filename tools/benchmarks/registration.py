"""How well roadside units are registered: random worlds, errors of poses and delays of stamps, by kind of world.

python tools/bench.py registration --first 300 --seeds 4 --lidars tilted16 --lidars level32
"""

from __future__ import annotations

import itertools
from collections import defaultdict
from dataclasses import replace
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
from log2sim.synth.traffic_data import REAR_AXLE_OFFSET_M, REAR_AXLE_TO_LIDAR_M, poses_of, run_of, stamps_of
from log2sim.synth.traffic_shapes import draw_user

TARGET_M, TARGET_DEG, TARGET_S = 0.1, 0.3, 0.02
RATES_HZ = (10.0, 5.0, 2.0, 20.0)
DRIFT_S = 2.0  # time constant of the errors of the ego's poses
# Put in: m and degrees, and s of delay.
NOISES, DELAYS_S = ((0.0, 0.0), (0.25, 1.0), (0.5, 2.0)), (0.0, 0.1, 0.3)
HEAD = ["world", "put in", "left m", "left deg", "within 0.1 m, 0.3 deg", "not told", "of these in the plane", "clock within 20 ms", "not told", "left out", "NEES"]  # fmt: skip


def main(first: int = 100, seeds: int = 4, lidars: list[str] = ["tilted16", "level32", "level64"]) -> None:
    """Disturb the pole of each world in several ways and print what is left, over all delays, and what of that is not told."""
    rows = defaultdict(list)
    for kind, lidar, k in itertools.product(("street", "open"), lidars, range(seeds)):
        true = draw_world(kind, first + k, lidar, (RATES_HZ[k % 4], RATES_HZ[(k + k // 4 + 1) % 4]))
        for noise, delay_s in itertools.product(NOISES, DELAYS_S):
            rng = np.random.default_rng([first + k, 0, *(round(100 * v) for v in noise)])
            # The poses of the ego err as registration expects them to, without which NEES would be too small.
            log = disturbed(drifting(true, rng), POLE, *noise, delay_s, rng)
            config = choose_detector(log, Config())
            found = register_road(log, config, select_sensors(log, config), progress=lambda *_: None)
            kinds, left = {fault.kind for fault in found.faults}, np.abs(errors_of(found.log, true, POLE))
            told = [kind in kinds for kind in ("unknown_road_pose", "unknown_road_clock", "wrong_road_pose")]
            in_plane = is_near_in_plane(found.log, true, POLE)
            rows[f"{kind} {lidar}", noise].append([*left, in_plane, *told, nees(found.units[0], log, true, delay_s)])
    table = []
    for (name, noise), figures in rows.items():
        away, turned, late, near, unknown, unknown_clock, left_out, squared = np.array(figures).T
        good, clock, count = (away <= TARGET_M) & (turned <= TARGET_DEG), late <= TARGET_S, len(figures)
        silent = ~good & (unknown + left_out == 0), ~clock & (unknown_clock + left_out == 0)
        table.append([
            name, f"{noise[0]:g} m, {noise[1]:g} deg", f"{np.median(away):.3f}", f"{np.median(turned):.2f}", f"{good.sum()} of {count}",
            f"{silent[0].sum()}", f"{(silent[0] & (near == 0)).sum()}", f"{clock.sum()} of {count}", f"{silent[1].sum()}", f"{left_out.sum():.0f}", f"{squared.mean():.2f}",
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


def draw_world(
    kind: str, seed: int, road_lidar: str, rates_hz: tuple[float, float] = (10.0, 10.0), duration_s: float = 4.5, step_deg: float = 0.5
) -> Log:  # fmt: skip
    """Draw a log without errors: a vehicle with a LiDAR and a pole with another, at rates of their own.

    `kind`: "street" with houses, fences, trees and parked vehicles as they are drawn, or "open", a road with nothing but moving traffic;
    `road_lidar`: "tilted16", "level32" or "level64"; `step_deg` in azimuth of both: coarse ones are cast faster. Every sweep depends on
    the seed and its index alone.
    """
    rng = np.random.default_rng([seed, 15])
    step = {"azimuth_step_deg": step_deg}
    lidar = LIDAR_MODELS["hdl32e"].model_copy(update={**step, "rate_hz": rates_hz[0]})
    scene = _draw_drive(lidar, rng)
    if kind == "open":
        moving = [o for o in scene.objects if (o.category and o.speed_mps > TRAFFIC_SPEED_MPS) or o.kind == "own car"]
        scene = replace(scene, objects=tuple(moving))
    run, (size, parts) = run_of(scene, duration_s + 0.5), draw_user("car", rng)[1]
    while not 4.0 < size[0] < 5.0:
        size, parts = draw_user("car", rng)[1]
    ego_T_lidar = transform(np.eye(3), np.array([REAR_AXLE_TO_LIDAR_M, 0.0, float(scene.sensor.position_m[2])]))
    model, map_T_pole = _pole(road_lidar, {**step, "rate_hz": rates_hz[1]}, scene, rng)
    phase_s = float(rng.uniform(0, 1 / rates_hz[1]))

    def of_vehicle(i: int, t_s: float) -> Sweep:
        now = run.at(t_s)
        return _sweep(now, lidar, now.sensor, now.objects, (seed, i), t_s)

    def of_pole(i: int, t_s: float) -> Sweep:
        """Cast a sweep in which the ego is one of the road users."""
        now = run.at(t_s)
        R, place = now.sensor.rotation, now.sensor.position_m
        yaw, speed = float(np.arctan2(R[1, 0], R[0, 0])), float(np.hypot(*now.sensor.velocity_mps))
        middle = place[:2] + 0.3 * np.array([np.cos(yaw), np.sin(yaw)])
        ego = TrafficObject("car", np.append(middle, now.surface.elevation(middle)), yaw, size, parts, speed)
        others = tuple(o for o in now.objects if o.kind != "own car")
        sensor = SensorState(map_T_pole[:3, :3], map_T_pole[:3, 3], np.zeros(2))
        sweep = _sweep(now, model, sensor, (*others, ego), (seed + 1000, i), t_s)
        return replace(sweep, xyz_m=apply(inverse(map_T_pole), sweep.xyz_m), frame="lidar")

    streams = {}
    for name, cast, period_s, begin_s in (
        (VEHICLE, of_vehicle, 1 / rates_hz[0], 0.0),
        (POLE, of_pole, 1 / rates_hz[1], phase_s),
    ):
        middle_s = np.arange(period_s / 2 + begin_s, duration_s - period_s / 2, period_s)
        read = lru_cache(maxsize=256)(lambda i, cast=cast, middle_s=middle_s: cast(i, float(middle_s[i])))
        streams[name] = Stream(name, stamps_of(middle_s + period_s / 2), read)
    t_pose = np.arange(int(np.ceil(duration_s * POSE_RATE_HZ)) + 1) / POSE_RATE_HZ
    return Log(
        name=f"{kind}-{seed}", format="synthetic", cameras={}, streams=streams,
        lidars={VEHICLE: Lidar(VEHICLE, "ego", ego_T_lidar), POLE: Lidar(POLE, "map", map_T_pole)},
        ego=poses_of(run, ego_T_lidar, t_pose), ego_vehicle=EgoVehicle(size, REAR_AXLE_OFFSET_M),
    )  # fmt: skip


def _sweep(
    now: TrafficScene, model: LidarModel, sensor: SensorState, objects: tuple[TrafficObject, ...], seed: tuple[int, int], t_s: float
) -> Sweep:  # fmt: skip
    """Cast a sweep whose middle is at a time, in the map; its stamp is its end."""
    passes = np.random.default_rng([seed[0], 3]).uniform(0.3, 0.9, len(objects))
    solids = [
        Solid(o.parts, o.position_m, o.yaw_rad, o.speed_mps * np.array([np.cos(o.yaw_rad), np.sin(o.yaw_rad)]), glass_passes=float(p))
        for o, p in zip(objects, passes)
    ]  # fmt: skip
    rng = np.random.default_rng([seed[0], 4, seed[1]])
    returns = cast_polytopes(model, sensor, solids, now.surface, rng, now.returns)
    (end_ns,) = stamps_of(np.array([t_s + 0.5 / model.rate_hz])).tolist()
    return Sweep(end_ns, returns.xyz_m, "map", stamps_of(t_s + returns.t_s.astype(np.float64)))


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


def _pole(name: str, step: dict[str, float], scene: TrafficScene, rng: np.random.Generator) -> tuple[LidarModel, Array]:
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
    if name == "tilted16":
        model = LIDAR_MODELS["rslidar16-roadside"].model_copy(update=step)
        height, pitch = 3.6 + rng.normal(0, 0.1), np.deg2rad(model.pitch_deg + rng.normal(0, 0.6))
    else:
        elevation = tuple(np.linspace(-25, 10, int(name.removeprefix("level"))).tolist())
        model = LIDAR_MODELS["vlp16"].model_copy(update={**step, "elevation_deg": elevation, "noise_m": 0.02})
        height, pitch = 3.0 + rng.normal(0, 0.1), np.deg2rad(rng.normal(0, 0.6))
    z = scene.surface.elevation(xy) + height
    return model, transform(rotation_from_rpy(np.deg2rad(rng.normal(0, 0.6)), pitch, towards), np.array([*xy, z]))


def drifting(log: Log, rng: np.random.Generator) -> Log:
    """Let the poses of the ego err by their usual sigmas for seconds at a time, by a Gauss-Markov process; sweeps follow."""
    assert log.ego is not None
    keep = np.exp(-np.diff(log.ego.t_ns, prepend=log.ego.t_ns[:1]) / NS_PER_S / DRIFT_S)
    white, twist = rng.normal(size=(len(keep), 6)), np.zeros((len(keep), 6))
    for k, share in enumerate(keep):
        twist[k] = white[k] if k == 0 else share * twist[k - 1] + np.sqrt(1 - share**2) * white[k]
    off = [exp_of(one) for one in twist * np.repeat([USUAL_SIGMA_M, USUAL_SIGMA_RAD], 3)]
    return replace_poses(log, replace(log.ego, map_T_ego=log.ego.map_T_ego @ off))


def remounted(log: Log, pole: str, mount: Array) -> Log:
    """Put a LiDAR of the roadside elsewhere."""
    return log.changed(lidars={**log.lidars, pole: replace(log.lidars[pole], mount_T_lidar=mount)})


def misplaced(log: Log, pole: str, shift_m: float, turn_deg: float) -> Log:
    """Shift a LiDAR of the roadside on the ground and turn it about the vertical, as by a wrong entry in a table."""
    mount = log.lidars[pole].mount_T_lidar
    turn = rotation_from_rpy(0.0, 0.0, np.radians(turn_deg)) @ mount[:3, :3]
    return remounted(log, pole, transform(turn, mount[:3, 3] + [shift_m, 0.0, 0.0]))


def disturbed(log: Log, pole: str, shift_m: float, turn_deg: float, delay_s: float, rng: np.random.Generator) -> Log:
    """Move and turn a LiDAR of the roadside in a random direction, and let its stamps be late."""
    shift, axis = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    error = exp_of(np.concatenate([shift_m * shift, np.radians(turn_deg) * axis]))
    mount = log.lidars[pole].mount_T_lidar
    log = remounted(log, pole, transform(error[:3, :3] @ mount[:3, :3], mount[:3, 3] + error[:3, 3]))
    return log.changed(streams={**log.streams, pole: shift_stream(log.streams[pole], round(delay_s * NS_PER_S))})


def is_near_in_plane(log: Log, true: Log, pole: str) -> bool:
    """Whether a LiDAR's place in the plane and its yaw are right to what registration says of them: tilt is not among that."""
    off = log.lidars[pole].mount_T_lidar @ inverse(true.lidars[pole].mount_T_lidar)
    shift = (log.lidars[pole].mount_T_lidar - true.lidars[pole].mount_T_lidar)[:2, 3]
    return bool(np.hypot(*shift) <= TARGET_M and abs(np.degrees(np.arctan2(off[1, 0], off[0, 0]))) <= TARGET_DEG)


def errors_of(log: Log, true: Log, pole: str) -> tuple[float, float, float]:
    """Compute how far a LiDAR's pose, m and degrees, and its clock, s, are from the truth."""
    off = log.lidars[pole].mount_T_lidar @ inverse(true.lidars[pole].mount_T_lidar)
    turned = float(np.degrees(np.linalg.norm(off[:3, :3] - np.eye(3)) / np.sqrt(2)))
    away = float(np.linalg.norm((log.lidars[pole].mount_T_lidar - true.lidars[pole].mount_T_lidar)[:3, 3]))
    late_s = float(log.streams[pole].t_ns[0] - true.streams[pole].t_ns[0]) / NS_PER_S
    return away, turned, late_s
