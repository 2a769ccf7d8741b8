"""Synchronized moments of a log whose pictures and sweeps are read when they are asked for."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Generic, TypeVar, overload

import numpy as np

from log2sim.datatypes import Log, Sweep, Tick
from log2sim.errors import ConfigError, LogError
from log2sim.geometry import NS_PER_S, Array
from log2sim.perception.lidar.cloud import sweep_to_map
from log2sim.perception.sync import Schedule, synchronize
from log2sim.registry import nearest

T = TypeVar("T")


def ticks_of(
    log: Log, cameras: Sequence[str] = (), *, start_s: float | None = None, stop_s: float | None = None
) -> Ticks:
    """Return the ticks of a log, as `Log.ticks` does; see there.

    Raises
    ------
    ConfigError
        For an unknown camera, and where no tick is left.
    LogError
        For a log without cameras and LiDARs, or with stamps that do not increase.
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
        return self._tick(self._rows[index])

    def __repr__(self) -> str:
        """Return the number of ticks."""
        return f"<{len(self)} ticks of {self._log.name!r:.80}>"

    def _tick(self, row: int) -> Tick:
        log, schedule = self._log, self._schedule
        t_ns = int(schedule.t_ns[row])
        frames = {name: int(index[row]) for name, index in schedule.frames.items() if index[row] >= 0}
        near = {name: int(index[schedule.reference_row, row]) for name, index in schedule.sweeps.items()}
        sweeps: Records[Sweep] = Records({name: _reading(log, name, k) for name, k in near.items() if k >= 0})
        return Tick(
            t_ns=t_ns,
            t_s=float(t_ns - schedule.t_ns[0]) / NS_PER_S,
            images=Records({name: _reading(log, name, k) for name, k in frames.items()}),
            sweeps=sweeps,
            image_ns={name: int(log.streams[name].t_ns[k]) for name, k in frames.items()},
            map_T_ego=_ego_pose(log, t_ns),
            points=lambda: points_of(log, sweeps),
        )


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


def _reading(log: Log, name: str, index: int) -> Callable[[], Any]:
    return lambda: log.streams[name].read(index)


def _ego_pose(log: Log, t_ns: int) -> Array | None:
    if log.ego is None:
        return None
    map_T_ego, valid = log.ego.at(t_ns)
    return np.asarray(map_T_ego[0]) if valid[0] else None
