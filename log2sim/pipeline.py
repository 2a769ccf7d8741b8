"""The method on one page: a log in, a scenario and a report out (Bhardwaj & Kalra, and past it)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from log2sim.agents.candidate import Timeline
from log2sim.agents.confidence import rate_agents
from log2sim.agents.conflicts import extend_static
from log2sim.agents.estimate import (
    camera_entries,
    ego_agent,
    ego_path,
    estimate_agents,
    provenance_of,
    scenario_of,
    simplify,
    with_observers,
    with_pose_errors,
)
from log2sim.agents.evidence import Recording
from log2sim.agents.heading import decide_headings
from log2sim.agents.judge import judge
from log2sim.config import Config
from log2sim.datatypes import ENDS, Agent, Fault, Log, Measurements, Scenario, Track
from log2sim.errors import NothingToReconstruct
from log2sim.files.stages import StageClock
from log2sim.localization.choice import GIVEN, PoseChoice, localize
from log2sim.localization.mounts import check_calibration
from log2sim.localization.roadside import register_road
from log2sim.logs.checks import say_without_pose
from log2sim.perception.first_pass import Observations, observe
from log2sim.perception.fusion import fuse
from log2sim.perception.homography_stage import estimation_options, fit_homographies, place_by_homography
from log2sim.perception.run_detectors import Detectors, GivenDetector, create_detectors, sort_detectors
from log2sim.perception.sync import Schedule, synchronize
from log2sim.plan import FusionLevel, Plan, Sensors, Stage, choose_detector, make_plan, select_sensors
from log2sim.report import RunOutputs, extended_report, report_of, stage_outcomes
from log2sim.road.describe import Recorded, describe
from log2sim.tracking.tracker import mark_unrecorded, track_ends

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, eq=False)
class Result:
    """What came of a run.

    Attributes
    ----------
    scenario : Scenario
    report : dict
        A document of `schemas/report-1.json`.
    log : Log
        As it was used: with the poses that were chosen, without the LiDARs that are out of range.
    """

    scenario: Scenario
    report: dict[str, Any]
    log: Log

    def __repr__(self) -> str:
        """Return its scenario and its log in one line."""
        return f"<Result: {self.scenario!r} of {self.log!r}>"

    def _repr_html_(self) -> str | None:
        """Return what a notebook shows of its scenario."""
        return self.scenario._repr_html_()


@dataclass(frozen=True, eq=False)
class Run:
    """What the stages of one run share.

    Attributes
    ----------
    log : Log
        Without the LiDARs that are out of range.
    config : Config
    plan : Plan
    schedule : Schedule
        The ticks, and the frames and sweeps of each.
    detectors : Detectors
    clock : StageClock
    report_progress : callable
        Called as `report_progress(stage, done, total)`.
    poses : PoseChoice
        Where the poses of `log` come from.
    faults : tuple of Fault
        Of poses, clocks and mounts.
    registration : sequence of dict
        How the road's sensors were registered, one entry for each roadside unit.
    """

    log: Log
    config: Config
    plan: Plan
    schedule: Schedule
    detectors: Detectors
    clock: StageClock
    report_progress: Progress
    poses: PoseChoice = GIVEN
    faults: tuple[Fault, ...] = ()
    registration: Sequence[dict[str, Any]] = ()


def reconstruct(
    log: Log,
    config: Config | None = None,
    *,
    detector: GivenDetector | list[GivenDetector] | tuple[GivenDetector, ...] | None = None,
    progress: Progress | None = None,
    cache: bool = True,
) -> Result:
    """Reconstruct the scenario of a log.

    Parameters
    ----------
    log : Log
        From `open_log`.
    config : Config, optional
        Settings; the defaults without.
    detector : callable, Detector, LidarDetector, str or a list of two of them, optional
        Takes the place of `detect.name` in the settings. A function gets a picture, (H, W, 3) uint8 BGR, and returns rows of x0,
        y0, x1, y1 in px, score in [0, 1], category of `log2sim.datatypes.CATEGORIES`; or `Detections`. An object has the members of
        `log2sim.perception.detect.detectors.Detector` or, for LiDAR sweeps, of `log2sim.perception.detect3d.detectors.LidarDetector`.
        A name is one that `--detector` takes. A list joins one for pictures and one for sweeps, such as `[find_cars, "lidar:vehicle"]`.
    progress : callable, optional
        Called as `progress(stage, done, total)`; with a total of 0 when a stage of unknown length begins.
    cache : bool
        Whether what the detector finds in pictures is taken from the user's cache, and kept there.

    Raises
    ------
    LogError, ConfigError, MissingExtra
        For logs and settings that cannot work.
    PluginError
        When the detector fails, or returns something else.
    NothingToReconstruct
        When neither an ego nor any agent was found.
    """
    run = start(log, config or Config(), detector=detector, progress=progress, cache=cache)
    observations = first_pass(run)
    return look_around(run, observations, second_pass(run, observations))


def start(
    log: Log, config: Config, *, detector: Any = None, progress: Progress | None = None, cache: bool = True
) -> Run:
    """Choose the poses and the sensors, check their calibration, synchronize them, and plan the run."""
    given = sort_detectors(detector, config)
    config = given.config
    clock, report_progress = StageClock(), progress or (lambda *_: None)
    with clock.stage("poses"):
        log, poses = localize(log, config, progress=report_progress)
    config = choose_detector(log, config)
    sensors = select_sensors(log, config)
    with clock.stage("calibration"):
        log, faults = check_calibration(log, config, sensors, progress=report_progress)
        sensors = sensors.without([fault.sensor for fault in faults if fault.treatment == "left_out"])
    with clock.stage("registration"):
        road = register_road(log, config, sensors, progress=report_progress)
        log, sensors = road.log, sensors.without([f.sensor for f in road.faults if f.treatment == "left_out"])
    report_progress("load", 0, 0)
    detectors = create_detectors(sensors.restrict(log), config, given, cache=cache)
    with clock.stage("sync"):
        schedule = schedule_of(log, config, sensors)
    plan = make_plan(log, config, sensors, schedule.t_ns)
    faults = (*poses.faults, *faults, *road.faults)
    return Run(
        sensors.restrict(log), config, plan, schedule, detectors, clock, report_progress, poses, faults, road.figures
    )


def schedule_of(log: Log, config: Config, sensors: Sensors) -> Schedule:
    """Synchronize the sensors of a run."""
    return synchronize(
        sensors.restrict(log),
        sensors.cameras,
        reference=config.sync.reference,
        max_residual_s=config.sync.max_residual_s,
        start_s=config.start_s,
        stop_s=config.stop_s,
    )


def first_pass(run: Run) -> Observations:
    """Detect and measure, tick by tick."""
    run.report_progress("detect and measure", 0, len(run.schedule))
    return observe(
        run.log,
        run.schedule,
        run.detectors.images,
        run.plan,
        mode=run.config.measure.mode,
        max_range_m=run.config.measure.max_range_m,
        clock=run.clock,
        progress=lambda done, total: run.report_progress("detect and measure", done, total),
        lidar_detector=run.detectors.sweeps,
        sweeps=run.config.lidar.sweeps,
        cache=run.detectors.cache,
    )


def second_pass(run: Run, observations: Observations) -> Result:
    """Go on from the observations, which stay as they are, to the scenario and the report."""
    log, config, plan, t_ns = run.log, run.config, run.plan, run.schedule.t_ns
    with run.clock.stage("topdown"):
        rng = np.random.default_rng(config.seed)
        homographies = fit_homographies(log, observations, plan, estimation_options(config.topdown), rng=rng)
        placed = place_by_homography(log, observations, homographies)
    with run.clock.stage("fuse"):
        across = plan.keeps(Stage.FUSION) or plan.keeps(Stage.FUSION_WITH_LIDAR)
        ends = [fuse(of_end, across=across) for of_end in split_by_end(placed, plan)]
        measurements = ends[0] if len(ends) == 1 else [Measurements.join(rows) for rows in zip(*ends)]
    with run.clock.stage("track", run.report_progress):
        tracks = track_ends(
            ends,
            t_ns,
            birth_score=config.track.birth_score,
            max_gap_s=config.track.max_gap_s,
            min_life_s=config.track.min_life_s,
        )
        tracks = mark_unrecorded(tracks, observations.recorded(run.schedule))
    ego, agents = agents_of(run, tracks, observations)
    if ego is None and not agents:
        raise NothingToReconstruct(
            f"{log.name}: {say_without_pose(log, t_ns)}, and no object was detected in {len(t_ns)} ticks"
        )
    return result_of(run, ego, RunOutputs(observations, measurements, homographies, tuple(agents), run.clock))


def split_by_end(measurements: Sequence[Measurements], plan: Plan) -> list[Sequence[Measurements]]:
    """Return the measurements by tick of what is tracked together: each end where tracks are joined, else everything."""
    if plan.fusion is not FusionLevel.TRACKS:
        return [measurements]
    return [[rows.take(rows.seen_by[:, k]) for rows in measurements] for k in range(len(ENDS))]


def agents_of(run: Run, tracks: Sequence[Track], observations: Observations) -> tuple[Agent | None, list[Agent]]:
    """Make agents of tracks, judged and rated together; the ego, if its poses are known, is returned separately."""
    log, t_ns = run.log, run.schedule.t_ns
    timeline = Timeline(t_ns, int(t_ns[0]))
    with run.clock.stage("smooth", run.report_progress):
        candidates = estimate_agents(tracks, observations.obstacles, timeline, smooth=run.config.smooth.enabled)
        candidates = decide_headings(candidates, ego_path(log, run.schedule), timeline)
        ego = ego_agent(log, timeline, run.poses.origin)
    with run.clock.stage("judge", run.report_progress):
        seen = run.schedule.without_frames(observations.unseen)
        recording = Recording(log, seen, observations.obstacles, timeline)
        judged = judge(candidates, ego, recording)
        rated = rate_agents(judged, timeline, lidar=bool(log.lidars))
        agents = [with_observers(c, with_pose_errors(c.agent, log, timeline), timeline) for c in rated]
        if run.config.track.static_for_all:
            agents = extend_static(agents, ego, observations.obstacles, timeline)
        limit = run.config.track.quarantine_confidence
        agents = [replace(a, quarantined=True) if a.confidence < limit else a for a in agents]
        # Without an ego the agents' waypoints alone hold the ticks, so all of them stay.
        return ego, simplify(agents) if ego is not None else agents


def result_of(run: Run, ego: Agent | None, outputs: RunOutputs) -> Result:
    """Assemble the scenario and the report of a run."""
    log, config, t_ns = run.log, run.config, run.schedule.t_ns
    outcomes = stage_outcomes(run.plan, outputs)
    faults = [fault.to_dict(int(t_ns[0])) for fault in (*run.faults, *outputs.observations.faults)]
    scenario = scenario_of(
        log,
        t_ns,
        [ego, *outputs.agents] if ego is not None else outputs.agents,
        cameras=camera_entries(log, run.plan.cameras, outputs.homographies),
        stages=[outcome.to_dict() for outcome in outcomes],
        provenance={
            **provenance_of(log, config, run.detectors.name, run.poses.to_provenance()),
            **({"faults": faults} if faults else {}),
        },
    )
    report = report_of(log, config, run.schedule, outputs, outcomes, scenario)
    added = {"poses": run.poses.to_dict(), "faults": faults, "registration": list(run.registration)}
    cached = {"detection_cache": None if run.detectors.cache is None else run.detectors.cache.figures()}
    return Result(scenario, {**report, **added, **cached}, log)


def look_around(run: Run, observations: Observations, result: Result) -> Result:
    """Describe the scenario of a run: lanes, colors of vehicles, traffic lights."""
    used = run.log.changed(cameras={name: run.log.cameras[name] for name in run.plan.cameras})
    recorded = Recorded(used, run.config, run.plan, observations, run.clock, run.report_progress)
    description = describe(result.scenario, recorded)
    stages = [*result.scenario.stages, *(outcome.to_dict() for outcome in description.outcomes)]
    scenario = replace(description.scenario, stages=tuple(stages))
    return replace(result, scenario=scenario, report=extended_report(result.report, description, run.clock))
