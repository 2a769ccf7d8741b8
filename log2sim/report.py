"""What came of a run: what each stage did, and what can be known of its quality without truth, as `report.json` holds it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from log2sim.agents.estimate import TOLERANCE_M
from log2sim.config import Config
from log2sim.datatypes import Agent, Finding, Lidar, Log, Measurements, Scenario
from log2sim.errors import NothingToReconstruct
from log2sim.files.documents import rounded
from log2sim.files.stages import StageClock
from log2sim.files.version import __version__
from log2sim.geometry import NS_PER_S, Array, Camera, apply, inverse, undistort
from log2sim.localization.choice import GIVEN, PoseChoice
from log2sim.perception.first_pass import Observations
from log2sim.perception.homography_stage import CameraHomography
from log2sim.perception.records import RecordSource
from log2sim.perception.run_detectors import Detectors, StageCache
from log2sim.perception.sync import Schedule
from log2sim.plan import DESCRIBING, Decision, HomographyScope, Plan, Stage, explain_missing_poses

if TYPE_CHECKING:
    from distributed import Client

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, eq=False)
class Run:
    """What the stages of one run share: the sensors in one map and on one clock, the ticks, and the plan.

    `poses` says where the poses of `log` come from, `faults` what is wrong with poses, clocks and mounts, and
    `registration` how each roadside unit was registered. `progress` is called as `progress(stage, done, total)`. `jobs` is the number
    of processes that share the work; workers of the scheduler of `client`, if there is one, share the first pass. `earlier` knows
    what stages of earlier runs made; None to do all again.
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
    client: Client | None = None


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
    # The cameras of a log with their homographies, as a scenario states them
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
                "slope": None if fit.slope is None else fit.slope.to_dict(),
            }
        entries.append({"name": name, "used": name in run.plan.cameras, "homography": homography})
    return Scenario(
        name=log.name,
        t0_ns=int(t_ns[0]),
        duration_s=float((t_ns[-1] - t_ns[0]) / NS_PER_S),
        agents=tuple(agents),
        map=log.map,
        cameras=tuple(entries),
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
    records, entries = RecordSource(log), []
    sensors: list[Camera | Lidar] = [*log.cameras.values(), *log.lidars.values()]
    for sensor in (sensor for sensor in sensors if sensor.mount == "map"):
        rays = [np.zeros((0, 3))]
        if isinstance(sensor, Camera):
            # Pixels in the middle row and column that the lens model explains.
            map_T_sensor, width, height = sensor.mount_T_cam, sensor.width_px, sensor.height_px
            u, v = np.linspace([0.0, 0.0], [width, height], 65).T
            row = np.column_stack([u, np.full_like(u, height / 2)])
            column = np.column_stack([np.full_like(v, width / 2), v])
            xy = undistort(sensor, np.concatenate([row, column]))
            xy = xy[np.isfinite(xy).all(axis=1)]
            rays.append(np.column_stack([xy, np.ones(len(xy))]))
        else:
            map_T_sensor, count = sensor.mount_T_lidar, len(log.streams[sensor.name].t_ns)
            for i in np.unique(np.linspace(0, count, VIEW_SWEEPS, endpoint=False).astype(int))[:count]:
                sweep = records.get(sensor.name, int(i))
                if sweep is not None:  # the stages before have reported it
                    xyz = np.asarray(sweep.xyz_m, dtype=np.float64)
                    rays.append(apply(inverse(map_T_sensor), xyz) if sweep.frame == "map" else xyz)
        rays_map = np.concatenate(rays) @ map_T_sensor[:3, :3].T
        yaw_rad, fov_rad = _view_of(np.arctan2(rays_map[:, 1], rays_map[:, 0]))
        kind = "camera" if isinstance(sensor, Camera) else "lidar"
        place = dict(zip(("x_m", "y_m", "z_m"), map_T_sensor[:3, 3].tolist()))
        look = {"yaw_rad": yaw_rad, "fov_rad": fov_rad, "range_m": range_m}
        entries.append({"name": sensor.name, "kind": kind, **place, **look})
    return tuple(entries)


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
    log, schedule, clock, ticks = run.log, run.schedule, run.clock, len(run.schedule)
    scenario, decisions, figures = described
    planned = (d for d in run.plan.decisions if d.stage not in DESCRIBING)
    stages = (*(_turned_out(d, run, observations, homographies, scenario.others) for d in planned), *decisions)
    scenario = replace(scenario, stages=tuple(stage.to_dict() for stage in stages))
    from_lidar = [rows.source == "lidar" for rows in measurements]
    total_s, detecting_s = clock.total(), clock.seconds.get("detect", 0.0)
    without_pose: dict[str, int] = {}
    for name, index in schedule.frames.items():
        known = log.map_T_sensor(name, log.streams[name].t_ns[index[index >= 0]])[1]
        without_pose |= {} if known.all() else {name: int(np.sum(~known))}
    agents = scenario.others
    categories = sorted({a.category for a in agents})
    known_m = [m for a in agents if (m := a.quality.get("smoothing_residual_rms_m")) is not None]
    report = {
        "report_version": 1,
        "log": {"name": log.name, "format": log.format, "digest": log.digest, "notes": list(log.notes)},
        "log2sim_version": __version__,
        "ticks": ticks,
        "duration_s": (int(schedule.t_ns[-1]) - int(schedule.t_ns[0])) / NS_PER_S,
        "seconds": round(total_s, 4),
        "ticks_per_second": round(ticks / total_s, 3),
        "ticks_per_second_without_detector": round(ticks / max(total_s - detecting_s, 1e-9), 3),
        "stages": clock.table(ticks),
        "plan": [{**stage.to_dict(), "saved_s": stage.saved_s, "saved_how": stage.saved_how} for stage in stages],
        "sync": {"reference": schedule.reference, "streams": schedule.summary()},
        "without_pose": without_pose,
        "detections": observations.detections,
        "homography": {name: _homography_entry(g, run.config.topdown.method) for name, g in homographies.items()},
        "measurements": {"total": sum(map(len, from_lidar)), "with_lidar": int(sum(map(np.sum, from_lidar)))},
        "agents": {
            "total": len(agents),
            "static": sum(a.static for a in agents),
            "by_category": {c: sum(a.category == c for a in agents) for c in categories},
            "smoothing_residual_median_m": rounded(float(np.median(known_m)), 4) if known_m else None,
            "doubtful": {a.id: [doubt.to_dict() for doubt in a.doubts] for a in scenario.agents if a.is_doubtful},
            "quarantined": [a.id for a in agents if a.quarantined],
        },
        **figures,
        "unreadable": observations.unreadable,
        "poses": run.poses.to_dict(),
        "faults": [fault.to_dict() for fault in (*run.faults, *observations.faults)],
        "registration": list(run.registration),
        "detection_cache": None if run.earlier is None else run.earlier.figures(run.detectors.cache),
    }
    return Result(scenario, report, log, (*run.poses.findings, *run.faults, *observations.faults))


def _turned_out(
    planned: Decision, run: Run, observations: Observations, homographies: Mapping[str, CameraHomography], agents: Sequence[Agent]
) -> Decision:  # fmt: skip
    """Return a decision as the data turned out."""
    stage = planned.stage
    if stage is Stage.MOTION_COMPENSATION and planned.kept:
        counts, total = observations.sweeps, sum(observations.sweeps.values())
        if total and counts["in the log"] == total:
            return Decision(stage, False, "the sweeps of the log are compensated already")
        if total and counts["in the log"] + counts["no times"] == total:
            return Decision(stage, False, "the points have no times of their own")
        if total and counts["at rest"]:
            reason = f"{planned.reason}; it stands still during {counts['at rest']} of {total} sweeps"
            return Decision(stage, counts["moving"] > 0, reason)
    if stage is Stage.DETECTION_IN_EVERY_FRAME and not planned.kept and observations.frames_detected:
        skipped, detected = sum(observations.frames_skipped.values()), observations.frames_detected
        if not skipped:
            return Decision(stage, True, "no camera was empty long enough to skip a frame")
        count = f"{skipped} of {skipped + detected} frames"
        names = ", ".join(f"{name} {n}" for name, n in sorted(observations.frames_skipped.items()))
        reason = f"{count} are between two in which nothing was found: {names}"
        if run.plan.picture_stride > 1:
            reason = f"{planned.reason}; {count} were not"
        each_s = sum(run.clock.seconds.get(step, 0.0) for step in ("decode", "detect")) / detected
        how = f"estimated: {1e3 * each_s:.3g} ms a frame (measured on {detected}), times {skipped}"
        return Decision(stage, False, reason, round(skipped * each_s, 4), how)
    if stage is Stage.HOMOGRAPHY and run.plan.homography is not HomographyScope.NONE:
        if not homographies:
            return Decision(stage, False, "every detection has LiDAR points or no foot in the image")
        return Decision(stage, True, f"{planned.reason}: {', '.join(homographies)}")
    if stage is Stage.SMOOTHING_OF_STATIC_AGENTS:
        static = sum(a.static for a in agents)
        reason = f"{static} of {len(agents)} agents are static: one pose for each" if static else "no agent is static"
        return Decision(stage, not static, reason)
    if stage is Stage.WAYPOINT_AT_EVERY_TICK:
        left_out = sum(a.quality.get("waypoints_left_out", 0) for a in agents)
        if not left_out:
            return Decision(stage, True, "no agent moves straight at constant speed")
        total = left_out + sum(len(a.waypoints) for a in agents)
        reason = f"{left_out} of {total} lie within {TOLERANCE_M * 100:.0f} cm of the line between their neighbors"
        return Decision(stage, False, reason)
    return planned


def unused_records(report: Mapping[str, Any]) -> list[Finding]:
    """List what a run could not use of its log or keep for later runs, as its report says."""
    lost = report["without_pose"].items()
    found = [Finding("frames_without_pose", name, "left_out", values={"count": float(n)}) for name, n in lost]
    problem = (report["detection_cache"] or {}).get("problem")
    not_cached = [Finding("not_cached", "cache", other=problem)] if problem else []
    return [*unreadable_records(report["unreadable"]), *found, *not_cached]


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
        "slope": None if fit.slope is None else fit.slope.to_dict(),
    }
