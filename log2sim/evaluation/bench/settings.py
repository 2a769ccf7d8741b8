"""Settings to compare, the Pareto front of error against run time, and whether one error is smaller by chance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from log2sim.config import AUTO, Config, Section
from log2sim.datatypes import Log
from log2sim.errors import ConfigError
from log2sim.perception.detect.onnx_detector import OnnxDetector, plan_tiles
from log2sim.perception.run_detectors import create_image_detector
from log2sim.plan import IMAGE_DETECTOR, choose_detector

# By object: sum of its squared errors, m^2, and their number. The error is the root of the ratio of both sums.
ErrorSums = Mapping[str, tuple[float, float]]
RESAMPLES = 1000
MIN_OBJECTS = 5
INTERVAL = (0.05, 0.95)


def _resamples(count: int) -> NDArray[np.int64]:
    # How often each of some objects is in each resample (`RESAMPLES`, count).
    return np.random.default_rng(0).multinomial(count, np.full(count, 1 / count), size=RESAMPLES)


def error_of(sums: ErrorSums) -> float | None:
    """Compute the root mean square error, m, of all objects; None without any."""
    squares, count = (sum(column) for column in zip(*sums.values())) if sums else (0.0, 0.0)
    return float(np.sqrt(squares / count)) if count > 0 else None


def error_interval(sums: ErrorSums) -> tuple[float, float] | None:
    """Compute the quantiles `INTERVAL` of an error, m, over resamples of its objects; None with fewer than `MIN_OBJECTS`."""
    if len(sums) < MIN_OBJECTS:
        return None
    drawn = _resamples(len(sums)) @ np.array([sums[name] for name in sorted(sums)])
    drawn = drawn[drawn[:, 1] > 0]
    low, high = np.sqrt(np.quantile(drawn[:, 0] / drawn[:, 1], INTERVAL))
    return float(low), float(high)


TILES = (0, 1, 2, 3, 5)  # numbers of tiles to try besides the present one; 0 is "auto"
SIDES_PX = (320, 416, 640, 960)  # input sizes to try with models that accept any
HYPOTHESES = (8, 30, 100, 300, 1000, 3000)  # numbers of RANSAC hypotheses to try besides the present one
NO_METHOD = "off"


@dataclass(frozen=True)
class Setting:
    """One setting of a stage."""

    stage: str
    name: str  # within the stage
    config: Config  # of the whole run
    present: bool  # whether it is the present setting

    @property
    def key(self) -> str:
        """Return its name among the settings of all stages."""
        return f"{self.stage}: {self.name}"


@dataclass(frozen=True)
class Grid:
    """The settings of every stage, the present one first; each other differs from it in one stage only."""

    detect: tuple[Setting, ...]
    measure: tuple[Setting, ...]
    homography: tuple[Setting, ...]
    hypotheses: tuple[Setting, ...]
    smooth: tuple[Setting, ...]

    @property
    def present(self) -> Setting:
        """Return the present setting of the detector in images."""
        return self.detect[0]


def make_grid(log: Log, config: Config, detectors: Sequence[str] = ()) -> Grid:
    """List the settings to compare on a log, each differing from the present ones in one stage.

    `config`: the present settings. `topdown.method` "off" is replaced by the first method. `detectors`: detectors to
    compare with the present one: names, or paths of ONNX files. Raises `ConfigError` or `MissingExtra` for a detector that
    cannot be loaded.
    """
    if config.detect.name == AUTO:
        config = config.changed(detect={"name": IMAGE_DETECTOR})
    if config.topdown.method == NO_METHOD:
        config = config.changed(topdown={"method": choices(config.topdown, "method")[0]})
    # Methods other than the present one are fitted to each camera alone.
    present, *others = _choices("homography", config, "topdown", "method")
    homography = [present, *(replace(s, config=s.config.changed(topdown={"rig": "apart"})) for s in others)]
    if len(config.cameras or log.cameras) > 1:
        rig = choices(config.topdown, "rig")[1]
        homography.append(Setting("homography", f"cameras {rig}", config.changed(topdown={"rig": rig}), False))
    # Of other numbers of hypotheses only homographies are scored, no whole runs.
    hypotheses = [
        Setting("homography", f"{n} hypotheses", config.changed(topdown={"hypotheses": n}), False)
        for n in HYPOTHESES
        if n != config.topdown.hypotheses
    ]
    on, other = config.smooth.enabled, config.changed(smooth={"enabled": not config.smooth.enabled})
    smooth = (
        Setting("smooth", "on" if on else "off", config, True),
        Setting("smooth", "off" if on else "on", other, False),
    )
    return Grid(
        detect=tuple(_detector_settings(log, config, detectors)),
        measure=_choices("measure", config, "measure", "mode"),
        homography=tuple(homography),
        hypotheses=tuple(hypotheses),
        smooth=smooth,
    )


def default_settings(log: Log, config: Config) -> tuple[Setting, ...]:
    """Return what `reconstruct` does with a log by these settings where it does more than search images, else nothing."""
    chosen = choose_detector(log, config)
    if config.detect.name != AUTO or not chosen.detect.in_sweeps:
        return ()
    return (Setting("whole run", f"reconstruct's default, {chosen.detect.name}", chosen, True),)


def choices(section: Section, key: str) -> list[str]:
    """List the allowed values of a setting, the present one first, without the one that leaves the stage out."""
    present = getattr(section, key)
    return [value for value in dict.fromkeys([present, *section.choices(key)]) if value != NO_METHOD]


def _choices(stage: str, config: Config, section: str, key: str) -> tuple[Setting, ...]:
    names = choices(getattr(config, section), key)
    return tuple(Setting(stage, name, config.changed(**{section: {key: name}}), k == 0) for k, name in enumerate(names))


def _detector_settings(log: Log, config: Config, detectors: Sequence[str]) -> list[Setting]:
    """List every detector with all distinct numbers of tiles, and with other input sizes where the model accepts them."""
    names = list(dict.fromkeys([config.detect.name, *detectors]))
    for name in names:
        if config.changed(detect={"name": name}).detect.in_sweeps:
            raise ConfigError(
                f"bench: compares detectors in images, '{name}' searches LiDAR sweeps; see log2sim detect"
            )
    out: list[Setting] = []
    stems = [Path(n).stem if n.endswith(".onnx") else n for n in names]
    for name, stem in zip(names, stems):
        own = config
        if name != config.detect.name:
            own = config.changed(detect={"name": name, "layout": "", "input_px": 0})
        label = f"{stem if stems.count(stem) == 1 else name} " if len(names) > 1 else ""
        detector = create_image_detector(log, own)
        if not isinstance(detector, OnnxDetector):
            out.append(Setting("detect", name, own, not out))
            continue
        # List names and settings of a detector with different inputs, the present one first
        inputs, seen = [], set()
        side = detector.model.spec.width_px or detector.layout.preprocessing.default_px
        cameras = [log.cameras[name] for name in own.cameras or log.cameras]
        for tiles in dict.fromkeys([own.detect.tiles, *TILES]):
            plan = tuple(len(plan_tiles(c.width_px, c.height_px, tiles or "auto", side)) for c in cameras)
            if plan not in seen:
                seen.add(plan)
                inputs.append(({0: "auto tiles", 1: "no tiles"}.get(tiles, f"{tiles} tiles"), "tiles", tiles))
        if detector.model.spec.width_px is None and detector.model.spec.height_px is None:
            usual = detector.layout.preprocessing.default_px
            inputs += [(f"input {side} px", "input_px", side) for side in SIDES_PX if side != usual]
        for title, key, value in inputs:
            out.append(Setting("detect", f"{label}{title}", own.changed(detect={key: value}), not out))
    return out


# Relative difference of errors that counts as none: on short logs a few objects more or less change them by as much.
ERROR_TOLERANCE = 0.05
# Fraction of bootstrap resamples in which a setting must be no worse than the present one to be recommended.
MIN_CONFIDENCE = 0.9
# Resamples are of the objects of one log, so that more certainty is never stated.
MAX_CONFIDENCE = 0.99
# Figures that say how many of the objects an error is of, in words.
COVERAGE = {"recall": "found", "placed_share": "placed"}
# Time saved must exceed this fraction of the whole run's time.
TIME_TOLERANCE = 0.05


@dataclass(frozen=True)
class Point:
    """One setting of a stage."""

    setting: str
    present: bool  # whether it is the present setting
    ms_per_tick: float  # ms
    error: float | None  # none when it cannot be computed
    figures: dict[str, Any] = field(default_factory=dict)  # everything else that was measured
    by_object: ErrorSums = field(default_factory=dict)  # contributions of single objects to the error, where known

    @property
    def coverage(self) -> dict[str, float]:
        """Shares of the objects that the setting finds, and that its homographies place, as far as they were measured."""
        return {name: self.figures[name] for name in COVERAGE if self.figures.get(name) is not None}

    def covers_as_many_as(self, other: Point) -> bool:
        """Return whether the setting finds and places as many objects as another one, within `ERROR_TOLERANCE`.

        Errors alone do not tell: a homography that places hardly anything invents little in a whole run, either.
        """
        mine = self.coverage
        return all(mine.get(name, 0.0) >= share * (1 - ERROR_TOLERANCE) for name, share in other.coverage.items())


@dataclass(frozen=True)
class Recommendation:
    """The recommended setting of a stage."""

    supported: str | None  # the setting that the figures support; None when they do not decide
    present: str
    reason: str

    @property
    def agrees(self) -> bool:
        """Whether the present setting is the supported one."""
        return self.supported == self.present


def pareto_front(cost: ArrayLike, error: ArrayLike) -> NDArray[np.bool_]:
    """Mark (K,) the Pareto-optimal points (K,), (K,); a point with a NaN is never one."""
    c, e = np.asarray(cost, dtype=np.float64), np.asarray(error, dtype=np.float64)
    no_worse = (c[None] <= c[:, None]) & (e[None] <= e[:, None])
    better = (c[None] < c[:, None]) | (e[None] < e[:, None])
    return np.isfinite(c) & np.isfinite(e) & ~(no_worse & better).any(axis=1)


def recommend(points: Sequence[Point], unit: str, whole_ms: float) -> Recommendation:
    """Recommend a setting of a stage: the fastest of those whose error is within `ERROR_TOLERANCE` of the smallest.

    Another setting replaces the present one only when it finds and places as many objects and is no worse with `MIN_CONFIDENCE`.

    `points`: one of them is the present setting. `unit`: of the error, for the reason. `whole_ms`: time of a whole run,
    ms a tick, which a stage's time is compared with.
    """
    present = next(p for p in points if p.present)
    others = [p for p in points if p.error is not None and p is not present]
    if present.error is None:
        reason = "no error of the present setting is known; objects have to be in sight for a second"
        return Recommendation(None, present.setting, reason)
    if not others:
        return Recommendation(present.setting, present.setting, f"there is nothing but {present.setting} to choose")
    # Those with less error than the present one, or about the same in clearly less time.
    better = []
    for p in others:
        error, cheaper = p.error or 0.0, present.ms_per_tick - p.ms_per_tick > TIME_TOLERANCE * whole_ms
        less = error < present.error * (1 - ERROR_TOLERANCE)
        same = error <= present.error * (1 + ERROR_TOLERANCE)
        better += [p] if p.covers_as_many_as(present) and (less or (cheaper and same)) else []
    sure = [p for p in better if _confidence(p, present) >= MIN_CONFIDENCE]
    if sure:
        chosen = _fastest_of_best(sure)
        figures = f"{_figures(chosen, unit)} against {_figures(present, unit)}{_confidence_text(chosen, present)}"
        reason = f"{chosen.setting} rather than {present.setting}: {figures}"
        return Recommendation(chosen.setting, present.setting, reason)
    best = _fastest_of_best(better or others)
    reason = f"{present.setting} stays: {_figures(present, unit)}; "
    if better:
        reason += f"{best.setting} may be better or not: {_figures(best, unit)}{_confidence_text(best, present)}"
    else:
        reason += f"next is {best.setting}: {_figures(best, unit)}"
    return Recommendation(present.setting, present.setting, reason)


def _confidence(point: Point, present: Point) -> float:
    """Compute the confidence that a setting is no worse than the present one; 1 when contributions of objects are unknown."""
    if not point.by_object or not present.by_object:
        return 1.0
    # The fraction of resamples in which an error is at most another one times `1 + allowance`
    allowance = ERROR_TOLERANCE if point.ms_per_tick < present.ms_per_tick else 0.0
    names = sorted({*point.by_object, *present.by_object})
    if len(names) < MIN_OBJECTS:
        return 0.0
    mine, theirs = (
        np.array([side.get(n, (0.0, 0.0)) for n in names]).reshape(-1, 2)
        for side in (point.by_object, present.by_object)
    )
    drawn = _resamples(len(names))
    a, b = drawn @ mine, drawn @ theirs
    usable = (a[:, 1] > 0) & (b[:, 1] > 0)
    if not usable.any():
        return 0.0
    a, b = a[usable], b[usable]
    return float(np.mean(a[:, 0] * b[:, 1] <= b[:, 0] * a[:, 1] * (1 + allowance) ** 2))


def _fastest_of_best(points: Sequence[Point]) -> Point:
    """Select the fastest of the points whose error is about the smallest."""
    least = min(p.error or 0.0 for p in points)
    return min((p for p in points if (p.error or 0.0) <= least * (1 + ERROR_TOLERANCE)), key=lambda p: p.ms_per_tick)


def _confidence_text(point: Point, present: Point) -> str:
    if not point.by_object:
        return ""
    few = len({*point.by_object, *present.by_object}) < MIN_OBJECTS
    sure = min(_confidence(point, present), MAX_CONFIDENCE)
    return ", too few objects to tell" if few else f", no worse in {sure:.0%} of resamples"


def _figures(point: Point, unit: str) -> str:
    shares = "".join(f", {share:.0%} {COVERAGE[name]}" for name, share in point.coverage.items())
    return f"{short(point.error)}{f' {unit}' * bool(unit)}{shares}, {short(point.ms_per_tick)} ms"


def short(value: float | None) -> str:
    """Format with three significant digits, "-" for None."""
    return "-" if value is None else f"{value:.3g}" if abs(value) < 999.5 else f"{value:.0f}"
