"""The page with a log: which pictures and points it takes, where boxes are drawn in them, and how large it becomes."""

from __future__ import annotations

import base64
import json
import re
import zlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from browser import CHROMIUM, DRIVER, Browser, browsing
from command_line import names, run
from hypothesis import given, settings
from hypothesis import strategies as st
from worlds import Solid, camera_ahead, outline_px

from log2sim.datatypes import Agent, Doubt, Lidar, Log, MapFrame, Scenario, Stream, Sweep, Waypoints
from log2sim.errors import ConfigError
from log2sim.geometry import Camera, box_corners, project
from log2sim.visualization.page.writer import write_page
from log2sim.visualization.recording import (
    CORNERS,
    MIN_HEIGHT_M,
    SEGMENTS,
    UNIT_M,
    OutlineProjector,
    PointsAbove,
    Recorded,
    choose_cameras,
    outline_of,
    pack,
    records_within,
    take_at_rate,
    take_evenly,
)

STEP_NS, FRAMES = 100_000_000, 21
START_NS = 1_700_000_000_000_000_000
CAR_SIZE = (4.4, 1.8, 1.5)
NOISE = np.random.default_rng(0).integers(-9, 10, (600, 1200, 1))  # makes pictures as large as those of a street
PATCH_M = (12.0, 8.0)  # where the LiDAR shows something that is 3 m high


def camera_of(name: str = "a", **placed: Any) -> Camera:
    """A camera at the roadside, 600 x 300 px."""
    whole = camera_ahead(name, **placed)
    return replace(whole, width_px=600, height_px=300, K=np.diag([0.5, 0.5, 1.0]) @ whole.K)


def agent(id: str, x_m: Any, y_m: float, **changes: Any) -> Agent:
    """An agent with a waypoint a second along x, heading east."""
    x = np.asarray(x_m, float)
    speed = np.gradient(x) if len(x) > 1 else np.zeros(1)
    flat, z = np.full(len(x), y_m), np.full(len(x), CAR_SIZE[2] / 2)
    w = Waypoints(np.arange(float(len(x))), x, flat, z, 0 * x, speed, np.ones(len(x), bool), 0 * x)
    return Agent(**{"id": id, "category": "car", "size_m": CAR_SIZE, "waypoints": w, **changes})


def picture(index: int, camera: Camera) -> np.ndarray:
    """A picture whose green tells its index: 10 for each; its right half is brighter, so that it shows something."""
    out = np.full((camera.height_px, camera.width_px, 3), (100, 20 + 10 * index, 160), np.int64)
    out[:, camera.width_px // 2 :, 0] += 60
    return (out + NOISE[: camera.height_px, : camera.width_px]).astype(np.uint8)


def points() -> np.ndarray:
    """The ground around the sensors, and a patch of 2 m that is 3 m high."""
    axis = np.arange(-30.0, 30.1, 0.5)
    ground = np.stack([g.ravel() for g in np.meshgrid(axis, axis, [0.0])], axis=1)
    small = np.arange(-1.0, 1.01, 0.1)
    patch = np.stack([g.ravel() for g in np.meshgrid(small, small, [3.0])], axis=1) + np.array([*PATCH_M, 0.0])
    return np.concatenate([ground, patch])


def roadside(*cameras: Camera) -> Log:
    """A log of cameras and a LiDAR at the roadside, whose pictures and points are known."""
    stamps = START_NS + STEP_NS * np.arange(FRAMES)
    streams = {c.name: Stream(c.name, stamps, lambda i, c=c: picture(i, c)) for c in cameras}
    xyz = points()
    bright = np.linspace(0, 50, len(xyz), dtype=np.float32)
    streams["top"] = Stream("top", stamps, lambda i: Sweep(int(stamps[i]), xyz, intensity=bright))
    lidars = {"top": Lidar("top", "map", np.eye(4))}
    return Log("road", "test", {c.name: c for c in cameras}, lidars, streams)


def scene(**changes: Any) -> Scenario:
    """A car that drives away from the camera, and a parked one beside it that is doubtful."""
    doubt = Doubt("empty", "rays pass through it")
    agents = (agent("car", [12.0, 20.0, 28.0], 0.0), agent("parked", [18.0], 6.0, static=True, doubts=(doubt,)))
    return Scenario(name="road", t0_ns=START_NS, duration_s=2.0, agents=agents, **changes)


def document_of(page: Path) -> dict[str, Any]:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page.read_text(), re.DOTALL)
    assert found
    return dict(json.loads(found[1]))


def unpacked(text: str) -> np.ndarray:
    """Rows x, y, height, intensity as bytes hold them."""
    planes = np.frombuffer(zlib.decompress(base64.b64decode(text)), np.uint8).reshape(6, -1).astype(np.int64)
    steps = [(planes[k] + 256 * planes[k + 1] + 2**15) % 2**16 - 2**15 for k in (0, 2)]
    return np.stack([*(np.cumsum(s) * UNIT_M for s in steps), planes[4], planes[5]], axis=1)


# What is taken


def test_records_are_taken_at_a_rate_or_evenly() -> None:
    t_ns = START_NS + STEP_NS * np.arange(100)
    assert records_within(t_ns, scene()).tolist() == list(range(21))
    assert take_at_rate(t_ns, np.arange(21), 5.0, START_NS).tolist() == list(range(0, 21, 2))
    assert take_at_rate(t_ns, np.arange(21), 10.0, START_NS).tolist() == list(range(21))
    assert take_at_rate(t_ns, np.arange(21), 1.0, START_NS).tolist() == [0, 10, 20]
    early = t_ns - STEP_NS // 5  # a camera whose first picture is a little before the scenario shows the same moments
    assert take_at_rate(early, np.arange(1, 21), 5.0, START_NS).tolist() == [1, *range(2, 21, 2)]
    assert take_evenly(9, 3).tolist() == [0, 4, 8]
    assert take_evenly(3, 9).tolist() == [0, 1, 2]


def test_cameras_are_in_the_order_in_which_they_look() -> None:
    def ego(name: str, yaw_deg: float) -> Camera:
        return camera_ahead(name, mount="ego", yaw_rad=np.radians(yaw_deg))

    log = roadside(ego("back", 178.0), ego("front", 0.0), ego("left", 60.0), camera_ahead("pole"), ego("right", -60.0))
    assert choose_cameras(log, scene()) == ("left", "front", "right", "back", "pole")
    used = scene(cameras=({"name": "front", "used": True}, {"name": "left", "used": False}))
    assert choose_cameras(log, used) == ("front",)
    assert choose_cameras(log, used, ("right", "left")) == ("left", "right")
    with pytest.raises(ConfigError, match="no camera 'rear'; the log has: back, front"):
        choose_cameras(log, used, ("rear",))


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.2, 1.0]))
def test_points_come_back_one_of_each_cell_the_highest(seed: int, cell_m: float) -> None:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 300))
    xy, height = rng.uniform(-100, 100, (n, 2)) * rng.choice([0.02, 1.0]), rng.uniform(MIN_HEIGHT_M, 5.0, n)
    rows = unpacked(pack(PointsAbove(0, (0, 0), xy, height, np.full(n, np.nan)), cell_m, 0.0))
    highest: dict[tuple[int, ...], int] = {}
    for k, cell in enumerate(map(tuple, np.floor(xy / cell_m).astype(int).tolist())):
        if cell not in highest or height[k] > height[highest[cell]]:
            highest[cell] = k
    kept = sorted(highest.values(), key=lambda k: tuple(np.floor(xy[k] / cell_m).astype(int)[::-1]))
    np.testing.assert_allclose(rows[:, :2], xy[kept], atol=UNIT_M / 2 + 1e-9)
    np.testing.assert_allclose(rows[:, 2] / 255 * (5.0 - MIN_HEIGHT_M) + MIN_HEIGHT_M, height[kept], atol=0.02)
    assert not rows[:, 3].any()


def test_outlines_are_where_a_pinhole_camera_shows_the_boxes() -> None:
    camera = camera_ahead("front")
    projector = OutlineProjector(roadside(camera), scene())
    found = projector.outlines("front", START_NS + 5 * STEP_NS)
    assert [projector.agents[row[0]].id for row in found] == ["parked", "car"]  # the farthest first
    for row, solid in zip(found, (Solid((18.0, 6.0, 0.75), CAR_SIZE), Solid((16.0, 0.0, 0.75), CAR_SIZE))):
        assert row[1] == CORNERS
        uv = np.array(row[2:]).reshape(8, 2)
        expected = outline_px(camera, camera.mount_T_cam, solid)
        np.testing.assert_allclose([*uv.min(axis=0), *uv.max(axis=0)], expected, atol=0.5)
    assert not projector.outlines("front", START_NS + 25 * STEP_NS)[1:]  # the car is gone, the parked one is not


def test_a_box_is_drawn_as_corners_only_where_its_edges_are_straight() -> None:
    straight = camera_ahead()
    bent = Camera("bent", 1200, 600, straight.K, "map", np.eye(4), "brown", (-0.3, 0.08, 0.0, 0.0))
    near = box_corners([0.0, 0.0, 5.0], [4.0, 2.0, 2.0], 0.0)[0]
    far = near + np.array([0.0, 0.0, 60.0])
    assert outline_of(straight, near)[0] == CORNERS
    assert outline_of(bent, far)[0] == CORNERS
    kind, lines = outline_of(bent, near)
    assert kind == SEGMENTS
    ends = project(bent, near)[0]
    assert min(np.hypot(*(lines.reshape(-1, 2) - ends[0]).T)) < 1e-6
    assert outline_of(straight, near - [0.0, 0.0, 5.0])[0] == SEGMENTS  # a part is behind the camera


@pytest.mark.slow
@pytest.mark.parametrize("max_bytes", [260_000, 1_200_000])
def test_the_page_keeps_to_its_size_and_uses_it(tmp_path: Path, max_bytes: int) -> None:
    log = roadside(camera_of("a"), camera_of("b", yaw_rad=0.5))
    notes = write_page(scene(), tmp_path / "page.html", recorded=Recorded(log, max_bytes))
    size = (tmp_path / "page.html").stat().st_size
    assert size <= max_bytes
    assert size > 0.35 * max_bytes
    document = document_of(tmp_path / "page.html")["recording"]
    assert tuple(document["notes"]) == notes
    write_page(scene(), tmp_path / "log.html", recorded=log)  # with all that fits into a page of the usual size
    assert "pictures" in document_of(tmp_path / "log.html")["recording"]
    shown = document["pictures"]["cameras"]
    assert [camera["name"] for camera in shown] == ["a", "b"]
    for camera in shown:
        for t_s, jpeg in zip(camera["t_s"], camera["jpeg"], strict=True):
            image = cv2.imdecode(np.frombuffer(base64.b64decode(jpeg), np.uint8), cv2.IMREAD_COLOR)
            assert image.shape[1] == document["pictures"]["width_px"]
            assert image.mean(axis=(0, 1))[1] == pytest.approx(20 + 10 * round(t_s * 10), abs=3)


def test_a_size_that_is_too_small_is_refused(tmp_path: Path) -> None:
    log = roadside(camera_of("a"))
    for max_bytes in (50_000, 118_000):
        with pytest.raises(ConfigError, match=r"--max-mb: .* MB"):
            write_page(scene(), tmp_path / "page.html", recorded=Recorded(log, max_bytes))
    assert names(tmp_path) == []


def test_view_shows_a_log(log_folder: Path, tmp_path: Path) -> None:
    truth = log_folder / "truth.json"
    metrics = tmp_path / "metrics.json"
    assert run("evaluate", truth, "--truth", log_folder, "--out", metrics, "--quiet").code == 0
    arguments = ("view", truth, "--log", log_folder, "--metrics", metrics, "--max-mb", "2", "--out")
    ran = run(*arguments, tmp_path / "page.html")
    assert ran.code == 0, ran.err
    assert "pictures of 1 camera, 480 px wide, up to 10 a second" in ran.out
    assert "LiDAR points of " in ran.out
    document = document_of(tmp_path / "page.html")
    assert document["background"] is not None
    assert document["metrics"][0][0] == "Metrics against tiny"
    assert "HOTA" in document["metrics"][0][1]
    other = json.loads(truth.read_text())
    (tmp_path / "other.json").write_text(json.dumps({**other, "t0_ns": other["t0_ns"] + 10**12}))
    assert (
        "choose the log that"
        in run("view", tmp_path / "other.json", "--log", log_folder, "--quiet", "--out", tmp_path / "b.html").line
    )
    assert "add --log" in run("view", truth, "--max-mb", "3", "--out", tmp_path / "b.html").line
    assert "expected metrics" in run("view", truth, "--metrics", truth, "--out", tmp_path / "b.html").line


# What it does


@pytest.fixture(scope="module")
def chromium(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """One browser for all tests of this module; skips where there is none."""
    if CHROMIUM is None or DRIVER is None:
        pytest.skip("needs Chromium and its driver (Debian: chromium, chromium-driver)")
    with browsing(tmp_path_factory.mktemp("profile")) as browser:
        yield browser


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of a log of two cameras, with metrics."""
    path = tmp_path_factory.mktemp("view") / "page.html"
    log = roadside(camera_of("a"), camera_of("b", yaw_rad=0.5))
    recorded = Recorded(log, 3_000_000)
    write_page(scene(), path, recorded=recorded, metrics=[("Metrics", "<b>recall</b> 0.9")])
    return path


@pytest.fixture
def browser(chromium: Browser) -> Iterator[Browser]:
    """The browser, whose pages must neither log an error nor ask for anything but themselves."""
    yield chromium
    assert chromium.log("browser") == []
    asked = {
        address.split("#")[0].rpartition("/")[2] for address in chromium.requests() if not address.startswith("blob:")
    }
    assert asked <= {"page.html"}


def opened(browser: Browser, page: Path, hash: str = "", **window: Any) -> Browser:
    browser.open(page.as_uri() + hash, **window)
    return browser


def colors(browser: Browser, canvas: str, x: float, y: float, reach: int = 1) -> np.ndarray:
    """Colors (K, 3) around a place of a canvas, CSS pixels, after the next frame."""
    script = """const [selector, x, y, reach, done] = arguments, width = 2 * reach + 1;
        requestAnimationFrame(() => requestAnimationFrame(() => {
            const pen = new OffscreenCanvas(width, width).getContext("2d", {willReadFrequently: true});
            pen.drawImage(document.querySelector(selector), reach - Math.round(x), reach - Math.round(y));
            done([...pen.getImageData(0, 0, width, width).data]);
        }));"""
    return np.array(browser.run_async(script, canvas, float(x), float(y), reach)).reshape(-1, 4)[:, :3]


def shows(browser: Browser, t_s: float) -> None:
    """Wait until the pictures of both cameras at a time are shown."""
    browser.wait(f"Object.values(log2sim.pictures).every((t) => Math.abs(t - {t_s}) < 0.001)")


def test_pictures_change_with_the_time(browser: Browser, page: Path) -> None:
    opened(browser, page)
    for t_s, index in ((0.0, 0), (1.0, 10), (0.44, 4), (2.0, 20)):
        browser.run("log2sim.time = arguments[0]", t_s)
        shows(browser, index / 10)
        for tile in (1, 2):
            seen = colors(browser, f".tile:nth-child({tile}) canvas", 8, 8, 4).mean(axis=0)
            assert seen[1] == pytest.approx(20 + 10 * index, abs=6)
    assert browser.run("return document.querySelector('.caption').textContent") == "a · 2.00 s"


def test_boxes_are_drawn_where_the_camera_shows_the_agents(browser: Browser, page: Path) -> None:
    opened(browser, page, "#t=1")
    shows(browser, 1.0)
    color = next(e["color"] for e in document_of(page)["layers"]["scenario"] if e["id"] == "car")
    wanted = [int(color[k : k + 2], 16) for k in (1, 3, 5)]
    box = outline_px(camera_of(), camera_of().mount_T_cam, Solid((20.0, 0.0, 0.75), CAR_SIZE))
    scale = browser.run("return document.querySelector('.tile canvas').clientWidth") / 600
    u0, v0, u1, v1 = box * scale
    for x, y in (((u0 + u1) / 2, v1), (u0, (v0 + v1) / 2 + 3), (u1, (v0 + v1) / 2 + 3)):  # sides of the rear
        near = np.abs(colors(browser, ".tile canvas", x, y, 2) - wanted).max(axis=1)
        assert near.min() < 40
    for x, y in ((u0 - 8, v1), (u1 + 8, v0), (u1 + 8, v1 + 8)):
        assert np.abs(colors(browser, ".tile canvas", x, y, 2) - wanted).max(axis=1).min() > 60
    browser.press("s")  # without the scenario no boxes
    assert np.abs(colors(browser, ".tile canvas", (u0 + u1) / 2, v1, 2) - wanted).max(axis=1).min() > 60


def test_an_agent_is_chosen_in_a_picture_and_marked_in_all(browser: Browser, page: Path) -> None:
    opened(browser, page, "#t=1")
    shows(browser, 1.0)
    box = outline_px(camera_of(), camera_of().mount_T_cam, Solid((20.0, 0.0, 0.75), CAR_SIZE))
    place = browser.run("return document.querySelector('.tile canvas').getBoundingClientRect().toJSON()")
    scale = place["width"] / 600
    x, y = place["x"] + (box[0] + box[2]) / 2 * scale, place["y"] + (box[1] + box[3]) / 2 * scale
    browser.mouse((x, y), click=False)
    browser.wait("document.getElementById('map').classList.contains('over')")
    browser.mouse((x, y))
    assert browser.run("return log2sim.chosen") == "car"
    browser.mouse((place["x"] + 5, place["y"] + 5))
    assert browser.run("return log2sim.chosen") is None


def test_one_camera_is_shown_large_or_none(browser: Browser, page: Path) -> None:
    opened(browser, page, "#t=1")
    wide = "return [...document.querySelectorAll('.tile')].map((t) => t.getBoundingClientRect().width)"
    small = browser.run(wide)
    browser.press("c")
    large = browser.run(wide)
    assert large[0] > 1.3 * small[0]
    assert large[1] == 0
    browser.press("c", "c")
    assert browser.run(wide) == small
    browser.press("i")
    assert browser.run(wide) == [0, 0]
    assert browser.run("return document.getElementById('layer-pictures').getAttribute('aria-pressed')") == "false"


def test_points_are_where_the_lidar_measured_them(browser: Browser, page: Path) -> None:
    opened(browser, page, "#t=1")
    browser.wait("log2sim.points !== null")
    t_s, count = browser.run("return log2sim.points")
    assert t_s == pytest.approx(1.0)
    packed = document_of(page)["recording"]["points"]["points"][10]
    assert count == len(unpacked(packed))
    place = np.array(browser.run("return log2sim.placeOf('car')"))
    scale = browser.run("return log2sim.pixelsPerMeter")
    x, y = place + scale * np.array([PATCH_M[0] - 20.0, -PATCH_M[1]])

    def saturated() -> float:
        return float(np.ptp(colors(browser, "#map", x, y, 4), axis=1).max())

    assert saturated() > 90
    browser.press("h")
    assert browser.run("return document.getElementById('points-color').textContent") == "by intensity"
    browser.press("x")
    assert saturated() < 30


def test_everything_fits_on_a_phone_and_under_a_finger(browser: Browser, page: Path) -> None:
    opened(browser, page, "#t=1", size=(390, 780))
    shows(browser, 1.0)
    small = """return [...document.querySelectorAll('button, input, summary')].filter((e) => e.getClientRects().length).map((e) => {
        const { width, height } = e.getBoundingClientRect();
        return [e.id || e.textContent, width, height];
    }).filter(([, width, height]) => Math.min(width, height) < 43.99)"""
    for step in ("", "layers-toggle", "layers-toggle", "list-toggle", "metrics-toggle"):
        if step:
            browser.run("document.getElementById(arguments[0]).click()", step)
        assert browser.run(small) == []
        assert browser.run("return document.documentElement.scrollWidth") <= 390
    assert browser.run("return document.getElementById('figures').textContent") == "Metrics<b>recall</b> 0.9"
    browser.run("document.getElementById('metrics').close(); log2sim.choose('parked')")
    assert browser.run(small) == []
    assert "Confidence" in browser.run("return document.getElementById('agent-now').innerText")
    assert browser.run("return document.getElementById('agent-doubts').textContent") == "rays pass through it empty"


def test_the_north_is_shown_only_where_the_map_knows_it(browser: Browser, tmp_path: Path) -> None:
    dark = []
    for frame in (MapFrame(), MapFrame(projection="+proj=utm +zone=32")):
        write_page(scene(map=frame), tmp_path / "page.html", overwrite=True)
        opened(browser, tmp_path / "page.html", "#agent=parked")
        height = browser.run("return document.getElementById('map').clientHeight")
        dark.append(colors(browser, "#map", 21, height - 54, 3).min())
        assert ("north" in browser.run("return document.getElementById('agent-now').textContent")) == bool(
            frame.projection
        )
    assert dark[0] > 150
    assert dark[1] < 80
