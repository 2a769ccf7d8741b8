"""Seams between cameras: registered patches, offsets of known mount errors, and mounts that make them vanish."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from log2sim.datatypes import Detections, Log, Measurements, Obstacles, Stream
from log2sim.evaluation.bench.runs import SeamBench
from log2sim.geometry import Array, Camera, PoseTrack, apply_homography, ground_homography, rotation_from_rpy, transform
from log2sim.perception.first_pass import Observations
from log2sim.perception.frames import RecordReader
from log2sim.perception.homography.correspondences import Correspondences
from log2sim.perception.homography.fit import HomographyFit
from log2sim.perception.homography.rig import Rig, RigState, foot_homography, rotation_of
from log2sim.perception.homography.rig_fit import RigFit
from log2sim.perception.homography_stage import CameraHomography
from log2sim.perception.seams import (
    SeamPictures,
    SeamPlace,
    SeamView,
    align_seams,
    find_seams,
    fit_mounts,
    ground_points,
    measure_seam,
    misalignment_m,
    moved_by_turn,
    register_patches,
    roads_at,
    standing_at,
    summarize_seams,
    ticks_of,
    turn_mounts,
    with_mounts,
)
from log2sim.perception.sync import Schedule

EGO_R_CAM = np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]])
T0_NS = 1_700_000_000_000_000_000
WAVES = np.random.default_rng(0)
# Cosines of wavelengths from 1 to 9 m in all directions.
NUMBERS = np.concatenate([scale * WAVES.normal(size=(5, 2)) for scale in (0.7, 1.5, 3.0, 6.0)])
PHASES = WAVES.uniform(0, 2 * np.pi, len(NUMBERS))
MIDDLE = np.array([1.6, 0.2])


def brightness(xy: Array) -> Array:
    """Of the ground at positions (N, 2)."""
    return 120 + 14 * np.cos(xy @ NUMBERS.T + PHASES).sum(axis=1)


def make_camera(name: str, yaw_deg: float, at: tuple[float, float, float], **lens: object) -> Camera:
    K = np.array([[480.0, 0, 384], [0, 480.0, 216], [0, 0, 1]])
    turn = rotation_from_rpy(0.0, np.radians(6.0), np.radians(yaw_deg))
    return Camera(name, 768, 432, K, "ego", transform(turn @ EGO_R_CAM, np.array(at)), **lens)  # type: ignore[arg-type]


def turned(camera: Camera, degrees: tuple[float, float, float]) -> Camera:
    turn = transform(rotation_of(np.radians(degrees)).T, np.zeros(3))
    return replace(camera, mount_T_cam=camera.mount_T_cam @ turn)


def shoot(camera: Camera, noise: float = 2.0, gain: float = 1.0, base: Array | None = None) -> np.ndarray:
    """Cast a ray a pixel onto the ground of the map."""
    pose = camera.mount_T_cam if base is None else base @ camera.mount_T_cam
    v, u = np.mgrid[: camera.height_px, : camera.width_px].astype(float)
    rays = np.stack([(u - camera.K[0, 2]) / camera.K[0, 0], (v - camera.K[1, 2]) / camera.K[1, 1], np.ones_like(u)], -1)
    rays = rays.reshape(-1, 3) @ pose[:3, :3].T
    near = rays[:, 2] < -0.05  # the ground within some 35 m
    xy = pose[:2, 3] - pose[2, 3] * rays[near, :2] / rays[near, 2:]
    gray = np.full(len(rays), 255.0)
    gray[near] = gain * brightness(xy)
    rng = np.random.default_rng(camera.width_px)
    gray = gray.reshape(u.shape) + noise * rng.normal(size=u.shape)
    return np.repeat(np.clip(gray, 0, 255).astype(np.uint8)[..., None], 3, axis=2)


CAMERAS = {"a": make_camera("a", 0.0, (1.7, 0.0, 1.6)), "b": make_camera("b", 60.0, (1.5, 0.4, 1.6))}
ROADS = {name: ground_homography(c, c.mount_T_cam) for name, c in CAMERAS.items()}


@pytest.mark.parametrize("offset_m", [(0.0, 0.0), (0.31, -0.17), (-1.02, 0.44)])
def test_a_shifted_patch_is_found_to_a_third_of_a_cell(offset_m: tuple[float, float]) -> None:
    cell = 0.04
    x, y = np.meshgrid(np.arange(0, 6, cell), np.arange(0, 4, cell), indexing="ij")
    rng = np.random.default_rng(1)

    def patch(shift: tuple[float, float], gain: float) -> np.ndarray:
        seen = brightness(np.column_stack([(x - shift[0]).ravel(), (y - shift[1]).ravel()])).reshape(x.shape)
        return (gain * seen + rng.normal(0, 2, x.shape)).astype(np.float32)

    found = register_patches(patch((0.0, 0.0), 1.0), patch(offset_m, 0.7), cell)
    assert found is not None
    np.testing.assert_allclose(found.offset_m, offset_m, atol=0.013)
    assert found.correlation > 0.9
    assert np.sqrt(np.diag(found.covariance)).max() < 0.015


def test_patches_that_do_not_tell_an_offset_are_refused() -> None:
    cell, rng = 0.04, np.random.default_rng(2)
    x, y = np.meshgrid(np.arange(0, 6, cell), np.arange(0, 3, cell), indexing="ij")
    edge = np.where(y > 1.5, 180.0, 60.0)
    crosswalk = np.where((x % 1.0) < 0.5, 200.0, 60.0)
    for name, one in {"even": 0 * x + 90.0, "an edge along it": edge, "a crosswalk": crosswalk}.items():
        patches = [(one + rng.normal(0, 2, x.shape)).astype(np.float32) for _ in range(2)]
        assert register_patches(patches[0], patches[1], cell) is None, name
    seen = brightness(np.column_stack([x.ravel(), y.ravel()])).reshape(x.shape).astype(np.float32)
    hidden = np.where(x < 4.0, np.nan, seen).astype(np.float32)
    assert register_patches(seen, hidden, cell) is None


def test_patches_of_different_ground_are_not_taken_for_the_same() -> None:
    cell, accepted = 0.04, 0
    x, y = np.meshgrid(np.arange(0, 6, cell), np.arange(0, 2, cell), indexing="ij")
    for k in range(40):
        pair = [
            brightness(np.column_stack([x.ravel() + s, y.ravel() - s])).reshape(x.shape)
            for s in (50 * k, 5000 + 70 * k)
        ]
        accepted += register_patches(pair[0].astype(np.float32), pair[1].astype(np.float32), cell) is not None
    assert accepted <= 1


def test_seams_lie_where_two_cameras_see_the_ground() -> None:
    places = find_seams(CAMERAS, ROADS, MIDDLE, 15.0)
    assert [(p.first, p.second) for p in places] == [("a", "b")]
    assert np.hypot(*(places[0].center_m - MIDDLE)) == pytest.approx(15.0)
    assert 20 < np.degrees(places[0].azimuth_rad) < 40
    apart = {"a": CAMERAS["a"], "b": make_camera("b", 180.0, (0.0, 0.0, 1.6))}
    roads = {name: ground_homography(c, c.mount_T_cam) for name, c in apart.items()}
    assert find_seams(apart, roads, MIDDLE, 15.0) == []


@pytest.mark.slow
@pytest.mark.parametrize("degrees", [(0.0, 0.0, 0.0), (0.3, 0.0, 0.0), (0.0, 0.3, 0.0), (0.1, -0.2, 0.2)])
def test_the_misalignment_of_a_known_mount_error_is_measured(degrees: tuple[float, float, float]) -> None:
    true = turned(CAMERAS["b"], degrees)
    images = {"a": shoot(CAMERAS["a"]), "b": shoot(true, gain=0.8)}
    seam = measure_seam(SeamView(find_seams(CAMERAS, ROADS, MIDDLE, 15.0)[0], 0), images, CAMERAS, ROADS)
    assert seam is not None
    center = np.array(seam.place.center_m)
    q = np.linalg.inv(ground_homography(true, true.mount_T_cam)) @ [*center, 1.0]
    expected = apply_homography(ROADS["b"], q[None, :2] / q[2])[0][0] - center
    # The offset grows with the square of the distance, and the patch is 6 m long.
    np.testing.assert_allclose(seam.offset_m, expected, atol=0.01 + 0.1 * np.hypot(*expected))
    # What was registered by the calibration tells what the true homographies make of it.
    right = {"a": ROADS["a"], "b": ground_homography(true, true.mount_T_cam)}
    assert misalignment_m(seam, ROADS) == pytest.approx(seam.distance_m)
    assert misalignment_m(seam, right) < 0.01 + 0.1 * np.hypot(*expected)
    assert misalignment_m(seam, {**ROADS, "b": -ROADS["b"]}) == np.inf
    assert summarize_seams([seam]) == {"a|b": pytest.approx(seam.distance_m)}


def rig_of(cameras: dict[str, Camera]) -> RigFit:
    rig = Rig.of(cameras, 0.0)
    state = RigState.calibrated(rig)
    fits = {
        n: HomographyFit(True, "", foot_homography(rig, state, n), np.zeros(0, dtype=bool), 0.0, 1.0) for n in cameras
    }
    return RigFit("", rig, fits, state)


def test_the_derivative_of_a_ground_position_by_a_turn_is_its_difference() -> None:
    rig = rig_of(CAMERAS)
    road = rig.road_at_tick("b", 0)
    assert road is not None
    xy, step = np.array([9.0, 7.0]), 1e-6
    q = np.linalg.inv(road) @ [*xy, 1.0]
    for k in range(3):
        mounts = {"a": np.zeros(3), "b": step * np.eye(3)[k]}
        moved = with_mounts(rig, mounts).road_at_tick("b", 0)
        assert moved is not None
        there = apply_homography(moved, q[None, :2] / q[2])[0][0]
        np.testing.assert_allclose((there - xy) / step, moved_by_turn(rig, "b", xy)[:, k], rtol=1e-3, atol=1e-2)


def log_of(true: dict[str, Camera], speed_mps: float) -> tuple[Log, Schedule, Observations]:
    """Twelve ticks of an ego that drives over the ground; the second camera exposes 30 ms after the first."""
    t = T0_NS + np.arange(12) * 500_000_000
    poses = np.repeat(np.eye(4)[None], 14, axis=0)
    times = T0_NS + np.arange(-1, 13) * 500_000_000
    poses[:, 0, 3] = speed_mps * (times - T0_NS) / 1e9
    ego = PoseTrack(times, poses)
    later = {"a": 0, "b": 30_000_000}

    def picture(name: str, k: int) -> np.ndarray:
        return shoot(true[name], base=ego.at(int(t[k] + later[name]))[0][0])

    streams = {n: Stream(n, t + later[n], lambda k, n=n: picture(n, k)) for n in true}
    log = Log("log", "test", dict(CAMERAS), {}, streams, ego)
    schedule = Schedule("a", t, {n: np.arange(12) for n in true}, {}, {n: np.zeros(12) for n in true})
    observed = Observations(measurements=[Measurements.empty()] * 12, obstacles=[None] * 12)
    return log, schedule, observed


def homographies_of(rig: RigFit) -> dict[str, CameraHomography]:
    return {n: CameraHomography(CAMERAS[n], rig.fits[n], "", "", rig) for n in CAMERAS}


@pytest.mark.slow
def test_mounts_are_turned_until_the_pictures_agree() -> None:
    true = {"a": CAMERAS["a"], "b": turned(CAMERAS["b"], (0.4, -0.2, 0.3))}
    log, schedule, observed = log_of(true, speed_mps=8.0)
    reader, before = RecordReader(log), homographies_of(rig_of(CAMERAS))
    after, _ = align_seams(SeamPictures.read(log, schedule, observed, reader, ticks_of(schedule, 3)), before)
    held_out = SeamPictures.read(log, schedule, observed, reader, ticks_of(schedule, 3, held_out=True))
    assert held_out.survey(before).median_m > 0.3
    assert held_out.survey(after).median_m < 0.03
    # A log with such mounts needs no homographies.
    rest = turn_mounts(log, after).cameras
    flat = {n: ground_homography(c, c.mount_T_cam) for n, c in rest.items()}
    for name, road in roads_at(log, schedule, after, 0).items():
        if name == "a":
            np.testing.assert_allclose(road / road[2, 2], flat[name] / flat[name][2, 2], atol=1e-9)
    for name in CAMERAS:  # obstacles are placed as before
        np.testing.assert_array_equal(after[name].fit.ground_H_image, before[name].fit.ground_H_image)
        assert after[name].rig is not None
        feet = foot_homography(after[name].rig.rig, after[name].rig.state, name)
        np.testing.assert_allclose(feet, before[name].fit.ground_H_image, rtol=1e-4, atol=1e-4)


@pytest.mark.slow
def test_bench_measures_seams_as_fitted_and_with_mounts_aligned() -> None:
    true = {"a": CAMERAS["a"], "b": turned(CAMERAS["b"], (0.3, 0.0, 0.0))}
    log, schedule, observed = log_of(true, speed_mps=0.0)
    shots = {n: shoot(c) for n, c in true.items()}
    streams = {n: replace(s, read=lambda k, n=n: shots[n] ^ np.uint8(k % 2)) for n, s in log.streams.items()}
    log, fits = log.changed(streams=streams), homographies_of(rig_of(CAMERAS))
    bench = SeamBench.of(log, schedule, observed, fits)
    figures = bench.figures(fits)
    assert figures["seam_m"] > 0.3
    assert figures["seam_aligned_m"] < 0.02
    assert figures["seams"] == 12
    apart = {n: replace(g, rig=None) for n, g in fits.items()}
    assert bench.figures(apart)["seam_m"] == pytest.approx(figures["seam_m"])
    assert "seam_aligned_m" not in bench.figures(apart)
    assert bench.figures({"a": fits["a"]}) == {}


def test_without_seams_mounts_stay_and_cameras_apart_are_left_alone() -> None:
    rig = rig_of(CAMERAS)
    assert all((v == 0).all() for v in fit_mounts(rig, []).values())
    log, schedule, observed = log_of(dict(CAMERAS), speed_mps=0.0)
    apart = {n: replace(g, rig=None) for n, g in homographies_of(rig).items()}
    pictures = SeamPictures(log, schedule, observed)
    aligned, survey = align_seams(pictures, apart)
    assert aligned == apart
    assert (survey.median_m, survey.places) == (None, 0)


def hidden_at(
    place: SeamPlace, points: Array | None, ground: Array, box: Array, step_m: float
) -> dict[str, np.ndarray] | None:
    log, schedule, observed = log_of(dict(CAMERAS), speed_mps=4.0)
    cloud = None
    if points is not None:
        zeros = np.zeros(len(points), np.float32)
        cloud = Obstacles(T0_NS, np.zeros(3), points.astype(np.float32), zeros, np.zeros(3, np.float32))
    q = (
        np.column_stack([ground, np.ones(len(ground))])
        @ np.linalg.inv(ground_homography(CAMERAS["a"], CAMERAS["a"].mount_T_cam, step_m)).T
    )
    rows = Correspondences(q[:, :2] / q[:, 2:], ground, np.zeros(len(ground), dtype=np.int64))
    seen = Measurements.unplaced(
        Detections(box, np.full(len(box), 0.9), np.full(len(box), "car", dtype="<U16")),
        t_ns=T0_NS, camera="a", sensor_m=np.zeros(3),
    )  # fmt: skip
    observed = replace(observed, obstacles=[cloud] * 12, ground={"a": [rows]}, measurements=[seen] * 12)
    known = standing_at(log, schedule, observed, ground_points(log, schedule, observed), 0)
    np.testing.assert_allclose(known.cameras["b"], [1.5 + 0.03 * 4.0, 0.4, 1.6], atol=1e-9)
    return known.hidden(place, CAMERAS, ROADS, 0.0)


def test_what_stands_at_a_place_or_before_it_is_left_out() -> None:
    place = find_seams(CAMERAS, ROADS, MIDDLE, 15.0)[0]
    there, no_box, none = np.array(place.center_m), np.zeros((0, 4)), np.zeros((0, 3))
    near = there + np.array([[0.0, 0.0], [0.5, 0.2], [-0.4, 0.3]])

    def share(points: Array | None, ground: Array = near, box: Array = no_box, step_m: float = 0.0) -> float | None:
        hidden = hidden_at(place, points, ground, box, step_m)
        return None if hidden is None else float(np.mean([h.mean() for h in hidden.values()]))

    assert share(none) == 0.0
    assert share(none, near + 20.0) is None  # no ground is known there
    assert share(none, step_m=0.12) is None  # a sidewalk
    assert share(None, near[:0]) == 0.0  # without a LiDAR nothing is known
    assert share(np.array([[*there, 0.3]])) > 0.0  # on it
    assert share(np.array([[*(0.5 * (there + MIDDLE)), 0.8]])) > 0.0  # before it, half as high as the cameras
    assert share(np.array([[*(0.5 * (there + MIDDLE)), 3.0]])) == 0.0  # above the line of sight
    assert share(none, near, np.array([[-50.0, 0.0, 850.0, 500.0]])) == 0.5  # a box in one of two pictures


def test_ticks_that_are_held_out_lie_between_the_others() -> None:
    schedule = Schedule("a", T0_NS + np.arange(40) * 10**8, {}, {}, {})
    assert set(ticks_of(schedule)) & set(ticks_of(schedule, held_out=True)) == set()
    short = Schedule("a", T0_NS + np.arange(3) * 10**8, {}, {}, {})
    assert ticks_of(short) == [0, 1, 2]
