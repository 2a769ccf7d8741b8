"""What leaving out saved, in seconds: measured, or estimated from what the same work cost elsewhere in the run.

Costs that no part of the run can tell are taken from one probe each: one sweep, one tick, one short fit. Nothing here
changes a result.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from log2sim.agents.simplify import TOLERANCE_M
from log2sim.datatypes import Agent, Log, Stream, Waypoints
from log2sim.errors import RecordError
from log2sim.perception.first_pass import Observations
from log2sim.perception.fusion import fuse
from log2sim.perception.homography.camera_fit import fit_camera
from log2sim.perception.homography.correspondences import Correspondences
from log2sim.perception.homography.estimate import EstimationOptions
from log2sim.perception.homography_stage import CameraHomography
from log2sim.perception.lidar.cloud import deskew, transform_rigidly
from log2sim.perception.sync import Schedule
from log2sim.plan import Plan
from log2sim.stage_clock import Costs, StageClock

PROBED_CORRESPONDENCES = 200


def settle(
    plan: Plan,
    log: Log,
    schedule: Schedule,
    seen: Observations,
    grounds: Mapping[str, CameraHomography],
    agents: Sequence[Agent],
    clock: StageClock,
    costs: Costs,
) -> Plan:
    """The plan with what the run has shown could be left out, and with the seconds that it saved where they are known."""
    plan = _frames(plan, seen, clock)
    plan = _lidars(plan, log, schedule, seen, clock)
    plan = _images(plan, log, schedule)
    plan = _compensation(plan, log, seen)
    plan = _homographies(plan, seen, grounds, costs)
    plan = _fusion(plan, seen, len(schedule))
    plan = _parked(plan, costs)
    return _waypoints(plan, agents)


def seconds_of(work: Callable[[], object], repeats: int = 1) -> float:
    """Least seconds of a piece of work."""
    spent = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        spent.append(time.perf_counter() - start)
    return min(spent)


def _frames(plan: Plan, seen: Observations, clock: StageClock) -> Plan:
    count = sum(seen.frames_skipped.values())
    if not count:
        return plan
    names = ", ".join(f"{name} {n}" for name, n in sorted(seen.frames_skipped.items()))
    plan = plan.decided(
        "every frame",
        False,
        f"{count} of {count + seen.frames_detected} frames are between two looks that found nothing: {names}",
    )
    each = (clock.seconds.get("decode", 0.0) + clock.seconds.get("detect", 0.0)) / max(seen.frames_detected, 1)
    return plan.saved("every frame", count * each, _estimate(each, "a frame looked at", seen.frames_detected, count))


def _lidars(plan: Plan, log: Log, schedule: Schedule, seen: Observations, clock: StageClock) -> Plan:
    """A sweep out of reach is neither read nor put into a cloud; reading it is probed."""
    far = [s for name, s in log.streams.items() if name not in log.lidars and name not in log.cameras]
    if not far:
        return plan
    read = sum(seen.sweeps.values())
    each = clock.seconds.get("cloud", 0.0) / max(read, 1) + seconds_of(lambda: _read(far[0], 0))
    ticks = len(far) * len(schedule)
    return plan.saved("every LiDAR", ticks * each, _estimate(each, "a sweep, of which one was read", 1, ticks))


def _images(plan: Plan, log: Log, schedule: Schedule) -> Plan:
    """One frame is decoded to tell what decoding all would have cost; a log may as well have no images."""
    frames = sum(int((index >= 0).sum()) for index in schedule.frames.values())
    if plan.keeps("decode images") or not frames:
        return plan
    name, index = next((n, int(i[i >= 0][0])) for n, i in schedule.frames.items() if (i >= 0).any())
    images: list[object] = []
    each = seconds_of(lambda: images.append(_read(log.streams[name], index)))
    if images[0] is None:
        return plan
    return plan.saved("decode images", frames * each, _estimate(each, f"a frame of {name}", 1, frames))


def _compensation(plan: Plan, log: Log, seen: Observations) -> Plan:
    kinds, total = seen.sweeps, sum(seen.sweeps.values())
    if plan.keeps("compensate") and total:
        if kinds["in the map"] == total:
            return plan.decided("compensate", False, "the sweeps of the log are compensated already")
        if kinds["in the map"] + kinds["no times"] == total:
            return plan.decided("compensate", False, "the points have no times of their own")
        if kinds["at rest"]:
            reason = next(s.reason for s in plan.steps if s.stage == "compensate")
            kept = kinds["moving"] > 0
            plan = plan.decided("compensate", kept, f"{reason}; it rests during {kinds['at rest']} of {total} sweeps")
    left_out = kinds["at rest"] + kinds["left out"]
    if not left_out or seen.last_sweep is None:
        return plan
    name, sweep = seen.last_sweep
    if sweep.frame == "map" or sweep.t_ns is None or not len(sweep.t_ns):
        return plan
    t_ns = sweep.t_ns
    each = seconds_of(lambda: deskew(log, name, sweep, t_ns), 2) - seconds_of(
        lambda: transform_rigidly(log, name, sweep), 2
    )
    return plan.saved("compensate", left_out * each, _estimate(each, f"a sweep of {name}", 1, left_out))


def _homographies(plan: Plan, seen: Observations, grounds: Mapping[str, CameraHomography], costs: Costs) -> Plan:
    left_out = [c for c in plan.cameras if c not in grounds and (seen.feet.get(c) or seen.ground.get(c))]
    if not left_out:
        return plan
    each = costs.each("homography")
    if each is not None:
        return plan.saved(
            "homography",
            len(left_out) * each,
            _estimate(each, "a fitted camera", costs.count["homography"], len(left_out)),
        )
    known = [Correspondences.join([*seen.feet.get(c, []), *seen.ground.get(c, [])]) for c in left_out]
    most = max(known, key=lambda c: len(c.uv))
    if len(most.uv) < 4:
        return plan
    rows = np.linspace(0, len(most.uv) - 1, min(len(most.uv), PROBED_CORRESPONDENCES)).astype(np.intp)
    few = Correspondences(most.uv[rows], most.xy_ego[rows], most.tick[rows])
    rng = np.random.default_rng(0)
    each = seconds_of(lambda: fit_camera(few, Correspondences.join([]), EstimationOptions(), rng=rng)) / len(rows)
    count = sum(len(c.uv) for c in known)
    return plan.saved("homography", count * each, _estimate(each, "a correspondence in a short fit", len(rows), count))


def _fusion(plan: Plan, seen: Observations, ticks: int) -> Plan:
    rows = seen.busiest
    if plan.keeps("fuse") or rows is None or not len(rows):
        return plan
    each = seconds_of(lambda: fuse(rows), 2) - seconds_of(lambda: fuse(rows, across=False), 2)
    each *= float(np.mean([len(m) for m in seen.measurements])) / len(rows)
    return plan.saved("fuse", ticks * each, _estimate(each, "a tick, by the busiest one", 1, ticks))


def _parked(plan: Plan, costs: Costs) -> Plan:
    standing, moving = costs.count.get("standing", 0), costs.count.get("moving", 0)
    if not standing:
        return plan
    plan = plan.decided(
        "smooth parked agents", False, f"{standing} of {standing + moving} tracks stand still: one pose for each"
    )
    each, instead = costs.each("moving"), costs.each("standing")
    if each is None or instead is None:
        return plan
    how = _estimate(
        each - instead, f"a track, {1e3 * each:.1f} ms moving against {1e3 * instead:.1f} ms standing", moving, standing
    )
    return plan.saved("smooth parked agents", standing * (each - instead), how)


def _waypoints(plan: Plan, agents: Sequence[Agent]) -> Plan:
    left_out = sum(a.quality.get("waypoints_left_out", 0) for a in agents)
    if not left_out:
        return plan
    total = left_out + sum(len(a.waypoints) for a in agents)
    reason = f"{left_out} of {total} lie within {TOLERANCE_M * 100:.0f} cm of the line between their neighbors"
    row = [0.123456789] * (len(Waypoints.FLOATS) + 1)
    each = seconds_of(lambda: json.dumps([row] * 100)) / 100
    return plan.decided("every waypoint", False, reason).saved(
        "every waypoint", left_out * each, _estimate(each, "a waypoint to write", 100, left_out)
    )


def _estimate(each_s: float, of: str, measured: int, times: int) -> str:
    return f"estimated: {1e3 * max(each_s, 0.0):.3g} ms {of} (measured on {measured}), times {times}"


def _read(stream: Stream, index: int) -> object | None:
    try:
        record: object = stream.read(index)
    except RecordError:
        return None
    return record
