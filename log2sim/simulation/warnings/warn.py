"""Warns of collisions in a scenario or in its replay: the ego, or without one each vehicle."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Set
from dataclasses import fields, replace
from itertools import permutations
from typing import NamedTuple

import numpy as np

from log2sim.datatypes import EGO, ENDS, STANDSTILL_MPS, Agent, Scenario
from log2sim.errors import ConfigError
from log2sim.geometry import Array, box_corners_bev
from log2sim.prediction.motion_table import TICK_S, table_of
from log2sim.simulation.result import Replay, to_scenario
from log2sim.simulation.vehicles.parameters import WHEELED
from log2sim.simulation.warnings.ego_path import EgoStates
from log2sim.simulation.warnings.known import ends_of, known_agents, observed_spans
from log2sim.simulation.warnings.settings import WarningSettings
from log2sim.simulation.warnings.warning import CollisionWarning, Moment, Warnings
from log2sim.simulation.warnings.watch import MIN_EGO_MPS, Courses, Watch

BRAKING_SEEN_S = 0.3
"""The ego's deceleration is that of its speed over this time: three ticks give it to 0.5 m/s2 where a speed is good to 0.1 m/s."""

SAME_WARNING_S = 1.0
"""A warning that ends for less time goes on."""

_DIGITS = 3


def warn(
    scenario: Scenario, replay: Replay | None = None, *, ends: str = "both", settings: WarningSettings | None = None
) -> Warnings:
    """Find the agents on a collision course with the ego, or without one with any vehicle: since when they are known, and when they are warned of.

    Parameters
    ----------
    scenario : Scenario
        With the spans in which each end observed an agent.
    replay : Replay, optional
        Where agents are, instead of in the scenario.
    ends : {"both", "vehicle", "road"}
        Whose observations count.
    settings : WarningSettings, optional
        Its `ends` are replaced by those above.

    Raises
    ------
    ConfigError
        For a scenario without an ego and without vehicles that move, or unknown ends.

    Notes
    -----
    At every tick of 0.1 s agents are expected where `log2sim.prediction` sees them by what the ends have observed up to then, and
    the ego on its path at its speed, or braking as it does. An agent with which the ego collides by that, with at least
    `min_probability` within `horizon_s`, is warned of from when the ego has to react within `margin_s`. Nothing later is used but the ego's path: its route. States of a
    reconstruction were smoothed over the whole log, so that they depend a little on what came next. In scenarios without an ego
    every vehicle that moves is warned as the ego would be, on a route of its own, while the ends know it.
    """
    settings = replace(settings or WarningSettings(), ends=ends)
    drivers = warnable(scenario)
    moved = to_scenario(replay, scenario) if replay is not None else scenario
    now = {a.id: a for a in moved.agents}
    table = table_of(moved)
    everybody = Watch(scenario, moved.others, settings, table.t_s)
    collisions = _collisions(replay, {driver.id for driver in drivers})
    sources = {a.id: a for a in scenario.agents}
    events, driven_s = [], 0.0
    for driver in drivers:
        watch = everybody.of_driver(driver)
        ticks = np.flatnonzero(table.present[list(now).index(driver.id)])
        drive = _Drive(watch, ego_states(now[driver.id], watch, table.t_s[ticks]), table.t_s[ticks], driver.id)
        own = _with_collisions(_events(drive, watch.courses(drive.ego, ticks)), collisions.get(driver.id, {}), drive)
        if len(ends_of(scenario)) > 1:
            own = [replace(e, known_by=_known_by(sources[e.agent], table.t_s, watch.interval_s)) for e in own]
        events += own
        driven_s += float((np.abs(drive.ego.speed_mps[:-1]) >= STANDSTILL_MPS).sum()) * TICK_S
    used = {f.name: getattr(settings, f.name) for f in fields(settings)}
    in_order = tuple(sorted(_once(events), key=lambda e: (e.begin_s, e.driver, e.agent)))
    return Warnings(
        tells_ends=bool(ends_of(scenario)),
        agents=len(everybody.table.agents),
        known_agents=int(np.isfinite(everybody.known.since_s).sum()),
        driven_s=round(driven_s, 1),
        events=in_order,
        **used,
    )


def warnable(scenario: Scenario) -> list[Agent]:
    """Return who is warned: the ego, or in a scenario without one the vehicles that move.

    Raises
    ------
    ConfigError
        When there is nobody.
    """
    if scenario.ego is not None:
        return [scenario.ego]
    wheeled = [a for a in scenario.agents if a.category in WHEELED and not a.static]
    drivers = [a for a in wheeled if np.abs(a.waypoints.speed_mps).max(initial=0.0) >= MIN_EGO_MPS]
    if not drivers:
        raise ConfigError(
            f"warnings: scenario '{scenario.name}' has no agent '{EGO}' and no vehicle that moves, so nobody could be warned"
        )
    return drivers


def ego_states(ego: Agent, watch: Watch, t_s: Array) -> EgoStates:
    """Return the states of the ego at times (T,), with what it braked just before."""
    x, y, _, yaw, speed = ego.trajectory.at(t_s)
    pace = np.abs(speed)
    before = np.abs(ego.trajectory.at(np.maximum(t_s - BRAKING_SEEN_S, t_s[:1])).speed_mps)
    past_s = np.minimum(t_s - t_s[0], BRAKING_SEEN_S)
    accel = np.divide(pace - before, past_s, out=np.zeros(len(t_s)), where=past_s > TICK_S / 2)
    return EgoStates(x, y, yaw, speed, accel, watch.ego_path.progress(x, y))


class _Drive(NamedTuple):
    """The ego's states at its ticks, and what is known of others."""

    watch: Watch
    ego: EgoStates
    t_s: Array
    driver: str

    def moment(self, agent: int, t_s: float) -> Moment:
        """Compute how far the ego and an agent are from each other at a time."""
        other, size = self.watch.table.agents[agent], self.watch.ego_path.size_m
        x, y, _, yaw, _ = other.trajectory.at(np.array([t_s]))
        columns = (self.ego.x_m, self.ego.y_m, np.unwrap(self.ego.yaw_rad), self.ego.speed_mps)
        own_x, own_y, own_yaw, own_speed = (float(np.interp(t_s, self.t_s, c)) for c in columns)
        gap_m = _gap_m(
            box_corners_bev([[own_x, own_y]], size[0], size[1], own_yaw),
            box_corners_bev([[x[0], y[0]]], other.size_m[0], other.size_m[1], yaw[0]),
        )
        stopping_m = float(self.watch.settings.stopping_distance_m(np.array(own_speed)))
        return Moment(*(round(v, _DIGITS) for v in (t_s, gap_m, abs(own_speed), stopping_m)))

    def known(self, agent: int) -> Moment | None:
        """Compute the same for when an agent is first known, and who is warned, too, and there; None where that never is."""
        own = [] if self.watch.own is None else [self.watch.own]
        since_s = max(float(self.t_s[0]), *self.watch.known.since_s[[agent, *own]].tolist())
        return self.moment(agent, since_s) if since_s <= self.t_s[-1] + TICK_S else None


def _events(drive: _Drive, found: Courses) -> list[CollisionWarning]:
    """Make a warning of all agents that the ego has to be warned of."""
    events = []
    for agent in np.unique(found.agent[found.due]).tolist():
        rows = np.flatnonzero(found.due & (found.agent == agent))
        first, who = rows[np.argmin(found.row[rows])], drive.watch.table.agents[agent]
        moment, way_m = drive.moment(agent, float(drive.t_s[found.row[first]])), float(found.way_m[first])
        needed = drive.watch.settings.needed_mps2(moment.ego_speed_mps, way_m)
        event = CollisionWarning(
            agent=who.id,
            category=who.category,
            driver=drive.driver,
            known=drive.known(agent),
            warned=moment,
            probability=round(float(found.probability[first]), _DIGITS),
            ttc_s=round(float(found.ttc_s[first]), _DIGITS),
            way_m=round(way_m, _DIGITS),
            needed_mps2=None if needed is None else round(needed, _DIGITS),
            braking_suffices=moment.stopping_m <= way_m,
            spans_s=_spans(np.sort(drive.t_s[found.row[rows]])),
        )
        events.append(event)
    return events


def _gap_m(a_m: Array, b_m: Array) -> float:
    """Return the distance of the nearest points of two boxes (1, 4, 2)."""
    import shapely

    return float(shapely.distance(shapely.polygons(a_m), shapely.polygons(b_m))[0])


def _spans(t_s: Array) -> tuple[tuple[float, float], ...]:
    """Join ticks (N,) to spans."""
    edges = np.flatnonzero(np.diff(t_s) > SAME_WARNING_S)
    first, last = np.concatenate([[0], edges + 1]), np.concatenate([edges, [len(t_s) - 1]])
    return tuple((round(float(t_s[a]), _DIGITS), round(float(t_s[b]), _DIGITS)) for a, b in zip(first, last))


def _collisions(replay: Replay | None, drivers: Set[str]) -> dict[str, dict[str, float]]:
    """Return when drivers first touch others in a replay, by both ids; boxes that overlap from the start have not collided."""
    touched: dict[str, dict[str, float]] = {}
    for event in () if replay is None else replay.metrics.get("collisions", ()):
        if not event.get("from_start", False):
            for driver, other in permutations(event["agents"], 2):
                if driver in drivers:
                    own = touched.setdefault(driver, {})
                    own[other] = min(own.get(other, np.inf), round(float(event["t_s"]), _DIGITS))
    return touched


def _with_collisions(
    events: Iterable[CollisionWarning], hit: Mapping[str, float], drive: _Drive
) -> list[CollisionWarning]:
    """Find which agents the ego touches, and add those that nothing was predicted of."""
    out = [replace(e, collision_s=hit.get(e.agent)) for e in events]
    row = {a.id: k for k, a in enumerate(drive.watch.table.agents)}
    for agent in hit.keys() - {e.agent for e in out}:
        k = row[agent]
        category = drive.watch.table.agents[k].category
        out.append(CollisionWarning(agent, category, drive.known(k), driver=drive.driver, collision_s=hit[agent]))
    return out


def _once(events: Iterable[CollisionWarning]) -> list[CollisionWarning]:
    """Leave out collisions without a warning of pairs that are there already: two vehicles may both be drivers."""
    out: dict[Set[str], list[CollisionWarning]] = {}
    for event in sorted(events, key=lambda e: e.warned is None):
        pair = out.setdefault(frozenset((event.driver, event.agent)), [])
        if event.warned is not None or not pair:
            pair.append(event)
    return [event for pair in out.values() for event in pair]


def _known_by(agent: Agent, t_s: Array, interval_s: float) -> dict[str, float]:
    """Return when each end alone knows an agent first, s."""
    found = {}
    present = np.ones((1, len(t_s)), dtype=bool)
    for end in ENDS:
        since = known_agents([agent], [observed_spans(agent, (end,))], t_s, interval_s, present).since_s[0]
        if np.isfinite(since):
            found[end] = round(float(since), _DIGITS)
    return found
