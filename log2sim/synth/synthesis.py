"""From a scene to a log and its truth."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Agent, EgoVehicle, Lidar, Log, MapFrame, Scenario, Stream, Waypoints
from log2sim.errors import ConfigError
from log2sim.geometry import NS_PER_S, Array, Camera, PoseTrack, rotation_from_rpy, transform, wrap_angle
from log2sim.synth import raycast
from log2sim.synth.actors import Actor, EgoMotion, States, actors_of
from log2sim.synth.cameras import camera_of, frame_stamps
from log2sim.synth.labels import Sighting, labels_2d, labels_3d, sightings, visible_at
from log2sim.synth.scene import Scene

TRUTH_STEP_S = 0.05
KEPT_SWEEPS = 64
GNSS_MEMORY_S = 2.0  # over which the errors of GNSS and IMU wander


def synthesize(scene: Scene, *, seed: int = 0, observe: bool = True) -> tuple[Log, Scenario]:
    """Make a log, whose records are rendered and cast when read, and its exact truth.

    Parameters
    ----------
    observe
        Work out what each camera and LiDAR sees of each agent: the truth's `visible` and the log's labels. Takes a
        look at every frame and sweep; without it both are left out.

    Returns
    -------
    log : Log
        `ego` has the errors of GNSS and IMU. A sweep's stamp is its end; its points are in the lidar frame at their own
        time. Record `i` of a sensor depends on the seed, the sensor's place in the scene and `i` alone.
    truth : Scenario
        Every agent and the ego ("ego") each 0.05 s; x, y, z of box centers. `visible` is true where one LiDAR sweep has
        20 points or more on the agent and one camera shows a third or more of its silhouette, at least half of its box.
    """
    ego, actors = EgoMotion(scene), actors_of(scene)
    cameras = {spec.name: camera_of(spec) for spec in scene.camera}
    lidars = {spec.name: Lidar(spec.name, "ego", raycast.ego_T_lidar(spec)) for spec in scene.lidar}
    casts = _casts(scene, ego, actors, seed)
    streams = _image_streams(scene, cameras, ego, actors, seed)
    for spec in scene.lidar:
        stamps = raycast.sweep_stamps(spec, scene)
        streams[spec.name] = Stream(spec.name, stamps, _reader(casts, spec.name))
    seen: dict[str, list[Sighting]] = {}
    if observe:
        seen = sightings(scene, cameras, ego, actors, _backdrop(scene, seed))
    t_s = np.arange(0, scene.duration_s + 1e-9, TRUTH_STEP_S)
    visible = visible_at(t_s, scene, seen, streams, casts, len(actors)) if observe else None
    truth = _truth(scene, ego, actors, t_s, visible, seed)
    log = Log(
        name=scene.name,
        format="synthetic",
        cameras=cameras,
        lidars=lidars,
        streams=streams,
        ego=_measured_poses(scene, ego, np.random.default_rng([seed, 1])),
        ego_vehicle=EgoVehicle(scene.ego.size_m, scene.ego.rear_axle_offset_m),
        map=truth.map,
        labels=labels_3d(scene, seen, actors, cameras) if observe else None,
        image_labels=labels_2d(seen, actors) if observe else {},
        reference_camera=scene.camera[0].name if scene.camera else None,
        digest=_digest(scene, seed),
        notes=(f"synthetic, seed {seed}",),
    )
    return log, truth


def _image_streams(
    scene: Scene, cameras: dict[str, Camera], ego: EgoMotion, actors: tuple[Actor, ...], seed: int
) -> dict[str, Stream]:
    def read(camera: Camera, place: int, t_ns: NDArray[np.int64], i: int) -> NDArray[np.uint8]:
        from log2sim.synth.render import render

        map_T_cam = ego.map_T_ego_ns(t_ns[i : i + 1])[0] @ camera.mount_T_cam
        rng = np.random.default_rng([seed, 2, place, i])
        return render(
            camera, map_T_cam, _backdrop(scene, seed), actors, (int(t_ns[i]) - scene.start_ns) / NS_PER_S, rng
        )

    out = {}
    for place, spec in enumerate(scene.camera):
        stamps = frame_stamps(spec, scene)
        if len(stamps) == 0:
            raise ConfigError(
                f"camera '{spec.name}': no frame falls within {scene.duration_s:g} s; change its offset_s"
            )
        out[spec.name] = Stream(spec.name, stamps, _bound(read, cameras[spec.name], place, stamps))
    return out


def _bound(read: Callable[..., Any], *arguments: Any) -> Callable[[int], Any]:
    return lambda i: read(*arguments, i)


@lru_cache(maxsize=2)
def _backdrop(scene: Scene, seed: int) -> Any:
    from log2sim.synth.backdrop import Backdrop

    return Backdrop(scene, seed)


def _casts(scene: Scene, ego: EgoMotion, actors: tuple[Actor, ...], seed: int) -> Callable[[str, int], raycast.Cast]:
    places = {spec.name: (place, spec) for place, spec in enumerate(scene.lidar)}

    @lru_cache(maxsize=KEPT_SWEEPS)
    def cast(name: str, i: int) -> raycast.Cast:
        place, spec = places[name]
        stamp = int(raycast.sweep_stamps(spec, scene)[i])
        return raycast.cast(spec, scene, ego, actors, stamp, np.random.default_rng([seed, 4, place, i]))

    return cast


def _reader(casts: Callable[[str, int], raycast.Cast], name: str) -> Callable[[int], Any]:
    return lambda i: casts(name, i).sweep


def _measured_poses(scene: Scene, ego: EgoMotion, rng: np.random.Generator) -> PoseTrack:
    """Poses of GNSS and IMU: each coordinate off by a first-order Gauss-Markov error."""
    count = int(np.floor(scene.duration_s * scene.gnss.rate_hz + 1e-9)) + 1
    t = np.arange(count) / scene.gnss.rate_hz
    sigma = np.array([scene.gnss.position_sigma_m] * 3 + [np.deg2rad(scene.gnss.angle_sigma_deg)] * 3)
    keep = np.exp(-1 / (scene.gnss.rate_hz * GNSS_MEMORY_S))
    error = np.empty((count, 6))
    error[0] = rng.normal(0, 1, 6) * sigma
    for k in range(1, count):
        error[k] = keep * error[k - 1] + np.sqrt(1 - keep**2) * rng.normal(0, 1, 6) * sigma
    exact = ego.map_T_ego(t)
    turn = transform(rotation_from_rpy(error[:, 3], error[:, 4], error[:, 5]), np.zeros((count, 3)))
    poses = exact @ turn
    poses[:, :3, 3] = exact[:, :3, 3] + error[:, :3]
    return PoseTrack(scene.start_ns + np.rint(t * NS_PER_S).astype(np.int64), poses)


def _truth(
    scene: Scene, ego: EgoMotion, actors: tuple[Actor, ...], t_s: Array, visible: NDArray[np.bool_] | None, seed: int
) -> Scenario:
    agents = [_ego_agent(scene, ego, t_s)]
    for index, actor in enumerate(actors):
        rgb = list(actor.spec.color)
        agents.append(
            Agent(
                id=actor.spec.id,
                category=actor.spec.category,
                size_m=actor.spec.box_m,
                waypoints=_waypoints(t_s, actor.at(t_s), None if visible is None else visible[:, index]),
                static=actor.trajectory is None,
                rear_axle_offset_m=actor.spec.rear_axle_offset_m,
                color={"rgb": rgb, "name": color_name(actor.spec.color)},
            )
        )
    origin = scene.origin
    frame = MapFrame(
        origin.latitude_deg,
        origin.longitude_deg,
        origin.altitude_m,
        f"+proj=tmerc +lat_0={origin.latitude_deg!r} +lon_0={origin.longitude_deg!r} +k=1 +x_0=0 +y_0=0 +ellps=WGS84 +units=m",
    )
    provenance = {"source": "synthetic", "seed": seed, "scene_digest": _digest(scene, seed)}
    return Scenario(scene.name, scene.start_ns, float(t_s[-1]), tuple(agents), frame, provenance=provenance)


def _ego_agent(scene: Scene, ego: EgoMotion, t_s: Array) -> Agent:
    motion = ego.trajectory.at(t_s)
    heading = np.stack([np.cos(motion.yaw_rad), np.sin(motion.yaw_rad)], 1)
    xy = motion.xy_m + scene.ego.rear_axle_offset_m * heading
    center = np.column_stack([xy, np.full(len(t_s), scene.ego.size_m[2] / 2)])
    states = States(center, motion.yaw_rad, motion.speed_mps, motion.way_m)
    return Agent(
        "ego", "car", scene.ego.size_m, _waypoints(t_s, states, None), rear_axle_offset_m=scene.ego.rear_axle_offset_m
    )


def _waypoints(t_s: Array, states: States, visible: NDArray[np.bool_] | None) -> Waypoints:
    n = len(t_s)
    return Waypoints(
        # Whole nanoseconds and nanometers: exact enough, and the file stays small.
        t_s=np.round(t_s, 9),
        x_m=np.round(states.center_m[:, 0], 9),
        y_m=np.round(states.center_m[:, 1], 9),
        z_m=np.round(states.center_m[:, 2], 9),
        yaw_rad=wrap_angle(np.round(states.yaw_rad, 9)),
        speed_mps=np.round(states.speed_mps, 9),
        observed=np.ones(n, dtype=bool),
        sigma_xy_m=np.zeros(n),
        visible=visible,
    )


# The names that people give to colors, by their place in hue, saturation and value.
_HUES = (
    (20, "red"),
    (45, "orange"),
    (70, "yellow"),
    (165, "green"),
    (200, "cyan"),
    (260, "blue"),
    (330, "purple"),
    (360, "red"),
)


def color_name(rgb: tuple[int, int, int]) -> str:
    """A common name of a color."""
    import colorsys

    hue, saturation, value = colorsys.rgb_to_hsv(*(c / 255 for c in rgb))
    if value < 0.2:
        return "black"
    if saturation < 0.18:
        return "white" if value > 0.85 else "silver" if value > 0.6 else "gray"
    return next(name for end, name in _HUES if hue * 360 <= end)


def _digest(scene: Scene, seed: int) -> str:
    return hashlib.sha256(f"{scene!r} {seed}".encode()).hexdigest()
