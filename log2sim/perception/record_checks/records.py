"""The watch over all records that a run reads, and the faults that it found."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Fault, Log
from log2sim.geometry import NS_PER_S
from log2sim.perception.record_checks.camera_watch import CameraWatch
from log2sim.perception.record_checks.lidar_watch import LidarWatch
from log2sim.perception.record_checks.missing import missing_records
from log2sim.perception.record_checks.spans import Span, spans_of
from log2sim.perception.sync import Schedule

# What sweeps of this LiDAR usually have: this quantile of the numbers of points, so that many with none do not lower it.
USUAL_QUANTILE = 0.9
# Next to no points: the ground alone gives most points of a sweep, so no change of the scenery takes nine of ten away.
MAX_SPARSE_SHARE = 0.1
# With fewer points than this a LiDAR shows no object farther than some meters.
MIN_USUAL_POINTS = 100


class RecordWatch:
    """Judge pictures and sweeps as they are read.

    Attributes
    ----------
    cameras : dict of str to CameraWatch
    lidars : dict of str to LidarWatch
    """

    def __init__(self, log: Log) -> None:
        self._log = log
        self.cameras = {name: CameraWatch(log, name) for name in log.cameras}
        self.lidars = {name: LidarWatch(log, name) for name in log.lidars}

    def faults(self, schedule: Schedule) -> tuple[Fault, ...]:
        """List what was found, a fault for each span of each sensor."""
        t0_ns = int(schedule.t_ns[0])
        found = [fault for camera in self.cameras.values() for fault in _camera_faults(camera, t0_ns)]
        found += [fault for lidar in self.lidars.values() for fault in _lidar_faults(lidar, t0_ns)]
        return (*found, *missing_records(self._log, schedule))


def _camera_faults(watch: CameraWatch, t0_ns: int) -> Iterator[Fault]:
    stamps = np.array(sorted(watch.states), dtype=np.int64)
    states = np.array([watch.states[t] for t in stamps.tolist()])
    for span in spans_of(stamps, states == "frozen"):
        message = f"pictures repeat an earlier one: {_when(span, t0_ns)}; they are not used"
        yield Fault("frozen_images", watch.name, message, "left_out", span.start_ns, span.end_ns, _counts(span))
    for span in spans_of(stamps, states == "black"):
        message = f"pictures show nothing (black, covered, of one color): {_when(span, t0_ns)}; they are not used"
        yield Fault("black_images", watch.name, message, "left_out", span.start_ns, span.end_ns, _counts(span))


def _lidar_faults(watch: LidarWatch, t0_ns: int) -> Iterator[Fault]:
    stamps = np.array(sorted(watch.points), dtype=np.int64)
    if len(stamps) == 0:
        return
    repeated = np.array([watch.repeated[t] for t in stamps.tolist()])
    for span in spans_of(stamps, repeated):
        message = f"sweeps repeat an earlier one: {_when(span, t0_ns)}; they are not used"
        yield Fault("repeated_sweeps", watch.name, message, "left_out", span.start_ns, span.end_ns, _counts(span))
    yield from _sparse_sweeps(watch.name, stamps, np.array([watch.points[t] for t in stamps.tolist()]), t0_ns)


def _sparse_sweeps(name: str, t_ns: NDArray[np.int64], points: NDArray[np.int64], t0_ns: int) -> Iterator[Fault]:
    """Mark the sweeps (F,) with next to no points, judged by what this LiDAR usually gives."""
    usual = float(np.quantile(points, USUAL_QUANTILE))
    if usual < MIN_USUAL_POINTS:
        message = f"sweeps have next to no points, at most {points.max()}"
        values = {"count": float(len(points)), "most_points": float(points.max())}
        yield Fault("sparse_sweeps", name, message, "kept", int(t_ns[0]), int(t_ns[-1]), values)
        return
    for span in spans_of(t_ns, points < MAX_SPARSE_SHARE * usual):
        inside = (t_ns >= span.start_ns) & (t_ns <= span.end_ns) & (points < MAX_SPARSE_SHARE * usual)
        most = int(points[inside].max())
        message = f"sweeps have at most {most} points where {usual:.0f} are usual: {_when(span, t0_ns)}"
        values = _counts(span) | {"most_points": float(most), "usual_points": usual}
        yield Fault("sparse_sweeps", name, message, "kept", span.start_ns, span.end_ns, values)


def _when(span: Span, t0_ns: int) -> str:
    """Say how many records a span holds, and when: "12 from 2.00 to 3.10 s"."""
    start_s, end_s = ((t - t0_ns) / NS_PER_S for t in (span.start_ns, span.end_ns))
    if span.total == 1:
        return f"1 at {start_s:.2f} s"
    counted = f"{span.count}" if span.count == span.total else f"{span.count} of {span.total}"
    return f"{counted} from {start_s:.2f} to {end_s:.2f} s"


def _counts(span: Span) -> dict[str, float]:
    return {"count": float(span.count)}
