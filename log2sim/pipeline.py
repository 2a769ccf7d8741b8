"""The method on one page: a log in, a scenario and a report out (Bhardwaj & Kalra, and past it)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from log2sim.agents.build import Timeline, estimate_agents
from log2sim.agents.duplicates import outside, without_doubles
from log2sim.agents.ego import ego_agent, ego_flow
from log2sim.agents.scenario_of import scenario_of
from log2sim.agents.simplify import simplify
from log2sim.config import Config
from log2sim.datatypes import Log, Scenario
from log2sim.errors import NothingToReconstruct
from log2sim.perception.detect.detectors import Detector, create_detector
from log2sim.perception.first_pass import Observations, observe
from log2sim.perception.homography_stage import estimation_options, fit_homographies, place_by_homography
from log2sim.perception.sync import Schedule, synchronize
from log2sim.plan import Plan, make_plan, plan_ticks
from log2sim.report import make_report
from log2sim.savings import settle
from log2sim.stage_clock import Costs, StageClock
from log2sim.tracking.tracker import track

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, eq=False)
class Result:
    """A reconstructed scenario and the report of the run (`schemas/report-1.json`)."""

    scenario: Scenario
    report: dict[str, Any]


def reconstruct(
    log: Log, config: Config | None = None, *, picture: bool = False, progress: Progress | None = None
) -> Result:
    """Reconstruct the scenario of a log.

    Parameters
    ----------
    log : Log
        From `open_log`.
    config : Config, optional
        Settings; the defaults without.
    picture : bool
        Whether a top-down picture will be asked for, which needs every camera's homography.
    progress : callable, optional
        Called as `progress(stage, done, total)`.

    Raises
    ------
    LogError, ConfigError, MissingExtra
        For logs and settings that cannot work.
    NothingToReconstruct
        When neither an ego nor any agent was found.
    """
    config, clock = config or Config(), StageClock()
    tell = progress or (lambda stage, done, total: None)
    plan = make_plan(log, config, picture=picture)
    detector = detector_of(log, config)
    log = plan.narrowed(log)
    with clock.stage("sync"):
        schedule = schedule_of(log, config, plan)
    plan = plan_ticks(plan, log, schedule.t_ns, min_life_s=config.track.min_life_s)
    seen = observe(
        log,
        schedule,
        detector,
        plan,
        mode=config.measure.mode,
        max_range_m=config.measure.max_range_m,
        clock=clock,
        progress=lambda done, total: tell("detect and measure", done, total),
    )
    return conclude(log, config, plan, detector, schedule, seen, clock)


def detector_of(log: Log, config: Config) -> Detector:
    """The detector that the settings name."""
    return create_detector(
        config.detect.name,
        log,
        min_score=config.detect.min_score or None,
        tiles=config.detect.tiles or "auto",
        layout=config.detect.layout or None,
        input_px=config.detect.input_px or None,
    )


def schedule_of(log: Log, config: Config, plan: Plan) -> Schedule:
    """The ticks of a run and what belongs to each."""
    return synchronize(
        log,
        plan.cameras,
        reference=config.sync.reference,
        max_residual_s=config.sync.max_residual_s,
        start_s=config.start_s,
        stop_s=config.stop_s,
    )


def conclude(
    log: Log, config: Config, plan: Plan, detector: Detector, schedule: Schedule, seen: Observations, clock: StageClock
) -> Result:
    """The second pass: from what was seen, which stays as it is, to the scenario and the report."""
    timeline, costs = Timeline(schedule.t_ns, int(schedule.t_ns[0])), Costs()
    with clock.stage("topdown"):
        plan, homographies = fit_homographies(
            log, seen, plan, estimation_options(config.topdown), rng=np.random.default_rng(config.seed), costs=costs
        )
        measurements = place_by_homography(log, seen, homographies, across=plan.keeps("fuse"))
    with clock.stage("track"):
        tracks = track(
            measurements,
            schedule.t_ns,
            birth_score=config.track.birth_score,
            max_gap_s=config.track.max_gap_s,
            min_life_s=config.track.min_life_s,
        )
    with clock.stage("smooth"):
        flow = ego_flow(log, schedule)
        built = estimate_agents(tracks, seen.obstacles, timeline, flow, smooth=config.smooth.enabled, costs=costs)
        ego = ego_agent(log, timeline)
        agents = outside(without_doubles(built, ego), ego)
        # Without an ego the agents' waypoints are all that tells the ticks.
        agents = simplify(agents) if ego is not None else agents
    if ego is None and not agents:
        raise NothingToReconstruct(f"{log.name}: no ego poses, and no object was detected in {len(schedule)} ticks")
    with clock.stage("probe savings"):
        plan = settle(plan, log, schedule, seen, homographies, agents, clock, costs)
    scenario = scenario_of(log, schedule, config, plan, detector, homographies, ego, agents)
    report = make_report(log, schedule, config, plan, seen, homographies, scenario, clock)
    return Result(scenario, report)
