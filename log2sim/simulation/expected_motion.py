"""Where the ego and others are expected to be within the horizon of a warning, by what was observed of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import ENDS, MARGIN_S, Agent, Scenario, Span, Trajectory
from log2sim.errors import ConfigError
from log2sim.files.arrays import Columns
from log2sim.files.plugins import nearest
from log2sim.geometry import Array, runs_of, wrap_angle
from log2sim.simulation.corridors import ON_PATH_COS, ON_PATH_M, PathTable
from log2sim.simulation.metrics.conflicts import touching
from log2sim.simulation.prediction.motion_table import Complex, MotionTable
from log2sim.simulation.prediction.prediction import DEFAULT_METHOD, predict_table
from log2sim.tracking.forward import CONFIRMED_AGE_S, TENTATIVE_HITS

CHOICES = (*ENDS, "both")  # whose observations count: those of the sensors of the ego, of those at the roadside, or all

_RANGES = {
    "horizon_s": (0.5, 10.0), "margin_s": (0.0, 10.0), "early_probability": (0.01, 1.0), "min_probability": (0.01, 1.0),
    "reaction_s": (0.0, 10.0), "brake_mps2": (0.5, 20.0),
}  # fmt: skip


@dataclass(frozen=True)
class WarningSettings:
    """When the ego is warned, and how it brakes.

    With the defaults a vehicle at 30 km/h stands after 12.7 m, 8.3 m of which it drives before it brakes.

    Raises `ConfigError` for a value out of its range.
    """

    ends: str = "both"  # one of "both", "vehicle", "road": whose observations count
    horizon_s: float = 5.0  # s: collisions are predicted for so long: from 200 km/h, a vehicle stands after 4.5 s
    # Of a predicted collision, from which on it is warned of when the ego has to react at once to stand before it.
    min_probability: float = 0.5
    # The same up to `margin_s` earlier: while there is time to wait, a doubtful prediction is waited for to become
    # clear.
    early_probability: float = 0.8
    # s: still earlier, there is no warning: who walks or drives toward the ego's path then usually stops before it.
    margin_s: float = 1.0
    reaction_s: float = 1.0  # s: from the warning until the brakes work
    brake_mps2: float = 8.0  # m/s2: deceleration: of a dry road, less what brakes need to build up

    def __post_init__(self) -> None:
        """Check all values."""
        if self.ends not in CHOICES:
            raise ConfigError(
                f"warn '{self.ends}'{nearest(self.ends, list(CHOICES))}: expected one of {', '.join(CHOICES)}"
            )
        for name, (low, high) in _RANGES.items():
            value = getattr(self, name)
            if not (math.isfinite(value) and low <= value <= high):
                raise ConfigError(f"warnings: {name} is {value:g}, expected {low:g} to {high:g}")

    @property
    def used_ends(self) -> tuple[str, ...]:
        """Return the ends whose observations count."""
        return ENDS if self.ends == "both" else (self.ends,)

    def stopping_distance_m(self, speed_mps: Array) -> Array:
        """Return the ways in m until a vehicle stands: reaction, then braking."""
        return np.asarray(np.abs(speed_mps) * self.reaction_s + speed_mps**2 / (2 * self.brake_mps2))

    def needed_mps2(self, speed_mps: float, way_m: float) -> float | None:
        """Return the deceleration that stops a vehicle within a way; None where it is driven before the brakes work."""
        left_m = way_m - abs(speed_mps) * self.reaction_s
        return speed_mps**2 / (2 * left_m) if left_m > 0 else None


# Between observations: most LiDARs turn ten times a second. Logs with fewer ticks are observed at these.
MIN_INTERVAL_S = 0.1


@dataclass(frozen=True, eq=False)
class Known:
    """What is known of A agents at T ticks.

    An agent is known from its third observation on (`TENTATIVE_HITS`), which is when trackers take it for an object, until it
    was not observed for `CONFIRMED_AGE_S`. A static one stays known.
    """

    since_s: Array  # (A,) when each agent is first known; infinite for those that never are
    source: NDArray[np.intp]  # (A, T) tick of the last observation, where an agent is known; else -1
    observed: NDArray[np.bool_]  # (A, T)
    count: NDArray[np.intp]  # (A, T) observations since the agent was found, at least 0
    # (A, T) rises by one when an agent is found again after it was lost; -1 before the first observation.
    piece: NDArray[np.intp]


def known_agents(
    agents: Sequence[Agent], spans: Sequence[Sequence[Span]], t_s: Array, interval_s: float, present: NDArray[np.bool_]
) -> Known:
    """Find at ticks (T,) what is known of agents (A,), which are present (A, T) and observed every `interval_s` in spans."""
    shape = (len(agents), len(t_s))
    since = np.full(len(agents), np.inf)
    source, piece = np.full(shape, -1, dtype=np.intp), np.full(shape, -1, dtype=np.intp)
    observed, count = np.zeros(shape, dtype=bool), np.zeros(shape, dtype=np.intp)
    ticks = np.arange(len(t_s))
    confirmed_s = (TENTATIVE_HITS - 1) * interval_s
    for k, agent in enumerate(agents):
        kept_s = np.inf if agent.static else max(CONFIRMED_AGE_S, 1.5 * interval_s)
        # Spans in order of time whose gaps a tracker bridges are one piece.
        pieces: list[list[Span]] = []
        for span in sorted(spans[k]):
            if pieces and span[0] - max(last for _, last in pieces[-1]) <= kept_s:
                pieces[-1].append(span)
            else:
                pieces.append([span])
        for number, runs in enumerate(pieces):
            start, end = runs[0][0], runs[-1][1]
            seen = np.zeros(len(t_s), dtype=bool)
            for first, last in runs:
                seen |= (t_s >= first - MARGIN_S) & (t_s <= last + MARGIN_S) & present[k]
            observed[k] |= seen
            after = t_s >= start - MARGIN_S
            piece[k, after] = number
            age = np.where(np.isfinite(start), t_s - start, np.inf)
            count[k, after] = np.minimum(age[after] / interval_s + MARGIN_S, len(t_s)).astype(np.intp) + 1
            if end - start < confirmed_s - MARGIN_S:
                continue
            since[k] = min(since[k], max(start + confirmed_s, float(t_s[0])))
            latest = np.maximum.accumulate(np.where(seen, ticks, -1))
            there = (t_s >= start + confirmed_s - MARGIN_S) & (latest >= 0) & (t_s <= end + kept_s + MARGIN_S)
            source[k, there] = latest[there]
    return Known(since, source, observed, count, piece)


def observed_spans(agent: Agent, ends: Sequence[str]) -> tuple[Span, ...]:
    """Return the spans, s, in which chosen ends observe an agent.

    Agents that do not say which end observed them are observed where their waypoints are, or, in truth, where they are visible:
    in scenarios of a single end these are all.
    """
    if agent.observed_by:
        return tuple(sorted(span for end in ends for span in agent.observed_by.get(end, ())))
    if agent.is_permanent:
        return ((-np.inf, np.inf),)
    w = agent.waypoints
    seen = w.observed if w.visible is None else w.observed & w.visible
    return tuple((float(w.t_s[first]), float(w.t_s[end - 1])) for first, end in runs_of(seen))


def ends_of(scenario: Scenario) -> tuple[str, ...]:
    """Return the ends whose sensors observed any agent; none where the scenario does not say."""
    return tuple(end for end in ENDS if any(a.observed_by.get(end) for a in scenario.agents))


def observation_interval_s(scenario: Scenario) -> float:
    """Return the time between observations in s: the least between waypoints, at least `MIN_INTERVAL_S`."""
    steps = [float(np.diff(a.waypoints.t_s).min()) for a in scenario.agents if len(a.waypoints) > 1]
    return max(min(steps, default=MIN_INTERVAL_S), MIN_INTERVAL_S)


# Between expected places; motion between them is straight, which is 3 cm off where a car turns with 4 m/s2 across.
LEAD_STEP_S = 0.25

# A tracker's speed rests on about a second of observations; older ones say nothing about the present.
LEARNED_OBSERVATIONS = 11

Index = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class ExpectedPaths(Columns):
    """Expected motion of C boxes at the leads (H,)."""

    position_m: Complex  # (C, H) box centers x + iy, map frame
    yaw_rad: Array  # (C, H)
    course: Complex  # (C, H) unit vectors along which and across which `sigma_m` holds
    sigma_m: Array  # (C, H, 2) standard deviations along and across
    size_m: Array  # (C, 2) length and width


class ExpectedAgents:
    """Where agents (A,) of a table are expected from any tick, by what is known of them then, observed every `interval_s`.

    Movers are predicted by `log2sim.simulation.prediction` from the states at ticks at which they were observed. To its standard deviations
    comes that of a speed which a tracker has learned from few observations: of the slope of a line through n places with
    errors sigma, sigma sqrt(12 / (n (n^2 - 1))) per interval. Static agents stay where they are.
    """

    def __init__(self, table: MotionTable, known: Known, interval_s: float, horizon_s: float) -> None:
        self.table, self.known, self._interval_s = table, known, interval_s
        self.lead_s = np.linspace(0.0, horizon_s, int(np.ceil(horizon_s / LEAD_STEP_S - 1e-9)) + 1)
        self._static = np.array([a.static for a in table.agents], dtype=bool)
        movers = np.flatnonzero(~self._static)
        self._mover = np.full(len(table.agents), -1, dtype=np.intp)
        self._mover[movers] = np.arange(len(movers))
        # A table of the states at ticks of observation alone, in which who was lost begins anew.
        there = known.observed[movers] & table.present[movers]
        blank, jumps = np.where(there, 1.0, np.nan), table.piece[movers]
        # Pieces that differ where either piece number does.
        pieces = known.piece[movers] * (int(jumps.max(initial=0)) + 1) + np.maximum(jumps, 0)
        seen = MotionTable(
            tuple(table.agents[k] for k in movers.tolist()), table.t_s,
            blank[..., None] * table.center_m[movers], blank * table.yaw_rad[movers], blank * table.speed_mps[movers],
            table.tick_s, np.where(there, table.velocity_mps[movers], np.nan), blank * table.sigma_m[movers], there,
            np.where(there, pieces, -1),
        )  # fmt: skip
        count = int(np.ceil((horizon_s + CONFIRMED_AGE_S) / LEAD_STEP_S))
        found = predict_table(seen, np.linspace(LEAD_STEP_S, count * LEAD_STEP_S, count), (DEFAULT_METHOD,))
        self._forecast = found.forecasts[DEFAULT_METHOD]
        self._row = np.full(seen.piece.shape, -1, dtype=np.intp)
        self._row[found.row, found.tick] = np.arange(len(found.row))

    def at(self, agent: Index, tick: Index) -> ExpectedPaths:
        """Return where agents (C,), known at ticks (C,), are expected at the leads from then on."""
        t, known, f, source = self.table, self.known, self._forecast, self.known.source[agent, tick]
        position, course = (np.empty((len(agent), len(self.lead_s)), dtype=complex) for _ in range(2))
        yaw, sigma = np.empty(position.shape), np.empty((*position.shape, 2))
        position[:], course[:] = t.position_m[agent, source][:, None], 1.0
        yaw[:], sigma[:] = t.yaw_rad[agent, source][:, None], t.sigma_m[agent, source][:, None, None]
        moving = np.flatnonzero(~self._static[agent])
        if len(moving):  # forecasts at the leads, which count from the last observation
            who, at = agent[moving], source[moving]
            row = self._row[self._mover[who], at]
            lead = (tick[moving] - at)[:, None] * t.tick_s + self.lead_s
            here, first = position[moving, :1], f.course[row][:, :1]
            sigma0 = sigma[moving, :1]
            position[moving] = _at_leads(np.concatenate([here, f.position_m[row]], axis=1), lead)
            way = _at_leads(np.concatenate([first, f.course[row]], axis=1), lead)
            course[moving] = way / np.abs(way)
            yaw[moving] += np.angle(course[moving] * first.conj())
            count = np.clip(known.count[who, at], 2, LEARNED_OBSERVATIONS)
            drift = sigma0[..., 0] * (np.sqrt(12.0 / (count * (count**2 - 1.0))) / self._interval_s)[:, None]
            spread = _at_leads(np.concatenate([sigma0, f.sigma_m[row]], axis=1), lead)
            sigma[moving] = np.sqrt(spread**2 + (drift * lead)[..., None] ** 2)
        return ExpectedPaths(position, yaw, course, sigma, t.size_m[agent, :2])


def _at_leads(values: NDArray[Any], lead_s: Array) -> NDArray[Any]:
    """Interpolate values (C, K, ...) that are `LEAD_STEP_S` apart, the first at 0, at leads (C, H)."""
    place = np.minimum(lead_s / LEAD_STEP_S, values.shape[1] - 1.0)
    k = np.minimum(place.astype(np.intp), values.shape[1] - 2)
    row = np.arange(len(values))[:, None]
    part = (place - k).reshape(*k.shape, *[1] * (values.ndim - 2))
    return np.asarray(values[row, k] + part * (values[row, k + 1] - values[row, k]))


# Within about a second drivers deviate by some 0.3 m from the middle of their lane, so that a near touch may also be a miss.
KEEPING_SIGMA_M, KEEPING_S = 0.3, 1.0


@dataclass(frozen=True, eq=False)
class EgoStates(Columns):
    """States of the ego (C,)."""

    x_m: Array  # box center, map frame
    y_m: Array
    yaw_rad: Array
    speed_mps: Array
    accel_mps2: Array  # of the speed's amount
    progress_m: Array  # how far along its path


class EgoPath:
    """Expected motion of the ego along the path that it has in the scenario: its route, which it knows."""

    def __init__(self, ego: Agent) -> None:
        self._trajectory = Trajectory.through(ego.waypoints, ego.rear_axle_offset_m)
        self.paths = PathTable([self._trajectory])
        self.size_m = ego.size_m

    def at(self, ego: EgoStates, lead_s: Array) -> ExpectedPaths:
        """Return where the ego is expected at leads (H,): on its path, as far aside as it is; off it, straight on.

        It keeps its speed, or goes on braking as it does until it stands.
        """
        speed_mps = np.abs(ego.speed_mps)
        accel_mps2 = np.minimum(ego.accel_mps2, 0.0)
        brakes = accel_mps2 < 0
        stands_s = np.divide(-speed_mps, accel_mps2, out=np.full(len(speed_mps), np.inf), where=brakes)
        t = np.minimum(lead_s, stands_s[:, None])
        ahead = np.asarray(speed_mps[:, None] * t + np.where(brakes, accel_mps2, 0.0)[:, None] * t**2 / 2)
        one = np.zeros((1, 1), dtype=np.intp)
        x0, y0, cos0, sin0, _ = self.paths.along(one, ego.progress_m[:, None])
        x, y, cos, sin, _ = self.paths.along(one, ego.progress_m[:, None] + ahead)
        origin = complex(*self.paths.origin_m)
        here = (ego.x_m + 1j * ego.y_m)[:, None]
        left = ((here - origin - (x0 + 1j * y0)) * (cos0 - 1j * sin0)).imag
        facing = np.exp(1j * ego.yaw_rad)[:, None]
        travel = facing * np.where(ego.speed_mps < 0, -1.0, 1.0)[:, None]
        on = (np.abs(left) < ON_PATH_M) & ((travel * (cos0 - 1j * sin0)).real > ON_PATH_COS)
        along = np.where(on, cos + 1j * sin, travel)
        direction: Complex = np.asarray(along / np.abs(along), dtype=np.complex128)
        position = np.where(on, origin + x + 1j * y + 1j * left * direction, here + ahead * travel)
        turned = np.where(on, np.angle(direction * (cos0 - 1j * sin0)), 0.0)
        yaw = wrap_angle(ego.yaw_rad[:, None] + turned)
        off = KEEPING_SIGMA_M * np.minimum(lead_s / KEEPING_S, 1.0)
        sigma = np.broadcast_to(off[:, None], (*position.shape, 2))
        return ExpectedPaths(
            position, yaw, direction, sigma, np.broadcast_to(np.array(self.size_m[:2]), (len(position), 2))
        )

    def heights(self, progress_m: Array, reach_m: Array) -> Array:
        """Return the heights (C, 7), m, of the ego's center on the next `reach_m` (C,) of its path."""
        ahead = progress_m[:, None] + np.linspace(0.0, 1.0, 7) * reach_m[:, None]
        at_s = self.paths.times(np.zeros((1, 1), dtype=np.intp), ahead)
        return self._trajectory.heights(at_s.ravel()).reshape(at_s.shape)


# Of the errors along and across, so that a probability is exact to a hundredth; odd, so that one of them is no error.
QUANTILES = 9

CHUNK = 256  # pairs of ways that are compared at once
# Beyond the outermost quantile, which is 1.6 standard deviations off, so that nothing is missed by looking no
# farther.
REACH_SIGMA = 2.0

MIN_TRAVEL_M = 1e-6  # an ego that moves by less between leads stands


def expected_contacts(ego: ExpectedPaths, others: ExpectedPaths, lead_s: Array) -> tuple[Array, Array]:
    """Compare C ways of the ego with one of another agent each, at leads (H,).

    Returns the probabilities (C,) that they meet within the horizon, and the times (C,), s, until they do: as expected
    without error; where that does not meet, the median of the times of errors that do. Infinite where none does.

    The errors of an agent at different leads are one: who is faster than expected is so throughout. They are normal along and
    across its course, with those of the ego added, and each takes `QUANTILES` values of equal probability; the probability is
    the share of the pairs of values with which the boxes meet. Between leads both move straight, and the time is exact. A
    first contact does not count where the ego stands by then, or is hit from behind, which its braking would not help, nor
    where boxes overlap already.
    """
    probability, time = np.zeros(len(ego.size_m)), np.full(len(ego.size_m), np.inf)
    # Whether two ways come so near that their boxes may meet with any of the errors.
    radius = (np.hypot(*ego.size_m.T) + np.hypot(*others.size_m.T)) / 2
    step = np.abs(np.diff(others.position_m - ego.position_m, axis=1)).max(axis=1, initial=0.0)
    sigma = np.hypot(others.sigma_m, ego.sigma_m)
    room = radius + step + REACH_SIGMA * np.hypot(sigma[..., 0], sigma[..., 1]).max(axis=1)
    near = np.flatnonzero(np.asarray(np.abs(others.position_m - ego.position_m).min(axis=1) <= room))
    for begin in range(0, len(near), CHUNK):
        rows = near[begin : begin + CHUNK]
        times = _contact_times(ego.take(rows), others.take(rows), lead_s)
        met = np.isfinite(times)
        probability[rows] = met.mean(axis=1)
        middle = times[:, times.shape[1] // 2]
        some = met.any(axis=1)
        median = np.full(len(rows), np.inf)
        median[some] = np.nanmedian(np.where(met, times, np.nan)[some], axis=1)
        time[rows] = np.where(np.isfinite(middle), middle, median)
    return probability, time


def _contact_times(ego: ExpectedPaths, others: ExpectedPaths, lead_s: Array) -> Array:
    """Return for pairs (C,) and all errors (K,) the times (C, K) of the first contact, infinite without."""
    normal = NormalDist()
    values = np.array([normal.inv_cdf((k + 0.5) / QUANTILES) for k in range(QUANTILES)])
    along, across = np.repeat(values, QUANTILES), np.tile(values, QUANTILES)
    sigma = np.hypot(others.sigma_m, ego.sigma_m)[:, None]
    off = sigma[..., 0] * along[:, None] + 1j * sigma[..., 1] * across[:, None]
    apart = (others.position_m - ego.position_m)[:, None] + off * others.course[:, None]
    span = np.diff(lead_s)
    start, rate = apart[..., :-1], np.diff(apart, axis=-1) / span
    shape = start.shape
    own, other = (np.broadcast_to(_middle(w.yaw_rad)[:, None], shape).ravel() for w in (ego, others))
    sizes = (np.broadcast_to(w.size_m[:, None, None], (*shape, 2)).reshape(-1, 2) for w in (ego, others))
    flat, speed = start.ravel(), rate.ravel()
    enter, leave = touching(flat.real, flat.imag, speed.real, speed.imag, own, other, *sizes)
    enter = np.maximum(enter, 0.0)
    meets = (enter < leave) & (enter <= np.broadcast_to(span, shape).ravel())
    then = np.where(meets, enter, 0.0)
    travel = np.diff(ego.position_m, axis=1)
    forward = np.where((travel * np.exp(-1j * _middle(ego.yaw_rad))).real < 0, -1.0, 1.0)
    moves = np.broadcast_to((np.abs(travel) > MIN_TRAVEL_M)[:, None], shape)
    ahead = ((flat + then * speed) * np.exp(-1j * own)).real.reshape(shape) * forward[:, None]
    times = np.where(meets, then + np.broadcast_to(lead_s[:-1], shape).ravel(), np.inf).reshape(shape)
    first = times.argmin(axis=-1)[..., None]
    counts = (ahead > -ego.size_m[:, :1, None] / 2) & moves
    time, counts = (np.take_along_axis(c, first, axis=-1)[..., 0] for c in (times, counts))
    return np.where(counts & (time > 0), time, np.inf)


def _middle(yaw_rad: Array) -> Array:
    """Return the yaws (C, H - 1) in the middle between leads."""
    turn = np.angle(np.exp(1j * np.diff(yaw_rad, axis=1)))
    return np.asarray(yaw_rad[:, :-1] + turn / 2)
