"""Charts below the map, marks of collisions, and animations that keep their colors."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from replay_maneuvers import MANEUVERS, agent_from, scenario_of

from log2sim.datatypes import Scenario
from log2sim.simulation.policy import Controls
from log2sim.simulation.result import Replay
from log2sim.simulation.runner import replay
from log2sim.visualization.plot.layers import Overlays
from log2sim.visualization.plot.layout import FigureLayout
from log2sim.visualization.plot.style import ALARM, TRACK_ALPHA
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
