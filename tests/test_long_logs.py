"""What a run holds in memory of each tick stays small, whatever the sensors record: the rest waits in a file."""

from __future__ import annotations

import gc
import tracemalloc

import numpy as np
import pytest
from looped_log import loop_log
from worlds import tiny_log

from log2sim import Config
from log2sim.datatypes import Log
from log2sim.files import arrays
from log2sim.pipeline import infer_scenario, observe_log, start


def held_after(log: Log, times: int) -> tuple[int, int]:
    """Ticks of a log that is driven several times, and the bytes held once it is reconstructed."""
    config = Config.load(detect={"name": "lidar:labels"})
    tracemalloc.start()
    run = start(loop_log(log, times), config)
    before = tracemalloc.get_traced_memory()[0]
    observations = observe_log(run)
    result = infer_scenario(run, observations)
    gc.collect()
    held = tracemalloc.get_traced_memory()[0] - before
    tracemalloc.stop()
    assert len(result.scenario.agents) > times
    return len(run.schedule), held


def test_a_looped_log_goes_on_where_it_ended() -> None:
    log, _ = tiny_log()
    long = loop_log(log, 3)
    assert log.ego is not None
    assert long.ego is not None
    step = len(log.ego.t_ns) - 1
    np.testing.assert_allclose(long.ego.map_T_ego[step, :3, 3], log.ego.map_T_ego[-1, :3, 3], atol=1e-9)
    for name, stream in long.streams.items():
        assert np.all(np.diff(stream.t_ns) > 0)
        assert len(stream.t_ns) % 3 == 0
        if name in log.lidars:
            third = stream.read(2 * len(stream.t_ns) // 3)
            assert third.stamp_ns == int(stream.t_ns[2 * len(stream.t_ns) // 3])


@pytest.mark.slow
def test_what_is_held_of_a_tick_is_far_less_than_what_is_kept_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    log, _ = tiny_log()
    monkeypatch.setattr(arrays, "MEMORY_BYTES", 0)
    (few, short), (many, long) = held_after(log, 2), held_after(log, 6)
    # All in memory, it is 90 KB a tick.
    assert (long - short) / (many - few) < 20_000
