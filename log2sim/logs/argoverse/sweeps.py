"""Sweeps of Argoverse 2: the points of two LiDARs in one file, in the ego frame, compensated to the start of the sweep."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Stream, Sweep
from log2sim.errors import RecordError
from log2sim.geometry import Array, apply, inverse
from log2sim.logs.arrow.tables import TableLimits, read_columns
from log2sim.logs.arrow.values import Kind
from log2sim.logs.sweeps import MAX_SWEEP_BYTES, MAX_SWEEP_POINTS, sweep_of

# First laser number of each LiDAR. On the sample log the elevations of a laser's points, computed from the position
# of this LiDAR, scatter by 0.003 to 0.005 degrees; from that of the other one by 0.1.
LIDARS = {"up_lidar": 0, "down_lidar": 32}
LASERS = 32
COLUMNS: dict[str, Kind] = {
    "x": "float",
    "y": "float",
    "z": "float",
    "laser_number": "int",
    "offset_ns": "int",
    "intensity": "float",
}
OPTIONAL = ("intensity",)
LIMITS = TableLimits(rows=MAX_SWEEP_POINTS, file_bytes=MAX_SWEEP_BYTES, unpacked_bytes=MAX_SWEEP_BYTES)
# A sweep lasts 0.1 s, those of both LiDARs together 0.106 s in the sample log.
MAX_OFFSET_NS = 1_000_000_000


def sweep_stream(lidar: str, t_ns: NDArray[np.int64], files: list[Path], ego_T_lidar: Array) -> Stream:
    """Stream of one LiDAR.

    Parameters
    ----------
    lidar : {"up_lidar", "down_lidar"}
    t_ns : (F,) int64
        Reference stamps of the files.
    files : list of Path
        F files, each with the points of both LiDARs.
    ego_T_lidar : (4, 4) float64
    """
    lidar_T_ego = inverse(ego_T_lidar)

    def read(i: int) -> Sweep:
        stamp = int(t_ns[i])
        columns = _read_points(files[i])
        strength = columns.get("intensity")
        rows = columns["laser_number"] // LASERS == LIDARS[lidar] // LASERS
        # Points are moved in double precision: they were stored in half precision, to which nothing should be added.
        xyz_ego = np.stack([columns[k][rows] for k in "xyz"], axis=1).astype(np.float64)
        xyz = apply(lidar_T_ego, xyz_ego).astype(np.float32)
        return sweep_of(
            xyz, stamp, columns["offset_ns"][rows], "lidar", stamp, None if strength is None else strength[rows]
        )

    return Stream(lidar, t_ns, read)


# The streams of both LiDARs read each file, one after the other.
@lru_cache(maxsize=4)
def _read_points(path: Path) -> dict[str, NDArray[Any]]:
    columns = read_columns(path, COLUMNS, optional=OPTIONAL, error=RecordError, limits=LIMITS)
    laser, offset_ns = columns["laser_number"], columns["offset_ns"]
    if len(laser) and not (laser.min() >= 0 and laser.max() < LASERS * len(LIDARS)):
        raise RecordError(f"{path}, column 'laser_number': {laser.min()} to {laser.max()}, expected 0 to 63")
    if len(laser) and np.abs(offset_ns).max() > MAX_OFFSET_NS:
        raise RecordError(
            f"{path}, column 'offset_ns': {offset_ns.min()} to {offset_ns.max()}, expected less than 1 s from the stamp"
        )
    finite = np.isfinite(columns["x"]) & np.isfinite(columns["y"]) & np.isfinite(columns["z"])
    return columns if finite.all() else {name: column[finite] for name, column in columns.items()}
