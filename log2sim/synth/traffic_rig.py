"""The camera beside the LiDAR of a random scene, and the light and weather that a scene has."""

from __future__ import annotations

from dataclasses import dataclass
from typing import get_args

import numpy as np

from log2sim.geometry import Array, Camera, inverse, rotation_from_rpy, transform
from log2sim.synth.lidar_models import LIDAR_MODELS, LidarModel, lidar_model
from log2sim.synth.scene import Environment
from log2sim.synth.traffic import Mount, TrafficScene

# KITTI's camera 2, which sits 0.27 m ahead of the LiDAR and 0.08 m lower (Geiger et al., IJRR 2013).
KITTI_SIZE_PX, KITTI_FOCAL_PX, KITTI_CENTER_PX = (1242, 375), 721.5377, (609.5593, 172.854)
KITTI_OFFSET_M = (0.27, 0.0, -0.08)
# At the roadside: a wide view of the road below.
ROADSIDE_SIZE_PX, ROADSIDE_FOCAL_PX = (960, 600), 600.0
ROADSIDE_PITCH_DEG, ROADSIDE_OFFSET_M = 17.0, (0.0, 0.0, 0.5)
DEFAULT_LIDAR: dict[str, str] = {"vehicle": "hdl64e", "roadside": "rslidar16-roadside"}
LIGHT_SHARES = {"noon": 0.4, "overcast": 0.25, "dusk": 0.15, "night": 0.2}
WEATHER_SHARES = {"clear": 0.7, "rain": 0.15, "fog": 0.15}
VISIBILITY_M, RAIN_MM_H = (50.0, 300.0), (2.0, 40.0)  # between which they are drawn
FORWARD_R_CAM = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0.0]])


@dataclass(frozen=True, eq=False)
class Rig:
    """Camera and LiDAR at one time.

    Attributes
    ----------
    camera : Camera
    map_T_cam : (4, 4) float64
    map_T_lidar : (4, 4) float64
    map_T_level : (4, 4) float64
        A frame at the camera with x right, y down along gravity and z forward: the camera's own where it looks level.
    lidar_height_m : float
        Above the ground below it.
    """

    camera: Camera
    map_T_cam: Array
    map_T_lidar: Array
    map_T_level: Array
    lidar_height_m: float


def camera_for(mount: Mount) -> tuple[int, int, Array]:
    """Width, height and intrinsics (3, 3) of the camera at a mount."""
    if mount == "vehicle":
        (width, height), focal, (cx, cy) = KITTI_SIZE_PX, KITTI_FOCAL_PX, KITTI_CENTER_PX
    else:
        (width, height), focal = ROADSIDE_SIZE_PX, ROADSIDE_FOCAL_PX
        cx, cy = (width - 1) / 2, (height - 1) / 2
    return width, height, np.array([[focal, 0, cx], [0, focal, cy], [0, 0, 1]])


def rig_of(scene: TrafficScene) -> Rig:
    """Place the camera of a scene at time 0: it looks where the LiDAR does, level on a vehicle, down at the roadside."""
    R, position = scene.sensor.rotation, scene.sensor.position_m
    yaw = float(np.arctan2(R[1, 0], R[0, 0]))
    offset = KITTI_OFFSET_M if scene.mount == "vehicle" else ROADSIDE_OFFSET_M
    pitch = 0.0 if scene.mount == "vehicle" else np.deg2rad(ROADSIDE_PITCH_DEG)
    eye = position + rotation_from_rpy(0.0, 0.0, yaw) @ np.array(offset)
    level = transform(rotation_from_rpy(0.0, 0.0, yaw) @ FORWARD_R_CAM, eye)
    map_T_cam = transform(rotation_from_rpy(0.0, pitch, yaw) @ FORWARD_R_CAM, eye)
    width, height, K = camera_for(scene.mount)
    camera = Camera("camera", width, height, K, "map", map_T_cam)
    return Rig(camera, map_T_cam, transform(R, position), level, float(position[2] - scene.surface.elevation(position)))


def mount_T_cam_of(mount: Mount, rig: Rig) -> Array:
    """Pose of the camera relative to the LiDAR, for a rig that moves as one piece."""
    if mount == "roadside":
        return np.asarray(inverse(rig.map_T_lidar) @ rig.map_T_cam)
    return transform(FORWARD_R_CAM, np.array(KITTI_OFFSET_M))


def sensor_named(name: str | None, mount: Mount) -> LidarModel | None:
    """Return the LiDAR of a name or TOML file; by default the usual one of the mount, for "random" None.

    Raises
    ------
    ConfigError
        For a name that is not known or a file that cannot be read.
    """
    if name == "random":
        return None
    return LIDAR_MODELS[DEFAULT_LIDAR[mount]] if name is None else lidar_model(name)


def draw_environment(rng: np.random.Generator, light: str | None, weather: str | None) -> Environment:
    """Draw light and weather; what is given stays, and does not change what else is drawn."""
    lights, weathers = list(LIGHT_SHARES), list(WEATHER_SHARES)
    drawn_light = str(rng.choice(lights, p=list(LIGHT_SHARES.values())))
    drawn_weather = str(rng.choice(weathers, p=list(WEATHER_SHARES.values())))
    visibility, rain = rng.uniform(*VISIBILITY_M), rng.uniform(*RAIN_MM_H)
    return Environment.model_validate(
        {
            "light": light or drawn_light,
            "weather": weather or drawn_weather,
            "visibility_m": round(float(visibility), 1),
            "rain_mm_h": round(float(rain), 1),
        }
    )


def known(field: str) -> tuple[str, ...]:
    """Values that a field of the environment may have."""
    return tuple(str(v) for v in get_args(Environment.model_fields[field].annotation))
