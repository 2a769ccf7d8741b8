"""Tables of native log folders: poses of the ego, labels, and CSV files as such."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Labels, Lidar, Log
from log2sim.errors import ConfigError
from log2sim.geometry import Array, Camera, quaternion_from_rotation, yaw_of
from log2sim.logs.native.labels import (
    BOX_2D_COLUMNS,
    BOX_3D_COLUMNS,
    BOX_3D_OPTIONAL,
    LABELED_COLUMNS,
    REGION_COLUMNS,
)
from log2sim.logs.native.reader import GNSS_COLUMNS, POSE_COLUMNS


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
    from log2sim.logs.geodesy import geodetic_from_map

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
