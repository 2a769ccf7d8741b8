"""Rollouts of all agents from a moment on, of which only what was before is known: simulated drivers, or simpler models.

Each driver keeps to a lane or, where there is none, to a course that winds as courses do, follows whom it finds ahead (intelligent driver
model), yields where paths cross, changes lanes where that gains something, and errs. Its parameters are fitted to its own last second, and
drawn anew for each rollout, so that rollouts are samples of what may happen.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import GROUP_OF, STANDSTILL_MPS, Agent, MapLane, Scenario
from log2sim.errors import ConfigError
from log2sim.files.plugins import nearest
from log2sim.geometry import Array, rectangles_overlap, wrap_angle
from log2sim.prediction.motion_table import TICK_S, Complex, smooth_motion, tabulate
from log2sim.prediction.prediction import ACCELERATION_S, MOVING
from log2sim.road.polyline import Polyline
from log2sim.simulation.metrics.realism import Motions, sizes_of
from log2sim.simulation.reactive import EXPONENT, IdmParameters, idm_parameters, leader_demand
from log2sim.simulation.vehicles.parameters import WHEELED

MODELS = ("drivers", "idm", "constant-velocity", "log")
"""How agents are simulated; "log" does what the log did."""

HISTORY_S = 1.0
"""Of the past is known; with the present eleven ticks, as in the challenge."""

POINTS = 161
"""Of the path of each agent, evenly spaced."""

LOOKAHEAD = 24
"""Places ahead on its path at which a driver looks for others."""

CHORD_M = 2.0
"""Courses are told by chords of this way to each side."""

SIDE_M = 0.2
"""Kept to others beside the path."""

NORMAL_PER_MEDIAN = 1.4826

Mask = NDArray[np.bool_]
Index = NDArray[np.intp]
Lane = tuple[MapLane, Polyline]


@dataclass(frozen=True, eq=False)
class Present:
    """Agents (A,) at the moment from which they are simulated, as their own last second tells.

    Attributes
    ----------
    place_m : (A,) complex128
    course_rad, yaw_rad : (A,) float64
        Direction of travel and of the box.
    speed_mps, accel_mps2, turn_radps : (A,) float64
        Along the course.
    moves : (A,) bool
        False for those that are static.
    jitter : (3, A) float64
        What the log jitters by along, across, in m, and in heading, in rad: one standard deviation.
    """

    agents: tuple[Agent, ...]
    place_m: Complex
    course_rad: Array
    yaw_rad: Array
    speed_mps: Array
    accel_mps2: Array
    turn_radps: Array
    moves: Mask
    jitter: Array

    @property
    def size_m(self) -> Array:
        """Length and width (A, 2)."""
        return sizes_of(self.agents)

    @property
    def group(self) -> NDArray[np.str_]:
        """Groups of categories (A,)."""
        return _groups_of(self.agents)


def _groups_of(agents: Sequence[Agent]) -> NDArray[np.str_]:
    return np.array([GROUP_OF.get(a.category, "other") for a in agents], dtype="<U16")


def moments(scenario: Scenario, every_s: float, horizon_s: float) -> list[float]:
    """Return times from which agents can be simulated: with a past, and half the horizon at least to compare with."""
    w = max(scenario.agents, key=lambda a: len(a.waypoints)).waypoints
    wanted = np.arange(w.t_s[0] + HISTORY_S, w.t_s[-1] - min(horizon_s, w.t_s[-1] - w.t_s[0] - HISTORY_S) / 2, every_s)
    # Where others have waypoints, too, so that nothing is taken from later ones.
    rows = np.unique(np.searchsorted(w.t_s, wanted - TICK_S / 4))
    return [float(t) for t in w.t_s[rows]]


def recorded(scenario: Scenario, now_s: float, horizon_s: float = 8.0) -> tuple[Motions, int]:
    """Return what the agents that are there at a time did from `HISTORY_S` before, (1, A, T), and the tick of that time."""
    before, after = round(HISTORY_S / TICK_S), round(horizon_s / TICK_S)
    t_s: Array = now_s + np.arange(-before, after + 1, dtype=np.float64) * TICK_S
    there = [
        a for a in scenario.agents if a.is_permanent or a.waypoints.t_s[0] - 1e-3 <= now_s <= a.waypoints.t_s[-1] + 1e-3
    ]
    table = tabulate(there, t_s, TICK_S)
    jumps = table.piece != table.piece[:, before, None]
    yaw = np.where(jumps, np.nan, table.yaw_rad)
    return Motions(tuple(there), TICK_S, np.where(jumps, np.nan, table.position_m)[None], yaw[None]), before


def judged(log: Motions, now: int) -> list[int]:
    """Return the rows of agents that move within the log or wait, and were there a while: those whose realism is measured."""
    past = log.present[0, :, : now + 1].sum(axis=1)
    return [k for k, a in enumerate(log.agents) if not a.static and past[k] > now / 2]


def observe(scenario: Scenario, now_s: float) -> Present:
    """Fit the state of agents at a time to their last second; nothing later is looked at."""
    log, now = recorded(scenario, now_s, 0.0)
    known = []
    for a in log.agents:
        past = (a.waypoints.t_s <= now_s + TICK_S / 2) & (a.waypoints.t_s >= now_s - HISTORY_S - TICK_S)
        known.append(
            a
            if a.is_permanent or a.static or not past.any()
            else replace(a, waypoints=a.waypoints.take(np.flatnonzero(past)))
        )
    t_s: Array = now_s + np.arange(-now, 1, dtype=np.float64) * TICK_S
    table = tabulate(known, t_s, TICK_S)
    smooth = smooth_motion(table)
    row = np.arange(len(known))
    last = table.present.shape[1] - 1 - table.present[:, ::-1].argmax(axis=1)
    yaw, velocity, place = (
        table.yaw_rad[row, last],
        smooth.velocity_mps[row, last],
        table.position_m[row, last] + smooth.velocity_mps[row, last] * (now_s - t_s[last]),
    )
    for k in np.flatnonzero(~table.present.any(axis=1)).tolist():  # seen once, between two ticks
        w = known[k].waypoints
        yaw[k], velocity[k] = w.yaw_rad[-1], w.speed_mps[-1] * np.exp(1j * w.yaw_rad[-1])
        place[k] = complex(w.x_m[-1], w.y_m[-1]) + velocity[k] * (now_s - w.t_s[-1])
    wheeled = np.array([a.category in WHEELED for a in known], dtype=bool)
    forward = (velocity * np.exp(-1j * yaw)).real
    slow = np.abs(velocity) < 2 * STANDSTILL_MPS
    course = np.where(wheeled | slow, np.where(wheeled & (forward < -0.5), yaw + np.pi, yaw), np.angle(velocity))
    speed = np.where(wheeled, np.abs(forward), np.abs(velocity))
    accel, jitter = np.zeros(len(known)), np.full((3, len(known)), np.nan)
    for k in np.flatnonzero([not a.static for a in known]).tolist():
        there = np.flatnonzero(table.present[k] & (table.piece[k] == table.piece[k, last[k]]))
        if len(there) < 7:
            continue
        t = t_s[there] - t_s[there[-1]]
        way = (table.position_m[k, there] - table.position_m[k, there[-1]]) * np.exp(-1j * course[k])
        fits = [np.polyfit(t, c, 2) for c in (way.real, way.imag)]
        accel[k] = 2 * fits[0][0]
        rest = [c - np.polyval(fit, t) for c, fit in zip((way.real, way.imag), fits)]
        jitter[:, k] = [_jitter(c) for c in (*rest, np.unwrap(table.yaw_rad[k, there]))]
    group = _groups_of(known)
    return Present(
        tuple(known), place, wrap_angle(course), yaw, np.where(slow, 0.0, speed), np.clip(accel, -4.0, 3.0),
        np.where(slow, 0.0, smooth.turn_radps[row, last]), np.array([not a.static for a in known], dtype=bool),
        np.stack([_drawn_to_group(c, group) for c in jitter]),
    )  # fmt: skip


def _jitter(values: Array) -> float:
    """Return the standard deviation of white noise in values at successive ticks, whose second differences have one of sqrt(6) times that."""
    return float(np.median(np.abs(values[4:] - 2 * values[2:-2] + values[:-4])) * NORMAL_PER_MEDIAN / np.sqrt(6.0))


def _drawn_to_group(own: Array, group: NDArray[np.str_]) -> Array:
    """Return variances' roots (A,) drawn halfway to those of the group, which stand in where nothing is known; 0 without either."""
    out = np.zeros(len(own))
    for name in np.unique(group):
        rows = group == name
        known = own[rows & np.isfinite(own)]
        usual = float(np.median(known)) if len(known) else 0.0
        out[rows] = np.sqrt((np.where(np.isfinite(own[rows]), own[rows], usual) ** 2 + usual**2) / 2)
    return out


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

    Parameters
    ----------
    model : str
        One of `MODELS`; all but "drivers" do the same in each rollout.
    horizon_s : float, s
        For which they are simulated; what they did in the `HISTORY_S` before comes first.

    Raises
    ------
    ConfigError
        For an unknown model.
    """
    if model not in MODELS:
        raise ConfigError(f"model '{model}'{nearest(model, list(MODELS))}: expected one of {', '.join(MODELS)}")
    log, now = recorded(scenario, now_s, horizon_s)
    if model == "log":
        return replace(
            log, position_m=np.repeat(log.position_m, count, axis=0), yaw_rad=np.repeat(log.yaw_rad, count, axis=0)
        )
    present = observe(scenario, now_s)
    ticks = round(horizon_s / TICK_S)
    if model == "constant-velocity":
        velocity = present.speed_mps * np.exp(1j * present.course_rad)
        place = present.place_m[:, None] + velocity[:, None] * np.arange(1, ticks + 1) * TICK_S
        yaw = np.repeat(present.yaw_rad[:, None], ticks, axis=1)
        place, yaw = np.repeat(place[None], count, axis=0), np.repeat(yaw[None], count, axis=0)
    else:
        crowd = Crowd(scenario, present, horizon_s, count if model == "drivers" else 1, rng, noisy=model == "drivers")
        place, yaw = crowd.run(ticks)
        if model != "drivers":
            place, yaw = np.repeat(place, count, axis=0), np.repeat(yaw, count, axis=0)
    past = [np.repeat(c[:, :, : now + 1], count, axis=0) for c in (log.position_m, log.yaw_rad)]
    return replace(
        log, position_m=np.concatenate([past[0], place], axis=2), yaw_rad=np.concatenate([past[1], yaw], axis=2)
    )


class Conflict(NamedTuple):
    """Where the paths of agents `one` and `two` (rows of movers) meet in rollouts (R,): stations at which each enters and leaves; NaN where they do not."""

    one: int
    two: int
    enters: Array  # (R, 2)
    leaves: Array  # (R, 2)
    merges: Mask  # (R,) whether both go on side by side
    patience_s: Array  # (R,) by how much later `one` may come and still go first


FREE_MPS = {"vehicle": 8.0, "two_wheeler": 4.5, "pedestrian": 1.3, "other": 5.0}
"""Speeds that those who stand take up."""

START_PER_S = {"vehicle": 0.06, "two_wheeler": 0.06, "pedestrian": 0.1, "other": 0.02}
"""How often those who stand set off by themselves."""

LATERAL_SHARE = {"vehicle": 0.5, "two_wheeler": 0.7, "pedestrian": 0.3, "other": 0.7}
"""Median of a driver's lateral acceleration without lanes, as a share of what is usual; it is spread by a factor of `LATERAL_SPREAD`."""

LATERAL_SPREAD, SPEED_SPREAD, ACCELERATION_SPREAD, JITTER_SPREAD = 2.0, 1.12, 1.5, 2.0
"""Factors of one standard deviation, of lateral acceleration, desired speed and acceleration noise of drivers, and of the log's jitter."""

WANDER_M, WANDER_AFTER_M = 0.15, 30.0
"""How far drivers are off their lane's middle, and after which way they are elsewhere."""

CANDIDATES = 6
"""Courses that a driver without lanes considers, of which the one is taken that leads through the fewest others."""

LATERAL_MPS2, BEND_M = 2.0, 10.0
"""Drivers take bends of streets with this lateral acceleration or less; bends are measured over this way."""

CRITICAL_GAP_S, TURNING_RAD = 4.0, np.radians(30.0)
"""Who turns accepts gaps from this one on in crossing traffic that goes straight (Highway Capacity Manual 2010, chapter 19: 4.1 to 7 s)."""

CLEAR_S = 0.5
"""Between one leaving and another entering where paths cross."""

GAIN_MPS2, SAFE_S, CHANGES_PER_S = 0.4, 1.0, 0.1
"""Least gain of a lane change (MOBIL; Kesting, Treiber and Helbing 2007), the time gap that is left to who comes from behind, and how often
who would gain changes."""

BESIDE_M = 1.2
"""How far from the middle of a lane the path beside it may be."""

CHANGE_S = 4.0


def _directions(path: Complex, step_m: Array) -> Complex:
    """Return unit vectors (R, M, N) along paths: of chords over `CHORD_M` to each side, so that corners of lanes are rounded."""
    out = np.empty_like(path)
    for m, every in enumerate(np.maximum(np.ceil(CHORD_M / step_m), 1).astype(np.intp).tolist()):
        n = np.arange(path.shape[2])
        chord = path[:, m, np.minimum(n + every, n[-1])] - path[:, m, np.maximum(n - every, 0)]
        out[:, m] = chord / np.abs(chord)
    return out


class Crowd:
    """R rollouts of M agents that move among A."""

    def __init__(
        self,
        scenario: Scenario,
        present: Present,
        horizon_s: float,
        count: int,
        rng: np.random.Generator,
        *,
        noisy: bool,
    ) -> None:
        self.now, self.rng, self.noisy, self.count = present, rng, noisy, count
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
        self.beside: dict[
            tuple[int, float], tuple[float, Array]
        ] = {}  # by mover and side, way to the lane there, and where there is none (R, N)
        reach = np.where(
            np.isin(self.group, ("pedestrian",)),
            (speed + 1.0) * horizon_s + 5.0,
            speed * horizon_s + 0.6 * horizon_s**2 + 15.0,
        )
        self.step_m = reach / (POINTS - 1)
        self.companion = self._companions()
        self._tree: Any = None
        self.path = self._paths(scenario, horizon_s)
        self.direction = _directions(self.path, self.step_m)
        self.limit = self._limits()
        self.conflicts = list(self._conflicts()) if noisy else []
        self.place = np.broadcast_to(present.place_m, (count, len(present.agents))).copy()
        self.yaw = np.broadcast_to(present.yaw_rad, (count, len(present.agents))).copy()
        i, j = self._near_pairs(0.0)
        overlap = self._overlapping(self.place, self.yaw, i, j)[1][0]
        self.touching = set(zip(i[overlap].tolist(), j[overlap].tolist()))  # which is the log's doing
        if noisy:
            self._fit_time_gaps()

    def _fit_time_gaps(self) -> None:
        """Give who follows another the time gap that it keeps now, in all rollouts up to a spread."""
        _, leads, gap = self._demand(self._reach())
        own_s = (gap - self.driver.gap_m) / np.maximum(self.speed, 2.0)
        follows = (self.speed > 2.0) & (np.abs(leads - self.speed) < 0.3 * self.speed) & (own_s < 3.0)
        fitted = np.clip(own_s, 0.4, 3.0) * self._spread(1.15, own_s.shape)
        self.driver.time_gap_s[follows] = fitted[follows]

    def _reach(self) -> Array:
        """Return how far drivers (R, M) look ahead, m."""
        return np.minimum(10.0 + 3.0 * self.speed + self.speed**2 / 3.0, 90.0)

    def _limits(self) -> Array:
        """Return speeds (R, M, N) along paths at which bends are taken, reached by comfortable braking."""
        if not self.noisy:
            return np.full(self.path.shape, np.inf)
        # Bends are measured over some way, since maps have corners where lanes meet.
        bend, n = np.empty(self.path.shape), np.arange(POINTS)
        for m, every in enumerate(np.ceil(BEND_M / 2 / self.step_m).astype(np.intp).tolist()):
            first, last = np.maximum(n - every, 0), np.minimum(n + every, n[-1])
            turn = self.direction[:, m, last] * self.direction[:, m, first].conj()
            bend[:, m] = np.abs(np.angle(turn)) / ((last - first) * self.step_m[m])
        limit = np.sqrt(LATERAL_MPS2 / np.maximum(bend, 1e-4))
        slower = 2 * self.driver.comfort_mps2 * self.step_m
        for k in range(POINTS - 2, -1, -1):
            limit[..., k] = np.minimum(limit[..., k], np.sqrt(limit[..., k + 1] ** 2 + slower))
        return limit

    def _spread(self, factor: float, shape: tuple[int, ...]) -> Array:
        return np.exp(np.log(factor) * self.rng.standard_normal(shape)) if self.noisy else np.ones(shape)

    def _companions(self) -> Index:
        """Return by mover (M,) whom of those it walks with it takes its course after."""
        place, velocity = (
            self.now.place_m[self.rows],
            (self.now.speed_mps * np.exp(1j * self.now.course_rad))[self.rows],
        )
        walks = self.group == "pedestrian"
        near = (
            (np.abs(place[:, None] - place) < 2.5)
            & (np.abs(velocity[:, None] - velocity) < 0.5)
            & walks[:, None]
            & walks
        )
        with_whom = np.arange(len(self.rows))
        for k in range(len(self.rows)):
            first = np.flatnonzero(near[k])
            if len(first):
                with_whom[k] = with_whom[min(int(first[0]), k)]
        return with_whom

    def _paths(self, scenario: Scenario, horizon_s: float) -> Complex:
        """Draw the paths (R, M, N)."""
        features = scenario.map_features
        lanes = {
            lane.id: (lane, Polyline.through(lane.points_m))
            for lane in (features.lanes if features else ())
            if len(lane.points_m) > 1
        }
        paths = self._courses(horizon_s)
        for m in np.flatnonzero(np.isin(self.group, ("vehicle", "two_wheeler"))).tolist():
            self._keep_to_lane(m, lanes, paths)
        return paths

    def _courses(self, horizon_s: float) -> Complex:
        """Draw courses that wind: curvatures are Ornstein-Uhlenbeck noise about what they are now, which dies away."""
        now, rows = self.now, self.rows
        tried, shape = CANDIDATES if self.noisy else 1, (self.count, len(self.rows))
        walks = self.group == "pedestrian"
        speed = np.maximum(now.speed_mps[rows], np.where(walks, 1.0, 3.0))
        lasts = speed * ACCELERATION_S
        kept = np.exp(-self.step_m / lasts)
        usual = np.array([MOVING[g].across_mps2 * LATERAL_SHARE[g] for g in self.group]) / speed**2
        sigma = usual * self._spread(LATERAL_SPREAD, (tried, *shape)) * self.noisy
        if self.noisy:
            sigma = sigma[..., self.companion]
        start = np.divide(now.turn_radps[rows], speed)
        bend = np.zeros((tried, *shape))
        points = np.empty((tried, *shape, POINTS), dtype=complex)
        points[..., 0] = now.place_m[rows]
        heading = np.broadcast_to(now.course_rad[rows], bend.shape).copy()
        limit = np.where(walks, 1.0, 0.15)
        for n in range(1, POINTS):
            if self.noisy:
                drawn = self.rng.standard_normal(bend.shape)[..., self.companion]
                bend = bend * kept + sigma * np.sqrt(1 - kept**2) * drawn
            total = np.clip(start * np.exp(-(n - 0.5) * self.step_m / lasts) + bend, -limit, limit)
            heading = heading + total * self.step_m
            points[..., n] = points[..., n - 1] + self.step_m * np.exp(1j * heading)
        if tried == 1:
            return np.asarray(points[0])
        best = self._hits(points, horizon_s).argmin(axis=0)
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
            near = np.flatnonzero(
                (np.abs(others - now.place_m[k]) < 2 * now.speed_mps[k] * horizon_s + 10.0).any(axis=1)
            )
            for j in near[near != k].tolist():
                away = (ways - others[j]) * turn[j]
                room = now.size_m[j] / 2 + now.size_m[k, 1] / 2 + SIDE_M
                count[:, :, m] += ((np.abs(away.real) < room[0]) & (np.abs(away.imag) < room[1])).sum(axis=-1)
        return count

    def _keep_to_lane(self, m: int, lanes: Mapping[str, Lane], paths: Complex) -> None:
        """Replace the paths (R, N) of a vehicle that is in a lane by ways along it and on, at random where there are several."""
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
        least = min(c[0] for c in costs.values())
        near = (
            sorted((c, name) for name, c in costs.items() if c[0] < least + 0.5)
            if self.noisy
            else [min((c, name) for name, c in costs.items())]
        )
        lane = lanes[near[0][1]][0]
        way = np.arange(POINTS) * self.step_m[m]
        lines: dict[tuple[str, ...], Polyline] = {}
        settle = max(10.0, 3.0 * self.now.speed_mps[k])
        wander = self._wander(m, (self.count, POINTS))
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
            paths[r, m] = xyz[:, 0] + 1j * xyz[:, 1]
        if self.noisy:
            direction = _directions(paths[:, m : m + 1], self.step_m[m : m + 1])[:, 0]
            middles = self._middles(lanes)
            for b, side in ((lane.left_lane, 1.0), (lane.right_lane, -1.0)):
                if b is not None and b in lanes:
                    aside = float(np.median(lanes[b][0].width_m) + np.median(lane.width_m)) / 2
                    there = paths[:, m] + 1j * side * aside * direction
                    off = middles.query(np.stack([there.real, there.imag], axis=-1))[0] > BESIDE_M
                    self.beside[m, side] = aside, np.cumsum(off, axis=1)

    def _middles(self, lanes: Mapping[str, Lane]) -> Any:
        """Return a search tree of all middle lines."""
        if self._tree is None:
            from scipy.spatial import cKDTree

            self._tree = cKDTree(np.concatenate([line.points_m[:, :2] for _, line in lanes.values()]))
        return self._tree

    def _wander(self, m: int, shape: tuple[int, int]) -> Array:
        """Draw how far drivers are off their lane's middle at points (R, N), from nothing on."""
        out = np.zeros(shape)
        if self.noisy:
            kept = np.exp(-self.step_m[m] / WANDER_AFTER_M)
            for n in range(1, shape[1]):
                out[:, n] = out[:, n - 1] * kept + WANDER_M * np.sqrt(1 - kept**2) * self.rng.standard_normal(shape[0])
            window = max(int(5.0 / self.step_m[m]), 1)
            smooth = np.cumsum(np.pad(out, ((0, 0), (window, 0))), axis=1)
            out = (smooth[:, window:] - smooth[:, :-window]) / window
        return out

    def _chain(self, name: str, lanes: Mapping[str, Lane], length_m: float) -> tuple[str, ...]:
        """Return a lane and what follows, at random weighed by how straight it leads on, or the straightest."""
        chain, gone = [name], lanes[name][1].length_m
        while gone < length_m and len(chain) < 40:
            heading = lanes[chain[-1]][1].heading_rad[-1]
            nexts = [n for n in lanes[chain[-1]][0].successors if n in lanes]
            if not nexts:
                break
            turns = np.array([abs(float(wrap_angle(lanes[n][1].heading_rad[-1] - heading))) for n in nexts])
            ends = np.array(
                [
                    gone + lanes[n][1].length_m < length_m and not any(m in lanes for m in lanes[n][0].successors)
                    for n in nexts
                ]
            )
            weight = np.exp(-1.5 * turns - 4.0 * ends)  # where the map ends, the road usually does not
            chain.append(
                nexts[int(self.rng.choice(len(nexts), p=weight / weight.sum())) if self.noisy else int(turns.argmin())]
            )
            gone += lanes[chain[-1]][1].length_m
        return tuple(chain)

    def _conflicts(self) -> Iterator[Conflict]:
        """Find where the paths of two movers meet that are apart now."""
        every = max(1, (POINTS - 1) // 40)
        coarse = self.path[:, :, ::every]
        low, high = (np.stack([f(coarse.real, axis=2), f(coarse.imag, axis=2)]) for f in (np.min, np.max))
        course = np.angle(np.diff(self.path, axis=2, append=2 * self.path[:, :, -1:] - self.path[:, :, -2:-1]))[
            :, :, ::every
        ]
        width = self.size_m[self.rows, 1]
        turning = np.abs(wrap_angle(course - course[:, :, :1])) > TURNING_RAD
        for i in range(len(self.rows)):
            for j in range(i):
                if self.group[i] == self.group[j] == "pedestrian" or self.speed[0, i] == self.speed[0, j] == 0.0:
                    continue
                if not ((low[:, :, i] < high[:, :, j] + 2) & (low[:, :, j] < high[:, :, i] + 2)).all(axis=0).any():
                    continue
                room = (width[i] + width[j]) / 2 + 0.5 + (self.step_m[i] + self.step_m[j]) * every / 4
                near = np.abs(coarse[:, i, :, None] - coarse[:, j, None, :]) < room
                met = near.any(axis=(1, 2)) & ~near[:, 0].any(axis=1) & ~near[:, :, 0].any(axis=1)
                if not met.any():
                    continue
                enters, leaves, first = (np.full((self.count, 2), np.nan) for _ in range(3))
                for side, (who, mask) in enumerate(((i, near.any(axis=2)), (j, near.any(axis=1)))):
                    begin = mask.argmax(axis=1)
                    end = mask.shape[1] - 1 - mask[:, ::-1].argmax(axis=1)
                    enters[:, side], leaves[:, side] = begin * every * self.step_m[who], end * every * self.step_m[who]
                    first[:, side] = course[np.arange(self.count), who, np.minimum(begin + 1, mask.shape[1] - 1)]
                enters[~met], leaves[~met] = np.nan, np.nan
                turns = np.stack(
                    [
                        turning[np.arange(self.count), who, np.minimum(mask, coarse.shape[2] - 1)]
                        for who, mask in ((i, near.any(axis=2).argmax(axis=1)), (j, near.any(axis=1).argmax(axis=1)))
                    ]
                )
                minor = turns[0].astype(float) - turns[1].astype(float)
                patience = -CRITICAL_GAP_S * minor + 0.7 * self.rng.standard_normal(self.count)
                merges = np.abs(wrap_angle(first[:, 0] - first[:, 1])) < TURNING_RAD
                yield Conflict(i, j, enters, leaves, merges, patience)

    def run(self, ticks: int) -> tuple[Complex, Array]:
        """Simulate and return places and headings (R, A, T)."""
        places, yaws = (np.empty((*self.place.shape, ticks), dtype=c.dtype) for c in (self.place, self.yaw))
        wanted, shape = np.zeros(self.speed.shape), (self.count, len(self.rows), ticks)
        more = self._spread(JITTER_SPREAD, (*shape[:2], 1))
        jitter = self.rng.standard_normal((3, *shape)) * self.now.jitter[:, None, self.rows, None] * more
        for n in range(ticks):
            if n % 2 == 0:  # drivers look twice in 0.4 s
                wanted = self._accelerations()
                if self.noisy and n % 10 == 0:
                    self._change_lanes(n)
            self._advance(wanted, n)
            places[..., n], yaws[..., n] = self._jittered(jitter[..., n]) if self.noisy else (self.place, self.yaw)
        return places, wrap_angle(yaws)

    def _at(self, way: Array) -> tuple[Complex, Complex]:
        """Return places and directions (R, M, ...) at ways (R, M, ...) along the paths, straight on beyond their ends."""
        flat = way.reshape(*way.shape[:2], -1)
        place = np.maximum(flat / self.step_m[:, None], 0.0)
        k = np.minimum(place.astype(np.intp), POINTS - 2)
        (low, high), (before, after) = (
            (np.take_along_axis(c, k, axis=2), np.take_along_axis(c, k + 1, axis=2))
            for c in (self.path, self.direction)
        )
        direction = before + np.clip(place - k, 0.0, 1.0) * (after - before)
        direction /= np.abs(direction)
        at = low + (place - k) * (high - low) + 1j * direction * self.shift[..., None]
        return at.reshape(way.shape), direction.reshape(way.shape)

    def _velocity(self) -> Complex:
        """Return velocities (R, A)."""
        out = np.zeros(self.place.shape, dtype=complex)
        out[:, self.rows] = self.speed * np.exp(1j * (self.yaw[:, self.rows] - self.offset))
        return out

    def _accelerations(self) -> Array:
        """Return what drivers (R, M) want, without what they err by."""
        d = self.driver
        k = np.clip((self.way / self.step_m).astype(np.intp), 0, POINTS - 1)
        desired = np.minimum(self.desired, np.take_along_axis(self.limit, k[..., None], axis=2)[..., 0])
        free = np.maximum(d.accel_mps2 * (1.0 - (self.speed / desired) ** EXPONENT), -d.comfort_mps2)
        taken, leads, _ = self._demand(self._reach())
        # Who stands sets off by itself now and then, or when who is ahead does.
        if self.noisy:
            chance = np.array([START_PER_S[g] for g in self.group]) * 2 * TICK_S
            self.waits &= (self.rng.random(self.waits.shape) > chance) & ~((leads > 1.0) & (taken > 0.05))
        for c in self.conflicts:
            for me, him, mine, his, sign in ((c.one, c.two, 0, 1, 1.0), (c.two, c.one, 1, 0, -1.0)):
                half = self.size_m[self.rows[[me, him]], 0] / 2
                gap = c.enters[:, mine] - self.way[:, me] - half[0]
                his_gap, his_end = (
                    c.enters[:, his] - self.way[:, him] - half[1],
                    c.leaves[:, his] - self.way[:, him] + half[1],
                )
                pace, his_pace = np.maximum(self.speed[:, me], 1.0), np.maximum(self.speed[:, him], 0.3)
                arrive, his_arrive, his_leave = gap / pace, np.maximum(his_gap, 0.0) / his_pace, his_end / his_pace
                ahead = (his_gap <= 0) | (his_arrive < arrive - sign * c.patience_s)
                met = (gap > 0) & (his_end > 0) & ahead & ~((self.speed[:, him] == 0.0) & (his_gap > 0))
                met &= np.where(c.merges, True, arrive < his_leave + CLEAR_S)
                lead = np.where(c.merges, self.speed[:, him], 0.0)
                room = np.where(c.merges, gap - np.maximum(his_gap, 0.0) - 2 * half[1] + d.gap_m[:, me], gap)
                room = np.where(c.merges & (his_gap > gap), gap, room)
                one = d.take(me)
                taken[:, me] = np.maximum(
                    taken[:, me], np.where(met, leader_demand(one, np.maximum(room, 0.3), self.speed[:, me], lead), 0.0)
                )
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

    def _demand(self, reach: Array) -> tuple[Array, Array, Array]:
        """Return the greatest share of the free acceleration that who is ahead takes (R, M), and the speed and the gap to that one."""
        taken, leads, gaps = np.zeros(self.speed.shape), np.zeros(self.speed.shape), np.full(self.speed.shape, np.inf)
        i, j = self._near_pairs(reach)
        if not len(i):
            return taken, leads, gaps
        ahead = reach[..., None] * (np.arange(LOOKAHEAD) + 0.5) / LOOKAHEAD
        at, direction = self._at(self.way[..., None] + ahead)
        velocity = self._velocity()
        half_i, half_j = self.size_m[self.rows[i]] / 2, self.size_m[j] / 2
        away = (self.place[:, j, None] - at[:, i]) * direction[:, i].conj()
        turn = np.exp(1j * self.yaw[:, j, None]) * direction[:, i].conj()
        cos, sin = np.abs(turn.real), np.abs(turn.imag)
        long = half_j[:, 0, None] * cos + half_j[:, 1, None] * sin
        wide = half_j[:, 0, None] * sin + half_j[:, 1, None] * cos
        met = (np.abs(away.imag) < wide + half_i[:, 1, None] + SIDE_M) & (
            np.abs(away.real) < long + reach[:, i, None] / LOOKAHEAD / 2
        )
        met &= ahead[:, i] + away.real > 0
        first = met.argmax(axis=2)[..., None]
        gap, speed = (
            np.take_along_axis(c, first, axis=2)[..., 0]
            for c in (ahead[:, i] + away.real - long, (velocity[:, j, None] * direction[:, i].conj()).real)
        )
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
        shift = np.where(
            np.isnan(u),
            self.shift,
            self.change[1] + (self.change[2] - self.change[1]) * u**3 * (10 - 15 * u + 6 * u**2),
        )
        lateral = (shift - self.shift) / TICK_S
        before = self.shift
        self.shift = shift
        at, direction = self._at(way)
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
        taken, _, _ = self._demand(self._reach())
        velocity = self._velocity()
        for (m, side), (aside, missing) in self.beside.items():
            k = self.rows[m]
            # Only lanes beside the first one are known, so who has changed may only change back.
            free = (
                ~((n - self.change[0, :, m]) * TICK_S < 2 * CHANGE_S)
                & (self.speed[:, m] > 4.0)
                & (self.shift[:, m] * side < 1.0)
            )
            free &= self.rng.random(self.count) < CHANGES_PER_S
            here, later = (
                np.clip(((self.way[:, m] + s * self.speed[:, m]) / self.step_m[m]).astype(np.intp), 0, POINTS - 1)
                for s in (0.0, 2 * CHANGE_S)
            )
            rollout = np.arange(self.count)
            free &= missing[rollout, later] == missing[rollout, here]
            away = (self.place - self.place[:, k, None]) * np.exp(-1j * self.yaw[:, k, None])
            there = np.abs(away.imag - side * aside) < 1.8
            there[:, k] = False
            room = np.abs(away.real) - (self.size_m[:, 0] + self.size_m[k, 0]) / 2
            along = (velocity * np.exp(-1j * self.yaw[:, k, None])).real
            near_s = SAFE_S * along + 2.0 * np.maximum(along - self.speed[:, m, None], 0.0)
            safe = ~(there & (away.real <= 0) & (room < 2.0 + near_s)).any(axis=1)
            one = self.driver.take(slice(m, m + 1))
            demand = leader_demand(
                one, np.where(there & (away.real > 0), room, np.inf), self.speed[:, m, None], along
            ).max(axis=1)
            gain = self.driver.accel_mps2[:, m] * (np.minimum(taken[:, m], 4.0) - np.minimum(demand, 4.0))
            begins = free & safe & (gain > GAIN_MPS2)
            target = np.where(np.abs(self.shift[:, m]) < 1.0, side * aside, 0.0)
            self.change[:, begins, m] = np.stack(
                [np.full(begins.sum(), float(n)), self.shift[begins, m], target[begins]]
            )
