"""The true map features of scenes: what is painted is listed, what is listed is painted, and lanes lead where they are driven."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import shapely
from worlds import tiny_scene

from log2sim.datatypes import MapFeatures
from log2sim.synth.ground import GROUND_M_PER_PX, TILE_PX, Ground, GroundPlan
from log2sim.synth.scene import Scene
from log2sim.synth.synthesis import map_features_of

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
