"""Tools beside the package run: one small run of each kind."""

from __future__ import annotations

import json
import pickle
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import bench_lanes
import bench_poses
import bench_warnings
import confidence_logs
import evaluate_kitti
import fit_confidence
import fit_late_fusion
import map_repeatability as tool
import numpy as np
import profile_ticks
import pytest
import track_kitti
from conftest import SHARED
from evaluate_kitti import evaluate
from ground_worlds import World, empty_scenario, world_log
from kitti_boxes import read_tracks
from kitti_paths import smooth_paths
from localization_worlds import BEND, HOUSES, LIDAR
from localization_worlds import drive as drive_around
from mutation import verdict
from mutation.supervising import Harness, indices, run_many
from profile_ticks import Measured, Times
from replay_maneuvers import MANEUVERS, scenario_of
from test_track import seen, stamps
from worlds import tiny_toml

from log2sim.config import MapConfig
from log2sim.datatypes import Frame, Log, Measurements, Track
from log2sim.geometry import NS_PER_S
from log2sim.logs.native.writer import write_log
from log2sim.road.builder import map_ground
from log2sim.road.ground_map import GroundMap
from log2sim.simulation.runner import replay
from log2sim.tracking.forward import ACCELERATION_MPS2, first_velocity, measurement_noise, predict

KITTI = SHARED / "data" / "kitti_tracking"


@pytest.mark.slow
@pytest.mark.real
@pytest.mark.parametrize("online", [True, False])
def test_a_recorded_sequence_is_tracked_ahead_of_the_baseline(tmp_path: Path, online: bool) -> None:
    if not KITTI.is_dir():
        pytest.skip(
            "the KITTI tracking labels and detections are not beside this checkout (../shared/data/kitti_tracking)"
        )
    (tmp_path / "calib").mkdir()
    detections = tmp_path / "detections"
    detections.mkdir()
    (detections / "0004.txt").write_bytes((KITTI / "detections" / "pointrcnn_Car" / "0004.txt").read_bytes())
    arguments = [
        "--detections",
        str(detections),
        "--calib",
        str(KITTI / "calib"),
        "--ego-motion",
        str(KITTI / "ego_motion"),
    ]
    assert track_kitti.main([*arguments, "--out", str(tmp_path / "out"), *(["--online"] if online else [])]) == 0
    result = {"0004": read_tracks(tmp_path / "out" / "0004.txt")}
    score = evaluate(result, {"0004": read_tracks(KITTI / "label_02" / "0004.txt")}, "Car")
    assert score.id_switches <= 1
    # AB3DMOT with its repository settings has 90.4 and 83.7 here.
    assert score.samota > 94.0
    assert score.mota > (90.0 if online else 93.0)
    report = tmp_path / "score.json"
    folders = ["--results", str(tmp_path / "out"), "--labels", str(KITTI / "label_02")]
    assert evaluate_kitti.main([*folders, "--categories", "Car", "--out", str(report)]) == 0
    assert report.is_file()


def a_track(ticks: list[int], t_ns: np.ndarray, seed: int = 0, category: str = "car", sigma_m: float = 0.3) -> Track:
    rng = np.random.default_rng(seed)
    xy = np.column_stack([0.9 * np.array(ticks), -0.2 * np.array(ticks)]) + rng.normal(0, sigma_m, (len(ticks), 2))
    rows = [seen(p[None], t_ns[k], category=category, sigma_m=sigma_m) for k, p in zip(ticks, xy)]
    return Track(category, np.array(ticks), Measurements.join(rows))


def least_squares(t: Track, t_ns: np.ndarray, *, whole_boxes: bool) -> tuple[np.ndarray, np.ndarray]:
    """States (n, 4) and covariances (n, 4, 4) from one dense normal matrix over all ticks of the track's life."""
    group = np.array(["vehicle"])
    ticks = np.arange(t.tick[0], t.tick[-1] + 1)
    n = len(ticks)
    information, rhs = np.zeros((4 * n, 4 * n)), np.zeros(4 * n)
    r = measurement_noise(t.measurements.covariance, np.repeat(group, len(t)), whole_boxes=whole_boxes)
    for k, tick in enumerate(t.tick):
        at = 4 * (tick - ticks[0])
        information[at : at + 2, at : at + 2] += np.linalg.inv(r[k])
        rhs[at : at + 2] += np.linalg.solve(r[k], t.measurements.center_m[k, :2])
    axis = t.measurements.yaw_rad[:1] if whole_boxes else np.array([np.nan])
    speed = first_velocity(axis, group)[0]
    information[2:4, 2:4] += np.linalg.inv(speed)
    for k in range(n - 1):
        dt = (t_ns[ticks[k + 1]] - t_ns[ticks[k]]) / NS_PER_S
        noise = predict(np.zeros((1, 4)), np.zeros((1, 4, 4)), dt, np.array([ACCELERATION_MPS2["vehicle"]]))[1][0]
        step = np.eye(4)
        step[0, 2] = step[1, 3] = dt
        link = np.hstack([-step, np.eye(4)])
        information[4 * k : 4 * k + 8, 4 * k : 4 * k + 8] += link.T @ np.linalg.inv(noise) @ link
    covariance = np.linalg.inv(information)
    blocks = np.stack([covariance[4 * k : 4 * k + 4, 4 * k : 4 * k + 4] for k in range(n)])
    return np.linalg.solve(information, rhs).reshape(n, 4), blocks


@pytest.mark.slow
@pytest.mark.parametrize("whole_boxes", [False, True])
def test_smoothed_paths_solve_the_whole_least_squares_problem(whole_boxes: bool) -> None:
    t_ns = stamps(30)
    t_ns[12:] += 40_000_000  # ticks need not be even
    tracks = [
        a_track([0, 1, 2, 6, 7, 11, 12, 13], t_ns, 1),
        a_track([5, 6], t_ns, 2),
        a_track(list(range(20, 30)), t_ns, 3),
        a_track([8], t_ns),
    ]
    paths = smooth_paths(tracks, t_ns, whole_boxes=whole_boxes)
    assert paths.tick.tolist() == [*range(14), 5, 6, *range(20, 30), 8]
    for k, t in enumerate(tracks):
        of = paths.track == k
        mean, covariance = least_squares(t, t_ns, whole_boxes=whole_boxes)
        np.testing.assert_allclose(paths.mean[of], mean, atol=1e-7)
        np.testing.assert_allclose(paths.covariance[of], covariance, atol=1e-7)
        assert paths.tick[of][paths.row[of] >= 0].tolist() == t.tick.tolist()
        assert paths.row[of][paths.row[of] >= 0].tolist() == list(range(len(t)))


@pytest.mark.slow
def test_log2sim_and_plain_numpy_find_the_same_points_in_boxes() -> None:
    from bench_projection import make_boxes, make_sweep, make_views, with_log2sim, with_numpy, with_opencv

    rng, views = np.random.default_rng(0), make_views()
    xyz, boxes = make_sweep(6400, rng), [make_boxes(rng) for _ in views]
    ours = with_log2sim(np.ascontiguousarray(xyz.T), views, boxes)
    plain, cv = with_numpy(np.float64, xyz, views, boxes), with_opencv(xyz, views, boxes)
    np.testing.assert_allclose(cv, plain, atol=1e-6)
    np.testing.assert_array_equal(np.isnan(ours), np.isnan(plain))
    assert np.nanmedian(np.abs(np.subtract(ours, plain))) < 1e-3


def result(seed: int, precision: float | None, **colors: Any) -> dict[str, Any]:
    lines = {
        "precision": precision, "recall": 0.5, "recall_20_m": 0.75, "lateral_median_m": 0.04, "lateral_p95_m": 0.1,
        "kind_accuracy": 1.0, "false_m_per_100_m": 2.0,
    }  # fmt: skip
    shapes = {"true": 2, "found": 1, "false": seed}
    lanes = {"precision": None, "recall": None, "center_median_m": None, "inside": 0.9}
    features = {
        "lane_lines": lines,
        "stop_lines": shapes,
        "crosswalks": {"true": 0, "found": 0, "false": 0},
        "lanes": lanes,
    }
    named = {
        "vehicles": 3,
        "with_color": 2,
        "named": 2,
        "right": 1,
        "ciede2000_median": 6.0,
        "confused": {"red as brown": 1},
    }
    case = bench_lanes.Case("scenes/worn.toml", "dusk", "rain", "worn")
    return {
        "case": case.name, "scene": case.scene, "sky": case.sky, "condition": case.condition, "seed": seed,
        "map_features": features, "colors": {**named, **colors}, "signals": None,
    }  # fmt: skip


@pytest.mark.slow
def test_rows_hold_means_over_seeds_and_sums_of_counts() -> None:
    ((scene, condition, precision, *rest),) = bench_lanes.lane_rows([result(1, 0.8), result(2, 0.6), result(3, None)])
    assert (scene, condition, precision) == ("worn", "dusk, rain, worn", "0.70")
    assert rest[:2] == ["0.50", "0.75"]
    assert rest[6:8] == ["3 of 6 + 6", "-"]
    assert rest[-1] == "0.90"
    assert rest[8] == "-"


@pytest.mark.slow
def test_a_minibus_at_the_curb_neither_slides_nor_turns_nor_grows() -> None:
    from bench_large_vehicles import measured

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
def test_the_table_of_a_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    sparse = {**LIDAR, "channels": 16, "azimuth_step_deg": 2.0}
    log, _ = drive_around(HOUSES, BEND, duration_s=1.5, sigma_m=0.4, angle_deg=0.2, lidars=[sparse], observe=True)
    write_log(log, tmp_path / "log")
    out = tmp_path / "figures.json"
    monkeypatch.setattr(sys, "argv", ["bench_poses.py", str(tmp_path / "log"), "--every", "--out", str(out)])
    assert bench_poses.main() == 0
    figures = json.loads(out.read_text())
    assert figures["surfaces"]["lidar"]["apart_m"] < figures["surfaces"]["given"]["apart_m"]
    assert len(figures["parked"]) == 4
    printed = capsys.readouterr().out
    assert "auto takes lidar: upright surfaces differ in sweeps 0.7 s apart" in printed
    assert "4 of them were labeled once in the map of the given poses" in printed  # synthetic labels are exact


@pytest.mark.slow
def test_the_equations_given_to_all_are_the_published_ones() -> None:
    pytest.importorskip("vehiclemodels", reason="needs commonroad-vehicle-models, the published model")
    from vehicle_maneuvers import SWITCH_MPS, Case, single_track_rates
    from vehiclemodels.parameters_vehicle2 import parameters_vehicle2
    from vehiclemodels.vehicle_dynamics_st import vehicle_dynamics_st

    rng, theirs = np.random.default_rng(4), parameters_vehicle2()
    for speed in (0.0, 0.05, 0.2, 3.0, 30.0):
        inputs = rng.uniform(-0.3, 0.3), rng.uniform(-5.0, 2.0)
        state = [*rng.normal(0, 0.1, 3), speed, *rng.normal(0, 0.1, 3)]
        ours = single_track_rates(Case("", 0.0, 0.0, 1.0, lambda t, exp, u=inputs: u), SWITCH_MPS)(0.0, state)
        # Below the switch what moves is compared: their slip follows the steering by a formula of its own there.
        count = 5 if speed < SWITCH_MPS else 7
        expected = vehicle_dynamics_st(state, list(inputs), theirs)
        np.testing.assert_allclose(ours[:count], expected[:count], rtol=1e-9, atol=1e-12)


ROOT = Path(__file__).resolve().parents[1]


FRAMES, SPEED_MPS = 30, 10.0


CALIBRATION = """P2: 700 0 600 0 0 700 180 0 0 0 1 0
R_rect 1 0 0 0 1 0 0 0 1
Tr_velo_cam 0 -1 0 0 0 0 -1 0 1 0 0 0
Tr_imu_velo 1 0 0 0 0 1 0 0 0 0 1 0
"""


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    """The ego goes north at 10 m/s; a car drives 20 m before its camera and 3 m to the left, one stands on the right."""
    motion, labels = [], []
    for k in range(FRAMES):
        y = SPEED_MPS * 0.1 * k
        motion.append(f"{0.1 * k} 100 {y} 1.65 0 0 {np.sqrt(0.5)} {np.sqrt(0.5)}")
        labels.append(f"{k} 1 Car 0 0 0 0 0 0 0 1.5 1.8 4.4 -3 1.65 20 {-np.pi / 2}")
        labels.append(f"{k} 2 Van 0 0 0 0 0 0 0 2.0 1.9 5.0 6 1.65 {50 - y} {-np.pi / 2}")
        labels.append(f"{k} -1 DontCare -1 -1 -10 0 0 9 9 -1 -1 -1 -1000 -1000 -1000 -10")
    for name, lines in {"ego_motion": motion, "label_02": labels}.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "0003.txt").write_text("\n".join(lines) + "\n")
    (tmp_path / "calib").mkdir()
    (tmp_path / "calib" / "0003.txt").write_text(CALIBRATION)
    return tmp_path


@pytest.mark.slow
def test_the_figures_count_warnings_a_minute(
    drive: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["bench_warnings.py", str(drive)])
    bench_warnings.main()
    out = capsys.readouterr().out
    assert "0003" in out
    assert "3 s driven: 0 warnings, 0.00 a minute" in out


@pytest.mark.slow
def test_agents_of_a_synthetic_log_are_rated_and_its_detector_errs(tmp_path):
    log, scene = confidence_logs.make_log(1, 8)
    detector = confidence_logs.SimulatedDetector(log, scene, 3)
    camera, stamp = log.cameras["camera"], int(log.streams["camera"].t_ns[3])
    frame = Frame(camera, stamp, lambda: np.zeros((camera.height_px, camera.width_px, 3), np.uint8))
    one, two = detector.detect(frame), detector.detect(frame)
    np.testing.assert_array_equal(one.box_px, two.box_px)
    assert len(one)
    assert one.score.min() >= confidence_logs.MIN_SCORE
    cases = pickle.loads(pickle.dumps(confidence_logs.cases_of(1, 8)))
    agents = [agent for case in cases for agent in fit_confidence.agents_of(case)]
    assert [sum(a.lidar == lidar for a in agents) > 3 for lidar in (True, False)] == [True, True]
    assert all(0 <= a.right <= 1 and a.ticks > 0 for a in agents)
    x = fit_confidence.matrix_of(agents)
    assert np.isfinite(x).all()
    tables, by_kind = fit_confidence.fit_all(agents)
    p = fit_confidence.probabilities(agents, tables)
    assert ((p > 0) & (p < 1)).all()
    assert set(by_kind) == {"position", "yaw", "speed"}


@pytest.mark.slow
def test_pairs_of_labels_are_right(tmp_path: Path) -> None:
    scene = tmp_path / "tiny.toml"
    scene.write_text(tiny_toml(), encoding="utf-8")
    x, right = fit_late_fusion.pairs_of(scene, "labels", "lidar:labels", 1)
    assert len(x) > 15
    assert right.mean() > 0.95
    assert (x[:, 3] > 0.3).all()


def mapped(world: World) -> GroundMap:
    log = world_log(world)
    return map_ground(log, empty_scenario(log), MapConfig(cell_m=0.05))


@pytest.fixture(scope="module")
def plain() -> GroundMap:
    return mapped(World())


@pytest.mark.slow
@pytest.mark.parametrize("shift_m", [0.0, 0.03, 0.1])
def test_an_injected_offset_is_found(plain: GroundMap, shift_m: float) -> None:
    # Pictures from farther left, taken as if from the middle, show everything farther right.
    offsets = tool.measure_offsets(plain, mapped(World(camera_shift_m=shift_m, seed=9)))
    assert offsets is not None
    assert len(offsets.xy) >= 10
    np.testing.assert_allclose(np.median(offsets.vector_m, axis=0), [0.0, -shift_m], atol=0.006)
    assert np.percentile(np.abs(offsets.offset_m - shift_m), 95) < 0.015


INPUTS, KILLS = 64, 10


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="forks, and reads /proc")
def test_nothing_crashes_hangs_or_is_swallowed(tmp_path: Path) -> None:
    """Some inputs of each kind; `tools/mutate.py --count N` runs more."""
    harness = Harness(tmp_path.resolve())
    rows = list(run_many(harness, 20, list(indices(INPUTS))))
    counts = Counter(row.verdict for row in rows)
    bad = [
        f"{row.verdict}: {row.replay} {row.kind}: {row.damage}: {row.reason}"
        for row in rows
        if row.verdict in verdict.BAD
    ]
    assert not bad, "\n".join(bad)
    assert sum(counts.values()) == INPUTS
    assert min(counts[name] for name in verdict.GOOD) > 1


@pytest.mark.slow
def test_figures_are_medians_a_tick_and_ratios_to_the_floor_of_one_thread() -> None:
    def run(cpu_s: float) -> Measured:
        parts = Counter({"perception.detect": 0.25 * cpu_s, "libraries": 0.25 * cpu_s, "tracking": 0.5 * cpu_s})
        return Measured(Times(cpu_s / 2, cpu_s), 10, {"detect": Times(1.0, 2.0)}, parts, parts)

    log = Log("some", "test", {}, {}, {})
    found = profile_ticks.figures(
        log, "labels", [run(1.0), run(9.0), run(2.0)], {1: [Times(0.5, 0.5)], 2: [Times(0.3, 0.6)]}
    )
    assert (found["cpu_ms"], found["wall_ms"], found["ticks_per_second"]) == (200.0, 100.0, 10.0)
    assert found["detector_cpu_ms"] == 100.0
    assert (found["cpu_over_floor"], found["without_detector_over_floor"]) == (4.0, 2.0)
    assert found["stages_ms"] == {"detect": {"wall": 100.0, "cpu": 200.0}}
    text = profile_ticks.show([found], 5)
    assert "| some | `labels` | 10 | 10.00 | 100 | 200 | 100 | 50 | 30 | 4.00 | 2.00 |" in text


@pytest.mark.slow
def test_rows_are_those_of_the_replay(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    import bench_replay

    scene = scenario_of(MANEUVERS["lane change"]())
    scene.save(tmp_path / "scene.json")
    out = tmp_path / "rows.json"
    options = ["--dt", "0.05", "0.1", "--agents", "2", "--models", "kinematic", "--out", str(out)]
    assert bench_replay.main([str(tmp_path / "scene.json"), *options]) == 0
    rows = json.loads(out.read_text())
    assert [row["dt_s"] for row in rows["tracking"]] == [0.05, 0.1]
    metrics = replay(scene, dt_s=0.1).metrics
    for key in bench_replay.LIMITS:
        assert rows["tracking"][1][key] == metrics[key]
        assert rows["tracking"][1]["worst"][key] == {"agent": "a", "value": metrics["by_agent"]["a"][key]}
    (speed,) = rows["speed"]
    assert (speed["agents"], speed["moved_by"]) == (2, ["kinematic"])
    assert speed["agent_steps_per_s"] == pytest.approx(2 / (speed["step_us"] * 1e-6))
    assert speed["times_real_time"] == pytest.approx(0.01 / (speed["step_us"] * 1e-6))
    printed = capsys.readouterr().out
    assert "| scene.json | 100 | 1 |" in printed
    assert "none" in printed
