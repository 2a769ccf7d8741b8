"""Runs of the pipeline with one stage's setting changed at a time, on shared detections and measurements."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from log2sim.datatypes import Log, Scenario
from log2sim.errors import NothingToReconstruct
from log2sim.evaluation.bench.localization import (
    Holdout,
    lidar_positions,
    score_homographies,
    score_measurements,
    split_holdout,
    true_positions,
)
from log2sim.evaluation.bench.pareto import Point
from log2sim.evaluation.bench.scores import EVERYTHING, Scope, Score, check_scope, score_scenario
from log2sim.evaluation.bench.seams import SeamBench
from log2sim.evaluation.bench.settings import Grid, Setting
from log2sim.evaluation.bench.shared_detections import RecordedDetections, detect_once
from log2sim.geometry import period_of
from log2sim.perception.first_pass import Observations, observe
from log2sim.perception.fusion import fuse
from log2sim.perception.homography_stage import CameraHomography, estimation_options, fit_homographies
from log2sim.perception.sync import Schedule
from log2sim.pipeline import Run, schedule_of, second_pass
from log2sim.plan import LABELS, Decision, HomographyScope, Plan, Stage, make_plan
from log2sim.run_detectors import Detectors, create_image_detector
from log2sim.sensors import select_sensors
from log2sim.stage_clock import StageClock

REPEATS = 3
"""Repetitions of short stages, taking turns; the least time counts, since other processes only add to it."""

MEASURE_REPEATS = 2
"""Repetitions of the measurement, which takes longer."""


Progress = Callable[[str, int, int], None]
Figures = dict[str, Any]


@dataclass(frozen=True, eq=False)
class BenchContext:
    """What all runs have in common.

    Attributes
    ----------
    log : Log
        Narrowed to the cameras and sensors of the plan.
    plan : Plan
    schedule : Schedule
    truth : Scenario or None
    scope : Scope
    grid : Grid
    found : dict of str to RecordedDetections
        Detections by setting of the detector.
    shared_s : dict of str to float, s
        Time of stages that all runs share.
    """

    log: Log
    plan: Plan
    schedule: Schedule
    truth: Scenario | None
    scope: Scope
    grid: Grid
    found: dict[str, RecordedDetections]
    shared_s: dict[str, float]

    @property
    def tick_s(self) -> float:
        """Median time between two ticks, s; 0 for a single one."""
        return period_of(self.schedule.t_ns)

    def ms_per_tick(self, seconds: float) -> float:
        """Convert seconds of the whole log to milliseconds a tick."""
        return seconds * 1e3 / len(self.schedule)


@dataclass(frozen=True, eq=False)
class BenchRun:
    """A whole run with one setting.

    Attributes
    ----------
    setting : Setting
    score : Score
        Of the scenario.
    measurement_score : Score
        Of the measured centers; empty without truth.
    stages_s : dict of str to float, s
        Time of each stage, including those shared with other runs.
    """

    setting: Setting
    score: Score
    measurement_score: Score
    stages_s: dict[str, float]

    @property
    def seconds(self) -> float:
        """Return the time of the whole run, s."""
        return sum(self.stages_s.values())


def make_context(
    log: Log, grid: Grid, truth: Scenario | None, report: Progress, scope: Scope = EVERYTHING
) -> BenchContext:
    """Synchronize the log and detect once with every setting of the detector."""
    check_scope(truth, scope)
    config, clock = grid.present.config, StageClock()
    sensors = select_sensors(log, config)
    with clock.stage("sync"):
        schedule = schedule_of(log, config, sensors)
    log = sensors.restrict(log)
    detectors = {s.name: create_image_detector(log, s.config) for s in grid.detect}
    decode = any(s.config.detect.name != LABELS for s in grid.detect)
    found, decoding_s = detect_once(
        log, schedule, detectors, decode=decode, progress=lambda done, total: report("detect", done, total)
    )
    plan = make_plan(log, config, sensors, schedule.t_ns)
    # Detections are looked up, so that no image is decoded and no frame skipped.
    plan = replace(plan.variant(Decision(Stage.IMAGE_DECODING, False, "detections are shared")), detector_stride=1)
    return BenchContext(log, plan, schedule, truth, scope, grid, found, {**clock.seconds, "decode": decoding_s})


def first_pass(
    context: BenchContext, detect: Setting, measure: Setting, report: Progress
) -> tuple[Observations, dict[str, float]]:
    """Measure what a detector found; returns the observations and the seconds of all stages so far."""
    clock, what = StageClock(), detect.name if measure.present else measure.name
    observations = observe(
        context.log,
        context.schedule,
        context.found[detect.name],
        context.plan,
        mode=measure.config.measure.mode,
        max_range_m=measure.config.measure.max_range_m,
        clock=clock,
        progress=lambda done, total: report(f"measure ({what})", done, total),
    )
    shared = {k: v for k, v in context.shared_s.items() if k != "decode" or detect.config.detect.name != LABELS}
    return observations, {**clock.seconds, **shared, "detect": context.found[detect.name].seconds}


def run_settings(
    context: BenchContext,
    settings: Sequence[Setting],
    observed: tuple[Observations, dict[str, float]],
    report: Progress,
) -> list[BenchRun]:
    """Reconstruct and score the scenario with every setting from the result of `first_pass`.

    Settings take turns `REPEATS` times; the least time of each stage counts.
    """
    (observations, before_s), measurement_score = observed, score_of_measurements(context, observed[0])
    scores: dict[str, Score] = {}
    spent: dict[str, list[dict[str, float]]] = {s.key: [] for s in settings}
    for repeat in range(REPEATS):
        for k, setting in enumerate(settings):
            clock = StageClock()
            scores[setting.key] = _concluded(context, setting, observations, clock)
            spent[setting.key].append(clock.seconds)
            report("track and smooth", repeat * len(settings) + k + 1, REPEATS * len(settings))
    return [
        BenchRun(
            s,
            scores[s.key],
            measurement_score,
            {**before_s, **{k: min(t[k] for t in spent[s.key]) for k in spent[s.key][0]}},
        )
        for s in settings
    ]


def _concluded(context: BenchContext, setting: Setting, observations: Observations, clock: StageClock) -> Score:
    detectors = Detectors(context.found[context.grid.present.name], None)
    try:
        run = Run(context.log, setting.config, context.plan, context.schedule, detectors, clock, lambda *_: None)
        result = second_pass(run, observations)
    except NothingToReconstruct:
        return Score({"agents": 0})
    return score_scenario(result.scenario, context.truth, context.tick_s, context.scope)


def run_all(context: BenchContext, report: Progress) -> tuple[list[BenchRun], Observations]:
    """Run every setting, the present one first; returns the runs and the observations of the present one."""
    grid = context.grid
    warm_up(context)
    passes = [[first_pass(context, grid.present, s, report) for s in grid.measure] for _ in range(MEASURE_REPEATS)]
    observations = [one for one, _ in passes[-1]]
    stages_s = [{k: min(each[n][1][k] for each in passes) for k in passes[0][n][1]} for n in range(len(observations))]
    runs = run_settings(
        context, (grid.present, *grid.homography[1:], *grid.smooth[1:]), (observations[0], stages_s[0]), report
    )
    for n, setting in enumerate(grid.measure[1:], 1):
        runs += run_settings(context, [setting], (observations[n], stages_s[n]), report)
    for setting in grid.detect[1:]:
        runs += run_settings(context, [setting], first_pass(context, setting, grid.measure[0], report), report)
    return _share_clouds(runs), observations[0]


def _share_clouds(runs: Sequence[BenchRun]) -> list[BenchRun]:
    """Give all runs the least time for clouds, which no compared setting affects."""
    least = min(r.stages_s["cloud"] for r in runs)
    return [replace(r, stages_s={**r.stages_s, "cloud": least}) for r in runs]


def warm_up(context: BenchContext) -> None:
    """Run the first tick once, so that imports and caches count for no stage."""
    s = context.schedule
    first = replace(
        s,
        t_ns=s.t_ns[:1],
        frames={name: index[:1] for name, index in s.frames.items()},
        sweeps={name: index[:, :1] for name, index in s.sweeps.items()},
        residuals_s={name: r[:1] for name, r in s.residuals_s.items()},
    )
    short = replace(context, schedule=first)
    observations, _ = first_pass(short, context.grid.present, context.grid.measure[0], lambda what, done, total: None)
    _concluded(short, context.grid.present, observations, StageClock())


def score_of_measurements(context: BenchContext, observations: Observations) -> Score:
    """Score the measured centers; empty without truth."""
    if context.truth is None:
        return Score({})
    across = context.plan.keeps(Stage.FUSION)
    fused = replace(observations, measurements=fuse(observations.measurements, across=across))
    return score_measurements(fused, true_positions(context.log, context.schedule, fused, context.truth))


def homography_points(context: BenchContext, observations: Observations, report: Progress) -> list[Point]:
    """Score every homography method on held-out obstacles; empty when no obstacle was measured."""
    truth, seed = context.truth, context.grid.present.config.seed
    if truth is not None:
        known = true_positions(context.log, context.schedule, observations, truth, when="imaged")
    else:
        known = lidar_positions(observations, context.tick_s)
    holdout = split_holdout(context.log, context.schedule, observations, known, np.random.default_rng(seed))
    if not len(holdout):
        return []
    settings = (*context.grid.homography, *context.grid.hypotheses)
    spent: dict[str, list[float]] = {s.name: [] for s in settings}
    fits: dict[str, dict[str, CameraHomography]] = {}
    for repeat in range(REPEATS):
        for k, setting in enumerate(settings):
            begin = time.perf_counter()
            fits[setting.name] = fit(context, setting, holdout)
            spent[setting.name].append(time.perf_counter() - begin)
            report("homographies", repeat * len(spent) + k + 1, REPEATS * len(spent))
    out = []
    # Those fitted together register the pictures best, whatever the settings are.
    together = [found for found in fits.values() if any(g.rig is not None for g in found.values())]
    seams = SeamBench.of(context.log, context.schedule, observations, together[0] if together else {})
    for setting in settings:
        score = score_homographies(context.log, holdout, fits[setting.name])
        figures = score.figures | fit_figures(fits[setting.name])
        if setting in context.grid.homography:
            figures |= seams.figures(fits[setting.name])
        ms = context.ms_per_tick(min(spent[setting.name]))
        out.append(Point(setting.name, setting.present, ms, figures["error_m"], figures, score.by_object["error_m"]))
    return out


def fit(context: BenchContext, setting: Setting, holdout: Holdout) -> dict[str, CameraHomography]:
    """Fit the homographies of all cameras by one method."""
    plan = replace(context.plan, homography=HomographyScope.ALL_CAMERAS)
    options, rng = estimation_options(setting.config.topdown), np.random.default_rng(setting.config.seed)
    return fit_homographies(context.log, holdout.observations, plan, options, rng=rng)


def fit_figures(grounds: Mapping[str, CameraHomography]) -> Figures:
    """Summarize the fits: jitter and residual, means over cameras, and how many cameras fell back to the calibration."""
    jitters = [v for v in (g.fit.jitter_m for g in grounds.values()) if np.isfinite(v)]
    residuals = [g.fit.error_m for g in grounds.values() if np.isfinite(g.fit.error_m)]
    return {
        "jitter_m": float(np.mean(jitters)) if jitters else None,
        "residual_m": float(np.mean(residuals)) if residuals else None,
        "cameras": len(grounds),
        "cameras_by_calibration": sum(bool(g.refusal) for g in grounds.values()),
    }
