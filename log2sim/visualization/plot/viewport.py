"""What part of the map a picture shows, the roles of agents in it, and shapes that are drawn."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from log2sim.datatypes import GROUP_OF, Agent, Scenario
from log2sim.geometry import Array, Polyline, box_corners_bev
from log2sim.visualization.plot.style import CROWD_COLOR, INK, MARKERS, PALETTE

MIN_MOVING_M = 1.0  # an agent is stationary when the bounding box of its trajectory has a shorter diagonal
FEW_POINTS = 24  # points of a trajectory that tell where it is


@dataclass(frozen=True, eq=False)
class AgentRole:
    """A moving agent as the pictures show it."""

    agent: Agent
    color: str
    leading: bool  # whether it has its own color, a label and a line in the legend

    @property
    def is_ego(self) -> bool:
        """Whether it is the ego."""
        return self.agent.id == "ego"

    @property
    def marker(self) -> str:
        """Return the marker of its group of categories."""
        return MARKERS[GROUP_OF[self.agent.category]]


@dataclass(frozen=True, eq=False)
class AgentRoles:
    """All agents of a scenario; the ego, if there is one, is the first mover even when it is stationary."""

    movers: tuple[AgentRole, ...]
    stationary: tuple[Agent, ...]


def assign_view_roles(scenario: Scenario, whole: Scenario | None = None) -> AgentRoles:
    """Split agents into movers and static ones; movers by closest approach to the ego, without one by distance driven.

    Where `scenario` is a part of a `whole` one, its agents keep their colors of the whole: those of every picture, film and page.
    """
    movers = _ranked(scenario)
    rank = {agent.id: k for k, agent in enumerate(movers if whole is None else _ranked(whole))}
    roles = [] if scenario.ego is None else [AgentRole(scenario.ego, INK, True)]
    for k, agent in enumerate(movers):
        leading = k < len(PALETTE)
        color = PALETTE[rank.get(agent.id, k) % len(PALETTE)] if leading else CROWD_COLOR
        roles.append(AgentRole(agent, color, leading))
    return AgentRoles(tuple(roles), tuple(a for a in scenario.others if not is_moving(a)))


def _ranked(scenario: Scenario) -> list[Agent]:
    """Return the agents that move but the ego, the most important first."""
    ego, moving = scenario.ego, [a for a in scenario.others if is_moving(a)]
    if ego is not None:  # by the shortest distance between a few points of both trajectories
        some = {a.id: some_points(centers_xy(a), FEW_POINTS) for a in (ego, *moving)}
        key = {a.id: float(np.hypot(*(some[a.id][:, None] - some[ego.id]).transpose(2, 0, 1)).min()) for a in moving}
    else:
        key = {a.id: -float(np.ptp(centers_xy(a), axis=0).sum()) for a in moving}
    return sorted(moving, key=lambda a: (key[a.id], a.id))


def is_moving(agent: Agent) -> bool:
    """Tell whether an agent moves by at least `MIN_MOVING_M`."""
    return not agent.static and float(np.hypot(*np.ptp(centers_xy(agent), axis=0))) >= MIN_MOVING_M


def centers_xy(agent: Agent) -> Array:
    """Return the box centers (T, 2), m, map frame."""
    return np.column_stack([agent.waypoints.x_m, agent.waypoints.y_m])


def some_points(xy_m: Array, most: int) -> Array:
    """Return at most so many of points (N, 2), evenly spaced, with the first and the last."""
    return np.asarray(xy_m[np.linspace(0, len(xy_m) - 1, min(len(xy_m), most)).round().astype(int)])


def paint_of(agent: Agent, otherwise: Any) -> Any:
    """Return the color that an agent itself has, which its heading mark is drawn in; `otherwise` where it is not known."""
    return otherwise if agent.color is None else tuple(v / 255 for v in agent.color["rgb"])


MIN_SIDE_M = 20.0
MARGIN_M = 4.0
REACH_M = 60.0  # movers closer than this to the ego's trajectory are always in view
MAX_UNCROWDED_MOVERS = 12  # with more movers there are fewer time marks, and the view keeps to where most of them are
STATIONARY_REACH_M = 25.0  # stationary agents closer than this to the ego's trajectory are in view


@dataclass(frozen=True)
class Viewport:
    """A rectangle of the map."""

    # x0, x1, y0, y1: m, map frame.
    x0: float
    x1: float
    y0: float
    y1: float
    m_per_pt: float = 0.1  # meters for each point (1/72 inch) of the figure

    @property
    def width_m(self) -> float:
        """Return the extent along x."""
        return self.x1 - self.x0

    @property
    def height_m(self) -> float:
        """Return the extent along y."""
        return self.y1 - self.y0

    def fitted(self, width_pt: float, height_pt: float) -> Viewport:
        """Widen the view about its center so that it fills axes of this size at equal aspect."""
        m_per_pt = max(self.width_m / width_pt, self.height_m / height_pt)
        (cx, w), (cy, h) = ((self.x0 + self.x1) / 2, width_pt), ((self.y0 + self.y1) / 2, height_pt)
        w, h = w * m_per_pt / 2, h * m_per_pt / 2
        return Viewport(cx - w, cx + w, cy - h, cy + h, m_per_pt)

    def contains(self, xy_m: Array) -> NDArray[np.bool_]:
        """Mark (N,) the points (N, 2) inside."""
        x, y = xy_m[:, 0], xy_m[:, 1]
        return (x >= self.x0) & (x <= self.x1) & (y >= self.y0) & (y <= self.y1)


def choose_viewport(roles: AgentRoles) -> Viewport:
    """Choose the smallest view of the ego's trajectory, all movers but far outliers, and stationary agents near them.

    Points of movers are outliers when they are farther from the core than `REACH_M` and than three times the upper quartile
    of all movers' distances, or twice the median of many movers. The core is the ego's trajectory or, without an ego, the
    median of all movers.
    """
    movers = [centers_xy(role.agent) for role in roles.movers]
    stationary = np.concatenate([centers_xy(a)[:1] for a in roles.stationary]) if roles.stationary else np.zeros((0, 2))
    if not movers:
        kept = stationary if len(stationary) else np.zeros((1, 2))
        away = _distance(kept, np.median(kept, axis=0)[None])
        kept = kept[away <= max(REACH_M, 3 * float(np.percentile(away, 75)))]
    else:
        few = [some_points(xy, FEW_POINTS) for xy in movers]
        ego = roles.movers[0].is_ego
        core = few[0] if ego else np.median(np.concatenate(few), axis=0)[None]
        everything, away = np.concatenate(movers), _distance(np.concatenate(few), core)
        crowd = len(movers) > MAX_UNCROWDED_MOVERS
        limit_m = max(REACH_M, 2 * float(np.median(away)) if crowd else 3 * float(np.percentile(away, 75)))
        kept = everything[_distance(everything, core) <= limit_m]
        if ego:
            kept = np.concatenate([kept, stationary[_distance(stationary, core) <= STATIONARY_REACH_M]])
    low, high = kept.min(axis=0), kept.max(axis=0)
    half = np.maximum((high - low) * 0.54 + MARGIN_M, MIN_SIDE_M / 2)
    cx, cy = (low + high) / 2
    return Viewport(cx - half[0], cx + half[0], cy - half[1], cy + half[1])


def nice_step(target: float) -> float:
    """Find the largest of 1, 2, 5 times a power of ten that is not above `target` > 0."""
    power = 10.0 ** np.floor(np.log10(target))
    return float(max((s * power for s in (1.0, 2.0, 5.0) if s * power <= target * (1 + 1e-9)), default=power))


def time_step_s(duration_s: float, movers: int, speed_mps: float, m_per_pt: float) -> float:
    """Choose the seconds between time marks: about eight a track, six with many movers, at least 9 pt apart."""
    apart = 9 * m_per_pt / max(speed_mps, 0.5)
    min_step_s = max(duration_s / (8 if movers <= MAX_UNCROWDED_MOVERS else 6), apart)
    return next((s for s in (0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 30.0, 60.0, 120.0, 300.0) if s >= min_step_s), 600.0)


def _distance(points: Array, core: Array) -> Array:
    """Compute the distance (N,) to the nearest point of the core."""
    nearest = np.full(len(points), np.inf)
    for c in core:
        np.minimum(nearest, np.hypot(points[:, 0] - c[0], points[:, 1] - c[1]), out=nearest)
    return nearest


# Bounds the time for a track that extends far beyond the view.
MAX_ARROWS = 100


def footprints(agent: Agent, xy_m: ArrayLike, yaw_rad: ArrayLike) -> Array:
    """Compute the footprints (M, 4, 2) of an agent at M poses."""
    return box_corners_bev(xy_m, agent.size_m[0], agent.size_m[1], yaw_rad)


def heading_triangles(corners: Array) -> Array:
    """Compute triangles (M, 3, 2) at the front of footprints (M, 4, 2)."""
    depth = 0.42  # of the length
    front_left, rear_left, rear_right, front_right = np.moveaxis(corners, 1, 0)
    left, right = front_left + depth * (rear_left - front_left), front_right + depth * (rear_right - front_right)
    inset = 0.2  # narrower than deep, so that it cannot be read as pointing sideways
    tip = (front_left + front_right) / 2
    return np.stack([left + inset * (right - left), right + inset * (left - right), tip], axis=1)


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


def arrows(xy_m: Array, view: Viewport) -> list[Array]:
    """Compute arrowheads (4, 2) along positions (T, 2) in the direction of travel, one every 110 points."""
    arc = Polyline(xy_m).s_m
    length = arc[-1] / view.m_per_pt
    if length < 26:
        return []
    count = min(max(1, round(length / 110.0)), MAX_ARROWS)
    size = 4.2 * view.m_per_pt
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
        aside, back = 0.75 * size * across, here - size * 0.35 * along
        out.append(np.stack([here + size * along, tail + aside, back, tail - aside]))
    return out


def time_marks(agent: Agent, step_s: float) -> tuple[Array, Array]:
    """Return the multiples (K,) of `step_s` within an agent's trajectory and its positions (K, 2) at them."""
    w = agent.waypoints
    t = np.arange(np.ceil(w.t_s[0] / step_s - 1e-9), np.floor(w.t_s[-1] / step_s + 1e-9) + 1) * step_s
    at = agent.at(t) if len(t) else None
    return t, np.zeros((0, 2)) if at is None else np.column_stack([at.x_m, at.y_m])


def spaced_apart(xy_m: Array, ends_m: Array, apart_m: float) -> NDArray[np.bool_]:
    """Mark (K,) the positions that keep a distance from the ends (E, 2) and from the previous marked one."""
    chosen = np.zeros(len(xy_m), dtype=bool)
    others = ends_m
    for k, place in enumerate(xy_m):
        if np.hypot(*(others - place).T).min() >= apart_m:
            chosen[k] = True
            others = np.concatenate([ends_m, place[None]])
    return chosen
