"""Tracks, boxes and labels on the map axes, as a few collections, so that 500 agents stay fast."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgba
from matplotlib.lines import Line2D

from log2sim.datatypes import Agent, Scenario
from log2sim.geometry import Array
from log2sim.road.ground_map import GroundMap
from log2sim.visualization.plot import viewport
from log2sim.visualization.plot.style import COLLISION_MARK, INK, PAPER, PARKED_EDGE, PARKED_FACE
from log2sim.visualization.plot.viewport import AgentRole, AgentRoles, Viewport, centers_xy, is_moving, paint_of

BACKGROUND, STATIONARY, TRUTH, TRACK, MARK, REPLAY, BOX, LABEL = range(1, 9)  # z-order, from the bottom up


def draw_background(ax: Axes, picture: GroundMap) -> None:
    """Draw a top-down picture below everything, lightened so that tracks stand out."""
    pale = 0.62 * picture.image_bgr[..., ::-1].astype(np.float32) + 0.38 * 255
    rgba = np.dstack([np.rint(pale).astype(np.uint8), (picture.alpha * 0.95).astype(np.uint8)])
    style: dict[str, Any] = {"origin": "upper", "interpolation": "antialiased", "aspect": "auto"}
    ax.imshow(rgba, extent=picture.extent_m, zorder=BACKGROUND, **style)


def add_polygons(ax: Axes, corners: Iterable[Array], **style: Any) -> None:
    """Add polygons, each (K, 2), in one collection, which does not change the limits of the axes."""
    ax.add_collection(PolyCollection(list(corners), **style), autolim=False)


def add_lines(ax: Axes, lines: Iterable[Array], **style: Any) -> None:
    """Add lines, each (K, 2), in one collection, which does not change the limits of the axes."""
    ax.add_collection(LineCollection(list(lines), **style), autolim=False)


def draw_stationary(ax: Axes, agents: Sequence[Agent], view: Viewport) -> None:
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
    ax: Axes, roles: AgentRoles, view: Viewport, step_s: float, *, alpha: float = 1.0, faint: bool = False
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


def draw_truth(ax: Axes, truth: Scenario) -> None:
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
    add_lines(ax, tracks, colors=colors, zorder=REPLAY, **dots)
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
