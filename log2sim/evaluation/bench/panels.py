"""Panels: the settings of one stage as points of error against run time, with Pareto front and recommendation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from log2sim.datatypes import Scenario
from log2sim.evaluation.bench.ends import STAGE as ENDS_STAGE
from log2sim.evaluation.bench.pareto import Point, Recommendation, front_mask, recommend
from log2sim.evaluation.bench.runs import BenchContext, BenchRun, Progress, homography_points, run_all
from log2sim.evaluation.bench.scores import Score

OWN_STAGES = {"detect": ("detect",), "measure": ("measure", "fuse"), "smooth": ("smooth",)}

WITHOUT_TRUTH = "the log has no labels: these figures say how steady a setting is, not how right"


@dataclass(frozen=True)
class Panel:
    """The settings of a stage.

    Attributes
    ----------
    stage : str
    error, label, unit : str
        Key of the figure that is the error, its description and its unit.
    points : tuple of Point
    on_front : tuple of bool
        Which points are Pareto-optimal.
    recommendation : Recommendation
    """

    stage: str
    error: str
    label: str
    unit: str
    points: tuple[Point, ...]
    on_front: tuple[bool, ...]
    recommendation: Recommendation


# Key, description and unit of a stage's error with truth, and without.
ERRORS = {
    "detect": (
        ("error_m", "position error, missed and false objects counted", "m"),
        ("gap_share", "part of the objects' ticks without a detection", ""),
    ),
    "measure": (
        ("error_m", "error of measured centers, cut at 2 m", "m"),
        ("smoothing_residual_m", "measurements' distance from the smoothed path", "m"),
    ),
    "homography": (
        ("error_m", "feet of obstacles placed by it alone, distance from LiDAR's, cut at 2 m", "m"),
        ("error_m", "feet of obstacles placed by it alone, distance from LiDAR's, cut at 2 m", "m"),
    ),
    "smooth": (
        ("state_error_m", "error of the position one second ahead", "m"),
        ("jitter_m", "jitter of waypoints", "m"),
    ),
    "whole run": (
        ("error_m", "position error, missed and false objects counted", "m"),
        ("jitter_m", "jitter of waypoints", "m"),
    ),
    ENDS_STAGE: (
        ("error_m", "vehicle, road, and both by LiDAR: position error, missed and false objects counted", "m"),
        ("jitter_m", "vehicle, road, and both by LiDAR: jitter of waypoints", "m"),
    ),
}


def make_panels(context: BenchContext, report: Progress, default: Sequence[Point] = ()) -> list[Panel]:
    """Run all settings and make one panel for each stage and one for whole runs, with those of the default beside them."""
    runs, observations = run_all(context, report)
    whole_ms = context.ms_per_tick(runs[0].seconds)
    known = context.truth is not None
    by_stage = {stage: [runs[0], *(r for r in runs[1:] if r.setting.stage == stage)] for stage in OWN_STAGES}
    homographies = homography_points(context, observations, report)
    whole = [*default, *(_whole_point(context, r, compared=not default) for r in runs)]
    points = {
        "detect": [_point(context, "detect", r) for r in by_stage["detect"]],
        "measure": [_measure_point(context, r) for r in by_stage["measure"]],
        "homography": homographies,
        "smooth": [_point(context, "smooth", r) for r in by_stage["smooth"]],
        "whole run": _with_placed_shares(whole, homographies),
    }
    return [_panel(stage, own, whole_ms, known) for stage, own in points.items() if own]


def make_ends_panel(points: Sequence[Point], truth: Scenario | None) -> Panel:
    """Make the panel of vehicle, road, and both; the present setting comes first."""
    return _panel(ENDS_STAGE, points, points[0].ms_per_tick, truth is not None)


def _panel(stage: str, points: Sequence[Point], whole_ms: float, known: bool) -> Panel:
    error, label, unit = ERRORS[stage][0 if known else 1]
    recommendation = recommend(points, unit, whole_ms)
    if not known and stage != "homography":
        recommendation = Recommendation(None, recommendation.present, WITHOUT_TRUTH)
    return Panel(stage, error, label, unit, tuple(points), tuple(bool(f) for f in front_mask(points)), recommendation)


def _name(context: BenchContext, stage: str, run: BenchRun) -> str:
    """Name a run within a stage; the present run belongs to every stage."""
    return run.setting.name if run.setting.stage == stage else getattr(context.grid, stage)[0].name


def _point(context: BenchContext, stage: str, run: BenchRun) -> Point:
    ms = context.ms_per_tick(sum(run.stages_s.get(s, 0.0) for s in OWN_STAGES[stage]))
    return _scored_point(_name(context, stage, run), run.setting.present, ms, run.score, _error(context, stage))


def _scored_point(name: str, present: bool, ms: float, score: Score, error: str) -> Point:
    return Point(name, present, ms, score.figures.get(error), score.figures, score.by_object.get(error, {}))


def _measure_point(context: BenchContext, run: BenchRun) -> Point:
    point = _point(context, "measure", run)
    if context.truth is None:
        return point
    return _scored_point(point.setting, point.present, point.ms_per_tick, run.measurement_score, "error_m")


def _with_placed_shares(whole: Sequence[Point], homographies: Sequence[Point]) -> list[Point]:
    """Add to whole runs the share of the obstacles that their homographies place."""
    if not homographies:
        return list(whole)
    shares = {f"homography: {p.setting}": p.figures["placed_share"] for p in homographies}
    present = next(p for p in homographies if p.present).figures["placed_share"]
    return [replace(p, figures={**p.figures, "placed_share": shares.get(p.setting, present)}) for p in whole]


def _whole_point(context: BenchContext, run: BenchRun, *, compared: bool) -> Point:
    """Make the point of a run; where it is `compared` with the others, that of the present settings is marked."""
    present = "present settings" if compared else f"{context.grid.present.config.detect.name} alone"
    name = present if run.setting.present else run.setting.key
    stages = {stage: context.ms_per_tick(s) for stage, s in run.stages_s.items()}
    point = _scored_point(
        name,
        run.setting.present and compared,
        context.ms_per_tick(run.seconds),
        run.score,
        _error(context, "whole run"),
    )
    return replace(point, figures={**point.figures, "stages_ms_per_tick": stages})


def _error(context: BenchContext, stage: str) -> str:
    return ERRORS[stage][0 if context.truth is not None else 1][0]
