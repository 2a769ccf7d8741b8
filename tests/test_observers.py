"""Which end measured an agent, and when."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from log2sim.agents.candidate import Timeline
from log2sim.agents.estimate import spans_of_ticks
from log2sim.datatypes import Agent, Scenario, Waypoints
from log2sim.edit.apply import edit
from log2sim.edit.edits import Shift, Speed
from log2sim.logs.opening import open_log
from log2sim.tracking.forward import MAX_MISSES

SAMPLE = Path(__file__).resolve().parents[1] / "samples" / "crossing"


def test_a_span_goes_on_over_missed_ticks_and_ends_at_longer_gaps() -> None:
    timeline = Timeline(np.arange(40, dtype=np.int64) * 100_000_000, 0)
    tick = np.array([2, 3, 3 + MAX_MISSES + 1, 3 + 2 * (MAX_MISSES + 1) + 1])
    last = (3 + MAX_MISSES + 1) / 10
    alone = float(timeline.seconds(timeline.t_ns[tick[-1:]])[0])
    assert spans_of_ticks(tick, timeline) == (pytest.approx((0.2, last)), (alone, alone))


def agent() -> Agent:
    t = np.arange(0.0, 4.0)
    zero = np.zeros(4)
    w = Waypoints(t, 10 * t, zero, zero, zero, np.full(4, 10.0), np.ones(4, bool), np.full(4, 0.1))
    return Agent("car-1", "car", (4.5, 1.8, 1.5), w, observed_by={"vehicle": ((1.0, 3.0),), "road": ((0.0, 2.0),)})


def test_edits_in_time_move_the_spans(tmp_path: Path) -> None:
    log = open_log(SAMPLE)
    source = Scenario("s", 0, 3.0, (agent(),), log.map, (), (), {})
    moved = edit(source, [Shift("car-1", 1.0), Speed("car-1", 2.0)]).scenario.agents[0]
    # Later by 1 s, then twice as fast from the first waypoint on, which is at 1 s.
    assert moved.observed_by == {"vehicle": ((1.5, 2.5),), "road": ((1.0, 2.0),)}
    path = tmp_path / "s.json"
    replace(source, agents=(moved,)).save(path)
    assert Scenario.load(path).agents[0].observed_by == moved.observed_by
