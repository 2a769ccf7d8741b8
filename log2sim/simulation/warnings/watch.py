"""Looks for agents on a collision course with the ego, at ticks, by what is known then."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import STANDSTILL_MPS, Agent, Scenario
from log2sim.geometry import Array
from log2sim.prediction.motion_table import TICK_S, Complex, tabulate
from log2sim.simulation.warnings.contact import expected_contacts
from log2sim.simulation.warnings.ego_path import EgoPath, EgoStates
from log2sim.simulation.warnings.expected_paths import ExpectedAgents
from log2sim.simulation.warnings.known import known_agents, observation_interval_s, observed_spans
from log2sim.simulation.warnings.settings import WarningSettings

MAX_SLOPE = 0.06
"""Of a road beyond the heights of the ego's path: more is rare outside of mountains."""

SPARE_MPS = 5.0
"""By so much an agent may become faster within the horizon, and be compared with the ego still."""

MIN_EGO_MPS = 1.0
"""A slower ego stands within a meter whenever it has to, so that it need not be warned."""

Index = NDArray[np.intp]


class Courses(NamedTuple):
    """Agents that may collide with the ego, by tick.

    Attributes
    ----------
    agent, row : (C,) int
        Index of the agent, and of the state of the ego.
    probability : (C,) float64
    ttc_s : (C,) float64, s
        Time to the collision.
    way_m : (C,) float64, m
        Of the ego until then.
    due : (C,) bool
        Whether the ego has to be warned: the collision is probable enough and near enough.
    """

    agent: Index
    row: Index
    probability: Array
    ttc_s: Array
    way_m: Array
    due: NDArray[np.bool_]


class Watch:
    """All agents of a scenario that somebody may be warned of, and what chosen ends know of them at common ticks.

    The ego is warned; `of_driver` gives the same watch for another vehicle.

    Parameters
    ----------
    scenario : Scenario
        With what was observed when.
    agents : sequence of Agent
        All but the ego, where they are: as in the scenario, or in a replay of it.
    settings : WarningSettings
    t_s : (T,) float64, s
        Ticks, `TICK_S` apart.
    """

    ego_path: EgoPath

    def __init__(self, scenario: Scenario, agents: Sequence[Agent], settings: WarningSettings, t_s: Array) -> None:
        self.settings, self.interval_s = settings, observation_interval_s(scenario)
        source = {a.id: a for a in scenario.agents}
        spans = [observed_spans(source[a.id], settings.used_ends) for a in agents]
        self.table = tabulate(agents, t_s, TICK_S)
        self.known = known_agents(agents, spans, t_s, self.interval_s, self.table.present)
        self.own: int | None = None
        if scenario.ego is not None:
            self.ego_path = EgoPath(scenario.ego)
        self._expected = ExpectedAgents(self.table, self.known, self.interval_s, settings.horizon_s)
        self._height_m = np.array([a.size_m[2] for a in agents])
        self._radius_m = np.array([np.hypot(*a.size_m[:2]) / 2 for a in agents])

    def of_driver(self, driver: Agent) -> Watch:
        """Return a watch that warns a vehicle of the scenario in place of the ego, while the ends know it."""
        view = copy(self)
        view.ego_path = EgoPath(driver)
        view.own = next((k for k, a in enumerate(self.table.agents) if a.id == driver.id), None)
        return view

    def courses(self, ego: EgoStates, ticks: Index, seen: tuple[Complex, Array] | None = None) -> Courses:
        """Find who may collide with the ego, whose states are those at ticks (T,).

        Parameters
        ----------
        ego : EgoStates
        ticks : (T,) int
        seen : (A,) complex128, m, and (A,) float64, m/s, optional
            Where agents are, and how fast, if they may be elsewhere than in the table: then they are expected to do from there
            what is expected in the table, as much faster as they are. NaN for those that are as in the table.
        """
        row, agent = np.nonzero(self.known.source[:, ticks].T >= 0)
        kept = np.abs(ego.speed_mps[row]) >= MIN_EGO_MPS
        if self.own is not None:
            kept &= (agent != self.own) & (self.known.source[self.own, ticks[row]] >= 0)
        row, agent = row[kept], agent[kept]
        kept = self._may_meet(ego.take(row), agent, ticks[row])
        row, agent = row[kept], agent[kept]
        tick = ticks[row]
        others = self._expected.at(agent, tick)
        if seen is not None:
            others = replace(others, position_m=self._moved(others.position_m, agent, tick, seen))
        lead_s = self._expected.lead_s
        own = self.ego_path.at(ego.take(row), lead_s)
        found = expected_contacts(own, others, lead_s)
        gone = np.concatenate(
            [np.zeros((len(row), 1)), np.cumsum(np.abs(np.diff(own.position_m, axis=1)), axis=1)], axis=1
        )
        way = np.array([np.interp(t, lead_s, w) if np.isfinite(t) else np.inf for t, w in zip(found.time_s, gone)])
        due = self.settings.is_due(found.probability, way, ego.speed_mps[row])
        return Courses(agent, row, found.probability, found.time_s, way, due)

    def _may_meet(self, ego: EgoStates, agent: Index, tick: Index) -> NDArray[np.bool_]:
        """Whether agents (C,) are within reach of the ego, and at a height of its path."""
        source = self.known.source[agent, tick]
        place, speed = self.table.position_m[agent, source], np.abs(self.table.velocity_mps[agent, source])
        apart = np.abs(place - (ego.x_m + 1j * ego.y_m))
        ahead_s = self.settings.horizon_s + (tick - source) * TICK_S
        size = self.ego_path.size_m
        reach = np.abs(ego.speed_mps) * self.settings.horizon_s + (speed + SPARE_MPS) * ahead_s
        near = np.flatnonzero(apart <= reach + np.hypot(*size[:2]) / 2 + self._radius_m[agent])
        path_z = self.ego_path.heights(ego.progress_m[near], apart[near])
        z = np.array(
            [self.table.agents[k].trajectory.heights(self.table.t_s[[n]])[0] for k, n in zip(agent[near], source[near])]
        )
        room = (self._height_m[agent[near]] + size[2]) / 2 + MAX_SLOPE * apart[near]
        meets = np.zeros(len(agent), dtype=bool)
        meets[near] = np.abs(path_z - z.reshape(-1, 1)).min(axis=1) < room if len(near) else False
        return meets

    def _moved(self, way: Complex, agent: Index, tick: Index, seen: tuple[Complex, Array]) -> Complex:
        """Let ways (C, H) begin where agents are seen to be, as much faster as they are."""
        place, speed = seen[0][agent], seen[1][agent]
        measured = np.isfinite(place) & self.known.observed[agent, tick]
        usual = np.abs(self.table.velocity_mps[agent, tick])
        faster = np.divide(speed, usual, out=np.ones(len(agent)), where=measured & (usual > STANDSTILL_MPS))
        moved = place[:, None] + np.minimum(faster, 2.0)[:, None] * (way - way[:, :1])
        return np.where(measured[:, None], moved, way)
