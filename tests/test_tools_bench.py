"""Benchmarks and fits: one command for each, worlds and figures against closed forms and second methods, small runs; damaged inputs."""

from __future__ import annotations

import ast
import importlib
import inspect
import pickle
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

import benchmarks.agents
import numpy as np
import pytest
from benchmarks import poses
from benchmarks.kitti import choose, describe_sequence, read_sequence
from conftest import SHARED
from entry import commands_in, run_named
from fits import confidence as fit_confidence
from fits import confidence_logs, late_fusion
from fits.line_maps import draw_scene
from fits.logistic import logistic_regression
from kitti.boxes import read_tracks
from kitti.scoring import evaluate
from localization_worlds import BEND, HOUSES, LIDAR, drive
from mutation.harness import BAD, GOOD, Harness
from profile_ticks import Measured, figures
from scipy.optimize import minimize
from worlds import tiny_toml

from log2sim.datatypes import Frame
from log2sim.datatypes.log_odds import probability_of
from log2sim.logs.native.writer import write_log

pytestmark = pytest.mark.slow
TOOLS = Path(__file__).resolve().parents[1] / "tools"


def test_one_command_lists_the_benchmarks_runs_them_and_refuses_unknown_ones(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert run_named("benchmarks", []) == 0
    listed = [line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines()]
    assert {"lanes", "homography", "kitti"} <= {name for name, _ in listed}
    assert all(len(title) > 10 for _, title in listed)
    assert run_named("benchmarks", ["tracks"]) == 2
    assert {"outline", "confidence"} <= set(commands_in("fits"))


@pytest.mark.parametrize("folder", ["benchmarks", "fits"])
def test_every_command_says_what_it_takes(folder: str, capsys: pytest.CaptureFixture[str]) -> None:
    for name in commands_in(folder):
        with pytest.raises(SystemExit, match="0"):
            run_named(folder, [name, "--help"])
        assert "usage" in capsys.readouterr().out.lower()


def test_documents_give_options_that_the_tools_have() -> None:
    pytest.importorskip("torch")
    root, folders = TOOLS.parent, {"bench": "benchmarks", "fit": "fits", "train": "training"}
    pages = [*root.glob("*.md"), root / "log2sim/README.md", *root.glob("samples/cookbook/*.md")]
    text = "\n".join(page.read_text(encoding="utf-8") for page in pages).replace("\\\n", " ")
    for tool, name, rest in re.findall(r"tools/(\w+)\.py(?: (\w+))?([^`\n#]*)", text):
        inner = f"{folders[tool]}.{name}" if tool in folders else tool
        asked = {option.replace("-", "_").removeprefix("no_") for option in re.findall(r" --([a-z-]+)", rest)}
        if asked and name != "NAME":
            known = set(inspect.signature(importlib.import_module(inner).main).parameters)
            assert asked <= known, (tool, name, rest)


def test_every_tool_can_be_imported() -> None:
    pytest.importorskip("torch")
    modules = {".".join(path.relative_to(TOOLS).with_suffix("").parts) for path in TOOLS.rglob("*.py")}
    assert len(modules) > 40
    for name in modules:
        importlib.import_module(name.removesuffix(".__init__"))


def test_poses_are_compared_by_surfaces_and_parked_vehicles(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sparse = {**LIDAR, "channels": 16, "azimuth_step_deg": 2.0}
    log, _ = drive(HOUSES, BEND, duration_s=1.5, sigma_m=0.4, angle_deg=0.2, lidars=[sparse], observe=True)
    write_log(log, tmp_path / "log")
    poses.main(tmp_path / "log")
    rows = [line.split("|")[1:4] for line in capsys.readouterr().out.splitlines() if line.startswith("| ")]
    found = {name.strip(): (float(given), float(lidar)) for name, given, lidar in rows[2:]}
    given, lidar = found["surfaces, sweeps 2 s apart, m"]
    assert lidar < given
    assert found["4 parked, median scatter, m"][0] == 0.0  # synthetic labels are exact


@pytest.mark.parametrize("off", [0.0, 6.0])
def test_a_logistic_regression_has_the_weights_of_a_minimizer(off: float) -> None:
    """Also where whole steps of Newton's method from the prior lead farther away."""
    rng = np.random.default_rng(0)
    x, prior, precision = np.column_stack([np.ones(200), rng.normal(size=(200, 2))]), [off, 1.0, 0.5], [0.1, 4.0, 1.0]
    right = rng.random(200) < 1 / (1 + np.exp(-x @ [0.3, -2.0, 1.0]))

    def cost(w: np.ndarray) -> float:
        return float(np.logaddexp(0.0, np.where(right, -1, 1) * (x @ w)).sum() + precision @ (w - prior) ** 2 / 2)

    found = logistic_regression(x, right, precision, prior)
    np.testing.assert_allclose(found, minimize(cost, prior).x, atol=1e-4)
    assert logistic_regression(x[:0], right[:0], precision, prior).tolist() == prior


def test_pairs_of_labels_that_late_fusion_is_fitted_to_are_right(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On several cores, too, whose processes would keep their pairs to themselves."""
    monkeypatch.setattr("log2sim.pipeline.default_jobs", lambda: 2)
    scene = tmp_path / "tiny.toml"
    scene.write_text(tiny_toml(), encoding="utf-8")
    x, right = late_fusion.pairs_of(scene, "labels", "lidar:labels", 1)
    assert len(x) > 15
    assert right.mean() > 0.95
    assert (x[:, 3] > 0.3).all()


def test_times_of_a_run_are_medians_a_tick_and_ratios_to_the_floor_of_one_thread() -> None:
    def run(cpu_s: float) -> Measured:
        return Measured((cpu_s / 2, cpu_s), 10, {"poses": (0.1, 0.1 * cpu_s), "detect": (1.0, 0.5 * cpu_s)})

    floor = {1: [(0.5, 0.5)], 2: [(0.3, 0.6)]}
    row, stages = figures("some", "labels", [run(1.0), run(9.0), run(2.0)], floor)
    assert row == ["some", "`labels`", "10", "10.00", "100", "200", "100", "50", "30", "4.00", "2.00"]
    assert "| detect | 100.0 | 100.0 |" in stages


def test_scales_that_make_confidences_right_are_fitted_for_each_group():
    rng, true = np.random.default_rng(3), {"vehicle": (-0.5, 1.4), "two_wheeler": (0.0, 1.0), "pedestrian": (0.6, 0.7)}
    agents = [
        fit_confidence.Judged("one", "any", group, odds, bool(rng.random() < probability_of(offset + slope * odds)))
        for group, (offset, slope) in true.items()
        for odds in rng.normal(0.5, 1.5, 4000).tolist()
    ]
    fitted = fit_confidence.fit_scales(agents)
    for group, scales in true.items():
        assert fitted[group] == pytest.approx(scales, abs=0.15)


def test_random_roads_are_scenes_whose_ego_stays_on_the_side_of_its_traffic() -> None:
    for scene in map(draw_scene, range(20)):
        road = scene.road[0]
        points, (x, y, _) = np.array(road.line), np.array(scene.ego.waypoints).T
        k = np.hypot(points[:, :1] - x, points[:, 1:] - y).argmin(axis=0).clip(1, len(points) - 2)
        (dx, dy), away = (points[k + 1] - points[k - 1]).T, np.array([x, y]).T - points[k]
        left = (dx * away[:, 1] - dy * away[:, 0]) / np.hypot(dx, dy)
        assert np.abs(left).max() < road.width_m / 2
        if road.lanes_back is None:
            assert (left > 0).all() == (scene.traffic == "left")


@pytest.mark.slow
def test_agents_of_a_synthetic_log_are_rated_and_its_detector_errs(tmp_path: Path) -> None:
    log, scene, true = confidence_logs.make_log(1, 0)
    detector = confidence_logs.SimulatedDetector(log, scene, true, 3)
    camera, stamp = log.cameras["camera"], int(log.streams["camera"].t_ns[3])
    frame = Frame(camera, stamp, lambda: np.zeros((camera.height_px, camera.width_px, 3), np.uint8))
    one, two = detector.detect(frame), detector.detect(frame)
    np.testing.assert_array_equal(one.box_px, two.box_px)
    assert len(one)
    assert one.score.min() >= confidence_logs.MIN_SCORE
    cases = pickle.loads(pickle.dumps(confidence_logs.cases_of(1, 0)))
    agents = [agent for case in cases for agent in fit_confidence.agents_of(case, "one")]
    assert [sum(a.lidar == lidar for a in agents) > 3 for lidar in (True, False)] == [True, True]
    assert all(0 <= a.right <= a.there <= 1 and a.ticks > 0 for a in agents)
    assert np.isfinite([list(a.evidence.values()) for a in agents]).all()
    judged = [a for case in cases for a in fit_confidence.judged_agents(case, "one")]
    assert len(judged) > 3
    assert {a.group for a in judged} <= {"vehicle", "two_wheeler", "pedestrian"}
    there, p = fit_confidence.probabilities(agents, fit_confidence.fit_there_and_right(agents))
    assert ((p > 0) & (p < 1) & (there < 1)).all()
    assert set(fit_confidence.fit_all_variances(agents, p)) == {"sigma_xy_m", "sigma_yaw_rad", "sigma_speed_mps"}
    written = ast.parse(fit_confidence.module_text("fit.py", agents)).body
    names = {target.id for line in written if isinstance(line, ast.Assign) for target in line.targets}
    assert names == {"THERE", "RIGHT", "VARIANCES", "CONFIDENCE"}
    # The cases with a LiDAR are measured, with a rule or without.
    (tmp_path / "1-000.pkl").write_bytes(pickle.dumps(cases))
    found = benchmarks.agents.measured(tmp_path / "1-000.pkl")
    assert [m["recall"] > 0.3 for _, m in found] == [True]
    assert f"{found[0][1]['recall']:.3f} | {found[0][1]['precision']:.3f}" in benchmarks.agents.tables(found)
    command = [sys.executable, TOOLS / "bench.py", "agents", tmp_path, "--jobs", "1", "--without"]
    without = [
        subprocess.run([*command, name], capture_output=True, text=True)
        for name in ("tracking.tracker.track", "no.rule")
    ]
    assert "| 1 | 0.000 |" in without[0].stdout  # a log of which nothing is found
    assert "no.rule" in without[1].stderr


INPUTS = range(1, 48, 2)  # one or two of each kind


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="forks, and reads /proc")
def test_nothing_crashes_hangs_or_is_swallowed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Some inputs of each kind; `tools/mutate.py --count N` runs more."""
    monkeypatch.chdir(tmp_path)
    harness = Harness(tmp_path.resolve(), 20)
    rows = [harness.run(index) for index in INPUTS]
    counts = Counter(row.verdict for row in rows)
    bad = [f"{r.verdict}: {r.index} {r.kind}: {r.damage}: {r.reason}" for r in rows if r.verdict in BAD]
    assert not bad, "\n".join(bad)
    assert min(counts[name] for name in GOOD) > 1


KITTI = SHARED / "data" / "kitti_tracking"


@pytest.mark.slow
@pytest.mark.real
@pytest.mark.parametrize("online", [True, False])
def test_a_recorded_sequence_is_tracked_ahead_of_the_baseline(online: bool) -> None:
    if not KITTI.is_dir():
        pytest.skip(
            "the KITTI tracking labels and detections are not beside this checkout (../shared/data/kitti_tracking)"
        )
    told = choose(describe_sequence(*read_sequence(KITTI, "0004"), online=online), online=online)
    score = evaluate({"0004": told}, {"0004": read_tracks(KITTI / "label_02" / "0004.txt")}, "Car")
    assert score.id_switches <= 1
    # AB3DMOT with its repository settings has 90.4 and 83.7 here.
    assert score.samota > 94.0
    assert score.mota > (90.0 if online else 93.0)
