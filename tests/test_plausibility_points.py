"""What the points of the LiDAR say about agents: rays that end in them, pass through or stop before, and long surfaces."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_overlap import agent, candidate
from worlds import rows_at

from log2sim.agents.candidate import Support, Timeline
from log2sim.agents.evidence import (
    Ending,
    Recording,
    classify_rays,
    count_rays,
    doubt_size,
    find_surface,
    image_height_share,
    shown_in_images,
    structure_shares,
    weigh,
)
from log2sim.agents.judge import contradict, is_refuted, missing_nats, usual_detection_rate
from log2sim.datatypes import AgentTable, Detections, Log, Measurements, Obstacles, Rays, Stream, Track
from log2sim.geometry import NS_PER_S, Camera, transform
from log2sim.perception.sync import Schedule

SENSOR = np.array([0.0, 0.0, 1.9])
CAR = (4.4, 1.8, 1.5)
ORIGIN = np.array([4e5, 5e6, 30.0])
TIMELINE = Timeline(np.arange(5) * NS_PER_S, 0)


def classify(start, end, yaw=0.0, size=CAR):
    """The ending of one ray about a box whose center is the origin."""
    start, end = np.array([start], dtype=float), np.array([end], dtype=float)
    return Ending(classify_rays(start, end - start, np.array([yaw]), np.array([size]))[0][0])


@pytest.mark.parametrize(
    ("end_x_m", "ending"),
    # The near side is at -2.2 m, the solid part starts 0.3 m behind it; the far side is at 2.2 m.
    [(-5.0, Ending.BEFORE), (-2.2, Ending.INSIDE), (0.0, Ending.INSIDE), (2.2, Ending.INSIDE), (8.0, Ending.THROUGH)],
)
def test_a_ray_ends_before_in_or_behind_a_box(end_x_m, ending) -> None:
    assert classify((-20.0, 0.0, -0.2), (end_x_m, 0.0, -0.2)) is ending


def test_rays_over_under_beside_and_through_windows_do_not_count() -> None:
    # The solid part is from 25 to 55 % of 1.5 m, so from -0.375 to 0.075 m about the center.
    for z in (-0.45, 0.15, 0.7):
        assert classify((-20.0, 0.0, z), (8.0, 0.0, z)) is Ending.ELSEWHERE
    assert classify((-20.0, 0.8, -0.2), (8.0, 0.8, -0.2)) is Ending.ELSEWHERE
    assert classify((20.0, 0.0, -0.2), (30.0, 0.0, -0.2)) is Ending.ELSEWHERE


def test_endings_turn_and_shift_with_the_box() -> None:
    rng = np.random.default_rng(2)
    start, to = rng.uniform(-12, 12, (4000, 3)) * [1, 1, 0.1], rng.uniform(-20, 20, (4000, 3)) * [1, 1, 0.02]
    size, yaw = np.tile(CAR, (4000, 1)), rng.uniform(-3, 3, 4000)
    (at_zero,) = classify_rays(start, to, np.zeros(4000), size)
    c, s = np.cos(yaw), np.sin(yaw)
    turned = [np.column_stack([c * v[:, 0] - s * v[:, 1], s * v[:, 0] + c * v[:, 1], v[:, 2]]) for v in (start, to)]
    assert np.array_equal(classify_rays(*turned, yaw, size)[0], at_zero)
    assert {Ending.INSIDE, Ending.THROUGH, Ending.BEFORE, Ending.ELSEWHERE} == set(at_zero)


def fan(wall_x_m, *, things=(), t_s=0.0):
    """Rays every 0.5 degrees from `SENSOR` to upright rectangles at x with y from and to, else a wall, else the flat ground."""
    azimuth, slope = (np.deg2rad(a).ravel() for a in np.meshgrid(np.arange(-60, 60.1, 0.5), np.arange(-15, 2.1, 0.5)))
    slope = np.tan(slope)
    reach = np.full(len(azimuth), wall_x_m) / np.cos(azimuth)
    reach = np.where(slope < 0, np.minimum(reach, SENSOR[2] / np.maximum(-slope, 1e-9)), reach)
    for x, y0, y1, top in things:
        at = x / np.cos(azimuth)
        y, z = at * np.sin(azimuth), SENSOR[2] + slope * at
        reach = np.where((y > y0) & (y < y1) & (z > 0) & (z < top) & (at < reach), at, reach)
    end = np.column_stack([reach * np.cos(azimuth), reach * np.sin(azimuth), SENSOR[2] + slope * reach])
    n = len(end)
    rays = Rays(
        end.astype(np.float32), np.full(n, t_s, np.float32), np.zeros(n, np.uint8),
        SENSOR[None].astype(np.float32), np.zeros((1, 3), np.float32),
    )  # fmt: skip
    return Obstacles(0, ORIGIN, end[:0].astype(np.float32), rays.t_s[:0], SENSOR.astype(np.float32), rays)


def over_map(built):
    w = built.waypoints
    return replace(built, waypoints=replace(w, x_m=w.x_m + ORIGIN[0], y_m=w.y_m + ORIGIN[1], z_m=w.z_m * 0 + 30.75))


def clouds(cloud):
    return [replace(cloud, stamp_ns=int(t)) for t in TIMELINE.t_ns]


def counted(built, cloud):
    counts, _ = count_rays([over_map(built)], clouds(cloud), TIMELINE)
    return [int(v.sum()) // 5 for v in counts]


def test_rays_that_go_on_to_ground_and_wall_behind_say_that_a_place_is_empty() -> None:
    inside, through, before = counted(agent(12.0), fan(40.0))
    assert (inside, before) == (0, 0)
    # They descend by 5.5 to 7 degrees from 1.9 m to 0.4 and 0.8 m, over 5 degrees of azimuth: 3 times 10 rays.
    assert through >= 20


def test_rays_that_end_at_the_back_of_a_car_support_it() -> None:
    inside, through, before = counted(agent(12.0), fan(40.0, things=[(9.8, -0.9, 0.9, 1.5)]))
    assert inside >= 20
    assert (through, before) == (0, 0)


def test_rays_that_end_at_a_van_in_front_say_nothing() -> None:
    inside, through, before = counted(agent(20.0), fan(40.0, things=[(9.8, -3.0, 3.0, 2.5)]))
    assert (inside, through) == (0, 0)
    assert before > 10


def test_a_box_behind_the_sensor_is_seen_across_the_seam_of_the_azimuths() -> None:
    ahead = fan(40.0)
    turned = replace(ahead, free=replace(ahead.free, end=ahead.free.end * np.array([-1, -1, 1], np.float32)))
    inside, through, before = counted(agent(-12.0), turned)
    assert (inside, before) == (0, 0)
    # Half of them are on either side of the seam.
    assert through > 0.6 * counted(agent(12.0), ahead)[1]


def test_moving_agents_are_where_they_are_at_the_time_of_a_ray() -> None:
    # At 20 m/s the car is 2 m farther 0.1 s after the stamp of the cloud.
    drives = over_map(replace(agent(10.0), waypoints=agent(10.0, speed=20.0).waypoints))
    late = fan(60.0, things=[(9.8, -0.9, 0.9, 1.5)], t_s=0.1)
    counts, _ = count_rays([drives], [late, None, None, None, None], TIMELINE)
    assert counts[0, 0, 0] >= 5
    assert counts[1, 0, 0] == 0


@pytest.mark.parametrize(
    ("category", "share", "doubted"), [("car", 0.2, 0), ("car", 0.45, 1), ("cyclist", 0.45, 0), ("cyclist", 0.9, 1)]
)
def test_doubt_begins_where_no_true_agent_is(category, share, doubted) -> None:
    support = Support(inside=round(1000 * (1 - share)), through=round(1000 * share), seen_ticks=9)
    judged = replace(candidate(agent(5.0, category=category)), support=support)
    assert len(contradict(judged, 0.9)) == doubted


def test_an_agent_through_whose_place_nearly_all_rays_pass_is_refuted() -> None:
    support = Support(inside=10, through=90, seen_ticks=9)
    assert is_refuted(replace(candidate(agent(5.0)), support=support), 0.9)
    # The rays of two ticks, or few ones, may be chance; a box that is too large has something in it.
    for other in ({"seen_ticks": 2}, {"inside": 1, "through": 9}, {"inside": 40}):
        assert not is_refuted(replace(candidate(agent(5.0)), support=replace(support, **other)), 0.9)


def face(length_m, y_m=-0.9, x_m=0.0, step_m=0.1):
    """Points along a surface of a length about x, three high."""
    x = np.arange(-length_m / 2, length_m / 2, step_m) + x_m
    return np.column_stack([np.tile(x, 3), np.full(3 * len(x), y_m)])


BELOW = np.array([0.0, -10.0])


def test_the_side_of_a_car_is_as_long_as_the_car_and_that_of_a_wall_longer() -> None:
    size = np.array(CAR[:2])
    assert find_surface(face(4.4), size, BELOW).length_m == pytest.approx(4.4, abs=0.3)
    assert find_surface(face(12.0), size, BELOW).length_m == pytest.approx(12.0, abs=0.3)
    # At 8 degrees to the box.
    c, s = np.cos(0.14), np.sin(0.14)
    turned = (face(12.0, y_m=0.0) @ np.array([[c, s], [-s, c]])) + [0, -0.7]
    assert find_surface(turned, size, BELOW).length_m == pytest.approx(12.0 * c, abs=0.5)


def test_a_row_of_parked_cars_is_no_wall() -> None:
    row = np.concatenate([face(4.4, x_m=x) for x in (-5.2, 0.0, 5.2)])
    assert find_surface(row, np.array(CAR[:2]), BELOW).length_m < 5.0


def test_two_sides_of_a_car_are_not_one_surface() -> None:
    side, back = face(4.4), face(1.8)[:, ::-1] + [-1.3, 0.0]
    corner = np.concatenate([side, back, back])
    assert find_surface(corner, np.array(CAR[:2]), BELOW).share < 0.75


@pytest.mark.parametrize(("length_m", "share"), [(4.4, 0.0), (5.9, 0.0), (12.0, 1.0)])
def test_a_car_on_the_face_of_a_wall_is_in_a_structure(length_m, share) -> None:
    xy = face(length_m, x_m=10.0, y_m=5.0 - 0.9)
    xyz = np.column_stack([xy, np.repeat([0.4, 0.8, 1.2], len(xy) // 3)]).astype(np.float32)
    cloud = Obstacles(0, ORIGIN, xyz, np.zeros(len(xyz), np.float32), SENSOR.astype(np.float32))
    built = [over_map(agent(10.0, 5.0)), over_map(agent(10.0, 5.0, category="pedestrian"))]
    in_structure, beside = structure_shares(built, clouds(cloud), TIMELINE)
    assert in_structure.tolist() == beside.tolist() == [share, 0.0]
    assert is_refuted(replace(candidate(built[0]), support=Support(in_structure=share)), 0.9) is bool(share)


def with_support(**figures):
    return replace(candidate(agent(5.0)), support=Support(**figures))


@pytest.mark.parametrize(("detected", "doubted"), [(40, 0), (20, 0), (12, 1), (5, 1)])
def test_an_agent_that_is_seldom_detected_where_images_show_it_well_is_doubted(detected, doubted):
    judged = with_support(shown_ticks=40, detected_ticks=detected, image_ticks=detected)
    assert [d.flag for d in contradict(judged, 0.9)] == ["hardly_observed"] * doubted
    # The odds of 5 are 31 to 1, those of 12 are 4 to 1.
    assert is_refuted(judged, 0.9) is (detected == 5)


@pytest.mark.parametrize(("in_images", "doubted"), [(12, 0), (0, 1)])
def test_what_sweeps_alone_show_where_images_show_the_place_well_is_doubted(in_images, doubted):
    judged = with_support(shown_ticks=40, detected_ticks=40, image_ticks=in_images)
    assert [d.flag for d in contradict(judged, 0.9)] == ["hardly_observed"] * doubted
    assert not is_refuted(judged, 0.9)


def test_the_evidence_of_missing_detections_is_a_ratio_of_likelihoods():
    # 10 of 40 at a rate of 0.9 against 0.05; forty ticks that err alike count as 40 / (1 + 39 / 2) independent ones.
    mean = 0.25 * np.log(0.05 / 0.9) + 0.75 * np.log(0.95 / 0.1)
    assert missing_nats(Support(shown_ticks=40, detected_ticks=10), 0.9) == pytest.approx(mean * 40 / 20.5)
    # A detector that finds half of all misses more, so that missing says less.
    assert missing_nats(Support(shown_ticks=40, detected_ticks=10), 0.5) < 0
    assert missing_nats(Support(shown_ticks=3, detected_ticks=0), 0.9) == 0
    assert missing_nats(Support(shown_ticks=40, detected_ticks=0), 0.0) == 0


def test_missing_detections_and_a_surface_that_goes_on_refute_together():
    seldom = {"shown_ticks": 40, "detected_ticks": 9}
    assert not is_refuted(with_support(**seldom), 0.9)
    assert not is_refuted(with_support(beside_structure=1.0), 0.9)
    assert is_refuted(with_support(**seldom, beside_structure=1.0), 0.9)


def test_what_no_ray_reaches_is_refuted_and_what_has_no_point_doubted():
    assert is_refuted(with_support(unreached=True), 0.9)
    (doubt,) = contradict(with_support(pointless=True), 0.9)
    assert doubt.flag == "hardly_observed"


VAN, BACK, CORNER = (9.8, -3.0, 3.0, 2.5), (17.8, -0.9, 0.9, 1.5), (17.8, 0.4, 0.9, 1.5)


@pytest.mark.parametrize(
    ("thing", "points", "pointless", "unreached"),
    [
        # Images show a car where the LiDAR sees a van before it, or look past its corner once.
        (VAN, [0, 0, 0, 0, 0], True, True),
        (VAN, [0, 0, 0, 30, 0], False, False),
        # Of some rays that reach its place most go on.
        (CORNER, [0, 0, 0, 0, 0], True, True),
        # Its points are those of what stands beside it, but rays end in it.
        (BACK, [0, 0, 0, 0, 0], True, False),
        (BACK, [9, 9, 9, 9, 9], False, False),
    ],
)
def test_where_the_lidar_looks_an_object_has_points(thing, points, pointless, unreached):
    car = over_map(agent(20.0))
    found = rows_at(np.array([[20.0, 0.0]] * 5) + ORIGIN[:2], "car", points=np.array(points), camera="front")
    found = replace(found, t_ns=TIMELINE.t_ns, sensor_m=np.tile(ORIGIN + SENSOR, (5, 1)))
    seen = replace(candidate(car), track=Track("car", np.arange(5), found))
    recording = Recording(
        Log("one", "none", {}, {}, {}),
        Schedule("front", TIMELINE.t_ns, {}, {}, {}),
        clouds(fan(40.0, things=[thing])),
        TIMELINE,
    )
    (weighed,) = weigh([seen], recording)
    assert (weighed.support.pointless, weighed.support.unreached) == (pointless, unreached)
    assert is_refuted(weighed, 0.9) is unreached


@pytest.mark.parametrize(("box_m", "share", "refuted"), [(1.4, 1.0, False), (0.9, 0.643, False), (0.5, 0.357, True)])
def test_points_that_are_twice_as_high_as_the_image_box_are_not_those_of_the_object(box_m, share, refuted):
    found = Detections(np.zeros((4, 4)), np.ones(4), np.array(["car"] * 4))
    m = replace(
        Measurements.unplaced(found, t_ns=0, camera="front", sensor_m=np.zeros(3)),
        points=np.full(4, 9), height_px_m=np.array([box_m, box_m, box_m, 9.0]), bottom_m=np.zeros(4), top_m=np.full(4, 1.4),
        truncated=np.array([False, False, False, True]),
    )  # fmt: skip
    found_share = image_height_share(m)
    assert found_share == pytest.approx(share, abs=1e-3)
    assert is_refuted(with_support(image_height_share=found_share), 0.9) is refuted
    assert image_height_share(m.take([0, 1, 3])) is None


def test_the_usual_rate_is_that_of_all_candidates():
    supports = [Support(shown_ticks=30, detected_ticks=30), Support(shown_ticks=10, detected_ticks=2), Support()]
    assert usual_detection_rate([replace(candidate(agent(5.0)), support=s) for s in supports]) == 0.8
    assert usual_detection_rate([]) == 0.0


@pytest.mark.parametrize(
    ("category", "size", "doubted"),
    [("car", (4.5, 1.9, 1.6), 0), ("car", (6.0, 2.3, 2.8), 1), ("truck", (7.0, 2.7, 3.0), 0), ("truck", (7.0, 2.8, 3.0), 1),
     ("other", (12.0, 3.0, 4.0), 0)],
)  # fmt: skip
def test_no_vehicle_is_wider_than_the_road_allows_or_longer_than_its_kind(category, size, doubted):
    assert [d.flag for d in doubt_size(agent(5.0, category=category, size=size))] == ["unlikely_size"] * doubted


AHEAD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
"""Axes of a camera that looks along x."""


@pytest.mark.parametrize(
    ("x_m", "y_m", "shown"),
    # f is 500 px: 1.5 m are 32 px at 23.4 m, and half of 1000 px less the border end 0.9 m aside for each meter ahead.
    [
        (10.0, 0.0, True),
        (23.0, 0.0, True),
        (24.0, 0.0, False),
        (10.0, 8.9, True),
        (10.0, 9.1, False),
        (-10.0, 0.0, False),
    ],
)
def test_an_image_shows_what_is_large_and_inside_of_its_borders(x_m, y_m, shown):
    for camera_x_m, seen in ((0.0, shown), (-3.5, False)):
        pose = transform(AHEAD, ORIGIN + np.array([camera_x_m, 0, 1.9]))
        camera = Camera(
            "front", 1000, 600, np.array([[500.0, 0, 500], [0, 500, 300], [0, 0, 1]]), mount="map", mount_T_cam=pose
        )
        log = Log("one", "none", {"front": camera}, {}, {"front": Stream("front", TIMELINE.t_ns, lambda _: None)})
        frames = np.array([0, 1, 2, 3, -1])
        schedule = Schedule("front", TIMELINE.t_ns, {"front": frames}, {}, {})
        recording = Recording(log, schedule, clouds(fan(40.0)), TIMELINE)
        boxes = AgentTable.of([over_map(agent(x_m, y_m))], recording.t_s)
        assert shown_in_images(boxes, recording)[0].tolist() == [seen] * 4 + [False]
