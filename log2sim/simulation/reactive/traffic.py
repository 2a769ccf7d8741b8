"""Decisions of reactive agents: follow their own path in time, but brake for what the scenario does not have there.

Each reactive agent has its own time in the scenario: it passes its trajectory at `rate` (1 as there, 0 standing), and
so falls behind by `delay_s`. It never leaves its path, keeps the scenario's stops, returns to the scenario's speed of
the place, and never catches up.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import STANDSTILL_MPS, Agent, Trajectory
from log2sim.geometry import Array
from log2sim.simulation.groups import Snapshot
from log2sim.simulation.reactive.foresight import Foresight, MotionForesight, PathForesight
from log2sim.simulation.reactive.idm import idm_parameters, rate_response
from log2sim.simulation.reactive.interaction import MIN_DEMAND, TrafficState, excess_demand, predict_all
from log2sim.simulation.reactive.path_table import PathTable, Pose
from log2sim.simulation.reactive.scenario_overlaps import deep_overlaps

DECISION_STEP_S = 0.1
CHUNK = 4096  # pairs evaluated together
RELEASE_S, MAX_KEPT_DEMAND = 0.5, 4.0
"""A demand fades over this time after it ends, so that the rate does not oscillate at the edge of a conflict."""

SAME_DELAY_S = 1e-9  # delays that differ by rounding are the same


class Traffic:
    """Decisions of the reactive agents among the A agents of a scenario; all columns are (A,) over all of them.

    Parameters
    ----------
    agents, trajectories : sequences
        All agents, and the trajectories of their box centers; for static agents one pose.
    reactive : collection of str
        Ids of the reactive agents.
    driven : str, optional
        Id of the agent whose states are given with each decision, since a policy drives it.
    foresight : str
        One of `FORESIGHTS`: what the reactive agents expect of others.

    Notes
    -----
    A pair of agents is evaluated only while it differs from the scenario: one is driven by a policy, or their delays
    differ, or they overlap in the scenario itself. The demand of a leader is compared with its demand in the scenario
    when the agent was at this place, and only the excess counts; so a scenario that drives closer than the model would
    is reproduced. Where the paths of two reactive agents cross, the one that was there first in the scenario goes
    first. Cost: R A comparisons a decision, then some 500 distances for each pair in reach.
    """

    def __init__(
        self,
        agents: Sequence[Agent],
        trajectories: Sequence[Trajectory],
        reactive: Collection[str],
        driven: str | None,
        foresight: str = "path",
    ) -> None:
        self.index = {a.id: k for k, a in enumerate(agents)}
        self.paths = PathTable(trajectories)
        self._foresight: Foresight
        self._foresight = MotionForesight(self.paths, agents) if foresight == "motion" else PathForesight(self.paths)
        self.reacts = np.array([a.id in reactive for a in agents], dtype=bool)
        self.idm = idm_parameters(agents)
        self._static = np.array([a.static for a in agents], dtype=bool)
        self._stays = np.array([a.is_permanent for a in agents], dtype=bool)
        self._driven = self.index[driven] if driven is not None else -1
        self._size = np.array([a.size_m for a in agents], dtype=np.float64).reshape(-1, 3)
        self._distrusted = deep_overlaps(self.paths, self._size, self._static)
        self.restart()

    def restart(self) -> None:
        """Reset all agents to the time of the scenario."""
        count, self._decided_s = len(self.reacts), -np.inf
        self.delay_s, self.rate, self.rate_slope = np.zeros(count), np.ones(count), np.zeros(count)
        self._taken, self._driven_m = np.zeros(count), 0.0

    def decide(self, t_s: float, dt_s: float, ego: Snapshot | None) -> None:
        """Choose the rates of the reactive agents, and advance their times in the scenario by `dt_s`.

        `ego` is the state of the driven agent, None if there is none.
        """
        tau = t_s - self.delay_s
        going = self.reacts & (self.paths.begin_s <= tau) & (tau < self.paths.end_s)
        if t_s > self._decided_s + DECISION_STEP_S - SAME_DELAY_S:
            self._decided_s = t_s
            self._decide(t_s, tau, np.flatnonzero(going), ego)
        rate = np.where(going, np.clip(self.rate + self.rate_slope * dt_s, 0.0, 1.0), 1.0)
        self.delay_s = self.delay_s + np.where(going, (1 - (self.rate + rate) / 2) * dt_s, 0.0)
        self.rate = rate

    def _decide(self, t_s: float, tau: Array, own: NDArray[np.intp], ego: Snapshot | None) -> None:
        """Set the rates of agents `own` (R,) and their slopes."""
        pose = self.paths.at(np.arange(len(tau)), tau)
        pace = np.abs(pose.speed_mps[own])
        log_accel = (np.abs(self.paths.at(own, tau[own] + DECISION_STEP_S).speed_mps) - pace) / DECISION_STEP_S
        pose = self._with_ego(pose, ego)
        prediction = predict_all(self._foresight, t_s, pose, tau, self.rate, self._driven)
        moment = TrafficState(
            self.paths,
            self.idm,
            self._size,
            self.reacts,
            self._driven,
            tau,
            self.rate,
            pose,
            prediction,
            self._foresight,
        )
        taken = np.zeros(len(tau))
        pairs = moment.meeting(*self._pairs(t_s, tau, own))
        for begin in range(0, len(pairs[0]), CHUNK):
            i, j = (p[begin : begin + CHUNK] for p in pairs)
            np.maximum.at(taken, i, excess_demand(moment, i, j, ~self._distrusted[i, j]))
        kept = np.minimum(self._taken, MAX_KEPT_DEMAND) * np.exp(-DECISION_STEP_S / RELEASE_S)
        taken = np.maximum(taken, np.where(kept > MIN_DEMAND, kept, 0.0))
        self._taken = taken
        rate, slope = rate_response(self.idm.take(own), self.rate[own], taken[own], pace, log_accel)
        stands = pace < STANDSTILL_MPS  # the scenario's time goes on: waiting then counts as the scenario's own stop
        self.rate[own], self.rate_slope[own] = np.where(stands, 1.0, rate), np.where(stands, 0.0, slope)

    def _with_ego(self, pose: Pose, ego: Snapshot | None) -> Pose:
        """Replace the pose of the driven agent by the one to which the policy has driven it."""
        k = self._driven
        if ego is None or k < 0 or not len(ego.x_m):
            return pose
        x, y, yaw, speed = pose.x_m.copy(), pose.y_m.copy(), pose.yaw_rad.copy(), pose.speed_mps.copy()
        x[k], y[k] = ego.x_m[0] - self.paths.origin_m[0], ego.y_m[0] - self.paths.origin_m[1]
        yaw[k], speed[k] = ego.yaw_rad[0], ego.speed_mps[0]
        # Its height is that of the scenario at this place; by time, nobody would brake for it on a slope if it fell behind.
        self._driven_m = self.paths.progress_near(k, self._driven_m, float(ego.x_m[0]), float(ego.y_m[0]))
        z = pose.z_m.copy()
        driven = np.array([k])
        z[k] = self.paths.at(driven, self.paths.times(driven, np.array([self._driven_m]))).z_m[0]
        return pose._replace(x_m=x, y_m=y, z_m=z, yaw_rad=yaw, speed_mps=speed)

    def _pairs(self, t_s: float, tau: Array, own: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return pairs of a reactive agent (P,) and a present agent (P,) whose relation differs from the scenario."""
        differs = (np.abs(self.delay_s[own][:, None] - self.delay_s) > SAME_DELAY_S) & ~self._static
        if self._driven >= 0:
            differs[:, self._driven] = True
        differs |= self._distrusted[own]
        differs &= (self.paths.begin_s <= t_s) & (tau <= self.paths.end_s) | self._stays
        differs[np.arange(len(own)), own] = False
        row, j = np.nonzero(differs)
        return own[row], j
