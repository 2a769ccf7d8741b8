"""Synchronization: the camera frames and LiDAR sweeps of every tick, and moments whose records are read on demand.

A tick is a frame of the reference camera. Every other camera contributes its nearest frame. Every camera frame gets the
nearest sweep, where the time of a sweep is the middle of its point times, not the stamp of its driver. Without cameras a
tick is a sweep of the reference LiDAR.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Generic, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

from log2sim.config import Config
from log2sim.datatypes import Log, Sweep, Tick
from log2sim.errors import ConfigError, LogError
from log2sim.files.plugins import nearest
from log2sim.geometry import NS_PER_S, Array, nearest_index
from log2sim.perception.lidar.cloud import sweep_to_map
from log2sim.perception.records import RecordSource

PROBED_RECORDS = 5


@dataclass(frozen=True, eq=False)
class Schedule:
    """Records of every tick."""

    reference: str  # camera that sets the ticks, or LiDAR where no camera is used
    t_ns: NDArray[np.int64]  # (T,): stamps of the ticks
    # Mapping of camera to (T,) int64: index into its stream, -1 where no frame is near enough
    frames: Mapping[str, NDArray[np.int64]]
    # By LiDAR (C, T): index for every camera in the order of `frames`, one row without cameras; -1 where none is near enough
    sweeps: Mapping[str, NDArray[np.int64]]
    # Mapping of stream to (T,) float64: time of the record less the requested time, NaN without a record
    residuals_s: Mapping[str, NDArray[np.float64]]

    def __len__(self) -> int:
        """Return the number of ticks."""
        return len(self.t_ns)

    @property
    def rows(self) -> int:
        """Number of rows of `sweeps`."""
        return max(len(self.frames), 1)

    @property
    def reference_row(self) -> int:
        """Row of `sweeps` that belongs to the reference."""
        return list(self.frames).index(self.reference) if self.frames else 0

    def drop_frames(self, ticks: Mapping[str, Sequence[int]]) -> Schedule:
        """Return the schedule without the frames of some ticks by camera, as if they had not been recorded."""
        frames = dict(self.frames)
        for camera, left_out in ticks.items():
            frames[camera] = frames[camera].copy()
            frames[camera][list(left_out)] = -1
        return replace(self, frames=frames)

    def summary(self) -> dict[str, Any]:
        """Summarize residuals by stream for the report: median and largest magnitude in s, and the number of ticks without a record."""
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
    """Find the records of every tick for the chosen cameras.

    `cameras`: without any, the sweeps of a LiDAR are the ticks. `reference`: camera that sets the ticks; "" takes the log's
    own choice, else the first camera. Without cameras the LiDAR; "" takes the one with the most sweeps. `max_residual_s`:
    largest difference between a record's time and the requested time, s. `start_s`, `stop_s`: keeps the ticks in [start,
    stop] seconds after the first one.

    Raises `LogError` for a stream without records or with stamps that do not increase; `ConfigError` when the reference is
    unknown or no tick is left.
    """
    if not cameras:
        reference = reference or max(log.lidars, key=lambda name: len(log.streams[name].t_ns))
    else:
        reference = reference or (log.reference_camera if log.reference_camera in cameras else "") or cameras[0]
    kind, used = ("camera", cameras) if cameras else ("LiDAR", tuple(log.lidars))
    if reference not in used:
        raise ConfigError(f"sync.reference: {kind} '{reference}' is not used; used: {', '.join(used)}")
    for name in (*cameras, *log.lidars):
        t_ns = log.streams[name].t_ns
        if len(t_ns) == 0:
            raise LogError(f"stream '{name}': has no record; expected at least one, or a log without this sensor")
        late = np.flatnonzero(np.diff(t_ns) <= 0) + 1
        if len(late):
            raise LogError(
                f"stream '{name}': stamp {t_ns[late[0]]} does not follow {t_ns[late[0] - 1]}; expected strictly increasing "
                "stamps, so sort the records and drop those that repeat one"
            )
    ticks = log.streams[reference].t_ns
    if not cameras:
        ticks = ticks + sweep_middle_ns(log, reference)
    seconds = (ticks - ticks[0]) / NS_PER_S
    keep = (seconds >= (-np.inf if start_s is None else start_s)) & (seconds <= (np.inf if stop_s is None else stop_s))
    if not keep.any():
        raise ConfigError(f"--start/--stop leave no frame of '{reference}', which lasts {seconds[-1]:.3f} s")
    ticks = ticks[keep]
    tolerance_ns = round(max_residual_s * NS_PER_S)
    frames, residuals = {}, {}
    for camera in cameras:
        index, residual_s = nearest_records(log.streams[camera].t_ns, ticks, tolerance_ns)
        # A frame that is nearest to several ticks is kept only at the nearest of them, so that no frame counts twice.
        order = np.lexsort((np.abs(residual_s), index))
        first = np.zeros(len(index), dtype=bool)
        first[order] = np.r_[True, index[order][1:] != index[order][:-1]]
        once = first & (index >= 0)
        frames[camera], residuals[camera] = np.where(once, index, -1), np.where(once, residual_s, np.nan)
    sweeps = {}
    for lidar in log.lidars:
        stream = log.streams[lidar]
        middle = stream.t_ns + sweep_middle_ns(log, lidar)
        stamps = [np.where(frames[c] >= 0, log.streams[c].t_ns[frames[c]], ticks) for c in cameras]
        asked = np.stack(stamps or [ticks])
        index, _ = nearest_records(middle, asked.ravel(), tolerance_ns)
        sweeps[lidar] = index.reshape(asked.shape)
        row = cameras.index(reference) if cameras else 0
        _, residuals[lidar] = nearest_records(middle, asked[row], tolerance_ns)
    return Schedule(reference, ticks, frames, sweeps, residuals)


def schedule_of(log: Log, cameras: tuple[str, ...], config: Config) -> Schedule:
    """Synchronize the chosen cameras and the LiDARs of a log by the settings of a run."""
    sync = config.sync
    return synchronize(
        log,
        cameras,
        reference=sync.reference,
        max_residual_s=sync.max_residual_s,
        start_s=config.start_s,
        stop_s=config.stop_s,
    )


def nearest_records(
    stamps_ns: NDArray[np.int64], asked_ns: NDArray[np.int64], tolerance_ns: int
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Find the record nearest to each requested stamp.

    Returns `index`: (T,): -1 beyond the tolerance; `residual_s`: (T,): NaN beyond the tolerance.

    The offline equivalent of the online rule of Bhardwaj & Kalra, which waits for the incoming record if it will be nearer
    than the last one. Of two equally near records the earlier is taken.
    """
    index = nearest_index(stamps_ns, asked_ns)
    residual_ns = stamps_ns[index] - asked_ns
    near = np.abs(residual_ns) <= tolerance_ns
    return np.where(near, index, -1), np.where(near, residual_ns / NS_PER_S, np.nan)


def sweep_middle_ns(log: Log, lidar: str) -> int:
    """Return the middle of a sweep's point times relative to its stamp, ns; 0 without point times.

    Taken from the first of `PROBED_RECORDS` sweeps that can be read; 0 where none can.
    """
    records = RecordSource(log)
    for i in range(min(PROBED_RECORDS, len(log.streams[lidar].t_ns))):
        sweep: Sweep | None = records.get(lidar, i)
        if sweep is not None:
            t_ns = sweep.t_ns
            return 0 if t_ns is None else (int(t_ns.min()) + int(t_ns.max())) // 2 - int(sweep.stamp_ns)
    return 0


T = TypeVar("T")


def ticks_of(
    log: Log, cameras: Sequence[str] = (), *, start_s: float | None = None, stop_s: float | None = None
) -> Ticks:
    """Return the ticks of a log, as `Log.ticks` does; see there.

    Raises `ConfigError` for an unknown camera, and where no tick is left; `LogError` for a log without cameras and LiDARs,
    or with stamps that do not increase.
    """
    for name in cameras:
        if name not in log.cameras:
            known = list(log.cameras)
            raise ConfigError(f"no camera '{name}'{nearest(name, known)}; the log has {', '.join(known) or 'none'}")
    if not log.cameras and not log.lidars:
        raise LogError(f"{log.name}: the log has neither a camera nor a LiDAR, so there are no ticks")
    schedule = synchronize(log, tuple(cameras) or tuple(log.cameras))
    seconds = (schedule.t_ns - schedule.t_ns[0]) / NS_PER_S
    low, high = -np.inf if start_s is None else start_s, np.inf if stop_s is None else stop_s
    chosen = np.flatnonzero((seconds >= low) & (seconds <= high))
    if not len(chosen):
        raise ConfigError(f"no tick from {low:g} to {high:g} s; the log has ticks from 0 to {seconds[-1]:.3f} s")
    return Ticks(log, schedule, range(int(chosen[0]), int(chosen[-1]) + 1))


class Ticks(Sequence[Tick]):
    """Ticks of a log, made when they are asked for; none is kept."""

    def __init__(self, log: Log, schedule: Schedule, rows: range) -> None:
        self._log, self._schedule, self._rows = log, schedule, rows

    def __len__(self) -> int:
        """Return the number of ticks."""
        return len(self._rows)

    @overload
    def __getitem__(self, index: int) -> Tick: ...

    @overload
    def __getitem__(self, index: slice) -> Ticks: ...

    def __getitem__(self, index: int | slice) -> Tick | Ticks:
        """Return a tick, or those of a slice."""
        if isinstance(index, slice):
            return Ticks(self._log, self._schedule, self._rows[index])
        log, schedule, row = self._log, self._schedule, self._rows[index]
        t_ns = int(schedule.t_ns[row])
        frames = {name: int(index[row]) for name, index in schedule.frames.items() if index[row] >= 0}
        near = {name: int(index[schedule.reference_row, row]) for name, index in schedule.sweeps.items()}
        require = RecordSource(log).require
        sweeps: Records[Sweep] = Records({name: partial(require, name, k) for name, k in near.items() if k >= 0})
        poses, known = (None, [False]) if log.ego is None else log.ego.at(t_ns)
        return Tick(
            t_ns=t_ns,
            t_s=float(t_ns - schedule.t_ns[0]) / NS_PER_S,
            images=Records({name: partial(require, name, k) for name, k in frames.items()}),
            sweeps=sweeps,
            image_ns={name: int(log.streams[name].t_ns[k]) for name, k in frames.items()},
            map_T_ego=np.asarray(poses[0]) if poses is not None and known[0] else None,
            points=lambda: points_of(log, sweeps),
        )

    def __repr__(self) -> str:
        """Return the number of ticks."""
        return f"<{len(self)} ticks of {self._log.name!r:.80}>"


class Records(Mapping[str, T], Generic[T]):
    """Records by sensor, each read when it is first asked for."""

    def __init__(self, readers: Mapping[str, Callable[[], T]]) -> None:
        self._readers = dict(readers)
        self._read: dict[str, T] = {}

    def __getitem__(self, name: str) -> T:
        """Return the record of a sensor; `KeyError` without one, `RecordError` when it cannot be read."""
        if name not in self._read:
            if name not in self._readers:
                known = ", ".join(self._readers) or "none"
                raise KeyError(f"no record of '{name}' at this tick; there are {known}")
            self._read[name] = self._readers[name]()
        return self._read[name]

    def __contains__(self, name: object) -> bool:
        """Return whether there is a record of a sensor, without reading it."""
        return name in self._readers

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names of the sensors."""
        return iter(self._readers)

    def __len__(self) -> int:
        """Return the number of records."""
        return len(self._readers)


def points_of(log: Log, sweeps: Mapping[str, Sweep]) -> Array:
    """Return the points (N, 3), m, of sweeps in the map frame; those of a sensor whose pose is not known are left out."""
    mapped = [sweep_to_map(log, name, sweep, compensate=True) for name, sweep in sweeps.items()]
    return np.concatenate([np.zeros((0, 3)), *(xyz for found in mapped if found is not None for xyz in [found[0]])])
