"""Shapes that are drawn: footprints, heading triangles, arrowheads, contiguous runs of a track."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike, NDArray

from log2sim.datatypes import Agent
from log2sim.geometry import Array, box_corners_bev
from log2sim.visualization.plot.roles import centers_xy
from log2sim.visualization.plot.viewport import Viewport

# Bounds the time for a track that extends far beyond the view.
MAX_ARROWS = 100


def footprints(agent: Agent, xy_m: ArrayLike, yaw_rad: ArrayLike) -> Array:
    """Compute the footprints (M, 4, 2) of an agent at M poses."""
    return box_corners_bev(xy_m, agent.size_m[0], agent.size_m[1], yaw_rad)


def heading_triangles(corners: Array, depth: float = 0.42) -> Array:
    """Compute triangles (M, 3, 2) at the front of footprints (M, 4, 2); `depth` is a fraction of the length."""
    front_left, rear_left, rear_right, front_right = np.moveaxis(corners, 1, 0)
    left, right = front_left + depth * (rear_left - front_left), front_right + depth * (rear_right - front_right)
    inset = 0.2  # narrower than deep, so that it cannot be read as pointing sideways
    return np.stack(
        [left + inset * (right - left), right + inset * (left - right), (front_left + front_right) / 2], axis=1
    )


def stripes(corners: Array, spacing_m: float) -> Array:
    """Compute parallel lines (K, 2, 2) across a footprint (4, 2), at 45 degrees to its sides and at least two of them."""
    front_left, rear_left, rear_right, _ = corners
    along, across = front_left - rear_left, rear_right - rear_left
    length, width = float(np.hypot(*along)), float(np.hypot(*across))
    reach = length + width
    count = max(int(reach / (spacing_m * np.sqrt(2))), 2)
    offset = (np.arange(count) + 0.5) / count * reach - width  # where the line meets the side, from the rear
    first = np.stack([np.maximum(offset, 0.0), np.maximum(-offset, 0.0)], axis=1)
    last = np.stack([np.minimum(length, offset + width), np.minimum(width, length - offset)], axis=1)
    ends = np.stack([first, last], axis=1)
    lines: Array = rear_left + ends[..., :1] * (along / length) + ends[..., 1:] * (across / width)
    return lines


def contiguous_runs(keep: NDArray[np.bool_]) -> Iterator[slice]:
    """Yield slices over points of a track, one for each run of kept segments `keep` (T - 1,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], keep.astype(np.int8), [0]])))
    for start, stop in zip(edges[::2], edges[1::2]):
        yield slice(int(start), int(stop) + 1)


def observed_and_filled(agent: Agent) -> tuple[list[Array], list[Array]]:
    """Split a track into polylines of its observed parts and of its filled gaps."""
    xy, observed = centers_xy(agent), agent.waypoints.observed
    both = observed[:-1] & observed[1:]
    return [xy[s] for s in contiguous_runs(both)], [xy[s] for s in contiguous_runs(~both)]


def arrows(xy_m: Array, view: Viewport, spacing_pt: float = 110.0, size_pt: float = 4.2) -> list[Array]:
    """Compute arrowheads (4, 2) along positions (T, 2) in the direction of travel, one every `spacing_pt` points."""
    steps = np.hypot(*np.diff(xy_m, axis=0).T)
    arc = np.concatenate([[0.0], np.cumsum(steps)])
    length = arc[-1] / view.m_per_pt
    if length < 26:
        return []
    count = min(max(1, round(length / spacing_pt)), MAX_ARROWS)
    size = size_pt * view.m_per_pt
    out = []
    for fraction in (np.arange(count) + 0.5) / count:
        at = fraction * arc[-1]
        here, back, ahead = (
            np.array([np.interp(s, arc, xy_m[:, 0]), np.interp(s, arc, xy_m[:, 1])]) for s in (at, at - size, at + size)
        )
        along = ahead - back
        if np.hypot(*along) == 0:
            continue
        along = along / np.hypot(*along)
        across = np.array([-along[1], along[0]])
        tail = here - size * 0.8 * along
        out.append(
            np.stack(
                [
                    here + size * along,
                    tail + 0.75 * size * across,
                    here - size * 0.35 * along,
                    tail - 0.75 * size * across,
                ]
            )
        )
    return out


def time_marks(agent: Agent, step_s: float) -> tuple[Array, Array]:
    """Return the multiples (K,) of `step_s` within an agent's trajectory and its positions (K, 2) at them."""
    w = agent.waypoints
    t = np.arange(np.ceil(w.t_s[0] / step_s - 1e-9), np.floor(w.t_s[-1] / step_s + 1e-9) + 1) * step_s
    state = agent.at(t) if len(t) else None
    xy = np.zeros((0, 2)) if state is None else np.column_stack([state.x_m, state.y_m])
    return t, xy


def spaced_apart(xy_m: Array, ends_m: Array, apart_m: float) -> NDArray[np.bool_]:
    """Mark (K,) the positions that keep a distance from the ends (E, 2) and from the previous marked one."""
    chosen = np.zeros(len(xy_m), dtype=bool)
    others = ends_m
    for k, place in enumerate(xy_m):
        if np.hypot(*(others - place).T).min() >= apart_m:
            chosen[k] = True
            others = np.concatenate([ends_m, place[None]])
    return chosen
