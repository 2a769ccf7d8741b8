"""The stage clock against a clock that the test turns by hand."""

from __future__ import annotations

import pytest

from log2sim.files import stages
from log2sim.files.stages import StageClock


class Hand:
    """A clock that stands until it is moved."""

    def __init__(self):
        self.now = 1000.0

    def __call__(self):
        return self.now

    def move(self, seconds):
        self.now += seconds


@pytest.fixture
def hand(monkeypatch):
    made = Hand()
    monkeypatch.setattr(stages.time, "perf_counter", made)
    return made


def test_an_inner_stage_stops_the_clock_of_the_outer_one(hand):
    watch = StageClock()
    with watch.stage("outer"):
        hand.move(1.0)
        with watch.stage("inner"):
            hand.move(4.0)
            with watch.stage("innermost"):
                hand.move(16.0)
            hand.move(32.0)
        hand.move(2.0)
    assert watch.seconds == {"outer": 3.0, "inner": 36.0, "innermost": 16.0}
    assert sum(watch.seconds.values()) == watch.total()


def fail(watch, hand):
    with watch.stage("fails"):
        hand.move(3.0)
        raise RuntimeError


def test_a_stage_that_fails_is_counted_and_the_outer_one_runs_on(hand):
    watch = StageClock()
    with watch.stage("outer"):
        with pytest.raises(RuntimeError):
            fail(watch, hand)
        hand.move(5.0)
    assert watch.seconds == {"fails": 3.0, "outer": 5.0}


def test_the_table_holds_ticks_per_second_and_none_for_a_stage_that_took_no_time(hand):
    watch = StageClock()
    with watch.stage("sync"):
        pass
    with watch.stage("detect"):
        hand.move(4.0)
    none, some = watch.table(ticks=10)
    assert (none["stage"], none["seconds"], none["ticks_per_second"]) == ("sync", 0.0, None)
    assert (some["stage"], some["seconds"], some["ticks_per_second"]) == ("detect", 4.0, 2.5)
    assert StageClock().table(ticks=10) == []
