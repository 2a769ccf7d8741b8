"""How realistic simulated agents are: the likelihood of what a log did among many rollouts of a simulation.

Montali et al., "The Waymo Open Sim Agents Challenge" (NeurIPS 2023), with the features, bins and weights of the challenge of 2024.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Agent, MapLane
from log2sim.geometry import Array, box_corners_bev, separating_axes, wrap_angle
from log2sim.simulation.prediction.motion_table import Complex

Mask = NDArray[np.bool_]


class Component(NamedTuple):
    """Bins of a histogram, what each starts with besides its counts, and the weight in the realism of all."""

    low: float
    high: float
    bins: int
    start: float
    weight: float


COMPONENTS = {
    "linear_speed": Component(0.0, 25.0, 10, 0.1, 0.05),
    "linear_acceleration": Component(-12.0, 12.0, 11, 0.1, 0.05),
    "angular_speed": Component(-0.628, 0.628, 11, 0.1, 0.05),
    "angular_acceleration": Component(-3.14, 3.14, 11, 0.1, 0.05),
    "distance_to_nearest_object": Component(-5.0, 40.0, 10, 0.1, 0.1),
    "collision": Component(-0.5, 1.5, 2, 0.001, 0.25),
    "time_to_collision": Component(0.0, 5.0, 10, 0.1, 0.1),
    "distance_to_road_edge": Component(-20.0, 40.0, 10, 0.1, 0.1),
    "off_road": Component(-0.5, 1.5, 2, 0.001, 0.25),
}
# Components that say whether something ever happens in a rollout, and the distance that is below, or beyond, 0 then.
EVENTS = {"collision": "distance_to_nearest_object", "off_road": "distance_to_road_edge"}
MAX_TTC_S = 5.0
# Who is ahead counts for the time to collision up to this difference of headings, and up to the second one if the
# overlap is small.
FOLLOWING_RAD, GRAZING_RAD, GRAZING_M = np.radians(75.0), np.radians(10.0), 0.5
FAR_M = 1e3
CELL_M = 0.25
GAP_M = 1.5  # gaps between lanes up to this width belong to the road


@dataclass(frozen=True, eq=False)
class Motions:
    """R rollouts of A agents at T ticks, `tick_s` apart; NaN where an agent is absent."""

    agents: tuple[Agent, ...]
    tick_s: float
    position_m: Complex  # (R, A, T), complex, m: box centers x + iy
    yaw_rad: Array  # (R, A, T)

    @property
    def size_m(self) -> Array:
        """Length and width (A, 2)."""
        return np.array([a.size_m[:2] for a in self.agents], dtype=np.float64).reshape(-1, 2)

    @property
    def present(self) -> Mask:
        """Whether an agent is there (R, A, T)."""
        return np.isfinite(self.yaw_rad)


class Road:
    """The area of lanes as a raster of signed distances from its edge, negative on it."""

    def __init__(self, lanes: Sequence[MapLane]) -> None:
        import cv2
        from scipy.ndimage import distance_transform_edt

        points = np.concatenate([lane.points_m[:, :2] for lane in lanes])
        self._low = points.min(axis=0) - 60.0
        cells = np.ceil((points.max(axis=0) + 60.0 - self._low) / CELL_M).astype(int)
        # A map of kilometers gets coarser cells, 16 million at most.
        self._cell_m = CELL_M * max(1.0, float(np.sqrt(cells.prod() / 16e6)))
        shape = np.ceil(cells * CELL_M / self._cell_m).astype(int)
        inside = np.zeros((shape[1], shape[0]), dtype=np.uint8)
        for lane in lanes:
            line = lane.points_m[:, 0] + 1j * lane.points_m[:, 1]
            steps = np.diff(line)
            normal = 1j * np.concatenate([steps[:1], (steps[1:] + steps[:-1]) / 2, steps[-1:]])
            half = normal / np.maximum(np.abs(normal), 1e-9) * lane.width_m / 2
            edges = np.stack([line + half, line - half])
            at = (np.stack([edges.real, edges.imag], axis=-1) - self._low) / self._cell_m
            pixel = np.round(at * 16).astype(np.int32)
            for k in range(len(line) - 1):
                cv2.fillConvexPoly(inside, pixel[[0, 0, 1, 1], [k, k + 1, k + 1, k]], 1, shift=4)
        gap = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (round(GAP_M / self._cell_m) | 1,) * 2)
        inside = cv2.morphologyEx(inside, cv2.MORPH_CLOSE, gap)
        self._distance_m = (distance_transform_edt(inside == 0) - distance_transform_edt(inside)) * self._cell_m

    def distance_m(self, position_m: Complex) -> Array:
        """Return how far places (...) are from the edge of the road, m, negative on it."""
        column, row = ((c - low) / self._cell_m for c, low in zip((position_m.real, position_m.imag), self._low))
        rows, columns = self._distance_m.shape
        known = np.isfinite(column)
        i, j = (np.clip(np.where(known, c, 0.0).astype(np.intp), 0, n - 1) for c, n in ((row, rows), (column, columns)))
        return np.where(known, self._distance_m[i, j], np.nan)


def features(motions: Motions, which: Sequence[int], road: Road | None = None) -> dict[str, Array]:
    """Compute the features (R, E, T) of agents at E rows; NaN where they are not known."""
    rows = np.array(which, dtype=np.intp)
    place, yaw = motions.position_m[:, rows], motions.yaw_rad[:, rows]
    velocity = _central(place) / motions.tick_s
    speed = np.abs(velocity)
    # Angles are wrapped over two ticks, so that half a turn within them is told apart.
    turn = wrap_angle(2.0 * _central(yaw)) / 2.0
    distance, ahead_s = _nearest(motions, rows)
    found = {
        "linear_speed": speed,
        "linear_acceleration": _central(speed) / motions.tick_s,
        "angular_speed": turn / motions.tick_s,
        "angular_acceleration": wrap_angle(2.0 * _central(turn)) / 2.0 / motions.tick_s**2,
        "distance_to_nearest_object": distance,
        "time_to_collision": ahead_s,
    }
    if road is not None:
        size = motions.size_m[rows]
        corners = box_corners_bev(
            np.stack([place.real, place.imag], axis=-1).reshape(-1, 2),
            np.broadcast_to(size[:, 0, None], place.shape).ravel(),
            np.broadcast_to(size[:, 1, None], place.shape).ravel(),
            yaw.ravel(),
        )
        edge = road.distance_m(corners[..., 0] + 1j * corners[..., 1]).max(axis=1)
        found["distance_to_road_edge"] = edge.reshape(place.shape)
    return found


def _central(values: NDArray[Any]) -> NDArray[Any]:
    """Return half the difference of both neighbors (..., T), NaN at both ends."""
    out = np.full_like(values, np.nan)
    out[..., 1:-1] = (values[..., 2:] - values[..., :-2]) / 2
    return out


def signed_distance(away_m: Complex, yaw_a: Array, yaw_b: Array, size_a_m: Array, size_b_m: Array) -> Array:
    """Return the distances (N,) of rectangles, m, negative by how deep they overlap; `away_m` leads from the centers of a to those of b.

    Cameron, "Enhancing GJK: computing minimum and penetration distances between convex polyhedra" (1997), whose closed form for rectangles
    this is: apart, a corner of one is nearest; overlapping, the shortest way out is along one of the four axes.
    """
    depth = np.full(len(away_m), -np.inf)
    for nx, ny, reach, _ in separating_axes(yaw_a, yaw_b, size_a_m, size_b_m):
        depth = np.maximum(depth, np.abs(away_m.real * nx + away_m.imag * ny) - reach)
    nearest = np.full(len(away_m), np.inf)
    for way, own, other, size, corners in (
        (away_m, yaw_a, yaw_b, size_a_m, size_b_m),
        (-away_m, yaw_b, yaw_a, size_b_m, size_a_m),
    ):
        for one, two in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
            corner = way + (one * corners[:, 0] + 1j * two * corners[:, 1]) / 2 * np.exp(1j * other)
            corner = corner * np.exp(-1j * own)
            beyond_x, beyond_y = np.abs(corner.real) - size[:, 0] / 2, np.abs(corner.imag) - size[:, 1] / 2
            nearest = np.minimum(nearest, np.hypot(np.maximum(beyond_x, 0.0), np.maximum(beyond_y, 0.0)))
    return np.where(depth > 0, nearest, depth)


def _nearest(motions: Motions, rows: NDArray[np.intp]) -> tuple[Array, Array]:
    """Return the signed distance (R, E, T) to the nearest other agent, and the time to collision with whom an agent follows."""
    place, yaw, size = motions.position_m, motions.yaw_rad, motions.size_m
    speed = np.abs(_central(place)) / motions.tick_s
    shape = (len(place), len(rows), place.shape[2])
    distance, ahead_s = np.full(shape, FAR_M), np.full(shape, MAX_TTC_S)
    for e, k in enumerate(rows.tolist()):
        away = place - place[:, k, None]
        away[:, k] = np.nan
        apart = np.abs(away)
        # Only who may be nearest is measured: boxes are between circles within and about them.
        outer, inner = np.hypot(*size.T) / 2, size.min(axis=1) / 2
        known = np.isfinite(apart)
        most = np.where(known, apart - (inner + inner[k])[:, None], np.inf).min(axis=1, initial=np.inf)
        r, a, t = np.nonzero(known & (apart - (outer + outer[k])[:, None] <= most[:, None]))
        one = np.broadcast_to(size[k], (len(r), 2))
        exact = signed_distance(away[r, a, t], yaw[r, k, t], yaw[r, a, t], one, size[a])
        np.minimum.at(distance[:, e], (r, t), exact)
        turn = np.abs(wrap_angle(yaw - yaw[:, k, None]))
        cos, sin = np.abs(np.cos(turn)), np.abs(np.sin(turn))
        rear = away * np.exp(-1j * yaw[:, k, None])
        half = size[None, :, :, None] / 2
        gap = rear.real - size[k, 0] / 2 - half[:, :, 0] * cos - half[:, :, 1] * sin
        aside = np.abs(rear.imag) - size[k, 1] / 2 - half[:, :, 0] * sin - half[:, :, 1] * cos
        with np.errstate(invalid="ignore"):
            follows = (gap > 0) & (aside < 0) & (turn <= FOLLOWING_RAD) & ((aside < -GRAZING_M) | (turn <= GRAZING_RAD))
        gap = np.where(follows, gap, np.inf)
        first = gap.argmin(axis=1)[:, None]
        least, leads = (np.take_along_axis(c, first, axis=1)[:, 0] for c in (gap, speed))
        closing = speed[:, k] - leads
        near = np.isfinite(least) & (closing > 0)
        meet_s = np.divide(least, closing, out=np.full_like(least, MAX_TTC_S), where=near)
        ahead_s[:, e] = np.minimum(meet_s, MAX_TTC_S)
    there = motions.present[:, rows]
    return np.where(there, distance, np.nan), np.where(there, ahead_s, np.nan)


class Realism(NamedTuple):
    """Likelihoods by component, the weighted mean of those that are known, and the displacement from the log, m: mean, and of the best rollout."""

    likelihood: dict[str, float]
    realism: float
    ade_m: float
    min_ade_m: float


def realism(log: Motions, simulated: Motions, rows: Sequence[int], now: int, road: Road | None = None) -> Realism:
    """Compare rollouts (R, A, T) with the log (1, A, T) of the same agents, after tick `now`.

    Parameters
    ----------
    rows : sequence of int
        Of the agents that are judged; the others are in their way. What they do before and at `now` is that of the log.
    road : Road, optional
        Without it nothing is said of the edges of the road.

    Notes
    -----
    Of each agent a histogram of each feature over all rollouts and ticks; the likelihood is the geometric mean of the shares of the bins that
    the log's values fall into, over ticks and agents. Collisions and leaving the road count once a rollout.
    """
    kept = [k for k in rows if log.present[0, k, now + 1 :].any()]
    known, drawn = features(log, kept, road), features(simulated, kept, road)
    there: Mask = log.present[0, kept]
    there[:, : now + 1] = False
    out: dict[str, float] = {}
    for name, component in COMPONENTS.items():
        source = EVENTS.get(name, name)
        if source not in known or not kept:
            continue
        one, many = known[source][0], drawn[source]
        if name in EVENTS:
            sign = -1.0 if name == "collision" else 1.0
            one, many = (np.any((sign * v > 0) & there, axis=-1, keepdims=True).astype(np.float64) for v in (one, many))
            valid: Mask = np.any(there, axis=-1, keepdims=True)
        else:
            many, valid = many[..., now + 1 :], there & np.isfinite(one)
        chance = [_shares(component, many[:, e], one[e])[valid[e]] for e in range(len(kept))]
        out[name] = float(np.exp(np.mean(np.log(np.concatenate(chance)))))
    weights = {name: COMPONENTS[name].weight for name in out}
    total = sum(weights.values())
    error = np.abs(simulated.position_m[:, kept] - log.position_m[:, kept])
    error = np.nanmean(np.where(there, error, np.nan), axis=2) if kept else np.full((1, 1), np.nan)
    mean = float(sum(out[name] * weight for name, weight in weights.items()) / total) if total else float("nan")
    return Realism(out, mean, float(np.nanmean(error)), float(np.nanmin(np.nanmean(error, axis=1))))


def _shares(component: Component, drawn: Array, values: Array) -> Array:
    """Return the shares (T,) of the bins that values (T,) fall into, among what was drawn."""
    low, high, bins = component.low, component.high, component.bins

    def bin_of(v: Array) -> NDArray[np.intp]:
        return np.minimum(((np.clip(v, low, high) - low) / (high - low) * bins).astype(np.intp), bins - 1)

    counts = np.bincount(bin_of(drawn[np.isfinite(drawn)]), minlength=bins) + component.start
    share: Array = counts / counts.sum()
    return share[bin_of(np.nan_to_num(values, nan=low))]
