"""Road users at common ticks: smoothed motion, the paths that they drive, lanes, and where others are on a path."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import STANDSTILL_MPS, MapLane, Scenario
from log2sim.geometry import Array, wrap_angle
from log2sim.prediction.motion_table import TICK_S, Complex, MotionTable, table_of
from log2sim.road.polyline import Polyline

Mask = NDArray[np.bool_]
Index = NDArray[np.intp]

SMOOTH_S = 0.3
"""Standard deviation of the smoothing of places and speeds: a lane change takes ten times as long (Toledo and Zohar, "Modeling
duration of lane changes", 2007: 1 to 13 s, on average 4.6 s)."""

STEP_M = 0.5
"""Between points of a path, and how far who stands may seem to move."""

HALF_LANE_M = 1.75
"""Half the width of a lane where none is known: 3.5 m, between streets (3.0 to 3.5 m) and motorways (3.5 to 3.75 m; RAA 2008)."""

SIDE_M = 0.3
"""Beyond a lane's edge, on either side, until which an agent has not crossed it: drivers keep their lane to this standard deviation."""

EXTENSION_M = 40.0
"""How far a path is continued as the circle that it ends on; beyond, where it leads is not known."""

BEND_SIGMA_1PM = 0.002
"""Standard deviation of the curvature there: lateral offsets are uncertain by half of it times the squared distance."""

REACH_M = 100.0
"""Agents farther from each other have nothing to do with each other."""

SAME_WAY_RAD = np.pi / 4
"""Courses that differ by less lead along one road."""


@dataclass(frozen=True, eq=False)
class Beside:
    """Where all agents (A, T) are relative to a reference agent R and the path that it drives.

    Attributes
    ----------
    ahead_m : (A, T) float64, m
        Of R's center along its path; NaN where either is absent or they are out of reach.
    aside_m : (A, T) float64, m
        To the left of R's path.
    turn_rad : (A, T) float64, rad
        Course of the agent minus that of the path at its place.
    gap_m : (A, T) float64, m
        Between the nearest bumpers along the path; negative side by side.
    sigma_m : (A, T) float64, m
        Standard deviation of the offset, of both agents and of where the path leads.
    half_m : float, m
        Half the width of R's lane.
    """

    ahead_m: Array
    aside_m: Array
    turn_rad: Array
    gap_m: Array
    sigma_m: Array
    half_m: float

    @cached_property
    def in_lane(self) -> Mask:
        """Whether an agent is in R's lane (A, T): its center is, and it has been since it was well inside, until it is well outside."""
        off = np.abs(self.aside_m)
        return latched(off < self.half_m - SIDE_M, off > self.half_m + SIDE_M, off < self.half_m)

    @cached_property
    def same_way(self) -> Mask:
        """Whether an agent goes the way that the path leads at its place (A, T)."""
        return np.asarray(np.abs(self.turn_rad) < SAME_WAY_RAD)

    @cached_property
    def leader(self) -> Index:
        """Who is next ahead in R's lane (T,); -1 for nobody."""
        gap = np.where(self.in_lane & self.same_way & (self.ahead_m > 0), self.ahead_m, np.inf)
        return np.where(np.isfinite(gap.min(axis=0, initial=np.inf)), gap.argmin(axis=0) if len(gap) else 0, -1)


class Traffic:
    """A scenario's road users at T ticks, `TICK_S` apart, and their lanes.

    `table` (A, T): as they are in the scenario. `place_m` (A, T) complex128, `speed_mps`, `accel_mps2` (A, T): smoothed over
    `SMOOTH_S`, the speed that along the course, never negative.
    """

    def __init__(self, scenario: Scenario) -> None:
        self.scenario, self.table = scenario, table_of(scenario)
        t = self.table
        self.ids = [a.id for a in t.agents]
        self.wheeled = np.isin(t.group, ("vehicle", "two_wheeler"))
        self.confidence = np.array([a.confidence for a in t.agents], dtype=np.float64)
        self.place_m = smoothed(t.position_m, t)
        velocity = smoothed(t.velocity_mps, t)
        self.speed_mps = np.abs(velocity)
        self.speed_mps[self.speed_mps < STANDSTILL_MPS] = 0.0
        self.accel_mps2 = rate(np.abs(velocity))
        heading = np.exp(1j * t.yaw_rad)
        back = (velocity * heading.conj()).real < -STANDSTILL_MPS
        heading = np.where(back, -heading, heading)
        # Of who hardly moves the box tells the course, of all others the velocity.
        self.course_rad = np.angle(np.where(self.speed_mps > 1.0, velocity, heading))
        self.sigma_m = t.sigma_m
        self.sigma_speed_mps = np.stack([_sigma_speed(t, k) for k in range(len(t.agents))]) if len(t.agents) else t.sigma_m
        self._paths: dict[int, tuple[Polyline, Array] | None] = {}

    def path(self, k: int) -> tuple[Polyline, Array] | None:
        """Return the path of an agent, continued at both ends by `EXTENSION_M`, and its stations (T,) there; None for who stands."""
        if k not in self._paths:
            self._paths[k] = _path_of(self.place_m[k], self.course_rad[k], self.table.piece[k])
        return self._paths[k]

    def beside(self, r: int) -> Beside | None:
        """Return where all agents are relative to agent `r`; None where that never moves or is no vehicle."""
        found = self.path(r) if self.wheeled[r] else None
        if found is None:
            return None
        line, station = found
        near = np.abs(self.place_m - self.place_m[r]) < REACH_M  # False for NaN
        near[r] = False
        a, n = np.nonzero(near)
        shape = near.shape
        ahead, aside, turn, sigma = (np.full(shape, np.nan) for _ in range(4))
        if len(a):
            place, course = self.place_m[a, n], self.course_rad[a, n]
            at = line.project(np.column_stack([place.real, place.imag]), course)
            on = (at.s_m > 0.0) & (at.s_m < line.length_m)
            a, n = a[on], n[on]
            ahead[a, n], aside[a, n], turn[a, n] = at.s_m[on] - station[n], at.aside_m[on], at.turn_rad[on]
            beyond = np.maximum(np.maximum(EXTENSION_M - at.s_m[on], at.s_m[on] - (line.length_m - EXTENSION_M)), 0.0)
            sigma[a, n] = np.sqrt(
                self.sigma_m[a, n] ** 2 + self.sigma_m[r, n] ** 2 + (BEND_SIGMA_1PM * beyond**2 / 2) ** 2
            )
        length = self.table.size_m[:, 0]
        gap = np.abs(ahead) - ((length + length[r]) / 2)[:, None]
        return Beside(ahead, aside, turn, gap, sigma, self.half_lane_m(r))

    @cached_property
    def lanes(self) -> list[tuple[MapLane, Polyline]]:
        """Lanes whose edges were seen: those inferred from paths alone follow who changes between lanes."""
        features = self.scenario.map_features
        known = [lane for lane in features.lanes if lane.inferred_from != "paths"] if features is not None else []
        return [(lane, Polyline.through(lane.points_m)) for lane in known]

    @cached_property
    def lane_of(self) -> Index:
        """Index of the lane that each agent is in (A, T), -1 for none; in junctions the one whose direction it has."""
        best, found = np.full(self.place_m.shape, np.inf), np.full(self.place_m.shape, -1)
        a, n = np.nonzero(np.isfinite(self.place_m) & self.wheeled[:, None])
        xy, course = np.column_stack([self.place_m[a, n].real, self.place_m[a, n].imag]), self.course_rad[a, n]
        for k, (lane, line) in enumerate(self.lanes):
            low, high = line.bounds_m
            near = np.flatnonzero(((xy > low - 5.0) & (xy < high + 5.0)).all(axis=1))
            if not len(near):
                continue
            at = line.project(xy[near], course[near])
            half = np.interp(at.s_m, Polyline.through(lane.points_m).s_m, np.interp(
                np.linspace(0, 1, len(line.s_m)), np.linspace(0, 1, len(lane.width_m)), lane.width_m)) / 2  # fmt: skip
            fits = at.inside & (np.abs(at.aside_m) <= half)
            # Where lanes overlap, the nearer center line and the direction decide; who goes against a lane is in it last.
            cost = np.abs(at.aside_m) + 3.0 * np.abs(at.turn_rad)
            better = fits & (cost < best[a[near], n[near]])
            rows = near[better]
            best[a[rows], n[rows]], found[a[rows], n[rows]] = cost[better], k
        return found

    def half_lane_m(self, r: int) -> float:
        """Return half the width of the lane that an agent drives in most; the usual one where none is known."""
        inside = self.lane_of[r][self.lane_of[r] >= 0] if self.lanes else np.zeros(0, dtype=np.intp)
        return float(np.median(self.lanes[np.bincount(inside).argmax()][0].width_m)) / 2 if len(inside) else HALF_LANE_M


def smoothed(values: Complex, table: MotionTable) -> Complex:
    """Smooth values (A, T) over `SMOOTH_S` within pieces of trajectories, odd about their ends, so that even motion stays even."""
    from scipy.ndimage import gaussian_filter1d

    out = values.copy()
    for k in range(len(values)):
        if table.agents[k].static:
            continue
        for piece in np.unique(table.piece[k][table.present[k]]):
            rows = np.flatnonzero(table.piece[k] == piece)
            v = values[k, rows]
            pad = min(len(v) - 1, round(4 * SMOOTH_S / TICK_S))
            if pad:
                v = np.concatenate([2 * v[0] - v[pad:0:-1], v, 2 * v[-1] - v[-2 : -pad - 2 : -1]])
                out[k, rows] = gaussian_filter1d(v, SMOOTH_S / TICK_S)[pad:-pad]
    return out


def rate(values: Array) -> Array:
    """Return the change (A, T) of values per second, central where both neighbors are known; NaN without any."""
    after = np.full(values.shape, np.nan)
    after[:, :-1] = np.diff(values, axis=1) / TICK_S
    before = np.concatenate([np.full((len(values), 1), np.nan), after[:, :-1]], axis=1)
    return np.where(np.isnan(after), before, np.where(np.isnan(before), after, (after + before) / 2))


def latched(on: Mask, off: Mask, start: Mask) -> Mask:
    """Return a state (..., T) that `on` switches on and `off` off; before either, the first known of `start`."""
    event = np.where(on, 1, np.where(off, 0, -1))
    ticks = np.arange(on.shape[-1])
    last = np.maximum.accumulate(np.where(event >= 0, ticks, -1), axis=-1)
    held = np.take_along_axis(event, np.maximum(last, 0), axis=-1)
    return np.asarray(np.where(last >= 0, held == 1, start))


def runs(state: Mask, least: int = 1) -> list[tuple[int, int]]:
    """Return first and last tick of each time (T,) that a state lasts for at least so many ticks."""
    edge = np.diff(np.concatenate([[False], state, [False]]).astype(np.int8))
    return [(i, j - 1) for i, j in zip(np.flatnonzero(edge > 0).tolist(), np.flatnonzero(edge < 0).tolist()) if j - i >= least]


def probability_above(value: Array | float, limit: float, sigma: Array | float) -> float:
    """Return the probability that a quantity with a normal error exceeds a limit; of several values, that all do, errors being one."""
    from scipy.special import ndtr

    value, sigma = np.broadcast_arrays(np.asarray(value, dtype=np.float64), np.asarray(sigma, dtype=np.float64))
    sure = np.where(value == limit, 0.5, (value > limit).astype(np.float64))
    normal = (sigma > 0) & np.isfinite(value) & np.isfinite(sigma)
    z = np.divide(value - limit, sigma, out=np.zeros(value.shape), where=normal)
    return float(np.min(np.where(normal, ndtr(z), np.where(np.isinf(sigma), 0.5, sure)))) if value.size else 0.0


def _sigma_speed(table: MotionTable, k: int) -> Array:
    """Return the standard deviation (T,) of speeds; where the scenario has none, that of a slope over a second of places."""
    w = table.agents[k].waypoints
    if w.sigma_speed_mps is not None:
        return np.interp(table.t_s, w.t_s, w.sigma_speed_mps)
    interval_s = float(np.median(np.diff(w.t_s))) if len(w) > 1 else 1.0
    count = max(1.0 / interval_s, 2.0)
    return table.sigma_m[k] * np.sqrt(12.0 / (count * (count**2 - 1.0))) / interval_s


def _path_of(place: Complex, course: Array, piece: Index) -> tuple[Polyline, Array] | None:
    """Return the longest stretch of a path without a jump, and stations (T,)."""
    known = piece >= 0
    if not known.any() or np.ptp(place[known].real) + np.ptp(place[known].imag) < 4 * STEP_M:
        return None
    longest = np.bincount(piece[known]).argmax()
    rows = np.flatnonzero(piece == longest)
    kept = [rows[0]]
    for n in rows[1:].tolist():
        step = (place[n] - place[kept[-1]]) * np.exp(-1j * course[n])
        if step.real >= STEP_M and step.real >= abs(step.imag):
            kept.append(n)
    if len(kept) < 4:
        return None
    point = place[kept]
    way = np.cumsum(np.abs(np.diff(point)))
    begin, end = (_continued(point[::-1]), _continued(point))
    line = np.concatenate([begin[::-1], point, end])
    polyline = Polyline.through(np.column_stack([line.real, line.imag, np.zeros(len(line))]), STEP_M)
    at = np.interp(np.arange(len(place)), kept, EXTENSION_M + np.concatenate([[0.0], way]))
    last = np.arange(len(place)) > kept[-1]
    at[last] += ((place[last] - point[-1]) * np.exp(-1j * course[kept[-1]])).real
    return polyline, np.where(piece == longest, at, np.nan)


def _continued(point: Complex) -> Complex:
    """Return points `STEP_M` apart that go on from the last point on the circle of the last 20 m."""
    way = np.abs(np.diff(point))
    back = np.cumsum(way[::-1])
    k = max(int(np.searchsorted(back, 20.0)), 3)
    recent = point[-k - 1 :]
    heading = np.unwrap(np.angle(np.diff(recent)))
    s = np.cumsum(np.abs(np.diff(recent)))
    middle = s - np.abs(np.diff(recent)) / 2
    bend, start = np.polyfit(middle, heading, 1) if len(middle) > 2 and np.ptp(middle) > 5.0 else (0.0, heading.mean())
    bend = float(np.clip(bend, -0.2, 0.2))
    d = np.arange(STEP_M, EXTENSION_M + STEP_M / 2, STEP_M)
    h = start + bend * s[-1]
    return np.asarray(point[-1] + d * np.exp(1j * (h + bend * d / 2)) * np.sinc(bend * d / (2 * np.pi)))


def turned(course_rad: Array, first: int, last: int) -> float:
    """Return by how much a course (T,) turns from one tick to another, whole turns included."""
    part = course_rad[first : last + 1]
    return float(np.sum(wrap_angle(np.diff(part))))
