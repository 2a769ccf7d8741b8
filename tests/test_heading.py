"""Which end is the front: small worlds of a street with traffic on either side, a car park, a side street, a lone car."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from fits import outline as fit_outline
from hypothesis import given, settings
from hypothesis import strategies as st
from test_size import bare
from worlds import rows_at, waypoints

from log2sim.agents import heading
from log2sim.agents.candidate import Timeline, candidate_of
from log2sim.agents.heading import (
    ALIKE_ACROSS,
    ALIKE_ALONG,
    MEETING_LOG_ODDS,
    USUALLY_RIGHT,
    decide_headings,
    find_rows,
    headings_of,
    side_log_odds,
    street_log_odds,
)
from log2sim.agents.moving import turn_to_courses
from log2sim.agents.size import TrackGeometry
from log2sim.config import Config
from log2sim.datatypes import TYPICAL_SIZE_M, Boxes3D, Track
from log2sim.datatypes.log_odds import probability_of
from log2sim.perception.boxes import rotate

T_NS = np.arange(20) * 100_000_000
TIMELINE = Timeline(T_NS, 0)
CAR_M = np.array([4.4, 1.8, 1.5])


def candidate(x, y, yaw, speed=0.0, *, front=None, score=0.9, axis=True, category="car"):
    """An agent at x, y that starts there with a speed along its yaw; a 3D detector's boxes point along `front`."""
    t = T_NS / 1e9
    xy = np.array([x, y]) + np.outer(speed * t, [np.cos(yaw), np.sin(yaw)])
    m = rows_at(xy, category, t_ns=T_NS)
    if front is not None:
        m = replace(m, box_yaw_rad=np.full(20, front), heading_score=np.full(20, score))
    w = waypoints(t, *xy.T, 0.0, yaw, speed, sigma_yaw_rad=np.full(20, 0.02))
    geometry = TrackGeometry(CAR_M, xy, m.covariance, np.zeros(20), yaw if axis else None)
    return candidate_of(Track(category, np.arange(20), m), geometry, w, {}, static=speed == 0)


def ego(heading=0.0, speed=8.0):
    along = np.outer(speed * np.arange(20) / 10, [np.cos(heading), np.sin(heading)])
    return np.column_stack([along, np.full(20, heading)])


def decided(*candidates, path=None):
    """Headings in degrees and agents after the decision."""
    agents = [c.agent for c in decide_headings(candidates, ego() if path is None else path, TIMELINE)]
    return [round(float(np.rad2deg(a.waypoints.yaw_rad[0]))) % 360 for a in agents], agents


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("yaw", [0.0, np.pi])
def test_parked_cars_point_with_the_traffic_of_their_side(side, yaw):
    """Oncoming traffic passes on the left where traffic keeps right (side 1), on the right in the mirror."""
    oncoming = candidate(40.0, 3.5 * side, np.pi, 9.0)
    parked = [candidate(8.0 * k, y * side, yaw) for k in range(3) for y in (-3.0, 6.5)]
    headings, agents = decided(oncoming, *parked)
    assert headings == [180, *[0, 180] * 3]
    assert min(a.quality["heading_confidence"] for a in agents) > 0.7
    assert not any(a.doubts for a in agents)
    # Not -0.0, though some are turned round.
    assert not any(np.signbit(a.waypoints.speed_mps).any() for a in agents[1:])


def test_a_queue_on_the_own_lane_points_ahead():
    headings, agents = decided(*[candidate(15.0 + 7 * k, 0.2, np.pi) for k in range(3)])
    assert headings == [0, 0, 0]
    assert min(a.quality["heading_confidence"] for a in agents) > 0.8


def test_a_car_park_is_decided_by_each_car_alone_with_a_weak_say_of_its_neighbors():
    known = [
        candidate(2.7 * k - 8, -20.0, np.pi / 2, front=np.pi / 2 * (-1 if k == 2 else 1), score=0.97) for k in range(6)
    ]
    headings, _ = decided(*known, candidate(2.7 * 6 - 8, -20.0, np.pi / 2))
    assert headings == [90, 90, 270, 90, 90, 90, 90]


@pytest.mark.parametrize(("score", "heading"), [(0.9, 180), (0.2, 0)])
def test_what_may_be_clutter_tells_nothing_of_traffic(score, heading):
    """Oncoming traffic passes on the right, so that it keeps left: cars at the curb there point against the ego."""
    oncoming = candidate(40.0, -3.5, np.pi, 9.0)
    measured = replace(oncoming.track.measurements, score=np.full(20, score))
    oncoming = replace(oncoming, track=replace(oncoming.track, measurements=measured))
    assert decided(oncoming, *[candidate(8.0 * k, -6.5, 0.0) for k in range(2)])[0][1:] == [heading] * 2


def cut(c, rows):
    """The candidate at some of its waypoints."""
    return replace(c, agent=replace(c.agent, waypoints=c.agent.waypoints.take(rows)))


@pytest.mark.parametrize("yaw", [0.0, np.pi])
def test_what_drives_off_or_stops_had_its_front_where_it_has_it_then(yaw):
    # So slow that it shows no direction of traffic.
    moving = candidate(30.0, 40.0, 0.0, 1.4, front=0.0, score=0.99)
    before, after = candidate(31.0, 40.0, yaw), candidate(32.0, 40.0, yaw)
    driving, stopping = cut(moving, slice(8, 20)), cut(moving, slice(0, 13))
    for world in ((cut(before, slice(0, 5)), driving), (cut(after, slice(15, 20)), stopping)):
        headings, agents = decided(*world)
        assert headings == [0, 0]
        assert agents[0].quality["heading_confidence"] > 0.9
    # Another place, another vehicle.
    assert decided(cut(candidate(31.0, 44.0, yaw), slice(0, 5)), driving)[1][0].quality["heading_confidence"] < 0.6


@pytest.mark.parametrize(
    ("category", "detections", "heading"), [("car", 20, 0), ("car", 3, 180), ("cyclist", 3, 0), ("truck", 11, 0)]
)
def test_a_motion_seen_in_few_detections_of_a_car_may_be_of_several_that_stand(category, detections, heading):
    """Of trucks, whose ends look alike, sure boxes may all be wrong."""
    sure = 0.999 if category == "truck" else 0.9
    moving = candidate(30.0, 40.0, 0.0, 8.0, front=np.pi, category=category, score=sure)
    rows = np.linspace(0, 19, detections).round().astype(int)
    track = Track(category, rows, moving.track.measurements.take(rows))
    assert decided(replace(moving, track=track), path=np.zeros((0, 3)))[0] == [heading]


def test_a_truck_that_drives_off_over_less_than_its_length_points_ahead_whatever_its_boxes_say():
    driving = candidate(30.0, 40.0, 0.0, 1.4, front=np.pi, category="truck", score=0.999)
    assert decided(driving, path=np.zeros((0, 3)))[0] == [0]


def test_a_lone_car_is_doubted_and_says_so_in_its_quality():
    (heading,), (agent,) = decided(candidate(30.0, 40.0, 1.0), path=np.zeros((0, 3)))
    assert heading == 57
    assert agent.quality["heading_confidence"] == 0.5
    assert [d.kind for d in agent.doubts] == ["heading_ambiguous"]


def test_headings_do_not_depend_on_the_map_or_on_the_order():
    turn = 2.2

    def go(c):
        w = c.agent.waypoints
        x, y = (np.cos(turn) * w.x_m - np.sin(turn) * w.y_m, np.sin(turn) * w.x_m + np.cos(turn) * w.y_m)
        return replace(
            c, agent=replace(c.agent, waypoints=replace(w, x_m=x + 900, y_m=y - 400, yaw_rad=w.yaw_rad + turn))
        )

    world = [candidate(40.0, 3.5, np.pi, 9.0), *[candidate(8.0 * k, -3.0, np.pi * (k % 2)) for k in range(3)]]
    path = ego() @ np.array([[np.cos(turn), np.sin(turn), 0], [-np.sin(turn), np.cos(turn), 0], [0, 0, 1]]) + [
        900,
        -400,
        turn,
    ]
    here, there = decided(*world)[1], decided(*[go(c) for c in world][::-1], path=path)[1][::-1]
    for a, b in zip(here, there):
        assert np.cos(b.waypoints.yaw_rad[0] - a.waypoints.yaw_rad[0] - turn) == pytest.approx(1.0)
        assert b.quality["heading_confidence"] == pytest.approx(a.quality["heading_confidence"], abs=2e-3)


def boxes_of_sweeps(category, velocity, yaw, *, turned, rate_hz=10.0, count=20):
    """Boxes of one object sweep by sweep, of which a random share is turned round, each as sure of its front as any other."""
    rng, t_s = np.random.default_rng(3), np.arange(count) / rate_hz
    yaw = yaw + np.pi * (rng.random(count) < turned)
    return np.rint(t_s * 1e9).astype(np.int64), [
        Boxes3D(
            np.array([round(t * 1e9)]), np.array([[5.0 + velocity[0] * t, 2.0 + velocity[1] * t, 0.8]]),
            np.array([TYPICAL_SIZE_M[category]]), np.array([y]), np.array([0.8]), np.array([category]), np.array([0.7]),
            np.array([40]),
        )
        for t, y in zip(t_s, yaw)
    ]  # fmt: skip


@pytest.mark.parametrize("rate_hz", [2.0, 10.0, 20.0])
@pytest.mark.parametrize(("category", "speed"), [("car", 8.0), ("truck", 6.0), ("cyclist", 4.0), ("pedestrian", 1.4)])
def test_boxes_of_sweeps_point_where_their_object_goes(category, speed, rate_hz):
    course = 2.2
    velocity = speed * np.array([np.cos(course), np.sin(course)])
    t_ns, found = boxes_of_sweeps(category, velocity, course, turned=0.8, rate_hz=rate_hz)
    turned = turn_to_courses(found, t_ns, Config().track)
    assert all(np.cos(b.yaw_rad[0] - course) > 0.99 for b in turned)
    assert np.mean([b.heading_score[0] for b in turned]) > 0.85
    assert all(np.array_equal(a.center_m, b.center_m) for a, b in zip(found, turned))


@pytest.fixture(scope="module")
def vehicles():
    """Vehicles that the weights were not fitted to."""
    found = [fit_outline.draw(np.random.default_rng([2, seed])) for seed in range(30)]
    return [v for v in found if v is not None]


def odds_of(seen, turn=0.0, shift=(0.0, 0.0), yaw=0.0, ground_m=0.0):
    """Log-odds of a vehicle at `shift` that is turned in the map, with a box that points along `yaw` from its axis."""
    track = bare([shift] * 3)
    parts = [np.column_stack([rotate(p[:, :2], turn) + shift, p[:, 2] + ground_m]) for p in np.array_split(seen.xyz, 3)]
    m = replace(
        track.measurements, cluster=tuple(parts), bottom_m=np.full(3, ground_m),
        sensor_m=np.tile(np.append(rotate(seen.view_m, turn) + shift, ground_m + 2.0), (3, 1)),
    )  # fmt: skip
    w = waypoints([0.0, 0.2], *shift, 0.0, turn + yaw)
    return heading.outline_log_odds(replace(track, measurements=m), w, np.array([0.0, 0.1, 0.2]), tuple(seen.size_m))


def test_most_fronts_are_found_and_sure_ones_are_right(vehicles):
    odds = np.array([odds_of(seen) for seen in vehicles])
    assert np.mean(odds > 0) >= 0.8
    assert np.mean(odds[np.abs(odds) > 3] > 0) >= 0.95


def test_a_vehicle_turned_round_has_the_opposite_log_odds_anywhere(vehicles):
    for seen in vehicles[:8]:
        here = odds_of(seen)
        assert odds_of(seen, turn=2.0, shift=(700.0, -300.0), ground_m=40.0) == pytest.approx(here, abs=0.4)
        assert odds_of(seen, yaw=np.pi) == pytest.approx(-here, abs=0.4)


def test_a_box_that_ends_too_early_is_as_long_as_its_points(vehicles):
    seen = max(
        (v for v in vehicles if v.size_m[0] < 5.5),
        key=lambda v: len(v.xyz) * (np.ptp(v.xyz[:, 0]) > 0.95 * v.size_m[0]),
    )
    size = seen.size_m * [0.85, 1.0, 1.0]
    short = heading.outline_of(seen.xyz, size, seen.view_m)
    exact = heading.outline_of(seen.xyz, seen.size_m, seen.view_m)
    assert np.mean(short.cells != exact.cells) < 0.08


def test_neighbors_behind_a_gap_and_the_ground_are_no_part_of_it():
    rng = np.random.default_rng(5)
    side = np.column_stack([rng.uniform(-2.2, 2.2, 400), np.full(400, 0.9), rng.uniform(0.3, 1.4, 400)])
    others = np.vstack(
        [side[:50] * 0.1 + [2.9, 0.0, 1.0], side[:50] * [1, 1, 0], side[:50] + np.array([0.0, 1.0, 0.0])]
    )
    alone, among = (
        heading.outline_of(p, np.array([4.4, 1.8, 1.5]), np.array([0.0, 9.0]))
        for p in (side, np.vstack([side, others]))
    )
    np.testing.assert_array_equal(alone.cells, among.cells)


def rows_of(poses, lengths_m=None, stands=None):
    poses = np.array(poses, dtype=float)
    lengths = np.full(len(poses), 4.5) if lengths_m is None else np.array(lengths_m)
    return find_rows(poses, lengths, np.arange(len(poses)) if stands is None else np.array(stands))


CURB = [(6.0 * k, 0.0, np.pi * (k % 2)) for k in range(4)]
LOT = [(0.1 * k, 2.7 * k, 0.0) for k in range(5)]


def test_cars_along_a_curb_are_one_row_and_so_are_those_side_by_side():
    (curb,), (lot,) = rows_of(CURB), rows_of(LOT)
    assert curb.members.tolist() == [0, 1, 2, 3]
    assert curb.toward.tolist() == [1, -1, 1, -1]
    assert (curb.alike, lot.alike) == (ALIKE_ALONG, ALIKE_ACROSS)
    assert len(lot.members) == 5


@pytest.mark.matrix
@pytest.mark.parametrize("seed", range(4))
def test_probabilities_are_those_of_all_cases_enumerated(seed):
    rng = np.random.default_rng(seed)
    rows = rows_of(CURB + [(50.0, 2.7 * k, 0.0) for k in range(2)])
    n = 6
    own, street, right = rng.normal(0, 2, n), rng.normal(0, 1.5, (2, n)), rng.normal()
    total, along = 0.0, np.zeros(n)
    for side, ways, turned in product(range(2), product([1, -1], repeat=len(rows)), product([1, -1], repeat=n)):
        weight = probability_of(right if side == 0 else -right)
        for row, way in zip(rows, ways):
            weight *= probability_of(way * np.mean(row.toward * street[side, row.members]))
            for k, toward in zip(row.members, row.toward):
                agrees = turned[k] * toward == way
                weight *= (row.alike if agrees else 1 - row.alike) * probability_of(turned[k] * own[k])
        total += weight
        along += weight * (np.array(turned) == 1)
    np.testing.assert_allclose(headings_of(rows, own, street, right), along / total, atol=1e-12)


def test_cars_whose_fronts_are_seen_tell_the_side_of_traffic_for_the_others():
    """Six cars at both curbs of a street of known traffic; each alone is unsure, the two without points know nothing."""
    poses = [(20.0 * k, y, 0.0) for k in range(3) for y in (-4.0, 4.0)]
    street = np.array([[2.0, -2.0] * 3, [-2.0, 2.0] * 3])
    own = np.array([-2.0, 2.0, -2.0, 2.0, 0.0, 0.0])
    chance = headings_of(rows_of(poses), own, street, 0.9)
    assert chance[4] < 0.3
    assert chance[5] > 0.7
    np.testing.assert_allclose(headings_of(rows_of(poses), -own, -street, 0.9), 1 - chance)


ANGLES = st.floats(-np.pi, np.pi)


def path(x0_m: float, y0_m: float, heading_rad: float, length_m: float = 60.0) -> np.ndarray:
    """A straight path (K, 3) of x, y and heading."""
    along = np.arange(0.0, length_m, 1.5)[:, None]
    return np.hstack([
        [x0_m, y0_m] + along * [np.cos(heading_rad), np.sin(heading_rad)], np.full((len(along), 1), heading_rad),
    ])  # fmt: skip


def moved(flow: np.ndarray, turn_rad: float, shift_m: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """The same path in a map that is turned and shifted."""
    return np.column_stack([rotate(flow[:, :2], turn_rad) + shift_m, flow[:, 2] + turn_rad])


def mirrored(flow: np.ndarray) -> np.ndarray:
    """The same path in a mirror along x."""
    return flow * [1.0, -1.0, -1.0]


USUAL = np.log(USUALLY_RIGHT / (1 - USUALLY_RIGHT))


@given(turn=ANGLES, apart_m=st.floats(2.5, 12.0), x=st.floats(-1e5, 1e5), late=st.floats(0.0, 30.0))
@settings(max_examples=40, deadline=None)
def test_oncoming_traffic_on_the_left_keeps_right_in_every_map_and_left_in_the_mirror(turn, apart_m, x, late):
    road = [path(0.0, 0.0, 0.0), path(60.0 + late, apart_m, np.pi)]
    assert side_log_odds([moved(p, turn, (x, -x)) for p in road]) == pytest.approx(USUAL + MEETING_LOG_ODDS)
    assert side_log_odds([moved(mirrored(p), turn, (x, -x)) for p in road]) == pytest.approx(USUAL - MEETING_LOG_ODDS)


@given(turn=ANGLES, left_m=st.sampled_from([-9.0, -4.0, 0.5, 3.0, 9.0]), flipped=st.booleans())
@settings(max_examples=40, deadline=None)
def test_the_direction_of_a_street_is_mirrored_with_its_world(turn, left_m, flipped):
    flow, pose = path(0.0, 0.0, 0.0), np.array([[20.0, left_m, np.pi * flipped]])
    right = street_log_odds(moved(pose, turn)[0], [moved(flow, turn)])[0]
    left = street_log_odds(moved(mirrored(pose), turn)[0], [moved(mirrored(flow), turn)])[1]
    assert right == pytest.approx(left, abs=1e-6)
    assert (right > 0) == ((left_m < 2) != flipped)
    # What points the other way has the opposite log-odds.
    turned = street_log_odds(moved(pose + np.array([0, 0, np.pi]), turn)[0], [moved(flow, turn)])[0]
    assert turned == pytest.approx(-right, abs=1e-6)


def test_in_the_lane_of_another_one_surely_goes_its_way_and_at_its_curb_most_likely():
    def along(left_m):
        return street_log_odds(np.array([30.0, left_m, 0.0]), [path(0.0, 0.0, 0.0)])[0]

    assert along(0.3) > along(-3.0) > 2 > 0 > along(3.0) > along(8.0)
