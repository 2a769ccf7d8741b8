"""Where the ego and others are expected to be within the horizon of a warning."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.prediction.motion_table import Complex, MotionTable
from log2sim.prediction.prediction import DEFAULT_METHOD, predict_table
from log2sim.simulation.warnings.known import Known
from log2sim.tracking.forward import CONFIRMED_AGE_S

LEAD_STEP_S = 0.25
"""Between expected places; motion between them is straight, which is 3 cm off where a car turns with 4 m/s2 across."""

LEARNED_OBSERVATIONS = 11
"""A tracker's speed rests on about a second of observations; older ones say nothing about the present."""

Index = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class ExpectedPaths:
    """Expected motion of C boxes at the leads (H,).

    Attributes
    ----------
    position_m : (C, H) complex128, m
        Box centers x + iy, map frame.
    yaw_rad : (C, H) float64
    course : (C, H) complex128
        Unit vectors along which and across which `sigma_m` holds.
    sigma_m : (C, H, 2) float64, m
        Standard deviations along and across.
    size_m : (C, 2) float64, m
        Length and width.
    """

    position_m: Complex
    yaw_rad: Array
    course: Complex
    sigma_m: Array
    size_m: Array

    def take(self, index: NDArray[np.generic]) -> ExpectedPaths:
        """Return some of the boxes."""
        return ExpectedPaths(
            *(c[index] for c in (self.position_m, self.yaw_rad, self.course, self.sigma_m, self.size_m))
        )


def lead_times(horizon_s: float) -> Array:
    """Return leads (H,), s, from 0 to a horizon."""
    return np.linspace(0.0, horizon_s, int(np.ceil(horizon_s / LEAD_STEP_S - 1e-9)) + 1)


class ExpectedAgents:
    """Where agents (A,) are expected from any tick, by the observations up to then.

    Parameters
    ----------
    table : MotionTable
        States of the agents at all ticks.
    known : Known
        What is known of them at these ticks.
    interval_s : float, s
        Between observations.
    horizon_s : float, s

    Notes
    -----
    Movers are predicted by `log2sim.prediction` from the states at ticks at which they were observed. To its standard deviations
    comes that of a speed which a tracker has learned from few observations: of the slope of a line through n places with
    errors sigma, sigma sqrt(12 / (n (n^2 - 1))) per interval. Static agents stay where they are.
    """

    def __init__(self, table: MotionTable, known: Known, interval_s: float, horizon_s: float) -> None:
        self.table, self.known, self._interval_s = table, known, interval_s
        self.lead_s = lead_times(horizon_s)
        self.size_m = np.array([a.size_m[:2] for a in table.agents], dtype=np.float64).reshape(-1, 2)
        self._static = np.array([a.static for a in table.agents], dtype=bool)
        movers = np.flatnonzero(~self._static)
        self._mover = np.full(len(table.agents), -1, dtype=np.intp)
        self._mover[movers] = np.arange(len(movers))
        seen = _observed_table(table, known, movers)
        count = int(np.ceil((horizon_s + CONFIRMED_AGE_S) / LEAD_STEP_S))
        found = predict_table(seen, np.linspace(LEAD_STEP_S, count * LEAD_STEP_S, count), (DEFAULT_METHOD,))
        self._forecast = found.forecasts[DEFAULT_METHOD]
        self._row = np.full(seen.piece.shape, -1, dtype=np.intp)
        self._row[found.row, found.tick] = np.arange(len(found.row))

    def at(self, agent: Index, tick: Index) -> ExpectedPaths:
        """Return where agents (C,), known at ticks (C,), are expected at the leads from then on."""
        ways = self._standing(agent, tick)
        moving = np.flatnonzero(~self._static[agent])
        if len(moving):
            position, yaw, course, sigma = self._moving(agent[moving], tick[moving])
            ways.position_m[moving], ways.yaw_rad[moving] = position, yaw
            ways.course[moving], ways.sigma_m[moving] = course, sigma
        return ways

    def _standing(self, agent: Index, tick: Index) -> ExpectedPaths:
        t, source = self.table, self.known.source[agent, tick]
        wide = (len(agent), len(self.lead_s))
        position = np.where(self._static[agent], t.position_m[agent, source], 0.0)
        sigma = np.where(self._static[agent], t.sigma_m[agent, source], 0.0)
        return ExpectedPaths(
            np.repeat(position[:, None], wide[1], axis=1),
            np.repeat(t.yaw_rad[agent, source][:, None], wide[1], axis=1),
            np.ones(wide, dtype=complex),
            np.broadcast_to(sigma[:, None, None], (*wide, 2)).copy(),
            self.size_m[agent],
        )

    def _moving(self, agent: Index, tick: Index) -> tuple[Complex, Array, Complex, Array]:
        """Look forecasts up at the leads, which count from the last observation."""
        table, known = self.table, self.known
        source = known.source[agent, tick]
        row = self._row[self._mover[agent], source]
        lead = (tick - source)[:, None] * table.tick_s + self.lead_s
        here = table.position_m[agent, source][:, None]
        sigma0 = np.repeat(table.sigma_m[agent, source][:, None, None], 2, axis=2)
        f = self._forecast
        position = _at_leads(np.concatenate([here, f.position_m[row]], axis=1), lead)
        course = _at_leads(np.concatenate([f.course[row][:, :1], f.course[row]], axis=1), lead)
        sigma = _at_leads(np.concatenate([sigma0, f.sigma_m[row]], axis=1), lead)
        course = course / np.abs(course)
        yaw = table.yaw_rad[agent, source][:, None] + np.angle(course * f.course[row][:, :1].conj())
        count = np.clip(known.count[agent, source], 2, LEARNED_OBSERVATIONS)
        slope = np.sqrt(12.0 / (count * (count**2 - 1.0))) / self._interval_s
        drift = sigma0[:, 0, 0] * slope
        return position, yaw, course, np.sqrt(sigma**2 + (drift[:, None] * lead)[..., None] ** 2)


def _observed_table(table: MotionTable, known: Known, rows: Index) -> MotionTable:
    """Return some rows of a table with the states at ticks of observation alone; who was lost begins anew."""
    there = known.observed[rows] & table.present[rows]
    blank = np.where(there, 1.0, np.nan)
    return MotionTable(
        tuple(table.agents[k] for k in rows.tolist()), table.t_s, table.tick_s,
        np.where(there, table.position_m[rows], np.nan), np.where(there, table.velocity_mps[rows], np.nan),
        blank * table.yaw_rad[rows], blank * table.sigma_m[rows], there,
        np.where(there, _numbered(table.piece[rows], known.piece[rows]), -1),
    )  # fmt: skip


def _numbered(jumps: Index, pieces: Index) -> Index:
    """Return numbers (A, T) that differ where either piece number does."""
    return np.asarray(pieces * (int(jumps.max(initial=0)) + 1) + np.maximum(jumps, 0))


def _at_leads(values: NDArray[Any], lead_s: Array) -> NDArray[Any]:
    """Interpolate values (C, K, ...) that are `LEAD_STEP_S` apart, the first at 0, at leads (C, H)."""
    place = np.minimum(lead_s / LEAD_STEP_S, values.shape[1] - 1.0)
    k = np.minimum(place.astype(np.intp), values.shape[1] - 2)
    row = np.arange(len(values))[:, None]
    part = (place - k).reshape(*k.shape, *[1] * (values.ndim - 2))
    return np.asarray(values[row, k] + part * (values[row, k + 1] - values[row, k]))
