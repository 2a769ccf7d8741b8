"""What the points of the LiDAR say about agents: rays that end in them, pass through or stop before, and long surfaces."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_plausibility_conflicts import agent, candidate
from worlds import rows_at

from log2sim.agents.candidate import Timeline
from log2sim.agents.evidence import (
    MIN_TENTATIVE_THERE,
    MIN_THERE,
    SIGNS,
    Recording,
    clutter_nats,
    continued,
    gather,
    may_suffice,
    remaining,
)
from log2sim.agents.judge import doubts_by_evidence, probabilities, suffices
from log2sim.agents.rays import Ending, classify_rays, count_rays
from log2sim.agents.size import static_geometry
from log2sim.datatypes import AgentTable, Obstacles, Rays, Track
from log2sim.datatypes.log_odds import log_odds_of
from log2sim.geometry import NS_PER_S

SENSOR = np.array([0.0, 0.0, 1.9])
CAR = (4.4, 1.8, 1.5)
ORIGIN = np.array([4e5, 5e6, 30.0])
TIMELINE = Timeline(np.arange(5) * NS_PER_S, 0)


def classify(start, end, yaw=0.0, size=CAR):
    """The ending of one ray about a box whose center is the origin."""
    start, end = np.array([start], dtype=float), np.array([end], dtype=float)
    return Ending(classify_rays(start, end - start, np.array([yaw]), np.array([size]))[0])


@pytest.mark.parametrize(
    ("end_x_m", "ending"),
    # The near side is at -2.2 m, the solid part starts 0.3 m behind it; the far side is at 2.2 m.
    [(-5.0, Ending.BEFORE), (-2.2, Ending.INSIDE), (0.0, Ending.INSIDE), (2.2, Ending.INSIDE), (8.0, Ending.THROUGH)],
)
def test_a_ray_ends_before_in_or_behind_a_box(end_x_m, ending) -> None:
    assert classify((-20.0, 0.0, -0.2), (end_x_m, 0.0, -0.2)) is ending


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
    counts = count_rays([over_map(built)], clouds(cloud), TIMELINE)
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


def test_what_is_likely_there_is_kept_and_a_strong_reason_is_a_doubt():
    assert suffices(MIN_THERE[True], confirmed=True, lidar=True)
    assert not suffices(MIN_THERE[True] - 0.01, confirmed=True, lidar=True)
    assert suffices(MIN_TENTATIVE_THERE, confirmed=False, lidar=True)
    assert not suffices(MIN_TENTATIVE_THERE - 0.01, confirmed=False, lidar=True)
    assert not suffices(0.9, confirmed=False, lidar=False)
    row = dict.fromkeys((*SIGNS, "pointless"), 0.0)
    assert doubts_by_evidence(agent(5.0), row, lidar=True) == []
    (doubt,) = doubts_by_evidence(agent(5.0), row | {"through": np.log(10)}, lidar=True)
    assert (doubt.kind, doubt.values["through_share"]) == ("empty", pytest.approx(0.9))


def person(score: float, in_sweeps: bool, way_m: float = 0.0) -> Track:
    found = rows_at(
        np.outer(np.linspace(0, way_m, 5), [1.0, 0.0]), "pedestrian", score=score, camera="" if in_sweeps else "front"
    )
    return Track(
        "pedestrian",
        np.arange(5),
        replace(found, t_ns=TIMELINE.t_ns, box_yaw_rad=np.full(5, 0.0 if in_sweeps else np.nan)),
    )


@pytest.mark.parametrize(
    ("way_m", "score", "in_sweeps", "may", "may_in_clutter", "confirmed"),
    [
        (0.0, 0.8, True, True, True, True), (0.0, 0.5, True, True, False, False), (1.5, 0.45, True, True, True, False),
        (1.5, 0.1, True, False, False, False), (0.0, 0.02, True, False, False, False), (8.0, 0.45, True, True, True, True),
        (8.0, 0.45, False, True, True, False), (8.0, 0.2, False, False, False, False),
    ],
)  # fmt: skip
def test_who_moves_on_is_confirmed_by_less_sure_boxes_of_sweeps(
    way_m, score, in_sweeps, may, may_in_clutter, confirmed
):
    track = person(score, in_sweeps, way_m)
    walking = agent(20.0, category="pedestrian", size=(0.6, 0.6, 1.7), speed=way_m / 4)
    seen = replace(candidate(walking), track=track, geometry=static_geometry(track))
    recording = Recording(False, [None] * 5, TIMELINE)
    assert gather([seen], recording)["confirmed"] == [confirmed]
    # Of few points what keeps its place before the sensor moves no more than what stays; more would stay behind if it did not move.
    # Poses drift by 1.5 m in 4 s.
    m = track.measurements
    for points, moves in ((3, False), (40, way_m > 1.5)):
        carried = replace(m, sensor_m=m.center_m - [20.0, 0.0, 0.0], points=np.full(5, points))
        table = gather([replace(seen, track=replace(track, measurements=carried))], recording)
        assert table["confirmed"] == [confirmed and (moves or way_m == 0 or not in_sweeps)]
        assert (table["travel"] > 0) == [moves]
    assert [may_suffice(track, static=way_m == 0, clutter=nats) for nats in (0.0, 3.0)] == [may, may_in_clutter]


def test_where_most_is_detected_weakly_the_weak_ones_are_clutter_and_the_sure_ones_stay_what_they_are():
    sure, weak = person(0.8, True), person(0.4, True)
    assert clutter_nats([]) == clutter_nats([sure] * 9) == clutter_nats([sure] * 30 + [weak] * 20) == 0
    # Of 100 weak ones some four are to be expected beside ten sure ones: one in twenty, where it is half of them elsewhere.
    assert clutter_nats([sure] * 10 + [weak] * 100) == pytest.approx(np.log(20), abs=0.3)
    nats = [clutter_nats([sure] * n + [weak] * 60) for n in range(0, 200, 5)]
    assert np.diff(nats).max() <= 0 < nats[0]
    # Sums of evidence, with and without.
    table = dict.fromkeys((*SIGNS, "bias"), np.array([1.0, 1.0])) | {"confirmed": np.array([1.0, 0.0])}
    before, after = (log_odds_of(probabilities(table, lidar=True, clutter=n)[0]) for n in (0.0, 1.5))
    assert before - after == pytest.approx([0.0, 1.5])


VAN, BACK, CORNER = (9.8, -3.0, 3.0, 2.5), (17.8, -0.9, 0.9, 1.5), (17.8, 0.4, 0.9, 1.5)


@pytest.mark.parametrize(
    ("thing", "points", "pointless", "through"),
    [
        # Images show a car where the LiDAR sees a van before it, or look past its corner once.
        (VAN, [0, 0, 0, 0, 0], True, 0.0),
        (VAN, [0, 0, 0, 30, 0], False, 0.0),
        # Of some rays that reach its place most go on.
        (CORNER, [0, 0, 0, 0, 0], True, -np.log(0.2)),
        # Its points are those of what stands beside it, but rays end in it.
        (BACK, [0, 0, 0, 0, 0], True, 0.0),
        (BACK, [9, 9, 9, 9, 9], False, 0.0),
    ],
)
def test_where_the_lidar_looks_an_object_has_points(thing, points, pointless, through):
    found = rows_at(np.array([[20.0, 0.0]] * 5) + ORIGIN[:2], "car", points=np.array(points), camera="front")
    found = replace(found, t_ns=TIMELINE.t_ns, sensor_m=np.tile(ORIGIN + SENSOR, (5, 1)))
    track = Track("car", np.arange(5), found)
    seen = replace(candidate(over_map(agent(20.0))), track=track, geometry=static_geometry(track))
    recording = Recording(False, clouds(fan(40.0, things=[thing])), TIMELINE)
    table = gather([seen], recording)
    assert set(SIGNS) <= set(table)
    assert np.isfinite(list(table.values())).all()
    assert table["pointless"] == pointless
    assert table["through"] == pytest.approx(through, abs=0.3)


@pytest.mark.parametrize(
    ("low_m", "high_m", "share"),
    # A side of a car ends with its box; one of a wall goes on at both ends, or at one and above.
    [((-2.2, 0.0), (2.2, 1.5), 0.0), ((-9.0, 0.0), (9.0, 1.5), 2 / 3), ((-2.2, 0.0), (9.0, 3.0), 2 / 3)],
)
def test_walls_go_on_beyond_a_box_and_vehicles_end(low_m, high_m, share):
    x, z = (a.ravel() for a in np.meshgrid(np.arange(low_m[0], high_m[0], 0.03), np.arange(low_m[1], high_m[1], 0.03)))
    side = np.column_stack([x, np.full(len(x), -0.9), z])
    yaw = 0.4
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    points = (side @ turn.T + [20.0, 0.0, 0.0]).astype(np.float32)
    cloud = Obstacles(0, ORIGIN, points, np.zeros(len(x), np.float32), SENSOR.astype(np.float32))
    boxes = AgentTable.of([over_map(agent(20.0, yaw=yaw))], TIMELINE.seconds(TIMELINE.t_ns))
    # Of its sides two ends, one side and the top have points.
    assert continued(boxes, [cloud] * 5) == pytest.approx([share * 3 / 4], abs=0.05)


@pytest.mark.parametrize(("wall", "speed", "share"), [(False, 1.0, 0.0), (True, 1.0, 1.0), (True, 0.2, 0.0)])
def test_what_stays_where_an_agent_left_is_no_mover(wall, speed, share):
    """A car of one side drives along x, or its box slides along a wall; as dense as a surface is at its distance."""
    car = over_map(agent(20.0, y_m=6.0, speed=speed))
    boxes, seen = AgentTable.of([car], TIMELINE.seconds(TIMELINE.t_ns)), []
    for tick, x_m in enumerate(boxes.center_m[0, :, 0] - ORIGIN[0]):
        low, high = (0.0, 60.0) if wall else (x_m - 2.2, x_m + 2.2)
        x, z = (a.ravel() for a in np.meshgrid(np.arange(low, high, 0.05), np.arange(0.1, 1.5, 0.05)))
        side = np.column_stack([x, np.full(len(x), 5.1), z]).astype(np.float32)
        seen.append(Obstacles(tick, ORIGIN, side, np.zeros(len(x), np.float32), SENSOR.astype(np.float32)))
    # At 0.2 m/s it stays within its place.
    assert remaining(boxes, seen) == pytest.approx([share], abs=0.1)
    assert remaining(boxes, [None] * 5) == [0.0]


@pytest.mark.parametrize(("wide_m", "thin"), [(0.7, 0.0), (0.15, np.log(0.7 / 0.2)), (np.nan, 0.0)])
def test_points_of_a_pole_are_thinner_than_a_person(wide_m, thin):
    half = np.full((5, 2), [wide_m / 2, wide_m / 4])
    found = rows_at(np.array([[20.0, 0.0]] * 5), "pedestrian", points=np.full(5, 9), low_m=-half, high_m=half)
    person = agent(20.0, category="pedestrian", size=(0.6, 0.6, 1.7))
    track = Track("pedestrian", np.arange(5), replace(found, t_ns=TIMELINE.t_ns))
    seen = replace(candidate(person), track=track, geometry=static_geometry(track))
    recording = Recording(False, [None] * 5, TIMELINE)
    assert gather([seen], recording)["thin"] == pytest.approx([thin], abs=0.05)
