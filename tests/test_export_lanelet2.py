"""Lanelet2 maps: how lanes meet, what traffic lights they name, where they lie, and what its own package finds in them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
import pytest
from export_worlds import ROOT, peer, straight, world
from pyproj import Transformer

from log2sim.datatypes import MapFeatures, MapFrame, MapLane, Marking, Scenario, Signal
from log2sim.export.exporters import export
from log2sim.export.roads.opendrive import edges_of

PROJECTION = "+proj=tmerc +lat_0=49 +lon_0=8.4 +k=1 +x_0=0 +y_0=0 +ellps=WGS84 +units=m"
OFFSET_M = (1000.0, 2000.0, 100.0)


def lane(name: str, start: float, stop: float, y: float, **more: object) -> MapLane:
    points = np.array([[start, y, 0.0], [(start + stop) / 2, y, 0.0], [stop, y, 0.0]])
    return MapLane(name, points, np.full(3, 3.5), **more)  # type: ignore[arg-type]


def flat(*xy: tuple[float, float]) -> np.ndarray:
    return np.array([[x, y, 0.0] for x, y in xy], dtype=float)


def street() -> Scenario:
    """Two lanes to the east, the right one into a junction with a light, and one to the west beside them."""
    lanes = (
        lane("right", 0, 50, 0.0, left_lane="left", left="dash", successors=("inside",)),
        lane("left", 0, 50, 3.5, right_lane="right", right="dash", opposite="west", left="middle"),
        replace(lane("west", 0, 50, 7.0, opposite="left", left="middle"), points_m=lane("", 50, 0, 7.0).points_m),
        lane("inside", 50, 60, 0.0, junction="1", predecessors=("right",)),
    )
    markings = (
        Marking("dash", "dashed", flat((0, 1.75), (50, 1.75)), 0.12, "white"),
        Marking("middle", "solid", flat((0, 5.25), (50, 5.25)), 0.12, "yellow"),
        Marking("stop", "stop_line", flat((49, -1.7), (49, 1.7)), 0.4),
        Marking("west stop", "stop_line", flat((1, 5.4), (1, 8.6)), 0.4),
        Marking("far stop", "stop_line", flat((10, 20), (14, 20)), 0.4),
        Marking("zebra", "crosswalk", flat((51, -2), (54, -2), (54, 5), (51, 5)), 3.0),
    )
    light = Signal("light", np.array([52.0, -4.0, 3.0]), np.pi, np.zeros(1), np.array(["red"]))
    frame = MapFrame(49.0, 8.4, 0.0, PROJECTION, OFFSET_M)
    return replace(world(straight("ego")), map=frame, map_features=MapFeatures(markings, (), lanes), signals=(light,))


def written(scenario: Scenario, folder: Path) -> Element:
    return ElementTree.parse(export(scenario, "lanelet2", folder)[0]).getroot()


def tags(item: Element) -> dict[str, str]:
    return {tag.attrib["k"]: tag.attrib["v"] for tag in item.iterfind("tag")}


def members(item: Element) -> dict[str, str]:
    return {member.attrib["role"]: member.attrib["ref"] for member in item.iterfind("member")}


def test_lanes_share_the_way_between_them_and_the_nodes_where_they_meet(tmp_path: Path) -> None:
    root = written(street(), tmp_path)
    numbers = [item.attrib["id"] for item in root]
    assert len(numbers) == len(set(numbers))
    ways = {way.attrib["id"]: way for way in root.iterfind("way")}
    lanelets = {tags(r).get("log2sim_id"): members(r) for r in root.iterfind("relation")}
    assert lanelets["left"]["right"] == lanelets["right"]["left"]
    assert lanelets["left"]["left"] == lanelets["west"]["left"]
    between = tags(ways[lanelets["right"]["left"]])
    assert (between["type"], between["subtype"], between["color"]) == ("line_thin", "dashed", "white")
    for side in ("left", "right"):
        before, after = (
            [nd.attrib["ref"] for nd in ways[lanelets[n][side]].iterfind("nd")] for n in ("right", "inside")
        )
        assert before[-1] == after[0]


def test_a_light_rules_the_lane_that_it_faces_from_its_stop_line_on(tmp_path: Path) -> None:
    root = written(street(), tmp_path)
    items = {item.attrib["id"]: item for item in root}
    ruled = {name: [m.attrib["ref"] for m in r.iterfind("member") if m.attrib["role"] == "regulatory_element"]
             for r in root.iterfind("relation") if (name := tags(r).get("log2sim_id"))}  # fmt: skip
    assert [name for name, found in ruled.items() if found] == ["right", "west"]
    (rule,), (other,) = ruled["right"], ruled["west"]
    # The stop line of the other way has no light: a sign at its end stops them there.
    assert [tags(items[r])["subtype"] for r in (rule, other)] == ["traffic_light", "traffic_sign"]
    sign, line = (items[members(items[other])[role]] for role in ("refers", "ref_line"))
    places = [[float(tags(items[nd.attrib["ref"]])[k]) for nd in sign.iterfind("nd")] for k in ("local_x", "local_y")]
    assert places == [[1.0, 1.0], [8.6, 9.5]]
    assert {tags(items[nd.attrib["ref"]])["local_x"] for nd in line.iterfind("nd")} == {"1.0000"}
    light, stop = (items[members(items[rule])[role]] for role in ("refers", "ref_line"))
    x = [float(tags(items[nd.attrib["ref"]])["local_x"]) for nd in stop.iterfind("nd")]
    assert x == [49.0, 49.0]
    # From the left to the right of who drives east towards it.
    y = [float(tags(items[nd.attrib["ref"]])["local_y"]) for nd in light.iterfind("nd")]
    assert y == pytest.approx([-3.85, -4.15])


def test_nodes_lie_where_the_projection_has_them(tmp_path: Path) -> None:
    back = Transformer.from_crs("+proj=longlat +ellps=WGS84", PROJECTION, always_xy=True)
    for node in written(street(), tmp_path).iterfind("node"):
        x, y = back.transform(float(node.attrib["lon"]), float(node.attrib["lat"]))
        local = tags(node)
        assert (x - OFFSET_M[0], y - OFFSET_M[1]) == pytest.approx(
            (float(local["local_x"]), float(local["local_y"])), abs=1e-4
        )
        assert float(local["ele"]) >= OFFSET_M[2]


@pytest.mark.peers
def test_lanelet2_routes_over_the_map_and_finds_its_light(tmp_path: Path) -> None:
    read, scenario = peer("lanelet2"), street()
    written(scenario, tmp_path)
    found = json.loads(read(ROOT / "tests/peers/lanelet2_read.py", tmp_path / "lanelet2_map.osm", 49.0, 8.4))
    assert (found["errors"], found["complaints"], found["crosswalks"]) == ([], [], 1)
    assert found["following"] == {"right": ["inside"], "left": [], "west": [], "inside": []}
    assert found["left"] == {
        "right": ["left", None],
        "left": [None, None],
        "west": [None, None],
        "inside": [None, None],
    }
    assert found["lights"] == {"right": [[["light"], True]], "left": [], "west": [], "inside": []}
    assert found["signs"] == {"right": [], "left": [], "west": [["stop_sign", 1]], "inside": []}
    back = Transformer.from_crs("+proj=longlat +ellps=WGS84", PROJECTION, always_xy=True)
    for one in scenario.map_features.lanes:  # type: ignore[union-attr]
        for own, theirs in zip(edges_of(one), found["edges"][one.id]):
            x, y = back.transform(*np.array(theirs)[:, :2].T)
            np.testing.assert_allclose(np.column_stack([x, y]), own[:, :2] + OFFSET_M[:2], atol=1e-3)
