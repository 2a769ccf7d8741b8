"""Rollouts of all agents from a moment on, of which only what was before is known: simulated drivers, or simpler models.

Each driver keeps to a lane or, where there is none, to a course that winds as courses do, follows whom it finds ahead (intelligent driver
model), stops at red lights, yields where paths cross, changes lanes where that gains something, and errs. Its parameters are fitted to its
own last second, and drawn anew for each rollout, so that rollouts are samples of what may happen.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Scenario
from log2sim.errors import ConfigError
from log2sim.files.plugins import nearest
from log2sim.geometry import Array, rectangles_overlap, wrap_angle
from log2sim.simulation.driver_paths import LIGHT_M, POINTS, SIDE_M, STOP_STATES, Paths
from log2sim.simulation.metrics.realism import Motions
from log2sim.simulation.prediction.motion_table import TICK_S, Complex
from log2sim.simulation.prediction.prediction import ACCELERATION_S, MOVING
from log2sim.simulation.present import Mask, observe, recorded
from log2sim.simulation.reactive import EXPONENT, IdmParameters, idm_parameters, leader_demand

MODELS = ("drivers", "idm", "constant-velocity", "log")  # how agents are simulated; "log" does what the log did
LOOKAHEAD = 24  # places ahead on its path at which a driver looks for others
FREE_MPS = {"vehicle": 8.0, "two_wheeler": 4.5, "pedestrian": 1.3, "other": 5.0}  # speeds that those who stand take up
# How often those who stand set off by themselves.
START_PER_S = {"vehicle": 0.06, "two_wheeler": 0.06, "pedestrian": 0.1, "other": 0.02}
# Factors of one standard deviation, of desired speed and acceleration noise of drivers, and of the log's jitter.
SPEED_SPREAD, ACCELERATION_SPREAD, JITTER_SPREAD = 1.12, 1.5, 2.0
CLEAR_S = 0.5  # between one leaving and another entering where paths cross
# Least gain of a lane change (MOBIL; Kesting, Treiber and Helbing 2007), the time gap that is left to who comes from
# behind, and how often who would gain changes.
GAIN_MPS2, SAFE_S, CHANGES_PER_S = 0.4, 1.0, 0.1
CHANGE_S = 4.0

# Who had to brake harder for a light that turns yellow drives on (Gazis, Herman and Maradudin 1960; ITE's value of 10
# ft/s2).
DILEMMA_MPS2 = 3.0
AT_LINE_M = 1.0  # how far before a stop line drivers come to rest

Index = NDArray[np.intp]


def roll_out(
    scenario: Scenario,
    now_s: float,
    model: str = "drivers",
    *,
    horizon_s: float = 8.0,
    count: int = 32,
    rng: np.random.Generator,
) -> Motions:
    """Simulate all agents that are there at a time, `count` times.

    Raises `ConfigError` for an unknown model.

    Parameters
    ----------
    model : str
        One of `MODELS`; all but "drivers" do the same in each rollout.
    horizon_s : float, s
        For which they are simulated; what they did in the `HISTORY_S` before comes first.
    """
    if model not in MODELS:
        raise ConfigError(f"model '{model}'{nearest(model, list(MODELS))}: expected one of {', '.join(MODELS)}")
    log, now = recorded(scenario, now_s, horizon_s)
    past_place, past_yaw = np.repeat(log.position_m, count, axis=0), np.repeat(log.yaw_rad, count, axis=0)
    if model == "log":
        return replace(log, position_m=past_place, yaw_rad=past_yaw)
    ticks = round(horizon_s / TICK_S)
    if model == "constant-velocity":
        present = observe(scenario, now_s)
        velocity = present.speed_mps * np.exp(1j * present.course_rad)
        place = present.place_m[:, None] + velocity[:, None] * np.arange(1, ticks + 1) * TICK_S
        yaw = np.repeat(present.yaw_rad[:, None], ticks, axis=1)
        place, yaw = place[None], yaw[None]
    else:
        crowd = Crowd(scenario, now_s, horizon_s, count if model == "drivers" else 1, rng, noisy=model == "drivers")
        place, yaw = crowd.run(ticks)
    if model != "drivers":
        place, yaw = np.repeat(place, count, axis=0), np.repeat(yaw, count, axis=0)
    place = np.concatenate([past_place[:, :, : now + 1], place], axis=2)
    return replace(log, position_m=place, yaw_rad=np.concatenate([past_yaw[:, :, : now + 1], yaw], axis=2))


class Crowd:
    """R rollouts of M agents that move among A."""

    def __init__(
        self, scenario: Scenario, now_s: float, horizon_s: float, count: int, rng: np.random.Generator, *, noisy: bool
    ) -> None:
        self.now_s, self.rng, self.noisy, self.count = now_s, rng, noisy, count
        self.now = present = observe(scenario, now_s)
        self.rows = np.flatnonzero(present.moves)
        shape = (count, len(self.rows))
        self.group = present.group[self.rows]
        self.size_m = present.size_m
        driver = idm_parameters([present.agents[k] for k in self.rows])
        columns = [np.broadcast_to(c, shape).copy() for c in vars(driver).values()]
        if noisy:
            columns = [c * self._spread(1.25, shape) for c in columns[:-1]] + columns[-1:]
        self.driver = IdmParameters(*columns)
        speed = present.speed_mps[self.rows]
        self.speed = np.broadcast_to(speed, shape).copy()
        self.waits = self.speed == 0.0
        free = np.array([FREE_MPS[g] for g in self.group])
        # Who drives slowly speeds up, to a speed between its own and that usual without others.
        more = self.rng.random(shape) * np.maximum(free - speed, 0.0) * noisy
        self.desired = np.where(self.waits, free, np.maximum(speed + more, 0.5)) * self._spread(SPEED_SPREAD, shape)
        self.noise = np.broadcast_to(present.accel_mps2[self.rows] * noisy, shape).copy()
        usual = np.array([MOVING[g].along_mps2 for g in self.group])
        self.sigma = usual * self._spread(ACCELERATION_SPREAD, shape)
        self.way = np.zeros(shape)
        self.shift = np.zeros(shape)  # beside the path, after changes of lane
        self.change = np.full((3, *shape), np.nan)  # tick, from, to
        self.offset = wrap_angle(present.yaw_rad - present.course_rad)[self.rows]
        features = scenario.map_features
        self.paths = Paths(features, present, horizon_s, count, rng, noisy=noisy)
        self.limit = self.paths.limits(self.driver.comfort_mps2) if noisy else np.full(self.paths.points.shape, np.inf)
        self.conflicts = list(self.paths.conflicts()) if noisy else []
        self.stops = list(self.paths.stops(features, scenario.signals)) if noisy else []
        self.place = np.broadcast_to(present.place_m, (count, len(present.agents))).copy()
        self.yaw = np.broadcast_to(present.yaw_rad, (count, len(present.agents))).copy()
        i, j = self._near_pairs(0.0)
        overlap = self._overlapping(self.place, self.yaw, i, j)[1][0]
        self.touching = set(zip(i[overlap].tolist(), j[overlap].tolist()))  # which is the log's doing
        if noisy:  # who follows another keeps the time gap that it has now, in all rollouts up to a spread
            _, leads, gap = self._demand()
            own_s = (gap - self.driver.gap_m) / np.maximum(self.speed, 2.0)
            follows = (self.speed > 2.0) & (np.abs(leads - self.speed) < 0.3 * self.speed) & (own_s < 3.0)
            fitted = np.clip(own_s, 0.4, 3.0) * self._spread(1.15, own_s.shape)
            self.driver.time_gap_s[follows] = fitted[follows]

    def _spread(self, factor: float, shape: tuple[int, ...]) -> Array:
        return np.exp(np.log(factor) * self.rng.standard_normal(shape)) if self.noisy else np.ones(shape)

    def run(self, ticks: int) -> tuple[Complex, Array]:
        """Simulate and return places and headings (R, A, T)."""
        places, yaws = (np.empty((*self.place.shape, ticks), dtype=c.dtype) for c in (self.place, self.yaw))
        wanted, shape = np.zeros(self.speed.shape), (self.count, len(self.rows), ticks)
        more = self._spread(JITTER_SPREAD, (*shape[:2], 1))
        jitter = self.rng.standard_normal((3, *shape)) * self.now.jitter[:, None, self.rows, None] * more
        for n in range(ticks):
            if n % 2 == 0:  # drivers look twice in 0.4 s
                wanted = self._accelerations(self.now_s + n * TICK_S)
                if self.noisy and n % 10 == 0:
                    self._change_lanes(n)
            self._advance(wanted, n)
            places[..., n], yaws[..., n] = self._jittered(jitter[..., n]) if self.noisy else (self.place, self.yaw)
        return places, wrap_angle(yaws)

    def _velocity(self) -> Complex:
        """Return velocities (R, A)."""
        out = np.zeros(self.place.shape, dtype=complex)
        out[:, self.rows] = self.speed * np.exp(1j * (self.yaw[:, self.rows] - self.offset))
        return out

    def _accelerations(self, t_s: float) -> Array:
        """Return what drivers (R, M) want at a time, without what they err by."""
        d = self.driver
        k = np.clip((self.way / self.paths.step_m).astype(np.intp), 0, POINTS - 1)
        desired = np.minimum(self.desired, np.take_along_axis(self.limit, k[..., None], axis=2)[..., 0])
        free = np.maximum(d.accel_mps2 * (1.0 - (self.speed / desired) ** EXPONENT), -d.comfort_mps2)
        taken, leads, _ = self._demand()
        # Who stands sets off by itself now and then, or when who is ahead does.
        if self.noisy:
            chance = np.array([START_PER_S[g] for g in self.group]) * 2 * TICK_S
            self.waits &= (self.rng.random(self.waits.shape) > chance) & ~((leads > 1.0) & (taken > 0.05))
        for stop in self.stops:
            m = stop.mover
            state, gap = stop.signal.at(t_s)[0], stop.station_m - self.way[:, m] - self.size_m[self.rows[m], 0] / 2
            held, near = gap > -AT_LINE_M, self.speed[:, m] ** 2 < 2 * DILEMMA_MPS2 * np.maximum(gap, 0.0)
            if state == "green":
                self.waits[:, m] &= ~(held & (gap < LIGHT_M))
            elif state in STOP_STATES:
                room = np.maximum(gap - AT_LINE_M + d.gap_m[:, m], 0.3)
                demand = leader_demand(d.take(m), room, self.speed[:, m], np.zeros(self.count))
                taken[:, m] = np.maximum(taken[:, m], np.where(held & (near | (state != "yellow")), demand, 0.0))
        for c in self.conflicts:
            for me, him, mine, his, sign in ((c.one, c.two, 0, 1, 1.0), (c.two, c.one, 1, 0, -1.0)):
                half = self.size_m[self.rows[[me, him]], 0] / 2
                gap = c.enters[:, mine] - self.way[:, me] - half[0]
                his_gap = c.enters[:, his] - self.way[:, him] - half[1]
                his_end = c.leaves[:, his] - self.way[:, him] + half[1]
                pace, his_pace = np.maximum(self.speed[:, me], 1.0), np.maximum(self.speed[:, him], 0.3)
                arrive, his_arrive, his_leave = gap / pace, np.maximum(his_gap, 0.0) / his_pace, his_end / his_pace
                ahead = (his_gap <= 0) | (his_arrive < arrive - sign * c.patience_s)
                met = (gap > 0) & (his_end > 0) & ahead & ~((self.speed[:, him] == 0.0) & (his_gap > 0))
                met &= np.where(c.merges, True, arrive < his_leave + CLEAR_S)
                lead = np.where(c.merges, self.speed[:, him], 0.0)
                room = np.where(c.merges, gap - np.maximum(his_gap, 0.0) - 2 * half[1] + d.gap_m[:, me], gap)
                room = np.where(c.merges & (his_gap > gap), gap, room)
                demand = leader_demand(d.take(me), np.maximum(room, 0.3), self.speed[:, me], lead)
                taken[:, me] = np.maximum(taken[:, me], np.where(met, demand, 0.0))
        wanted = np.maximum(free - d.accel_mps2 * taken, -d.brake_mps2)
        return np.where(self.waits, -d.brake_mps2, wanted)

    def _near_pairs(self, reach: Array | float) -> tuple[Index, Index]:
        """Return movers and agents that may be within a distance of each other's boxes in some rollout."""
        radius = np.hypot(*self.size_m.T) / 2
        apart = np.abs(self.place[:, self.rows, None] - self.place[:, None]) - radius[self.rows, None] - radius
        near = (apart < (reach[..., None] if isinstance(reach, np.ndarray) else reach)).any(axis=0)
        near[np.arange(len(self.rows)), self.rows] = False
        i, j = np.nonzero(near)
        return i, j

    def _demand(self) -> tuple[Array, Array, Array]:
        """Return the greatest share of the free acceleration that who is ahead takes (R, M), and the speed and the gap to that one."""
        reach = np.minimum(10.0 + 3.0 * self.speed + self.speed**2 / 3.0, 90.0)  # how far drivers look ahead
        taken, leads, gaps = np.zeros(self.speed.shape), np.zeros(self.speed.shape), np.full(self.speed.shape, np.inf)
        i, j = self._near_pairs(reach)
        if not len(i):
            return taken, leads, gaps
        ahead = reach[..., None] * (np.arange(LOOKAHEAD) + 0.5) / LOOKAHEAD
        at, direction = self.paths.at(self.way[..., None] + ahead, self.shift)
        velocity = self._velocity()
        half_i, half_j = self.size_m[self.rows[i]] / 2, self.size_m[j] / 2
        away = (self.place[:, j, None] - at[:, i]) * direction[:, i].conj()
        turn = np.exp(1j * self.yaw[:, j, None]) * direction[:, i].conj()
        cos, sin = np.abs(turn.real), np.abs(turn.imag)
        long = half_j[:, 0, None] * cos + half_j[:, 1, None] * sin
        wide = half_j[:, 0, None] * sin + half_j[:, 1, None] * cos
        met = np.abs(away.imag) < wide + half_i[:, 1, None] + SIDE_M
        met &= np.abs(away.real) < long + reach[:, i, None] / LOOKAHEAD / 2
        met &= ahead[:, i] + away.real > 0
        first = met.argmax(axis=2)[..., None]
        columns = ahead[:, i] + away.real - long, (velocity[:, j, None] * direction[:, i].conj()).real
        gap, speed = (np.take_along_axis(c, first, axis=2)[..., 0] for c in columns)
        gap = np.where(met.any(axis=2), gap - half_i[:, 0], np.inf)
        walkers = (self.group[i] == "pedestrian") & (self.now.group[j] == "pedestrian")
        gap = np.where(walkers & (speed < 0), np.inf, gap)
        gap[:, self._touched(i, j)] = np.inf
        d = self.driver.take(i)
        demand = leader_demand(d, gap, self.speed[:, i], speed)
        starts = np.flatnonzero(np.diff(i, prepend=-1))
        most = np.maximum.reduceat(demand, starts, axis=1)
        taken[:, i[starts]] = most
        who = demand == np.repeat(most, np.diff(np.append(starts, len(i))), axis=1)
        leads[:, i[starts]] = np.maximum.reduceat(np.where(who & (demand > 0), speed, 0.0), starts, axis=1)
        gaps[:, i[starts]] = np.minimum.reduceat(np.where(who, gap, np.inf), starts, axis=1)
        return taken, leads, gaps

    def _touched(self, i: Index, j: Index) -> Mask:
        return np.array([(a, b) in self.touching for a, b in zip(i.tolist(), j.tolist())], dtype=bool)

    def _overlapping(self, place: Complex, yaw: Array, i: Index, j: Index) -> tuple[Complex, Mask]:
        """Return how far agents j (P,) are from movers i (P,), (R, P), and whether their boxes overlap."""
        away = np.asarray(place[:, j] - place[:, self.rows[i]])
        one, two = (np.broadcast_to(self.size_m[k], (*away.shape, 2)).reshape(-1, 2) for k in (self.rows[i], j))
        headings = yaw[:, self.rows[i]].ravel(), yaw[:, j].ravel()
        hit = rectangles_overlap(away.real.ravel(), away.imag.ravel(), *headings, one, two).reshape(away.shape)
        # People brush past each other and walk shoulder to shoulder: their boxes overlap in logs, too.
        return away, hit & ~((self.group[i] == "pedestrian") & (self.now.group[j] == "pedestrian"))

    def _jittered(self, jitter: Array) -> tuple[Complex, Array]:
        """Return places and headings (R, A) as labels have them, off by jitter (3, R, M), but where boxes would overlap by it."""
        place, yaw = self.place.copy(), self.yaw.copy()
        place[:, self.rows] += (jitter[0] + 1j * jitter[1]) * np.exp(1j * yaw[:, self.rows])
        yaw[:, self.rows] += jitter[2]
        i, j = self._near_pairs(1.0)
        r, pair = np.nonzero(self._overlapping(place, yaw, i, j)[1])
        for k in (self.rows[i[pair]], j[pair]):
            place[r, k], yaw[r, k] = self.place[r, k], self.yaw[r, k]
        return place, yaw

    def _advance(self, wanted: Array, n: int) -> None:
        """Move agents by a tick; who would drive into another stays where it is."""
        speed = self.speed
        if self.noisy:
            kept = np.exp(-TICK_S / ACCELERATION_S)
            drawn = self.rng.standard_normal(self.noise.shape)
            self.noise = self.noise * kept + self.sigma * np.sqrt(1 - kept**2) * drawn
        accel = np.where(self.waits, wanted, wanted + np.where(wanted > -1.0, self.noise, np.minimum(self.noise, 0.0)))
        after = np.maximum(speed + np.clip(accel, -self.driver.brake_mps2, 4.0) * TICK_S, 0.0)
        way = self.way + (speed + after) / 2 * TICK_S
        u = np.clip((n + 1 - self.change[0]) * TICK_S / CHANGE_S, 0.0, 1.0)
        changed = self.change[1] + (self.change[2] - self.change[1]) * u**3 * (10 - 15 * u + 6 * u**2)
        before, self.shift = self.shift, np.where(np.isnan(u), self.shift, changed)
        lateral = (self.shift - before) / TICK_S
        at, direction = self.paths.at(way, self.shift)
        yaw = np.angle(direction) + self.offset + np.arctan2(lateral, np.maximum(after, 1.0))
        # A way of millimeters has no direction of its own.
        place, heading = self.place.copy(), self.yaw.copy()
        place[:, self.rows], heading[:, self.rows] = at, np.where(way > 0, yaw, self.yaw[:, self.rows])
        i, j = self._near_pairs(1.0)
        if len(i):
            away, hit = self._overlapping(place, heading, i, j)
            ahead = (away * np.exp(-1j * (heading[:, self.rows[i]] - self.offset[i]))).real > 0
            hit &= ahead & ~self._touched(i, j)
            stays = np.zeros(self.speed.shape, dtype=bool)
            r, p = np.nonzero(hit)
            stays[r, i[p]] = True
            place[:, self.rows] = np.where(stays, self.place[:, self.rows], place[:, self.rows])
            heading[:, self.rows] = np.where(stays, self.yaw[:, self.rows], heading[:, self.rows])
            way, after = np.where(stays, self.way, way), np.where(stays, 0.0, after)
            self.shift = np.where(stays, before, self.shift)
        self.place, self.yaw, self.way, self.speed = place, heading, way, after

    def _change_lanes(self, n: int) -> None:
        """Begin changes of lane that gain acceleration and leave who comes from behind room."""
        taken, _, _ = self._demand()
        velocity = self._velocity()
        for (m, side), (aside, missing) in self.paths.beside.items():
            k = self.rows[m]
            # Only lanes beside the first one are known, so who has changed may only change back.
            free = ~((n - self.change[0, :, m]) * TICK_S < 2 * CHANGE_S)
            free &= (self.speed[:, m] > 4.0) & (self.shift[:, m] * side < 1.0)
            free &= self.rng.random(self.count) < CHANGES_PER_S
            ways = (self.way[:, m] + s * self.speed[:, m] for s in (0.0, 2 * CHANGE_S))
            here, later = (np.clip((w / self.paths.step_m[m]).astype(np.intp), 0, POINTS - 1) for w in ways)
            rollout = np.arange(self.count)
            free &= missing[rollout, later] == missing[rollout, here]
            away = (self.place - self.place[:, k, None]) * np.exp(-1j * self.yaw[:, k, None])
            there = np.abs(away.imag - side * aside) < 1.8
            there[:, k] = False
            room = np.abs(away.real) - (self.size_m[:, 0] + self.size_m[k, 0]) / 2
            along = (velocity * np.exp(-1j * self.yaw[:, k, None])).real
            near_s = SAFE_S * along + 2.0 * np.maximum(along - self.speed[:, m, None], 0.0)
            safe = ~(there & (away.real <= 0) & (room < 2.0 + near_s)).any(axis=1)
            one, gap = self.driver.take(slice(m, m + 1)), np.where(there & (away.real > 0), room, np.inf)
            demand = leader_demand(one, gap, self.speed[:, m, None], along).max(axis=1)
            gain = self.driver.accel_mps2[:, m] * (np.minimum(taken[:, m], 4.0) - np.minimum(demand, 4.0))
            begins = free & safe & (gain > GAIN_MPS2)
            target = np.where(np.abs(self.shift[:, m]) < 1.0, side * aside, 0.0)
            self.change[0, begins, m] = n
            self.change[1:, begins, m] = self.shift[begins, m], target[begins]
