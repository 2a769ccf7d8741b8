"""Poses of the ego: LiDAR odometry against exact motion, poses replaced and put back, and which poses are chosen."""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from localization_worlds import BEND, HOUSES, STANDING, STRAIGHT, TUNNEL, drive, relative_errors
from worlds import tiny_log

from log2sim import Config, reconstruct
from log2sim.datatypes import Log, Stream, Sweep
from log2sim.errors import ConfigError, LogError, MissingExtra, RecordError
from log2sim.geometry import PoseTrack, apply, inverse, rotation_from_rpy, transform, yaw_of
from log2sim.localization.choice import localize, localize_like
from log2sim.localization.odometry import Odometry, densest_lidar, move_points, run_odometry
from log2sim.localization.replaced import replace_poses
from log2sim.localization.verdict import fit_to_given, level_on_ground
from log2sim.perception.lidar.cloud import sweep_to_map

LIDAR, AUTO = ({"source": name} for name in ("lidar", "auto"))


@cache
def bend() -> tuple[Log, PoseTrack]:
    """20 m around a bend between houses, with exact poses."""
    return drive(HOUSES, BEND)


@cache
def along_bend() -> Odometry:
    return run_odometry(bend()[0], "top")


@cache
def tunnel() -> Log:
    return drive(TUNNEL, STRAIGHT, duration_s=1.5, sigma_m=0.3)[0]


def track_of(found: Odometry) -> PoseTrack:
    return PoseTrack(found.t_ns, found.odom_T_ego)


def without_poses(log: Log) -> Log:
    return replace(log, ego=None)


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


@pytest.mark.slow
def test_odometry_stays_within_centimeters_over_twenty_meters_around_a_bend() -> None:
    found = along_bend()
    off_m, off_rad = relative_errors(track_of(found), bend()[1])
    assert found.path_m == pytest.approx(19.2, abs=0.2)
    assert off_m.max() < 0.1
    assert off_m[-1] < 0.05
    assert off_rad.max() < np.deg2rad(0.6)
    assert not found.predicted.any()
    assert not found.degenerate.any()


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


def test_sweeps_in_the_map_give_the_odometry_of_those_of_the_sensor() -> None:
    found = run_odometry(in_map(bend()[0]), "top")
    assert np.abs(found.odom_T_ego - along_bend().odom_T_ego).max() < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("waypoints", "rate_hz", "duration_s"),
    [
        ([[0.0, 0.0, 8.0], [60.0, 0.0, 8.0]], 2.0, 5.0),
        (BEND, 20.0, 2.5),
        ([[0.0, 0.0, 30.0], [120.0, 0.0, 30.0]], 10.0, 2.5),
    ],
    ids=["2 Hz", "20 Hz", "30 m/s"],
)
def test_odometry_at_other_rates_and_speeds(waypoints: list[list[float]], rate_hz: float, duration_s: float) -> None:
    log, true = drive(HOUSES, waypoints, duration_s=duration_s, lidar={"rate_hz": rate_hz})
    assert relative_errors(track_of(run_odometry(log, "top")), true)[0].max() < 0.1


def test_a_standing_ego_stands() -> None:
    log, _ = drive(HOUSES, STANDING, duration_s=1.0, sigma_m=0.2)
    found = run_odometry(log, "top")
    assert np.linalg.norm(found.odom_T_ego[:, :3, 3], axis=1).max() < 0.02


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


def test_after_a_long_gap_a_new_path_begins_and_the_longest_is_kept() -> None:
    log, true = bend()

    def change(sweep: Sweep, i: int) -> Sweep:
        if 6 <= i < 17:
            raise RecordError("gone")
        return sweep

    found = run_odometry(with_sweeps(log, change), "top")
    assert found.t_ns[0] == log.streams["top"].t_ns[17]
    assert found.problems == {"unreadable or without a pose": 11, "of another part of the drive": 6}
    assert relative_errors(track_of(found), true)[0].max() < 0.1


def test_sweeps_of_nothing_are_an_error() -> None:
    empty = with_sweeps(bend()[0], lambda sweep, i: replace(sweep, xyz_m=sweep.xyz_m[:0], t_ns=sweep.t_ns[:0]))
    with pytest.raises(LogError, match="LiDAR odometry found no motion in the 25 sweeps of 'top'"):
        run_odometry(empty, "top")


def test_moved_points_are_those_of_their_own_transforms() -> None:
    rng = np.random.default_rng(0)
    track = other_track(bend()[1])
    t_ns = rng.integers(track.t_ns[10], track.t_ns[30], 400)
    xyz = rng.uniform(-50, 50, (400, 3))
    moved = move_points(xyz, t_ns, track.at)
    np.testing.assert_allclose(moved, apply(track.at(t_ns)[0], xyz), atol=1e-3)
    assert move_points(xyz, t_ns + 10**10, track.at) is None
    assert move_points(xyz[:0], t_ns[:0], track.at).shape == (0, 3)


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


def test_labels_without_a_pose_are_left_out_and_images_and_notes_stay() -> None:
    log = labeled()
    log = replace(log, labels=replace(log.labels, never_labeled=("bicycle",)))
    half = len(log.ego.t_ns) // 2
    short = PoseTrack(log.ego.t_ns[:half], log.ego.map_T_ego[:half], extrapolate_s=0.0)
    new = replace_poses(log, short)
    assert set(new.labels.t_ns.tolist()) == {t for t in log.labels.t_ns.tolist() if t <= short.t_ns[-1]}
    assert new.labels.never_labeled == log.labels.never_labeled
    assert new.notes == log.notes
    assert new.image_labels is log.image_labels
    assert new.streams["front"] is log.streams["front"]
    with pytest.raises(RecordError, match="no ego pose is known"):
        new.streams["top"].read(len(new.streams["top"].t_ns) - 1)


def test_a_turned_and_shifted_path_is_fitted_exactly() -> None:
    true = bend()[1]
    map_T_odom = transform(rotation_from_rpy(0.02, -0.03, 1.2), np.array([5.0, 300.0, -2.0]))
    np.testing.assert_allclose(
        fit_to_given(replace(true, map_T_ego=inverse(map_T_odom) @ true.map_T_ego), true), map_T_odom, atol=1e-9
    )
    assert fit_to_given(replace(true, t_ns=true.t_ns + 10**12), true) is None


@pytest.mark.parametrize(("roll_deg", "pitch_deg"), [(0.0, 0.0), (3.0, -2.0), (-5.0, 6.0)])
def test_a_tilted_vehicle_is_put_level_on_the_ground(roll_deg: float, pitch_deg: float) -> None:
    tilt = transform(rotation_from_rpy(np.deg2rad(roll_deg), np.deg2rad(pitch_deg), 0.0), np.array([0.0, 0.0, 0.1]))
    rng = np.random.default_rng(1)
    ground = np.column_stack([rng.uniform(-12, 12, (3000, 2)), np.zeros(3000)])
    wall = np.column_stack([np.full(300, 5.0), rng.uniform(-3, 3, 300), rng.uniform(0, 2, 300)])
    seen = apply(inverse(tilt), np.concatenate([ground, wall]))
    level = level_on_ground(seen, 0.0)
    np.testing.assert_allclose(level @ inverse(tilt) @ [0, 0, 1, 0], [0, 0, 1, 0], atol=2e-3)
    assert (level @ inverse(tilt))[2, 3] == pytest.approx(0.0, abs=5e-3)
    assert level_on_ground(wall, 0.0) is None


def test_the_densest_lidar_on_the_ego_is_taken() -> None:
    sparse = {"name": "side", "position_m": [0.0, 0.0, 1.0], "channels": 4, "range_m": 20.0}
    dense = {"name": "top", "position_m": [1.2, 0.0, 1.9], "channels": 24}
    fixed = {"name": "pole", "position_m": [9.0, 9.0, 5.0], "channels": 24, "mount": "map"}
    log, _ = drive(HOUSES, STRAIGHT, duration_s=0.3, lidars=[sparse, fixed, dense])
    assert densest_lidar(log) == "top"


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


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize(
    ("sigma_m", "angle_deg", "expected"),
    [(0.0, 0.0, "given"), (0.02, 0.05, "given"), (0.15, 0.1, "lidar"), (0.4, 0.1, "lidar"), (0.0, 1.0, "lidar")],
)
@pytest.mark.parametrize("waypoints", [BEND, STANDING], ids=["driving", "standing"])
def test_the_choice_follows_the_errors_of_the_poses(
    waypoints: list[list[float]], sigma_m: float, angle_deg: float, expected: str, seed: int
) -> None:
    log, _ = drive(HOUSES, waypoints, sigma_m=sigma_m, angle_deg=angle_deg, seed=seed)
    assert localize(log, Config.load(poses=AUTO))[1].source == expected


def test_a_tunnel_keeps_the_given_poses_and_says_why() -> None:
    log, choice = localize(tunnel(), Config.load(poses=AUTO))
    assert choice.source == "given"
    assert choice.reason.startswith("LiDAR odometry is not sure of")
    np.testing.assert_allclose(log.ego.map_T_ego, tunnel().ego.map_T_ego, atol=0.25)


def test_an_empty_plain_keeps_the_given_poses() -> None:
    log, _ = drive([], STRAIGHT, duration_s=1.0, sigma_m=0.3)
    choice = localize(log, Config.load(poses=AUTO))[1]
    assert choice.source == "given"
    with pytest.raises(LogError, match="cannot tell how the ego moves"):
        localize(without_poses(log), Config())


def test_odometry_that_is_asked_for_in_a_tunnel_says_that_it_is_doubtful() -> None:
    choice = localize(tunnel(), Config.load(poses=LIDAR))[1]
    assert choice.source == "lidar"
    assert "sweeps show too little that holds one direction of motion" in choice.notes[0]


def test_a_tunnel_without_poses_is_refused() -> None:
    with pytest.raises(LogError, match="no ego poses, and LiDAR odometry cannot tell how the ego moves"):
        localize(without_poses(tunnel()), Config())


@pytest.mark.slow
def test_a_log_without_poses_becomes_a_scenario_in_the_frame_of_the_first_sweep() -> None:
    log, _ = drive(HOUSES, BEND, observe=True)
    given = reconstruct(log, Config.load(detect={"name": "lidar:labels"}, poses=LIDAR)).scenario
    alone = reconstruct(without_poses(log), Config.load(detect={"name": "lidar:vehicle"}))
    assert alone.report["poses"]["source"] == "lidar"
    assert alone.report["poses"]["reason"] == "the log has no poses"
    assert alone.scenario.provenance["poses"] == {"source": "lidar"}
    ego = alone.scenario.ego
    assert ego.quality["source"] == given.ego.quality["source"] == "LiDAR odometry"
    start = np.array([ego.waypoints.x_m[0] - 1.4, ego.waypoints.y_m[0]])
    assert np.hypot(*start) < 0.5  # the first tick is the middle of the first sweep, half a turn before its stamp
    path_m = np.hypot(np.diff(ego.waypoints.x_m), np.diff(ego.waypoints.y_m)).sum()
    assert path_m == pytest.approx(19.0, abs=0.5)


@pytest.mark.slow
def test_truth_of_labels_moves_with_the_poses_of_the_scenario() -> None:
    log, _ = drive(HOUSES, BEND, duration_s=1.5, sigma_m=0.3, observe=True)
    new, choice = localize(log, Config.load(poses=LIDAR, start_s=0.2, stop_s=0.9))
    again = localize_like(log, {"poses": choice.to_provenance()})
    assert choice.to_provenance()["during_ns"]
    np.testing.assert_array_equal(again.ego.map_T_ego, new.ego.map_T_ego)
    np.testing.assert_array_equal(again.labels.center_m, new.labels.center_m)
    assert localize_like(log, {}) is log
    given, _ = localize(log, Config())
    np.testing.assert_array_equal(localize_like(log, {"poses": {"source": "given"}}).ego.map_T_ego, given.ego.map_T_ego)
    for spoiled in ({"source": ["lidar"]}, {"source": "gps"}, ["lidar"], "lidar", None, {}):
        assert localize_like(log, {"poses": spoiled}) is log


def test_given_poses_are_not_touched() -> None:
    log = bend()[0]
    new, choice = localize(log, Config())
    assert new is log
    assert choice.to_provenance() == {"source": "given"}


def test_roadside_logs_need_no_poses() -> None:
    fixed = [{"name": "pole", "position_m": [9.0, 9.0, 5.0], "channels": 8, "mount": "map"}]
    log, _ = drive(HOUSES, STRAIGHT, duration_s=0.3, lidars=fixed)
    new, choice = localize(without_poses(log), Config.load(poses=AUTO))
    assert (choice.source, new.ego) == ("none", None)


def test_a_log_without_lidar_has_no_lidar_odometry() -> None:
    log = replace(bend()[0], lidars={})
    with pytest.raises(ConfigError, match="--poses lidar: drive has no LiDAR on the ego"):
        localize(log, Config.load(poses=LIDAR))
    assert localize(log, Config.load(poses=AUTO))[1].source == "given"


def test_without_the_library_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "small_gicp", None)
    with pytest.raises(MissingExtra, match="LiDAR odometry needs the extra 'odometry'"):
        localize(bend()[0], Config.load(poses=LIDAR))
    choice = localize(bend()[0], Config.load(poses=AUTO))[1]
    assert choice.source == "given"
    assert "extra 'odometry' is not installed" in choice.reason
