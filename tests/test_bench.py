"""Error against run time: the front, the recommendation, what runs share, the figures, and the command with its files."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import names, run
from plain_settings import ALL_KEPT
from worlds import tiny_log, waypoints

from log2sim.config import Config
from log2sim.datatypes import Agent, Detections, Frame, Log, Scenario, Waypoints
from log2sim.errors import LogError
from log2sim.evaluation.bench.benchmark import Benchmark, bench, bench_document
from log2sim.evaluation.bench.runs import BenchContext, detect_once, make_context
from log2sim.evaluation.bench.runs import timed_first_pass as run_first_pass
from log2sim.evaluation.bench.scores import (
    CUTOFF_M,
    jitter,
    score_homographies,
    score_scenario,
    split_holdout,
    true_positions,
)
from log2sim.evaluation.bench.settings import Point, make_grid, pareto_front, recommend
from log2sim.files.documents import check
from log2sim.geometry import Array, apply_homography
from log2sim.perception.detect.layouts import COCO_80, LAYOUTS, InputSpec
from log2sim.perception.detect.onnx_detector import OnnxDetector, OnnxModel
from log2sim.perception.first_pass import Observations
from log2sim.perception.homography.correspondences import Correspondences
from log2sim.perception.homography_stage import CameraHomography, calibrated_homography
from log2sim.perception.sync import schedule_of
from log2sim.plan import select_sensors

FirstPass = tuple[BenchContext, Observations, dict[str, float]]
LABELS = Config.load(detect={"name": "labels"}, **ALL_KEPT)


def silent(what: str, done: int, total: int) -> None:
    pass


@pytest.fixture(scope="module")
def tiny() -> tuple[Log, Scenario]:
    return tiny_log()


@pytest.fixture(scope="module")
def first_pass(tiny: tuple[Log, Scenario]) -> FirstPass:
    context = make_context(tiny[0], make_grid(tiny[0], LABELS), tiny[1], silent)
    return context, *run_first_pass(context, context.grid.present, context.grid.measure[0], silent)


@pytest.fixture(scope="module")
def result(tiny: tuple[Log, Scenario]) -> Benchmark:
    return bench(tiny[0], LABELS, truth=tiny[1])


# The front and the recommendation


def test_the_front_is_what_nothing_beats() -> None:
    cost = [1.0, 2.0, 2.0, 3.0, 4.0, 5.0, 0.5]
    error = [9.0, 5.0, 6.0, 5.0, 1.0, 1.0, np.nan]
    assert pareto_front(cost, error).tolist() == [True, True, False, False, True, False, False]


def point(name: str, ms: float, error: float | None, *, present: bool = False, spread: float = 0.0) -> Point:
    """A point of ten objects that have the same error, or ones that scatter about it by a factor."""
    factors = 1 + spread * np.linspace(-1, 1, 10)
    parts = {} if error is None else {str(k): (float((error * f) ** 2), 1.0) for k, f in enumerate(factors)}
    return Point(name, present, ms, error, {}, parts)


def test_less_error_wins_and_of_equal_errors_the_cheaper() -> None:
    now = point("now", 10.0, 1.0, present=True)
    assert recommend([now, point("better", 30.0, 0.5)], "m", 100.0).supported == "better"
    assert recommend([now, point("cheaper", 1.0, 1.02)], "m", 100.0).supported == "cheaper"
    assert recommend([now, point("a", 30.0, 0.5), point("b", 20.0, 0.51)], "m", 100.0).supported == "b"
    assert recommend([now, point("worse", 1.0, 2.0)], "m", 100.0).agrees


# Figures


def moving(name: str, xy: Array, tick_s: float = 0.1) -> Agent:
    w = waypoints(np.arange(len(xy)) * tick_s, *xy.T, speed_mps=3.0)
    return Agent(name, "car", (4.0, 1.8, 1.5), w, quality={"detections": len(xy)})


def world(*offsets: tuple[float, float]) -> Scenario:
    """Cars 20 m apart that all drive along x, off from there by so much."""
    x = 0.3 * np.arange(20)
    agents = tuple(
        moving(f"car-{k}", np.column_stack([x + dx, 20.0 * k + dy + 0 * x])) for k, (dx, dy) in enumerate(offsets)
    )
    return Scenario("world", 0, 1.9, agents)


def test_the_error_counts_distance_misses_and_false_objects() -> None:
    truth = world((0, 0), (0, 0))
    perfect = score_scenario(truth, truth, 0.1).figures
    assert perfect["error_m"] == 0.0
    assert perfect["recall"] == perfect["precision"] == 1.0
    shifted = score_scenario(world((0, 1.0), (0, -1.0)), truth, 0.1).figures
    assert shifted["error_m"] == pytest.approx(1.0)
    assert shifted["state_error_m"] == pytest.approx(1.0)
    # One of two is missed: 20 ticks right, 20 missed, each of these half an object that is 2 m off.
    missed = score_scenario(world((0, 0)), truth, 0.1).figures
    assert missed["error_m"] == pytest.approx(np.sqrt(CUTOFF_M**2 * 10 / (20 + 10)))
    # One is 10 m off, so one is missed and one false: together an object that is 2 m off.
    lost = score_scenario(world((0, 0), (0, 10.0)), truth, 0.1).figures
    assert lost["error_m"] == pytest.approx(np.sqrt(CUTOFF_M**2 * 20 / (20 + 20)))


def test_jitter_is_the_deviation_of_white_noise_and_not_acceleration() -> None:
    t = np.arange(400) * 0.1
    smooth = np.column_stack([3 * t + 1.5 * t**2, 0 * t])
    noise = np.random.default_rng(1).normal(0, 0.2, (400, 2))

    def of(*agents: Agent) -> float | None:
        return jitter(replace(world(), agents=agents), 0.1)

    assert of(moving("a", smooth)) == pytest.approx(0.0, abs=1e-9)
    assert of(moving("a", smooth + noise)) == pytest.approx(0.2, rel=0.1)
    assert of() is None
    assert of(moving("a", smooth[:4])) is None
    standing = replace(moving("b", smooth + 10 * noise), static=True)
    assert of(moving("a", smooth), standing) == pytest.approx(0.0, abs=1e-9)
    # Fewer waypoints of the same motion: nothing was lost, so nothing jitters.
    whole = moving("a", smooth).waypoints
    kept = np.unique(np.r_[0, np.random.default_rng(2).integers(0, 400, 90), 399])
    columns = {name: getattr(whole, name)[kept] for name in Waypoints.FLOATS} | {"observed": whole.observed[kept]}
    thinned = replace(moving("a", smooth), waypoints=Waypoints(**{**columns, "speed_mps": 3 + 3 * t[kept]}))
    assert of(thinned) == pytest.approx(0.0, abs=1e-9)


def test_a_right_homography_has_no_error_and_a_shifted_one_its_shift(
    tiny: tuple[Log, Scenario], first_pass: FirstPass
) -> None:
    (log, truth), (context, seen, _) = tiny, first_pass
    known = true_positions(log, context.schedule, seen, truth, when="imaged")
    holdout = split_holdout(log, context.schedule, seen, known, np.random.default_rng(0))
    # What is held out is not fitted to.
    fitted, everything = (Correspondences.join(o.feet["front"]) for o in (holdout.observations, seen))
    held = Correspondences.join(holdout.feet["front"])
    same = (fitted.tick[:, None] == held.tick) & (np.abs(fitted.uv[:, None] - held.uv).max(axis=2) < 1)
    assert not same.any()
    assert 0 < len(fitted.uv) < len(everything.uv)
    base = calibrated_homography(log, log.cameras["front"])
    assert base is not None
    uv = [apply_homography(np.linalg.inv(base.ground_H_image), f.xy_ego)[0] for f in holdout.feet["front"]]
    exact = replace(holdout, feet={"front": [replace(f, uv=p) for f, p in zip(holdout.feet["front"], uv, strict=True)]})

    def score(shift_m: float) -> dict[str, Any]:
        shift = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, shift_m], [0.0, 0.0, 1.0]])
        fit = replace(base, ground_H_image=shift @ base.ground_H_image)
        return score_homographies(log, exact, {"front": CameraHomography(log.cameras["front"], fit, "")}).figures

    assert score(0.0)["error_m"] == pytest.approx(0.0, abs=1e-6)
    assert score(0.0)["placed_share"] == 1.0
    assert score(0.7)["error_m"] == score(0.7)["near_error_m"] == pytest.approx(0.7)
    assert score(30.0)["error_m"] == pytest.approx(CUTOFF_M)
    assert score(0.0)["center_error_m"] < score(1.5)["center_error_m"] <= CUTOFF_M


# Settings and shared work


@pytest.mark.parametrize("present", ["apart", "together"])
def test_several_cameras_are_fitted_together_and_apart(tiny: tuple[Log, Scenario], present: str) -> None:
    front = tiny[0].cameras["front"]
    log = tiny[0].changed(cameras={"front": front, "left": replace(front, name="left")})
    grid = make_grid(log, Config.load(detect={"name": "labels"}, topdown={"rig": present}))
    rigs = {s.name: s.config.topdown.rig for s in grid.homography}
    other = {"apart": "together", "together": "apart"}[present]
    assert rigs["time-aware"] == present
    assert rigs[f"cameras {other}"] == other
    assert {rig for name, rig in rigs.items() if name not in ("time-aware", f"cameras {other}")} == {"apart"}
    alone = make_grid(tiny[0], LABELS)
    assert not any("cameras" in s.name for s in alone.homography)


def test_tiles_and_input_sizes_are_those_that_change_something(
    tiny: tuple[Log, Scenario], monkeypatch: pytest.MonkeyPatch
) -> None:
    def open_size(log: Log, config: Config) -> OnnxDetector:
        side = None if config.detect.name == "any.onnx" else 300
        model = OnnxModel(Path("m.onnx"), InputSpec("images", side, side, False, np.dtype(np.float32)), {}, None)
        return OnnxDetector("m", model, LAYOUTS["yolox"], COCO_80, 0.4, 0.4, 0.5, "auto", 0.4)

    monkeypatch.setattr("log2sim.evaluation.bench.settings.create_image_detector", open_size)
    grid = make_grid(tiny[0], Config.load(detect={"name": "any.onnx"}), ["models/fixed.onnx"])
    found = {s.name: (s.config.detect.tiles, s.config.detect.input_px) for s in grid.detect}
    # The picture is 480 px wide, so "auto" is no tiles for both; 416 px is what the family takes anyway.
    assert found == {
        "any auto tiles": (0, 0),
        "any 2 tiles": (2, 0),
        "any 3 tiles": (3, 0),
        "any 5 tiles": (5, 0),
        "any input 320 px": (0, 320),
        "any input 640 px": (0, 640),
        "any input 960 px": (0, 960),
        "fixed auto tiles": (0, 0),
        "fixed 2 tiles": (2, 0),
        "fixed 3 tiles": (3, 0),
        "fixed 5 tiles": (5, 0),
    }
    assert [s.present for s in grid.detect] == [True] + [False] * 10
    assert grid.detect[-1].config.detect.name == "models/fixed.onnx"
    alike = make_grid(tiny[0], Config.load(detect={"name": "a/m.onnx"}), ["b/m.onnx"]).detect
    assert len({s.name for s in alike}) == len(alike) == 8


@dataclass
class Counting:
    """A detector that counts what it is asked for."""

    name: str = "counting"
    default_min_score: float = 0.3
    asked: list[tuple[str, int]] = field(default_factory=list)

    def detect(self, frame: Frame) -> Detections:
        self.asked.append((frame.camera.name, frame.t_ns))
        assert frame.image().shape[2] == 3
        return Detections(np.array([[1.0, 2.0, 3.0, 4.0]]), np.array([0.5]), np.array(["car"]))


def test_every_frame_is_decoded_and_detected_once(tiny: tuple[Log, Scenario]) -> None:
    log, decoded = tiny[0], []
    stream = log.streams["front"]
    log = replace(
        log, streams={**log.streams, "front": replace(stream, read=lambda k: (decoded.append(k), stream.read(k))[1])}
    )
    schedule = schedule_of(log, select_sensors(log, LABELS).cameras, LABELS)
    detectors = {"a": Counting(), "b": Counting()}
    told: list[tuple[int, int]] = []
    found, decoding_s = detect_once(
        log, schedule, detectors, decode=True, progress=lambda done, total: told.append((done, total))
    )
    frames = [("front", int(t)) for t in stream.t_ns]
    assert detectors["a"].asked == detectors["b"].asked == frames
    assert decoded == list(range(len(frames)))
    assert told == [(k + 1, len(frames)) for k in range(len(frames))]
    assert decoding_s > 0
    assert sum(found["a"].spent_s) > 0

    def fail() -> Any:
        raise AssertionError("an image was asked for again")

    for name, t_ns in frames * 2:
        assert len(found["a"].detect(Frame(log.cameras[name], t_ns, fail))) == 1
    assert len(detectors["a"].asked) == len(frames)
    assert len(found["a"].detect(Frame(log.cameras["front"], 1, fail))) == 0


# The whole


def test_every_stage_has_a_panel_and_the_figures_fit_each_other(result: Benchmark) -> None:
    panels = {p.stage: p for p in result.panels}
    assert list(panels) == ["detect", "measure", "homography", "smooth", "whole run"]
    for panel in panels.values():
        assert sum(p.present for p in panel.points) == 1
        assert len({p.setting for p in panel.points}) == len(panel.points)
        assert all(p.ms_per_tick > 0 for p in panel.points)
        assert any(panel.on_front)
    grid = result.context.grid
    settings = sum(map(len, (grid.detect, grid.measure, grid.homography, grid.smooth)))
    assert len(panels["whole run"].points) == settings - 3
    present = next(p for p in panels["whole run"].points if p.present)
    assert present.ms_per_tick == pytest.approx(sum(present.figures["stages_ms_per_tick"].values()))
    assert present.figures["recall"] == 1.0
    measured = {p.setting: p.error for p in panels["measure"].points}
    assert measured["robust"] < 0.5 * measured["paper"]
    assert panels["measure"].recommendation.supported == "robust"


def test_the_document_keeps_its_schema_and_says_the_same(result: Benchmark) -> None:
    out = json.loads(json.dumps(bench_document(result), allow_nan=False))
    check(out, "bench-1", LogError)
    assert out["truth"] == "tiny"
    assert out["ticks"] == 10
    for panel, entry in zip(result.panels, out["panels"], strict=True):
        front = {p.setting for p, f in zip(panel.points, panel.on_front, strict=True) if f}
        assert {p["setting"] for p in entry["points"] if p["on_front"]} == front
        assert entry["supports"]["setting"] == panel.recommendation.supported
        assert all(p["error"] == p["figures"][entry["error"]["figure"]] for p in entry["points"])


def test_the_dataframe_has_a_row_for_each_setting_with_its_figures(result: Benchmark) -> None:
    pytest.importorskip("pandas")
    table = result.to_dataframe()
    points = [(panel.stage, point) for panel in result.panels for point in panel.points]
    assert list(zip(table.stage, table.setting)) == [(stage, point.setting) for stage, point in points]
    assert table.present.sum() == sum(point.present for _, point in points)
    for row, (_, point) in zip(table.to_dict("records"), points, strict=True):
        assert row["ms_per_tick"] == point.ms_per_tick
        known = {name: value for name, value in point.figures.items() if value is not None}
        assert {k: row[k] for k in known} == known


@pytest.mark.slow
def test_the_command_writes_two_files_and_replaces_only_when_asked(tiny_folder: Path, tmp_path: Path) -> None:
    import cv2

    options = (tiny_folder, "--out", tmp_path / "b", "--detector", "labels", "--stop", "0.5")
    ran = run("bench", *options)
    assert ran.code == 0, ran.err
    assert names(tmp_path / "b") == ["bench.json", "bench.png"]
    assert "detecting: 6 of 6" in ran.err
    assert run("validate", tmp_path / "b/bench.json").code == 0
    picture = cv2.imread(str(tmp_path / "b/bench.png"))
    assert picture.shape[1] > 1500
    assert 0.01 < (picture.min(axis=2) < 200).mean() < 0.3
    again = run("bench", *options)
    assert again.code == 2
    assert "--overwrite" in again.line
    quiet = run("bench", *options, "--overwrite", "--quiet", "--stop", "0.2")
    assert (quiet.code, quiet.out, quiet.err) == (0, "", "")
    assert json.loads((tmp_path / "b/bench.json").read_text())["ticks"] == 3


def test_what_cannot_be_is_one_line_and_leaves_nothing(tiny_folder: Path, tmp_path: Path) -> None:
    wrong = {
        3: (tmp_path / "none", "--out", tmp_path / "b"),
        2: (tiny_folder, "--out", tmp_path / "b", "--detector", "labels", "--detector", "lables"),
    }
    for code, arguments in wrong.items():
        ran = run("bench", *arguments)
        assert ran.code == code
        assert ran.line
    (tmp_path / "file").write_text("")
    assert "is a file and not a folder" in run("bench", tiny_folder, "--out", tmp_path / "file").line
    assert names(tmp_path) == ["file"]
