"""Short predictions of every agent at every tick, by several methods, with their spread, and how far they are off."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import CATEGORIES, EGO, GROUP_OF, STANDSTILL_MPS, Scenario
from log2sim.errors import ConfigError
from log2sim.files.documents import rounded, short_repr
from log2sim.geometry import Array
from log2sim.geometry.statistics import CHI2_2DOF_95
from log2sim.simulation.prediction.motion_table import (
    MIN_COURSE_MPS,
    PROOF_S,
    TICK_S,
    Complex,
    MotionTable,
    displacement,
    smooth_motion,
    table_of,
    turn_rates,
)

Index = NDArray[np.intp]

SPACING_M = 0.5  # of the points of a path: the middle of a chord on a circle of 6 m is 5 mm off
MAX_ASIDE_M = 1.5  # an agent farther from a path follows another: lanes are 3 m wide or more
# An agent is on a path when their directions differ by less than 26 degrees; beyond, it leaves or crosses it.
MIN_COS = 0.9
TURN_M = 6.0  # directions that differ by a radian count as much as so many meters
NEIGHBORS = 24  # points that are looked at for each agent: 3 m of its own path, and those of several others
MAX_BEYOND_M = 2.0  # how far a path is continued straight on
# Kinds of paths: agents follow their own kind, and riders vehicles too; where riders or people turn off, no vehicle
# may.
VEHICLES, RIDERS, WALKERS = range(3)


def kind_of(category: str) -> int:
    """Return whether a category goes as `VEHICLES`, `RIDERS` or `WALKERS` do."""
    return {"two_wheeler": RIDERS, "pedestrian": WALKERS}.get(GROUP_OF[category], VEHICLES)


@dataclass(frozen=True, eq=False)
class Paths:
    """N points of paths, one path after the other."""

    point_m: Complex  # (N,) m, map frame
    direction: Complex  # (N,) unit vectors of travel
    distance_m: Array  # (N,) along the path; of the next path it goes on from the end of the one before: it rises
    path: NDArray[np.intp]  # (N,)
    known_s: Array  # (N,) s, when an agent was there; minus infinity on lanes, which are known beforehand
    agent: NDArray[np.intp]  # (N,) row of the agent that was there; -1 on lanes
    kind: NDArray[np.intp]  # (N,) who was there, see `kind_of`; `VEHICLES` on lanes

    @classmethod
    def driven(cls, table: MotionTable, lanes: Sequence[Array] = ()) -> Self:
        """Collect where agents went, and lanes (K, 2), m, map frame, in their direction of travel."""
        parts = [
            (*_resampled(line[:, 0] + 1j * line[:, 1], np.full(len(line), -np.inf)), -1, VEHICLES) for line in lanes
        ]
        for k, agent in enumerate(table.agents):
            there = np.flatnonzero(table.present[k] & (np.abs(table.velocity_mps[k]) > MIN_COURSE_MPS))
            for run in np.split(there, np.flatnonzero(np.diff(table.piece[k, there])) + 1):
                if len(run) > 1:
                    part = _resampled(table.position_m[k, run], table.t_s[run])
                    parts.append((*part, k, kind_of(agent.category)))
        parts = [part for part in parts if len(part[0]) > 1]
        counts = [len(part[0]) for part in parts]
        # The direction of a point is that of the step to it; of the first, of the step from it.
        steps = [np.diff(part[0])[np.maximum(np.arange(-1, len(part[0]) - 1), 0)] for part in parts]
        starts = np.cumsum([0.0, *(part[1][-1] + SPACING_M for part in parts)])
        return cls(
            np.concatenate([np.zeros(0, dtype=complex), *(part[0] for part in parts)]),
            np.concatenate([np.zeros(0, dtype=complex), *(step / np.abs(step) for step in steps)]),
            np.concatenate([np.zeros(0), *(start + part[1] for start, part in zip(starts, parts))]),
            np.repeat(np.arange(len(parts)), counts),
            np.concatenate([np.zeros(0), *(part[2] for part in parts)]),
            np.repeat(np.array([part[3] for part in parts], dtype=np.intp), counts),
            np.repeat(np.array([part[4] for part in parts], dtype=np.intp), counts),
        )


def follow(
    paths: Paths, table: MotionTable, at: tuple[Index, ...], course: Complex, speed_mps: Array, lead_s: Array
) -> tuple[Complex, Complex]:
    """Compute positions, m, and courses, (N, H) complex128, of agents along the paths that they are on, after leads (H,), s.

    Each agent, at a row and tick of the table `at` (N,), (N,), follows a path that others of its kind had made by then, or a
    lane. `course` (N,): unit vectors, NaN where it is unknown. NaN without a path, and beyond where it was known.
    """
    from scipy.spatial import cKDTree

    point = np.full((len(course), len(lead_s)), np.nan, dtype=complex)
    heading, count, asked = point.copy(), min(NEIGHBORS, len(paths.point_m)), np.flatnonzero(np.isfinite(course))
    if not count or not len(asked):
        return point, heading
    agent, t_s = at[0][asked, None], table.t_s[at[1]][asked, None]
    position, direction = table.position_m[at][asked, None], course[asked, None]
    tree = cKDTree(_features(paths.point_m, paths.direction))
    _, near = tree.query(_features(position[:, 0], direction[:, 0]), count, distance_upper_bound=TURN_M)
    near = near.reshape(-1, count)
    row = np.minimum(near, len(paths.point_m) - 1)
    offset = (position - paths.point_m[row]) * paths.direction[row].conj()
    usable = (near < len(paths.point_m)) & (paths.known_s[row] <= t_s) & (paths.agent[row] != agent)
    kind = np.array([kind_of(a.category) for a in table.agents], dtype=np.intp)[agent]
    usable &= (paths.kind[row] == kind) | (paths.kind[row] == VEHICLES) & (kind == RIDERS)
    usable &= (np.abs(offset.imag) < MAX_ASIDE_M) & (np.abs(offset.real) <= SPACING_M)
    usable &= (direction * paths.direction[row].conj()).real > MIN_COS
    pick = np.flatnonzero(usable.any(axis=1)), usable.argmax(axis=1)[usable.any(axis=1)]
    on, row, offset, t_s = asked[pick[0]], row[pick], offset[pick], t_s[pick[0], 0]
    # Up to where each path was known at these times.
    late_s = np.nan_to_num(paths.known_s, neginf=0.0)
    span, first_s = float(np.ptp(late_s)) + 1.0, late_s.min()
    key = paths.path * span + np.where(np.isfinite(paths.known_s), paths.known_s - first_s, 0.0)
    wanted = paths.path[row] * span + np.clip(t_s - first_s, 0.0, span - 0.5)
    end = paths.distance_m[np.searchsorted(key, wanted, side="right") - 1][:, None]
    ahead = (paths.distance_m[row] + offset.real)[:, None] + speed_mps[on, None] * lead_s
    inside = np.clip(ahead, paths.distance_m[row, None], end)
    way = paths.direction[np.searchsorted(paths.distance_m, inside)]
    place = np.interp(inside, paths.distance_m, paths.point_m)
    place = place + way * (1j * offset.imag[:, None] + ahead - inside)
    known = ahead <= end + MAX_BEYOND_M
    point[on], heading[on] = np.where(known, place, np.nan), np.where(known, way, np.nan)
    return point, heading


def _features(position_m: Complex, direction: Complex) -> Array:
    """Coordinates (N, 4), m, whose distances weigh places and directions."""
    turned = TURN_M * direction
    return np.column_stack([position_m.real, position_m.imag, turned.real, turned.imag])


def _resampled(point_m: Complex, known_s: Array) -> tuple[Complex, Array, Array]:
    """Points `SPACING_M` apart on a polyline, their distances along it, and when each was reached."""
    way = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(point_m)))])
    moved = np.concatenate([[True], np.diff(way) > 0])
    way, point_m, known_s = way[moved], point_m[moved], known_s[moved]
    at = np.arange(0.0, way[-1], SPACING_M)
    known_s = known_s[np.minimum(np.searchsorted(way, at), len(way) - 1)]
    if len(known_s) > 1:
        known_s[0] = known_s[1]  # its direction is that of the step to the second point
    return np.interp(at, way, point_m), at, known_s


class Restlessness(NamedTuple):
    """Standard deviations of the acceleration along and across the course that does not follow from an agent's past."""

    along_mps2: float
    across_mps2: float


# For how long an acceleration lasts: drivers and pedestrians change what they do after one to three seconds.
ACCELERATION_S = 2.0
MOVING: Mapping[str, Restlessness] = {
    "vehicle": Restlessness(0.8, 0.6), "two_wheeler": Restlessness(0.7, 0.6), "pedestrian": Restlessness(0.35, 0.35),
    "other": Restlessness(0.8, 0.6),
}  # fmt: skip
WAITING: Mapping[str, Restlessness] = {
    "vehicle": Restlessness(0.5, 0.1), "two_wheeler": Restlessness(0.4, 0.1), "pedestrian": Restlessness(0.25, 0.15),
    "other": Restlessness(0.5, 0.1),
}  # fmt: skip
"""Of agents that stand: most stay, some start."""

# Who has stood for as long is half as likely to start at once: the longer agents stand, the longer they go on to stand.
WAITING_S = 10.0
USUAL_SPREAD_ERRORS = 5.0  # how many errors of an agent's own past the values above count as
MIN_SCALE = 0.1  # of an agent's own variances to the usual ones: what was regular so far can still brake


def drift_variance(lead_s: Array) -> Array:
    """Compute the variance, m2, of the way after leads that an acceleration of 1 m/s2 makes, which lasts exponentially long.

    Twice integrated Ornstein-Uhlenbeck noise (Singer, "Estimating optimal tracking filter performance for manned maneuvering
    targets", 1970): it grows as lead^4 / 4 within `ACCELERATION_S` and as lead^3 beyond.
    """
    r = np.asarray(lead_s, dtype=np.float64) / ACCELERATION_S
    series = r**4 / 4 - r**5 / 15 + r**6 / 72  # cancels below in the closed form
    closed = 2 * r**3 / 3 - r**2 + 2 - 2 * (1 + r) * np.exp(-r)
    return np.asarray(ACCELERATION_S**4 * np.where(r < 0.05, series, closed))


def usual_sigma(table: MotionTable, lead_s: Array) -> Array:
    """Compute usual standard deviations (A, T, H, 2), m, along and across the course, for agents of each kind."""
    speed = np.abs(table.velocity_mps)
    groups = [GROUP_OF[a.category] for a in table.agents]
    moving, waiting = (
        np.array([kind[g] for g in groups], dtype=np.float64).reshape(-1, 1, 2) for kind in (MOVING, WAITING)
    )
    stands, ticks = speed < STANDSTILL_MPS, np.arange(speed.shape[1])
    since = np.maximum.accumulate(np.where(~stands | table.begins, ticks, 0), axis=1)
    stood_s = np.where(stands, ticks - since, 0) * table.tick_s
    patience = np.sqrt(WAITING_S / (WAITING_S + stood_s))
    acceleration = np.where(stands[..., None], waiting * patience[..., None], moving)
    variance = drift_variance(lead_s)[:, None] * acceleration[:, :, None] ** 2
    return np.asarray(np.sqrt(table.sigma_m[..., None, None] ** 2 + variance))


def own_scale(table: MotionTable, error_m: Complex, course: Complex, sigma_m: Array, ticks: int) -> Array:
    """Compute by how much each agent's motion was more regular than usual so far: factors (A, T) on its standard deviations.

    `error_m` (A, T): of the prediction at each tick for `ticks` later, m; NaN where unknown. `course` (A, T): unit vectors of
    the predicted courses. `sigma_m` (A, T, 2): usual standard deviations then. Errors closer to each other than `ticks`, after
    which they are known, count as one. Times at which an agent stood do not count, nor does its factor differ from 1: they say
    nothing about how it drives.
    """
    off = error_m * course.conj()
    squared = (off.real / sigma_m[..., 0]) ** 2 + (off.imag / sigma_m[..., 1]) ** 2
    moves = np.abs(np.where(table.present, table.velocity_mps, 0.0)) >= STANDSTILL_MPS
    known = np.isfinite(squared) & moves
    # Sums within each piece, up to the tick after which each error is known.
    ticks_on = np.arange(squared.shape[1])
    start = np.maximum.accumulate(np.where(table.begins, ticks_on, 0), axis=1)
    sums = []
    for value in (squared, 2.0):
        total = np.zeros_like(squared)
        total[:, ticks:] = np.cumsum(np.where(known, value, 0.0), axis=1)[:, : max(len(ticks_on) - ticks, 0)]
        sums.append((total - np.take_along_axis(total, start, axis=1)) / ticks)
    usual = 2.0 * USUAL_SPREAD_ERRORS
    scale = np.sqrt(np.maximum((usual + sums[0]) / (usual + sums[1]), MIN_SCALE))
    return np.where(moves, scale, 1.0)


METHODS: Mapping[str, str] = {
    "velocity": "constant velocity",
    "turn": "constant speed and turn rate",
    "smoothed": "velocity and turn rate smoothed exponentially, constants weighed by the agent's past",
    "path": "smoothed speed along the path of another agent or a lane, where one is known; else as smoothed",
}
"""Methods of prediction by name, and what each expects an agent to keep."""

DEFAULT_METHOD = "path"  # where no path is known it is `smoothed`, and elsewhere it errs less
LEAD_STEP_S = 0.5  # interval of predicted positions: half a second as in nuScenes' prediction task
HORIZON_LIMITS_S = (0.1, 10.0)  # within a tick there is nothing to predict; beyond 10 s no agent keeps to what it did


# Standard deviation of the lateral distance of two agents on one path: drivers keep to a lane within some 0.3 m each.
# At short leads an agent's own motion tells its place more exactly.
PATH_SIGMA_M = 0.5


@dataclass(frozen=True, eq=False)
class Forecast:
    """Predictions of N agent-ticks by one method."""

    __repr__ = short_repr

    position_m: Complex  # (N, H) predicted box centers x + iy, m, map frame
    course: Complex  # (N, H) unit vectors of the predicted courses; of the heading where the agent stands
    sigma_m: Array  # (N, H, 2) standard deviations along and across the course


@dataclass(frozen=True, eq=False)
class Predictions:
    """N predictions, of all agents at all ticks at which they are present, for H leads."""

    __repr__ = short_repr

    table: MotionTable  # what they start from
    lead_s: Array  # (H,)
    row: NDArray[np.intp]  # (N,) agents, as indices of `table.agents`; the ticks of one agent follow each other
    tick: NDArray[np.intp]  # (N,) indices of `table.t_s`
    forecasts: Mapping[str, Forecast]  # by the names of `METHODS`
    constants_s: Array  # (N, 2) time constants of velocity and turn rate that the past of the agent chose
    on_path: NDArray[np.bool_]  # (N,) where `path` knows one

    def rows_of(self, agent: str) -> NDArray[np.intp]:
        """Return the indices (K,) of the predictions of an agent, in order of time; none for an unknown one."""
        k = next((k for k, a in enumerate(self.table.agents) if a.id == agent), -1)
        return np.flatnonzero(self.row == k)


def leads_of(horizon_s: float) -> Array:
    """Return the leads (H,), s, up to a horizon, which is rounded to ticks: every `LEAD_STEP_S`, and the horizon itself.

    Raises `ConfigError` for a horizon outside `HORIZON_LIMITS_S`.
    """
    low, high = HORIZON_LIMITS_S
    if not low <= horizon_s <= high:
        raise ConfigError(f"horizon: {horizon_s:g} s, expected {low:g} to {high:g} s")
    horizon_s = round(horizon_s / TICK_S) * TICK_S
    leads = np.arange(1, math.floor(horizon_s / LEAD_STEP_S + 1e-6) + 1) * LEAD_STEP_S
    ends = len(leads) > 0 and math.isclose(leads[-1], horizon_s, abs_tol=1e-6)
    return np.asarray(leads if ends else np.append(leads, horizon_s))


def predict_scenario(
    scenario: Scenario, horizon_s: float = 3.0, *, methods: Sequence[str] = tuple(METHODS)
) -> Predictions:
    """Predict where each agent of a scenario will be, at every tick and from its states up to then.

    `horizon_s`: longest lead, from 0.1 to 10 s. `methods`: of `METHODS`; `path` knows the lanes of the scenario that are between
    markings. Raises `ConfigError` for any other.

    Only states up to a tick are used. Those of a reconstruction were smoothed over the whole log, so that they depend a little
    of what came next: predictions by a system that measures while it drives are worse.
    """
    found = () if scenario.map_features is None else scenario.map_features.lanes
    # Lanes out of paths would know where agents will go.
    lanes = [lane.points_m[:, :2] for lane in found if lane.inferred_from != "paths"]
    return predict_table(table_of(scenario), leads_of(horizon_s), methods, lanes)


def predict_table(
    table: MotionTable, lead_s: Array, methods: Sequence[str] = tuple(METHODS), lanes: Sequence[Array] = ()
) -> Predictions:
    """Predict agents from their states at ticks, for leads (H,), s; see `predict_scenario`."""
    for name in methods:
        if name not in METHODS:
            raise ConfigError(f"method: '{name}' is not known; known: {', '.join(METHODS)}")
    at = row, tick = np.nonzero(table.present)
    smooth = smooth_motion(table)
    latest, smoothed = table.velocity_mps[at], (smooth.velocity_mps[at], smooth.turn_radps[at])
    motions = {"velocity": (latest, np.zeros(len(latest))), "turn": (latest, turn_rates(table)[at])}
    # The last lead is that by which the past is judged.
    leads, ticks = np.append(lead_s, PROOF_S), round(PROOF_S / table.tick_s)
    usual, (later, observed) = usual_sigma(table, leads), table.later(ticks)
    known = np.zeros(len(latest), dtype=bool)
    forecasts = {}
    for name in methods:
        velocity, turn = motions.get(name, smoothed)
        speed, heading = np.abs(velocity), np.exp(1j * table.yaw_rad[at])
        fast = speed > MIN_COURSE_MPS
        heading[fast] = velocity[fast] / speed[fast]
        position = table.position_m[at][:, None] + displacement(velocity[:, None], turn[:, None], leads)
        course = heading[:, None] * np.exp(1j * turn[:, None] * leads)
        if name == "path":  # averaged with the way along a path by their variances across
            seen = np.where(fast, course[:, 0], np.nan)
            point, direction = follow(Paths.driven(table, lanes), table, at, seen, speed, leads)
            there, free = np.isfinite(point), usual[at][..., 1] ** 2
            share = np.where(there, free / (free + PATH_SIGMA_M**2), 0.0)
            position = position + share * np.where(there, point - position, 0.0)
            course = course + share * np.where(there, direction - course, 0.0)
            course, known = course / np.abs(course), np.asarray(there.any(axis=1))
        error, judged = np.full(later.shape, np.nan, dtype=complex), np.ones(later.shape, dtype=complex)
        error[at], judged[at] = position[:, -1] - later[at], course[:, -1]
        scale = own_scale(table, np.where(observed, error, np.nan), judged, usual[:, :, -1], ticks)
        sigma = usual[at][:, :-1] * scale[at][:, None, None]
        forecasts[name] = Forecast(position[:, :-1], course[:, :-1], sigma)
    return Predictions(table, lead_s, row, tick, forecasts, smooth.constants_s[at], known)


MOTIONS = ("moving", "standing")  # whether an agent is faster than `STANDSTILL_MPS` when it is predicted


def measure_predictions(predictions: Predictions) -> list[dict[str, Any]]:
    """Return the `figures` of a document of `schemas/prediction-1.json`, by kind of agent and motion.

    Compared with the trajectories of their agents are ticks at which an agent was observed, with positions at which it was
    observed too. Agents that the scenario says never move are left out: it keeps one pose for each, so that nothing can be off.
    ADE is the mean distance over all leads up to one, FDE the distance at it (Pellegrini et al., ICCV 2009). NEES is the mean
    squared error over the squared sigma for each axis, 1 when sigmas are honest.
    """
    table, row, tick = predictions.table, predictions.row, predictions.tick
    # Where agents were (N, H) at the predicted times, and whether they were observed then and at the prediction.
    truth = np.full((len(row), len(predictions.lead_s)), np.nan, dtype=complex)
    seen = np.zeros(truth.shape, dtype=bool)
    for h, lead in enumerate(predictions.lead_s):
        position, observed = table.later(round(lead / table.tick_s))
        truth[:, h], seen[:, h] = position[row, tick], observed[row, tick]
    category = table.category[row]
    is_ego = np.array([a.id == EGO for a in table.agents], dtype=bool)[row]
    mobile = ~np.array([a.static for a in table.agents], dtype=bool)[row]
    moving = np.abs(table.velocity_mps[row, tick]) >= STANDSTILL_MPS
    kinds: list[tuple[str, Any]] = [("all", ~is_ego), *((c, ~is_ego & (category == c)) for c in CATEGORIES)]
    out = []
    for name, chosen in [*kinds, ("ego", is_ego), ("on a path", predictions.on_path)]:
        for motion, there in zip(MOTIONS, (moving, ~moving)):
            rows, methods = np.flatnonzero(chosen & mobile & there), {}
            for method, forecast in predictions.forecasts.items():
                error = (truth[rows] - forecast.position_m[rows]) * forecast.course[rows].conj()
                figures = _figures(predictions, error, forecast, rows, seen[rows])
                if figures:
                    methods[method] = figures
            if methods:
                out.append({"agents": name, "motion": motion, "methods": methods})
    return out


def _figures(
    predictions: Predictions,
    error: NDArray[np.complex128],
    forecast: Forecast,
    rows: NDArray[np.intp],
    seen: NDArray[np.bool_],
) -> list[dict[str, Any]]:
    """Compute the figures of errors (K, H) in the frames of the predicted courses; one entry for each lead with any."""
    out = []
    distance, lead_s = np.abs(error), predictions.lead_s
    whole = np.isclose(lead_s, np.rint(lead_s)) | (np.arange(len(lead_s)) == len(lead_s) - 1)
    for h in np.flatnonzero(whole).tolist():  # whole seconds and the horizon
        there = seen[:, h]
        if not there.any():
            continue
        sigma = forecast.sigma_m[rows[there], h]
        off = np.stack([error[there, h].real, error[there, h].imag], axis=-1)
        known = (sigma > 0).all(axis=1)
        squared = ((off[known] / sigma[known]) ** 2).sum(axis=1)
        upto = seen[there, : h + 1]
        ade_m, fde_m = distance[there, : h + 1][upto].mean(), distance[there, h].mean()
        nees, within = (squared.mean() / 2, (squared < CHI2_2DOF_95).mean()) if known.any() else (None, None)
        agents = len(np.unique(predictions.row[rows[there]]))
        figures = {"ade_m": ade_m, "fde_m": fde_m, "nees": nees, "within_95": within}
        out.append({
            "lead_s": round(float(lead_s[h]), 3), "ticks": int(there.sum()), "agents": agents,
            **{key: None if value is None else rounded(float(value), 4) for key, value in figures.items()},
        })  # fmt: skip
    return out


VERSION = 1

_DIGITS = 3


def prediction_document(
    scenario: Scenario, predictions: Predictions, *, with_positions: bool = False
) -> dict[str, Any]:
    """Return the document of `schemas/prediction-1.json`; the predicted positions only where asked for."""
    table, agents, positions = predictions.table, [], []
    for agent in table.agents:
        rows = predictions.rows_of(agent.id)
        # The time constants that its whole past chose; null without predictions, or for infinity.
        chosen = predictions.constants_s[rows[-1]] if len(rows) else np.full(2, np.inf)
        velocity_s, turn_s = (float(c) if np.isfinite(c) else None for c in chosen)
        agents.append({
            "id": agent.id, "category": agent.category, "ticks": len(rows), "velocity_constant_s": velocity_s,
            "turn_constant_s": turn_s,
        })  # fmt: skip
        methods = {}
        for name, forecast in predictions.forecasts.items() if with_positions else ():  # a row a tick, a column a lead
            position, sigma = forecast.position_m[rows], forecast.sigma_m[rows]
            columns = {
                "x_m": position.real, "y_m": position.imag, "course_rad": np.angle(forecast.course[rows]),
                "sigma_along_m": sigma[:, :, 0], "sigma_across_m": sigma[:, :, 1],
            }  # fmt: skip
            methods[name] = {key: np.round(values, _DIGITS).tolist() for key, values in columns.items()}
        t_s = np.round(table.t_s[predictions.tick[rows]], _DIGITS).tolist()
        positions.append({"id": agent.id, "t_s": t_s, "methods": methods})
    document = {
        "prediction_version": VERSION, "scenario": scenario.name, "scenario_sha256": scenario.digest,
        "tick_s": table.tick_s, "lead_s": [round(float(lead), _DIGITS) for lead in predictions.lead_s],
        "methods": {name: METHODS[name] for name in predictions.forecasts}, "agents": agents,
        "figures": measure_predictions(predictions),
    }  # fmt: skip
    return {**document, "predictions": positions} if with_positions else document


def format_figures(document: dict[str, Any]) -> str:
    """Format the figures of a document: a line for each kind of agent, motion and method."""
    lead_s = sorted({f["lead_s"] for entry in document["figures"] for m in entry["methods"].values() for f in m})
    if not lead_s:
        return "nothing to compare with: no agent is observed for a second or longer"
    heads = [f"{name} {lead:g} s" for name in ("ADE", "FDE") for lead in lead_s]
    cells = [["errors in m", "method", *heads, "NEES", "in 95 %", "ticks"]]
    for entry in document["figures"]:
        name = f"{entry['agents']}, {entry['motion']}"
        for method, figures in entry["methods"].items():
            at = {f["lead_s"]: f for f in figures}
            errors = [f"{at[s][key]:.2f}" if s in at else "-" for key in ("ade_m", "fde_m") for s in lead_s]
            last = figures[-1]
            honest = ["-" if last[key] is None else f"{last[key]:.2f}" for key in ("nees", "within_95")]
            cells.append([name, method, *errors, *honest, str(last["ticks"])])
            name = ""
    widths = [max(len(row[k]) for row in cells) for k in range(len(cells[0]))]
    return "\n".join(
        "  ".join([*(c.ljust(w) for c, w in zip(row[:2], widths)), *(c.rjust(w) for c, w in zip(row[2:], widths[2:]))])
        for row in cells
    )
