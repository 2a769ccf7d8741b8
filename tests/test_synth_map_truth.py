"""The true map features of scenes: what is painted is listed, what is listed is painted, and lanes lead where they are driven."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import shapely
from worlds import tiny_log, tiny_scene

from log2sim.datatypes import MapFeatures, Scenario
from log2sim.synth.ground import GROUND_M_PER_PX, TILE_PX, Ground, GroundPlan, dashes_along, stretch
from log2sim.synth.scene import Scene
from log2sim.synth.truth import map_features_of

CROSSING: dict[str, Any] = {
    "road": [
        {"line": [[-40.0, 0.0], [40.0, 0.0]], "width_m": 8.0},
        {"line": [[0.0, -40.0], [0.0, 40.0]], "width_m": 6.0, "marking": "solid", "sidewalk_m": 0.0},
    ],
    "zebra": [{"line": [[12.0, -4.0], [12.0, 4.0]]}],
    "stop_line": [{"line": [[-8.0, -3.7], [-8.0, -0.1]]}],
    "arrow": [{"position": [-14.0, -2.0], "shape": "left"}, {"position": [-20.0, 2.0], "yaw_deg": 180.0}],
}


def features(**changes: Any) -> tuple[Scene, MapFeatures]:
    scene = tiny_scene([], **{**CROSSING, **changes})
    return scene, map_features_of(scene)


def painted(scene: Scene, tiles: range = range(-3, 3)) -> tuple[np.ndarray, np.ndarray]:
    """Middles (N, 2) of the pixels around the origin and how much of them is painted."""
    ground = Ground(GroundPlan.of(scene), 0)
    only = {"meadow": 0.0, "sidewalk": 0.0, "curb": 0.0, "asphalt": 0.0, "paint": 1.0}
    share = np.vstack([np.hstack([ground.shade(0, i, j, only) for i in tiles]) for j in tiles])
    at = (np.arange(len(share)) + tiles.start * TILE_PX + 0.5) * GROUND_M_PER_PX
    x, y = np.meshgrid(at, at)
    return np.column_stack([x.ravel(), y.ravel()]), share.ravel()


def shapes(truth: MapFeatures) -> tuple[Any, Any]:
    lines = [
        shapely.LineString(m.points_m[:, :2]).buffer(m.width_m / 2, cap_style="flat")
        for m in truth.markings
        if m.kind in ("solid", "dashed", "stop_line")
    ]
    closed = [shapely.Polygon(m.points_m[:, :2]) for m in truth.markings if m.kind in ("crosswalk", "other")]
    return shapely.union_all(lines), shapely.union_all(closed)


@pytest.mark.slow
def test_all_paint_is_listed_and_all_that_is_listed_is_painted() -> None:
    scene, truth = features()
    xy, share = painted(scene)
    lines, closed = shapes(truth)
    inside = shapely.contains_xy(shapely.union(lines, closed).buffer(0.06), *xy.T)
    assert share[~inside].max() == 0
    solid = [m for m in truth.markings if m.kind in ("solid", "stop_line")]
    for marking in solid:
        strip = shapely.LineString(marking.points_m[:, :2]).buffer(marking.width_m / 2 - 0.045, cap_style="flat")
        own = shapely.contains_xy(strip, *xy.T)
        assert own.any() or marking.width_m < 0.12
        assert share[own].min(initial=1.0) > 0.9, marking.id
    for marking in (m for m in truth.markings if m.kind == "dashed"):
        own = shapely.contains_xy(shapely.LineString(marking.points_m[:, :2]).buffer(0.03), *xy.T)
        assert 0.3 < share[own].mean() < 0.75  # about half of it is gaps
        ends = marking.points_m[[0, -1], :2]
        for end in ends[np.abs(ends).max(1) < 30]:  # paint begins and ends where it does
            near = np.linalg.norm(xy - end, axis=1) < 0.08
            assert share[near].max() > 0.1
            assert share[near].min() < 0.5
    for marking in (m for m in truth.markings if m.kind == "other"):
        own = shapely.contains_xy(shapely.Polygon(marking.points_m[:, :2]).buffer(-0.05), *xy.T)
        assert own.sum() > 100
        assert share[own].min() > 0.9


def test_kinds_colors_and_gaps_are_those_of_the_scene() -> None:
    road = {"line": [[-50.0, 0.0], [50.0, 0.0]], "width_m": 10.5, "lanes": 3, "lanes_back": 1, "sidewalk_m": 0.0}
    road |= {"center_marking": "double", "center_color": "yellow", "missing_m": [[40.0, 60.0]], "old_m": [0.6]}
    _, truth = features(road=[road], zebra=[], stop_line=[], arrow=[])
    by_offset = {round(float(m.points_m[0, 1]), 2): (m.kind, m.color, len(m.points_m)) for m in truth.markings}
    # Two lanes along the line at its right, one back at its left; removed lines are no markings.
    assert by_offset == {
        -5.05: ("solid", "white", 2),
        -1.75: ("dashed", "white", 2),
        1.62: ("solid", "yellow", 2),
        1.88: ("solid", "yellow", 2),
        5.05: ("solid", "white", 2),
    }
    solid = sorted((m.points_m[0, 0], m.points_m[-1, 0]) for m in truth.markings if m.kind == "solid")
    assert {(round(float(a), 6), round(float(b), 6)) for a, b in solid} == {(-50.0, -10.0), (10.0, 50.0)}
    assert {b.kind for b in truth.borders} == {"edge"}


@pytest.mark.parametrize("side", ["right", "left"])
def test_lanes_lead_where_traffic_drives_and_name_what_lies_beside_them(side: str) -> None:
    _, truth = features(traffic=side)
    lanes = {lane.id: lane for lane in truth.lanes}
    sides = {m.id: m for m in truth.markings} | {b.id: b for b in truth.borders}
    assert len(lanes) == 2 * 2 * 3  # two roads, two lanes, three parts
    for lane in lanes.values():
        ahead = lane.points_m[-1, :2] - lane.points_m[0, :2]
        ahead /= np.linalg.norm(ahead)
        left = np.array([-ahead[1], ahead[0]])
        middle = lane.points_m[:, :2].mean(0)
        # The middle of both roads lies at the origin, to the left where traffic keeps right.
        assert np.sign(-middle @ left) == (1 if side == "right" else -1)
        for next_one in lane.successors:
            assert np.allclose(lanes[next_one].points_m[0], lane.points_m[-1])
            assert lane.id in lanes[next_one].predecessors
        assert lane.opposite is not None
        other = lanes[lane.opposite]
        assert other.opposite == lane.id
        assert np.allclose(
            other.points_m[0, :2] - other.points_m[-1, :2], ahead * shapely.LineString(lane.points_m).length
        )
        for name, sign in ((lane.left, 1), (lane.right, -1)):
            assert (name is None) == (lane.junction is not None)
            if name is not None:
                edge = shapely.LineString(sides[name].points_m[:, :2])
                offset = np.array(edge.interpolate(edge.project(shapely.Point(middle))).coords[0]) - middle
                assert offset @ left == pytest.approx(sign * lane.width_m[0] / 2, abs=1e-6)
    assert sum(lane.junction is not None for lane in lanes.values()) == 4


def test_a_road_that_bends_has_dashes_all_along_and_lanes_within() -> None:
    s = np.linspace(0, 60, 61)
    line = np.column_stack([40 * np.sin(s / 40), 40 - 40 * np.cos(s / 40)])
    road = {"line": line.tolist(), "dash_m": [4.0, 8.0], "width_m": 7.0, "sidewalk_m": 0.0}
    _, truth = features(road=[road], zebra=[], stop_line=[], arrow=[])
    (center,) = (m for m in truth.markings if m.kind == "dashed")
    radius = np.linalg.norm(center.points_m[:, :2] - [0, 40], axis=1)
    assert np.allclose(radius, 40, atol=0.01)
    dashes = dashes_along(line, 4.0, 8.0)
    assert [shapely.LineString(d).length for d in dashes] == pytest.approx([4.0] * 5, abs=1e-3)
    # Paint is listed from the first dash, which half a gap precedes, to the end of the last.
    assert np.allclose(center.points_m[0, :2], stretch(line, 4.0, 5.0)[0])
    assert np.allclose(center.points_m[-1, :2], dashes[-1][-1])
    for lane in truth.lanes:
        away = np.abs(np.linalg.norm(lane.points_m[:, :2] - [0, 40], axis=1) - 40)
        assert np.allclose(away, away[0], atol=0.01)


def test_worn_paint_is_missing_by_the_share_that_is_asked_for_and_removed_lines_are_dim() -> None:
    road = {"line": [[-40.0, 0.0], [40.0, 0.0]], "marking": "solid", "side_marking": "none", "sidewalk_m": 0.0}
    plain: dict[str, Any] = {"zebra": [], "stop_line": [], "arrow": []}
    _, fresh = painted(features(road=[road], **plain)[0])
    _, worn = painted(features(road=[{**road, "worn": 0.4}], **plain)[0])
    on = fresh > 0.9
    assert 0.45 < worn[on].mean() < 0.75
    assert ((worn[on] == 0) | (worn[on] > 0.9)).all()
    xy, old = painted(features(road=[{**road, "marking": "dashed", "old_m": [0.5]}], **plain)[0])
    beside = old[np.abs(xy[:, 1] - 0.5) < 0.04]
    assert 0.3 < beside.max() < 0.5


def test_the_truth_of_a_log_holds_its_map_and_keeps_it_in_a_file() -> None:
    _, truth = tiny_log([], observe=False, **CROSSING)
    again = Scenario.from_dict(truth.to_dict())
    assert again.map_features is not None
    assert truth.map_features is not None
    assert [m.id for m in again.map_features.markings] == [m.id for m in truth.map_features.markings]
    assert len(again.map_features.lanes) == 12
