"""The studio: what it serves and to whom, what it keeps, and what can be done on its page."""

from __future__ import annotations

import contextlib
import http.client
import json
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import Browser
from command_line import run
from test_edit import parked, scenario, straight

from log2sim import open_log
from log2sim.datatypes import COLOR_NAMES, Agent, Finding, Log, Scenario
from log2sim.datatypes.color_names import name_of
from log2sim.edit.corrections import correct, load_corrections
from log2sim.errors import ScenarioError
from log2sim.geometry import Camera, apply, inverse, project
from log2sim.visualization.page.document import PAINTS
from log2sim.visualization.page.writer import write_page
from log2sim.visualization.recording import Recorded
from log2sim.visualization.studio import Studio

ROOT = Path(__file__).resolve().parents[1]


def world() -> Scenario:
    """A car whose track is broken in two beside a parked one that points backwards."""
    whole = straight("car-1", y_m=6.0)
    w = whole.waypoints
    first, last = (
        replace(whole, id=f"car-{k}", waypoints=w.take(part)) for k, part in ((1, w.t_s < 1.5), (2, w.t_s > 2.0))
    )
    doubtful = replace(parked("car-3"), doubts=(Finding("heading_ambiguous"),))
    return scenario(straight("ego", speed_mps=5.0), first, last, doubtful)


@contextlib.contextmanager
def serving(path: Path, source: Scenario | None = None, **options: Any) -> Iterator[Studio]:
    studio = Studio(source or world(), path, **options)
    thread = threading.Thread(target=studio.serve, daemon=True)
    thread.start()
    try:
        yield studio
    finally:
        studio.close()
        thread.join(10)


def ask(studio: Studio, method: str, path: str, body: bytes | None = None, **headers: str) -> tuple[int, bytes]:
    connection = http.client.HTTPConnection(studio.origin.removeprefix("http://"), timeout=20)
    connection.request(method, path, body, headers)
    reply = connection.getresponse()
    got = reply.status, reply.read()
    connection.close()
    return got


FLIP = {"kind": "flip", "agent": {"t_ns": 10**9, "x_m": 30.0, "y_m": -3.0}}


def put(studio: Studio, *entries: Any, **headers: str) -> tuple[int, dict[str, Any]]:
    document = {"format": "log2sim-corrections", "version": 1, "corrections": list(entries)}
    path = studio.address.removeprefix(studio.origin) + "corrections"
    code, body = ask(studio, "PUT", path, json.dumps(document).encode(), **headers)
    return code, json.loads(body) if code != 404 else {}


def test_what_is_corrected_is_kept_and_gone_on_with(tmp_path: Path) -> None:
    file = tmp_path / "c.json"
    with serving(file) as studio:
        code, reply = put(studio, FLIP)
        assert code == 200
        assert reply["unmatched"] == []
        assert [a["doubts"] for a in reply["agents"] if a["id"] == "car-3"] == [[]]
    assert load_corrections(file)["corrections"] == [FLIP]
    with serving(file) as studio:
        assert not studio.result.scenario["car-3"].doubts
        assert b"heading_ambiguous" not in studio.page()


def test_only_its_own_page_on_this_computer_is_answered(tmp_path: Path) -> None:
    with serving(tmp_path / "c.json") as studio:
        page = studio.address.removeprefix(studio.origin)
        assert ask(studio, "GET", page)[0] == 200
        assert ask(studio, "GET", "/")[0] == 404
        assert ask(studio, "GET", "/guess/")[0] == 404
        assert ask(studio, "GET", page, Host="evil.example")[0] == 404
        assert put(studio, FLIP, Origin="http://evil.example")[0] == 404
        assert put(studio, FLIP, Host="localhost.evil.example")[0] == 404
        assert studio.origin.startswith("http://127.0.0.1:")
    assert not (tmp_path / "c.json").exists()


@pytest.mark.parametrize(
    "body",
    [
        b"",
        b"{",
        b"[" * 100_000,
        b'{"format": 1}',
        b'{"format": "log2sim-corrections", "version": 1, "corrections": [NaN]}',
    ],
)
def test_a_body_that_is_no_document_changes_nothing(tmp_path: Path, body: bytes) -> None:
    with serving(tmp_path / "c.json") as studio:
        put(studio, FLIP)
        path = studio.address.removeprefix(studio.origin) + "corrections"
        code, reply = ask(studio, "PUT", path, body)
        assert code == 422
        assert "error" in json.loads(reply)
        assert ask(studio, "PUT", path, None, **{"Content-Length": "99999999999"})[0] == 413
        assert put(studio, FLIP)[0] == 200
    assert load_corrections(tmp_path / "c.json")["corrections"] == [FLIP]


def test_contradicting_corrections_are_one_line_and_not_kept(tmp_path: Path) -> None:
    with serving(tmp_path / "c.json") as studio:
        entries = [{**FLIP, "kind": "category", "category": name} for name in ("bus", "truck")]
        code, reply = put(studio, *entries)
        assert code == 422
        assert "contradict" in reply["error"]
    assert not (tmp_path / "c.json").exists()
    (tmp_path / "c.json").write_text("{}")
    with pytest.raises(ScenarioError):
        Studio(world(), tmp_path / "c.json")


def test_a_second_studio_on_a_file_is_refused(tmp_path: Path, interruptible: None) -> None:
    world().save(tmp_path / "s.json")
    arguments = ["studio", tmp_path / "s.json", "--corrections", tmp_path / "c.json", "--no-browser"]
    command = [sys.executable, "-m", "log2sim", *map(str, arguments)]
    first = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    try:
        assert first.stdout is not None
        assert first.stdout.readline().startswith("http://127.0.0.1:")
        ran = run(*arguments)
        assert ran.code == 2
        assert "c.json" in ran.err
        first.send_signal(signal.SIGINT)
        assert "0 corrections" in first.communicate(timeout=20)[0]
        assert first.returncode == 0
    finally:
        first.kill()


# The page


@pytest.fixture
def studio(tmp_path: Path) -> Iterator[Studio]:
    with serving(tmp_path / "c.json") as served:
        yield served


def shown(browser: Browser, studio: Studio, count: int) -> list[str]:
    """Wait until so many corrections are kept; return the agents of the page."""
    browser.wait(f"log2sim.corrections().length === {count}")
    assert len(studio.document["corrections"]) == count
    return list(browser.run("return log2sim.agents"))


def click(browser: Browser, name: str) -> None:
    browser.run("document.getElementById(arguments[0]).click()", f"studio-{name}")


def place(browser: Browser, agent: str) -> tuple[float, float]:
    x, y = browser.run(
        "const r = document.getElementById('map').getBoundingClientRect(), p = log2sim.placeOf(arguments[0]); return [p[0] + r.left, p[1] + r.top]",
        agent,
    )
    return float(x), float(y)


def test_a_scenario_is_corrected_on_the_page(chromium: Browser, studio: Studio) -> None:
    browser = chromium
    browser.open(studio.address)
    browser.press("J")  # the doubtful one
    assert browser.run("return log2sim.chosen") == "car-3"
    browser.press("B")
    shown(browser, studio, 1)
    assert studio.result.scenario["car-3"].waypoints.yaw_rad[0] < 0
    assert browser.run("return document.getElementById('doubts-toggle').hidden")

    # Two tracks of one car, merged by the keyboard and a click.
    browser.run("log2sim.choose('car-1'); log2sim.time = 2.2")
    browser.press("M")
    browser.mouse(place(browser, "car-2"))
    assert shown(browser, studio, 2) == ["ego", "car-1", "car-3"]
    assert studio.result.scenario["car-1"].waypoints.t_s[-1] == 4.0

    # Dragged 2 m to the left of its way, and put back by undo.
    scale = browser.run("return log2sim.pixelsPerMeter")
    click(browser, "move")
    x, y = place(browser, "car-1")
    browser.mouse((x, y), (x, y - scale), (x, y - 2 * scale))
    click(browser, "move")
    shown(browser, studio, 3)
    assert studio.result.scenario["car-1"].at(2.2).y_m[0] == pytest.approx(8.0, abs=2 / scale)
    browser.press("Z")
    shown(browser, studio, 2)
    assert studio.result.scenario["car-1"].at(2.2).y_m[0] == pytest.approx(6.0, abs=0.01)
    browser.press("Y")
    shown(browser, studio, 3)

    browser.run(
        "const e = document.getElementById('studio-category'); e.value = 'truck'; e.dispatchEvent(new Event('change'))"
    )
    shown(browser, studio, 4)
    assert studio.result.scenario["car-1"].category == "truck"
    for name in ("blue", "red"):  # at once: the second waits for the first and takes its place
        browser.run(
            "const e = document.getElementById('studio-color'); e.value = arguments[0]; e.dispatchEvent(new Event('change'))",
            name,
        )
    browser.wait(
        "document.getElementById('studio-color').value === 'red' && log2sim.corrections().at(-1).name === 'red'"
    )
    shown(browser, studio, 5)
    assert (studio.result.scenario["car-1"].color or {})["name"] == "red"
    browser.press("\ue017")  # Delete
    assert "car-1" not in shown(browser, studio, 6)
    assert [entry for entry in browser.log("browser") if entry["level"] == "SEVERE"] == []
    assert {address.split("/")[2] for address in browser.requests()} <= {studio.origin.removeprefix("http://")}


def test_two_pages_of_a_studio_lose_nothing(chromium: Browser, studio: Studio) -> None:
    browser = chromium
    browser.open(studio.address)
    assert put(studio, FLIP)[0] == 200  # from another page
    browser.run("log2sim.choose('car-1')")
    click(browser, "confirm")
    browser.wait("document.getElementById('studio-status').textContent.includes('load this one again')")
    assert studio.document["corrections"] == [FLIP]
    browser.open(studio.address)
    browser.run("log2sim.choose('car-1')")
    click(browser, "confirm")
    shown(browser, studio, 2)


def test_the_page_without_a_server_corrects_and_downloads(chromium: Browser, tmp_path: Path) -> None:
    browser = chromium
    write_page(world(), tmp_path / "page.html")
    browser.cdp("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path))
    browser.open((tmp_path / "page.html").as_uri())
    browser.press("J")
    assert browser.run("return log2sim.chosen") is None  # folded, the keys are those of the page
    browser.run("document.getElementById('studio').open = true")
    read = [n for n in browser.cdp("Accessibility.getFullAXTree")["nodes"] if not n["ignored"]]
    controls = [
        n for n in read if n["role"]["value"] in ("button", "combobox", "spinbutton", "textbox", "slider", "image")
    ]
    assert len(controls) > 30
    assert [n["role"]["value"] for n in controls if not n["name"]["value"]] == []
    for name, text in (("author", "me"), ("reason", "its lamps")):
        browser.run("document.getElementById(arguments[0]).value = arguments[1]", f"studio-{name}", text)
    browser.press("J", "B")
    browser.wait("log2sim.corrections().length === 1")
    turned = browser.run("return log2sim.headingOf('car-3')")
    assert np.cos(turned - world()["car-3"].waypoints.yaw_rad[0]) == pytest.approx(-1.0)
    browser.run("log2sim.choose('car-1'); log2sim.time = 2.2")
    browser.press("M")
    browser.run(
        "[...document.querySelectorAll('#agents button')].find((b) => b.textContent.startsWith('car-2')).click()"
    )
    browser.wait("log2sim.agents.length === 3")
    browser.press("Z")
    browser.wait("log2sim.agents.length === 4")
    browser.press("Y")
    browser.wait("log2sim.agents.length === 3")
    click(browser, "download")
    file = tmp_path / "corrections.json"
    for _ in range(100):
        if file.exists():
            break
        time.sleep(0.05)
    document = load_corrections(file)
    assert [(c["kind"], c["author"], c.get("reason")) for c in document["corrections"]] == [
        ("flip", "me", "its lamps"),
        ("merge", "me", None),
    ]
    result = correct(world(), document)
    assert result.unmatched == ()
    assert result.scenario["car-3"].waypoints.yaw_rad[0] < 0
    assert [agent.id for agent in result.scenario.agents] == ["ego", "car-1", "car-3"]
    assert [entry for entry in browser.log("browser") if entry["level"] == "SEVERE"] == []


def test_on_a_phone_and_by_touch(chromium: Browser, studio: Studio) -> None:
    browser = chromium
    browser.open(studio.address, size=(420, 800), dark=True)
    browser.touch([place(browser, "car-3")])
    browser.wait("log2sim.chosen === 'car-3'")
    for name in ("confirm", "merge", "move", "next", "undo"):
        left, top, right, bottom = browser.run(
            "const r = document.getElementById(arguments[0]).getBoundingClientRect(); return [r.left, r.top, r.right, r.bottom]",
            f"studio-{name}",
        )
        assert bottom - top >= 44
        assert 0 <= left < right <= 420
    click(browser, "confirm")
    shown(browser, studio, 1)
    assert not studio.result.scenario["car-3"].is_doubtful


def test_lines_are_drawn_and_erased_on_the_page(chromium: Browser, studio: Studio) -> None:
    browser = chromium
    browser.open(studio.address)
    browser.run("document.getElementById('studio-feature').value = 'curb'")

    def window(x_m: float, y_m: float) -> tuple[float, float]:
        x, y = browser.run(
            "const r = document.getElementById('map').getBoundingClientRect(), p = log2sim.pixelOf(...arguments); return [p[0] + r.left, p[1] + r.top]",
            x_m,
            y_m,
        )
        return float(x), float(y)

    click(browser, "line")
    for place_m in ((5.0, -8.0), (15.0, -8.0), (25.0, -7.0)):
        browser.mouse(window(*place_m))
    browser.press("\ue007")
    shown(browser, studio, 1)
    features = studio.result.scenario.map_features
    assert features is not None
    (border,) = features.borders
    assert border.kind == "curb"
    np.testing.assert_allclose(border.points_m[:, :2], [[5, -8], [15, -8], [25, -7]], atol=0.2)
    np.testing.assert_allclose(border.points_m[:, 2], 0.0, atol=1e-3)  # on the ground below the boxes
    click(browser, "erase")
    browser.mouse(window(10.0, -8.0))
    shown(browser, studio, 2)
    assert not studio.result.scenario.map_features


def test_a_box_is_sized_in_the_map_and_the_other_end_stays(chromium: Browser, studio: Studio) -> None:
    browser = chromium
    browser.open(studio.address)
    before = studio.result.scenario["car-3"]
    browser.run("log2sim.choose('car-3')")
    scale = browser.run("return log2sim.pixelsPerMeter")
    while scale < 25:
        browser.wheel(*place(browser, "car-3"), -400)
        scale = browser.run("return log2sim.pixelsPerMeter")
    browser.press("E")
    x, y = place(browser, "car-3")
    w, (length, width, _) = before.waypoints, before.size_m
    ahead = np.array([np.cos(w.yaw_rad[0]), -np.sin(w.yaw_rad[0])]) * scale
    front = np.array([x, y]) + ahead * length / 2
    browser.mouse(tuple(front), tuple(front + ahead))  # type: ignore[arg-type]
    browser.press("\ue007")
    browser.wait("log2sim.corrections().length === 2")
    after = studio.result.scenario["car-3"]
    assert after.size_m[:2] == pytest.approx((length + 1.0, width), abs=1.5 / scale)
    rear = [
        np.array([a.waypoints.x_m[0], a.waypoints.y_m[0]]) - ahead * [1, -1] / scale * a.size_m[0] / 2
        for a in (before, after)
    ]
    np.testing.assert_allclose(rear[1], rear[0], atol=0.1)


SHOW_FRONT = "[...document.querySelectorAll('#cameras button')].find((b) => b.textContent === 'front').click()"


def test_a_box_is_moved_in_a_picture_through_its_calibration(chromium: Browser, tmp_path: Path) -> None:
    """The picture's pixels are those of log2sim's own projection, and a drag there moves the box on the ground."""
    log = open_log(ROOT / "samples/crossing")
    scenario = Scenario.load(ROOT / "samples/crossing/truth.json")
    browser = chromium
    with serving(tmp_path / "c.json", scenario, recorded=Recorded(log, max_bytes=3_000_000)) as served:
        browser.open(served.address)
        name = "car_parked"
        browser.run(SHOW_FRONT)
        browser.run("log2sim.time = 1.0; log2sim.choose(arguments[0])", name)
        browser.wait("log2sim.pictures.front !== null")
        browser.press("E")
        browser.wait("log2sim.pictures.front === log2sim.time")
        t_s = browser.run("return log2sim.time")
        expected = in_view(log, scenario, scenario[name], t_s)
        at = scenario[name].at(t_s)
        pixel = browser.run("return log2sim.inPicture('front', ...arguments)", float(at.x_m[0]), float(at.y_m[0]))
        box = browser.run(
            "const r = document.querySelector('[aria-label=\"Picture of front\"]').getBoundingClientRect(); return [r.left, r.top, r.width]"
        )
        np.testing.assert_allclose(
            (np.array(pixel) - box[:2]) * log.cameras["front"].width_px / box[2], expected, atol=0.5
        )
        goal = browser.run(
            "return log2sim.inPicture('front', ...arguments)", float(at.x_m[0]) - 2.0, float(at.y_m[0]) + 2.0
        )
        browser.mouse(tuple(pixel), tuple(goal))
        browser.press("\ue007")
        browser.wait("log2sim.corrections().length === 1")
        (entry,) = served.document["corrections"]
        # A pixel of the picture is up to a meter of the ground there.
        moved = np.array([entry["poses"][0]["x_m"] - at.x_m[0], entry["poses"][0]["y_m"] - at.y_m[0]])
        np.testing.assert_allclose(moved, [-2.0, 2.0], atol=0.8)
        # Loaded again, its box is in the picture where it is now.
        browser.open(served.address)
        browser.run(SHOW_FRONT)
        browser.run("log2sim.time = arguments[0]", t_s)
        browser.wait("log2sim.pictures.front !== null")
        now = served.result.scenario[name].at(t_s)
        browser.mouse(
            tuple(
                browser.run(
                    "return log2sim.inPicture('front', ...arguments)", float(now.x_m[0]), float(now.y_m[0]), 0.7
                )
            )
        )
        browser.wait(f"log2sim.chosen === '{name}'")
        # Its shape is that of the camera's pictures on a phone, too, so that the calibration holds.
        browser.open(served.address, size=(420, 800))
        browser.run("log2sim.choose(arguments[0])", name)
        click(browser, "move")
        browser.run(SHOW_FRONT)
        shape = "const c = document.querySelector('[aria-label=\"Picture of front\"]'); return c.clientWidth / c.clientHeight"
        camera = log.cameras["front"]
        assert browser.run(shape) == pytest.approx(camera.width_px / camera.height_px, rel=0.01)
        assert [line for line in browser.log("browser") if line["level"] == "SEVERE"] == []


def in_view(log: Log, scenario: Scenario, agent: Agent, t_s: float) -> np.ndarray:
    """Pixel of the ground below an agent in the front camera."""
    stamps, at = log.streams["front"].t_ns, agent.at(t_s)
    t_ns = int(stamps[np.argmin(np.abs(stamps - scenario.t0_ns - t_s * 1e9))])
    ground = np.array([[at.x_m[0], at.y_m[0], at.z_m[0] - agent.size_m[2] / 2]])
    return project(log.cameras["front"], apply(inverse(log.map_T_sensor("front", t_ns)[0][0]), ground))[0][0]


def test_paints_have_the_colors_of_their_names() -> None:
    assert {name: name_of(rgb) for name, rgb in PAINTS.items()} == {name: name for name in COLOR_NAMES}


@pytest.mark.parametrize(
    ("model", "distortion"),
    [
        ("none", ()),
        ("brown", (-0.3, 0.1, 0.002, -0.001, -0.02)),
        ("brown", (-0.2, 0.05, 0.001, 0.002, 0.01, 0.1, 0.02, 0.003)),
        ("fisheye", (-0.02, 0.01, -0.003, 0.0005)),
    ],
)
def test_the_page_projects_as_log2sim_does(model: str, distortion: tuple[float, ...], chromium: Browser) -> None:
    K = np.array([[900.0, 0, 640], [0, 880.0, 360], [0, 0, 1]])
    cam_T_map = np.array([[0.0, -1, 0, 0.3], [0, 0, -1, 1.6], [1, 0, 0, -2.0], [0, 0, 0, 1]])
    camera = Camera("c", 1280, 720, K, "map", inverse(cam_T_map), model, distortion)
    ground = np.array([[x, y, 0.2] for x in (6.0, 15.0, 60.0) for y in (-2.5, 0.0, 2.0)])
    uv, valid = project(camera, apply(cam_T_map, ground))
    assert valid.all()
    entry = {"K": [900, 880, 640, 360], "model": model, "distortion": list(distortion), "reach": 1e6}
    entry |= {"t_s": [0.0], "cam_T_map": [cam_T_map[:3].ravel().tolist()]}
    source = (ROOT / "log2sim/visualization/page/surface.js").read_text(encoding="utf-8")
    chromium.open("about:blank")
    pixels, places = chromium.run(
        source
        + """const [entry, points] = arguments, camera = new Calibrated(entry), m = entry.cam_T_map[0];
        const pixels = points.map((point) => camera.pixel(camera.toCamera(m, ...point)));
        return [pixels, pixels.map(([u, v], k) => camera.ground(m, u, v, points[k][2]))];""",
        entry,
        ground.tolist(),
    )
    np.testing.assert_allclose(pixels, uv, atol=1e-6)
    np.testing.assert_allclose(places, ground[:, :2], atol=1e-3)
