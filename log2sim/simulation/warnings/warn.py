"""Warns of collisions with the ego of a scenario or of its replay."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import EGO, ENDS, STANDSTILL_MPS, Agent, Scenario
from log2sim.errors import ConfigError
from log2sim.geometry import Array, box_corners_bev
from log2sim.prediction.motion_table import TICK_S, table_of
from log2sim.simulation.result import Replay, to_scenario
from log2sim.simulation.warnings.ego_way import EgoStates
from log2sim.simulation.warnings.known import has_ends, known_agents, observed_spans
from log2sim.simulation.warnings.settings import WarningSettings
from log2sim.simulation.warnings.warning import Moment, Warning, Warnings
from log2sim.simulation.warnings.watch import Courses, Watch

BRAKING_SEEN_S = 0.3
"""The ego's deceleration is that of its speed over this time: three ticks tell it to 0.5 m/s2 where a speed is good to 0.1 m/s."""

SAME_WARNING_S = 1.0
"""A warning that ends for less time goes on."""

_DIGITS = 3


def warn(
    scenario: Scenario, replay: Replay | None = None, *, ends: str = "both", settings: WarningSettings | None = None
) -> Warnings:
    """Find the agents on a collision course with the ego: since when they are known, and when they are warned of.

    Parameters
    ----------
    scenario : Scenario
        Tells which end observed an agent when.
    replay : Replay, optional
        Where agents are, instead of in the scenario.
    ends : {"both", "vehicle", "road"}
        Whose observations count.
    settings : WarningSettings, optional
        Its `ends` are replaced by those above.

    Raises
    ------
    ConfigError
        For a scenario without an ego, or unknown ends.

    Notes
    -----
    At every tick of 0.1 s agents are expected where `log2sim.prediction` sees them by what the ends have observed up to then, and
    the ego on its path at its speed, or braking as it does. An agent with which the ego collides by that, with at least
    `min_probability` within `horizon_s`, is warned of. Nothing later is used but the ego's path: its route. States of a
    reconstruction were smoothed over the whole log, so that they tell a little of what came next.
    """
    settings = replace(settings or WarningSettings(), ends=ends)
    moved = to_scenario(replay, scenario) if replay is not None else scenario
    if scenario.ego is None or moved.ego is None:
        raise ConfigError(f"warnings: scenario '{scenario.name}' has no agent '{EGO}' that could be warned")
    table = table_of(moved)
    ticks = np.flatnonzero(table.present[[a.id for a in moved.agents].index(EGO)])
    watch = Watch(scenario, moved.others, settings, table.t_s)
    ego = ego_states(moved.ego, watch, table.t_s[ticks])
    events = _events(watch, watch.courses(ego, ticks), ego, ticks)
    hit = _collisions(replay)
    events = _with_collisions(events, hit, watch, ego, ticks)
    sources = {a.id: a for a in scenario.agents}
    if has_ends(scenario):
        events = [replace(e, known_by=_known_by(sources[e.agent], table.t_s, watch.interval_s)) for e in events]
    driven_s = float((np.abs(ego.speed_mps) >= STANDSTILL_MPS).sum()) * TICK_S
    return Warnings(
        settings.ends, has_ends(scenario), settings.horizon_s, settings.min_probability, settings.reaction_s,
        settings.brake_mps2, round(driven_s, 1), tuple(sorted(events, key=_time_of)),
    )  # fmt: skip


def ego_states(ego: Agent, watch: Watch, t_s: Array) -> EgoStates:
    """Return the states of the ego at times (T,), with what it braked just before."""
    x, y, _, yaw, speed = ego.trajectory.at(t_s)
    pace = np.abs(speed)
    before = np.abs(ego.trajectory.at(np.maximum(t_s - BRAKING_SEEN_S, t_s[:1])).speed_mps)
    past_s = np.minimum(t_s - t_s[0], BRAKING_SEEN_S)
    accel = np.divide(pace - before, past_s, out=np.zeros(len(t_s)), where=past_s > TICK_S / 2)
    return EgoStates(x, y, yaw, speed, accel, watch.ego_way.progress(x, y))


def _events(watch: Watch, found: Courses, ego: EgoStates, ticks: NDArray[np.intp]) -> list[Warning]:
    """Make a warning of all agents that reach the probability."""
    events = []
    s, t_s = watch.settings, watch.table.t_s[ticks]
    warned = found.probability >= s.min_probability
    for agent in np.unique(found.agent[warned]).tolist():
        rows = np.flatnonzero(warned & (found.agent == agent))
        first = rows[np.argmin(found.row[rows])]
        n, way = int(found.row[first]), float(found.way_m[first])
        moment = _moment(watch, agent, ego, ticks, float(t_s[n]))
        needed = s.needed_mps2(moment.ego_speed_mps, way)
        who = watch.table.agents[agent]
        events.append(
            Warning(
                who.id, who.category, _moment(watch, agent, ego, ticks, float(watch.known.since_s[agent])),
                warned=moment, probability=round(float(found.probability[first]), _DIGITS),
                ttc_s=round(float(found.ttc_s[first]), _DIGITS), way_m=round(way, _DIGITS),
                needed_mps2=None if needed is None else round(needed, _DIGITS), braking_suffices=moment.stopping_m <= way,
                spans_s=_spans(np.sort(t_s[found.row[rows]])),
            )
        )  # fmt: skip
    return events


def _moment(watch: Watch, agent: int, ego: EgoStates, ticks: NDArray[np.intp], t_s: float) -> Moment | None:
    """Tell how far the ego and an agent are from each other at a time; None while either is absent, or never."""
    own_s, other = watch.table.t_s[ticks], watch.table.agents[agent]
    if not own_s[0] - TICK_S <= t_s <= own_s[-1] + TICK_S:
        return None
    x, y, _, yaw, _ = other.trajectory.at(np.array([t_s]))
    ours = [np.interp(t_s, own_s, c) for c in (ego.x_m, ego.y_m, np.unwrap(ego.yaw_rad), ego.speed_mps)]
    size = watch.ego_way.size_m
    boxes = (
        box_corners_bev([[ours[0], ours[1]]], size[0], size[1], ours[2]),
        box_corners_bev([[x[0], y[0]]], other.size_m[0], other.size_m[1], yaw[0]),
    )
    speed = abs(float(ours[3]))
    stopping = watch.settings.stopping_distance_m(speed)
    return Moment(round(t_s, _DIGITS), round(_gap_m(*boxes), _DIGITS), round(speed, _DIGITS), round(stopping, _DIGITS))


def _gap_m(a_m: Array, b_m: Array) -> float:
    """Return the distance of the nearest points of two boxes (1, 4, 2)."""
    import shapely

    return float(shapely.distance(shapely.polygons(a_m), shapely.polygons(b_m))[0])


def _spans(t_s: Array) -> tuple[tuple[float, float], ...]:
    """Join ticks (N,) to spans."""
    edges = np.flatnonzero(np.diff(t_s) > SAME_WARNING_S)
    first, last = np.concatenate([[0], edges + 1]), np.concatenate([edges, [len(t_s) - 1]])
    return tuple((round(float(t_s[a]), _DIGITS), round(float(t_s[b]), _DIGITS)) for a, b in zip(first, last))


def _collisions(replay: Replay | None) -> Mapping[str, float]:
    """Return when the ego first touches others in a replay, by id."""
    if replay is None:
        return {}
    touched: dict[str, float] = {}
    for event in replay.metrics.get("collisions", ()):
        if EGO in event["agents"]:
            (other,) = (i for i in event["agents"] if i != EGO)
            touched[other] = min(touched.get(other, np.inf), float(event["t_s"]))
    return touched


def _with_collisions(
    events: Iterable[Warning], hit: Mapping[str, float], watch: Watch, ego: EgoStates, ticks: NDArray[np.intp]
) -> list[Warning]:
    """Tell which agents the ego touches, and add those that nothing was predicted of."""
    out = [replace(e, collision_s=round(hit[e.agent], _DIGITS)) if e.agent in hit else e for e in events]
    ids = [a.id for a in watch.table.agents]
    for agent in hit.keys() - {e.agent for e in out}:
        k = ids.index(agent)
        known = _moment(watch, k, ego, ticks, float(watch.known.since_s[k]))
        out.append(Warning(agent, watch.table.agents[k].category, known, collision_s=round(hit[agent], _DIGITS)))
    return out


def _known_by(agent: Agent, t_s: Array, interval_s: float) -> dict[str, float]:
    """Return when each end alone knows an agent first, s."""
    found: dict[str, Any] = {}
    for end in ENDS:
        present = np.ones((1, len(t_s)), dtype=bool)
        since = known_agents([agent], [observed_spans(agent, (end,))], t_s, interval_s, present).since_s[0]
        if np.isfinite(since):
            found[end] = round(float(since), _DIGITS)
    return found


def _time_of(warning: Warning) -> tuple[float, str]:
    at = warning.warned.t_s if warning.warned else warning.collision_s
    return float("inf") if at is None else at, warning.agent
