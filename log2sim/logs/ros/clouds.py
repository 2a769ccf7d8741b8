"""Points of a PointCloud2 message of any layout, and the times at which they were measured."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Sweep
from log2sim.errors import RecordError
from log2sim.logs.pcd import find_intensity_field
from log2sim.logs.ros.containers import printable
from log2sim.logs.ros.settings import LidarTopic
from log2sim.logs.sweeps import MAX_SWEEP_POINTS, sweep_of

# sensor_msgs/PointField: datatypes 1 to 8.
DATATYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
TIME_FIELDS = (
    "t", "time", "times", "timestamp", "timestamps", "stamp", "stamps", "time_stamp", "offset_time", "time_offset", "t_offset",
    "point_time", "point_time_offset", "offset_ns", "ts",
)  # fmt: skip
UNITS_NS = {"s": 1e9, "ms": 1e6, "us": 1e3, "ns": 1.0}
# Units are factors of 1000 apart: a sweep that spans a thirtieth to thirty times the period has one unit only.
MAX_SPAN_RATIO = 30.0
# Times up to this long count from the stamp of the message; larger ones are those of a clock.
MAX_RELATIVE_NS = 10e9
# A clock that is nearer to the stamps than this is the one that the stamps are of.
MAX_CLOCK_OFFSET_NS = 60e9
DEFAULT_PERIOD_NS = 1e8


def find_time_field(names: list[str], chosen: str = "") -> str | None:
    """Find the field of the points' times; None where there is none."""
    if chosen:
        return chosen if chosen in names else None
    return next((name for name in names if name.lower() in TIME_FIELDS), None)


def sweep_from(message: Any, t_ns: int, period_ns: float, settings: LidarTopic, where: str) -> Sweep:
    """Build a sweep from a decoded PointCloud2.

    Parameters
    ----------
    message : sensor_msgs/PointCloud2
    t_ns : int
        Its stamp.
    period_ns : float
        Time between two sweeps, by which the unit of the times is recognized.
    settings : LidarTopic
    where : str
        Names the message in errors.

    Raises
    ------
    RecordError
        When fields, sizes and data contradict each other.
    """
    points = point_table(message, where)
    missing = [name for name in "xyz" if name not in (points.dtype.names or ())]
    if missing:
        raise RecordError(
            f"{where}: the points have no field '{missing[0]}', only {', '.join(points.dtype.names or ())}"
        )
    xyz = np.stack(
        [points[name].astype(np.float64 if points[name].dtype.itemsize == 8 else np.float32) for name in "xyz"], 1
    )
    # Drivers mark rays without a return by NaN or by zeros.
    kept = np.isfinite(xyz).all(axis=1) & xyz.any(axis=1)
    xyz = xyz[kept]
    name = find_time_field(list(points.dtype.names or ()), settings.time_field)
    offset = None if name is None else offsets_ns(points[name][kept], t_ns, period_ns, settings)
    strength = find_intensity_field(points.dtype)
    return sweep_of(
        xyz,
        t_ns,
        offset,
        "lidar",
        t_ns if settings.compensated else None,
        None if strength is None else points[strength][kept],
    )


def point_table(message: Any, where: str) -> NDArray[Any]:
    """View the data of a PointCloud2 as a structured array (N,); nothing is copied but padded rows."""
    height, width, step = int(message.height), int(message.width), int(message.point_step)
    row_step = int(message.row_step) or width * step
    data = np.asarray(message.data, dtype=np.uint8)
    if height * width > MAX_SWEEP_POINTS:
        raise RecordError(f"{where}: {height * width} points, more than the {MAX_SWEEP_POINTS} that a sweep may have")
    dtype = _dtype(message, step, where)
    needed = (height - 1) * row_step + width * step if height and width else 0
    if row_step < width * step or len(data) < needed:
        raise RecordError(
            f"{where}: {len(data)} bytes for {height} x {width} points of {step} bytes (rows of {row_step}), "
            f"expected at least {needed}"
        )
    if not needed:
        return np.zeros(0, dtype)
    if row_step == width * step:
        return np.frombuffer(data[:needed], dtype)
    rows = np.lib.stride_tricks.as_strided(data, (height, width * step), (row_step, 1))
    return np.frombuffer(np.ascontiguousarray(rows), dtype)


def _dtype(message: Any, step: int, where: str) -> np.dtype[Any]:
    order = ">" if message.is_bigendian else "<"
    names, formats, offsets = [], [], []
    for point_field in message.fields:
        code = DATATYPES.get(int(point_field.datatype))
        count, name = max(1, int(point_field.count)), printable(point_field.name)
        if code is None or count > step or not name or name in names:
            continue
        names.append(name)
        formats.append(order + code if count == 1 else f"({count},){order}{code}")
        offsets.append(int(point_field.offset))
    try:
        return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": step})
    except (ValueError, TypeError) as problem:
        raise RecordError(f"{where}: the fields of the points do not fit into {step} bytes: {problem}") from None


def offsets_ns(values: NDArray[Any], t_ns: int, period_ns: float, settings: LidarTopic) -> NDArray[np.int64] | None:
    """Compute times (N,) ns of points relative to the stamp of their message; None where no unit makes sense of them.

    Notes
    -----
    Drivers give seconds, milliseconds, microseconds or nanoseconds under the same names, from the stamp or of a clock. The unit
    is the one in which the values span about the time between two sweeps. Values far from zero are of a clock: the stamps' own
    where it is near to them; otherwise the first of them is put at the stamp.
    """
    if not len(values) or values.ndim != 1:
        return None if values.ndim != 1 else np.zeros(0, dtype=np.int64)
    low = values.min()
    span = float(values.max()) - float(low) if values.dtype.kind == "f" else float(int(values.max()) - int(low))
    unit_ns = UNITS_NS.get(settings.time_unit) or _recognized_unit_ns(span, period_ns)
    if unit_ns is None or not np.isfinite(span):
        return None
    # The difference to the first is exact also for large clock values.
    forward: NDArray[np.int64] = np.round((values - low).astype(np.float64) * unit_ns).astype(np.int64)
    first_ns = _nanoseconds(low, unit_ns)
    if settings.stamp != "auto":
        return forward if settings.stamp == "start" else forward - forward.max()
    if abs(first_ns) <= MAX_RELATIVE_NS:
        return forward + first_ns
    return forward + (first_ns - t_ns if abs(first_ns - t_ns) <= MAX_CLOCK_OFFSET_NS else 0)


def _recognized_unit_ns(span: float, period_ns: float) -> float | None:
    if span <= 0:
        return None
    ratio = {unit: abs(np.log(span * unit / period_ns)) for unit in UNITS_NS.values()}
    best = min(ratio, key=ratio.__getitem__)
    return best if ratio[best] <= np.log(MAX_SPAN_RATIO) else None


def _nanoseconds(value: Any, unit_ns: float) -> int:
    """Convert one value; whole numbers of any size exactly."""
    if isinstance(value, np.integer):
        return int(value) * round(unit_ns)
    whole = int(value)
    return whole * round(unit_ns) + round((float(value) - whole) * unit_ns)
