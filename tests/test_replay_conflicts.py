"""Time to collision and post-encroachment time: closed forms, and all pairs of rows tried one by one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from replay_maneuvers import scenario_of
from replay_scenes import line
from test_replay_contacts import SPACING_S, T_S, boxes_of

from log2sim.geometry import rectangles_overlap
from log2sim.simulation.metrics.collisions import BoxTracks
from log2sim.simulation.metrics.conflicts import (
    HORIZON_S,
    conflicts,
    most_critical,
    post_encroachment_times,
    time_to_touch,
    times_to_collision,
)
from log2sim.simulation.runner import replay


def test_time_to_touch_is_when_moments_see_the_first_overlap():
    rng = np.random.default_rng(1)
    n = 1000
    d, v = rng.uniform(-12, 12, (2, n)), rng.normal(0, 5, (2, n))
    yaw, size = rng.uniform(-np.pi, np.pi, (2, n)), rng.uniform(0.5, 5, (2, n, 3))
    found = time_to_touch(*d, *v, *yaw, *size)
    moments = np.arange(0, 6, 0.002)
    seen = np.stack([rectangles_overlap(*(d + t * v), *yaw, *size) for t in moments])
    expected = np.where(seen.any(axis=0) & ~seen[0], moments[np.argmax(seen, axis=0)], np.inf)
    brief = (seen.sum(axis=0) <= 2) | seen[0]
    np.testing.assert_array_equal((found < 5.9)[~brief], (expected < 5.9)[~brief])
    soon = (expected < 5.9) & ~brief
    assert soon.sum() > 50
    assert np.all(np.abs(found[soon] - expected[soon]) < 0.0021)
    assert np.all(np.isinf(found[seen[0]]))


def town(count, seed):
    """Agents that drive straight, turn or stand, some only for a while."""
    rng = np.random.default_rng(seed)
    tracks = []
    for _ in range(count):
        x, y, yaw, speed, rate = (*rng.uniform(-25, 25, 2), *rng.uniform(-np.pi, np.pi, 1), rng.uniform(0, 15), rng.choice([0, 0.4, 1.8]))  # fmt: skip
        speed = speed * (rng.uniform() < 0.8)
        begin, end = sorted(rng.choice(T_S, 2))
        life = (0.0, 4.0) if rng.uniform() < 0.6 else (begin, end)

        def heading(t, yaw=yaw, rate=rate):
            return yaw + rate * t

        def along(trig, start, speed=speed, rate=rate, heading=heading):
            def at(t):
                fine = np.linspace(0, 1, 101)[:, None] * t
                return start + speed * trig(heading(fine)).mean(axis=0) * t

            return at

        tracks.append((along(np.cos, x), along(np.sin, y), heading, *life))
    sizes = np.stack([rng.uniform(0.6, 8, count), rng.uniform(0.5, 2.5, count), np.full(count, 1.6)], axis=1)
    return boxes_of(*tracks, size=sizes)


def test_the_least_times_to_collision_are_those_of_all_pairs_at_all_rows():
    boxes = town(40, seed=7)
    moves = np.arange(40) % 5 > 0
    vx, vy = boxes.velocities(SPACING_S)
    a, b = np.triu_indices(40, 1)
    a, b = (c[moves[a] | moves[b]] for c in (a, b))
    times = np.stack([
        time_to_touch(x[b] - x[a], y[b] - y[a], ux[b] - ux[a], uy[b] - uy[a], yaw[a], yaw[b], boxes.size_m[a], boxes.size_m[b])
        for x, y, ux, uy, yaw in zip(boxes.x_m, boxes.y_m, vx, vy, boxes.yaw_rad)
    ])  # fmt: skip
    together = boxes.present[:, a] & boxes.present[:, b]
    times = np.where(together & (times <= HORIZON_S), times, np.inf)
    expected = {(i, j): t for i, j, t in zip(a.tolist(), b.tolist(), times.min(axis=0)) if np.isfinite(t)}
    found = times_to_collision(boxes, moves, SPACING_S)
    pairs = list(zip(found.a.tolist(), found.b.tolist()))
    assert len(expected) > 40
    assert set(pairs) == set(expected)
    np.testing.assert_allclose(found.time_s, [expected[p] for p in pairs], atol=1e-12)
    rows = [times[:, np.flatnonzero((a == i) & (b == j))[0]].argmin() for i, j in pairs]
    np.testing.assert_array_equal(found.row, rows)


def test_velocities_are_of_the_motion_and_not_of_the_heading():
    boxes = boxes_of((lambda t: 3 * t, lambda t: -4 * t + t**2, 1.0, 1.0, 3.0), (0.0, 0.0, 0.5, 2.0, 2.0))
    vx, vy = boxes.velocities(SPACING_S)
    inner = slice(21, 60)
    np.testing.assert_allclose(vx[inner, 0], 3.0, atol=1e-9)
    np.testing.assert_allclose(vy[inner, 0], -4 + 2 * T_S[inner], atol=1e-9)
    assert np.isnan(vx[:20, 0]).all()
    assert (vx[40, 1], vy[40, 1]) == (0.0, 0.0)
    alone = BoxTracks(boxes.x_m, boxes.y_m, boxes.z_m, boxes.yaw_rad, boxes.speed_mps + 2.0, boxes.size_m)
    assert alone.velocities(SPACING_S)[1][40, 1] == pytest.approx(2 * np.sin(0.5))


def test_at_right_angles_it_is_from_the_rear_out_to_the_front_in():
    first = (lambda t: 10 * (t - 1.0), 0.0, 0.0)  # out of the other's lane when its center is 3 m past
    for late_s in (1.03, 1.77):
        second = (0.0, lambda t, late_s=late_s: -5 * (t - 1.0 - late_s), -np.pi / 2)
        expected = (1.0 + late_s - 3 / 5) - (1.0 + 3 / 10)
        for tracks, order in (((first, second), (0, 1)), ((second, first), (1, 0))):
            found = post_encroachment_times(boxes_of(*tracks), SPACING_S)
            assert (found.first.tolist(), found.second.tolist()) == ([order[0]], [order[1]])
            assert (found.came_row - found.left_row) * SPACING_S == pytest.approx(expected, abs=5e-4)
            assert found.left_row * SPACING_S == pytest.approx(1.3, abs=5e-4)


def pairs_of(*tracks):
    return len(post_encroachment_times(boxes_of(*tracks), SPACING_S).first)


def test_only_who_is_seen_to_leave_and_who_is_seen_to_come_counts():
    def straight(t):
        return 10 * (t - 1.0)

    def across(t):
        return 10 * (t - 2.0)

    second = (0.0, across, np.pi / 2)
    assert pairs_of((straight, 0.0, 0.0), second) == 1
    assert pairs_of((straight, 0.0, 0.0, 0.0, 1.0), second) == 0  # its log ends on the crossing
    assert pairs_of((straight, 0.0, 0.0), (0.0, across, np.pi / 2, 2.0, 4.0)) == 0  # it appears there
    assert pairs_of((0.0, 0.0, 0.0, 0.0, 1.0), second) == 0  # parked, and then no more seen
    assert pairs_of((lambda t: straight(t + 0.8), 0.0, 0.1), (straight, 0.0, 0.0)) == 0  # one follows the other
    assert pairs_of((straight, 5.0, 0.0), (lambda t: 20 - straight(t), 0.0, np.pi)) == 0  # in other lanes
    assert pairs_of((straight, 0.0, 0.0)) == 0


def test_a_new_collision_is_zero_and_one_of_the_log_is_left_out_of_the_least():
    a, b = (lambda t: 10 * t, 0.0, 0.0), (lambda t: 60 - 10 * t, 0.0, np.pi)
    c = (lambda t: 100 + 0 * t, lambda t: 20 - 5 * t, -np.pi / 2)
    boxes, ids = boxes_of(a, b, c), ["ego", "b", "c"]
    event = {"agents": ["ego", "b"], "t_s": 2.8, "until_s": 3.2, "relative_speed_mps": 20.0, "from_start": False}
    for whose, contact, value in (("replay", "new", 0.0), ("reconstruction", "scenario", None)):
        near = conflicts(boxes, np.ones(3, bool), T_S, ids, [{**event, "belongs_to": whose}])
        entry = next(e for e in near if e["agents"] == ["ego", "b"])
        assert (entry["contact"], entry["ego"]) == (contact, True)
        smallest = most_critical([entry], "min_ttc")
        assert smallest is None if value is None else (smallest["s"], smallest["t_s"]) == (0.0, 2.8)
    assert conflicts(boxes_of(c), np.ones(1, bool), T_S, ["c"], []) == []
    none = np.zeros((len(T_S), 0))
    assert conflicts(BoxTracks(none, none, none, none, none, np.zeros((0, 3))), np.zeros(0, bool), T_S, [], []) == []


@pytest.mark.parametrize("grade", [-0.1, 0.05, 0.1])
def test_on_a_slope_the_time_to_collision_is_that_on_the_flat_and_under_a_bridge_none(grade):
    agents = [line("ego", 0, speed=20, duration_s=2), line("slow", 60, speed=5, duration_s=2)]

    def least(height_of):
        raised = (replace(a, waypoints=replace(a.waypoints, z_m=height_of(a))) for a in agents)
        return replay(scenario_of(*raised), mode="exact").metrics["min_ttc"]

    assert least(lambda a: grade * a.waypoints.x_m) == least(lambda a: 0 * a.waypoints.x_m) is not None
    assert least(lambda a: 0 * a.waypoints.x_m + 6 * (a.id == "slow")) is None
