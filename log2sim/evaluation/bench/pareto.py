"""Which settings are worth their time: the Pareto front of error against run time, and what it says of the present one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from log2sim.evaluation.bench.bootstrap import LEAST_OBJECTS, Parts, share_not_worse

NO_ERROR = "no error of the present setting is known; objects have to be in sight for a second"
# Errors that differ by less are the same: logs are short, and a few objects more or less move them by as much.
SAME_ERROR = 0.05
# Part of the resamples in which a setting must do as well as the present one to take its place.
SURE = 0.9
# Nobody notices less than this share of the whole run's time.
SAME_TIME = 0.05


@dataclass(frozen=True)
class Point:
    """One setting of a stage: its time, its error (None where nothing tells it) and everything else that was measured.

    `parts` is what single objects have in the error, where it is known.
    """

    setting: str
    present: bool
    ms_per_tick: float
    error: float | None
    figures: dict[str, Any] = field(default_factory=dict)
    parts: Parts = field(default_factory=dict)


@dataclass(frozen=True)
class Verdict:
    """The setting that the figures support, None where they cannot tell, and a sentence that says why."""

    supported: str | None
    present: str
    reason: str

    @property
    def agrees(self) -> bool:
        """Whether the present setting is the supported one."""
        return self.supported == self.present


def pareto_front(cost: ArrayLike, error: ArrayLike) -> NDArray[np.bool_]:
    """Mask (K,) of the points (K,), (K,) that no other beats in one without losing in the other; NaN is never on it."""
    c, e = np.asarray(cost, dtype=np.float64), np.asarray(error, dtype=np.float64)
    known = np.isfinite(c) & np.isfinite(e)
    no_worse = (c[None] <= c[:, None]) & (e[None] <= e[:, None])
    better = (c[None] < c[:, None]) | (e[None] < e[:, None])
    beaten = (no_worse & better).any(axis=1)
    return known & ~beaten


def front_of(points: Sequence[Point]) -> NDArray[np.bool_]:
    """Mask (K,) of the points on the front."""
    return pareto_front([p.ms_per_tick for p in points], [np.nan if p.error is None else p.error for p in points])


def judge(points: Sequence[Point], unit: str, whole_ms: float) -> Verdict:
    """Choose among the settings of a stage: least error, and the cheapest of those whose error is about as small.

    Another setting takes the present one's place only where that is no matter of chance.

    Parameters
    ----------
    points : sequence of Point
        One of them is the present setting.
    unit : str
        Of the error, for the sentence.
    whole_ms : float
        What a tick of a whole run takes, ms; a stage's time is weighed against it.
    """
    present = next(p for p in points if p.present)
    others = [p for p in points if p.error is not None and p is not present]
    if present.error is None:
        return Verdict(None, present.setting, NO_ERROR)
    if not others:
        return Verdict(present.setting, present.setting, f"there is nothing but {present.setting} to choose")
    better = [p for p in others if _gains(p, present, whole_ms)]
    sure = [p for p in better if _sureness(p, present) >= SURE]
    if sure:
        chosen = _choose(sure)
        return Verdict(chosen.setting, present.setting, _instead(chosen, present, unit))
    best = _choose(better or others)
    reason = f"{present.setting} stays: {_figures(present, unit)}; "
    if better:
        reason += f"{best.setting} may be better or not: {_figures(best, unit)}{_sure_words(best, present)}"
    else:
        reason += f"next is {best.setting}: {_figures(best, unit)}"
    return Verdict(present.setting, present.setting, reason)


def _gains(point: Point, present: Point, whole_ms: float) -> bool:
    """Whether a setting looks better than the present one: less error, or about the same in clearly less time."""
    error, known = point.error or 0.0, present.error or 0.0
    cheaper = present.ms_per_tick - point.ms_per_tick > SAME_TIME * whole_ms
    return error < known * (1 - SAME_ERROR) or (cheaper and error <= known * (1 + SAME_ERROR))


def _sureness(point: Point, present: Point) -> float:
    """Share of resamples in which a setting is no worse than the present one, where the objects' parts are known."""
    if not point.parts or not present.parts:
        return 1.0
    return share_not_worse(point.parts, present.parts, SAME_ERROR if point.ms_per_tick < present.ms_per_tick else 0.0)


def _choose(points: Sequence[Point]) -> Point:
    """The cheapest of those whose error is about the least."""
    least = min(p.error or 0.0 for p in points)
    return min((p for p in points if (p.error or 0.0) <= least * (1 + SAME_ERROR)), key=lambda p: p.ms_per_tick)


def _instead(chosen: Point, present: Point, unit: str) -> str:
    figures = f"{_figures(chosen, unit)} against {_figures(present, unit)}"
    return f"{chosen.setting} rather than {present.setting}: {figures}{_sure_words(chosen, present)}"


def _sure_words(point: Point, present: Point) -> str:
    if not point.parts:
        return ""
    few = len({*point.parts, *present.parts}) < LEAST_OBJECTS
    return ", too few objects to tell" if few else f", {_sureness(point, present):.0%} sure"


def _figures(point: Point, unit: str) -> str:
    return f"{short(point.error)}{f' {unit}' * bool(unit)}, {short(point.ms_per_tick)} ms"


def short(value: float | None) -> str:
    """Three digits that count, "-" for None."""
    return "-" if value is None else f"{value:.3g}" if abs(value) < 999.5 else f"{value:.0f}"
