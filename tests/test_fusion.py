"""Fusion of what several cameras measured: one row an object, whoever saw it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from worlds import measured_row, rows_at, scan, standing

from log2sim.datatypes import Measurements
from log2sim.perception.boxes import rotate
from log2sim.perception.fusion import fuse_tick

T0_NS = 1_700_000_000_000_000_000
SENSOR = np.array([0.0, 0.0, 1.9])


def row(cluster, category="car", camera="a", score=0.9, *, truncated=False, far=(0.0, 0.0, 0.0), t_ns=T0_NS):
    """One measured object from its points (n, 3) on flat ground."""
    return measured_row(
        cluster + far, SENSOR + far, category, camera=camera, score=score, bottom_m=far[2], t_ns=t_ns,
        truncated=np.array([truncated]),
    )  # fmt: skip


def placed(xy, sigma_m, camera, category="car", score=0.9, source="topdown"):
    """One object without LiDAR points."""
    at = rows_at([xy], category, sigma_m=sigma_m, source=source, camera=camera, score=score, t_ns=T0_NS)
    if source:
        return at
    return replace(at, center_m=np.full((1, 3), np.nan), covariance=np.full((1, 2, 2), np.nan))


def join(*rows):
    return Measurements.join(rows)


def points_of(*solids, keep=None):
    xyz, owner = scan(list(solids), noise_m=0.01)
    return [xyz[(owner == k) & (xyz[:, 2] > 0.2)] for k in range(len(solids))]


CAR = standing(14, 4, 30)
CAR_POINTS = points_of(CAR)[0]
# Seen by two cameras, each of which sees one part; the parts share some of the points.
ALONG = rotate(CAR_POINTS[:, :2], -CAR.yaw_rad)[:, 0]
QUARTERS = np.quantile(ALONG, [0.25, 0.75])
FRONT, REAR = CAR_POINTS[QUARTERS[0] < ALONG], CAR_POINTS[QUARTERS[1] > ALONG]


def test_one_object_in_two_cameras_becomes_one_row_from_all_of_its_points():
    fused = fuse_tick(join(row(FRONT, camera="a", score=0.6), row(REAR, camera="b", score=0.8)))
    assert len(fused) == 1
    assert (fused.camera[0], fused.score[0], fused.box_px[0, 0]) == ("b", 0.8, 10.8)
    assert len(fused.cluster[0]) == len(FRONT) + len(REAR)
    whole = np.hypot(*(fused.center_m[0] - CAR.center_m)[:2])
    assert whole < 0.2
    # The two parts overlap, so the extents of the whole are longer than those of either.
    assert (fused.high_m - fused.low_m)[0, 0] > 3.9
    assert fused.bottom_m[0] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("far", [(5e5, 5e6, 250.0), (-2e6, 9e6, -10.0)])
def test_map_coordinates_of_any_size_change_nothing_else(far):
    def made(at):
        pair = join(row(FRONT, camera="a", score=0.6, far=at), row(REAR, camera="b", score=0.8, far=at))
        return fuse_tick(join(pair, row(points_of(standing(25, -6, 0))[0], camera="a", far=at)))

    here, there = made((0.0, 0.0, 0.0)), made(far)
    assert len(here) == len(there) == 2
    np.testing.assert_allclose(there.center_m - far, here.center_m, atol=1e-3)
    np.testing.assert_allclose(there.low_m, here.low_m, atol=1e-3)
    np.testing.assert_allclose(there.high_m, here.high_m, atol=1e-3)
    np.testing.assert_allclose(there.covariance, here.covariance, atol=1e-3)


def test_one_object_found_twice_by_one_camera_keeps_the_surer_row_as_it_is():
    sure, unsure = row(CAR_POINTS, score=0.9), row(CAR_POINTS[::2], "truck", score=0.5)
    fused = fuse_tick(join(unsure, sure))
    assert len(fused) == 1
    assert (fused.category[0], fused.score[0]) == ("car", 0.9)
    np.testing.assert_array_equal(fused.center_m, sure.center_m)
    assert len(fused.cluster[0]) == len(CAR_POINTS)


def test_a_whole_view_of_an_object_is_surer_than_a_cut_one_of_a_like_score():
    fused = fuse_tick(join(row(FRONT, camera="a", score=0.9, truncated=True), row(REAR, camera="b", score=0.8)))
    assert fused.camera.tolist() == ["b"]
    assert fused.truncated.tolist() == [False]
    much = fuse_tick(join(row(FRONT, camera="a", score=0.9, truncated=True), row(REAR, camera="b", score=0.5)))
    assert much.camera.tolist() == ["a"]
    assert much.truncated.tolist() == [False]


def test_an_object_that_every_camera_cuts_stays_cut():
    fused = fuse_tick(join(row(FRONT, camera="a", truncated=True), row(REAR, camera="b", truncated=True)))
    assert fused.truncated.tolist() == [True]


def test_neighbors_stay_two():
    one, other = standing(14, 4, 0), standing(14, 6.4, 0)
    a, b = points_of(one, other)
    fused = fuse_tick(join(row(a, camera="a"), row(b, camera="b")))
    assert len(fused) == 2


@pytest.mark.parametrize(
    ("category", "same"), [("truck", True), ("bus", True), ("pedestrian", False), ("cyclist", False)]
)
def test_only_categories_that_are_confused_with_each_other_are_joined(category, same):
    # The person and the cyclist are seen first, so that no driver is looked for in a car.
    fused = fuse_tick(
        join(row(CAR_POINTS, "car", "a", 0.6), row(CAR_POINTS + np.array([0, 0.05, 0]), category, "b", 0.9))
    )
    groups = sorted(fused.category.tolist())
    assert (len(fused) == 1) == (same or category == "pedestrian")
    assert category in groups if category != "pedestrian" else groups == ["car"]


def test_the_result_does_not_depend_on_the_order_of_the_rows():
    a, b = points_of(standing(14, 4, 0), standing(22, -5, 90))
    rows = [row(FRONT, camera="a", score=0.6), row(REAR, camera="b", score=0.8), row(b, camera="a", score=0.7)]
    rows.append(placed((40.0, 3.0), 1.0, "b", score=0.65))
    results = [fuse_tick(join(*(rows[i] for i in order))) for order in ([0, 1, 2, 3], [3, 2, 1, 0], [2, 0, 3, 1])]
    assert [len(r) for r in results] == [3, 3, 3]
    assert len(a)
    for r in results[1:]:
        np.testing.assert_allclose(r.center_m, results[0].center_m, atol=1e-6)
        assert r.score.tolist() == results[0].score.tolist()


def test_fusing_again_changes_nothing():
    once = fuse_tick(
        join(row(FRONT, camera="a", score=0.6), row(REAR, camera="b", score=0.8), placed((40.0, 3.0), 1.0, "a"))
    )
    twice = fuse_tick(once)
    for name in ("center_m", "score", "category", "points"):
        np.testing.assert_array_equal(getattr(twice, name), getattr(once, name))


# 99 % of the squared distances of two unit normals differ by less than 9.21 times the sum of their variances.
@pytest.mark.parametrize("sigma_m", [0.3, 2.0])
@pytest.mark.parametrize(("factor", "one"), [(0.99, True), (1.01, False)])
def test_places_without_points_are_gated_by_their_covariance(sigma_m, factor, one):
    apart = factor * np.sqrt(9.21 * 2) * sigma_m
    fused = fuse_tick(join(placed((20.0, 0.0), sigma_m, "a"), placed((20.0, apart), sigma_m, "b")))
    assert (len(fused) == 1) == one


def test_places_of_one_camera_are_never_joined():
    assert len(fuse_tick(join(placed((20.0, 0.0), 1.0, "a"), placed((20.0, 0.5), 1.0, "a")))) == 2


def test_a_place_without_points_joins_the_cluster_that_stands_there_and_takes_its_place():
    far_off = placed(CAR.center_m[:2] + np.array([0.6, 0.3]), 0.8, "b", score=0.5)
    fused = fuse_tick(join(far_off, row(CAR_POINTS, camera="a", score=0.9)))
    assert fused.source.tolist() == ["lidar"]
    assert np.hypot(*(fused.center_m[0] - CAR.center_m)[:2]) < 0.2


def test_rows_without_a_place_are_joined_with_nothing():
    rows = join(placed((0, 0), 1.0, "a", source=""), placed((0, 0), 1.0, "b", source=""), row(CAR_POINTS, camera="b"))
    fused = fuse_tick(rows)
    assert sorted(fused.source.tolist()) == ["", "", "lidar"]


def test_a_person_made_of_a_cars_points_is_its_driver_and_is_dropped():
    inside = CAR_POINTS[np.linalg.norm(CAR_POINTS[:, :2] - CAR_POINTS[50, :2], axis=1) < 0.5]
    assert len(inside) > 5
    fused = fuse_tick(join(row(CAR_POINTS), row(inside, "pedestrian", score=0.95)))
    assert fused.category.tolist() == ["car"]


def test_a_person_beside_a_car_stays():
    person = standing(12.0, 1.5, 0, (0.7, 0.7, 1.75))
    car, walker = points_of(CAR, person)
    assert sorted(fuse_tick(join(row(car), row(walker, "pedestrian"))).category.tolist()) == ["car", "pedestrian"]


def test_no_rows_and_one_row_are_left_alone():
    assert len(fuse_tick(Measurements.empty())) == 0
    alone = row(CAR_POINTS)
    np.testing.assert_array_equal(fuse_tick(alone).center_m, alone.center_m)


def without_points(r, sigma_m=1.0):
    """A row whose points were counted but not kept, as mode "paper" has them."""
    return replace(r, cluster=(np.zeros((0, 3)),), covariance=np.eye(2)[None] * sigma_m**2)


def test_rows_whose_points_were_not_kept_are_gated_by_their_covariance():
    here, there = row(CAR_POINTS, camera="a"), row(CAR_POINTS + np.array([0, 9.0, 0]), camera="b")
    assert len(fuse_tick(join(without_points(here), without_points(replace(here, camera=np.array(["b"])))))) == 1
    assert len(fuse_tick(join(without_points(here), without_points(there)))) == 2
    assert len(fuse_tick(join(without_points(here), without_points(here)))) == 2  # one camera tells its own boxes apart
    walker = without_points(row(CAR_POINTS[:9], "pedestrian"))
    assert sorted(fuse_tick(join(without_points(here), walker)).category.tolist()) == ["car", "pedestrian"]


def test_covariances_that_are_known_along_one_line_alone_are_no_obstacle():
    thin = placed((20.0, 0.0), 1.0, "a")
    flat = replace(thin, covariance=np.array([[[4.0, 0.0], [0.0, 1e-9]]]))
    near = replace(flat, camera=np.array(["b"]), center_m=flat.center_m + np.array([3.0, 0, 0]))
    assert len(fuse_tick(join(flat, near))) == 1
    beside = replace(flat, camera=np.array(["b"]), center_m=flat.center_m + np.array([0, 0.5, 0]))
    assert len(fuse_tick(join(flat, beside))) == 2


def test_a_tall_thing_over_a_car_does_not_change_its_ground():
    over = np.vstack([CAR_POINTS, CAR_POINTS[:30] + np.array([0, 0, 0.4])])
    fused = fuse_tick(join(row(CAR_POINTS, camera="a", score=0.9), row(over, camera="b", score=0.8)))
    assert len(fused) == 1
    assert fused.bottom_m[0] == pytest.approx(0.0, abs=1e-9)
