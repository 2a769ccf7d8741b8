"""What came of a run: what each stage did, and what can be known of its quality without truth, as `report.json` holds it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from log2sim.agents.estimate import TOLERANCE_M
from log2sim.config import Config
from log2sim.datatypes import Agent, Finding, Log, Measurements, Scenario
from log2sim.errors import NothingToReconstruct
from log2sim.files.documents import rounded
from log2sim.files.stages import StageClock
from log2sim.files.version import __version__
from log2sim.geometry import NS_PER_S, Array, apply, inverse, undistort
from log2sim.localization.choice import GIVEN, PoseChoice
from log2sim.perception.first_pass import Observations
from log2sim.perception.homography_stage import CameraHomography
from log2sim.perception.records import RecordSource
from log2sim.perception.run_cache import StageCache
from log2sim.perception.run_detectors import Detectors
from log2sim.perception.sync import Schedule
from log2sim.plan import DESCRIBING, Decision, HomographyScope, Plan, Stage, explain_missing_poses

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, eq=False)
class Run:
    """What the stages of one run share: the sensors in one map and on one clock, the ticks, and the plan.

    `poses` says where the poses of `log` come from, `faults` what is wrong with poses, clocks and mounts, and
    `registration` how each roadside unit was registered. `progress` is called as `progress(stage, done, total)`. `jobs` is the number
    of processes that share the work. `earlier` knows what stages of earlier runs made; None to do all again.
    """

    log: Log
    config: Config
    plan: Plan
    schedule: Schedule
    detectors: Detectors
    clock: StageClock
    progress: Progress
    jobs: int = 1
    poses: PoseChoice = GIVEN
    faults: tuple[Finding, ...] = ()
    registration: Sequence[dict[str, Any]] = ()
    earlier: StageCache | None = None


@dataclass(frozen=True, eq=False)
class Result:
    """What came of a run: the scenario, a report as of `schemas/report-1.json`, the log as it was used, and what is wrong with it."""

    scenario: Scenario
    report: dict[str, Any]
    log: Log
    findings: tuple[Finding, ...]  # of poses, sensors and records; those of agents are their doubts

    def __repr__(self) -> str:
        """Return its scenario and its log in one line."""
        return f"<Result: {self.scenario!r} of {self.log!r}>"

    def _repr_html_(self) -> str | None:
        """Return what a notebook shows of its scenario."""
        return self.scenario._repr_html_()


def draft_scenario(
    run: Run, observations: Observations, homographies: Mapping[str, CameraHomography], agents: Sequence[Agent]
) -> Scenario:
    """Put agents, the ego among them, and sensors into a scenario with its provenance; raises `NothingToReconstruct` without agents."""
    log, config, t_ns = run.log, run.config, run.schedule.t_ns
    if not agents:
        reason = explain_missing_poses(log, t_ns)
        raise NothingToReconstruct(f"{log.name}: {reason}, and no object was detected in {len(t_ns)} ticks")
    faults = [fault.to_dict() for fault in (*run.faults, *observations.faults)]
    return Scenario(
        name=log.name,
        t0_ns=int(t_ns[0]),
        duration_s=float((t_ns[-1] - t_ns[0]) / NS_PER_S),
        agents=tuple(agents),
        map=log.map,
        cameras=tuple(camera_entries(log, run.plan.cameras, homographies)),
        sensors=roadside_sensors(log, config.measure.max_range_m),
        provenance={
            "log": {"name": log.name, "format": log.format, "digest": log.digest},
            "log2sim_version": __version__,
            "detector": run.detectors.name,
            "poses": dict(run.poses.to_provenance()),
            "config": config.to_dict(),
            "seed": config.seed,
            "history": ["reconstruct"],
            **({"faults": faults} if faults else {}),
        },
    )


# Neighboring directions of LiDARs are less than a degree apart; a mast next to one hides a few degrees more.
MIN_BLIND_RAD = math.radians(5.0)
# Sweeps of which directions are taken, over the whole log.
VIEW_SWEEPS = 3


def roadside_sensors(log: Log, range_m: float) -> tuple[dict[str, Any], ...]:
    """Return the sensors that are fixed in the map, as a scenario states them.

    A camera looks where the rays of its middle row and column go, a LiDAR where it measured points.
    """
    mounts = [(name, "camera", c.mount_T_cam) for name, c in log.cameras.items() if c.mount == "map"]
    mounts += [(name, "lidar", lidar.mount_T_lidar) for name, lidar in log.lidars.items() if lidar.mount == "map"]
    entries = []
    for name, kind, map_T_sensor in mounts:
        rays_map = (_camera_rays(log, name) if kind == "camera" else _lidar_rays(log, name)) @ map_T_sensor[:3, :3].T
        yaw_rad, fov_rad = _view_of(np.arctan2(rays_map[:, 1], rays_map[:, 0]))
        place = dict(zip(("x_m", "y_m", "z_m"), map_T_sensor[:3, 3].tolist()))
        look = {"yaw_rad": yaw_rad, "fov_rad": fov_rad, "range_m": range_m}
        entries.append({"name": name, "kind": kind, **place, **look})
    return tuple(entries)


def _camera_rays(log: Log, name: str) -> Array:
    """Return rays (N, 3), cam frame, of pixels in the middle row and column that the lens model explains."""
    camera = log.cameras[name]
    u, v = np.linspace([0.0, 0.0], [camera.width_px, camera.height_px], 65).T
    row = np.column_stack([u, np.full_like(u, camera.height_px / 2)])
    column = np.column_stack([np.full_like(v, camera.width_px / 2), v])
    xy = undistort(camera, np.concatenate([row, column]))
    xy = xy[np.isfinite(xy).all(axis=1)]
    return np.column_stack([xy, np.ones(len(xy))])


def _lidar_rays(log: Log, name: str) -> Array:
    """Return rays (N, 3), lidar frame, to the points of some sweeps of a LiDAR that is fixed in the map."""
    records, count = RecordSource(log), len(log.streams[name].t_ns)
    lidar_T_map = inverse(log.lidars[name].mount_T_lidar)
    rays = [np.zeros((0, 3))]
    for i in np.unique(np.linspace(0, count, VIEW_SWEEPS, endpoint=False).astype(int))[:count]:
        sweep = records.get(name, int(i))
        if sweep is None:
            continue  # the stages before have reported it
        xyz = np.asarray(sweep.xyz_m, dtype=np.float64)
        rays.append(apply(lidar_T_map, xyz) if sweep.frame == "map" else xyz)
    return np.concatenate(rays)


def _view_of(azimuth_rad: Array) -> tuple[float, float]:
    """Return middle and width, rad, of the narrowest field of view that holds azimuths (N,); all around where there are not two."""
    azimuth = np.unique(azimuth_rad % (2 * math.pi))
    if len(azimuth) < 2:
        return 0.0, 2 * math.pi
    gap = np.diff(azimuth, append=azimuth[0] + 2 * math.pi)
    widest = int(gap.argmax())
    if gap[widest] < MIN_BLIND_RAD:
        return 0.0, 2 * math.pi
    middle = azimuth[widest] + gap[widest] / 2 + math.pi
    return math.remainder(float(middle), 2 * math.pi), float(2 * math.pi - gap[widest])


def camera_entries(log: Log, used: Sequence[str], homographies: Mapping[str, CameraHomography]) -> list[dict[str, Any]]:
    """Return the cameras of a log with their homographies, as a scenario states them."""
    entries = []
    for name in log.cameras:
        ground, homography = homographies.get(name), None
        if ground is not None and ground.fit.ok:
            fit = ground.fit
            homography = {
                "ground_H_image": fit.ground_H_image.tolist(),
                "source": ground.source,
                "inliers": int(fit.inliers.sum()),
                "correspondences": len(fit.inliers),
                "error_m": float(fit.error_m) if np.isfinite(fit.error_m) else None,
                "condition": float(fit.condition),
                "pitch_roll": None if fit.pitch_roll is None else fit.pitch_roll.to_dict(),
            }
        entries.append({"name": name, "used": name in used, "homography": homography})
    return entries


def conclude(
    run: Run,
    observations: Observations,
    measurements: Sequence[Measurements],
    homographies: Mapping[str, CameraHomography],
    described: tuple[Scenario, Sequence[Decision], Mapping[str, Any]],
) -> Result:
    """Join the plan and what became of it to the report of a finished run, and write what each stage did into its scenario.

    `measurements`: by tick. `described`: what `describe` returns.
    """
    log, config, schedule, clock = run.log, run.config, run.schedule, run.clock
    scenario, decisions, figures = described
    found: Mapping[Stage, Callable[[Decision], Decision]] = {
        Stage.MOTION_COMPENSATION: lambda d: _compensation(d, observations),
        Stage.DETECTION_IN_EVERY_FRAME: lambda d: _detection(d, run.plan.picture_stride, observations, clock),
        Stage.HOMOGRAPHY: lambda d: _homography(d, run.plan.homography, homographies),
        Stage.SMOOTHING_OF_STATIC_AGENTS: lambda d: _static(scenario.others),
        Stage.WAYPOINT_AT_EVERY_TICK: lambda d: _waypoints(scenario.others),
    }
    planned = (d for d in run.plan.decisions if d.stage not in DESCRIBING)
    stages = (*(found[d.stage](d) if d.stage in found else d for d in planned), *decisions)
    scenario = replace(scenario, stages=tuple(stage.to_dict() for stage in stages))
    from_lidar = [rows.source == "lidar" for rows in measurements]
    report = {
        "report_version": 1,
        "log": {"name": log.name, "format": log.format, "digest": log.digest, "notes": list(log.notes)},
        "log2sim_version": __version__,
        "ticks": len(schedule),
        "duration_s": (int(schedule.t_ns[-1]) - int(schedule.t_ns[0])) / NS_PER_S,
        **_times(clock, len(schedule)),
        "plan": [stage.to_report() for stage in stages],
        "sync": {"reference": schedule.reference, "streams": schedule.summary()},
        "without_pose": _frames_without_pose(log, schedule),
        "detections": observations.detections,
        "homography": {name: _homography_entry(g, config.topdown.method) for name, g in homographies.items()},
        "measurements": {"total": sum(map(len, from_lidar)), "with_lidar": int(sum(map(np.sum, from_lidar)))},
        "agents": _agent_counts(scenario),
        **figures,
        "unreadable": observations.unreadable,
        "poses": run.poses.to_dict(),
        "faults": [fault.to_dict() for fault in (*run.faults, *observations.faults)],
        "registration": list(run.registration),
        "detection_cache": None if run.earlier is None else run.earlier.figures(run.detectors.cache),
    }
    return Result(scenario, report, log, (*run.poses.findings, *run.faults, *observations.faults))


def _compensation(planned: Decision, observations: Observations) -> Decision:
    counts, total = observations.sweeps, sum(observations.sweeps.values())
    if not planned.kept or not total:
        return planned
    if counts["in the log"] == total:
        return Decision(planned.stage, False, "the sweeps of the log are compensated already")
    if counts["in the log"] + counts["no times"] == total:
        return Decision(planned.stage, False, "the points have no times of their own")
    if counts["at rest"]:
        reason = f"{planned.reason}; it stands still during {counts['at rest']} of {total} sweeps"
        return Decision(planned.stage, counts["moving"] > 0, reason)
    return planned


def _detection(planned: Decision, picture_stride: int, observations: Observations, clock: StageClock) -> Decision:
    seconds = clock.seconds
    skipped, detected = sum(observations.frames_skipped.values()), observations.frames_detected
    if planned.kept or not detected:
        return planned
    if not skipped:
        return Decision(planned.stage, True, "no camera was empty long enough to skip a frame")
    names = ", ".join(f"{name} {n}" for name, n in sorted(observations.frames_skipped.items()))
    reason = f"{skipped} of {skipped + detected} frames are between two in which nothing was found: {names}"
    if picture_stride > 1:
        reason = f"{planned.reason}; {skipped} of {skipped + detected} frames were not"
    each_s = (seconds.get("decode", 0.0) + seconds.get("detect", 0.0)) / max(detected, 1)
    how = f"estimated: {1e3 * each_s:.3g} ms a frame (measured on {detected}), times {skipped}"
    return Decision(planned.stage, False, reason, round(skipped * each_s, 4), how)


def _homography(planned: Decision, scope: HomographyScope, homographies: Mapping[str, CameraHomography]) -> Decision:
    if scope is HomographyScope.NONE:
        return planned
    if not homographies:
        return Decision(planned.stage, False, "every detection has LiDAR points or no foot in the image")
    return Decision(planned.stage, True, f"{planned.reason}: {', '.join(homographies)}")


def _static(agents: Sequence[Agent]) -> Decision:
    static = sum(a.static for a in agents)
    reason = f"{static} of {len(agents)} agents are static: one pose for each" if static else "no agent is static"
    return Decision(Stage.SMOOTHING_OF_STATIC_AGENTS, not static, reason)


def _waypoints(agents: Sequence[Agent]) -> Decision:
    stage, left_out = Stage.WAYPOINT_AT_EVERY_TICK, sum(a.quality.get("waypoints_left_out", 0) for a in agents)
    if not left_out:
        return Decision(stage, True, "no agent moves straight at constant speed")
    total = left_out + sum(len(a.waypoints) for a in agents)
    reason = f"{left_out} of {total} lie within {TOLERANCE_M * 100:.0f} cm of the line between their neighbors"
    return Decision(stage, False, reason)


DETECTOR_STAGES = ("detect",)


def _times(clock: StageClock, ticks: int) -> dict[str, Any]:
    """Return the seconds of a run so far, its rates, and the table of its stages."""
    total, detecting = clock.total(), sum(clock.seconds.get(stage, 0.0) for stage in DETECTOR_STAGES)
    return {
        "seconds": round(total, 4),
        "ticks_per_second": round(ticks / total, 3),
        "ticks_per_second_without_detector": round(ticks / max(total - detecting, 1e-9), 3),
        "stages": clock.table(ticks),
    }


def _frames_without_pose(log: Log, schedule: Schedule) -> dict[str, int]:
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
