"""Warnings and ends on the page and in pictures."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from browser import Browser
from replay_maneuvers import scenario_of
from test_replay_warnings import crossing_walker, seen, town_ego

from log2sim.datatypes import Scenario
from log2sim.simulation.result import Replay
from log2sim.simulation.runner import replay
from log2sim.simulation.warnings import warn
from log2sim.visualization.page.document import page_document
from log2sim.visualization.page.writer import write_page

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


def test_the_page_lists_marks_and_draws_a_warning(chromium: Browser, tmp_path: Path) -> None:
    browser, world = chromium, scene()
    write_page(world, tmp_path / "w.html", replay=warned(world))
    browser.open(f"file://{tmp_path}/w.html")
    assert browser.run("return document.getElementById('warned-count').textContent") == "1 warning"
    assert browser.run("return document.querySelectorAll('#events .warned').length") == 1
    browser.run("document.querySelector('#warned-agents button').click()")
    assert browser.run("return log2sim.chosen") == "p"
    begins = warned(world).warnings.events[0].begin_s
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
