"""Writer of native log folders."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Labels, Lidar, Log, Stream, Sweep
from log2sim.errors import ConfigError, LogError, RecordError
from log2sim.files.documents import check, refuse_folder
from log2sim.files.outputs import replaced_folder
from log2sim.geometry import Array, Camera, quaternion_from_rotation, yaw_of
from log2sim.logs.native.reader import (
    BOX_2D_COLUMNS,
    BOX_3D_COLUMNS,
    BOX_3D_OPTIONAL,
    COMPENSATED,
    GNSS_COLUMNS,
    INDEX_COLUMNS,
    LABELED_COLUMNS,
    MANIFEST,
    POSE_COLUMNS,
    REGION_COLUMNS,
)
from log2sim.logs.records import JPEG_MAGIC, image_size


def write_ego(log: Log, root: Path, manifest: dict[str, Any], kind: str) -> None:
    """Write the ego's poses, or the same as GNSS fixes, and describe the ego in the manifest."""
    sensors: list[Camera | Lidar] = [*log.cameras.values(), *log.lidars.values()]
    if log.ego is None and all(sensor.mount == "map" for sensor in sensors):
        # Without an ego the height of the road is one of the map.
        manifest["ego"] = {"ground_z_m": float(log.ground_z_ego_m) + log.map.offset_m[2]}
        return
    vehicle = log.ego_vehicle
    manifest["ego"] = {
        "size_m": [float(v) for v in vehicle.size_m],
        "rear_axle_offset_m": float(vehicle.rear_axle_offset_m),
        "ground_z_m": float(log.ground_z_ego_m),
    }
    if log.ego is None:
        return
    manifest["ego"][kind] = f"ego/{kind}.csv"
    poses = log.ego.map_T_ego
    if kind == "poses":
        values = np.hstack([poses[:, :3, 3] + log.map.offset_m, quaternion_from_rotation(poses[:, :3, :3])])
        write_table(root / "ego/poses.csv", POSE_COLUMNS, _rows(log.ego.t_ns, values))
        return
    if log.map.projection is None:
        raise ConfigError(
            f"log '{log.name}': its map has no projection, so its ego cannot be written as GNSS; write poses"
        )
    from log2sim.logs.stamps import geodetic_from_map

    latitude, longitude, altitude, convergence = geodetic_from_map(log.map, poses[:, :3, 3], f"log '{log.name}'")
    pitch = -np.arcsin(np.clip(poses[:, 2, 0], -1, 1))
    roll = np.arctan2(poses[:, 2, 1], poses[:, 2, 2])
    values = np.stack([latitude, longitude, altitude, roll, pitch, yaw_of(poses) - convergence], axis=1)
    write_table(root / "ego/gnss.csv", GNSS_COLUMNS, _rows(log.ego.t_ns, values))


def write_labels(log: Log, root: Path, manifest: dict[str, Any], offset: Array) -> None:
    """Write the tables of labels and name them in the manifest; `offset` (3,) is that of the map."""
    entry: dict[str, Any] = {}
    if log.labels is not None:
        _write_boxes_3d(log.labels, root, entry, offset)
    if log.image_labels:
        entry["boxes_2d"] = "labels/boxes_2d.csv"
        rows = []
        for name, boxes in log.image_labels.items():
            camera = np.full(len(boxes.t_ns), name)
            rows += [(*row, str(c)) for row, c in zip(_rows(boxes.t_ns, boxes.box_px, camera), boxes.category)]
        write_table(root / entry["boxes_2d"], BOX_2D_COLUMNS, rows)
    if log.ignored_regions:
        entry["ignored_2d"] = "labels/ignored_2d.csv"
        rows = []
        for name, regions in log.ignored_regions.items():
            rows += _rows(regions.t_ns, regions.box_px, np.full(len(regions.t_ns), name))
        write_table(root / entry["ignored_2d"], REGION_COLUMNS, rows)
    if entry:
        manifest["labels"] = entry


def _write_boxes_3d(b: Labels, root: Path, entry: dict[str, Any], offset: Array) -> None:
    entry["boxes_3d"] = "labels/boxes_3d.csv"
    values = np.hstack([b.center_m + offset, b.size_m, b.yaw_rad[:, None]])
    columns, rows = dict(BOX_3D_COLUMNS), _rows(b.t_ns, values, b.track_id, b.category)
    for name, kind in BOX_3D_OPTIONAL.items():
        column = getattr(b, name)
        if column is not None:
            columns[name] = kind
            rows = [(*row, str(v) if kind == "str" else int(v)) for row, v in zip(rows, column)]
    write_table(root / entry["boxes_3d"], columns, rows)
    if b.cameras is not None:
        entry["cameras"] = list(b.cameras)
    if b.never_labeled:
        entry["never_labeled"] = list(b.never_labeled)
    if b.labeled_ns is not None:
        entry["labeled"] = "labels/labeled.csv"
        write_table(root / entry["labeled"], LABELED_COLUMNS, ((t,) for t in b.labeled_ns.tolist()))


def _rows(t_ns: NDArray[np.int64], values: Array, *words: NDArray[np.str_]) -> list[tuple[Any, ...]]:
    return [(t, *(str(w) for w in text), *v) for t, v, *text in zip(t_ns.tolist(), values.tolist(), *words)]


def write_table(path: Path, columns: Iterable[str], rows: Iterable[Sequence[Any]]) -> None:
    """Write a CSV table."""
    path.parent.mkdir(exist_ok=True)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    path.write_text(text.getvalue(), encoding="utf-8")


POINT_RESOLUTION_M = 1e-3
# float32 resolves 1 mm up to about 8 km.
MAX_FLOAT32_M = 8000.0

Progress = Callable[[int, int], None]


def write_log(
    log: Log,
    path: Path | str,
    *,
    overwrite: bool = False,
    jpeg_quality: int = 90,
    ego: Literal["poses", "gnss"] = "poses",
    sweep: Literal["npz", "npy", "bin"] = "npz",
    progress: Progress | None = None,
    problems: list[str] | None = None,
) -> None:
    """Write any log as a native log folder, whole or not at all.

    Parameters
    ----------
    log : Log
        Its records are read one by one, so that a log may render them on demand.
    overwrite : bool
        Replace a log folder of that name; a folder that is no log is never replaced.
    jpeg_quality : int
        1 to 100, of images that the log does not hold as files; those are copied.
    ego : "poses" or "gnss"
        "gnss" writes latitude, longitude and angles; the log's map then needs a projection.
    sweep : "npz", "npy" or "bin"
        Points are rounded to 1 mm. Only "npz" keeps the stamps of the points.
    progress : callable, optional
        Called as `progress(done, total)` after each record.
    problems : list of str, optional
        Takes why records cannot be read, which are then left out. Without it the first one is an error.

    Raises
    ------
    ConfigError
        When the folder exists and may not be replaced, or cannot be written.
    RecordError
        When a record of the log cannot be read.
    LogError
        When none of a stream can be read.
    """
    target = Path(path)
    refuse_target(target, overwrite=overwrite)
    with replaced_folder(target, overwrite=overwrite) as temporary:
        _Writer(log, temporary, jpeg_quality, ego, sweep, progress, problems).write()


def refuse_target(target: Path, *, overwrite: bool) -> None:
    """Raise `ConfigError` where no log folder may be written."""
    refuse_folder(target, overwrite=overwrite, holding=MANIFEST, kind="log folder")


@dataclass(eq=False)
class _Rows:
    """What the index of one stream gets: rows of stamp, file and, where sweeps are compensated, its stamp."""

    rows: list[tuple[int, str]] = field(default_factory=list)
    compensated_ns: list[int] = field(default_factory=list)
    frames: set[str] = field(default_factory=set)

    def write(self, name: str, path: Path) -> None:
        """Write the index; `ConfigError` where the sweeps differ in kind."""
        if len(self.frames) > 1:
            raise ConfigError(f"stream '{name}' mixes sweeps in the lidar and in the map frame; write one kind")
        if not self.compensated_ns:
            write_table(path, INDEX_COLUMNS, self.rows)
            return
        if len(self.compensated_ns) < len(self.rows):
            raise ConfigError(f"stream '{name}' mixes sweeps that are and that are not compensated; write one kind")
        rows = [(*row, t) for row, t in zip(self.rows, self.compensated_ns)]
        write_table(path, [*INDEX_COLUMNS, *COMPENSATED], rows)


@dataclass(frozen=True, eq=False)
class _Writer:
    """Writes one log into an empty folder."""

    log: Log
    root: Path
    jpeg_quality: int
    ego: str
    sweep: str
    progress: Progress | None
    problems: list[str] | None

    def write(self) -> None:
        """Write the records of all streams, then the tables and the manifest."""
        offset = np.array(self.log.map.offset_m)
        manifest = _manifest(self.log, offset)
        total = sum(len(s.t_ns) for s in self.log.streams.values())
        done = 0
        for entry in manifest["sensors"]:
            stream, folder = self.log.streams[entry["name"]], self.root / entry["name"]
            folder.mkdir()
            index = _Rows()
            for i in range(len(stream.t_ns)):
                self._write_record(stream, i, folder, index, offset)
                done += 1
                if self.progress is not None:
                    self.progress(done, total)
            if not index.rows:
                raise LogError(f"stream '{stream.name}': none of its {len(stream.t_ns)} records can be read")
            if "map" in index.frames:
                entry["points_frame"] = "map"
            index.write(stream.name, self.root / entry["index"])
        write_ego(self.log, self.root, manifest, self.ego)
        write_labels(self.log, self.root, manifest, offset)
        check(manifest, "log-1", ConfigError)
        (self.root / MANIFEST).write_text(json.dumps(manifest, indent=1, allow_nan=False) + "\n", encoding="utf-8")

    def _write_record(self, stream: Stream, i: int, folder: Path, index: _Rows, offset: Array) -> None:
        t_ns = int(stream.t_ns[i])
        try:
            if stream.encoded is not None:
                file = _copy_image(stream.encoded(i), folder, i, t_ns)
            else:
                record = stream.read(i)
                if isinstance(record, Sweep):
                    file = _write_sweep(record, folder, i, self.sweep, offset)
                    index.frames.add(record.frame)
                    if record.compensated_ns is not None:
                        index.compensated_ns.append(int(record.compensated_ns))
                else:
                    import simplejpeg

                    name = f"{i:06d}.jpg"
                    data = simplejpeg.encode_jpeg(
                        np.ascontiguousarray(record), quality=self.jpeg_quality, colorspace="BGR"
                    )
                    (folder / name).write_bytes(data)
                    file = f"{folder.name}/{name}"
        except RecordError as error:
            if self.problems is None:
                raise
            self.problems.append(f"stream '{stream.name}': {error}")
            return
        index.rows.append((t_ns, file))


def _manifest(log: Log, offset: Array) -> dict[str, Any]:
    m = log.map
    sensors: list[Camera | Lidar] = [*log.cameras.values(), *log.lidars.values()]
    manifest: dict[str, Any] = {
        "log_version": 1,
        "name": log.name,
        "map": {
            "latitude_deg": m.latitude_deg,
            "longitude_deg": m.longitude_deg,
            "altitude_m": m.altitude_m,
            "projection": m.projection,
        },
        "sensors": [_sensor(s, offset) for s in sensors],
    }
    if log.reference_camera is not None:
        manifest["reference_camera"] = log.reference_camera
    return manifest


def _sensor(sensor: Camera | Lidar, offset: Array) -> dict[str, Any]:
    camera = isinstance(sensor, Camera)
    mount_T_sensor = sensor.mount_T_cam if isinstance(sensor, Camera) else sensor.mount_T_lidar
    translation = mount_T_sensor[:3, 3] + (offset if sensor.mount == "map" else 0.0)
    entry: dict[str, Any] = {
        "name": sensor.name,
        "kind": "camera" if camera else "lidar",
        "mount": sensor.mount,
        "translation_m": translation.tolist(),
        "rotation_wxyz": quaternion_from_rotation(mount_T_sensor[:3, :3]).tolist(),
        "index": f"{sensor.name}/index.csv",
    }
    if isinstance(sensor, Camera):
        K = sensor.K
        entry["intrinsics"] = {
            "width_px": int(sensor.width_px),
            "height_px": int(sensor.height_px),
            "fx_px": float(K[0, 0]),
            "fy_px": float(K[1, 1]),
            "cx_px": float(K[0, 2]),
            "cy_px": float(K[1, 2]),
            "distortion_model": sensor.distortion_model,
            "distortion": [float(d) for d in sensor.distortion],
        }
        if sensor.rolling_shutter is not None:
            entry["intrinsics"]["rolling_shutter"] = asdict(sensor.rolling_shutter)
    return entry


def _copy_image(data: bytes, folder: Path, i: int, t_ns: int) -> str:
    image_size(data, f"{folder.name}, stamp {t_ns}")  # an image, or a RecordError
    name = f"{i:06d}.{'jpg' if data[:2] == JPEG_MAGIC else 'png'}"
    (folder / name).write_bytes(data)
    return f"{folder.name}/{name}"


def _write_sweep(sweep: Sweep, folder: Path, i: int, kind: str, offset: Array) -> str:
    name = f"{i:06d}.{kind}"
    xyz = np.asarray(sweep.xyz_m, dtype=np.float64) + (offset if sweep.frame == "map" else 0.0)
    near = len(xyz) == 0 or float(np.abs(xyz).max()) < MAX_FLOAT32_M
    xyz = np.round(xyz / POINT_RESOLUTION_M) * POINT_RESOLUTION_M
    if near:
        xyz = xyz.astype(np.float32)
    if kind == "npz":
        columns: dict[str, NDArray[Any]] = {"xyz_m": xyz}
        if sweep.t_ns is not None:
            offset_ns = sweep.t_ns - sweep.stamp_ns
            small = len(offset_ns) == 0 or np.abs(offset_ns).max() < 2**31
            columns["t_offset_ns"] = offset_ns.astype(np.int32 if small else np.int64)
        if sweep.intensity is not None:
            columns["intensity"] = _packed(sweep.intensity)
        np.savez_compressed(folder / name, **columns)  # type: ignore[arg-type]
    elif kind == "npy":
        np.save(folder / name, xyz)
    else:
        strength = np.zeros(len(xyz), np.float32) if sweep.intensity is None else np.nan_to_num(sweep.intensity)
        (folder / name).write_bytes(np.column_stack([xyz, strength]).astype("<f4").tobytes())
    return f"{folder.name}/{name}"


def _packed(intensity: NDArray[np.float32]) -> NDArray[Any]:
    """Return intensities as bytes where they are whole numbers up to 255, as most LiDARs have them."""
    if len(intensity) and np.isfinite(intensity).all():
        whole = intensity.round()
        if np.array_equal(whole, intensity) and whole.max() <= 255:
            return whole.astype(np.uint8)
    return intensity
