"""Poses of the ego: LiDAR odometry against exact motion, poses replaced and put back, and which poses are chosen."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from localization_worlds import BEND, HOUSES, STANDING, STRAIGHT, TUNNEL, drive, relative_errors
from worlds import tiny_log

from log2sim import Config, reconstruct
from log2sim.datatypes import ImageLabels, Log, MapFrame, Stream, Sweep
from log2sim.errors import LogError, RecordError
from log2sim.geometry import PoseTrack, apply, inverse, rotation_from_rpy, transform, yaw_of
from log2sim.localization.camera_motion import follow_camera
from log2sim.localization.choice import localize, localize_like
from log2sim.localization.given_poses import check_poses, list_faults
from log2sim.localization.odometry import Odometry, densest_lidar, run_odometry
from log2sim.localization.replaced import replace_poses
from log2sim.localization.verdict import bridge_by_lidar, fit_to_given
from log2sim.perception.lidar.cloud import sweep_to_map

AUTO = {"source": "auto"}


@cache
def bend() -> tuple[Log, PoseTrack]:
    """20 m around a bend between houses, with exact poses."""
    return drive(HOUSES, BEND)


@cache
def tunnel() -> Log:
    return drive(TUNNEL, STRAIGHT, duration_s=1.5, sigma_m=0.3)[0]


def track_of(found: Odometry) -> PoseTrack:
    return PoseTrack(found.t_ns, found.odom_T_ego)


def with_sweeps(log: Log, change) -> Log:
    """The log with each sweep of "top" changed by a function of the sweep and its index."""
    stream = log.streams["top"]
    changed = Stream("top", stream.t_ns, lambda i: change(stream.read(i), i))
    return replace(log, streams={**log.streams, "top": changed})


def in_map(log: Log) -> Log:
    """The log with sweeps in the map, compensated by its poses."""

    def change(sweep: Sweep, i: int) -> Sweep:
        mapped = sweep_to_map(log, "top", sweep, compensate=True)
        assert mapped is not None
        return replace(sweep, xyz_m=mapped[0], frame="map")

    return with_sweeps(log, change)


def other_track(track: PoseTrack) -> PoseTrack:
    """Poses that drift away from a track, turned and tilted against it."""
    s = (track.t_ns - track.t_ns[0]) * 1e-9
    turn = rotation_from_rpy(0.01 * np.sin(s), 0.02 * s, 0.5 + 0.05 * s)
    drift = np.stack([100 + 0.3 * s, -40 + 0.1 * s**2, 0.05 * s], axis=1)
    return replace(track, map_T_ego=transform(turn, drift) @ track.map_T_ego)


def test_odometry_does_not_compensate_what_the_log_has_compensated() -> None:
    log, true = bend()

    def change(sweep: Sweep, i: int) -> Sweep:
        """Points in the sensor's frame at its stamp, still with their times."""
        mapped = sweep_to_map(log, "top", sweep, compensate=True)
        assert mapped is not None
        at_stamp = inverse(log.map_T_sensor("top", sweep.stamp_ns)[0][0])
        return replace(sweep, xyz_m=apply(at_stamp, mapped[0]), compensated_ns=sweep.stamp_ns)

    found = run_odometry(with_sweeps(log, change), "top")
    assert relative_errors(track_of(found), true)[0].max() < 0.1


def test_a_standing_ego_stands() -> None:
    log, _ = drive(HOUSES, STANDING, duration_s=1.0, sigma_m=0.2)
    found = run_odometry(log, "top")
    assert np.linalg.norm(found.odom_T_ego[:, :3, 3], axis=1).max() < 0.02


@cache
def labeled() -> Log:
    log = tiny_log()[0]
    return in_map(log)


def test_replacing_poses_and_putting_them_back_changes_nothing() -> None:
    log = labeled()
    back = replace_poses(replace_poses(log, other_track(log.ego)), log.ego)
    np.testing.assert_allclose(back.labels.center_m, log.labels.center_m, atol=1e-9)
    np.testing.assert_allclose(back.labels.yaw_rad, log.labels.yaw_rad, atol=1e-3)  # of a tilted box only yaw is kept
    for i in (0, 5):
        np.testing.assert_allclose(
            back.streams["top"].read(i).xyz_m, log.streams["top"].read(i).xyz_m, atol=1e-6, rtol=0
        )


def test_everything_keeps_its_place_in_the_frame_of_the_ego() -> None:
    log = labeled()
    new = replace_poses(log, other_track(log.ego))
    for old_xyz, new_xyz, t_ns in [
        (log.labels.center_m, new.labels.center_m, log.labels.t_ns),
        *[(log.streams["top"].read(3).xyz_m, new.streams["top"].read(3).xyz_m, log.streams["top"].read(3).t_ns)],
    ]:
        before = apply(inverse(log.ego.at(t_ns)[0]), old_xyz)
        np.testing.assert_allclose(apply(inverse(new.ego.at(t_ns)[0]), new_xyz), before, atol=1e-3)
    assert np.abs(new.labels.center_m - log.labels.center_m).max() > 50
    turned = yaw_of(new.ego.at(log.labels.t_ns)[0]) - yaw_of(log.ego.at(log.labels.t_ns)[0])
    np.testing.assert_allclose(new.labels.yaw_rad - log.labels.yaw_rad, turned, atol=2e-3)


def test_a_turned_and_shifted_path_is_fitted_exactly() -> None:
    true = bend()[1]
    map_T_odom = transform(rotation_from_rpy(0.02, -0.03, 1.2), np.array([5.0, 300.0, -2.0]))
    np.testing.assert_allclose(
        fit_to_given(replace(true, map_T_ego=inverse(map_T_odom) @ true.map_T_ego), true), map_T_odom, atol=1e-9
    )
    assert fit_to_given(replace(true, t_ns=true.t_ns + 10**12), true) is None


def test_good_poses_are_kept_and_bad_ones_are_replaced() -> None:
    choices = {}
    for sigma_m in (0.0, 0.3):
        log, _ = drive(HOUSES, BEND, duration_s=1.2, sigma_m=sigma_m, angle_deg=sigma_m / 3)
        new, choices[sigma_m] = localize(log, Config.load(poses=AUTO))
        assert (new is log) == (sigma_m == 0.0)
    assert choices[0.0].source == "given"
    assert choices[0.3].source == "lidar"
    assert choices[0.3].excess_m["apart"] > 0.05 > choices[0.0].excess_m["apart"]
    assert choices[0.3].to_dict()["estimate"]["poses"] == 12


def test_a_tunnel_keeps_the_given_poses_and_says_why() -> None:
    log, choice = localize(tunnel(), Config.load(poses=AUTO))
    assert choice.source == "given"
    assert choice.reason.startswith("LiDAR odometry is not sure of")
    np.testing.assert_allclose(log.ego.map_T_ego, tunnel().ego.map_T_ego, atol=0.25)


CAMERA = {"name": "front", "position_m": [1.7, 0.0, 1.5], "size_px": [640, 400], "pitch_deg": -6.0}
TURN = [[0.0, 0.0, 5.0], [8.0, 0.0, 5.0], [20.0, 6.0, 5.0]]


@cache
def street(nod_deg: float = 0.0) -> Log:
    """Eight meters along a street and around a bend, without LiDAR; the camera looks up by an angle more than its mount says."""
    ego = {"waypoints": TURN, "poses": "poses", "rounding_m": 10.0}
    buildings = [{**house, "center": [house["center"][0] + 5, house["center"][1]]} for house in HOUSES]
    log, _ = tiny_log(
        [],
        duration_s=1.6,
        ego=ego,
        camera=[{**CAMERA, "pitch_deg": CAMERA["pitch_deg"] + nod_deg}],
        lidar=[],
        building=buildings,
        observe=False,
    )
    return log


@cache
def frames() -> list[np.ndarray]:
    return [street().streams["front"].read(i) for i in range(len(street().streams["front"].t_ns))]


def filmed(change=lambda image, i: image) -> Log:
    """The street without poses, its images changed by a function of the image and its index."""
    stream = street().streams["front"]
    changed = Stream("front", stream.t_ns, lambda i: change(frames()[i], i))
    return replace(street(), ego=None, streams={"front": changed})


@pytest.mark.slow
def test_the_path_of_the_camera_is_that_of_the_ego_within_some_percent() -> None:
    found = follow_camera(filmed(), "front")
    true, _ = street().ego.at(found.t_ns)
    true = inverse(true[0]) @ true
    path_m = np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=1).sum()
    off_m = np.linalg.norm(found.start_T_ego[:, :2, 3] - true[:, :2, 3], axis=1)
    assert path_m > 6
    assert off_m.max() < 0.05 * path_m
    turned = inverse(true[-1]) @ found.start_T_ego[-1]
    assert abs(np.arctan2(turned[1, 0], turned[0, 0])) < np.deg2rad(2.0)
    assert not found.predicted.any()


def test_images_that_do_not_change_show_an_ego_that_stands() -> None:
    found = follow_camera(filmed(lambda image, i: frames()[0]), "front")
    np.testing.assert_array_equal(found.start_T_ego, np.tile(np.eye(4), (len(found.t_ns), 1, 1)))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda image, i: image // 64, "images are too dark"),
        (lambda image, i: np.full_like(image, 128), "show too little of the road"),
    ],
    ids=["dark", "blank"],
)
def test_images_that_show_nothing_are_refused_in_one_line(change, words: str) -> None:
    with pytest.raises(LogError, match=words) as caught:
        localize(filmed(change), Config())
    assert "\n" not in str(caught.value)


def test_a_camera_of_unknown_height_has_no_scale() -> None:
    log = filmed()
    flat = replace(log.cameras["front"], mount_T_cam=np.eye(4))
    with pytest.raises(LogError, match=r"camera 'front' is mounted 0.00 m above the ground"):
        localize(replace(log, cameras={"front": flat}), Config())


@pytest.mark.slow
def test_a_scenario_of_a_camera_alone_holds_the_ego() -> None:
    nothing = ImageLabels(np.zeros(0, dtype=np.int64), np.zeros((0, 4)), np.zeros(0, dtype="<U16"))
    log = replace(filmed(), image_labels={"front": nothing})
    result = reconstruct(log, Config.load(detect={"name": "labels"}))
    assert result.scenario.ego.quality["source"] == "camera motion"
    assert result.scenario.provenance["poses"] == {"source": "camera"}
    assert isinstance(result.log.ego, PoseTrack)


def without_poses(log: Log) -> Log:
    return replace(log, ego=None)


def test_a_map_that_begins_at_the_ego_has_no_place_on_earth() -> None:
    """Of a log without poses; one that has them keeps its place, whichever poses are used."""
    log = replace(bend()[0], map=MapFrame(48.0, 9.0, 400.0, "+proj=tmerc +lat_0=48 +lon_0=9"))
    found, choice = localize(without_poses(log), Config())
    assert found.map == MapFrame()
    assert "not where the log places it" in choice.reason
    assert localize(log, Config.load(poses={"source": "lidar"}))[0].map == log.map


def test_unreadable_sweeps_are_counted_and_bridged() -> None:
    log, true = bend()

    def change(sweep: Sweep, i: int) -> Sweep:
        if 8 <= i < 11:
            raise RecordError("gone")
        return sweep if i != 15 else replace(sweep, xyz_m=sweep.xyz_m[:10], t_ns=sweep.t_ns[:10])

    found = run_odometry(with_sweeps(log, change), "top")
    assert found.problems == {"unreadable or without a pose": 3, "too few points": 1}
    assert len(found.t_ns) == found.sweeps - 3
    assert found.predicted.sum() == 1
    assert relative_errors(track_of(found), true)[0][~found.predicted].max() < 0.1


def test_the_densest_lidar_on_the_ego_is_taken() -> None:
    sparse = {"name": "side", "position_m": [0.0, 0.0, 1.0], "channels": 4, "range_m": 20.0}
    dense = {"name": "top", "position_m": [1.2, 0.0, 1.9], "channels": 24}
    fixed = {"name": "pole", "position_m": [9.0, 9.0, 5.0], "channels": 24, "mount": "map"}
    log, _ = drive(HOUSES, STRAIGHT, duration_s=0.3, lidars=[sparse, fixed, dense])
    assert densest_lidar(log) == "top"


def test_an_empty_plain_keeps_the_given_poses() -> None:
    log, _ = drive([], STRAIGHT, duration_s=1.0, sigma_m=0.3)
    choice = localize(log, Config.load(poses=AUTO))[1]
    assert choice.source == "given"
    with pytest.raises(LogError, match="cannot tell how the ego moves"):
        localize(without_poses(log), Config())


def frozen_log(buildings: list[dict[str, object]], waypoints: list[list[float]]) -> tuple[Log, PoseTrack]:
    """Poses that stay from 2.4 s to the end at 4 s, and the true ones."""
    log, true = drive(buildings, waypoints, duration_s=4.0)
    poses = true.map_T_ego.copy()
    from_row = int(np.searchsorted(true.t_ns, true.t_ns[0] + 2_400_000_000))
    poses[from_row:] = poses[from_row]
    return log.changed(ego=replace(true, map_T_ego=poses)), true


def silent(done: int, total: int) -> None:
    assert 0 < done <= total


@pytest.mark.slow
def test_odometry_goes_on_where_the_motion_before_does_not_tell_the_pose() -> None:
    pytest.importorskip("small_gicp")
    log, true = frozen_log(HOUSES, BEND)
    assert log.ego is not None
    checked = check_poses(log.ego)
    found = bridge_by_lidar(log, checked, silent)
    asked = true.t_ns[true.t_ns <= log.streams["top"].t_ns[-1]]
    assert not checked.track.at(asked)[1].all()
    poses, known = found.track.at(asked)
    assert known.all()
    off = np.linalg.norm(poses[:, :2, 3] - true.at(asked)[0][:, :2, 3], axis=1)
    assert off.max() < 0.25
    (fault,) = list_faults(log, found.stretches, int(true.t_ns[0]), int(true.t_ns[-1]))
    assert fault.treatment == "corrected"
    assert fault.other == "LiDAR odometry"
    again = localize_like(log, {"poses": {"source": "given"}})
    assert again.ego is not None
    np.testing.assert_array_equal(again.ego.map_T_ego, found.track.map_T_ego)
