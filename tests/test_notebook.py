"""What a notebook needs: short representations with a picture, tables, ticks, and pictures of moments."""

from __future__ import annotations

import base64
import re
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import matplotlib
import numpy as np
import pytest
from test_view import Parts
from worlds import tiny_log

from log2sim import plot
from log2sim.datatypes import Log, Scenario, Stream
from log2sim.datatypes.scenario import COLUMNS
from log2sim.errors import ConfigError, ScenarioError
from log2sim.perception.sync import synchronize
from log2sim.simulation.result import Replay
from log2sim.simulation.runner import replay
from log2sim.visualization.notebook import notebook_labels
from log2sim.visualization.overlay import labels_at, read_moment

EVIL = "<script>window.hacked = 1</script>\"'<img src=x onerror=hacked>"
MAX_PAGE_BYTES = 150_000


@pytest.fixture(scope="module")
def world() -> tuple[Log, Scenario]:
    return tiny_log(noise_m=0.0)


@pytest.fixture(scope="module")
def log(world: tuple[Log, Scenario]) -> Log:
    return world[0]


@pytest.fixture(scope="module")
def scenario(world: tuple[Log, Scenario]) -> Scenario:
    return world[1]


@pytest.fixture(scope="module")
def replayed(scenario: Scenario) -> Replay:
    return replay(scenario, mode="exact")


def counting(log: Log) -> tuple[Log, Counter[tuple[str, int]]]:
    """The log, and how often each of its records was read."""
    reads: Counter[tuple[str, int]] = Counter()

    def counted(name: str, stream: Stream) -> Stream:
        def read(index: int) -> Any:
            reads[name, index] += 1
            return stream.read(index)

        return Stream(name, stream.t_ns, read)

    return log.changed(streams={name: counted(name, s) for name, s in log.streams.items()}), reads


# Representations


def test_a_repr_is_one_short_line(log: Log, scenario: Scenario, replayed: Replay) -> None:
    for value in (log, scenario, replayed, log.ticks(), log.ticks()[0]):
        assert "\n" not in repr(value)
        assert len(repr(value)) < 120
    assert repr(log) == "<Log 'tiny' (synthetic): 1 camera, 1 LiDAR, 1.0 s>"
    assert repr(scenario) == "<Scenario 'tiny': the ego and 3 other agents, 1.0 s>"
    assert repr(replace(scenario, agents=scenario.others[:1])) == "<Scenario 'tiny': 1 agent, 1.0 s>"


@pytest.mark.parametrize("kind", ["log", "scenario", "replayed"])
def test_the_html_has_escaped_text_and_a_small_picture(kind: str, request: pytest.FixtureRequest) -> None:
    value = request.getfixturevalue(kind)
    evil = (
        replace(value, scenario=EVIL)
        if kind == "replayed"
        else value.changed(name=EVIL)
        if kind == "log"
        else replace(value, name=EVIL)
    )
    page = evil._repr_html_()
    parts = Parts(page)
    assert "script" not in {tag for tag, _ in parts.tags}
    assert not any(name.startswith("on") for _, attributes in parts.tags for name in attributes)
    assert any("window.hacked" in text for _, text in parts.texts)
    pictures = [a["src"] or "" for tag, a in parts.tags if tag == "img"]
    assert len(pictures) == 1
    data = base64.b64decode(re.sub(r"^data:image/(png|jpeg);base64,", "", pictures[0]))
    assert cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR).std() > 5
    assert len(page) < MAX_PAGE_BYTES


# Tables


def test_the_dataframe_holds_every_waypoint(scenario: Scenario) -> None:
    frame = scenario.to_dataframe()
    assert list(frame.columns) == list(COLUMNS)
    assert len(frame) == sum(len(a.waypoints) for a in scenario.agents)
    for agent in scenario.agents:
        rows = frame[frame.agent == agent.id]
        for key in ("t_s", "x_m", "y_m", "z_m", "yaw_rad", "speed_mps", "observed", "sigma_xy_m"):
            assert np.array_equal(rows[key].to_numpy(), getattr(agent.waypoints, key))
        assert set(rows.category) == {agent.category}
        assert rows[["length_m", "width_m", "height_m"]].iloc[0].tolist() == list(agent.size_m)
    assert frame.attrs == {"name": "tiny", "t0_ns": scenario.t0_ns}
    assert str(frame.observed.dtype) == "bool"
    assert frame.sigma_yaw_rad.isna().all()
    assert len(replace(scenario, agents=()).to_dataframe()) == 0


# Ticks


def test_ticks_are_those_of_the_schedule_and_read_nothing_unasked(log: Log) -> None:
    schedule = synchronize(log, ("front",))
    counted, reads = counting(log)
    ticks = counted.ticks()
    before = sum(reads.values())
    assert [tick.t_ns for tick in ticks] == schedule.t_ns.tolist()
    assert [tick.t_s for tick in ticks] == pytest.approx(((schedule.t_ns - schedule.t_ns[0]) / 1e9).tolist())
    tick = ticks[4]
    assert "front" in tick.images
    assert list(tick.sweeps) == ["top"]
    assert sum(reads.values()) == before
    frame = int(schedule.frames["front"][4])
    assert np.array_equal(tick.images["front"], log.streams["front"].read(frame))
    assert tick.image_ns["front"] == log.streams["front"].t_ns[frame]
    tick.images["front"]
    assert reads["front", frame] == 1
    with pytest.raises(KeyError, match="no record of 'back' at this tick; there are front"):
        tick.images["back"]


# Pictures


def test_agents_are_drawn_where_their_labels_are(log: Log, scenario: Scenario) -> None:
    tick = log.ticks()[5]
    moment = read_moment(log, t_ns=tick.t_ns)
    known = labels_at(log.labels, tick.t_ns)
    drawn = labels_at(notebook_labels(scenario, log, tick.t_ns), tick.t_ns)
    assert moment.t_ns == tick.t_ns
    assert sorted(drawn.category) == sorted(known.category)
    for at, size in zip(drawn.center_m, drawn.size_m):
        k = int(np.argmin(np.linalg.norm(known.center_m - at, axis=1)))
        assert at == pytest.approx(known.center_m[k], abs=0.02)
        assert size == pytest.approx(known.size_m[k])


def test_a_log_without_cameras_shows_a_sweep(log: Log) -> None:
    blind = log.changed(cameras={})
    assert any("top, from above" in text for _, text in Parts(blind._repr_html_() or "").texts)


def test_a_log_shows_a_moment(log: Log, scenario: Scenario, tmp_path: Path) -> None:
    picture = log.show(log.ticks()[5], camera="front", scenario=scenario)
    shown = cv2.imdecode(np.frombuffer(picture._repr_png_(), np.uint8), cv2.IMREAD_COLOR)
    assert shown.std() > 20
    assert "agent: vehicle" in [t.get_text() for legend in picture.figure.legends for t in legend.get_texts()]
    assert "0.500 s" in repr(picture)
    picture.save(tmp_path / "tick.png")
    with pytest.raises(ConfigError, match="exists already"):
        picture.save(tmp_path / "tick.png")
    with pytest.raises(ConfigError, match="no camera 'back'"):
        log.show(0.5, camera="back")
    with pytest.raises(ConfigError, match=r"ticks from 0 to 0\.900 s"):
        log.show(7.0)


def test_plot_makes_a_figure_of_its_own(scenario: Scenario, monkeypatch: pytest.MonkeyPatch) -> None:
    import matplotlib.pyplot as plt

    monkeypatch.setattr(matplotlib, "rcParams", matplotlib.rcParams.copy())
    plt.switch_backend("agg")
    ax = plot(scenario, truth=scenario)
    assert ax.figure.number in plt.get_fignums()
    plt.close(ax.figure)
    other = replace(scenario, map=replace(scenario.map, projection="+proj=utm +zone=33"))
    with pytest.raises(ScenarioError, match=r"map\.projection"):
        plot(scenario, truth=other)
    assert plt.get_fignums() == []
