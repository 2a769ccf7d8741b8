"""What came of a run: what each stage did, and what can be known of its quality without truth, as `report.json` holds it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from log2sim.agents.estimate import TOLERANCE_M
from log2sim.config import Config
from log2sim.datatypes import Agent, Finding, Log, Measurements, Scenario
from log2sim.files.documents import rounded
from log2sim.files.stages import StageClock
from log2sim.geometry import NS_PER_S
from log2sim.perception.first_pass import Observations
from log2sim.perception.homography_stage import CameraHomography
from log2sim.perception.sync import Schedule
from log2sim.plan import DESCRIBING, Decision, HomographyScope, Outcome, Plan, Stage
from log2sim.version import __version__


def stage_outcomes(
    plan: Plan,
    observations: Observations,
    homographies: Mapping[str, CameraHomography],
    agents: Sequence[Agent],
    clock: StageClock,
) -> tuple[Outcome, ...]:
    """Join the decisions of a plan with what the stages did, in the plan's order, but for those that describe the scenario."""
    found: Mapping[Stage, Callable[[Decision], Outcome]] = {
        Stage.MOTION_COMPENSATION: lambda d: _compensation(d, observations),
        Stage.DETECTION_IN_EVERY_FRAME: lambda d: _detection(d, plan.picture_stride, observations, clock),
        Stage.HOMOGRAPHY: lambda d: _homography(d, plan.homography, homographies),
        Stage.SMOOTHING_OF_STATIC_AGENTS: lambda d: _static(agents),
        Stage.WAYPOINT_AT_EVERY_TICK: lambda d: _waypoints(agents),
    }
    return tuple(found.get(d.stage, Outcome)(d) for d in plan.decisions if d.stage not in DESCRIBING)


def _compensation(planned: Decision, observations: Observations) -> Outcome:
    counts, total = observations.sweeps, sum(observations.sweeps.values())
    if not planned.kept or not total:
        return Outcome(planned)
    if counts["in the log"] == total:
        return Outcome(Decision(planned.stage, False, "the sweeps of the log are compensated already"))
    if counts["in the log"] + counts["no times"] == total:
        return Outcome(Decision(planned.stage, False, "the points have no times of their own"))
    if counts["at rest"]:
        reason = f"{planned.reason}; it stands still during {counts['at rest']} of {total} sweeps"
        return Outcome(Decision(planned.stage, counts["moving"] > 0, reason))
    return Outcome(planned)


def _detection(planned: Decision, picture_stride: int, observations: Observations, clock: StageClock) -> Outcome:
    seconds = clock.seconds
    skipped, detected = sum(observations.frames_skipped.values()), observations.frames_detected
    if planned.kept or not detected:
        return Outcome(planned)
    if not skipped:
        return Outcome(Decision(planned.stage, True, "no camera was empty long enough to skip a frame"))
    names = ", ".join(f"{name} {n}" for name, n in sorted(observations.frames_skipped.items()))
    reason = f"{skipped} of {skipped + detected} frames are between two in which nothing was found: {names}"
    if picture_stride > 1:
        reason = f"{planned.reason}; {skipped} of {skipped + detected} frames were not"
    each_s = (seconds.get("decode", 0.0) + seconds.get("detect", 0.0)) / max(detected, 1)
    how = f"estimated: {1e3 * each_s:.3g} ms a frame (measured on {detected}), times {skipped}"
    return Outcome(Decision(planned.stage, False, reason), round(skipped * each_s, 4), how)


def _homography(planned: Decision, scope: HomographyScope, homographies: Mapping[str, CameraHomography]) -> Outcome:
    if scope is HomographyScope.NONE:
        return Outcome(planned)
    if not homographies:
        return Outcome(Decision(planned.stage, False, "every detection has LiDAR points or no foot in the image"))
    return Outcome(Decision(planned.stage, True, f"{planned.reason}: {', '.join(homographies)}"))


def _static(agents: Sequence[Agent]) -> Outcome:
    static = sum(a.static for a in agents)
    reason = f"{static} of {len(agents)} agents are static: one pose for each" if static else "no agent is static"
    return Outcome(Decision(Stage.SMOOTHING_OF_STATIC_AGENTS, not static, reason))


def _waypoints(agents: Sequence[Agent]) -> Outcome:
    stage, left_out = Stage.WAYPOINT_AT_EVERY_TICK, sum(a.quality.get("waypoints_left_out", 0) for a in agents)
    if not left_out:
        return Outcome(Decision(stage, True, "no agent moves straight at constant speed"))
    total = left_out + sum(len(a.waypoints) for a in agents)
    reason = f"{left_out} of {total} lie within {TOLERANCE_M * 100:.0f} cm of the line between their neighbors"
    return Outcome(Decision(stage, False, reason))


DETECTOR_STAGES = ("detect",)


def report_of(
    log: Log,
    config: Config,
    schedule: Schedule,
    observations: Observations,
    measurements: Sequence[Measurements],
    homographies: Mapping[str, CameraHomography],
    outcomes: Sequence[Outcome],
    scenario: Scenario,
    clock: StageClock,
) -> dict[str, Any]:
    """Assemble what a report says of the stages of a finished run."""
    ticks = len(schedule)
    return {
        "report_version": 1,
        "log": {"name": log.name, "format": log.format, "digest": log.digest, "notes": list(log.notes)},
        "log2sim_version": __version__,
        "ticks": ticks,
        "duration_s": (int(schedule.t_ns[-1]) - int(schedule.t_ns[0])) / NS_PER_S,
        **_times(clock, ticks),
        "plan": [outcome.to_report() for outcome in outcomes],
        "sync": {"reference": schedule.reference, "streams": schedule.summary()},
        "without_pose": _without_pose(log, schedule),
        "detections": observations.detections,
        "homography": {name: _homography_entry(g, config.topdown.method) for name, g in homographies.items()},
        "measurements": _measurement_counts(measurements),
        "agents": _agent_counts(scenario),
    }


def _times(clock: StageClock, ticks: int) -> dict[str, Any]:
    """Return the seconds of a run so far, its rates, and the table of its stages."""
    total, detecting = clock.total(), sum(clock.seconds.get(stage, 0.0) for stage in DETECTOR_STAGES)
    return {
        "seconds": round(total, 4),
        "ticks_per_second": round(ticks / total, 3),
        "ticks_per_second_without_detector": round(ticks / max(total - detecting, 1e-9), 3),
        "stages": clock.table(ticks),
    }


def _without_pose(log: Log, schedule: Schedule) -> dict[str, int]:
    """Frames by camera that were left out because the ego's pose is not known at their stamp."""
    counts = {}
    for name, index in schedule.frames.items():
        known = log.map_T_sensor(name, log.streams[name].t_ns[index[index >= 0]])[1]
        if not known.all():
            counts[name] = int(np.sum(~known))
    return counts


def unused_records(report: Mapping[str, Any]) -> list[Finding]:
    """List what a run could not use of its log or keep for later runs, as its report says."""
    found = unreadable_records(report["unreadable"])
    found += [
        Finding("frames_without_pose", name, "left_out", values={"count": float(count)})
        for name, count in report["without_pose"].items()
    ]
    problem = (report["detection_cache"] or {}).get("problem")
    return [*found, *([Finding("not_cached", "cache", other=problem)] if problem else [])]


def unreadable_records(counted: Mapping[str, Any]) -> list[Finding]:
    """List the streams with records that could not be read, of their number and the first message by stream."""
    return [
        Finding("unreadable", name, "left_out", values={"count": float(entry["count"])}, other=entry["first"])
        for name, entry in counted.items()
    ]


def _homography_entry(ground: CameraHomography, method: str) -> dict[str, Any]:
    fit = ground.fit
    return {
        "method": method,
        "ok": fit.ok,
        "source": ground.source,
        "refused": ground.refusal or None,
        "correspondences": len(fit.inliers),
        "inliers": int(fit.inliers.sum()),
        "error_m": rounded(fit.error_m, 4),
        "jitter_m": rounded(fit.jitter_m, 4),
        "condition": rounded(fit.condition, 3),
        "pitch_roll": None if fit.pitch_roll is None else fit.pitch_roll.to_dict(),
    }


def _measurement_counts(measurements: Sequence[Measurements]) -> dict[str, Any]:
    by_tick = [rows.source == "lidar" for rows in measurements]
    return {"total": sum(map(len, by_tick)), "with_lidar": int(sum(np.sum(mask) for mask in by_tick))}


def _agent_counts(scenario: Scenario) -> dict[str, Any]:
    agents = scenario.others
    categories = sorted({a.category for a in agents})
    doubtful = {a.id: [doubt.to_dict() for doubt in a.doubts] for a in scenario.agents if a.is_doubtful}
    residuals = [
        a.quality["smoothing_residual_rms_m"] for a in agents if a.quality.get("smoothing_residual_rms_m") is not None
    ]
    return {
        "total": len(agents),
        "static": sum(a.static for a in agents),
        "by_category": {c: sum(a.category == c for a in agents) for c in categories},
        "smoothing_residual_median_m": rounded(float(np.median(residuals)), 4) if residuals else None,
        "doubtful": doubtful,
        "quarantined": [a.id for a in agents if a.quarantined],
    }
