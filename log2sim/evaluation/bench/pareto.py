"""Pareto front of error against run time, and the recommended setting of a stage."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from log2sim.evaluation.bench.bootstrap import MIN_OBJECTS, ErrorSums, confidence_not_worse

NO_ERROR = "no error of the present setting is known; objects have to be in sight for a second"
# Relative difference of errors that counts as none: on short logs a few objects more or less change them by as much.
ERROR_TOLERANCE = 0.05
# Fraction of bootstrap resamples in which a setting must be no worse than the present one to be recommended.
MIN_CONFIDENCE = 0.9
# A log has no objects but its own, so resamples of them never make sure.
MAX_CONFIDENCE = 0.99
# Figures that say how many of the objects an error is of, in words.
COVERAGE = {"recall": "found", "placed_share": "placed"}
# Time saved must exceed this fraction of the whole run's time.
TIME_TOLERANCE = 0.05


@dataclass(frozen=True)
class Point:
    """One setting of a stage.

    Attributes
    ----------
    setting : str
    present : bool
        Whether it is the present setting.
    ms_per_tick : float, ms
    error : float or None
        None when it cannot be computed.
    figures : dict
        Everything else that was measured.
    by_object : ErrorSums
        Contributions of single objects to the error, where known.
    """

    setting: str
    present: bool
    ms_per_tick: float
    error: float | None
    figures: dict[str, Any] = field(default_factory=dict)
    by_object: ErrorSums = field(default_factory=dict)

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
    """The recommended setting of a stage.

    Attributes
    ----------
    supported : str or None
        The setting that the figures support; None when they do not decide.
    present : str
    reason : str
    """

    supported: str | None
    present: str
    reason: str

    @property
    def agrees(self) -> bool:
        """Whether the present setting is the supported one."""
        return self.supported == self.present


def pareto_front(cost: ArrayLike, error: ArrayLike) -> NDArray[np.bool_]:
    """Mark (K,) the Pareto-optimal points (K,), (K,); a point with a NaN is never one."""
    c, e = np.asarray(cost, dtype=np.float64), np.asarray(error, dtype=np.float64)
    known = np.isfinite(c) & np.isfinite(e)
    no_worse = (c[None] <= c[:, None]) & (e[None] <= e[:, None])
    better = (c[None] < c[:, None]) | (e[None] < e[:, None])
    beaten = (no_worse & better).any(axis=1)
    return known & ~beaten


def front_mask(points: Sequence[Point]) -> NDArray[np.bool_]:
    """Mark (K,) the points on the Pareto front."""
    return pareto_front([p.ms_per_tick for p in points], [np.nan if p.error is None else p.error for p in points])


def recommend(points: Sequence[Point], unit: str, whole_ms: float) -> Recommendation:
    """Recommend a setting of a stage: the fastest of those whose error is within `ERROR_TOLERANCE` of the smallest.

    Another setting replaces the present one only when it finds and places as many objects and is no worse with `MIN_CONFIDENCE`.

    Parameters
    ----------
    points : sequence of Point
        One of them is the present setting.
    unit : str
        Of the error, for the reason.
    whole_ms : float
        Time of a whole run, ms a tick, which a stage's time is compared with.
    """
    present = next(p for p in points if p.present)
    others = [p for p in points if p.error is not None and p is not present]
    if present.error is None:
        return Recommendation(None, present.setting, NO_ERROR)
    if not others:
        return Recommendation(present.setting, present.setting, f"there is nothing but {present.setting} to choose")
    better = [p for p in others if p.covers_as_many_as(present) and _gains(p, present, whole_ms)]
    sure = [p for p in better if _confidence(p, present) >= MIN_CONFIDENCE]
    if sure:
        chosen = _fastest_of_best(sure)
        return Recommendation(chosen.setting, present.setting, _replacement_text(chosen, present, unit))
    best = _fastest_of_best(better or others)
    reason = f"{present.setting} stays: {_figures(present, unit)}; "
    if better:
        reason += f"{best.setting} may be better or not: {_figures(best, unit)}{_confidence_text(best, present)}"
    else:
        reason += f"next is {best.setting}: {_figures(best, unit)}"
    return Recommendation(present.setting, present.setting, reason)


def _gains(point: Point, present: Point, whole_ms: float) -> bool:
    """Tell whether a setting has less error than the present one, or about the same in clearly less time."""
    error, known = point.error or 0.0, present.error or 0.0
    cheaper = present.ms_per_tick - point.ms_per_tick > TIME_TOLERANCE * whole_ms
    return error < known * (1 - ERROR_TOLERANCE) or (cheaper and error <= known * (1 + ERROR_TOLERANCE))


def _confidence(point: Point, present: Point) -> float:
    """Compute the confidence that a setting is no worse than the present one; 1 when contributions of objects are unknown."""
    if not point.by_object or not present.by_object:
        return 1.0
    return confidence_not_worse(
        point.by_object, present.by_object, ERROR_TOLERANCE if point.ms_per_tick < present.ms_per_tick else 0.0
    )


def _fastest_of_best(points: Sequence[Point]) -> Point:
    """Select the fastest of the points whose error is about the smallest."""
    least = min(p.error or 0.0 for p in points)
    return min((p for p in points if (p.error or 0.0) <= least * (1 + ERROR_TOLERANCE)), key=lambda p: p.ms_per_tick)


def _replacement_text(chosen: Point, present: Point, unit: str) -> str:
    figures = f"{_figures(chosen, unit)} against {_figures(present, unit)}"
    return f"{chosen.setting} rather than {present.setting}: {figures}{_confidence_text(chosen, present)}"


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
