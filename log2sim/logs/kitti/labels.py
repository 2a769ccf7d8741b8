"""What KITTI's raw drives and its tracking benchmark share, with the labels of the latter.

The chain is imu -> velo -> cam 0 -> rectified cam 0 -> camera i. All its links are rigid except the projections P_i, whose
last column holds the position of camera i relative to the rectified camera 0.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import EgoVehicle, ImageLabels, ImageRegions, Labels, Lidar, Log, MapFrame, Stream, Sweep
from log2sim.datatypes.log import ROTATION_TOLERANCE
from log2sim.errors import LogError
from log2sim.files.arrays import Columns
from log2sim.files.documents import parse_float, parse_int
from log2sim.files.inputs import is_present, read_file
from log2sim.geometry import (
    Array,
    Camera,
    PoseTrack,
    apply,
    inverse,
    nearest_rotation,
    rotation_from_rpy,
    transform,
    wrap_angle,
)
from log2sim.logs.records import MAX_POSITION_M, read_sweep, sweep_of
from log2sim.logs.stamps import note_damaged_rows

EARTH_RADIUS_M = 6378137.0
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
    """Calibration of one drive: poses (4, 4) of the Velodyne and of the rectified camera 0, and P (3, 4) by number of camera."""

    ego_T_velo: Array
    ego_T_rect: Array
    projections: Mapping[int, Array]

    @classmethod
    def of(cls, velo_T_imu: Array, cam_T_velo: Array, rect_R_cam: Array, projections: Mapping[int, Array]) -> Rig:
        """Chain the links of the calibration."""
        ego_T_velo = EGO_T_IMU @ inverse(velo_T_imu)
        rect_T_velo = transform(rect_R_cam, np.zeros(3)) @ cam_T_velo
        return cls(ego_T_velo, ego_T_velo @ inverse(rect_T_velo), projections)

    def camera(self, number: int, width_px: int, height_px: int) -> Camera:
        """Camera `number` of the rectified images, called "image_0N"."""
        P = self.projections[number]
        cam_T_rect = transform(np.eye(3), np.linalg.solve(P[:, :3], P[:, 3]))
        pose = self.ego_T_rect @ inverse(cam_T_rect)
        return Camera(f"image_{number:02d}", width_px, height_px, P[:, :3], "ego", pose)


def read_text(path: Path) -> str:
    """Read a small text file; raise a `LogError` that names it where that fails."""
    data = read_file(path, MAX_TEXT_BYTES, LogError, missing="no such file; KITTI stores it with the drive's data")
    return data.decode("utf-8", errors="replace")


class Calibration:
    """Entries of a KITTI calibration file, numbers by key; none for lines that hold words.

    Raises `LogError` for a key that occurs twice, one that nothing follows, as where a file is cut, and an entry that is asked for
    and is not there, not of its shape, not finite, or no rotation or projection.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.text = path, read_text(path)
        self.values: dict[str, Array] = {}
        for line in filter(None, map(str.strip, self.text.splitlines())):
            key, _, rest = line.partition(" ")
            if not rest:
                raise LogError(f"{path}: nothing follows '{key[:40]}'; expected numbers")
            try:
                numbers = np.array([parse_float(word) for word in rest.split()])
            except ValueError:
                numbers = np.zeros(0)  # words are in no entry that is used
            key = key.removesuffix(":")
            if key in self.values:
                raise LogError(f"{path}: entry '{key[:40]}' occurs twice; remove the one of the two that is wrong")
            self.values[key] = numbers

    def entry(self, shape: tuple[int, ...], *keys: str) -> Array:
        """Entry under the first of `keys` that there is, as an array of `shape`."""
        key, count = next((k for k in keys if k in self.values), None), int(np.prod(shape))
        if key is None:
            raise LogError(f"{self.path}: no entry '{keys[0]}'; expected {count} numbers after it")
        values = self.values[key]
        if values.size != count or not np.isfinite(values).all():
            raise LogError(f"{self.path}, entry '{key}': {values.size} numbers, expected {count} finite ones")
        return values.reshape(shape)

    def rotation(self, *keys: str) -> Array:
        """Entry that is a rotation (3, 3)."""
        return self._nearest_rotation(self.entry((3, 3), *keys), keys[0])

    def rigid(self, *keys: str) -> Array:
        """Entry that is a rotation and a translation, as (4, 4)."""
        m = self.entry((3, 4), *keys)
        return transform(self._nearest_rotation(m[:, :3], keys[0]), m[:, 3])

    def projection(self, key: str) -> Array:
        """Entry that is the P (3, 4) of a rectified camera."""
        P = self.entry((3, 4), key)
        if not (P[0, 0] > 0 and P[1, 1] > 0 and P[2, 2] == 1 and P[1, 0] == 0 and not P[2, :2].any()):
            expected = "expected positive focal lengths and a last row 0 0 1"
            raise LogError(f"{self.path}, entry '{key}': K is {P[:, :3].tolist()}, {expected}")
        return P

    def _nearest_rotation(self, rotation: Array, key: str) -> Array:
        off = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
        determinant = float(np.linalg.det(rotation))
        if off > ROTATION_TOLERANCE or determinant < 0:
            raise LogError(
                f"{self.path}, entry '{key}': not a rotation matrix: R R^T is off the identity by {off:.2g} (at most "
                f"{ROTATION_TOLERANCE:g} is allowed), determinant {determinant:.3g} (expected +1); check the calibration"
            )
        return nearest_rotation(rotation)


def poses_from_oxts(rows: Array) -> tuple[Array, MapFrame]:
    """Ego poses (N, 4, 4) and the map frame of oxts records (N, >= 6): lat, lon, alt, roll, pitch, yaw.

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
    """Stream of Velodyne sweeps; the scanner faces forward at `t_ns` and backward at `begin_ns` and `end_ns`, all (F,).

    It turns clockwise seen from above. On drive 2011_09_26_0005, aligned sweeps 0.6 and 1.5 s apart agree to 5.1 cm (point to
    plane, RMS) with this, to 5.7 cm without stamps, to 6.0 cm with the other sense.
    """

    def read(i: int) -> Sweep:
        sweep = read_sweep(files[i], int(t_ns[i]))
        clockwise = -np.arctan2(sweep.xyz_m[:, 1], sweep.xyz_m[:, 0]) / np.pi
        begin, end = int(begin_ns[i] - t_ns[i]), int(end_ns[i] - t_ns[i])
        offset = np.round(np.where(clockwise < 0, -clockwise * begin, clockwise * end)).astype(np.int64)
        return sweep_of(sweep.xyz_m, sweep.stamp_ns, offset, "lidar", intensity=sweep.intensity)

    return Stream("velodyne", t_ns, read)


CATEGORY_OF = {
    "Car": "car", "Van": "car", "Truck": "truck", "Pedestrian": "pedestrian", "Person": "pedestrian",
    "Person_sitting": "pedestrian", "Cyclist": "cyclist", "Tram": "other", "Misc": "other",
}  # fmt: skip
NOT_LABELED = "DontCare"
NEVER_LABELED = ("bicycle", "motorcycle")
"""No class is for bicycles without riders, nor for motorcycles (Geiger et al., "Vision meets robotics", 2013, section III)."""

LABEL_FIELDS = 17
RESULT_FIELDS = 18
"""Of a line that ends with a score."""
# A day and more at 10 Hz; stamps of much larger numbers do not fit into int64 ns.
MAX_FRAME = 1_000_000
CAMERA = "image_02"

PosesAt = Callable[[NDArray[np.int64]], tuple[Array, NDArray[np.bool_]]]


@dataclass(frozen=True, eq=False)
class DriveLabels:
    """Contents of a label file; empty without one."""

    boxes_3d: Labels | None = None
    boxes_2d: Mapping[str, ImageLabels] = field(default_factory=dict)  # by camera
    ignored: Mapping[str, ImageRegions] = field(default_factory=dict)  # by camera
    text: str = ""  # the file, for the log's digest


@dataclass(frozen=True, eq=False)
class LabelRows(Columns):
    """Lines of a label file."""

    frame: NDArray[np.int64]  # (L,)
    track_id: NDArray[np.str_]  # (L,)
    type: NDArray[np.str_]  # (L,)
    values: Array  # (L, 14): the numbers from truncation on


def read_labels(
    path: Path, rig: Rig, track: PoseTrack, stamp_of: Callable[[NDArray[np.int64]], NDArray[np.int64]], notes: list[str]
) -> DriveLabels:
    """Read a label file, empty where there is none; `stamp_of` gives the stamps (L,) of frame numbers (L,).

    Only objects in view of camera 2 have labels. Regions of its images with objects too far, too occluded or too crowded to
    be labeled are marked by boxes of the type DontCare.
    """
    if not is_present(path):
        return DriveLabels()
    text = read_text(path)
    rows = parse_labels_noting(text, path, notes)
    return labels_of_rows(rows, poses_of_rect(track, rig.ego_T_rect), stamp_of, text)


def parse_labels_noting(text: str, path: Path, notes: list[str]) -> LabelRows:
    """Parse a label file; lines that are damaged are left out and noted."""
    damaged: list[str] = []
    rows = parse_labels(text, path, damaged)
    note_damaged_rows(damaged, len(rows.frame) + len(damaged), notes)
    return rows


def poses_of_rect(track: PoseTrack, ego_T_rect: Array) -> PosesAt:
    """Return the function that places the rectified camera 0, which has the pose (4, 4) in the frame of the ego."""

    def at(t_ns: NDArray[np.int64]) -> tuple[Array, NDArray[np.bool_]]:
        map_T_ego, known = track.at(t_ns)
        return map_T_ego @ ego_T_rect, known

    return at


def labels_of_rows(
    rows: LabelRows,
    poses_at: PosesAt,
    stamp_of: Callable[[NDArray[np.int64]], NDArray[np.int64]],
    text: str,
    camera: str = CAMERA,
) -> DriveLabels:
    """Place the rows of label files in the map; those of unlabeled regions become regions of the image.

    `poses_at`: gives the poses (L, 4, 4) of the frame that boxes are in, and whether they are known, at stamps (L,).
    `stamp_of`: gives the stamps (L,) of frame numbers (L,). `text`: the files, for the log's digest. `camera`: in whose images
    objects were labeled.
    """
    is_ignored = rows.type == NOT_LABELED
    ignored, rows = rows.take(is_ignored), rows.take(~is_ignored)
    t_ns = stamp_of(rows.frame)
    category = np.array([CATEGORY_OF[name] for name in rows.type.tolist()], dtype="<U16")
    map_T_rect, k = poses_at(t_ns)
    # Rows hold height, width, length, the center of the bottom, and the rotation about the camera's y axis.
    height, width, length, turn = rows.values[:, [7, 8, 9, 13]].T
    level = np.zeros(len(t_ns))
    center = rows.values[:, 10:13] - np.stack([level, height / 2, level], axis=1)
    ahead = np.stack([np.cos(turn), level, -np.sin(turn)], axis=1)
    heading = np.einsum("lij,lj->li", map_T_rect[:, :3, :3], ahead)
    yaw = wrap_angle(np.arctan2(heading[:, 1], heading[:, 0]))
    size = np.stack([length, width, height], axis=1)
    boxes = Labels(
        t_ns[k], rows.track_id[k], category[k], apply(map_T_rect, center)[k], size[k], yaw[k], cameras=(camera,),
        kind=rows.type[k], occlusion=rows.values[k, 1].astype(np.int64), never_labeled=NEVER_LABELED,
    )  # fmt: skip
    return DriveLabels(
        boxes,
        {camera: ImageLabels(t_ns, rows.values[:, 3:7], category)},
        {camera: ImageRegions(stamp_of(ignored.frame), ignored.values[:, 3:7])},
        text,
    )


def parse_labels(text: str, path: Path, damaged: list[str]) -> LabelRows:
    """Parse the lines of a label file; `damaged` takes a message for each that is wrong."""
    rows = []
    for k, line in enumerate(text.splitlines(), start=1):
        words, problem = line.split(), ""
        if not words:
            continue
        if not LABEL_FIELDS <= len(words) <= RESULT_FIELDS or words[2] not in (*CATEGORY_OF, NOT_LABELED):
            known = ", ".join([*CATEGORY_OF, NOT_LABELED])
            problem = f"expected frame, track id, type ({known}) and {LABEL_FIELDS - 3} numbers"
        else:
            try:
                frame, row = parse_int(words[0]), [parse_float(word) for word in words[3:LABEL_FIELDS]]
            except ValueError:
                problem = f"expected numbers after the type, found '{' '.join(words)[:60]}'"
            else:
                if not (np.abs(row) <= MAX_POSITION_M).all():  # False for NaN
                    problem = f"a number is not finite, or larger than {MAX_POSITION_M:g}"
                elif not 0 <= frame <= MAX_FRAME:
                    problem = f"frame {words[0][:20]}, expected 0 to {MAX_FRAME}"
        if problem:
            damaged.append(f"{path}, line {k}: {problem}")
        else:
            rows.append((frame, words[1], words[2], row))
    frames, ids, types, values = zip(*rows) if rows else ((), (), (), ())
    table = np.array(values, dtype=np.float64).reshape(-1, LABEL_FIELDS - 3)
    return LabelRows(np.array(frames, np.int64), np.array(ids, "<U16"), np.array(types, "<U16"), table)


def drive_log(
    rig: Rig, cameras: Mapping[str, Camera], streams: Mapping[str, Stream], track: PoseTrack, labels: DriveLabels,
    **about: Any,
) -> Log:  # fmt: skip
    """Make the log of a drive of KITTI's car."""
    lidars = {"velodyne": Lidar("velodyne", "ego", rig.ego_T_velo)} if "velodyne" in streams else {}
    return Log(
        cameras=cameras, lidars=lidars, streams=streams, ego=track, ego_vehicle=EGO_VEHICLE, labels=labels.boxes_3d,
        image_labels=labels.boxes_2d, ignored_regions=labels.ignored, **about,
    )  # fmt: skip
