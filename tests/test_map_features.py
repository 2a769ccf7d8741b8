"""Map features and signals: exact round trips, shifts with the scenario, refusals that name the item."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from worlds import waypoints

from log2sim import Scenario
from log2sim.datatypes import Agent, MapFeatures, MapFrame, MapLane, Marking, RoadBorder, Signal
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
    signal = Signal("s1", np.array([1.0, 2.0, 5.1]), 0.3, np.array([0.0, 2.5]), np.array(["red", "green"]), 0.2)
    parts = {"map_features": features(), "signals": (signal,), **parts}
    return Scenario("s", 10**18, 5.0, (Agent("a", "car", (4.0, 2.0, 1.5), waypoints([0.0, 1.0])),), **parts)


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


# Where something is changed in the document, and what the refusal names.
DAMAGE: list[tuple[tuple[Any, ...], Callable[[Any], Any], str]] = [
    (("map_features", "borders", 0, "id"), lambda _: "m1", "'m1'"),
    (("map_features", "lanes", 0, "successors"), lambda _: ["l9"], "'l9'"),
    (("map_features", "lanes", 0, "left"), lambda _: "m9", "'m9'"),
    (("map_features", "lanes", 1, "width_m"), lambda widths: widths[:-1], "lane 'l2'"),
    (("map_features", "markings", 0, "kind"), lambda _: "zigzag", "markings"),
    (("signals", 0, "state"), lambda states: states[:-1], "signal 's1'"),
    (("signals", 0, "t_s"), lambda _: [1.0, 1.0], "signal 's1'"),
    (("signals",), lambda signals: signals * 2, "signal 's1'"),
]


@pytest.mark.parametrize(("place", "change", "named"), DAMAGE)
def test_what_cannot_be_is_refused_by_name(place: tuple[Any, ...], change: Callable[[Any], Any], named: str) -> None:
    holder = document = scenario().to_dict()
    for step in place[:-1]:
        holder = holder[step]
    holder[place[-1]] = change(holder[place[-1]])
    with pytest.raises(ScenarioError, match=named):
        Scenario.from_dict(document)
