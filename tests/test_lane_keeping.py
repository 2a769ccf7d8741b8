"""The lateral position of an agent in its lane, in closed form, and the summary of a scenario that tells it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from command_line import run
from export_paths import agent, line, scenario

from log2sim.datatypes import MapFeatures, MapLane
from log2sim.road.lane_keeping import find_lane_changes, locate_in_lanes, summarize_lane_keeping


def road() -> tuple[MapLane, ...]:
    """Two lanes of 3.5 m side by side, each in two pieces."""
    lanes = []
    for side, y in (("right", 1.75), ("left", 5.25)):
        for k in (0, 1):
            points = np.column_stack([line(50.0, 3, 0.0, (50.0 * k, y)), np.zeros(3)])
            other = {"left_lane" if side == "right" else "right_lane": f"{'left' if side == 'right' else 'right'}-{k}"}
            links = {"successors": (f"{side}-1",)} if k == 0 else {"predecessors": (f"{side}-0",)}
            lanes.append(MapLane(f"{side}-{k}", points, np.full(3, 3.5), **other, **links))
    return tuple(lanes)


def test_the_offset_is_that_of_the_path() -> None:
    x = np.linspace(2.0, 98.0, 193)
    driver = agent(np.column_stack([x, 1.75 + 0.4 * np.sin(x / 15.0)]))
    position = locate_in_lanes(driver, road(), driver.waypoints.t_s)
    np.testing.assert_allclose(position.aside_m, 0.4 * np.sin(x / 15.0), atol=1e-3)
    assert [road()[k].id for k in dict.fromkeys(position.lane.tolist())] == ["right-0", "right-1"]
    assert find_lane_changes(position, road()) == []


def test_a_change_of_lane_is_told_once_and_to_its_side() -> None:
    x = np.linspace(0.0, 100.0, 201)
    y = 1.75 + 3.5 * np.clip((x - 30.0) / 40.0, 0.0, 1.0)
    driver = agent(np.column_stack([x, y]))
    (change,) = find_lane_changes(locate_in_lanes(driver, road()), road())
    assert (change.origin, change.target, change.side) == ("right-1", "left-1", "left")
    at = driver.at(change.t_s)
    assert 3.5 < at.y_m[0] < 3.5 + 0.2 + 0.1
    back = agent(np.column_stack([x, 7.0 - y]))
    assert [c.side for c in find_lane_changes(locate_in_lanes(back, road()), road())] == ["right"]


def test_the_summary_tells_how_far_over_the_line_a_vehicle_is() -> None:
    summary = summarize_lane_keeping(agent(line(90.0, 91, 0.0, (5.0, 2.75)), size_m=(4.6, 1.9, 1.6)), road())
    assert summary is not None
    assert summary["aside_m"] == {"mean": 1.0, "sd": 0.0, "leftmost": 1.0, "rightmost": 1.0}
    assert (summary["in_lane"], summary["over_line"], summary["width_m"]) == (1.0, 1.0, 3.5)


def test_inspect_describes_a_scenario(tmp_path: Path) -> None:
    world = scenario(agent(line(90.0, 91, 0.0, (5.0, 2.0))), map_features=MapFeatures(lanes=road(), notes=("night",)))
    world.save(tmp_path / "scenario.json")
    document = json.loads(run("inspect", tmp_path / "scenario.json", "--json").out)
    assert (document["agents"]["count"], document["ego"]) == (0, {"doubtful": False})
    assert document["lanes"] == {"count": 4, "junctions": 0, "inferred_from": {"markings": 4}, "in_file": True}
    assert document["ego_in_lane"]["aside_m"]["mean"] == pytest.approx(0.25, abs=1e-3)
    assert document["notes"] == ["night"]
