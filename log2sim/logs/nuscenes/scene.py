"""One scene of nuScenes: its samples, sweeps, poses and annotations as labels.

Tables are JSON lists of flat records, scanned in chunks because some hold over a gigabyte.

Verified on sweeps of two vehicles (n008, n015). Files keep the order of firing: 32 rings in turn, 1084 and 1086 times.
Rays without a return are stored with range 0 and compensated like the others, so they lie where the sensor was: on a
straight path that ends at the origin with the last firing. The first one is 0.425 m behind at a speed of 8.5 m/s, the
way of 50 ms. Hence all points are in the frame of the sensor at the end of the turn, which is the stamp. It begins at
the left of the vehicle and turns clockwise; times by order and by azimuth agree to 0.2 ms.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Labels, Sweep
from log2sim.errors import LogError, RecordError
from log2sim.files.arrays import Columns
from log2sim.files.documents import RepeatedKeysError, read_json, require_unique, unique_decoder
from log2sim.files.inputs import inside, open_regular, require_link_inside
from log2sim.geometry import Array, PoseTrack, apply, inverse, rotation_from_quaternion, transform, wrap_angle, yaw_of
from log2sim.logs.records import MAX_SWEEP_BYTES, MAX_SWEEP_POINTS, find_not_unit, read_bytes, sweep_of
from log2sim.logs.stamps import MAX_TIME_S, compute_scan_offset_ns, note_left_out, strictly_increasing

Record = dict[str, Any]

CHUNK_BYTES = 4 * 1024 * 1024
# Records of v1.0 have 200 to 700 bytes.
MAX_RECORD_BYTES = 64 * 1024
# Tokens have 32 characters, names of files some hundred; arrays of text make room for the longest in every row.
MAX_TEXT_CHARACTERS = 1024
# Meters, pixels and parts of quaternions are all smaller; squares of much larger numbers are not finite.
MAX_NUMBER = 1e9
# Braces inside of strings are tried as the start of a record before the one that is.
MAX_BRACES = 64

SCENES, DATA = "scene", "sample_data"


@dataclass(frozen=True)
class Tables:
    """Tables of one version, such as the folder v1.0-mini."""

    folder: Path

    def path(self, table: str) -> Path:
        """Return the file of a table; `LogError` when it is a link that leaves the folders of the log."""
        path = self.folder / f"{table}.json"
        require_link_inside(path, self.folder.parent)
        return path

    def read(self, table: str, key: str) -> list[Record]:
        """Read a small table; `LogError` for a record whose `key` is no text."""
        path = self.path(table)
        records = read_json(path)
        if not isinstance(records, list) or not all(isinstance(r, dict) for r in records):
            raise LogError(f"{path}: expected a list of records")
        for record in records:
            text_of(record, key, path)
        return records

    def all_of(self, table: str) -> dict[str, Record]:
        """Read a small table as its records by token."""
        return {record["token"]: record for record in self.read(table, "token")}

    def by_token(self, table: str, tokens: Collection[str]) -> dict[str, Record]:
        """Scan a table for the records of some tokens; `LogError` when it has not all of them."""
        path = self.path(table)
        wanted = set(tokens)
        found: dict[str, Record] = {}
        for record in scan_records(path, "token", wanted) if wanted else ():
            found[record["token"]] = record
            if len(found) == len(wanted):
                break
        if len(found) < len(wanted):
            missing = min(wanted - found.keys())
            raise LogError(
                f"{path}: no record with token {missing[:40]!a}, which another table names "
                f"({len(wanted) - len(found)} of {len(wanted)} are missing)"
            )
        return found

    def matching(self, table: str, key: str, values: Collection[str]) -> list[Record]:
        """Scan a table for the records whose `key` is one of some values."""
        return list(scan_records(self.path(table), key, values))


def scan_records(path: Path, key: str, values: Collection[str], chunk_bytes: int = CHUNK_BYTES) -> Iterator[Record]:
    """Find the records of a table in which `key` has one of some values, in the order of the table.

    Only these records are parsed. Memory is bounded by the chunk; line breaks and spaces are as they like. Raises `LogError` for a
    table that is missing or does not begin and end as a list, or a wanted record that is not valid JSON.
    """
    wanted = frozenset(values)
    plain = frozenset(value.encode(errors="replace") for value in wanted)
    entry = re.compile(rb'"' + re.escape(key.encode()) + rb'"\s*:\s*"([^"]*)"')
    for data, begin, end, offset in _windows(path, chunk_bytes):
        found = entry.findall(data, begin)
        escaped = b"\\" in data and any(b"\\" in value for value in found)
        if not escaped and plain.isdisjoint(found):
            continue
        for match in entry.finditer(data, begin):
            if match.start() >= end:
                break
            if match[1] in plain or b"\\" in match[1]:
                record = _record_around(data, match.start(), f"{path}, byte {offset + match.start()}")
                if isinstance(record.get(key), str) and record[key] in wanted:
                    yield record


def _windows(path: Path, chunk_bytes: int) -> Iterator[tuple[bytes, int, int, int]]:
    """Yield parts of a table as bytes, the range in them that is new, and the offset in the file of the first byte.

    Around the new range every record that touches it is complete.
    """
    try:
        with open_regular(path) as file:
            data, begin, offset = b"", 0, 0
            while True:
                chunk = file.read(chunk_bytes)
                if not offset and not data and chunk.lstrip()[:1] not in (b"[", b""):
                    raise LogError(f"{path}: begins with {chunk.lstrip()[:1]!a}, expected a JSON list of records")
                if b"\0" in chunk:  # a file that was cut and grown by a copy that failed: it may go on for gigabytes
                    place = offset + len(data) + chunk.index(b"\0")
                    raise LogError(f"{path}, byte {place}: not valid JSON: a zero byte; is the file damaged?")
                if not chunk and data.rstrip()[-1:] != b"]":
                    raise LogError(f"{path}: not valid JSON: it does not end with ']'; is the file truncated?")
                data += chunk
                end = max(len(data) - MAX_RECORD_BYTES, begin) if chunk else len(data)
                yield data, begin, end, offset
                if not chunk:
                    return
                cut = max(end - MAX_RECORD_BYTES, 0)
                data, begin, offset = data[cut:], end - cut, offset + cut
    except OSError as problem:
        raise LogError(f"{path}: cannot be read: {problem.strerror}; it belongs to the other tables") from None


def _record_around(data: bytes, at: int, where: str) -> Record:
    """Parse the record that holds the entry at a place."""
    first, last, start = max(at - MAX_RECORD_BYTES, 0), at + MAX_RECORD_BYTES, at
    for _ in range(MAX_BRACES):
        start = data.rfind(b"{", first, start)
        if start < 0:
            break
        text = data[start:last].decode("utf-8", errors="replace")
        repeated: list[str] = []
        try:
            record, length = unique_decoder(repeated).raw_decode(text)
        except (ValueError, RecursionError):
            continue
        if len(text[:length].encode()) > at - start:
            try:
                require_unique(repeated)
            except RepeatedKeysError as problem:
                raise LogError(f"{where}: {problem}") from None
            return dict(record)
    raise LogError(f"{where}: not valid JSON; expected a flat record of at most {MAX_RECORD_BYTES} bytes")


def text_of(record: Record, key: str, path: Path) -> str:
    """Return a text of a record; `LogError` when it has none or one that cannot be printed in a line."""
    value = record.get(key)
    if not isinstance(value, str) or not value.isprintable() or len(value) > MAX_TEXT_CHARACTERS:
        raise _wrong(record, key, path, f"a text in one line of at most {MAX_TEXT_CHARACTERS} characters")
    return value


def stamp_ns_of(record: Record, path: Path) -> int:
    """Return the stamp of a record in ns; `LogError` when it is no whole number of microseconds."""
    value = record.get("timestamp")
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value <= MAX_TIME_S * 10**6:
        raise _wrong(record, "timestamp", path, "whole microseconds")
    return value * 1000


def numbers_of(records: list[Record], key: str, shape: tuple[int, ...], path: Path) -> Array:
    """Return the numbers of a key as (len(records), *shape) float64; `LogError` that names the first record without."""
    rows = np.zeros((len(records), *shape))
    for k, record in enumerate(records):
        try:
            row = np.asarray(record.get(key), dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            row = np.zeros(0)
        if row.shape != shape or not (np.abs(row) <= MAX_NUMBER).all():
            expected = " x ".join(str(n) for n in shape)
            raise _wrong(record, key, path, f"{expected} finite numbers up to {MAX_NUMBER:g}")
        rows[k] = row
    return rows


def quaternions_of(records: list[Record], path: Path) -> Array:
    """Return the rotations of records, unit quaternions (R, 4) scalar-first; `LogError` for one that is not."""
    q = numbers_of(records, "rotation", (4,), path)
    for k in find_not_unit(q):
        raise _wrong(records[k], "rotation", path, "a unit quaternion")
    return q


def _wrong(record: Record, key: str, path: Path, expected: str) -> LogError:
    """Return the error for a value of a record, which it names by its token."""
    text = ascii(record.get(key))
    shown = text if len(text) <= 60 else f"{text[:57]}..."
    return LogError(f"{path}, token {str(record.get('token'))[:40]!a}: '{key}' is {shown}, expected {expected}")


# Velodyne HDL-32E, user's manual: 32 lasers, one firing of all in 46.08 us, no returns nearer than 1 m.
RINGS = 32
FIRING_NS = 46_080
MIN_RANGE_M = 1.0
# More than a turn: several sweeps joined in one file.
MAX_FIRINGS = 1200
TURN_NS = 50_000_000

BYTES_PER_POINT = 20


def read_sweep(path: Path, t_ns: int, track: PoseTrack, ego_T_lidar: Array) -> Sweep:
    """Read a sweep in the frame of the sensor at `t_ns`; points nearer than 1 m, which are no returns, are left out."""
    data = read_bytes(path, t_ns, MAX_SWEEP_BYTES)
    points = len(data) // BYTES_PER_POINT
    if len(data) % BYTES_PER_POINT:
        raise RecordError(f"{path} (stamp {t_ns}): {len(data)} bytes, not 5 float32 (x, y, z, intensity, ring) a point")
    if points > MAX_SWEEP_POINTS:
        raise RecordError(f"{path} (stamp {t_ns}): {points} points, more than {MAX_SWEEP_POINTS}")
    rows = np.frombuffer(data, "<f4").reshape(-1, 5)
    xyz, offset_ns = rows[:, :3], firing_offset_ns(rows[:, 4])
    # Where it was at the time of each point, in its frame at the stamp, where that is known.
    sensor: Array = np.zeros(3)
    if offset_ns is not None:
        first = int(offset_ns.min())
        map_T_ego, known = track.at(np.array([t_ns + first, t_ns]))
        map_T_lidar = map_T_ego @ ego_T_lidar
        if first and known.all():
            start = map_T_lidar[1, :3, :3].T @ (map_T_lidar[0, :3, 3] - map_T_lidar[1, :3, 3])
            sensor = (offset_ns / first)[:, None] * start
    with np.errstate(over="ignore", invalid="ignore"):
        returned = np.linalg.norm(xyz - sensor, axis=1) >= MIN_RANGE_M
    offset_ns = None if offset_ns is None else offset_ns[returned]
    return sweep_of(xyz[returned], t_ns, offset_ns, "lidar", t_ns, rows[returned, 3])


def firing_offset_ns(ring: NDArray[np.float32]) -> NDArray[np.int64] | None:
    """Time (N,) ns of points relative to the end of the turn by their order; None when it is not that of firing."""
    firings = len(ring) // RINGS
    in_turn = np.array_equal(ring, np.tile(np.arange(RINGS), firings))
    if not 0 < firings <= MAX_FIRINGS or not in_turn:
        return None
    return np.repeat((np.arange(firings, dtype=np.int64) - (firings - 1)) * FIRING_NS, RINGS)


# Names of sensors become names of files.
CHANNEL = re.compile(r"[A-Za-z0-9_-]{1,64}")


@dataclass(frozen=True, eq=False)
class Channel:
    """One sensor of a scene."""

    name: str  # such as CAM_FRONT
    modality: str  # "camera", "lidar" or "radar"
    calibration: Record  # of calibrated_sensor
    ego_T_sensor: Array  # (4, 4)
    records: list[Record]  # of sample_data, key frames and sweeps, by their stamps, with files or without
    t_ns: NDArray[np.int64]  # (F,)

    def present(self, root: Path, where: Path) -> tuple[list[Record], NDArray[np.int64], list[Path]]:
        """Select the records whose files are there: records, stamps (F,) and files."""
        files = [inside(root, text_of(record, "filename", where), str(where)) for record in self.records]
        rows = [k for k, file in enumerate(files) if file.is_file()]
        return [self.records[k] for k in rows], self.t_ns[rows], [files[k] for k in rows]


@dataclass(frozen=True, eq=False)
class Scene:
    """The records of one scene."""

    tables: Tables
    record: Record  # of scene
    notes: list[str] = field(default_factory=list)  # takes what is wrong with the stamps

    @cached_property
    def samples(self) -> list[Record]:
        """Key frames by their stamps."""
        path = self.tables.path("sample")
        token = text_of(self.record, "token", self.tables.path(SCENES))
        samples = self.tables.matching("sample", "scene_token", [token])
        if not samples:
            raise LogError(f"{path}: no sample of scene '{self.record.get('name')}'; expected its key frames")
        by_token = {text_of(sample, "token", path): sample for sample in samples}
        twice, stated = len(samples) - len(by_token), self.record.get("nbr_samples")
        if twice:
            self.notes.append(f"sample.json: {twice} key frames are there twice; each counts once")
        if isinstance(stated, int) and len(by_token) < stated:
            missing = f"{stated - len(by_token)} of the {stated} key frames of the scene"
            self.notes.append(f"sample.json: {missing} are missing")
        return sorted(by_token.values(), key=lambda sample: stamp_ns_of(sample, path))

    @cached_property
    def data(self) -> list[Record]:
        """Records of all sensors, in the order of the table."""
        path = self.tables.path("sample")
        data = self.tables.matching(DATA, "sample_token", {text_of(s, "token", path) for s in self.samples})
        if not data:
            raise LogError(f"{self.tables.path(DATA)}: no record of scene '{self.record.get('name')}'")
        return data

    @cached_property
    def channels(self) -> dict[str, Channel]:
        """Sensors by name."""
        path, of_sensors = self.tables.path("calibrated_sensor"), self.tables.path("sensor")
        used = {text_of(record, "calibrated_sensor_token", self.tables.path(DATA)) for record in self.data}
        calibrated = self.tables.by_token("calibrated_sensor", used)
        sensors = self.tables.all_of("sensor")
        by_name: dict[str, list[tuple[Record, Record]]] = {}
        for record in self.data:
            calibration = calibrated[record["calibrated_sensor_token"]]
            sensor = sensors.get(text_of(calibration, "sensor_token", path))
            if sensor is None:
                token = f"'{calibration['sensor_token'][:40]}', which calibrated_sensor.json names"
                raise LogError(f"{of_sensors}: no record with token {token}")
            name = text_of(sensor, "channel", of_sensors)
            if not CHANNEL.fullmatch(name):
                raise LogError(f"{of_sensors}: channel {name[:40]!a}, expected letters, digits, _ and -")
            by_name.setdefault(name, []).append((record, calibration | {"modality": sensor.get("modality")}))
        return {name: self._channel(name, by_name[name]) for name in sorted(by_name)}

    def _channel(self, name: str, rows: list[tuple[Record, Record]]) -> Channel:
        calibration = rows[0][1]
        same = [record for record, other in rows if other["token"] == calibration["token"]]
        if len(same) < len(rows):
            self.notes.append(f"{name}: {len(rows) - len(same)} records of another calibration left out")
        stamps = np.array([stamp_ns_of(r, self.tables.path(DATA)) for r in same], dtype=np.int64)
        order = np.argsort(stamps, kind="stable")  # tables have no order
        keep = strictly_increasing(stamps[order], name, self.notes)
        path = self.tables.path("calibrated_sensor")
        rotation = rotation_from_quaternion(quaternions_of([calibration], path)[0])
        ego_T_sensor = transform(rotation, numbers_of([calibration], "translation", (3,), path)[0])
        records, t_ns = [same[k] for k in order[keep]], stamps[order[keep]]
        return Channel(name, str(calibration["modality"]), calibration, ego_T_sensor, records, t_ns)

    @cached_property
    def ego(self) -> PoseTrack:
        """Ego poses at the stamps of all sensors, without an offset; those of one stamp are the same."""
        path, where = self.tables.path("ego_pose"), self.tables.path(DATA)
        tokens = {text_of(record, "ego_pose_token", where) for record in self.data}
        records = list(self.tables.by_token("ego_pose", tokens).values())
        stamps = np.array([stamp_ns_of(record, path) for record in records], dtype=np.int64)
        rotation = rotation_from_quaternion(quaternions_of(records, path))
        poses = transform(rotation, numbers_of(records, "translation", (3,), path))
        t_ns, first = np.unique(stamps, return_index=True)
        return PoseTrack(t_ns, poses[first])

    @cached_property
    def location(self) -> str:
        """Name of the city and its quarter; "" when log.json does not state it."""
        logs = self.tables.all_of("log")
        return str(logs.get(str(self.record.get("log_token")), {}).get("location", ""))


ANNOTATIONS = "sample_annotation"
CATEGORY_OF = {
    "vehicle.car": "car", "vehicle.truck": "truck", "vehicle.bus.bendy": "bus", "vehicle.bus.rigid": "bus",
    "vehicle.motorcycle": "motorcycle", "vehicle.bicycle": "bicycle", "vehicle.construction": "other",
    "vehicle.emergency.ambulance": "other", "vehicle.emergency.police": "other", "vehicle.trailer": "other",
    "human.pedestrian.adult": "pedestrian", "human.pedestrian.child": "pedestrian",
    "human.pedestrian.construction_worker": "pedestrian", "human.pedestrian.police_officer": "pedestrian",
    "human.pedestrian.wheelchair": "pedestrian", "human.pedestrian.personal_mobility": "other",
    "human.pedestrian.stroller": "other",
}  # fmt: skip
NO_ROAD_USERS = {
    "animal", "movable_object.barrier", "movable_object.debris", "movable_object.pushable_pullable",
    "movable_object.trafficcone", "static_object.bicycle_rack",
}  # fmt: skip
WITH_RIDER = "cycle.with_rider"
# Visibility in the pictures of all cameras together: 1 is up to 40 %.
HARDLY_VISIBLE = "1"
# An object that crosses the direction in which the turns start would get two labels within a few ms.
MIN_STEP_NS = 10_000_000
# Key frames are 0.4 to 0.6 s apart; over more than a missing one nothing is interpolated.
MAX_GAP_NS = 1_100_000_000


@dataclass(frozen=True, eq=False)
class _Rows(Columns):
    """Annotations as columns, A rows, in the order of instances and stamps."""

    sample: NDArray[np.int64]
    t_ns: NDArray[np.int64]
    track_id: NDArray[np.str_]
    kind: NDArray[np.str_]
    category: NDArray[np.str_]
    center_m: Array
    size_m: Array
    yaw_rad: Array
    visible: NDArray[np.bool_]


def read_labels(scene: Scene, lidar: Channel | None, offset_m: Array, notes: list[str]) -> Labels | None:
    """Read the annotations of a scene.

    `lidar`: in whose sweeps objects were labeled. `offset_m` (3,) float64: taken off positions. `notes`: takes what was
    left out. Returns None for a scene without annotations, as those of the test split are.

    A box fits the points where they were measured, and the LiDAR scans different directions at different times of its
    turn. Of the one fast car with points at hand, the box ends 2 cm from points of 16 ms before the stamp, in which it
    drove 15 cm.
    Between annotations of an instance in consecutive samples boxes are added for each turn of the LiDAR: positions
    linear, yaw the shorter way, size, category and visibility of the nearer one. `labeled_ns` are the samples alone.
    """
    sample_path = scene.tables.path("sample")
    samples = {text_of(sample, "token", sample_path): k for k, sample in enumerate(scene.samples)}
    annotations = scene.tables.matching(ANNOTATIONS, "sample_token", samples)
    if not annotations:
        notes.append("the scene has no annotations: nothing is labeled")
        return None
    stamps = np.array([stamp_ns_of(sample, sample_path) for sample in scene.samples], dtype=np.int64)
    rows = _rows_of(scene, annotations, samples, notes)
    rows = replace(rows, t_ns=scanned_ns(scene, lidar, stamps[rows.sample], rows.center_m))
    # Stamps of all turns of the LiDAR: those known (F,), and others about every 50 ms where they are farther apart
    t_ns = stamps if lidar is None else np.union1d(stamps, lidar.t_ns)
    t_ns = t_ns[np.diff(t_ns, prepend=t_ns[0] - MIN_STEP_NS) >= MIN_STEP_NS]
    step = np.diff(t_ns)
    missing = np.where(step <= MAX_GAP_NS, np.maximum(np.round(step / TURN_NS).astype(np.int64) - 1, 0), 0)
    first = np.repeat(np.arange(len(missing)), missing)
    number = np.arange(len(first)) - np.repeat(np.cumsum(missing) - missing, missing) + 1
    step_ns = (step // (missing + 1))[first]
    ends_ns = np.union1d(t_ns, t_ns[first] + number * step_ns)
    rows = _Rows.join([rows, _between(scene, lidar, rows, stamps, ends_ns)])
    rows = rows.take(np.argsort(rows.t_ns, kind="stable"))
    return Labels(
        rows.t_ns, rows.track_id, rows.category, rows.center_m - offset_m, rows.size_m, rows.yaw_rad, rows.visible,
        kind=rows.kind, labeled_ns=np.unique(stamps - (0 if lidar is None else TURN_NS // 2)),
    )  # fmt: skip


def scanned_ns(scene: Scene, lidar: Channel | None, t_ns: NDArray[np.int64], center_m: Array) -> NDArray[np.int64]:
    """Compute when (L,) the LiDAR scanned objects at `center_m` (L, 3) in the turns that end at `t_ns` (L,)."""
    if lidar is None:
        return t_ns
    map_T_ego, known = scene.ego.at(t_ns)
    local = apply(inverse(map_T_ego @ lidar.ego_T_sensor), center_m)
    return np.where(known, t_ns + compute_scan_offset_ns(local, TURN_NS), t_ns).astype(np.int64)


def _between(
    scene: Scene, lidar: Channel | None, rows: _Rows, stamps: NDArray[np.int64], ends_ns: NDArray[np.int64]
) -> _Rows:
    """Interpolate annotations of one instance in consecutive samples (S,) at the turns that end between them."""
    step_ns = np.diff(rows.t_ns)
    same = (rows.track_id[1:] == rows.track_id[:-1]) & (step_ns > 0) & (step_ns <= MAX_GAP_NS)
    before = np.flatnonzero(same & (np.diff(rows.sample) == 1))
    first = np.searchsorted(ends_ns, stamps[rows.sample[before]], side="right")
    count = np.maximum(np.searchsorted(ends_ns, stamps[rows.sample[before + 1]]) - first, 0)
    pair = np.repeat(before, count)
    end_ns = ends_ns[np.repeat(first, count) + np.arange(len(pair)) - np.repeat(np.cumsum(count) - count, count)]
    begin_ns, span_ns = rows.t_ns[pair], rows.t_ns[pair + 1] - rows.t_ns[pair]
    step = rows.center_m[pair + 1] - rows.center_m[pair]
    roughly = ((end_ns - TURN_NS // 2 - begin_ns) / span_ns)[:, None]
    t_ns = scanned_ns(scene, lidar, end_ns, rows.center_m[pair] + roughly * step)
    share = (t_ns - begin_ns) / span_ns
    keep = (t_ns - begin_ns >= MIN_STEP_NS) & (begin_ns + span_ns - t_ns >= MIN_STEP_NS)
    keep[1:] &= (pair[1:] != pair[:-1]) | (np.diff(t_ns) >= MIN_STEP_NS)
    turn = wrap_angle(rows.yaw_rad[pair + 1] - rows.yaw_rad[pair])
    center = rows.center_m[pair] + share[:, None] * step
    yaw = wrap_angle(rows.yaw_rad[pair] + share * turn)
    nearer = np.where(share <= 0.5, pair, pair + 1)
    return replace(rows.take(nearer[keep]), t_ns=t_ns[keep], center_m=center[keep], yaw_rad=yaw[keep])


def _rows_of(scene: Scene, annotations: list[Record], samples: dict[str, int], notes: list[str]) -> _Rows:
    """Check annotations and return them as columns; stamps are still 0."""
    path, of_categories = scene.tables.path(ANNOTATIONS), scene.tables.path("category")
    tokens = [text_of(a, "instance_token", path) for a in annotations]
    instances, categories = scene.tables.by_token("instance", tokens), scene.tables.all_of("category")
    kind_of = {}
    for token, instance in instances.items():
        wanted = text_of(instance, "category_token", scene.tables.path("instance"))
        if wanted not in categories:
            raise LogError(f"{of_categories}: no record with token '{wanted[:40]}', which instance.json names")
        kind_of[token] = text_of(categories[wanted], "name", of_categories)
    kinds = [kind_of[token] for token in tokens]
    attributes = {token: str(r.get("name")) for token, r in scene.tables.all_of("attribute").items()}
    category, visible = list[str](), list[bool]()
    for a, kind in zip(annotations, kinds):
        named = a.get("attribute_tokens", [])
        if not isinstance(named, list):
            raise LogError(f"{path}, token {str(a.get('token'))[:40]!a}: 'attribute_tokens' is no list")
        word, ridden = CATEGORY_OF.get(kind, ""), WITH_RIDER in [attributes.get(str(token)) for token in named]
        category.append("cyclist" if word == "bicycle" and ridden else word)
        # The sensors hit it, and its visibility, where it is stated, is above 40 %.
        hits = [a.get(key, 0) for key in ("num_lidar_pts", "num_radar_pts")]
        is_hit = any(isinstance(n, int) and n > 0 for n in hits)
        visible.append(is_hit and a.get("visibility_token") != HARDLY_VISIBLE)
    size = numbers_of(annotations, "size", (3,), path)[:, [1, 0, 2]]  # tables: width, length, height
    rows = _Rows(
        np.array([samples[a["sample_token"]] for a in annotations], dtype=np.int64),
        np.zeros(len(annotations), dtype=np.int64),
        np.array(tokens),
        np.array(kinds),
        np.array(category, dtype="<U16"),
        numbers_of(annotations, "translation", (3,), path),
        size,
        yaw_of(rotation_from_quaternion(quaternions_of(annotations, path))),
        np.array(visible, dtype=bool),
    )
    note_left_out((kind for kind, word in zip(kinds, category) if not word), NO_ROAD_USERS, notes)
    flat = ~(size > 0).all(axis=1)
    if flat.any():
        notes.append(f"{int(flat.sum())} labels left out because a size is not above 0")
    kept = np.flatnonzero((rows.category != "") & ~flat)
    kept = kept[np.lexsort((rows.sample[kept], rows.track_id[kept]))]
    same = (np.diff(rows.sample[kept]) == 0) & (rows.track_id[kept][1:] == rows.track_id[kept][:-1])
    if same.any():
        notes.append(f"{int(same.sum())} labels repeat an instance in its sample; dropped")
    return rows.take(kept[np.r_[True, ~same][: len(kept)]])
