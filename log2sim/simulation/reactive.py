"""Reactive agents: they keep to their paths and brake for what the scenario does not have.

Each reactive agent has its own time in the scenario: it passes its trajectory at `rate` (1 as there, 0 standing), and
so falls behind by `delay_s`. It never leaves its path, keeps the scenario's stops, returns to the scenario's speed of
the place, and never catches up.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import STANDSTILL_MPS, Agent, Trajectory
from log2sim.geometry import Array, wrap_angle
from log2sim.simulation import corridors
from log2sim.simulation.groups import AgentGroup, PedestrianGroup, Snapshot, StepClock, VehicleGroup
from log2sim.simulation.metrics.collisions import BoxTracks, contacts
from log2sim.simulation.prediction.motion_table import TICK_S, displacement, smooth_motion, tabulate
from log2sim.simulation.reference import GRID_S, POINT_COLUMNS, REFERENCE_HOLD_MPS, VEHICLE_COLUMNS
from log2sim.simulation.vehicles.vehicle import WHEELED, Columns

EXPONENT = 4.0
MIN_GAP_M = 0.1  # shorter gaps, and overlaps, count as this one
MIN_PACE_MPS = 0.5  # where it is slower, the rate responds as at this speed; it would have no bound at standstill
HOLD_MPS = 0.2  # a slower agent with a leader is held at standstill,
HOLD_DEMAND = 0.5  # until the leader demands less than this share of the free acceleration: 1.4 times the minimum gap

# Time gap in s, minimum gap in m, acceleration, comfortable and hardest braking in m/s2. On wheels: town traffic in
# Treiber and Kesting, "Traffic Flow Dynamics", 2013, chapter 11. On foot: an arm's length, and a stop within one step.
ON_WHEELS = (1.0, 2.0, 1.0, 1.5, 8.0)
ON_FOOT = (0.5, 0.7, 1.0, 1.5, 4.0)


@dataclass(frozen=True, eq=False)
class IdmParameters(Columns):
    """Parameters of the intelligent driver model, all (A,)."""

    time_gap_s: Array
    gap_m: Array  # minimum gap, kept at standstill
    accel_mps2: Array  # free acceleration
    comfort_mps2: Array  # comfortable braking
    brake_mps2: Array  # hardest braking


def idm_parameters(agents: Sequence[Agent]) -> IdmParameters:
    """Return the parameters of agents by category."""
    rows = [ON_WHEELS if a.category in WHEELED else ON_FOOT for a in agents]
    return IdmParameters(*np.array(rows, dtype=np.float64).reshape(-1, 5).T)


def leader_demand(driver: IdmParameters, gap_m: Array, pace_mps: Array, leader_mps: Array) -> Array:
    """Return the share of the free acceleration that a leader takes: (s* / s)^2 of the model; 1 at the minimum gap at low speed.

    Treiber, Hennecke and Helbing, "Congested traffic states in empirical observations and microscopic simulations", 2000.
    """
    closing = pace_mps * (pace_mps - leader_mps) / (2 * np.sqrt(driver.accel_mps2 * driver.comfort_mps2))
    desired = driver.gap_m + np.maximum(pace_mps * driver.time_gap_s + closing, 0.0)
    return np.asarray((desired / np.maximum(gap_m, MIN_GAP_M)) ** 2)


def rate_response(
    driver: IdmParameters, rate: Array, taken: Array, pace_mps: Array, log_accel_mps2: Array
) -> tuple[Array, Array]:
    """Return the rate and its slope in 1/s, (A,) each, of trajectories at `pace_mps` here, with demand `taken`.

    The scenario's speed at a place is the model's desired speed, so the rate is its v / v0, and the model's
    acceleration is added to the scenario's. Braking that the scenario does anyway counts as a response to the leader.
    Without demand a rate of 1 stays 1: the agent follows the scenario.
    """
    logged = rate**2 * log_accel_mps2
    excess = np.maximum(driver.accel_mps2 * taken - np.maximum(-logged, 0.0), 0.0)
    accel = driver.accel_mps2 * (1 - rate**EXPONENT) - excess
    accel = np.maximum(accel, -driver.brake_mps2 - np.minimum(logged, 0.0))
    slope = accel / np.maximum(pace_mps, MIN_PACE_MPS)
    held = (rate * pace_mps < HOLD_MPS) & (taken > HOLD_DEMAND)
    return np.where(held, 0.0, rate), np.where(held, 0.0, slope)


# `path`: others go where the scenario has them go. `motion`: they go on as they have moved so far, as who sees them
# for the first time expects.
FORESIGHTS = ("path", "motion")

# Time constant of the turn rate of a vehicle that a policy drives: short, since simulated headings have no noise.
DRIVEN_TURN_S = 0.3

Index = NDArray[np.intp]


class PathForesight:
    """Others go where the scenario has them go."""

    def __init__(self, paths: corridors.PathTable) -> None:
        self._paths = paths

    def expect(self, agent: Index, t_s: Array, rate: Array) -> corridors.Prediction:
        """Predict agents (P,) that pass their trajectories at rates (P,), from where these are at times (P,)."""
        pose = self._paths.at(agent[:, None], t_s[:, None] + rate[:, None] * corridors.HORIZON_S)
        return corridors.Prediction(pose.x_m, pose.y_m, pose.yaw_rad, pose.speed_mps * rate[:, None])

    def expect_driven(self, agent: int, t_s: float, pose: corridors.Pose) -> corridors.Prediction:
        """Predict an agent that a policy drives, from where it is among all poses: along its path while on it; (1, H)."""
        x, y, yaw, speed = (float(c[agent]) for c in (pose.x_m, pose.y_m, pose.yaw_rad, pose.speed_mps))
        cos, sin, one, whole_m = np.cos(yaw), np.sin(yaw), np.array([agent]), float(self._paths.marks[agent])
        foot = self._paths.foot(one, np.zeros(1), whole_m, np.array([[x]]), np.array([[y]]))
        left_m = float(foot.left_m[0, 0])
        along = float(cos * foot.cos[0, 0] + sin * foot.sin[0, 0])
        if speed >= 0 and abs(left_m) < corridors.ON_PATH_M and along > corridors.ON_PATH_COS:
            return self._along_path(agent, foot.distance_m[0] + foot.ahead_m[0], np.array([speed]), left_m)
        traveled = speed * corridors.HORIZON_S[None]
        same = np.ones_like(traveled)
        return corridors.Prediction(x + traveled * cos, y + traveled * sin, yaw * same, speed * same)

    def expect_driven_in_scenario(self, agent: int, t_s: Array) -> corridors.Prediction:
        """Predict that agent by the same rules from where the scenario has it at times (P,)."""
        pose = self._paths.at(np.full(len(t_s), agent), t_s)
        return self._along_path(agent, pose.distance_m, np.abs(pose.speed_mps))

    def _along_path(self, agent: int, distance_m: Array, pace_mps: Array, left_m: float = 0.0) -> corridors.Prediction:
        """Predict an agent that goes along its path at speeds (P,) from distances (P,), with an offset to the left."""
        ahead = distance_m[:, None] + pace_mps[:, None] * corridors.HORIZON_S
        x, y, cos, sin, _ = self._paths.along(np.array([agent])[:, None], ahead)
        pace = np.broadcast_to(pace_mps[:, None], ahead.shape)
        return corridors.Prediction(x - left_m * sin, y + left_m * cos, np.arctan2(sin, cos), pace)


class MotionForesight(PathForesight):
    """Others go on at the speed and turn rate that they had so far, smoothed as `log2sim.simulation.prediction` does."""

    def __init__(self, paths: corridors.PathTable, agents: Sequence[Agent]) -> None:
        super().__init__(paths)
        self._begin_s, end_s = float(paths.begin_s.min()), float(paths.end_s.max())
        ticks = np.arange(int((end_s - self._begin_s) / TICK_S) + 1, dtype=np.float64)
        table = tabulate(agents, self._begin_s + TICK_S * ticks)
        smooth = smooth_motion(table)
        self._velocity = np.where(table.present, smooth.velocity_mps, 0.0)
        self._turn_radps = np.where(table.present, smooth.turn_radps, 0.0)
        self._seen: tuple[float, float] | None = None
        self._driven_radps = 0.0

    def expect(self, agent: Index, t_s: Array, rate: Array) -> corridors.Prediction:
        """Predict as `PathForesight` does."""
        pose = self._paths.at(agent, t_s)
        since = (t_s - self._begin_s) / TICK_S + 1e-6
        tick = np.clip(since.astype(np.intp), 0, self._turn_radps.shape[1] - 1)
        turn = self._turn_radps[agent, tick]
        turned = np.exp(1j * turn * np.clip(since - tick, 0.0, 1.0) * TICK_S)
        return _go_on(pose, np.asarray(self._velocity[agent, tick] * turned * rate), turn * rate)

    def expect_driven(self, agent: int, t_s: float, pose: corridors.Pose) -> corridors.Prediction:
        """Predict as `PathForesight` does."""
        one = corridors.Pose(*(np.asarray(c)[agent : agent + 1] for c in pose))
        yaw = float(one.yaw_rad[0])
        if self._seen is None or not t_s > self._seen[0]:  # it begins, or begins again
            self._driven_radps = 0.0
        else:
            step_s = t_s - self._seen[0]
            rate = float(wrap_angle(yaw - self._seen[1])) / step_s
            self._driven_radps += (rate - self._driven_radps) * -np.expm1(-step_s / DRIVEN_TURN_S)
        self._seen = t_s, yaw
        return _go_on(one, one.speed_mps * np.exp(1j * one.yaw_rad), np.array([self._driven_radps]))

    def expect_driven_in_scenario(self, agent: int, t_s: Array) -> corridors.Prediction:
        """Predict as `PathForesight` does."""
        return self.expect(np.full(len(t_s), agent), t_s, np.ones(len(t_s)))


def _go_on(pose: corridors.Pose, velocity: NDArray[np.complex128], turn_radps: Array) -> corridors.Prediction:
    """Go on from poses (P,) with velocities (P,) that turn at rates (P,)."""
    way = displacement(velocity[:, None], turn_radps[:, None], corridors.HORIZON_S)
    yaw = pose.yaw_rad[:, None] + turn_radps[:, None] * corridors.HORIZON_S
    speed = np.copysign(np.abs(velocity), pose.speed_mps)[:, None]
    x, y = pose.x_m[:, None] + way.real, pose.y_m[:, None] + way.imag
    return corridors.Prediction(x, y, yaw, np.broadcast_to(speed, yaw.shape))


MIN_LOOKAHEAD_M = 10.0  # also at standstill

MARGINS_NOW = corridors.SafetyMargins(side_m=0.2, crossing_m=1.0, crossing_s=0.5, behind_m=0.0)
MARGINS_IN_SCENARIO = corridors.SafetyMargins(side_m=0.5, crossing_m=2.5, crossing_s=0.8, behind_m=1.0)
# Tolerances, besides the difference of the margins, within which an interaction counts as that of the scenario.
GAP_M, SPEED_MPS = 0.5, 0.5

MIN_DEMAND = 1e-3  # share of the free acceleration below which a demand is ignored
PATH_HULL_MARGIN_M = 1.0  # how far paths may leave the hull of a few of their points

DECISION_STEP_S = 0.1
CHUNK = 4096  # pairs evaluated together
# A demand fades over this time after it ends, so that the rate does not oscillate at the edge of a conflict.
RELEASE_S, MAX_KEPT_DEMAND = 0.5, 4.0

SAME_DELAY_S = 1e-9  # delays that differ by rounding are the same


class Traffic:
    """Decisions of the reactive agents among the A agents of a scenario; all columns are (A,) over all of them.

    `agents`, `trajectories`: all agents, and the trajectories of their box centers; for static agents one pose.
    `reactive`: ids of the reactive agents. `driven`: id of the agent whose states are given with each decision, since a
    policy drives it. `foresight`: one of `FORESIGHTS`: what the reactive agents expect of others.

    A pair of agents is evaluated only while it differs from the scenario: one is driven by a policy, or their delays
    differ, or they overlap in the scenario itself. The demand of a leader is compared with its demand in the scenario
    when the agent was at this place, and only the excess counts; so a scenario that drives closer than the model would
    is reproduced. Where the paths of two reactive agents cross, the one that was there first in the scenario goes
    first. Cost: R A comparisons a decision, then some 500 distances for each pair in reach.
    """

    _t_s: Array  # time on the scenario of each agent at the last decision, and where it was
    _pose: corridors.Pose
    _prediction: corridors.Prediction  # where agents were expected to go then, (A, H)

    def __init__(
        self,
        agents: Sequence[Agent],
        trajectories: Sequence[Trajectory],
        reactive: Collection[str],
        driven: str | None,
        foresight: str = "path",
    ) -> None:
        self.index = {a.id: k for k, a in enumerate(agents)}
        self.paths = corridors.PathTable(trajectories)
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

    def _decide(self, t_s: float, tau: Array, own: Index, ego: Snapshot | None) -> None:
        """Set the rates of agents `own` (R,) and their slopes; each agent is at its own time of the scenario, `tau`."""
        paths, driven, everyone = self.paths, self._driven, np.arange(len(tau))
        pose = paths.at(everyone, tau)
        pace = np.abs(pose.speed_mps[own])
        log_accel = (np.abs(paths.at(own, tau[own] + DECISION_STEP_S).speed_mps) - pace) / DECISION_STEP_S
        if ego is not None and driven >= 0 and len(ego.x_m):  # the driven agent is where the policy has driven it
            x, y, z, yaw, speed = (c.copy() for c in pose[:5])
            x[driven], y[driven] = ego.x_m[0] - paths.origin_m[0], ego.y_m[0] - paths.origin_m[1]
            yaw[driven], speed[driven] = ego.yaw_rad[0], ego.speed_mps[0]
            # Its height is that of the scenario at this place; by time, nobody would brake for it on a slope if it fell behind.
            self._driven_m = paths.progress_near(driven, self._driven_m, float(ego.x_m[0]), float(ego.y_m[0]))
            one = np.array([driven])
            z[driven] = paths.at(one, paths.times(one, np.array([self._driven_m]))).z_m[0]
            pose = pose._replace(x_m=x, y_m=y, z_m=z, yaw_rad=yaw, speed_mps=speed)
        prediction = self._foresight.expect(everyone, tau, self.rate)
        if driven >= 0:
            prediction = _select(everyone == driven, self._foresight.expect_driven(driven, t_s, pose), prediction)
        self._t_s, self._pose, self._prediction = tau, pose, prediction
        # Pairs of a reactive agent and a present one whose relation differs from the scenario.
        differs = (np.abs(self.delay_s[own][:, None] - self.delay_s) > SAME_DELAY_S) & ~self._static
        if driven >= 0:
            differs[:, driven] = True
        differs |= self._distrusted[own]
        differs &= (paths.begin_s <= t_s) & (tau <= paths.end_s) | self._stays
        differs[np.arange(len(own)), own] = False
        row, other = np.nonzero(differs)
        pairs, taken = self._meeting(own[row], other), np.zeros(len(tau))
        for begin in range(0, len(pairs[0]), CHUNK):
            i, j = (p[begin : begin + CHUNK] for p in pairs)
            np.maximum.at(taken, i, self._excess_demand(i, j))
        kept = np.minimum(self._taken, MAX_KEPT_DEMAND) * np.exp(-DECISION_STEP_S / RELEASE_S)
        self._taken = taken = np.maximum(taken, np.where(kept > MIN_DEMAND, kept, 0.0))
        rate, slope = rate_response(self.idm.take(own), self.rate[own], taken[own], pace, log_accel)
        stands = pace < STANDSTILL_MPS  # the scenario's time goes on: waiting then counts as the scenario's own stop
        self.rate[own], self.rate_slope[own] = np.where(stands, 1.0, rate), np.where(stands, 0.0, slope)

    def _reach_m(self, i: Index) -> Array:
        """Return the look-ahead distance of agents (P,): a comfortable stop and a reserve."""
        pace, d = np.abs(self._pose.speed_mps[i]), self.idm.take(i)
        stop_m = pace * (d.time_gap_s + corridors.HORIZON_S[-1]) + pace**2 / (2 * d.comfort_mps2)
        return np.asarray(np.minimum(MIN_LOOKAHEAD_M + stop_m + self._size[i, 0], corridors.EXTENSION_M))

    def _meeting(self, i: Index, j: Index) -> tuple[Index, Index]:
        """Select those of the pairs (P,), (P,) that may come near each other within the horizon."""
        p, size, radius = self._pose, self._size, np.hypot(self._size[:, 0], self._size[:, 1]) / 2
        reach = self._reach_m(i) + np.abs(p.speed_mps[j]) * corridors.HORIZON_S[-1] + radius[i] + radius[j]
        near = (p.x_m[i] - p.x_m[j]) ** 2 + (p.y_m[i] - p.y_m[j]) ** 2 < reach**2
        i, j = i[near], j[near]
        # At one height are agents j with agents i, or with the paths of these that far ahead.
        gap_m = np.hypot(p.x_m[i] - p.x_m[j], p.y_m[i] - p.y_m[j])
        ahead_m = self.paths.at(i, self.paths.times(i, p.distance_m[i] + gap_m)).z_m
        apart_m = np.minimum(np.abs(p.z_m[i] - p.z_m[j]), np.abs(ahead_m - p.z_m[j]))
        level = apart_m < (size[i, 2] + size[j, 2]) / 2
        i, j = i[level], j[level]
        # Four boxes about the path ahead exclude most agents within the circle, above all those in other lanes.
        x, y = (np.ascontiguousarray(c[:, ::4].T) for c in self._prediction[:2])
        swept = self._hull(i, x[:, j], y[:, j])
        room = radius[j] + size[i, 1] / 2 + MARGINS_IN_SCENARIO.side_m + PATH_HULL_MARGIN_M
        own = np.flatnonzero(self.reacts)
        ahead = np.linspace(0.0, 1.0, 13)[:, None] * self._reach_m(own)
        x, y, *_ = self.paths.along(own[None], p.distance_m[own] + ahead)
        meets, slot = np.zeros(len(i), dtype=bool), np.searchsorted(own, i)
        for part in (slice(0, 4), slice(3, 7), slice(6, 10), slice(9, 13)):
            section = self._hull(own, x[part], y[part])
            apart = [
                (low > end[slot] + room) | (high < begin[slot] - room)
                for (low, high), (begin, end) in zip(swept, section)
            ]
            meets |= ~(apart[0] | apart[1])
        return i[meets], j[meets]

    def _hull(self, i: Index, x_m: Array, y_m: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        """Return minimum and maximum of points (N, P), ahead and to the left of agents i (P,)."""
        cos, sin = np.cos(self._pose.yaw_rad[i]), np.sin(self._pose.yaw_rad[i])
        dx, dy = x_m - self._pose.x_m[i], y_m - self._pose.y_m[i]
        ahead, left = dx * cos + dy * sin, dy * cos - dx * sin
        return (ahead.min(axis=0), ahead.max(axis=0)), (left.min(axis=0), left.max(axis=0))

    def _corridor(self, i: Index, pace: Array, progress: Array) -> corridors.SweptCorridor:
        length, width, reach = self._size[i, 0], self._size[i, 1], float(self._reach_m(i).max())
        return corridors.SweptCorridor(i, self._pose.distance_m[i], length, width, pace, progress, reach)

    def _excess_demand(self, i: Index, j: Index) -> Array:
        """Return the share of the free acceleration of agents i (P,) that agents j (P,) take beyond the scenario."""
        driver, logged_pace, t_s = self.idm.take(i), np.abs(self._pose.speed_mps[i]), self._t_s[i]
        pace, trusted = self.rate[i] * logged_pace, ~self._distrusted[i, j]
        logged = self.paths.at(i[:, None], t_s[:, None] + corridors.HORIZON_S).distance_m
        logged = logged - self._pose.distance_m[i][:, None]
        starting = pace[:, None] * corridors.HORIZON_S + driver.accel_mps2[:, None] * corridors.HORIZON_S**2 / 2
        means = np.where(self.rate[i][:, None] < 1, np.minimum(logged, starting), logged)
        there = corridors.Prediction(*(c[j] for c in self._prediction))
        found = corridors.leaders(self.paths, self._corridor(i, pace, means), there, self._size[j], MARGINS_NOW)
        # Where two reactive agents meet, the one that was first in the scenario goes first; an obstacle already in the path is
        # waited for.
        first = self.reacts[i] & self.reacts[j] & (found.ahead_s > 0)
        first &= found.own_t_s < self._t_s[j] + self.rate[j] * found.ahead_s
        gap = np.where(first & trusted, np.inf, found.gap_m)
        taken = leader_demand(driver, gap, pace, found.speed_mps)
        k = np.flatnonzero(
            (taken > MIN_DEMAND) & trusted & (self.paths.begin_s[j] <= t_s) & (t_s <= self.paths.end_s[j])
        )
        if len(k):  # less the demand of agents j in the scenario when agents i were here, as far as it applies now
            i, j, gap, t_s, logged_pace = i[k], j[k], gap[k], t_s[k], logged_pace[k]
            there = self._foresight.expect(j, t_s, np.ones(len(j)))
            if np.any(j == self._driven):
                driven = self._foresight.expect_driven_in_scenario(self._driven, t_s)
                there = _select(j == self._driven, driven, there)
            corridor = self._corridor(i, logged_pace, logged[k])
            found = corridors.leaders(self.paths, corridor, there, self._size[j], MARGINS_IN_SCENARIO)
            # The nearer the other agent is than it was in the scenario, the less of that counts; at half the gap none.
            known, logged_gap = np.isfinite(found.gap_m), found.gap_m - GAP_M
            was = np.where(known, logged_gap, 0.0)
            lost = np.where(known, np.maximum(was - gap, 0.0) / np.maximum(was / 2, 1.0), 1.0)
            before = leader_demand(driver.take(k), logged_gap, logged_pace, found.speed_mps - SPEED_MPS)
            taken[k] -= np.maximum(1 - lost, 0.0) * before
        return np.maximum(taken, 0.0)


def _select(mask: NDArray[np.bool_], one: corridors.Prediction, other: corridors.Prediction) -> corridors.Prediction:
    return corridors.Prediction(*(np.where(mask[:, None], a, b) for a, b in zip(one, other)))


DEEP_OVERLAP_M = 0.5  # larger than the errors of boxes
OVERLAP_CHUNK = 200


def deep_overlaps(paths: corridors.PathTable, size_m: Array, static: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the pairs (A, A) whose boxes come to overlap by more than `DEEP_OVERLAP_M`, not from the start.

    Pairs that overlap from the start are one object detected twice, or a load and its carrier: no reason to brake.
    """
    count, moving, step_s = len(size_m), ~static, corridors.TIME_STEP_S
    deep, together = np.zeros((2, count, count), dtype=bool)
    if not moving.any():
        return deep
    stays = static & (paths.begin_s == paths.end_s)
    begin_s, end_s = np.where(stays, -np.inf, paths.begin_s), np.where(stays, np.inf, paths.end_s)
    t_s = np.arange(paths.begin_s[moving].min(), paths.end_s[moving].max() + step_s, step_s)
    size = np.maximum(size_m - [DEEP_OVERLAP_M, DEEP_OVERLAP_M, 0.0], 0.1)
    for part in np.split(t_s, range(OVERLAP_CHUNK, len(t_s), OVERLAP_CHUNK)):
        pose = paths.at(np.arange(count), part[:, None])
        there = (begin_s <= part[:, None]) & (part[:, None] <= end_s)
        x, y, z, yaw, speed = (np.where(there, c, np.nan) for c in pose[:5])
        found = contacts(BoxTracks(x, y, z, yaw, speed, size), moving)
        a, b = found.a, found.b
        deep[a, b] = True
        at_once = part[found.first_row.astype(np.intp)] <= np.maximum(begin_s[a], begin_s[b]) + step_s
        together[a[at_once], b[at_once]] = True
    into = deep & ~together
    return into | into.T


# Columns that scale with the rate, and the columns of their derivatives.
RATE_OF_SPEED = {"speed": "accel_ahead", "velocity_x": "accel_x", "velocity_y": "accel_y"}


class ReactiveGroup(AgentGroup):
    """Agents that follow the scenario at the time and rate that `traffic` decides, here placed exactly on their path."""

    driver = "reactive"
    follows_scenario_time = False
    columns: tuple[str, ...] = ("x", "y", "yaw", "speed")

    def join(self, traffic: Traffic, clock: StepClock) -> None:
        """Connect the group with the traffic; call it once, before anything else."""
        self.traffic, self.clock, self._logged_last = traffic, clock, self.last
        self.index = np.array([traffic.index[a.id] for a in self.agents], dtype=np.intp)
        self._end_s = np.array([r.trajectory.t_s[-1] for r in self.references])
        self._first_row = np.array([r.first_row for r in self.references], dtype=np.intp)
        self._rows = np.array([len(r.columns) for r in self.references], dtype=np.intp)
        self._begin = np.cumsum(self._rows) - self._rows
        self._flat = np.concatenate([r.columns for r in self.references])
        jumps = [(k, t) for k, r in enumerate(self.references) for t in r.trajectory.discontinuity_times()]
        # As in the scenario, an agent is placed again after the row that blends both sides of a discontinuity.
        self._discontinuities = np.array([(k, t + wait) for k, t in jumps for wait in (0.0, GRID_S)]).reshape(-1, 2)
        self._tau = np.full(len(self.agents), -np.inf)

    def open_window(self, begin: int, end: int, begin_s: float, end_s: float) -> None:
        """Prepare the tables; at the first step also reset the lifetimes, which delays extend."""
        if begin == 0:
            self.last, self._tau = self._logged_last, np.full(len(self.agents), -np.inf)
        super().open_window(begin, end, begin_s, end_s)

    def log_times(self, t_s: float) -> Array:
        """Return the scenario times of the living agents: the present time less their delay."""
        return t_s - self.traffic.delay_s[self.index[self.live]]

    def look_up(self, t_s: float) -> None:
        """Set `row` (C, A) to the references at the agents' times in the scenario."""
        self.now_s = t_s
        live, delay = self.live, self.traffic.delay_s[self.index]
        # A delayed agent lives on until it has reached the end of its trajectory.
        self.last = np.minimum(self.clock.last_step(self._end_s + delay), self.clock.steps - 1)
        tau = t_s - delay
        last = self._rows[live] - 1
        place = np.clip(tau[live] / GRID_S - self._first_row[live], 0.0, last)
        k = np.minimum(place.astype(np.intp), np.maximum(last - 1, 0))
        low = self._flat[self._begin[live] + k]
        high = self._flat[self._begin[live] + np.minimum(k + 1, last)]
        self.row = self._slowed((low + (place - k)[:, None] * (high - low)).T, live)
        agent, at_s = self._discontinuities[:, 0].astype(np.intp), self._discontinuities[:, 1]
        jumped = (self._tau[agent] < at_s) & (at_s <= tau[agent]) & np.isfinite(self._tau[agent])
        self._tau = tau
        if jumped.any():
            self.place(np.intersect1d(agent[jumped], live), t_s)

    def _exact(self, index: NDArray[np.intp], t_s: float) -> Array:
        at_s = t_s - self.traffic.delay_s[self.index[index]]
        rows = [self.references[i].exact(np.array([t]))[0] for i, t in zip(index, at_s)]
        return self._slowed(np.stack(rows, axis=1), index)

    def _slowed(self, row: Array, index: NDArray[np.intp]) -> Array:
        """Scale the rows (C, N) of agents that pass their references at their rate."""
        rate, slope = self.traffic.rate[self.index[index]], self.traffic.rate_slope[self.index[index]]
        if np.all(rate == 1):
            return row
        row = row.copy()
        names = {name: k for k, name in enumerate(self.columns)}
        speeds = [names[speed] for speed in RATE_OF_SPEED if speed in names]
        for speed, change in RATE_OF_SPEED.items():
            if change in names:
                row[names[change]] = row[names[change]] * rate**2 + row[names[speed]] * slope
        row[speeds] *= rate
        if "stands" in names:
            row[names["stands"]] = np.maximum(row[names["stands"]], np.hypot.reduce(row[speeds]) < REFERENCE_HOLD_MPS)
        return row


class ReactiveVehicleGroup(ReactiveGroup, VehicleGroup):
    """Vehicles that react."""

    columns = VEHICLE_COLUMNS


class ReactivePedestrianGroup(ReactiveGroup, PedestrianGroup):
    """Points that react."""

    columns = POINT_COLUMNS
