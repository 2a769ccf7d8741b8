"""Shared by the readers of KITTI raw drives and of the KITTI tracking layout: vehicle, calibration chain, oxts, sweeps.

The chain is imu -> velo -> cam 0 -> rectified cam 0 -> camera i. All its links are rigid except the projections P_i, whose
last column holds the position of camera i relative to the rectified camera 0.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import EgoVehicle, Lidar, MapFrame, Stream, Sweep
from log2sim.errors import LogError
from log2sim.geometry import Array, Camera, inverse, nearest_rotation, rotation_from_rpy, transform
from log2sim.input_files import read_file
from log2sim.logs.pose_checks import MAX_POSITION_M
from log2sim.logs.sweeps import read_sweep, sweep_of
from log2sim.numerals import parse_float

EARTH_RADIUS_M = 6378137.0
ROTATION_TOLERANCE = 1e-3
MAX_TEXT_BYTES = 64 * 1024 * 1024
OXTS_FIELDS = 30

# The IMU is 0.93 m above the road (Geiger et al., Vision meets Robotics, IJRR 2013, fig. 1). That it is 0.30 m ahead of the
# rear axle was measured: lateral velocity over yaw rate of drive 2011_09_26_0005 gives 0.32 +- 0.03 m. The car's
# center line is taken to pass under the scanner, 0.32 m to the right of the IMU.
EGO_T_IMU = transform(np.eye(3), [0.30, 0.32, 0.93])
# A Volkswagen Passat B6 estate, by its data sheet.
EGO_VEHICLE = EgoVehicle(size_m=(4.77, 1.82, 1.52), rear_axle_offset_m=1.25)


@dataclass(frozen=True, eq=False)
class Rig:
    """Calibration of one drive.

    Attributes
    ----------
    ego_T_velo : (4, 4) float64
    ego_T_rect : (4, 4) float64
        Pose of the rectified camera 0.
    projections : mapping of int to (3, 4) float64
        P by number of camera.
    """

    ego_T_velo: Array
    ego_T_rect: Array
    projections: Mapping[int, Array]

    def camera(self, number: int, width_px: int, height_px: int) -> Camera:
        """Camera `number` of the rectified images, called "image_0N"."""
        P = self.projections[number]
        cam_T_rect = transform(np.eye(3), np.linalg.solve(P[:, :3], P[:, 3]))
        return Camera(
            f"image_{number:02d}", width_px, height_px, P[:, :3], "ego", self.ego_T_rect @ inverse(cam_T_rect)
        )

    def lidar(self) -> Lidar:
        """Return the Velodyne."""
        return Lidar("velodyne", "ego", self.ego_T_velo)


def rig_of(velo_T_imu: Array, cam_T_velo: Array, rect_R_cam: Array, projections: Mapping[int, Array]) -> Rig:
    """Chain the links of the calibration."""
    ego_T_velo = EGO_T_IMU @ inverse(velo_T_imu)
    rect_T_velo = transform(rect_R_cam, np.zeros(3)) @ cam_T_velo
    return Rig(ego_T_velo, ego_T_velo @ inverse(rect_T_velo), projections)


def read_text(path: Path) -> str:
    """Read a small text file; raise a `LogError` that names it where that fails."""
    data = read_file(path, MAX_TEXT_BYTES, LogError, missing="no such file; KITTI stores it with the drive's data")
    return data.decode("utf-8", errors="replace")


def read_calibration(path: Path) -> dict[str, Array]:
    """Numbers by key of a KITTI calibration file; none for lines that hold words.

    Raises
    ------
    LogError
        For a key that occurs twice, and for one that nothing follows, as where a file is cut.
    """
    values: dict[str, Array] = {}
    for line in filter(None, map(str.strip, read_text(path).splitlines())):
        key, _, rest = line.partition(" ")
        if not rest:
            raise LogError(f"{path}: nothing follows '{key[:40]}'; expected numbers")
        try:
            numbers = np.array([parse_float(word) for word in rest.split()])
        except ValueError:
            numbers = np.zeros(0)  # words are in no entry that is used
        if key.removesuffix(":") in values:
            raise LogError(
                f"{path}: entry '{key.removesuffix(':')[:40]}' occurs twice; remove the one of the two that is wrong"
            )
        values[key.removesuffix(":")] = numbers
    return values


def calibration_entry(calibration: Mapping[str, Array], path: Path, shape: tuple[int, ...], *keys: str) -> Array:
    """Entry of a calibration under the first of `keys` that it has, as an array of `shape`; `LogError` without one."""
    key = next((k for k in keys if k in calibration), None)
    if key is None:
        raise LogError(f"{path}: no entry '{keys[0]}'; expected {int(np.prod(shape))} numbers after it")
    values = calibration[key]
    if values.size != np.prod(shape) or not np.isfinite(values).all():
        raise LogError(f"{path}, entry '{key}': {values.size} numbers, expected {int(np.prod(shape))} finite ones")
    return values.reshape(shape)


def checked_rotation(rotation: Array, where: str) -> Array:
    """Return the nearest rotation matrix (3, 3); `LogError` when the given one is off by more than 1e-3."""
    off = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    determinant = float(np.linalg.det(rotation))
    if off > ROTATION_TOLERANCE or determinant < 0:
        raise LogError(
            f"{where}: not a rotation matrix: R R^T is off the identity by {off:.2g} (at most {ROTATION_TOLERANCE:g} "
            f"is allowed), determinant {determinant:.3g} (expected +1); check the calibration"
        )
    return nearest_rotation(rotation)


def checked_projection(P: Array, where: str) -> Array:
    """Return P (3, 4) of a rectified camera; `LogError` when it is none."""
    if not (P[0, 0] > 0 and P[1, 1] > 0 and P[2, 2] == 1 and P[1, 0] == 0 and not P[2, :2].any()):
        raise LogError(f"{where}: K is {P[:, :3].tolist()}, expected positive focal lengths and a last row 0 0 1")
    return P


def poses_from_oxts(rows: Array) -> tuple[Array, MapFrame]:
    """Ego poses (N, 4, 4) and the map frame of oxts records (N, >= 6): lat, lon, alt, roll, pitch, yaw.

    Notes
    -----
    Mercator on a sphere of 6378137 m scaled by the cosine of the first latitude, as in the KITTI development kit (Geiger et
    al., 2013), so that lengths near the first record are true. The origin is the first fix, put on the road.
    """
    latitude, longitude, altitude = rows[:, 0], rows[:, 1], rows[:, 2]
    scale = np.cos(np.radians(latitude[0]))
    x = scale * EARTH_RADIUS_M * np.radians(longitude)
    y = scale * EARTH_RADIUS_M * np.arctanh(np.sin(np.radians(latitude)))
    ground_m = float(altitude[0] - EGO_T_IMU[2, 3])
    position = np.stack([x - x[0], y - y[0], altitude - ground_m], axis=1)
    map_T_imu = transform(rotation_from_rpy(rows[:, 3], rows[:, 4], rows[:, 5]), position)
    projection = (
        f"+proj=merc +R={EARTH_RADIUS_M:.0f} +lon_0={float(longitude[0])!r} +k_0={float(scale)!r} +x_0=0 "
        f"+y_0={-float(y[0])!r} +units=m +no_defs"
    )
    frame = MapFrame(float(latitude[0]), float(longitude[0]), ground_m, projection)
    return map_T_imu @ inverse(EGO_T_IMU), frame


def parse_oxts(text: str, where: str) -> Array:
    """Lines of oxts records as (N, 30); every line must hold as many finite numbers."""
    rows = []
    for k, line in enumerate(text.splitlines(), start=1):
        if not line.strip():
            continue
        try:
            row = [parse_float(word) for word in line.split()]
        except ValueError:
            row = []
        if len(row) < OXTS_FIELDS or not (np.abs(row) <= MAX_POSITION_M).all():
            raise LogError(f"{where}, line {k}: expected {OXTS_FIELDS} finite numbers (lat lon alt roll pitch yaw ...)")
        if abs(row[0]) >= 90:
            raise LogError(f"{where}, line {k}: latitude {row[0]:g}, expected less than 90 degrees")
        rows.append(row[:OXTS_FIELDS])
    return np.array(rows).reshape(-1, OXTS_FIELDS)


def sweep_stream(
    t_ns: NDArray[np.int64], begin_ns: NDArray[np.int64], end_ns: NDArray[np.int64], files: list[Path]
) -> Stream:
    """Stream of Velodyne sweeps; the scanner faces forward at `t_ns` and backward at `begin_ns` and `end_ns`, all (F,)."""

    def read(i: int) -> Sweep:
        sweep = read_sweep(files[i], int(t_ns[i]))
        offset = spin_offset_ns(sweep.xyz_m, int(begin_ns[i] - t_ns[i]), int(end_ns[i] - t_ns[i]))
        return sweep_of(sweep.xyz_m, sweep.stamp_ns, offset, "lidar", intensity=sweep.intensity)

    return Stream("velodyne", t_ns, read)


def spin_offset_ns(xyz_m: NDArray[np.floating], begin_ns: int, end_ns: int) -> NDArray[np.int64]:
    """Time (N,) ns of points (N, 3) in the velo frame, relative to the moment at which the scanner faces forward.

    Notes
    -----
    The scanner turns clockwise seen from above. On drive 2011_09_26_0005, aligned sweeps 0.6 and 1.5 s apart agree to 5.1 cm
    (point to plane, RMS) with this, to 5.7 cm without stamps, to 6.0 cm with the other sense.
    """
    clockwise = -np.arctan2(xyz_m[:, 1], xyz_m[:, 0]) / np.pi
    offset_ns = np.where(clockwise < 0, -clockwise * begin_ns, clockwise * end_ns)
    return np.asarray(np.round(offset_ns).astype(np.int64))
