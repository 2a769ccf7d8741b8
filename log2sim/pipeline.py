"""The method on one page: a log in, a scenario and a report out (Bhardwaj & Kalra, and past it)."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from log2sim.agents import estimate
from log2sim.agents.candidate import Timeline
from log2sim.agents.evidence import Recording, clutter_nats
from log2sim.agents.heading import decide_headings
from log2sim.agents.judge import extend_static, judge
from log2sim.config import Config
from log2sim.datatypes import Finding, Log
from log2sim.errors import ConfigError
from log2sim.files.cluster import client_of
from log2sim.files.processes import default_jobs
from log2sim.files.stages import StageClock
from log2sim.geometry import PoseTrack
from log2sim.localization.choice import localize, refine_for_map
from log2sim.localization.given_poses import list_faults
from log2sim.localization.mounts import check_calibration
from log2sim.localization.roadside import register_road
from log2sim.perception.first_pass import Observations, observe
from log2sim.perception.fusion import fuse
from log2sim.perception.homography_stage import fit_homographies, place_by_homography
from log2sim.perception.run_detectors import GivenDetector, StageCache, create_detectors, open_store, sort_detectors
from log2sim.perception.sync import schedule_of
from log2sim.plan import choose_detector, make_plan, select_sensors
from log2sim.report import Progress, Result, Run, conclude, draft_scenario
from log2sim.road.describe import describe
from log2sim.tracking.tracker import mark_unrecorded, track

LATER = ("topdown", "track", "smooth", "map", "appearance")  # settings of stages after the first pass


def reconstruct(
    log: Log,
    config: Config | None = None,
    *,
    detector: GivenDetector | list[GivenDetector] | tuple[GivenDetector, ...] | None = None,
    progress: Progress | None = None,
    cache: bool = True,
    jobs: int | None = None,
    scheduler: str | None = None,
) -> Result:
    """Reconstruct the scenario of a log.

    `detector`: in place of `detect.name` of `config`. A function gets a picture, (H, W, 3) uint8 BGR, and returns rows of x0, y0, x1,
    y1 in px, score in [0, 1], category of `log2sim.datatypes.CATEGORIES`; or `Detections`. An object is a `Detector` of
    `perception.detect.detectors` or, for sweeps, a `LidarDetector` of `perception.detect3d.detectors`; a name one that `--detector`
    takes. A list joins one for pictures and one for sweeps, such as `[find_cars, "lidar:vehicle"]`. `progress`: called as
    `progress(stage, done, total)`, with a total of 0 when a stage of unknown length begins. `cache`: whether what is detected and
    measured is taken from the user's cache, and kept there. `jobs`: processes that share the work, with the same result; None for
    all usable cores, or one with a detector from elsewhere, which need not work in a forked process. `scheduler`: address of a Dask
    scheduler whose workers detect and measure, in the same folders, with the same result. Raises `LogError`, `ConfigError` and `MissingExtra` for logs and settings that cannot work, `PluginError` when the detector fails or returns something else,
    `NothingToReconstruct` when neither an ego nor any agent was found.
    """
    with nullcontext() if scheduler is None else client_of(scheduler) as client:
        run = start(log, config or Config(), detector=detector, progress=progress, cache=cache, jobs=jobs)
        if client is not None and not run.detectors.own:
            raise ConfigError(
                f"--scheduler: workers have no {run.detectors.name}; only detectors of log2sim can be used there"
            )
        return infer_scenario(run, observe_log(replace(run, client=client)))


def start(
    log: Log, config: Config, *, detector: Any = None, progress: Progress | None = None, cache: bool = True, jobs: int | None = None
) -> Run:  # fmt: skip
    """Put the sensors in one map and on one clock, synchronize them, and plan the run."""
    given = sort_detectors(detector, config)
    clock, progress = StageClock(), progress or (lambda *_: None)
    store = open_store() if cache else None
    earlier = StageCache(log, store, clock)
    with clock.stage("poses"):
        log, poses = localize(earlier.log, given.config, progress=progress)
    config = choose_detector(log, given.config)
    sensors = select_sensors(log, config)
    with clock.stage("calibration"):
        check, asked = partial(check_calibration, log, config, sensors, progress=progress), config.calibration
        # The cache keeps findings alone: a check that also corrects the log runs again.
        if asked.check and not (asked.fix_time or asked.fix_mounts):
            of = [{name: value for name, value in config.to_dict().items() if name not in LATER}, sensors]
            faults = earlier.known("calibration", log, of, (Finding,), lambda: check()[1])
        else:
            log, faults = check()
        sensors = sensors.without([fault.subject for fault in faults if fault.treatment == "left_out"])
    with clock.stage("poses"):
        of = [poses.source, poses.checked, poses.during_ns, faults]
        for_map = earlier.known("map-poses", log, of, (PoseTrack,), lambda: refine_for_map(log, poses, faults).for_map)
        poses = replace(poses, for_map=for_map)
    with clock.stage("registration"):
        road = register_road(log, config, sensors, progress=progress)
        sensors = sensors.without([fault.subject for fault in road.faults if fault.treatment == "left_out"])
    progress("load", 0, 0)
    log = sensors.restrict(road.log)
    detectors = create_detectors(log, config, given, store=store)
    with clock.stage("sync"):
        schedule = schedule_of(log, sensors.cameras, config)
    tiled = detectors.search_tiles(log.cameras[name] for name in sensors.cameras)
    plan = make_plan(road.log, config, sensors, schedule.t_ns, tiled=tiled)
    faults = (*list_faults(log, poses.stretches, *schedule.t_ns[[0, -1]].tolist()), *faults, *road.faults)
    jobs = jobs or (default_jobs() if detectors.own else 1)
    return Run(log, config, plan, schedule, detectors, clock, progress, jobs, poses, faults, road.figures, earlier)


def observe_log(run: Run) -> Observations:
    """Detect and measure, tick by tick."""
    progress = partial(run.progress, "detect and measure")
    progress(0, len(run.schedule))
    return observe(
        run.log, run.schedule, run.plan, detectors=run.detectors, config=run.config, clock=run.clock, progress=progress, jobs=run.jobs,
        client=run.client,
    )  # fmt: skip


def infer_scenario(run: Run, observations: Observations) -> Result:
    """Go on from observations, which stay as they are, to the scenario and the report."""
    log, config, plan, schedule, clock = run.log, run.config, run.plan, run.schedule, run.clock
    timeline, obstacles = Timeline(schedule.t_ns, int(schedule.t_ns[0])), observations.obstacles
    with clock.stage("topdown"):
        homographies = fit_homographies(log, observations, plan, config.topdown, rng=np.random.default_rng(config.seed))
        placed = place_by_homography(log, observations, homographies)
    with clock.stage("fuse"):
        fused = fuse(placed, across=plan.fuses)
    with clock.stage("track", run.progress):
        limits = config.track
        tracks = track(
            fused, schedule.t_ns, birth_score=limits.birth_score, max_gap_s=limits.max_gap_s, min_life_s=limits.min_life_s,
            flow_mps=estimate.ego_velocity(log, schedule),
        )  # fmt: skip
        tracks = mark_unrecorded(tracks, observations.recorded(schedule), 2 if plan.tiles_by_turns else 1)
    with clock.stage("smooth", run.progress):
        clutter = clutter_nats(tracks)
        candidates = estimate.estimate_agents(
            tracks, obstacles, timeline, smooth=config.smooth.enabled, clutter=clutter, jobs=run.jobs
        )
        candidates = decide_headings(candidates, estimate.ego_path(log, schedule), timeline)
        ego = estimate.ego_agent(log, timeline, run.poses.origin)
    with clock.stage("judge", run.progress):
        judged = judge(candidates, ego, Recording(bool(log.lidars), obstacles, timeline), clutter=clutter)
        agents = [
            estimate.with_observers(c, estimate.with_pose_errors(c.agent, log, timeline), timeline) for c in judged
        ]
        if limits.static_for_all:
            agents = extend_static(agents, ego, obstacles, timeline)
        least = limits.quarantine_confidence / (1 if log.lidars else 3)
        agents = [replace(a, quarantined=a.confidence < least) for a in agents]
        # Without an ego the agents' waypoints alone hold the ticks, so all of them stay.
        agents = estimate.simplify(agents) if ego is not None else agents
    scenario = draft_scenario(run, observations, homographies, agents if ego is None else [ego, *agents])
    described = describe(
        scenario, log, plan, observations, settings=config.map, for_map=run.poses.for_map, earlier=run.earlier,
        jobs=run.jobs, clock=clock, progress=run.progress,
    )  # fmt: skip
    return conclude(run, observations, fused, homographies, described)
