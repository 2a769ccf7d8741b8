"""The map of the ground against a road whose height, paint and reflectivity are known everywhere."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from ground_worlds import World, empty_scenario, height_at, is_paint, parked_car, world_log

from log2sim.config_sections import MapConfig
from log2sim.errors import LogError
from log2sim.geometry import Array
from log2sim.mapping.builder import map_ground
from log2sim.mapping.ground_map import GroundMap

SETTINGS = MapConfig(cell_m=0.05)


@pytest.fixture(scope="module")
def ground() -> GroundMap:
    log = world_log(World(gains=(1.0, 0.7), lidars=2))
    return map_ground(log, empty_scenario(log), SETTINGS)


def positions(ground: GroundMap) -> Array:
    rows, columns = np.mgrid[: ground.alpha.shape[0], : ground.alpha.shape[1]]
    return ground.xy_of(rows, columns)


def near_path(xy: Array, reach_m: float) -> Array:
    along = np.clip(xy[..., 0], 0, 10)
    return np.hypot(xy[..., 0] - along, xy[..., 1]) < reach_m


def clear_of_edges(xy: Array, margin_m: float) -> Array:
    off = np.abs(xy - np.rint(xy))
    return (off > margin_m).all(axis=-1)


def test_cells_and_positions_are_inverse(ground: GroundMap) -> None:
    rows, columns = ground.cells_of([[1.234, -2.345]])
    np.testing.assert_allclose(ground.xy_of(rows, columns), [[1.234, -2.345]], atol=1e-9)
    x0, _, _, y1 = ground.extent_m
    np.testing.assert_allclose(ground.xy_of(0, 0), [x0 + 0.025, y1 - 0.025])
    np.testing.assert_allclose(np.array(ground.extent_m) / 0.05, np.rint(np.array(ground.extent_m) / 0.05), atol=1e-6)


def test_heights_are_those_of_the_road_and_of_the_curb(ground: GroundMap) -> None:
    xy = positions(ground)
    known = np.isfinite(ground.height_m) & near_path(xy, 12.0) & (np.abs(xy[..., 1] - 6.0) > 0.3)
    error = ground.height_m[known] - height_at(xy[known])
    assert known.sum() > 50_000
    assert abs(np.median(error)) < 0.01
    assert np.percentile(np.abs(error), 95) < 0.03


def test_paint_stands_out_in_intensity_at_any_range_and_on_any_scale(ground: GroundMap) -> None:
    xy = positions(ground)
    known = np.isfinite(ground.intensity) & clear_of_edges(xy, 0.15) & (xy[..., 1] < 5.5)
    for low, high in ((0, 6), (6, 12), (12, 20)):
        ring = known & near_path(xy, high) & ~near_path(xy, low)
        paint, road = (ground.intensity[ring & (is_paint(xy) == kind)] for kind in (True, False))
        assert min(len(paint), len(road)) > 2000
        assert np.percentile(paint, 10) > np.percentile(road, 90)


def test_colors_lie_where_the_paint_is_on_a_slope(ground: GroundMap) -> None:
    xy = positions(ground)
    seen = (ground.alpha > 200) & clear_of_edges(xy, 0.06) & near_path(xy, 8.0) & (np.abs(xy[..., 1]) < 5)
    value = ground.color_bgr[..., 1][seen]
    wrong = (value > 120) != is_paint(xy[seen])
    assert seen.sum() > 20_000
    assert wrong.mean() < 0.002


def test_a_shift_of_ten_centimeters_would_be_noticed() -> None:
    log = world_log(World(camera_shift_m=0.1))
    shifted = map_ground(log, empty_scenario(log), SETTINGS)
    xy = positions(shifted)
    seen = (shifted.alpha > 200) & clear_of_edges(xy, 0.06) & near_path(xy, 8.0) & (np.abs(xy[..., 1]) < 5)
    assert ((shifted.color_bgr[..., 1][seen] > 120) != is_paint(xy[seen])).mean() > 0.02


def test_exposures_are_balanced_over_the_overlap(ground: GroundMap) -> None:
    xy = positions(ground)
    seen = (ground.alpha > 200) & clear_of_edges(xy, 0.2) & near_path(xy, 8.0) & is_paint(xy)
    left, right = (ground.color_bgr[..., 0][seen & side] for side in (xy[..., 1] > 2, xy[..., 1] < -2))
    assert 0.93 < float(np.median(left)) / float(np.median(right)) < 1.07  # 1.43 without gains


def test_parked_cars_are_unknown_ground() -> None:
    log = world_log()
    ground = map_ground(log, empty_scenario(log, parked_car(8.0, 2.5)), SETTINGS)
    rows, columns = ground.cells_of([[8.0, 2.5], [8.0, -2.5]])
    (r, s), (c, d) = np.rint(rows).astype(int), np.rint(columns).astype(int)
    assert ground.alpha[r, c] == 0
    assert np.isnan(ground.height_m[r, c])
    assert np.isnan(ground.intensity[r, c])
    assert ground.alpha[s, d] > 0
    assert np.isfinite(ground.height_m[s, d])


def test_cameras_alone_lie_on_the_ground_under_the_ego() -> None:
    log = world_log(World(lidars=0))
    ground = map_ground(log, empty_scenario(log), SETTINGS)
    xy = positions(ground)
    assert not np.isfinite(ground.height_m).any()
    assert not np.isfinite(ground.intensity).any()
    assert any("no height" in note for note in ground.notes)
    seen = (ground.alpha > 200) & clear_of_edges(xy, 0.15) & near_path(xy, 3.0) & (xy[..., 0] < 9)
    assert seen.sum() > 5000
    assert ((ground.color_bgr[..., 1][seen] > 120) != is_paint(xy[seen])).mean() < 0.02


def test_a_log_of_lidars_alone_has_no_color() -> None:
    log = world_log(World(gains=()))
    ground = map_ground(log, empty_scenario(log), SETTINGS)
    assert not ground.alpha.any()
    assert np.isfinite(ground.height_m).any()
    assert any("no color" in note for note in ground.notes)


def test_a_map_ends_where_nothing_more_is_known(ground: GroundMap) -> None:
    known = ground.known
    assert all(known[edge].any() for edge in (0, -1, np.s_[:, 0], np.s_[:, -1]))
    nothing = GroundMap(
        np.zeros((3, 4, 3), np.uint8), np.zeros((3, 4), np.uint8), np.full((3, 4), np.nan, np.float32),
        np.full((3, 4), np.nan, np.float32), 0.5, (0.0, 2.0, 0.0, 1.5),
    )  # fmt: skip
    assert nothing.around(nothing.known).extent_m == (0.0, 0.5, 1.0, 1.5)


def test_a_log_without_poses_is_refused_with_the_reason() -> None:
    log = world_log()
    with pytest.raises(LogError, match="no pose"):
        map_ground(log.changed(ego=None), empty_scenario(log), SETTINGS)


def test_a_long_log_gets_coarser_cells_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("log2sim.mapping.raster.MAX_CELLS", 100_000)
    log = world_log(World(gains=()))
    ground = map_ground(log, empty_scenario(log), SETTINGS)
    assert ground.alpha.size <= 100_000
    assert any("cells of 0." in note for note in ground.notes)


def test_sweeps_without_intensity_leave_the_heights() -> None:
    log = world_log(World(gains=()))
    read = log.streams["l0"].read
    stream = dataclasses.replace(
        log.streams["l0"], t_ns=log.streams["l0"].t_ns, read=lambda i: dataclasses.replace(read(i), intensity=None)
    )
    ground = map_ground(log.changed(streams={"l0": stream}), empty_scenario(log), SETTINGS)
    assert np.isfinite(ground.height_m).any()
    assert not np.isfinite(ground.intensity).any()
    assert any("no intensity" in note for note in ground.notes)
