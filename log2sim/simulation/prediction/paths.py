"""Paths that agents may follow: where others of their kind went before, or lanes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import GROUP_OF
from log2sim.geometry import Array
from log2sim.simulation.prediction.motion_table import MIN_COURSE_MPS, Complex, MotionTable

SPACING_M = 0.5
"""Of the points of a path: the middle of a chord on a circle of 6 m is 5 mm off."""

MAX_ASIDE_M = 1.5
"""An agent farther from a path follows another: lanes are 3 m wide or more."""

MIN_COS = 0.9
"""An agent is on a path when their directions differ by less than 26 degrees; beyond, it leaves or crosses it."""

TURN_M = 6.0
"""Directions that differ by a radian count as much as so many meters."""

NEIGHBORS = 24
"""Points that are looked at for each agent: 3 m of its own path, and those of several others."""

MAX_BEYOND_M = 2.0
"""How far a path is continued straight on."""

VEHICLES, RIDERS, WALKERS = range(3)
"""Kinds of paths: agents follow their own kind, and riders vehicles too; where riders or people turn off, no vehicle may."""


def kind_of(category: str) -> int:
    """Return whether a category goes as `VEHICLES`, `RIDERS` or `WALKERS` do."""
    return {"two_wheeler": RIDERS, "pedestrian": WALKERS}.get(GROUP_OF[category], VEHICLES)


@dataclass(frozen=True, eq=False)
class Paths:
    """N points of paths, one path after the other."""

    point_m: Complex  # (N,) m, map frame
    direction: Complex  # (N,) unit vectors of travel
    distance_m: (
        Array  # (N,) along the path; of the next path it goes on from the end of the one before, so that it rises
    )
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
        starts = np.cumsum([0.0, *(part[1][-1] + SPACING_M for part in parts)])
        return cls(
            np.concatenate([np.zeros(0, dtype=complex), *(part[0] for part in parts)]),
            np.concatenate([np.zeros(0, dtype=complex), *(_directions(part[0]) for part in parts)]),
            np.concatenate([np.zeros(0), *(start + part[1] for start, part in zip(starts, parts))]),
            np.repeat(np.arange(len(parts)), counts),
            np.concatenate([np.zeros(0), *(part[2] for part in parts)]),
            np.repeat(np.array([part[3] for part in parts], dtype=np.intp), counts),
            np.repeat(np.array([part[4] for part in parts], dtype=np.intp), counts),
        )

    def ends_at(self, row: NDArray[np.intp], t_s: Array) -> Array:
        """Compute up to where the paths of points (Q,) were known at times (Q,): `distance_m` (Q,)."""
        late_s = np.nan_to_num(self.known_s, neginf=0.0)
        span = float(np.ptp(late_s)) + 1.0 if len(late_s) else 1.0
        key = self.path * span + np.where(np.isfinite(self.known_s), self.known_s - late_s.min(), 0.0)
        asked = self.path[row] * span + np.clip(t_s - late_s.min(), 0.0, span - 0.5)
        return np.asarray(self.distance_m[np.searchsorted(key, asked, side="right") - 1])


@dataclass(frozen=True, eq=False)
class Places:
    """Where Q agents are on paths."""

    row: NDArray[np.intp]  # (Q,) of the nearest point; -1 where there is no path
    distance_m: Array  # (Q,) along the path
    aside_m: Array  # (Q,) to the left of it
    end_m: Array  # (Q,) up to where the path was known


@dataclass(frozen=True, eq=False)
class Seekers:
    """Q agents that look for the paths that they are on."""

    position_m: Complex  # (Q,) box centers, m, map frame
    direction: Complex  # (Q,) unit vectors of the courses; NaN where the course is unknown
    t_s: Array  # (Q,)
    agent: NDArray[np.intp]  # (Q,) rows of the agents
    kind: NDArray[np.intp]  # (Q,) of the agents, see `kind_of`


def locate(paths: Paths, seekers: Seekers) -> Places:
    """Find the path that each of Q agents is on, of those that others of its kind had made by then."""
    from scipy.spatial import cKDTree

    chosen = np.full(len(seekers.t_s), -1)
    distance, aside = np.full(len(chosen), np.nan), np.full(len(chosen), np.nan)
    asked = np.flatnonzero(np.isfinite(seekers.direction))
    if not len(paths.point_m) or not len(asked):
        return Places(chosen, distance, aside, distance)
    position, direction = seekers.position_m[asked, None], seekers.direction[asked, None]
    tree = cKDTree(_features(paths.point_m, paths.direction))
    count = min(NEIGHBORS, len(paths.point_m))
    _, near = tree.query(_features(position[:, 0], direction[:, 0]), count, distance_upper_bound=TURN_M)
    near = near.reshape(-1, count)
    row = np.minimum(near, len(paths.point_m) - 1)
    offset = (position - paths.point_m[row]) * paths.direction[row].conj()
    usable = (near < len(paths.point_m)) & (paths.known_s[row] <= seekers.t_s[asked, None])
    usable &= paths.agent[row] != seekers.agent[asked, None]
    kind = seekers.kind[asked, None]
    usable &= (paths.kind[row] == kind) | (paths.kind[row] == VEHICLES) & (kind == RIDERS)
    usable &= (np.abs(offset.imag) < MAX_ASIDE_M) & (np.abs(offset.real) <= SPACING_M)
    usable &= (direction * paths.direction[row].conj()).real > MIN_COS
    pick = np.arange(len(asked)), usable.argmax(axis=1)
    chosen[asked] = np.where(usable[pick], row[pick], -1)
    distance[asked], aside[asked] = paths.distance_m[row[pick]] + offset[pick].real, offset[pick].imag
    return Places(chosen, distance, aside, paths.ends_at(np.maximum(chosen, 0), seekers.t_s))


def follow(paths: Paths, places: Places, speed_mps: Array, lead_s: Array) -> tuple[Complex, Complex]:
    """Compute positions, m, and courses, (Q, H) complex128, of agents with speeds (Q,), m/s, after leads (H,), s.

    NaN beyond where a path was known.
    """
    on = places.row >= 0
    ahead = places.distance_m[:, None] + speed_mps[:, None] * lead_s
    point = np.full(ahead.shape, np.nan, dtype=complex)
    heading = point.copy()
    if not on.any():
        return point, heading
    begin, end = paths.distance_m[places.row[on], None], places.end_m[on, None]
    inside = np.clip(ahead[on], begin, end)
    heading[on] = paths.direction[np.searchsorted(paths.distance_m, inside)]
    point[on] = np.interp(inside, paths.distance_m, paths.point_m)
    point[on] += heading[on] * (1j * places.aside_m[on, None] + ahead[on] - inside)
    known = ahead <= np.where(on, places.end_m, -np.inf)[:, None] + MAX_BEYOND_M
    return np.where(known, point, np.nan), np.where(known, heading, np.nan)


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


def _directions(point_m: Complex) -> Complex:
    """Return unit vectors of the steps to the points of a path; at the first, of the step from it."""
    step = np.diff(point_m)
    step = np.append(step[:1], step)
    return np.asarray(step / np.abs(step))
