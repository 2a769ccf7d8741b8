"""Records that lie: pictures that repeat or show nothing, sweeps that repeat or are sparse, and gaps; and what is no fault."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np
import pytest
from worlds import camera_ahead, scan, standing, tiny_log

from log2sim.datatypes import Lidar, Log, Stream, Sweep
from log2sim.geometry import PoseTrack, transform
from log2sim.perception.records import CameraWatch, LidarWatch, RecordWatch, shows_nothing, shrink, sketch_sweep
from log2sim.perception.sync import synchronize

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


def test_a_camera_with_noise_that_stands_never_repeats_a_picture():
    log, t_ns, images = pictures()
    still = with_motion(log, np.zeros(len(t_ns)))
    live = [noisy(images[0], i) for i in range(len(t_ns))]
    assert set(states(still, t_ns, live)) == {"live"}
    found = states(still, t_ns, [live[min(i, 7)] for i in range(len(t_ns))])
    assert set(found[:8]) == {"live"}
    assert set(found[8:]) == {"frozen"}


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


@pytest.mark.parametrize("step_m", [0.0, 0.05, 0.5])
def test_sweeps_with_noise_are_no_copies(step_m):
    log = lidar_log(step_m)
    assert not any(repeated(log, [log.streams["top"].read(i) for i in range(COUNT)]))


def test_flat_ground_alone_looks_the_same_from_everywhere_and_is_no_copy():
    log = lidar_log(0.5)
    ground, _ = scan([], sensor=(0.0, 0.0, 1.9))
    assert not any(repeated(log, [Sweep(int(t), ground - [0.0, 0.0, 1.9]) for t in STAMPS]))


def streams_log(**stamps):
    cameras = {name: camera_ahead(name) for name in stamps if name != "top"}
    lidars = {"top": Lidar("top", "map", np.eye(4))} if "top" in stamps else {}
    nothing = lambda i: Sweep(0, np.zeros((1, 3)))  # noqa: E731
    return Log("log", "test", cameras, lidars, {n: Stream(n, t, nothing) for n, t in stamps.items()})


def missing(log):
    schedule = synchronize(log, tuple(log.cameras))
    first_ns, last_ns = int(schedule.t_ns[0]), int(schedule.t_ns[-1])
    return [
        (f.kind, f.subject, f.start_s, f.end_s, f.values)
        for f in RecordWatch(log).faults(log.streams, first_ns, last_ns)
    ]


def test_missing_records_are_told_with_start_and_length():
    t = 1_700_000_000_000_000_000 + np.arange(50) * STEP_NS
    assert missing(streams_log(front=t, left=t, top=t)) == []
    found = missing(streams_log(front=t, left=np.delete(t, slice(30, 50)), top=np.delete(t, slice(11, 20))))
    assert found == [
        ("missing_images", "left", 2.9, 4.9, {"gaps": 1.0, "longest_s": 2.0}),
        ("missing_sweeps", "top", 1.0, 2.0, {"gaps": 1.0, "longest_s": 1.0}),
    ]
