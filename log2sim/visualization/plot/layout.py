"""Layout of a figure: title, map axes, legend, scale, and labels at free places."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon
from matplotlib.ticker import FuncFormatter, MultipleLocator

from log2sim.datatypes import STANDSTILL_MPS, Agent, explain_doubt
from log2sim.geometry import Array
from log2sim.visualization.plot import style, viewport
from log2sim.visualization.plot.viewport import AgentRole, AgentRoles, Viewport, centers_xy, nice_step

LABEL_Z = 8.0
# Mean width of a bold letter of the font and half the height of a line, of its size.
LETTER_WIDTH, LETTER_HALF_HEIGHT = 0.68, 0.55
# Where a label may be beside its box, the best first.
SIDES = ((1, 1), (-1, 1), (1, -1), (-1, -1), (0, 1), (0, -1), (1, 0), (-1, 0))
RINGS_PT = (0.0, 6.0)  # how far from the box it may be
FAR_RINGS_PT = (0.0, 6.0, 14.0)  # the same for a short label that has no room closer to its track than to any other
ALONG_TRACK = (0.75, 0.5, 0.25, 0.0)  # shares of a track at which a label may be when there is no room at its end
MAX_TRACK_POINTS = 40  # points of a track that labels keep clear of; for 500 agents more would take seconds
MOVER_PT, DETAIL_PT = 7.0, 6.0
MAX_ID_LETTERS, MAX_REASON_LETTERS = 20, 44
Bounds = tuple[float, float, float, float]  # of a rectangle: least x and y, greatest x and y, m
Anchor = tuple[Array, Array]  # what a label is beside: its place (2,) and half its extents (2,), m


@dataclass(frozen=True, eq=False)
class MapLabel:
    """A label at its place."""

    text: str
    color: str
    place_m: Array  # (2,) middle of the text
    size_pt: float
    bold: bool


def short_label(role: AgentRole) -> str:
    """Return what marks a mover on the map where there is little room."""
    return style.printable_label(role.agent.id, MAX_ID_LETTERS) + "?" * role.agent.is_doubtful


def speed_text(agent: Agent) -> str:
    """Return the highest speed of an agent in words."""
    speed = float(np.max(np.abs(agent.waypoints.speed_mps)))
    return f"{speed * 3.6:.0f} km/h" if speed >= STANDSTILL_MPS else "stands"


def place_labels(
    roles: AgentRoles,
    view: Viewport,
    times_step_s: float,
    sensors: Sequence[Mapping[str, Any]],
    *,
    static: bool = False,
) -> tuple[list[MapLabel], set[str]]:
    """Find places for the labels of movers and doubtful agents, with `static` of all static ones, and for times along the ego's track.

    Labels keep clear of `sensors`, those of a scenario. Also returns the ids of the agents of which the map says all that the legend would.

    Short labels of all movers get their places before any is replaced by the full one, so that the long texts of some do not
    take the room of the others.
    """
    # Labels keep clear of boxes, points along the leading tracks, and sensors.
    taken = [_bounds(agent, len(agent.waypoints) // 2) for agent in roles.stationary]
    tracks = {r.agent.id: viewport.some_points(centers_xy(r.agent), MAX_TRACK_POINTS) for r in roles.movers}
    r = 1.2 * view.m_per_pt
    for role in roles.movers:
        taken.append(_bounds(role.agent, -1))
        if role.leading:
            taken.append(_bounds(role.agent, 0))
            taken.extend((x - r, y - r, x + r, y + r) for x, y in tracks[role.agent.id])
    mark = style.SENSOR_PT / 2 * view.m_per_pt
    taken += [(s["x_m"] - mark, s["y_m"] - mark, s["x_m"] + mark, s["y_m"] + mark) for s in sensors]
    room = LabelRoom(view, taken)
    labels, told = list[MapLabel](), set[str]()

    def place_detail(text: str, anchor: Anchor) -> bool:
        place = room.place(text, DETAIL_PT, [anchor])
        labels.extend([] if place is None else [MapLabel(text, style.MUTED, place, DETAIL_PT, bold=False)])
        return place is not None

    # From the rectangle of a label to the nearest of points (N, 2).
    def gap_m(xy_m: Array, place: Array, half: Array) -> float:
        return float(np.hypot(*np.maximum(np.abs(xy_m - place) - half, 0.0).T).min(initial=np.inf))

    def place_mover(role: AgentRole, text: str) -> Array | None:  # closer to its own track than to any other
        id, xy = role.agent.id, centers_xy(role.agent)
        others = np.concatenate([np.zeros((0, 2)), *(xy for other, xy in tracks.items() if other != id)])
        half = np.full(2, role.agent.size_m[1] / 2)
        along = [(xy[round(share * (len(xy) - 1))], half) for share in ALONG_TRACK]  # the latest first
        anchors = [_end_of(role.agent), *along]
        return room.place(text, MOVER_PT, anchors, lambda at, h: gap_m(tracks[id], at, h) <= gap_m(others, at, h))

    leading, short_places = [role for role in roles.movers if role.leading], dict[str, Array | None]()
    for role in leading:
        short = short_label(role)
        place = place_mover(role, short)
        place = room.place(short, MOVER_PT, [_end_of(role.agent)]) if place is None else place
        short_places[role.agent.id] = place
    for role in leading:  # by the full one if there is room for it
        id, short = role.agent.id, short_label(role)
        full, short_place = f"{short} · {speed_text(role.agent)}", short_places[id]
        if short_place is not None:
            room.taken.remove(room.bounds(short, MOVER_PT, short_place))
        if (place := place_mover(role, full)) is not None:
            labels.append(MapLabel(full, role.color, place, MOVER_PT, bold=True))
            told.add(id)
        elif short_place is not None:
            room.taken.append(room.bounds(short, MOVER_PT, short_place))
            labels.append(MapLabel(short, role.color, short_place, MOVER_PT, bold=True))
    for agent in roles.stationary:
        anchor = centers_xy(agent)[len(agent.waypoints) // 2], np.full(2, agent.size_m[1] / 2)
        name = style.printable_label(agent.id, MAX_ID_LETTERS)
        if agent.is_doubtful:
            reason = style.printable_label(explain_doubt(agent))
            if len(reason) <= MAX_REASON_LETTERS and place_detail(f"{name}? {reason}", anchor):
                told.add(agent.id)
            else:
                place_detail(f"{name}?", anchor)
        elif static:
            place_detail(name, anchor)
    if roles.movers and roles.movers[0].is_ego:
        ego = roles.movers[0].agent
        t, xy = viewport.time_marks(ego, times_step_s)
        apart = viewport.spaced_apart(xy, centers_xy(ego)[[0, -1]], max(ego.size_m[0] / 2, 24 * view.m_per_pt))
        for when, at in zip(t[apart], xy[apart]):
            place_detail(f"{when:g} s", (at, np.full(2, ego.size_m[1] / 2)))
    return labels, told


def draw_labels(ax: Axes, labels: Sequence[MapLabel]) -> None:
    """Write labels at their places."""
    for label in labels:
        ax.text(
            label.place_m[0], label.place_m[1], label.text, color=label.color, fontsize=label.size_pt,
            fontweight="bold" if label.bold else "normal", family=style.FONT, ha="center", va="center_baseline",
            path_effects=style.halo(), zorder=LABEL_Z, parse_math=False, clip_on=True,
        )  # fmt: skip


class LabelRoom:
    """The places on a map that are taken, and the search for free ones."""

    def __init__(self, view: Viewport, taken: list[Bounds]) -> None:
        self.view, self.taken = view, taken

    def place(
        self, text: str, size_pt: float, anchors: Iterable[Anchor], fits: Callable[[Array, Array], bool] | None = None
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
        size = np.array([LETTER_WIDTH / 2 * size_pt * len(text) + 1.0, LETTER_HALF_HEIGHT * size_pt])
        return size * self.view.m_per_pt

    def bounds(self, text: str, size_pt: float, place: Array) -> Bounds:
        """Return the bounds of a text about a place."""
        half = self.half_size(text, size_pt)
        return (*(place - half), *(place + half))

    def is_free(self, place: Array, half: Array) -> bool:
        """Whether a label about a place is in the view and clear of all that is taken."""
        low, high = place - half, place + half
        inside = self.view.contains(np.stack([low, high])).all()
        return bool(inside) and not any(
            low[0] < t[2] and high[0] > t[0] and low[1] < t[3] and high[1] > t[1] for t in self.taken
        )


def _end_of(agent: Agent) -> Anchor:
    """Return the last box of a mover."""
    xy_m = centers_xy(agent)[-1]
    return xy_m, np.ptp(viewport.footprints(agent, xy_m, agent.waypoints.yaw_rad[-1])[0], axis=0) / 2


def _bounds(agent: Agent, k: int) -> Bounds:
    """Return the bounds of the box of an agent at waypoint `k`."""
    (corners,) = viewport.footprints(agent, centers_xy(agent)[k], agent.waypoints.yaw_rad[k])
    return (*corners.min(axis=0), *corners.max(axis=0))


# With more leading movers their speeds are in the legend: longer labels would cover the boxes of others.
MAX_NAMED = 8
MOVING_SIDES = SIDES[4:] + SIDES[:4]  # in animations, the best first
GAP_PT = 2.0


def names_fit(roles: AgentRoles) -> bool:
    """Tell whether labels of an animation have speeds, so that the legend need not list them."""
    return sum(role.leading for role in roles.movers) <= MAX_NAMED


class MovingLabels:
    """Labels of the leading movers; each keeps to its side of the box as long as there is room."""

    def __init__(self, ax: Axes, view: Viewport, roles: AgentRoles) -> None:
        self._ax, self._view, self._named = ax, view, names_fit(roles)
        look: dict[str, Any] = {
            "fontsize": MOVER_PT, "family": style.FONT, "fontweight": "bold", "parse_math": False, "animated": True, "clip_on": True,
            "ha": "center", "va": "center_baseline", "zorder": 9,
        }  # fmt: skip
        leading = [role for role in roles.movers if role.leading]
        self._texts = {r.agent.id: ax.text(0, 0, "", color=r.color, path_effects=style.halo(), **look) for r in leading}
        self._side: dict[str, tuple[int, int]] = {}

    def show(self, present: list[tuple[AgentRole, Array, float]]) -> None:
        """Draw the labels of movers beside the corners (4, 2) of their boxes, with their speeds, m/s, in the order of their rank."""
        room = LabelRoom(self._view, [(*c.min(axis=0), *c.max(axis=0)) for _, c, _ in present])
        for role, corners, speed_mps in present:
            text = self._texts.get(role.agent.id)
            if text is None:
                continue
            moves = self._named and abs(speed_mps) >= STANDSTILL_MPS
            text.set_text(short_label(role) + f" · {abs(speed_mps) * 3.6:.0f} km/h" * moves)
            low, high = corners.min(axis=0), corners.max(axis=0)
            half, before = room.half_size(text.get_text(), MOVER_PT), self._side.get(role.agent.id)
            for side in (before, *MOVING_SIDES) if before is not None else MOVING_SIDES:
                place = (low + high) / 2 + np.array(side) * ((high - low) / 2 + half + GAP_PT * self._view.m_per_pt)
                if room.is_free(place, half):
                    room.taken.append((*(place - half), *(place + half)))
                    self._side[role.agent.id] = side
                    text.set_position((place[0], place[1]))
                    self._ax.draw_artist(text)
                    break


WIDTH_IN = 10.0
LEFT_IN, SIDE_IN, TOP_IN, BOTTOM_IN, GAP_IN = 0.72, 2.3, 0.74, 0.52, 0.2
MIN_MAP_IN, MAX_MAP_IN = 3.4, 8.4
ROW_IN = 0.178
# Below the map: a chart, the gap below it, the time axis, and the heading of the charts.
CHART_IN, CHART_GAP_IN, TIME_IN, HEAD_IN = 0.56, 0.12, 0.36, 0.26


@dataclass(frozen=True, eq=False)
class FigureLayout:
    """A figure and its parts."""

    figure: Figure
    ax: Axes  # of the map
    view: Viewport  # what the map shows
    foot_in: float  # inch, height below the map for charts

    @property
    def width_in(self) -> float:
        """Return the width of the figure, inch."""
        return float(self.figure.get_figwidth())

    def set_width_px(self, width_px: int) -> None:
        """Choose the dots per inch that make the figure so wide, and its sides whole pixels."""
        height_px = round(width_px * self.figure.get_figheight() / self.width_in)
        self.figure.set_dpi(width_px / self.width_in)
        # A hair more, since the canvas cuts off parts of pixels.
        self.figure.set_size_inches((width_px + 0.01) / self.figure.dpi, (height_px + 0.01) / self.figure.dpi)


def make_layout(
    view: Viewport, legend_rows: int, *, projected: bool, foot_in: float, aspect: float | None
) -> FigureLayout:
    """Lay out a figure whose map has the proportions of the view within limits, above `foot_in` inches for charts.

    With an `aspect`, height over width, the figure has that, and is so large that all has room.
    """
    width, map_width = WIDTH_IN, WIDTH_IN - LEFT_IN - SIDE_IN - GAP_IN
    needed = legend_rows * ROW_IN + 1.0
    around = TOP_IN + BOTTOM_IN + foot_in
    if aspect is None:
        wanted = max(map_width * view.height_m / view.width_m, needed)
        map_height = float(np.clip(wanted, MIN_MAP_IN, MAX_MAP_IN))
    else:
        width = max(WIDTH_IN, (max(needed, MIN_MAP_IN) + around) / aspect)
        map_width, map_height = width - LEFT_IN - SIDE_IN - GAP_IN, width * aspect - around
    height = map_height + around
    figure = style.new_figure(width, height)
    ax = figure.add_axes((LEFT_IN / width, (foot_in + BOTTOM_IN) / height, map_width / width, map_height / height))
    fitted = view.fitted(map_width * 72, map_height * 72)
    ax.set(xlim=(fitted.x0, fitted.x1), ylim=(fitted.y0, fitted.y1), facecolor="#FBFCFD")
    ax.set_aspect("equal", adjustable="box")
    names = ("east", "north") if projected else ("map x", "map y")
    style.style_axes(ax)
    step_m = nice_step(max(fitted.width_m, fitted.height_m) / 5)
    for axis, name, low in zip((ax.xaxis, ax.yaxis), names, (fitted.x0, fitted.y0)):
        # Seven-digit tick labels are unreadable; their common part goes into the axis label.
        base_m = float(np.floor(low / 1000) * 1000) if abs(low) >= 1e5 else 0.0
        axis.set_major_locator(MultipleLocator(step_m))
        axis.set_major_formatter(FuncFormatter(lambda v, _, base_m=base_m: f"{v - base_m:.6g}".replace("-", "−")))
        since = f" − {base_m:.0f}" if base_m > 0 else f" + {-base_m:.0f}" if base_m < 0 else ""
        axis.set_label_text(f"{name}{since} (m)", fontsize=7.5, color=style.MUTED, family=style.FONT)
    return FigureLayout(figure, ax, fitted, foot_in)


def write_title(layout: FigureLayout, title: str, subtitle: str) -> None:
    """Write the title and a smaller line below it, flush with the map's left edge."""
    height = layout.figure.get_figheight()
    look: dict[str, Any] = {"family": style.FONT, "ha": "left", "va": "baseline", "parse_math": False}
    title, subtitle = style.printable_label(title, 70), style.printable_label(subtitle, 130)
    x = LEFT_IN / layout.width_in
    layout.figure.text(x, 1 - 0.36 / height, title, fontsize=13, fontweight="bold", color=style.INK, **look)
    layout.figure.text(x, 1 - 0.59 / height, subtitle, fontsize=8, color=style.MUTED, **look)


def fill_legend(owner: Axes | Figure, rows: list[tuple[Any, str]], place: tuple[float, float], **look: Any) -> None:
    """Draw a legend whose upper left corner is at a place in fractions of axes or a figure."""
    legend = owner.legend(
        [handle for handle, _ in rows], [text for _, text in rows], loc="upper left", bbox_to_anchor=place, borderaxespad=0,
        frameon=False, prop={"family": style.FONT, "size": 7.0}, labelcolor=style.INK, **look,
    )  # fmt: skip
    for text in legend.get_texts():
        text.set_parse_math(False)


def legend_rows(
    roles: AgentRoles,
    mark_step_s: float | None,
    told: Set[str],
    *,
    truth: bool,
    replay: bool,
    collisions: int,
    outside: int,
) -> list[tuple[Any, str]]:
    """List handles and texts: leading movers but the `told` ones, counts of the others, then the meaning of marks that occur."""
    rows: list[tuple[Any, str]] = []
    listed = any(role.leading and role.agent.id not in told for role in roles.movers)
    if roles.movers:
        present = mark_step_s is None and not listed  # an animation whose labels tell the speed
        rows.append((_line("none"), "km/h: speed at this time" if present else "km/h: highest speed of each"))
    numbered = []  # the ego first, then ids by their number: car-2 before car-10
    for role in roles.movers:
        name = role.agent.id.rstrip("0123456789")
        numbered.append((not role.is_ego, name, int(role.agent.id[len(name) :] or 0), role.agent.id, role))
    for *_, id, role in sorted(numbered, key=lambda entry: entry[:4]):
        if role.leading and id not in told:
            marker, category = "s" if role.is_ego else role.marker, role.agent.category
            name = "ego" if role.is_ego else style.printable_label(id, 20)
            name += "" if role.is_ego or id.startswith(category) else f" · {category}"
            line = _line(role.color, lw=2.4 if role.is_ego else 1.7, marker=marker, ms=4.6)
            rows.append((line, f"{name} · {speed_text(role.agent)}"))
    rest = sum(not r.leading for r in roles.movers)
    if rest:
        rows.append((_line(style.CROWD_COLOR, lw=1.0), f"{rest} more moving, farther away"))
    if roles.stationary:
        rows.append((Patch(fc=style.PARKED_FACE, ec=style.PARKED_EDGE, lw=0.6), f"{len(roles.stationary)} static"))
    if roles.movers and mark_step_s is not None:
        rows.append((Patch(fc=style.PAPER, ec=style.MUTED, lw=0.9), "start (hollow), end (filled)"))
        rows.append(
            (_line("none", marker="o", ms=3.2, mfc=style.PAPER, mec=style.MUTED, mew=0.9), f"every {mark_step_s:g} s")
        )
    if mark_step_s is not None and any(not r.agent.waypoints.observed.all() for r in roles.movers):
        rows.append((_line(style.MUTED, lw=1.3, ls=(0, (2.2, 1.8))), "not observed, interpolated"))
    if any(a.color is not None for a in (*(r.agent for r in roles.movers), *roles.stationary)):
        nose = _line("none", marker="^", ms=4.6, mfc="#C0392B", mec=style.MUTED, mew=0.4)
        rows.append((nose, "heading, in the vehicle's color"))
    if truth:
        rows.append((_line(style.INK, lw=0.8, ls=(0, (3, 2))), "truth"))
    if replay:
        rows.append((_line(style.MUTED, lw=1.9, ls=(0, (0.1, 1.6)), dash_capstyle="round"), "replay"))
    if collisions:
        rows.append((Line2D([], [], ls="none", **{**style.COLLISION_MARK, "ms": 6.0}), "collision of the replay"))
    if outside:
        rows.append((_line("none"), f"{outside} outside this view"))
    return rows


def draw_scale_and_north(layout: FigureLayout, *, projected: bool) -> None:
    """Draw a scale bar of a round length at the foot of the column, and a north arrow on a projected map."""
    height = layout.figure.get_figheight()
    m_per_in = layout.view.m_per_pt * 72
    length_m = nice_step(1.35 * m_per_in)
    x, y, w = layout.width_in - SIDE_IN + 0.06, layout.foot_in + BOTTOM_IN + 0.08, length_m / m_per_in
    column = layout.figure.add_axes((0, 0, 1, 1), frameon=False)
    column.set(xlim=(0, layout.width_in), ylim=(0, height), xticks=[], yticks=[])
    column.set_zorder(-1)
    for k, face in enumerate((style.INK, style.PAPER)):
        left, right, top = x + k * w / 2, x + k * w / 2 + w / 2, y + 0.06
        corners = [(left, y), (right, y), (right, top), (left, top)]
        column.add_patch(Polygon(corners, fc=face, ec=style.INK, lw=0.8, closed=True))
    look: dict[str, Any] = {"family": style.FONT, "fontsize": 7, "color": style.INK, "va": "bottom"}
    column.text(x, y + 0.1, "0", ha="center", **look)
    column.text(x + w, y + 0.1, f"{length_m:g} m", ha="center", **look)
    if projected:
        nx, ny = layout.width_in - 0.42, y
        for aside, face in ((-0.1, style.INK), (0.1, style.PAPER)):
            corners = [(nx, ny + 0.4), (nx + aside, ny), (nx, ny + 0.09)]
            column.add_patch(Polygon(corners, fc=face, ec=style.INK, lw=0.8))
        column.text(nx, ny + 0.44, "N", ha="center", **{**look, "fontsize": 8.5, "fontweight": "bold"})


def _line(color: str, **look: Any) -> Line2D:
    edge = {"mec": style.PAPER, "mew": 0.5} if "mec" not in look else {}
    return Line2D([0, 1], [0, 1], color=color, **{"lw": 0, "mfc": color, **edge, **look})
