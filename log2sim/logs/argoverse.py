"""Argoverse 2: logs of the sensor data set, and those of its LiDAR and map-change data sets.

What the user guide does not say was measured on a log of the validation split. Points are compensated to the stamp of
their sweep, its start: with that the elevations of a laser's points scatter by 0.003 to 0.005 degrees, with the end by 0.03
to 0.06. The ego's origin is 0.33 m above the road: planes fitted to the points within 9 m of two sweeps say 0.337 and 0.334,
the raster of ground heights below 68 poses 0.32 with a deviation of 0.03. The stamps of the poses, among them those of the
images, are those at which the LiDARs pass the axes of the cameras, to 1 ms; as exposures are centered on that (user guide),
the stamp of an image is the middle of its exposure. Shutters are global, and images are undistorted (user guide).
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator, Mapping
from functools import cache, lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import EgoVehicle, Labels, Lidar, Log, MapFrame, Stream, Sweep
from log2sim.errors import LogError, RecordError
from log2sim.files.images import MAX_IMAGE_PX
from log2sim.files.inputs import is_present, read_file, require_links_inside
from log2sim.geometry import Array, Camera, PoseTrack, apply, inverse, shift_poses
from log2sim.geometry.transforms import OFFSET_STEP_M
from log2sim.logs.arrow import LIMITS, Kind, TableLimits, read_columns
from log2sim.logs.excerpt import digest_of
from log2sim.logs.records import (
    MAX_SWEEP_BYTES,
    MAX_SWEEP_POINTS,
    FolderReader,
    checked_poses,
    image_stream,
    list_files,
    list_numbered_files,
    sweep_of,
)
from log2sim.logs.stamps import compute_turn_share, defer_notes, note_left_out, strictly_increasing

CITY_IN_NAME = re.compile(r"____([A-Z]{3})(_city_|\.|$)")


# City frames: zone of UTM (north of the equator), east and north of the origin in it on WGS 84, m; heights count from an unknown
# zero. The development kit states the origins as latitude and longitude (av2.geometry.utm); in UTM they are these multiples of
# 30 m, to 0.07 m in Palo Alto and 0.03 m elsewhere.
CITIES: Mapping[str, tuple[int, float, float]] = {
    "ATX": (14, 621_150.0, 3_349_890.0), "DTW": (17, 320_670.0, 4_685_370.0), "MIA": (17, 580_560.0, 2_850_960.0),
    "PAO": (10, 576_480.0, 4_141_380.0), "PIT": (17, 583_710.0, 4_477_260.0), "WDC": (18, 323_460.0, 4_306_470.0),
}  # fmt: skip


def map_frame_of(city: str | None, offset_m: tuple[float, float, float], notes: list[str]) -> MapFrame:
    """Map frame whose origin is `offset_m` from that of a city's frame; only local where the city is not known."""
    if city is None or city not in CITIES:
        why = "map/ has no file that names it" if city is None else f"'{city}' is none of {', '.join(CITIES)}"
        notes.append(f"the city of the log is not known ({why}): the position of the map on Earth is unknown")
        return MapFrame(offset_m=offset_m)
    from pyproj import Proj

    zone, east_m, north_m = CITIES[city]
    projection = f"+proj=utm +zone={zone} +datum=WGS84 +units=m +no_defs"
    offset = (east_m + offset_m[0], north_m + offset_m[1], offset_m[2])
    longitude, latitude = Proj(projection)(offset[0], offset[1], inverse=True)
    return MapFrame(float(latitude), float(longitude), None, projection, offset)


QUATERNION = ("qw", "qx", "qy", "qz")
TRANSLATION = ("tx_m", "ty_m", "tz_m")
TRANSFORM: Mapping[str, Kind] = dict.fromkeys((*QUATERNION, *TRANSLATION), "float")


def transforms_of(columns: Mapping[str, NDArray[Any]], path: Path) -> Array:
    """Build transforms (N, 4, 4) of the columns `TRANSFORM`, each (N,); `LogError` for an impossible one."""
    q, position = (
        np.stack([columns[k].astype(np.float64) for k in names], axis=1) for names in (QUATERNION, TRANSLATION)
    )
    return checked_poses(q, position, lambda row: f"{path}, row {row}")


# First laser number of each LiDAR. On the sample log the elevations of a laser's points, computed from the position
# of this LiDAR, scatter by 0.003 to 0.005 degrees; from that of the other one by 0.1.
LIDARS = {"up_lidar": 0, "down_lidar": 32}
LASERS = 32
COLUMNS: dict[str, Kind] = {
    "x": "float", "y": "float", "z": "float", "laser_number": "int", "offset_ns": "int", "intensity": "float",
}  # fmt: skip
SWEEP_LIMITS = TableLimits(rows=MAX_SWEEP_POINTS, file_bytes=MAX_SWEEP_BYTES, unpacked_bytes=MAX_SWEEP_BYTES)
# A sweep lasts 0.1 s, those of both LiDARs together 0.106 s in the sample log.
MAX_OFFSET_NS = 1_000_000_000


def sweep_stream(lidar: str, t_ns: NDArray[np.int64], files: list[Path], ego_T_lidar: Array) -> Stream:
    """Stream of one of `LIDARS`; each of the files (F,), with reference stamps `t_ns` (F,), has the points of both."""
    lidar_T_ego = inverse(ego_T_lidar)

    def read(i: int) -> Sweep:
        stamp, columns = int(t_ns[i]), _read_points(files[i])
        own = columns["laser_number"] // LASERS == LIDARS[lidar] // LASERS
        columns = {name: column[own] for name, column in columns.items()}
        # Points are moved in double precision: they were stored in half precision, to which nothing should be added.
        xyz_ego = np.stack([columns[k] for k in "xyz"], axis=1).astype(np.float64)
        xyz = apply(lidar_T_ego, xyz_ego).astype(np.float32)
        return sweep_of(xyz, stamp, columns["offset_ns"], "lidar", stamp, columns.get("intensity"))

    return Stream(lidar, t_ns, read)


# The streams of both LiDARs read each file, one after the other.
@lru_cache(maxsize=4)
def _read_points(path: Path) -> dict[str, NDArray[Any]]:
    columns = read_columns(path, COLUMNS, optional=("intensity",), error=RecordError, limits=SWEEP_LIMITS)
    for name, low, high, expected in (
        ("laser_number", 0, LASERS * len(LIDARS) - 1, "0 to 63"),
        ("offset_ns", -MAX_OFFSET_NS, MAX_OFFSET_NS, "less than 1 s from the stamp"),
    ):
        values = columns[name]
        if len(values) and not (values.min() >= low and values.max() <= high):
            found = f"{values.min()} to {values.max()}"
            raise RecordError(f"{path}, column '{name}': {found}, expected {expected}")
    finite = np.isfinite(columns["x"]) & np.isfinite(columns["y"]) & np.isfinite(columns["z"])
    return columns if finite.all() else {name: column[finite] for name, column in columns.items()}


SIZE = ("length_m", "width_m", "height_m")
LABEL_COLUMNS: dict[str, Kind] = {
    "timestamp_ns": "int", "track_uuid": "text", "category": "text", **dict.fromkeys(SIZE, "float"), **TRANSFORM,
    "num_interior_pts": "int",
}  # fmt: skip

# By the taxonomy of the data set's user guide.
CATEGORY_OF = {
    "REGULAR_VEHICLE": "car", "LARGE_VEHICLE": "truck", "BOX_TRUCK": "truck", "TRUCK": "truck", "TRUCK_CAB": "truck",
    "BUS": "bus", "SCHOOL_BUS": "bus", "ARTICULATED_BUS": "bus", "MOTORCYCLE": "motorcycle",
    "MOTORCYCLIST": "motorcycle", "BICYCLE": "bicycle", "BICYCLIST": "cyclist", "PEDESTRIAN": "pedestrian",
    "OFFICIAL_SIGNALER": "pedestrian", "VEHICULAR_TRAILER": "other", "RAILED_VEHICLE": "other",
    "WHEELED_DEVICE": "other", "WHEELED_RIDER": "other", "WHEELCHAIR": "other", "STROLLER": "other",
}  # fmt: skip
NO_ROAD_USERS = {
    "BOLLARD", "CONSTRUCTION_CONE", "CONSTRUCTION_BARREL", "STOP_SIGN", "SIGN", "MOBILE_PEDESTRIAN_SIGN",
    "MOBILE_PEDESTRIAN_CROSSING_SIGN", "MESSAGE_BOARD_TRAILER", "TRAFFIC_LIGHT_TRAILER", "DOG", "ANIMAL",
}  # fmt: skip
# People who ride, by what they ride: both have boxes of their own.
RIDDEN_BY = {"BICYCLIST": "BICYCLE", "MOTORCYCLIST": "MOTORCYCLE", "WHEELED_RIDER": "WHEELED_DEVICE"}
# Between the centers of a rider and of the vehicle below, in the plane: less than half a bicycle.
MAX_RIDER_DISTANCE_M = 0.8

# The upper LiDAR turns clockwise in 0.1 s and looks in this direction at the stamp of a sweep (144.5 and 143.6 degrees in the
# two sweeps of the sample log, 143.4 in the rows that the user guide prints of another one); the lower one looks opposite.
START_AZIMUTH_RAD = np.radians(144.0)
PERIOD_NS = 100_000_000
HALF_TURN_NS = PERIOD_NS // 2


def read_labels(
    path: Path, ego: PoseTrack, upper_lidar_xy: Array, swept_ns: NDArray[np.int64], notes: list[str]
) -> Labels:
    """Read `annotations.feather`; the upper LiDAR is at `upper_lidar_xy` (2,), m, ego frame, sweeps at `swept_ns` (F,) are there.

    A box is in the ego frame of its sweep's stamp, the start of the sweep, as the points are. It is drawn around the points
    of both LiDARs, which scan an object half a turn apart and each where it was at that time; ego motion alone is compensated.
    Hence the time of a box is the mean of both passages (`scan_time_ns`), not the stamp. In the two sweeps of the sample log,
    of the points on cars that drive faster than 5 m/s, moved by the car's speed to the time of the box, 99.6 % lie in the box
    with this time and 89 % with the stamp; of two cars at 10 m/s, whose rear the LiDARs hit, all and 24 to 30 %.
    """
    columns = read_columns(path, LABEL_COLUMNS)
    size = np.stack([columns[k].astype(np.float64) for k in SIZE], axis=1)
    bad = np.flatnonzero(~(size > 0).all(axis=1) | ~np.isfinite(size).all(axis=1))
    if len(bad):
        raise LogError(f"{path}, row {bad[0]}: size {size[bad[0]].tolist()}, expected length, width, height above 0 m")
    for name in ("track_uuid", "category"):
        missing = [k for k, word in enumerate(columns[name]) if word is None]
        if missing:
            raise LogError(f"{path}, row {missing[0]}: no '{name}'")
    t_ns, track_id, kinds = columns["timestamp_ns"], columns["track_uuid"].astype(np.str_), columns["category"]
    size, ego_T_box, kinds, keep = _join_riders(t_ns, size, transforms_of(columns, path), kinds.astype(np.str_))
    map_T_ego, known = ego.at(t_ns)
    if not known.all():
        notes.append(f"{np.sum(~known)} labels left out because the ego's pose is not known at their stamps")
    category = np.array([CATEGORY_OF.get(k, "") for k in kinds], dtype="<U16")
    note_left_out(kinds[keep & (category == "")].tolist(), NO_ROAD_USERS, notes)
    first = np.unique(np.rec.fromarrays([t_ns, track_id]), return_index=True)[1]  # of a track that repeats at a stamp
    keep &= known & (category != "") & np.isin(np.arange(len(t_ns)), first)
    map_T_box = map_T_ego @ ego_T_box
    after_ns = scan_time_ns(ego_T_box[:, :2, 3] - upper_lidar_xy)
    labeled = np.unique(t_ns)
    without = len(labeled) - int(np.isin(labeled, swept_ns).sum())
    if without:
        notes.append(f"sweeps are missing at {without} of the {len(labeled)} stamps that were labeled")
    return Labels(
        t_ns=(t_ns + after_ns)[keep],
        track_id=track_id[keep],
        category=category[keep],
        center_m=map_T_box[keep, :3, 3],
        size_m=size[keep],
        yaw_rad=np.arctan2(map_T_box[keep, 1, 0], map_T_box[keep, 0, 0]),
        visible=columns["num_interior_pts"][keep] > 0,
        kind=kinds[keep],
        labeled_ns=labeled + HALF_TURN_NS,
    )


def scan_time_ns(xy_lidar: Array) -> NDArray[np.int64]:
    """Compute when both LiDARs scan objects at `xy_lidar` (N, 2), m, ego axes: the mean (N,), ns, after the stamp of the sweep."""
    upper_ns = np.round(compute_turn_share(xy_lidar, START_AZIMUTH_RAD) * PERIOD_NS).astype(np.int64)
    return np.asarray((upper_ns + (upper_ns + HALF_TURN_NS) % PERIOD_NS) // 2)


def _join_riders(
    t_ns: NDArray[np.int64], size: Array, ego_T_box: Array, kinds: NDArray[np.str_]
) -> tuple[Array, Array, NDArray[np.str_], NDArray[np.bool_]]:
    """Join each rider with the vehicle below, up to the rider's head: sizes, poses, kinds, and which boxes (N,) are kept.

    The road user has the vehicle's track, length and width; a rider without a vehicle stays as it is.
    """
    poses, joined, keep = ego_T_box.copy(), kinds.copy(), np.ones(len(kinds), dtype=bool)
    for rider in np.flatnonzero(np.isin(kinds, list(RIDDEN_BY))):
        same = np.flatnonzero((t_ns == t_ns[rider]) & (kinds == RIDDEN_BY[str(kinds[rider])]))
        away = np.linalg.norm(ego_T_box[same, :2, 3] - ego_T_box[rider, :2, 3], axis=1)
        if not len(same) or away.min() > MAX_RIDER_DISTANCE_M:
            continue
        vehicle = same[np.argmin(away)]
        rows = [vehicle, rider]
        bottom = (ego_T_box[rows, 2, 3] - size[rows, 2] / 2).min()
        top = (ego_T_box[rows, 2, 3] + size[rows, 2] / 2).max()
        size[vehicle, 2], poses[vehicle, 2, 3] = top - bottom, (top + bottom) / 2
        joined[vehicle], keep[rider] = kinds[rider], False
    return size, poses, joined, keep


POSES = "city_SE3_egovehicle.feather"
MOUNTS, INTRINSICS = "calibration/egovehicle_SE3_sensor.feather", "calibration/intrinsics.feather"
ANNOTATIONS = "annotations.feather"
ROAD_Z_EGO_M = -0.33
# A Ford Fusion Hybrid, by its data sheet; that does not say how far it reaches behind the rear axle: 1.1 m is an estimate.
EGO_VEHICLE = EgoVehicle(size_m=(4.87, 1.85, 1.48), rear_axle_offset_m=1.335)
REFERENCE_CAMERA = "ring_front_center"
# A log below a folder of splits of a folder of data sets: argoverse2/sensor/val/LOG.
MAX_DEPTH = 3
MAX_FOLDERS = 20_000

INTRINSIC_COLUMNS: dict[str, Kind] = {
    "sensor_name": "text", "fx_px": "float", "fy_px": "float", "cx_px": "float", "cy_px": "float",
    "height_px": "int", "width_px": "int",
}  # fmt: skip


class ArgoverseReader(FolderReader):
    """Reader of Argoverse 2 logs; the root is a log, a split or a folder of splits."""

    name = "argoverse2"
    looks_for = f"a folder with {POSES} and calibration/, or a folder up to three levels above such folders"

    def matches(self, path: Path) -> bool:
        """Return whether the folder is a log or holds some."""
        return next(_logs(path), None) is not None

    def find(self, path: Path) -> dict[str, Path]:
        """Find the logs at a folder by name; below other folders with these ("sensor/val/LOG")."""
        if _is_log(path):
            return {path.resolve().name: path}
        return {log.relative_to(path).as_posix(): log for log in _logs(path)}

    def open(self, path: Path, sequence: str) -> Log:
        """Open a log; no image, no sweep and no annotation is read."""
        folder = path if _is_log(path) else path / sequence
        require_links_inside(folder, path)
        return _open(folder)


READER = ArgoverseReader()


def _is_log(path: Path) -> bool:
    return (path / POSES).is_file() and (path / "calibration").is_dir()


def _logs(root: Path) -> Iterator[Path]:
    """Find logs at and up to `MAX_DEPTH` levels below a folder, not below logs nor in what is hidden or cannot be read."""
    folders, left = [(root, MAX_DEPTH)], MAX_FOLDERS
    while folders and left:
        left -= 1
        path, below = folders.pop()
        if _is_log(path):
            yield path
        elif below:
            try:
                with os.scandir(path) as entries:
                    inside = [e.name for e in entries if not e.name.startswith(".") and e.is_dir()]
            except OSError:
                continue
            folders += [(path / name, below - 1) for name in inside]


def _open(path: Path) -> Log:
    notes: list[str] = []
    # All its poses, in a map that lies `offset_m`, whole kilometers, off the city's frame.
    poses = path / POSES
    columns = read_columns(poses, {"timestamp_ns": "int", **TRANSFORM})
    city_T_ego = transforms_of(columns, poses)
    if not len(city_T_ego):
        raise LogError(f"{poses}: no poses; expected at least one")
    keep = strictly_increasing(columns["timestamp_ns"], poses.name, notes)
    east, north = (float(v) for v in np.floor(city_T_ego[keep[0], :2, 3] / OFFSET_STEP_M) * OFFSET_STEP_M)
    map_T_ego = shift_poses(city_T_ego[keep], np.array([east, north, 0.0]))
    ego, offset_m = PoseTrack(columns["timestamp_ns"][keep], map_T_ego), (east, north, 0.0)
    table = read_columns(path / MOUNTS, {"sensor_name": "text", **TRANSFORM})
    mounts = {str(n): mount for n, mount in zip(table["sensor_name"], transforms_of(table, path / MOUNTS))}
    cameras, streams = _cameras(path, mounts, notes)
    t_ns, files = stamped_files(path / "sensors" / "lidar", ".feather", notes)
    missing = [name for name in LIDARS if name not in mounts]
    if not files:
        notes.append("no sweeps: sensors/lidar/ holds none")
    elif missing:
        raise LogError(f"{path / MOUNTS}: no sensor '{missing[0]}'; expected {', '.join(LIDARS)}")
    lidars = {name: Lidar(name, "ego", mounts[name]) for name in (LIDARS if files else ())}
    streams |= {name: sweep_stream(name, t_ns, files, mounts[name]) for name in lidars}
    if not streams:
        raise LogError(f"{path / 'sensors'}: neither sweeps nor images; expected lidar/STAMP.feather")
    # Three letters in the names of the map files.
    names = sorted(p.name for p in (path / "map").iterdir()) if (path / "map").is_dir() else []
    city = next((match[1] for match in map(CITY_IN_NAME.search, names) if match), None)
    map_frame = map_frame_of(city, offset_m, notes)
    notes.append("stamps count from an unknown moment: only their differences are known")
    labels: Callable[[], Labels] | None = None
    if is_present(path / ANNOTATIONS):
        notes.append("objects were labeled only within 5 m of the drivable area")
        upper_lidar_xy = mounts.get("up_lidar", np.eye(4))[:2, 3]
        labels = cache(partial(read_labels, path / ANNOTATIONS, ego, upper_lidar_xy, t_ns, notes))
    else:
        notes.append(f"no labels: {ANNOTATIONS} is missing, as in test splits")
    index = [path / name for name in (POSES, MOUNTS, INTRINSICS) if (path / name).is_file()]
    records = sorted(path.glob("*.feather")) + sorted((path / "sensors").rglob("*.*"))
    return Log(
        name=f"argoverse2-{path.resolve().name}",
        format=READER.name,
        cameras=cameras,
        lidars=lidars,
        streams=streams,
        ego=ego,
        ego_vehicle=EGO_VEHICLE,
        map=map_frame,
        labels=labels,
        ground_z_ego_m=ROAD_Z_EGO_M,
        reference_camera=REFERENCE_CAMERA if REFERENCE_CAMERA in cameras else None,
        digest=digest_of([read_file(p, LIMITS.file_bytes, LogError).hex() for p in index], records),
        notes=defer_notes(notes, *filter(None, [labels])),
        calibrations={n: str(path / (INTRINSICS if n in cameras else MOUNTS)) for n in streams},
        details={"city": city},
    )


def _cameras(folder: Path, mounts: dict[str, Array], notes: list[str]) -> tuple[dict[str, Camera], dict[str, Stream]]:
    root, path = folder / "sensors" / "cameras", folder / INTRINSICS
    found = {p.name: stamped_files(p, ".jpg", notes) for p in sorted(root.iterdir())} if root.is_dir() else {}
    found = {name: (t_ns, files) for name, (t_ns, files) in found.items() if files}
    if not found or not is_present(path):
        left_out = f"images of {len(found)} cameras left out: {INTRINSICS} is missing"
        notes.append(left_out if found else "no images: sensors/cameras/ holds none")
        return {}, {}
    # k1, k2, k3 of the file are those of the lens, which the images lack.
    columns, cameras, streams = read_columns(path, INTRINSIC_COLUMNS), dict[str, Camera](), dict[str, Stream]()
    for row, name in enumerate(columns.pop("sensor_name")):
        values = {key: float(column[row]) for key, column in columns.items()}
        fx, fy, cx, cy, height, width = values.values()
        is_possible = np.isfinite(list(values.values())).all() and min(fx, fy, height, width) > 0
        if not is_possible or width * height > MAX_IMAGE_PX:
            raise LogError(f"{path}, row {row} ('{name}'): {values}, expected a size in px and focal lengths above 0")
        if name in mounts:
            K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
            cameras[str(name)] = Camera(str(name), int(width), int(height), K, "ego", mounts[name])
    for name, (t_ns, files) in found.items():
        if name in cameras:
            streams[name] = image_stream(name, t_ns, files, (cameras[name].width_px, cameras[name].height_px))
        else:
            notes.append(f"images of '{name}' left out: it is not in {INTRINSICS} and {MOUNTS}")
    without = sorted(set(cameras) - set(streams))
    if without:
        notes.append(f"no images of {', '.join(without)}")
    return {name: cameras[name] for name in streams}, streams


def stamped_files(folder: Path, suffix: str, notes: list[str]) -> tuple[NDArray[np.int64], list[Path]]:
    """Files of a folder whose names are stamps in ns, in their order; other names are noted."""
    stamped = list_numbered_files(folder, (suffix,))
    others = len(list_files(folder, (suffix,))) - len(stamped)
    if others:
        notes.append(f"{folder.name}: {others} files left out, their names are no stamps of their own")
    return np.array(list(stamped), dtype=np.int64), list(stamped.values())
