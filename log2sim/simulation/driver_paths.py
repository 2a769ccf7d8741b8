"""Paths that simulated drivers may take: along lanes or winding, where they meet, how fast bends are taken, and where lights stop them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from log2sim.datatypes import MapFeatures, MapLane, Signal
from log2sim.geometry import Array, Polyline, wrap_angle
from log2sim.simulation.prediction.motion_table import Complex
from log2sim.simulation.prediction.prediction import ACCELERATION_S, MOVING
from log2sim.simulation.present import Mask, Present

POINTS = 161
"""Of the path of each agent, evenly spaced."""

CHORD_M = 2.0
"""Courses are told by chords of this way to each side."""

SIDE_M = 0.2
"""Kept to others beside the path."""

LATERAL_SHARE = {"vehicle": 0.5, "two_wheeler": 0.7, "pedestrian": 0.3, "other": 0.7}
"""Median of a driver's lateral acceleration without lanes, as a share of what is usual; it is spread by a factor of `LATERAL_SPREAD`."""

LATERAL_SPREAD = 2.0

WANDER_M, WANDER_AFTER_M = 0.15, 30.0
"""How far drivers are off their lane's middle, and after which way they are elsewhere."""

CANDIDATES = 6
"""Courses that a driver without lanes considers, of which the one is taken that leads through the fewest others."""

LATERAL_MPS2, BEND_M = 2.0, 10.0
"""Drivers take bends of streets with this lateral acceleration or less; bends are measured over this way."""

CRITICAL_GAP_S, TURNING_RAD = 4.0, np.radians(30.0)
"""Who turns accepts gaps from this one on in crossing traffic that goes straight (Highway Capacity Manual 2010, chapter 19: 4.1 to 7 s)."""

BESIDE_M = 1.2
"""How far from the middle of a lane the path beside it may be."""

LIGHT_M, LIGHT_ASIDE_M = 30.0, 12.0
"""How far ahead and aside of who stops at it a light may be: stop lines are up to 25 m before lights across a junction."""

BEFORE_LIGHT_M = 3.0
"""Where nothing is painted, drivers stop this far before the light."""

STOP_STATES = ("red", "red_yellow", "yellow")

Lane = tuple[MapLane, Polyline]


class Conflict(NamedTuple):
    """Where the paths of agents `one` and `two` (rows of movers) meet in rollouts (R,): stations at which each enters and leaves; NaN where they do not."""

    one: int
    two: int
    enters: Array  # (R, 2)
    leaves: Array  # (R, 2)
    merges: Mask  # (R,) whether both go on side by side
    patience_s: Array  # (R,) by how much later `one` may come and still go first


class Stop(NamedTuple):
    """A light on the path of a mover, and the stations (R,) at which it stops there; NaN in rollouts that lead elsewhere."""

    mover: int
    signal: Signal
    station_m: Array


def light_ahead(signal: Signal, place: complex, course_rad: float) -> tuple[float, float] | None:
    """Return how far ahead and to the left of a place a signal is; None where it faces elsewhere, or is no light for who stops there."""
    way = (complex(signal.position_m[0], signal.position_m[1]) - place) * np.exp(-1j * course_rad)
    faces = signal.heading_rad is None or np.cos(signal.heading_rad - course_rad) < -0.5
    return (way.real, way.imag) if faces and 0 < way.real < LIGHT_M and abs(way.imag) < LIGHT_ASIDE_M else None


class Paths:
    """Paths of M movers in R rollouts.

    Attributes
    ----------
    points : (R, M, N) complex128, m
        `step_m` (M,) apart.
    direction : (R, M, N) complex128
        Unit vectors along them, of chords over `CHORD_M` to each side, so that corners of lanes are rounded.
    beside : dict
        By mover and side (1 left, -1 right), way to the lane there, m, and in how many of the points before each (R, N) there is none.
    """

    def __init__(
        self, features: MapFeatures | None, present: Present, horizon_s: float, count: int, rng: np.random.Generator, *, noisy: bool
    ) -> None:  # fmt: skip
        self.now, self.rng, self.noisy, self.count = present, rng, noisy, count
        self.rows = np.flatnonzero(present.moves)
        self.group, speed = present.group[self.rows], present.speed_mps[self.rows]
        walks = self.group == "pedestrian"
        reach = np.where(walks, (speed + 1.0) * horizon_s + 5.0, speed * horizon_s + 0.6 * horizon_s**2 + 15.0)
        self.step_m = reach / (POINTS - 1)
        self.points = self._courses(horizon_s)
        self.beside: dict[tuple[int, float], tuple[float, Array]] = {}
        known = [lane for lane in (features.lanes if features else ()) if len(lane.points_m) > 1]
        lanes = {lane.id: (lane, Polyline.through(lane.points_m)) for lane in known}
        for m in np.flatnonzero(np.isin(self.group, ("vehicle", "two_wheeler"))).tolist() if lanes else ():
            self._keep_to_lane(m, lanes)
        self.direction = (
            np.stack([self._directions(m) for m in range(len(self.rows))], axis=1) if len(self.rows) else self.points
        )

    def _directions(self, m: int) -> Complex:
        every, n = max(int(np.ceil(CHORD_M / self.step_m[m])), 1), np.arange(POINTS)
        chord = self.points[:, m, np.minimum(n + every, n[-1])] - self.points[:, m, np.maximum(n - every, 0)]
        return np.asarray(chord / np.abs(chord))

    def at(self, way: Array, shift: Array) -> tuple[Complex, Complex]:
        """Return places and directions (R, M, ...) at ways (R, M, ...), to the left by shifts (R, M), straight on beyond the ends."""
        flat = way.reshape(*way.shape[:2], -1)
        place = np.maximum(flat / self.step_m[:, None], 0.0)
        k = np.minimum(place.astype(np.intp), POINTS - 2)
        (low, high), (before, after) = (
            (np.take_along_axis(c, k, axis=2), np.take_along_axis(c, k + 1, axis=2))
            for c in (self.points, self.direction)
        )
        direction = before + np.clip(place - k, 0.0, 1.0) * (after - before)
        direction /= np.abs(direction)
        at = low + (place - k) * (high - low) + 1j * direction * shift[..., None]
        return at.reshape(way.shape), direction.reshape(way.shape)

    def limits(self, comfort_mps2: Array) -> Array:
        """Return speeds (R, M, N) along paths at which bends are taken, reached by comfortable braking (R, M)."""
        # Bends are measured over some way, since maps have corners where lanes meet.
        bend, n = np.empty(self.points.shape), np.arange(POINTS)
        for m, every in enumerate(np.ceil(BEND_M / 2 / self.step_m).astype(np.intp).tolist()):
            first, last = np.maximum(n - every, 0), np.minimum(n + every, n[-1])
            turn = self.direction[:, m, last] * self.direction[:, m, first].conj()
            bend[:, m] = np.abs(np.angle(turn)) / ((last - first) * self.step_m[m])
        limit = np.sqrt(LATERAL_MPS2 / np.maximum(bend, 1e-4))
        slower = 2 * comfort_mps2 * self.step_m
        for k in range(POINTS - 2, -1, -1):
            limit[..., k] = np.minimum(limit[..., k], np.sqrt(limit[..., k + 1] ** 2 + slower))
        return limit

    def _companions(self) -> list[int]:
        """Return by mover whom of those it walks with it takes its course after."""
        place = self.now.place_m[self.rows]
        velocity = (self.now.speed_mps * np.exp(1j * self.now.course_rad))[self.rows]
        walks = self.group == "pedestrian"
        near = (np.abs(place[:, None] - place) < 2.5) & (np.abs(velocity[:, None] - velocity) < 0.5)
        near &= walks[:, None] & walks
        with_whom: list[int] = []
        for k in range(len(place)):
            first = int(near[k].argmax()) if near[k].any() else k
            with_whom.append(with_whom[first] if first < k else k)
        return with_whom

    def _courses(self, horizon_s: float) -> Complex:
        """Draw courses that wind: curvatures are Ornstein-Uhlenbeck noise about what they are now, which dies away."""
        now, rows = self.now, self.rows
        tried, shape = CANDIDATES if self.noisy else 1, (self.count, len(rows))
        walks = self.group == "pedestrian"
        speed = np.maximum(now.speed_mps[rows], np.where(walks, 1.0, 3.0))
        lasts = speed * ACCELERATION_S
        kept = np.exp(-self.step_m / lasts)
        bend = np.zeros((tried, *shape))
        if self.noisy:
            together = self._companions()
            usual = np.array([MOVING[g].across_mps2 * LATERAL_SHARE[g] for g in self.group]) / speed**2
            sigma = usual * np.exp(np.log(LATERAL_SPREAD) * self.rng.standard_normal((tried, *shape)))
            sigma = sigma[..., together]
        start = np.divide(now.turn_radps[rows], speed)
        points = np.empty((tried, *shape, POINTS), dtype=complex)
        points[..., 0] = now.place_m[rows]
        heading = np.broadcast_to(now.course_rad[rows], bend.shape).copy()
        limit = np.where(walks, 1.0, 0.15)
        for n in range(1, POINTS):
            if self.noisy:
                drawn = self.rng.standard_normal(bend.shape)[..., together]
                bend = bend * kept + sigma * np.sqrt(1 - kept**2) * drawn
            total = np.clip(start * np.exp(-(n - 0.5) * self.step_m / lasts) + bend, -limit, limit)
            heading = heading + total * self.step_m
            points[..., n] = points[..., n - 1] + self.step_m * np.exp(1j * heading)
        best = self._hits(points, horizon_s).argmin(axis=0) if self.noisy else np.zeros(shape, dtype=np.intp)
        return np.asarray(np.take_along_axis(points, best[None, ..., None], axis=0)[0])

    def _hits(self, points: Complex, horizon_s: float) -> Array:
        """Count the moments (C, R, M) at which who goes on along paths (C, R, M, N) at its speed is where others would be by theirs."""
        now, t_s = self.now, np.arange(0.5, horizon_s + 0.1, 0.5)
        others = now.place_m[:, None] + (now.speed_mps * np.exp(1j * now.course_rad))[:, None] * t_s
        turn = np.exp(-1j * now.yaw_rad)[:, None]
        count = np.zeros(points.shape[:3])
        for m, k in enumerate(self.rows.tolist()):
            if now.speed_mps[k] == 0.0:
                continue
            at = np.minimum(np.rint(now.speed_mps[k] * t_s / self.step_m[m]).astype(np.intp), POINTS - 1)
            ways = points[:, :, m, at]
            reach = 2 * now.speed_mps[k] * horizon_s + 10.0
            near = np.flatnonzero((np.abs(others - now.place_m[k]) < reach).any(axis=1))
            for j in near[near != k].tolist():
                away = (ways - others[j]) * turn[j]
                room = now.size_m[j] / 2 + now.size_m[k, 1] / 2 + SIDE_M
                count[:, :, m] += ((np.abs(away.real) < room[0]) & (np.abs(away.imag) < room[1])).sum(axis=-1)
        return count

    def _keep_to_lane(self, m: int, lanes: Mapping[str, Lane]) -> None:
        """Replace the paths of a vehicle that is in a lane by ways along it and on, at random where there are several."""
        k = self.rows[m]
        place, heading = self.now.place_m[k], np.array([self.now.course_rad[k]])
        xy = np.array([[place.real, place.imag]])
        costs, before_m = {}, 4.0 * float(self.now.speed_mps[k])  # who comes to a lane within seconds keeps to it, too
        for name, (lane, line) in lanes.items():
            low, high = line.bounds_m
            if np.any(xy[0] < low - 5.0 - before_m) or np.any(xy[0] > high + 5.0 + before_m):
                continue
            at = line.project(xy, heading)
            station, aside, turn = float(at.s_m[0]), float(at.aside_m[0]), float(at.turn_rad[0])
            half = float(np.median(lane.width_m)) * 0.6
            cost = abs(aside) + 3.0 * abs(turn)
            if at.inside[0] and abs(aside) < half and abs(turn) < np.radians(40.0):
                costs[name] = (cost, station, aside, turn)
            elif -before_m < station < 0 and abs(aside) < half and abs(turn) < np.radians(10.0):
                costs[name] = (cost + 2.0 - station / 20.0, station, aside, turn)
        if not costs:
            return
        near = sorted((c, name) for name, c in costs.items())
        near = [c for c in near if c[0][0] < near[0][0][0] + 0.5] if self.noisy else near[:1]
        lane = lanes[near[0][1]][0]
        way = np.arange(POINTS) * self.step_m[m]
        lines: dict[tuple[str, ...], Polyline] = {}
        settle = max(10.0, 3.0 * self.now.speed_mps[k])
        wander = self._wander(m) if self.noisy else np.zeros((self.count, POINTS))
        for r in range(self.count):
            (_, station, aside, turn), name = near[self.rng.integers(len(near))] if self.noisy else near[0]
            chain = self._chain(name, lanes, way[-1] + station)
            if chain not in lines:
                pieces = [lanes[c][1].points_m for c in chain]
                lines[chain] = Polyline.through(np.concatenate([pieces[0], *(p[1:] for p in pieces[1:])]))
            # The offset settles as if critically damped; those on two wheels keep to their side.
            rest = aside if self.group[m] == "two_wheeler" else float(np.clip(aside, -0.4, 0.4))
            off = aside - rest
            offset = rest + (off + (np.tan(turn) + off / settle) * way) * np.exp(-way / settle)
            xyz = lines[chain].offset(station + way, offset + wander[r])
            self.points[r, m] = xyz[:, 0] + 1j * xyz[:, 1]
        if not self.noisy:
            return
        from scipy.spatial import cKDTree

        direction = self._directions(m)
        middles = cKDTree(np.concatenate([line.points_m[:, :2] for _, line in lanes.values()]))
        for b, side in ((lane.left_lane, 1.0), (lane.right_lane, -1.0)):
            if b is not None and b in lanes:
                aside = float(np.median(lanes[b][0].width_m) + np.median(lane.width_m)) / 2
                there = self.points[:, m] + 1j * side * aside * direction
                off = middles.query(np.stack([there.real, there.imag], axis=-1))[0] > BESIDE_M
                self.beside[m, side] = aside, np.cumsum(off, axis=1)

    def _wander(self, m: int) -> Array:
        """Draw how far drivers are off their lane's middle at points (R, N), from nothing on."""
        out = np.zeros((self.count, POINTS))
        kept = np.exp(-self.step_m[m] / WANDER_AFTER_M)
        for n in range(1, POINTS):
            out[:, n] = out[:, n - 1] * kept + WANDER_M * np.sqrt(1 - kept**2) * self.rng.standard_normal(self.count)
        window = max(int(5.0 / self.step_m[m]), 1)
        smooth = np.cumsum(np.pad(out, ((0, 0), (window, 0))), axis=1)
        return np.asarray((smooth[:, window:] - smooth[:, :-window]) / window)

    def _chain(self, name: str, lanes: Mapping[str, Lane], length_m: float) -> tuple[str, ...]:
        """Return a lane and what follows, at random weighed by how straight it leads on, or the straightest."""
        chain, gone = [name], lanes[name][1].length_m
        while gone < length_m and len(chain) < 40:
            heading = lanes[chain[-1]][1].heading_rad[-1]
            nexts = [n for n in lanes[chain[-1]][0].successors if n in lanes]
            if not nexts:
                break
            turns = np.array([abs(float(wrap_angle(lanes[n][1].heading_rad[-1] - heading))) for n in nexts])
            if self.noisy:  # where the map ends, the road usually does not
                short = np.array([gone + lanes[n][1].length_m < length_m for n in nexts])
                ends = short & [not any(m in lanes for m in lanes[n][0].successors) for n in nexts]
                weight = np.exp(-1.5 * turns - 4.0 * ends)
                chain.append(nexts[int(self.rng.choice(len(nexts), p=weight / weight.sum()))])
            else:
                chain.append(nexts[int(turns.argmin())])
            gone += lanes[chain[-1]][1].length_m
        return tuple(chain)

    def conflicts(self) -> Iterator[Conflict]:
        """Find where the paths of two movers meet that are apart now."""
        every, rollout = max(1, (POINTS - 1) // 40), np.arange(self.count)
        coarse = self.points[:, :, ::every]
        low, high = (np.stack([f(coarse.real, axis=2), f(coarse.imag, axis=2)]) for f in (np.min, np.max))
        end = 2 * self.points[:, :, -1:] - self.points[:, :, -2:-1]
        course = np.angle(np.diff(self.points, axis=2, append=end))[:, :, ::every]
        width, speed = self.now.size_m[self.rows, 1], self.now.speed_mps[self.rows]
        turning = np.abs(wrap_angle(course - course[:, :, :1])) > TURNING_RAD
        for i in range(len(self.rows)):
            for j in range(i):
                if self.group[i] == self.group[j] == "pedestrian" or speed[i] == speed[j] == 0.0:
                    continue
                if not ((low[:, :, i] < high[:, :, j] + 2) & (low[:, :, j] < high[:, :, i] + 2)).all(axis=0).any():
                    continue
                room = (width[i] + width[j]) / 2 + 0.5 + (self.step_m[i] + self.step_m[j]) * every / 4
                near = np.abs(coarse[:, i, :, None] - coarse[:, j, None, :]) < room
                met = near.any(axis=(1, 2)) & ~near[:, 0].any(axis=1) & ~near[:, :, 0].any(axis=1)
                if not met.any():
                    continue
                enters, leaves, first, turns = (np.full((self.count, 2), np.nan) for _ in range(4))
                for side, (who, mask) in enumerate(((i, near.any(axis=2)), (j, near.any(axis=1)))):
                    begin = mask.argmax(axis=1)
                    last = mask.shape[1] - 1 - mask[:, ::-1].argmax(axis=1)
                    enters[:, side], leaves[:, side] = begin * every * self.step_m[who], last * every * self.step_m[who]
                    first[:, side] = course[rollout, who, np.minimum(begin + 1, mask.shape[1] - 1)]
                    turns[:, side] = turning[rollout, who, begin]
                enters[~met], leaves[~met] = np.nan, np.nan
                patience = -CRITICAL_GAP_S * (turns[:, 0] - turns[:, 1]) + 0.7 * self.rng.standard_normal(self.count)
                merges = np.abs(wrap_angle(first[:, 0] - first[:, 1])) < TURNING_RAD
                yield Conflict(i, j, enters, leaves, merges, patience)

    def stops(self, features: MapFeatures | None, signals: Sequence[Signal]) -> Iterator[Stop]:
        """Find where drivers stop at lights."""
        for m in np.flatnonzero(self.group != "pedestrian").tolist() if signals else ():
            found = stop_stations(self.points[:, m], self.direction[:, m], self.step_m[m], features, signals)
            yield from (Stop(m, s, where) for s, where in zip(signals, found) if np.isfinite(where).any())


def stop_stations(
    points: Complex, direction: Complex, step_m: float, features: MapFeatures | None, signals: Sequence[Signal]
) -> Array:
    """Return how far along ways (R, N), `step_m` apart, it is to stop at each of S lights (S, R), m; NaN where a light is for others.

    That is at the last stop line before the light, else at a crosswalk there, else `BEFORE_LIGHT_M` before it. Of several lights that
    face one place the one least aside counts.
    """
    painted = features.markings if features is not None else ()
    edges: dict[str, list[tuple[complex, complex]]] = {"stop_line": [], "crosswalk": []}
    for marking in (m for m in painted if m.kind in edges):
        corner = (marking.points_m[:, 0] + 1j * marking.points_m[:, 1]).tolist()
        edges[marking.kind] += zip(corner, corner[1:] + (corner[:1] if marking.kind == "crosswalk" else []))
    at = [
        np.array([_crossed(points, *edge) * step_m for edge in known]).reshape(-1, len(points))
        for known in edges.values()
    ]
    out = np.full((len(signals), len(points)), np.nan)
    for r in range(len(points)):
        ahead = []
        for k, signal in enumerate(signals):
            place = complex(signal.position_m[0], signal.position_m[1])
            nearest = float(np.abs(points[r] - place).argmin()) * step_m - BEFORE_LIGHT_M
            for station in (
                s
                for kind in (*(a[:, r] for a in at), np.array([nearest]))
                for s in np.sort(kind[kind > 0])[::-1].tolist()
            ):
                n = int(station / step_m)
                found = light_ahead(signal, points[r, n], float(np.angle(direction[r, n])))
                if found is not None:
                    ahead.append((abs(found[1]), k, station))
                    break
        taken: list[float] = []
        for _, k, station in sorted(ahead):
            if all(abs(station - other) > 1.0 for other in taken):
                taken.append(station)
                out[k, r] = station
    return out


def _crossed(way: Complex, one: complex, two: complex) -> Array:
    """Return the points, as fractions, at which ways (R, N) first cross the line from one place to another; NaN where they do not."""
    if one == two:
        return np.full(len(way), np.nan)
    local = (way - one) / (two - one)
    before, after = local[:, :-1], local[:, 1:]
    step = (after - before).imag
    share = np.divide(-before.imag, step, out=np.full(step.shape, -1.0), where=step != 0)
    at = before.real + share * (after - before).real
    hit = (share >= 0) & (share < 1) & (at >= 0) & (at <= 1)
    first = hit.argmax(axis=1)
    return np.where(hit.any(axis=1), first + share[np.arange(len(way)), first], np.nan)
