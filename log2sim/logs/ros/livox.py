"""Clouds of Livox LiDARs as their driver records them (livox_ros_driver and livox_ros_driver2, CustomMsg)."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Sweep
from log2sim.errors import RecordError
from log2sim.logs.ros.bag import STAMP
from log2sim.logs.ros.settings import LidarTopic
from log2sim.logs.sweeps import MAX_SWEEP_POINTS, sweep_of

TYPES = ("livox_ros_driver/msg/CustomMsg", "livox_ros_driver2/msg/CustomMsg")
FIELDS = ["header", "timebase", "point_num", "lidar_id", "rsvd", "points"]
# CustomPoint: time in ns after the stamp, position in m; then reflectivity, tag and line.
POINT_FORMATS = ("u4", "f4", "f4", "f4", "u1")
POINT_BYTES = 19
ENCAPSULATION_BYTES = 4


def sweep_from_livox(raw: bytes, encoding: str, t_ns: int, settings: LidarTopic, where: str) -> Sweep:
    """Build a sweep from the bytes of a CustomMsg; `RecordError`, beginning with `where`, when they are damaged.

    Notes
    -----
    The points are viewed as an array: decoded one by one, 20,000 of them would take longer than a sweep lasts.
    """
    order = "<" if encoding == "ros1" or raw[1:2] == b"\1" else ">"
    try:
        (length,) = struct.unpack_from(order + "I", raw, STAMP.stop)
        position = STAMP.stop + 4 + length
        if encoding != "ros1":  # CDR aligns numbers to their size, counted from behind the encapsulation
            position += -(position - ENCAPSULATION_BYTES) % 8
        # timebase, point_num, lidar_id, rsvd[3]
        (count,) = struct.unpack_from(order + "I", raw, position + 16)
    except struct.error:
        raise RecordError(f"{where}: {len(raw)} bytes, too few for a CustomMsg") from None
    begin = position + 20
    step = POINT_BYTES if encoding == "ros1" else POINT_BYTES + 1
    if count > MAX_SWEEP_POINTS or begin + count * step - (step - POINT_BYTES) > len(raw):
        raise RecordError(f"{where}: {len(raw)} bytes for {count} points of {step} bytes")
    # CDR does not pad the last point.
    data = raw[begin : begin + count * step].ljust(count * step, b"\0")
    formats = [order + kind for kind in POINT_FORMATS]
    dtype = np.dtype({"names": list("txyzr"), "formats": formats, "offsets": [0, 4, 8, 12, 16], "itemsize": step})
    points: NDArray[Any] = np.frombuffer(data, dtype)
    xyz = np.stack([points[axis] for axis in "xyz"], axis=1).astype(np.float32)
    kept = xyz.any(axis=1)
    offset = points["t"][kept].astype(np.int64)
    if settings.stamp == "end" and len(offset):
        offset -= offset.max()
    return sweep_of(
        xyz[kept],
        t_ns,
        None if settings.time_field == "none" else offset,
        "lidar",
        t_ns if settings.compensated else None,
        points["r"][kept],
    )
