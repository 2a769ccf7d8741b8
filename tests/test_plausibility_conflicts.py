"""Agents in one place at one time: the less likely one is cut to what is possible, or doubted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from worlds import rows_at, waypoints

from log2sim.agents.candidate import AgentCandidate, Timeline, name_agents
from log2sim.agents.judge import conflict_doubts, extend_static, find_conflicts, resolve_conflicts, suppress_duplicates
from log2sim.datatypes import Agent, Track

T = np.linspace(0.0, 4.0, 5)


def passing(y_m):
    """A car that comes from behind, 10 m in 4 s."""
    return agent(-10.0, y_m, speed=2.5)


def judged(*built, ego=None):
    """What is left of agents with their confidence, with doubts."""
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


def test_a_way_that_ends_in_the_ego_is_cut_where_it_enters() -> None:
    ego = agent(0.0)
    # Both are 4.4 m long: they meet when the centers are that far apart, at 2.24 s; waypoints stand every second.
    ((cut, doubts),) = judged((passing(0.3), 0.9), ego=ego)
    assert cut.waypoints.t_s.tolist() == [0.0, 1.0, 2.0]
    assert cut.waypoints.x_m.tolist() == [-10.0, -7.5, -5.0]
    assert doubts == []
    way = passing(0.3).waypoints
    backward = replace(passing(0.3), waypoints=replace(way, x_m=way.x_m[::-1]))
    ((late, _),) = judged((backward, 0.9), ego=ego)
    assert late.waypoints.t_s.tolist() == [2.0, 3.0, 4.0]


def test_what_is_in_the_ego_all_the_time_is_dropped() -> None:
    assert judged((agent(1.0, 0.5, yaw=0.7), 0.9), ego=agent(0.0)) == []


def test_of_two_that_meet_at_an_end_the_less_likely_one_ends_before() -> None:
    standing = agent(0.0)
    for evidence, ends in (((0.9, 0.1), 2.0), ((0.1, 0.9), 4.0)):
        found = {a.waypoints.speed_mps[0]: a for a, _ in judged((standing, evidence[0]), (passing(0.3), evidence[1]))}
        assert found[2.5].waypoints.t_s[-1] == ends


def test_who_drives_through_the_middle_of_another_is_doubted_by_name_and_time() -> None:
    standing = agent(0.0)
    through = agent(-6.0, speed=3.0)
    found = {a.waypoints.speed_mps[0]: (a, d) for a, d in judged((standing, 0.9), (through, 0.1))}
    assert found[0.0][1] == []
    kept, (doubt,) = found[3.0]
    assert len(kept.waypoints) == 5
    assert (doubt.kind, doubt.sentence, doubt.start_s, doubt.end_s) == (
        "passes_through",
        "passes through car-2 at 2.0 s",
        1.0,
        3.0,
    )


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


def agent(x_m, y_m=0.0, yaw=0.0, category="car", size=(4.4, 1.8, 1.5), t=(0.0, 4.0), speed=0.0):
    t_s = np.linspace(*t, 5)
    return Agent("", category, size, waypoints(t_s, x_m + speed * t_s, y_m, 0.7, yaw, speed))


def candidate(built, confidence=0.5):
    """A candidate; duplicates and conflicts are judged without its geometry."""
    track = Track(built.category, np.arange(3), rows_at(np.zeros((3, 2)), built.category))
    return AgentCandidate(replace(built, confidence=confidence), track, None)


def kept(*built, ego=None):
    named = name_agents(suppress_duplicates([candidate(a, e) for a, e in built], ego))
    return [c.agent for c in named]


def names(*built, ego=None):
    return [a.id for a in kept(*built, ego=ego)]


def test_of_two_in_one_place_the_one_with_more_evidence_stays():
    left = kept((agent(10.0), 0.3), (agent(10.8, size=(5.0, 1.9, 1.6)), 0.9))
    assert [a.size_m[0] for a in left] == [5.0]
    assert left[0].id == "car-1"


def test_neighbors_bumper_to_bumper_both_stay_and_are_numbered_by_their_start():
    assert names((agent(15.0), 0.9), (agent(10.3), 0.3)) == ["car-1", "car-2"]
    later = replace(agent(30.0).waypoints, t_s=np.linspace(1.0, 4.0, 5))
    ordered = kept((replace(agent(30.0), waypoints=later), 0.9), (agent(50.0), 0.1))
    assert [a.waypoints.x_m[0] for a in ordered] == [50.0, 30.0]


@pytest.mark.parametrize(("apart_m", "count"), [(0.2, 1), (0.5, 2)])
def test_people_are_doubles_only_where_they_stand_in_each_other(apart_m, count):
    body = (0.7, 0.6, 1.75)
    pair = [(agent(x, category="pedestrian", size=body), 0.1) for x in (5.0, 5.0 + apart_m)]
    assert len(names(*pair)) == count


@pytest.mark.parametrize(("y_m", "count"), [(0.0, 1), (0.85, 1), (1.0, 2)])
def test_a_person_whose_center_is_outside_a_car_is_beside_it(y_m, count):
    # The car's side is at 0.9 m, as far as sizes of cars are known.
    person = agent(10.5, y_m, category="pedestrian", size=(0.7, 0.7, 1.75))
    assert len(names((agent(10.0), 0.9), (person, 0.2))) == count
