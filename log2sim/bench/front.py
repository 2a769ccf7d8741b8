"""Which settings are worth their time: the Pareto front of error against run time, and what it says of the present one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

# Errors that differ by less are the same: logs are short, and a few objects more or less move them by as much.
SAME_ERROR = 0.05
# Nobody notices less than this share of the whole run's time.
SAME_TIME = 0.05


@dataclass(frozen=True)
class Point:
    """One setting of a stage: its time, its error (None where nothing tells it) and everything else that was measured."""

    setting: str
    present: bool
    ms_per_tick: float
    error: float | None
    figures: dict[str, Any] = field(default_factory=dict)


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
    beaten = (no_worse & better & known[None]).any(axis=1)
    return known & ~beaten


def front_of(points: Sequence[Point]) -> NDArray[np.bool_]:
    """Mask (K,) of the points on the front."""
    return pareto_front([p.ms_per_tick for p in points], [np.nan if p.error is None else p.error for p in points])


def judge(points: Sequence[Point], unit: str, whole_ms: float) -> Verdict:
    """Choose among the settings of a stage: least error, and the cheapest of those whose error is about as small.

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
    known = [p for p in points if p.error is not None]
    if not known or present.error is None:
        return Verdict(None, present.setting, "no error is known")
    if len(known) == 1:
        return Verdict(present.setting, present.setting, f"{present.setting} is the only setting")
    least = min(p.error for p in known if p.error is not None)
    as_good = [p for p in known if p.error is not None and p.error <= least * (1 + SAME_ERROR)]
    chosen = min(as_good, key=lambda p: p.ms_per_tick)
    if present in as_good and present.ms_per_tick - chosen.ms_per_tick <= SAME_TIME * whole_ms:
        chosen = present
    if chosen is present:
        return Verdict(present.setting, present.setting, _stays(present, known, unit))
    return Verdict(chosen.setting, present.setting, _instead(chosen, present, unit))


def _stays(present: Point, known: Sequence[Point], unit: str) -> str:
    others = [p for p in known if p is not present]
    best = min(others, key=lambda p: p.error or 0.0)
    return (
        f"{present.setting} stays: {_figures(present, unit)}; the best other is {best.setting}: {_figures(best, unit)}"
    )


def _instead(chosen: Point, present: Point, unit: str) -> str:
    return f"{chosen.setting} rather than {present.setting}: {_figures(chosen, unit)} against {_figures(present, unit)}"


def _figures(point: Point, unit: str) -> str:
    return f"{point.error:.3g} {unit}, {point.ms_per_tick:.3g} ms"
