"""Pictures of scenarios: formats, what they show, and that a failure leaves nothing behind."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from log2sim.datatypes import TYPICAL_SIZE_M, Agent, Scenario, Waypoints
from log2sim.errors import ConfigError
from log2sim.visualization.plot import viewport
from log2sim.visualization.plot.layers import Overlays
from log2sim.visualization.plot.layout import FigureLayout
from log2sim.visualization.plot.tracks import plot_tracks, still
from log2sim.visualization.plot.viewport import assign_roles


def make_agent(
    name: str, start: tuple[float, float], velocity: tuple[float, float], *, category: str = "car", count: int = 21
) -> Agent:
    t = np.arange(count) * 0.1
    vx, vy = velocity
    n, speed = np.ones(count), float(np.hypot(vx, vy))
    waypoints = Waypoints(
        t,
        start[0] + vx * t,
        start[1] + vy * t,
        0.8 * n,
        np.arctan2(vy, vx) * n,
        speed * n,
        np.ones(count, dtype=bool),
        0.1 * n,
    )
    return Agent(name, category, TYPICAL_SIZE_M[category], waypoints, static=speed == 0)


def make_scenario(*agents: Agent, name: str = "scene") -> Scenario:
    return Scenario(name, 0, 2.0, agents)


def crossing() -> Scenario:
    return make_scenario(
        make_agent("ego", (-10, 0), (10, 0)),
        make_agent("1", (15, 4), (-8, 0)),
        make_agent("2", (3, -12), (0, 1.4), category="pedestrian"),
        make_agent("p", (0, 8), (0, 0)),
    )


@pytest.mark.matrix
@pytest.mark.parametrize(
    ("suffix", "magic"),
    [(".png", b"\x89PNG"), (".svg", b"<?xml"), (".pdf", b"%PDF"), (".gif", b"GIF89a"), (".MP4", b"")],
)
def test_the_suffix_chooses_the_format(tmp_path: Path, suffix: str, magic: bytes) -> None:
    out = tmp_path / f"tracks{suffix}"
    plot_tracks(crossing(), out)
    assert out.read_bytes().startswith(magic)
    assert out.stat().st_size > 5000
    assert [p.name for p in tmp_path.iterdir()] == [out.name]


def test_an_unknown_suffix_lists_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"\.png, \.svg, \.pdf.*\.gif, \.mp4.*'\.bmp'"):
        plot_tracks(crossing(), tmp_path / "a.bmp")


def draw(scenario: Scenario, **overlays: object) -> FigureLayout:
    return still(scenario, assign_roles(scenario), Overlays(**overlays))  # type: ignore[arg-type]


def test_the_view_holds_every_mover_and_equal_meters_on_both_axes() -> None:
    sheet = draw(crossing())
    x0, x1 = sheet.ax.get_xlim()
    y0, y1 = sheet.ax.get_ylim()
    for agent in crossing().agents:
        w = agent.waypoints
        assert x0 < w.x_m.min() - 2 < w.x_m.max() + 2 < x1
        assert y0 < w.y_m.min() - 1 < w.y_m.max() + 1 < y1
    box = sheet.ax.get_window_extent()
    assert box.width / (x1 - x0) == pytest.approx(box.height / (y1 - y0), rel=1e-6)


def many(count: int) -> Scenario:
    rng = np.random.default_rng(7)
    return make_scenario(
        make_agent("ego", (0, 0), (10, 0)),
        *(
            make_agent(f"id-{k:05d}", tuple(rng.uniform(-80, 80, 2)), tuple(rng.uniform(2, 9, 2)), count=5)
            for k in range(count)
        ),
    )


@pytest.mark.matrix
@pytest.mark.parametrize(
    "scenario",
    [
        make_scenario(),
        make_scenario(make_agent("ego", (0, 0), (0, 0), count=1)),
        make_scenario(make_agent("ego", (0, 0), (0, 0)), make_agent("1", (3, 3), (4, 1))),
        make_scenario(*crossing().others),
        make_scenario(
            make_agent("ego", (0, -3), (12, 0)), *(make_agent(f"p{k}", (5 * k, 0), (0, 0)) for k in range(100))
        ),
        make_scenario(*crossing().agents, make_agent("$^$", (0, 5), (3, 0)), name="price $5$ of 日本\nand more"),
    ],
    ids=["nobody", "one waypoint", "ego stands", "no ego", "100 parked", "odd name"],
)
@pytest.mark.parametrize("suffix", [".png", ".gif"])
def test_every_kind_of_scene_can_be_drawn(tmp_path: Path, scenario: Scenario, suffix: str) -> None:
    plot_tracks(scenario, tmp_path / f"a{suffix}", dpi=60)


def test_boxes_have_the_real_size_and_heading() -> None:
    agent = make_agent("1", (3.0, 4.0), (0.0, 2.0))  # drives north: length 4.4 along y, width 1.85 along x
    corners = viewport.footprints(agent, (3.0, 4.0), np.pi / 2)[0]
    expected = [(3 - 0.925, 4 + 2.2), (3 - 0.925, 4 - 2.2), (3 + 0.925, 4 - 2.2), (3 + 0.925, 4 + 2.2)]
    np.testing.assert_allclose(corners, expected, atol=1e-12)
    assert viewport.heading_triangles(corners[None])[0, 2] == pytest.approx((3.0, 6.2))


def test_colors_of_movers_are_distinct_and_keep_to_rank() -> None:
    roles = assign_roles(many(20))
    assert len({role.color for role in roles.movers}) == 21
    nearest = assign_roles(
        make_scenario(
            make_agent("ego", (0, 0), (10, 0)), make_agent("a", (0, 50), (5, 0)), make_agent("b", (0, 5), (5, 0))
        )
    )
    assert [role.agent.id for role in nearest.movers] == ["ego", "b", "a"]
