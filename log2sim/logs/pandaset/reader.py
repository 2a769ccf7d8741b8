"""PandaSet sequences: six cameras, a spinning Pandar64 and a forward PandarGT.

What the data set does not document was measured on sequence 002. The pose of a sweep has x right, y forward, z up, and its
origin is 0.325 m above the road (fit of the road within 15 m, 0.319 to 0.337 m over 40 sweeps), as the rear axle does. The Pandar64 turns
clockwise and passes the rear at the stamp of the sweep. The PandarGT keeps its own time, up to 90 ms away from the
Pandar64's, so that a moving car is at two positions in one file (up to 1 m apart); hence two streams. No index states the
times of the PandarGT: they are those of its points, so its stamps are read from all sweeps, but only when they are used.
"""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import cache, cached_property, lru_cache, partial
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import EgoVehicle, Labels, Lidar, Log, MapFrame, Stream, Sweep
from log2sim.errors import LogError, RecordError
from log2sim.files.documents import JSON_LIMIT_BYTES, read_json
from log2sim.files.inputs import is_present, read_file, read_text, require_links_inside
from log2sim.geometry import NS_PER_S, Array, Camera, PoseTrack, apply, inverse, nearest_rotation, transform, wrap_angle
from log2sim.logs import records
from log2sim.logs.checks import Span, describe_gap
from log2sim.logs.excerpt import digest_of
from log2sim.logs.pandaset.unpickle import MAX_TABLE_BYTES, Columns, read_pickled_table
from log2sim.logs.records import MAX_KEPT_BYTES
from log2sim.logs.stamps import (
    MAX_TIME_S,
    compute_scan_offset_ns,
    defer_notes,
    geodetic_from_map,
    note_left_out,
    poses_from_geodetic,
    select_spaced,
    strictly_increasing,
    transverse_mercator,
)

# Value of the column "d" by LiDAR.
LIDARS: Mapping[str, int] = {"pandar64": 0, "pandargt": 1}
COLUMNS = ("x", "y", "z", "t", "d", "i")
READING_THREADS = 4


class SweepFiles:
    """Files of a sequence, each with the points of both LiDARs; stamps of the PandarGT are read when first used.

    Tables that are read for the stamps are kept, up to `MAX_KEPT_BYTES`, until the sweeps of both LiDARs are read.
    """

    def __init__(self, files: dict[int, Path], t_ns: NDArray[np.int64], notes: list[str]) -> None:
        self.files, self._t_ns, self._notes = files, t_ns, notes
        self._indexes: dict[str, tuple[NDArray[np.int64], list[Path]]] = {}
        self._lock, self._kept_lock = Lock(), Lock()
        self._kept: dict[Path, tuple[Columns, set[str]]] = {}  # with the LiDARs that have got them
        self._kept_bytes = 0

    def stream(self, lidar: str) -> Stream:
        """Return the stream of one LiDAR."""

        def read(i: int) -> Sweep:
            t_ns, files = self.index(lidar)
            return _read_sweep(self._take(files[i], lidar), files[i], int(t_ns[i]), LIDARS[lidar])

        def encoded(i: int) -> bytes:
            return read_file(self.index(lidar)[1][i], MAX_TABLE_BYTES, RecordError)

        return Stream(lidar, lambda: self.index(lidar)[0], read, encoded)

    def index(self, lidar: str) -> tuple[NDArray[np.int64], list[Path]]:
        """Return stamps (F,) and files of the sweeps of one LiDAR, in order."""
        with self._lock:
            if lidar not in self._indexes:
                t_ns = self._t_ns if lidar == "pandar64" else self.gt_stamps
                numbers = np.array(list(self.files))
                keep = strictly_increasing(t_ns[numbers], lidar, self._notes)
                self._indexes[lidar] = t_ns[numbers[keep]], [self.files[int(n)] for n in numbers[keep]]
            return self._indexes[lidar]

    @cached_property
    def gt_stamps(self) -> NDArray[np.int64]:
        """Middle (N,) of the PandarGT's points of each sweep.

        Where a sweep is missing or cannot be read, the stamp of the Pandar64 moved as those next to it.
        """
        with ThreadPoolExecutor(READING_THREADS) as pool:
            middles = zip(self.files, pool.map(self._gt_middle_ns, self.files.values()))
            known = {number: stamp - int(self._t_ns[number]) for number, stamp in middles if stamp is not None}
        if not known:
            return self._t_ns.copy()
        moved = np.interp(np.arange(len(self._t_ns)), list(known), list(known.values()))
        return np.asarray(self._t_ns + np.round(moved).astype(np.int64))

    def _gt_middle_ns(self, path: Path) -> int | None:
        """Return the middle of the PandarGT's times; None where they cannot be those of a sweep."""
        try:
            columns = read_pickled_table(path)
        except RecordError:
            return None
        needed = {name: columns[name] for name in COLUMNS if name in columns}
        with self._kept_lock:
            size = sum(column.nbytes for column in needed.values())
            if self._kept_bytes + size <= MAX_KEPT_BYTES:
                self._kept[path] = {name: column.copy() for name, column in needed.items()}, set()
                self._kept_bytes += size
        try:
            t_s = columns["t"][columns["d"] == LIDARS["pandargt"]].astype(np.float64)
        except (KeyError, TypeError, ValueError, IndexError):
            return None
        t_s = t_s[np.abs(t_s) < MAX_TIME_S]  # False for NaN
        return round((float(t_s.min()) + float(t_s.max())) / 2 * NS_PER_S) if len(t_s) else None

    def _take(self, path: Path, lidar: str) -> Columns | None:
        """Return a kept table for one LiDAR, None where it is not kept."""
        with self._kept_lock:
            columns, read = self._kept.get(path, (None, set()))
            read.add(lidar)
            if columns is not None and len(read) == len(LIDARS):
                del self._kept[path]
                self._kept_bytes -= sum(column.nbytes for column in columns.values())
            return columns


# One file holds the sweeps of both LiDARs, which are read one after the other.
_read_points = lru_cache(maxsize=4)(read_pickled_table)


def _read_sweep(kept: Columns | None, path: Path, t_ns: int, number: int) -> Sweep:
    where = f"{path} (stamp {t_ns})"
    try:
        columns = _read_points(path) if kept is None else kept
        # Indices take half the time of a mask.
        rows = np.flatnonzero(columns["d"] == number)
        xyz = np.stack([columns[k].take(rows) for k in ("x", "y", "z")], axis=1)
        t_s = columns["t"].take(rows)
        strength = columns["i"].take(rows) if "i" in columns and columns["i"].dtype.kind in "iuf" else None
        if xyz.dtype.kind != "f" or t_s.dtype.kind != "f" or columns["d"].dtype.kind not in "iuf":
            kinds = f"{xyz.dtype}, {t_s.dtype} and {columns['d'].dtype}"
            raise RecordError(f"{where}: columns x, y, z, then t and d are {kinds}, expected numbers")
    except KeyError as missing:
        raise RecordError(f"{where}: no column {missing}; expected x, y, z, i, t, d") from None
    timed = np.abs(t_s) < MAX_TIME_S  # False for NaN
    if not timed.all():
        xyz, t_s, strength = xyz[timed], t_s[timed], None if strength is None else strength[timed]
    offset_ns = np.round(t_s * NS_PER_S).astype(np.int64) - t_ns
    return records.sweep_of(xyz, t_ns, offset_ns, "map", intensity=strength)


PERIOD_NS = 100_000_000

CATEGORY_OF = {
    "Car": "car", "Pickup Truck": "truck", "Medium-sized Truck": "truck", "Semi-truck": "truck", "Bus": "bus",
    "Motorcycle": "motorcycle", "Motorized Scooter": "motorcycle", "Pedestrian": "pedestrian",
    "Pedestrian with Object": "pedestrian", "Emergency Vehicle": "other",
    "Other Vehicle - Construction Vehicle": "other", "Other Vehicle - Pedicab": "other",
    "Other Vehicle - Uncommon": "other", "Personal Mobility Device": "other", "Towed Object": "other",
    "Train": "other", "Tram / Subway": "other",
}  # fmt: skip
NO_ROAD_USERS = {
    "Animals - Bird", "Animals - Other", "Cones", "Construction Signs", "Pylons", "Road Barriers", "Rolling Containers",
    "Signs", "Temporary Construction Barriers",
}  # fmt: skip
LABEL_COLUMNS = (
    "uuid", "label", "yaw", "position.x", "position.y", "position.z", "dimensions.x", "dimensions.y", "dimensions.z",
)  # fmt: skip
# Columns that a file lacks where no object of its sweep has the attribute, and the values that they get then.
OPTIONAL: dict[str, str | int] = {"attributes.rider_status": "", "cuboids.sibling_id": "-", "cuboids.sensor_id": -1}
RIDER = {"With Rider": "cyclist", "Without Rider": "bicycle"}
GT_SENSOR = 1
# A bicycle in a sweep that does not state whether somebody rides it, until its other sweeps decide.
UNKNOWN_RIDER = "bicycle?"


def read_labels(
    files: dict[int, Path], t_ns: NDArray[np.int64], gt_t_ns: NDArray[np.int64], map_T_lidar: Array, notes: list[str]
) -> Labels:
    """Labels of the cuboid files by number of sweep, whose stamps are `t_ns` and, of the PandarGT, `gt_t_ns` (N,).

    A cuboid fits the points where they were measured, and the Pandar64, at `map_T_lidar` (N, 4, 4), scans different directions at
    different times; on moving cars of sequence 002 the time by `compute_scan_offset_ns` is off that of the points inside the box by
    0.5 +- 0.4 ms: the turn takes 0.1 s and ends at the rear, at the stamp of the sweep. Of an object with a cuboid for each LiDAR
    the Pandar64's is kept.
    """
    parts, left_out = list[tuple[NDArray[Any], ...]](), list[str]()
    twice = flat = 0
    for number, path in files.items():
        if number < len(t_ns):
            found = read_pickled_table(path, LogError)
            for name in LABEL_COLUMNS:
                if name not in found:
                    raise LogError(f"{path}: no column '{name}'; expected cuboids with {', '.join(LABEL_COLUMNS)}")
                is_possible = found[name].dtype.kind in "fiu" and (np.abs(found[name]) <= records.MAX_POSITION_M).all()
                if name not in ("uuid", "label") and not is_possible:
                    raise LogError(f"{path}, column '{name}': expected finite numbers up to {records.MAX_POSITION_M:g}")
            table = {name: np.full(len(found["uuid"]), value) for name, value in OPTIONAL.items()} | found
            twice += len(table["uuid"]) - len(np.unique(table["uuid"].astype(np.str_)))
            flat += int((_sizes(table) <= 0).any(axis=1).sum())
            parts.append(_frame(table, int(t_ns[number]), int(gt_t_ns[number]), map_T_lidar[number], left_out))
    if twice:
        notes.append(f"{twice} cuboids left out: their sweep has another one of the same uuid")
    if flat:
        notes.append(f"{flat} cuboids left out: a side of them is 0 or less")
    note_left_out(left_out, NO_ROAD_USERS, notes)
    missing = sorted(set(range(len(t_ns))) - set(files))
    if missing:
        count = f"{len(missing)} of {len(t_ns)} files"
        notes.append(f"annotations/cuboids: {count} are missing, first number {missing[0]:02d}")
    if not parts:
        raise LogError(f"{next(iter(files.values())).parent}: no cuboids of the sweeps of this log")
    columns = [np.concatenate(column) for column in zip(*parts)]
    keep = select_spaced(columns[0], columns[1])
    t_ns, track_id, category, center, size, yaw = (c[keep] for c in columns)
    # A bicycle of unknown rider is what it is in most other sweeps.
    alone = 0
    for track in np.unique(track_id[category == UNKNOWN_RIDER]):
        rows = track_id == track
        words, counts = np.unique(category[rows & (category != UNKNOWN_RIDER)], return_counts=True)
        category[rows & (category == UNKNOWN_RIDER)] = words[np.argmax(counts)] if len(words) else "bicycle"
        alone += not len(words)
    if alone:
        taken = f"{alone} bicycle{'s' * (alone != 1)} taken as unridden"
        notes.append(f"{taken}: no sweep states whether somebody rides them")
    return Labels(t_ns, track_id, category, center, size, yaw)


def _frame(c: Columns, t_ns: int, gt_t_ns: int, map_T_lidar: Array, left_out: list[str]) -> tuple[NDArray[Any], ...]:
    """Stamps, track ids, categories, centers, sizes and yaws of one sweep's cuboids; `left_out` takes the kinds of others."""
    words = [
        RIDER.get(str(rider), UNKNOWN_RIDER) if kind == "Bicycle" else CATEGORY_OF.get(str(kind), "")
        for kind, rider in zip(c["label"], c["attributes.rider_status"])
    ]
    category = np.array(words, dtype="<U16")
    left_out += [str(kind) for kind in c["label"][category == ""]]
    uuid, sibling = c["uuid"].astype(np.str_), c["cuboids.sibling_id"].astype(np.str_)
    of_gt = c["cuboids.sensor_id"] == GT_SENSOR
    # In sequence 002 one of the two names the other by a part of its uuid only.
    twin = of_gt & (np.isin(sibling, uuid[~of_gt]) | np.isin(uuid, sibling[~of_gt]))
    # A cuboid of the PandarGT alone still belongs to the track of its twin.
    track_id = np.where(of_gt & (np.char.str_len(sibling) > 1), sibling, uuid)
    center = np.stack([c[f"position.{k}"] for k in "xyz"], axis=1).astype(np.float64)
    stamp = np.where(of_gt, gt_t_ns, t_ns + compute_scan_offset_ns(apply(inverse(map_T_lidar), center), PERIOD_NS))
    size, yaw = _sizes(c), wrap_angle(c["yaw"] + np.pi / 2)
    keep = (category != "") & ~twin & (size > 0).all(axis=1)
    return tuple(column[keep] for column in (stamp, track_id, category, center, size, yaw))


def _sizes(c: Columns) -> Array:
    """Length, width and height (M, 3) of cuboids; the data set's x is the width and its y the length, a yaw of 0 faces +y."""
    return np.stack([c["dimensions.y"], c["dimensions.x"], c["dimensions.z"]], axis=1).astype(np.float64)


TABLE = ".pkl.gz"
ROAD_BELOW_POSE_M = 0.325
# From the ego frame (x forward, y left, origin on the road) to the frame of the data set's poses.
POSE_T_EGO = transform(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), [0.0, 0.0, -ROAD_BELOW_POSE_M])
# Fit of azimuth over time (x, y) and of the vertical field of view, -25 to +15 degrees (z), of the Pandar64's points.
EGO_T_PANDAR64 = transform(np.eye(3), [0.75, 0.0, 1.8 + ROAD_BELOW_POSE_M])
# The mount of the PandarGT is not documented; its points are in the map already, so the mount only sets where its rays start.
# A Chrysler Pacifica, by its data sheet.
EGO_VEHICLE = EgoVehicle(size_m=(5.18, 2.02, 1.78), rear_axle_offset_m=1.45)

# Camera poses that scatter more about the mount do not fit the ego poses.
MAX_MOUNT_SPREAD_M = 0.05
MIN_GNSS_TRACK_M = 20.0
MAX_GNSS_ANGLE_RAD = np.radians(1.0)


class PandaSetReader(records.FolderReader):
    """Reader of PandaSet sequences; the root is a sequence or a folder of sequences."""

    name = "pandaset"
    looks_for = "a folder with lidar/poses.json and camera/, or a folder of such folders"

    def find(self, path: Path) -> dict[str, Path]:
        """Find the sequences at a folder by name."""
        places = [path] if _is_sequence(path) else [p for p in records.list_folders(path) if _is_sequence(p)]
        return {p.resolve().name if p == path else p.name: p for p in places}

    def open(self, path: Path, sequence: str) -> Log:
        """Open a sequence; no sweep and no cuboid is read."""
        folder = path if _is_sequence(path) else path / sequence
        require_links_inside(folder, path)
        return _open(folder)


READER = PandaSetReader()


def _is_sequence(path: Path) -> bool:
    return (path / "lidar" / "poses.json").is_file() and (path / "camera").is_dir()


def _open(path: Path) -> Log:
    notes: list[str] = []
    lidar_t_ns, map_T_pose = _poses(path / "lidar")
    map_T_ego = map_T_pose @ POSE_T_EGO
    keep = strictly_increasing(lidar_t_ns, "lidar/timestamps.json", notes)
    track = PoseTrack(lidar_t_ns[keep], map_T_ego[keep])
    cameras, streams = _cameras(path, track, notes)
    kept = set(keep.tolist())  # records whose stamp is far off have no place among the others
    files = _files(path, "lidar", TABLE, len(lidar_t_ns), notes)
    sweeps = SweepFiles({k: file for k, file in files.items() if k in kept}, lidar_t_ns, notes)
    lidars = {lidar: Lidar(lidar, "ego", EGO_T_PANDAR64) for lidar in (LIDARS if sweeps.files else ())}
    streams |= {lidar: sweeps.stream(lidar) for lidar in lidars}
    if not streams:
        raise LogError(f"{path}: neither images nor sweeps are there; a log needs at least one record")
    cuboids = records.list_numbered_files(path / "annotations" / "cuboids", (TABLE,))
    cuboids = {k: file for k, file in cuboids.items() if k in kept or k >= len(lidar_t_ns)}
    map_T_lidar = map_T_ego @ EGO_T_PANDAR64

    @cache
    def labels() -> Labels | None:
        return read_labels(cuboids, lidar_t_ns, sweeps.gt_stamps, map_T_lidar, notes) if cuboids else None

    index = read_text(path / "lidar" / "poses.json", JSON_LIMIT_BYTES, LogError)
    return Log(
        name=f"pandaset-{path.resolve().name}",
        format=READER.name,
        cameras=cameras,
        lidars=lidars,
        streams=streams,
        ego=track,
        ego_vehicle=EGO_VEHICLE,
        map=_map_frame(path / "meta" / "gps.json", map_T_pose, notes),
        labels=labels,
        reference_camera="front_camera" if "front_camera" in cameras else None,
        digest=digest_of([index], sorted(path.glob(f"*/*{TABLE}")) + sorted(path.glob("*/*/*.*"))),
        calibrations={n: f"{path}/camera/{n}/intrinsics.json" for n in cameras},
        notes=defer_notes(notes, *(partial(sweeps.index, lidar) for lidar in lidars), labels),
    )


def _files(path: Path, folder: str, suffix: str, count: int, notes: list[str]) -> dict[int, Path]:
    """Find the records of a sensor by their number and note missing ones: they are gaps."""
    found = records.list_numbered_files(path / folder, (suffix,))
    files = {k: p for k, p in found.items() if k < count}
    beyond, missing = len(found) - len(files), sorted(set(range(count)) - set(files))
    if beyond:
        notes.append(f"{folder}: {beyond} of {len(found)} records left out: there are stamps for {count}")
    if missing:
        notes.append(f"{folder}: {len(missing)} of {count} records are missing, first number {missing[0]:02d}")
    return files


def _cameras(path: Path, track: PoseTrack, notes: list[str]) -> tuple[dict[str, Camera], dict[str, Stream]]:
    cameras, streams = {}, {}
    for folder in records.list_folders(path / "camera"):
        name, intrinsics = folder.name, folder / "intrinsics.json"
        if not is_present(intrinsics):
            images = len(records.list_numbered_files(folder, (".jpg",)))
            if images:
                notes.append(f"camera/{name}: {images} images left out: it has no intrinsics.json")
            continue
        t_ns, map_T_cam = _poses(folder)
        files = _files(path, f"camera/{name}", ".jpg", len(t_ns), notes)
        if not files:
            continue
        size_px = records.first_image_size(list(files.values()))
        # Mount `ego_T_cam` (4, 4) of a camera from its poses in the world: medians over its frames
        map_T_ego, known = track.at(t_ns)
        if not known.any():
            apart = describe_gap(Span.of("ego poses", track.t_ns), Span.of("frames", t_ns))
            raise LogError(f"{folder}/timestamps.json and lidar/timestamps.json: {apart}")
        ego_T_cam = inverse(map_T_ego[known]) @ map_T_cam[known]
        translation = np.median(ego_T_cam[:, :3, 3], axis=0)
        rotation = nearest_rotation(np.median(ego_T_cam[:, :3, :3], axis=0))
        spread_m = float(np.median(np.linalg.norm(ego_T_cam[:, :3, 3] - translation, axis=1)))
        if spread_m > MAX_MOUNT_SPREAD_M:
            notes.append(f"{name}: its poses and the ego's do not fit together, typically by {spread_m:.2f} m")
        try:
            lens = read_json(intrinsics)
            fx, fy, cx, cy = (float(lens[k]) for k in ("fx", "fy", "cx", "cy"))
        except (TypeError, KeyError, ValueError):
            raise LogError(f"{intrinsics}: expected the numbers fx, fy, cx, cy") from None
        if fx <= 0 or fy <= 0:
            raise LogError(f"{intrinsics}: fx {fx:g}, fy {fy:g}, expected focal lengths above 0")
        K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        cameras[name] = Camera(name, *size_px, K, "ego", transform(rotation, translation))
        numbers = np.array(list(files))
        numbers = numbers[strictly_increasing(t_ns[numbers], name, notes)]
        streams[name] = records.image_stream(name, t_ns[numbers], [files[int(n)] for n in numbers], size_px)
    if not cameras:
        notes.append("no images: camera/ has no folder with intrinsics.json, poses.json, timestamps.json and images")
    return cameras, streams


def _map_frame(path: Path, map_T_pose: Array, notes: list[str]) -> MapFrame:
    """Georeference the map where the GNSS track is long enough to show that its axes are east and north."""
    if not is_present(path):
        return MapFrame()
    fixes = read_json(path)
    try:
        geodetic = np.array([[f["lat"], f["long"], f["height"]] for f in fixes], dtype=np.float64).reshape(-1, 3)
    except (TypeError, KeyError, ValueError):
        raise LogError(f"{path}: expected a list of records with lat, long and height") from None
    if not len(geodetic) or not np.isfinite(geodetic).all() or np.abs(geodetic[:, 0]).max() >= 90:
        notes.append("meta/gps.json holds no usable fixes: the position of the map is unknown")
        return MapFrame()
    frame, reason = georeference(geodetic, map_T_pose[: len(geodetic), :3, 3], str(path))
    if reason:
        notes.append(f"{reason}: the map is only local and its north is not known")
    return frame


def georeference(geodetic: Array, xyz_map: Array, where: str) -> tuple[MapFrame, str]:
    """Map frame of GNSS fixes (N, 3) in deg and m at positions (N, 3) in the map, and why it has no projection if so; `where` names the fixes in errors.

    The map's axes count as east and north only if the track reaches 20 m and the best rotation is below 1 degree.
    """
    n = min(len(geodetic), len(xyz_map))
    latitude, longitude, altitude = (float(v) for v in geodetic[0])
    local = MapFrame(latitude, longitude, altitude)
    if np.linalg.norm(np.ptp(xyz_map[:, :2], axis=0)) < MIN_GNSS_TRACK_M:
        return local, f"the ego moves less than {MIN_GNSS_TRACK_M:g} m"
    first = MapFrame(latitude, longitude, altitude, transverse_mercator(latitude, longitude))
    east_north = poses_from_geodetic(first, geodetic[:n], np.zeros((n, 3)), where=where)[:, :2, 3]
    a, b = xyz_map[:n, :2] - xyz_map[:n, :2].mean(0), east_north - east_north.mean(0)
    turn = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    if abs(turn) > MAX_GNSS_ANGLE_RAD:
        return local, f"GNSS and map differ by {np.degrees(turn):.1f} degrees"
    map_m = xyz_map[:n].mean(0)
    shift = np.append(east_north.mean(0) - map_m[:2], np.mean(geodetic[:n, 2] - altitude - xyz_map[:n, 2]))
    latitude, longitude, altitude = (float(v[0]) for v in geodetic_from_map(first, shift[None], where)[:3])
    return MapFrame(latitude, longitude, altitude, transverse_mercator(latitude, longitude)), ""


def _poses(folder: Path) -> tuple[NDArray[np.int64], Array]:
    """Stamps (N,) int64 ns and poses (N, 4, 4) of a sensor in the world."""
    stamps, poses = read_json(folder / "timestamps.json"), read_json(folder / "poses.json")
    if not isinstance(stamps, list) or not isinstance(poses, list) or len(stamps) != len(poses) or not stamps:
        raise LogError(f"{folder}: timestamps.json and poses.json must be lists of the same length, and not empty")
    try:
        q = np.array([[p["heading"][k] for k in "wxyz"] for p in poses], dtype=np.float64)
        position = np.array([[p["position"][k] for k in "xyz"] for p in poses], dtype=np.float64)
    except (TypeError, KeyError, ValueError) as problem:
        expected = "expected records of position x, y, z and heading w, x, y, z"
        raise LogError(f"{folder}/poses.json: {expected}: {problem}") from None
    sensor_poses = records.checked_poses(q, position, lambda k: f"{folder}/poses.json: record {k}")
    for k, stamp in enumerate(stamps):
        if not isinstance(stamp, (int, float)) or isinstance(stamp, bool) or not abs(stamp) < MAX_TIME_S:
            expected = f"expected a stamp in seconds below {MAX_TIME_S:g}"
            raise LogError(f"{folder}/timestamps.json: record {k}: {str(stamp)[:40]!a}, {expected}")
    return np.round(np.array(stamps, dtype=np.float64) * NS_PER_S).astype(np.int64), sensor_poses
