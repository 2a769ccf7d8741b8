"""Stretches of time in which a stream has no records."""

from __future__ import annotations

from collections.abc import Iterator

from log2sim.datatypes import Fault, Log
from log2sim.geometry import NS_PER_S
from log2sim.perception.record_checks.spans import MAX_SPANS, gaps_of
from log2sim.perception.sync import Schedule

Gap = tuple[int, int]


def missing_records(log: Log, schedule: Schedule) -> Iterator[Fault]:
    """List the interruptions of the streams that a run uses, from its first to its last tick."""
    start_ns, end_ns = int(schedule.t_ns[0]), int(schedule.t_ns[-1])
    for name in dict.fromkeys([*schedule.frames, *schedule.sweeps]):
        gaps = gaps_of(log.streams[name].t_ns, start_ns, end_ns)
        for some in [gaps] if len(gaps) > MAX_SPANS else [[gap] for gap in gaps]:
            yield _interruption(log, name, some, start_ns, end_ns)


def _interruption(log: Log, name: str, gaps: list[Gap], start_ns: int, end_ns: int) -> Fault:
    kind, what = ("missing_images", "pictures") if name in log.cameras else ("missing_sweeps", "sweeps")
    first, last = gaps[0][0], gaps[-1][1]
    longest_s = max(b - a for a, b in gaps) / NS_PER_S
    a_s, b_s = (first - start_ns) / NS_PER_S, (last - start_ns) / NS_PER_S
    if len(gaps) > 1:
        message = f"no {what} in {len(gaps)} stretches of up to {longest_s:.2f} s, from {a_s:.2f} to {b_s:.2f} s"
    elif first == start_ns and last == end_ns:
        message = f"no {what} at all from the first to the last tick"
    elif first == start_ns:
        message = f"no {what} in the first {longest_s:.2f} s"
    elif last == end_ns:
        message = f"no {what} in the last {longest_s:.2f} s, after {a_s:.2f} s"
    else:
        message = f"no {what} for {longest_s:.2f} s, from {a_s:.2f} to {b_s:.2f} s"
    values = {"gaps": float(len(gaps)), "longest_s": longest_s}
    return Fault(kind, name, message, "kept", first, last, values)
