"""Reader of native log folders: `log.json` (schemas/log-1.json), CSV tables, images and sweeps."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from log2sim.datatypes import EgoVehicle, Labels, Lidar, Log, MapFrame, Stream
from log2sim.documents import JSON_LIMIT_BYTES, check, read_json
from log2sim.errors import LogError
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
from log2sim.input_files import open_regular, read_file
from log2sim.links import inside, require_link_inside
from log2sim.logs.images import image_stream
from log2sim.logs.native.csv_tables import CsvTable, read_csv_table
from log2sim.logs.native.labels import (
    BOX_2D_COLUMNS,
    BOX_3D_COLUMNS,
    BOX_3D_OPTIONAL,
    LABELED_COLUMNS,
    REGION_COLUMNS,
    boxes_2d,
    boxes_3d,
    regions_2d,
)
from log2sim.logs.native.offset import offset_of, shifted_camera, shifted_labels, shifted_lidar
from log2sim.logs.native.sweep_files import SweepFiles
from log2sim.logs.notes import note_damaged_rows
from log2sim.logs.pose_checks import QUATERNION_TOLERANCE, find_not_unit
from log2sim.logs.stamps import strictly_increasing

MANIFEST = "log.json"

INDEX_COLUMNS = {"t_ns": "int", "file": "str"}
COMPENSATED = {"compensated_ns": "int"}
POSE_COLUMNS = {"t_ns": "int", **dict.fromkeys(("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz"), "float")}
GNSS_FIELDS = ("latitude_deg", "longitude_deg", "altitude_m", "roll_rad", "pitch_rad", "yaw_rad")
GNSS_COLUMNS = {"t_ns": "int", **dict.fromkeys(GNSS_FIELDS, "float")}


class NativeReader:
    """Reader of log2sim's own log folders."""

    name = "log2sim"
    looks_for = f"a folder with {MANIFEST}"
    suffixes = ()

    def matches(self, path: Path) -> bool:
        """Return whether the folder holds a sequence of this layout."""
        return bool(self.sequences(path))

    def sequences(self, path: Path) -> list[str]:
        """Return the names of the sequences, sorted."""
        if _is_manifest(path / MANIFEST):
            return [path.resolve().name]
        return sorted(p.parent.name for p in path.glob(f"*/{MANIFEST}") if _is_manifest(p))

    def open(self, path: Path, sequence: str) -> Log:
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

    def log(self) -> Log:
        m = self.manifest
        map_frame, track = self._ego()
        sensors = [self._sensor(k, entry) for k, entry in enumerate(m["sensors"])]
        self._check_sensors(sensors)
        labels = self._labels()
        boxes, regions = self._label_table("boxes_2d", BOX_2D_COLUMNS), self._label_table("ignored_2d", REGION_COLUMNS)
        offset = offset_of(track, sensors, labels)
        cameras = {s.name: shifted_camera(s, offset) for s in sensors if isinstance(s, Camera)}
        lidars = {s.name: shifted_lidar(s, offset) for s in sensors if isinstance(s, Lidar)}
        ego = m.get("ego", {})
        # Without an ego the height of the road is one of the map.
        roadside = track is None and all(sensor.mount == "map" for sensor in sensors)
        default = EgoVehicle()
        length, width, height = (float(v) for v in ego.get("size_m", default.size_m))
        return Log(
            name=m["name"],
            format=READER.name,
            cameras=cameras,
            lidars=lidars,
            streams={e["name"]: self._stream(k, e, offset) for k, e in enumerate(m["sensors"])},
            ego=None if track is None else PoseTrack(track.t_ns, shift_poses(track.map_T_ego, offset)),
            ego_vehicle=EgoVehicle(
                (length, width, height), float(ego.get("rear_axle_offset_m", default.rear_axle_offset_m))
            ),
            map=replace(map_frame, offset_m=tuple(offset.tolist())),
            labels=None if labels is None else shifted_labels(labels, offset),
            image_labels={} if boxes is None else boxes_2d(boxes, set(cameras)),
            ignored_regions={} if regions is None else regions_2d(regions, set(cameras)),
            ground_z_ego_m=float(ego.get("ground_z_m", 0.0)) - (float(offset[2]) if roadside else 0.0),
            reference_camera=m.get("reference_camera"),
            digest=self.hash.hexdigest(),
            notes=tuple(self.notes),
            calibrations={e["name"]: f"{self.file}, sensors[{k}]" for k, e in enumerate(m["sensors"])},
        )

    def table(
        self,
        relative: str,
        field: str,
        columns: Mapping[str, str],
        optional: Mapping[str, str] | None = None,
        damaged: list[str] | None = None,
    ) -> CsvTable:
        """Read a table that the manifest names under `field`; rows that are cut go to `damaged`, else they are an error."""
        path = inside(self.root, relative, f"{self.file}, field '{field}'")
        table = read_csv_table(path, columns, optional, damaged=damaged)
        self.hash.update(table.sha256.encode())
        return table

    def _ego(self) -> tuple[MapFrame, PoseTrack | None]:
        m = self.manifest.get("map", {})
        map_frame = MapFrame(m.get("latitude_deg"), m.get("longitude_deg"), m.get("altitude_m"), m.get("projection"))
        ego = self.manifest.get("ego")
        if ego is None or not {"poses", "gnss"} & set(ego):
            return map_frame, None
        if "poses" in ego:
            table = self.table(ego["poses"], "ego.poses", POSE_COLUMNS)
            self._not_empty(table)
            rotation = self._rotations(table)
            poses = transform(rotation, table.stack("x_m", "y_m", "z_m"))
        else:
            table = self.table(ego["gnss"], "ego.gnss", GNSS_COLUMNS)
            self._not_empty(table)
            from log2sim.logs.geodesy import map_frame_of, poses_from_geodetic

            _check_geodetic(table)
            map_frame = map_frame_of(map_frame, *(float(table[f][0]) for f in GNSS_FIELDS[:3]))
            poses = poses_from_geodetic(
                map_frame,
                table.stack(*GNSS_FIELDS[:3]),
                table.stack(*GNSS_FIELDS[3:]),
                where=f"{self.file}, field 'map.projection'",
            )
        keep, notes = strictly_increasing(table["t_ns"], "ego")
        self.notes += notes
        return map_frame, PoseTrack(table["t_ns"][keep], poses[keep])

    def _rotations(self, table: CsvTable) -> Array:
        q = table.stack("qw", "qx", "qy", "qz")
        bad = find_not_unit(q)
        if len(bad):
            norm = float(np.linalg.norm(q[bad[0]]))
            raise LogError(f"{table.where(bad[0], 'qw,qx,qy,qz')}: norm {norm:.6g}, expected a unit quaternion")
        return rotation_from_quaternion(q)

    def _not_empty(self, table: CsvTable) -> None:
        if not len(table):
            raise LogError(f"{table.path}: no records below the header; a stream needs at least one")

    def _sensor(self, k: int, entry: Mapping[str, Any]) -> Camera | Lidar:
        where = f"{self.file}, sensors[{k}] '{entry['name']}'"
        norm = float(np.linalg.norm(entry["rotation_wxyz"]))
        if abs(norm - 1) > QUATERNION_TOLERANCE:
            raise LogError(f"{where}: rotation_wxyz has norm {norm:.6g}, expected a unit quaternion (scalar first)")
        mount_T_sensor = transform(rotation_from_quaternion(entry["rotation_wxyz"]), entry["translation_m"])
        if entry["kind"] == "lidar":
            return Lidar(entry["name"], entry["mount"], mount_T_sensor)
        i = entry["intrinsics"]
        model, distortion = i.get("distortion_model", "none"), tuple(float(v) for v in i.get("distortion", ()))
        if len(distortion) not in DISTORTION_LENGTHS[model]:
            expected = " or ".join(map(str, DISTORTION_LENGTHS[model]))
            raise LogError(f"{where}: intrinsics.distortion has {len(distortion)} values, '{model}' takes {expected}")
        K = np.array([[i["fx_px"], 0.0, i["cx_px"]], [0.0, i["fy_px"], i["cy_px"]], [0.0, 0.0, 1.0]])
        lines = i.get("rolling_shutter")
        shutter = None if lines is None else RollingShutter(lines["direction"], float(lines["readout_s"]))
        return Camera(
            entry["name"], i["width_px"], i["height_px"], K, entry["mount"], mount_T_sensor, model, distortion, shutter
        )

    def _check_sensors(self, sensors: list[Camera | Lidar]) -> None:
        names: set[str] = set()
        for k, sensor in enumerate(sensors):
            where = f"{self.file}, sensors[{k}] '{sensor.name}'"
            if sensor.name in names:
                raise LogError(f"{where}: the name occurs twice; names must be unique")
            if sensor.mount == "ego" and "ego" not in self.manifest:
                raise LogError(
                    f"{where}: is mounted on the ego, but the log has no 'ego' with poses or gnss; an empty 'ego' says "
                    "that its poses are not known"
                )
            names.add(sensor.name)
        reference = self.manifest.get("reference_camera")
        cameras = [s.name for s in sensors if isinstance(s, Camera)]
        if reference is not None and reference not in cameras:
            raise LogError(
                f"{self.file}, field 'reference_camera': no camera '{reference}'; there are: {', '.join(cameras)}"
            )

    def _stream(self, k: int, entry: Mapping[str, Any], offset: Array) -> Stream:
        frame = entry.get("points_frame", "lidar")
        compensable = COMPENSATED if entry["kind"] == "lidar" and frame == "lidar" else None
        table = self.table(entry["index"], f"sensors[{k}].index", INDEX_COLUMNS, compensable)
        self._not_empty(table)
        keep, notes = strictly_increasing(table["t_ns"], entry["name"])
        self.notes += notes
        files = [inside(self.root, str(table["file"][row]), table.where(row, "file")) for row in keep]
        t_ns = table["t_ns"][keep]
        for file in files:
            self.hash.update(f"{file.name} {file.stat().st_size if file.exists() else -1}\n".encode())
        if entry["kind"] == "camera":
            size_px = entry["intrinsics"]["width_px"], entry["intrinsics"]["height_px"]
            return image_stream(entry["name"], t_ns, files, size_px)
        compensated = table.columns.get("compensated_ns")
        sweeps = SweepFiles(files, t_ns, frame, offset, None if compensated is None else compensated[keep])
        return Stream(entry["name"], t_ns, sweeps.read)

    def _labels(self) -> Labels | None:
        entry = self.manifest.get("labels", {})
        table = self._label_table("boxes_3d", BOX_3D_COLUMNS, BOX_3D_OPTIONAL)
        if table is None:
            return None
        names = [s["name"] for s in self.manifest["sensors"] if s["kind"] == "camera"]
        for name in entry.get("cameras", ()):
            if name not in names:
                raise LogError(
                    f"{self.file}, field 'labels.cameras': no camera '{name}'; there are: {', '.join(sorted(names))}"
                )
        labels = boxes_3d(table)
        labeled = self._label_table("labeled", LABELED_COLUMNS)
        return replace(
            labels,
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


def _check_geodetic(table: CsvTable) -> None:
    for field, limit in (("latitude_deg", 90.0), ("longitude_deg", 360.0)):
        bad = np.flatnonzero(np.abs(table[field]) > limit)
        if len(bad):
            raise LogError(
                f"{table.where(bad[0], field)}: {table[field][bad[0]]:g}, expected at most {limit:g} degrees"
            )
