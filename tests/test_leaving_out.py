"""What the plan leaves out changes no result beyond its tolerance: the same log with the stage and without it."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from plain_settings import AGENTS_ALONE
from test_pipeline import assert_same_agents
from worlds import CAR, PARKED, scan, standing, tiny_log

import log2sim.agents.estimate
import log2sim.perception.lidar.cloud
import log2sim.perception.run_detectors
import log2sim.pipeline
import log2sim.plan
from log2sim import Config, Scenario, reconstruct, replay
from log2sim.agents.estimate import simplify_waypoints
from log2sim.agents.hypotheses import Part
from log2sim.config import TopdownConfig
from log2sim.datatypes import Detections, Frame, Lidar, Log, Measurements, Stream, Sweep, Waypoints
from log2sim.errors import LogError, RecordError
from log2sim.evaluation.metrics.evaluator import evaluate
from log2sim.files.documents import check
from log2sim.files.stages import StageClock
from log2sim.geometry import PoseTrack, transform
from log2sim.perception.detect.detectors import create_detector
from log2sim.perception.first_pass import Observations
from log2sim.perception.fusion import fuse_tick
from log2sim.perception.homography_stage import fit_homographies
from log2sim.perception.lidar.cloud import assemble_cloud, is_at_rest, sweep_to_map
from log2sim.pipeline import Result, infer_scenario, observe_log, start
from log2sim.plan import Decision, HomographyScope, Plan, Stage, make_plan, select_sensors
from log2sim.report import stage_outcomes

LABELS = Config.load(detect={"name": "labels"}, **AGENTS_ALONE)
FRONT = {"name": "front", "position_m": [1.7, 0.0, 1.5], "size_px": [480, 300], "offset_s": 0.03}
BACK = {"name": "back", "position_m": [-0.5, 0.0, 1.5], "size_px": [480, 300], "yaw_deg": 180.0, "offset_s": 0.03}
STANDING = {"waypoints": [[0.0, 0.0, 0.01], [0.1, 0.0, 0.01]], "poses": "poses"}


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


def plan_of(log: Log, config: Config = LABELS, t_ns: np.ndarray | None = None) -> Plan:
    sensors = select_sensors(log, config)
    return make_plan(log, config, sensors, log.streams["front"].t_ns if t_ns is None else t_ns)


@pytest.fixture(scope="module")
def tiny() -> Log:
    return tiny_log()[0]


@pytest.fixture(scope="module")
def still() -> Log:
    """A log whose ego all but stands: it creeps on by a centimeter."""
    return tiny_log(ego=STANDING)[0]


def with_blank_images(log: Log) -> Log:
    """The log with images that cost nothing to read."""
    blank = {n: replace(log.streams[n], read=lambda i: np.zeros((300, 480, 3), np.uint8)) for n in log.cameras}
    return replace(log, streams={**log.streams, **blank})


# --- motion compensation


def swaying(log: Log, amplitude_m: float) -> Log:
    """The log with poses that sway by an amplitude about where they start."""
    assert log.ego is not None
    pose = np.repeat(log.ego.map_T_ego[:1], len(log.ego.t_ns), axis=0)
    pose[:, 0, 3] += amplitude_m * np.sin(np.arange(len(pose)))
    return replace(log, ego=PoseTrack(log.ego.t_ns, pose))


@pytest.mark.slow
def test_an_ego_that_stands_needs_no_compensation(still: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    log = swaying(still, 0.01)
    without = run(log)
    left_out = entry(without, "motion compensation")
    assert not left_out["kept"]
    assert "stands still" in left_out["reason"]
    monkeypatch.setattr(log2sim.plan, "MAX_STATIC_EGO_MOTION_M", 0.0)
    monkeypatch.setattr(log2sim.perception.lidar.cloud, "AT_REST_M", 0.0)
    full = run(log)
    assert entry(full, "motion compensation")["kept"]
    assert 0.0 < farthest_m(without.scenario, full.scenario) < 0.05


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


def test_the_part_of_a_log_in_which_the_ego_stands_needs_no_compensation(tiny: Log) -> None:
    assert tiny.ego is not None
    t_ns = tiny.ego.t_ns[0] + np.arange(41) * 100_000_000
    x = np.r_[np.zeros(21), np.linspace(0.0, 20.0, 20)]
    ego = PoseTrack(t_ns, transform(np.eye(3), np.column_stack([x, np.zeros(41), np.zeros(41)])))
    log = replace(tiny, ego=ego)
    assert plan_of(log, t_ns=t_ns).keeps(Stage.MOTION_COMPENSATION)
    assert not plan_of(log, t_ns=t_ns[:10]).keeps(Stage.MOTION_COMPENSATION)
    assert plan_of(log, t_ns=t_ns[15:25]).keeps(Stage.MOTION_COMPENSATION)


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


@pytest.mark.parametrize(("speed_mps", "rests"), [(0.0, True), (0.08, True), (0.2, False), (20.0, False)])
def test_rest_is_less_than_a_centimeter_during_the_sweep(speed_mps: float, rests: bool) -> None:
    t_ns = np.arange(3) * 100_000_000
    ego = PoseTrack(t_ns, transform(np.eye(3), np.outer(t_ns * 1e-9, [speed_mps, 0.0, 0.0])))
    log = Log("l", "log2sim", {}, {"top": Lidar("top", "ego", np.eye(4))}, {}, ego)
    points = np.random.default_rng(0).uniform(-30, 30, (200, 3))
    sweep = Sweep(0, points, "lidar", np.linspace(0, 100_000_000, 200).astype(np.int64))
    assert is_at_rest(log, "top", sweep) == rests
    one = sweep_to_map(log, "top", sweep, compensate=False)
    many = sweep_to_map(log, "top", sweep, compensate=True)
    assert one is not None
    assert many is not None
    assert (np.abs(one[0] - many[0]).max() == 0.0) == rests


@pytest.mark.parametrize(("kind", "words"), [("map", "compensated already"), ("lidar", "no times of their own")])
def test_sweeps_that_cannot_be_compensated_are_told(tiny: Log, kind: str, words: str) -> None:
    def read(i: int) -> Sweep:
        sweep = tiny.streams["top"].read(i)
        mapped = sweep_to_map(tiny, "top", sweep, compensate=True)
        xyz = mapped[0] if kind == "map" and mapped is not None else sweep.xyz_m
        return Sweep(sweep.stamp_ns, xyz, kind, sweep.t_ns if kind == "map" else None)  # type: ignore[arg-type]

    log = replace(tiny, streams={**tiny.streams, "top": Stream("top", tiny.streams["top"].t_ns, read)})
    step = entry(run(log), "motion compensation")
    assert not step["kept"]
    assert words in step["reason"]


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


def test_a_lidar_within_reach_is_kept(tiny: Log) -> None:
    assert entry(run(with_roadside_lidar(tiny, 60.0, Counter())), "use of every LiDAR")["kept"]


# --- images and frames


def test_boxes_of_the_log_need_no_image(tiny: Log) -> None:
    def unreadable(i: int) -> Any:
        raise RecordError(f"frame {i} is gone")

    blind = replace(tiny, streams={**tiny.streams, "front": replace(tiny.streams["front"], read=unreadable)})
    without, full = run(blind), run(tiny)
    assert_same_agents(without.scenario, full.scenario, within=0.0)
    assert without.report["unreadable"] == {}
    assert not entry(full, "image decoding")["kept"]


@pytest.mark.slow
def test_lanes_and_colors_are_left_out_when_asked(tiny: Log) -> None:
    without = run(tiny)
    assert without.scenario.map_features is None
    assert all(agent.color is None for agent in without.scenario.agents)
    stages = {"markings and lanes": "map.lanes=false", "colors of vehicles": "appearance.colors=false"}
    assert all(
        entry(without, stage) == entry(without, stage) | {"kept": False, "reason": why} for stage, why in stages.items()
    )
    full = run(tiny, Config.load(detect={"name": "labels"}))
    assert full.scenario.map_features is not None
    assert all(entry(full, stage)["kept"] for stage in stages)
    assert_same_agents(without.scenario, full.scenario, within=0.0)


def test_sweeps_alone_have_no_colors(tiny: Log) -> None:
    result = run(tiny, Config.load(detect={"name": "lidar:labels"}))
    step = entry(result, "colors of vehicles")
    assert not step["kept"]
    assert "no camera is used" in step["reason"]
    assert entry(result, "markings and lanes")["kept"]
    assert result.scenario.map_features is not None
    assert all(marking.sources == ("lidar",) for marking in result.scenario.map_features.markings)


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


@pytest.fixture(scope="module")
def passing() -> Log:
    """A car that is before the ego, is overtaken and comes into the view of the camera that looks back."""
    car = CAR | {"waypoints": [[4.0, 3.0, 2.0], [8.0, 3.0, 2.0]]}
    ego = {"waypoints": [[0.0, 0.0, 12.0], [40.0, 0.0, 12.0]], "poses": "poses"}
    lidar = {"name": "top", "position_m": [1.2, 0.0, 1.9], "channels": 24, "elevation_deg": [-18.0, 3.0]}
    lidar |= {"azimuth_deg": [-180.0, 180.0], "azimuth_step_deg": 0.8, "range_m": 60.0}
    return with_blank_images(tiny_log([car, PARKED], ego=ego, duration_s=2.0, camera=[FRONT, BACK], lidar=[lidar])[0])


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


@pytest.mark.slow
def test_whoever_comes_into_an_empty_view_is_not_missed(passing: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    few, looked = run_counting(passing, monkeypatch)
    every, all_frames = run_counting(passing, monkeypatch, stride=1)
    assert 4 < looked.frames["back"] < all_frames.frames["back"] == 20
    assert few.report["detections"]["back"] > 0
    assert_same_agents(few.scenario, every.scenario, within=0.0)


@pytest.mark.parametrize(("ticks", "stride"), [(1, 1), (2, 1), (4, 2), (10, 3), (100, 3)])
def test_looks_are_nearer_than_a_track_is_long(ticks: int, stride: int, tiny: Log) -> None:
    config = Config.load(detect={"name": "some.onnx"})
    t_ns = np.arange(ticks) * 100_000_000
    assert plan_of(tiny, config, t_ns).detector_stride == stride
    assert plan_of(tiny, LABELS, t_ns).detector_stride == 1


@pytest.mark.parametrize(
    ("name", "period_s", "hz", "stride"),
    [
        ("some.onnx+lidar:vehicle", 0.3, 10, 3),
        ("some.onnx+lidar:vehicle", 0.3, 20, 6),
        ("some.onnx+lidar:vehicle", 0.3, 2, 1),
        ("some.onnx+lidar:vehicle", 0.0, 10, 1),
        ("some.onnx", 0.3, 10, 1),
        ("labels+lidar:vehicle", 0.3, 10, 1),
    ],
)
def test_pictures_are_searched_less_often_only_where_sweeps_are_searched_and_a_network_looks(
    name: str, period_s: float, hz: int, stride: int, tiny: Log
) -> None:
    config = Config.load(detect={"name": name, "period_s": period_s})
    plan = plan_of(tiny, config, np.arange(40) * (10**9 // hz))
    assert plan.picture_stride == stride
    # Frames between two empty ones are left out only where all are searched otherwise.
    assert stride == 1 or plan.detector_stride == 1
    assert plan.decision(Stage.DETECTION_IN_EVERY_FRAME).kept is (stride == 1 and plan.detector_stride == 1)


@pytest.mark.slow
def test_a_look_that_could_not_be_read_found_nothing_out(both: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    sound = both.streams["back"]

    def read(i: int) -> Any:
        if i == 3:
            raise RecordError("torn")
        return sound.read(i)

    log = replace(both, streams={**both.streams, "back": replace(sound, read=read)})
    _, looked = run_counting(log, monkeypatch)
    assert looked.frames["back"] == 7  # all but 3, which is torn, and 7 and 8


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


def lost(camera: str, bottom_px: float) -> Measurements:
    """A row of a camera without LiDAR points, whose box ends at a height in the image."""
    detections = Detections(np.array([[10.0, 10.0, 60.0, bottom_px]]), np.ones(1), np.array(["car"]))
    return Measurements.unplaced(detections, t_ns=0, camera=camera, sensor_m=np.zeros(3))


def test_a_box_without_a_foot_in_the_image_needs_no_homography(both: Log) -> None:
    plan = plan_of(both)
    for bottom_px, wanted in ((250.0, {"back"}), (297.0, {"back"}), (298.0, set()), (300.0, set())):
        seen = Observations(measurements=[lost("back", bottom_px)], obstacles=[None])
        fits = fit_homographies(both, seen, plan, TopdownConfig(), rng=np.random.default_rng(0))
        assert set(fits) == wanted


@pytest.mark.slow
def test_correspondences_that_nobody_reads_are_not_gathered(tiny: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[Observations] = []
    monkeypatch.setattr(log2sim.pipeline, "fit_homographies", lambda log, s, *_, **__: (seen.append(s), {})[1])
    run(tiny, Config.load(detect={"name": "labels"}, topdown={"method": "off"}))
    run(tiny)
    off, on = seen
    assert off.feet == off.ground == {"front": []}
    assert len(on.feet["front"]) == len(on.ground["front"]) == 10


def test_a_cloud_does_not_sample_the_ground_for_nobody(tiny: Log) -> None:
    sweep = tiny.streams["top"].read(3)
    clouds = [
        assemble_cloud(tiny, {"top": sweep}, origin=np.zeros(3), ground_z=0.0, max_range_m=60.0) for _ in range(2)
    ]
    for cloud, ground in zip(clouds, (False, True)):
        assert cloud is not None
        cloud.prepare(ground=ground)
        assert ("ground_sample" in vars(cloud)) == ground
        assert {"obstacle_columns", "azimuth_index"} <= set(vars(cloud))


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


def test_one_camera_gives_the_same_scenario_with_fusion(tiny: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    without = run(tiny)
    step = entry(without, "fusion of cameras")
    assert not step["kept"]
    decide = log2sim.plan._decide
    monkeypatch.setattr(
        log2sim.plan, "_decide", lambda stage, *why: decide(stage, *(why[:1] if stage is Stage.FUSION else why))
    )
    full = run(tiny)
    assert_same_agents(without.scenario, full.scenario, within=0.0)


# --- parked agents


def test_a_parked_car_needs_no_smoothing(tiny: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    without = run(tiny)
    step = entry(without, "smoothing of static agents")
    assert not step["kept"]
    assert step["reason"].startswith("1 of 3 agents")
    (parked,) = [a for a in without.scenario.others if a.static]
    monkeypatch.setattr(log2sim.agents.estimate, "explain_track", lambda track: [Part(track, static=False)])
    full = run(tiny)
    assert entry(full, "smoothing of static agents")["kept"]
    smoothed = min(full.scenario.others, key=lambda a: np.hypot(a.waypoints.x_m[0] - 14.0, a.waypoints.y_m[0] + 4.0))
    w = smoothed.waypoints
    assert len(w) >= len(parked.waypoints) == 2
    apart = np.hypot(w.x_m - parked.waypoints.x_m[0], w.y_m - parked.waypoints.y_m[0])
    assert apart.max() < 0.3
    assert apart.min() < 0.15


def test_a_parked_car_needs_no_controller(tiny: Log) -> None:
    scenario = run(tiny).scenario
    driven = replace(scenario, agents=tuple(replace(a, static=False) for a in scenario.agents))
    (parked,) = [a for a in scenario.others if a.static]
    with_pose, with_pid = ({a.id: a for a in replay(s).agents}[parked.id] for s in (scenario, driven))
    assert (with_pose.driver, with_pid.driver) == ("static", "pid")
    for k in ("x_m", "y_m"):
        np.testing.assert_allclose(getattr(with_pid, k), getattr(with_pose, k)[0], atol=0.01)


# --- waypoints


def way(
    t: np.ndarray, x: np.ndarray, y: np.ndarray, speed: np.ndarray, observed: np.ndarray | None = None
) -> Waypoints:
    seen = np.ones(len(t), bool) if observed is None else observed
    yaw = np.arctan2(np.gradient(y), np.gradient(x))
    return Waypoints(t, x, y, np.full(len(t), 0.7), yaw, speed, seen, np.full(len(t), 0.1))


T = np.arange(51) * 0.1
DRIVE = way(T, 10.0 * T, np.zeros(51), np.full(51, 10.0))


def test_constant_motion_keeps_a_waypoint_a_second() -> None:
    few = simplify_waypoints(DRIVE)
    np.testing.assert_allclose(np.diff(few.t_s).max(), 1.0, atol=0.11)
    assert len(few) <= 8
    assert (few.t_s[0], few.t_s[-1]) == (T[0], T[-1])


def test_accelerating_and_turning_keep_what_interpolation_does_not_give_back() -> None:
    braking = way(T, 10.0 * T - 1.5 * T**2, np.zeros(51), 10.0 - 3.0 * T)
    assert len(simplify_waypoints(braking)) > 15
    circle = way(T, 20 * np.sin(T / 2), 20 - 20 * np.cos(T / 2), np.full(51, 10.0))
    assert len(simplify_waypoints(circle)) > 15


def test_ends_of_what_was_observed_stay() -> None:
    observed = (T < 1.95) | (T > 3.45)
    few = simplify_waypoints(way(T, 10.0 * T, np.zeros(51), np.full(51, 10.0), observed))
    assert {19, 20, 34, 35} <= set(np.rint(few.t_s * 10).astype(int))
    assert not few.observed[(few.t_s > 1.95) & (few.t_s < 3.45)].any()


@pytest.mark.parametrize("column", ["x_m", "y_m", "z_m", "yaw_rad", "speed_mps", "sigma_xy_m"])
def test_a_waypoint_that_departs_in_any_column_stays(column: str) -> None:
    values = getattr(DRIVE, column).copy()
    values[23] += 0.05
    assert 23 in np.rint(simplify_waypoints(replace(DRIVE, **{column: values})).t_s * 10).astype(int)
    values[23] += 0.0015 - 0.05
    assert len(simplify_waypoints(replace(DRIVE, **{column: values}))) == len(simplify_waypoints(DRIVE))


def test_the_yaw_may_cross_the_half_turn() -> None:
    yaw = np.where(np.arange(51) % 2, np.pi - 1e-4, -np.pi + 1e-4)
    assert len(simplify_waypoints(replace(DRIVE, yaw_rad=yaw))) == len(simplify_waypoints(DRIVE))


@pytest.fixture(scope="module")
def straight() -> tuple[Log, Scenario]:
    return tiny_log([CAR | {"waypoints": [[16.0, 2.0, 4.0], [60.0, 2.0, 4.0]]}, PARKED], duration_s=3.0, noise_m=0.0)


@pytest.mark.slow
def test_few_waypoints_are_as_good_as_all(straight: tuple[Log, Scenario], monkeypatch: pytest.MonkeyPatch) -> None:
    log, truth = straight
    few = run(log)
    step = entry(few, "waypoint at every tick")
    assert not step["kept"]
    monkeypatch.setattr(log2sim.pipeline, "simplify", lambda agents: agents)
    every = run(log).scenario
    assert every.ego is not None
    ticks = every.ego.waypoints.t_s
    assert [len(a.waypoints) for a in few.scenario.agents if a.id == "ego"] == [len(ticks)]
    assert sum(len(a.waypoints) for a in few.scenario.agents) < sum(len(a.waypoints) for a in every.agents)
    for a, b in zip(few.scenario.agents, every.agents):
        p, q = a.at(ticks), b.at(ticks)
        np.testing.assert_array_equal(p.valid, q.valid)
        for k, tolerance in (("x_m", 0.01), ("y_m", 0.01), ("z_m", 0.01), ("yaw_rad", 0.002), ("speed_mps", 0.02)):
            np.testing.assert_allclose(getattr(p, k), getattr(q, k), rtol=0, atol=tolerance + 1e-12)
    measured = [evaluate(s, truth) for s in (few.scenario, every)]
    assert measured[0]["recall"] == measured[1]["recall"]
    assert measured[0]["position_rmse_m"] == pytest.approx(measured[1]["position_rmse_m"], abs=0.01)
    assert evaluate(every, few.scenario)["recall"] == evaluate(every, every)["recall"] == 1.0
    driven = [{a.id: a for a in replay(s).agents} for s in (few.scenario, every)]
    for name, agent in driven[0].items():
        np.testing.assert_allclose(agent.x_m, driven[1][name].x_m, rtol=0, atol=0.03)
        np.testing.assert_allclose(agent.y_m, driven[1][name].y_m, rtol=0, atol=0.03)


# --- the report


def test_the_time_saved_by_skipped_frames_is_that_of_the_others() -> None:
    clock = StageClock()
    clock.seconds.update({"decode": 1.0, "detect": 3.0})
    observations = Observations(frames_detected=40, frames_skipped={"back": 20})
    plan = Plan(("back",), (Decision(Stage.DETECTION_IN_EVERY_FRAME, False, "empty frames are skipped"),))
    (outcome,) = stage_outcomes(plan, observations, {}, (), clock)
    assert outcome.saved_s == pytest.approx(20 * 4.0 / 40)
    assert "20 of 60 frames" in outcome.decision.reason


def test_seconds_stand_in_the_report_and_not_in_the_scenario(tiny: Log) -> None:
    a, b = run(tiny), run(tiny)
    assert a.scenario.to_dict() == b.scenario.to_dict()
    assert all("saved_s" in p for p in a.report["plan"])
    assert not any("saved_s" in p for p in a.scenario.stages)
