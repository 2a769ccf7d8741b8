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


def test_rows_of_one_sweep_are_never_one_object_even_where_they_share_points():
    """A detector in the sweep has told touching vehicles apart; cameras that saw the same points have not."""
    for cameras, count in ((("a", "b"), 1), (("a", ""), 1), (("", ""), 2)):
        pair = [row(FRONT, camera=cameras[0], score=0.6), row(REAR, camera=cameras[1], score=0.8)]
        fused = fuse_tick(join(*pair))
        assert len(fused) == count, cameras
    for whole, kept in zip(pair[::-1], (fused.take([0]), fused.take([1]))):
        np.testing.assert_array_equal(kept.center_m, whole.center_m)
        assert len(kept.cluster[0]) == len(whole.cluster[0])


def test_one_object_found_twice_by_one_camera_keeps_the_surer_row_as_it_is():
    sure, unsure = row(CAR_POINTS, score=0.9), row(CAR_POINTS[::2], "truck", score=0.5)
    fused = fuse_tick(join(unsure, sure))
    assert len(fused) == 1
    assert (fused.category[0], fused.score[0]) == ("car", 0.9)
    np.testing.assert_array_equal(fused.center_m, sure.center_m)
    assert len(fused.cluster[0]) == len(CAR_POINTS)


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


# 99 % of the squared distances of two unit normals differ by less than 9.21 times the sum of their variances.
@pytest.mark.parametrize("sigma_m", [0.3, 2.0])
@pytest.mark.parametrize(("factor", "one"), [(0.99, True), (1.01, False)])
def test_places_without_points_are_gated_by_their_covariance(sigma_m, factor, one):
    apart = factor * np.sqrt(9.21 * 2) * sigma_m
    fused = fuse_tick(join(placed((20.0, 0.0), sigma_m, "a"), placed((20.0, apart), sigma_m, "b")))
    assert (len(fused) == 1) == one


def test_a_place_without_points_joins_the_cluster_that_stands_there_and_takes_its_place():
    far_off = placed(CAR.center_m[:2] + np.array([0.6, 0.3]), 0.8, "b", score=0.5)
    fused = fuse_tick(join(far_off, row(CAR_POINTS, camera="a", score=0.9)))
    assert fused.source.tolist() == ["lidar"]
    assert np.hypot(*(fused.center_m[0] - CAR.center_m)[:2]) < 0.2


def test_a_person_made_of_a_cars_points_is_its_driver_and_is_dropped():
    inside = CAR_POINTS[np.linalg.norm(CAR_POINTS[:, :2] - CAR_POINTS[50, :2], axis=1) < 0.5]
    assert len(inside) > 5
    fused = fuse_tick(join(row(CAR_POINTS), row(inside, "pedestrian", score=0.95)))
    assert fused.category.tolist() == ["car"]
