"""Samples a scenario and its truth at the same instants, in the same frame, as columns."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import GROUP_OF, Agent, Scenario
from log2sim.evaluation.metrics.pairs import Mask
from log2sim.geometry import NS_PER_S, Array, nearest_index

MAX_TRUTH_GAP_S = 0.25
MAX_SIMPLIFIED_GAP_S = 1.05
"""Simplified trajectories omit waypoints of straight uniform motion for up to a second."""

MIN_TICK_S = 0.02
"""Instants taken from the waypoints of all agents are not nearer to each other: some logs stamp every label by itself."""

TRUTH_MARGIN_S = 0.15
"""A truth agent is extrapolated this far beyond its first and last label, without being counted there."""


@dataclass(frozen=True, eq=False)
class StateTable:
    """States of A agents at T ticks; NaN where an agent is absent.

    Attributes
    ----------
    ids : tuple of str
    category, group : (A,) str
    size_m : (A, 3) float64, m
    xy_m : (A, T, 2) float64, m
        Box centers, the scenario's map frame.
    z_m : (A, T) float64, m
    yaw_rad : (A, T) float64
    speed_mps : (A, T) float64, m/s
    range_m : (A, T) float64, m
        From the ego's center; infinite without an ego.
    visible : (A, T) bool
        False where the truth does not count.
    labeled : (A, T) bool
        False where the truth's state is interpolated over a gap of its labels or extrapolated.
    lidar_points : (A, T) float64
        LiDAR points in the truth's box; NaN where they were not counted.
    """

    ids: tuple[str, ...]
    category: NDArray[np.str_]
    group: NDArray[np.str_]
    size_m: Array
    xy_m: Array
    z_m: Array
    yaw_rad: Array
    speed_mps: Array
    range_m: Array
    visible: Mask
    labeled: Mask
    lidar_points: Array

    @property
    def present(self) -> Mask:
        """Mark (A, T) the ticks at which each agent is present."""
        return np.isfinite(self.xy_m[..., 0])


def evaluation_ticks_s(scenario: Scenario, truth: Scenario) -> Array:
    """Choose the instants (T,), seconds of the scenario, at which to compare; all within the time of the truth.

    Notes
    -----
    These are the times of the ego's waypoints. When they are on average more than 0.25 s apart, which simplification does,
    the waypoints of all agents are added, and when that is not enough, those of the truth, at least `MIN_TICK_S` apart.
    """
    shift_s = (truth.t0_ns - scenario.t0_ns) / NS_PER_S
    ego = scenario.ego
    ours = [a.waypoints.t_s for a in scenario.agents]
    theirs = [a.waypoints.t_s + shift_s for a in truth.agents]
    if not theirs:
        return np.zeros(0)
    first, last = min(t[0] for t in theirs), max(t[-1] for t in theirs)
    # A scenario without agents misses every truth agent during its duration.
    begin = min((t[0] for t in ours), default=0.0)
    end = max((t[-1] for t in ours), default=scenario.duration_s)
    ego_t_s = np.zeros(0) if ego is None else ego.waypoints.t_s
    for times in ([] if ego is None else [ego_t_s], ours, ours + theirs):
        if not times:
            continue
        # Agents of one tick may differ in the last digits of their stamps.
        _, index = np.unique(np.round(np.concatenate(times), 4), return_index=True)
        t = np.sort(np.concatenate(times)[index])
        t = _thinned(t, ego_t_s)
        t = t[(t >= max(first, begin) - TRUTH_MARGIN_S) & (t <= min(last, end) + TRUTH_MARGIN_S)]
        if len(t) > 1 and (t[-1] - t[0]) / (len(t) - 1) <= MAX_TRUTH_GAP_S:
            break
    return t


def _thinned(t_s: Array, wanted_s: Array) -> Array:
    """Keep of increasing instants (T,) those wanted, and others at least `MIN_TICK_S` from these and each other."""
    wanted = np.isin(t_s, wanted_s)
    away = np.full(len(t_s), np.inf)
    if wanted.any():
        away = np.abs(t_s - t_s[wanted][nearest_index(t_s[wanted], t_s)])
    keep, last_s = wanted.copy(), -np.inf
    for k in np.flatnonzero(away >= MIN_TICK_S):
        if t_s[k] - last_s >= MIN_TICK_S:
            keep[k], last_s = True, t_s[k]
    return t_s[keep]


def reconstructed_states(agents: tuple[Agent, ...], ticks_s: Array, ego_xy: Array | None) -> StateTable:
    """Sample reconstructed agents at the ticks (T,); `ego_xy` (T, 2), m, or None."""
    sampled = [a.at(ticks_s) for a in agents]
    xy = _stack([np.stack([s.x_m, s.y_m], -1) for s in sampled], (len(ticks_s), 2))
    yaw = _stack([s.yaw_rad for s in sampled], (len(ticks_s),))
    speed = _stack([s.speed_mps for s in sampled], (len(ticks_s),))
    z = _stack([s.z_m for s in sampled], (len(ticks_s),))
    there, unknown = np.isfinite(yaw), np.full(yaw.shape, np.nan)
    return _table(
        agents, ego_xy, xy_m=xy, z_m=z, yaw_rad=yaw, speed_mps=speed, visible=there, labeled=there, lidar_points=unknown
    )


def truth_states(agents: tuple[Agent, ...], ticks_s: Array, shift_m: Array, ego_xy: Array | None) -> StateTable:
    """Sample truth agents at the ticks (seconds of the truth), moved by `shift_m`.

    Notes
    -----
    `visible` is that of the nearest waypoint. In gaps longer than 0.25 s and outside the trajectory it is False: there an
    interpolated or extrapolated box only prevents a reconstructed agent from counting as false.
    """
    columns = [_sample_truth(a, ticks_s) for a in agents]
    xy = _stack([c[0] for c in columns], (len(ticks_s), 2)) + shift_m[:2]
    z = _stack([c[1] for c in columns], (len(ticks_s),)) + shift_m[2]
    yaw = _stack([c[2] for c in columns], (len(ticks_s),))
    speed = _stack([c[3] for c in columns], (len(ticks_s),))
    visible, labeled = (_stack([c[k].astype(np.float64) for c in columns], (len(ticks_s),)) > 0 for k in (4, 5))
    points = _stack([c[6] for c in columns], (len(ticks_s),))
    seen = {"visible": visible & labeled, "labeled": labeled, "lidar_points": points}
    return _table(agents, ego_xy, xy_m=xy, z_m=z, yaw_rad=yaw, speed_mps=speed, **seen)


def ego_states(
    scenario: Scenario, truth: Scenario, ticks_s: Array, truth_ticks_s: Array, shift_m: Array
) -> StateTable | None:
    """Sample the ego as one row, the true one at the ticks at which it is known; None without an ego."""
    ours = None if scenario.ego is None else reconstructed_states((scenario.ego,), ticks_s, None)
    if truth.ego is None:
        return ours
    true = truth_states((truth.ego,), truth_ticks_s, shift_m, None)
    if ours is None:
        return true
    xy_m = np.where(true.present[..., None], true.xy_m, ours.xy_m)
    return replace(true, xy_m=xy_m, yaw_rad=np.where(true.present, true.yaw_rad, ours.yaw_rad))


def _sample_truth(agent: Agent, t: Array) -> tuple[Array, Array, Array, Array, Mask, Mask, Array]:
    w = agent.waypoints
    s = agent.at(np.clip(t, w.t_s[0], w.t_s[-1]))
    outside = t - np.clip(t, w.t_s[0], w.t_s[-1])
    step = s.speed_mps * outside
    xy = np.stack([s.x_m + step * np.cos(s.yaw_rad), s.y_m + step * np.sin(s.yaw_rad)], -1)
    present = np.abs(outside) <= TRUTH_MARGIN_S
    nearest = nearest_index(w.t_s, t)
    visible = np.ones(len(t), dtype=bool) if w.visible is None else w.visible[nearest]
    points = np.full(len(t), np.nan) if w.lidar_points is None else w.lidar_points[nearest]
    points = np.where(np.abs(w.t_s[nearest] - t) <= MAX_TRUTH_GAP_S, points, np.nan)
    # Simplified, a static agent has its first and last waypoint only, and one in straight motion a few.
    simplified = bool(agent.quality.get("waypoints_left_out"))
    max_gap_s = np.inf if agent.static and len(w) == 2 else MAX_SIMPLIFIED_GAP_S if simplified else MAX_TRUTH_GAP_S
    labeled = agent.at(t, max_gap_s=float(max_gap_s)).valid
    nan = np.where(present, 0.0, np.nan)
    return xy + nan[:, None], s.z_m + nan, s.yaw_rad + nan, s.speed_mps + nan, visible, labeled, points + nan


def _table(agents: tuple[Agent, ...], ego_xy: Array | None, **columns: Any) -> StateTable:
    """Complete the sampled columns with what is constant for each agent, and with the distance from the ego."""
    category = np.array([a.category for a in agents], dtype="<U16")
    if ego_xy is None:
        range_m = np.where(np.isfinite(columns["yaw_rad"]), np.inf, np.nan)
    else:
        range_m = np.hypot(*np.moveaxis(columns["xy_m"] - ego_xy, -1, 0))
    return StateTable(
        ids=tuple(a.id for a in agents),
        category=category,
        group=np.array([GROUP_OF.get(c, "other") for c in category], dtype="<U16"),
        size_m=np.array([a.size_m for a in agents], dtype=np.float64).reshape(-1, 3),
        range_m=range_m,
        **columns,
    )


def _stack(rows: list[Array], shape: tuple[int, ...]) -> Array:
    return np.stack(rows) if rows else np.zeros((0, *shape))
