"""Pictures of scenarios: formats, what they show, and that a failure leaves nothing behind."""

from __future__ import annotations

import dataclasses
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from export_worlds import straight, world
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from replay_maneuvers import MANEUVERS, agent_from, scenario_of
from worlds import waypoints

from log2sim.datatypes import TYPICAL_SIZE_M, Agent, Finding, Scenario
from log2sim.geometry import Array, box_corners_bev
from log2sim.simulation.policy import Controls
from log2sim.simulation.result import Replay
from log2sim.simulation.runner import replay
from log2sim.visualization.plot import layers, viewport
from log2sim.visualization.plot.layers import Overlays
from log2sim.visualization.plot.layout import FigureLayout
from log2sim.visualization.plot.style import ALARM, TRACK_ALPHA
from log2sim.visualization.plot.tracks import plot_tracks, still
from log2sim.visualization.plot.viewport import assign_view_roles


def make_agent(
    name: str, start: tuple[float, float], velocity: tuple[float, float], *, category: str = "car", count: int = 21
) -> Agent:
    t = np.arange(count) * 0.1
    vx, vy = velocity
    speed = float(np.hypot(vx, vy))
    w = waypoints(t, start[0] + vx * t, start[1] + vy * t, 0.8, np.arctan2(vy, vx), speed)
    return Agent(name, category, TYPICAL_SIZE_M[category], w, static=speed == 0)


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


def draw(scenario: Scenario, **overlays: object) -> FigureLayout:
    return still(scenario, assign_view_roles(scenario), Overlays(**overlays))  # type: ignore[arg-type]


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
    roles = assign_view_roles(many(20))
    assert len({role.color for role in roles.movers}) == 21
    nearest = assign_view_roles(
        make_scenario(
            make_agent("ego", (0, 0), (10, 0)), make_agent("a", (0, 50), (5, 0)), make_agent("b", (0, 5), (5, 0))
        )
    )
    assert [role.agent.id for role in nearest.movers] == ["ego", "b", "a"]


def named(key: str, id: str, **moved: float):
    agent = dataclasses.replace(MANEUVERS[key](), id=id)
    w = agent.waypoints
    return dataclasses.replace(
        agent, waypoints=dataclasses.replace(w, y_m=w.y_m + moved.get("north", 0.0), x_m=w.x_m + moved.get("east", 0.0))
    )


def scene(ego: str = "ego") -> Scenario:
    wall = agent_from([0.0], [120.0], [0.0], [0.0], [0.0], id="wall", static=True)
    return scenario_of(named("brake to stop and go", ego), named("turn of radius 8 m", "turns", north=12.0), wall)


def reckless() -> tuple[Scenario, Replay]:
    scenario = scene()
    return scenario, replay(scenario, ego=lambda seen: Controls(2.0, 0.0002))


@pytest.mark.slow
def test_the_charts_show_commands_response_and_errors() -> None:
    scenario, result = reckless()
    ego = result.agent("ego")
    by_label = {
        (ax.get_legend().get_title().get_text().split(" (")[0], k): line
        for ax in draw(scenario, replay=result).figure.axes
        if ax.get_legend() is not None
        for k, line in enumerate([a for a in ax.lines if len(a.get_xdata()) > 2])
    }
    assert ego.commands is not None
    for key, expected in (
        (("speed", 1), ego.speed_mps * 3.6),
        (("speed", 0), scenario.ego.waypoints.speed_mps * 3.6),  # type: ignore[union-attr]
        (("pedal", 0), ego.commands.pedal_mps2),
        (("pedal", 1), ego.accel_mps2),
        (("steering", 0), np.degrees(ego.commands.steer_rad)),
        (("tracking error", 1), ego.cross_track_m),
        (("tracking error", 0), ego.along_track_m),
    ):
        np.testing.assert_allclose(by_label[key].get_ydata(), expected)


@pytest.mark.slow
def test_a_gif_keeps_every_frame_and_the_colors_that_mean_something(tmp_path: Path) -> None:
    from PIL import Image

    scenario, result = reckless()
    scenario = dataclasses.replace(scenario, duration_s=6.0)
    plot_tracks(scenario, tmp_path / "a.gif", replay=result)
    with Image.open(tmp_path / "a.gif") as moving:
        assert moving.n_frames == 61
        for frame in (0, 30, 60):
            moving.seek(frame)
            pixels = np.asarray(moving.convert("RGB")).reshape(-1, 3).astype(int)
            for color in [role.color for role in assign_view_roles(scenario).movers] + [ALARM]:
                full = 255 * np.array(to_rgb(color))
                for alpha in (1.0, TRACK_ALPHA) if color != ALARM else (1.0,):
                    near = np.abs(pixels - (alpha * full + (1 - alpha) * 255)).max(axis=1) <= 6
                    assert near.sum() > 10, (frame, color, alpha)


def doubted(agent: Agent, *spans: tuple[float | None, float | None]) -> Agent:
    return replace(
        agent, doubts=tuple(Finding("reversing", start_s=a, end_s=b, text="reverses at 7.4 m/s") for a, b in spans)
    )


def scene_doubts() -> Scenario:
    """Movers doubtful from 1 to 2 s, at the end, and for low confidence; a standing one; and one without a doubt."""
    names = ("middle", "end", "unsure", "sure")
    middle, end, unsure, sure = (straight(name, start=(0.0, 6.0 * k)) for k, name in enumerate(names, start=1))
    parked = replace(straight("parked", start=(20.0, -8.0), speed=0.0), static=True)
    agents = doubted(middle, (1.0, 2.0)), doubted(end, (2.5, None)), replace(unsure, confidence=0.2), sure
    return world(straight("ego"), *agents, doubted(parked, (None, None)))


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
    places = striped(draw(scene_doubts()))
    for hatched in ([15.0, 12.0], [15.0, 18.0], [20.0, -8.0]):  # the ends of "end" and "unsure", and what is parked
        assert min(np.hypot(*(place - hatched)) for place in places) < 0.05
    assert len(places) == 3
    clean = scene_doubts()
    sure = tuple(replace(a, doubts=(), confidence=1.0) for a in clean.agents)
    assert striped(draw(replace(clean, agents=sure))) == []


def texts(sheet: FigureLayout) -> list[str]:
    return [t.get_text() for legend in sheet.figure.legends for t in legend.get_texts()]


def meeting() -> Scenario:
    """Eighteen that end a meter apart, so that their labels want the same places."""
    ways = [(np.cos(a), np.sin(a)) for a in np.linspace(0, 2 * np.pi, 18, endpoint=False)]
    return make_scenario(*(make_agent(str(k), (22 * c, 22 * s), (-10 * c, -10 * s)) for k, (c, s) in enumerate(ways)))


@pytest.mark.parametrize("scenario", [many(40), meeting()], ids=["spread", "meeting"])
def test_labels_do_not_overlap(scenario: Scenario) -> None:
    sheet = draw(scenario)
    sheet.figure.canvas.draw()
    labels = [t for t in sheet.ax.texts if t.get_fontweight() == "bold"]
    assert len(labels) > 6
    boxes = [t.get_window_extent() for t in labels]
    for i, a in enumerate(boxes):
        # Letters of the box's edge may touch; a shared area of more than a pixel or two is an overlap.
        assert not any(
            min(a.x1, b.x1) - max(a.x0, b.x0) > 2 and min(a.y1, b.y1) - max(a.y0, b.y0) > 2 for b in boxes[:i]
        )


def test_overlays_get_a_line_in_the_legend() -> None:
    scenario = crossing()
    assert not {"truth", "replay"} & set(texts(draw(scenario)))
    assert {"truth", "replay"} <= set(texts(draw(scenario, truth=scenario, replay=replay(scenario))))
