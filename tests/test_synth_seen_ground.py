"""Ground that a synthetic log shows: in view and near, not behind what stands there."""

from __future__ import annotations

from typing import Any

import numpy as np
import shapely
from worlds import tiny_log

from log2sim.evaluation.road import seen_ground


def seen(agents: list[dict[str, Any]] | None = None, **changes: Any) -> Any:
    still = {"waypoints": [[0.0, 0.0, 0.0], [20.0, 0.0, 3.0]], "wait_s": [[0, 60.0]]}
    _, truth = tiny_log(agents or [], ego=still, duration_s=0.6, **changes)
    return seen_ground(truth, np.zeros(3))


def test_a_camera_shows_what_is_in_view_within_forty_meters() -> None:
    area = seen(lidar=[])
    # The camera at x = 1.7 looks east, 70 degrees wide: at 20 m to 14 m aside.
    for x, y, expected in (
        (20.5, 0.5, True),
        (20.5, 10.5, True),
        (20.5, 17.5, False),
        (-5.5, 0.5, False),
        (48.5, 0.5, False),
    ):
        assert bool(shapely.contains_xy(area, x, y)) == expected, (x, y)
    half_angle = np.deg2rad(35)
    reach = 40.0**2 * half_angle - 1.7**2  # of the sector, but what lies too low in front of the car
    assert 0.75 * reach < area.area < 1.05 * reach


def test_what_stands_there_hides_the_ground_behind_it() -> None:
    wall = {"center": [12.0, -8.0], "size_m": [1.0, 14.0, 6.0]}
    van = {"id": "van", "category": "car", "size_m": [5.0, 2.0, 2.4], "pose": [12.0, 4.0, 0.0]}
    free, hidden = seen(lidar=[]), seen([van], lidar=[], building=[wall])
    for x, y in ((25.5, -8.5), (18.5, 5.5)):
        assert shapely.contains_xy(free, x, y)
        assert not shapely.contains_xy(hidden, x, y)
    assert shapely.contains_xy(hidden, 9.5, -2.5)
    assert free.buffer(1e-9).contains(hidden)
