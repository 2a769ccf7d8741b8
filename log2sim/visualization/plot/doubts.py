"""What a picture shows of doubtful agents: hatched boxes, striped tracks, and the reasons in the legend."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Set
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.patches import Patch

from log2sim.datatypes import MIN_TRUSTED_CONFIDENCE, Agent, why_doubtful
from log2sim.geometry import Array
from log2sim.visualization.plot import shapes
from log2sim.visualization.plot.roles import AgentRoles, centers_xy
from log2sim.visualization.plot.style import MUTED, PAPER, PARKED_FACE, printable
from log2sim.visualization.plot.viewport import Viewport

MAX_NAMED = 5
"""Doubtful agents whose reasons are in the legend."""

LINE_LETTERS, MAX_LINES = 34, 3
"""Letters that fit into a line of the legend, and lines of one reason."""

MIN_SHOWN_S = 0.5
"""A doubt about less time is shown for as much, so that it can be seen."""

STEP_S = 0.1
"""Spacing at which the doubtful part of a track is followed."""

STRIPES_PT, STRIPE_PT = 3.0, 0.9
"""Spacing and width of the stripes in boxes."""


def shown_spans(agent: Agent) -> list[tuple[float, float]]:
    """List the spans of time in which an agent is shown as doubtful, s; infinite for its whole life."""
    if agent.confidence < MIN_TRUSTED_CONFIDENCE:
        return [(-np.inf, np.inf)]
    spans = []
    for doubt in agent.doubts:
        start = -np.inf if doubt.start_s is None else doubt.start_s
        end = np.inf if doubt.end_s is None else doubt.end_s
        more = max(MIN_SHOWN_S - (end - start), 0.0) / 2
        spans.append((start - more, end + more))
    return spans


def is_doubted_at(agent: Agent, t_s: float) -> bool:
    """Tell whether an agent is shown as doubtful at a time."""
    return any(start <= t_s <= end for start, end in shown_spans(agent))


def hatch_stationary(ax: Axes, roles: AgentRoles, view: Viewport, z: float) -> None:
    """Hatch the boxes of doubtful stationary agents, whenever the doubt holds."""
    for agent in roles.stationary:
        if agent.is_doubtful:
            _hatch(ax, agent, len(agent.waypoints) // 2, view, stripe=MUTED, edge=MUTED, z=z)


def hatch_movers(ax: Axes, roles: AgentRoles, view: Viewport, z_track: float, z_box: float) -> None:
    """Stripe the tracks of movers where they are doubtful, and hatch their last boxes if they are so at the end."""
    tracks: list[Array] = []
    for role in roles.movers:
        tracks += doubtful_parts(role.agent)
        if is_doubted_at(role.agent, float(role.agent.waypoints.t_s[-1])):
            _hatch(ax, role.agent, -1, view, stripe=PAPER, edge=role.color, z=z_box)
    dashes: dict[str, Any] = {"linestyles": [(0, (1.1, 1.4))], "linewidths": 1.3, "colors": PAPER, "zorder": z_track}
    ax.add_collection(LineCollection(tracks, **dashes), autolim=False)


def box_stripes(agent: Agent, xy_m: Array, yaw_rad: float, view: Viewport) -> list[Array]:
    """Compute the stripes, each (2, 2), that hatch the box of an agent at a pose."""
    return list(shapes.stripes(shapes.footprints(agent, xy_m, yaw_rad)[0], STRIPES_PT * view.m_per_pt))


def doubtful_parts(agent: Agent) -> Iterator[Array]:
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
        rows.append((_hatched_patch(color), _wrapped(f"{agent.id} is doubtful: {why_doubtful(agent)}")))
    if len(doubtful) > MAX_NAMED:
        rows.append((Patch(fc="none", ec="none"), f"and {len(doubtful) - MAX_NAMED} more doubtful"))
    if not doubtful and any(a.is_doubtful for a in roles.stationary):
        rows.append((_hatched_patch(PARKED_FACE), "doubtful"))
    return rows


def _hatched_patch(color: str) -> Patch:
    return Patch(fc=color, ec=MUTED if color == PARKED_FACE else PAPER, hatch="//////", lw=0.6)


def _wrapped(text: str) -> str:
    whole = printable(text, LINE_LETTERS * MAX_LINES)
    return "\n".join(textwrap.wrap(whole, LINE_LETTERS, max_lines=MAX_LINES, placeholder=" …"))


def _hatch(ax: Axes, agent: Agent, k: int, view: Viewport, *, stripe: str, edge: str, z: float) -> None:
    """Draw stripes and outline of the box at waypoint `k`."""
    xy_m, yaw_rad = centers_xy(agent)[k], float(agent.waypoints.yaw_rad[k])
    lines = LineCollection(box_stripes(agent, xy_m, yaw_rad, view), colors=stripe, linewidths=STRIPE_PT, zorder=z)
    outline = list(shapes.footprints(agent, xy_m, yaw_rad))
    ax.add_collection(lines, autolim=False)
    ax.add_collection(
        PolyCollection(outline, facecolors="none", edgecolors=edge, linewidths=0.9, zorder=z), autolim=False
    )
