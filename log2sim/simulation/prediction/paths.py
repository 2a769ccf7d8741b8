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

Index = NDArray[np.intp]

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
