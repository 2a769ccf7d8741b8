"""What a run holds in memory of each tick stays small, whatever the sensors record: the rest waits in a file."""

from __future__ import annotations

import numpy as np
from looped_log import loop_log
from worlds import tiny_log


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
