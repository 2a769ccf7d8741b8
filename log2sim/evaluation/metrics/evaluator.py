"""Compares a reconstructed scenario with the truth; HOTA."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from log2sim import geometry
from log2sim.datatypes import CATEGORIES, GROUPS, Agent, LabelView, Log, Scenario
from log2sim.errors import ConfigError, ScenarioError
from log2sim.evaluation.metrics import comparison, verdicts
from log2sim.evaluation.metrics.correctness import correctness, over_ticks
from log2sim.evaluation.metrics.truth import load_truth
from log2sim.evaluation.road import color_figures, map_figures, signal_figures
from log2sim.export.exporters import on_map
from log2sim.files.plugins import nearest

if TYPE_CHECKING:
    from log2sim.report import Result


# Similarity thresholds 0.05, 0.10, ... 0.95 over which the figures are averaged.
ALPHAS: geometry.Array = np.arange(1, 20) / 20


def hota(
    pairs: comparison.AgentPairs, truth_present: comparison.Mask, other_present: comparison.Mask
) -> dict[str, float | None]:
    """Score the tracking: "hota" with its detection and association parts "det_a" and "ass_a", each the mean over `ALPHAS`.

    `pairs`: candidates; those of absent agents and those with similarity 0 are left out. `truth_present`,
    `other_present` (A, T), (B, T): which agents count at which ticks. All are None when there is no truth.

    Luiten et al., "HOTA", IJCV 129 (2021). Matches of a tick maximize the sum of similarity times the global alignment of
    both identities. Without any reconstructed agent all figures are 0.
    """
    names = ("hota", "det_a", "ass_a")
    if not (truth_present.any() and other_present.any()):
        return dict.fromkeys(names, 0.0 if truth_present.any() else None)
    present = truth_present[pairs.truth, pairs.tick] & other_present[pairs.other, pairs.tick] & (pairs.similarity > 0)
    pairs = pairs.take(present)
    truth_count, other_count = truth_present.sum(1), other_present.sum(1)
    # Compute the Jaccard alignment (A, B) of the identities over all ticks, before the one-to-one assignment.
    ticks = truth_present.shape[1]
    row_sum, col_sum = np.zeros((len(truth_count), ticks)), np.zeros((len(other_count), ticks))
    np.add.at(row_sum, (pairs.truth, pairs.tick), pairs.similarity)
    np.add.at(col_sum, (pairs.other, pairs.tick), pairs.similarity)
    share = row_sum[pairs.truth, pairs.tick] + col_sum[pairs.other, pairs.tick] - pairs.similarity
    potential = np.zeros((len(truth_count), len(other_count)))
    np.add.at(potential, (pairs.truth, pairs.other), pairs.similarity / share)
    union = truth_count[:, None] + other_count[None] - potential
    alignment = np.divide(potential, union, out=np.zeros_like(potential), where=union > 0)
    score = alignment[pairs.truth, pairs.other] * pairs.similarity
    chosen = [
        a + geometry.choose_pairs(pairs.truth[a:b], pairs.other[a:b], -score[a:b], 0.0)
        for a, b in pairwise(pairs.bounds(ticks))
    ]
    matched = pairs.take(np.concatenate(chosen))
    det_a, ass_a = np.zeros(len(ALPHAS)), np.zeros(len(ALPHAS))
    total = int(truth_count.sum() + other_count.sum())
    for k, alpha in enumerate(ALPHAS):
        # A similarity equal to the threshold counts, despite rounding.
        hits = matched.take(matched.similarity >= alpha - 1e-12)
        if len(hits.tick) == 0:
            continue
        # TPA: how often a pair of identities matched; FNA, FPA: how often one of them was present without the other.
        pair_code = hits.truth * len(other_present) + hits.other
        code, tpa = np.unique(pair_code, return_counts=True)
        i, j = np.divmod(code, len(other_present))
        ass_a[k] = np.sum(tpa * tpa / (truth_count[i] + other_count[j] - tpa)) / tpa.sum()
        det_a[k] = tpa.sum() / (total - tpa.sum())
    return {name: float(v.mean()) for name, v in zip(names, (np.sqrt(det_a * ass_a), det_a, ass_a))}


DIGITS = 6


def agent_rows(c: comparison.Comparison) -> list[dict[str, Any]]:
    """Make one row per counted truth agent: its matches and errors; size errors are signed."""
    truth, other, counted, switched = c.truth, c.other, c.counted, c.switched
    errors = verdicts.state_errors(truth, other, c.match, counted)
    rows, rows_of = [], np.broadcast_to(np.arange(len(truth.agents))[:, None], counted.shape)
    for i in np.flatnonzero(counted.any(1)):
        mine, covered = errors.take(errors.truth == i), comparison.coverage(c, rows_of == i)
        ids, ticks = np.unique(mine.other, return_counts=True)
        size = mine.size_m.mean(axis=0) if len(mine.other) else np.full(3, np.nan)
        headed = mine.yaw_rad[np.isfinite(mine.yaw_rad)]
        rows.append({
            "id": truth.agents[i].id, "category": str(truth.category[i]), "ticks": int(counted[i].sum()),
            "matched": len(mine.other), **{key: covered[key] for key in ("labeled", "hit", "hit_matched")},
            "matched_ids": {other.agents[j].id: int(n) for j, n in zip(ids, ticks)},
            "id_switches": int(switched[i].sum()), "mean_range_m": float(truth.range_m[i, counted[i]].mean()),
            "position_rmse_m": verdicts.root_mean_square(mine.position_m),
            "yaw_median_deg": verdicts.median(np.degrees(headed)),
            "speed_rmse_mps": verdicts.root_mean_square(mine.speed_mps),
            **{f"{side}_error_m": float(v) for side, v in zip(("length", "width", "height"), size)},
        })  # fmt: skip
    return rows


def uncounted_rows(
    other: comparison.StateTable, kind: str, mask: comparison.Mask, **counts: comparison.Mask
) -> list[dict[str, Any]]:
    """Make one row per reconstructed agent that is of a kind, such as false, at the ticks of a mask (B, T), if there are any.

    Ticks of the agent in the masks `counts` are counted by their names.
    """
    return [
        {
            "id": other.agents[j].id,
            "category": str(other.category[j]),
            f"{kind}_ticks": int(mask[j].sum()),
            **{name: int(count[j].sum()) for name, count in counts.items()},
            "ticks": int(other.present[j].sum()),
            "mean_range_m": float(other.range_m[j, mask[j]].mean()),
        }
        for j in np.flatnonzero(mask.any(1))
    ]


def rounded_tree(value: Any) -> Any:
    """Round all floats of a document to six decimals; a value that is not finite becomes None."""
    if isinstance(value, dict):
        return {k: rounded_tree(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [rounded_tree(v) for v in value]
    if isinstance(value, float):
        return round(value, DIGITS) if math.isfinite(value) else None
    return value


# Takes states (N, 4), x, y, z in m and heading in rad, at times (N,), s of the truth, to those in the other map.
Move = Callable[[geometry.Array, geometry.Array], geometry.Array]


def place_truth(truth: Scenario, scenario: Scenario) -> tuple[Scenario, dict[str, Any]]:
    """Bring a truth into the map of a scenario; where both maps have the same projection it stays, `Scenario.shift_to` does the rest.

    Returns also "method", how both maps were brought together: "same_map", "projection" or "ego_path", and "ego_apart_m", the
    median distance of the egos in the end, None where not both are known. Raises `ConfigError` when positions have no
    coordinates in the projection of the scenario.

    Two projections scale alike only to some tenths of a percent, 0.1 m at 50 m. What moves with time is therefore kept as it
    is around the true ego, and only the ego is reprojected. Where a georeference is missing and the egos are farther apart
    than matches may be, the truth is rotated about the vertical and shifted so that front and rear of the egos coincide best
    (least squares; Kabsch, 1976).
    """
    theirs, ours = truth.map, scenario.map
    if theirs.projection and ours.projection:
        if theirs.projection == ours.projection:
            apart_m = _ego_apart_m(truth, scenario, truth.shift_to(scenario))
            return truth, {"method": "same_map", "ego_apart_m": apart_m}
        altitudes = theirs.altitude_m, ours.altitude_m
        rise_m = 0.0 if altitudes[0] is None or altitudes[1] is None else altitudes[0] - altitudes[1]
        target = on_map(theirs, ours.projection, ours.offset_m)

        def reproject(states: geometry.Array, _t_s: geometry.Array) -> geometry.Array:
            return np.asarray(target.forward(states) + np.array([0, 0, rise_m, 0]))

        def around_ego(states: geometry.Array, t_s: geometry.Array) -> geometry.Array:
            # What is around the ego is kept as it is, and the ego moved.
            assert truth.ego is not None
            s = truth.ego.at(np.clip(t_s, truth.ego.waypoints.t_s[0], truth.ego.waypoints.t_s[-1]))
            before = np.stack([s.x_m, s.y_m, s.z_m, s.yaw_rad], axis=1)
            after = reproject(before, t_s)
            turn = after[:, 3] - before[:, 3]
            xyz = np.einsum(
                "nij,nj->ni", geometry.rotation_from_rpy(0 * turn, 0 * turn, turn), states[:, :3] - before[:, :3]
            )
            return np.column_stack([xyz + after[:, :3], states[:, 3] + turn])

        method = "projection"
        far: Move = reproject
        near: Move = reproject if truth.ego is None else around_ego
    else:
        apart_m = _ego_apart_m(truth, scenario, truth.shift_to(scenario))
        if apart_m is None or apart_m <= comparison.GATE_M:
            return truth, {"method": "same_map", "ego_apart_m": apart_m}
        method = "ego_path"
        near = far = _fit_egos(truth, scenario)
    moved = replace(_moved(truth, near, far), map=scenario.map)
    return moved, {"method": method, "ego_apart_m": _ego_apart_m(moved, scenario, np.zeros(3))}


def describe_placement(placement: dict[str, Any]) -> str | None:
    """Say how both maps were brought together; None where they are the same."""
    if placement["method"] == "same_map":
        return None
    how = {
        "projection": "their maps have two projections: the truth was reprojected by latitude and longitude",
        "ego_path": "their maps are not the same, and no georeference joins them: the truth was put where the egos fit best",
    }[placement["method"]]
    apart_m = placement["ego_apart_m"]
    return how if apart_m is None else f"{how}; then the boxes of the egos are {apart_m:.2f} m apart (median)"


def _common_egos(truth: Scenario, scenario: Scenario) -> tuple[geometry.Array, geometry.Array]:
    """Return states (K, 4) of the true ego and of the other at the times of the latter at which both are known."""
    if truth.ego is None or scenario.ego is None:
        return np.zeros((0, 4)), np.zeros((0, 4))
    t_s = scenario.ego.waypoints.t_s
    true = truth.ego.at(t_s + (scenario.t0_ns - truth.t0_ns) / geometry.NS_PER_S)
    ours = scenario.ego.at(t_s)
    both = true.valid & ours.valid
    return tuple(np.stack([s.x_m, s.y_m, s.z_m, s.yaw_rad], axis=1)[both] for s in (true, ours))  # type: ignore[return-value]


def _ego_apart_m(truth: Scenario, scenario: Scenario, shift_m: geometry.Array) -> float | None:
    true, ours = _common_egos(truth, scenario)
    gap = true[:, :2] + shift_m[:2] - ours[:, :2]
    return float(np.median(np.hypot(gap[:, 0], gap[:, 1]))) if len(gap) else None


def _fit_egos(truth: Scenario, scenario: Scenario) -> Move:
    """Return the rigid motion that puts the true ego on the other one, as well as one motion can."""
    true, ours = _common_egos(truth, scenario)
    half_m = truth.ego.size_m[0] / 2 if truth.ego is not None else 0.0
    # Both ends of the ego, so that a standing one has a heading, too.
    a, b = (
        np.concatenate(
            [s[:, :2] + end * np.stack([np.cos(s[:, 3]), np.sin(s[:, 3])], axis=1) for end in (-half_m, half_m)]
        )
        for s in (true, ours)
    )
    from_m, to_m = a.mean(axis=0), b.mean(axis=0)
    p, q = a - from_m, b - to_m
    turn = float(np.arctan2((p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]).sum(), (p * q).sum()))
    rise_m = float(np.mean(ours[:, 2] - true[:, 2]))

    def move(states: geometry.Array, _t_s: geometry.Array) -> geometry.Array:
        pivot, goal = np.array([*from_m, 0.0]), np.array([*to_m, rise_m])
        xyz = (states[:, :3] - pivot) @ geometry.rotation_from_rpy(0.0, 0.0, turn).T + goal
        return np.column_stack([xyz, states[:, 3] + turn])

    return move


def _moved(truth: Scenario, near: Move, far: Move) -> Scenario:
    """Move agents and views by `near`, and what has no time by `far`."""

    def agent(a: Agent) -> Agent:
        w = a.waypoints
        x, y, z, yaw = near(np.stack([w.x_m, w.y_m, w.z_m, w.yaw_rad], axis=1), w.t_s).T
        return replace(a, waypoints=replace(w, x_m=x, y_m=y, z_m=z, yaw_rad=geometry.wrap_angle(yaw)))

    def view(v: LabelView) -> LabelView:
        states = near(np.column_stack([v.translation_m, np.zeros(len(v.t_s))]), v.t_s)
        turn = geometry.rotation_from_rpy(0 * states[:, 3], 0 * states[:, 3], states[:, 3])
        rotation = geometry.quaternion_from_rotation(turn @ geometry.rotation_from_quaternion(v.rotation_wxyz))
        return replace(v, translation_m=states[:, :3], rotation_wxyz=rotation)

    def points(xyz_m: geometry.Array) -> geometry.Array:
        return far(np.column_stack([xyz_m, np.zeros(len(xyz_m))]), np.zeros(len(xyz_m)))[:, :3]

    regions = truth.ignore_regions
    return replace(
        truth,
        agents=tuple(agent(a) for a in truth.agents),
        ignore_regions=None if regions is None else replace(regions, views=tuple(view(v) for v in regions.views)),
        map_features=None if truth.map_features is None else truth.map_features.moved(points),
        signals=tuple(replace(s, position_m=points(s.position_m[None])[0]) for s in truth.signals),
        # Cells along the axes of the truth's own map.
        provenance={key: value for key, value in truth.provenance.items() if key != "seen_ground"},
    )


VERSION = 1
RANGES_M = ((0.0, 20.0), (20.0, 40.0), (40.0, 60.0))


def evaluate(
    scenario: Scenario | Result | Path | str,
    truth: Scenario | Log | Path | str,
    *,
    max_range_m: float | None = None,
    categories: Sequence[str] | None = None,
) -> dict[str, Any]:
    """Measure a scenario against its truth.

    Raises `ConfigError` for an unknown category, a range that is not positive, or a range without an ego to measure it
    from. Raises `LogError` when the log has no labels. Raises `ScenarioError` when the two do not overlap in time.

    `scenario`: a scenario or its file, or what `log2sim.reconstruct` returns. `truth`: a scenario or its file, or a log or its path,
    whose labels in view of the cameras that the scenario used are taken. Start time and map may be others. The ego (id "ego") is
    compared separately from the other agents. `max_range_m`, m: only agents within this distance of the ego are compared, in both
    scenarios. `categories`: only agents of these categories or groups ("vehicle", "two_wheeler") are compared, in both scenarios.
    Returns the document of `schemas/metrics-1.json`. Keys carry the unit: `_m` meters, `_mps` m/s, `_deg` degrees, `_s` seconds;
    recall, precision, MOTA and HOTA are fractions. A figure that cannot be computed is None.

    CLEAR MOT (Bernardin and Stiefelhagen, 2008) and HOTA (Luiten et al., 2021) with matches by the distance of box centers.
    Recall and precision count agent-ticks; position, speed and size errors are over matched agent-ticks. Quarantined agents, which
    replays and exports leave out, are left out here too, and listed; static agents are compared from their first to their last
    observation.
    """
    if isinstance(scenario, Log):
        raise TypeError("evaluate takes the scenario first, then the log with its truth")
    if isinstance(scenario, (str, Path)):
        scenario = Scenario.load(scenario)
    elif not isinstance(scenario, Scenario):
        scenario = scenario.scenario
    quarantined = [agent.id for agent in scenario.agents if agent.quarantined]
    agents = []
    for agent in scenario.active.agents:
        rows = np.flatnonzero(agent.waypoints.observed)
        if agent.static and len(rows):  # from its first to its last observation
            agent = replace(agent, waypoints=agent.waypoints.take(slice(rows[0], rows[-1] + 1)))
        agents.append(agent)
    scenario = replace(scenario, agents=tuple(agents))
    truth, placement = place_truth(load_truth(truth, scenario, points=True), scenario)
    selection = comparison.Selection(max_range_m, select_categories(categories))
    compared, ticks_s, ego = compare_scenarios(scenario, truth, selection)
    ours, tick_s = compared.other, _tick_s(ticks_s)
    truth_ticks_s = ticks_s + (scenario.t0_ns - truth.t0_ns) / geometry.NS_PER_S
    everywhere = np.ones_like(compared.counted), np.ones_like(compared.false)
    sides = compared.truth, compared.other
    by_range = {
        f"{low:g}-{high:g}": _figures(compared, *((s.range_m >= low) & (s.range_m < high) for s in sides))
        for low, high in RANGES_M
    }
    # By the category of the truth for matched ticks, of the reconstructed agent for false ones.
    names = {*compared.truth.category[compared.asked_for.any(1)], *compared.other.category[compared.false.any(1)]}
    by_category = {
        name: _figures(compared, *(over_ticks(s.category == name, s.present) for s in sides))
        for name in CATEGORIES
        if name in names
    }
    # The agent that each truth agent is matched with most often, by its id.
    partners = {}
    for row, agent in enumerate(compared.truth.agents):
        hits = compared.match[row][compared.counted[row] & (compared.match[row] >= 0)]
        if len(hits):
            partners[agent.id] = compared.other.agents[int(np.bincount(hits).argmax())]
    of_ego, shift_m = None, truth.shift_to(scenario)
    if truth.ego is not None and scenario.ego is not None:
        true = comparison.truth_states((truth.ego,), truth_ticks_s, shift_m, None)
        own = comparison.reconstructed_states((scenario.ego,), ticks_s, None)
        both = true.present & true.visible & own.present
        errors = verdicts.state_errors(true, own, np.where(own.present, 0, -1), both)
        of_ego = {
            "ticks": int(both.sum()),
            "position_rmse_m": verdicts.root_mean_square(errors.position_m),
            "yaw_median_deg": verdicts.median(np.degrees(errors.yaw_rad)),
            "speed_rmse_mps": verdicts.root_mean_square(errors.speed_mps),
        }
    result = {
        "metrics_version": VERSION,
        "scenario": scenario.name,
        "truth": truth.name,
        "max_range_m": max_range_m,
        "categories": None if categories is None else sorted(selection.categories),
        "ticks": len(ticks_s),
        "tick_s": tick_s,
        "placement": placement,
        "quarantined": quarantined,
        **_figures(compared, *everywhere),
        "by_range": None if ego is None else by_range,
        "by_category": by_category,
        "correctness": correctness(compared, scenario.others, ticks_s, ego),
        "ego": of_ego,
        "map_features": map_figures(scenario, truth),
        "colors": color_figures(truth.others, partners),
        "signals": signal_figures(scenario, truth),
        "matching": verdicts.matching_rules(),
        "counting": verdicts.counting_rules(truth),
        "agents": agent_rows(compared),
        "false_agents": uncounted_rows(
            ours, "false", compared.false, matched_ticks=comparison.matched_ticks(compared, compared.counted)
        ),
        "ignored_agents": uncounted_rows(ours, "ignored", compared.ignored),
    }
    return dict(rounded_tree(result))


def compare_scenarios(
    scenario: Scenario, truth: Scenario, selection: comparison.Selection
) -> tuple[comparison.Comparison, geometry.Array, comparison.StateTable | None]:
    """Match the agents of a scenario with those of its truth; also the ticks (T,), s of the scenario, and the ego, one row.

    Raises `ConfigError` and `ScenarioError` as `evaluate`.
    """
    ticks_s = comparison.evaluation_ticks_s(scenario, truth)
    if len(ticks_s) == 0 and scenario.agents and truth.agents:
        spans = [
            f"{min(s.t0_ns / geometry.NS_PER_S + float(a.waypoints.t_s[0]) for a in s.agents):.3f} to "
            f"{max(s.t0_ns / geometry.NS_PER_S + float(a.waypoints.t_s[-1]) for a in s.agents):.3f} s"
            for s in (scenario, truth)
        ]
        raise ScenarioError(
            f"the scenario covers {spans[0]}, the truth {spans[1]}: they share no time; are both of the same log?"
        )
    truth_ticks_s = ticks_s + (scenario.t0_ns - truth.t0_ns) / geometry.NS_PER_S
    shift_m = truth.shift_to(scenario)
    ego = comparison.states_of_ego(scenario, truth, ticks_s, truth_ticks_s, shift_m)
    ego_xy = None if ego is None else ego.xy_m[0]
    if selection.max_range_m is not None and not selection.max_range_m > 0:
        raise ConfigError(f"range is {selection.max_range_m:g} m; it must be greater than 0")
    if selection.max_range_m is not None and ego_xy is None:
        raise ConfigError("a range is given, but neither the scenario nor the truth has an ego to measure it from")
    true = comparison.truth_states(truth.others, truth_ticks_s, shift_m, ego_xy)
    ours = comparison.reconstructed_states(scenario.others, ticks_s, ego_xy)
    stated = truth.provenance.get("visibility") != "computed"
    compared = comparison.compare_agents(true, ours, _tick_s(ticks_s), selection, visibility_stated=stated)
    return comparison.drop_ignored(compared, truth.ignore_regions, truth_ticks_s, shift_m), ticks_s, ego


def _tick_s(ticks_s: geometry.Array) -> float:
    """Return the median interval of ticks (T,), s; 0 for fewer than two."""
    return float(np.median(np.diff(ticks_s))) if len(ticks_s) > 1 else 0.0


def _figures(
    c: comparison.Comparison, truth_selected: comparison.Mask, other_selected: comparison.Mask
) -> dict[str, Any]:
    """Compute all figures over the selected ticks of the truth (A, T) and the selected false ticks (B, T)."""
    counted, false = c.counted & truth_selected, c.false & other_selected
    hit = comparison.matched_ticks(c, counted)
    truth_ticks, matched, wrong = int(counted.sum()), int(hit.sum()), int(false.sum())
    agents, found = counted.any(1), (counted & (c.match >= 0)).sum(1) >= 0.5 * counted.sum(1)
    ours, real = (hit | false).any(1), hit.sum(1) >= false.sum(1)
    id_switches = int((c.switched & counted).sum())
    return {
        "recall": matched / truth_ticks if truth_ticks else None,
        "precision": matched / (matched + wrong) if matched + wrong else None,
        "recall_agents": float(found[agents].mean()) if agents.any() else None,
        "precision_agents": float(real[ours].mean()) if ours.any() else None,
        **verdicts.summarize_verdicts(verdicts.state_errors(c.truth, c.other, c.match, counted)),
        "id_switches": id_switches,
        "mota": comparison.mota(truth_ticks, truth_ticks - matched, wrong, id_switches),
        **hota(c.pairs, counted, hit | false),
        "coverage": comparison.coverage(c, truth_selected),
        "counts": {
            "truth_agents": int(agents.sum()), "truth_agents_found": int((agents & found).sum()),
            "truth_ticks": truth_ticks, "matched_ticks": matched, "missed_ticks": truth_ticks - matched,
            "false_ticks": wrong, "ignored_ticks": int((c.ignored & other_selected).sum()),
            "reconstructed_agents": int(ours.sum()), "false_agents": int((ours & ~real).sum()),
        },
    }  # fmt: skip


def select_categories(categories: Sequence[str] | None) -> frozenset[str]:
    """Return the categories of names and groups, all by default; `ConfigError` for an unknown one."""
    if categories is None:
        return frozenset(CATEGORIES)
    known = [*CATEGORIES, *(g for g in GROUPS if g not in CATEGORIES)]
    for name in categories:
        if name not in known:
            raise ConfigError(f"unknown category '{name}'{nearest(name, known)}; known: {', '.join(known)}")
    return frozenset(c for name in categories for c in GROUPS.get(name, (name,)))
