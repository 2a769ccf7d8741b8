"""The runs: the pipeline with one stage's setting changed at a time, on detections and measurements that are shared."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from log2sim.datatypes import Log, Scenario
from log2sim.errors import NothingToReconstruct
from log2sim.evaluation.bench.localization import (
    Held,
    hold_out,
    judge_measured,
    judge_placed,
    lidar_places,
    true_places,
)
from log2sim.evaluation.bench.pareto import Point
from log2sim.evaluation.bench.scores import EVERYTHING, Judged, Scope, check_scope, judge_scenario
from log2sim.evaluation.bench.settings import Grid, Setting
from log2sim.evaluation.bench.shared_detections import Remembered, detect_once
from log2sim.geometry import NS_PER_S
from log2sim.perception.first_pass import Observations, observe
from log2sim.perception.homography_stage import CameraHomography, estimation_options, fit_homographies
from log2sim.perception.sync import Schedule
from log2sim.pipeline import conclude, detector_of, schedule_of
from log2sim.plan import LABELS, Plan, make_plan
from log2sim.stage_clock import StageClock

REPEATS = 3
"""Short stages are timed so often, taking turns; the least time counts, since others on the machine only add to it."""

LOOKS = 2
"""So often for measurement, which takes longer."""

FOR_THE_REPORT = ("probe savings",)

Progress = Callable[[str, int, int], None]
Figures = dict[str, Any]


@dataclass(frozen=True, eq=False)
class Bed:
    """What all runs have in common; `found` are the detections of every setting of the detector, `shared_s` seconds."""

    log: Log
    plan: Plan
    schedule: Schedule
    truth: Scenario | None
    scope: Scope
    grid: Grid
    found: dict[str, Remembered]
    shared_s: dict[str, float]

    @property
    def tick_s(self) -> float:
        """Median time between two ticks, s; 0 for a single one."""
        t = self.schedule.t_ns
        return float(np.median(np.diff(t))) / NS_PER_S if len(t) > 1 else 0.0

    def ms_per_tick(self, seconds: float) -> float:
        return seconds * 1e3 / len(self.schedule)


@dataclass(frozen=True, eq=False)
class Run:
    """A whole run: what it is worth and the seconds of its stages, also of those that it shared with other runs.

    `measured` is what its measurements are worth, which only truth can tell.
    """

    setting: Setting
    judged: Judged
    measured: Judged
    stages_s: dict[str, float]

    @property
    def seconds(self) -> float:
        """Of the whole run, without what only serves its report."""
        return sum(s for stage, s in self.stages_s.items() if stage not in FOR_THE_REPORT)


def make_bed(log: Log, grid: Grid, truth: Scenario | None, tell: Progress, scope: Scope = EVERYTHING) -> Bed:
    """Synchronize the log and find its objects once with every setting of the detector."""
    check_scope(truth, scope)
    config, clock = grid.present.config, StageClock()
    plan = make_plan(log, config)
    log = plan.narrowed(log)
    with clock.stage("sync"):
        schedule = schedule_of(log, config, plan)
    detectors = {s.name: detector_of(log, s.config) for s in grid.detect}
    decode = any(s.config.detect.name != LABELS for s in grid.detect)
    found, decoding_s = detect_once(
        log, schedule, detectors, decode=decode, progress=lambda done, total: tell("detect", done, total)
    )
    plan = plan.decided("decode images", False, "detections are remembered")
    return Bed(log, plan, schedule, truth, scope, grid, found, {**clock.seconds, "decode": decoding_s})


def look(bed: Bed, detect: Setting, measure: Setting, tell: Progress) -> tuple[Observations, dict[str, float]]:
    """Measure what a detector has found; what was seen and the seconds of all stages up to there."""
    clock, what = StageClock(), detect.name if measure.present else measure.name
    seen = observe(
        bed.log,
        bed.schedule,
        bed.found[detect.name],
        bed.plan,
        mode=measure.config.measure.mode,
        max_range_m=measure.config.measure.max_range_m,
        clock=clock,
        progress=lambda done, total: tell(f"measure ({what})", done, total),
    )
    shared = {k: v for k, v in bed.shared_s.items() if k != "decode" or detect.config.detect.name != LABELS}
    return seen, {**clock.seconds, **shared, "detect": bed.found[detect.name].seconds}


def run(
    bed: Bed, settings: Sequence[Setting], first_pass: tuple[Observations, dict[str, float]], tell: Progress
) -> list[Run]:
    """Go on from a first pass to the scenario with every setting, and measure what it is worth.

    Settings take turns several times and the least of each stage's times counts.
    """
    (seen, before_s), measured = first_pass, measured_by(bed, first_pass[0])
    judged: dict[str, Judged] = {}
    spent: dict[str, list[dict[str, float]]] = {s.key: [] for s in settings}
    for repeat in range(REPEATS):
        for k, setting in enumerate(settings):
            clock = StageClock()
            judged[setting.key] = _concluded(bed, setting, seen, clock)
            spent[setting.key].append(clock.seconds)
            tell("track and smooth", repeat * len(settings) + k + 1, REPEATS * len(settings))
    return [
        Run(
            s,
            judged[s.key],
            measured,
            {**before_s, **{k: min(t[k] for t in spent[s.key]) for k in spent[s.key][0]}},
        )
        for s in settings
    ]


def _concluded(bed: Bed, setting: Setting, seen: Observations, clock: StageClock) -> Judged:
    detector = bed.found[bed.grid.present.name]
    try:
        result = conclude(bed.log, setting.config, bed.plan, detector, bed.schedule, seen, clock)
    except NothingToReconstruct:
        return Judged({"agents": 0})
    return judge_scenario(result.scenario, bed.truth, bed.tick_s, bed.scope)


def run_all(bed: Bed, tell: Progress) -> tuple[list[Run], Observations]:
    """Run every setting, the present one first; also what was seen with it."""
    grid = bed.grid
    warm_up(bed)
    looks = [[look(bed, grid.present, s, tell) for s in grid.measure] for _ in range(LOOKS)]
    seen = [one for one, _ in looks[-1]]
    stages_s = [{k: min(each[n][1][k] for each in looks) for k in looks[0][n][1]} for n in range(len(seen))]
    runs = run(bed, (grid.present, *grid.homography[1:], *grid.smooth[1:]), (seen[0], stages_s[0]), tell)
    for n, setting in enumerate(grid.measure[1:], 1):
        runs += run(bed, [setting], (seen[n], stages_s[n]), tell)
    for setting in grid.detect[1:]:
        runs += run(bed, [setting], look(bed, setting, grid.measure[0], tell), tell)
    return _share_clouds(runs), seen[0]


def _share_clouds(runs: Sequence[Run]) -> list[Run]:
    """The same time for clouds in all runs, the least of them: no setting that is compared has to do with it."""
    least = min(r.stages_s["cloud"] for r in runs)
    return [replace(r, stages_s={**r.stages_s, "cloud": least}) for r in runs]


def warm_up(bed: Bed) -> None:
    """Run the first tick once, since what is loaded then is no stage's time."""
    s = bed.schedule
    first = replace(
        s,
        t_ns=s.t_ns[:1],
        frames={name: index[:1] for name, index in s.frames.items()},
        sweeps={name: index[:, :1] for name, index in s.sweeps.items()},
        residuals_s={name: r[:1] for name, r in s.residuals_s.items()},
    )
    short = replace(bed, schedule=first)
    seen, _ = look(short, bed.grid.present, bed.grid.measure[0], lambda what, done, total: None)
    _concluded(short, bed.grid.present, seen, StageClock())


def measured_by(bed: Bed, seen: Observations) -> Judged:
    """What measured centers are worth; nothing is known without truth."""
    if bed.truth is None:
        return Judged({})
    return judge_measured(seen, true_places(bed.log, bed.schedule, seen, bed.truth))


def homography_points(bed: Bed, seen: Observations, tell: Progress) -> list[Point]:
    """Every method of the homography, judged by obstacles that it was not fitted to; none where no obstacle was measured."""
    truth, seed = bed.truth, bed.grid.present.config.seed
    if truth is not None:
        known = true_places(bed.log, bed.schedule, seen, truth, when="imaged")
    else:
        known = lidar_places(seen, bed.tick_s)
    held = hold_out(bed.log, bed.schedule, seen, known, np.random.default_rng(seed))
    if not len(held):
        return []
    settings = (*bed.grid.homography, *bed.grid.hypotheses)
    spent: dict[str, list[float]] = {s.name: [] for s in settings}
    fits: dict[str, dict[str, CameraHomography]] = {}
    for repeat in range(REPEATS):
        for k, setting in enumerate(settings):
            begin = time.perf_counter()
            fits[setting.name] = fit(bed, setting, held)
            spent[setting.name].append(time.perf_counter() - begin)
            tell("homographies", repeat * len(spent) + k + 1, REPEATS * len(spent))
    out = []
    for setting in settings:
        judged = judge_placed(bed.log, held, fits[setting.name])
        figures = judged.figures | fit_figures(fits[setting.name])
        ms = bed.ms_per_tick(min(spent[setting.name]))
        out.append(Point(setting.name, setting.present, ms, figures["error_m"], figures, judged.parts["error_m"]))
    return out


def fit(bed: Bed, setting: Setting, held: Held) -> dict[str, CameraHomography]:
    """The homographies of all cameras by one method."""
    plan = bed.plan.decided("homography", True, "a top-down picture is asked for")
    options, rng = estimation_options(setting.config.topdown), np.random.default_rng(setting.config.seed)
    return fit_homographies(bed.log, held.seen, plan, options, rng=rng)[1]


def fit_figures(grounds: Mapping[str, CameraHomography]) -> Figures:
    """What the fits say of themselves: jitter and residual, means over cameras, and how many fell back on the calibration."""
    jitters = [v for v in (g.fit.jitter_m for g in grounds.values()) if np.isfinite(v)]
    residuals = [g.fit.error_m for g in grounds.values() if np.isfinite(g.fit.error_m)]
    return {
        "jitter_m": float(np.mean(jitters)) if jitters else None,
        "residual_m": float(np.mean(residuals)) if residuals else None,
        "cameras": len(grounds),
        "cameras_by_calibration": sum(bool(g.refusal) for g in grounds.values()),
    }
