"""Given poses that jump, freeze or are sparse: found, repaired to known errors, and nothing found in healthy ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from log2sim.agents.candidate import Timeline
from log2sim.agents.estimate import ego_agent, with_pose_errors
from log2sim.datatypes import FAULT_KINDS, Agent, Log, Stream, Waypoints
from log2sim.geometry import Array, PoseTrack, rotation_from_rpy, transform, wrap_angle, yaw_of
from log2sim.localization.choice import localize_like
from log2sim.localization.given_poses import MAX_SIGMA_M, CheckedPoses, check_poses, list_faults
from log2sim.localization.path import POSITION_PRIOR, YAW_PRIOR, fit_path, noise_of

NS = 1_000_000_000


def drive(
    seconds: float,
    hz: float,
    *,
    speed: float = 10.0,
    brake: float = 0.0,
    turn: float = 0.0,
    sigma: float = 0.0,
    seed: int = 0,
) -> PoseTrack:
    """Poses of a car that brakes to a stop, m/s2, and turns by a swinging yaw rate, rad/s, with white noise of position."""
    fine = np.arange(0.0, seconds + 1e-9, 1e-3)
    v = np.maximum(speed - brake * np.maximum(fine - 1.0, 0.0), 0.0)
    yaw = np.cumsum(turn * np.sin(0.8 * fine) * (v > 0)) * 1e-3
    x, y = np.cumsum(v * np.cos(yaw)) * 1e-3, np.cumsum(v * np.sin(yaw)) * 1e-3
    t = np.arange(0.0, seconds + 1e-9, 1 / hz)
    columns = [np.interp(t, fine, c) for c in (x, y, yaw)]
    noise = np.random.default_rng(seed).normal(0, 1, (len(t), 4)) * [sigma, sigma, sigma, sigma / 20]
    rotation = rotation_from_rpy(np.zeros(len(t)), np.zeros(len(t)), columns[2] + noise[:, 3])
    poses = transform(rotation, np.stack([columns[0], columns[1], 0 * t], axis=1) + noise[:, :3])
    return PoseTrack(np.rint(t * NS).astype(np.int64), poses)


def times(track: PoseTrack) -> Array:
    return np.asarray((track.t_ns - track.t_ns[0]) / NS)


def jumping(
    track: PoseTrack, start_s: float, stop_s: float, shift_m: tuple[float, float, float], turn: float = 0.0
) -> PoseTrack:
    poses, k = track.map_T_ego.copy(), (times(track) >= start_s) & (times(track) < stop_s)
    poses[k, :3, 3] += shift_m
    poses[k, :3, :3] = rotation_from_rpy(0.0, 0.0, turn) @ poses[k, :3, :3]
    return replace(track, map_T_ego=poses)


def frozen(track: PoseTrack, start_s: float, stop_s: float) -> PoseTrack:
    poses, k = track.map_T_ego.copy(), np.flatnonzero((times(track) >= start_s) & (times(track) < stop_s))
    poses[k] = poses[k[0]]
    return replace(track, map_T_ego=poses)


def thinned(track: PoseTrack, step: int) -> PoseTrack:
    return replace(track, t_ns=track.t_ns[::step], map_T_ego=track.map_T_ego[::step])


def errors(found: CheckedPoses, true: PoseTrack) -> tuple[float, float, Array]:
    """Largest errors in m and rad where poses are known, and where they are."""
    poses, known = found.track.at(true.t_ns)
    off = np.linalg.norm(poses[:, :3, 3] - true.map_T_ego[:, :3, 3], axis=1)
    turned = np.abs(wrap_angle(yaw_of(poses) - yaw_of(true.map_T_ego)))
    return float(off[known].max()), float(turned[known].max()), known


def kinds(found: CheckedPoses) -> list[str]:
    return [s.kind for s in found.stretches if s.kind != "gap"]


def log_of(track: PoseTrack, records_hz: float = 10.0) -> Log:
    t_ns = np.arange(track.t_ns[0], track.t_ns[-1] + 1, round(NS / records_hz), dtype=np.int64)
    return Log("drive", "test", {}, {}, {"front": Stream("front", t_ns, lambda i: None)}, ego=track)


# --- healthy poses stay as they are

HEALTHY = {
    "fast": drive(6, 50, speed=30.0, sigma=0.01),
    "10 Hz on a motorway": drive(6, 10, speed=30.0, sigma=0.02),
    "hard stop": drive(6, 50, speed=14.0, brake=9.5),
    "hard stop at 10 Hz": drive(6, 10, speed=14.0, brake=9.5),
    "turns": drive(10, 20, turn=0.7, sigma=0.01),
    "1000 Hz": drive(3, 1000, sigma=0.01),
    "standing": drive(5, 50, speed=0.0),
    "standing with noise": drive(5, 50, speed=0.0, sigma=0.02),
    "waiting, then driving": replace(drive(6, 50), map_T_ego=drive(6, 50, brake=5.0).map_T_ego[::-1].copy()),
    "two poses": drive(0.2, 10),
    "one pose": drive(0.0, 10),
    "5 Hz": drive(10, 5, turn=0.4),
}


@pytest.mark.parametrize("name", HEALTHY)
def test_healthy_poses_are_not_touched(name: str) -> None:
    track = HEALTHY[name]
    found = check_poses(track)
    assert not found.stretches
    assert found.track is track


@pytest.mark.parametrize("hz", [10, 50, 400])
@pytest.mark.parametrize("sigma", [0.1, 0.5])
def test_noisy_poses_are_smoothed_and_tell_how_good_they_are(sigma: float, hz: int) -> None:
    true, noisy = drive(10, hz, turn=0.2), drive(10, hz, turn=0.2, sigma=sigma)
    found = check_poses(noisy)
    assert not found.stretches
    inner = (times(true) > 0.5) & (times(true) < 9.5)
    before, after = (t.map_T_ego[inner, :2, 3] - true.map_T_ego[inner, :2, 3] for t in (noisy, found.track))
    assert np.std(after) < 0.65 * np.std(before)
    assert found.track.sigma_m is not None
    assert 0.2 < np.std(after) / np.median(found.track.sigma_m) < 1.6


def test_errors_that_last_are_not_smoothed() -> None:
    true, rng = drive(20, 50), np.random.default_rng(0)
    poses, keep = true.map_T_ego.copy(), np.exp(-0.02 / 2.0)
    error = rng.normal(0, 0.3, 3)
    for pose in poses:
        error = keep * error + np.sqrt(1 - keep**2) * rng.normal(0, 0.3, 3)
        pose[:3, 3] += error
    track = replace(true, map_T_ego=poses)
    assert check_poses(track).track is track


def test_stamps_that_are_off_are_not_taken_for_noise() -> None:
    true = drive(10, 10, speed=20.0)
    poses = true.map_T_ego.copy()
    poses[:, 0, 3] += np.random.default_rng(0).normal(0, 0.1, len(poses))
    found = check_poses(replace(true, map_T_ego=poses))
    assert found.track.map_T_ego is poses


def test_rounded_poses_are_healthy() -> None:
    track = drive(10, 50, speed=1.0, turn=0.3)
    rounded = track.map_T_ego.copy()
    rounded[:, :3, 3] = rounded[:, :3, 3].round(1)
    assert not check_poses(replace(track, map_T_ego=rounded)).stretches


def test_poses_of_2_hz_tell_nothing_and_are_not_moved() -> None:
    track = drive(10, 2, turn=0.3)
    found = check_poses(track)
    assert not list_faults(log_of(track), found.stretches, None)
    np.testing.assert_array_equal(found.track.at(track.t_ns)[0], track.at(track.t_ns)[0])


@settings(max_examples=40, deadline=None)
@given(
    st.floats(0, 35), st.floats(0, 9.5), st.floats(-0.6, 0.6), st.sampled_from([5, 10, 20, 50, 100]), st.floats(0, 0.3),
    st.integers(0, 10**6),
)  # fmt: skip
def test_no_drive_that_a_car_can_do_gives_a_fault(
    speed: float, brake: float, turn: float, hz: int, sigma: float, seed: int
) -> None:
    # Across, tires hold 10 m/s2.
    turn = float(np.clip(turn, -10 / max(speed, 1.0), 10 / max(speed, 1.0)))
    found = check_poses(drive(6, hz, speed=speed, brake=brake, turn=turn, sigma=sigma, seed=seed))
    assert not found.stretches


# --- faults are found and repaired


@pytest.mark.parametrize(
    ("start_s", "stop_s"), [(2.0, 3.0), (0.0, 1.0), (5.0, 7.0), (2.0, 2.05)], ids=["amid", "start", "end", "two poses"]
)
@pytest.mark.parametrize("shift", [(0.0, 5.0, 0.0), (5.0, 0.0, 0.0), (0.0, 1.2, 0.0), (0.5, 0.0, 0.0), (0.0, 0.0, 3.0)])
def test_a_jump_is_moved_back(start_s: float, stop_s: float, shift: tuple[float, float, float]) -> None:
    true = drive(6, 50, turn=0.2, sigma=0.01)
    found = check_poses(jumping(true, start_s, stop_s, shift))
    if np.linalg.norm(shift) < 2.1 and start_s != 2.0:
        # Of a small step at an end of the log the other end may be hidden in noise.
        assert kinds(found) == ["skip"]
        return
    off, turned, known = errors(found, true)
    assert kinds(found) == ["pose_jump"]
    assert known.all()
    assert off < 0.12
    assert turned < 0.01
    stretch = found.stretches[0]
    assert stretch.shift_m == pytest.approx(np.linalg.norm(shift), abs=0.1)
    assert stretch.first_ns / NS == pytest.approx(start_s, abs=0.2)
    assert stretch.last_ns / NS == pytest.approx(min(stop_s, 6.0), abs=0.2)


def test_a_step_is_taken_out_of_the_shorter_part_and_said_to_be_open() -> None:
    true = drive(6, 50, sigma=0.01)
    track = jumping(true, 4.0, 99.0, (3.0, 1.0, 0.0))
    found = check_poses(track)
    assert errors(found, true)[0] < 0.1
    (fault,) = list_faults(log_of(track), found.stretches, None)
    assert "which part is right does not show" in fault.message


def test_a_step_forward_that_stays_may_be_of_the_stamps_and_is_told_only() -> None:
    track = drive(6, 10, sigma=0.01)
    kept = (times(track) < 3.95) | (times(track) > 4.15)
    skipping = PoseTrack(track.t_ns[: kept.sum()], track.map_T_ego[kept])
    found = check_poses(skipping)
    assert found.track is skipping
    (fault,) = list_faults(log_of(skipping), found.stretches, None)
    assert fault.treatment == "kept"
    assert fault.values["shift_m"] == pytest.approx(2.0, abs=0.1)


@pytest.mark.parametrize("start_s", [0.0, 2.0, 5.0])
def test_a_heading_that_jumps_is_turned_back(start_s: float) -> None:
    true = drive(6, 50, turn=0.2, sigma=0.01)
    found = check_poses(jumping(true, start_s, start_s + 1.01, (0.0, 0.0, 0.0), np.deg2rad(10)))
    assert kinds(found) == ["pose_jump"]
    assert errors(found, true)[1] < 0.01


def test_two_jumps_are_two_faults() -> None:
    true = drive(10, 50, turn=0.2, sigma=0.01)
    track = jumping(jumping(true, 2.0, 3.0, (0.0, 5.0, 0.0)), 6.0, 6.5, (2.0, 2.0, 0.0))
    found = check_poses(track)
    assert kinds(found) == ["pose_jump", "pose_jump"]
    assert errors(found, true)[0] < 0.1


def test_a_jump_at_10_hz_on_a_motorway_is_found() -> None:
    true = drive(6, 10, speed=30.0, sigma=0.02)
    found = check_poses(jumping(true, 2.0, 3.0, (1.0, 0.0, 0.0)))
    assert kinds(found) == ["pose_jump"]
    assert errors(found, true)[0] < 0.15


@pytest.mark.parametrize("brake", [0.0, 3.0])
@pytest.mark.parametrize("turn", [0.0, 0.4])
@pytest.mark.parametrize("hz", [10, 50, 100])
def test_frozen_poses_are_bridged(hz: int, turn: float, brake: float) -> None:
    true = drive(6, hz, brake=brake, turn=turn, sigma=0.01)
    found = check_poses(frozen(true, 2.0, 3.0))
    off, turned, known = errors(found, true)
    assert kinds(found) == ["frozen_poses"]
    assert known.all()
    assert off < 0.2
    assert turned < 0.06


@pytest.mark.parametrize(("start_s", "stop_s"), [(0.0, 1.5), (4.5, 9.0)], ids=["start", "end"])
def test_poses_that_freeze_at_an_end_are_used_as_far_as_they_are_known(start_s: float, stop_s: float) -> None:
    true = drive(6, 50, sigma=0.01)
    track = frozen(true, start_s, stop_s)
    found = check_poses(track)
    off, _, known = errors(found, true)
    assert 0.6 < known.mean() < 0.97
    assert off < 2 * MAX_SIGMA_M
    (fault,) = list_faults(log_of(track), found.stretches, None)
    assert fault.kind == "frozen_poses"
    assert fault.treatment == "left_out"
    assert "is left out" in fault.message


def test_poses_that_freeze_while_the_car_brakes_to_a_stop_are_found() -> None:
    true = drive(6, 50, speed=6.0, brake=4.0, sigma=0.01)
    found = check_poses(frozen(true, 1.5, 3.0))
    assert kinds(found) == ["frozen_poses"]
    assert errors(found, true)[0] < 0.35


@settings(max_examples=30, deadline=None)
@given(
    st.floats(4, 30), st.floats(-0.3, 0.3), st.sampled_from([10, 20, 50]), st.floats(1.0, 4.0), st.integers(0, 10**6)
)
def test_sigmas_of_bridges_cover_their_errors(speed: float, turn: float, hz: int, start_s: float, seed: int) -> None:
    true = drive(6, hz, speed=speed, turn=turn, sigma=0.01, seed=seed)
    found = check_poses(frozen(true, start_s, start_s + 1.0))
    poses, known = found.track.at(true.t_ns)
    off = np.linalg.norm(poses[known, :2, 3] - true.map_T_ego[known, :2, 3], axis=1)
    sigma = found.track.sigmas_at(true.t_ns[known], (0.02, 0.002))[:, 0]
    assert kinds(found) == ["frozen_poses"]
    assert np.all(off < 5 * sigma)


@pytest.mark.parametrize(("step", "bound_m"), [(5, 0.1), (25, 0.1), (50, 0.3)])
def test_poses_of_a_slower_source_that_repeat_are_not_used(step: int, bound_m: float) -> None:
    true = drive(10, 50, turn=0.2)
    rows = np.arange(len(true.t_ns)) // step * step
    track = replace(true, map_T_ego=true.map_T_ego[rows])
    found = check_poses(track)
    assert errors(found, true)[0] < bound_m
    told = [f for f in list_faults(log_of(track), found.stretches, None) if f.kind == "frozen_poses"]
    assert len(told) == 1
    assert "repeat the one before" in told[0].message


@pytest.mark.parametrize("sigma", [0.001, 0.01])
def test_poses_that_stay_but_for_noise_are_frozen(sigma: float) -> None:
    true = drive(6, 50, speed=12.0, turn=0.2, sigma=0.01)
    track = frozen(true, 2.0, 3.0)
    during = (times(true) >= 2.0) & (times(true) < 3.0)
    track.map_T_ego[during, :3, 3] += np.random.default_rng(0).normal(0, sigma, (during.sum(), 3))
    found = check_poses(track)
    assert kinds(found) == ["frozen_poses"]
    assert errors(found, true)[0] < 0.25


# The same examples each time: about one of some hundred fails, see the test below.
@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    st.floats(1, 30), st.floats(-0.5, 0.5), st.floats(0, 6), st.sampled_from([1, 2, 5, 10, 20, 50]),
    st.sampled_from([0.0, 0.01, 0.03]), st.floats(0, 11), st.floats(0.3, 3), st.sampled_from([0.0, 0.5, 1.0, 3.0, 10.0]),
    st.floats(0, 6.28), st.integers(0, 10**6),
)  # fmt: skip
def test_a_repair_never_makes_poses_worse(
    speed: float, turn: float, brake: float, hz: int, sigma: float, start_s: float, lasts_s: float, jump_m: float,
    way: float, seed: int,
) -> None:  # fmt: skip
    turn = float(np.clip(turn, -8 / speed, 8 / speed))
    true = drive(12, hz, speed=speed, turn=turn, brake=brake, sigma=sigma, seed=seed)
    stop_s = start_s + lasts_s
    if jump_m:
        wrong = jumping(true, start_s, stop_s, (jump_m * np.cos(way), jump_m * np.sin(way), 0.0))
    elif ((times(true) >= start_s) & (times(true) < stop_s)).any():
        wrong = frozen(true, start_s, stop_s)
    else:
        wrong = true
    poses, known = check_poses(wrong).track.at(true.t_ns)
    after = poses[known, :2, 3] - true.map_T_ego[known, :2, 3]
    before = wrong.map_T_ego[:, :2, 3] - true.map_T_ego[:, :2, 3]
    rms = [float(np.sqrt(np.mean(np.sum(off**2, axis=1)))) for off in (before, after)]
    assert rms[1] <= 1.2 * rms[0] + 0.05


@pytest.mark.xfail(strict=True, reason="where a slow vehicle comes to rest is moved to the place of the jump")
def test_a_jump_during_the_only_way_of_a_slow_vehicle_is_not_made_worse() -> None:
    true = drive(12, 5, speed=1.0, turn=0.0, brake=1.0, sigma=0.03, seed=0)
    wrong = jumping(true, 0.0, 2.0, (np.cos(3.0), np.sin(3.0), 0.0))
    off = [track.map_T_ego[:, :2, 3] - true.map_T_ego[:, :2, 3] for track in (wrong, check_poses(wrong).track)]
    before, after = (np.sqrt(np.mean(np.sum(o**2, axis=1))) for o in off)
    assert after <= 1.2 * before + 0.05


# --- gaps


@pytest.mark.parametrize(("step", "bound_m"), [(25, 0.03), (50, 0.12), (62, 0.25)])
def test_sparse_poses_are_interpolated_by_the_motion(step: int, bound_m: float) -> None:
    true = drive(10, 50, turn=0.3, brake=1.0)
    found = check_poses(thinned(true, step))
    poses, known = found.track.at(true.t_ns)
    inside = true.t_ns <= thinned(true, step).t_ns[-1]
    off = np.linalg.norm(poses[:, :3, 3] - true.map_T_ego[:, :3, 3], axis=1)
    straight = replace(thinned(true, step), max_gap_s=np.inf).at(true.t_ns)[0]
    by_line = np.linalg.norm(straight[:, :3, 3] - true.map_T_ego[:, :3, 3], axis=1)
    assert known[inside].all()
    assert off[inside].max() < min(bound_m, by_line[inside].max())


def test_sigma_grows_with_the_gap_and_within_it() -> None:
    true = drive(12, 50)
    sigmas = []
    for gap_s in (0.5, 1.0, 2.0):
        kept = (times(true) < 5.0) | (times(true) > 5.0 + gap_s)
        track = replace(true, t_ns=true.t_ns[kept], map_T_ego=true.map_T_ego[kept])
        at = [round((5.0 + share * gap_s) * NS) for share in (0.1, 0.5)]
        sigmas.append(check_poses(track).track.sigmas_at(at, (0.02, 0.002))[:, 0])
    assert np.all(np.diff(sigmas, axis=0)[:, 1] > 0.005)
    assert all(low < high for low, high in sigmas)


def test_a_gap_that_is_too_long_is_told_with_its_start_and_length() -> None:
    true = drive(20, 50)
    kept = (times(true) < 5.0) | (times(true) > 11.0)
    track = replace(true, t_ns=true.t_ns[kept], map_T_ego=true.map_T_ego[kept])
    found = check_poses(track)
    (fault,) = list_faults(log_of(true), found.stretches, None)
    assert fault.kind == "sparse_poses"
    assert fault.treatment == "left_out"
    assert "from 4.98 to 11.02 s" in fault.message
    known = found.track.at(np.array([2, 8, 15]) * NS)[1]
    assert known.tolist() == [True, False, True]


def test_gaps_without_records_are_not_told() -> None:
    track = thinned(drive(10, 50), 100)
    found = check_poses(track)
    assert list_faults(log_of(track, 10.0), found.stretches, None)
    assert not list_faults(log_of(track, 0.5), found.stretches, None)


def test_faults_outside_of_the_time_that_is_used_are_not_told() -> None:
    track = jumping(drive(6, 50), 2.0, 3.0, (0.0, 5.0, 0.0))
    found = check_poses(track)
    (fault,) = list_faults(log_of(track), found.stretches, None)
    assert fault.kind in FAULT_KINDS
    assert fault.values["shift_m"] == pytest.approx(5.0, abs=0.05)
    assert not list_faults(log_of(track), found.stretches, (4 * NS, 6 * NS))


# --- the log


def test_evaluation_finds_the_repaired_poses_again() -> None:
    track = jumping(drive(6, 50), 2.0, 3.0, (0.0, 5.0, 0.0))
    log = localize_like(log_of(track), {"poses": {"source": "given"}})
    assert log.ego is not None
    np.testing.assert_array_equal(log.ego.map_T_ego, check_poses(track).track.map_T_ego)


# --- the fit


def test_the_fit_reproduces_a_parabola_and_extrapolates_it() -> None:
    t = np.linspace(0, 2, 30)
    asked = np.array([0.5, 1.77, 2.3])

    def path(t: Array) -> Array:
        return np.stack([3 + 8 * t - t**2, 0.5 * t], axis=1)

    found = fit_path(t, path(t), 1e-3, asked, POSITION_PRIOR)
    np.testing.assert_allclose(found.value, path(asked), atol=5e-3)
    assert found.sigma[2] > 5 * found.sigma[0]


def test_the_fit_finds_a_step_between_its_samples() -> None:
    t = np.linspace(0, 2, 41)
    after = t > 1.0
    found = fit_path(t, 8 * t[:, None] + 5.0 * after[:, None], 0.01, t[:1], POSITION_PRIOR, after=after)
    assert found.step[0] == pytest.approx(5.0, abs=3 * found.step_sigma)
    assert found.step_sigma < 0.03


def test_sigmas_of_the_fit_are_those_of_paths_drawn_from_its_prior() -> None:
    rng, dt = np.random.default_rng(0), 0.02
    t = np.arange(0, 4, dt)
    seen = (t < 1.2) | (t > 2.6)
    ratios = []
    for _ in range(60):
        jerk = rng.normal(0, np.sqrt(YAW_PRIOR.density / dt), len(t))
        yaw = np.cumsum(np.cumsum(np.cumsum(jerk) * dt) * dt) * dt
        measured = yaw[seen] + rng.normal(0, 0.002, seen.sum())
        found = fit_path(t[seen][::3], measured[::3, None], 0.002, t[~seen][::5], YAW_PRIOR)
        ratios.append((found.value[:, 0] - yaw[~seen][::5]) / found.sigma)
    assert np.std(ratios) == pytest.approx(1.0, abs=0.3)


def test_noise_is_estimated_in_spite_of_jumps_and_irregular_stamps() -> None:
    rng = np.random.default_rng(1)
    t = np.sort(rng.uniform(0, 20, 2000))
    values = np.stack([10 * t, t**2 / 2], axis=1) + rng.normal(0, 0.05, (2000, 2))
    values[900:1000] += 5.0
    assert noise_of(t, values, 0.02) == pytest.approx(0.05, rel=0.15)


# --- what is placed by the poses


def test_agents_are_as_uncertain_as_the_poses_that_place_them() -> None:
    true = drive(6, 50)
    kept = (times(true) < 2.0) | (times(true) > 4.0)
    log = log_of(check_poses(replace(true, t_ns=true.t_ns[kept], map_T_ego=true.map_T_ego[kept])).track)
    t = np.arange(0.0, 6.05, 0.1)
    timeline = Timeline(np.rint(t * NS).astype(np.int64), 0)
    flat = np.zeros(len(t))
    seen = np.ones(len(t), dtype=bool)
    near = Waypoints(t, 10 * t, flat + 3.0, flat, flat, flat + 10, seen, flat + 0.1, flat + 0.05)
    far = replace(near, y_m=flat + 40.0)
    size = (4.5, 1.8, 1.5)
    small, large = (
        with_pose_errors(Agent("a", "car", size, w), log, timeline).waypoints.sigma_xy_m for w in (near, far)
    )
    middle = len(t) // 2
    assert small[0] == pytest.approx(0.1)
    assert small[middle] > 0.14
    assert large[middle] > small[middle]
    standing = with_pose_errors(Agent("b", "car", size, near, static=True), log, timeline).waypoints
    np.testing.assert_allclose(standing.sigma_xy_m, 0.1, atol=1e-3)
    assert with_pose_errors(Agent("a", "car", size, near), log_of(true), timeline).waypoints is near


def test_the_ego_is_less_sure_where_its_poses_are_bridged() -> None:
    true = drive(6, 50)
    t_ns = np.arange(0, 6 * NS + 1, NS // 10)
    whole = ego_agent(log_of(true), Timeline(t_ns, 0))
    bridged = ego_agent(log_of(check_poses(frozen(true, 2.0, 3.5)).track), Timeline(t_ns, 0))
    assert whole is not None
    assert bridged is not None
    added = bridged.waypoints.sigma_xy_m - whole.waypoints.sigma_xy_m
    assert added[27] > 0.03
    assert abs(added[10]) < 2e-3
