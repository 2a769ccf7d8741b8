"""Synthesis of a log and its exact truth from a scene, and its writing.

scene = load_scene("samples/crossing.toml")
log, truth = synthesize(scene, seed=1)          # records are rendered and cast when they are read
write_synthetic(scene, "samples/crossing", seed=1)
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Agent, EgoVehicle, Lidar, Log, MapFrame, Scenario, Stream, Waypoints
from log2sim.datatypes.color_names import name_of
from log2sim.errors import ConfigError
from log2sim.files.documents import check_folder
from log2sim.files.outputs import replaced_folder
from log2sim.geometry import NS_PER_S, Array, Camera, PoseTrack, rotation_from_rpy, transform, wrap_angle
from log2sim.synth import raycast
from log2sim.synth.actors import Actor, ActorStates, MovingScene
from log2sim.synth.backdrop import Backdrop
from log2sim.synth.ground import Ground, GroundPlan
from log2sim.synth.light import Lamp, headlights, light_of, street_lights
from log2sim.synth.paint import GroundReflectance
from log2sim.synth.render import Body, SceneInstant, bodies_at, camera_of, frame_stamps, render, signals_of
from log2sim.synth.scene import Scene
from log2sim.synth.truth import (
    FrameVisibility,
    labels_2d,
    labels_3d,
    map_features_of,
    seen_ground,
    visibility_by_camera,
    visible_at,
)

TRUTH_STEP_S = 0.05
# Sweeps that were cast for the visibility of agents and are read next: memory for some hundred of 64 lines.
MAX_CACHED_BYTES, BYTES_PER_RAY = 400_000_000, 32
GNSS_CORRELATION_S = 2.0  # time constant of the errors of GNSS and IMU


def synthesize(scene: Scene, *, seed: int = 0, observe: bool = True) -> tuple[Log, Scenario]:
    """Make a log, whose records are rendered and cast when read, and its exact truth.

    In the log, `ego` has the errors of GNSS and IMU. A sweep's stamp is its end; its points are in the lidar frame at their
    own time. Record `i` of a sensor depends on the seed, the sensor's index in the scene and `i` alone. The truth has every
    agent and the ego ("ego") each 0.05 s; x, y, z of box centers. `visible` is true where one LiDAR sweep has 20 points or
    more on the agent and one camera shows a third or more of its silhouette, at least half of its box; without `observe`
    it is omitted, and so are the log's labels. Its map features are all that is painted, where roads end, and their lanes.
    """
    moving = MovingScene.of(scene)
    cameras = {spec.name: camera_of(spec) for spec in scene.camera}
    lidars = {spec.name: Lidar(spec.name, spec.mount, raycast.mount_T_lidar(spec)) for spec in scene.lidar}
    specs = {spec.name: (index, spec) for index, spec in enumerate(scene.lidar)}
    rays = max((len(raycast.ray_pattern(spec)[0]) for spec in scene.lidar), default=1)

    @lru_cache(maxsize=max(1, MAX_CACHED_BYTES // (BYTES_PER_RAY * rays)))
    def cast(name: str, i: int) -> raycast.LabeledSweep:
        index, spec = specs[name]
        stamp, rng = int(raycast.sweep_stamps(spec, scene)[i]), np.random.default_rng([seed, 4, index, i])
        return raycast.cast_sweep(spec, moving, stamp, rng, _ground_reflectance(scene, seed))

    streams = _image_streams(moving, cameras, seed)
    for spec in scene.lidar:
        stamps = raycast.sweep_stamps(spec, scene)
        streams[spec.name] = Stream(spec.name, stamps, lambda i, name=spec.name: cast(name, i).sweep)
    frames: dict[str, list[FrameVisibility]] = {}
    t_s = np.arange(0, scene.duration_s + 1e-9, TRUTH_STEP_S)
    visible = None
    if observe:
        frames = visibility_by_camera(moving, cameras, _backdrop(scene, seed))
        sweeps = []
        for spec in scene.lidar:
            stamps, count = streams[spec.name].t_ns, len(moving.actors)
            hits = (cast(spec.name, i).hit for i in range(len(stamps)))
            points = np.array([np.bincount(h[h >= 0], minlength=count) for h in hits]).reshape(len(stamps), count)
            sweeps.append((stamps - round(NS_PER_S / spec.rate_hz / 2), points))
        t_ns = scene.start_ns + np.rint(t_s * NS_PER_S).astype(np.int64)
        visible = visible_at(t_ns, frames, sweeps, len(moving.actors))
    truth = _truth(moving, t_s, visible, seed)
    if observe:
        truth = replace(truth, provenance={**truth.provenance, "seen_ground": seen_ground(moving, cameras, cast)})
    log = Log(
        name=scene.name, format="synthetic", cameras=cameras, lidars=lidars, streams=streams,
        ego=None if moving.ego is None else _measured_poses(moving.ego, scene, np.random.default_rng([seed, 1])),
        ego_vehicle=EgoVehicle() if scene.ego is None else EgoVehicle(scene.ego.size_m, scene.ego.rear_axle_offset_m),
        map=truth.map, labels=labels_3d(scene, frames, moving.actors) if observe else None,
        image_labels=labels_2d(frames, moving.actors) if observe else {},
        reference_camera=scene.camera[0].name if scene.camera else None, digest=_digest(scene, seed),
        notes=(f"synthetic, seed {seed}",),
    )  # fmt: skip
    return log, truth


def _image_streams(moving: MovingScene, cameras: dict[str, Camera], seed: int) -> dict[str, Stream]:
    scene, light = moving.scene, light_of(moving.scene.environment)

    def read(camera: Camera, index: int, t_ns: NDArray[np.int64], i: int) -> NDArray[np.uint8]:
        map_T_cam = moving.map_T_mount(camera.mount, t_ns[i : i + 1])[0] @ camera.mount_T_cam
        rng = np.random.default_rng([seed, 2, index, i])
        bodies = [Body.of(actor, moving.seconds(t_ns[i])) for actor in moving.seen_from(camera.mount)]
        bodies += bodies_at(scene, moving.seconds(t_ns[i]))
        lamps: list[Lamp] = []
        if light.lamps > 0:  # street lights around the camera, and the headlights of all that drives
            lamps += street_lights(scene.road, map_T_cam[:2, 3])
            for actor in moving.seen_from("map"):
                if actor.spec.vehicle and actor.path is not None:
                    pose = actor.at(moving.seconds(t_ns[i])).map_T_agent()[0]
                    pose[2, 3] = 0.0
                    lamps += headlights(pose, actor.spec.box_m[0] / 2, actor.spec.box_m[1])
        return render(camera, map_T_cam, SceneInstant(_backdrop(scene, seed), bodies, light, tuple(lamps)), rng)

    out = {}
    for index, spec in enumerate(scene.camera):
        stamps = frame_stamps(spec, scene)
        if len(stamps) == 0:
            raise ConfigError(
                f"camera '{spec.name}': no frame falls within {scene.duration_s:g} s; change its offset_s"
            )
        out[spec.name] = Stream(spec.name, stamps, partial(read, cameras[spec.name], index, stamps))
    return out


@lru_cache(maxsize=2)
def _backdrop(scene: Scene, seed: int) -> Backdrop:
    return Backdrop.of(scene, seed)


@lru_cache(maxsize=2)
def _ground_reflectance(scene: Scene, seed: int) -> GroundReflectance:
    return GroundReflectance(Ground(GroundPlan.of(scene), seed), light_of(scene.environment).wetness)


def _measured_poses(ego: Actor, scene: Scene, rng: np.random.Generator) -> PoseTrack:
    """Poses of GNSS and IMU: each coordinate with a first-order Gauss-Markov error."""
    count = int(np.floor(scene.duration_s * scene.gnss.rate_hz + 1e-9)) + 1
    t = np.arange(count) / scene.gnss.rate_hz
    sigma = np.array([scene.gnss.position_sigma_m] * 3 + [np.deg2rad(scene.gnss.angle_sigma_deg)] * 3)
    keep = np.exp(-1 / (scene.gnss.rate_hz * GNSS_CORRELATION_S))
    error = np.empty((count, 6))
    error[0] = rng.normal(0, 1, 6) * sigma
    for k in range(1, count):
        error[k] = keep * error[k - 1] + np.sqrt(1 - keep**2) * rng.normal(0, 1, 6) * sigma
    exact = ego.map_T_axle(t)
    turn = transform(rotation_from_rpy(error[:, 3], error[:, 4], error[:, 5]), np.zeros((count, 3)))
    poses = exact @ turn
    poses[:, :3, 3] = exact[:, :3, 3] + error[:, :3]
    return PoseTrack(scene.start_ns + np.rint(t * NS_PER_S).astype(np.int64), poses)


def _truth(moving: MovingScene, t_s: Array, visible: NDArray[np.bool_] | None, seed: int) -> Scenario:
    scene, agents = moving.scene, []
    if moving.ego is not None:
        waypoints, offset_m = _waypoints(t_s, moving.ego.at(t_s), None), moving.ego.offset_m
        agents.append(Agent("ego", "car", moving.ego.spec.box_m, waypoints, rear_axle_offset_m=offset_m))
    for index, actor in enumerate(moving.actors):
        spec, shown = actor.spec, None if visible is None else visible[:, index]
        agents.append(Agent(
            spec.id, spec.category, spec.box_m, _waypoints(t_s, actor.at(t_s), shown), static=actor.path is None,
            rear_axle_offset_m=spec.rear_axle_offset_m, color={"rgb": list(spec.color), "name": name_of(spec.color)},
        ))  # fmt: skip
    at = scene.origin
    place = f"+lat_0={at.latitude_deg!r} +lon_0={at.longitude_deg!r}"
    projection = f"+proj=tmerc {place} +k=1 +x_0=0 +y_0=0 +ellps=WGS84 +units=m"
    frame = MapFrame(at.latitude_deg, at.longitude_deg, at.altitude_m, projection)
    provenance = {"source": "synthetic", "seed": seed, "scene_digest": _digest(scene, seed)}
    return Scenario(
        scene.name, scene.start_ns, float(t_s[-1]), tuple(agents), frame, provenance=provenance,
        map_features=map_features_of(scene), signals=signals_of(scene),
    )  # fmt: skip


def _waypoints(t_s: Array, states: ActorStates, visible: NDArray[np.bool_] | None) -> Waypoints:
    # Whole nanoseconds and nanometers: exact enough, and the file stays small.
    t, x, y, z, yaw, speed = (np.round(c, 9) for c in (t_s, *states.center_m.T, states.yaw_rad, states.speed_mps))
    seen, sigma = np.ones(len(t_s), dtype=bool), np.zeros(len(t_s))
    return Waypoints(t, x, y, z, wrap_angle(yaw), speed, seen, sigma, visible=visible)


def _digest(scene: Scene, seed: int) -> str:
    return hashlib.sha256(f"{scene!r} {seed}".encode()).hexdigest()


TRUTH_FILE = "truth.json"


def write_synthetic(
    scene: Scene,
    out: Path | str,
    *,
    seed: int = 0,
    overwrite: bool = False,
    jpeg_quality: int = 85,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Write a scene's log as a native log folder with its truth as `truth.json` in it, whole or not at all.

    A folder `out` that is there already is replaced only with `overwrite`, and only if it is a log. `jpeg_quality`: 1 to
    100. `progress(done, total)` is called after each record.

    Raises `ConfigError` when the folder may not be replaced or cannot be written.
    """
    from log2sim.logs.native.writer import refuse_target, write_log

    target = Path(out)
    refuse_target(target, overwrite=overwrite)
    check_folder(target, overwrite=overwrite)
    log, truth = synthesize(scene, seed=seed)
    poses: Literal["gnss", "poses"] = scene.ego.poses if scene.ego is not None else "poses"
    with replaced_folder(target, overwrite=overwrite) as folder:
        write_log(log, folder, jpeg_quality=jpeg_quality, ego=poses, progress=progress)
        truth.save(folder / TRUTH_FILE)
