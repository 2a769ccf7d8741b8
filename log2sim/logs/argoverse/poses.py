"""Transforms in the tables of Argoverse 2: quaternion and translation in seven columns."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.errors import LogError
from log2sim.geometry import Array, PoseTrack, rotation_from_quaternion, shift_poses, transform
from log2sim.logs.arrow.tables import read_columns
from log2sim.logs.arrow.values import Kind
from log2sim.logs.pose_checks import MAX_POSITION_M, find_not_unit
from log2sim.logs.stamps import strictly_increasing

QUATERNION = ("qw", "qx", "qy", "qz")
TRANSLATION = ("tx_m", "ty_m", "tz_m")
TRANSFORM: Mapping[str, Kind] = dict.fromkeys((*QUATERNION, *TRANSLATION), "float")
OFFSET_STEP_M = 1000.0


def read_ego_track(path: Path, notes: list[str]) -> tuple[PoseTrack, tuple[float, float, float]]:
    """Read `city_SE3_egovehicle.feather`.

    Returns
    -------
    track : PoseTrack
        Every row of the file, in a map whose origin is whole kilometers away from that of the city.
    offset_m : (3,) tuple of float, m
        From the city's frame to the map: city = map + `offset_m`.
    """
    columns = read_columns(path, {"timestamp_ns": "int", **TRANSFORM})
    city_T_ego = transforms_of(columns, path)
    if not len(city_T_ego):
        raise LogError(f"{path}: no poses; expected at least one")
    keep, problems = strictly_increasing(columns["timestamp_ns"], path.name)
    notes += problems
    east, north = (float(v) for v in np.floor(city_T_ego[keep[0], :2, 3] / OFFSET_STEP_M) * OFFSET_STEP_M)
    map_T_ego = shift_poses(city_T_ego[keep], np.array([east, north, 0.0]))
    return PoseTrack(columns["timestamp_ns"][keep], map_T_ego), (east, north, 0.0)


def read_mounts(path: Path) -> dict[str, Array]:
    """Read `egovehicle_SE3_sensor.feather`: `ego_T_sensor` (4, 4) by sensor."""
    columns = read_columns(path, {"sensor_name": "text", **TRANSFORM})
    mounts = transforms_of(columns, path)
    return {str(name): mount for name, mount in zip(columns["sensor_name"], mounts)}


def transforms_of(columns: Mapping[str, NDArray[Any]], path: Path) -> Array:
    """Build transforms (N, 4, 4) of the columns `TRANSFORM`, each (N,).

    Raises
    ------
    LogError
        When one is not finite or absurdly far away, or its quaternion no unit quaternion; names file and row.
    """
    q = np.stack([columns[k].astype(np.float64) for k in QUATERNION], axis=1)
    position = np.stack([columns[k].astype(np.float64) for k in TRANSLATION], axis=1)
    bad = np.union1d(find_not_unit(q), np.flatnonzero(~(np.abs(position) <= MAX_POSITION_M).all(axis=1)))
    if len(bad):
        k = int(bad[0])
        raise LogError(
            f"{path}, row {k}: quaternion {q[k].tolist()}, translation {position[k].tolist()}, expected finite numbers "
            f"up to {MAX_POSITION_M:g} and a unit quaternion"
        )
    return transform(rotation_from_quaternion(q), position)
