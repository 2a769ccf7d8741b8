"""Films: codecs, sizes, frames, the part of the scenario that they show, and that they are written frame by frame."""

from __future__ import annotations

import dataclasses
import sys
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import CHROMIUM, DRIVER, browsing
from command_line import names, run
from export_worlds import straight, world
from matplotlib.colors import to_rgb

from log2sim.datatypes import Scenario
from log2sim.errors import ConfigError
from log2sim.simulation.runner import replay
from log2sim.visualization.plot import encoding
from log2sim.visualization.plot.layers import Overlays
from log2sim.visualization.plot.selection import PlotOptions, TimeRange, cut_replay, cut_scenario, select_shown
from log2sim.visualization.plot.style import INK
from log2sim.visualization.plot.tracks import plot_tracks, still
from log2sim.visualization.plot.viewport import assign_view_roles


def scene() -> Scenario:
    parked = dataclasses.replace(straight("parked", start=(5.0, -6.0), speed=0.0), static=True)
    return world(straight("ego"), straight("car-1", start=(0.0, 6.0), speed=8.0), parked)


def read_film(path: Path) -> tuple[Any, list[np.ndarray]]:
    """The video stream of a film and its frames (H, W, 3), RGB."""
    av = pytest.importorskip("av")
    with av.open(str(path)) as film:
        (stream,) = film.streams
        found = {name: getattr(stream.codec_context, name) for name in ("name", "pix_fmt", "width", "height")}
        found["fps"] = float(stream.average_rate)
        return found, [frame.to_ndarray(format="rgb24") for frame in film.decode(stream)]


def test_an_mp4_is_h264_of_the_size_and_rate_that_were_asked_for(tmp_path: Path) -> None:
    pytest.importorskip("av")
    out = plot_tracks(scene(), tmp_path / "film.mp4", options=PlotOptions((480, 320), fps=20, start_s=1, stop_s=1.5))
    found, frames = read_film(out)
    assert found == {"name": "h264", "pix_fmt": "yuv420p", "width": 480, "height": 320, "fps": 20.0}
    assert len(frames) == 11
    data = out.read_bytes()
    assert data.find(b"moov") < data.find(b"mdat")
    ink = np.abs(frames[0].astype(int) - np.rint(255 * np.array(to_rgb(INK)))).max(axis=2) <= 12
    assert ink.sum() > 40  # BT.709 both ways; the colors of BT.601 are off by up to 20


def living(count: int, alive: list[int]) -> Iterator[np.ndarray]:
    """Frames that differ, and how many of them there are at once."""
    seen: list[weakref.ref[np.ndarray]] = []
    for k in range(count):
        frame = np.full((64, 96, 3), 255, np.uint8)
        frame[10:20, k : k + 9] = (0, 114, 178)
        seen.append(weakref.ref(frame))
        yield frame
        del frame
        alive.append(sum(r() is not None for r in seen))


@pytest.mark.parametrize("codec", ["libx264", "libvpx-vp9", "opencv", "gif"])
def test_frames_are_not_kept(tmp_path: Path, codec: str) -> None:
    alive: list[int] = []
    frames, out = living(60, alive), tmp_path / "film"
    if codec == "gif":
        encoding.write_gif(frames, out, 10, ["#0072B2"])
    elif codec == "opencv":
        encoding.write_with_opencv(frames, out.with_suffix(".webm"), 10)
    else:
        pytest.importorskip("av")
        encoding.write_with_av(frames, out, 10, codec, "mp4" if codec == "libx264" else "webm")
    assert len(alive) == 60
    assert max(alive) <= 3


def test_a_range_of_time_cuts_tracks_at_its_ends() -> None:
    scenario = scene()
    cut = cut_scenario(scenario, TimeRange(0.6, 1.25))
    car = next(a for a in cut.agents if a.id == "car-1")
    assert car.waypoints.t_s[[0, -1]].tolist() == [0.6, 1.25]
    assert car.waypoints.x_m[[0, -1]] == pytest.approx([8 * 0.6, 8 * 1.25])
    assert np.diff(car.waypoints.t_s).min() > 0
    result = replay(scenario, dt_s=0.05)
    there = cut_replay(result, TimeRange(0.6, 1.25), scenario).agent("car-1")
    assert 0.55 < there.t_s[0] < there.t_s[-1] < 1.3
    assert len(there.cross_track_m) == len(there.commands.gear) == len(there.t_s)
    parked = cut_replay(result, TimeRange(0.6, 1.25), scenario).agent(
        "parked"
    )  # has a state at the start and one at the end
    assert parked.x_m[0] == 5.0
    event = {"t_s": 0.9, "agents": ["car-1", "parked"], "belongs_to": "replay"}
    hit = dataclasses.replace(result, metrics={**result.metrics, "collisions": [event]})
    for span, count in ((TimeRange(0.6, 1.25), 1), (TimeRange(1.0, 2.0), 0)):
        assert len(cut_replay(hit, span, scenario).metrics["collisions"]) == count
    assert cut_scenario(scenario, TimeRange(0.0, scenario.duration_s)) is scenario
    early = world(straight("ego"), straight("gone", start=(0.0, 3.0), t_s=np.array([0.0, 0.5, 1.0])))
    assert [a.id for a in cut_scenario(early, TimeRange(2.0, 3.0)).agents] == ["ego"]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["a.png", "--fps", "5"], "fps: a.png is a still picture"),
        (["a.svg", "--size", "640x480"], "size: a.svg has no pixels"),
        (["a.mp4", "--size", "641x480"], "expected even sides"),
        (["a.gif", "--size", "10x480"], "expected sides of 240 to 7680 px"),
        (["a.gif", "--fps", "60"], "expected 1 to 50 frames a second in a .gif"),
        (["a.gif", "--speed", "0"], "expected 0.001 to 1000 times real time"),
        (["a.png", "--start", "2", "--stop", "1"], "start, stop: 2 to 1 s"),
        (["a.png", "--start", "9"], "within the scenario, 0 to 3 s"),
        (["a.png", "--extent", "1,2,3"], "X0,Y0,X1,Y1"),
        (["a.png", "--extent", "-5,0,-5,9"], "at least 1 m apart"),
        (["a.png", "--agents", ","], "names nobody"),
        (["a.png", "--agents", "ego,bus"], "'bus' is no agent"),
    ],
)
def test_options_that_do_not_fit_are_told_in_one_line(tmp_path: Path, arguments: list[str], said: str) -> None:
    scene().save(tmp_path / "s.json")
    ran = run("plot", tmp_path / "s.json", "-o", tmp_path / arguments[0], *arguments[1:])
    assert ran.code == 2
    assert said in ran.line
    assert names(tmp_path) == ["s.json"]


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None or DRIVER is None, reason="no Chromium with its driver here")
@pytest.mark.parametrize(
    ("name", "kind"), [("film.mp4", 'video/mp4; codecs="avc1.640028"'), ("film.webm", "video/webm; codecs=vp9")]
)
def test_a_film_plays_in_a_browser(tmp_path: Path, name: str, kind: str) -> None:
    pytest.importorskip("av")
    plot_tracks(scene(), tmp_path / name, options=PlotOptions((480, 320), fps=20, start_s=0.5, stop_s=1.5))
    page = tmp_path / "page.html"
    page.write_text(f"<!doctype html><title>film</title><video muted src={name}></video>", encoding="utf-8")
    with browsing(tmp_path / "profile", flags=["--allow-file-access-from-files"]) as browser:
        browser.open(page.as_uri())
        if not browser.run("return document.createElement('video').canPlayType(arguments[0])", kind):
            pytest.skip(f"this Chromium has no decoder for {kind}")
        browser.wait("document.querySelector('video').readyState >= 2")
        video = browser.run(
            "const v = document.querySelector('video'); return [v.videoWidth, v.videoHeight, v.duration]"
        )
        assert video[:2] == [480, 320]
        assert video[2] == pytest.approx(21 / 20, abs=0.06)
        browser.run("document.querySelector('video').play()")
        browser.wait("document.querySelector('video').ended")
        pixel = """const v = document.querySelector('video'), c = document.createElement('canvas');
            c.width = v.videoWidth; c.height = v.videoHeight; const g = c.getContext('2d'); g.drawImage(v, 0, 0);
            return [...g.getImageData(2, 2, 1, 1).data].slice(0, 3)"""
        assert min(browser.run(pixel)) > 245  # the paper is white


def test_without_pyav_an_mp4_becomes_a_webm_which_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    scene().save(tmp_path / "s.json")
    options = ("--size", "480x320", "--stop", 0.3, "--fps", 10)
    ran = run("plot", tmp_path / "s.json", "-o", tmp_path / "film.mp4", *options)
    assert ran.code == 0, ran.err
    (note,) = [line for line in ran.out.splitlines() if line.startswith("note:")]
    assert "'video'" in note
    assert note.endswith("written as film.webm")
    assert names(tmp_path) == ["film.webm", "s.json"]
    again = run("plot", tmp_path / "s.json", "-o", tmp_path / "film.mp4", *options)
    assert (again.code, "film.webm: exists already" in again.line) == (2, True)
    first = (tmp_path / "film.webm").read_bytes()
    assert run("plot", tmp_path / "s.json", "-o", tmp_path / "film.mp4", *options, "--overwrite").code == 0
    assert (tmp_path / "film.webm").read_bytes() == first
    found, frames = read_film(tmp_path / "film.webm")
    assert (found["name"], found["width"], len(frames)) == ("vp9", 480, 4)


def test_a_picture_shows_the_agents_and_the_part_of_the_map_that_it_is_asked_for() -> None:
    scenario = scene()
    options = PlotOptions(extent_m=(12.0, 9.0, -3.0, -4.0), agents=("car-1",))
    shown, result = select_shown(scenario, replay(scenario, dt_s=0.05), options)
    assert [a.id for a in shown.agents] == [a.id for a in result.agents] == ["car-1"]
    layout = still(shown, assign_view_roles(shown), Overlays(options=options))
    x0, x1, y0, y1 = *layout.ax.get_xlim(), *layout.ax.get_ylim()
    assert (x0 + x1, y0 + y1) == pytest.approx((9.0, 5.0))
    assert min(x1 - x0 - 15.0, y1 - y0 - 13.0) == pytest.approx(0.0, abs=1e-9)
    with pytest.raises(ConfigError, match=r"agents: 'car1' is no agent.*'car-1'"):
        select_shown(scenario, None, PlotOptions(agents=("car1",)))
