"""Labels on the map: each beside its box or track at a free place, as long as there is room for it."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from matplotlib.axes import Axes

from log2sim.datatypes import STANDSTILL_MPS, Agent, why_doubtful
from log2sim.geometry import Array
from log2sim.visualization.plot import shapes
from log2sim.visualization.plot.roles import AgentRole, AgentRoles, centers_xy
from log2sim.visualization.plot.style import FONT, MUTED, halo, printable
from log2sim.visualization.plot.viewport import Viewport

LABEL_Z = 8.0
LETTER_WIDTH, LETTER_HALF_HEIGHT = 0.68, 0.55
"""Mean width of a bold letter of the font and half the height of a line, of its size."""

SIDES = ((1, 1), (-1, 1), (1, -1), (-1, -1), (0, 1), (0, -1), (1, 0), (-1, 0))
"""Where a label may be beside its box, the best first."""

RINGS_PT = (0.0, 6.0)
"""How far from the box it may be."""

FAR_RINGS_PT = (0.0, 6.0, 14.0)
"""The same for a short label that has no room closer to its track than to any other."""

ALONG_TRACK = (0.75, 0.5, 0.25, 0.0)
"""Shares of a track at which a label may be when there is no room at its end."""

MAX_TRACK_POINTS = 40
"""Points of a track that labels keep clear of; for 500 agents more would take seconds."""

MOVER_PT, DETAIL_PT = 7.0, 6.0
MAX_ID_LETTERS, MAX_REASON_LETTERS = 20, 44

Bounds = tuple[float, float, float, float]
"""Of a rectangle: least x and y, greatest x and y, m."""

Anchor = tuple[Array, Array]
"""What a label is beside: its place (2,) and half its extents (2,), m."""


@dataclass(frozen=True, eq=False)
class MapLabel:
    """A label at its place.

    Attributes
    ----------
    text, color : str
    place_m : (2,) float64, m
        Middle of the text.
    size_pt : float
    bold : bool
    """

    text: str
    color: str
    place_m: Array
    size_pt: float
    bold: bool


@dataclass(eq=False)
class Placed:
    """Labels of a picture.

    Attributes
    ----------
    labels : list of MapLabel
    told : set of str
        Ids of the agents of which the map says all that the legend would.
    """

    labels: list[MapLabel] = field(default_factory=list)
    told: set[str] = field(default_factory=set)


def short_label(role: AgentRole) -> str:
    """Return the id of a mover."""
    return printable(role.agent.id, MAX_ID_LETTERS) + "?" * role.agent.is_doubtful


def speed_text(agent: Agent) -> str:
    """Return the highest speed of an agent in words."""
    speed = float(np.max(np.abs(agent.waypoints.speed_mps)))
    return f"{speed * 3.6:.0f} km/h" if speed >= STANDSTILL_MPS else "stands"


def full_label(role: AgentRole) -> str:
    """Return id and highest speed of a mover."""
    return f"{short_label(role)} · {speed_text(role.agent)}"


def place_labels(roles: AgentRoles, view: Viewport, times_step_s: float, *, label_static: bool = False) -> Placed:
    """Find places for the labels of movers, of doubtful or else all stationary agents, and for times along the ego's track.

    Notes
    -----
    Short labels of all movers get their places before any is replaced by the full one, so that the long texts of some do not
    take the room of the others.
    """
    room = LabelRoom(view, _occupied(roles, view))
    tracks = {role.agent.id: _points_of(role.agent) for role in roles.movers}
    placed = Placed()
    leading = [role for role in roles.movers if role.leading]
    short = {role.agent.id: _place_short(role, room, tracks) for role in leading}
    for role in leading:
        _place_mover(role, short[role.agent.id], room, placed, tracks)
    for agent in roles.stationary:
        if agent.is_doubtful or label_static:
            _place_stationary(agent, room, placed)
    if roles.movers and roles.movers[0].is_ego:
        _place_times(roles.movers[0].agent, times_step_s, room, placed)
    return placed


def draw_labels(ax: Axes, labels: Sequence[MapLabel]) -> None:
    """Write labels at their places."""
    for label in labels:
        ax.text(
            label.place_m[0], label.place_m[1], label.text, color=label.color, fontsize=label.size_pt,
            fontweight="bold" if label.bold else "normal", family=FONT, ha="center", va="center_baseline",
            path_effects=halo(), zorder=LABEL_Z, parse_math=False, clip_on=True,
        )  # fmt: skip


class LabelRoom:
    """The places on a map that are taken, and the search for free ones."""

    def __init__(self, view: Viewport, taken: list[Bounds]) -> None:
        self.view, self.taken = view, taken

    def place(
        self,
        text: str,
        size_pt: float,
        anchors: Iterable[Anchor],
        fits: Callable[[Array, Array], bool] | None = None,
    ) -> Array | None:
        """Reserve room for a text beside the first anchor that has it, and return its middle (2,), m; None without.

        `fits` is asked of a free place and half the size of the text, both (2,), m; without it the text may be farther away.
        """
        half = self.half_size(text, size_pt)
        pad = 1.5 * self.view.m_per_pt
        for anchor, box_half in anchors:
            if not self.view.contains(anchor[None])[0]:
                continue
            for ring, side in itertools.product(FAR_RINGS_PT if fits is None else RINGS_PT, SIDES):
                place = anchor + np.array(side) * (box_half + half + pad + ring * self.view.m_per_pt)
                if self.is_free(place, half) and (fits is None or fits(place, half)):
                    self.taken.append((*(place - half), *(place + half)))
                    return np.asarray(place)
        return None

    def half_size(self, text: str, size_pt: float) -> Array:
        """Estimate half the width and height of a text (2,), m."""
        return (
            np.array([LETTER_WIDTH / 2 * size_pt * len(text) + 1.0, LETTER_HALF_HEIGHT * size_pt]) * self.view.m_per_pt
        )

    def is_free(self, place: Array, half: Array) -> bool:
        """Whether a label about a place is in the view and clear of all that is taken."""
        low, high = place - half, place + half
        inside = self.view.contains(np.stack([low, high])).all()
        return bool(inside) and not any(
            low[0] < t[2] and high[0] > t[0] and low[1] < t[3] and high[1] > t[1] for t in self.taken
        )

    def give_back(self, text: str, size_pt: float, place: Array) -> None:
        """Free the room of a text that was placed."""
        half = self.half_size(text, size_pt)
        self.taken.remove((*(place - half), *(place + half)))


def _place_short(role: AgentRole, room: LabelRoom, tracks: Mapping[str, Array]) -> Array | None:
    text = short_label(role)
    anchors = itertools.chain(_end_of(role.agent), _along(role.agent))
    place = room.place(text, MOVER_PT, anchors, _belongs_to(role.agent, tracks))
    return room.place(text, MOVER_PT, _end_of(role.agent)) if place is None else place


def _place_mover(
    role: AgentRole, short_place: Array | None, room: LabelRoom, placed: Placed, tracks: Mapping[str, Array]
) -> None:
    """Replace the short label of a mover by the full one if there is room for it."""
    short, full = short_label(role), full_label(role)
    if short_place is not None:
        room.give_back(short, MOVER_PT, short_place)
    anchors = itertools.chain(_end_of(role.agent), _along(role.agent))
    place = room.place(full, MOVER_PT, anchors, _belongs_to(role.agent, tracks))
    if place is not None:
        placed.labels.append(MapLabel(full, role.color, place, MOVER_PT, bold=True))
        placed.told.add(role.agent.id)
    elif short_place is not None:
        half = room.half_size(short, MOVER_PT)
        room.taken.append((*(short_place - half), *(short_place + half)))
        placed.labels.append(MapLabel(short, role.color, short_place, MOVER_PT, bold=True))


def _belongs_to(agent: Agent, tracks: Mapping[str, Array]) -> Callable[[Array, Array], bool]:
    """Make a test whether a place for a label is closer to the track of its agent than to any other."""
    own = tracks[agent.id]
    others = np.concatenate([np.zeros((0, 2)), *(xy for id, xy in tracks.items() if id != agent.id)])
    return lambda place, half: _gap_m(own, place, half) <= _gap_m(others, place, half)


def _gap_m(xy_m: Array, place: Array, half: Array) -> float:
    """Compute the distance from the rectangle of a label to the nearest of points (N, 2); infinite without any."""
    outside = np.maximum(np.abs(xy_m - place) - half, 0.0)
    return float(np.hypot(*outside.T).min(initial=np.inf))


def _end_of(agent: Agent) -> Iterator[Anchor]:
    """Yield the last box of a mover."""
    xy_m = centers_xy(agent)[-1]
    yield xy_m, np.ptp(shapes.footprints(agent, xy_m, agent.waypoints.yaw_rad[-1])[0], axis=0) / 2


def _along(agent: Agent) -> Iterator[Anchor]:
    """Yield places along the track of a mover, the latest first."""
    xy = centers_xy(agent)
    for share in ALONG_TRACK:
        yield xy[round(share * (len(xy) - 1))], np.full(2, agent.size_m[1] / 2)


def _place_stationary(agent: Agent, room: LabelRoom, placed: Placed) -> None:
    """Write the id of a stationary agent beside it, of a doubtful one with the reason if there is room for it."""
    anchor = centers_xy(agent)[len(agent.waypoints) // 2], np.full(2, agent.size_m[1] / 2)
    name = printable(agent.id, MAX_ID_LETTERS) + "?" * agent.is_doubtful
    reason = printable(why_doubtful(agent)) if agent.is_doubtful else ""
    for text in (f"{name} {reason}", name) if reason else (name,):
        whole = text != name
        place = None if whole and len(reason) > MAX_REASON_LETTERS else room.place(text, DETAIL_PT, [anchor])
        if place is not None:
            placed.labels.append(MapLabel(text, MUTED, place, DETAIL_PT, bold=False))
            placed.told |= {agent.id} if whole else set()
            return


def _place_times(ego: Agent, step_s: float, room: LabelRoom, placed: Placed) -> None:
    t, xy = shapes.time_marks(ego, step_s)
    apart = shapes.spaced_apart(xy, centers_xy(ego)[[0, -1]], max(ego.size_m[0] / 2, 24 * room.view.m_per_pt))
    for when, at in zip(t[apart], xy[apart]):
        place = room.place(f"{when:g} s", DETAIL_PT, [(at, np.full(2, ego.size_m[1] / 2))])
        if place is not None:
            placed.labels.append(MapLabel(f"{when:g} s", MUTED, place, DETAIL_PT, bold=False))


def _occupied(roles: AgentRoles, view: Viewport) -> list[Bounds]:
    """Collect the bounds of boxes and of points along the leading tracks, which labels keep clear of."""
    out = [_bounds(agent, len(agent.waypoints) // 2) for agent in roles.stationary]
    r = 1.2 * view.m_per_pt
    for role in roles.movers:
        out.append(_bounds(role.agent, -1))
        if role.leading:
            out.append(_bounds(role.agent, 0))
            out.extend((x - r, y - r, x + r, y + r) for x, y in _points_of(role.agent))
    return out


def _points_of(agent: Agent) -> Array:
    """Return points (K, 2) along a track, m."""
    xy = centers_xy(agent)
    return np.asarray(xy[np.linspace(0, len(xy) - 1, min(len(xy), MAX_TRACK_POINTS)).round().astype(int)])


def _bounds(agent: Agent, k: int) -> Bounds:
    """Return the bounds of the box of an agent at waypoint `k`."""
    (corners,) = shapes.footprints(agent, centers_xy(agent)[k], agent.waypoints.yaw_rad[k])
    return (*corners.min(axis=0), *corners.max(axis=0))
