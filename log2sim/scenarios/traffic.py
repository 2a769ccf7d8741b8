"""Road users at common ticks: smoothed motion, the paths that they drive, lanes, and where others are on a path."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import STANDSTILL_MPS, Agent, MapLane, Scenario
from log2sim.geometry import Array, Polyline, fit_windows, runs_of, wrap_angle
from log2sim.simulation.prediction.motion_table import TICK_S, Complex, MotionTable, table_of
from log2sim.simulation.prediction.prediction import MOVING, drift_variance

Mask = NDArray[np.bool_]
Index = NDArray[np.intp]

SMOOTH_S, SMOOTH_NOISY_S, SMOOTH_TO_MPS = 0.4, 1.0, 0.1
"""Smoothing to each side, and the noise of velocities that it shall reach: a lane change takes seconds (Toledo and Zohar, "Modeling
duration of lane changes", 2007: 1 to 13 s, on average 4.6 s)."""

DRIFT_TICKS = 13  # over which lateral speeds are averaged, a third of a lane change

STEP_M = 0.5
"""Between points of a path, and how far who stands may seem to move."""

HALF_LANE_M = 1.75
"""Half the width of a lane where none is known: 3.5 m, between streets (3.0 to 3.5 m) and motorways (3.5 to 3.75 m; RAA 2008)."""

HALF_TRACK_M = 1.0
"""The same of a track for bicycles (ERA 2010: 2.0 m)."""

SIDE_M = 0.3
"""Beyond a lane's edge, on either side, until which an agent has not crossed it: drivers keep their lane to this standard deviation."""

UNSEEN_S = 2.0
"""For how long agents are supposed to go on before and after they were seen: a reconstruction loses them at the edge of what sensors show."""

EXTENSION_M = 40.0
"""How far a path is continued: beside a lane or the path of another vehicle, else on the circle that it ends on."""

GUIDED_M, FITTED_M = 8.0, 30.0
"""Up to how far aside others show where a path leads, and the part of it that the circle is fitted to."""

BEND_SIGMA_1PM = 0.002
"""Standard deviation of the curvature there: lateral offsets are uncertain by half of it times the squared distance."""

KEEPING_MPS = 0.5
"""Lateral speed of who keeps a lane: a third to a half of those in lane changes."""

LANE_CHANGE_S = 8.0
"""Longest lane change: 95 of 100 take less (Toledo and Zohar 2007)."""

REACH_M = 100.0
"""Agents farther from each other have nothing to do with each other."""

SAME_WAY_RAD = np.pi / 4
"""Courses that differ by less lead along one road."""


@dataclass(frozen=True, eq=False)
class Beside:
    """Where all agents (A, T) are relative to a reference agent R and the path that it drives."""

    ahead_m: Array  # (A, T), m: of R's center along its path; NaN where either is absent or they are out of reach
    aside_m: Array  # (A, T), m: to the left of R's path
    turn_rad: Array  # (A, T), rad: course of the agent minus that of the path at its place
    gap_m: Array  # (A, T), m: between the nearest bumpers along the path; negative side by side
    sigma_m: Array  # (A, T), m: standard deviation of the offset, of both agents and of where the path leads
    half_m: float  # m: half the width of R's lane

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


class Driven(NamedTuple):
    """Where an agent drove: ticks (K,) that its path has points of, and the line through them."""

    ticks: Index
    line: Polyline


class Continued(NamedTuple):
    """Agents (A, T) also while they are not seen: places x + iy, headings of boxes, courses, speeds, sigmas of places."""

    place_m: Complex
    yaw_rad: Array
    course_rad: Array
    speed_mps: Array
    sigma_m: Array


class Path(NamedTuple):
    """The path of an agent, continued at both ends."""

    line: Polyline
    station_m: Array  # (T,), m: of the agent on it; NaN where it is elsewhere
    begin_m: float  # m: between these stations it is known where it leads; likewise `end_m`
    end_m: float


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
        self.place_m, velocity = smoothed(t)
        self.speed_mps = np.abs(velocity)
        self.speed_mps[self.speed_mps < STANDSTILL_MPS] = 0.0
        self.accel_mps2 = rate(np.abs(velocity))
        heading = np.exp(1j * t.yaw_rad)
        back = (velocity * heading.conj()).real < -STANDSTILL_MPS
        heading = np.where(back, -heading, heading)
        # Of who hardly moves the box tells the course, of all others the velocity.
        self.course_rad = np.angle(np.where(self.speed_mps > 1.0, velocity, heading))
        jitter = np.array([_jitter(a) for a in t.agents]).reshape(-1, 1)
        self.sigma_m = np.where(t.sigma_m.any(axis=1, keepdims=True), t.sigma_m, jitter) if len(jitter) else t.sigma_m
        sigma_speed = [_sigma_speed(t, k, s) for k, s in enumerate(self.sigma_m)]
        self.sigma_speed_mps = np.array(sigma_speed).reshape(self.sigma_m.shape)
        self._paths: dict[int, Path | None] = {}

    def path(self, k: int) -> Path | None:
        """Return the path of an agent; None for who stands."""
        if k not in self._paths:
            self._paths[k] = self._continued(k) if k in self._driven else None
        return self._paths[k]

    @cached_property
    def _driven(self) -> dict[int, Driven]:
        """Where vehicles and others drove, each until it jumps."""
        found = {k: _driven_of(self.place_m[k], self.course_rad[k], self.table.piece[k]) for k in range(len(self.ids))}
        return {k: driven for k, driven in found.items() if driven is not None}

    def _continued(self, k: int) -> Path:
        """Continue a path at both ends by `EXTENSION_M`: beside a lane or where others drove on, else on a circle."""
        ticks, line = self._driven[k]
        guides = [line for _, line in self.lanes]
        guides += [d.line for j, d in self._driven.items() if j != k and self.wheeled[j]]
        points, known_m = line.points_m[:, 0] + 1j * line.points_m[:, 1], []
        for sign in (1.0, -1.0):  # ahead, then back: the line is turned around for it
            reversed_ = points[::-1] if sign < 0 else points
            more, sure_m = _continuation(reversed_, guides, sign)
            points = np.concatenate([reversed_, more])[:: int(sign)]
            known_m.append(sure_m)
        whole = Polyline.through(np.column_stack([points.real, points.imag, np.zeros(len(points))]), STEP_M)
        way = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(self.place_m[k, ticks])))])
        place, course, now = self.place_m[k], self.course_rad[k, ticks[-1]], np.arange(len(self.place_m[k]))
        station = np.interp(now, ticks, EXTENSION_M + way * (line.length_m / way[-1]))
        after = now > ticks[-1]
        station[after] += ((place[after] - place[ticks[-1]]) * np.exp(-1j * course)).real
        station[self.table.piece[k] != self.table.piece[k, ticks[0]]] = np.nan
        return Path(whole, station, EXTENSION_M - known_m[1], whole.length_m - EXTENSION_M + known_m[0])

    def beside(self, r: int) -> Beside | None:
        """Return where all agents are relative to agent `r`; None where that never moves or is no vehicle."""
        found = self.path(r) if self.wheeled[r] else None
        if found is None:
            return None
        line, station = found.line, found.station_m
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
            beyond = np.maximum(np.maximum(found.begin_m - at.s_m[on], at.s_m[on] - found.end_m), 0.0)
            heading_sigma = np.sqrt(2.0) * self.sigma_m[r, n] / FITTED_M  # of the line through its last places
            both, bend = self.sigma_m[a, n] ** 2 + self.sigma_m[r, n] ** 2, BEND_SIGMA_1PM * beyond**2 / 2
            sigma[a, n] = np.sqrt(both + (heading_sigma * beyond) ** 2 + bend**2)
        return Beside(ahead, aside, turn, self._gap(r, ahead), sigma, self.half_lane_m(r))

    def beside_unseen(self, r: int, seen: Beside) -> Beside:
        """Return where all agents are relative to agent `r` also for `UNSEEN_S` before and after both were seen.

        Speeds stay as they were; who changes lanes goes on to do so until it is amid one, all others keep theirs.
        """
        ahead, aside, turn, sigma = (c.copy() for c in (seen.ahead_m, seen.aside_m, seen.turn_rad, seen.sigma_m))
        lost, width = 1.0 * np.isnan(self.place_m), 2.0 * seen.half_m
        now, second = np.arange(self.place_m.shape[1]), round(1.0 / TICK_S)
        along = self.speed_mps * np.cos(turn) - self.speed_mps[r]
        for o in np.flatnonzero(np.isfinite(ahead).any(axis=1)).tolist():
            across_mps2 = MOVING[str(self.table.group[o])].across_mps2
            for edge, rows in out_of_sight(np.isfinite(seen.ahead_m[o])):
                lead_s = (rows - edge) * TICK_S
                near = np.flatnonzero(np.isfinite(seen.aside_m[o]) & (np.abs(now - edge) <= second))
                slope = np.polyfit(near * TICK_S, seen.aside_m[o, near], 1)[0] if len(near) > second // 2 else 0.0
                # Both to the path of R, which may bend, and to the road.
                lateral = min(float(slope), float(self.drift_mps[o, edge] * np.cos(turn[o, edge])), key=abs)
                way = (lateral if abs(lateral) > KEEPING_MPS and lateral * slope > 0 else 0.0) * lead_s
                ahead[o, rows] = ahead[o, edge] + along[o, edge] * lead_s
                lane = aside[o, edge] / width
                middles = np.floor(lane) * width - aside[o, edge], np.ceil(lane) * width - aside[o, edge]
                aside[o, rows] = aside[o, edge] + np.clip(way, *middles)
                turn[o, rows] = turn[o, edge]
                drift = np.maximum(lost[o, rows] + lost[r, rows], 1.0) * drift_variance(np.abs(lead_s))
                rate = 2.0 * (self.sigma_m[o, edge] * lead_s) ** 2  # of two places a second apart
                sigma[o, rows] = np.sqrt(sigma[o, edge] ** 2 + rate + across_mps2**2 * drift)
        return replace(seen, ahead_m=ahead, aside_m=aside, turn_rad=turn, gap_m=self._gap(r, ahead), sigma_m=sigma)

    def _gap(self, r: int, ahead_m: Array) -> Array:
        length = self.table.size_m[:, 0]
        return np.asarray(np.abs(ahead_m) - ((length + length[r]) / 2)[:, None])

    @cached_property
    def continued(self) -> Continued:
        """Return where agents are, for `UNSEEN_S` before and after they were seen straight on at their speeds, but at no time without others."""
        t = self.table
        place, course, speed = t.position_m.copy(), self.course_rad.copy(), self.speed_mps.copy()
        yaw, sigma = t.yaw_rad.copy(), self.sigma_m.copy()
        moves = t.present.any(axis=1) & np.array([not a.static for a in t.agents], dtype=bool)
        for k in np.flatnonzero(moves).tolist():
            along = MOVING[str(t.group[k])].along_mps2
            for end, rows in out_of_sight(t.present[k]):
                lead_s = (rows - end) * TICK_S
                place[k, rows] = place[k, end] + speed[k, end] * np.exp(1j * course[k, end]) * lead_s
                yaw[k, rows], course[k, rows], speed[k, rows] = yaw[k, end], course[k, end], speed[k, end]
                sigma[k, rows] = np.hypot(sigma[k, end], along * np.sqrt(drift_variance(np.abs(lead_s))))
        return Continued(place, yaw, course, speed, sigma)

    @cached_property
    def drift_mps(self) -> Array:
        """Lateral speed (A, T) of vehicles relative to the road, positive to the left.

        The road leads where the lane does that an agent is in; without one, where most vehicles went that passed there, the agent among
        them; without two others, as the agent's course does when it turns evenly within `LANE_CHANGE_S`.
        """
        road = self._common_course()
        for k in np.flatnonzero(self.wheeled).tolist():
            rows = np.flatnonzero(np.isfinite(self.course_rad[k]))
            window = min(round(LANE_CHANGE_S / TICK_S) | 1, len(rows) - (len(rows) + 1) % 2)
            if window > 2:
                own = fit_windows(np.unwrap(self.course_rad[k, rows]), window, 1)
                road[k, rows] = np.where(np.isnan(road[k, rows]), own, road[k, rows])
            for lane in np.unique(self.lane_of[k][self.lane_of[k] >= 0]).tolist():
                inside = np.flatnonzero(self.lane_of[k] == lane)
                line = self.lanes[lane][1]
                place = self.place_m[k, inside]
                at = line.project(np.column_stack([place.real, place.imag]), self.course_rad[k, inside])
                road[k, inside] = line.heading_at(at.s_m)
        drift = self.speed_mps * np.sin(self.course_rad - road)
        for k in np.flatnonzero(self.wheeled).tolist():
            rows = np.flatnonzero(np.isfinite(drift[k]))
            if len(rows) > DRIFT_TICKS:
                drift[k, rows] = fit_windows(drift[k, rows], DRIFT_TICKS, 1)
        return drift

    def _common_course(self) -> Array:
        """Return the median course (A, T) of the vehicles that pass near the place of each at any time; NaN with fewer than two others."""
        from scipy.spatial import cKDTree

        out = np.full(self.course_rad.shape, np.nan)
        points = [np.zeros((0, 5))]
        turn = rate(np.unwrap(np.nan_to_num(self.course_rad), axis=1))
        for k in [k for k in self._driven if self.wheeled[k]]:
            ticks = self._driven[k].ticks
            way = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(self.place_m[k, ticks])))])
            ticks = ticks[np.unique(way // 4.0, return_index=True)[1]]
            place, speed = self.place_m[k, ticks], np.maximum(self.speed_mps[k, ticks], 1.0)
            columns = (place.real, place.imag, self.course_rad[k, ticks], turn[k, ticks] / speed)
            points.append(np.column_stack([*columns, np.full(len(ticks), k)]))
        x, y, heading, bend, who = np.concatenate(points).T
        a, n = np.nonzero(np.isfinite(self.course_rad) & self.wheeled[:, None] & (self.speed_mps > 1.0))
        count = min(48, len(x))
        if count < 2 or not len(a):
            return out
        place, course = self.place_m[a, n], self.course_rad[a, n]
        tree, xy = cKDTree(np.column_stack([x, y])), np.column_stack([place.real, place.imag])
        distance, near = tree.query(xy, count, distance_upper_bound=12.0)
        known = np.isfinite(distance)
        near = np.where(known, near, 0)
        along = ((place[:, None] - x[near] - 1j * y[near]) * np.exp(-1j * heading[near])).real
        turn = wrap_angle(heading[near] + bend[near] * along - course[:, None])
        known &= (np.abs(along) <= 3.0) & (np.abs(turn) < SAME_WAY_RAD) & (who[near] != a[:, None])
        # One vote for each vehicle: of its points the nearest.
        order = np.argsort(np.where(known, who[near], np.inf), axis=1, kind="stable")
        sorted_who = np.take_along_axis(np.where(known, who[near], np.nan), order, axis=1)
        first = np.isfinite(sorted_who)
        first[:, 1:] &= sorted_who[:, 1:] != sorted_who[:, :-1]
        votes = np.where(first, np.take_along_axis(turn, order, axis=1), np.nan)
        enough = first.sum(axis=1) >= 2
        votes = np.concatenate([votes[enough], np.zeros((enough.sum(), 1))], axis=1)
        out[a[enough], n[enough]] = course[enough] + np.nanmedian(votes, axis=1)
        return out

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
            vertices, widths = (np.linspace(0, 1, len(values)) for values in (line.s_m, lane.width_m))
            width = np.interp(at.s_m, line.s_m, np.interp(vertices, widths, lane.width_m))
            fits = at.inside & (np.abs(at.aside_m) <= width / 2)
            # Where lanes overlap, the nearer center line and the direction decide; who goes against a lane is in it last.
            cost = np.abs(at.aside_m) + 3.0 * np.abs(at.turn_rad)
            better = fits & (cost < best[a[near], n[near]])
            rows = near[better]
            best[a[rows], n[rows]], found[a[rows], n[rows]] = cost[better], k
        return found

    def half_lane_m(self, r: int) -> float:
        """Return half the width of the lane that an agent drives in most; the usual one where none is known."""
        if self.table.category[r] in ("cyclist", "bicycle"):
            return HALF_TRACK_M
        inside = self.lane_of[r][self.lane_of[r] >= 0] if self.lanes else np.zeros(0, dtype=np.intp)
        return float(np.median(self.lanes[np.bincount(inside).argmax()][0].width_m)) / 2 if len(inside) else HALF_LANE_M


def smoothed(table: MotionTable) -> tuple[Complex, Complex]:
    """Smooth places and velocities (A, T) by parabolas over `SMOOTH_S` to each side, and over up to `SMOOTH_NOISY_S` where velocities jump.

    The velocity of vehicles is their speed along the heading, which a reconstruction smooths and which jitters less than the places.
    """
    place, velocity = table.position_m.copy(), table.velocity_mps.copy()
    wheeled = np.isin(table.group, ("vehicle", "two_wheeler"))
    velocity[wheeled] = table.speed_mps[wheeled] * np.exp(1j * table.yaw_rad[wheeled])
    for k, agent in enumerate(table.agents):
        if agent.static:
            continue
        w = agent.waypoints
        sampled = w.speed_mps * np.exp(1j * w.yaw_rad)
        # The median of two axes' errors is 1.18 sigma.
        jumps = np.abs(np.diff(sampled, 2)) / np.sqrt(6.0) / 1.18 if len(w) > 4 else np.zeros(1)
        interval_s = float(np.median(np.diff(w.t_s))) if len(w) > 1 else 0.0
        half_s = float(np.clip(np.median(jumps) ** 2 * interval_s / (2.0 * SMOOTH_TO_MPS**2), SMOOTH_S, SMOOTH_NOISY_S))
        for piece in np.unique(table.piece[k][table.present[k]]).tolist():
            rows = np.flatnonzero(table.piece[k] == piece)
            window = min(2 * round(half_s / TICK_S) + 1, len(rows) - (len(rows) + 1) % 2)
            if window > 3:
                start = place[k, rows[0]]
                place[k, rows] = start + fit_windows(place[k, rows] - start, window, 2)
                velocity[k, rows] = fit_windows(velocity[k, rows], window, 2)
    return place, velocity


def out_of_sight(seen: Mask) -> list[tuple[int, Index]]:
    """Return the first and the last tick at which something was seen (T,), each with the ticks for `UNSEEN_S` before or after it."""
    (first, last), ticks = np.flatnonzero(seen)[[0, -1]].tolist(), round(UNSEEN_S / TICK_S)
    return [
        (first, np.arange(max(first - ticks, 0), first)),
        (last, np.arange(last + 1, min(last + 1 + ticks, len(seen)))),
    ]


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


def runs(state: Mask, least: int = 1, bridged: int = 0) -> list[tuple[int, int]]:
    """Return first and last tick of each time (T,) that a state lasts for at least so many ticks, breaks of up to `bridged` included."""
    begin, end = np.array(runs_of(state), dtype=np.intp).reshape(-1, 2).T
    apart = begin[1:] - end[:-1] > bridged
    begin, end = begin[np.concatenate([[True], apart])[: len(begin)]], end[np.concatenate([apart, [True]])[: len(end)]]
    return [(i, j - 1) for i, j in zip(begin.tolist(), end.tolist()) if j - i >= least]


def probability_above(value: Array | float, limit: float, sigma: Array | float) -> float:
    """Return the probability that a quantity with a normal error exceeds a limit; of several values, that all do, errors being one."""
    from scipy.special import ndtr

    value, sigma = np.broadcast_arrays(np.asarray(value, dtype=np.float64), np.asarray(sigma, dtype=np.float64))
    sure = np.where(value == limit, 0.5, (value > limit).astype(np.float64))
    normal = (sigma > 0) & np.isfinite(value) & np.isfinite(sigma)
    z = np.divide(value - limit, sigma, out=np.zeros(value.shape), where=normal)
    return float(np.min(np.where(normal, ndtr(z), np.where(np.isinf(sigma), 0.5, sure)))) if value.size else 0.0


def _jitter(agent: Agent) -> float:
    """Return the standard deviation of places on each axis that third differences show: labels and truth that do not tell any may have some.

    Places at less than 4 Hz change by more than they jitter, and are left as they are.
    """
    w = agent.waypoints
    if agent.static or len(w) < 8 or float(np.median(np.diff(w.t_s))) > 0.25:
        return 0.0
    # Of two axes with errors of sigma the median length is 1.177 sigma, and 1, -3, 3, -1 are 20 of one variance.
    return float(np.median(np.abs(np.diff(w.x_m + 1j * w.y_m, 3))) / (1.1774 * np.sqrt(20.0)))


def _sigma_speed(table: MotionTable, k: int, sigma_m: Array) -> Array:
    """Return the standard deviation (T,) of speeds; where the scenario has none, that of a slope over a second of places."""
    w = table.agents[k].waypoints
    if w.sigma_speed_mps is not None:
        return np.asarray(np.interp(table.t_s, w.t_s, w.sigma_speed_mps))
    interval_s = float(np.median(np.diff(w.t_s))) if len(w) > 1 else 1.0
    count = max(1.0 / interval_s, 2.0)
    return np.asarray(sigma_m * np.sqrt(12.0 / (count * (count**2 - 1.0))) / interval_s)


def _driven_of(place: Complex, course: Array, piece: Index) -> Driven | None:
    """Return the longest stretch of a path without a jump; None for who stands."""
    known = piece >= 0
    if not known.any() or np.ptp(place[known].real) + np.ptp(place[known].imag) < 4 * STEP_M:
        return None
    rows = np.flatnonzero(piece == np.bincount(piece[known]).argmax())
    kept = [int(rows[0])]
    for n in rows[1:].tolist():
        step = (place[n] - place[kept[-1]]) * np.exp(-1j * course[n])
        if step.real >= STEP_M and step.real >= abs(step.imag):
            kept.append(n)
    if len(kept) < 4:
        return None
    point = place[kept]
    points = np.column_stack([point.real, point.imag, np.zeros(len(kept))])
    return Driven(np.array(kept), Polyline.through(points, STEP_M))


def _continuation(point: Complex, guides: Sequence[Polyline], sign: float) -> tuple[Complex, float]:
    """Return points that go on from the last one for `EXTENSION_M`, and for how far others show the way, m."""
    more, sure_m = np.zeros(0, dtype=complex), 0.0
    end = point[-1]
    heading = float(np.angle(end - point[-min(len(point), round(2.0 / STEP_M) + 1)])) + (np.pi if sign < 0 else 0.0)
    best = GUIDED_M
    for line in guides:
        low, high = line.bounds_m
        if not (low[0] - best < end.real < high[0] + best and low[1] - best < end.imag < high[1] + best):
            continue
        at = line.project(np.array([[end.real, end.imag]]), np.array([heading]))
        left_m = float(line.length_m - at.s_m[0] if sign > 0 else at.s_m[0])
        if at.inside[0] and abs(at.turn_rad[0]) < np.radians(20) and abs(at.aside_m[0]) < best and left_m > 5.0:
            best = abs(float(at.aside_m[0]))
            d = np.arange(STEP_M, min(left_m, EXTENSION_M) + 1e-9, STEP_M)
            xy = line.offset(at.s_m[0] + sign * d, np.full(len(d), at.aside_m[0]))
            more, sure_m = xy[:, 0] + 1j * xy[:, 1], float(d[-1])
    rest = np.arange(STEP_M, EXTENSION_M - sure_m + 1e-9, STEP_M)
    return np.concatenate([more, _circle(np.concatenate([point[-200:], more]), rest)]), sure_m


def _circle(point: Complex, d: Array) -> Complex:
    """Return the points at distances on the circle that the last `FITTED_M` of a line run along."""
    back = np.cumsum(np.abs(np.diff(point))[::-1])
    recent = point[-max(int(np.searchsorted(back, FITTED_M)), 3) - 1 :]
    step = np.abs(np.diff(recent))
    heading, s = np.unwrap(np.angle(np.diff(recent))), np.cumsum(step)
    bend, start = np.polyfit(s - step / 2, heading, 1) if s[-1] > 5.0 else (0.0, heading.mean())
    bend = float(np.clip(bend, -0.2, 0.2))
    return np.asarray(point[-1] + d * np.exp(1j * (start + bend * (s[-1] + d / 2))) * np.sinc(bend * d / (2 * np.pi)))


def turned(course_rad: Array, first: int, last: int) -> float:
    """Return by how much a course (T,) turns from one tick to another, whole turns included."""
    part = course_rad[first : last + 1]
    return float(np.sum(wrap_angle(np.diff(part))))
