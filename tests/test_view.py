"""The page: what is written into it, and what it does in a headless Chromium."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from browser import Browser, opened
from command_line import names, run
from replay_maneuvers import scenario_of
from test_replay_warnings import crossing_walker, seen, town_ego
from worlds import waypoints

from log2sim.datatypes import Agent, Finding, Scenario
from log2sim.errors import ConfigError
from log2sim.geometry import Array, box_corners_bev, wrap_angle
from log2sim.road.ground_map import GroundMap
from log2sim.simulation.result import Replay
from log2sim.simulation.runner import replay
from log2sim.simulation.warnings import warn
from log2sim.visualization.page.document import SCALES, page_document
from log2sim.visualization.page.writer import page_html, write_page
from log2sim.visualization.plot import style
from log2sim.visualization.plot.viewport import assign_view_roles

ROOT = Path(__file__).resolve().parents[1]
TRUTH = ROOT / "samples" / "crossing" / "truth.json"
ESCAPE, HOME, END, LEFT, RIGHT, ENTER = "\ue00c", "\ue011", "\ue010", "\ue012", "\ue014", "\ue007"
EVIL = '</script x></script><script>window.hacked = 1</script><img src=x onerror="window.hacked = 1">{{data}}<!--'


def agent(id: str, x_m: Array, y_m: float, yaw_rad: float = 0.0, **changes: Any) -> Agent:
    """An agent with a waypoint a second along x."""
    speed = np.gradient(np.asarray(x_m, float)) if len(x_m) > 1 else 0.0
    w = waypoints(np.arange(len(x_m)), x_m, y_m, 0.0, yaw_rad, speed, sigma_m=0.0)
    return Agent(**{"id": id, "category": "car", "size_m": (4.0, 2.0, 1.6), "waypoints": w, **changes})


def made(*agents: Agent, name: str = "made") -> Scenario:
    return Scenario(name=name, t0_ns=0, duration_s=4.0, agents=agents)


class Parts(HTMLParser):
    """Tags of a page with their attributes, and each text with the tag before it."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.texts: list[tuple[str, str]] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        if self.tags and data.strip():
            self.texts.append((self.tags[-1][0], data))


# What is written


def test_the_document_holds_every_layer() -> None:
    scenario = Scenario.load(TRUTH)
    replayed = replay(scenario, dt_s=0.1)
    document = page_document(scenario, truth=scenario, replay=replayed)
    assert {k: len(v) for k, v in document["layers"].items()} == {"scenario": 12, "truth": 12, "replay": 12}
    assert document["end_s"] == scenario.duration_s
    entry = next(e for e in document["layers"]["replay"] if e["id"] == "car_turning")
    summed = np.cumsum(np.cumsum(entry["x_m"])) / SCALES["x_m"]
    np.testing.assert_allclose(summed, replayed.agent("car_turning").x_m, atol=0.51e-3)


def test_agents_have_the_colors_of_the_pictures() -> None:
    scenario = Scenario.load(TRUTH)
    entries = {e["id"]: e for e in page_document(scenario)["layers"]["scenario"]}
    roles = assign_view_roles(scenario)
    assert list(entries) == [r.agent.id for r in roles.movers] + [a.id for a in roles.stationary]
    for role in roles.movers[1:]:
        assert entries[role.agent.id]["color"] == role.color
    assert entries["ego"]["ego"]
    assert [e["id"] for e in entries.values() if e["stationary"]] == [a.id for a in roles.stationary]


def test_the_page_asks_for_nothing_from_outside() -> None:
    page = page_html({**page_document(Scenario.load(TRUTH)), "scales": SCALES})
    parts = Parts(page)
    assert set(re.findall(r"https?://[^\s\"'<>]+", page)) == {"http://www.w3.org/2000/svg"}  # a name, not a place
    assert not [a for _, a in parts.tags if {"src", "action"} & set(a)]
    assert [a["href"] for tag, a in parts.tags if tag == "link"] == ["data:,"]
    policy = next(a["content"] for _, a in parts.tags if a.get("http-equiv") == "Content-Security-Policy")
    assert policy is not None
    assert policy.startswith("default-src 'none';")
    (style,) = (text for tag, text in parts.texts if tag == "style")
    script = [text for tag, text in parts.texts if tag == "script"][-1]
    for text, kind in ((script, "script"), (style, "style")):
        digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
        assert f"{kind}-src 'sha256-{digest}'" in policy


def test_names_in_a_scenario_cannot_become_part_of_the_page() -> None:
    document = {**page_document(made(agent(EVIL, np.arange(5.0), 0.0), name=EVIL)), "scales": SCALES}
    parts, usual = (Parts(page_html(d)) for d in (document, {**document, "name": "x", "layers": {"scenario": []}}))
    assert [tag for tag, _ in parts.tags] == [tag for tag, _ in usual.tags]
    data = next(text for tag, text in parts.texts if tag == "script")
    assert json.loads(data) == document


def test_view_writes_a_page(tmp_path: Path) -> None:
    assert run("replay", TRUTH, "--dt", "0.1", "--out", tmp_path / "r.json", "--quiet").code == 0
    arguments = ("view", TRUTH, "--truth", TRUTH, "--replay", tmp_path / "r.json", "--out", tmp_path / "v.html")
    ran = run(*arguments)
    assert ran.code == 0, ran.err
    assert "v.html: 0.2 MB, 11 agents and the ego" in ran.out
    assert names(tmp_path) == ["r.json", "v.html"]
    assert "--overwrite" in run(*arguments).line
    assert run(*arguments, "--overwrite", "--quiet").out == ""


def test_a_page_that_cannot_be_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ran = run("view", TRUTH, "--out", tmp_path / "v.png")
    assert ran.code == 2
    assert "must end in .html" in ran.line
    monkeypatch.setattr("log2sim.visualization.page.document.MAX_ROWS", 100)
    with pytest.raises(ConfigError, match="1260 waypoints are more than the 100"):
        write_page(Scenario.load(TRUTH), tmp_path / "v.html")
    assert names(tmp_path) == []


# What it does


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of the sample with all layers."""
    path = tmp_path_factory.mktemp("view") / "page.html"
    scenario = Scenario.load(TRUTH)
    write_page(scenario, path, truth=scenario, replay=replay(scenario, dt_s=0.1))
    return path


def page_with(tmp_path: Path, *agents: Agent, name: str = "made") -> Path:
    write_page(made(*agents, name=name), tmp_path / "page.html")
    return tmp_path / "page.html"


def time_of(browser: Browser) -> float:
    return float(browser.run("return log2sim.time"))


def place_of(browser: Browser, id: str) -> Array:
    return np.array(browser.run("return log2sim.placeOf(arguments[0])", id), dtype=np.float64)


def pixels(browser: Browser, place: Array, width: int) -> list[tuple[int, ...]]:
    """Colors of the canvas from a place on to the right after the next frame."""
    script = """const [x, y, width, done] = arguments;
        requestAnimationFrame(() => requestAnimationFrame(() => {
            const pen = new OffscreenCanvas(width, 1).getContext("2d", {willReadFrequently: true});
            pen.drawImage(document.getElementById("map"), -Math.round(x), -Math.round(y));
            done([...pen.getImageData(0, 0, width, 1).data]);
        }));"""
    row = browser.run_async(script, float(place[0]), float(place[1]), width)
    return [tuple(row[k : k + 3]) for k in range(0, len(row), 4)]


def pixel(browser: Browser, place: Array) -> tuple[int, ...]:
    return pixels(browser, place, 1)[0]


def rgb(hex: str) -> tuple[int, ...]:
    return tuple(int(hex[k : k + 2], 16) for k in (1, 3, 5))


def pressed(browser: Browser, id: str) -> bool:
    return bool(browser.run("return document.getElementById(arguments[0]).getAttribute('aria-pressed') === 'true'", id))


def text_of(browser: Browser, id: str) -> str:
    return str(browser.run("return document.getElementById(arguments[0]).textContent", id))


def test_agents_are_where_they_are_between_waypoints_too(browser: Browser, tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    source = agent("a", rng.uniform(-50, 50, 60), 0.0)
    w = source.waypoints
    t = np.round(np.cumsum(rng.uniform(0.001, 0.12, 60)), 4)
    source = replace(
        source, waypoints=replace(w, t_s=t, y_m=rng.uniform(-50, 50, 60), yaw_rad=rng.uniform(-3.1, 3.1, 60))
    )
    opened(browser, page_with(tmp_path, source, agent("origin", np.zeros(5), 0.0)), "#agent=a")
    script = """const out = [];
        for (const t of arguments[0]) {
            log2sim.time = t;
            out.push([...log2sim.placeOf("a") ?? [0, 0], log2sim.headingOf("a") ?? 1e9]);
        }
        return [out, log2sim.placeOf("origin"), log2sim.pixelsPerMeter];"""
    asked = np.concatenate([rng.uniform(0, t[-1] + 0.3, 300), np.linspace(0, t[-1], 300), t])
    shown, origin, scale = browser.run(script, asked.tolist())
    known = source.at(asked, margin_s=1e-4)
    x, y, heading = np.array(shown).T
    np.testing.assert_array_equal(heading < 1e9, known.valid)
    there = known.valid
    np.testing.assert_allclose((x - origin[0])[there] / scale, known.x_m[there], atol=2e-3)
    np.testing.assert_allclose((origin[1] - y)[there] / scale, known.y_m[there], atol=2e-3)
    np.testing.assert_allclose(wrap_angle(heading - known.yaw_rad)[there], 0.0, atol=2e-4)


def test_boxes_have_their_size_color_and_heading(browser: Browser, tmp_path: Path) -> None:
    turned = agent("ego", np.full(5, 3.0), -2.0, yaw_rad=0.6)
    opened(browser, page_with(tmp_path, turned, agent("car", np.linspace(0, 20, 5), 8.0)))
    scale, center = browser.run("return log2sim.pixelsPerMeter"), place_of(browser, "ego")

    def at(ahead: float, left: float) -> tuple[int, ...]:
        c, s = np.cos(0.6), np.sin(0.6)
        return pixel(browser, center + scale * np.array([ahead * c - left * s, -ahead * s - left * c]))

    inside = [at(a, b) for a in (-1.85, 1.85) for b in (-0.85, 0.85)]
    assert inside == [rgb(style.INK)] * 4
    outside = [at(2.2, 0.0), at(-2.2, 0.0), at(0.0, 1.2), at(0.0, -1.2), at(2.0, 1.4)]
    assert rgb(style.INK) not in outside
    assert min(at(1.2, 0.0)) > 200 > max(at(-1.2, 0.0))  # the heading mark is at the front
    corners = box_corners_bev([[3.0, -2.0]], 4.0, 2.0, 0.6)[0] - [3.0, -2.0]
    just_in = center + 0.93 * scale * corners[0] * [1, -1]
    assert pixel(browser, just_in) == rgb(style.INK)


def doubtful_scene() -> Scenario:
    """A car that is doubtful from 1 to 2 s, a parked one all the time, one of low confidence and one without a doubt."""
    car, unsure, sure = (
        agent(name, np.linspace(0, 8, 5), y) for name, y in (("car", 6.0), ("unsure", 12.0), ("sure", 18.0))
    )
    waypoints = replace(
        car.waypoints,
        sigma_xy_m=np.linspace(0.1, 0.5, 5),
        sigma_yaw_rad=np.full(5, 0.1),
        sigma_speed_mps=np.full(5, 0.3),
    )
    quality = {"points_median": 40.4, "detections": 20, "without_lidar": 2, "lidar_only": 1}
    through = Finding("passes_through", text="passes through parked at 1.2 s", start_s=1.0, end_s=2.0)
    car = replace(car, waypoints=waypoints, quality=quality, doubts=(through,), confidence=0.93)
    parked = replace(
        agent("parked", np.full(2, 20.0), 0.0, static=True), doubts=(Finding("empty", text="rays pass through it"),)
    )
    return made(agent("ego", np.linspace(0, 20, 5), 0.0), car, replace(unsure, confidence=0.3), sure, parked)


def striped(browser: Browser, id: str) -> list[tuple[int, ...]]:
    """Colors along the middle line of an agent that heads east, behind its heading mark."""
    scale = browser.run("return log2sim.pixelsPerMeter")
    return sorted(set(pixels(browser, place_of(browser, id) - [1.8 * scale, 0.0], int(1.6 * scale))), key=sum)


def test_doubtful_agents_are_hatched_while_the_doubt_holds(browser: Browser, tmp_path: Path) -> None:
    write_page(doubtful_scene(), tmp_path / "page.html")
    opened(browser, tmp_path / "page.html", "#t=0.5")
    plain = {id: len(striped(browser, id)) for id in ("car", "sure", "unsure", "parked")}
    assert plain["car"] == plain["sure"] == 1
    assert min(plain["unsure"], plain["parked"]) > 1  # all the time
    browser.run("log2sim.time = 1.5")
    assert len(striped(browser, "car")) > 1
    assert min(striped(browser, "car")[-1]) > 200  # stripes of the color of the paper
    assert len(striped(browser, "sure")) == 1
    browser.run("log2sim.time = 2.5")
    assert len(striped(browser, "car")) == 1


def test_the_panel_says_how_far_an_agent_can_be_trusted(browser: Browser, tmp_path: Path) -> None:
    write_page(doubtful_scene(), tmp_path / "page.html")
    opened(browser, tmp_path / "page.html", "#t=0.5&agent=car")
    pixel(browser, np.zeros(2))
    said = text_of(browser, "agent-now")
    for part in (
        "Sigma0.15 m · 5.7° · 0.30 m/s", "Confidence0.93", "LiDAR40 points in a sweep",
        "Source20 detections, 2 of them placed by camera, 1 more by LiDAR alone",
    ):  # fmt: skip
        assert part in said
    assert text_of(browser, "agent-doubts") == "passes through parked at 1.2 s (1.0 to 2.0 s) passes_through"
    holds = "return document.getElementById('agent-doubts').classList.contains('holds')"
    assert not browser.run(holds)
    browser.run("log2sim.time = 1.5")
    pixel(browser, np.zeros(2))
    assert browser.run(holds)
    browser.run("log2sim.choose('unsure')")
    assert text_of(browser, "agent-doubts") == "confidence 0.30 confidence"
    browser.run("log2sim.choose('sure')")
    assert text_of(browser, "agent-doubts") == ""
    shown = "return [...document.querySelectorAll('#agent-now dt')].filter((d) => !d.hidden).map((d) => d.textContent)"
    assert browser.run(shown) == ["Confidence", "Heading", "Position", "Observed"]  # nobody knows the rest


def test_doubtful_agents_are_listed_and_visited(browser: Browser, tmp_path: Path) -> None:
    write_page(doubtful_scene(), tmp_path / "page.html")
    opened(browser, tmp_path / "page.html")
    assert text_of(browser, "doubtful-count") == "3 doubtful agents"
    assert "3 doubtful" in text_of(browser, "summary")
    rows = browser.run("return [...document.querySelectorAll('#doubtful-agents button')].map((b) => b.textContent)")
    assert rows == [
        "car: passes through parked at 1.2 s", "unsure: confidence 0.30", "parked: rays pass through it",
    ]  # fmt: skip
    browser.run("document.querySelector('#doubtful-agents button').click()")
    assert (time_of(browser), browser.run("return log2sim.chosen")) == (1.0, "car")
    (tmp_path / "clean").mkdir()
    opened(browser, page_with(tmp_path / "clean", agent("car", np.arange(5.0), 0.0)))
    assert browser.run("return document.getElementById('doubtful').hidden")


def test_a_click_on_an_agent_shows_its_panel(browser: Browser, sample: Path) -> None:
    opened(browser, sample, "#t=2")
    browser.mouse(tuple(place_of(browser, "car_turning")))
    assert browser.run("return log2sim.chosen") == "car_turning"
    assert text_of(browser, "agent-id") == "car_turning"
    assert "car · 4.3 × 1.8 m · 0.0 to 5.2 s" in text_of(browser, "agent-kind")
    speed = Scenario.load(TRUTH).agents[2].at(2.0).speed_mps[0]
    browser.wait("document.querySelector('figcaption output').textContent")
    shown = browser.run("return document.querySelector('figcaption output').textContent")
    assert shown == f"{speed:.2f} m/s · {speed * 3.6:.0f} km/h"
    assert browser.run("return [...document.querySelectorAll('.plot canvas')].every((c) => c.clientWidth > 100)")
    browser.mouse((20.0, 300.0))
    assert browser.run("return log2sim.chosen") is None
    assert browser.run("return document.getElementById('details').hidden")


def test_a_link_names_the_moment_and_the_agent(browser: Browser, sample: Path) -> None:
    opened(browser, sample, "#t=3.2&agent=bus_1")
    assert time_of(browser) == 3.2
    assert browser.run("return log2sim.chosen") == "bus_1"
    browser.run("location.hash = '#t=1.5&agent=ego'")
    browser.wait("log2sim.time === 1.5 && log2sim.chosen === 'ego'")
    for nonsense, t in (("#t=soon", 1.5), ("#t=-9", 0.0), ("#t=1e9", 5.2), ("#agent=nobody", 5.2), ("#%", 5.2)):
        browser.run("location.hash = arguments[0]", nonsense)
        browser.wait(f"log2sim.time === {t}")
    assert browser.run("return log2sim.chosen") is None


def test_the_keyboard_does_everything(browser: Browser, sample: Path) -> None:
    opened(browser, sample, "#t=1")
    browser.press(RIGHT, RIGHT, RIGHT, LEFT)
    assert time_of(browser) == pytest.approx(1.2)
    browser.press(END)
    assert time_of(browser) == 5.2
    browser.press(HOME)
    assert time_of(browser) == 0.0
    scale = browser.run("return log2sim.pixelsPerMeter")
    browser.press("+")
    assert browser.run("return log2sim.pixelsPerMeter") == pytest.approx(1.25 * scale)
    browser.press("-", "-", "0")
    assert browser.run("return log2sim.pixelsPerMeter") == pytest.approx(scale)
    browser.press(">", ">", "<")
    assert text_of(browser, "rate") == "2×"
    browser.press("t", "r", "s", "w", "l")
    assert [pressed(browser, f"layer-{k}") for k in ("truth", "replay", "scenario", "trails", "names")] == [False] * 5
    browser.press("t")
    assert pressed(browser, "layer-truth")
    browser.press("n")
    assert browser.run("return log2sim.chosen") == "ego"
    browser.press("n", "p", ESCAPE)
    assert browser.run("return log2sim.chosen") is None
    browser.press("f")
    assert pressed(browser, "follow")
    assert browser.run("return document.getElementById('help').open") is False
    browser.press("?")
    assert browser.run("return document.getElementById('help').open") is True
    browser.press(ESCAPE)
    assert browser.run("return document.getElementById('help').open") is False


# Time stands in the page but for the frames that a test lets pass.
CLOCK = """let now = 1000, queue = [];
    performance.now = () => now;
    window.requestAnimationFrame = (f) => queue.push(f);
    window.pass = (ms) => { now += ms; for (const f of queue.splice(0)) f(now); return log2sim.time; };"""


def test_playing_keeps_to_the_clock_at_any_speed(browser: Browser, sample: Path) -> None:
    opened(browser, sample)
    browser.run(CLOCK)
    browser.press(" ")
    assert [browser.run("return pass(100)") for _ in range(3)] == pytest.approx([0.1, 0.2, 0.3])
    browser.press(">", ">", ">")  # 2, 5, 10 times
    assert browser.run("return pass(50)") == pytest.approx(0.8)
    browser.press("<", "<", "<", "<", "<", "<")  # 0.1
    assert browser.run("return pass(100)") == pytest.approx(0.81)
    browser.press(" ")
    assert browser.run("return pass(100)") == pytest.approx(0.81)
    browser.wait("location.hash === '#t=0.81'")
    browser.run("log2sim.time = 5.15; log2sim.play()")
    assert [browser.run("return pass(200)") for _ in range(3)] == pytest.approx([5.17, 5.19, 5.2])
    assert browser.run("return document.getElementById('play').getAttribute('aria-label')") == "Play"
    assert browser.run("log2sim.play(); return pass(100)") == pytest.approx(0.01)  # from the start again


def test_following_keeps_the_agent_in_the_middle(browser: Browser, sample: Path) -> None:
    opened(browser, sample)
    middle = browser.run("const m = document.getElementById('map'); return [m.clientWidth / 2, m.clientHeight / 2]")
    browser.press("f")
    for t in (1.0, 4.0):
        browser.run("log2sim.time = arguments[0]", t)
        pixel(browser, np.zeros(2))
        np.testing.assert_allclose(place_of(browser, "ego"), middle, atol=1e-6)
    browser.run("log2sim.choose('car_turning')")
    pixel(browser, np.zeros(2))
    np.testing.assert_allclose(place_of(browser, "car_turning"), middle, atol=1e-6)
    browser.mouse((300, 300), (340, 320))
    assert not pressed(browser, "follow")


def test_layers_come_and_go(browser: Browser, sample: Path) -> None:
    opened(browser, sample, "#t=2")
    behind = np.array([-1.5, 0.0]) * browser.run("return log2sim.pixelsPerMeter")
    place = place_of(browser, "ego") + behind
    assert pixel(browser, place) == rgb(style.INK)
    browser.press("s", "t", "r", "m")
    assert pixel(browser, place) == (251, 252, 253)
    browser.press("s")
    assert pixel(browser, place) == rgb(style.INK)


def test_collisions_of_the_replay_are_marked_and_visited(browser: Browser, tmp_path: Path) -> None:
    scenario = made(agent("ego", np.linspace(0, 20, 5), 0.0), agent("car", np.linspace(20, 0, 5), 0.5, yaw_rad=np.pi))
    replayed = replay(scenario, mode="exact", dt_s=0.1)
    (event,) = replayed.metrics["collisions"]  # both at 10 m after 2 s, bumpers 0.4 s before
    assert (event["t_s"], event["until_s"]) == pytest.approx((1.6, 2.4), abs=0.06)
    later = {**event, "t_s": 3.0, "until_s": 3.1, "agents": ["car"], "belongs_to": "replay"}
    metrics = {**replayed.metrics, "collisions": [event, later]}
    write_page(scenario, tmp_path / "page.html", replay=replace(replayed, metrics=metrics))
    opened(browser, tmp_path / "page.html")
    marks = browser.run("return [...document.querySelectorAll('#events button')].map((b) => [b.className, b.title])")
    assert marks == [
        ["known", f"ego and car collide at {event['t_s']:.2f} s, in the scenario itself"], ["new", "car collide at 3.00 s"],
    ]  # fmt: skip
    script = """return [...document.querySelectorAll('#events .label')].map((label, k) => {
        const at = document.querySelectorAll('#events button')[k].getBoundingClientRect(), box = label.getBoundingClientRect();
        return [label.textContent, (box.left + box.right) / 2 - (at.left + at.right) / 2];
    })"""
    labels = browser.run(script)
    assert [text for text, _ in labels] == ["ego × car", "car"]
    assert max(abs(off) for _, off in labels) < 1.5
    assert text_of(browser, "collided-count") == "2 collisions"
    browser.press("e")
    assert time_of(browser) == pytest.approx(event["t_s"], abs=1e-4)
    assert browser.run("return log2sim.chosen") == "ego"
    browser.press("e")
    assert (time_of(browser), browser.run("return log2sim.chosen")) == (3.0, "car")
    browser.press("e")
    assert time_of(browser) == pytest.approx(event["t_s"], abs=1e-4)
    box = browser.run("return document.querySelector('#events .new').getBoundingClientRect().toJSON()")
    browser.mouse((box["x"] + box["width"] / 2, box["y"] + box["height"] - 3))
    assert time_of(browser) == 3.0
    browser.run("log2sim.choose(null)")
    scale = browser.run("return log2sim.pixelsPerMeter")
    below = place_of(browser, "car") + np.array([1.2 * scale, scale + 3.5])
    colors = [pixel(browser, below + np.array([0, k])) for k in (-1, 0, 1)]
    assert any(np.abs(np.subtract(c, rgb("#C62828"))).max() < 60 for c in colors)


def test_plots_show_how_far_truth_and_replay_are(browser: Browser, tmp_path: Path) -> None:
    ways = {
        name: agent("ego", np.linspace(0, 20, 5), y)
        for name, y in (("scenario", 0.0), ("truth", 0.25), ("replay", -1.5))
    }
    layers = {"truth": made(ways["truth"]), "replay": replay(made(ways["replay"]), mode="exact", dt_s=0.1)}
    write_page(made(ways["scenario"]), tmp_path / "page.html", **layers)
    opened(browser, tmp_path / "page.html", "#t=1.7&agent=ego")
    pixel(browser, np.zeros(2))
    shown = "return [...document.querySelectorAll('figure')].map((f) => f.hidden ? null : f.querySelector('output').textContent)"
    assert browser.run(shown) == ["5.00 m/s · 18 km/h", None, "0.25 m · 1.50 m"]


def test_the_list_is_searched(browser: Browser, sample: Path) -> None:
    opened(browser, sample)
    shown = "return [...document.querySelectorAll('#agents .id')].map((e) => e.textContent)"
    assert len(browser.run(shown)) == 12
    browser.press("/", *"static car")
    assert browser.run(shown) == ["car_parked", "car_parked_north"]
    assert time_of(browser) == 0.0  # letters of a search are no commands
    browser.press(ENTER)
    assert browser.run("return log2sim.chosen") == "car_parked"
    browser.run("const s = document.getElementById('search'); s.value = 'xyz'; s.dispatchEvent(new Event('input'))")
    assert browser.run(shown) == []
    assert text_of(browser, "more") == "No agent matches."


@pytest.mark.parametrize(("size", "first"), [((1200, 800), True), ((390, 780), False)], ids=["wide", "narrow"])
def test_the_list_is_put_away_and_an_agent_shown_all_the_same(
    browser: Browser, sample: Path, size: tuple[int, int], first: bool
) -> None:
    opened(browser, sample, size=size)
    script = "return ['agent-list', 'details'].map((id) => document.getElementById(id).getClientRects().length > 0)"
    assert browser.run(script) == [first, False]
    browser.press("a")
    assert browser.run(script) == [not first, False]
    browser.run("log2sim.choose('bus_1')")
    assert browser.run(script) == [False, True]
    browser.press(ESCAPE)
    assert browser.run(script) == [not first, False]
    inside = "const r = document.getElementById('scrub').getBoundingClientRect(); return [r.right, r.bottom]"
    assert (np.array(browser.run(inside)) <= size).all()


def test_the_policy_lets_nothing_out(chromium: Browser, sample: Path) -> None:
    opened(chromium, sample)
    script = "const done = arguments[0]; fetch('http://127.0.0.1:9/').then(() => done('sent'), (e) => done(e.name))"
    assert chromium.run_async(script) == "TypeError"
    chromium.run(
        "const s = document.createElement('script'); s.textContent = 'window.ran = 1'; document.body.append(s)"
    )
    chromium.run("const i = new Image(); i.src = 'http://127.0.0.1:9/i.png'; document.body.append(i)")
    assert chromium.run("return window.ran") is None
    refused = [entry["message"] for entry in chromium.log("browser")]
    assert len([m for m in refused if "Content Security Policy" in m]) >= 3
    chromium.requests()


def test_a_map_of_the_ground_is_embedded_where_it_lies_and_stays_small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("log2sim.visualization.page.document.MAX_BYTES", 20_000)
    alpha = np.zeros((400, 420), np.uint8)
    alpha[10:390, 20:410] = 255
    color = np.random.default_rng(2).integers(0, 256, (400, 420, 3)).astype(np.uint8)
    nothing = np.full(alpha.shape, np.nan, np.float32)
    ground = GroundMap(color, alpha, nothing, nothing, 0.5, (10.0, 220.0, 0.0, 200.0))
    entry = page_document(made(agent("a", np.arange(5.0), 0.0)), background=ground)["background"]
    assert entry["extent_m"] == [20.0, 215.0, 5.0, 195.0]
    kind, _, data = entry["source"].partition(",")
    assert kind == "data:image/webp;base64"
    assert len(data) <= 20_000 * 4 / 3 + 4
    shown = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_UNCHANGED)
    assert shown.shape[1] < 390
    assert shown.shape[1] / shown.shape[0] == pytest.approx(390 / 380, rel=0.02)
    blank = GroundMap(color[:5, :5], alpha[:5, :5], nothing[:5, :5], nothing[:5, :5], 0.5, (0.0, 2.5, 0.0, 2.5))
    assert page_document(made(agent("a", np.arange(5.0), 0.0)), background=blank)["background"] is None


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
