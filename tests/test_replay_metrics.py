"""Errors of a replay and collisions, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from replay_maneuvers import agent_from, driven, lane_change, scenario_of

from log2sim.datatypes import Trajectory
from log2sim.errors import CheckFailed
from log2sim.geometry import rectangles_overlap
from log2sim.simulation.metrics.all_metrics import check_strict, require_strict, summarize, tracking_errors
from log2sim.simulation.metrics.collisions import SCENARIO_MARGIN_M, SCENARIO_WINDOW_S, BoxTracks, collisions, contacts
from log2sim.simulation.runner import replay

T_S = np.arange(0, 41) * 0.1


def circle(radius_m, speed):
    angle = speed * T_S / radius_m
    return agent_from(
        T_S, radius_m * np.sin(angle), radius_m * (1 - np.cos(angle)), angle, np.full(41, speed), offset_m=0
    )


@pytest.mark.parametrize("outward_m", [-0.4, 0.0, 0.7])
@pytest.mark.parametrize("late_s", [0.0, 0.32])
@pytest.mark.parametrize(("radius", "speed", "limit"), [(20.0, 6.0, 2e-3), (8.0, 12.0, 7e-3)])
def test_on_a_circle_the_error_across_is_the_difference_of_radii_however_late(outward_m, late_s, radius, speed, limit):
    path = Trajectory.through(circle(radius, speed).waypoints, 0.0)
    t = np.linspace(1.2, 2.8, 33)
    angle = speed * (t - late_s) / radius
    r = radius + outward_m
    across, _ = tracking_errors(path, t, r * np.sin(angle), radius - r * np.cos(angle))
    np.testing.assert_allclose(across, -outward_m, atol=limit)  # a left turn: outward is right; chords of 50 ms


def test_on_a_straight_line_errors_are_the_components():
    agent = agent_from(T_S, 5 * T_S * np.cos(0.5), 5 * T_S * np.sin(0.5), np.full(41, 0.5), np.full(41, 5.0))
    t = np.array([1.0, 2.0, 3.0])
    ahead, left = 0.8, 0.3
    x = 5 * t * np.cos(0.5) + ahead * np.cos(0.5) - left * np.sin(0.5)
    y = 5 * t * np.sin(0.5) + ahead * np.sin(0.5) + left * np.cos(0.5)
    across, along = tracking_errors(Trajectory.through(agent.waypoints, 1.3), t, x, y)
    np.testing.assert_allclose(across, left, atol=1e-9)
    np.testing.assert_allclose(along, ahead, atol=1e-9)


def test_left_is_positive_when_the_log_reverses_too():
    agent = agent_from(T_S, -2 * T_S, 0 * T_S, 0 * T_S, np.full(41, -2.0))
    across, along = tracking_errors(
        Trajectory.through(agent.waypoints, 1.3), np.array([2.0]), np.array([-4.0 + 0.1]), np.array([0.25])
    )
    assert across[0] == pytest.approx(0.25)
    assert along[0] == pytest.approx(0.1)


def test_the_error_across_does_not_depend_on_the_logged_heading_of_what_moves():
    agent = agent_from(T_S, 5 * T_S, 0 * T_S, np.full(41, 0.6), np.full(41, 5.0))
    across, _ = tracking_errors(
        Trajectory.through(agent.waypoints, 0.0), np.array([2.0]), np.array([10.0]), np.array([0.5])
    )
    assert across[0] == pytest.approx(0.5, abs=1e-3)


def test_at_a_log_that_stands_the_heading_parts_across_from_along():
    agent = agent_from(T_S, 0 * T_S, 0 * T_S, np.full(41, np.pi / 2), 0 * T_S)
    across, along = tracking_errors(
        Trajectory.through(agent.waypoints, 0.0), np.array([2.0]), np.array([0.2]), np.array([-0.6])
    )
    assert across[0] == pytest.approx(-0.2)
    assert along[0] == pytest.approx(-0.6)


def rectangles(dx, dy, turn, size_a=(4.0, 2.0), size_b=(4.0, 2.0)):
    one = [np.array([v], float) for v in (dx, dy, 0.0, turn)]
    return bool(rectangles_overlap(*one, np.array([size_a]), np.array([size_b]))[0])


@pytest.mark.parametrize(
    ("dx", "dy", "turn", "contact"),
    [
        (3.999, 0, 0, True), (4.0, 0, 0, False), (0, 1.999, 0, True), (0, 2.0, 0, False), (3.999, 1.999, 0, True),
        (2.999, 0, np.pi / 2, True), (3.001, 0, np.pi / 2, False),
        # A corner that points at a side: its reach is half the diagonal's projection, (4 + 2) / 2 / sqrt(2).
        (2.0 + 3 / np.sqrt(2) - 0.001, 0, np.pi / 4, True), (2.0 + 3 / np.sqrt(2) + 0.001, 0, np.pi / 4, False),
        # Bounding boxes overlap, rectangles do not.
        (3.6, 2.6, np.pi / 4, False),
    ],
)  # fmt: skip
def test_rectangles_meet_where_geometry_says(dx, dy, turn, contact):
    assert rectangles(dx, dy, turn) is contact
    assert rectangles(-dx, -dy, turn) is contact


def boxes(*tracks, z=None, size=(4.0, 2.0, 1.5)):
    """Boxes from tracks (S,) of x on one line each: y, then x."""
    x = np.array([t[1] for t in tracks], float).T
    y = np.tile(np.array([t[0] for t in tracks], float), (len(x), 1))
    zero = np.zeros_like(x)
    return BoxTracks(x, y, zero if z is None else zero + np.array(z), zero, zero + 5.0, np.tile(size, (len(tracks), 1)))


def test_bridges_and_absent_agents_are_not_hit():
    moves = np.array([True, True])
    x = np.linspace(0, 1, 30)
    assert len(contacts(boxes((0, x), (0, x)), moves).a) == 30
    assert len(contacts(boxes((0, x), (0, x), z=(0.0, 1.5)), moves).a) == 0
    gone = np.where(np.arange(30) < 25, np.nan, x)
    assert len(contacts(boxes((0, x), (0, gone)), moves).a) == 5
    assert len(contacts(boxes((0, x), (0, x)), np.array([False, False])).a) == 0


@pytest.mark.slow
def test_all_pairs_are_found_as_by_trying_each():
    rng = np.random.default_rng(2)
    n = 40
    x, y = rng.uniform(0, 60, (1, n)), rng.uniform(0, 60, (1, n))
    yaw, size = (
        rng.uniform(-np.pi, np.pi, (1, n)),
        np.stack([rng.uniform(1, 12, n), rng.uniform(0.5, 3, n), np.ones(n)], axis=1),
    )
    moves = rng.uniform(size=n) < 0.5
    found = contacts(BoxTracks(x, y, 0 * x, yaw, 0 * x, size), moves)

    def corners(k):
        rim = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * size[k, :2] / 2
        c, s = np.cos(yaw[0, k]), np.sin(yaw[0, k])
        return rim @ np.array([[c, s], [-s, c]]) + [x[0, k], y[0, k]]

    def grid(k):  # a second method: points of one box inside the other
        u, v = np.meshgrid(np.linspace(0, 1, 120), np.linspace(0, 1, 60))
        a, b, _, d = corners(k)
        return a + u.reshape(-1, 1) * (b - a) + v.reshape(-1, 1) * (d - a)

    def inside(points, k):
        c, s = np.cos(yaw[0, k]), np.sin(yaw[0, k])
        local = (points - [x[0, k], y[0, k]]) @ np.array([[c, -s], [s, c]])
        return np.any(np.all(np.abs(local) < size[k, :2] / 2, axis=1))

    expected = {
        (a, b)
        for a in range(n)
        for b in range(a + 1, n)
        if (moves[a] or moves[b]) and (inside(grid(a), b) or inside(grid(b), a))
    }
    assert len(expected) > 5
    assert set(zip(found.a.tolist(), found.b.tolist())) == expected


def one_contact(log_x, log_y=0.0):
    """A replayed contact at 2 s of boxes at y = 0; the log has the second box at `log_x` (S,), `log_y`."""
    t = np.arange(0, 81) * 0.05
    hit = np.where(np.abs(t - 2.0) < 0.01, 3.0, 10.0)
    events = collisions(
        boxes((0, 0 * t), (0, hit)), boxes((0, 0 * t), (log_y, log_x(t))), np.array([True, True]), t, ["a", "b"]
    )
    assert len(events) == 1
    return events[0]


def test_a_collision_is_new_unless_the_log_has_it_near_in_time_and_place():
    inside, outside = SCENARIO_WINDOW_S - 0.1, SCENARIO_WINDOW_S + 0.1

    def at(moment, gap=-1.0):
        return lambda t: np.where(np.abs(t - moment) < 0.01, 4.0 + gap, 10.0)

    assert one_contact(at(2.0 + inside))["in_log"]
    assert one_contact(at(2.0 - inside))["in_log"]
    assert not one_contact(at(2.0 + outside))["in_log"]
    assert not one_contact(at(2.0 - outside))["in_log"]
    assert one_contact(at(2.0, SCENARIO_MARGIN_M * 0.9))["in_log"]
    assert not one_contact(at(2.0, SCENARIO_MARGIN_M * 1.1))["in_log"]
    assert SCENARIO_MARGIN_M <= 0.1  # more would hide what a replay does wrong
    assert SCENARIO_WINDOW_S <= 0.5


def test_contacts_of_a_pair_that_are_near_in_time_are_one_collision():
    t = np.arange(0, 100) * 0.05
    x = np.where((t > 1) & (t < 1.5) | (t > 1.7) & (t < 2) | (t > 4), 3.0, 10.0)
    far = boxes((0, 0 * t), (50, 0 * t))
    events = collisions(boxes((0, 0 * t), (0, x)), far, np.array([True, True]), t, ["a", "b"])
    assert [(round(e["t_s"], 2), round(e["until_s"], 2)) for e in events] == [(1.05, 1.95), (4.05, 4.95)]


def crossing(second_y):
    """A car that stops for one that passes ahead of it, or would."""
    car = agent_from(T_S, 5 * T_S, 0 * T_S, 0 * T_S, np.full(41, 5.0), id="car")
    other = agent_from(T_S, np.full(41, 12.0), second_y, np.full(41, np.pi / 2), np.gradient(second_y, T_S), id="other")
    return scenario_of(car, other)


def test_boxes_that_cross_in_the_log_collide_in_the_replay_and_the_log_has_it():
    result = replay(crossing(5 * T_S - 10.0))
    (event,) = result.metrics["collisions"]
    assert event["agents"] == ["car", "other"]
    assert event["in_log"]
    assert event["relative_speed_mps"] == pytest.approx(5 * np.sqrt(2), abs=0.05)
    # Bumper at 12 - 0.9: (12 - 0.9 - 2.2) / 5 s; the other then spans y from -2.2 + ... and is there.
    assert event["t_s"] == pytest.approx((12 - 0.9 - 2.2) / 5, abs=0.051)
    assert result.metrics["new_collisions"] == 0
    assert check_strict(result) == []
    assert replay(crossing(5 * T_S + 20.0)).metrics["collisions"] == []


def test_an_ego_that_does_not_brake_has_a_collision_that_the_log_has_not_and_strict_says_so():
    from log2sim.simulation.policy import Controls

    t = T_S
    speed = np.maximum(6 - 3 * t, 0)
    x = np.where(t < 2, 6 * t - 1.5 * t**2, 6.0)
    ego = agent_from(t, x, 0 * t, 0 * t, speed, id="ego")
    parked = agent_from([0.0], [12.0], [0.0], [0.0], [0.0], id="parked", static=True)
    scene = scenario_of(ego, parked)
    assert check_strict(replay(scene)) == []
    reckless = replay(scene, ego=lambda seen: Controls(0.0, 0.0))
    assert reckless.metrics["new_collisions"] == 1
    assert reckless.metrics["by_agent"]["ego"]["collisions"]
    assert any("ego and parked collide" in line for line in check_strict(reckless))
    with pytest.raises(CheckFailed, match="ego and parked collide"):
        require_strict(reckless)


def test_strict_names_discontinuities_and_vehicles_off_their_path():
    t = T_S
    sharp = agent_from(
        t,
        np.minimum(4 * t, 8.0),
        np.maximum(4 * t - 8.0, 0.0),
        np.where(t < 2, 0, np.pi / 2),
        np.full(41, 4.0),
        id="sharp",
    )
    broken = check_strict(replay(scenario_of(sharp)))
    assert any(line.startswith("agent 'sharp'") and "off its path" in line for line in broken)
    leap = agent_from(t, 5 * t + np.where(t > 2.05, 30, 0), 0 * t, 0 * t, np.full(41, 5.0), id="leap")
    assert any("discontinuous" in line for line in check_strict(replay(scenario_of(leap))))


def test_overall_errors_weigh_every_sample_alike():
    metrics = replay(scenario_of(
        agent_from(T_S, 5 * T_S, 0.02 * (T_S > 2), 0 * T_S, np.full(41, 5.0), id="long"),
        agent_from(T_S[:11], 5 * T_S[:11], 20 + 0.1 * (T_S[:11] > 0.5), 0 * T_S[:11], np.full(11, 5.0), id="short"),
    )).metrics  # fmt: skip
    long, short = (metrics["by_agent"][k]["cross_track_rms_m"] for k in ("long", "short"))
    assert short > long > 0
    samples = np.array([81, 21])  # at 20 Hz, both ends
    assert metrics["cross_track_rms_m"] == pytest.approx(
        np.sqrt(samples @ np.array([long, short]) ** 2 / samples.sum()), abs=2e-6
    )
    assert metrics["followers"] == 2


def test_errors_across_are_of_all_who_keep_to_the_way_and_a_dash_stands_where_nobody_has_one():
    agents = [
        driven(lambda t: np.full_like(t, 15.0), lane_change, 6.0, id="ego"),
        driven(lambda t: np.full_like(t, 15.0), lane_change, 6.0, start=(0, 40, 0), id="other"),
    ]
    done = replay(scenario_of(*agents), agents=["ego", "other"])
    assert {a.driver for a in done.agents} == {"reactive"}
    worst = max(done.metrics["by_agent"][k]["cross_track_max_m"] for k in ("ego", "other"))
    assert (done.metrics["cross_track_max_m"], done.metrics["followers"]) == (worst, 0)
    assert worst > 0.001
    assert summarize(done).startswith(
        f"cross-track {done.metrics['cross_track_rms_m']:.3f} m rms, {worst:.3f} m max · along-track - · speed -"
    )
    assert summarize(replay(scenario_of())).startswith("cross-track - · along-track - · speed -")
    assert summarize(replay(scenario_of(*agents), mode="exact")).startswith("cross-track 0.000 m rms")
