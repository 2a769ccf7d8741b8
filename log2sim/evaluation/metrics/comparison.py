"""Truth and reconstruction at the same ticks, in one frame, matched as CLEAR MOT does, with what counts on either side."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Agent, AgentTable, IgnoreRegions, Scenario
from log2sim.evaluation.metrics.truth import MIN_POINTS, image_samples
from log2sim.files.arrays import Columns
from log2sim.geometry import NS_PER_S, Array, PoseTrack, choose_pairs, inverse, nearest_index

Index = NDArray[np.int64]
Mask = NDArray[np.bool_]
GATE_M = 2.0
GATE_PER_LENGTH = 0.25


def gate_m(length_m: Array) -> Array:
    """Compute the gate (A,), m: the largest distance of matching box centers, by the truth's length (A,), m.

    nuScenes matches within 2 m. The center of a partly visible bus or truck is uncertain by more, so the gate is at least a
    quarter of the length.
    """
    return np.maximum(GATE_M, GATE_PER_LENGTH * np.asarray(length_m, dtype=np.float64))


@dataclass(frozen=True, eq=False)
class AgentPairs(Columns):
    """Pairs within the gate, sorted by tick."""

    tick: Index  # (P,)
    # truth, other: (P,) indices of the truth agent and of the reconstructed agent.
    truth: Index
    other: Index
    distance_m: Array  # (P,)
    similarity: Array  # (P,) 1 - distance / gate; 0 across groups of categories
    same_group: Mask  # (P,)

    def bounds(self, ticks: int) -> Index:
        """Return row numbers (T + 1,): the pairs of tick t are rows bounds[t] to bounds[t + 1]."""
        return np.searchsorted(self.tick, np.arange(ticks + 1))


def near_pairs(truth_xy: Array, other_xy: Array, gates_m: Array, same_group: Mask) -> AgentPairs:
    """Collect the pairs within the gate.

    `truth_xy`, `other_xy` (A, T, 2), (B, T, 2), m: box centers in one frame, NaN where an agent is absent. `gates_m`
    (A,). `same_group` (A, B).
    """
    found: list[tuple[Index, ...]] = []
    distances = []
    for t in range(truth_xy.shape[1]):
        a, b = np.flatnonzero(np.isfinite(truth_xy[:, t, 0])), np.flatnonzero(np.isfinite(other_xy[:, t, 0]))
        gap = truth_xy[a, None, t] - other_xy[None, b, t]
        distance = np.hypot(gap[..., 0], gap[..., 1])
        i, j = np.nonzero(distance <= gates_m[a, None])
        found.append((np.full(len(i), t), a[i], b[j]))
        distances.append(distance[i, j])
    none = np.zeros(0, dtype=np.int64)
    tick, truth, other = (np.concatenate(column) for column in zip((none, none, none), *found))
    distance_m = np.concatenate([np.zeros(0), *distances])
    same = same_group[truth, other]
    similarity = np.where(same, 1 - distance_m / gates_m[truth], 0.0)
    return AgentPairs(tick, truth, other, distance_m, similarity, same)


def associate(pairs: AgentPairs, truths: int, others: int, ticks: int) -> tuple[Index, Mask, Mask]:
    """Match agents tick by tick, keeping what was matched before while it is within the gate.

    Returns, of A truth agents and B reconstructed agents at T ticks: (A, T) index of the reconstructed agent, -1 for none;
    (B, T) those matched within their group of categories; (B, T) others that are at a labeled object of another group.

    Bernardin and Stiefelhagen (2008), section 2.2.1: previous matches within the gate are kept, then the remaining agents
    are matched with the most pairs and the least total distance. A truth agent keeps its previous match over gaps. When two
    truth agents have the same previous match, the nearer one keeps it.
    """
    match = np.full((truths, ticks), -1, dtype=np.int64)
    used, absorbed = np.zeros((others, ticks), dtype=bool), np.zeros((others, ticks), dtype=bool)
    last = np.full(truths, -1, dtype=np.int64)
    bounds = pairs.bounds(ticks)
    for t in range(ticks):
        near = pairs.take(np.arange(bounds[t], bounds[t + 1]))
        for same_group_only, choose in ((True, _kept), (True, _nearest), (False, _nearest)):
            free = (match[near.truth, t] < 0) & ~used[near.other, t] & (near.same_group | (not same_group_only))
            chosen = choose(near, np.flatnonzero(free), last)
            if same_group_only:
                match[near.truth[chosen], t] = near.other[chosen]
                used[near.other[chosen], t] = True
            else:
                absorbed[near.other[chosen], t] = True
        last = np.where(match[:, t] >= 0, match[:, t], last)
    return match, used, absorbed


def _kept(near: AgentPairs, rows: Index, last: Index) -> Index:
    """Select the candidate `rows` that continue the last match of their truth agent; the nearest of several."""
    rows = rows[last[near.truth[rows]] == near.other[rows]]
    rows = rows[np.argsort(near.distance_m[rows], kind="stable")]
    _, first = np.unique(near.other[rows], return_index=True)
    return rows[first]


def _nearest(near: AgentPairs, rows: Index, last: Index) -> Index:
    """Select of the candidate `rows` the most pairs with the least total distance."""
    distance = near.distance_m[rows]
    # One more pair always outweighs any saving in distance.
    bonus = 1.0 + distance.sum()
    return rows[choose_pairs(near.truth[rows], near.other[rows], distance, bonus)]


def switches(match: NDArray[np.int64], counted: Mask) -> Mask:
    """Mark (A, T) identity switches: counted ticks with another match than at the last counted tick with one."""
    held = np.where(counted, match, -1)
    out = np.zeros(match.shape, dtype=bool)
    last = np.full(len(match), -1, dtype=np.int64)
    for t in range(match.shape[1]):
        now = held[:, t]
        out[:, t] = (now >= 0) & (last >= 0) & (now != last)
        last = np.where(now >= 0, now, last)
    return out


def mota(truth_ticks: int, missed: int, false: int, id_switches: int) -> float | None:
    """Compute the multiple object tracking accuracy, 1 - (misses + false + switches) / truth; None without truth."""
    return 1 - (missed + false + id_switches) / truth_ticks if truth_ticks else None


MAX_TRUTH_GAP_S = 0.25
MAX_SIMPLIFIED_GAP_S = 1.05  # simplified trajectories omit waypoints of straight uniform motion for up to a second
# Instants taken from the waypoints of all agents are not nearer to each other: some logs stamp every label by itself.
MIN_TICK_S = 0.02
# A truth agent is extrapolated this far beyond its first and last label, without being counted there.
TRUTH_MARGIN_S = 0.15


@dataclass(frozen=True, eq=False)
class StateTable(AgentTable):
    """Agents at T ticks with what makes them count.

    `range_m` (A, T), m: from the ego's center; infinite without an ego. `visible` (A, T): False where the truth does
    not count. `labeled` (A, T): False where the truth's state is interpolated over a gap of its labels or extrapolated.
    `lidar_points` (A, T): LiDAR points in the truth's box; NaN where they were not counted.
    """

    range_m: Array
    visible: Mask
    labeled: Mask
    lidar_points: Array


def evaluation_ticks_s(scenario: Scenario, truth: Scenario) -> Array:
    """Choose the instants (T,), seconds of the scenario, at which to compare; all within the time of the truth.

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
        # Those of the ego stay, and others at least `MIN_TICK_S` from these and each other.
        wanted = np.isin(t, ego_t_s)
        away = np.full(len(t), np.inf)
        if wanted.any():
            away = np.abs(t - t[wanted][nearest_index(t[wanted], t)])
        kept, last_s = wanted.copy(), -np.inf
        for k in np.flatnonzero(away >= MIN_TICK_S):
            if t[k] - last_s >= MIN_TICK_S:
                kept[k], last_s = True, t[k]
        t = t[kept]
        t = t[(t >= max(first, begin) - TRUTH_MARGIN_S) & (t <= min(last, end) + TRUTH_MARGIN_S)]
        if len(t) > 1 and (t[-1] - t[0]) / (len(t) - 1) <= MAX_TRUTH_GAP_S:
            break
    return t


def reconstructed_states(agents: tuple[Agent, ...], ticks_s: Array, ego_xy: Array | None) -> StateTable:
    """Sample reconstructed agents at the ticks (T,); `ego_xy` (T, 2), m, or None."""
    table = AgentTable.of(agents, ticks_s)
    return _limit_range(table, ego_xy, table.present, table.present, np.full(table.yaw_rad.shape, np.nan))


def truth_states(agents: tuple[Agent, ...], ticks_s: Array, shift_m: Array, ego_xy: Array | None) -> StateTable:
    """Sample truth agents at the ticks (seconds of the truth), moved by `shift_m`.

    `visible` is that of the nearest waypoint. In gaps longer than 0.25 s and outside the trajectory it is False: there an
    interpolated or extrapolated box only prevents a reconstructed agent from counting as false.
    """
    table = AgentTable.of(agents, ticks_s, margin_s=TRUTH_MARGIN_S)
    visible, labeled = np.ones(table.present.shape, dtype=bool), np.zeros(table.present.shape, dtype=bool)
    points = np.full(table.present.shape, np.nan)
    for k, agent in enumerate(agents):
        w, nearest = agent.waypoints, nearest_index(agent.waypoints.t_s, ticks_s)
        if w.visible is not None:
            visible[k] = w.visible[nearest]
        if w.lidar_points is not None:
            near = (np.abs(w.t_s[nearest] - ticks_s) <= MAX_TRUTH_GAP_S) & table.present[k]
            points[k] = np.where(near, w.lidar_points[nearest], np.nan)
        # Simplified, a static agent has its first and last waypoint only, and one in straight motion a few.
        simplified = bool(agent.quality.get("waypoints_left_out"))
        max_gap_s = np.inf if agent.static and len(w) == 2 else MAX_SIMPLIFIED_GAP_S if simplified else MAX_TRUTH_GAP_S
        labeled[k] = agent.at(ticks_s, max_gap_s=float(max_gap_s)).valid
    moved = replace(table, center_m=table.center_m + shift_m)
    return _limit_range(moved, ego_xy, visible & labeled, labeled, points)


def states_of_ego(
    scenario: Scenario, truth: Scenario, ticks_s: Array, truth_ticks_s: Array, shift_m: Array
) -> StateTable | None:
    """Sample the ego as one row, the true one at the ticks at which it is known; None without an ego."""
    ours = None if scenario.ego is None else reconstructed_states((scenario.ego,), ticks_s, None)
    if truth.ego is None:
        return ours
    true = truth_states((truth.ego,), truth_ticks_s, shift_m, None)
    if ours is None:
        return true
    center_m = np.where(true.present[..., None], true.center_m, ours.center_m)
    return replace(true, center_m=center_m, yaw_rad=np.where(true.present, true.yaw_rad, ours.yaw_rad))


def _limit_range(
    table: AgentTable, ego_xy: Array | None, visible: Mask, labeled: Mask, lidar_points: Array
) -> StateTable:
    away_m = np.full(table.present.shape, np.inf)
    if ego_xy is not None:
        away_m = np.hypot(*np.moveaxis(table.xy_m - ego_xy, -1, 0))
    range_m = np.where(table.present, away_m, np.nan)
    columns = table.agents, table.t_s, table.center_m, table.yaw_rad, table.speed_mps
    return StateTable(*columns, range_m, visible, labeled, lidar_points)


MIN_REGION_SHARE = 0.5
MAX_FRAME_LAG_S = 0.15  # a tick is compared with the nearest labeled frame of a camera within this time


def ignored_ticks(ignore_regions: IgnoreRegions, t_s: Array, agents: StateTable, candidates: Mask) -> Mask:
    """Mark (B, T) the boxes that no labeled camera shows in a labeled part of its image.

    `t_s` (T,): ticks, seconds of the truth. `agents`: B agents at these ticks, the truth's map frame. `candidates` (B,
    T): the boxes to decide on; all others are False.

    A camera shows a box in an ignore region when at least half of the visible outline lies in the union of the regions of
    the nearest frame. One camera that shows it in a labeled part suffices to keep it.
    """
    labeled, hidden = np.zeros_like(candidates), np.zeros_like(candidates)
    for view in (view for view in ignore_regions.views if len(view.t_s)):
        # Poses are interpolated: at 30 m/s a car moves 1.5 m in half a frame at 10 Hz.
        frame = nearest_index(view.t_s, t_s)
        near = np.abs(view.t_s[frame] - t_s) <= MAX_FRAME_LAG_S
        at_frames, times_s = view.map_T_cam, (view.t_s, np.clip(t_s, view.t_s[0], view.t_s[-1]))
        frames_ns, ticks_ns = (np.round(s * NS_PER_S).astype(np.int64) for s in times_s)
        poses, known = PoseTrack(frames_ns, at_frames).at(ticks_ns)
        map_T_cam = np.where(known[:, None, None], poses, at_frames[frame])
        for k in np.flatnonzero(candidates.any(0) & near):
            rows = np.flatnonzero(candidates[:, k])
            regions = view.region_px[view.region_frame == frame[k]]
            boxes = agents.center_m[rows, k], agents.size_m[rows], agents.yaw_rad[rows, k]
            for row, uv in zip(rows, image_samples(view.camera, inverse(map_T_cam[k]), *boxes)):
                if len(uv):
                    u, v = uv[:, None, 0], uv[:, None, 1]
                    within = (u >= regions[:, 0]) & (u <= regions[:, 2]) & (v >= regions[:, 1]) & (v <= regions[:, 3])
                    share = within.any(axis=1).mean()
                    (hidden if share >= MIN_REGION_SHARE else labeled)[row, k] = True
    outside = candidates & ~hidden & ~labeled if ignore_regions.outside_views else np.zeros_like(candidates)
    return (hidden & ~labeled) | outside


MIN_COUNTED_S = 1.0  # a truth agent counts when its counted ticks make up at least this time
# Of LiDARs on an object that some sensor hit. Waymo's first level of difficulty is drawn at as many.
MIN_HIT_POINTS = 5
# Why a labeled object does not count at a tick; the first that applies.
REASONS = {
    "other_category": "of a category that was not asked for",
    "out_of_range": "out of range",
    "few_points": f"fewer than {MIN_POINTS} LiDAR points",
    "not_in_picture": "less than half in a picture",
    "hidden": "hidden according to the truth",
    "short": f"in sight for less than {MIN_COUNTED_S:g} s",
}
COUNTED, NOT_LABELED = 0, -1


@dataclass(frozen=True)
class Selection:
    """Which agents are compared: within `max_range_m` of the ego, None for all, and of these `categories`."""

    max_range_m: float | None
    categories: frozenset[str]

    def covers(self, side: StateTable) -> Mask:
        """Mark (A, T) the ticks at which an agent is present and selected."""
        return side.present & self.near(side) & self.chosen(side)[:, None]

    def near(self, side: StateTable) -> Mask:
        """Mark (A, T) the ticks at which an agent is within range."""
        return np.ones_like(side.present) if self.max_range_m is None else side.range_m <= self.max_range_m

    def chosen(self, side: StateTable) -> Mask:
        """Mark (A,) the agents of the selected categories."""
        return np.isin(side.category, list(self.categories))


@dataclass(frozen=True, eq=False)
class Comparison:
    """A truth agents and B reconstructed agents at T ticks, matched."""

    # truth, other: truth and reconstruction.
    truth: StateTable
    other: StateTable
    pairs: AgentPairs
    match: Index  # (A, T) index of the reconstructed agent, -1 for none
    counted: Mask  # (A, T) ticks at which a truth agent counts
    # (A, T) 0 where it counts, else 1 + the place of the reason in `REASONS`; -1 where it is not labeled
    why_not: Index
    switched: Mask  # (A, T) identity switches
    selected: Mask  # (B, T) ticks at which a reconstructed agent is present, within range and of a selected category
    false: Mask  # (B, T) ticks at which a reconstructed agent is false
    ignored: Mask  # (B, T) unmatched ticks in ignore regions

    @property
    def asked_for(self) -> Mask:
        """Mark (A, T) the labeled ticks of the truth that are within range and of a selected category."""
        return np.asarray((self.why_not == COUNTED) | (self.why_not > list(REASONS).index("out_of_range") + 1))


def compare_agents(
    truth: StateTable, other: StateTable, tick_s: float, selection: Selection, *, visibility_stated: bool = True
) -> Comparison:
    """Match agents and mark what counts.

    `tick_s`: interval of the ticks. `visibility_stated`: whether the truth states what is visible; else it follows from
    `MIN_POINTS` points and from pictures.
    """
    same_group = truth.group[:, None] == other.group[None]
    pairs = near_pairs(truth.xy_m, other.xy_m, gate_m(truth.size_m[:, 0]), same_group)
    match, used, absorbed = associate(pairs, len(truth.agents), len(other.agents), truth.range_m.shape[1])
    in_sight = counted = selection.covers(truth) & truth.visible
    # Half a tick of tolerance, since stamps jitter.
    enough = counted.sum(1) * tick_s >= MIN_COUNTED_S - tick_s / 2 if tick_s else np.zeros(len(counted), dtype=bool)
    counted = in_sight & enough[:, None]
    few = ~truth.visible & (truth.lidar_points < MIN_POINTS) & (not visibility_stated)
    hidden = ~truth.visible & visibility_stated
    first = [~truth.labeled, counted, ~selection.chosen(truth)[:, None], ~selection.near(truth), few]
    codes = [NOT_LABELED, COUNTED, *range(1, len(REASONS) + 1)]
    why_not = np.select([*first, ~truth.visible & ~hidden, hidden, in_sight], codes, NOT_LABELED)
    selected = selection.covers(other)
    false = selected & ~used & ~absorbed
    switched, none = switches(match, counted), np.zeros_like(false)
    return Comparison(truth, other, pairs, match, counted, why_not, switched, selected, false, none)


def coverage(c: Comparison, selected: Mask) -> dict[str, Any]:
    """Count what was labeled at the selected ticks (A, T) of the truth, what of it counts, and why the rest does not.

    Returns agent-ticks: "labeled", "counted", "why_not" by the names in `REASONS`; "hit", those within range and of a
    selected category with at least `MIN_HIT_POINTS` LiDAR points, counted or not, "hit_matched" and "hit_recall" of
    these; all three None where nobody counted the points.
    """
    labeled = selected & (c.why_not != NOT_LABELED)
    wanted = selected & c.asked_for
    counts = np.bincount(c.why_not[labeled], minlength=len(REASONS) + 1)
    hit = wanted & (c.truth.lidar_points >= MIN_HIT_POINTS)
    ticks, matched = int(hit.sum()), int((hit & (c.match >= 0)).sum())
    known = bool(np.isfinite(c.truth.lidar_points[wanted]).any())
    return {
        "labeled": int(labeled.sum()),
        "counted": int(counts[COUNTED]),
        "why_not": {name: int(count) for name, count in zip(REASONS, counts[1:], strict=True)},
        "hit": ticks if known else None,
        "hit_matched": matched if known else None,
        "hit_recall": matched / ticks if ticks else None,
    }


def drop_ignored(c: Comparison, regions: IgnoreRegions | None, truth_ticks_s: Array, shift_m: Array) -> Comparison:
    """Move false ticks in ignore regions, and of categories never labeled, to the ignored ones.

    `regions`: None where the labels are complete. `truth_ticks_s` (T,), s. `shift_m` (3,), m: from the truth's map to
    the scenario's.
    """
    if regions is None:
        return c
    in_truth_map = replace(c.other, center_m=c.other.center_m - shift_m)
    never = c.false & np.isin(c.other.category, regions.categories)[:, None]
    ignored = never | ignored_ticks(regions, truth_ticks_s, in_truth_map, c.false & ~never)
    return replace(c, false=c.false & ~ignored, ignored=ignored)


def matched_ticks(c: Comparison, truth_selected: Mask) -> Mask:
    """Mark (B, T) the ticks at which a reconstructed agent matches a selected truth agent."""
    i, t = np.nonzero(truth_selected & (c.match >= 0))
    hit = np.zeros(c.false.shape, dtype=bool)
    hit[c.match[i, t], t] = True
    return hit
