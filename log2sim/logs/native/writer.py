"""Writer of native log folders."""

from __future__ import annotations

import csv
import io
import json
import secrets
import shutil
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Lidar, Log, Stream, Sweep
from log2sim.documents import check
from log2sim.errors import ConfigError
from log2sim.geometry import Array, Camera, quaternion_from_rotation, yaw_of
from log2sim.logs.native.labels import BOX_2D_COLUMNS, BOX_3D_COLUMNS, REGION_COLUMNS
from log2sim.logs.native.reader import GNSS_COLUMNS, INDEX_COLUMNS, MANIFEST, POSE_COLUMNS

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
) -> None:
    """Write any log as a native log folder, whole or not at all.

    Parameters
    ----------
    log : Log
        Its records are read one by one, so that a log may render them on demand.
    path : Path or str
    overwrite : bool
        Replace a log folder of that name; a folder that is no log is never replaced.
    jpeg_quality : int
        1 to 100.
    ego : "poses" or "gnss"
        "gnss" writes latitude, longitude and angles; the log's map then needs a projection.
    sweep : "npz", "npy" or "bin"
        Points are rounded to 1 mm. Only "npz" keeps the stamps of the points.
    progress : callable, optional
        Called as `progress(done, total)` after each record.

    Raises
    ------
    ConfigError
        When the folder exists and may not be replaced, or cannot be written.
    RecordError
        When a record of the log cannot be read.
    """
    target = Path(path)
    _refuse(target, overwrite)
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(4)}")
    try:
        temporary.mkdir(parents=True)
        _write(log, temporary, _Encoding(jpeg_quality, ego, sweep), progress)
        if target.exists():
            shutil.rmtree(target)
        temporary.rename(target)
    except OSError as error:
        raise ConfigError(f"{target}: cannot be written: {error.strerror or error}") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _refuse(target: Path, overwrite: bool) -> None:
    if not target.exists():
        return
    empty = target.is_dir() and not any(target.iterdir())
    if not (empty or overwrite):
        raise ConfigError(f"{target}: exists already; choose another name or pass --overwrite")
    if not (empty or (target / MANIFEST).is_file()):
        raise ConfigError(f"{target}: exists and is no log folder, so it is not replaced; choose another name")


@dataclass(frozen=True)
class _Encoding:
    """How images, ego poses and sweeps are stored: JPEG quality, "poses" or "gnss", suffix of the sweep files."""

    jpeg_quality: int
    ego: str
    sweep: str


def _write(log: Log, root: Path, encoding: _Encoding, progress: Progress | None) -> None:
    total = sum(len(s.t_ns) for s in log.streams.values())
    done = 0
    offset = np.array(log.map.offset_m)
    manifest = _manifest(log, offset)
    for entry in manifest["sensors"]:
        stream, folder = log.streams[entry["name"]], root / entry["name"]
        folder.mkdir()
        files, frames = [], set()
        for i in range(len(stream.t_ns)):
            record = stream.read(i)
            if isinstance(record, Sweep):
                files.append(_write_sweep(record, folder, i, encoding.sweep, offset))
                frames.add(record.frame)
            else:
                files.append(_write_image(record, folder, i, encoding.jpeg_quality))
            done += 1
            if progress is not None:
                progress(done, total)
        if len(frames) > 1:
            raise ConfigError(f"stream '{stream.name}' mixes sweeps in the lidar and in the map frame; write one kind")
        if "map" in frames:
            entry["points_frame"] = "map"
        _write_index(stream, files, root / entry["index"])
    _write_ego(log, root, manifest, encoding.ego)
    _write_labels(log, root, manifest, offset)
    check(manifest, "log-1", ConfigError)
    (root / MANIFEST).write_text(json.dumps(manifest, indent=1, allow_nan=False) + "\n", encoding="utf-8")


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
    return entry


def _write_image(image: NDArray[np.uint8], folder: Path, i: int, jpeg_quality: int) -> str:
    import simplejpeg

    name = f"{i:06d}.jpg"
    data = simplejpeg.encode_jpeg(np.ascontiguousarray(image), quality=jpeg_quality, colorspace="BGR")
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
        np.savez_compressed(folder / name, **columns)  # type: ignore[arg-type]
    elif kind == "npy":
        np.save(folder / name, xyz)
    else:
        (folder / name).write_bytes(np.pad(xyz.astype("<f4"), ((0, 0), (0, 1))).tobytes())
    return f"{folder.name}/{name}"


def _write_index(stream: Stream, files: list[str], path: Path) -> None:
    _write_table(path, INDEX_COLUMNS, zip(stream.t_ns.tolist(), files))


def _write_ego(log: Log, root: Path, manifest: dict[str, Any], kind: str) -> None:
    if log.ego is None:
        return
    (root / "ego").mkdir(exist_ok=True)
    vehicle = log.ego_vehicle
    manifest["ego"] = {
        kind: f"ego/{kind}.csv",
        "size_m": [float(v) for v in vehicle.size_m],
        "rear_axle_offset_m": float(vehicle.rear_axle_offset_m),
        "ground_z_m": float(log.ground_z_ego_m),
    }
    poses = log.ego.map_T_ego
    if kind == "poses":
        values = np.hstack([poses[:, :3, 3] + log.map.offset_m, quaternion_from_rotation(poses[:, :3, :3])])
        _write_table(root / "ego/poses.csv", POSE_COLUMNS, _rows(log.ego.t_ns, values))
        return
    if log.map.projection is None:
        raise ConfigError(
            f"log '{log.name}': its map has no projection, so its ego cannot be written as GNSS; write poses"
        )
    from log2sim.logs.geodesy import geodetic_from_map

    latitude, longitude, altitude, convergence = geodetic_from_map(log.map, poses[:, :3, 3], f"log '{log.name}'")
    pitch = -np.arcsin(np.clip(poses[:, 2, 0], -1, 1))
    roll = np.arctan2(poses[:, 2, 1], poses[:, 2, 2])
    values = np.stack([latitude, longitude, altitude, roll, pitch, yaw_of(poses) - convergence], axis=1)
    _write_table(root / "ego/gnss.csv", GNSS_COLUMNS, _rows(log.ego.t_ns, values))


def _write_labels(log: Log, root: Path, manifest: dict[str, Any], offset: Array) -> None:
    entry: dict[str, Any] = {}
    if log.labels is not None:
        b = log.labels
        entry["boxes_3d"] = "labels/boxes_3d.csv"
        values = np.hstack([b.center_m + offset, b.size_m, b.yaw_rad[:, None]])
        columns, rows = dict(BOX_3D_COLUMNS), _rows(b.t_ns, values, b.track_id, b.category)
        if b.visible is not None:
            columns["visible"] = "bool"
            rows = [(*row, int(v)) for row, v in zip(rows, b.visible)]
        _write_table(root / entry["boxes_3d"], columns, rows)
        if b.cameras is not None:
            entry["cameras"] = list(b.cameras)
    if log.image_labels:
        entry["boxes_2d"] = "labels/boxes_2d.csv"
        rows = []
        for name, boxes in log.image_labels.items():
            camera = np.full(len(boxes.t_ns), name)
            rows += [(*row, str(c)) for row, c in zip(_rows(boxes.t_ns, boxes.box_px, camera), boxes.category)]
        _write_table(root / entry["boxes_2d"], BOX_2D_COLUMNS, rows)
    if log.ignored_regions:
        entry["ignored_2d"] = "labels/ignored_2d.csv"
        rows = []
        for name, regions in log.ignored_regions.items():
            rows += _rows(regions.t_ns, regions.box_px, np.full(len(regions.t_ns), name))
        _write_table(root / entry["ignored_2d"], REGION_COLUMNS, rows)
    if entry:
        manifest["labels"] = entry


def _rows(t_ns: NDArray[np.int64], values: Array, *words: NDArray[np.str_]) -> list[tuple[Any, ...]]:
    return [(t, *(str(w) for w in text), *v) for t, v, *text in zip(t_ns.tolist(), values.tolist(), *words)]


def _write_table(path: Path, columns: Iterable[str], rows: Iterable[Sequence[Any]]) -> None:
    path.parent.mkdir(exist_ok=True)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    path.write_text(text.getvalue(), encoding="utf-8")
