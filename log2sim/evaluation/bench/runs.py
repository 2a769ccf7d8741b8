"""Runs of the pipeline with one stage's setting changed at a time, on shared detections."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.config import Config
from log2sim.datatypes import ENDS, ROAD, Detections, Frame, Log, Scenario, end_of
from log2sim.errors import LogError, NothingToReconstruct, RecordError
from log2sim.evaluation.bench import scores as scoring
from log2sim.evaluation.bench.settings import Grid, Point, Setting
from log2sim.evaluation.detection.detect_log import take_ticks
from log2sim.files.stages import StageClock
from log2sim.geometry import period_of
from log2sim.perception.cooperative import detector_by_mounting
from log2sim.perception.detect.detectors import Detector
from log2sim.perception.first_pass import Observations, observe
from log2sim.perception.fusion import fuse
from log2sim.perception.homography_stage import CameraHomography, fit_homographies
from log2sim.perception.records import RecordSource
from log2sim.perception.run_detectors import Detectors, create_image_detector
from log2sim.perception.sync import Schedule, schedule_of
from log2sim.pipeline import infer_scenario, observe_log, start
from log2sim.plan import LABELS, Decision, FusionLevel, HomographyScope, Plan, Stage, make_plan, select_sensors
from log2sim.report import Run


@dataclass(frozen=True, eq=False)
class RecordedDetections:
    """A `Detector` that returns recorded detections; none for a frame that was not recorded."""

    name: str
    default_min_score: float
    found: dict[tuple[str, int], Detections] = field(default_factory=dict)  # by camera and stamp
    spent_s: list[float] = field(default_factory=list)  # time of the recorded detector for each frame

    def detect(self, frame: Frame) -> Detections:
        """Return the recorded boxes of one frame."""
        return self.found.get((frame.camera.name, frame.t_ns), Detections.empty())


def detect_once(
    log: Log,
    schedule: Schedule,
    detectors: Mapping[str, Detector],
    *,
    decode: bool,
    progress: Callable[[int, int], None],
) -> tuple[dict[str, RecordedDetections], float]:
    """Run every detector on every frame of a schedule once.

    Detectors take turns on each frame, so that a change of the machine's speed affects all of them.

    Returns recorded detections by the same names, and the seconds of decoding. Raises `LogError` when no frame of a
    camera can be read.
    """

    def decoded(image: NDArray[np.uint8] | None) -> NDArray[np.uint8]:
        if image is None:
            raise RecordError("a detector needs the image, but all were expected to need none, and none was decoded")
        return image

    recorded = {key: RecordedDetections(d.name, d.default_min_score) for key, d in detectors.items()}
    records, decoding_s = RecordSource(log), 0.0
    for tick in range(len(schedule)):
        for camera, index in schedule.frames.items():
            if index[tick] < 0:
                continue
            begin = time.perf_counter()
            image = records.get(camera, int(index[tick])) if decode else None
            decoding_s += time.perf_counter() - begin
            if decode and image is None:
                continue
            frame = Frame(log.cameras[camera], int(log.streams[camera].t_ns[index[tick]]), partial(decoded, image))
            for key, detector in detectors.items():
                begin = time.perf_counter()
                recorded[key].found[camera, frame.t_ns] = detector.detect(frame)
                recorded[key].spent_s.append(time.perf_counter() - begin)
        progress(tick + 1, len(schedule))
    records.require_some()
    return recorded, decoding_s


REPEATS = 3  # repetitions of short stages, taking turns; the least time counts, since other processes only add to it
MEASURE_REPEATS = 2  # repetitions of the measurement, which takes longer
Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, eq=False)
class BenchContext:
    """What all runs have in common."""

    log: Log  # narrowed to the cameras and sensors of the plan
    plan: Plan
    schedule: Schedule
    truth: Scenario | None
    scope: scoring.ScoreScope
    grid: Grid
    found: dict[str, RecordedDetections]  # detections by setting of the detector
    shared_s: dict[str, float]  # time of stages that all runs share

    @property
    def tick_s(self) -> float:
        """Median time between two ticks, s; 0 for a single one."""
        return period_of(self.schedule.t_ns)

    def ms_per_tick(self, seconds: float) -> float:
        """Convert seconds of the whole log to milliseconds a tick."""
        return seconds * 1e3 / len(self.schedule)


@dataclass(frozen=True, eq=False)
class BenchRun:
    """A whole run with one setting."""

    setting: Setting
    score: scoring.Score  # of the scenario
    measurement_score: scoring.Score  # of the measured centers; empty without truth
    stages_s: dict[str, float]  # time of each stage, including those shared with other runs

    @property
    def seconds(self) -> float:
        """Return the time of the whole run, s."""
        return sum(self.stages_s.values())


def make_context(
    log: Log, grid: Grid, truth: Scenario | None, report: Progress, scope: scoring.ScoreScope = scoring.EVERYTHING
) -> BenchContext:
    """Synchronize the log and detect once with every setting of the detector."""
    scoring.check_scope(truth, scope)
    config, clock = grid.present.config, StageClock()
    sensors = select_sensors(log, config)
    with clock.stage("sync"):
        schedule = schedule_of(sensors.restrict(log), sensors.cameras, config)
    log = sensors.restrict(log)
    detectors = {s.name: create_image_detector(log, s.config) for s in grid.detect}
    decode = any(s.config.detect.name != LABELS for s in grid.detect)
    found, decoding_s = detect_once(
        log, schedule, detectors, decode=decode, progress=lambda done, total: report("detect", done, total)
    )
    plan = make_plan(log, config, sensors, schedule.t_ns).only_agents()
    # Detections are looked up, so that no image is decoded and no frame skipped.
    plan = replace(plan.variant(Decision(Stage.IMAGE_DECODING, False, "detections are shared")), detector_stride=1)
    return BenchContext(log, plan, schedule, truth, scope, grid, found, {**clock.seconds, "decode": decoding_s})


def timed_first_pass(
    context: BenchContext, detect: Setting, measure: Setting, report: Progress
) -> tuple[Observations, dict[str, float]]:
    """Measure what a detector found; returns the observations and the seconds of all stages so far."""
    clock, what = StageClock(), detect.name if measure.present else measure.name
    observations = observe(
        context.log, context.schedule, context.plan, detectors=Detectors(context.found[detect.name], None),
        config=measure.config, clock=clock, progress=lambda done, total: report(f"measure ({what})", done, total),
    )  # fmt: skip
    shared = {k: v for k, v in context.shared_s.items() if k != "decode" or detect.config.detect.name != LABELS}
    return observations, {**clock.seconds, **shared, "detect": sum(context.found[detect.name].spent_s)}


def run_settings(
    context: BenchContext,
    settings: Sequence[Setting],
    observed: tuple[Observations, dict[str, float]],
    report: Progress,
) -> list[BenchRun]:
    """Reconstruct and score the scenario with every setting from the result of `timed_first_pass`.

    Settings take turns `REPEATS` times; the least time of each stage counts.
    """
    (observations, before_s), measurement_score = observed, scoring.Score({})
    if context.truth is not None:
        across = context.plan.keeps(Stage.FUSION)
        fused = replace(observations, measurements=fuse(observations.measurements, across=across))
        known = scoring.true_positions(context.log, context.schedule, fused, context.truth)
        measurement_score = scoring.score_measurements(fused, known)
    scores: dict[str, scoring.Score] = {}
    spent: dict[str, list[dict[str, float]]] = {s.key: [] for s in settings}
    for repeat in range(REPEATS):
        for k, setting in enumerate(settings):
            clock = StageClock()
            scores[setting.key] = _concluded(context, setting, observations, clock)
            spent[setting.key].append(clock.seconds)
            report("track and smooth", repeat * len(settings) + k + 1, REPEATS * len(settings))
    least_s = {key: {k: min(t[k] for t in times) for k in times[0]} for key, times in spent.items()}
    return [BenchRun(s, scores[s.key], measurement_score, {**before_s, **least_s[s.key]}) for s in settings]


def _concluded(context: BenchContext, setting: Setting, observations: Observations, clock: StageClock) -> scoring.Score:
    detectors = Detectors(context.found[context.grid.present.name], None)
    try:
        run = Run(context.log, setting.config, context.plan, context.schedule, detectors, clock, lambda *_: None)
        result = infer_scenario(run, observations)
    except NothingToReconstruct:
        return scoring.Score({"agents": 0})
    return scoring.score_scenario(result.scenario, context.truth, context.tick_s, context.scope)


def run_all(context: BenchContext, report: Progress) -> tuple[list[BenchRun], Observations]:
    """Run every setting, the present one first; returns the runs and the observations of the present one."""
    grid = context.grid
    # The first tick alone, so that imports and caches count for no stage.
    short = replace(context, schedule=take_ticks(context.schedule, slice(1)))
    first, _ = timed_first_pass(short, grid.present, grid.measure[0], lambda *_: None)
    _concluded(short, grid.present, first, StageClock())
    one_pass = partial(timed_first_pass, context, grid.present, report=report)
    passes = [[one_pass(s) for s in grid.measure] for _ in range(MEASURE_REPEATS)]
    observations = [one for one, _ in passes[-1]]
    stages_s = [{k: min(each[n][1][k] for each in passes) for k in passes[0][n][1]} for n in range(len(observations))]
    shared = (grid.present, *grid.homography[1:], *grid.smooth[1:])
    runs = run_settings(context, shared, (observations[0], stages_s[0]), report)
    for n, setting in enumerate(grid.measure[1:], 1):
        runs += run_settings(context, [setting], (observations[n], stages_s[n]), report)
    for setting in grid.detect[1:]:
        runs += run_settings(context, [setting], timed_first_pass(context, setting, grid.measure[0], report), report)
    least = min(r.stages_s["cloud"] for r in runs)
    return [replace(r, stages_s={**r.stages_s, "cloud": least}) for r in runs], observations[0]


def homography_points(context: BenchContext, observations: Observations, report: Progress) -> list[Point]:
    """Score every homography method on held-out obstacles; empty when no obstacle was measured."""
    truth, seed = context.truth, context.grid.present.config.seed
    if truth is not None:
        known = scoring.true_positions(context.log, context.schedule, observations, truth, when="imaged")
    else:
        known = scoring.lidar_positions(observations, context.tick_s)
    holdout = scoring.split_holdout(context.log, context.schedule, observations, known, np.random.default_rng(seed))
    if not len(holdout):
        return []
    settings = (*context.grid.homography, *context.grid.hypotheses)
    plan = replace(context.plan, homography=HomographyScope.ALL_CAMERAS)
    spent: dict[str, list[float]] = {s.name: [] for s in settings}
    fits: dict[str, dict[str, CameraHomography]] = {}
    for repeat in range(REPEATS):
        for k, setting in enumerate(settings):
            begin, rng = time.perf_counter(), np.random.default_rng(setting.config.seed)
            ours = setting.config.topdown
            fits[setting.name] = fit_homographies(context.log, holdout.observations, plan, ours, rng=rng)
            spent[setting.name].append(time.perf_counter() - begin)
            report("homographies", repeat * len(spent) + k + 1, REPEATS * len(spent))
    out = []
    for setting in settings:
        score = scoring.score_homographies(context.log, holdout, fits[setting.name])
        ms, grounds = context.ms_per_tick(min(spent[setting.name])), list(fits[setting.name].values())
        jitters = [v for v in (g.fit.jitter_m for g in grounds) if np.isfinite(v)]
        residuals = [v for v in (g.fit.error_m for g in grounds) if np.isfinite(v)]
        figures = {
            "jitter_m": float(np.mean(jitters)) if jitters else None,
            "residual_m": float(np.mean(residuals)) if residuals else None,
            "cameras": len(grounds),
            "cameras_by_calibration": sum(bool(g.refusal) for g in grounds),
        }
        out.append(score.point(setting.name, setting.present, ms, "error_m", **figures))
    return out


STAGE = "ends"
DETECTOR = "lidar:vehicle"  # searches sweeps where the settings name no detector for them


def make_context_of_ends(
    log: Log, ends: Sequence[Setting], truth: Scenario | None, scope: scoring.ScoreScope
) -> BenchContext:
    """Synchronize a log without cameras, of which the ends alone are compared.

    Raises `LogError` for a log without LiDARs at both ends.
    """
    if not ends:
        raise LogError(f"{log.name}: has no camera, and bench compares methods for images; use detect and evaluate")
    scoring.check_scope(truth, scope)
    config = ends[0].config
    sensors = select_sensors(log, config)
    schedule = schedule_of(sensors.restrict(log), sensors.cameras, config)
    plan = make_plan(log, config, sensors, schedule.t_ns).only_agents()
    grid = Grid(detect=tuple(ends[:1]), measure=(), homography=(), hypotheses=(), smooth=())
    return BenchContext(sensors.restrict(log), plan, schedule, truth, scope, grid, {}, {})


def ends_settings(log: Log, config: Config) -> tuple[Setting, ...]:
    """List the levels of fusion and the ends alone, the present one first; none for a log without LiDARs at both ends.

    LiDAR sweeps alone are searched, so that the LiDARs of the ends are what is compared.
    """
    if not ({end_of(lidar) for lidar in log.lidars.values()} >= set(ENDS)):
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
    log: Log, settings: Sequence[Setting], truth: Scenario | None, scope: scoring.ScoreScope, report: Progress
) -> list[Point]:
    """Run every setting once, as `reconstruct` does, and score its scenario.

    The time is that of everything after synchronization: poses, calibration and registration are the same for all.
    """
    out = []
    for k, setting in enumerate(settings):
        run = start(log, setting.config, cache=False)
        begin = time.perf_counter()
        try:
            result = infer_scenario(replace(run, plan=run.plan.only_agents()), observe_log(run))
            score = scoring.score_scenario(result.scenario, truth, period_of(run.schedule.t_ns), scope)
        except NothingToReconstruct:
            score = scoring.Score({"agents": 0})
        ms = (time.perf_counter() - begin) * 1e3 / len(run.schedule)
        stages = {stage: s * 1e3 / len(run.schedule) for stage, s in run.clock.seconds.items()}
        error = "error_m" if truth is not None else "jitter_m"
        out.append(score.point(setting.name, setting.present, ms, error, stages_ms_per_tick=stages))
        report(setting.stage, k + 1, len(settings))
    return out
