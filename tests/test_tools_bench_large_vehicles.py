"""Long vehicles close by are found where they are: scenes of the benchmark of large vehicles, from exact boxes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytestmark = pytest.mark.slow

TOOLS = Path(__file__).resolve().parents[1] / "tools"


@pytest.fixture(autouse=True)
def _tools_on_path(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(TOOLS))


@pytest.mark.slow
def test_a_minibus_at_the_curb_neither_slides_nor_turns_nor_grows() -> None:
    from benchmarks.large_vehicles import measured

    (found,) = next(measured(["minibus"], ["curb"], "labels", 0))
    assert found.recall == 1.0
    assert found.position_m is not None
    assert found.position_m < 0.3
    assert found.yaw_deg is not None
    assert found.yaw_deg < 3.0
    assert found.speed_mps == 0.0
    assert found.length_m is not None
    assert abs(found.length_m) < 0.5
    assert found.width_m is not None
    assert abs(found.width_m) < 0.3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "pose"),
    [("sedan", "curb"), ("box_truck", "beside"), ("bus", "start"), ("road_train", "curb"), ("road_train", "start")],
)
def test_whoever_is_seen_from_both_ends_is_within_a_foot_and_three_degrees(kind: str, pose: str) -> None:
    from benchmarks.large_vehicles import measured

    for rows in measured([kind], [pose], "labels", 0):
        (found,) = (f for f in rows if f.vehicle == "target")
        assert found.recall > 0.95
        assert found.position_m is not None
        assert found.position_m < 0.3
        assert found.yaw_deg is not None
        assert found.yaw_deg < 3.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "pose"), [("bus", "oncoming"), ("road_train", "overtaking"), ("road_train", "overtaken")]
)
def test_who_passes_the_ego_is_there_though_the_only_camera_looks_ahead(kind: str, pose: str) -> None:
    from benchmarks.large_vehicles import measured

    (found,) = next(measured([kind], [pose], "labels", 0, cameras=1))
    assert found.recall > 0.95
    assert found.extra == 0
    assert found.position_m is not None
    assert found.position_m < 0.3
    assert found.yaw_deg is not None
    assert found.yaw_deg < 3.0


def test_the_sweep_is_where_the_boxes_are() -> None:
    from benchmarks.large_vehicles import KINDS, log_of, scene_of

    log, truth = log_of(scene_of("bus", "end_on", False, exact=True), seed=0)
    sweep = log.streams["top"].read(0)
    (bus,) = truth.others
    on_sensor, known = log.map_T_sensor("top", sweep.stamp_ns)
    assert known.all()
    points = sweep.xyz_m @ on_sensor[0, :3, :3].T + on_sensor[0, :3, 3]
    above = points[points[:, 2] > 0.2]
    rear_m = bus.waypoints.x_m[0] - KINDS["bus"][1][0] / 2
    np.testing.assert_allclose(above[:, 0].min(), rear_m, atol=1e-3)
    assert np.abs(above[:, 1]).max() <= KINDS["bus"][1][1] / 2 + 1e-3
