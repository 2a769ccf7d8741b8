"""The whole way as a library: what it gives, what it does not depend on, and logs that lack something."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from plain_settings import AGENTS_ALONE, ALL_KEPT
from worlds import PARKED, tiny_log

from log2sim import Config, Scenario, reconstruct
from log2sim.datatypes import Labels, Log
from log2sim.errors import LogError
from log2sim.evaluation.metrics.evaluator import evaluate
from log2sim.files.documents import check, write_json
from log2sim.report import Result

LABELS = Config.load(detect={"name": "labels"}, **AGENTS_ALONE, **ALL_KEPT)


def run(log: Log, **changes: Any) -> Result:
    return reconstruct(log, LABELS.changed(**changes))


@pytest.fixture(scope="module")
def tiny() -> tuple[Log, Scenario]:
    return tiny_log()


@pytest.fixture(scope="module")
def result(tiny: tuple[Log, Scenario]) -> Result:
    return run(tiny[0])


def assert_same_agents(
    a: Scenario, b: Scenario, *, within: float, shift_m: tuple[float, ...] = (0.0, 0.0, 0.0)
) -> None:
    """The same agents with the same columns; `shift_m` is what b's map coordinates, offset included, are ahead of a's."""
    assert [x.id for x in a.agents] == [x.id for x in b.agents]
    move = np.array(b.map.offset_m) - np.array(a.map.offset_m) - np.array(shift_m)
    for x, y in zip(a.agents, b.agents):
        assert (x.category, x.static) == (y.category, y.static)
        np.testing.assert_allclose(x.size_m, y.size_m, atol=within)
        for k, column in enumerate(("x_m", "y_m", "z_m")):
            np.testing.assert_allclose(
                getattr(x.waypoints, column), getattr(y.waypoints, column) + move[k], rtol=0, atol=within
            )
        np.testing.assert_allclose(np.cos(x.waypoints.yaw_rad - y.waypoints.yaw_rad), 1.0, atol=within)
        np.testing.assert_allclose(x.waypoints.speed_mps, y.waypoints.speed_mps, rtol=0, atol=within)
        np.testing.assert_allclose(x.waypoints.t_s, y.waypoints.t_s, rtol=0, atol=1e-9)
        np.testing.assert_array_equal(x.waypoints.observed, y.waypoints.observed)


def test_a_log_becomes_a_scenario_that_keeps_its_schema_and_matches_the_truth(
    tiny: tuple[Log, Scenario], result: Result, tmp_path: Path
) -> None:
    log, truth = tiny
    scenario, report = result.scenario, result.report
    scenario.save(tmp_path / "s.json")
    assert Scenario.load(tmp_path / "s.json").to_dict() == scenario.to_dict()
    check(report, "report-1", LogError)
    write_json(tmp_path / "r.json", report)  # no NaN in it
    metrics = evaluate(scenario, truth)
    check(metrics, "metrics-1", LogError)
    assert metrics["recall"] == 1.0
    assert metrics["precision"] == 1.0
    assert metrics["position_rmse_m"] < 0.4
    assert metrics["ego"]["position_rmse_m"] < 0.02  # its poses have no noise here
    assert scenario.provenance["log"]["digest"] == log.digest
    assert report["ticks"] == 10
    assert {s["stage"] for s in report["stages"]} >= {"sync", "detect", "measure", "fuse", "track", "smooth"}
    assert 0.5 * report["seconds"] < sum(s["seconds"] for s in report["stages"]) <= 1.001 * report["seconds"]
    assert set(report["sync"]["streams"]) == {"front", "top"}
    assert report["unreadable"] == {}
    assert report["detections"]["front"] >= 20  # two or three objects in ten frames


# --- what the result does not depend on


def test_the_order_and_the_ids_of_labels_change_nothing(tiny: tuple[Log, Scenario], result: Result) -> None:
    log, _ = tiny
    rng = np.random.default_rng(0)
    assert log.labels is not None
    order = rng.permutation(len(log.labels.t_ns))
    columns = {
        k: getattr(log.labels, k)[order]
        for k in ("t_ns", "category", "center_m", "size_m", "yaw_rad", "visible")
        if getattr(log.labels, k) is not None
    }
    mixed = Labels(**columns, track_id=rng.permutation([f"t{k}" for k in range(len(order))]))
    assert_same_agents(result.scenario, run(replace(log, labels=mixed)).scenario, within=1e-9)


# --- logs that lack something


def test_without_lidar_the_cameras_alone_find_who_is_there(tiny: tuple[Log, Scenario]) -> None:
    log, truth = tiny
    blind = replace(log, lidars={}, streams={"front": log.streams["front"]})
    got = run(blind)
    check(got.report, "report-1", LogError)
    assert got.report["measurements"]["with_lidar"] == 0
    assert got.report["measurements"]["total"] > 0
    metrics = evaluate(got.scenario, truth)
    assert metrics["recall"] >= 0.5
    assert metrics["position_median_m"] < 1.5
    again = run(blind)  # places come from the homography, and that from random samples
    assert again.report["homography"] == got.report["homography"]
    assert again.scenario.to_dict() == got.scenario.to_dict()
    step = next(p for p in got.scenario.stages if p["stage"] == "homography")
    assert step["kept"]
    assert "without LiDAR" in step["reason"]


def test_nobody_in_sight_leaves_the_ego_alone() -> None:
    log, _ = tiny_log(agents=[PARKED | {"pose": [-60.0, 4.0, 0.0]}])
    scenario = run(log).scenario
    assert [a.id for a in scenario.agents] == ["ego"]
