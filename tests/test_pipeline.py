"""The whole way as a library: what it gives, what it does not depend on, and logs that lack something."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from extremes.small_log import rows_changed
from plain_settings import AGENTS_ALONE
from worlds import PARKED, tiny_log

from log2sim import Config, Scenario, open_log, reconstruct, replay
from log2sim.datatypes import Labels, Log, Stream
from log2sim.errors import ConfigError, LogError, NothingToReconstruct, ScenarioError
from log2sim.evaluation.metrics.evaluator import evaluate
from log2sim.files.documents import check, write_json
from log2sim.pipeline import Result

UTM_M = (691_000.0, 5_334_000.0, 0.0)
LABELS = Config.load(detect={"name": "labels"}, **AGENTS_ALONE)


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


def test_a_report_that_breaks_its_schema_is_noticed(result: Result) -> None:
    for change in ({"ticks": 0}, {"stages": [{"stage": "x"}]}, {"unreadable": {"front": {"count": 0, "first": ""}}}):
        with pytest.raises(LogError):
            check({**result.report, **change}, "report-1", LogError)


def test_every_camera_and_every_decision_is_stated(result: Result) -> None:
    assert [c["name"] for c in result.scenario.cameras] == ["front"]
    assert all(c["used"] for c in result.scenario.cameras)
    steps = {p["stage"]: p for p in result.scenario.stages}
    assert not steps["fusion of cameras"]["kept"]  # one camera
    assert "one camera" in steps["fusion of cameras"]["reason"]
    assert steps["motion compensation"]["kept"]
    assert all(p["reason"] for p in result.scenario.stages)
    # Times differ from run to run, so they stand in the report alone.
    timed = ("saved_s", "saved_how")
    assert [dict(p) for p in result.scenario.stages] == [
        {k: v for k, v in p.items() if k not in timed} for p in result.report["plan"]
    ]


def test_the_same_log_and_seed_give_the_same_scenario(tiny: tuple[Log, Scenario], result: Result) -> None:
    assert run(tiny[0]).scenario.to_dict() == result.scenario.to_dict()


def test_a_log_is_not_changed_by_a_run(tiny: tuple[Log, Scenario]) -> None:
    log, _ = tiny
    assert log.ego is not None
    poses, boxes = log.ego.map_T_ego.copy(), {n: b.box_px.copy() for n, b in log.image_labels.items()}
    run(log)
    np.testing.assert_array_equal(log.ego.map_T_ego, poses)
    for name, box in boxes.items():
        np.testing.assert_array_equal(log.image_labels[name].box_px, box)


# --- what the result does not depend on


def rewrite(source: Path, target: Path, change: Callable[[dict[str, str]], None]) -> Path:
    """A copy of a log folder with every row of every table changed."""
    shutil.copytree(source, target)
    rows_changed(target, change)
    return target


def moved(shift_m: tuple[float, float, float]) -> Callable[[dict[str, str]], None]:
    def change(row: dict[str, str]) -> None:
        for column, shift in zip(("x_m", "y_m", "z_m"), shift_m):
            if column in row:
                row[column] = repr(float(row[column]) + shift)

    return change


def later(shift_ns: int) -> Callable[[dict[str, str]], None]:
    def change(row: dict[str, str]) -> None:
        row["t_ns"] = str(int(row["t_ns"]) + shift_ns)

    return change


def test_coordinates_of_millions_of_meters_change_nothing(tiny_folder: Path, tmp_path: Path) -> None:
    near = run(open_log(tiny_folder)).scenario
    far = run(open_log(rewrite(tiny_folder, tmp_path / "far", moved(UTM_M)))).scenario
    assert far.map.offset_m == UTM_M
    assert max(np.abs(a.waypoints.x_m).max() for a in far.agents) < 1000
    assert_same_agents(near, far, within=1e-6, shift_m=UTM_M)


def test_a_broken_shift_moves_the_whole_scene_and_nothing_else(tiny_folder: Path, tmp_path: Path) -> None:
    shift = (-2345.678, 1234.567, 89.1)
    near = run(open_log(tiny_folder)).scenario
    far = run(open_log(rewrite(tiny_folder, tmp_path / "far", moved(shift)))).scenario
    # Points are float32 about the ego, and grids of points start at other places: not to the last digit.
    assert_same_agents(near, far, within=1e-3, shift_m=shift)


@pytest.mark.matrix
@pytest.mark.parametrize(
    "shift_ns", [-1_700_000_000_000_000_000, -3_400_000_000_000_000_000, 5_000_000_000_000_000_000]
)
def test_the_epoch_of_the_stamps_changes_nothing(tiny_folder: Path, tmp_path: Path, shift_ns: int) -> None:
    now = run(open_log(tiny_folder)).scenario
    then = run(open_log(rewrite(tiny_folder, tmp_path / "then", later(shift_ns)))).scenario
    assert then.t0_ns == now.t0_ns + shift_ns
    assert_same_agents(now, then, within=1e-9)


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


def test_without_camera_there_are_no_ticks_and_it_says_so(tiny: tuple[Log, Scenario]) -> None:
    log, _ = tiny
    with pytest.raises(LogError, match=r"no camera, which detector .* needs"):
        run(replace(log, cameras={}, streams={"top": log.streams["top"]}, image_labels={}, reference_camera=None))


@pytest.mark.slow
def test_one_of_two_cameras_gives_what_a_log_of_that_camera_gives() -> None:
    front = {"name": "front", "position_m": [1.7, 0.0, 1.5], "size_px": [480, 300], "offset_s": 0.03}
    left = {"name": "left", "position_m": [1.7, 0.4, 1.5], "size_px": [480, 300], "yaw_deg": 50.0, "offset_s": 0.04}
    both, _ = tiny_log(camera=[front, left])
    alone = replace(
        both,
        cameras={"front": both.cameras["front"]},
        streams={k: v for k, v in both.streams.items() if k != "left"},
        image_labels={"front": both.image_labels["front"]},
        reference_camera="front",
    )
    chosen = run(both, cameras=("front",)).scenario
    assert_same_agents(chosen, run(alone).scenario, within=1e-9)
    assert {c["name"]: c["used"] for c in chosen.cameras}["front"]
    assert not {c["name"]: c["used"] for c in chosen.cameras}.get("left", False)
    full = run(both)
    assert next(p for p in full.report["plan"] if p["stage"] == "fusion of cameras")["kept"]
    assert set(full.report["detections"]) == {"front", "left"}


def test_nobody_in_sight_leaves_the_ego_alone() -> None:
    log, _ = tiny_log(agents=[PARKED | {"pose": [-60.0, 4.0, 0.0]}])
    scenario = run(log).scenario
    assert [a.id for a in scenario.agents] == ["ego"]


def test_nobody_and_no_ego_is_nothing_to_reconstruct(tiny: tuple[Log, Scenario]) -> None:
    log, _ = tiny
    far = replace(log.image_labels["front"], t_ns=log.image_labels["front"].t_ns + 10**12)
    fixed = replace(
        log,
        ego=None,
        labels=None,
        image_labels={"front": far},
        cameras={n: replace(c, mount="map") for n, c in log.cameras.items()},
        lidars={n: replace(s, mount="map") for n, s in log.lidars.items()},
    )
    with pytest.raises(NothingToReconstruct, match="no ego poses, and no object"):
        run(fixed)


def test_a_single_frame_gives_a_scenario(tiny: tuple[Log, Scenario]) -> None:
    got = run(tiny[0], start_s=0.4, stop_s=0.4)
    check(got.report, "report-1", LogError)
    assert got.report["ticks"] == 1
    assert got.scenario.duration_s == 0.0
    assert got.scenario.ego is not None


def test_progress_runs_to_the_end(tiny: tuple[Log, Scenario]) -> None:
    told: list[tuple[str, int, int]] = []
    reconstruct(tiny[0], LABELS, progress=lambda *step: told.append(step))
    counted = [(done, total) for _, done, total in told if total]
    assert counted == [(k, 10) for k in range(11)]
    assert {done for _, done, total in told if not total} == {0}  # stages whose length is not known beforehand


def test_a_wrong_camera_is_refused(tiny: tuple[Log, Scenario]) -> None:
    with pytest.raises(ConfigError, match="no camera 'frnt'"):
        run(tiny[0], cameras=("frnt",))


# --- replay of what came out


def test_the_scenario_replays_and_the_replay_reads_back(result: Result, tmp_path: Path) -> None:
    from log2sim.simulation.result import Replay

    done = replay(result.scenario)
    done.save(tmp_path / "r.json")
    assert {a.id for a in Replay.load(tmp_path / "r.json").agents} == {a.id for a in result.scenario.agents}
    assert done.metrics["cross_track_rms_m"] < 0.1
    assert not [c for c in done.metrics["collisions"] if not c["in_log"]]


def test_a_scenario_by_hand_checks_itself(tmp_path: Path, result: Result) -> None:
    document = result.scenario.to_dict()
    document["agents"][0]["waypoints"]["speed_mps"].pop()
    with pytest.raises(ScenarioError, match=r"speed_mps has \d+ values, t_s has"):
        Scenario.from_dict(document)


def test_a_stream_that_fails_now_and_then_is_counted_by_stream(tiny: tuple[Log, Scenario]) -> None:
    from log2sim.errors import RecordError

    log, truth = tiny
    sound = log.streams["top"]

    def read(i: int) -> Any:
        if i % 3 == 0:
            raise RecordError(f"sweep {i} is gone")
        return sound.read(i)

    got = run(replace(log, streams={**log.streams, "top": Stream("top", sound.t_ns, read)}))
    gone = len(range(0, len(sound.t_ns), 3))
    assert got.report["unreadable"]["top"]["count"] == gone - (len(sound.t_ns) % 3 == 1)  # no frame asks for the last
    assert got.report["unreadable"]["top"]["first"] == "sweep 0 is gone"
    assert evaluate(got.scenario, truth)["recall"] >= 0.9
