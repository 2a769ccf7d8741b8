"""Mounts of cameras against a LiDAR: edges of synthetic scans and pictures with exact truth, and the sample with faults put in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import pytest

from log2sim import Config, open_log, pipeline
from log2sim.datatypes import Finding, Log
from log2sim.geometry import (
    Camera,
    PoseTrack,
    RollingShutter,
    apply,
    inverse,
    project,
    project_moving,
    rotation_from_rpy,
    transform,
)
from log2sim.localization.clocks import turn_mount
from log2sim.localization.edges import (
    SYSTEMATIC_RAD,
    EdgeView,
    YawEstimate,
    estimate_yaw,
    points_in_mount,
    score_angles,
)
from log2sim.localization.mounts import FlowPair, check_cameras, find_exchanged, flow_agreement
from log2sim.plan import choose_detector, select_sensors

SAMPLE = Path(__file__).parents[1] / "samples/crossing"
FORWARD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
K = np.array([[600.0, 0.0, 399.5], [0.0, 600.0, 199.5], [0.0, 0.0, 1.0]])
CAMERA = Camera("front", 800, 400, K, "ego", transform(FORWARD, [1.5, 0.0, 1.5]))


def yawed(camera: Camera, degrees: float) -> Camera:
    return replace(camera, mount_T_cam=turn_mount(camera.mount_T_cam, np.radians([0.0, 0.0, degrees])))


# Alignment in a world of posts


def world(
    camera: Camera, rng: np.random.Generator, *, frames: int = 10, overhang_rad: float = 0.002, left_share: float = 0.5
) -> list[EdgeView]:
    """Pictures of the upright edges of panels, as many edges that no LiDAR sees, and points beside the ends of the panels."""
    views = []
    for _ in range(frames):
        azimuth, range_m = rng.uniform(-0.5, 0.5, 12), rng.uniform(6.0, 40.0, 12)
        left = rng.random(12) < left_share
        gray = np.full((camera.height_px, camera.width_px), 60, np.uint8)
        points = []
        for a, r, is_left in zip(azimuth, range_m, left):
            a_end = a + (overhang_rad if is_left else -overhang_rad)
            both = [
                np.stack([r * np.cos(b) + 0 * up, r * np.sin(b) + 0 * up, up], 1) for b, up in ((a_end, UP), (a, UP))
            ]
            uv, valid = project(camera, apply(inverse(camera.mount_T_cam), both[0]))
            cv2.polylines(gray, [np.round(uv[valid]).astype(np.int32)], False, 200, 1)
            points.append(both[1] + rng.normal(0.0, 0.02, both[1].shape))
        for u in rng.uniform(0, camera.width_px, 12).astype(int):
            cv2.line(gray, (u, 100), (u, 300), 200, 1)
        noisy = gray + rng.integers(0, 6, gray.shape, dtype=np.uint8)
        views.append(EdgeView(noisy, 1.0, np.concatenate(points), np.repeat(left, len(UP))))
    return views


UP = np.linspace(0.5, 2.5, 6)


def estimated(camera: Camera, views: Sequence[EdgeView]) -> YawEstimate | None:
    return estimate_yaw([score_angles(camera, view) for view in views])


@pytest.mark.parametrize("degrees", [-1.5, -0.3, 0.0, 1.0])
def test_the_yaw_that_a_mount_lacks_is_found(degrees: float) -> None:
    found = estimated(yawed(CAMERA, degrees), world(CAMERA, np.random.default_rng(3)))
    assert found is not None
    assert np.degrees(found.yaw_rad) == pytest.approx(-degrees, abs=0.06)


def test_errors_are_as_large_as_the_scatter_between_parts_of_the_log() -> None:
    errors, scatter = [], []
    for seed in range(8):
        found = estimated(CAMERA, world(CAMERA, np.random.default_rng(seed), frames=8))
        assert found is not None
        errors.append(found.yaw_rad)
        scatter.append(np.sqrt(found.sigma_rad**2 - SYSTEMATIC_RAD**2))
    assert 0.3 < np.std(errors) / np.sqrt(np.mean(np.square(scatter))) < 2.0
    assert np.abs(errors).max() < SYSTEMATIC_RAD


def test_pictures_of_another_place_give_no_yaw() -> None:
    for seed in range(3):
        pictures, points = (world(CAMERA, np.random.default_rng(k)) for k in (seed, 100 + seed))
        mixed = [replace(picture, points_mount=p.points_mount, left=p.left) for picture, p in zip(pictures, points)]
        assert estimated(CAMERA, mixed) is None


# Motion in images


def flow_pairs(camera: Camera, rng: np.random.Generator) -> list[FlowPair]:
    """Exact motion of standing points around the road for an ego that goes ahead and turns, some of them on a car that overtakes."""
    pairs = []
    for _ in range(4):
        points = rng.uniform([-30.0, -30.0, -1.0], [30.0, 30.0, 6.0], (2000, 3))
        second_T_first = inverse(transform(rotation_from_rpy(0.0, 0.0, rng.uniform(-0.05, 0.05)), [1.0, 0.02, 0.0]))
        after = apply(second_T_first, points)
        after[:300, 0] += 3.0
        both = [apply(inverse(camera.mount_T_cam), xyz) for xyz in (points, after)]
        shown = project(camera, both[0])[1] & project(camera, both[1])[1]
        rays = [xyz[shown] / np.linalg.norm(xyz[shown], axis=1)[:, None] for xyz in both]
        pairs.append(FlowPair(rays[0], rays[1], second_T_first))
    return pairs


def test_points_move_as_the_own_mount_says_and_exchanged_mounts_show() -> None:
    rng = np.random.default_rng(5)
    rig = {
        name: replace(yawed(CAMERA, degrees), name=name)
        for name, degrees in (("front", 0), ("left", 70), ("right", -70))
    }
    pairs = {name: flow_pairs(camera, rng) for name, camera in rig.items()}
    for name, camera in rig.items():
        assert (flow_agreement(camera, pairs[name]) or 0.0) > 0.99
        assert (flow_agreement(yawed(camera, 3.0), pairs[name]) or 0.0) > 0.9
    assert find_exchanged(rig, pairs) == {}
    swapped = {"front": rig["front"], "left": rig["right"], "right": rig["left"]}
    assert find_exchanged(swapped, pairs) == {"left": "right", "right": "left"}
    overtaken = {**pairs, "left": pairs["right"]}
    assert find_exchanged(rig, overtaken) == {}
    behind = flow_pairs(yawed(CAMERA, 180.0), rng)
    assert (flow_agreement(rig["right"], behind) or 0.0) < 0.3
    assert find_exchanged(rig, {**overtaken, "right": behind}) == {}
    assert flow_agreement(rig["left"], pairs["left"][:2]) is None


# The sample


@pytest.fixture(scope="module")
def sample() -> Log:
    return open_log(SAMPLE)


def with_cameras(log: Log, *cameras: Camera) -> Log:
    return log.changed(cameras={**log.cameras, **{camera.name: camera for camera in cameras}})


def checked(log: Log, *, fix: bool = False, of_lidars: tuple[Finding, ...] = ()) -> tuple[Log, tuple[Finding, ...]]:
    config = choose_detector(
        log, Config().changed(calibration={"fix_mounts": fix}, detect={"name": "ssd-mobilenet-v2"})
    )
    return check_cameras(log, config, select_sensors(log, config), of_lidars=of_lidars, progress=lambda *_: None)


def test_nothing_is_said_of_the_sample(sample: Log) -> None:
    same, faults = checked(sample)
    assert faults == ()
    assert same is sample


def test_a_turned_camera_is_told_and_corrected(sample: Log) -> None:
    turned = with_cameras(sample, yawed(sample.cameras["front"], 1.0))
    same, (fault,) = checked(turned)
    assert (fault.kind, fault.subject, fault.treatment) == ("camera_rotation", "front", "kept")
    assert same is turned
    assert abs(fault.values["yaw_deg"] - 1.0) < 2 * fault.values["yaw_sigma_deg"] < 0.4
    mended, (fault,) = checked(turned, fix=True)
    assert fault.treatment == "corrected"
    rest = mended.cameras["front"].mount_T_cam[:3, :3].T @ sample.cameras["front"].mount_T_cam[:3, :3]
    assert np.degrees(np.arccos((np.trace(rest) - 1) / 2)) < 0.15
    assert mended.cameras["front_left"] is sample.cameras["front_left"]


def test_exchanged_mounts_are_told_by_name_and_given_back(sample: Log) -> None:
    left, right = sample.cameras["front_left"], sample.cameras["front_right"]
    swapped = with_cameras(
        sample, replace(left, mount_T_cam=right.mount_T_cam), replace(right, mount_T_cam=left.mount_T_cam)
    )
    _, faults = checked(swapped)
    assert [(f.kind, f.subject, f.treatment) for f in faults] == [
        ("swapped_cameras", "front_left", "left_out"),
        ("swapped_cameras", "front_right", "left_out"),
    ]
    assert faults[0].other == "front_right"
    mended, faults = checked(swapped, fix=True)
    assert {f.treatment for f in faults} == {"corrected"}
    for name in ("front_left", "front_right"):
        np.testing.assert_array_equal(mended.cameras[name].mount_T_cam, sample.cameras[name].mount_T_cam)


def test_a_camera_that_is_turned_far_is_found_from_there(sample: Log) -> None:
    _, (fault,) = checked(with_cameras(sample, yawed(sample.cameras["front"], -3.0)))
    assert fault.values["yaw_deg"] == pytest.approx(-3.0, abs=0.2)


def test_slips_of_one_mount_are_told_and_mended(sample: Log) -> None:
    front, left = sample.cameras["front"], sample.cameras["front_left"]
    aside = transform(rotation_from_rpy(0.0, 0.0, np.pi / 2), np.zeros(3))
    inverted = replace(front, mount_T_cam=inverse(front.mount_T_cam))
    lying = replace(left, mount_T_cam=left.mount_T_cam @ inverse(aside))
    mended, faults = checked(with_cameras(sample, inverted, lying), fix=True)
    assert [(f.kind, f.subject) for f in faults] == [("wrong_mount", "front"), ("wrong_mount", "front_left")]
    assert [f.case for f in faults] == ["inverted", "turned"]
    assert faults[1].values == {"turn_deg": 90.0}
    for name in ("front", "front_left"):
        np.testing.assert_allclose(mended.cameras[name].mount_T_cam, sample.cameras[name].mount_T_cam, atol=1e-12)


def test_dark_pictures_say_nothing(sample: Log) -> None:
    stream = sample.streams["front"]
    dark = replace(stream, read=lambda i: stream.read(i) // 40, encoded=None)
    turned = with_cameras(sample, yawed(sample.cameras["front"], 1.0))
    dark_log = turned.changed(streams={**sample.streams, "front": dark})
    assert [fault.kind for fault in checked(dark_log, fix=True)[1]] == ["unknown_rotation"]


def test_a_run_goes_on_without_cameras_that_are_left_out(sample: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    left_out = Finding("swapped_cameras", "front", "left_out", case="flow")
    kept = Finding("swapped_cameras", "front_left", case="flow")
    monkeypatch.setattr(pipeline, "check_calibration", lambda log, *_, **__: (log, (left_out, kept)))
    run = pipeline.start(sample, Config().changed(detect={"name": "labels"}), cache=False)
    assert run.plan.cameras == ("front_left", "front_right")
    assert run.schedule.reference == "front_left"
    assert run.faults[-2:] == (left_out, kept)


@pytest.mark.parametrize("direction", ["down", "left"])
def test_points_are_where_they_are_when_their_line_is_exposed(direction: Literal["down", "left"]) -> None:
    t_ns, speed_mps = np.arange(0, 2_000_000_000, 10_000_000), 20.0
    poses = transform(np.eye(3), np.stack([speed_mps * t_ns / 1e9, 0 * t_ns, 0 * t_ns], axis=1))
    none: dict[str, Any] = {}
    ego = PoseTrack(t_ns, poses)
    log = Log("drive", "test", none, none, none, ego=ego)
    camera = replace(CAMERA, rolling_shutter=RollingShutter(direction, 0.04))
    points = np.random.default_rng(0).uniform([35.0, -5.0, 0.0], [60.0, 5.0, 5.0], (50, 3))
    found = points_in_mount(log, camera, 1_000_000_000, points)
    assert found is not None
    uv, _, valid = project_moving(
        camera, points, lambda s: inverse(ego.at(1_000_000_000 + np.round(s * 1e9).astype(int))[0] @ camera.mount_T_cam)
    )
    assert valid.sum() > 20
    np.testing.assert_allclose(
        project(camera, apply(inverse(camera.mount_T_cam), found))[0][valid], uv[valid], atol=0.1
    )
    still = points_in_mount(log, replace(camera, rolling_shutter=None), 1_000_000_000, points)
    assert still is not None
    assert np.abs(found - still)[:, 0].max() > 0.1
