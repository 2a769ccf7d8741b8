"""What a picture shows: tracks, boxes, lanes, doubts, predictions, warnings, collisions, observers; a few collections stay fast."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Iterator, Sequence, Set
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgba
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Wedge

from log2sim import datatypes
from log2sim.geometry import Array, Polyline
from log2sim.road.ground_map import GroundMap
from log2sim.simulation.metrics.collisions import REPLAY
from log2sim.simulation.prediction.prediction import DEFAULT_METHOD, predict_scenario
from log2sim.visualization.plot import viewport
from log2sim.visualization.plot.selection import NO_OPTIONS, PlotOptions, TimeRange
from log2sim.visualization.plot.style import (
    BORDER_COLOR,
    COLLISION_MARK,
    FONT,
    INK,
    LANE_ARROW,
    LANE_FACE,
    MARKING_COLOR,
    MUTED,
    PAPER,
    PARKED_EDGE,
    PARKED_FACE,
    SENSOR_COLOR,
    SENSOR_PT,
    SIGNAL_COLOR,
    WARNING,
    halo,
    printable_label,
)
from log2sim.visualization.plot.viewport import AgentRole, AgentRoles, Viewport, centers_xy, is_moving, paint_of

BACKGROUND, STATIONARY, TRUTH, TRACK, MARK, DRIVEN, BOX, LABEL = range(1, 9)  # z-order, from the bottom up


def add_polygons(ax: Axes, corners: Iterable[Array], **style: Any) -> None:
    """Add polygons, each (K, 2), in one collection, which does not change the limits of the axes."""
    ax.add_collection(PolyCollection(list(corners), **style), autolim=False)


def add_lines(ax: Axes, lines: Iterable[Array], **style: Any) -> None:
    """Add lines, each (K, 2), in one collection, which does not change the limits of the axes."""
    ax.add_collection(LineCollection(list(lines), **style), autolim=False)


def draw_stationary(ax: Axes, agents: Sequence[datatypes.Agent], view: Viewport) -> None:
    """Draw stationary agents as gray boxes; as a dot where the box would be too small to see."""
    if not agents:
        return
    middle = [len(a.waypoints) // 2 for a in agents]
    xy = np.array([centers_xy(a)[k] for a, k in zip(agents, middle)])
    corners = np.concatenate([viewport.footprints(a, p, a.waypoints.yaw_rad[k]) for a, p, k in zip(agents, xy, middle)])
    edge: dict[str, Any] = {"edgecolors": PARKED_EDGE, "zorder": STATIONARY}
    add_polygons(ax, corners, facecolors=PARKED_FACE, linewidths=0.6, **edge)
    paints = [paint_of(a, PARKED_EDGE) for a in agents]
    add_polygons(ax, viewport.heading_triangles(corners), facecolors=paints, linewidths=0.3, **edge)
    small = np.array([max(a.size_m[:2]) < 5 * view.m_per_pt for a in agents])
    if small.any():
        ax.plot(xy[small, 0], xy[small, 1], "o", ms=3, mfc=PARKED_FACE, mec=PARKED_EDGE, mew=0.6, zorder=STATIONARY)


def draw_tracks(
    ax: Axes, roles: AgentRoles, view: Viewport, step_s: float, *, alpha: float, faint: bool = False
) -> None:
    """Draw tracks as lines with arrowheads, filled gaps dashed, and time marks.

    `alpha`: below 1 lines become pale ribbons under overlays. `faint`: lines only, as the background of an animation.
    """
    for leading in (False, True):
        same_rank = [r for r in roles.movers if r.leading is leading]
        _lines(ax, same_rank, alpha if leading else alpha * 0.5, leading)
    shown = [role for role in roles.movers if role.leading]
    heads = [(head, role.color) for role in shown for head in viewport.arrows(centers_xy(role.agent), view)]
    if faint:
        return
    if heads:
        faces = [color for _, color in heads]
        add_polygons(ax, [h for h, _ in heads], facecolors=faces, edgecolors=PAPER, linewidths=0.5, zorder=MARK)
    for role in shown:
        t, xy = viewport.time_marks(role.agent, step_s)
        apart = np.append(True, np.hypot(*np.diff(xy, axis=0).T) > 4 * view.m_per_pt)[: len(t)]
        ax.plot(*xy[apart].T, "o", ms=2.7, mfc=PAPER, mec=role.color, mew=0.8, zorder=MARK + 0.1, ls="none")


def draw_ends(ax: Axes, roles: AgentRoles, view: Viewport, *, ghosts_step_s: float | None) -> None:
    """Draw boxes at real size: hollow at the start, filled at the end, pale every `ghosts_step_s` unless None."""
    for rank, role in enumerate(reversed(roles.movers)):
        agent, w, xy = role.agent, role.agent.waypoints, centers_xy(role.agent)
        alpha = 1.0 if role.leading else 0.55
        z = BOX + rank / (len(roles.movers) + 1) * 0.5
        if ghosts_step_s is not None and role.leading:
            t, at = viewport.time_marks(agent, ghosts_step_s)
            apart = viewport.spaced_apart(at, xy[[0, -1]], 1.15 * agent.size_m[0])
            if apart.any():
                ghost = viewport.footprints(agent, at[apart], agent.at(t[apart]).yaw_rad)
                faint = {"facecolors": to_rgba(role.color, 0.10), "edgecolors": to_rgba(role.color, 0.4)}
                add_polygons(ax, ghost, linewidths=0.8, zorder=TRACK - 0.5, **faint)
        first, last = (viewport.footprints(agent, xy[k], w.yaw_rad[k]) for k in (0, -1))
        paint = paint_of(agent, to_rgba(PAPER, 0.85))
        rim = "none" if agent.color is None else to_rgba(PAPER, 0.85)
        for corners, face, edge, level in (
            (first, to_rgba(PAPER, 0.75), to_rgba(role.color, 0.9 * alpha), z - 0.6),
            (last, to_rgba(role.color, 0.92 * alpha), PAPER, z),
            (viewport.heading_triangles(last), paint, rim, z),
        ):
            add_polygons(ax, corners, facecolors=face, edgecolors=edge, linewidths=0.8, zorder=level)
        if max(agent.size_m[:2]) < 9 * view.m_per_pt:
            face = to_rgba(role.color, alpha)
            ax.plot(*xy[-1], role.marker, ms=4.2, mfc=face, mec=PAPER, mew=0.7, zorder=z + 0.01)


def draw_truth(ax: Axes, truth: datatypes.Scenario) -> None:
    """Draw the truth as thin dark dashed lines and hollow dashed boxes."""
    tracks, corners = [], []
    for agent in truth.agents:
        xy = centers_xy(agent)
        if is_moving(agent):
            tracks.append(xy)
        corners.append(viewport.footprints(agent, xy[-1], agent.waypoints.yaw_rad[-1])[0])
    style: dict[str, Any] = {"linewidths": 0.8, "linestyles": [(0, (3, 2))], "zorder": BOX + 0.8}
    add_lines(ax, tracks, colors=to_rgba(INK, 0.9), **style)
    add_polygons(ax, corners, facecolors="none", edgecolors=to_rgba(INK, 0.9), **style)


def draw_replay(ax: Axes, replay: Any, roles: AgentRoles) -> None:
    """Draw replayed trajectories as dotted lines with a dotted box at the end, in the color of the track."""
    role_of = {role.agent.id: role for role in roles.movers}
    tracks, colors, ends = [], [], []
    for driven in replay.agents:
        role = role_of.get(driven.id)
        if role is not None and len(driven.t_s):
            xy = np.column_stack([driven.x_m, driven.y_m])
            tracks.append(xy)
            colors.append(to_rgba(role.color))
            ends.append(viewport.footprints(role.agent, xy[-1], np.asarray(driven.yaw_rad)[-1])[0])
    dots: dict[str, Any] = {"linestyles": [(0, (0.1, 2.0))], "linewidths": 1.6, "capstyle": "round"}
    add_lines(ax, tracks, colors=colors, zorder=DRIVEN, **dots)
    dotted: dict[str, Any] = {"linestyles": [(0, (1, 1.2))], "linewidths": 1.1}
    add_polygons(ax, ends, facecolors="none", edgecolors=colors, zorder=BOX + 0.7, **dotted)


def draw_collisions(ax: Axes, xy_m: Array, **style: Any) -> Line2D:
    """Mark collisions that belong to the replay."""
    return ax.plot(*xy_m.T, ls="none", zorder=LABEL - 0.1, **COLLISION_MARK, **style)[0]


def _lines(ax: Axes, roles: list[AgentRole], alpha: float, leading: bool) -> None:
    observed: list[tuple[Array, str]] = []
    filled: list[tuple[Array, str]] = []
    for role in reversed(roles):
        xy, known = centers_xy(role.agent), role.agent.waypoints.observed
        both = known[:-1] & known[1:]
        for kind, keep in ((observed, both), (filled, ~both)):
            edges = np.flatnonzero(np.diff(keep.astype(np.int8), prepend=0, append=0))
            kind.extend((xy[start : stop + 1], role.color) for start, stop in zip(edges[::2], edges[1::2]))
    ribbon = 1.5 if alpha < 1.0 else 1.0
    width = [ribbon * (2.4 if c == INK else 1.7) for _, c in observed] if leading else [1.0] * len(observed)
    parts, colors = [p for p, _ in observed], [to_rgba(c, alpha) for _, c in observed]
    if leading and alpha == 1.0:
        rim = {"colors": to_rgba(PAPER, 0.85), "linewidths": [w + 1.6 for w in width]}
        add_lines(ax, parts, zorder=TRACK - 0.2, capstyle="round", **rim)
    add_lines(ax, parts, colors=colors, linewidths=width, zorder=TRACK, capstyle="round")
    gaps, colors = [p for p, _ in filled], [to_rgba(c, alpha) for _, c in filled]
    add_lines(ax, gaps, colors=colors, linewidths=1.3, zorder=TRACK, linestyle=(0, (2.2, 1.8)))


STEP_S = 0.1  # between the points of a line: ends observe at the rate of their LiDARs
WIDTH_PT, BESIDE_PT = 1.3, 3.4  # width of a line, and how far to the right of the track it is


def lines_of(agent: datatypes.Agent, end: str, aside_m: float = 0.0) -> list[Array]:
    """Return lines (K, 2), m, map frame, along which an end alone observed an agent; `aside_m` to its right."""
    w = agent.waypoints
    if not agent.observed_by.get(end) or len(w) < 2:
        return []
    t_s = np.arange(w.t_s[0], w.t_s[-1] + STEP_S / 2, STEP_S)
    alone = np.ones(len(t_s), dtype=bool)
    for other in datatypes.ENDS:
        spans = agent.observed_by.get(other, ())
        seen = np.any([t_s < -np.inf, *((t_s >= a - 1e-6) & (t_s <= b + 1e-6) for a, b in spans)], axis=0)
        alone &= seen if other == end else ~seen
    states = agent.trajectory.at(t_s)
    right = states.yaw_rad - np.pi / 2
    points = np.column_stack([states.x_m + aside_m * np.cos(right), states.y_m + aside_m * np.sin(right)])
    runs = np.split(np.arange(len(t_s)), np.flatnonzero(np.diff(alone)) + 1)
    return [points[run] for run in runs if alone[run[0]] and len(run) > 1]


LINE: dict[str, Any] = {"color": WARNING, "lw": 1.2, "ls": (0, (4.0, 2.5)), "marker": "o", "ms": 3.5, "mfc": "none"}
TEXT_PT = -9.0  # how far above the middle of the line its text is


def warned_events(replay: Any) -> list[Any]:
    """List the warnings of a replay."""
    return [] if replay is None or replay.warnings is None else [w for w in replay.warnings.events if w.warned]


def draw_warnings(ax: Axes, replay: Any) -> None:
    """Draw a line from the warned vehicle to the agent for each warning, where they are first warned, with the time and the distance."""
    for w in warned_events(replay):
        t_s, pair = w.warned.t_s, [replay.agent(id) for id in (w.driver, w.agent)]
        ends_m = np.array([[float(np.interp(t_s, a.t_s, c)) for c in (a.x_m, a.y_m)] for a in pair])
        ax.plot(*ends_m.T, zorder=LABEL - 0.2, **LINE)
        ax.annotate(
            f"{t_s:.1f} s: {w.warned.distance_m:.1f} m", ends_m.mean(axis=0), (0.0, TEXT_PT), textcoords="offset points",
            color=WARNING, fontsize=6.5, fontweight="bold", family=FONT, ha="center", va="center", path_effects=halo(),
            zorder=LABEL, parse_math=False, annotation_clip=True,
        )  # fmt: skip


def new_collisions(replay: Any) -> tuple[Array, Array]:
    """Find when collisions of a replay begin (K,), s, that its scenario does not have, and the middles (K, 2) of both boxes, m."""
    if replay is None:
        return np.zeros(0), np.zeros((0, 2))
    events = [e for e in replay.metrics.get("collisions", ()) if e["belongs_to"] == REPLAY]
    agents = {a.id: a for a in replay.agents}

    def place(t_s: float, id: str) -> list[float]:
        return [float(np.interp(t_s, agents[id].t_s, c)) for c in (agents[id].x_m, agents[id].y_m)]

    places = [np.mean([place(e["t_s"], id) for id in e["agents"]], axis=0) for e in events]
    return np.array([e["t_s"] for e in events], dtype=np.float64), np.array(places, dtype=np.float64).reshape(-1, 2)


DOTS: dict[str, Any] = {"linestyles": [(0, (1.0, 1.3))], "linewidths": 1.3}
ELLIPSE_ALPHA, ELLIPSE_EDGE_ALPHA = 0.14, 0.6
_CIRCLE = np.exp(2j * np.pi * np.arange(36) / 36)


class PredictedPaths:
    """Predictions of the agents of a scenario, to be drawn at times."""

    def __init__(self, scenario: datatypes.Scenario, horizon_s: float) -> None:
        self.horizon_s = horizon_s
        self._found = predict_scenario(scenario, horizon_s, methods=(DEFAULT_METHOD,))
        self._rows = {a.id: self._found.rows_of(a.id) for a in scenario.agents}

    def at(self, agent: str, t_s: float) -> tuple[Array, Array] | None:
        """Return what was expected of an agent at the last tick up to a time; None when it is absent or stands.

        The path (H + 1, 2), m, from where it is to where it is expected to be, and the ellipse (V, 2) of one standard deviation there.
        """
        found, rows = self._found, self._rows[agent]
        table, ticks = found.table, found.tick[rows]
        k = int(np.searchsorted(table.t_s[ticks], t_s + 1e-6, side="right")) - 1
        if k < 0 or t_s - table.t_s[ticks[k]] > table.tick_s:
            return None
        forecast, row = found.forecasts[DEFAULT_METHOD], rows[k]
        if abs(table.velocity_mps[found.row[row], found.tick[row]]) < datatypes.STANDSTILL_MPS:
            return None
        path = np.append(table.position_m[found.row[row], ticks[k]], forecast.position_m[row])
        along, across = forecast.sigma_m[row, -1]
        rim = path[-1] + forecast.course[row, -1] * (along * _CIRCLE.real + 1j * across * _CIRCLE.imag)
        return np.column_stack([path.real, path.imag]), np.column_stack([rim.real, rim.imag])

    def times_of(self, agent: str) -> Array:
        """Choose the times (K,), s, at which a still picture shows what was expected of an agent.

        Every `horizon_s`, so that they follow each other, and at its last tick, after which nothing else is drawn.
        """
        found, rows = self._found, self._rows[agent]
        t = found.table.t_s[found.tick[rows]]
        if len(t) < 2:
            return t[:0]
        h = self.horizon_s
        regular = np.arange(np.ceil(t[0] / h + 1e-6), np.floor(t[-1] / h) + 1) * h
        return np.append(regular[regular < t[-1] - h / 3], t[-1])


def draw_predictions(ax: Axes, roles: AgentRoles, paths: PredictedPaths) -> None:
    """Draw what was expected of the leading movers at several times, as dotted lines with an ellipse at the end."""
    shown = [
        (role, expected)
        for role in roles.movers
        if role.leading
        for t in paths.times_of(role.agent.id)
        if role.agent.waypoints.t_s[0] <= t <= role.agent.waypoints.t_s[-1]
        if (expected := paths.at(role.agent.id, float(t))) is not None
    ]
    lines = LineCollection([], zorder=MARK + 0.2, **DOTS)
    ellipses = PolyCollection([], linewidths=0.7, zorder=TRACK - 0.4)
    show_expected(lines, ellipses, shown)
    for artist in (lines, ellipses):
        ax.add_collection(artist, autolim=False)


def show_expected(
    lines: LineCollection, ellipses: PolyCollection, shown: list[tuple[AgentRole, tuple[Array, Array]]]
) -> None:
    """Set paths and ellipses in the colors of the agents."""
    colors = [role.color for role, _ in shown]
    lines.set_segments([path for _, (path, _) in shown])
    lines.set_color([to_rgba(color) for color in colors])
    ellipses.set_verts([ellipse for _, (_, ellipse) in shown])
    ellipses.set_facecolor([to_rgba(color, ELLIPSE_ALPHA) for color in colors])
    ellipses.set_edgecolor([to_rgba(color, ELLIPSE_EDGE_ALPHA) for color in colors])


@dataclass(frozen=True, eq=False)
class Overlays:
    """What a picture shows besides the scenario, and the options that concern how."""

    replay: Any = None  # drawn over the scenario, with charts below the map
    truth: datatypes.Scenario | None = None  # in the time and map of the scenario
    background: GroundMap | None = None  # A picture of the ground, drawn below everything
    predicted: PredictedPaths | None = None
    span: TimeRange | None = None  # range of time that is shown; None for the whole scenario
    options: PlotOptions = NO_OPTIONS

    def span_of(self, scenario: datatypes.Scenario) -> TimeRange:
        """Return the range of time that is shown."""
        return self.span or TimeRange(0.0, scenario.duration_s)


MAX_NAMED = 5  # doubtful agents whose reasons are in the legend
LINE_LETTERS, MAX_LINES = 34, 3  # letters that fit into a line of the legend, and lines of one reason
MIN_SHOWN_S = 0.5  # a doubt about less time is shown for as much, so that it can be seen
STRIPES_PT, STRIPE_PT = 3.0, 0.9  # spacing and width of the stripes in boxes


def shown_spans(agent: datatypes.Agent) -> list[tuple[float, float]]:
    """List the spans of time in which an agent is shown as doubtful, s; infinite for its whole life."""
    if agent.confidence < datatypes.MIN_TRUSTED_CONFIDENCE:
        return [(-np.inf, np.inf)]
    spans = []
    for doubt in agent.doubts:
        start = -np.inf if doubt.start_s is None else doubt.start_s
        end = np.inf if doubt.end_s is None else doubt.end_s
        more = max(MIN_SHOWN_S - (end - start), 0.0) / 2
        spans.append((start - more, end + more))
    return spans


def is_doubted_at(agent: datatypes.Agent, t_s: float) -> bool:
    """Tell whether an agent is shown as doubtful at a time."""
    return any(start <= t_s <= end for start, end in shown_spans(agent))


def hatch_movers(ax: Axes, roles: AgentRoles, view: Viewport, z_track: float, z_box: float) -> None:
    """Stripe the tracks of movers where they are doubtful, and hatch their last boxes if they are so at the end."""
    tracks: list[Array] = []
    for role in roles.movers:
        tracks += doubtful_parts(role.agent)
        if is_doubted_at(role.agent, float(role.agent.waypoints.t_s[-1])):
            hatch(ax, role.agent, -1, view, stripe=PAPER, edge=role.color, z=z_box)
    dashes: dict[str, Any] = {"linestyles": [(0, (1.1, 1.4))], "linewidths": 1.3, "colors": PAPER, "zorder": z_track}
    add_lines(ax, tracks, **dashes)


def box_stripes(agent: datatypes.Agent, xy_m: Array, yaw_rad: float, view: Viewport) -> list[Array]:
    """Compute the stripes, each (2, 2), that hatch the box of an agent at a pose."""
    return list(viewport.stripes(viewport.footprints(agent, xy_m, yaw_rad)[0], STRIPES_PT * view.m_per_pt))


def doubtful_parts(agent: datatypes.Agent) -> Iterator[Array]:
    """Yield the parts of a track (K, 2) that are shown as doubtful."""
    w = agent.waypoints
    for start, end in shown_spans(agent):
        first, last = max(start, float(w.t_s[0])), min(end, float(w.t_s[-1]))
        if last > first:
            at = agent.at(np.linspace(first, last, max(int((last - first) / STEP_S), 1) + 1))
            yield np.column_stack([at.x_m, at.y_m])


def doubt_rows(roles: AgentRoles, told: Set[str] = frozenset()) -> list[tuple[Any, str]]:
    """List handles and texts of the legend: a line for each of the first doubtful agents but the `told` ones, with the reason."""
    doubtful = [(r.agent, r.color) for r in roles.movers if r.agent.is_doubtful]
    doubtful += [(a, PARKED_FACE) for a in roles.stationary if a.is_doubtful and a.id not in told]
    doubtful.sort(key=lambda entry: not entry[0].doubts)  # low confidence alone says less
    rows: list[tuple[Any, str]] = []
    for agent, color in doubtful[:MAX_NAMED]:
        text = printable_label(f"{agent.id} is doubtful: {datatypes.explain_doubt(agent)}", LINE_LETTERS * MAX_LINES)
        lines = textwrap.wrap(text, LINE_LETTERS, max_lines=MAX_LINES, placeholder=" …")
        rows.append((_hatched_patch(color), "\n".join(lines)))
    if len(doubtful) > MAX_NAMED:
        rows.append((Patch(fc="none", ec="none"), f"and {len(doubtful) - MAX_NAMED} more doubtful"))
    if not doubtful and any(a.is_doubtful for a in roles.stationary):
        rows.append((_hatched_patch(PARKED_FACE), "doubtful"))
    return rows


def _hatched_patch(color: str) -> Patch:
    return Patch(fc=color, ec=MUTED if color == PARKED_FACE else PAPER, hatch="//////", lw=0.6)


def hatch(ax: Axes, agent: datatypes.Agent, k: int, view: Viewport, *, stripe: str, edge: str, z: float) -> None:
    """Draw stripes and outline of the box at waypoint `k`."""
    xy_m, yaw_rad = centers_xy(agent)[k], float(agent.waypoints.yaw_rad[k])
    add_lines(ax, box_stripes(agent, xy_m, yaw_rad, view), colors=stripe, linewidths=STRIPE_PT, zorder=z)
    outline = viewport.footprints(agent, xy_m, yaw_rad)
    add_polygons(ax, outline, facecolors="none", edgecolors=edge, linewidths=0.9, zorder=z)


LANES, LINES = BACKGROUND + 0.2, BACKGROUND + 0.4  # z-order: above a picture of the ground, below what stands
MIN_LINE_PT, BORDER_PT = 0.9, 0.8
DASHES = (0, (4.0, 3.0))
ARROW_EVERY_M, ARROW_M = 15.0, (1.6, 0.7)  # arrows along lanes: distance from one to the next, length and half width
SENSOR: dict[str, Any] = {"marker": "^", "ms": SENSOR_PT, "mfc": SENSOR_COLOR, "mec": PAPER, "mew": 0.8, "ls": "none"}


def draw_road(ax: Axes, scenario: datatypes.Scenario, view: Viewport, *, over_picture: bool) -> None:
    """Draw the map features of a scenario; the faces of lanes not over a picture of the ground, which they would hide."""
    # Draw sensors that are fixed in the map with their fields of view; of those that look all around only the range.
    for sensor in scenario.sensors:
        half = min(np.rad2deg(sensor["fov_rad"]) / 2, 180.0)
        yaw, place = np.rad2deg(sensor["yaw_rad"]), (sensor["x_m"], sensor["y_m"])
        face = "none" if half > 179.9 else to_rgba(SENSOR_COLOR, 0.05)
        edge, z = to_rgba(SENSOR_COLOR, 0.3), LANES - 0.2
        ax.add_artist(Wedge(place, sensor["range_m"], yaw - half, yaw + half, fc=face, ec=edge, lw=0.8, zorder=z))
        ax.plot(*place, zorder=LINES + 3, scalex=False, scaley=False, **SENSOR)
    features = scenario.map_features
    if features is None:
        return
    if not over_picture:
        outlines = [lane_outline(lane) for lane in features.lanes]
        add_polygons(ax, outlines, facecolors=LANE_FACE, edgecolors="none", zorder=LANES)
    arrows = [arrow for lane in features.lanes for arrow in lane_arrows(lane)]
    add_polygons(ax, arrows, facecolors=LANE_ARROW, zorder=LANES + 0.1)
    borders = [border.points_m[:, :2] for border in features.borders]
    add_lines(ax, borders, colors=BORDER_COLOR, linewidths=BORDER_PT, zorder=LINES - 0.1)
    # Lines along their middle, dashed ones with dashes, and outlines of crosswalks and symbols.
    areas = [m for m in features.markings if m.kind in ("crosswalk", "other")]
    faces, edges = ([_shade(m, alpha) for m in areas] for alpha in (0.25, 0.9))
    style: dict[str, Any] = {"linewidths": 0.6, "hatch": "////", "zorder": LINES}
    add_polygons(ax, [m.points_m[:, :2] for m in areas], facecolors=faces, edgecolors=edges, **style)
    for dashed in (False, True):
        lines = [m for m in features.markings if m not in areas and (m.kind == "dashed") is dashed]
        widths = [max(m.width_m / view.m_per_pt, MIN_LINE_PT) for m in lines]
        style = {"linestyles": [DASHES]} if dashed else {"capstyle": "butt"}
        points, colors = [m.points_m[:, :2] for m in lines], [_shade(m, 1.0) for m in lines]
        add_lines(ax, points, colors=colors, linewidths=widths, zorder=LINES, **style)


class SignalLights:
    """Traffic lights of an animation, each in the color of its state at the time that is shown."""

    def __init__(self, ax: Axes, signals: Sequence[datatypes.Signal]) -> None:
        self._ax, self._signals = ax, signals
        style: dict[str, Any] = {"ls": "none", "marker": "o", "ms": 5.0, "mec": PAPER, "mew": 0.9, "animated": True}
        self._marks = [ax.plot(*signal.position_m[:2], zorder=LABEL - 0.3, **style)[0] for signal in signals]

    def show(self, t_s: float) -> None:
        """Draw the states at a time, s."""
        for signal, mark in zip(self._signals, self._marks):
            mark.set_markerfacecolor(SIGNAL_COLOR[str(signal.at(t_s)[0])])
            self._ax.draw_artist(mark)


def road_rows(scenario: datatypes.Scenario) -> list[tuple[Any, str]]:
    """Return the lines of the legend for what there is."""
    features = scenario.map_features
    rows: list[tuple[Any, str]] = []
    if features is not None:
        if features.lanes:
            inferred = sum(lane.inferred_from == "paths" for lane in features.lanes)
            text = f"{len(features.lanes)} lanes" + (f", {inferred} from paths alone" if inferred else "")
            rows.append((Patch(fc=LANE_FACE, ec="none"), text))
        if features.markings:
            rows.append((Line2D([0, 1], [0, 1], color=MARKING_COLOR["white"], lw=1.3), "marking on the ground"))
        if any(m.color == "yellow" for m in features.markings):
            rows.append((Line2D([0, 1], [0, 1], color=MARKING_COLOR["yellow"], lw=1.3), "yellow marking"))
        if features.borders:
            rows.append((Line2D([0, 1], [0, 1], color=BORDER_COLOR, lw=BORDER_PT), "border of a road"))
    if scenario.sensors:
        rows.append((Line2D([], [], **{**SENSOR, "mew": 1.0}), "sensor at the road, its field of view"))
    if scenario.signals:
        style: dict[str, Any] = {"marker": "o", "ms": 5.0, "mfc": SIGNAL_COLOR["red"], "mec": PAPER, "ls": "none"}
        rows.append((Line2D([], [], **style), "traffic light"))
    return rows


def lane_outline(lane: datatypes.MapLane) -> Array:
    """Return the outline (2 N, 2) of a lane, m, map frame."""
    xy = lane.points_m[:, :2]
    along = np.gradient(xy, axis=0)
    along /= np.maximum(np.hypot(*along.T), 1e-9)[:, None]
    aside = np.stack([-along[:, 1], along[:, 0]], axis=1) * lane.width_m[:, None] / 2
    return np.concatenate([xy + aside, (xy - aside)[::-1]])


def lane_arrows(lane: datatypes.MapLane) -> list[Array]:
    """Return triangles (3, 2), m, along the middle of a lane that show its direction."""
    traveled = Polyline(lane.points_m).s_m
    count = max(int(traveled[-1] // ARROW_EVERY_M), 1)
    if traveled[-1] < 2 * ARROW_M[0]:
        return []
    arrows = []
    for s in (np.arange(count) + 0.5) * traveled[-1] / count:
        tip, tail = (
            np.array([np.interp(s + d, traveled, column) for column in lane.points_m[:, :2].T])
            for d in (ARROW_M[0] / 2, -ARROW_M[0] / 2)
        )
        ahead = tip - tail
        left = np.array([-ahead[1], ahead[0]]) / max(float(np.hypot(*ahead)), 1e-9) * ARROW_M[1]
        arrows.append(np.array([tip, tail + left, tail - left]))
    return arrows


def _shade(marking: datatypes.Marking, alpha: float) -> tuple[float, float, float, float]:
    doubtful = marking.confidence < datatypes.MIN_TRUSTED_CONFIDENCE
    return to_rgba(MARKING_COLOR[marking.color or "white"], alpha * (0.4 if doubtful else 1.0))
