"""Vehicle alone, road alone, and both joined at each level, as whole runs on one log."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

from log2sim.config import Config
from log2sim.datatypes import ENDS, ROAD, Log, Scenario, end_of
from log2sim.errors import LogError, NothingToReconstruct
from log2sim.evaluation.bench.pareto import Point
from log2sim.evaluation.bench.runs import BenchContext
from log2sim.evaluation.bench.scores import Scope, Score, check_scope, score_scenario
from log2sim.evaluation.bench.settings import Grid, Setting
from log2sim.fusion_level import FusionLevel
from log2sim.geometry import period_of
from log2sim.perception.cooperative.detector import detector_by_mounting
from log2sim.pipeline import first_pass, schedule_of, second_pass, start
from log2sim.plan import make_plan
from log2sim.sensors import select_sensors

STAGE = "ends"
DETECTOR = "lidar:vehicle"
"""Searches sweeps where the settings name no detector for them."""


def has_both_ends(log: Log) -> bool:
    """Return whether a log has LiDARs of the vehicle and of the road."""
    return {end_of(lidar) for lidar in log.lidars.values()} >= set(ENDS)


def make_context_of_ends(log: Log, ends: Sequence[Setting], truth: Scenario | None, scope: Scope) -> BenchContext:
    """Synchronize a log without cameras, of which the ends alone are compared.

    Raises
    ------
    LogError
        For a log without LiDARs at both ends.
    """
    if not ends:
        raise LogError(
            f"{log.name}: the log has no camera, and bench compares methods for images; use detect and evaluate"
        )
    check_scope(truth, scope)
    config = ends[0].config
    sensors = select_sensors(log, config)
    schedule = schedule_of(log, config, sensors)
    plan = make_plan(log, config, sensors, schedule.t_ns)
    grid = Grid(detect=tuple(ends[:1]), measure=(), homography=(), hypotheses=(), smooth=())
    return BenchContext(sensors.restrict(log), plan, schedule, truth, scope, grid, {}, {})


def ends_settings(log: Log, config: Config) -> tuple[Setting, ...]:
    """List the levels of fusion and the ends alone, the present one first; none for a log without LiDARs at both ends.

    LiDAR sweeps alone are searched, so that the LiDARs of the ends are what is compared.
    """
    if not has_both_ends(log):
        return ()
    name = config.detect.in_sweeps or DETECTOR
    present = config.cooperation.ends if config.cooperation.ends != "both" else config.cooperation.fusion
    ways: dict[str, dict[str, Any]] = {f"{end} alone": {"ends": end} for end in ENDS}
    ways |= {f"both, {level}": {"ends": "both", "fusion": str(level)} for level in FusionLevel}
    out = []
    for title, change in ways.items():
        detector = detector_by_mounting(log, name) if change["ends"] == ROAD else name
        changed = config.changed(cameras=[], detect={"name": detector}, cooperation=change)
        chosen = change.get("fusion", change["ends"])
        out.append(Setting(STAGE, title, changed, chosen == present))
    return tuple(sorted(out, key=lambda setting: not setting.present))


def whole_points(
    log: Log,
    settings: Sequence[Setting],
    truth: Scenario | None,
    scope: Scope,
    report: Callable[[str, int, int], None],
) -> list[Point]:
    """Run every setting once, as `reconstruct` does, and score its scenario.

    The time is that of everything after synchronization: poses, calibration and registration are the same for all.
    """
    out = []
    for k, setting in enumerate(settings):
        run = start(log, setting.config, cache=False)
        begin = time.perf_counter()
        try:
            result = second_pass(run, first_pass(run))
            score = score_scenario(result.scenario, truth, period_of(run.schedule.t_ns), scope)
        except NothingToReconstruct:
            score = Score({"agents": 0})
        ms = (time.perf_counter() - begin) * 1e3 / len(run.schedule)
        stages = {stage: s * 1e3 / len(run.schedule) for stage, s in run.clock.seconds.items()}
        error = "error_m" if truth is not None else "jitter_m"
        figures = {**score.figures, "stages_ms_per_tick": stages}
        out.append(
            Point(setting.name, setting.present, ms, score.figures.get(error), figures, score.by_object.get(error, {}))
        )
        report(setting.stage, k + 1, len(settings))
    return out
