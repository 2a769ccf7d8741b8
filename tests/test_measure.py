"""Measurement in image boxes: ray-cast clouds whose every point has a known owner."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import KDTree
from worlds import Solid, apart, camera_ahead, cloud_at, outline_px, scan, standing

from log2sim.datatypes import Boxes3D, Detections
from log2sim.geometry import apply, inverse, transform
from log2sim.perception.boxes import rotate
from log2sim.perception.lidar.cloud import ON_GROUND_M
from log2sim.perception.lidar.clusters import continued_sides
from log2sim.perception.lidar.measure import measure
from log2sim.perception.lidar.projection import View

T0_NS = 1_700_000_000_000_000_000
SENSOR = (0.0, 0.0, 1.9)
PERSON = (0.7, 0.7, 1.75)


def height_of(rows):
    """Height of the only row's points above its ground."""
    return (rows.top_m - rows.bottom_m).item()


def view_ahead(far=(0.0, 0.0, 0.0), yaw=0.0):
    camera = camera_ahead(yaw_rad=yaw, at=(0.0, 0.0, 0.0))
    at = np.array(far) + np.array([0.0, 0.0, 1.6])
    return View(camera, T0_NS, transform(camera.mount_T_cam[:3, :3], at))


def cloud_of(world, *, far=(0.0, 0.0, 0.0), height=None, t_s=0.0):
    """The cloud of points (N, 3) on flat ground, with exact heights, as seen from `SENSOR`, all moved by `far`."""
    return cloud_at(world, height, t_s=t_s, stamp_ns=T0_NS, origin=far, sensor=SENSOR)


def measure_view(view, found, cloud, mode="robust"):
    """Rows of the boxes of one frame."""
    return measure([(view, found, cloud)], mode=mode)


def boxes(view, solids, categories=None, score=None):
    outline = np.array([outline_px(view.camera, view.map_T_cam, s) for s in solids]).reshape(-1, 4)
    category = np.array(categories or ["car"] * len(solids), dtype="<U16")
    return Detections(outline, np.full(len(solids), 0.9) if score is None else score, category)


def owners(cluster, world, owner):
    """Which solid each point of a cluster comes from, by the nearest point of the world."""
    assert len(cluster)
    gap, which = KDTree(world).query(cluster[:, :3])
    assert gap.max() < 1e-4
    return owner[which]


PLACES = [(10, 2, 20), (14, -4, -30), (18, 6, 75), (22, -3, 140), (28, 5, 5), (35, -8, 170), (12, 5, 100)]


@pytest.mark.parametrize(("x", "y", "yaw_deg"), PLACES)
def test_a_free_car_is_measured_within_its_own_sigma(x, y, yaw_deg):
    car, view = standing(x, y, yaw_deg), view_ahead()
    world, owner = scan([car], noise_m=0.01)
    row = measure_view(view, boxes(view, [car]), cloud_of(world))
    error = (row.center_m[0] - car.center_m)[:2]
    assert row.source[0] == "lidar"
    assert apart(row.yaw_rad[0], car.yaw_rad) < np.deg2rad(4)
    assert np.hypot(*error) < 0.6
    assert error @ np.linalg.solve(row.covariance[0], error) < 13.8  # 99.9 %, two degrees of freedom
    assert row.bottom_m[0] == pytest.approx(0.0, abs=0.02)
    on_car = int(((owner == 0) & (world[:, 2] > ON_GROUND_M)).sum())
    assert 0.8 * on_car <= row.points[0] <= on_car
    assert (owners(row.cluster[0], world, owner) == 0).all()


@pytest.mark.parametrize("angle", [0.6, 1.9, -2.6])
def test_turning_the_world_turns_the_measurement(angle):
    car = standing(15, 3, 25)
    world, _ = scan([car], noise_m=0.01)
    view, turned_view = view_ahead(), view_ahead(yaw=angle)
    turned = np.column_stack([rotate(world[:, :2], angle), world[:, 2]])
    here = measure_view(view, boxes(view, [car]), cloud_of(world))
    there = measure_view(turned_view, boxes(view, [car]), cloud_of(turned))
    # Cells of clustering and steps of the yaw search stay where they are, so a point or two may differ.
    np.testing.assert_allclose(rotate(there.center_m[:, :2], -angle), here.center_m[:, :2], atol=0.08)
    np.testing.assert_allclose(there.high_m - there.low_m, here.high_m - here.low_m, atol=0.08)
    assert apart(there.yaw_rad[0], here.yaw_rad[0] + angle) < np.deg2rad(1.5)


@pytest.mark.parametrize(
    ("name", "occluder"),
    [
        ("post", Solid((8.0, 1.6, 1.5), (0.2, 0.2, 3.0))),
        ("person", standing(10, 2.5, 0, PERSON)),
        ("hedge", Solid((9.0, 3.0, 0.4), (0.5, 6.0, 0.8))),
    ],
)
def test_what_stands_in_front_is_not_the_object(name, occluder):
    car, view = standing(16, 3, 40), view_ahead()
    world, owner = scan([car, occluder], noise_m=0.01)
    assert (owner == 1).sum() > 50
    row = measure_view(view, boxes(view, [car]), cloud_of(world))
    assert (owners(row.cluster[0], world, owner) == 0).all(), name
    error = (row.center_m[0] - car.center_m)[:2]
    assert np.hypot(*error) < 1.0


def test_a_person_before_a_car_and_the_car_behind_are_told_apart():
    person, car, view = standing(9, 1.2, 0, PERSON), standing(15, 2, 90), view_ahead()
    world, owner = scan([person, car], noise_m=0.01)
    rows = measure_view(view, boxes(view, [person, car], ["pedestrian", "car"]), cloud_of(world))
    assert (owners(rows.cluster[0], world, owner) == 0).all()
    assert (owners(rows.cluster[1], world, owner) == 1).all()
    assert np.hypot(*(rows.center_m[0] - person.center_m)[:2]) < 0.3


def test_ground_in_the_box_and_branches_above_it_are_left_out():
    car, view = standing(14, 2, 30), view_ahead()
    branch = Solid((13.0, 2.0, 4.6), (3.0, 3.0, 0.4))
    world, owner = scan([car, branch], noise_m=0.01, elevation_deg=(-20, 25), steps=(360, 90))
    tall = boxes(view, [car])
    tall.box_px[0] += [-20, -200, 20, 60]
    row = measure_view(view, tall, cloud_of(world))
    assert (owners(row.cluster[0], world, owner) == 0).all()
    assert height_of(row) < 2.0


def test_boxes_cut_by_the_images_border_are_marked_and_use_points_beyond_it():
    car, view = standing(9, 6.6, 10), view_ahead()
    world, owner = scan([car], noise_m=0.01, azimuth_deg=(10, 80))
    found = boxes(view, [car])
    assert found.box_px[0, 0] == 0.0
    uv, _ = project(view, world[owner == 0])
    outside = (uv[:, 0] < 0).sum()
    row = measure_view(view, found, cloud_of(world))
    assert row.truncated.tolist() == [True]
    assert outside > 20
    seen = ((owner == 0) & (world[:, 2] > ON_GROUND_M)).sum()
    assert row.points[0] > 0.9 * seen
    assert np.hypot(*(row.center_m[0] - car.center_m)[:2]) < 0.4


NOTHING = {
    "sky": (500, 5, 560, 40),
    "without area": (300, 320, 300, 320),
    "upside down": (400, 400, 300, 300),
    "outside": (-900, -900, -800, -800),
    "NaN": (np.nan, np.nan, np.nan, np.nan),
}


@pytest.mark.parametrize("mode", ["robust", "paper"])
@pytest.mark.parametrize("name", NOTHING)
def test_boxes_without_points_come_back_without_a_place(name, mode):
    world, _ = scan([standing(14, 2, 30)])
    found = Detections(np.array([NOTHING[name]], dtype=float), np.array([0.7]), np.array(["truck"]))
    rows = measure_view(view_ahead(), found, cloud_of(world), mode=mode)
    assert rows.source.tolist() == [""]
    assert rows.points.tolist() == [0]
    assert np.isnan(rows.center_m).all()
    assert np.isnan(rows.covariance).all()
    assert np.isnan(rows.yaw_rad).all()
    assert rows.cluster[0].shape == (0, 3)
    assert np.isnan([*rows.low_m[0], *rows.high_m[0], rows.bottom_m[0], rows.top_m[0]]).all()
    assert (rows.t_ns[0], rows.score[0], rows.camera[0]) == (T0_NS, 0.7, "front")


def test_a_thin_thing_in_a_cars_box_is_no_car():
    view = view_ahead()
    world, _ = scan([Solid((12.0, 0.0, 0.6), (0.1, 0.1, 1.2))], noise_m=0.005)
    assert (world[:, 2] > 0.3).sum() > 10
    assert measure_view(view, boxes(view, [standing(14, 0, 90)]), cloud_of(world)).source.tolist() == [""]


def test_the_stamp_is_the_mean_time_of_the_objects_own_points():
    car, view = standing(14, 2, 30), view_ahead()
    world, owner = scan([car])
    t_s = np.where(owner == 0, np.linspace(-0.05, -0.03, len(world)), 5.0)
    row = measure_view(view, boxes(view, [car]), cloud_of(world, t_s=t_s))
    taken = (owner == 0) & (world[:, 2] > ON_GROUND_M)
    assert (row.t_ns[0] - T0_NS) / 1e9 == pytest.approx(t_s[taken].mean(), abs=1e-3)
    untouched = measure_view(view, Detections(np.array([NOTHING["sky"]], float), np.ones(1), np.array(["car"])), None)
    assert untouched.t_ns[0] == T0_NS


def test_the_height_in_the_image_is_the_objects_height():
    for x in (8.0, 16.0, 30.0):
        person, view = standing(x, 1.5, 0, PERSON), view_ahead()
        world, _ = scan([person])
        row = measure_view(view, boxes(view, [person], ["pedestrian"]), cloud_of(world))
        # The outline is that of a box whose near side is half a width closer than its points' middle at most.
        assert row.height_px_m[0] == pytest.approx(1.75, rel=0.12)


# Mode "paper"


@pytest.mark.matrix
@pytest.mark.parametrize("seed", range(4))
def test_paper_mode_is_the_point_nearest_to_the_box_center_and_the_extent_of_all(seed):
    rng = np.random.default_rng(seed)
    view = view_ahead()
    world = rng.uniform([5, -6, 0], [25, 6, 2], (800, 3))
    found = Detections(np.array([[450.0, 220, 700, 380]]) + rng.uniform(-40, 40, 4), np.ones(1), np.array(["car"]))
    row = measure_view(view, found, cloud_of(world), mode="paper")
    uv, front = project(view, world)
    box = found.box_px[0]
    inside = np.array([front[k] and box[0] <= uv[k, 0] <= box[2] and box[1] <= uv[k, 1] <= box[3] for k in range(800)])
    middle = (box[:2] + box[2:]) / 2
    best = min(np.flatnonzero(inside), key=lambda k: np.hypot(*(uv[k] - middle)))
    np.testing.assert_allclose(row.center_m[0], world[best], atol=1e-5)
    np.testing.assert_allclose([*(row.high_m - row.low_m)[0], height_of(row)], np.ptp(world[inside], axis=0), atol=1e-5)
    assert row.points[0] == inside.sum()


# Projection of clouds


def project(view, world):
    """Pixels (N, 2) by the pinhole formula alone, and what is in front (N,)."""
    p = apply(inverse(view.map_T_cam), world)
    with np.errstate(divide="ignore", invalid="ignore"):
        uv = p[:, :2] / p[:, 2:] * 700.0 + [600.0, 300.0]
    return uv, p[:, 2] > 0.1


def flank(azimuth_step_deg, *, length_m=16.0, aside_m=2.5, start_m=2.0):
    """Points of a long side beside the sensor, one a ray."""
    azimuth = np.arange(
        np.arctan2(aside_m, start_m + length_m), np.arctan2(aside_m, start_m), np.deg2rad(azimuth_step_deg)
    )
    return np.stack([aside_m / np.tan(azimuth), np.full(len(azimuth), aside_m)], axis=1)


def test_a_flank_goes_on_where_rays_are_far_apart_and_ends_where_none_hits_it():
    points = flank(0.4)
    near, far = points[points[:, 0] <= 9.0].T, points[points[:, 0] > 9.0].T
    assert np.diff(np.sort(points[:, 0])).max() > 0.8
    np.testing.assert_array_equal(continued_sides(near, far, 22.0), np.arange(far.shape[1]))
    # What is beyond a gap that no lost ray explains, beside the flank, or longer than the category, is something else.
    assert len(continued_sides(near, far + np.array([[3.0], [0.0]]), 22.0)) == 0
    assert len(continued_sides(near, far + np.array([[0.0], [1.0]]), 22.0)) == 0
    kept = continued_sides(near, far, 10.0)
    assert far[0, kept].max() <= near[0].min() + 10.0 + 1e-9
    assert 0 < len(kept) < far.shape[1]


@pytest.mark.parametrize(
    ("name", "behind", "category", "reaches_m"),
    [
        ("nothing behind", None, "bus", 12.0),
        ("a car a bit more than a gap behind it", standing(20.4, 3.9), "bus", 12.0),
        ("a car's box ends where a car does", None, "car", 8.4),
        ("a wall that is longer than vehicles are", standing(29.0, 4.25, 0.0, (24.0, 2.6, 3.0)), "bus", 8.4),
        ("a wall that goes on round the corner", standing(5.2, 9.15, 0.0, (0.4, 7.4, 3.0)), "bus", 8.4),
    ],
)
def test_the_points_of_a_long_vehicle_go_on_beyond_a_box_that_is_too_short(name, behind, category, reaches_m):
    """The bus is 12 m long and begins at 5 m; the box of the detector holds its first 8 m."""
    bus = standing(11.0, 4.2, 0.0, (12.0, 2.5, 3.0))
    world, owner = scan([bus, *([] if behind is None else [behind])], azimuth_deg=(0.0, 60.0), steps=(720, 48))
    box = Boxes3D(
        np.array([T0_NS]), np.array([[9.0, 4.0, 1.5]]), np.array([[8.0, 2.3, 3.0]]), np.zeros(1), np.full(1, 0.9),
        np.array([category]), np.full(1, 0.9), np.array([100]),
    )  # fmt: skip
    rows = measure([], box, cloud_of(world))
    found = rows.cluster[0][:, :3]
    assert (owners(found, world, owner) == 0).all(), name
    assert found[:, 0].max() - 5.0 == pytest.approx(reaches_m, abs=0.5), name
