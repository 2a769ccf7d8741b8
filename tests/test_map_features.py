"""Map features and signals: exact round trips, shifts with the scenario, refusals that name the item."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from log2sim import Scenario
from log2sim.datatypes import Agent, MapFeatures, MapFrame, MapLane, Marking, RoadBorder, Signal, Waypoints
from log2sim.errors import ScenarioError
from log2sim.geometry import Array

LINE = np.array([[0.1, 0.2, 0.3], [10.0, 1 / 3, 0.0], [20.0, 0.0, -0.1]])


def shifted(*by_m: float) -> Array:
    return LINE + np.array([*by_m, 0.0])[:3]


def features() -> MapFeatures:
    return MapFeatures(
        (Marking("m1", "dashed", LINE, 0.15, "white", 0.9, ("camera",)), Marking("m2", "crosswalk", LINE, 3.0)),
        (RoadBorder("b1", "curb", shifted(0, 4), 0.7, ("lidar",)),),
        (
            MapLane("l1", shifted(0, 2), np.full(3, 3.5), left="b1", right="m1", successors=("l2",)),
            MapLane("l2", shifted(20, 2), np.array([3.5, 3.0, 2.9]), predecessors=("l1",), inferred_from="paths"),
        ),
        ("no stop line seen",),
    )


def scenario(**parts: Any) -> Scenario:
    flat = np.zeros(2)
    waypoints = Waypoints(
        t_s=np.array([0.0, 1.0]), x_m=flat, y_m=flat, z_m=flat, yaw_rad=flat, speed_mps=flat,
        observed=np.ones(2, bool), sigma_xy_m=flat,
    )  # fmt: skip
    signal = Signal("s1", np.array([1.0, 2.0, 5.1]), 0.3, np.array([0.0, 2.5]), np.array(["red", "green"]), 0.2)
    parts = {"map_features": features(), "signals": (signal,), **parts}
    return Scenario("s", 10**18, 5.0, (Agent("a", "car", (4.0, 2.0, 1.5), waypoints),), **parts)


def test_a_file_gives_back_the_same_numbers(tmp_path: Path) -> None:
    written = scenario()
    written.save(tmp_path / "s.json")
    read = Scenario.load(tmp_path / "s.json")
    assert read.to_dict() == written.to_dict()
    assert read.digest == written.digest
    assert read.map_features is not None
    np.testing.assert_array_equal(read.map_features.markings[0].points_m, LINE)
    assert read.map_features.lanes[0].successors == ("l2",)


def test_a_scenario_without_them_has_no_such_keys() -> None:
    document = scenario(map_features=None, signals=()).to_dict()
    assert not {"map_features", "signals"} & document.keys()
    assert Scenario.from_dict(document).map_features is None


def test_they_move_with_the_map_and_the_time() -> None:
    here = scenario(map=MapFrame(offset_m=(100.0, 200.0, 5.0)))
    there = replace(here, map=MapFrame(offset_m=(90.0, 0.0, 0.0)), t0_ns=here.t0_ns - 2 * 10**9)
    moved = here.aligned_to(there)
    assert moved.map_features is not None
    np.testing.assert_allclose(moved.map_features.lanes[1].points_m, shifted(30, 202, 5))
    np.testing.assert_allclose(moved.signals[0].position_m, [11.0, 202.0, 10.1])
    np.testing.assert_allclose(moved.signals[0].t_s, [2.0, 4.5])


def double_id(document: dict[str, Any]) -> None:
    document["map_features"]["borders"][0]["id"] = "m1"


def unknown_lane(document: dict[str, Any]) -> None:
    document["map_features"]["lanes"][0]["successors"] = ["l9"]


def unknown_side(document: dict[str, Any]) -> None:
    document["map_features"]["lanes"][0]["left"] = "m9"


def few_widths(document: dict[str, Any]) -> None:
    document["map_features"]["lanes"][1]["width_m"].pop()


def unknown_kind(document: dict[str, Any]) -> None:
    document["map_features"]["markings"][0]["kind"] = "zigzag"


def few_states(document: dict[str, Any]) -> None:
    document["signals"][0]["state"].pop()


def times_fall(document: dict[str, Any]) -> None:
    document["signals"][0]["t_s"] = [1.0, 1.0]


def same_signal(document: dict[str, Any]) -> None:
    document["signals"] *= 2


@pytest.mark.parametrize(
    ("damage", "named"),
    [
        (double_id, "'m1'"), (unknown_lane, "'l9'"), (unknown_side, "'m9'"), (few_widths, "lane 'l2'"),
        (unknown_kind, "markings"), (few_states, "signal 's1'"), (times_fall, "signal 's1'"), (same_signal, "signal 's1'"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused_by_name(damage: Any, named: str) -> None:
    document = scenario().to_dict()
    damage(document)
    with pytest.raises(ScenarioError, match=named):
        Scenario.from_dict(document)
