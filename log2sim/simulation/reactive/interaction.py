"""Demands of other agents on reactive agents at one time, beyond the demands in the scenario at the same place."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.simulation.reactive.foresight import Foresight
from log2sim.simulation.reactive.idm import IdmParameters, leader_demand
from log2sim.simulation.reactive.path_table import EXTENSION_M, PathTable, Pose
from log2sim.simulation.reactive.prediction import Prediction
from log2sim.simulation.reactive.swept_corridor import HORIZON_S, PredictedBoxes, SafetyMargins, SweptCorridor, leaders

MIN_LOOKAHEAD_M = 10.0  # also at standstill

MARGINS_NOW = SafetyMargins(side_m=0.2, crossing_m=1.0, crossing_s=0.5, behind_m=0.0)
MARGINS_IN_SCENARIO = SafetyMargins(side_m=0.5, crossing_m=2.5, crossing_s=0.8, behind_m=1.0)
GAP_M, SPEED_MPS = 0.5, 0.5
"""Tolerances, besides the difference of the margins, within which an interaction counts as that of the scenario."""

MIN_DEMAND = 1e-3  # share of the free acceleration below which a demand is ignored
PATH_HULL_MARGIN_M = 1.0  # how far paths may leave the hull of a few of their points

Index = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class TrafficState:
    """All agents (A,) at one time.

    Attributes
    ----------
    paths : PathTable
    idm : IdmParameters
    size_m : (A, 3) float64
    reacts : (A,) bool
        Whether an agent is reactive.
    driven : int
        The agent that a policy drives, -1 without.
    t_s : (A,) float64
        Time on the scenario of each agent.
    rate : (A,) float64
        Rate at which each agent passes its trajectory.
    pose : Pose
        Where the agents are, (A,).
    prediction : Prediction
        Where they are expected to go, (A, H).
    foresight : Foresight
        What expects it.
    """

    paths: PathTable
    idm: IdmParameters
    size_m: Array
    reacts: NDArray[np.bool_]
    driven: int
    t_s: Array
    rate: Array
    pose: Pose
    prediction: Prediction
    foresight: Foresight

    def reach_m(self, i: Index) -> Array:
        """Return the look-ahead distance of agents (P,): a comfortable stop and a reserve."""
        pace, d = np.abs(self.pose.speed_mps[i]), self.idm.take(i)
        stop_m = pace * (d.time_gap_s + HORIZON_S[-1]) + pace**2 / (2 * d.comfort_mps2)
        result: Array = np.minimum(MIN_LOOKAHEAD_M + stop_m + self.size_m[i, 0], EXTENSION_M)
        return result

    def meeting(self, i: Index, j: Index) -> tuple[Index, Index]:
        """Select those of the pairs (P,), (P,) that may come near each other within the horizon."""
        p, radius = self.pose, np.hypot(self.size_m[:, 0], self.size_m[:, 1]) / 2
        reach = self.reach_m(i) + np.abs(p.speed_mps[j]) * HORIZON_S[-1] + radius[i] + radius[j]
        near = (p.x_m[i] - p.x_m[j]) ** 2 + (p.y_m[i] - p.y_m[j]) ** 2 < reach**2
        i, j = i[near], j[near]
        level = self._level(i, j)
        i, j = i[level], j[level]
        # Four boxes about the path ahead exclude most agents within the circle, above all those in other lanes.
        x, y = (np.ascontiguousarray(c[:, ::4].T) for c in self.prediction[:2])
        swept = self._hull(i, x[:, j], y[:, j])
        room = radius[j] + self.size_m[i, 1] / 2 + MARGINS_IN_SCENARIO.side_m + PATH_HULL_MARGIN_M
        own = np.flatnonzero(self.reacts)
        ahead = np.linspace(0.0, 1.0, 13)[:, None] * self.reach_m(own)
        x, y, *_ = self.paths.along(own[None], self.pose.distance_m[own] + ahead)
        meets, slot = np.zeros(len(i), dtype=bool), np.searchsorted(own, i)
        for part in (slice(0, 4), slice(3, 7), slice(6, 10), slice(9, 13)):
            section = self._hull(own, x[part], y[part])
            apart = [
                (low > end[slot] + room) | (high < begin[slot] - room)
                for (low, high), (begin, end) in zip(swept, section)
            ]
            meets |= ~(apart[0] | apart[1])
        return i[meets], j[meets]

    def _level(self, i: Index, j: Index) -> NDArray[np.bool_]:
        """Whether agents j (P,) are at the height of agents i (P,), or of the paths of these that far ahead."""
        p = self.pose
        gap_m = np.hypot(p.x_m[i] - p.x_m[j], p.y_m[i] - p.y_m[j])
        ahead_m = self.paths.at(i, self.paths.times(i, p.distance_m[i] + gap_m)).z_m
        apart_m = np.minimum(np.abs(p.z_m[i] - p.z_m[j]), np.abs(ahead_m - p.z_m[j]))
        result: NDArray[np.bool_] = apart_m < (self.size_m[i, 2] + self.size_m[j, 2]) / 2
        return result

    def _hull(self, i: Index, x_m: Array, y_m: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        """Return minimum and maximum of points (N, P), ahead and to the left of agents i (P,)."""
        cos, sin = np.cos(self.pose.yaw_rad[i]), np.sin(self.pose.yaw_rad[i])
        dx, dy = x_m - self.pose.x_m[i], y_m - self.pose.y_m[i]
        ahead, left = dx * cos + dy * sin, dy * cos - dx * sin
        return (ahead.min(axis=0), ahead.max(axis=0)), (left.min(axis=0), left.max(axis=0))


def excess_demand(m: TrafficState, i: Index, j: Index, trusted: NDArray[np.bool_]) -> Array:
    """Return the share of the free acceleration of agents i (P,) that agents j (P,) take beyond the scenario.

    Where the scenario is not `trusted` (P,), the whole demand counts.
    """
    driver, logged_pace = m.idm.take(i), np.abs(m.pose.speed_mps[i])
    pace = m.rate[i] * logged_pace
    logged = m.paths.at(i[:, None], m.t_s[i][:, None] + HORIZON_S).distance_m - m.pose.distance_m[i][:, None]
    starting = pace[:, None] * HORIZON_S + driver.accel_mps2[:, None] * HORIZON_S**2 / 2
    means = np.where(m.rate[i][:, None] < 1, np.minimum(logged, starting), logged)
    x, y, yaw, speed = (c[j] for c in m.prediction)
    found = leaders(m.paths, _corridor(m, i, pace, means), _boxes(m, j, (x, y, yaw, speed)), MARGINS_NOW)
    # Where two reactive agents meet, the one that was first in the scenario goes first; an obstacle already in the path is
    # waited for.
    first = m.reacts[i] & m.reacts[j] & (found.ahead_s > 0)
    first &= found.own_t_s < m.t_s[j] + m.rate[j] * found.ahead_s
    gap = np.where(first & trusted, np.inf, found.gap_m)
    taken = leader_demand(driver, gap, pace, found.speed_mps)
    t_s = m.t_s[i]
    k = np.flatnonzero((taken > MIN_DEMAND) & trusted & (m.paths.begin_s[j] <= t_s) & (t_s <= m.paths.end_s[j]))
    if len(k):
        taken[k] -= _demand_in_scenario(m, i[k], j[k], gap[k], _corridor(m, i[k], logged_pace[k], logged[k]))
    return np.maximum(taken, 0.0)


def _demand_in_scenario(m: TrafficState, i: Index, j: Index, gap_m: Array, corridor: SweptCorridor) -> Array:
    """Return the demand of agents j (P,) in the scenario when agents i (P,) were here, as far as it applies now.

    The nearer the other agent is than it was in the scenario, the less of the scenario's demand counts; at half the gap
    none.
    """
    found = leaders(m.paths, corridor, _boxes(m, j, _predict_in_scenario(m, j, m.t_s[i])), MARGINS_IN_SCENARIO)
    gap = found.gap_m - GAP_M
    taken = leader_demand(m.idm.take(i), gap, corridor.pace_mps, found.speed_mps - SPEED_MPS)
    known = np.isfinite(gap)
    scale = np.maximum(np.where(known, gap, 0.0) / 2, 1.0)
    lost = np.where(known, np.maximum(np.where(known, gap, 0.0) - gap_m, 0.0) / scale, 1.0)
    result: Array = np.maximum(1 - lost, 0.0) * taken
    return result


def _corridor(m: TrafficState, i: Index, pace: Array, progress: Array) -> SweptCorridor:
    reach = float(m.reach_m(i).max())
    return SweptCorridor(i, m.pose.distance_m[i], m.size_m[i, 0], m.size_m[i, 1], pace, progress, reach)


def _boxes(m: TrafficState, j: Index, prediction: Prediction) -> PredictedBoxes:
    return PredictedBoxes(*prediction, m.size_m[j, 0], m.size_m[j, 1])


def predict_all(foresight: Foresight, t_s: float, pose: Pose, own_s: Array, rate: Array, driven: int) -> Prediction:
    """Predict all agents (A,) at a time, each of which is at its own time of the scenario `own_s` (A,)."""
    everyone = np.arange(len(own_s))
    prediction = foresight.expect(everyone, own_s, rate)
    return (
        prediction
        if driven < 0
        else _select(everyone == driven, foresight.expect_driven(driven, t_s, pose), prediction)
    )


def _predict_in_scenario(m: TrafficState, j: Index, t_s: Array) -> Prediction:
    """Predict agents (P,) from the scenario at times (P,), by the same rules."""
    prediction = m.foresight.expect(j, t_s, np.ones(len(j)))
    if not np.any(j == m.driven):
        return prediction
    return _select(j == m.driven, m.foresight.expect_driven_in_scenario(m.driven, t_s), prediction)


def _select(mask: NDArray[np.bool_], one: Prediction, other: Prediction) -> Prediction:
    x, y, yaw, speed = (np.where(mask[:, None], a, b) for a, b in zip(one, other))
    return x, y, yaw, speed
