"""Charts below the map, marks of collisions, and animations that keep their colors."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.text import Text
from replay_maneuvers import MANEUVERS, agent_from, scenario_of

from log2sim.datatypes import Scenario
from log2sim.simulation.policy import Controls
from log2sim.simulation.result import Replay
from log2sim.simulation.runner import replay
from log2sim.visualization.plot.animation import AnimatedArtists
from log2sim.visualization.plot.layers import Overlays, new_collisions
from log2sim.visualization.plot.layout import FigureLayout
from log2sim.visualization.plot.scene import draw_base
from log2sim.visualization.plot.style import ALARM, TRACK_ALPHA
from log2sim.visualization.plot.time_series import timeline_of
from log2sim.visualization.plot.tracks import plot_tracks, still
from log2sim.visualization.plot.viewport import assign_roles


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


def layout_of(scenario: Scenario, result: Replay | None) -> FigureLayout:
    return still(scenario, assign_roles(scenario), Overlays(replay=result))


def chart_axes(layout: FigureLayout) -> list:
    return [ax for ax in layout.figure.axes if ax.get_legend() is not None]


@pytest.mark.slow
def test_the_charts_are_of_the_ego_and_else_of_the_worst_follower() -> None:
    scenario = scene()
    timeline = timeline_of(replay(scenario), scenario, assign_roles(scenario))
    assert timeline is not None
    assert timeline.role.agent.id == "ego"
    scenario = scene(ego="car")
    result = replay(scenario)
    worst = {k: v["cross_track_max_m"] for k, v in result.metrics["by_agent"].items()}
    timeline = timeline_of(result, scenario, assign_roles(scenario))
    assert timeline is not None
    assert worst["turns"] > worst["car"]
    assert timeline.role.agent.id == "turns"


def test_where_only_the_log_drives_there_are_no_charts() -> None:
    scenario = scene()
    old = replay(scenario)
    old = dataclasses.replace(
        old,
        agents=tuple(dataclasses.replace(a, commands=None, cross_track_m=None, along_track_m=None) for a in old.agents),
    )
    for result in (None, replay(scenario, mode="exact"), old):
        assert timeline_of(result, scenario, assign_roles(scenario)) is None
        assert chart_axes(layout_of(scenario, result)) == []


@pytest.mark.slow
def test_the_charts_show_commands_response_and_errors() -> None:
    scenario, result = reckless()
    ego = result.agent("ego")
    by_label = {
        (ax.get_legend().get_title().get_text().split(" (")[0], k): line
        for ax in chart_axes(layout_of(scenario, result))
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


def test_who_walks_has_no_pedal_and_no_wheel() -> None:
    t = np.arange(0, 41) * 0.1
    walker = agent_from(t, 1.2 * t, 0 * t, 0 * t, np.full(41, 1.2), id="w", category="pedestrian", offset_m=0)
    scenario = scenario_of(walker)
    timeline = timeline_of(replay(scenario), scenario, assign_roles(scenario))
    assert timeline is not None
    assert [s.name for s in timeline.charts] == ["speed", "tracking error"]


def test_in_reverse_the_pedal_is_that_of_the_gear() -> None:
    scenario = scenario_of(MANEUVERS["reversing"]())
    result = replay(scenario)
    timeline = timeline_of(result, scenario, assign_roles(scenario))
    assert timeline is not None
    commands, response = next(s for s in timeline.charts if s.name == "pedal").lines
    agent = result.agents[0]
    moving = (agent.t_s > 5.4) & (agent.t_s < 11.5)
    assert np.corrcoef(commands.values[moving], response.values[moving])[0, 1] > 0.8


@pytest.mark.slow
@pytest.mark.parametrize("driver", ["pid", "policy"])
def test_no_writing_of_the_sheet_covers_other_writing(driver: str) -> None:
    scenario, result = reckless()
    layout = layout_of(scenario, result if driver == "policy" else replay(scenario))
    layout.canvas.draw()
    writing = [t for t in layout.figure.findobj(Text) if t.get_text().strip() and t.get_visible()]
    extents = [t.get_window_extent() for t in writing]
    page = layout.figure.bbox
    shown = [(t, e) for t, e in zip(writing, extents) if page.x0 < e.x1 and e.x0 < page.x1]
    ticks = {id(label) for ax in layout.figure.axes for label in [*ax.get_xticklabels(), *ax.get_yticklabels()]}
    for k, (a, ea) in enumerate(shown):
        if id(a) not in ticks:
            assert ea.x0 >= 0
            assert ea.x1 <= page.x1 + 1, a.get_text()
        for b, eb in shown[:k]:
            if id(a) in ticks and id(b) in ticks:
                continue  # locators leave tick labels outside the limits, which are not drawn
            wide = min(ea.x1, eb.x1) - max(ea.x0, eb.x0)
            high = min(ea.y1, eb.y1) - max(ea.y0, eb.y0)
            assert not (wide > 2 and high > 2), (a.get_text(), b.get_text())


@pytest.mark.slow
def test_the_map_keeps_its_size_above_the_strips() -> None:
    scenario, result = reckless()
    plain, with_strips = layout_of(scenario, None), layout_of(scenario, result)
    one, other = (s.ax.get_window_extent() for s in (plain, with_strips))
    assert (other.width, other.height) == pytest.approx((one.width, one.height))
    assert with_strips.figure.bbox.y1 - other.y1 == pytest.approx(plain.figure.bbox.y1 - one.y1)
    assert all(ax.get_window_extent().y1 < other.y0 for ax in chart_axes(with_strips))


@pytest.mark.slow
def test_collisions_that_the_log_has_not_are_marked_between_the_boxes() -> None:
    scenario, result = reckless()
    (event,) = [e for e in result.metrics["collisions"] if e["belongs_to"] == "replay"]
    times, places = new_collisions(result)
    assert times.tolist() == [event["t_s"]]
    ego = result.agent("ego")
    middle = (np.interp(event["t_s"], ego.t_s, ego.x_m) + 120.0) / 2
    assert places[0, 0] == pytest.approx(middle)
    assert "collision of the replay" in [
        t.get_text() for t in layout_of(scenario, result).figure.legends[0].get_texts()
    ]
    assert len(new_collisions(replay(scenario))[0]) == 0
    in_log = dataclasses.replace(
        result, metrics={**result.metrics, "collisions": [{**event, "belongs_to": "scenario"}]}
    )
    assert len(new_collisions(in_log)[0]) == 0


@pytest.mark.slow
def test_the_cursor_moves_and_marks_come_when_it_hits() -> None:
    scenario, result = reckless()
    roles = assign_roles(scenario)
    base = draw_base(scenario, roles, Overlays(replay=result), moving=True)
    layout, charts = base.layout, base.charts
    assert charts is not None
    artists = AnimatedArtists(layout, roles, Overlays(replay=result), charts=charts)
    layout.canvas.draw()
    (hit_s,) = new_collisions(result)[0]
    for t_s, marks in ((hit_s - 0.1, 0), (hit_s + 0.1, 1)):
        artists.show(t_s)
        assert len(artists.collisions.get_xdata()) == marks
        for _, strip, cursor, dot, value in charts.moving:
            line = strip.lines[-1]
            assert cursor.get_xdata()[0] == t_s
            now = np.interp(t_s, line.t_s, line.values)
            assert dot.get_ydata()[0] == pytest.approx(now)
            assert float(value.get_text().replace("−", "-").strip("°kmh/s²").split()[0]) == pytest.approx(now, abs=0.06)
    artists.show(scenario.duration_s + 100)
    assert len(charts.moving[0][3].get_xdata()) == 0


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
            for color in [role.color for role in assign_roles(scenario).movers] + [ALARM]:
                full = 255 * np.array(to_rgb(color))
                for alpha in (1.0, TRACK_ALPHA) if color != ALARM else (1.0,):
                    near = np.abs(pixels - (alpha * full + (1 - alpha) * 255)).max(axis=1) <= 6
                    assert near.sum() > 10, (frame, color, alpha)
