"""Validation of a log: reads every record and reports its problems."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from log2sim.datatypes import Log, Stream, Sweep
from log2sim.errors import RecordError
from log2sim.logs.excerpt import summarize_stamps
from log2sim.logs.native.reader import READER
from log2sim.logs.opening import open_log

MAX_POINT_DISTANCE_M = 1000.0


def validate_log(
    path: Path | str | Log,
    *,
    format: str = "auto",
    sequence: str | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[str]:
    """List the problems of a log, one line each.

    `path`, `format`, `sequence`: as for `open_log`; or an open log. `progress`: called as `progress(done, total)` after
    each record. Raises `LogError` when the log cannot be opened at all.
    """
    log = path if isinstance(path, Log) else open_log(path, format=format, sequence=sequence)
    # Notes on other formats say what the format lacks; those on native logs say what is wrong with the stamps.
    problems = list(log.notes) if log.format == READER.name else []
    total = sum(len(s.t_ns) for s in log.streams.values())
    done = 0
    for stream in log.streams.values():
        bad = 0
        for i in range(len(stream.t_ns)):
            problem = _record(log, stream, i)
            bad += problem is not None and problem[0]
            if problem is not None:
                problems.append(problem[1])
            done += 1
            if progress is not None:
                progress(done, total)
        if bad == len(stream.t_ns):
            problems.append(f"stream '{stream.name}': none of its {bad} records can be read")
    return problems + _coverage(log)


def _record(log: Log, stream: Stream, i: int) -> tuple[bool, str] | None:
    """Whether a record is unreadable, and its problem; None without one."""
    try:
        record = stream.read(i)
    except RecordError as error:
        return True, f"stream '{stream.name}': {error}"
    if not isinstance(record, Sweep):
        return None
    where = f"stream '{stream.name}', stamp {stream.t_ns[i]}"
    if not len(record.xyz_m):
        return False, f"{where}: the sweep has no points"
    if record.frame == "lidar" and float(np.abs(record.xyz_m).max()) > MAX_POINT_DISTANCE_M:
        return False, f"{where}: a point is {np.abs(record.xyz_m).max():.0f} m from the LiDAR; are the units meters?"
    return None


def list_gaps(log: Log) -> list[str]:
    """List the streams in which records seem to be missing, by the steps between their stamps, one line each."""
    lines = []
    for name, stream in log.streams.items():
        summary = summarize_stamps(stream.t_ns)
        if summary["gaps"]:
            longest = max(summary["gaps"], key=lambda gap: float(gap["length_s"]))
            count = len(summary["gaps"])
            lines.append(
                f"stream '{name}': {count} gap{'s' * (count > 1)} in its records at {summary['rate_hz']:g} Hz, the longest of "
                f"{longest['length_s']:g} s after stamp {longest['after_ns']}"
            )
    return lines


def _coverage(log: Log) -> list[str]:
    """List sensors on the ego with records at stamps where its pose is unknown."""
    on_ego = [n for n in log.streams if (log.cameras.get(n) or log.lidars[n]).mount == "ego"]
    if log.ego is None and on_ego:
        return [
            f"the log has no poses of the ego, on which {', '.join(on_ego)} are mounted; reconstruct estimates them"
        ]
    problems = []
    for name, stream in log.streams.items():
        known = log.map_T_sensor(name, stream.t_ns)[1]
        if not known.all():
            first = stream.t_ns[np.argmin(known)]
            problems.append(
                f"stream '{name}': no ego pose for {np.sum(~known)} of {len(known)} records, first at stamp {first}"
            )
    return problems
