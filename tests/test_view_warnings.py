"""Warnings and ends on the page and in pictures."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest
from browser import CHROMIUM, DRIVER, Browser, browsing
from replay_maneuvers import scenario_of
from test_replay_warnings import crossing_walker, seen, town_ego

from log2sim.datatypes import Scenario
from log2sim.simulation.result import Replay
from log2sim.simulation.runner import replay
from log2sim.simulation.warnings import warn
from log2sim.visualization.page.document import page_document
from log2sim.visualization.page.writer import write_page
from log2sim.visualization.plot.layers import Overlays, lines_of, warned_places
from log2sim.visualization.plot.tracks import still
from log2sim.visualization.plot.viewport import assign_roles

WARN_LIGHT = (179, 92, 0)


def scene() -> Scenario:
    return scenario_of(town_ego(8.0), seen(crossing_walker(6.0, 8.0), vehicle=(5.0, 8.0), road=(1.0, 8.0)))


def warned(world: Scenario) -> Replay:
    result = replay(world, mode="exact", dt_s=0.1)
    return replace(result, warnings=warn(world, result))


def test_the_document_tells_of_warnings_and_of_ends() -> None:
    world = scene()
    document = page_document(world, replay=warned(world))
    entries = {e["id"]: e for e in document["layers"]["scenario"]}
    assert entries["p"]["observed_by"] == {"vehicle": [[5.0, 8.0]], "road": [[1.0, 8.0]]}
    assert "observed_by" not in entries["ego"]
    assert document["warnings"]["title"] == "1 warning"
    (event,) = document["warnings"]["events"]
    assert event["agent"] == "p"
    assert event["t_s"] == event["spans"][0][0]
    assert event["brief"].startswith("p: warning at ")


def test_without_warnings_and_with_one_end_a_page_tells_of_neither() -> None:
    world = scenario_of(town_ego(8.0), seen(crossing_walker(6.0, 8.0), vehicle=(0.0, 8.0)))
    document = page_document(world, replay=replay(world, mode="exact", dt_s=0.1))
    assert document["warnings"] == {"title": "", "events": []}
    assert not [e for e in document["layers"]["scenario"] if "observed_by" in e]


def test_a_picture_shows_beside_the_tracks_what_one_end_alone_observed() -> None:
    world = scene()
    walker = world.agents[1]
    (road,) = lines_of(walker, "road", 0.5)
    assert lines_of(walker, "vehicle") == []
    states = walker.at([1.0, 4.9])
    assert road[0] == pytest.approx([states.x_m[0] + 0.5, states.y_m[0]])
    assert road[-1] == pytest.approx([states.x_m[1] + 0.5, states.y_m[1]], abs=0.15)
    assert lines_of(world.agents[0], "road") == []


@pytest.mark.parametrize("ends", [1, 2])
def test_the_legend_explains_ends_and_warnings_where_there_are_some(ends: int) -> None:
    spans = {"vehicle": (5.0, 8.0), "road": (1.0, 8.0)} if ends == 2 else {"vehicle": (0.0, 8.0)}
    world = scenario_of(town_ego(8.0), seen(crossing_walker(6.0, 8.0), **spans))
    for result in (None, warned(world)):
        layout = still(world, assign_roles(world), Overlays(replay=result))
        told = {text.get_text() for text in layout.figure.legends[0].get_texts()}
        assert ("observed by the road alone" in told) == (ends == 2)
        assert ("warning: when, and how far apart" in told) == (result is not None)


def test_a_warning_is_drawn_from_the_ego_to_the_agent() -> None:
    world = scene()
    result = warned(world)
    (place,) = warned_places(result)
    t_s = result.warnings.events[0].begin_s
    for point, agent in zip(place.ends_m, world.agents):
        states = agent.at(t_s)
        assert point == pytest.approx([states.x_m[0], states.y_m[0]], abs=1e-3)
    assert warned_places(replace(result, warnings=None)) == []


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Browser, str]]:
    if CHROMIUM is None or DRIVER is None:
        pytest.skip("no Chromium with a driver")
    folder, world = tmp_path_factory.mktemp("page"), scene()
    write_page(world, folder / "w.html", replay=warned(world))
    with browsing(folder / "profile") as browser:
        yield browser, f"file://{folder}/w.html"


def test_the_page_lists_marks_and_draws_a_warning(page: tuple[Browser, str]) -> None:
    browser, address = page
    browser.open(address)
    assert browser.run("return document.getElementById('warned-count').textContent") == "1 warning"
    assert browser.run("return document.querySelectorAll('#events .warned').length") == 1
    browser.run("document.querySelector('#warned-agents button').click()")
    assert browser.run("return log2sim.chosen") == "p"
    begins = warned(scene()).warnings.events[0].begin_s
    assert browser.run("return log2sim.time") == pytest.approx(begins)
    assert "braking suffices" in browser.run("return document.getElementById('agent-warning').textContent")
    browser.run("log2sim.choose(null)")
    colored = {t: orange(browser, t) for t in (begins - 0.5, begins + 0.3)}
    assert colored[begins - 0.5] == 0
    assert colored[begins + 0.3] > 50
    assert not [entry for entry in browser.log("browser") if entry["level"] == "SEVERE"]


def orange(browser: Browser, t: float) -> int:
    """Pixels of the map in the color of warnings at a time."""
    browser.run("log2sim.time = arguments[0]", t)
    return browser.run_async(
        """const [color, done] = arguments; requestAnimationFrame(() => requestAnimationFrame(() => {
        const map = document.getElementById("map"), { data } = map.getContext("2d").getImageData(0, 0, map.width, map.height);
        let count = 0;
        for (let k = 0; k < data.length; k += 4) if (color.every((c, i) => Math.abs(data[k + i] - c) < 8)) count++;
        done(count);
        }));""",
        WARN_LIGHT,
    )


def test_the_panel_tells_which_end_observes_an_agent(page: tuple[Browser, str]) -> None:
    browser, address = page
    browser.open(address)
    rows = "[...document.querySelectorAll('#agent-now dt')].find((d) => d.textContent === 'Observed by')"
    told = {}
    browser.run("log2sim.choose('p')")
    for t in (0.5, 3.0, 6.0):
        browser.run("log2sim.time = arguments[0]", t)
        browser.wait(
            f"{rows}.nextElementSibling.textContent && document.getElementById('time').textContent == '{t:.2f}'"
        )
        told[t] = browser.run(f"return {rows}.nextElementSibling.textContent")
    since = " (vehicle from 5.0 s, road from 1.0 s)"
    assert told == {0.5: f"nobody{since}", 3.0: f"road{since}", 6.0: f"vehicle and road{since}"}
    browser.run("log2sim.choose('ego')")
    assert browser.run(f"return {rows}.hidden")
    browser.press("o")
    assert browser.run("return document.getElementById('layer-ends').getAttribute('aria-pressed')") == "false"
