"""What a run leaves out, one test a rule, each with its reason."""

from __future__ import annotations

from contextlib import suppress
from types import SimpleNamespace

import numpy as np
import pytest

from log2sim.config import Config
from log2sim.datatypes import Lidar, Log
from log2sim.files import stages
from log2sim.files.stages import StageClock
from log2sim.geometry import Camera, PoseTrack, transform
from log2sim.plan import Decision, HomographyScope, Plan, Stage, make_plan, select_sensors


def make_log(
    cameras: tuple[str, ...] = ("front", "left"), lidars: tuple[str, ...] = ("top",), moved_m: float | None = 12.5
) -> Log:
    """A log without records; `moved_m` None for one without ego poses."""
    ego = None
    if moved_m is not None:
        position = np.array([[100.0, 50.0, 0.0], [100.0, 50.0 - moved_m, 0.0], [100.0, 50.0, 0.0]])
        ego = PoseTrack(np.array([0, 1, 2]) * 10**9, transform(np.eye(3), position))
    k = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
    return Log(
        name="drive",
        format="log2sim",
        cameras={c: Camera(c, 640, 480, k, "ego", np.eye(4)) for c in cameras},
        lidars={name: Lidar(name, "ego", np.eye(4)) for name in lidars},
        streams={},
        ego=ego,
    )


T_NS = np.arange(21, dtype=np.int64) * 100_000_000


def plan_of(log: Log | None = None, config: Config | None = None) -> Plan:
    log, config = log or make_log(), config or Config()
    return make_plan(log, config, select_sensors(log, config), T_NS)


def test_every_stage_is_decided_once_with_a_reason() -> None:
    decisions = plan_of(config=Config.load(settings=["detect.name=labels+lidar:labels"])).decisions
    # About the fusion of vehicle and road only logs with both say something.
    assert [d.stage for d in decisions] == [stage for stage in Stage if stage is not Stage.FUSION_OF_ENDS]
    in_sweeps = [Stage.DETECTION_IN_SWEEPS, Stage.FUSION_WITH_LIDAR, Stage.FUSION_OF_ENDS]
    assert [d.stage for d in plan_of().decisions] == [s for s in Stage if s not in in_sweeps]
    assert not plan_of().keeps(Stage.DETECTION_IN_SWEEPS)
    assert decisions[0].to_dict() == {"stage": "use of every LiDAR", "kept": True, "reason": "1 within range"}


def test_a_variant_changes_one_decision() -> None:
    plan = plan_of()
    later = plan.variant(Decision(Stage.HOMOGRAPHY, False, "for a comparison"))
    assert not later.keeps(Stage.HOMOGRAPHY)
    assert plan.keeps(Stage.HOMOGRAPHY)
    assert [d for d in later.decisions if d.stage is not Stage.HOMOGRAPHY] == [
        d for d in plan.decisions if d.stage is not Stage.HOMOGRAPHY
    ]
    assert plan.homography is HomographyScope.CAMERAS_IN_NEED
    assert plan_of(config=Config.load(settings=["topdown.method=off"])).homography is HomographyScope.NONE


@pytest.fixture
def hand(monkeypatch):
    """A clock that stands until it is moved."""
    times = [1000.0]
    monkeypatch.setattr(stages.time, "perf_counter", lambda: sum(times))
    return SimpleNamespace(move=times.append)


def test_an_inner_stage_stops_the_clock_of_the_outer_one_also_where_it_fails(hand):
    watch = StageClock()
    with watch.stage("outer"):
        hand.move(1.0)
        with suppress(RuntimeError), watch.stage("inner"):
            hand.move(4.0)
            with watch.stage("innermost"):
                hand.move(16.0)
                raise RuntimeError
        hand.move(2.0)
    assert watch.seconds == {"outer": 3.0, "inner": 4.0, "innermost": 16.0}
    assert sum(watch.seconds.values()) == watch.total()


def test_the_table_holds_ticks_per_second_and_none_for_a_stage_that_took_no_time(hand):
    watch = StageClock()
    with watch.stage("sync"):
        pass
    with watch.stage("detect"):
        hand.move(4.0)
    none, some = watch.table(ticks=10)
    assert (none["stage"], none["seconds"], none["ticks_per_second"]) == ("sync", 0.0, None)
    assert (some["stage"], some["seconds"], some["ticks_per_second"]) == ("detect", 4.0, 2.5)
    assert StageClock().table(ticks=10) == []
