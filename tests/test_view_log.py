"""The page with a log: which pictures and points it takes, where boxes are drawn in them, and how large it becomes."""

from __future__ import annotations

import base64
import json
import re
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import Browser, opened
from command_line import run
from hypothesis import given, settings
from hypothesis import strategies as st
from worlds import Solid, camera_ahead, outline_px, waypoints

from log2sim.datatypes import Agent, Finding, Lidar, Log, Scenario, Stream, Sweep
from log2sim.geometry import Camera
from log2sim.visualization.page.writer import write_page
from log2sim.visualization.recording import (
    MIN_HEIGHT_M,
    UNIT_M,
    PointsAbove,
    Recorded,
    pack_recording,
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
    speed = np.gradient(x) if len(x) > 1 else 0.0
    w = waypoints(np.arange(len(x)), x, y_m, CAR_SIZE[2] / 2, 0.0, speed, sigma_m=0.0)
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
    doubt = Finding("empty", text="rays pass through it")
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


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.2, 1.0]))
def test_points_come_back_one_of_each_cell_the_highest(seed: int, cell_m: float) -> None:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 300))
    xy, height = rng.uniform(-100, 100, (n, 2)) * rng.choice([0.02, 1.0]), rng.uniform(MIN_HEIGHT_M, 5.0, n)
    rows = unpacked(pack_recording(PointsAbove(0, (0, 0), xy, height, np.full(n, np.nan)), cell_m, 0.0))
    highest: dict[tuple[int, ...], int] = {}
    for k, cell in enumerate(map(tuple, np.floor(xy / cell_m).astype(int).tolist())):
        if cell not in highest or height[k] > height[highest[cell]]:
            highest[cell] = k
    kept = sorted(highest.values(), key=lambda k: tuple(np.floor(xy[k] / cell_m).astype(int)[::-1]))
    np.testing.assert_allclose(rows[:, :2], xy[kept], atol=UNIT_M / 2 + 1e-9)
    np.testing.assert_allclose(rows[:, 2] / 255 * (5.0 - MIN_HEIGHT_M) + MIN_HEIGHT_M, height[kept], atol=0.02)
    assert not rows[:, 3].any()


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
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of a log of two cameras, with metrics."""
    path = tmp_path_factory.mktemp("view") / "page.html"
    log = roadside(camera_of("a"), camera_of("b", yaw_rad=0.5))
    recorded = Recorded(log, 3_000_000)
    write_page(scene(), path, recorded=recorded, metrics=[("Metrics", "<b>recall</b> 0.9")])
    return path


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
