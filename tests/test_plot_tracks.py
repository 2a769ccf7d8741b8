"""Pictures of scenarios: formats, what they show, and that a failure leaves nothing behind."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from log2sim.datatypes import TYPICAL_SIZE_M, Agent, MapFrame, Scenario, Waypoints
from log2sim.errors import ConfigError
from log2sim.simulation.runner import replay
from log2sim.visualization.plot import viewport
from log2sim.visualization.plot.animation import AnimatedArtists
from log2sim.visualization.plot.layers import Overlays
from log2sim.visualization.plot.layout import FigureLayout, place_labels
from log2sim.visualization.plot.style import PALETTE, printable
from log2sim.visualization.plot.tracks import plot_tracks, still
from log2sim.visualization.plot.viewport import Viewport, assign_roles, choose_viewport, nice_step, time_step_s


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


def test_a_png_is_2000_px_wide(tmp_path: Path) -> None:
    from PIL import Image

    plot_tracks(crossing(), tmp_path / "a.png")
    with Image.open(tmp_path / "a.png") as image:
        assert image.width == 2000


def test_a_gif_runs_in_real_time(tmp_path: Path) -> None:
    from PIL import Image

    plot_tracks(crossing(), tmp_path / "a.gif")
    with Image.open(tmp_path / "a.gif") as image:
        assert image.n_frames == 21  # 0.0, 0.1 ... 2.0 s
        assert image.info["duration"] == 100
        assert max(image.size) <= 1000


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".svg", ".png"])
def test_the_same_scenario_gives_the_same_bytes(tmp_path: Path, suffix: str) -> None:
    for name in ("a", "b"):
        plot_tracks(crossing(), tmp_path / f"{name}{suffix}")
    assert (tmp_path / f"a{suffix}").read_bytes() == (tmp_path / f"b{suffix}").read_bytes()


def test_an_unknown_suffix_lists_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"\.png, \.svg, \.pdf.*\.gif, \.mp4.*'\.bmp'"):
        plot_tracks(crossing(), tmp_path / "a.bmp")


def test_an_existing_file_stays_unless_overwrite_is_asked_for(tmp_path: Path) -> None:
    out = tmp_path / "a.png"
    out.write_bytes(b"mine")
    with pytest.raises(ConfigError, match="--overwrite"):
        plot_tracks(crossing(), out)
    assert out.read_bytes() == b"mine"
    plot_tracks(crossing(), out, overwrite=True)
    assert out.read_bytes() != b"mine"


@pytest.mark.parametrize("suffix", [".png", ".gif"])
def test_a_failure_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str
) -> None:
    out = tmp_path / f"a{suffix}"
    out.write_bytes(b"good")

    def fail_half_way(figure: object, path: Path, **options: object) -> None:
        path.write_bytes(b"half")
        raise RuntimeError("disk")

    show = AnimatedArtists.show

    def fail_later(stage: AnimatedArtists, t_s: float) -> None:
        if t_s > 0.55:
            raise RuntimeError("disk")
        show(stage, t_s)

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", fail_half_way)
    monkeypatch.setattr("log2sim.visualization.plot.animation.AnimatedArtists.show", fail_later)
    with pytest.raises(RuntimeError, match="disk"):
        plot_tracks(crossing(), out, overwrite=True)
    assert out.read_bytes() == b"good"
    assert list(tmp_path.iterdir()) == [out]


def draw(scenario: Scenario, **overlays: object) -> FigureLayout:
    return still(scenario, assign_roles(scenario), Overlays(**overlays))  # type: ignore[arg-type]


def texts(sheet: FigureLayout) -> list[str]:
    return [t.get_text() for legend in sheet.figure.legends for t in legend.get_texts()]


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


def test_an_outlier_does_not_blow_up_the_view_and_is_reported() -> None:
    scenario = make_scenario(*crossing().agents, make_agent("99", (5000, 0), (5, 0)))
    assert choose_viewport(assign_roles(scenario)) == choose_viewport(assign_roles(crossing()))
    assert "1 outside this view" in texts(draw(scenario))


def test_far_map_coordinates_shift_the_view_and_nothing_else() -> None:
    def shifted(agent: Agent) -> Agent:
        w = agent.waypoints
        return dataclasses.replace(agent, waypoints=dataclasses.replace(w, x_m=w.x_m + 5e5, y_m=w.y_m - 4e6))

    near = choose_viewport(assign_roles(crossing()))
    far = choose_viewport(assign_roles(make_scenario(*(shifted(a) for a in crossing().agents))))
    assert (far.x0, far.x1, far.y0, far.y1) == pytest.approx(
        (near.x0 + 5e5, near.x1 + 5e5, near.y0 - 4e6, near.y1 - 4e6), abs=1e-6
    )


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


@pytest.mark.slow
def test_a_crowd_of_500_is_summed_up_in_the_legend() -> None:
    rows = texts(draw(many(500)))
    assert f"{500 - len(PALETTE)} more moving, farther away" in rows
    assert len(rows) <= len(PALETTE) + 8


def meeting() -> Scenario:
    """Eighteen that end a meter apart, so that their labels want the same places."""
    ways = [(np.cos(a), np.sin(a)) for a in np.linspace(0, 2 * np.pi, 18, endpoint=False)]
    return make_scenario(*(make_agent(str(k), (22 * c, 22 * s), (-10 * c, -10 * s)) for k, (c, s) in enumerate(ways)))


@pytest.mark.parametrize("scenario", [many(40), meeting()], ids=["spread", "meeting"])
def test_labels_do_not_overlap(scenario: Scenario) -> None:
    sheet = draw(scenario)
    sheet.canvas.draw()
    labels = [t for t in sheet.ax.texts if t.get_fontweight() == "bold"]
    assert len(labels) > 6
    boxes = [t.get_window_extent() for t in labels]
    for i, a in enumerate(boxes):
        # Letters of the box's edge may touch; a shared area of more than a pixel or two is an overlap.
        assert not any(
            min(a.x1, b.x1) - max(a.x0, b.x0) > 2 and min(a.y1, b.y1) - max(a.y0, b.y0) > 2 for b in boxes[:i]
        )


@pytest.mark.slow
def test_the_legend_stands_beside_the_map() -> None:
    sheet = draw(many(500))
    sheet.canvas.draw()
    legend = sheet.figure.legends[0].get_window_extent()
    assert legend.x0 >= sheet.ax.get_window_extent().x1
    assert legend.x1 <= sheet.figure.bbox.x1
    assert legend.y0 >= 0


def test_overlays_get_a_line_in_the_legend() -> None:
    scenario = crossing()
    assert not {"truth", "replay"} & set(texts(draw(scenario)))
    assert {"truth", "replay"} <= set(texts(draw(scenario, truth=scenario, replay=replay(scenario))))


@pytest.mark.slow
def test_overlays_can_be_animated(tmp_path: Path) -> None:
    scenario = crossing()
    plot_tracks(scenario, tmp_path / "a.gif", truth=scenario, replay=replay(scenario))


def test_north_is_named_only_when_the_map_knows_it() -> None:
    local = draw(crossing())
    known = draw(dataclasses.replace(crossing(), map=MapFrame(49.0, 8.4, 0.0, "+proj=tmerc")))
    assert (local.ax.get_xlabel(), known.ax.get_ylabel()) == ("map x (m)", "north (m)")
    assert "N" in [t.get_text() for ax in known.figure.axes for t in ax.texts]
    assert "N" not in [t.get_text() for ax in local.figure.axes for t in ax.texts]


def test_boxes_have_the_real_size_and_heading() -> None:
    agent = make_agent("1", (3.0, 4.0), (0.0, 2.0))  # drives north: length 4.4 along y, width 1.85 along x
    corners = viewport.footprints(agent, (3.0, 4.0), np.pi / 2)[0]
    expected = [(3 - 0.925, 4 + 2.2), (3 - 0.925, 4 - 2.2), (3 + 0.925, 4 - 2.2), (3 + 0.925, 4 + 2.2)]
    np.testing.assert_allclose(corners, expected, atol=1e-12)
    assert viewport.heading_triangles(corners[None])[0, 2] == pytest.approx((3.0, 6.2))


def test_arrows_point_the_way_of_travel() -> None:
    xy = np.column_stack([np.linspace(50, 0, 51), np.zeros(51)])
    heads = viewport.arrows(xy, Viewport(0, 50, -10, 10, m_per_pt=0.1))
    assert len(heads) == 5  # 500 pt of way, one each 110 pt
    assert all(head[0, 0] < head[[1, 3], 0].min() for head in heads)


def test_filled_gaps_are_split_from_what_was_seen() -> None:
    agent = make_agent("1", (0.0, 0.0), (1.0, 0.0), count=6)
    observed = np.array([True, True, False, False, True, True])
    agent = dataclasses.replace(agent, waypoints=dataclasses.replace(agent.waypoints, observed=observed))
    seen, filled = viewport.observed_and_filled(agent)
    assert [part[:, 0].round(6).tolist() for part in seen] == [[0.0, 0.1], [0.4, 0.5]]
    assert [part[:, 0].round(6).tolist() for part in filled] == [[0.1, 0.2, 0.3, 0.4]]


def test_colors_of_movers_are_distinct_and_keep_to_rank() -> None:
    roles = assign_roles(many(20))
    assert len({role.color for role in roles.movers}) == 21
    nearest = assign_roles(
        make_scenario(
            make_agent("ego", (0, 0), (10, 0)), make_agent("a", (0, 50), (5, 0)), make_agent("b", (0, 5), (5, 0))
        )
    )
    assert [role.agent.id for role in nearest.movers] == ["ego", "b", "a"]


def test_steps_are_round_numbers() -> None:
    assert [nice_step(v) for v in (0.9, 1.0, 3.2, 7.0, 49.9, 100.0)] == [0.5, 1.0, 2.0, 5.0, 20.0, 100.0]
    assert time_step_s(6.0, 3, 10.0, 0.05) == 1.0
    assert time_step_s(6.0, 3, 10.0, 5.0) == 5.0  # 45 m between marks of a car at 10 m/s
    assert time_step_s(120.0, 50, 10.0, 0.05) == 20.0


def test_letters_that_the_font_lacks_become_question_marks() -> None:
    assert printable("Straße 日 \n x") == "Straße ? x"
    assert len(printable("x" * 500)) == 80


def test_a_part_of_a_scenario_keeps_the_colors_of_the_whole_and_labels_are_ids() -> None:
    whole = many(8)
    colors = {role.agent.id: role.color for role in assign_roles(whole).movers}
    part = dataclasses.replace(whole, agents=whole.agents[:1] + whole.agents[4:])
    assert {role.agent.id: role.color for role in assign_roles(part, whole).movers} == {
        a.id: colors[a.id] for a in part.agents
    }
    assert {role.agent.id: role.color for role in assign_roles(part).movers} != {
        a.id: colors[a.id] for a in part.agents
    }
    roles = assign_roles(whole)
    placed = place_labels(roles, choose_viewport(roles).fitted(400, 400), 1.0)
    assert placed.labels
    assert all(
        any(label.text.startswith(a.id) for a in whole.agents) or label.text.endswith(" s") for label in placed.labels
    )


def test_static_agents_have_labels_on_demand() -> None:
    roles = assign_roles(crossing())
    view = choose_viewport(roles).fitted(400, 400)
    assert not any(label.text == "p" for label in place_labels(roles, view, 1.0).labels)
    assert any(label.text == "p" for label in place_labels(roles, view, 1.0, static=True).labels)


def test_labels_keep_clear_of_sensors_at_the_road() -> None:
    roles = assign_roles(crossing())
    view = choose_viewport(roles).fitted(400, 400)
    for label in place_labels(roles, view, 1.0).labels:
        at = {"x_m": label.place_m[0], "y_m": label.place_m[1]}
        others = place_labels(roles, view, 1.0, sensors=[at]).labels
        half = np.array([len(label.text) * 0.25, 0.5]) * label.size_pt * view.m_per_pt
        assert not any((np.abs(o.place_m - label.place_m) < half).all() for o in others)
