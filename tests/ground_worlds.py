"""A log over a sloping road whose height, paint and reflectivity are known at every place."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from log2sim.datatypes import Agent, Lidar, Log, Scenario, Stream, Sweep
from log2sim.geometry import Array, Camera, PoseTrack, apply, rotation_from_rpy, transform, undistort

SLOPE = 0.05
EGO_R_CAM = np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]])
DURATION_S, SPEED_MPS = 2.0, 5.0


def height_at(xy: Array) -> Array:
    """Height of the road, m, with a curb of 12 cm at y = 6."""
    return SLOPE * xy[..., 0] + 0.12 * (xy[..., 1] > 6.0)


def is_paint(xy: Array) -> Array:
    """Squares of 1 m, every second of them painted."""
    return (np.floor(xy[..., 0]) + np.floor(xy[..., 1])) % 2 > 0


@dataclass(frozen=True)
class World:
    """What differs between the logs.

    Attributes
    ----------
    camera_shift_m : float
        By how much the cameras are off their mounts to the left, which the log does not say.
    gains : tuple of float
        Exposure of each camera.
    lidar_scale : float
        Of the intensities.
    """

    camera_shift_m: float = 0.0
    gains: tuple[float, ...] = (1.0,)
    lidar_scale: float = 1.0
    lidars: int = 1
    seed: int = 5


def poses(t_s: Array) -> Array:
    """Poses (T, 4, 4) of an ego that drives up the slope."""
    xy = np.stack([SPEED_MPS * t_s, np.zeros_like(t_s)], axis=-1)
    pitch = np.full(len(t_s), -np.arctan(SLOPE))
    return transform(rotation_from_rpy(0 * pitch, pitch, 0 * pitch), np.column_stack([xy, height_at(xy)]))


def world_log(world: World = World()) -> Log:
    """A log with a camera for each gain and LiDARs at 10 Hz."""
    t = np.arange(0, 21) * 100_000_000 + 10**18
    ego = PoseTrack(t, poses((t - t[0]) / 1e9))
    cameras, streams, lidars = {}, {}, {}
    for k, gain in enumerate(world.gains):
        yaw = 0.5 * (k - (len(world.gains) - 1) / 2)
        mount = transform(rotation_from_rpy(0.0, 0.35, yaw) @ EGO_R_CAM, [1.5, 0.0, 1.6])
        camera = Camera(f"c{k}", 480, 320, np.array([[300.0, 0, 240], [0, 300.0, 160], [0, 0, 1]]), "ego", mount)
        cameras[camera.name] = camera
        streams[camera.name] = Stream(camera.name, t, _pictures(camera, ego, gain, world.camera_shift_m))
    for k in range(world.lidars):
        lidar = Lidar(f"l{k}", "ego", transform(np.eye(3), [0.5, 0.4 * k, 1.8]))
        lidars[lidar.name] = lidar
        streams[lidar.name] = Stream(lidar.name, t, _sweeps(lidar, ego, world, world.lidar_scale * 10.0**-k))
    return Log("road", "log2sim", cameras, lidars, streams, ego, reference_camera=next(iter(cameras), None))


def empty_scenario(log: Log, *agents: Agent) -> Scenario:
    """The span of the log, with these agents."""
    return Scenario("road", int(log.ego.t_ns[0]) if log.ego else 10**18, DURATION_S, agents)


def _pictures(camera: Camera, ego: PoseTrack, gain: float, shift_m: float) -> Callable[[int], np.ndarray]:
    v, u = np.mgrid[: camera.height_px, : camera.width_px].astype(float)
    rays = np.column_stack([undistort(camera, np.column_stack([u.ravel(), v.ravel()])), np.ones(u.size)])

    def read(i: int) -> np.ndarray:
        map_T_cam = ego.map_T_ego[i] @ transform(np.eye(3), [0, shift_m, 0]) @ camera.mount_T_cam
        out = rays @ map_T_cam[:3, :3].T
        # On the plane of the road: the curb is far to the side.
        normal = np.array([-SLOPE, 0, 1.0])
        down = out @ normal < -1e-6
        far = np.where(down, -(map_T_cam[:3, 3] @ normal) / np.where(down, out @ normal, 1.0), 0.0)
        xy = map_T_cam[:2, 3] + far[:, None] * out[:, :2]
        value = np.where(down, np.where(is_paint(xy), 180.0, 60.0) * gain, 230.0)
        return np.repeat(np.rint(np.clip(value, 0, 255)).reshape(u.shape)[..., None], 3, axis=2).astype(np.uint8)

    return read


def _sweeps(lidar: Lidar, ego: PoseTrack, world: World, scale: float) -> Callable[[int], Sweep]:
    azimuth, elevation = np.meshgrid(np.deg2rad(np.arange(0, 360, 0.4)), np.deg2rad(np.arange(-25, -2, 0.5)))
    a, e = azimuth.ravel(), elevation.ravel()
    rays = np.column_stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])

    def read(i: int) -> Sweep:
        rng = np.random.default_rng([world.seed, i])
        map_T_lidar = ego.map_T_ego[i] @ lidar.mount_T_lidar
        out, origin = rays @ map_T_lidar[:3, :3].T, map_T_lidar[:3, 3]
        normal, far = np.array([-SLOPE, 0, 1.0]), np.zeros(len(rays))
        for curb in (0.0, 0.12):
            reach = (curb - origin @ normal) / (out @ normal)
            xy = origin[:2] + reach[:, None] * out[:, :2]
            on_it = (xy[:, 1] > 6.0) == (curb > 0)
            far = np.where(on_it & (reach > 0), reach, far)
        known = (far > 0) & (far < 60)
        far = far[known] + rng.normal(0, 0.02, known.sum())
        xyz = rays[known] * far[:, None]
        paint = is_paint(apply(map_T_lidar, xyz)[:, :2])
        strength = scale * np.where(paint, 60.0, 15.0) * (10.0 / far) ** 2 * rng.uniform(0.8, 1.2, len(far))
        return Sweep(int(ego.t_ns[i]), xyz.astype(np.float32), "lidar", None, None, strength.astype(np.float32))

    return read
