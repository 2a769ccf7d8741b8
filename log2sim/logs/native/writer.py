"""Writer of native log folders."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Labels, Lidar, Log, Stream, Sweep
from log2sim.datatypes.log import intrinsics_to_dict
from log2sim.errors import ConfigError, LogError, RecordError
from log2sim.files.documents import check, refuse_folder
from log2sim.files.images import JPEG_MAGIC, image_size
from log2sim.files.outputs import replaced_folder
from log2sim.geometry import Array, Camera, quaternion_from_rotation, yaw_of
from log2sim.logs.native import reader as tables
from log2sim.logs.stamps import geodetic_from_map

POINT_RESOLUTION_M = 1e-3
# float32 resolves 1 mm up to about 8 km.
MAX_FLOAT32_M = 8000.0


def write_log(
    log: Log,
    path: Path | str,
    *,
    overwrite: bool = False,
    jpeg_quality: int = 90,
    ego: Literal["poses", "gnss"] = "poses",
    sweep: Literal["npz", "npy", "bin"] = "npz",
    progress: Callable[[int, int], None] | None = None,
    problems: list[str] | None = None,
) -> None:
    """Write any log as a native log folder, whole or not at all.

    `log`: its records are read one by one, so that a log may render them on demand. `overwrite`: replace a log folder of that
    name; a folder that is no log is never replaced. `jpeg_quality`: 1 to 100, of images that the log does not hold as files;
    those are copied. `ego`: "gnss" writes latitude, longitude and angles; the log's map then needs a projection. `sweep`: points
    are rounded to 1 mm; only "npz" keeps the stamps of the points. `progress`: called as `progress(done, total)`. `problems`:
    takes why records cannot be read, which are then left out; without it the first one is an error.

    Raises `ConfigError` when the folder exists and may not be replaced, or cannot be written; `RecordError` when a record of the
    log cannot be read, `LogError` when none of a stream can be.
    """
    target = Path(path)
    refuse_target(target, overwrite=overwrite)
    offset = np.array(log.map.offset_m)
    sensors: list[Camera | Lidar] = [*log.cameras.values(), *log.lidars.values()]
    manifest: dict[str, Any] = {"log_version": 1, "name": log.name, "map": asdict(log.map)}
    del manifest["map"]["offset_m"]
    manifest["sensors"] = [_sensor(s, offset) for s in sensors]
    if log.reference_camera is not None:
        manifest["reference_camera"] = log.reference_camera
    total, done = sum(len(s.t_ns) for s in log.streams.values()), 0
    with replaced_folder(target, overwrite=overwrite) as root:
        for entry in manifest["sensors"]:
            stream = log.streams[entry["name"]]
            (root / stream.name).mkdir()
            rows, sweeps = list[tuple[Any, ...]](), list[tuple[str, int | None]]()
            sweep_kind = sweep if entry["kind"] == "lidar" else ""
            for i, t_ns in enumerate(stream.t_ns.tolist()):
                try:
                    suffix, data, kind = _encode(stream, i, sweep_kind, jpeg_quality, offset)
                except RecordError as error:
                    if problems is None:
                        raise
                    problems.append(f"stream '{stream.name}': {error}")
                else:
                    file = f"{stream.name}/{i:06d}.{suffix}"
                    (root / file).write_bytes(data)
                    rows.append((t_ns, file))
                    sweeps += [] if kind is None else [kind]
                done += 1
                if progress is not None:
                    progress(done, total)
            if not rows:
                raise LogError(f"stream '{stream.name}': none of its {len(stream.t_ns)} records can be read")
            columns = list(tables.INDEX_COLUMNS)
            frames, compensated = {frame for frame, _ in sweeps}, [int(t) for _, t in sweeps if t is not None]
            if len(frames) > 1 or 0 < len(compensated) < len(rows):
                kinds = (
                    "in the lidar and in the map frame" if len(frames) > 1 else "that are and that are not compensated"
                )
                raise ConfigError(f"stream '{stream.name}' mixes sweeps {kinds}; write one kind")
            if frames == {"map"}:
                entry["points_frame"] = "map"
            if compensated:
                rows = [(*row, t) for row, t in zip(rows, compensated)]
                columns += tables.COMPENSATED
            _write_table(root / entry["index"], columns, rows)
        manifest["ego"] = _write_ego(log, root, sensors, ego)
        labels = _write_labels(log, root, offset)
        if labels:
            manifest["labels"] = labels
        check(manifest, "log-1", ConfigError)
        (root / tables.MANIFEST).write_text(json.dumps(manifest, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def refuse_target(target: Path, *, overwrite: bool) -> None:
    """Raise `ConfigError` where no log folder may be written."""
    refuse_folder(target, overwrite=overwrite, holding=tables.MANIFEST, kind="log folder")


def _sensor(sensor: Camera | Lidar, offset: Array) -> dict[str, Any]:
    mount_T_sensor = sensor.mount_T_cam if isinstance(sensor, Camera) else sensor.mount_T_lidar
    translation = mount_T_sensor[:3, 3] + (offset if sensor.mount == "map" else 0.0)
    entry: dict[str, Any] = {
        "name": sensor.name,
        "kind": "camera" if isinstance(sensor, Camera) else "lidar",
        "mount": sensor.mount,
        "translation_m": translation.tolist(),
        "rotation_wxyz": quaternion_from_rotation(mount_T_sensor[:3, :3]).tolist(),
        "index": f"{sensor.name}/index.csv",
    }
    if isinstance(sensor, Camera):
        entry["intrinsics"] = intrinsics_to_dict(sensor)
        if sensor.rolling_shutter is not None:
            entry["intrinsics"]["rolling_shutter"] = asdict(sensor.rolling_shutter)
    return entry


def _encode(
    stream: Stream, i: int, kind: str, jpeg_quality: int, offset: Array
) -> tuple[str, bytes, tuple[str, int | None] | None]:
    """Return suffix and bytes of the file of a record; of a sweep, in a format `kind`, also its frame and to which stamp it is compensated."""
    if stream.encoded is not None and not kind:  # of an image
        data = stream.encoded(i)
        image_size(data, f"{stream.name}, stamp {stream.t_ns[i]}")  # an image, or a RecordError
        return "jpg" if data[:2] == JPEG_MAGIC else "png", data, None
    record = stream.read(i)
    if not isinstance(record, Sweep):
        import simplejpeg

        data = simplejpeg.encode_jpeg(np.ascontiguousarray(record), quality=jpeg_quality, colorspace="BGR")
        return "jpg", data, None
    xyz = np.asarray(record.xyz_m, dtype=np.float64) + (offset if record.frame == "map" else 0.0)
    near = len(xyz) == 0 or float(np.abs(xyz).max()) < MAX_FLOAT32_M
    xyz = np.round(xyz / POINT_RESOLUTION_M) * POINT_RESOLUTION_M
    xyz = xyz.astype(np.float32) if near else xyz
    out = io.BytesIO()
    if kind == "npz":
        columns: dict[str, NDArray[Any]] = {"xyz_m": xyz}
        if record.t_ns is not None:
            offset_ns = record.t_ns - record.stamp_ns
            small = len(offset_ns) == 0 or np.abs(offset_ns).max() < 2**31
            columns["t_offset_ns"] = offset_ns.astype(np.int32 if small else np.int64)
        strength = record.intensity
        if strength is not None:
            # Bytes where they are whole numbers up to 255, as most LiDARs have them.
            fits = len(strength) and np.isfinite(strength).all() and np.array_equal(strength.round(), strength)
            columns["intensity"] = strength.astype(np.uint8) if fits and strength.max() <= 255 else strength
        np.savez_compressed(out, **columns)  # type: ignore[arg-type]
    elif kind == "npy":
        np.save(out, xyz)
    else:
        of_points = np.zeros(len(xyz), np.float32) if record.intensity is None else np.nan_to_num(record.intensity)
        out.write(np.column_stack([xyz, of_points]).astype("<f4").tobytes())
    return kind, out.getvalue(), (record.frame, record.compensated_ns)


def _write_ego(log: Log, root: Path, sensors: Sequence[Camera | Lidar], kind: str) -> dict[str, Any]:
    """Write the ego's poses, or the same as GNSS fixes, and return its entry of the manifest."""
    if log.ego is None and all(sensor.mount == "map" for sensor in sensors):
        # Without an ego the height of the road is one of the map.
        return {"ground_z_m": float(log.ground_z_ego_m) + log.map.offset_m[2]}
    vehicle = log.ego_vehicle
    entry: dict[str, Any] = {
        "size_m": [float(v) for v in vehicle.size_m],
        "rear_axle_offset_m": float(vehicle.rear_axle_offset_m),
        "ground_z_m": float(log.ground_z_ego_m),
    }
    if log.ego is None:
        return entry
    poses, columns = log.ego.map_T_ego, tables.POSE_COLUMNS
    if kind == "poses":
        values = np.hstack([poses[:, :3, 3] + log.map.offset_m, quaternion_from_rotation(poses[:, :3, :3])])
    elif log.map.projection is None:
        lacks = "its map has no projection, so its ego cannot be written as GNSS"
        raise ConfigError(f"log '{log.name}': {lacks}; write poses")
    else:
        columns = tables.GNSS_COLUMNS
        latitude, longitude, altitude, convergence = geodetic_from_map(log.map, poses[:, :3, 3], f"log '{log.name}'")
        pitch = -np.arcsin(np.clip(poses[:, 2, 0], -1, 1))
        roll = np.arctan2(poses[:, 2, 1], poses[:, 2, 2])
        values = np.stack([latitude, longitude, altitude, roll, pitch, yaw_of(poses) - convergence], axis=1)
    _write_table(root / f"ego/{kind}.csv", columns, _rows(log.ego.t_ns, values))
    return {**entry, kind: f"ego/{kind}.csv"}


def _write_labels(log: Log, root: Path, offset: Array) -> dict[str, Any]:
    """Write the tables of labels, and return their entry of the manifest; `offset` (3,) is that of the map."""
    entry: dict[str, Any] = {}

    def write(name: str, columns: Iterable[str], rows: Iterable[Sequence[Any]]) -> None:
        entry[name] = f"labels/{name}.csv"
        _write_table(root / entry[name], columns, rows)

    b: Labels | None = log.labels
    if b is not None:
        columns, values = list(tables.BOX_3D_COLUMNS), np.hstack([b.center_m + offset, b.size_m, b.yaw_rad[:, None]])
        boxes = _rows(b.t_ns, values, b.track_id, b.category)
        for name, kind in tables.BOX_3D_OPTIONAL.items():
            column = getattr(b, name)
            if column is not None:
                columns.append(name)
                boxes = [(*row, str(v) if kind == "str" else int(v)) for row, v in zip(boxes, column)]
        write("boxes_3d", columns, boxes)
        if b.cameras is not None:
            entry["cameras"] = list(b.cameras)
        if b.never_labeled:
            entry["never_labeled"] = list(b.never_labeled)
        if b.labeled_ns is not None:
            write("labeled", tables.LABELED_COLUMNS, ((t,) for t in b.labeled_ns.tolist()))
    if log.image_labels:
        rows = []
        for name, image in log.image_labels.items():
            of_camera = _rows(image.t_ns, image.box_px, np.full(len(image.t_ns), name))
            rows += [(*row, str(c)) for row, c in zip(of_camera, image.category)]
        write("boxes_2d", tables.BOX_2D_COLUMNS, rows)
    if log.ignored_regions:
        rows = []
        for name, regions in log.ignored_regions.items():
            rows += _rows(regions.t_ns, regions.box_px, np.full(len(regions.t_ns), name))
        write("ignored_2d", tables.REGION_COLUMNS, rows)
    return entry


def _rows(t_ns: NDArray[np.int64], values: Array, *words: NDArray[np.str_]) -> list[tuple[Any, ...]]:
    return [(t, *(str(w) for w in text), *v) for t, v, *text in zip(t_ns.tolist(), values.tolist(), *words)]


def _write_table(path: Path, columns: Iterable[str], rows: Iterable[Sequence[Any]]) -> None:
    path.parent.mkdir(exist_ok=True)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    path.write_text(text.getvalue(), encoding="utf-8")
