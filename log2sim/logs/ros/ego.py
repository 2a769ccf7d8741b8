"""The vehicle's frame in a recording, and where in it the ego's origin and the road are."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from log2sim.datatypes import EgoVehicle, Lidar, Stream, Sweep
from log2sim.errors import RecordError
from log2sim.geometry import Array, apply, inverse, rotation_from_quaternion, transform
from log2sim.logs.ros.frames import FrameTree
from log2sim.logs.ros.settings import EgoSettings

# Usual names of the frame of a vehicle, first that of REP 105.
BASE_FRAMES = ("base_link", "base_footprint", "ego_vehicle", "vehicle", "rear_axle", "base", "chassis", "ego")
GROUND_FRAME = "base_footprint"
# x forward, y left, z up out of the axes of an image: x right, y down, z forward.
CAMERA_R_EGO = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])

# The road is looked for in the first sweep around the vehicle, well below the sensor: a car's LiDAR is at least so high.
ROAD_RADIUS_M = (3.0, 20.0)
MIN_SENSOR_HEIGHT_M, MAX_SENSOR_HEIGHT_M = 0.5, 100.0
ROAD_BIN_M = 0.05
MIN_ROAD_POINTS = 200


@dataclass(frozen=True, eq=False)
class EgoFrame:
    """The vehicle's frame.

    Attributes
    ----------
    base : str or None
        Its name; None for a recording of roadside sensors.
    base_T_ego : (4, 4) float64
    ground_z_m : float or None
        Height of the road in the ego frame; None where it has to be measured.
    vehicle : EgoVehicle
    notes : tuple of str
    """

    base: str | None
    base_T_ego: Array
    ground_z_m: float | None
    vehicle: EgoVehicle
    notes: tuple[str, ...]


def choose_base(
    tree: FrameTree, sensor_frames: list[str], pose_frames: Iterable[str], fixed_frames: tuple[str, ...], given: str
) -> tuple[str | None, str]:
    """Choose the vehicle's frame, and say why.

    Parameters
    ----------
    tree : FrameTree
    sensor_frames : list of str
        Frames of the LiDARs, then of the cameras.
    pose_frames : iterable of str
        Frames whose poses odometry gives.
    fixed_frames : tuple of str
        Names of frames that do not move.
    given : str
        That of the settings; "" without one.
    """
    if given:
        return given, "the settings name it"
    pose_frames = list(pose_frames)
    known = tree.frames | set(pose_frames) | set(sensor_frames)
    reasons = {frame: "by its name" for frame in BASE_FRAMES if frame in known}
    reasons |= {frame: "odometry gives its poses" for frame in pose_frames if frame not in reasons}
    # One that sensors are fixed to goes before one that they are not.
    ordered = sorted(reasons, key=lambda f: all(tree.mount(f, sensor) is None for sensor in sensor_frames))
    if ordered:
        return ordered[0], reasons[ordered[0]]
    for frame in sensor_frames:
        root = tree.rigid_root(frame)
        if root not in fixed_frames:
            return root, f"all sensors are fixed to it, and no frame is named {BASE_FRAMES[0]}"
    return None, "the sensors stand still"


def place_ego(base: str | None, settings: EgoSettings, tree: FrameTree, camera_frames: Collection[str]) -> EgoFrame:
    """Place the ego in the vehicle's frame by the settings, else by the name of the frame."""
    notes = []
    rotation = rotation_from_quaternion(settings.rotation_wxyz)
    given = settings.model_fields_set
    if base is not None and base in camera_frames and "rotation_wxyz" not in given:
        rotation = CAMERA_R_EGO
    base_T_ego = transform(rotation, settings.origin_m)
    default = EgoVehicle()
    offset_m = settings.rear_axle_offset_m
    vehicle = EgoVehicle(
        settings.size_m or default.size_m, default.rear_axle_offset_m if offset_m is None else offset_m
    )
    if base is None:
        return EgoFrame(None, np.eye(4), settings.ground_z_m or 0.0, vehicle, ())
    if "origin_m" not in given:
        notes.append(f"the frame '{base}' is taken to be at the middle of the rear axle (ego.origin_m in the settings)")
    if settings.size_m is None:
        notes.append("the size of the ego is not known; that of a usual car is taken (ego.size_m)")
    ground_m = settings.ground_z_m
    if ground_m is None:
        ground_m = _known_ground_m(base, base_T_ego, tree, given, notes)
    return EgoFrame(base, base_T_ego, ground_m, vehicle, tuple(notes))


def _known_ground_m(base: str, base_T_ego: Array, tree: FrameTree, given: set[str], notes: list[str]) -> float | None:
    footprint = tree.mount(base, GROUND_FRAME) if GROUND_FRAME in tree.frames and base != GROUND_FRAME else None
    if footprint is not None:
        return float((inverse(base_T_ego) @ footprint)[2, 3])
    if base in BASE_FRAMES or "origin_m" in given:
        where = "ego.origin_m" if "origin_m" in given else f"'{base}'"
        notes.append(f"{where} is taken to be at the height of the road (ego.ground_z_m)")
        return 0.0
    return None


def measure_ground_m(sweep: Sweep, ego_T_lidar: Array) -> float:
    """Measure the height of the road in the ego frame: the most frequent one of points around and below the sensor.

    Raises
    ------
    RecordError
        When there are too few points there.
    """
    points = apply(ego_T_lidar, sweep.xyz_m)
    radius = np.hypot(points[:, 0] - ego_T_lidar[0, 3], points[:, 1] - ego_T_lidar[1, 3])
    around = (radius > ROAD_RADIUS_M[0]) & (radius < ROAD_RADIUS_M[1])
    height = ego_T_lidar[2, 3] - points[:, 2]
    z = points[around & (height > MIN_SENSOR_HEIGHT_M) & (height < MAX_SENSOR_HEIGHT_M), 2]
    if len(z) < MIN_ROAD_POINTS:
        raise RecordError(f"{len(z)} points around and below the sensor, too few to find the road")
    counts = np.bincount(np.floor((z - z.min()) / ROAD_BIN_M).astype(np.int64))
    mode_m = z.min() + (counts.argmax() + 0.5) * ROAD_BIN_M
    return float(np.median(z[np.abs(z - mode_m) < 2 * ROAD_BIN_M]))


def measure_road(
    frame: EgoFrame, lidars: Mapping[str, Lidar], streams: Mapping[str, Stream]
) -> tuple[float, tuple[str, ...]]:
    """Measure the height of the road in the ego frame in a sweep, with remarks; 0 where no LiDAR shows it."""
    notes = []
    for name, lidar in lidars.items():
        try:
            ground_m = measure_ground_m(streams[name].read(0), lidar.mount_T_lidar)
        except RecordError as problem:
            notes.append(f"{name}: {problem}")
            continue
        side = "below" if ground_m <= 0 else "above"
        notes.append(
            f"the road is {abs(ground_m):.2f} m {side} the origin of the ego in the frame '{frame.base}', measured in the "
            f"first sweep of {name} (ego.ground_z_m)"
        )
        return ground_m, tuple(notes)
    notes.append(f"the height of the road in '{frame.base}' is not known; taken as 0 (ego.ground_z_m)")
    return 0.0, tuple(notes)
