"""Labels of an animation, which go along with their agents and keep clear of each other."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.text import Text

from log2sim.datatypes import STANDSTILL_MPS
from log2sim.geometry import Array
from log2sim.visualization.plot.labels import MOVER_PT, LabelRoom, short_label
from log2sim.visualization.plot.roles import AgentRole, AgentRoles
from log2sim.visualization.plot.style import FONT, halo
from log2sim.visualization.plot.viewport import Viewport

MAX_NAMED = 8
"""With more leading movers their speeds are in the legend: longer labels would cover the boxes of others."""

SIDES = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, 1), (1, -1), (-1, -1))
"""Where a label may be beside its box, the best first."""

GAP_PT = 2.0


def names_fit(roles: AgentRoles) -> bool:
    """Tell whether labels of an animation have speeds, so that the legend need not list them."""
    return sum(role.leading for role in roles.movers) <= MAX_NAMED


class MovingLabels:
    """Labels of the leading movers; each keeps to its side of the box as long as there is room."""

    def __init__(self, ax: Axes, view: Viewport, roles: AgentRoles) -> None:
        self._ax, self._view, self._named = ax, view, names_fit(roles)
        self._texts = {role.agent.id: _hidden_text(ax, role) for role in roles.movers if role.leading}
        self._side: dict[str, tuple[int, int]] = {}

    def show(self, present: list[tuple[AgentRole, Array, float]]) -> None:
        """Draw the labels of movers beside the corners (4, 2) of their boxes, with their speeds, m/s, in the order of their rank."""
        room = LabelRoom(self._view, [(*c.min(axis=0), *c.max(axis=0)) for _, c, _ in present])
        for role, corners, speed_mps in present:
            text = self._texts.get(role.agent.id)
            if text is None:
                continue
            text.set_text(self._text_of(role, speed_mps))
            place = self._place(role.agent.id, text.get_text(), corners, room)
            if place is not None:
                text.set_position((place[0], place[1]))
                self._ax.draw_artist(text)

    def _text_of(self, role: AgentRole, speed_mps: float) -> str:
        if not self._named:
            return short_label(role)
        name = short_label(role)
        moves = abs(speed_mps) >= STANDSTILL_MPS
        return f"{name} · {abs(speed_mps) * 3.6:.0f} km/h" if moves else name

    def _place(self, id: str, text: str, corners: Array, room: LabelRoom) -> Array | None:
        """Reserve room for a label, at the side where it was if that is free; None without."""
        low, high = corners.min(axis=0), corners.max(axis=0)
        half = room.half_size(text, MOVER_PT)
        before = self._side.get(id)
        for side in (before, *SIDES) if before is not None else SIDES:
            place = (low + high) / 2 + np.array(side) * ((high - low) / 2 + half + GAP_PT * self._view.m_per_pt)
            if room.is_free(place, half):
                room.taken.append((*(place - half), *(place + half)))
                self._side[id] = side
                return np.asarray(place)
        return None


def _hidden_text(ax: Axes, role: AgentRole) -> Text:
    style: dict[str, Any] = {"family": FONT, "fontweight": "bold", "parse_math": False, "animated": True}
    return ax.text(
        0, 0, "", color=role.color, fontsize=MOVER_PT, path_effects=halo(), clip_on=True, ha="center",
        va="center_baseline", zorder=9, **style,
    )  # fmt: skip
