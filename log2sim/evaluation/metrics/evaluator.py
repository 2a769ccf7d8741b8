"""Compares a reconstructed scenario with the truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from log2sim.datatypes import CATEGORIES, GROUPS, Agent, Log, Scenario
from log2sim.errors import ConfigError, ScenarioError
from log2sim.evaluation.colors import color_figures
from log2sim.evaluation.lanes.figures import map_figures
from log2sim.evaluation.metrics.align import (
    StateTable,
    ego_states,
    evaluation_ticks_s,
    reconstructed_states,
    truth_states,
)
from log2sim.evaluation.metrics.clear_mot import mota
from log2sim.evaluation.metrics.comparison import (
    MIN_COUNTED_S,
    Comparison,
    Selection,
    compare,
    coverage,
    matched_ticks,
    without_ignored,
)
from log2sim.evaluation.metrics.correctness import correctness
from log2sim.evaluation.metrics.hota import hota
from log2sim.evaluation.metrics.pairs import Mask
from log2sim.evaluation.metrics.per_agent import agent_rows, false_rows, ignored_rows, rounded_tree
from log2sim.evaluation.metrics.placing import place_truth
from log2sim.evaluation.metrics.rules import counting_rules, matching_rules
from log2sim.evaluation.metrics.state_errors import median, root_mean_square, state_errors, summarize
from log2sim.evaluation.metrics.truth import load_truth
from log2sim.evaluation.signals import signal_figures
from log2sim.geometry import NS_PER_S, Array
from log2sim.registry import nearest

if TYPE_CHECKING:
    from log2sim.pipeline import Result

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

    Parameters
    ----------
    scenario : Scenario, Result, Path or str
        A scenario or its file, or what `log2sim.reconstruct` returns.
    truth : Scenario, Log, Path or str
        A scenario or its file, or a log or its path, whose labels in view of the cameras that the scenario used are taken.
        Start time and map may be others. The ego (id "ego") is compared separately from the other agents.
    max_range_m : float, m, optional
        Only agents within this distance of the ego are compared, in both scenarios.
    categories : sequence of str, optional
        Only agents of these categories or groups ("vehicle", "two_wheeler") are compared, in both scenarios.

    Returns
    -------
    dict
        The document of `schemas/metrics-1.json`. Keys carry the unit: `_m` meters, `_mps` m/s, `_deg` degrees, `_s` seconds;
        recall, precision, MOTA and HOTA are fractions. A figure that cannot be computed is None.

    Raises
    ------
    ConfigError
        For an unknown category, a range that is not positive, or a range without an ego to measure it from.
    LogError
        When the log has no labels.
    ScenarioError
        When the two do not overlap in time.

    Notes
    -----
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
    scenario = replace(scenario, agents=tuple(_while_observed(agent) for agent in scenario.active.agents))
    truth, placement = place_truth(load_truth(truth, scenario, points=True), scenario)
    compared, ticks_s, ego = compare_scenarios(scenario, truth, Selection(max_range_m, _selected(categories)))
    ours, tick_s = compared.other, _tick_s(ticks_s)
    truth_ticks_s = ticks_s + (scenario.t0_ns - truth.t0_ns) / NS_PER_S
    everywhere = np.ones_like(compared.counted), np.ones_like(compared.false)
    result = {
        "metrics_version": VERSION,
        "scenario": scenario.name,
        "truth": truth.name,
        "max_range_m": max_range_m,
        "categories": None if categories is None else sorted(_selected(categories)),
        "ticks": len(ticks_s),
        "tick_s": tick_s,
        "placement": placement,
        "quarantined": quarantined,
        **_figures(compared, *everywhere),
        "by_range": None if ego is None else _by_range(compared),
        "by_category": _by_category(compared),
        "correctness": correctness(compared, scenario.others, ticks_s, ego),
        "ego": _ego_figures(scenario, truth, ticks_s, truth_ticks_s, truth.shift_to(scenario)),
        "map_features": map_figures(scenario, truth),
        "colors": color_figures(truth.others, _matched(compared, scenario)),
        "signals": signal_figures(scenario, truth),
        "matching": matching_rules(),
        "counting": counting_rules(truth, MIN_COUNTED_S),
        "agents": agent_rows(compared),
        "false_agents": false_rows(ours, compared.false, matched_ticks(compared, compared.counted)),
        "ignored_agents": ignored_rows(ours, compared.ignored),
    }
    return dict(rounded_tree(result))


def compare_scenarios(
    scenario: Scenario, truth: Scenario, selection: Selection
) -> tuple[Comparison, Array, StateTable | None]:
    """Match the agents of a scenario with those of its truth, without the egos.

    Returns
    -------
    compared : Comparison
    ticks_s : (T,) float64, s
        Of the scenario.
    ego : StateTable or None
        One row.

    Raises
    ------
    ConfigError, ScenarioError
        As `evaluate`.
    """
    ticks_s = evaluation_ticks_s(scenario, truth)
    if len(ticks_s) == 0 and scenario.agents and truth.agents:
        raise ScenarioError(_no_common_time(scenario, truth))
    truth_ticks_s = ticks_s + (scenario.t0_ns - truth.t0_ns) / NS_PER_S
    shift_m = truth.shift_to(scenario)
    ego = ego_states(scenario, truth, ticks_s, truth_ticks_s, shift_m)
    ego_xy = None if ego is None else ego.xy_m[0]
    _check_range(selection.max_range_m, ego_xy)
    true = truth_states(truth.others, truth_ticks_s, shift_m, ego_xy)
    ours = reconstructed_states(scenario.others, ticks_s, ego_xy)
    stated = truth.provenance.get("visibility") != "computed"
    compared = compare(true, ours, _tick_s(ticks_s), selection, visibility_stated=stated)
    return without_ignored(compared, truth.ignore_regions, truth_ticks_s, shift_m), ticks_s, ego


def _matched(c: Comparison, scenario: Scenario) -> dict[str, Agent]:
    """Return the agent that each truth agent is matched with most often, by its id."""
    agents = {agent.id: agent for agent in scenario.others}
    out = {}
    for row, name in enumerate(c.truth.ids):
        hits = c.match[row][c.counted[row] & (c.match[row] >= 0)]
        if len(hits):
            out[name] = agents[c.other.ids[int(np.bincount(hits).argmax())]]
    return out


def _tick_s(ticks_s: Array) -> float:
    """Return the median interval of ticks (T,), s; 0 for fewer than two."""
    return float(np.median(np.diff(ticks_s))) if len(ticks_s) > 1 else 0.0


def _figures(c: Comparison, truth_selected: Mask, other_selected: Mask) -> dict[str, Any]:
    """Compute all figures over the selected ticks of the truth (A, T) and the selected false ticks (B, T)."""
    counted, false = c.counted & truth_selected, c.false & other_selected
    hit = matched_ticks(c, counted)
    truth_ticks, matched, wrong = int(counted.sum()), int(hit.sum()), int(false.sum())
    agents, found = counted.any(1), (counted & (c.match >= 0)).sum(1) >= 0.5 * counted.sum(1)
    ours, real = (hit | false).any(1), hit.sum(1) >= false.sum(1)
    id_switches = int((c.switched & counted).sum())
    tracking = hota(c.pairs, counted, hit | false)
    return {
        "recall": matched / truth_ticks if truth_ticks else None,
        "precision": matched / (matched + wrong) if matched + wrong else None,
        "recall_agents": float(found[agents].mean()) if agents.any() else None,
        "precision_agents": float(real[ours].mean()) if ours.any() else None,
        **summarize(state_errors(c.truth, c.other, c.match, counted)),
        "id_switches": id_switches,
        "mota": mota(truth_ticks, truth_ticks - matched, wrong, id_switches),
        "hota": None if tracking is None else tracking.hota,
        "det_a": None if tracking is None else tracking.det_a,
        "ass_a": None if tracking is None else tracking.ass_a,
        "coverage": coverage(c, truth_selected),
        "counts": {
            "truth_agents": int(agents.sum()),
            "truth_agents_found": int((agents & found).sum()),
            "truth_ticks": truth_ticks,
            "matched_ticks": matched,
            "missed_ticks": truth_ticks - matched,
            "false_ticks": wrong,
            "ignored_ticks": int((c.ignored & other_selected).sum()),
            "reconstructed_agents": int(ours.sum()),
            "false_agents": int((ours & ~real).sum()),
        },
    }


def _by_range(c: Comparison) -> dict[str, Any]:
    return {
        f"{low:g}-{high:g}": _figures(
            c,
            (c.truth.range_m >= low) & (c.truth.range_m < high),
            (c.other.range_m >= low) & (c.other.range_m < high),
        )
        for low, high in RANGES_M
    }


def _by_category(c: Comparison) -> dict[str, Any]:
    """Compute the figures by category: of the truth for matched ticks, of the reconstructed agent for false ones."""
    names = set(c.truth.category[c.asked_for.any(1)]) | set(c.other.category[c.false.any(1)])
    return {
        name: _figures(c, _rows(c.truth.category == name, c.counted), _rows(c.other.category == name, c.false))
        for name in CATEGORIES
        if name in names
    }


def _rows(which: Mask, like: Mask) -> Mask:
    return np.broadcast_to(which[:, None], like.shape)


def _while_observed(agent: Agent) -> Agent:
    """Return a static agent without the time before its first and after its last observation."""
    rows = np.flatnonzero(agent.waypoints.observed)
    if not agent.static or not len(rows):
        return agent
    return replace(agent, waypoints=agent.waypoints.take(slice(rows[0], rows[-1] + 1)))


def _selected(categories: Sequence[str] | None) -> frozenset[str]:
    if categories is None:
        return frozenset(CATEGORIES)
    known = [*CATEGORIES, *(g for g in GROUPS if g not in CATEGORIES)]
    for name in categories:
        if name not in known:
            raise ConfigError(f"unknown category '{name}'{nearest(name, known)}; known: {', '.join(known)}")
    return frozenset(c for name in categories for c in GROUPS.get(name, (name,)))


def _no_common_time(scenario: Scenario, truth: Scenario) -> str:
    spans = [
        f"{min(s.t0_ns / NS_PER_S + float(a.waypoints.t_s[0]) for a in s.agents):.3f} to "
        f"{max(s.t0_ns / NS_PER_S + float(a.waypoints.t_s[-1]) for a in s.agents):.3f} s"
        for s in (scenario, truth)
    ]
    return f"the scenario covers {spans[0]}, the truth {spans[1]}: they share no time; are both of the same log?"


def _check_range(max_range_m: float | None, ego_xy: Array | None) -> None:
    if max_range_m is None:
        return
    if not max_range_m > 0:
        raise ConfigError(f"range is {max_range_m:g} m; it must be greater than 0")
    if ego_xy is None:
        raise ConfigError("a range is given, but neither the scenario nor the truth has an ego to measure it from")


def _ego_figures(
    scenario: Scenario, truth: Scenario, ticks_s: Array, truth_ticks_s: Array, shift_m: Array
) -> dict[str, Any] | None:
    if truth.ego is None or scenario.ego is None:
        return None
    true = truth_states((truth.ego,), truth_ticks_s, shift_m, None)
    ours = reconstructed_states((scenario.ego,), ticks_s, None)
    both = true.present & true.visible & ours.present
    errors = state_errors(true, ours, np.where(ours.present, 0, -1), both)
    return {
        "ticks": int(both.sum()),
        "position_rmse_m": root_mean_square(errors.position_m),
        "yaw_median_deg": median(np.degrees(errors.yaw_rad)),
        "speed_rmse_mps": root_mean_square(errors.speed_mps),
    }
