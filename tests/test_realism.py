"""Realism of simulated agents: the metrics by closed forms, and what simulated drivers do and do not do."""

from dataclasses import replace

import numpy as np
import pytest
from worlds import waypoints

from log2sim.datatypes import Agent, MapFeatures, MapLane, Marking, Scenario, Signal
from log2sim.errors import ConfigError
from log2sim.simulation.drivers import roll_out
from log2sim.simulation.metrics.realism import Motions, Road, features, realism, signed_distance
from log2sim.simulation.present import judged, recorded

T_S = np.arange(0.0, 9.01, 0.1)


def agent(id, x, y, yaw, speed, category="car", size=(4.5, 1.8, 1.5)):
    return Agent(id, category, size, waypoints(T_S, x, y, 0.75, yaw, speed, sigma_m=0.0))


def scenario(*agents):
    return Scenario("world", 0, 9.0, agents)


def test_signed_distance_is_that_of_polygons_and_the_shortest_way_out_of_those_that_overlap():
    shapely = pytest.importorskip("shapely")
    rng = np.random.default_rng(0)
    n = 300
    away = rng.uniform(-6, 6, n) + 1j * rng.uniform(-6, 6, n)
    a, b = rng.uniform(-np.pi, np.pi, (2, n))
    size_a, size_b = rng.uniform(0.5, 5.0, (2, n, 2))
    found = signed_distance(away, a, b, size_a, size_b)

    def box(center, yaw, size):
        local = np.array([1 + 1j, 1 - 1j, -1 - 1j, -1 + 1j])
        corners = center + (local.real * size[0] / 2 + 1j * local.imag * size[1] / 2) * np.exp(1j * yaw)
        return shapely.Polygon(np.column_stack([corners.real, corners.imag]))

    for k in range(n):
        one, two = box(0, a[k], size_a[k]), box(away[k], b[k], size_b[k])
        if found[k] > 0:
            assert found[k] == pytest.approx(one.distance(two), abs=1e-9)
        else:
            # Moved by a little more than the depth in the best of many directions they are apart, by less in none.
            ways = np.exp(1j * np.linspace(0, 2 * np.pi, 720))
            assert (
                any(
                    not one.intersects(box(away[k] + w * (-found[k] * 1.001 + 1e-6), b[k], size_b[k]))
                    for w in ways[::4]
                )
                or found[k] > -1e-3
                or any(not one.intersects(box(away[k] + w * (-found[k] * 1.01), b[k], size_b[k])) for w in ways)
            )
            assert all(one.intersects(box(away[k] + w * (-found[k] * 0.98), b[k], size_b[k])) for w in ways[::8])


def test_road_distance_is_that_to_the_edge_of_a_straight_lane():
    x = np.arange(-50.0, 51.0, 5.0)
    road = Road([MapLane("l", np.column_stack([x, 0 * x, 0 * x]), np.full(len(x), 4.0))])
    y = np.array([0.0, 1.0, 2.5, 10.0])
    assert road.distance_m(10.0 + 1j * y) == pytest.approx(y - 2.0, abs=0.3)


def motions(position):
    agents = (agent("a", T_S, 0.0, 0.0, 1.0), agent("b", T_S, 0.0, 0.0, 1.0))
    return Motions(agents, 0.1, position, np.zeros(position.shape))


def test_likelihood_of_collisions_is_the_share_of_rollouts_that_collide():
    ticks, rollouts, collide = 30, 8, 3
    apart = np.zeros((1, 2, ticks), dtype=complex)
    apart[:, 1] = 20j
    drawn = np.repeat(apart, rollouts, axis=0)
    drawn[:collide, 1, 15] = 1j
    found = realism(motions(apart), motions(drawn), [0, 1], 10).likelihood
    assert found["collision"] == pytest.approx((rollouts - collide + 0.001) / (rollouts + 0.002))
    early = drawn.copy()
    early[:, 1, 15], early[:, 1, 5] = 20j, 1j  # before the moment nothing counts
    assert realism(motions(apart), motions(early), [0, 1], 10).likelihood["collision"] == pytest.approx(1.0, abs=1e-3)


def test_likelihood_of_speeds_is_the_share_of_their_bin_over_all_rollouts():
    x = np.arange(30) * 0.1
    log, drawn = np.zeros((1, 2, 30), dtype=complex), np.zeros((4, 2, 30), dtype=complex)
    log[:, 1] = drawn[:, 1] = 200j
    log[:, 0] = 3.0 * x  # the second bin of 2.5 m/s
    drawn[:, 0] = np.array([1.0, 3.0, 4.0, 9.0])[:, None] * x
    found = realism(motions(log), motions(drawn), [0], 10).likelihood
    # Central differences are known at 18 of the 19 ticks after the moment.
    assert found["linear_speed"] == pytest.approx((2 * 18 + 0.1) / (4 * 18 + 1.0))
    assert found["angular_speed"] == pytest.approx((4 * 18 + 0.1) / (4 * 18 + 1.1))
    assert realism(motions(log), motions(drawn), [0], 10).min_ade_m == pytest.approx(0.0)


def test_time_to_collision_is_the_gap_over_the_closing_speed():
    x = np.arange(30) * 0.1
    log = np.zeros((1, 2, 30), dtype=complex)
    log[:, 0], log[:, 1] = 8.0 * x, 22.0 + 2.0 * x  # gap 17.5 m, closing by 6 m/s
    ahead = features(motions(log), [0, 1])["time_to_collision"]
    assert ahead[0, 0, 1:-1] == pytest.approx(((17.5 - 6.0 * x) / 6.0)[1:-1])
    assert ahead[0, 1, 1:-1] == pytest.approx(5.0)


def platoon():
    """Return a car that comes up to one that stands, and one on a road that crosses."""
    x = 10.0 * T_S
    return scenario(
        agent("ego", x, 0.0, 0.0, 10.0),
        agent("stands", 60.0, 0.0, 0.0, 0.0),
        agent("crosses", 38.0, -40.0 + 10.0 * T_S, np.pi / 2, 10.0),
    )


def test_nothing_after_the_moment_is_looked_at():
    world = platoon()
    w = world.agents[0].waypoints
    later = w.t_s > 1.08
    moved = replace(w, y_m=np.where(later, 30.0, w.y_m), speed_mps=np.where(later, 3.0, w.speed_mps))
    changed = replace(world, agents=(replace(world.agents[0], waypoints=moved), *world.agents[1:]))

    def drawn(scenario, seed):
        return roll_out(scenario, 1.03, count=4, rng=np.random.default_rng(seed)).position_m[..., 11:]

    assert np.array_equal(drawn(world, 1), drawn(changed, 1))
    assert not np.array_equal(drawn(world, 1), drawn(world, 2))


def test_drivers_stop_behind_who_stands_and_yield_where_paths_cross():
    world = platoon()
    log, now = recorded(world, 1.0)
    assert judged(log, now) == [0, 1, 2]
    apart = {}
    for model in ("drivers", "idm", "constant-velocity"):
        drawn = roll_out(world, 1.0, model, count=16, rng=np.random.default_rng(0))
        apart[model] = features(drawn, [0])["distance_to_nearest_object"][:, 0, now + 1 :].min(axis=1)
        assert drawn.position_m[:, 0, now] == pytest.approx(log.position_m[0, 0, now])
        spread = np.ptp(drawn.position_m[:, 0, -1].real)
        assert spread > 2.0 if model == "drivers" else spread == 0.0
        if model == "drivers":  # nor do they stop at once
            assert np.nanmin(features(drawn, [0, 2])["linear_acceleration"][..., now + 3 :]) > -9.0
    assert (apart["drivers"] > 0).all()
    assert (apart["constant-velocity"] < 0).all()


def test_rollouts_of_the_log_are_the_log_and_unknown_models_name_the_nearest():
    world = platoon()
    log, now = recorded(world, 1.0)
    drawn = roll_out(world, 1.0, "log", count=3, rng=np.random.default_rng(0))
    assert realism(log, drawn, judged(log, now), now).ade_m == 0.0
    with pytest.raises(ConfigError, match="drivers"):
        roll_out(world, 1.0, "driver", rng=np.random.default_rng(0))


def at_light(*, states, t_s, start_m=-30.0, speed=10.0, lanes=True, line=True, heading=np.pi, aside=3.0):
    """Return a car that comes up to a stop line at x = 0 whose light stands across a junction, 20 m on."""
    x = start_m + speed * T_S
    points = np.column_stack([np.arange(-100.0, 201.0, 5.0), np.zeros((61, 2)).T[0], np.zeros(61)])
    lane = MapLane("l", points, np.full(61, 3.5))
    stop = Marking("s", "stop_line", np.array([[0.0, -1.75, 0.0], [0.0, 1.75, 0.0]]), 0.4, "white")
    features = MapFeatures(lanes=(lane,) * lanes, markings=(stop,) * line)
    light = Signal("t", np.array([20.0, aside, 4.0]), heading, np.array(t_s), np.array(states))
    return replace(scenario(agent("ego", x, 0.0, 0.0, speed)), map_features=features, signals=(light,))


def fronts(world, now_s=1.0, horizon_s=8.0):
    """Return where the front of the car is after each tick (R, T)."""
    drawn = (
        roll_out(world, now_s, count=8, horizon_s=horizon_s, rng=np.random.default_rng(0)).position_m[:, 0, 11:].real
    )
    return drawn + 2.25


@pytest.mark.parametrize("lanes", [True, False])
def test_drivers_stop_at_the_stop_line_of_a_red_light_and_go_on_at_green(lanes):
    red = fronts(at_light(states=["red"], t_s=[0.0], lanes=lanes))
    assert ((red[:, -1] > -6.0) & (red[:, -1] < 0.5)).all()
    assert red.max() < 0.5
    assert (fronts(at_light(states=["green"], t_s=[0.0], lanes=lanes))[:, -1] > 20.0).all()
    then_green = fronts(at_light(states=["red", "green"], t_s=[0.0, 5.0], lanes=lanes))
    assert then_green[:, 38].max() < 0.5
    assert (then_green[:, -1] > 3.0).all()


def test_lights_that_face_others_stand_aside_or_turn_yellow_too_late_stop_nobody():
    for more in ({"heading": 0.0}, {"aside": 30.0}):
        assert (fronts(at_light(states=["red"], t_s=[0.0], **more))[:, -1] > 20.0).all()
    late = at_light(states=["green", "yellow", "red"], t_s=[0.0, 1.5, 4.5], start_m=-24.0)
    assert (fronts(late)[:, -1] > 20.0).all()  # 9 m before the line when it turns yellow: 5.5 m/s2 would be needed
    early = at_light(states=["green", "yellow", "red"], t_s=[0.0, 1.1, 4.1], start_m=-50.0)
    assert fronts(early).max() < 0.5


def test_without_a_stop_line_drivers_stop_before_the_light_and_who_stands_there_sets_off_at_green():
    found = fronts(at_light(states=["red"], t_s=[0.0], line=False, start_m=-15.0))
    assert ((found[:, -1] > 11.0) & (found[:, -1] < 17.5)).all()
    waits = at_light(states=["red", "green"], t_s=[0.0, 3.0], start_m=-4.0, speed=0.0)
    found = fronts(waits)
    assert (found[:, 15] < 0.0).all()
    assert (found[:, -1] > 3.0).all()
