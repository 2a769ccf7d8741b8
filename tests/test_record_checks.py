"""Records that lie: pictures that repeat or show nothing, sweeps that repeat or are sparse, and gaps; and what is no fault."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np
import pytest
from worlds import camera_ahead, scan, standing, tiny_log

from log2sim.config import Config, MapConfig
from log2sim.datatypes import Lidar, Log, Stream, Sweep
from log2sim.geometry import PoseTrack, transform
from log2sim.perception.records import (
    CameraWatch,
    LidarWatch,
    RecordWatch,
    common_share,
    gaps_of,
    measure_change,
    shows_nothing,
    shrink,
    sketch_sweep,
    spans_of,
)
from log2sim.perception.sync import synchronize
from log2sim.pipeline import reconstruct
from log2sim.road.builder import map_ground

STEP_NS = 100_000_000
COUNT = 10
STAMPS = 1_700_000_000_000_000_000 + np.arange(COUNT) * STEP_NS


@lru_cache
def pictures():
    """A street as a camera at 3 m/s sees it, ten pictures, and its log."""
    log, _ = tiny_log(observe=False)
    stream = log.streams["front"]
    return log, stream.t_ns, [stream.read(i) for i in range(len(stream.t_ns))]


def compressed(image, quality):
    return cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], cv2.IMREAD_COLOR)


def noisy(image, seed, sigma=4.0):
    noise = np.random.default_rng(seed).normal(0, sigma, image.shape)
    return np.clip(np.round(image + noise), 0, 255).astype(np.uint8)


def states(log, t_ns, images):
    watch = CameraWatch(log, "front")
    return [watch.judge(int(t), shrink(image)) for t, image in zip(t_ns, images)]


def with_motion(log, step_m):
    """The log with an ego that has moved by so many meters (T,) forward at the stamps of the front camera, and stood before."""
    t_ns = log.streams["front"].t_ns
    return log.changed(ego=path(t_ns, step_m))


def path(t_ns, x_m):
    """Poses along x at stamps, and at the place of the first a second before."""
    x, t = np.r_[x_m[0], x_m].astype(float), np.r_[t_ns[0] - 1_000_000_000, t_ns]
    return PoseTrack(t, transform(np.eye(3), np.stack([x, 0 * x, 0 * x], axis=1)))


def test_pictures_of_a_moving_camera_are_live():
    log, t_ns, images = pictures()
    assert set(states(log, t_ns, images)) == {"live"}
    assert set(states(log, t_ns, [compressed(image, 40) for image in images])) == {"live"}


def test_repeated_pictures_are_frozen_once_the_camera_has_moved():
    log, t_ns, images = pictures()
    found = states(log, t_ns, [images[min(i, 3)] for i in range(len(images))])
    assert set(found[:4]) == {"live"}
    assert set(found[5:]) == {"frozen"}


def test_repeated_pictures_that_were_compressed_again_are_frozen():
    log, t_ns, images = pictures()
    log = with_motion(log, 1.0 * np.arange(len(t_ns)))
    found = states(log, t_ns, [images[i] if i < 3 else compressed(images[3], 60 + 3 * i) for i in range(len(images))])
    assert set(found[:4]) == {"live"}
    assert set(found[6:]) == {"frozen"}


def test_a_camera_that_goes_on_is_live_again():
    log, t_ns, images = pictures()
    found = states(log, t_ns, [images[3 if 3 <= i < 7 else i] for i in range(len(images))])
    assert found[6] == "frozen"
    assert set(found[7:]) == {"live"}


def test_every_second_picture_sent_twice_is_told():
    log, t_ns, images = pictures()
    log = with_motion(log, 0.5 * np.arange(len(t_ns)))
    found = states(log, t_ns, [images[i - i % 2] for i in range(len(images))])
    assert set(found[2::2]) == {"live"}
    assert set(found[3::2]) == {"frozen"}


def test_identical_pictures_of_a_camera_that_stands_are_no_fault():
    log, t_ns, images = pictures()
    still = with_motion(log, np.zeros(len(t_ns)))
    assert set(states(still, t_ns, [images[0]] * len(t_ns))) == {"live"}
    assert set(states(log.changed(ego=None), t_ns, [images[0]] * len(t_ns))) == {"live"}


def test_a_camera_with_noise_that_stands_never_repeats_a_picture():
    log, t_ns, images = pictures()
    still = with_motion(log, np.zeros(len(t_ns)))
    live = [noisy(images[0], i) for i in range(len(t_ns))]
    assert set(states(still, t_ns, live)) == {"live"}
    found = states(still, t_ns, [live[min(i, 7)] for i in range(len(t_ns))])
    assert set(found[:8]) == {"live"}
    assert set(found[8:]) == {"frozen"}


def scatter(i):
    return np.random.default_rng(0).normal(0, 0.3, len(i))


@pytest.mark.parametrize(
    "step_m", [lambda i: 5.0 * (i >= 4), lambda i: 0.02 * i, scatter], ids=["jump", "drift", "scatter"]
)
def test_poses_that_jump_or_drift_do_not_make_a_standing_camera_frozen(step_m):
    log, t_ns, images = pictures()
    moved = with_motion(log, step_m(np.arange(len(t_ns))))
    assert set(states(moved, t_ns, [noisy(images[0], i) for i in range(len(t_ns))])) == {"live"}


def test_a_camera_known_to_have_noise_never_repeats_a_picture_while_it_starts():
    log, t_ns, images = pictures()
    log = with_motion(log, 0.06 * np.maximum(np.arange(len(t_ns)) - 6, 0))
    found = states(log, t_ns, [noisy(images[0], min(i, 7)) for i in range(len(t_ns))])
    assert set(found[:8]) == {"live"}
    assert set(found[8:]) == {"frozen"}


def test_a_camera_without_noise_that_creeps_to_a_stop_is_not_frozen():
    log, t_ns, images = pictures()
    places = np.minimum(np.arange(len(t_ns)), 6)
    assert set(states(with_motion(log, 0.05 * places), t_ns, [images[i] for i in places])) == {"live"}


def test_a_standing_camera_without_noise_is_not_frozen_by_scattered_poses():
    log, t_ns, images = pictures()
    moved = with_motion(log, 0.2 * scatter(np.arange(len(t_ns))))
    assert set(states(moved, t_ns, [images[0]] * len(t_ns))) == {"live"}


def gray(level, shape=(375, 1242)):
    return np.full((*shape, 3), level, dtype=np.uint8)


@pytest.mark.parametrize(
    "image",
    [
        gray(0), gray(255), gray((90, 20, 160)), noisy(gray(3), 1, 3.0), noisy(gray(128), 2, 45.0),
        compressed(noisy(gray(20), 3, 8.0), 50), gray(0, (1080, 1920)),
        noisy(gray(0) + np.linspace(20, 90, 1242).astype(np.uint8)[None, :, None], 4),
    ],
    ids=["black", "saturated", "one color", "dark noise", "much noise", "compressed noise", "large", "shade"],
)  # fmt: skip
def test_pictures_of_nothing_show_nothing(image):
    assert shows_nothing(shrink(image))


def test_scenes_at_night_and_in_fog_show_something():
    _, _, images = pictures()
    night = np.zeros((375, 1242, 3), dtype=np.uint8)
    cv2.circle(night, (700, 180), 2, (200, 220, 255), -1)  # one lamp far away
    assert not shows_nothing(shrink(noisy(night, 1, 3.0)))
    assert not shows_nothing(shrink(noisy((images[0] * 0.1).astype(np.uint8), 2, 2.0)))
    assert not shows_nothing(shrink(noisy((200 + (images[0] * 0.15)).astype(np.uint8), 3, 2.0)))


@pytest.mark.parametrize("shape", [(1, 1), (2, 3), (3, 500), (500, 3), (13, 17), (300, 4000)])
def test_pictures_of_any_shape_are_judged(shape):
    watch = CameraWatch(pictures()[0], "front")
    rng = np.random.default_rng(0)
    for i in range(3):
        assert watch.judge(i, shrink(rng.integers(0, 255, (*shape, 3), dtype=np.uint8))) in ("live", "black")
        assert shows_nothing(shrink(gray(7, shape)))


def test_change_is_zero_of_equal_pictures_only():
    _, _, images = pictures()
    small = shrink(images[0])
    assert measure_change(small, shrink(images[0])) == 0
    assert measure_change(small, shrink(images[-1])) > 10


SOLIDS = [standing(12.0 + 6 * k, (-1) ** k * 6.0, 20.0 * k) for k in range(6)]


def lidar_log(step_m=0.5, frame="lidar"):
    """A log whose LiDAR drives along a street by so much a sweep."""
    lidar = Lidar("top", "ego", transform(np.eye(3), np.array([0.0, 0.0, 1.9])))

    def read(i):
        world, _ = scan(SOLIDS, sensor=(step_m * i, 0.0, 1.9), noise_m=0.02, seed=i)
        return Sweep(int(STAMPS[i]), world - [step_m * i, 0.0, 1.9] if frame == "lidar" else world, frame)

    return Log(
        "log", "test", {}, {"top": lidar}, {"top": Stream("top", STAMPS, read)}, path(STAMPS, step_m * np.arange(COUNT))
    )


def repeated(log, sweeps):
    watch = LidarWatch(log, "top")
    return [watch.is_repeated(int(t), sketch_sweep(log, "top", sweep)) for t, sweep in zip(STAMPS, sweeps)]


def changed(sweep, how, i):
    xyz = sweep.xyz_m
    if how == "shuffled":
        xyz = np.random.default_rng(i).permutation(xyz)
    if how == "rounded":
        xyz = np.round(xyz + np.random.default_rng(i).normal(0, 3e-4, xyz.shape), 3)
    return replace(sweep, stamp_ns=int(STAMPS[i]), xyz_m=xyz)


@pytest.mark.parametrize("frame", ["lidar", "map"])
@pytest.mark.parametrize("how", ["copied", "shuffled"])
def test_copies_of_sweeps_are_told_whatever_the_order_of_their_points(how, frame):
    log = lidar_log(frame=frame)
    read = log.streams["top"].read
    found = repeated(log, [changed(read(2), how, i) if 2 < i < 7 else read(i) for i in range(COUNT)])
    assert found == [2 < i < 7 for i in range(COUNT)]


def test_copies_rounded_to_millimeters_are_told_once_it_is_known_that_sweeps_differ():
    log = lidar_log()
    read = log.streams["top"].read
    found = repeated(log, [read(i) if i < 7 else changed(read(6), "rounded", i) for i in range(COUNT)])
    assert found == [i >= 7 for i in range(COUNT)]


@pytest.mark.parametrize("step_m", [0.0, 0.05, 0.5])
def test_sweeps_with_noise_are_no_copies(step_m):
    log = lidar_log(step_m)
    assert not any(repeated(log, [log.streams["top"].read(i) for i in range(COUNT)]))


@pytest.mark.parametrize("step_m", [0.0, 0.06])
def test_copies_are_told_of_a_lidar_that_stands_or_starts_and_has_noise(step_m):
    log = lidar_log(0.0).changed(ego=path(STAMPS, step_m * np.maximum(np.arange(COUNT) - 6, 0)))
    read = log.streams["top"].read
    found = repeated(log, [read(min(i, 7)) for i in range(COUNT)])
    assert found == [i > 7 for i in range(COUNT)]


@pytest.mark.parametrize("start", [0.0, 0.5])
def test_equal_sweeps_without_noise_of_a_lidar_that_stands_are_no_fault(start):
    """It may have driven before: then its sweeps differed."""
    at = np.minimum(np.arange(COUNT), 5) * start
    log = lidar_log().changed(ego=path(STAMPS, at))
    sweeps = [scan(SOLIDS, sensor=(x, 0.0, 1.9))[0] - [x, 0.0, 1.9] for x in at]
    assert not any(repeated(log, [Sweep(int(t), xyz) for t, xyz in zip(STAMPS, sweeps)]))


def test_equal_sweeps_without_noise_are_no_fault_where_poses_scatter():
    at = 0.06 * np.random.default_rng(1).normal(size=COUNT)
    log = lidar_log().changed(ego=path(STAMPS, at))
    sweep = scan(SOLIDS)[0] - [0.0, 0.0, 1.9]
    assert not any(repeated(log, [Sweep(int(t), sweep) for t in STAMPS]))


def test_flat_ground_alone_looks_the_same_from_everywhere_and_is_no_copy():
    log = lidar_log(0.5)
    ground, _ = scan([], sensor=(0.0, 0.0, 1.9))
    assert not any(repeated(log, [Sweep(int(t), ground - [0.0, 0.0, 1.9]) for t in STAMPS]))


def test_common_share_of_halves():
    log = lidar_log(0.0)
    sweep = log.streams["top"].read(0)
    half = replace(sweep, xyz_m=sweep.xyz_m[::2])
    assert common_share(*(sketch_sweep(log, "top", s) for s in (sweep, sweep))) == 1
    assert common_share(*(sketch_sweep(log, "top", s) for s in (sweep, half))) == pytest.approx(2 / 3, abs=0.05)


def test_spans_join_what_is_near_and_everything_where_it_is_much():
    t_ns = np.arange(100) * STEP_NS
    at_fault = np.zeros(100, dtype=bool)
    at_fault[[3, 4, 6, 50, 51]] = True
    assert [(s.start_ns // STEP_NS, s.end_ns // STEP_NS, s.count, s.total) for s in spans_of(t_ns, at_fault)] == [
        (3, 6, 3, 4), (50, 51, 2, 2),
    ]  # fmt: skip
    at_fault[::20] = True
    assert [(s.count, s.total) for s in spans_of(t_ns, at_fault)] == [(10, 81)]
    assert spans_of(t_ns, np.zeros(100, dtype=bool)) == []


def test_gaps_are_longer_than_dropped_records():
    t_ns = np.arange(100) * STEP_NS
    assert gaps_of(t_ns, 0, int(t_ns[-1])) == []
    assert gaps_of(np.delete(t_ns, [20, 21, 50]), 0, int(t_ns[-1])) == []
    assert gaps_of(np.delete(t_ns, slice(20, 30)), 0, int(t_ns[-1])) == [(19 * STEP_NS, 30 * STEP_NS)]
    assert gaps_of(t_ns[:60], 0, int(t_ns[-1])) == [(59 * STEP_NS, 99 * STEP_NS)]
    slow = np.arange(20) * 5 * STEP_NS
    assert gaps_of(np.delete(slow, [7, 9]), 0, int(slow[-1])) == []
    assert gaps_of(slow[:2], 0, int(slow[-1])) == []


def streams_log(**stamps):
    cameras = {name: camera_ahead(name) for name in stamps if name != "top"}
    lidars = {"top": Lidar("top", "map", np.eye(4))} if "top" in stamps else {}
    nothing = lambda i: Sweep(0, np.zeros((1, 3)))  # noqa: E731
    return Log("log", "test", cameras, lidars, {n: Stream(n, t, nothing) for n, t in stamps.items()})


def missing(log):
    schedule = synchronize(log, tuple(log.cameras))
    return [(f.kind, f.sensor, f.message) for f in RecordWatch(log).faults(schedule)]


def test_missing_records_are_told_with_start_and_length():
    t = 1_700_000_000_000_000_000 + np.arange(50) * STEP_NS
    assert missing(streams_log(front=t, left=t, top=t)) == []
    found = missing(streams_log(front=t, left=np.delete(t, slice(30, 50)), top=np.delete(t, slice(11, 20))))
    assert found == [
        ("missing_images", "left", "no pictures in the last 2.00 s, after 2.90 s"),
        ("missing_sweeps", "top", "no sweeps for 1.00 s, from 1.00 to 2.00 s"),
    ]


@pytest.mark.parametrize("count", [0, 7])
def test_sweeps_with_next_to_no_points_are_told_with_counts(count):
    log = lidar_log()
    watch = RecordWatch(log)
    for i, t in enumerate(STAMPS.tolist()):
        sweep = log.streams["top"].read(i)
        few = replace(sweep, xyz_m=sweep.xyz_m[:count]) if i in (4, 5) else sweep
        watch.lidars["top"].is_repeated(t, sketch_sweep(log, "top", few))
    [fault] = watch.faults(synchronize(log, ()))
    assert (fault.kind, fault.sensor, fault.treatment) == ("sparse_sweeps", "top", "kept")
    assert fault.values["count"] == 2
    assert fault.values["most_points"] == count
    assert "2 from 0.40 to 0.50 s" in fault.message


def gap_errors(seed):
    """Errors (N, 2) m and sigmas (N,) m of the agents at the ticks without sweeps, and the faults that were told."""
    log, truth = tiny_log(seed=seed, duration_s=3.0)
    start_ns = int(log.streams["front"].t_ns[0])
    old = log.streams["top"]
    kept = np.flatnonzero(np.abs(old.t_ns - start_ns - 1_500_000_000) > 500_000_000)
    log = log.changed(streams={**log.streams, "top": Stream("top", old.t_ns[kept], lambda i: old.read(int(kept[i])))})
    result = reconstruct(log, Config.load(settings=["detect.name=labels"]))
    errors, sigmas = [], []
    for agent in result.scenario.others:
        w = agent.waypoints
        t = np.arange(1.1, 2.0, 0.1)
        t = t[(t >= w.t_s[0]) & (t <= w.t_s[-1])]
        xy = np.stack([np.interp(t, w.t_s, v) for v in (w.x_m, w.y_m)], axis=1)
        true = [
            np.stack([np.interp(t, o.waypoints.t_s, v) for v in (o.waypoints.x_m, o.waypoints.y_m)], axis=1)
            for o in truth.others
        ]
        if len(t):
            errors.append(min((xy - at for at in true), key=lambda e: np.hypot(*e.T).mean()))
            sigmas.append(np.interp(t, w.t_s, w.sigma_xy_m))
    return np.concatenate(errors), np.concatenate(sigmas), result.report["faults"]


@pytest.mark.slow
def test_positions_are_as_uncertain_as_their_errors_while_no_sweeps_come():
    several = [gap_errors(seed) for seed in range(2)]
    assert all([fault["kind"] for fault in faults] == ["missing_sweeps"] for *_, faults in several)
    error, sigma = (np.concatenate([found[k] for found in several]) for k in range(2))
    assert np.mean((error**2).sum(axis=1) / (2 * sigma**2)) < 2.0
    assert sigma.max() < 1.0


@pytest.mark.slow
def test_black_pictures_are_not_mapped():
    log, truth = tiny_log(observe=False)
    read = log.streams["front"].read
    half = Stream("front", log.streams["front"].t_ns, lambda i: read(i) * np.uint8(i < 5))
    whole, part = (
        map_ground(changed, truth, MapConfig())
        for changed in (log, log.changed(streams={**log.streams, "front": half}))
    )
    assert 0 < part.coverage.sum() < whole.coverage.sum()
    assert part.image_bgr[part.coverage].min() > 20
