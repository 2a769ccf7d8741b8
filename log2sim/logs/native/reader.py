"""Reader of native log folders: `log.json` (schemas/log-1.json), CSV tables, images and sweeps."""

from __future__ import annotations

import csv
import hashlib
import io
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim import datatypes
from log2sim.datatypes.log import ROTATION_TOLERANCE, camera_of
from log2sim.errors import LogError
from log2sim.files.documents import JSON_LIMIT_BYTES, check, is_plain, read_json
from log2sim.files.inputs import inside, open_regular, read_file, require_link_inside
from log2sim.files.plugins import nearest
from log2sim.geometry import (
    DISTORTION_LENGTHS,
    Array,
    Camera,
    PoseTrack,
    RollingShutter,
    rotation_from_quaternion,
    shift_poses,
    transform,
)
from log2sim.geometry.transforms import OFFSET_STEP_M
from log2sim.logs.records import FolderReader, checked_poses, image_stream, read_sweep
from log2sim.logs.stamps import map_frame_of, note_damaged_rows, poses_from_geodetic, strictly_increasing

MAX_TABLE_BYTES = 256 * 1024 * 1024
# No coordinate on Earth, in any projection, is near this, and no square of it overflows.
MAX_NUMBER = 1e8

_EXPECTED = {
    "int": "a whole number",
    "float": f"a finite number of at most {MAX_NUMBER:g} in size",
    "bool": "0, 1, true or false",
    "str": "text",
}


@dataclass(frozen=True, eq=False)
class CsvTable:
    """A CSV file with typed columns (N,); `line` (N,) is where each row is in the file, for messages."""

    path: Path
    columns: Mapping[str, NDArray[Any]]
    line: NDArray[np.int64]
    sha256: str  # of the file

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.line)

    def __getitem__(self, name: str) -> NDArray[Any]:
        """Return a column (N,)."""
        return self.columns[name]

    def stack(self, *names: str) -> NDArray[np.float64]:
        """Stack columns to (N, len(names)) float64."""
        return np.stack([self.columns[n].astype(np.float64) for n in names], axis=1)

    def where(self, row: int, field: str) -> str:
        """Location of a value, for a message."""
        return f"{self.path}, line {self.line[row]}, field '{field}'"

    def refuse(self, wrong: NDArray[np.bool_], field: str, words: str) -> None:
        """Raise `LogError` for the first row that is wrong (N,), if there is one; VALUE in `words` stands for what it has."""
        if wrong.any():
            row = int(np.argmax(wrong))
            value = self.columns[field][row] if field in self.columns else ""
            shown = f"{value:g}" if isinstance(value, float) else str(value)
            raise LogError(f"{self.where(row, field)}: {words.replace('VALUE', shown, 1)}")


def read_csv_table(
    path: Path,
    columns: Mapping[str, str],
    optional: Mapping[str, str] | None = None,
    *,
    damaged: list[str] | None = None,
) -> CsvTable:
    """Read a CSV file with a header; an unknown column is an error.

    `columns`, `optional`: columns that must and that may be there, in any order. `damaged`: takes a message for each row with
    fewer or more fields than the header, which is left out; else it is an error. Raises `LogError` naming file, line and field.
    """
    kinds = {**columns, **(optional or {})}
    data = read_file(path, MAX_TABLE_BYTES, LogError)
    try:
        reader = csv.reader(io.StringIO(data.decode("utf-8-sig"), newline=""), strict=True)
        rows = [(reader.line_num, row) for row in reader if row]
    except UnicodeDecodeError as problem:
        number, byte = data.count(b"\n", 0, problem.start) + 1, f"byte 0x{data[problem.start]:02x}"
        raise LogError(f"{path}, line {number}: not text in UTF-8: {byte}; save the table as UTF-8") from None
    except csv.Error as problem:
        raise LogError(f"{path}: not a CSV table: {problem}") from None
    if not rows:
        raise LogError(f"{path}: is empty; expected the header {','.join(columns)}")
    header = [name.strip() for name in rows[0][1]]
    missing = [name for name in columns if name not in header]
    if missing:
        raise LogError(f"{path}, line 1: column '{missing[0]}' is missing; expected the header {','.join(columns)}")
    for name in header:
        if name not in kinds:
            hint = nearest(name, list(kinds))
            raise LogError(f"{path}, line 1: unknown column '{name}'{hint}; known: {', '.join(kinds)}")
        if header.count(name) > 1:
            raise LogError(f"{path}, line 1: column '{name}' occurs twice")
    whole = [(n, row) for n, row in rows[1:] if len(row) == len(header)]
    wrong = [(n, row) for n, row in rows[1:] if len(row) != len(header)]
    said = [f"{path}, line {n}: {len(row)} fields, the header has {len(header)}" for n, row in wrong]
    if said and damaged is None:
        raise LogError(said[0])
    if damaged is not None:
        damaged += said
    line = np.array([n for n, _ in whole], dtype=np.int64)
    values = {}
    for k, name in enumerate(header):
        cells, kind = [row[k].strip() for _, row in whole], kinds[name]
        values[name], bad = _parse(cells, kind)
        if bad is not None:
            expected = f"expected {_EXPECTED[kind]}"
            raise LogError(f"{path}, line {line[bad]}, field '{name}': '{cells[bad][:40]}', {expected}")
    return CsvTable(path, values, line, hashlib.sha256(data).hexdigest())


def _parse(text: list[str], kind: str) -> tuple[NDArray[Any], int | None]:
    """Return the values of cells, and which is the first that is wrong; None without one."""
    if kind == "str":
        return np.array(text, dtype=np.str_), None
    if kind == "bool":
        words = {"0": False, "1": True, "false": False, "true": True}
        known = [words.get(t.lower()) for t in text]
        return np.array(known, dtype=bool), known.index(None) if None in known else None
    try:
        if not is_plain("".join(text)):
            raise ValueError
        values = np.array(text, dtype=np.str_).astype(np.int64 if kind == "int" else np.float64)
    except (ValueError, OverflowError):
        # The first that cannot be parsed by itself, or is impossible.
        good = [_parse([t], kind)[1] is None for t in text] if len(text) > 1 else [False]
        return np.zeros(0), good.index(False)
    # Numbers are finite and, unless whole (stamps), at most `MAX_NUMBER`.
    possible = np.isfinite(values) & ((np.abs(values) <= MAX_NUMBER) | (values.dtype.kind == "i"))
    return values, None if possible.all() else int(np.argmin(possible))


SIZE_FIELDS = ("length_m", "width_m", "height_m")
BOX_3D_FIELDS = ("x_m", "y_m", "z_m", *SIZE_FIELDS, "yaw_rad")
BOX_3D_COLUMNS = {"t_ns": "int", "track_id": "str", "category": "str", **dict.fromkeys(BOX_3D_FIELDS, "float")}
BOX_3D_OPTIONAL = {"visible": "bool", "kind": "str", "occlusion": "int"}
LABELED_COLUMNS = {"t_ns": "int"}
BOX_2D_FIELDS = ("u0_px", "v0_px", "u1_px", "v1_px")
REGION_COLUMNS = {"t_ns": "int", "camera": "str", **dict.fromkeys(BOX_2D_FIELDS, "float")}
BOX_2D_COLUMNS = {**REGION_COLUMNS, "category": "str"}


def boxes_3d(table: CsvTable) -> datatypes.Labels:
    """Labels of a table with `BOX_3D_COLUMNS` and, optionally, some of `BOX_3D_OPTIONAL`."""
    _check_categories(table)
    visible, kind, occlusion = (table.columns.get(name) for name in BOX_3D_OPTIONAL)
    for name in SIZE_FIELDS:
        table.refuse(table[name] <= 0, name, "VALUE, expected a size above 0")
    if occlusion is not None:
        table.refuse(~np.isin(occlusion, (0, 1, 2, 3)), "occlusion", "VALUE, expected 0, 1, 2 or 3")
    center, size = table.stack("x_m", "y_m", "z_m"), table.stack(*SIZE_FIELDS)
    return datatypes.Labels(
        table["t_ns"], table["track_id"], table["category"], center, size, table["yaw_rad"], visible, kind=kind,
        occlusion=occlusion,
    )  # fmt: skip


def boxes_by_camera(table: CsvTable, cameras: Iterable[str]) -> dict[str, tuple[NDArray[np.bool_], Array]]:
    """Rows (N,) and boxes (L, 4), u0, v0, u1, v1 in px, of each camera that a table with `REGION_COLUMNS` has some of."""
    box, names = table.stack(*BOX_2D_FIELDS), sorted(cameras)
    empty = (box[:, 2] <= box[:, 0]) | (box[:, 3] <= box[:, 1])
    table.refuse(empty, "u1_px,v1_px", "the box is empty, expected u0 < u1 and v0 < v1")
    table.refuse(~np.isin(table["camera"], names), "camera", f"no camera 'VALUE'; there are: {', '.join(names)}")
    rows = {name: table["camera"] == name for name in names}
    return {n: (r, box[r]) for n, r in rows.items() if r.any()}


def _check_categories(table: CsvTable) -> None:
    words = f"'VALUE', expected one of {', '.join(datatypes.CATEGORIES)}"
    table.refuse(~np.isin(table["category"], datatypes.CATEGORIES), "category", words)


MANIFEST = "log.json"

INDEX_COLUMNS = {"t_ns": "int", "file": "str"}
COMPENSATED = {"compensated_ns": "int"}
POSE_COLUMNS = {"t_ns": "int", **dict.fromkeys(("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz"), "float")}
GNSS_FIELDS = ("latitude_deg", "longitude_deg", "altitude_m", "roll_rad", "pitch_rad", "yaw_rad")
GNSS_COLUMNS = {"t_ns": "int", **dict.fromkeys(GNSS_FIELDS, "float")}


class NativeReader(FolderReader):
    """Reader of log2sim's own log folders."""

    name = "log2sim"
    looks_for = f"a folder with {MANIFEST}"

    def find(self, path: Path) -> dict[str, Path]:
        """Find the folders of logs at a folder by name."""
        if _is_manifest(path / MANIFEST):
            return {path.resolve().name: path}
        return {p.parent.name: p.parent for p in path.glob(f"*/{MANIFEST}") if _is_manifest(p)}

    def open(self, path: Path, sequence: str) -> datatypes.Log:
        """Open a sequence."""
        root = path if (path / MANIFEST).is_file() else path / sequence
        require_link_inside(root / MANIFEST, root, path)
        return _Folder(root).log()


READER = NativeReader()


def _is_manifest(path: Path) -> bool:
    """Return whether a log.json may be ours: the table of that name of nuScenes is a list."""
    try:
        require_link_inside(path, path.parent.parent)
    except LogError:
        return not path.with_name("scene.json").exists()  # opening it says what is wrong
    try:
        with open_regular(path) as file:
            return not file.read(64).lstrip().startswith(b"[")
    except OSError:
        return False


class _Folder:
    """A log folder while it is opened; collects notes and the digest."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.file = root / MANIFEST
        self.notes: list[str] = []
        self.manifest: dict[str, Any] = read_json(self.file)
        try:
            check(self.manifest, "log-1", LogError)
        except LogError as error:
            raise LogError(f"{self.file}: {error}") from None
        self.hash = hashlib.sha256(read_file(self.file, JSON_LIMIT_BYTES, LogError))

    def log(self) -> datatypes.Log:
        m = self.manifest
        map_frame, track = self._ego()
        sensors = [self._sensor(k, entry) for k, entry in enumerate(m["sensors"])]
        self._check_sensors(sensors)
        labels = self._labels()
        boxes, regions = self._label_table("boxes_2d", BOX_2D_COLUMNS), self._label_table("ignored_2d", REGION_COLUMNS)
        # Whole kilometers (3,), m, by which the log is shifted towards the map's origin.
        mounts = [s.mount_T_cam if isinstance(s, Camera) else s.mount_T_lidar for s in sensors if s.mount == "map"]
        places = [mount_T_sensor[:3, 3] for mount_T_sensor in (mounts if track is None else track.map_T_ego[:1])]
        places += [] if labels is None else list(labels.center_m[:1])
        offset = OFFSET_STEP_M * np.round((places[0] if places else np.zeros(3)) / OFFSET_STEP_M) + 0.0
        cameras, lidars = dict[str, Camera](), dict[str, datatypes.Lidar]()
        for sensor in sensors:
            shift = offset if sensor.mount == "map" else np.zeros(3)
            if isinstance(sensor, Camera):
                cameras[sensor.name] = replace(sensor, mount_T_cam=shift_poses(sensor.mount_T_cam, shift))
            else:
                lidars[sensor.name] = replace(sensor, mount_T_lidar=shift_poses(sensor.mount_T_lidar, shift))
        image_labels, ignored = dict[str, datatypes.ImageLabels](), dict[str, datatypes.ImageRegions]()
        if boxes is not None:
            _check_categories(boxes)
            for name, (rows, box) in boxes_by_camera(boxes, cameras).items():
                image_labels[name] = datatypes.ImageLabels(boxes["t_ns"][rows], box, boxes["category"][rows])
        if regions is not None:
            for name, (rows, box) in boxes_by_camera(regions, cameras).items():
                ignored[name] = datatypes.ImageRegions(regions["t_ns"][rows], box)
        ego, vehicle = m.get("ego", {}), datatypes.EgoVehicle()
        length, width, height = (float(v) for v in ego.get("size_m", vehicle.size_m))
        axle_m = float(ego.get("rear_axle_offset_m", vehicle.rear_axle_offset_m))
        # Without an ego the height of the road is one of the map.
        roadside = track is None and all(sensor.mount == "map" for sensor in sensors)
        return datatypes.Log(
            name=m["name"],
            format=READER.name,
            cameras=cameras,
            lidars=lidars,
            streams={e["name"]: self._stream(k, e, offset) for k, e in enumerate(m["sensors"])},
            ego=None if track is None else PoseTrack(track.t_ns, shift_poses(track.map_T_ego, offset)),
            ego_vehicle=datatypes.EgoVehicle((length, width, height), axle_m),
            map=replace(map_frame, offset_m=tuple(offset.tolist())),
            labels=None if labels is None else replace(labels, center_m=labels.center_m - offset),
            image_labels=image_labels,
            ignored_regions=ignored,
            ground_z_ego_m=float(ego.get("ground_z_m", 0.0)) - (float(offset[2]) if roadside else 0.0),
            reference_camera=m.get("reference_camera"),
            digest=self.hash.hexdigest(),
            notes=tuple(self.notes),
            calibrations={e["name"]: f"{self.file}, sensors[{k}]" for k, e in enumerate(m["sensors"])},
        )

    def table(
        self, relative: str, field: str, columns: Mapping[str, str], optional: Mapping[str, str] | None = None,
        damaged: list[str] | None = None,
    ) -> CsvTable:  # fmt: skip
        """Read a table that the manifest names under `field`; rows that are cut go to `damaged`, else they are an error."""
        path = inside(self.root, relative, f"{self.file}, field '{field}'")
        table = read_csv_table(path, columns, optional, damaged=damaged)
        self.hash.update(table.sha256.encode())
        if damaged is None and not len(table):
            raise LogError(f"{table.path}: no records below the header; a stream needs at least one")
        return table

    def _ego(self) -> tuple[datatypes.MapFrame, PoseTrack | None]:
        m = self.manifest.get("map", {})
        map_frame = datatypes.MapFrame(
            m.get("latitude_deg"), m.get("longitude_deg"), m.get("altitude_m"), m.get("projection")
        )
        ego = self.manifest.get("ego")
        if ego is None or not {"poses", "gnss"} & set(ego):
            return map_frame, None
        if "poses" in ego:
            table = self.table(ego["poses"], "ego.poses", POSE_COLUMNS)
            q, position = table.stack("qw", "qx", "qy", "qz"), table.stack("x_m", "y_m", "z_m")
            poses = checked_poses(q, position, lambda row: table.where(row, "qw,qx,qy,qz"))
        else:
            table = self.table(ego["gnss"], "ego.gnss", GNSS_COLUMNS)
            for field, limit in (("latitude_deg", 90.0), ("longitude_deg", 360.0)):
                table.refuse(np.abs(table[field]) > limit, field, f"VALUE, expected at most {limit:g} degrees")
            place, attitude = table.stack(*GNSS_FIELDS[:3]), table.stack(*GNSS_FIELDS[3:])
            map_frame = map_frame_of(map_frame, *place[0].tolist())
            poses = poses_from_geodetic(map_frame, place, attitude, where=f"{self.file}, field 'map.projection'")
        keep = strictly_increasing(table["t_ns"], "ego", self.notes)
        return map_frame, PoseTrack(table["t_ns"][keep], poses[keep])

    def _sensor(self, k: int, entry: Mapping[str, Any]) -> Camera | datatypes.Lidar:
        where = f"{self.file}, sensors[{k}] '{entry['name']}'"
        norm = float(np.linalg.norm(entry["rotation_wxyz"]))
        if abs(norm - 1) > ROTATION_TOLERANCE:
            raise LogError(f"{where}: rotation_wxyz has norm {norm:.6g}, expected a unit quaternion (scalar first)")
        mount_T_sensor = transform(rotation_from_quaternion(entry["rotation_wxyz"]), entry["translation_m"])
        if entry["kind"] == "lidar":
            return datatypes.Lidar(entry["name"], entry["mount"], mount_T_sensor)
        i = entry["intrinsics"]
        model, count = i.get("distortion_model", "none"), len(i.get("distortion", ()))
        if count not in DISTORTION_LENGTHS[model]:
            expected = " or ".join(map(str, DISTORTION_LENGTHS[model]))
            raise LogError(f"{where}: intrinsics.distortion has {count} values, '{model}' takes {expected}")
        lines = i.get("rolling_shutter")
        shutter = None if lines is None else RollingShutter(lines["direction"], float(lines["readout_s"]))
        return replace(camera_of(entry["name"], i, entry["mount"], mount_T_sensor), rolling_shutter=shutter)

    def _check_sensors(self, sensors: list[Camera | datatypes.Lidar]) -> None:
        names = [sensor.name for sensor in sensors]
        for k, sensor in enumerate(sensors):
            where = f"{self.file}, sensors[{k}] '{sensor.name}'"
            if sensor.name in names[:k]:
                raise LogError(f"{where}: the name occurs twice; names must be unique")
            if sensor.mount == "ego" and "ego" not in self.manifest:
                advice = "an empty 'ego' says that its poses are not known"
                raise LogError(f"{where}: is mounted on the ego, but the log has no 'ego' with poses or gnss; {advice}")
        reference, cameras = self.manifest.get("reference_camera"), [s.name for s in sensors if isinstance(s, Camera)]
        if reference is not None and reference not in cameras:
            there = f"no camera '{reference}'; there are: {', '.join(cameras)}"
            raise LogError(f"{self.file}, field 'reference_camera': {there}")

    def _stream(self, k: int, entry: Mapping[str, Any], offset: Array) -> datatypes.Stream:
        frame = entry.get("points_frame", "lidar")
        compensable = COMPENSATED if entry["kind"] == "lidar" and frame == "lidar" else None
        table = self.table(entry["index"], f"sensors[{k}].index", INDEX_COLUMNS, compensable)
        keep = strictly_increasing(table["t_ns"], entry["name"], self.notes)
        files = [inside(self.root, str(table["file"][row]), table.where(row, "file")) for row in keep]
        t_ns = table["t_ns"][keep]
        for file in files:
            self.hash.update(f"{file.name} {file.stat().st_size if file.exists() else -1}\n".encode())
        if entry["kind"] == "camera":
            size_px = entry["intrinsics"]["width_px"], entry["intrinsics"]["height_px"]
            return image_stream(entry["name"], t_ns, files, size_px)
        compensated = table.columns.get("compensated_ns")
        compensated_ns = None if compensated is None else compensated[keep]

        def read(i: int) -> datatypes.Sweep:
            sweep = read_sweep(files[i], int(t_ns[i]), frame)
            if compensated_ns is not None:
                return replace(sweep, compensated_ns=int(compensated_ns[i]))
            if frame == "map" and offset.any():
                return replace(sweep, xyz_m=sweep.xyz_m.astype(np.float64) - offset)
            return sweep

        return datatypes.Stream(entry["name"], t_ns, read)

    def _labels(self) -> datatypes.Labels | None:
        entry = self.manifest.get("labels", {})
        table = self._label_table("boxes_3d", BOX_3D_COLUMNS, BOX_3D_OPTIONAL)
        if table is None:
            return None
        names = sorted(s["name"] for s in self.manifest["sensors"] if s["kind"] == "camera")
        for name in entry.get("cameras", ()):
            if name not in names:
                there = f"no camera '{name}'; there are: {', '.join(names)}"
                raise LogError(f"{self.file}, field 'labels.cameras': {there}")
        labeled = self._label_table("labeled", LABELED_COLUMNS)
        return replace(
            boxes_3d(table),
            cameras=tuple(entry["cameras"]) if "cameras" in entry else None,
            labeled_ns=None if labeled is None else np.unique(labeled["t_ns"]),
            never_labeled=tuple(entry.get("never_labeled", ())),
        )

    def _label_table(
        self, key: str, columns: Mapping[str, str], optional: Mapping[str, str] | None = None
    ) -> CsvTable | None:
        relative = self.manifest.get("labels", {}).get(key)
        if relative is None:
            return None
        damaged: list[str] = []
        table = self.table(relative, f"labels.{key}", columns, optional, damaged)
        note_damaged_rows(damaged, len(table) + len(damaged), self.notes)
        return table
