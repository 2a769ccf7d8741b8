"""Sweeps of PandaSet: both LiDARs in one pickled table each, times of the PandarGT only in its points."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property, lru_cache
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Stream, Sweep
from log2sim.errors import RecordError
from log2sim.geometry import NS_PER_S
from log2sim.logs.pandaset.unpickle import Columns, read_pickled_table
from log2sim.logs.stamps import MAX_TIME_S, strictly_increasing
from log2sim.logs.sweeps import sweep_of

# Value of the column "d" by LiDAR.
LIDARS: Mapping[str, int] = {"pandar64": 0, "pandargt": 1}
COLUMNS = ("x", "y", "z", "t", "d", "i")
# Tables that are kept from the reading of the stamps until their sweeps are read, so that they are decompressed once.
MAX_KEPT_BYTES = 256 * 1024**2
READING_THREADS = 4


class SweepFiles:
    """Files of a sequence, each with the points of both LiDARs; stamps of the PandarGT are read when first used."""

    def __init__(self, files: dict[int, Path], t_ns: NDArray[np.int64], notes: list[str]) -> None:
        self.files, self._t_ns, self._notes = files, t_ns, notes
        self._indexes: dict[str, tuple[NDArray[np.int64], list[Path]]] = {}
        self._lock, self._kept = Lock(), _KeptTables()

    def stream(self, lidar: str) -> Stream:
        """Return the stream of one LiDAR."""

        def read(i: int) -> Sweep:
            t_ns, files = self.index(lidar)
            return _read_sweep(self._kept.take(files[i], lidar), files[i], int(t_ns[i]), LIDARS[lidar])

        return Stream(lidar, lambda: self.index(lidar)[0], read)

    def index(self, lidar: str) -> tuple[NDArray[np.int64], list[Path]]:
        """Return stamps (F,) and files of the sweeps of one LiDAR, in order."""
        with self._lock:
            if lidar not in self._indexes:
                t_ns = self._t_ns if lidar == "pandar64" else self.gt_stamps
                numbers = np.array(list(self.files))
                keep, problems = strictly_increasing(t_ns[numbers], lidar)
                self._notes += problems
                self._indexes[lidar] = t_ns[numbers[keep]], [self.files[int(n)] for n in numbers[keep]]
            return self._indexes[lidar]

    @cached_property
    def gt_stamps(self) -> NDArray[np.int64]:
        """Middle (N,) of the PandarGT's points of each sweep.

        Where a sweep is missing or cannot be read, the stamp of the Pandar64 moved as those next to it.
        """
        with ThreadPoolExecutor(READING_THREADS) as pool:
            middles = zip(self.files, pool.map(self._gt_middle_ns, self.files.values()))
            known = {number: stamp - int(self._t_ns[number]) for number, stamp in middles if stamp is not None}
        if not known:
            return self._t_ns.copy()
        moved = np.interp(np.arange(len(self._t_ns)), list(known), list(known.values()))
        return np.asarray(self._t_ns + np.round(moved).astype(np.int64))

    def _gt_middle_ns(self, path: Path) -> int | None:
        try:
            columns = read_pickled_table(path)
            self._kept.add(path, columns)
        except RecordError:
            return None
        return _gt_middle_ns(columns)


class _KeptTables:
    """Tables whose sweeps are still to be read, up to `MAX_KEPT_BYTES`; safe to share between threads."""

    def __init__(self) -> None:
        self._tables: dict[Path, tuple[Columns, set[str]]] = {}
        self._bytes, self._lock = 0, Lock()

    def add(self, path: Path, columns: Columns) -> None:
        """Keep the columns of a table that a sweep needs, if there is room."""
        needed = {name: columns[name] for name in COLUMNS if name in columns}
        size = sum(column.nbytes for column in needed.values())
        with self._lock:
            if self._bytes + size <= MAX_KEPT_BYTES:
                self._tables[path] = {name: column.copy() for name, column in needed.items()}, set()
                self._bytes += size

    def take(self, path: Path, lidar: str) -> Columns | None:
        """Return a table for one LiDAR, None where it is not kept; forget it when all LiDARs have got it."""
        with self._lock:
            columns, read = self._tables.get(path, (None, set()))
            read.add(lidar)
            if columns is not None and len(read) == len(LIDARS):
                del self._tables[path]
                self._bytes -= sum(column.nbytes for column in columns.values())
            return columns


def _gt_middle_ns(columns: Mapping[str, NDArray[Any]]) -> int | None:
    """Return the middle of the PandarGT's times; None where they cannot be those of a sweep."""
    try:
        t_s = columns["t"][columns["d"] == LIDARS["pandargt"]].astype(np.float64)
    except (KeyError, TypeError, ValueError, IndexError):
        return None
    t_s = t_s[np.abs(t_s) < MAX_TIME_S]  # False for NaN
    return round((float(t_s.min()) + float(t_s.max())) / 2 * NS_PER_S) if len(t_s) else None


# One file holds the sweeps of both LiDARs, which are read one after the other.
@lru_cache(maxsize=4)
def _read_points(path: Path) -> Columns:
    return read_pickled_table(path)


def _read_sweep(kept: Columns | None, path: Path, t_ns: int, number: int) -> Sweep:
    where = f"{path} (stamp {t_ns})"
    try:
        columns = _read_points(path) if kept is None else kept
        # Indices take half the time of a mask.
        rows = np.flatnonzero(columns["d"] == number)
        xyz = np.stack([columns[k].take(rows) for k in ("x", "y", "z")], axis=1)
        t_s = columns["t"].take(rows)
        strength = columns["i"].take(rows) if "i" in columns and columns["i"].dtype.kind in "iuf" else None
        if xyz.dtype.kind != "f" or t_s.dtype.kind != "f" or columns["d"].dtype.kind not in "iuf":
            kinds = f"{xyz.dtype}, {t_s.dtype} and {columns['d'].dtype}"
            raise RecordError(f"{where}: columns x, y, z, then t and d are {kinds}, expected numbers")
    except KeyError as missing:
        raise RecordError(f"{where}: no column {missing}; expected x, y, z, i, t, d") from None
    timed = np.abs(t_s) < MAX_TIME_S  # False for NaN
    if not timed.all():
        xyz, t_s, strength = xyz[timed], t_s[timed], None if strength is None else strength[timed]
    offset_ns = np.round(t_s * NS_PER_S).astype(np.int64) - t_ns
    return sweep_of(xyz, t_ns, offset_ns, "map", intensity=strength)
