"""Synchronization at camera rate: which frame and which sweep belong to a tick, and by how much they miss it.

A tick is one frame of the reference camera. Every other camera contributes its nearest frame. Every camera frame gets the
nearest sweep, where a sweep's time is the middle of the points that it holds, not the stamp that its driver wrote.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Log, Stream, Sweep
from log2sim.errors import ConfigError, LogError, RecordError
from log2sim.geometry import NS_PER_S, nearest_index

PROBED_RECORDS = 5


@dataclass(frozen=True, eq=False)
class Schedule:
    """What belongs together.

    `t_ns` (T,) int64 stamps of the ticks; `frames` camera -> (T,) index into its stream, -1 where none is near enough;
    `sweeps` lidar -> (C, T) index for every camera in the order of `frames`, -1 where none is near enough.
    `residuals_s` stream -> (T,) signed seconds from what was asked for to what was taken, NaN where nothing was.
    """

    reference: str
    t_ns: NDArray[np.int64]
    frames: Mapping[str, NDArray[np.int64]]
    sweeps: Mapping[str, NDArray[np.int64]]
    residuals_s: Mapping[str, NDArray[np.float64]]

    def __len__(self) -> int:
        return len(self.t_ns)

    def summary(self) -> dict[str, Any]:
        """Residuals a stream for the report: median and largest size in s, and how many ticks have no record."""
        return {
            name: {
                "median_abs_s": float(np.nanmedian(np.abs(r))) if np.isfinite(r).any() else None,
                "max_abs_s": float(np.nanmax(np.abs(r))) if np.isfinite(r).any() else None,
                "missing": int(np.isnan(r).sum()),
            }
            for name, r in self.residuals_s.items()
        }


def synchronize(
    log: Log,
    cameras: tuple[str, ...],
    *,
    reference: str = "",
    max_residual_s: float = 0.1,
    start_s: float | None = None,
    stop_s: float | None = None,
) -> Schedule:
    """Build the schedule of a log for the chosen cameras.

    Parameters
    ----------
    reference : str
        Camera that sets the ticks; "" takes the log's own choice, else the first camera.
    max_residual_s : float
        Farthest that a record may lie from what it is asked for, s.
    start_s, stop_s : float, optional
        Keeps the ticks in [start, stop] seconds after the first one.

    Raises
    ------
    LogError
        For a stream without records or with stamps that do not increase.
    ConfigError
        When the reference is unknown or no tick is left.
    """
    reference = reference or (log.reference_camera if log.reference_camera in cameras else "") or cameras[0]
    if reference not in cameras:
        raise ConfigError(f"sync.reference: camera '{reference}' is not used; used: {', '.join(cameras)}")
    for name in (*cameras, *log.lidars):
        _check_stamps(log.streams[name])
    ticks = log.streams[reference].t_ns
    seconds = (ticks - ticks[0]) / NS_PER_S
    keep = (seconds >= (start_s if start_s is not None else -np.inf)) & (
        seconds <= (stop_s if stop_s is not None else np.inf)
    )
    if not keep.any():
        raise ConfigError(f"--start/--stop leave no frame of '{reference}', which lasts {seconds[-1]:.3f} s")
    ticks = ticks[keep]
    tolerance_ns = round(max_residual_s * NS_PER_S)
    frames, residuals = {}, {}
    for camera in cameras:
        frames[camera], residuals[camera] = _assign_frames_once(
            *nearest_records(log.streams[camera].t_ns, ticks, tolerance_ns)
        )
    sweeps = {}
    for lidar in log.lidars:
        stream = log.streams[lidar]
        middle = stream.t_ns + sweep_middle_ns(stream)
        asked = np.stack([np.where(frames[c] >= 0, log.streams[c].t_ns[frames[c]], ticks) for c in cameras])
        index, _ = nearest_records(middle, asked.ravel(), tolerance_ns)
        sweeps[lidar] = index.reshape(asked.shape)
        _, residuals[lidar] = nearest_records(middle, asked[cameras.index(reference)], tolerance_ns)
    return Schedule(reference, ticks, frames, sweeps, residuals)


def _check_stamps(stream: Stream) -> None:
    """Raise `LogError` where a search among the stamps would go wrong; a reader puts its records in order."""
    if len(stream.t_ns) == 0:
        raise LogError(f"stream '{stream.name}': has no record; expected at least one, or a log without this sensor")
    late = np.flatnonzero(np.diff(stream.t_ns) <= 0) + 1
    if len(late):
        raise LogError(
            f"stream '{stream.name}': stamp {stream.t_ns[late[0]]} does not follow {stream.t_ns[late[0] - 1]}; expected "
            "strictly increasing stamps, so sort the records and drop those that repeat one"
        )


def nearest_records(
    stamps_ns: NDArray[np.int64], asked_ns: NDArray[np.int64], tolerance_ns: int
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Index (T,) of the record nearest to each asked stamp, -1 beyond the tolerance, and the residual (T,) in s.

    Notes
    -----
    This is where the online rule of Bhardwaj & Kalra ends up once the whole log is known: wait for the incoming record if
    it will be nearer than the last one. Of two equally near ones the earlier is taken.
    """
    index = nearest_index(stamps_ns, asked_ns)
    residual_ns = stamps_ns[index] - asked_ns
    near = np.abs(residual_ns) <= tolerance_ns
    return np.where(near, index, -1), np.where(near, residual_ns / NS_PER_S, np.nan)


def _assign_frames_once(
    index: NDArray[np.int64], residual_s: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Let only the nearest tick have a frame that several ticks would take: a frame is evidence for one moment."""
    order = np.lexsort((np.abs(residual_s), index))
    first = np.zeros(len(index), dtype=bool)
    first[order] = np.r_[True, index[order][1:] != index[order][:-1]]
    keep = first & (index >= 0)
    return np.where(keep, index, -1), np.where(keep, residual_s, np.nan)


def sweep_middle_ns(stream: Stream) -> int:
    """Middle of a sweep's point times relative to its stamp, ns, from the first sweep that can be read; 0 without point times.

    Raises
    ------
    LogError
        When none of the first sweeps can be read.
    """
    problem: Exception | None = None
    for i in range(min(PROBED_RECORDS, len(stream.t_ns))):
        try:
            sweep: Sweep = stream.read(i)
        except RecordError as error:
            problem = error
            continue
        if sweep.t_ns is None:
            return 0
        if len(sweep.t_ns):
            return (int(sweep.t_ns.min()) + int(sweep.t_ns.max())) // 2 - int(sweep.stamp_ns)
    if problem is not None and len(stream.t_ns) <= PROBED_RECORDS:
        raise LogError(
            f"stream '{stream.name}': none of its {len(stream.t_ns)} sweeps can be read; the first problem: {problem}"
        )
    return 0
