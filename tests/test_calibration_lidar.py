"""Time offsets and rotations of LiDARs, put into worlds with exact truth, are found, told and corrected; nothing else is."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from localization_worlds import HOUSES, drive

from log2sim.config import Config
from log2sim.datatypes import Finding, Log, Stream
from log2sim.geometry import NS_PER_S, PoseTrack, inverse, rotation_from_rpy
from log2sim.localization.clocks import OFFSET, PITCH, YAW, check_lidars, fit_clock_and_mount, turn_mount
from log2sim.localization.replaced import shift_stream
from log2sim.localization.surfaces import MAX_SWEEPS, SweepPairs, choose_sweeps, exp_of, log_of, pair_sweeps
from log2sim.plan import Sensors

TOP = "top"
LIDAR = {"channels": 20, "azimuth_step_deg": 1.5}
# Speeds up, turns left, and goes on straight.
LIVELY = [[-30.0, 0.0, 1.5], [-16.0, 0.0, 6.0], [-4.0, 3.0, 7.0], [10.0, 10.0, 4.0], [22.0, 12.0, 3.0]]
PLAIN = Config()


@pytest.fixture(scope="module")
def lively() -> Log:
    """A log with exact poses."""
    return drive(HOUSES, LIVELY, duration_s=5.5, lidar=LIDAR)[0]


@pytest.fixture(scope="module")
def seen_lively(lively: Log) -> SweepPairs:
    return seen_in(lively)


def turned(log: Log, *, yaw_deg: float = 0.0, pitch_deg: float = 0.0) -> Log:
    lidar, turn = log.lidars[TOP], np.radians([0.0, pitch_deg, yaw_deg])
    return log.changed(lidars={TOP: replace(lidar, mount_T_lidar=turn_mount(lidar.mount_T_lidar, turn))})


def check(log: Log, **asked: bool) -> tuple[Log, tuple[Finding, ...]]:
    config = PLAIN.changed(calibration=asked) if asked else PLAIN
    return check_lidars(log, config, Sensors((), tuple(log.lidars)), progress=lambda *_: None)


def seen_in(log: Log) -> SweepPairs:
    seen = pair_sweeps(log, TOP, None, lambda *_: None)
    assert seen is not None
    return seen


def noisy(track: PoseTrack, seed: int, sigma_m: float = 0.03, sigma_deg: float = 0.1, tau_s: float = 2.0) -> PoseTrack:
    """Poses with first-order Gauss-Markov errors of each coordinate."""
    track = replace(track, t_ns=track.t_ns[::5], map_T_ego=track.map_T_ego[::5])
    rng, sigma = np.random.default_rng(seed), np.array([sigma_m] * 3 + [np.radians(sigma_deg)] * 3)
    step_s = float(np.median(np.diff(track.t_ns))) / NS_PER_S
    keep, error = np.exp(-step_s / tau_s), rng.normal(0, sigma)
    poses = []
    for pose in track.map_T_ego:
        poses.append(pose @ exp_of(error))
        error = keep * error + np.sqrt(1 - keep**2) * rng.normal(0, sigma)
    return replace(track, map_T_ego=np.array(poses))


# --- what is estimated


def wrong(seen: SweepPairs, *, offset_s: float = 0.0, yaw_deg: float = 0.0, pitch_deg: float = 0.0) -> SweepPairs:
    """What would be seen with late stamps and a mount turned about the sensor."""
    turn = exp_of(np.array([0.0, 0.0, 0.0, 0.0, *np.radians([pitch_deg, yaw_deg])]))
    turn[:3, 3] = seen.sensor_m - turn[:3, :3] @ seen.sensor_m
    moved = [replace(p.found, first_T_second=turn @ p.found.first_T_second @ inverse(turn)) for p in seen.pairs]
    pairs = tuple(replace(pair, found=found) for pair, found in zip(seen.pairs, moved))
    return replace(seen, pairs=pairs, t_ns=seen.t_ns + round(offset_s * NS_PER_S))


@pytest.mark.parametrize("offset_s", [0.02, -0.05, 0.1])
def test_an_offset_of_the_stamps_is_found_while_the_ego_speeds_up_and_turns(
    seen_lively: SweepPairs, offset_s: float
) -> None:
    found = fit_clock_and_mount(wrong(seen_lively, offset_s=offset_s))
    assert found.shows_offset
    assert found.values[OFFSET] == pytest.approx(-offset_s, abs=0.004)
    assert np.abs(np.degrees(found.values[[PITCH, YAW]])).max() < 0.1


@pytest.mark.parametrize(("yaw_deg", "pitch_deg"), [(0.2, 0.0), (3.0, 0.0), (1.0, -0.7)])
def test_a_turned_mount_is_found(seen_lively: SweepPairs, yaw_deg: float, pitch_deg: float) -> None:
    found = fit_clock_and_mount(wrong(seen_lively, yaw_deg=yaw_deg, pitch_deg=pitch_deg))
    assert np.degrees(found.values[[PITCH, YAW]]) == pytest.approx([-pitch_deg, -yaw_deg], abs=0.1)
    assert abs(found.values[OFFSET]) < 0.004


def test_standard_deviations_tell_how_wrong_estimates_are(seen_lively: SweepPairs) -> None:
    exact = seen_lively.track
    found = [fit_clock_and_mount(replace(seen_lively, track=noisy(exact, seed))) for seed in range(12)]
    values, sigma = np.array([f.values for f in found]), np.array([f.sigma for f in found])
    nees = np.mean((values / sigma) ** 2, axis=0)[[OFFSET, PITCH, YAW]]
    assert nees.min() > 0.1
    assert nees.max() < 2.0
    # The sigma is that of the poses' errors, not a bound that holds for all: half a degree would be told.
    assert np.degrees(np.median(sigma[:, YAW])) < 0.2
    assert np.median(sigma[:, OFFSET]) < 0.01


# --- what is told and corrected


def test_a_sound_log_tells_nothing_even_if_corrections_are_asked_for(lively: Log) -> None:
    log, faults = check(lively, fix_time=True, fix_mounts=True)
    assert faults == ()
    assert log is lively


def test_late_stamps_are_corrected_with_those_of_the_points(lively: Log) -> None:
    late = lively.changed(streams={TOP: shift_stream(lively.streams[TOP], NS_PER_S // 10)})
    log, (fault,) = check(late, fix_time=True)
    assert fault.treatment == "corrected"
    shift_ns = log.streams[TOP].t_ns - lively.streams[TOP].t_ns
    assert np.abs(shift_ns).max() < 0.004 * NS_PER_S
    sweep, before = log.streams[TOP].read(3), lively.streams[TOP].read(3)
    assert sweep.stamp_ns - before.stamp_ns == shift_ns[3]
    assert (sweep.t_ns - before.t_ns == shift_ns[3]).all()
    way = np.linalg.norm(np.diff(lively.ego.map_T_ego[:, :3, 3], axis=0), axis=1)
    fastest = (way / np.diff(lively.ego.t_ns) * NS_PER_S).max()
    assert fault.values["moved_m"] == pytest.approx(0.1 * fastest, rel=0.15)


def test_stamps_at_the_end_of_sweeps_whose_points_have_no_times_are_half_a_turn_late(lively: Log) -> None:
    old = lively.streams[TOP]
    untimed = Stream(TOP, old.t_ns, lambda i: replace(old.read(i), t_ns=None))
    _, (fault,) = check(lively.changed(streams={TOP: untimed}))
    assert fault.values["offset_s"] == pytest.approx(0.05, abs=0.01)


def test_a_turned_mount_is_corrected_about_the_axes_that_are_certain(lively: Log) -> None:
    log, (fault,) = check(turned(lively, yaw_deg=1.0), fix_mounts=True)
    assert (fault.kind, fault.treatment) == ("lidar_rotation", "corrected")
    assert fault.case == "mount"
    assert fault.values["yaw_deg"] == pytest.approx(1.0, abs=0.1)
    true, mount = lively.lidars[TOP].mount_T_lidar, log.lidars[TOP].mount_T_lidar
    assert np.abs(np.degrees(log_of(inverse(true) @ mount)[3:])).max() < 0.1
    assert (mount[:3, 3] == true[:3, 3]).all()


def test_a_heading_by_which_the_ego_drives_askew_is_named(lively: Log) -> None:
    assert lively.ego is not None
    askew = exp_of(np.array([0.0, 0.0, 0.0, 0.0, 0.0, np.radians(2.0)]))
    _, (fault,) = check(lively.changed(ego=replace(lively.ego, map_T_ego=lively.ego.map_T_ego @ askew)))
    assert fault.values["yaw_deg"] == pytest.approx(2.0, abs=0.1)
    assert fault.values["course_deg"] == pytest.approx(-2.0, abs=0.3)
    assert fault.case == "heading"


def test_a_mount_at_another_place_is_found_where_the_ego_turns(lively: Log) -> None:
    true = lively.lidars[TOP]
    moved = true.mount_T_lidar.copy()
    moved[:2, 3] += [0.8, -1.0]
    log, (fault,) = check(lively.changed(lidars={TOP: replace(true, mount_T_lidar=moved)}), fix_mounts=True)
    assert (fault.kind, fault.treatment) == ("lidar_translation", "corrected")
    assert [fault.values[n] for n in ("x_m", "y_m")] == pytest.approx([0.8, -1.0], abs=0.15)
    assert log.lidars[TOP].mount_T_lidar == pytest.approx(true.mount_T_lidar, abs=0.15)


# --- where there is nothing to see


def unread(log: Log, **changes: Any) -> Log:
    def read(i: int) -> Any:
        raise AssertionError("read")

    streams = {TOP: Stream(TOP, log.streams[TOP].t_ns, read)}
    return log.changed(streams=streams, **changes)


def test_a_standing_ego_costs_no_sweep(lively: Log) -> None:
    assert lively.ego is not None
    still = np.repeat(lively.ego.map_T_ego[:1], len(lively.ego.t_ns), axis=0)
    log = unread(lively, ego=replace(lively.ego, map_T_ego=still))
    assert check(log)[1] == ()
    assert [f.kind for f in check(log, fix_time=True, fix_mounts=True)[1]] == ["unknown_offset", "unknown_rotation"]


def test_sweeps_that_do_not_belong_to_the_poses_are_blamed_for_nothing(lively: Log) -> None:
    assert lively.ego is not None
    other = replace(lively.ego, map_T_ego=lively.ego.map_T_ego[::-1])
    assert check(lively.changed(ego=other))[1] == ()


def test_of_a_long_log_a_few_sweeps_are_looked_at_where_the_ego_turns() -> None:
    t_s = np.arange(0.0, 600.0, 0.1)
    yaw = np.clip(t_s - 400.0, 0.0, 3.0) * 0.5
    xy = np.cumsum(np.stack([np.cos(yaw), np.sin(yaw)], axis=1), axis=0)
    poses = np.tile(np.eye(4), (len(t_s), 1, 1))
    poses[:, :3, :3], poses[:, :2, 3] = rotation_from_rpy(0.0, 0.0, yaw), xy
    t_ns = np.rint(t_s * NS_PER_S).astype(np.int64)
    rows = choose_sweeps(PoseTrack(t_ns, poses), t_ns)
    assert len(rows) <= MAX_SWEEPS
    assert np.sum((t_s[rows] > 399) & (t_s[rows] < 404)) >= 5
    assert len(choose_sweeps(PoseTrack(t_ns, poses), t_ns, (0, 5 * NS_PER_S))) == MAX_SWEEPS
