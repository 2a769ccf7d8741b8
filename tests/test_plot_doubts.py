"""Doubtful agents in pictures: hatched boxes, striped tracks, reasons in the legend."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from export_worlds import straight, world
from matplotlib.collections import LineCollection

from log2sim.datatypes import Agent, Doubt, Scenario
from log2sim.geometry import Array, box_corners_bev
from log2sim.visualization.plot import layers, viewport
from log2sim.visualization.plot.layout import FigureLayout
from log2sim.visualization.plot.tracks import still
from log2sim.visualization.plot.viewport import assign_roles


def doubted(agent: Agent, *spans: tuple[float | None, float | None]) -> Agent:
    return replace(agent, doubts=tuple(Doubt("reversing", "reverses at 7.4 m/s", *span) for span in spans))


def scene() -> Scenario:
    """Movers doubtful from 1 to 2 s, at the end, and for low confidence; a standing one; and one without a doubt."""
    names = ("middle", "end", "unsure", "sure")
    middle, end, unsure, sure = (straight(name, start=(0.0, 6.0 * k)) for k, name in enumerate(names, start=1))
    parked = replace(straight("parked", start=(20.0, -8.0), speed=0.0), static=True)
    agents = doubted(middle, (1.0, 2.0)), doubted(end, (2.5, None)), replace(unsure, confidence=0.2), sure
    return world(straight("ego"), *agents, doubted(parked, (None, None)))


def drawn(scenario: Scenario) -> FigureLayout:
    return still(scenario, assign_roles(scenario))


def striped(layout: FigureLayout) -> list[Array]:
    """The middles of all groups of stripes."""
    groups = [c.get_segments() for c in layout.ax.collections if isinstance(c, LineCollection)]
    return [np.mean(g, axis=(0, 1)) for g in groups if len(g) > 1 and all(len(s) == 2 for s in g)]


@pytest.mark.parametrize("yaw", [0.0, 0.7, -2.9])
@pytest.mark.parametrize("spacing_m", [0.2, 0.5, 40.0])
def test_stripes_cross_the_box_at_45_degrees(yaw: float, spacing_m: float) -> None:
    corners = box_corners_bev([[3.0, -2.0]], 4.4, 1.8, yaw)[0]
    lines = viewport.stripes(corners, spacing_m)
    c, s = np.cos(yaw), np.sin(yaw)
    local = (lines - [3.0, -2.0]) @ np.array([[c, -s], [s, c]])
    assert len(lines) >= 2
    assert np.abs(local).max(axis=(0, 1)) == pytest.approx([2.2, 0.9], abs=0.51 * spacing_m if spacing_m < 1 else 2)
    assert (np.abs(local) <= np.array([2.2, 0.9]) + 1e-9).all()
    on_edge = np.isclose(np.abs(local), [2.2, 0.9]).any(axis=-1)
    assert on_edge.all()  # from side to side
    step = local[:, 1] - local[:, 0]
    np.testing.assert_allclose(np.abs(step[:, 0]), np.abs(step[:, 1]), atol=1e-9)


def test_a_track_is_striped_where_it_is_doubtful() -> None:
    agent = doubted(straight("car"), (1.0, 2.0))
    (part,) = layers.doubtful_parts(agent)
    np.testing.assert_allclose(part[[0, -1], 0], [5.0, 10.0])
    (whole,) = layers.doubtful_parts(replace(straight("car"), confidence=0.49))
    np.testing.assert_allclose(whole[[0, -1], 0], [0.0, 15.0])
    assert list(layers.doubtful_parts(doubted(straight("car"), (7.0, 8.0)))) == []
    (moment,) = layers.doubtful_parts(doubted(straight("car"), (1.0, 1.0)))
    assert moment[-1, 0] - moment[0, 0] == pytest.approx(5.0 * layers.MIN_SHOWN_S)  # a moment could not be seen


def test_boxes_are_hatched_where_they_are_doubtful() -> None:
    places = striped(drawn(scene()))
    for hatched in ([15.0, 12.0], [15.0, 18.0], [20.0, -8.0]):  # the ends of "end" and "unsure", and what is parked
        assert min(np.hypot(*(place - hatched)) for place in places) < 0.05
    assert len(places) == 3
    clean = scene()
    assert (
        striped(drawn(replace(clean, agents=tuple(replace(a, doubts=(), confidence=1.0) for a in clean.agents)))) == []
    )
