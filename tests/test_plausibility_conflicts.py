"""Agents in one place at one time: the less likely one is cut to what is possible, or doubted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_overlap import agent, candidate

from log2sim.agents import conflicts
from log2sim.agents.candidate import Timeline, name_agents
from log2sim.agents.conflicts import (
    conflict_doubts,
    extend_static,
    find_conflicts,
    resolve_conflicts,
)
from log2sim.datatypes import AgentTable, Obstacles, Rays

T = np.linspace(0.0, 4.0, 5)


def passing(y_m):
    """A car that comes from behind, 10 m in 4 s."""
    return agent(-10.0, y_m, speed=2.5)


def backward(built):
    return replace(built, waypoints=replace(built.waypoints, x_m=built.waypoints.x_m[::-1]))


def judged(*built, ego=None):
    """What is left of agents with their evidence, with doubts."""
    named = name_agents(resolve_conflicts([candidate(a, e) for a, e in built], ego, T))
    return list(zip([c.agent for c in named], conflict_doubts(named, ego, T)))


def test_overlaps_have_the_shares_of_exact_rectangles() -> None:
    # 4.4 m long: 2.2 m apart they share half; crossed at right angles a square of 1.8 m.
    agents = [agent(0.0), agent(2.2), agent(-50.0), agent(0.0, -50.0), agent(-50.0, yaw=np.pi / 2)]
    (half, crossed), _ = find_conflicts(agents, T)
    assert (half.first, half.second, half.tick.tolist()) == (0, 1, [0, 1, 2, 3, 4])
    assert half.share == pytest.approx(0.5)
    assert half.depth_m == pytest.approx(1.8)
    assert (crossed.first, crossed.second) == (2, 4)
    assert crossed.share == pytest.approx(1.8 / 4.4)


def test_agents_of_other_times_or_places_have_no_conflict() -> None:
    assert find_conflicts([agent(0.0, t=(0.0, 1.9)), agent(0.0, t=(2.0, 4.0)), agent(4.5)], T)[0] == []


def test_a_way_that_ends_in_the_ego_is_cut_where_it_enters() -> None:
    ego = agent(0.0)
    # Both are 4.4 m long: they meet when the centers are that far apart, at 2.24 s; waypoints stand every second.
    ((cut, doubts),) = judged((passing(0.3), 9.0), ego=ego)
    assert cut.waypoints.t_s.tolist() == [0.0, 1.0, 2.0]
    assert cut.waypoints.x_m.tolist() == [-10.0, -7.5, -5.0]
    assert doubts == []
    ((late, _),) = judged((backward(passing(0.3)), 9.0), ego=ego)
    assert late.waypoints.t_s.tolist() == [2.0, 3.0, 4.0]


def test_nobody_drives_through_the_ego() -> None:
    through = agent(-10.0, 0.2, speed=9.0)
    ((cut, _),) = judged((through, 1e6), ego=agent(0.0))
    assert find_conflicts([cut, agent(0.0)], T)[0] == []
    assert cut.waypoints.t_s.tolist() == [2.0, 3.0, 4.0]


def test_what_is_in_the_ego_all_the_time_is_dropped() -> None:
    assert judged((agent(1.0, 0.5, yaw=0.7), 50.0), ego=agent(0.0)) == []


@pytest.mark.parametrize("y_m", [1.85, -2.5])
def test_who_passes_beside_the_ego_keeps_the_whole_way(y_m) -> None:
    ((kept, doubts),) = judged((passing(y_m), 1.0), ego=agent(0.0))
    assert kept.waypoints.t_s.tolist() == T.tolist()
    assert doubts == []


def test_who_touches_the_ego_is_doubted_only_then() -> None:
    # 1.8 m wide: they share 2 cm of it, 1.1 % of the box, where they are beside each other.
    beside = agent(-10.0, 1.78, speed=2.5)
    ((kept, (doubt,)),) = judged((beside, 1.0), ego=agent(0.0))
    assert len(kept.waypoints) == 5
    assert (doubt.flag, doubt.reason, doubt.start_s, doubt.end_s) == ("in_ego", "touches the ego at 4.0 s", 3.0, 4.0)


def test_a_static_agent_is_gone_when_the_ego_stands_in_its_place() -> None:
    parked = replace(agent(3.0), static=True)
    arriving = agent(-8.0, speed=2.5)
    ((cut, _),) = judged((parked, 9.0), ego=arriving)
    # The ego reaches 3 m from its center, 1.4 m of contact, between 2 and 3 s.
    assert cut.waypoints.t_s.tolist() == [0.0, 2.0]
    assert cut.waypoints.x_m.tolist() == [3.0, 3.0]


def test_without_an_ego_nothing_is_cut() -> None:
    ((kept, doubts),) = judged((passing(0.0), 1.0))
    assert len(kept.waypoints) == 5
    assert doubts == []


def test_of_two_that_meet_at_an_end_the_less_likely_one_ends_before() -> None:
    standing = agent(0.0)
    for evidence, ends in (((9.0, 1.0), 2.0), ((1.0, 9.0), 4.0)):
        found = {a.waypoints.speed_mps[0]: a for a, _ in judged((standing, evidence[0]), (passing(0.3), evidence[1]))}
        assert found[2.5].waypoints.t_s[-1] == ends


def test_who_drives_through_the_middle_of_another_is_doubted_by_name_and_time() -> None:
    standing = agent(0.0)
    through = agent(-6.0, speed=3.0)
    found = {a.waypoints.speed_mps[0]: (a, d) for a, d in judged((standing, 9.0), (through, 1.0))}
    assert found[0.0][1] == []
    kept, (doubt,) = found[3.0]
    assert len(kept.waypoints) == 5
    assert (doubt.flag, doubt.reason, doubt.start_s, doubt.end_s) == (
        "passes_through",
        "passes through car-2 at 2.0 s",
        1.0,
        3.0,
    )


def test_two_that_stand_in_each_other_have_one_doubt_of_the_whole_life() -> None:
    pair = replace(agent(0.0), static=True), replace(agent(3.5), static=True)
    found = judged((pair[0], 9.0), (pair[1], 1.0))
    ((doubt,),) = [d for _, d in found if d]
    assert (doubt.reason, doubt.start_s) == ("stands in car-1", None)


def test_people_beside_each_other_and_beside_a_car_are_not_in_one_place() -> None:
    body = (0.7, 0.7, 1.75)
    people = [agent(x, 0.95, category="pedestrian", size=body) for x in (0.0, 0.45)]
    assert all(doubts == [] for _, doubts in judged((agent(0.0), 9.0), *((p, 1.0) for p in people)))


def test_who_passes_the_ego_closely_has_no_doubt_by_rounding() -> None:
    rng = np.random.default_rng(0)
    for yaw in rng.uniform(-3, 3, 40):
        c, s = np.cos(yaw), np.sin(yaw)
        beside = agent(-1.9 * s, 1.9 * c, yaw=yaw)
        assert [doubts for _, doubts in judged((beside, 1.0), ego=agent(0.0, yaw=yaw))] == [[]]


@pytest.mark.parametrize(("y_m", "count"), [(0.8, 0), (0.6, 1)])
def test_a_rider_who_passes_a_parked_car_closely_is_there_by_the_errors_of_boxes(y_m, count) -> None:
    # Half widths of 0.9 and 0.35 m meet 1.25 m apart.
    rider = agent(-5.0, y_m, category="cyclist", size=(1.8, 0.7, 1.8), speed=2.5)
    found = judged((agent(0.0), 9.0), (rider, 1.0))
    assert sum(len(doubts) for _, doubts in found) == count
    assert all(len(a.waypoints) == 5 for a, _ in found)


def test_whoever_is_seen_at_a_single_tick_stays_as_in_logs_of_one_frame() -> None:
    now = agent(9.0)
    once = replace(now, waypoints=now.waypoints.take(slice(2, 3)))
    assert [len(a.waypoints.t_s) for a, _ in judged((once, 3.0))] == [1]
    assert judged((replace(once, waypoints=agent(0.5).waypoints.take(slice(2, 3))), 3.0), ego=agent(0.0)) == []


def test_conflicts_are_the_same_whether_ticks_are_looked_at_together_or_in_turn(monkeypatch):
    agents = [agent(0.0), agent(2.2), agent(0.0, t=(1.0, 2.0)), agent(-50.0), agent(-50.0, yaw=np.pi / 2, t=(0.0, 1.5))]
    together, _ = find_conflicts(agents, T)
    monkeypatch.setattr(conflicts, "TICKS_AT_A_TIME", 3)
    in_turn, present = find_conflicts(agents, T)
    assert len(together) > 2
    assert [(c.first, c.second, c.tick.tolist()) for c in in_turn] == [
        (c.first, c.second, c.tick.tolist()) for c in together
    ]
    for one, other in zip(in_turn, together):
        np.testing.assert_allclose(one.share, other.share)
        np.testing.assert_allclose(one.depth_m, other.depth_m)
    np.testing.assert_array_equal(present, AgentTable.of(agents, T).present)


def static(x_m, t, *, confidence=0.9):
    return replace(agent(x_m, t=t), id=f"car at {x_m}", static=True, confidence=confidence)


def life(extended):
    return [(a.waypoints.t_s[0], a.waypoints.t_s[-1]) for a in extended]


def test_static_agents_exist_all_the_time_but_where_something_else_is() -> None:
    timeline = Timeline((np.linspace(0.0, 4.0, 41) * 1e9).astype(np.int64), 0)
    clouds = [None] * 41
    (alone,) = extend_static([static(0.0, (1.0, 2.0))], None, clouds, timeline)
    assert life([alone]) == [(0.0, 4.0)]
    w = alone.waypoints
    assert w.observed.tolist() == [1.0 <= t <= 2.0 for t in w.t_s.tolist()]
    # The ego is in its place until it is 4.4 m away, at 10 m/s; the other car takes it before.
    ego = agent(0.0, speed=10.0)
    (late,) = extend_static([static(0.0, (3.0, 4.0))], ego, clouds, timeline)
    assert life([late])[0][0] == pytest.approx(0.44, abs=0.1)
    pair = extend_static([static(0.0, (0.0, 1.0)), static(1.0, (3.0, 4.0), confidence=0.8)], None, clouds, timeline)
    assert life(pair) == [(0.0, pytest.approx(2.9)), (3.0, 4.0)]
    assert extend_static([ego], None, clouds, timeline) == [ego]


def test_a_place_through_which_rays_pass_is_free() -> None:
    timeline = Timeline((np.linspace(0.0, 4.0, 41) * 1e9).astype(np.int64), 0)
    sensor = np.array([-10.0, 0.0, 0.6])
    y, z = (a.ravel() for a in np.meshgrid(np.linspace(-0.8, 0.8, 9), np.linspace(0.5, 0.6, 5)))

    def rays_to(x_m):
        end = np.column_stack([np.full(len(y), x_m), y, z]).astype(np.float32)
        still = np.zeros(len(end), np.float32)
        free = Rays(end, still, still.astype(np.uint8), sensor[None].astype(np.float32), np.zeros((1, 3), np.float32))
        return Obstacles(0, np.zeros(3), end[:0], still[:0], sensor.astype(np.float32), free)

    # They pass until 1 s, end at the car from then on, and pass again from 3.5 s.
    t = np.linspace(0.0, 4.0, 41)
    clouds = [rays_to(20.0 if s < 0.95 or s > 3.45 else -2.2) for s in t]
    (car,) = extend_static([static(0.0, (2.0, 3.0))], None, clouds, timeline)
    assert life([car]) == [(pytest.approx(1.0), pytest.approx(3.4))]
