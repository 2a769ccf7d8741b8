"""One size for every track and places measured against it: ray-cast tracks with exact truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from worlds import apart, measured_row, rows_at, scan, standing

from log2sim.agents.candidate import Timeline
from log2sim.agents.hypotheses import explain_track
from log2sim.agents.moving import moving_candidate
from log2sim.agents.size import ends_of, moving_geometry, static_geometry
from log2sim.datatypes import TYPICAL_SIZE_M, Measurements, OtherView, Track
from log2sim.geometry import rotation_from_rpy
from log2sim.perception.boxes import rotate

T0_NS = 1_700_000_000_000_000_000
STEP_NS = 100_000_000
CAR = (4.4, 1.85, 1.6)


def measured(states, size=CAR, category="car", *, sensors=None, noise_m=0.01, ends_visible=(True, True)):
    """A track over a box at the states (x, y, yaw), each measured from its sensor (3,) by the box fit."""
    rows = []
    for k, (x, y, yaw) in enumerate(states):
        sensor = np.array((0.0, 0.0, 1.9) if sensors is None else sensors[k])
        xyz, owner = scan(
            [standing(x - sensor[0], y - sensor[1], np.rad2deg(yaw), size)],
            azimuth_deg=(-180, 180), steps=(900, 32), noise_m=noise_m, seed=k,
        )  # fmt: skip
        cluster = xyz[(owner == 0) & (xyz[:, 2] > 0.2)] + [*sensor[:2], 0.0]
        row = measured_row(cluster, sensor, category, ends_visible=ends_visible, t_ns=T0_NS + k * STEP_NS)
        rows.append(replace(row, height_px_m=np.array([size[2]])))
    return Track(category, np.arange(len(rows)), Measurements.join(rows))


def bare(xy, category="car", step_s=0.1):
    """A track of measured centers without points."""
    t_ns = T0_NS + np.round(np.arange(len(xy)) * step_s * 1e9).astype(np.int64)
    return Track(category, np.arange(len(xy)), rows_at(xy, category, t_ns=t_ns))


def moved(track, shift, angle=0.0):
    """The same track in a map that is turned and shifted."""

    def go(p):
        return np.concatenate([rotate(p[..., :2], angle), p[..., 2:]], axis=-1) + shift

    m, r = track.measurements, rotation_from_rpy(0, 0, angle)[:2, :2]
    return replace(
        track,
        measurements=replace(
            m, center_m=go(m.center_m), sensor_m=go(m.sensor_m), cluster=tuple(go(c) for c in m.cluster),
            yaw_rad=m.yaw_rad + angle, covariance=r @ m.covariance @ r.T,
            bottom_m=m.bottom_m + shift[2], top_m=m.top_m + shift[2],
        ),
    )  # fmt: skip


PASSING = [(0.8 * k, 0.0, 1.9) for k in range(25)]  # the sensor drives past at 8 m/s


# Standing


def stands(track):
    (part,) = explain_track(track)
    return part.static


@pytest.mark.parametrize("category", ["car", "pedestrian", "cyclist"])
@pytest.mark.parametrize("jitter_m", [0.0, 0.1])
def test_what_stays_stands_and_what_goes_moves(category, jitter_m):
    rng = np.random.default_rng(3)
    xy = np.array([20.0, 3.0]) + rng.normal(0, jitter_m, (30, 2))
    assert stands(bare(xy, category))
    assert stands(bare(xy + np.array([5e5, 5e6]), category))
    for speed in (1.6, 8.0):
        along = np.outer(np.arange(30) * 0.1 * speed, [0.6, 0.8])
        assert not stands(bare(xy + along, category))


def test_of_two_sightings_a_vehicle_stands_and_a_person_walks():
    xy = [[20.0, 3.0], [20.0, 3.1]]
    assert stands(bare(xy, "car"))
    assert not stands(bare(xy, "pedestrian"))


@pytest.mark.parametrize(("x", "y", "yaw_deg"), [(12, 5, 0), (14, -5, 20), (10, 6, 95), (12, -4, 175)])
def test_a_parked_car_passed_by_is_found_with_its_size_and_yaw(x, y, yaw_deg):
    yaw = np.deg2rad(yaw_deg)
    shape = static_geometry(measured([(x, y, yaw)] * 25, sensors=PASSING))
    assert shape.is_likely
    # A hundredth of the points is cut at each end, and rays miss the very corners.
    np.testing.assert_allclose(shape.size_m, CAR, atol=0.2)
    assert apart(shape.yaw_rad, yaw, np.pi) < np.deg2rad(2)
    assert np.hypot(*(shape.xy_m - [x, y]).T).max() < 0.1
    np.testing.assert_array_equal(shape.xy_m, np.tile(shape.xy_m[0], (25, 1)))
    np.testing.assert_allclose(shape.z_m, 0.8, atol=0.1)
    error = shape.xy_m[0] - [x, y]
    assert error @ np.linalg.solve(shape.covariance[0], error) < 9.21


@pytest.mark.parametrize("size", [(3.7, 1.7, 1.5), (5.2, 2.0, 1.9)])
def test_sizes_that_are_seen_whole_are_kept_and_not_typical_ones(size):
    shape = static_geometry(measured([(10, 5, 0.1)] * 25, size, sensors=PASSING))
    np.testing.assert_allclose(shape.size_m, size, atol=0.2)


def test_a_size_that_is_not_seen_is_the_typical_one():
    behind = [(0.0, 0.0, 0.9)] * 12
    shape = static_geometry(measured([(12, 0, 0.0)] * 12, sensors=behind))
    # Corners are sharp in this world, so that the car seems 3 % wider than the typical one, and is taken to be as much longer.
    assert shape.size_m[0] == pytest.approx(TYPICAL_SIZE_M["car"][0], abs=0.15)
    assert apart(shape.yaw_rad, 0.0, np.pi) < np.deg2rad(3)
    assert np.sqrt(shape.covariance[0, 0, 0]) > 3 * np.sqrt(shape.covariance[0, 1, 1])


@pytest.mark.parametrize(("shift", "angle"), [((5e5, 5e6, 0.0), 0.0), ((-30.0, 8.0, 0.0), 1.3), ((0, 0, 0), -2.4)])
def test_shapes_move_and_turn_with_the_map(shift, angle):
    track = measured([(12, 5, 0.3)] * 15, sensors=PASSING[:15])
    here, there = static_geometry(track), static_geometry(moved(track, np.array(shift), angle))
    # Cells that tell persistent points from stray ones lie fixed in the map.
    np.testing.assert_allclose(there.size_m, here.size_m, atol=0.08)
    np.testing.assert_allclose(there.xy_m, rotate(here.xy_m, angle) + shift[:2], atol=0.08)
    assert apart(there.yaw_rad, here.yaw_rad + angle, np.pi) < np.deg2rad(1.5)
    track, yaw = measured(oncoming(12)), np.full(12, np.pi)
    here, there = moving_geometry(track, yaw), moving_geometry(moved(track, np.array(shift), angle), yaw + angle)
    np.testing.assert_allclose(there.size_m, here.size_m, atol=1e-4)
    np.testing.assert_allclose(there.xy_m, rotate(here.xy_m, angle) + shift[:2], atol=1e-4)
    r = rotation_from_rpy(0, 0, angle)[:2, :2]
    np.testing.assert_allclose(there.covariance, r @ here.covariance @ r.T, atol=1e-4)


def test_points_that_one_tick_lent_from_a_neighbor_are_left_out():
    track = measured([(12, 5, 0.0)] * 15, sensors=PASSING[:15])
    m = track.measurements
    stray = np.array([16.0, 5.0, 0.5]) + np.random.default_rng(0).normal(0, 0.3, (60, 3))
    mixed = replace(track, measurements=replace(m, cluster=(np.vstack([m.cluster[0], stray]), *m.cluster[1:])))
    np.testing.assert_allclose(static_geometry(mixed).size_m, static_geometry(track).size_m, atol=0.1)
    np.testing.assert_allclose(static_geometry(mixed).xy_m, static_geometry(track).xy_m, atol=0.1)


def test_a_standing_box_lies_where_its_points_are_though_every_tick_was_off():
    track = measured([(12, 5, 0.0)] * 15, sensors=PASSING[:15])
    off = track.measurements.center_m + np.array([0.5, -0.4, 0.0])
    shape = static_geometry(replace(track, measurements=replace(track.measurements, center_m=off)))
    assert np.hypot(*(shape.xy_m - [12, 5]).T).max() < 0.1


# Moving


@pytest.mark.parametrize(
    ("category", "side_m", "likely"),
    [
        ("pedestrian", (0.3, 0.25), True),
        ("pedestrian", (0.12, 0.12), False),
        ("cyclist", (1.7, 0.4), True),  # from behind
        ("cyclist", (0.12, 0.12), False),
    ],
)
def test_a_narrow_body_may_be_a_person_and_a_post_is_not(category, side_m, likely):
    track = measured([(8.0, 0.0, 0.0)] * 4, (*side_m, 1.7), category)
    assert static_geometry(track).is_likely == likely
    assert moving_geometry(track, np.zeros(4)).is_likely == likely


def oncoming(count=25, speed=8.0, y=4.0, heading=np.pi, start_m=30.0):
    direction = np.array([np.cos(heading), np.sin(heading)])
    start = np.array([start_m, y]) if heading else np.array([8.0, y])
    xy = start + np.outer(np.arange(count) * 0.1 * speed, direction)
    return [(x, y_, heading) for x, y_ in xy]


@pytest.mark.parametrize("heading", [0.0, np.pi])
def test_a_moving_car_keeps_one_size_and_is_found_within_its_sigma(heading):
    states = oncoming(heading=heading)
    track = measured(states)
    shape = moving_geometry(track, np.full(len(states), heading))
    truth = np.array(states)[:, :2]
    # The corners of this world are sharp, those that are allowed for are round.
    np.testing.assert_allclose(shape.size_m, CAR, atol=0.25)
    error = shape.xy_m - truth
    assert np.hypot(*error.T).max() < 0.3
    assert np.median(np.einsum("ni,nij,nj->n", error, np.linalg.inv(shape.covariance), error)) < 1.4
    assert shape.xy_m.shape == (25, 2)
    assert shape.yaw_rad is None


def test_a_long_car_seen_whole_once_is_long_all_along():
    size = (5.4, 1.9, 1.6)
    states = oncoming(start_m=15.0)
    shape = moving_geometry(measured(states, size), np.full(len(states), np.pi))
    assert shape.size_m[0] == pytest.approx(5.4, abs=0.25)
    assert np.hypot(*(shape.xy_m - np.array(states)[:, :2]).T).max() < 0.35


@pytest.mark.parametrize(
    ("size", "box", "seen_share"),
    [
        ((5.4, 1.9, 1.6), (5.2, 1.9, 1.6), 0.6),
        ((5.4, 1.9, 1.6), (4.6, 1.8, 1.6), 1.0),
        ((3.4, 1.65, 1.5), (4.4, 1.85, 1.5), 1.0),
    ],
)
def test_a_low_hood_that_no_ray_meets_does_not_make_a_long_car_short(size, box, seen_share):
    states = oncoming(start_m=15.0)
    track, yaw = measured(states, size), np.full(len(states), np.pi)
    rear_m = np.array(states)[:, 0] + size[0] / 2
    rows = []
    for k, (x, y, _) in enumerate(states):
        cluster = track.measurements.cluster[k]
        behind = cluster[cluster[:, 0] > rear_m[k] - seen_share * size[0]]
        row = measured_row(behind, ends_visible=(True, True), t_ns=T0_NS + k * STEP_NS)
        rows.append(
            replace(
                row, box_size_m=np.array([box]), box_yaw_rad=np.array([np.pi]), box_center_m=np.array([[x, y, 0.8]])
            )
        )
    shape = moving_geometry(replace(track, measurements=Measurements.join(rows)), yaw)
    # What is seen of the first is off by 2.2 m, the detector at the others by 0.8 and 1.0 m.
    assert shape.size_m[0] == pytest.approx(size[0], abs=0.5)


@pytest.mark.parametrize(
    ("category", "size", "share"),
    [("cyclist", (1.75, 0.65, 1.7), 0.5), ("pedestrian", (0.4, 0.6, 1.7), 0.5), ("car", CAR, 1.0)],
)
def test_of_a_length_that_is_not_seen_boxes_of_riders_and_people_tell_half_and_others_all(category, size, share):
    typical = TYPICAL_SIZE_M[category][0]
    box = (0.8 * typical, *TYPICAL_SIZE_M[category][1:])
    track = measured([(12, 0, 0.0)] * 12, size, category, sensors=[(0.0, 0.0, 0.9)] * 12)
    boxes = replace(
        track.measurements, box_size_m=np.tile(box, (12, 1)), box_yaw_rad=np.zeros(12),
        box_center_m=np.tile([12.0, 0.0, 0.8], (12, 1)),
    )  # fmt: skip
    length_m = moving_geometry(replace(track, measurements=boxes), np.zeros(12)).size_m[0]
    assert length_m == pytest.approx(box[0] ** share * typical ** (1 - share), rel=0.05)


def test_a_person_who_sways_is_not_as_long_as_the_way_of_the_points():
    sway_m = 0.2 * np.sin(np.arange(15))
    states = [(12 + sway, 5, 0.0) for sway in sway_m.tolist()]
    shape = static_geometry(measured(states, (0.5, 0.6, 1.7), "pedestrian", sensors=PASSING[:15]))
    # The points reach over .9 m.
    assert shape.size_m[:2] == pytest.approx([0.5, 0.6], abs=0.3)


def test_what_goes_on_beyond_its_ends_is_less_sure_and_tells_no_size():
    states = oncoming(start_m=15.0)
    yaw = np.full(len(states), np.pi)
    whole = moving_geometry(measured(states, (3.6, 1.7, 1.5)), yaw)
    cut = moving_geometry(measured(states, (3.6, 1.7, 1.5), ends_visible=(False, False)), yaw)
    # The corners of this world are sharp, those that are allowed for are round.
    assert whole.size_m[0] == pytest.approx(3.6, abs=0.25)
    assert cut.size_m[0] == pytest.approx(TYPICAL_SIZE_M["car"][0], abs=0.05)
    assert (np.trace(cut.covariance, axis1=1, axis2=2) > np.trace(whole.covariance, axis1=1, axis2=2)).all()


def swept(speed_mps, size=(12.5, 2.55, 3.6), start=(-9.0, 4.0), ticks=20):
    """A track of a truck that drives along x past a sensor at rest; every point was measured at its own time."""
    rows, turn_s = [], 0.1
    for k in range(ticks):
        x = start[0] + speed_mps * 0.1 * k
        columns = []
        for azimuth in np.arange(450):
            late_s = azimuth / 450 * turn_s
            ahead = speed_mps * late_s
            columns.append((late_s, x + ahead, -180.0 + azimuth * 0.8))
        cloud = []
        for late_s, at, azimuth_deg in columns:
            if abs(np.rad2deg(np.arctan2(start[1], at)) - azimuth_deg) > 110.0:
                continue
            xyz, owner = scan(
                [standing(at, start[1], 0.0, size)], azimuth_deg=(azimuth_deg, azimuth_deg), steps=(1, 16)
            )
            hit = xyz[(owner == 0) & (xyz[:, 2] > 0.2)]
            cloud.append(np.column_stack([hit, np.full(len(hit), late_s)]))
        cluster = np.concatenate(cloud)
        mean_s = float(cluster[:, 3].mean())
        cluster[:, 3] -= mean_s
        t_ns = T0_NS + k * STEP_NS + round(mean_s * 1e9)
        row = measured_row(cluster[:, :3], (0.0, 0.0, 1.9), "truck", ends_visible=(True, True), t_ns=t_ns)
        rows.append((replace(row, cluster=(cluster,)), x + speed_mps * mean_s))
    truth = np.array([[x, start[1]] for _, x in rows])
    return Track("truck", np.arange(ticks), Measurements.join([row for row, _ in rows])), truth


@pytest.mark.parametrize("speed_mps", [10.0, 30.0])
def test_at_30_mps_a_truck_is_where_it_is_at_rest_since_its_points_carry_their_times(speed_mps):
    ticks = 7
    track, truth = swept(speed_mps, ticks=ticks)
    velocity = np.tile([speed_mps, 0.0], (ticks, 1))
    shape = moving_geometry(track, np.zeros(ticks), velocity)
    smeared = moving_geometry(track, np.zeros(ticks))
    error = np.abs(shape.xy_m - truth)[:, 0]
    assert np.median(error) < 0.1
    assert shape.size_m[0] == pytest.approx(12.5, abs=0.25)
    assert np.abs(smeared.xy_m - truth)[:, 0].max() > (0.3 if speed_mps == 30.0 else 0.0)
    assert error.max() < 0.2


def test_ends_of_many_measurements_are_those_of_each_alone_from_two_viewpoints_too() -> None:
    states = [(9.0 + 0.3 * k, 4.0, 0.1) for k in range(6)]
    track = measured(states, sensors=[(0.0, 0.0, 1.9)] * 6)
    behind = measured(states, sensors=[(30.0, 0.0, 1.9)] * 6).measurements
    others = tuple(OtherView(behind.sensor_m[k], behind.ends_visible[k], behind.cluster[k]) for k in range(6))
    # Two of the measurements have one viewpoint only.
    both = replace(track.measurements, others=tuple(None if k in (1, 4) else view for k, view in enumerate(others)))
    track_of_both = replace(track, measurements=both)
    rows, yaw, velocity = np.array([0, 1, 3, 4, 5]), np.full(5, 0.1), np.tile([3.0, 0.0], (5, 1))
    together = ends_of(track_of_both, rows, yaw, velocity)
    one = ends_of(track, rows, yaw, velocity)
    for k in range(5):
        alone = ends_of(track_of_both, rows[k : k + 1], yaw[:1], velocity[:1])
        for name in ("low", "high", "real", "gap_m"):
            np.testing.assert_array_equal(getattr(together, name)[k], getattr(alone, name)[0])
    # From behind, its rear end faces the sensor; from ahead, its front does.
    assert (one.real[:, 0] > 0).tolist() != (together.real[:, 0] > 0).tolist()
    assert together.real[[0, 2, 4], 0].tolist() == [[2, 2]] * 3
    np.testing.assert_array_equal(together.real[[1, 3]], one.real[[1, 3]])
    np.testing.assert_allclose((together.high - together.low)[[0, 2, 4], 0], CAR[0], atol=0.1)


def test_a_slow_truck_is_laid_along_its_sides_not_along_a_way_that_errors_bend():
    truck, count = (10.5, 2.4, 3.5), 20
    track = measured([(9.0 + 0.2 * k, 6.0, 0.0) for k in range(count)], truck, "truck")
    m, aside = track.measurements, 0.4 * np.sin(np.linspace(-1.5, 1.5, count))
    boxes = {
        "box_center_m": np.column_stack([9.0 + 0.2 * np.arange(count), 6.0 + aside, np.full(count, 1.75)]),
        "box_size_m": np.tile(truck, (count, 1)),
        "box_yaw_rad": np.zeros(count),
    }
    rows = replace(m, **boxes, center_m=np.column_stack([boxes["box_center_m"][:, :2], m.center_m[:, 2]]))
    timeline = Timeline(T0_NS + np.arange(count) * STEP_NS, T0_NS)
    w = moving_candidate(replace(track, measurements=rows), [None] * count, timeline, smooth=True).agent.waypoints
    assert np.abs(w.y_m - 6.0).max() < 0.15
    assert apart(w.yaw_rad, 0.0, np.pi).max() < np.deg2rad(4)


@pytest.mark.parametrize("heading", [0.0, 0.8])
def test_a_bus_that_leaves_the_view_goes_on_though_boxes_take_its_flank_for_an_end(heading):
    bus, count, step_m = (11.0, 2.5, 3.1), 20, 0.7
    along = np.array([np.cos(heading), np.sin(heading)])
    aside = np.array([-along[1], along[0]])
    xy = (-8.0 + step_m * np.arange(count))[:, None] * along + 4.0 * aside
    m = measured([(*place, heading) for place in xy.tolist()], bus, "bus").measurements
    z = np.full(count, 1.55)
    columns = {
        "center_m": np.column_stack([xy, z]), "box_center_m": np.column_stack([xy, z]),
        "box_size_m": np.tile(bus, (count, 1)), "box_yaw_rad": np.full(count, heading),
    }  # fmt: skip
    for k in range(count - 4, count):  # two meters of the flank are left, which a box stands behind
        turned = np.append(xy[k] - 4.5 * along + 4.3 * aside, 1.55)
        columns["center_m"][k] = columns["box_center_m"][k] = turned
        columns["box_yaw_rad"][k] += np.pi / 2
    clusters = tuple(
        points if k < count - 4 else points[(points[:, :2] - xy[k]) @ along < -3.5]
        for k, points in enumerate(m.cluster)
    )
    track = Track("bus", np.arange(count), replace(m, **columns, cluster=(*clusters[:-1], clusters[-1][:0])))
    timeline = Timeline(T0_NS + np.arange(count) * STEP_NS, T0_NS)
    found = moving_candidate(track, [None] * count, timeline, smooth=True)
    assert np.isfinite(found.geometry.xy_m).all()
    w = found.agent.waypoints
    assert np.abs((np.column_stack([w.x_m, w.y_m]) - xy) @ aside).max() < 0.4
    assert apart(w.yaw_rad, heading, np.pi).max() < np.deg2rad(5)
