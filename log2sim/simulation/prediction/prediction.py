"""Short predictions of every agent at every tick, by several methods, with their spread."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import GROUP_OF, STANDSTILL_MPS, Scenario
from log2sim.errors import ConfigError
from log2sim.files.documents import short_repr
from log2sim.geometry import Array
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
from log2sim.simulation.prediction.paths import Paths, Seekers, follow, kind_of, locate


class Restlessness(NamedTuple):
    """Standard deviations of the acceleration along and across the course that does not follow from an agent's past."""

    along_mps2: float
    across_mps2: float


ACCELERATION_S = 2.0
"""For how long an acceleration lasts: drivers and pedestrians change what they do after one to three seconds."""

MOVING: Mapping[str, Restlessness] = {
    "vehicle": Restlessness(0.8, 0.6), "two_wheeler": Restlessness(0.7, 0.6), "pedestrian": Restlessness(0.35, 0.35),
    "other": Restlessness(0.8, 0.6),
}  # fmt: skip
WAITING: Mapping[str, Restlessness] = {
    "vehicle": Restlessness(0.5, 0.1), "two_wheeler": Restlessness(0.4, 0.1), "pedestrian": Restlessness(0.25, 0.15),
    "other": Restlessness(0.5, 0.1),
}  # fmt: skip
"""Of agents that stand: most stay, some start."""

WAITING_S = 10.0
"""Who has stood for as long is half as likely to start at once: the longer agents stand, the longer they go on to stand."""

USUAL_SPREAD_ERRORS = 5.0
"""How many errors of an agent's own past the values above count as."""

MIN_SCALE = 0.1
"""Of an agent's own variances to the usual ones: what was regular so far can still brake."""


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
    stands = speed < STANDSTILL_MPS
    patience = np.sqrt(WAITING_S / (WAITING_S + _lasting(stands, table) * table.tick_s))
    acceleration = np.where(stands[..., None], waiting * patience[..., None], moving)
    variance = drift_variance(lead_s)[:, None] * acceleration[:, :, None] ** 2
    return np.asarray(np.sqrt(table.sigma_m[..., None, None] ** 2 + variance))


def _lasting(state: NDArray[np.bool_], table: MotionTable) -> NDArray[np.intp]:
    """For how many ticks (A, T) a state has lasted; 0 where it is not so."""
    ticks = np.arange(state.shape[1])
    since = np.maximum.accumulate(np.where(~state | table.begins, ticks, 0), axis=1)
    return np.where(state, ticks - since, 0)


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
    sums = [_known_sums(np.where(known, v, 0.0), table, ticks) / ticks for v in (squared, 2.0)]
    usual = 2.0 * USUAL_SPREAD_ERRORS
    scale = np.sqrt(np.maximum((usual + sums[0]) / (usual + sums[1]), MIN_SCALE))
    return np.where(moves, scale, 1.0)


def _known_sums(value: Array, table: MotionTable, ticks: int) -> Array:
    """Sum values (A, T) within each piece, up to the tick after which each is known."""
    total = np.zeros_like(value)
    total[:, ticks:] = np.cumsum(value, axis=1)[:, : value.shape[1] - ticks] if ticks < value.shape[1] else 0.0
    start = np.maximum.accumulate(np.where(table.begins, np.arange(value.shape[1]), 0), axis=1)
    return np.asarray(total - np.take_along_axis(total, start, axis=1))


METHODS: Mapping[str, str] = {
    "velocity": "constant velocity",
    "turn": "constant speed and turn rate",
    "smoothed": "velocity and turn rate smoothed exponentially, constants weighed by the agent's past",
    "path": "smoothed speed along the path of another agent or a lane, where one is known; else as smoothed",
}
"""Methods of prediction by name, and what each expects an agent to keep."""

DEFAULT_METHOD = "path"
"""Where no path is known it is `smoothed`, and elsewhere it errs less."""

LEAD_STEP_S = 0.5
"""Interval of predicted positions: half a second as in nuScenes' prediction task."""

HORIZON_LIMITS_S = (0.1, 10.0)
"""Within a tick there is nothing to predict; beyond 10 s no agent keeps to what it did."""


PATH_SIGMA_M = 0.5
"""Standard deviation of the lateral distance of two agents on one path: drivers keep to a lane within some 0.3 m each. At short
leads an agent's own motion tells its place more exactly."""


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

    Parameters
    ----------
    horizon_s : float, s
        Longest lead.
    methods : sequence of str
        Of `METHODS`; `path` knows the lanes of the scenario that are between markings.

    Raises
    ------
    ConfigError
        For a horizon that is not from 0.1 to 10 s, or an unknown method.

    Notes
    -----
    Only states up to a tick are used. Those of a reconstruction were smoothed over the whole log, so that they depend a little
    of what came next: predictions by a system that measures while it drives are worse.
    """
    found = () if scenario.map_features is None else scenario.map_features.lanes
    # Lanes out of paths would know where agents will go.
    lanes = [lane.points_m[:, :2] for lane in found if lane.inferred_from != "paths"]
    return predict_table(table_of(scenario, TICK_S), leads_of(horizon_s), methods, lanes)


def predict_table(
    table: MotionTable, lead_s: Array, methods: Sequence[str] = tuple(METHODS), lanes: Sequence[Array] = ()
) -> Predictions:
    """Predict agents from their states at ticks, for leads (H,), s; see `predict_scenario`."""
    for name in methods:
        if name not in METHODS:
            raise ConfigError(f"method: '{name}' is not known; known: {', '.join(METHODS)}")
    present = _Present(table, *np.nonzero(table.present))
    smooth = smooth_motion(table)
    latest, velocity = present.of(table.velocity_mps), present.of(smooth.velocity_mps)
    motions = {
        "velocity": (latest, np.zeros(len(latest))),
        "turn": (latest, present.of(turn_rates(table))),
        "smoothed": (velocity, present.of(smooth.turn_radps)),
    }
    # The last lead is that by which the past is judged.
    leads = np.append(lead_s, PROOF_S)
    known = np.zeros(len(latest), dtype=bool)
    forecasts = {}
    for name in methods:
        way = _turn_on(present, *motions[name if name in motions else "smoothed"], leads)
        if name == "path":
            paths = Paths.driven(table, lanes)
            way, known = _drawn_to_paths(present, way, np.abs(velocity), paths, leads)
        forecasts[name] = _with_sigma(present, way, lead_s)
    return Predictions(table, lead_s, present.row, present.tick, forecasts, present.of(smooth.constants_s), known)


class _Present(NamedTuple):
    """Where agents are present in a table: row (N,) and tick (N,)."""

    table: MotionTable
    row: NDArray[np.intp]
    tick: NDArray[np.intp]

    def of(self, column: NDArray[Any]) -> NDArray[Any]:
        """Take the values (N, ...) of a column (A, T, ...)."""
        return column[self.row, self.tick]


class _Way(NamedTuple):
    """Predicted positions and courses (N, H)."""

    position_m: Complex
    course: Complex


def _turn_on(present: _Present, velocity: Complex, turn: Array, lead_s: Array) -> _Way:
    """Move on with velocities (N,) that turn at rates (N,)."""
    speed = np.abs(velocity)
    course = np.exp(1j * present.of(present.table.yaw_rad))
    fast = speed > MIN_COURSE_MPS
    course[fast] = velocity[fast] / speed[fast]
    position = present.of(present.table.position_m)[:, None] + displacement(velocity[:, None], turn[:, None], lead_s)
    return _Way(position, course[:, None] * np.exp(1j * turn[:, None] * lead_s))


def _drawn_to_paths(
    present: _Present, way: _Way, speed_mps: Array, paths: Paths, lead_s: Array
) -> tuple[_Way, NDArray[np.bool_]]:
    """Average a way with that along a path by their variances across; and tell where a path is known (N,)."""
    table = present.table
    kinds = np.array([kind_of(a.category) for a in table.agents], dtype=np.intp)
    seekers = Seekers(
        present.of(table.position_m),
        np.where(speed_mps > MIN_COURSE_MPS, way.course[:, 0], np.nan),
        table.t_s[present.tick],
        present.row,
        kinds[present.row],
    )
    point, heading = follow(paths, locate(paths, seekers), speed_mps, lead_s)
    known = np.isfinite(point)
    free_variance = present.of(usual_sigma(table, lead_s))[..., 1] ** 2
    share = np.where(known, free_variance / (free_variance + PATH_SIGMA_M**2), 0.0)
    position = way.position_m + share * np.where(known, point - way.position_m, 0.0)
    course = way.course + share * np.where(known, heading - way.course, 0.0)
    return _Way(position, course / np.abs(course)), np.asarray(known.any(axis=1))


def _with_sigma(present: _Present, way: _Way, lead_s: Array) -> Forecast:
    """Add standard deviations to a way whose last lead is `PROOF_S`."""
    table, shape = present.table, present.table.position_m.shape
    ticks = round(PROOF_S / table.tick_s)
    usual = usual_sigma(table, np.append(lead_s, PROOF_S))
    later, observed = table.later(ticks)
    error, course = np.full(shape, np.nan, dtype=complex), np.ones(shape, dtype=complex)
    error[present.row, present.tick] = way.position_m[:, -1] - present.of(later)
    course[present.row, present.tick] = way.course[:, -1]
    scale = own_scale(table, np.where(observed, error, np.nan), course, usual[:, :, -1], ticks)
    sigma = present.of(usual)[:, :-1] * present.of(scale)[:, None, None]
    return Forecast(way.position_m[:, :-1], way.course[:, :-1], sigma)
