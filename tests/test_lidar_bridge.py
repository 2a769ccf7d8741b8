"""Poses that froze, or are missing, for longer than the motion around tells: LiDAR odometry bridges them where it fits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from localization_worlds import BEND, HOUSES, drive

from log2sim.datatypes import Log
from log2sim.geometry import PoseTrack
from log2sim.localization.choice import localize_like
from log2sim.localization.given_poses import check_poses, list_faults
from log2sim.localization.verdict import bridge_by_lidar

pytest.importorskip("small_gicp")


def frozen_log(buildings: list[dict[str, object]], waypoints: list[list[float]]) -> tuple[Log, PoseTrack]:
    """Poses that stay from 2.4 s to the end at 4 s, and the true ones."""
    log, true = drive(buildings, waypoints, duration_s=4.0)
    poses = true.map_T_ego.copy()
    from_row = int(np.searchsorted(true.t_ns, true.t_ns[0] + 2_400_000_000))
    poses[from_row:] = poses[from_row]
    return log.changed(ego=replace(true, map_T_ego=poses)), true


def silent(done: int, total: int) -> None:
    assert 0 < done <= total


@pytest.mark.slow
def test_odometry_goes_on_where_the_motion_before_does_not_tell_the_pose() -> None:
    log, true = frozen_log(HOUSES, BEND)
    assert log.ego is not None
    checked = check_poses(log.ego)
    found = bridge_by_lidar(log, checked, silent)
    asked = true.t_ns[true.t_ns <= log.streams["top"].t_ns[-1]]
    assert not checked.track.at(asked)[1].all()
    poses, known = found.track.at(asked)
    assert known.all()
    off = np.linalg.norm(poses[:, :2, 3] - true.at(asked)[0][:, :2, 3], axis=1)
    assert off.max() < 0.25
    (fault,) = list_faults(log, found.stretches, int(true.t_ns[0]), int(true.t_ns[-1]))
    assert fault.treatment == "corrected"
    assert fault.other == "LiDAR odometry"
    again = localize_like(log, {"poses": {"source": "given"}})
    assert again.ego is not None
    np.testing.assert_array_equal(again.ego.map_T_ego, found.track.map_T_ego)
