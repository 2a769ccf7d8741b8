"""Panels: the settings of one stage as points of error against run time, with their front and what they say."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from log2sim.evaluation.bench.pareto import Point, Verdict, front_of, judge
from log2sim.evaluation.bench.runs import FOR_THE_REPORT, Bed, Progress, Run, homography_points, run_all
from log2sim.evaluation.bench.scores import Judged

OWN_STAGES = {"detect": ("detect",), "measure": ("measure", "fuse"), "smooth": ("smooth",)}

WITHOUT_TRUTH = "the log has no labels: these figures say how steady a setting is, not how right"


@dataclass(frozen=True)
class Panel:
    """The points of a stage; `error` names the figure that is their error, `label` says what it is, `unit` its unit."""

    stage: str
    error: str
    label: str
    unit: str
    points: tuple[Point, ...]
    on_front: tuple[bool, ...]
    verdict: Verdict


# Figure, words and unit of a stage's error with truth, and without.
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
}


def make_panels(bed: Bed, tell: Progress) -> list[Panel]:
    """Run everything and lay it out, one panel a stage and one for whole runs."""
    runs, seen = run_all(bed, tell)
    whole_ms = bed.ms_per_tick(runs[0].seconds)
    known = bed.truth is not None
    by_stage = {stage: [runs[0], *(r for r in runs[1:] if r.setting.stage == stage)] for stage in OWN_STAGES}
    points = {
        "detect": [_point(bed, "detect", r) for r in by_stage["detect"]],
        "measure": [_measure_point(bed, r) for r in by_stage["measure"]],
        "homography": homography_points(bed, seen, tell),
        "smooth": [_point(bed, "smooth", r) for r in by_stage["smooth"]],
        "whole run": [_whole_point(bed, r) for r in runs],
    }
    return [_panel(stage, own, whole_ms, known) for stage, own in points.items() if own]


def _panel(stage: str, points: Sequence[Point], whole_ms: float, known: bool) -> Panel:
    error, label, unit = ERRORS[stage][0 if known else 1]
    verdict = judge(points, unit, whole_ms)
    if not known and stage != "homography":
        verdict = Verdict(None, verdict.present, WITHOUT_TRUTH)
    return Panel(stage, error, label, unit, tuple(points), tuple(bool(f) for f in front_of(points)), verdict)


def _name(bed: Bed, stage: str, run: Run) -> str:
    """The name of a run within a stage: the present run is one of every stage."""
    return run.setting.name if run.setting.stage == stage else getattr(bed.grid, stage)[0].name


def _point(bed: Bed, stage: str, run: Run) -> Point:
    ms = bed.ms_per_tick(sum(run.stages_s.get(s, 0.0) for s in OWN_STAGES[stage]))
    return _judged(_name(bed, stage, run), run.setting.present, ms, run.judged, _error(bed, stage))


def _judged(name: str, present: bool, ms: float, judged: Judged, error: str) -> Point:
    return Point(name, present, ms, judged.figures.get(error), judged.figures, judged.parts.get(error, {}))


def _measure_point(bed: Bed, run: Run) -> Point:
    point = _point(bed, "measure", run)
    if bed.truth is None:
        return point
    return _judged(point.setting, point.present, point.ms_per_tick, run.measured, "error_m")


def _whole_point(bed: Bed, run: Run) -> Point:
    name = "present settings" if run.setting.present else run.setting.key
    stages = {stage: bed.ms_per_tick(s) for stage, s in run.stages_s.items() if stage not in FOR_THE_REPORT}
    point = _judged(name, run.setting.present, bed.ms_per_tick(run.seconds), run.judged, _error(bed, "whole run"))
    return replace(point, figures={**point.figures, "stages_ms_per_tick": stages})


def _error(bed: Bed, stage: str) -> str:
    return ERRORS[stage][0 if bed.truth is not None else 1][0]
