"""Stretches of time in which a stream has no records."""

from __future__ import annotations

from collections.abc import Iterator

from log2sim.datatypes import Fault, Log
from log2sim.geometry import NS_PER_S
from log2sim.perception.record_checks.spans import MAX_SPANS, MIN_STAMPS, gaps_of, shortest_gap_ns
from log2sim.perception.sync import Schedule

Gap = tuple[int, int]


def missing_records(log: Log, schedule: Schedule) -> Iterator[Fault]:
    """List the interruptions of the streams that a run uses, and where its ticks start late or end early."""
    start_ns, end_ns = int(schedule.t_ns[0]), int(schedule.t_ns[-1])
    for name in dict.fromkeys([*schedule.frames, *schedule.sweeps]):
        gaps = gaps_of(log.streams[name].t_ns, start_ns, end_ns)
        for some in [gaps] if len(gaps) > MAX_SPANS else [[gap] for gap in gaps]:
            yield _interruption(log, name, some, start_ns, end_ns)
    yield from _ticks_cut_short(log, schedule)


def _what(log: Log, name: str) -> tuple[str, str]:
    """Return the kind of fault and the records of a sensor in the plural."""
    return ("missing_images", "pictures") if name in log.cameras else ("missing_sweeps", "sweeps")


def _interruption(log: Log, name: str, gaps: list[Gap], start_ns: int, end_ns: int) -> Fault:
    kind, what = _what(log, name)
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


def _ticks_cut_short(log: Log, schedule: Schedule) -> Iterator[Fault]:
    """Tell where all other sensors recorded while the one that sets the ticks did not, so that nothing is reconstructed there."""
    name = schedule.reference
    stamps = log.streams[name].t_ns
    others = [log.streams[other].t_ns for other in (*schedule.frames, *schedule.sweeps) if other != name]
    others = [t_ns for t_ns in others if len(t_ns)]
    if not others or len(stamps) < MIN_STAMPS or len(schedule) < len(stamps):  # the settings chose a part of the log
        return
    kind, what = _what(log, name)
    advice = "another sensor as sync.reference sets other ticks"
    first, last = int(stamps[0]), int(stamps[-1])
    earliest, latest = max(int(t[0]) for t in others), min(int(t[-1]) for t in others)
    least_ns = shortest_gap_ns(stamps)
    if first - earliest > least_ns:
        late_s = (first - earliest) / NS_PER_S
        message = f"its {what} set the ticks and start {late_s:.2f} s after those of all other sensors; {advice}"
        yield Fault(kind, name, message, "kept", earliest, first, {"gaps": 1.0, "longest_s": late_s})
    if latest - last > least_ns:
        early_s = (latest - last) / NS_PER_S
        message = (
            f"its {what} set the ticks and end {early_s:.2f} s before those of all other sensors: nothing after that is "
            f"reconstructed; {advice}"
        )
        yield Fault(kind, name, message, "kept", last, latest, {"gaps": 1.0, "longest_s": early_s})
