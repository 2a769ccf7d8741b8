"""Warnings of collisions with the ego, or without one of each vehicle, from what the sensors at chosen ends have observed."""

from __future__ import annotations

import math
from collections.abc import Sequence, Set
from copy import copy
from dataclasses import fields, replace
from itertools import chain, permutations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import EGO, ENDS, STANDSTILL_MPS, Agent, Scenario
from log2sim.datatypes.agent import MAX_LISTED
from log2sim.errors import ConfigError
from log2sim.geometry import Array
from log2sim.simulation.expected_motion import (
    EgoPath,
    EgoStates,
    ExpectedAgents,
    WarningSettings,
    ends_of,
    expected_contacts,
    known_agents,
    observation_interval_s,
    observed_spans,
)
from log2sim.simulation.metrics.realism import signed_distance
from log2sim.simulation.policy import Controls, Observation
from log2sim.simulation.prediction.motion_table import TICK_S, Complex, table_of, tabulate
from log2sim.simulation.reference import ControllerMemory, Reference, follow_vehicles, vehicle_reference_of
from log2sim.simulation.result import CollisionWarning, Moment, Replay, Warnings, to_scenario
from log2sim.simulation.vehicles.vehicle import WHEELED, VehicleState, parameters_for

_ENDS = {"vehicle": "the vehicle's sensors", "road": "the road's sensors", "both": "the sensors of vehicle and road"}


def describe_warnings(warnings: Warnings) -> str:
    """Say how many warnings there are, and describe the first ones."""
    whose = (
        _ENDS[warnings.ends] if warnings.tells_ends else "all sensors, which the scenario does not distinguish by end"
    )
    others = "agents" if any(w.driver != EGO for w in warnings.events) else "other agents"
    lines = [
        f"{count_warnings(warnings)} in {warnings.driven_s:.1f} s of driving, by {whose}: they know {warnings.known_agents} of {warnings.agents} {others}"
    ]
    lines += [f"  {describe_warning(w, warnings)}" for w in warnings.events[:MAX_LISTED]]
    if len(warnings.events) > MAX_LISTED:
        lines.append(f"  and {len(warnings.events) - MAX_LISTED} more")
    return "\n".join(lines)


def count_warnings(warnings: Warnings) -> str:
    """Say how many warnings there are, and how many collisions nothing was predicted of."""
    warned = sum(w.warned is not None for w in warnings.events)
    missed = len(warnings.events) - warned
    text = f"{warned or 'no'} warning{'s' * (warned != 1)}"
    return text if not missed else f"{text} and {missed} collision{'s' * (missed != 1)} without"


def describe_warning(warning: CollisionWarning, warnings: Warnings) -> str:
    """Describe a warning: when, how soon and how far off the collision is, whether braking suffices, and since when it is known."""
    parts, at, known = [describe_briefly(warning) + "."], warning.warned, warning.known
    if at is not None and warning.way_m is not None:
        verdict = "braking suffices" if warning.braking_suffices else "braking comes too late"
        needed = "" if warning.needed_mps2 is None else f", {warning.needed_mps2:.1f} m/s2 would be needed"
        parts.append(
            f"{'The ego' if warning.driver == EGO else warning.driver} drives {at.ego_speed_mps * 3.6:.0f} km/h, {warning.way_m:.1f} m from the "
            f"collision, and stands after {at.stopping_m:.1f} m ({warnings.reaction_s:g} s to react, then {warnings.brake_mps2:g} m/s2): {verdict}{needed}."
        )
    in_order = sorted(warning.known_by.items(), key=lambda e: e[1])
    ends = "; ".join(f"to the {end} alone from {t_s:.2f} s" for end, t_s in in_order)
    since = "Never known" if known is None else f"Known since {known.t_s:.2f} s, {known.distance_m:.1f} m away"
    parts.append(f"{since} ({ends})." if ends else f"{since}.")
    if at is not None and warning.collision_s is not None:
        parts.append(f"They collide at {warning.collision_s:.2f} s.")
    return " ".join(parts)


def describe_briefly(warning: CollisionWarning) -> str:
    """Say who is warned of, when, and how soon and how far off the collision is."""
    at, pair = warning.warned, warning.agent if warning.driver == EGO else f"{warning.driver} and {warning.agent}"
    if at is None or warning.ttc_s is None:
        return f"{pair}: no warning before the collision at {warning.begin_s:.2f} s"
    return (
        f"{pair}: warning at {at.t_s:.2f} s, collision in {warning.ttc_s:.2f} s with probability "
        f"{warning.probability:.2f}, {at.distance_m:.1f} m apart"
    )


MAX_SLOPE = 0.06  # of a road beyond the heights of the ego's path: more is rare outside of mountains
SPARE_MPS = 5.0  # by so much an agent may become faster within the horizon, and be compared with the ego still
MIN_EGO_MPS = 1.0  # a slower ego stands within a meter whenever it has to, so that it need not be warned
Index = NDArray[np.intp]


class Courses(NamedTuple):
    """Agents that may collide with the ego, by tick; columns (C,)."""

    agent: Index
    row: Index  # of the state of the ego
    probability: Array
    ttc_s: Array  # time to the collision
    way_m: Array  # of the ego until then
    due: NDArray[np.bool_]  # whether the ego has to be warned: the collision is probable enough and near enough


class Watch:
    """All agents of a scenario that somebody may be warned of, and what chosen ends know of them at common ticks.

    The ego is warned; `for_driver` gives the same watch for another vehicle.

    `scenario`: with what was observed when. `agents`: all but the ego, where they are: as in the scenario, or in a
    replay of it. `t_s` (T,), s: ticks, `TICK_S` apart.
    """

    ego_path: EgoPath

    def __init__(self, scenario: Scenario, agents: Sequence[Agent], settings: WarningSettings, t_s: Array) -> None:
        self.settings, self.interval_s = settings, observation_interval_s(scenario)
        source = {a.id: a for a in scenario.agents}
        spans = [observed_spans(source[a.id], settings.used_ends) for a in agents]
        self.table = tabulate(agents, t_s)
        self.known = known_agents(agents, spans, t_s, self.interval_s, self.table.present)
        self.own: int | None = None
        if scenario.ego is not None:
            self.ego_path = EgoPath(scenario.ego)
        self._expected = ExpectedAgents(self.table, self.known, self.interval_s, settings.horizon_s)

    def for_driver(self, driver: Agent) -> Watch:
        """Return a watch that warns a vehicle of the scenario in place of the ego, while the ends know it."""
        view = copy(self)
        view.ego_path = EgoPath(driver)
        view.own = next((k for k, a in enumerate(self.table.agents) if a.id == driver.id), None)
        return view

    def courses(self, ego: EgoStates, ticks: Index, seen: tuple[Complex, Array] | None = None) -> Courses:
        """Find who may collide with the ego, whose states are those at ticks (T,).

        `ticks` (T,) int. `seen` (A,) complex128, m, and (A,), m/s, optional: where agents are, and how fast, if they
        may be elsewhere than in the table: then they are expected to do from there what is expected in the table, as
        much faster as they are. NaN for those that are as in the table.
        """
        row, agent = np.nonzero(self.known.source[:, ticks].T >= 0)
        kept = np.abs(ego.speed_mps[row]) >= MIN_EGO_MPS
        if self.own is not None:
            kept &= (agent != self.own) & (self.known.source[self.own, ticks[row]] >= 0)
        row, agent = row[kept], agent[kept]
        # Of these, who is within reach of the ego, and at a height of its path.
        table, size, source = self.table, self.ego_path.size_m, self.known.source[agent, ticks[row]]
        place, speed = table.position_m[agent, source], np.abs(table.velocity_mps[agent, source])
        apart = np.abs(place - (ego.x_m + 1j * ego.y_m)[row])
        ahead_s = self.settings.horizon_s + (ticks[row] - source) * TICK_S
        reach = np.abs(ego.speed_mps[row]) * self.settings.horizon_s + (speed + SPARE_MPS) * ahead_s
        radius = np.hypot(*table.size_m[agent, :2].T) / 2
        near = np.flatnonzero(apart <= reach + np.hypot(*size[:2]) / 2 + radius)
        row, agent, source, apart = row[near], agent[near], source[near], apart[near]
        path_z = self.ego_path.heights(ego.progress_m[row], apart)
        z = np.array([table.agents[k].trajectory.heights(table.t_s[[n]])[0] for k, n in zip(agent, source)])
        room = (table.size_m[agent, 2] + size[2]) / 2 + MAX_SLOPE * apart
        level = np.abs(path_z - z.reshape(-1, 1)).min(axis=1) < room
        row, agent = row[level], agent[level]
        tick, lead_s = ticks[row], self._expected.lead_s
        others = self._expected.at(agent, tick)
        if seen is not None:  # ways begin where agents are seen to be, and are as much faster as they are
            place, speed = seen[0][agent], seen[1][agent]
            measured = np.isfinite(place) & self.known.observed[agent, tick]
            usual = np.abs(table.velocity_mps[agent, tick])
            faster = np.divide(speed, usual, out=np.ones(len(agent)), where=measured & (usual > STANDSTILL_MPS))
            usually = others.position_m
            moved = place[:, None] + np.minimum(faster, 2.0)[:, None] * (usually - usually[:, :1])
            others = replace(others, position_m=np.where(measured[:, None], moved, usually))
        own = self.ego_path.at(ego.take(row), lead_s)
        probability, time_s = expected_contacts(own, others, lead_s)
        gone = np.cumsum(np.abs(np.diff(own.position_m, axis=1, prepend=own.position_m[:, :1])), axis=1)
        way = np.array([np.interp(t, lead_s, w) if np.isfinite(t) else np.inf for t, w in zip(time_s, gone)])
        # To be warned of when the ego has to react at once; `margin_s` earlier, while there is time, only if it is clear.
        pace, s = np.abs(ego.speed_mps[row]), self.settings
        left_m = way - s.stopping_distance_m(pace)
        due = (probability >= s.early_probability) & (left_m <= pace * s.margin_s)
        due |= (probability >= s.min_probability) & (left_m <= 0)
        return Courses(agent, row, probability, time_s, way, due)


# The ego's deceleration is that of its speed over this time: three ticks give it to 0.5 m/s2 where a speed is good to
# 0.1 m/s.
BRAKING_SEEN_S = 0.3

SAME_WARNING_S = 1.0  # a warning that ends for less time goes on
_DIGITS = 3


def warn(
    scenario: Scenario, replay: Replay | None = None, *, ends: str = "both", settings: WarningSettings | None = None
) -> Warnings:
    """Find the agents on a collision course with the ego, or without one with any vehicle: since when they are known, and when they are warned of.

    Agents are where the replay has them, or the scenario without one; only what `ends` ("both", "vehicle" or "road") observed
    counts, which overrides those of the settings. Raises `ConfigError` for a scenario without an ego and without vehicles that
    move, or unknown ends.

    Notes
    -----
    At every tick of 0.1 s agents are expected where `log2sim.simulation.prediction` sees them by what the ends have observed up to then, and
    the ego on its path at its speed, or braking as it does. An agent with which the ego collides by that, with at least
    `min_probability` within `horizon_s`, is warned of from when the ego has to react within `margin_s`. Nothing later is used but the ego's path: its route. States of a
    reconstruction were smoothed over the whole log, so that they depend a little on what came next. In scenarios without an ego
    every vehicle that moves is warned as the ego would be, on a route of its own, while the ends know it.
    """
    settings = replace(settings or WarningSettings(), ends=ends)
    moved = to_scenario(replay, scenario) if replay is not None else scenario
    now, source = ({a.id: a for a in s.agents} for s in (moved, scenario))
    drivers = warnable(replace(scenario, agents=tuple(a for a in scenario.agents if a.id in now)))
    table = table_of(moved)
    everybody = Watch(scenario, moved.others, settings, table.t_s)
    # When drivers first touch others in the replay; boxes that overlap from the start have not collided.
    touched: dict[str, dict[str, float]] = {driver.id: {} for driver in drivers}
    for event in () if replay is None else replay.metrics.get("collisions", ()):
        for one, two in permutations(event["agents"], 2) if not event.get("from_start", False) else ():
            if one in touched:
                touched[one][two] = min(touched[one].get(two, np.inf), round(float(event["t_s"]), _DIGITS))
    row = {a.id: k for k, a in enumerate(moved.others)}
    events, driven_s = [], 0.0
    for driver in drivers:
        watch, hit = everybody.for_driver(driver), touched[driver.id]
        ticks = np.flatnonzero(table.present[list(now).index(driver.id)])
        t_s, path = table.t_s[ticks], now[driver.id].trajectory
        x, y, _, yaw, speed = path.at(t_s)
        past_s = np.minimum(t_s - t_s[0], BRAKING_SEEN_S)
        slower = np.abs(speed) - np.abs(path.at(np.maximum(t_s - BRAKING_SEEN_S, t_s[:1])).speed_mps)
        accel = np.divide(slower, past_s, out=np.zeros(len(t_s)), where=past_s > TICK_S / 2)
        drive = _Drive(watch, EgoStates(x, y, yaw, speed, accel, watch.ego_path.paths.progress(0, x, y)), t_s)
        found = watch.courses(drive.ego, ticks)
        own = []
        for k in np.unique(found.agent[found.due]).tolist():
            rows = np.flatnonzero(found.due & (found.agent == k))
            first, who = rows[np.argmin(found.row[rows])], watch.table.agents[k]
            moment, way_m = drive.moment(k, float(t_s[found.row[first]])), float(found.way_m[first])
            needed = settings.needed_mps2(moment.ego_speed_mps, way_m)
            own.append(CollisionWarning(
                agent=who.id, category=who.category, driver=driver.id, known=drive.known(k), warned=moment,
                probability=round(float(found.probability[first]), _DIGITS),
                ttc_s=round(float(found.ttc_s[first]), _DIGITS), way_m=round(way_m, _DIGITS),
                needed_mps2=None if needed is None else round(needed, _DIGITS),
                braking_suffices=moment.stopping_m <= way_m, spans_s=_spans(np.sort(t_s[found.row[rows]])),
                collision_s=hit.get(who.id),
            ))  # fmt: skip
        for agent in hit.keys() - {e.agent for e in own}:  # collisions that nothing was predicted of
            known = drive.known(row[agent])
            own.append(CollisionWarning(agent, now[agent].category, known, driver=driver.id, collision_s=hit[agent]))
        for n, event in enumerate(own) if len(ends_of(scenario)) > 1 else ():
            who, known_by, present = source[event.agent], {}, np.ones((1, len(table.t_s)), dtype=bool)
            for end in ENDS:
                spans = [observed_spans(who, (end,))]
                since = known_agents([who], spans, table.t_s, watch.interval_s, present).since_s[0]
                if np.isfinite(since):
                    known_by[end] = round(float(since), _DIGITS)
            own[n] = replace(event, known_by=known_by)
        events += own
        driven_s += float((np.abs(speed[:-1]) >= STANDSTILL_MPS).sum()) * TICK_S
    # Of two vehicles that are both drivers, a collision without a warning is told once, and not where there is a warning.
    once: dict[Set[str], list[CollisionWarning]] = {}
    for event in sorted(events, key=lambda e: e.warned is None):
        pair = once.setdefault(frozenset((event.driver, event.agent)), [])
        if event.warned is not None or not pair:
            pair.append(event)
    in_order = sorted(chain(*once.values()), key=lambda e: (e.begin_s, e.driver, e.agent))
    return Warnings(
        tells_ends=bool(ends_of(scenario)), agents=len(everybody.table.agents), driven_s=round(driven_s, 1),
        known_agents=int(np.isfinite(everybody.known.since_s).sum()), events=tuple(in_order),
        **{f.name: getattr(settings, f.name) for f in fields(settings)},
    )  # fmt: skip


def warnable(scenario: Scenario) -> list[Agent]:
    """Return who is warned: the ego, or in a scenario without one the vehicles that move.

    Raises `ConfigError` when there is nobody.
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


class _Drive(NamedTuple):
    """The ego's states at its ticks, and what is known of others."""

    watch: Watch
    ego: EgoStates
    t_s: Array

    def moment(self, agent: int, t_s: float) -> Moment:
        """Compute how far the ego and an agent are from each other at a time."""
        other, size = self.watch.table.agents[agent], self.watch.ego_path.size_m
        x, y, _, yaw, _ = other.trajectory.at(np.array([t_s]))
        columns = (self.ego.x_m, self.ego.y_m, np.unwrap(self.ego.yaw_rad), self.ego.speed_mps)
        own_x, own_y, own_yaw, own_speed = (float(np.interp(t_s, self.t_s, c)) for c in columns)
        away, sizes = x + 1j * y - complex(own_x, own_y), [np.array([s]) for s in (size, other.size_m)]
        gap_m = max(float(signed_distance(away, np.array([own_yaw]), yaw, *sizes)[0]), 0.0)
        stopping_m = float(self.watch.settings.stopping_distance_m(np.array(own_speed)))
        return Moment(*(round(v, _DIGITS) for v in (t_s, gap_m, abs(own_speed), stopping_m)))

    def known(self, agent: int) -> Moment | None:
        """Compute the same for when an agent is first known, and who is warned, too, and there; None where that never is."""
        own = [] if self.watch.own is None else [self.watch.own]
        since_s = max(float(self.t_s[0]), *self.watch.known.since_s[[agent, *own]].tolist())
        return self.moment(agent, since_s) if since_s <= self.t_s[-1] + TICK_S else None


def _spans(t_s: Array) -> tuple[tuple[float, float], ...]:
    """Join ticks (N,) to spans."""
    edges = np.flatnonzero(np.diff(t_s) > SAME_WARNING_S)
    first, last = np.concatenate([[0], edges + 1]), np.concatenate([edges, [len(t_s) - 1]])
    return tuple((round(float(t_s[a]), _DIGITS), round(float(t_s[b]), _DIGITS)) for a, b in zip(first, last))


# Of a car that pulls away: twice what the intelligent driver model takes for comfortable in towns.
MAX_THROTTLE_MPS2 = 3.0

CATCH_UP_S = 0.2  # after it has braked, the ego catches up with so much and no more


class LateDriver:
    """Follows the trajectory of an ego on wheels by the controller of `pid`, by the scenario's time less a delay."""

    def __init__(self, ego: Agent) -> None:
        self._ego, self._parameters = ego, parameters_for([ego])
        self._reference: Reference | None = None
        self._memory = ControllerMemory.fresh(1)
        self._delay_s, self._braked = 0.0, False

    def drive(self, seen: Observation) -> Controls:
        """Return what follows the scenario."""
        if self._braked and abs(self._row(seen)[3, 0]) > STANDSTILL_MPS:
            self._delay_s = max(self._delay_s, seen.t_s - self._place_s(seen) - CATCH_UP_S)
        commands = self._follow(seen)
        return replace(commands, accel_mps2=min(commands.accel_mps2, MAX_THROTTLE_MPS2)) if self._braked else commands

    def brake(self, seen: Observation, brake_mps2: float) -> Controls:
        """Return what stops the ego on its path; it goes on from there."""
        self._delay_s, self._braked = seen.t_s - self._place_s(seen), True
        self._memory = ControllerMemory.fresh(1)
        return replace(self._follow(seen), accel_mps2=-brake_mps2)

    def _follow(self, seen: Observation) -> Controls:
        row, ego = self._row(seen), seen.ego
        assert self._reference is not None  # since `_row` has built it
        x0, y0 = self._reference.trajectory.origin_m
        # The rear axle, relative to the origin of the reference.
        x = ego.x_m - ego.rear_axle_offset_m * np.cos(ego.yaw_rad) - x0
        y = ego.y_m - ego.rear_axle_offset_m * np.sin(ego.yaw_rad) - y0
        columns = (x, y, ego.yaw_rad, ego.speed_mps, ego.steer_rad, 0.0, 0.0, 0.0)
        state = VehicleState(*(np.array([c]) for c in columns))
        p = replace(self._parameters, understeer_s2pm2=np.array([ego.understeer_s2pm2]))
        commands, self._memory = follow_vehicles(row, state, self._memory, p, seen.dt_s)
        return Controls(float(commands.pedal_mps2[0]), float(commands.steer_rad[0]), bool(commands.reverse[0]))

    def _row(self, seen: Observation) -> Array:
        """Return the reference (C, 1) of the present."""
        if self._reference is None:
            self._reference = vehicle_reference_of(self._ego, seen.dt_s)
        return self._reference.exact(np.array([seen.t_s - self._delay_s])).T

    def _place_s(self, seen: Observation) -> float:
        """Return when the scenario was at this place; its end beyond."""
        at_s = float(seen.path.t_s[0])
        return at_s if np.isfinite(at_s) else float(self._ego.waypoints.t_s[-1])


CLEAR_S = 1.0  # the ego drives on when its way has been clear for so long


class BrakeWhenWarned:
    """Drives along the path of the scenario at its times; when warned, brakes after the reaction time until its way is clear.

    Its way is clear when no collision would be predicted if it drove on as in the scenario. It then goes on from there, later than
    in the scenario.
    """

    def __init__(self, settings: WarningSettings | None = None) -> None:
        self.settings = settings or WarningSettings()

    def reset(self, scenario: Scenario) -> None:
        """Begin a scenario."""
        assert scenario.ego is not None  # a policy drives an ego
        self._watch = Watch(scenario, scenario.others, self.settings, table_of(scenario).t_s)
        self._index = {a.id: k for k, a in enumerate(scenario.others)}
        self._driver, self._tick = LateDriver(scenario.ego), -1
        self._warned_s, self._danger_s = np.inf, -np.inf

    def __call__(self, seen: Observation) -> Controls:
        """Answer an observation."""
        tick = int((seen.t_s - self._watch.table.t_s[0]) / TICK_S + 1e-6)
        if tick > self._tick:
            self._tick = tick
            self._check_danger(seen, min(tick, len(self._watch.table.t_s) - 1))
        if self._braking(seen.t_s):
            return self._driver.brake(seen, self.settings.brake_mps2)
        return self._driver.drive(seen)

    def _braking(self, t_s: float) -> bool:
        return t_s >= self._warned_s + self.settings.reaction_s - 1e-9

    def _check_danger(self, seen: Observation, tick: int) -> None:
        """Look for danger, and forget the warning where there was none for `CLEAR_S`."""
        ego, t_s = seen.ego, seen.t_s
        speed, accel = ego.speed_mps, math.copysign(ego.accel_mps2, ego.accel_mps2 * ego.speed_mps)
        if self._braking(t_s):
            # Negative where the path is driven in reverse.
            forward = math.cos(float(seen.path.yaw_rad[0]) - ego.yaw_rad)
            speed = math.copysign(max(abs(speed), float(seen.path.speed_mps[0]), MIN_EGO_MPS), forward)
            accel = 0.0
        one = [np.array([v]) for v in (ego.x_m, ego.y_m, ego.yaw_rad, speed, accel, seen.path.progress_m)]
        place, pace = np.full(len(self._index), np.nan, dtype=complex), np.full(len(self._index), np.nan)
        rows = np.array([self._index[i] for i in seen.others.id.tolist()], dtype=np.intp)
        place[rows] = seen.others.x_m + 1j * seen.others.y_m
        pace[rows] = np.hypot(seen.others.velocity_x_mps, seen.others.velocity_y_mps)
        found = self._watch.courses(EgoStates(*one), np.array([tick]), (place, pace))
        if found.due.any():
            self._danger_s, self._warned_s = t_s, min(self._warned_s, t_s)
        elif t_s > self._danger_s + CLEAR_S - 1e-9:
            self._warned_s = np.inf
