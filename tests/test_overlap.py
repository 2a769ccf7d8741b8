"""No two agents in one place, none in the ego's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from log2sim.agents.candidate import AgentCandidate, name_agents
from log2sim.agents.judge import suppress_duplicates
from log2sim.datatypes import Agent, Waypoints


def agent(x_m, y_m=0.0, yaw=0.0, category="car", size=(4.4, 1.8, 1.5), t=(0.0, 4.0), speed=0.0):
    t_s = np.linspace(*t, 5)
    n = len(t_s)
    waypoints = Waypoints(
        t_s=t_s, x_m=x_m + speed * t_s, y_m=np.full(n, y_m), z_m=np.full(n, 0.7), yaw_rad=np.full(n, yaw),
        speed_mps=np.full(n, speed), observed=np.ones(n, dtype=bool), sigma_xy_m=np.full(n, 0.1),
    )  # fmt: skip
    return Agent("", category, size, waypoints)


def candidate(built, evidence=1.0):
    """A confirmed candidate; duplicates are judged without its track."""
    return AgentCandidate(built, evidence, True, None, None)


def kept(*built, ego=None):
    named = name_agents(suppress_duplicates([candidate(a, e) for a, e in built], ego))
    return [c.agent for c in named]


def names(*built, ego=None):
    return [a.id for a in kept(*built, ego=ego)]


def test_of_two_in_one_place_the_one_with_more_evidence_stays():
    left = kept((agent(10.0), 3.0), (agent(10.8, size=(5.0, 1.9, 1.6)), 9.0))
    assert [a.size_m[0] for a in left] == [5.0]
    assert left[0].id == "car-1"


def test_neighbors_bumper_to_bumper_both_stay_and_are_numbered_by_their_start():
    assert names((agent(15.0), 9.0), (agent(10.3), 3.0)) == ["car-1", "car-2"]
    later = replace(agent(30.0).waypoints, t_s=np.linspace(1.0, 4.0, 5))
    ordered = kept((replace(agent(30.0), waypoints=later), 9.0), (agent(50.0), 1.0))
    assert [a.waypoints.x_m[0] for a in ordered] == [50.0, 30.0]


@pytest.mark.parametrize(("apart_m", "count"), [(0.2, 1), (0.5, 2)])
def test_people_are_doubles_only_where_they_stand_in_each_other(apart_m, count):
    body = (0.7, 0.6, 1.75)
    pair = [(agent(x, category="pedestrian", size=body), 1.0) for x in (5.0, 5.0 + apart_m)]
    assert len(names(*pair)) == count


@pytest.mark.parametrize(("y_m", "count"), [(0.0, 1), (0.85, 1), (1.0, 2)])
def test_a_person_whose_center_is_outside_a_car_is_beside_it(y_m, count):
    # The car's side is at 0.9 m, as far as sizes of cars are known.
    person = agent(10.5, y_m, category="pedestrian", size=(0.7, 0.7, 1.75))
    assert len(names((agent(10.0), 9.0), (person, 2.0))) == count
