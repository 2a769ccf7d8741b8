"""What a run took and what can be known of its quality without truth, as `report.json` holds it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from log2sim.config import Config
from log2sim.datatypes import Log, Measurements, Scenario
from log2sim.describe import Description
from log2sim.documents import rounded
from log2sim.geometry import NS_PER_S
from log2sim.outcome import Outcome, RunOutputs
from log2sim.perception.homography_stage import CameraHomography
from log2sim.perception.sync import Schedule
from log2sim.stage_clock import StageClock
from log2sim.version import __version__

DETECTOR_STAGES = ("detect",)


def report_of(
    log: Log,
    config: Config,
    schedule: Schedule,
    outputs: RunOutputs,
    outcomes: Sequence[Outcome],
    scenario: Scenario,
) -> dict[str, Any]:
    """Assemble the report of a finished run."""
    clock, observations = outputs.clock, outputs.observations
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
        "unreadable": observations.records.summary() if observations.records is not None else {},
        "detections": observations.detections,
        "homography": {name: _homography_entry(g, config.topdown.method) for name, g in outputs.homographies.items()},
        "measurements": _measurement_counts(outputs.measurements),
        "agents": _agent_counts(scenario),
    }


def extended_report(report: dict[str, Any], description: Description, clock: StageClock) -> dict[str, Any]:
    """Return the report of a run whose scenario was described since, with the times of all stages."""
    return {
        **report,
        **_times(clock, report["ticks"]),
        "plan": [*report["plan"], *(outcome.to_report() for outcome in description.outcomes)],
        "unreadable": {**description.reader.summary(), **report["unreadable"]},
        **description.figures,
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
