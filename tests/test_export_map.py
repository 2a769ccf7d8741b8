"""Markings, crosswalks, borders and traffic lights in the formats of others."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from export_paths import agent, line, scenario
from test_export_scenarionet import described
from test_lanes import cross

from log2sim.datatypes import MapFeatures, Marking, RoadBorder, Scenario, Signal
from log2sim.export.exporters import export
from log2sim.export.roads.opendrive import lanes, signal_lanes


def along(y_m: float, first_m: float = -40.0, last_m: float = -9.0) -> np.ndarray:
    return np.column_stack([line(last_m - first_m, 15, np.pi / 2, (y_m, first_m)), np.zeros(15)])


def world() -> Scenario:
    """The crossing with lines at the arm from the south, a crosswalk across it and a light for it."""
    zebra = np.array([[-4.0, -12.0, 0.0], [4.0, -12.0, 0.0], [4.0, -9.0, 0.0], [-4.0, -9.0, 0.0]])
    markings = (
        Marking("edge", "solid", along(3.5), 0.12, "white", 0.9),
        Marking("middle", "dashed", along(0.0), 0.15, "yellow", 0.9),
        Marking("zebra", "crosswalk", zebra, 3.0, "white", 0.9),
        Marking("stop", "stop_line", np.array([[0.0, -12.5, 0.0], [3.5, -12.5, 0.0]]), 0.5, "white", 0.9),
    )
    border = RoadBorder("curb", "curb", along(-3.6), 0.8)
    light = Signal("light", np.array([5.0, 8.0, 4.0]), -np.pi / 2, np.array([0.0, 2.0]), np.array(["red", "green"]))
    return replace(cross(), map_features=MapFeatures(markings, (border,)), signals=(light,))


def test_a_light_is_for_the_lane_that_leads_towards_its_face() -> None:
    there = world()
    (lane,) = signal_lanes(there.signals[0], lanes(there))
    np.testing.assert_allclose(lane.points_m[-1, 0], 1.75, atol=0.3)
    assert lane.points_m[0, 1] < lane.points_m[-1, 1] < 0
    assert signal_lanes(replace(there.signals[0], heading_rad=None), lanes(there)) == []
    assert signal_lanes(replace(there.signals[0], heading_rad=0.0), lanes(there)) != [lane]


def test_opendrive_has_road_marks_crosswalks_and_lights(tmp_path: Path) -> None:
    export(world(), "openscenario", tmp_path)
    root = ElementTree.parse(tmp_path / "road.xodr").getroot()
    (light,) = root.iter("signal")
    (road,) = (r for r in root.iterfind("road") if light in list(r.iter("signal")))
    assert [light.find("positionInertial").attrib[k] for k in "xyz"] == ["5", "8", "4"]
    assert float(light.attrib["s"]) == pytest.approx(float(road.attrib["length"]), abs=1e-3)
    (zebra,) = (o for o in root.iter("object") if o.attrib["type"] == "crosswalk")
    assert sorted((float(zebra.attrib["length"]), float(zebra.attrib["width"]))) == pytest.approx([3.0, 8.0], abs=0.05)
    assert len(zebra.findall("outlines/outline/cornerLocal")) == 4
    left = road.find("lanes/laneSection/center/lane/roadMark").attrib
    right = road.find("lanes/laneSection/right/lane/roadMark").attrib
    assert (left["type"], left["color"], left["width"]) == ("broken", "yellow", "0.15")
    assert (right["type"], right["color"], right["width"]) == ("solid", "white", "0.12")
    inside = [r for r in root.iterfind("road") if r.attrib["junction"] != "-1"]
    assert {m.attrib["type"] for r in inside for m in r.iter("roadMark")} == {"none"}  # nothing was seen there


def test_scenarionet_has_lines_edges_crosswalks_and_lights(tmp_path: Path) -> None:
    file = described(world(), tmp_path)
    kinds = {name: f["type"] for name, f in file["map_features"].items() if not name.startswith("lane")}
    assert kinds == {
        "edge": "ROAD_LINE_SOLID_SINGLE_WHITE", "middle": "ROAD_LINE_BROKEN_SINGLE_YELLOW", "zebra": "CROSSWALK", "curb": "ROAD_EDGE_BOUNDARY",
    }  # fmt: skip
    ((lane, light),) = file["dynamic_map_states"].items()
    assert lane in file["map_features"]
    assert light["state"]["object_state"][:21] == 20 * ["LANE_STATE_STOP"] + ["LANE_STATE_GO"]
    assert file["metadata"]["number_summary"]["num_traffic_lights"] == 1
    for name, feature in file["map_features"].items():
        for other in feature.get("exit_lanes", ()):
            assert name in file["map_features"][other]["entry_lanes"]


def test_commonroad_has_line_markings_neighbors_and_lights(tmp_path: Path) -> None:
    (file,) = (f for f in export(world(), "commonroad", tmp_path) if f.suffix == ".xml")
    root = ElementTree.parse(file).getroot()
    (light,) = root.iterfind("trafficLight")
    cycle = [(e.findtext("color"), int(e.findtext("duration"))) for e in light.iterfind("cycle/cycleElement")]
    assert cycle[:2] == [("red", 20), ("green", cycle[1][1])]
    (lanelet,) = (x for x in root.iterfind("lanelet") if x.find("trafficLightRef") is not None)
    assert lanelet.find("trafficLightRef").attrib["ref"] == light.attrib["id"]
    assert [lanelet.findtext(f"{side}Bound/lineMarking") for side in ("left", "right")] == ["dashed", "solid"]
    after = {s.attrib["ref"] for s in lanelet.iterfind("successor")}
    assert len(after) == 2
    for other in root.iterfind("lanelet"):
        if other.attrib["id"] in after:
            assert other.find("predecessor").attrib["ref"] == lanelet.attrib["id"]
            assert other.findtext("laneletType") == "intersection"


def test_osi_has_lanes_boundaries_and_lights(tmp_path: Path) -> None:
    betterosi = pytest.importorskip("betterosi")
    (file,) = export(world(), "osi", tmp_path)
    frames: list[Any] = list(betterosi.read(file, return_ground_truth=True))
    first = frames[0]
    numbers = [m.id.value for part in (first.lane, first.lane_boundary, first.road_marking, first.traffic_light, first.moving_object) for m in part]  # fmt: skip
    assert len(set(numbers)) == len(numbers)
    assert len(first.lane) == len(lanes(world()))
    assert len(first.lane_boundary) == 2 * len(first.lane)
    lane_of = {lane.id.value: lane for lane in first.lane}
    for lane in first.lane:
        for pair in lane.classification.lane_pairing:
            if pair.successor_lane_id is not None:
                back = lane_of[pair.successor_lane_id.value].classification.lane_pairing
                assert lane.id.value in {p.antecessor_lane_id.value for p in back if p.antecessor_lane_id is not None}
    kind = betterosi.TrafficLight.Classification.Color
    assert [frames[k].traffic_light[0].classification.color for k in (0, 19, 20)] == [kind.RED, kind.RED, kind.GREEN]
    types = betterosi.LaneBoundary.Classification.Type
    assert {b.classification.type for b in first.lane_boundary} >= {types.SOLID_LINE, types.DASHED_LINE, types.NO_LINE}


def test_a_scenario_without_map_features_has_no_marks(tmp_path: Path) -> None:
    export(scenario(agent(line())), "openscenario", tmp_path)
    root = ElementTree.parse(tmp_path / "road.xodr").getroot()
    assert {m.attrib["type"] for m in root.iter("roadMark")} == {"none"}
    assert not [*root.iter("signal"), *root.iter("object")]
