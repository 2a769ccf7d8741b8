"""The first pass: a driving ego, a ray-cast world and a detector that knows the truth."""

from __future__ import annotations

import threading
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from plain_settings import AGENTS_ALONE
from worlds import camera_ahead, cloud_at, outline_px, scan, standing

from log2sim.config import Config
from log2sim.datatypes import Boxes3D, Detections, Frame, ImageLabels, Lidar, Log, Stream, Sweep
from log2sim.errors import RecordError
from log2sim.files.stages import StageClock
from log2sim.geometry import Camera, PoseTrack, apply, inverse, rotation_from_rpy, transform
from log2sim.perception.first_pass import base_poses, observe
from log2sim.perception.frames import AHEAD, read_pictures, work_ahead
from log2sim.perception.fusion import fuse
from log2sim.perception.lidar.cloud import CELL_RAD, CloudSensor, cloud_origin, obstacles_of, sample_rays
from log2sim.perception.records import RecordSource
from log2sim.perception.run_detectors import Detectors
from log2sim.perception.sync import synchronize
from log2sim.pipeline import reconstruct
from log2sim.plan import make_plan, select_sensors

T0_NS = 1_700_000_000_000_000_000
STEP_NS = 100_000_000
TICKS = 4
SPEED_MPS = 5.0
SOLIDS = (standing(16.0, 3.0, 30.0), standing(12.0, -4.0, 0.0, (0.7, 0.7, 1.75)))
CATEGORIES = ("car", "pedestrian")
EGO_T_LIDAR = transform(np.eye(3), np.array([0.0, 0.0, 1.9]))
STAMPS = T0_NS + np.arange(TICKS) * STEP_NS


class Truth:
    """A detector that projects the solids; it counts its frames and looks at the images only if told to."""

    name, default_min_score = "truth", 0.1

    def __init__(self, log, far=(0.0, 0.0, 0.0), *, looks=False):
        self.log, self.far, self.looks, self.frames = log, np.array(far), looks, []

    def detect(self, frame):
        self.frames.append((frame.camera.name, frame.t_ns))
        if self.looks:
            frame.image()
        map_T_cam = self.log.map_T_sensor(frame.camera.name, frame.t_ns)[0][0].copy()
        map_T_cam[:3, 3] -= self.far
        outline = np.array([outline_px(frame.camera, map_T_cam, s) for s in SOLIDS])
        return Detections(outline, np.full(len(SOLIDS), 0.9), np.array(CATEGORIES, dtype="<U16"))


def driving_log(*, far=(0.0, 0.0, 0.0), broken=(), cameras=("front",), empty=(), yaw=0.0):
    """A log of four ticks at 5 m/s; `broken` and `empty` name (stream, index) that cannot be read or hold no point."""
    reads = Counter()
    far = np.array(far)
    t = T0_NS + np.arange(-2, TICKS + 2) * STEP_NS
    x = (t - T0_NS) / 1e9 * SPEED_MPS
    poses = transform(np.eye(3), np.stack([x, 0 * x, 0 * x], axis=1) + far)

    def check(name, i):
        reads[name, i] += 1
        if (name, i) in broken:
            raise RecordError(f"{name} {i}: torn")

    def image(name):
        def read(i):
            check(name, i)
            return np.zeros((600, 1200, 3), dtype=np.uint8)

        return read

    def sweep(i):
        check("top", i)
        if ("top", i) in empty:
            return Sweep(int(STAMPS[i]), np.zeros((0, 3)))
        at = SPEED_MPS * i * STEP_NS / 1e9
        world, _ = scan(SOLIDS, sensor=(at, 0.0, 1.9), noise_m=0.01, seed=i)
        return Sweep(int(STAMPS[i]), world - [at, 0.0, 1.9], "lidar", np.full(len(world), STAMPS[i]))

    log = Log(
        "log",
        "test",
        {name: camera_ahead(name, mount="ego") for name in cameras},
        {"top": Lidar("top", "ego", EGO_T_LIDAR)},
        {**{name: Stream(name, STAMPS, image(name)) for name in cameras}, "top": Stream("top", STAMPS, sweep)},
        PoseTrack(t, poses),
    )
    return log, reads


def run(log, detector=None, *, sweeps=None, config=None, max_range_m=80.0, mode="robust", labels=False, reads=None):
    reads = {} if reads is None else reads
    config = config or Config.load(settings=["detect.name=labels"] if labels else [])
    sensors = select_sensors(log, config)
    ticks, schedule = [], synchronize(log, sensors.cameras)
    plan = make_plan(log, config, sensors, schedule.t_ns, tiled=True)
    reads.clear()  # synchronization looks into a sweep
    out = observe(
        log, schedule, plan, detectors=Detectors(detector or Truth(log), sweeps),
        config=config.changed(measure={"mode": mode, "max_range_m": max_range_m}), clock=StageClock(),
        progress=lambda done, total: ticks.append((done, total)),
    )  # fmt: skip
    return out, ticks


@pytest.mark.parametrize("far", [(0.0, 0.0, 0.0), (5e5, 5e6, 70.0)], ids=["origin", "UTM"])
def test_every_tick_has_every_object_at_its_place_in_the_map(far):
    log, _ = driving_log(far=far)
    out, ticks = run(log, Truth(log, far))
    assert ticks == [(k + 1, TICKS) for k in range(TICKS)]
    assert len(out.measurements) == len(out.obstacles) == TICKS
    for k, m in enumerate(out.measurements):
        assert sorted(m.category.tolist()) == ["car", "pedestrian"]
        for solid, category in zip(SOLIDS, CATEGORIES):
            row = m.take(m.category == category)
            assert np.hypot(*(row.center_m[0] - solid.center_m - far)[:2]) < 0.3
            assert row.bottom_m[0] == pytest.approx(far[2], abs=0.1)
            assert row.t_ns[0] == STAMPS[k]
    assert out.detections == {"front": TICKS * 2}


class Sweeps:
    """A detector in sweeps that finds the solids, with the same score for all."""

    name = "lidar:truth"

    def __init__(self, score):
        self.score = score

    def detect(self, cloud, earlier):
        n = len(SOLIDS)
        rows = [np.array([getattr(s, field) for s in SOLIDS]) for field in ("center_m", "size_m", "yaw_rad")]
        some = np.full(n, 50), None
        return Boxes3D(
            np.full(n, cloud.stamp_ns), *rows, np.ones(n), np.array(CATEGORIES), np.full(n, self.score), *some
        )


@pytest.mark.parametrize("score", [0.4, 0.6])
def test_tiles_take_turns_and_pictures_are_watched_where_sweeps_show_a_person(score):
    log, _ = driving_log(cameras=("front", "left"))
    detector, turns = Truth(log), []
    inner = detector.detect
    detector.detect = lambda frame: turns.append((frame.camera.name, frame.t_ns, frame.turn)) or inner(frame)
    run(log, detector, sweeps=Sweeps(score), config=Config.load(detect={"name": "truth.onnx+lidar:vehicle"}))
    assert [turn.number for camera, _, turn in turns if camera == "front"] == [0, 1, 3, 4]
    # The stride is two, and frames between ticks 0 and 2 may be skipped: these two are of different turns.
    for camera, t_ns, turn in turns:
        seen = outline_px(log.cameras[camera], log.map_T_sensor(camera, t_ns)[0][0], SOLIDS[1])
        np.testing.assert_allclose(turn.watched_px, seen[None][: int(score > 0.5)], atol=2)
    turns.clear()
    run(log, detector, config=Config.load(detect={"name": "truth.onnx"}))
    assert {turn for *_, turn in turns} == {None}  # nothing but the pictures shows what is there


def test_obstacles_are_the_points_above_the_ground_at_their_places():
    log, _ = driving_log()
    out, _ = run(log)
    for k, cloud in enumerate(out.obstacles):
        world = cloud.xyz + cloud.origin
        assert cloud.stamp_ns == STAMPS[k]
        assert len(world) > 50
        np.testing.assert_allclose(cloud.sensor + cloud.origin, [SPEED_MPS * k * 0.1, 0, 1.9], atol=1e-4)
        near = [(np.hypot(*(world[:, :2] - s.center_m[:2]).T) < 2.6) for s in SOLIDS]
        assert np.logical_or(*near).mean() > 0.98
        assert world[:, 2].min() > 0.1


def test_each_record_is_read_once_and_images_only_if_they_are_needed():
    log, reads = driving_log(cameras=("front", "left"))
    detector = Truth(log)
    out, _ = run(log, detector, labels=True, reads=reads)
    assert set(reads) == {("top", i) for i in range(TICKS)}
    assert set(reads.values()) == {1}
    assert len(detector.frames) == 2 * TICKS
    assert [len(m) for m in out.measurements] == [4] * TICKS  # two objects, seen by two cameras
    assert [len(m) for m in fuse(out.measurements)] == [2] * TICKS
    log, reads = driving_log(cameras=("front", "left"))
    run(log, Truth(log, looks=True), reads=reads)
    assert reads == {(s, i): 1 for s in ("front", "left", "top") for i in range(TICKS)}


def test_one_torn_image_and_one_torn_sweep_are_counted_and_cost_only_their_tick():
    log, _ = driving_log(broken={("front", 1), ("top", 2)})
    out, ticks = run(log, Truth(log, looks=True))
    assert len(ticks) == TICKS
    found = [m.source.tolist() for m in out.measurements]
    assert found[0] == found[3] == ["lidar", "lidar"]
    assert found[1] == []
    assert found[2] == ["", ""]
    assert [o is None for o in out.obstacles] == [False, False, True, False]
    assert out.records.summary() == {
        "front": {"count": 1, "first": "front 1: torn"},
        "top": {"count": 1, "first": "top 2: torn"},
    }


def roadside(log):
    """The same log from posts: sensors fixed in the map where the ego was at the start, and no ego."""
    cameras = {n: replace(c, mount="map") for n, c in log.cameras.items()}
    streams = {**log.streams, "top": replace(log.streams["top"], read=lambda i: first(log, i))}
    return replace(log, ego=None, cameras=cameras, lidars={"top": Lidar("top", "map", EGO_T_LIDAR)}, streams=streams)


def first(log, i):
    sweep = log.streams["top"].read(0)
    return replace(sweep, stamp_ns=int(STAMPS[i]), t_ns=np.full(len(sweep.t_ns), STAMPS[i]))


def test_sensors_on_a_post_need_no_ego():
    log = roadside(driving_log()[0])
    out, _ = run(log)
    for m in out.measurements:
        assert m.source.tolist() == ["lidar", "lidar"]
        for solid, category in zip(SOLIDS, CATEGORIES):
            row = m.take(m.category == category)
            assert np.hypot(*(row.center_m[0] - solid.center_m)[:2]) < 0.3
    np.testing.assert_array_equal(base_poses(log, np.array([T0_NS]))[0], np.eye(4))
    origin, ground = cloud_origin(log, T0_NS)
    np.testing.assert_allclose(origin, [0.0, 0.0, (1.9 + 1.6) / 2])
    assert ground == 0.0


def test_the_ground_under_the_ego_turns_with_its_pitch():
    log, _ = driving_log()
    pose = transform(rotation_from_rpy(0.0, 0.1, 0.0), np.array([5.0, 6.0, 7.0]))
    tilted = replace(log, ego=PoseTrack(STAMPS[:1], pose[None]), ground_z_ego_m=-0.5)
    origin, ground = cloud_origin(tilted, int(STAMPS[0]))
    np.testing.assert_allclose(origin, [5, 6, 7])
    assert ground == pytest.approx(7.0 - 0.5 * np.cos(0.1))


def test_feet_and_ground_points_lie_where_the_camera_sees_them():
    log, _ = driving_log()
    out, _ = run(log)
    camera = log.cameras["front"]
    ego_T_cam = camera.mount_T_cam
    for parts, allowed_px in ((out.ground["front"], 3.0), (out.feet["front"], 25.0)):
        assert sorted({int(t) for p in parts for t in p.tick}) == list(range(TICKS))
        for p in parts:
            ground = np.column_stack([p.xy_ego, np.zeros(len(p.xy_ego))])
            seen = apply(inverse(ego_T_cam), ground)
            uv = seen[:, :2] / seen[:, 2:] * 700.0 + [600.0, 300.0]
            # Rough for feet: the lower side of an outline belongs to a corner, the ground to the nearest points.
            assert np.median(np.hypot(*(uv - p.uv).T)) < allowed_px


def test_mode_paper_runs_from_the_log_to_the_scenario():
    log, _ = driving_log()
    boxes = [Truth(log).detect(Frame(log.cameras["front"], int(t), lambda: None)).box_px for t in STAMPS]
    labels = ImageLabels(np.repeat(STAMPS, 2), np.concatenate(boxes), np.array(CATEGORIES * TICKS))
    log = replace(log, image_labels={"front": labels})
    config = Config.load(settings=["detect.name=labels", "measure.mode=paper"], **AGENTS_ALONE)
    scenario = reconstruct(log, config).scenario
    assert scenario.ego is not None
    assert scenario.others


def with_records(log, **reads):
    """The log with other records: by stream a function of the index."""
    streams = {name: Stream(name, log.streams[name].t_ns, read) for name, read in reads.items()}
    return log.changed(streams={**log.streams, **streams})


def test_a_repeated_sweep_counts_as_not_recorded_and_is_told():
    log, _ = driving_log()
    sweep = log.streams["top"].read
    out, _ = run(with_records(log, top=lambda i: sweep((0, 1, 1, 3)[i])))
    assert [cloud is None for cloud in out.obstacles] == [False, False, True, False]
    assert set(out.measurements[2].source) == {""}  # seen by the camera alone
    assert [(f.kind, f.subject, f.treatment, f.start_s) for f in out.faults] == [
        ("repeated_sweeps", "top", "left_out", (STAMPS[2] - STAMPS[0]) / 1e9)
    ]


@pytest.mark.parametrize("finds", [True, False])
def test_a_black_picture_says_nothing_unless_something_is_found_in_it(finds):
    log, _ = driving_log()
    detector = Truth(log)
    if not finds:
        detector.detect = lambda frame: Detections.empty()
    out, _ = run(log, detector)
    assert out.unseen == ({} if finds else {"front": [0, 1, 2, 3]})
    assert [f.kind for f in out.faults] == ([] if finds else ["black_images"])


SIZE = (64, 48)
K = np.array([[60.0, 0, 32], [0, 60.0, 24], [0, 0, 1.0]])


def log_of(reads: list[tuple[str, int]], *, black: int = -1, broken: int = -1) -> Log:
    """Two cameras with 5 frames each, the second 50 ms later; the first pixel of a frame is its index."""

    def read(name: str, i: int) -> NDArray[np.uint8]:
        reads.append((name, i))
        if i == broken:
            raise RecordError("broken")
        blocks = np.random.default_rng([i, len(name)]).integers(0, 255, (6, 8, 3)).astype(np.uint8)
        image = blocks.repeat(8, axis=0).repeat(8, axis=1)
        image[0, 0] = i
        return np.zeros_like(image) if i == black else image

    cameras = {n: Camera(n, *SIZE, K, "map", np.eye(4)) for n in ("left", "right2")}
    streams = {
        name: Stream(name, np.arange(5, dtype=np.int64) * 10**8 + k * 5 * 10**7, lambda i, n=name: read(n, i))
        for k, name in enumerate(cameras)
    }
    return Log("l", "synthetic", cameras, {}, streams)


def test_each_is_decoded_once_and_comes_in_order_of_time() -> None:
    reads: list[tuple[str, int]] = []
    log = log_of(reads)
    wanted = {"left": np.array([3, 1, 4, 1]), "right2": np.array([1])}
    steps: list[tuple[int, int]] = []
    pictures = read_pictures(RecordSource(log), wanted, lambda *step: steps.append(step))
    got = [(camera, index, int(image[0, 0, 0])) for camera, index, image in pictures]
    assert got == [("left", 1, 1), ("right2", 1, 1), ("left", 3, 3), ("left", 4, 4)]
    assert sorted(reads) == [("left", 1), ("left", 3), ("left", 4), ("right2", 1)]
    assert steps == [(k + 1, 4) for k in range(4)]


PATIENCE_S = 20.0


def test_no_more_is_made_ahead_than_asked_for() -> None:
    begun: list[int] = []
    results = work_ahead(begun.append, range(100), ahead=3)
    next(results)
    assert len(begun) <= 5
    results.close()


def test_an_error_comes_with_the_item_that_caused_it() -> None:
    results = work_ahead(lambda n: 6 // n, [3, 2, 0, 1])
    assert [next(results), next(results)] == [2, 3]
    with pytest.raises(ZeroDivisionError):
        next(results)


def test_closing_an_iterator_does_not_wait_for_its_work() -> None:
    """The garbage collector may close it under a lock that the working threads need to end."""
    started, held, closed = threading.Event(), threading.Event(), threading.Event()

    def work(n: int) -> int:
        if n:
            started.set()
            held.wait(PATIENCE_S)
        return n

    results = work_ahead(work, range(2 * AHEAD), ahead=1)
    assert next(results) == 0
    assert started.wait(PATIENCE_S)

    def close() -> None:
        results.close()
        closed.set()

    closing = threading.Thread(target=close, daemon=True)
    closing.start()
    in_time = closed.wait(PATIENCE_S / 4)
    held.set()
    closing.join()
    assert in_time


def cloud_of(xyz, **columns):
    return cloud_at(xyz, origin=(1e5, 2e6, 3.0), **columns)


def directions(rays):
    to = rays.end - rays.start
    return np.arctan2(to[:, 1], to[:, 0]), to[:, 2] / np.hypot(to[:, 0], to[:, 1])


def test_near_and_far_points_keep_their_share() -> None:
    # A wall at 5 m on one half and one at 40 m on the other, both with a ray every 0.1 degrees.
    azimuth, slope = (
        a.ravel() for a in np.meshgrid(np.deg2rad(np.arange(-80, 80, 0.1)), np.deg2rad(np.arange(-2, 2, 0.1)))
    )
    reach = np.where(azimuth < 0, 5.0, 40.0)
    rays = sample_rays(cloud_of(np.column_stack([reach * np.cos(azimuth), reach * np.sin(azimuth), 2 + reach * slope])))
    near = np.hypot(rays.end[:, 0], rays.end[:, 1]) < 6
    assert near.sum() == pytest.approx((~near).sum(), rel=0.02)
    assert len(rays) == pytest.approx(160 / 0.5 * 4 / 0.5, rel=0.15)
    found_azimuth, found_slope = directions(rays)
    assert np.ptp(found_azimuth) == pytest.approx(np.deg2rad(160), abs=2 * CELL_RAD)
    assert np.ptp(found_slope) == pytest.approx(np.deg2rad(4), abs=2 * CELL_RAD)


@pytest.mark.parametrize("spread_m", [0.3, 4.0, 60.0])
def test_of_obstacles_the_first_point_of_every_voxel_is_kept(spread_m: float) -> None:
    xyz = (
        np.random.default_rng(3)
        .uniform([-spread_m, -spread_m, 0.3], [spread_m, spread_m, 4.0], (60_000, 3))
        .astype(np.float32)
    )
    cloud = cloud_of(xyz)
    near = xyz[np.hypot(xyz[:, 0], xyz[:, 1]) < 70]
    first = np.unique(np.floor(near / np.float32(0.12)), axis=0, return_index=True)[1]
    np.testing.assert_array_equal(obstacles_of(cloud).xyz, near[np.sort(first)])


def test_each_ray_starts_where_its_sensor_was() -> None:
    sensors = [
        CloudSensor(2, np.array([1.0, 0, 2]), np.array([10.0, 0, 0])),
        CloudSensor(1, np.array([-1.0, 3, 1]), np.zeros(3)),
    ]
    xyz = np.array([[20.0, 0, 1], [0, 20, 1], [-20, 0, 1]])
    rays = sample_rays(cloud_of(xyz, sensors=sensors, t_s=np.array([0.0, -0.1, 0.05])))
    start_of = {tuple(e): s for e, s in zip(rays.end.round(3).tolist(), rays.start.round(3).tolist())}
    assert start_of == {(20, 0, 1): [1, 0, 2], (0, 20, 1): [0, 0, 2], (-20, 0, 1): [-1, 3, 1]}
