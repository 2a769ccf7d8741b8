"""Smoothed trajectories: against dense least squares, closed forms, and truth with noise, outliers and gaps."""

from __future__ import annotations

import numpy as np
import pytest
from benchmarks import smoothing as maneuvers
from scipy.integrate import quad_vec
from scipy.linalg import expm

from log2sim.agents.smooth.fixed_interval import smooth_interval
from log2sim.agents.smooth.motion_model import MotionModel, broken_limits, course_is_known, yaw_of_motion, yaw_sigma
from log2sim.agents.smooth.quadratic import (
    ACCELERATION_PRIOR_MPS2,
    VELOCITY_PRIOR_MPS,
    NoisyPositions,
    from_band,
    selected_inverse,
    to_band,
)
from log2sim.agents.smooth.smoother import signed_speed, smooth_track
from log2sim.geometry import wrap_angle

DT = 0.1


def straight(t: np.ndarray) -> np.ndarray:
    return np.column_stack([12.0 * t, 3.0 + 4.0 * t])


def turn(t: np.ndarray) -> np.ndarray:
    """8 m/s on a circle of 20 m."""
    return 20.0 * np.column_stack([np.sin(0.4 * t), 1 - np.cos(0.4 * t)])


def stop(t: np.ndarray) -> np.ndarray:
    """10 m/s, braking with 2.5 m/s2 from 2 s on until it stands at 6 s."""
    braking = np.clip(t - 2.0, 0.0, 4.0)
    return np.column_stack([10.0 * np.minimum(t, 6.0) - 1.25 * braking**2, 0 * t])


def reverse(t: np.ndarray) -> np.ndarray:
    """Forward at first, standing still for an instant at 4 s, then backward."""
    return np.column_stack([20.0 - 1.25 * (t - 4.0) ** 2, 0 * t])


MANEUVERS = {"straight": straight, "turn": turn, "stop": stop, "reverse": reverse}


def dense_solution(observed: NoisyPositions, knots: np.ndarray, density: float) -> tuple[np.ndarray, np.ndarray]:
    """States (K, 6) and covariances (K, 6, 6): all knots' process noise integrated numerically, one dense system."""
    f = np.zeros((3, 3))
    f[0, 1] = f[1, 2] = 1.0
    count = len(knots)
    information, rhs = np.zeros((count * 6, count * 6)), np.zeros(count * 6)

    def add(rows: np.ndarray, weight: np.ndarray, target: np.ndarray) -> None:
        nonlocal information, rhs
        information += rows.T @ weight @ rows
        rhs += rows.T @ weight @ target

    for k in range(count - 1):
        dt = knots[k + 1] - knots[k]
        noise, _ = quad_vec(lambda s: density * np.outer(expm(f * s)[:, 2], expm(f * s)[:, 2]), 0.0, dt, epsabs=1e-15)
        for axis in range(2):
            rows = np.zeros((3, count * 6))
            rows[:, 6 * k + axis : 6 * k + 6 : 2] = -expm(f * dt)
            rows[:, 6 * k + 6 + axis : 6 * k + 12 : 2] = np.eye(3)
            add(rows, np.linalg.inv(noise), np.zeros(3))
    prior = np.diag([0, 0, *[VELOCITY_PRIOR_MPS**-2] * 2, *[ACCELERATION_PRIOR_MPS2**-2] * 2])
    information[:6, :6] += prior
    for t, xy, r in zip(observed.t_s, observed.xy, observed.r):
        k = int(np.argmin(np.abs(knots - t)))
        rows = np.zeros((2, count * 6))
        rows[[0, 1], [6 * k, 6 * k + 1]] = 1.0
        add(rows, np.linalg.inv(r), xy)
    covariance = np.linalg.inv(information)
    states = (covariance @ rhs).reshape(count, 6)
    return states, np.array([covariance[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] for k in range(count)])


def test_the_banded_solver_agrees_with_dense_least_squares() -> None:
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.uniform(0.05, 0.6, 12))
    root = rng.normal(0, 0.2, (12, 2, 2))
    # Observations on a smooth way far within their noise keep the robust weights at 1.
    xy = np.column_stack([2.0 * t, 0.2 * t**2]) + rng.normal(0, 1e-4, (12, 2))
    observed = NoisyPositions(t, xy, root @ np.swapaxes(root, 1, 2) + 0.04 * np.eye(2))
    path = smooth_interval(observed, t, MotionModel(2.0, holonomic=True))
    state, covariance = path.state.reshape(-1, 6), path.covariance
    expected, expected_covariance = dense_solution(observed, t, 2.0)
    assert path.weight.min() > 0.999
    np.testing.assert_allclose(state, expected, rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(covariance, expected_covariance, rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(path.residual_m, np.hypot(*(xy - state[:, :2]).T), atol=1e-9)


def test_states_between_observations_are_those_of_a_knot_there() -> None:
    t = np.array([0.0, 0.4, 0.8, 1.2, 1.6])
    observed = NoisyPositions(t, np.column_stack([t**2, 0 * t]), np.tile(0.01 * np.eye(2), (5, 1, 1)))
    asked = np.array([0.2, 0.5, 1.6, 2.0])
    knots = np.unique(np.concatenate([t, asked]))
    expected, expected_covariance = dense_solution(observed, knots, 4.0)
    rows = np.searchsorted(knots, asked)
    path = smooth_interval(observed, asked, MotionModel(4.0, holonomic=True))
    np.testing.assert_allclose(path.state.reshape(-1, 6), expected[rows], atol=2e-3)
    np.testing.assert_allclose(path.covariance, expected_covariance[rows], rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("step_s", [1e-3, 0.01, 0.1, 1.0, 10.0])
def test_steps_from_milliseconds_to_seconds(step_s: float) -> None:
    t = step_s * np.arange(60)
    truth = np.column_stack([5.0 * t, -2.0 * t])
    path = smooth_track(t, truth, sigma_m=0.1)
    np.testing.assert_allclose(path.xy_m, truth, atol=1e-3 * max(1.0, 5 * step_s))
    assert np.isfinite(path.covariance).all()
    # Faster than noise allows and slower than the motion model remembers, speeds are not known so well.
    if 0.01 <= step_s <= 1.0:
        np.testing.assert_allclose(path.velocity_mps, np.tile([5.0, -2.0], (60, 1)), atol=0.05)


@pytest.mark.parametrize("maneuver", MANEUVERS)
@pytest.mark.parametrize("sigma", [0.1, 0.3, 0.6])
def test_noise_outliers_and_gaps_leave_the_way_near_to_the_truth(maneuver: str, sigma: float) -> None:
    t = DT * np.arange(80)
    truth, velocity = MANEUVERS[maneuver](t), np.gradient(MANEUVERS[maneuver](t), t, axis=0)
    squared, slow, rejected, kept, inside = [], [], [], [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        xy = truth + rng.normal(0, sigma, truth.shape)
        wrong = np.isin(np.arange(80), rng.choice(np.arange(5, 75), 6, replace=False))
        angle = rng.uniform(0, 2 * np.pi, 80)
        xy[wrong] += 12 * sigma * np.column_stack([np.cos(angle), np.sin(angle)])[wrong]
        valid = (np.arange(80) < 30) | (np.arange(80) >= 38)
        path = smooth_track(t, np.where(valid[:, None], xy, np.nan), sigma_m=sigma)
        error = np.hypot(*(path.xy_m - truth).T)
        squared.append(error**2)
        slow.append(np.hypot(*(path.velocity_mps - velocity).T))
        rejected.append(~path.inlier[wrong & valid])
        kept.append(path.inlier[~wrong & valid])
        inside.append(
            np.einsum("ti,tij,tj->t", path.xy_m - truth, np.linalg.inv(path.covariance), path.xy_m - truth) < 9.21
        )
    assert np.concatenate(rejected).mean() > 0.97
    assert np.concatenate(kept).mean() > 0.97
    seen = valid & (t > 0.5) & (t < 7.4)
    assert np.sqrt(np.mean(np.array(squared)[:, seen])) < 0.8 * sigma  # raw positions are off by 1.41 sigma
    assert np.sqrt(np.mean(np.square(np.array(slow)[:, seen]))) < 0.35 + 1.6 * sigma
    # What it says of its own error is true: within the 99 % ellipse far more often than not.
    assert np.mean(inside) > 0.9


def test_more_noise_in_the_data_less_weight() -> None:
    t, rng = DT * np.arange(60), np.random.default_rng(1)
    noise = rng.normal(0, 1, (60, 2))
    sigma = np.where(np.arange(60) % 2 == 0, 0.05, 0.8)
    xy = straight(t) + noise * sigma[:, None]
    told = np.hypot(*(smooth_track(t, xy, sigma_m=sigma).xy_m - straight(t)).T)
    untold = np.hypot(*(smooth_track(t, xy, sigma_m=0.4).xy_m - straight(t)).T)
    assert told.mean() < 0.5 * untold.mean()
    # Covariances are taken less literally, since measurements come with them.
    as_matrix = smooth_track(t, xy, covariance=sigma[:, None, None] ** 2 * np.eye(2))
    np.testing.assert_allclose(as_matrix.xy_m, smooth_track(t, xy, sigma_m=sigma).xy_m, atol=0.05)


@pytest.mark.parametrize("motion", [MotionModel(), MotionModel(holonomic=True), MotionModel(heading_rad=0.4)])
def test_what_stands_all_along_is_at_the_mean_of_its_positions_whatever_it_is(motion: MotionModel) -> None:
    for rate_hz, sigma in ((2, 0.3), (10, 0.1), (10, 0.3)):
        t = np.arange(0, 10, 1 / rate_hz)
        xy = np.random.default_rng(1).normal([40.0, -7.0], sigma, (len(t), 2))
        path = smooth_track(t, xy, sigma_m=sigma, motion=motion)
        of_mean = sigma / np.sqrt(len(t))
        np.testing.assert_allclose(path.xy_m, np.tile(xy.mean(axis=0), (len(t), 1)), atol=0.1 * of_mean)
        np.testing.assert_allclose(np.sqrt(path.covariance[:, [0, 1], [0, 1]]), of_mean, rtol=0.05)
        assert np.hypot(*path.velocity_mps.T).max() < 1e-3
        assert (path.yaw_rad == (motion.heading_rad or 0.0)).all()
        assert (path.curvature_1pm == 0).all()


def test_a_vehicle_does_not_slide_sideways() -> None:
    for maneuver in MANEUVERS.values():
        t = DT * np.arange(80)
        xy = maneuver(t) + np.random.default_rng(6).normal(0, 0.1, (80, 2))
        path = smooth_track(t, xy, sigma_m=0.1, motion=MotionModel(heading_rad=0.0))
        speed = np.hypot(*path.velocity_mps.T)
        across = path.velocity_mps[:, 1] * np.cos(path.yaw_rad) - path.velocity_mps[:, 0] * np.sin(path.yaw_rad)
        assert np.abs(across[speed > 1.0]).max() < 1e-6
        assert np.abs(across).max() < 0.6


def test_reversing_keeps_the_heading_and_turns_the_speed() -> None:
    t = DT * np.arange(80)
    for hint, heading in ((None, 0.0), (0.2, 0.0), (np.pi, np.pi)):
        path = smooth_track(t, reverse(t), sigma_m=0.1, motion=MotionModel(heading_rad=hint))
        assert np.abs(wrap_angle(path.yaw_rad - heading)).max() < 0.02
        speed = signed_speed(path.velocity_mps, path.yaw_rad)
        expected = np.cos(heading) * -2.5 * (t - 4.0)
        assert np.abs(speed - expected)[5:-5].max() < 0.15


def test_yaw_runs_on_across_the_half_turn() -> None:
    t = DT * np.arange(200)
    path = smooth_track(t, turn(t), sigma_m=0.05)
    expected = wrap_angle(0.4 * t)
    assert np.abs(wrap_angle(path.yaw_rad - expected)).max() < 0.05
    assert (path.yaw_rad >= -np.pi).all()
    assert (path.yaw_rad < np.pi).all()
    np.testing.assert_allclose(path.curvature_1pm[20:-20], 1 / 20, rtol=0.05)


def test_heading_between_two_parts_of_motion_turns_with_the_way() -> None:
    # East at 2 m/s, creeping through a corner at 0.5 m/s, north at 2 m/s; it stands, with
    # 0.1 m/s of noise, for a while at the corner's end.
    velocity = np.array([[2.0, 0.0]] * 10 + [[0.4, 0.3]] * 10 + [[0.1, 0.0]] * 10 + [[0.0, 2.0]] * 10)
    xy = np.concatenate([[[0.0, 0.0]], np.cumsum(velocity * DT, axis=0)[:-1]])
    yaw = yaw_of_motion(xy, velocity)
    assert (np.diff(yaw) >= -1e-12).all()
    assert yaw[9] == 0.0
    assert yaw[30] == pytest.approx(np.pi / 2)
    assert np.ptp(yaw[21:30]) == pytest.approx(0.0, abs=1e-12)
    assert 0.2 < yaw[15] < 1.2


@pytest.mark.parametrize(("shift_s", "angle"), [(1e3, 0.0), (1.7e9, 0.0), (0.0, 2.0)])
def test_a_track_moves_and_turns_with_its_clock_and_its_scene(shift_s: float, angle: float) -> None:
    t, c, s = (
        0.125 * np.arange(64),
        np.cos(angle),
        np.sin(angle),
    )  # times that are exact in binary, so that the shift is
    rotation = np.array([[c, -s], [s, c]])
    xy = turn(t) + np.random.default_rng(7).normal(0, 0.2, (64, 2))
    a, b = smooth_track(t, xy, sigma_m=0.2), smooth_track(t + shift_s, xy @ rotation.T, sigma_m=0.2)
    np.testing.assert_allclose(b.xy_m, a.xy_m @ rotation.T, atol=1e-8)
    np.testing.assert_allclose(wrap_angle(b.yaw_rad - a.yaw_rad - angle), 0.0, atol=1e-7)
    np.testing.assert_allclose(b.t_s - shift_s, a.t_s)


def test_gaps_are_filled_and_their_covariance_says_so() -> None:
    t = np.concatenate([DT * np.arange(20), 5.0 + DT * np.arange(20)])
    path = smooth_track(t, straight(t), sigma_m=0.1, at_s=DT * np.arange(70))
    np.testing.assert_allclose(path.xy_m, straight(path.t_s), atol=0.02)
    sigma = np.sqrt(path.covariance[:, 0, 0])
    assert sigma[34] > 2 * sigma[10]
    assert sigma[34] == sigma[20:50].max() or abs(int(np.argmax(sigma[20:50])) + 20 - 34) <= 1


def test_rows_that_are_not_finite_are_not_used() -> None:
    t = DT * np.arange(40)
    xy, broken = straight(t), straight(t)
    broken[5], broken[9, 1] = np.nan, np.inf
    used = np.isin(np.arange(40), [5, 9], invert=True)
    path = smooth_track(t, broken, sigma_m=0.1)
    expected = smooth_track(t[used], xy[used], sigma_m=0.1, at_s=t)
    np.testing.assert_array_equal(path.xy_m, expected.xy_m)
    np.testing.assert_array_equal(path.inlier, used)
    np.testing.assert_array_equal(np.isnan(path.residual_m), ~used)


@pytest.mark.parametrize(
    ("t", "xy", "sigma", "message"),
    [
        ([0.0, 0.1, 0.1], np.zeros((3, 2)), 0.1, "does not at index 2"),
        ([0.0, 0.2, 0.1], np.zeros((3, 2)), 0.1, "does not at index 2"),
        ([0.0, 0.1], np.zeros((3, 2)), 0.1, r"\(n, 2\)"),
        ([0.0, 0.1], np.full((2, 2), np.nan), 0.1, "no valid position"),
        ([], np.zeros((0, 2)), 0.1, "no valid position"),
        ([0.0, 0.1], np.zeros((2, 2)), 0.0, "sigma_m must be positive"),
        ([0.0, 0.1], np.zeros((2, 2)), [0.1, np.nan], "sigma_m must be positive"),
        ([0.0, 0.1], np.zeros((2, 2)), None, "sigma_m must be positive"),
    ],
)
def test_what_cannot_be_smoothed_is_refused(t: object, xy: np.ndarray, sigma: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        smooth_track(t, xy, sigma_m=sigma)  # type: ignore[arg-type]


def test_impossible_motion_is_flagged() -> None:
    t = DT * np.arange(60)
    assert smooth_track(t, turn(t), sigma_m=0.1).broken == ()
    spin = 2.0 * np.column_stack([np.sin(2.0 * t), 1 - np.cos(2.0 * t)])  # 4 m/s on a circle of 2 m
    broken = smooth_track(t, spin, sigma_m=0.01, motion=MotionModel(100.0)).broken
    assert [limit.start_s < 0.5 < limit.end_s for limit in broken if limit.kind == "curvature"] == [True]
    assert smooth_track(t, spin, sigma_m=0.01, motion=MotionModel(1e4, holonomic=True)).broken == ()
    rocket = np.column_stack([10.0 * t**2, 0 * t])
    broken = smooth_track(t, rocket, sigma_m=0.01, motion=MotionModel(100.0)).broken
    assert "acceleration" in [limit.kind for limit in broken]


@pytest.mark.parametrize("sigma", [0.1, 0.3, 0.6])
def test_covariances_are_honest(sigma: float) -> None:
    ratios: dict[str, list[float]] = {}
    for world in maneuvers.worlds(sigma, 0.01, seeds=6):
        path = smooth_track(world.truth.t_s[world.valid], world.xy_m[world.valid], sigma_m=sigma, at_s=world.truth.t_s)
        off = path.xy_m - world.truth.xy_m
        squared = np.einsum("ti,tij,tj->t", off, np.linalg.inv(path.covariance), off) / 2
        ratios.setdefault(world.maneuver, []).append(float(squared.mean()))
    assert 0.5 < np.mean(list(ratios.values())) < 2.0
    for maneuver, values in ratios.items():
        assert 0.4 < np.mean(values) < 2.2, maneuver


@pytest.mark.parametrize("sigma", [0.1, 0.3, 0.6])
def test_no_yaw_leaps_or_swings_at_the_ends(sigma: float) -> None:
    for world in maneuvers.worlds(sigma, 0.03, seeds=4):
        path = smooth_track(world.truth.t_s[world.valid], world.xy_m[world.valid], sigma_m=sigma, at_s=world.truth.t_s)
        off = np.degrees(np.abs(wrap_angle(path.yaw_rad - world.truth.yaw_rad)))
        assert off.max() < 8 + 40 * sigma, (world.maneuver, world.seed)
        assert np.degrees(np.abs(wrap_angle(np.diff(path.yaw_rad)))).max() < 8


@pytest.mark.parametrize("rate_hz", [2, 4, 20])
def test_errors_follow_the_number_of_observations_and_nothing_else_of_the_rate(rate_hz: int) -> None:
    by_rate = {}
    for rate in (rate_hz, 10):
        rows = []
        for maneuver in maneuvers.MANEUVERS:
            for truth, t, xy in maneuvers.rate_worlds(maneuver, rate, 0.2, seeds=3):
                path = smooth_track(t, xy, sigma_m=0.2, at_s=truth.t_s)
                estimate = path.xy_m, path.velocity_mps, path.yaw_rad, path.curvature_1pm
                rows.append(maneuvers.errors_of(truth, *estimate))
        by_rate[rate] = np.median(rows, axis=0)
    ratio = by_rate[rate_hz] / by_rate[10]
    assert ratio[0] == pytest.approx(np.sqrt(10 / rate_hz), rel=0.25)
    assert (ratio[1:3] < 1.25 * max(1.0, np.sqrt(10 / rate_hz))).all()


@pytest.mark.parametrize("rate_hz", [2, 4, 10, 20])
@pytest.mark.parametrize("sigma", [0.05, 0.15])
def test_a_queue_stands_and_rolls_at_every_rate(rate_hz: int, sigma: float) -> None:
    verdicts = []
    for truth, t, xy in maneuvers.rate_worlds(maneuvers.QUEUE, rate_hz, sigma, seeds=6):
        path = smooth_track(t, xy, sigma_m=sigma, at_s=truth.t_s, motion=MotionModel(heading_rad=0.4))
        verdicts.append(maneuvers.standing_verdicts(truth, path.velocity_mps))
    found, wrong = np.mean(verdicts, axis=0)
    # It takes some observations to tell a stop of 2 s from rolling.
    assert found > {2: 0.4, 4: 0.55, 10: 0.65, 20: 0.65}[rate_hz]
    assert wrong < 0.05


def test_what_stands_neither_creeps_nor_turns_not_even_at_its_last_stamp() -> None:
    t = DT * np.arange(120)
    for sigma in (0.05, 0.15, 0.3):
        for seed in range(6):
            xy = stop(t) + np.random.default_rng(seed).normal(0, sigma, (120, 2))
            path = smooth_track(t, xy, sigma_m=sigma)
            standing = t > 7.5
            assert np.hypot(*path.velocity_mps[standing].T).max() < 0.04 + 0.4 * sigma, (sigma, seed)
            assert np.ptp(path.yaw_rad[standing]) < 1e-6
            assert np.hypot(*(path.xy_m[standing] - stop(t)[standing]).T).max() < 1.2 * sigma


def test_what_drives_off_at_the_end_of_its_track_is_not_held() -> None:
    t = DT * np.arange(100)
    leaving = np.clip(t - 8.5, 0.0, None)
    truth = np.column_stack([leaving**2, 0 * t])
    for seed in range(4):
        xy = truth + np.random.default_rng(seed).normal(0, 0.03, (100, 2))
        # Even where the positions are said to be far worse than they are.
        for said in (0.03, 0.15):
            path = smooth_track(t, xy, sigma_m=said, motion=MotionModel(heading_rad=0.0))
            assert path.velocity_mps[-1, 0] > 1.5
            assert np.hypot(*path.velocity_mps[t < 7.5].T).max() < 0.1


def test_what_rolls_slowly_goes_along_its_hint() -> None:
    t = DT * np.arange(60)
    for seed in range(6):
        xy = np.column_stack([0.45 * t, 0 * t]) + np.random.default_rng(seed).normal(0, 0.3, (60, 2))
        path = smooth_track(t, xy, sigma_m=0.3, motion=MotionModel(4.0, heading_rad=0.0))
        assert np.sqrt(np.mean(path.velocity_mps[:, 1] ** 2)) < 0.06


def test_a_slow_vehicle_goes_where_it_points() -> None:
    t = DT * np.arange(100)
    along = np.where(t < 4.0, 5.0 * t - 0.55 * t**2, 11.2 + 0.6 * (t - 4.0))
    xy = np.column_stack([along, 0 * t]) + np.random.default_rng(4).normal(0, 0.2, (100, 2))
    path = smooth_track(t, xy, sigma_m=0.2)
    across = path.velocity_mps[:, 1] * np.cos(path.yaw_rad) - path.velocity_mps[:, 0] * np.sin(path.yaw_rad)
    assert np.abs(across).max() < 0.12
    assert np.degrees(np.abs(path.yaw_rad[t > 4.0])).max() < 6


def test_densities_come_out_as_the_motion_was_made() -> None:
    """White jerk of known density along x and across, from its exact covariance."""
    q = np.array([[1 / 20, 1 / 8, 1 / 6], [1 / 8, 1 / 3, 1 / 2], [1 / 6, 1 / 2, 1.0]])
    scale = np.array([DT**2.5, DT**1.5, DT**0.5])
    root = np.linalg.cholesky(q * scale[:, None] * scale)
    step = np.array([[1.0, DT, DT**2 / 2], [0.0, 1.0, DT], [0.0, 0.0, 1.0]])
    t, found = DT * np.arange(120), []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        state, xy = np.array([[0.0, 0.0], [100.0, 0.0], [0.0, 0.0]]), []
        for _ in t:
            xy.append(state[0].copy())
            state = step @ state + root @ rng.normal(size=(3, 2)) * np.sqrt([8.0, 0.2])
        noisy = np.array(xy) + rng.normal(0, 0.1, (120, 2))
        found.append(
            smooth_interval(
                NoisyPositions(t, noisy, np.tile(0.01 * np.eye(2), (120, 1, 1))), t, MotionModel()
            ).jerk_density
        )
    typical = np.exp(np.mean(np.log(found), axis=0))
    assert 8.0 / 2 < typical[0] < 8.0 * 2
    assert 0.2 / 2.5 < typical[1] < 0.2 * 2.5


@pytest.mark.parametrize("count", [1, 2, 7, 9, 24, 41])
def test_the_selected_inverse_has_the_blocks_of_the_whole_one(count: int) -> None:
    rng, size = np.random.default_rng(count), 3
    root = np.tril(rng.normal(size=(count * size, count * size))) * (
        np.abs(np.subtract.outer(np.arange(count * size) // size, np.arange(count * size) // size)) <= 1
    )
    whole = root @ root.T + 4 * np.eye(count * size)
    blocks = whole.reshape(count, size, count, size)
    k = np.arange(count)
    diagonal, off = blocks[k, :, k], blocks[k[:-1], :, k[1:]]
    on, above = selected_inverse(diagonal, off)
    inverse = np.linalg.inv(whole).reshape(blocks.shape)
    np.testing.assert_allclose(on, inverse[k, :, k], atol=1e-12)
    np.testing.assert_allclose(above, inverse[k[:-1], :, k[1:]], atol=1e-12)
    back = from_band(to_band(diagonal, off), size)
    np.testing.assert_allclose(back[0], diagonal)
    np.testing.assert_allclose(back[1], off)


def test_limits_that_a_motion_breaks_are_named_with_their_spans() -> None:
    t, zero = DT * np.arange(10), np.zeros(10)
    calm = np.zeros((10, 2))
    assert broken_limits(t, calm, zero, zero) == ()
    (hard,) = broken_limits(t, calm + np.array([11.0, 0.0]), zero, zero)
    assert (hard.kind, hard.values["most_mps2"], hard.start_s, hard.end_s) == ("acceleration", 11.0, t[0], t[-1])
    (slide,) = broken_limits(t, calm + np.array([0.0, 9.0]), zero, zero)
    assert slide.kind == "lateral_acceleration"
    (spin,) = broken_limits(t, calm, zero, np.where(t == t[3], 0.4, 0.0))
    assert (spin.kind, spin.values["at_s"], spin.start_s, spin.end_s) == ("curvature", t[3], t[3], t[3])
    (jolt,) = broken_limits(t, np.where(t > t[4], 6.0, 0.0)[:, None] * np.array([1.0, 0.0]), zero, zero)
    assert (jolt.kind, jolt.start_s, jolt.end_s) == ("jerk", t[4], t[5])
    assert spin.sentence == f"turns on a circle of 2.5 m at {t[3]:.1f} s"
    assert spin.holds(t).tolist() == (t == t[3]).tolist()


def test_a_limit_that_noise_may_have_broken_is_not() -> None:
    t, zero = DT * np.arange(10), np.zeros(10)
    above = np.full((10, 2), [11.0, 0.0])
    assert broken_limits(t, above, zero, zero, {"acceleration": zero + 0.5}) == ()
    assert broken_limits(t, above, zero, zero, {"acceleration": zero + 0.2}) != ()


@pytest.mark.parametrize("sigma", [0.05, 0.2])
def test_sigmas_of_yaw_and_speed_are_honest(sigma: float) -> None:
    t = DT * np.arange(60)
    truth_yaw, off_yaw, off_speed = np.arctan2(*np.gradient(turn(t), t, axis=0).T[::-1]), [], []
    truth_speed = np.hypot(*np.gradient(turn(t), t, axis=0).T)
    for seed in range(12):
        noisy = turn(t) + np.random.default_rng(seed).normal(0, sigma, (60, 2))
        path = smooth_track(t, noisy, sigma_m=sigma)
        off_yaw.append(wrap_angle(path.yaw_rad - truth_yaw)[2:-2] / path.sigma_yaw_rad[2:-2])
        off_speed.append((np.hypot(*path.velocity_mps.T) - truth_speed)[2:-2] / path.sigma_speed_mps[2:-2])
    assert 0.5 < np.mean(np.square(off_yaw)) < 2.0
    assert 0.5 < np.mean(np.square(off_speed)) < 2.0


def test_the_sigma_of_a_held_heading_grows_with_the_way_only() -> None:
    velocity = np.column_stack([np.r_[np.full(5, 5.0), np.full(5, 0.5), np.zeros(10)], np.zeros(20)])
    xy = np.column_stack([np.cumsum(velocity[:, 0]) * DT, np.zeros(20)])
    known = np.arange(20) < 5
    sigma = yaw_sigma(xy, velocity, np.tile(0.01 * np.eye(2), (20, 1, 1)), known)
    np.testing.assert_allclose(sigma[:5], 0.02)
    assert np.all(np.diff(sigma[5:10]) > 0)
    np.testing.assert_allclose(sigma[11:], sigma[11])
    unknown = yaw_sigma(xy, velocity, np.tile(0.01 * np.eye(2), (20, 1, 1)), ~known & known, hint_sigma_rad=0.3)
    assert unknown.tolist() == [0.3] * 20


def braked(t: np.ndarray, rest_s: float) -> np.ndarray:
    """Braking at 3 m/s2 to rest at a time."""
    before = np.minimum(t - rest_s, 0.0)
    return np.column_stack([-1.5 * before**2, 0 * t])


@pytest.mark.parametrize("rate_hz", [2.0, 5.0, 20.0])
@pytest.mark.parametrize("seen_after_s", [-0.6, 0.0, 0.5, 3.0])
def test_what_brakes_to_rest_does_not_roll_back(rate_hz: float, seen_after_s: float) -> None:
    """The errors of boxes repeat from tick to tick; the last tick is later than the last measurement."""
    t = np.arange(0.0, 4.0 + seen_after_s, 1 / rate_hz)
    for seed in range(4):
        rng = np.random.default_rng(seed)
        error = np.array([np.interp(t, np.arange(0, 9, 0.5), rng.normal(0, 0.08, 18)) for _ in range(2)]).T
        noisy = braked(t, 4.0) + error + rng.normal(0, 0.02, (len(t), 2))
        covariance = np.tile(0.15**2 * np.eye(2), (len(t), 1, 1))
        asked = np.append(t, t[-1] + 0.08)
        path = smooth_track(t, noisy, covariance=covariance, at_s=asked, motion=MotionModel(heading_rad=0.0))
        speed = signed_speed(path.velocity_mps, path.yaw_rad)
        assert speed.min() > -0.1
        assert np.abs(path.yaw_rad).max() < 0.3
        assert np.hypot(*(path.xy_m - braked(asked, 4.0)).T).max() < 0.5


@pytest.mark.parametrize("rate_hz", [2.0, 10.0])
def test_a_view_that_changes_at_the_end_is_no_acceleration(rate_hz: float) -> None:
    """In the last second more of the front comes into view, so the center seems to move forward."""
    t = np.arange(0.0, 5.0, 1 / rate_hz)
    off = []
    for seed in range(6):
        forward = 0.5 * np.clip(t - 4.0, 0.0, 1.0)
        xy = np.column_stack([8.0 * t + forward, 0 * t]) + np.random.default_rng(seed).normal(0, 0.05, (len(t), 2))
        covariance = np.tile(0.2**2 * np.eye(2), (len(t), 1, 1))
        off.append(np.abs(np.hypot(*smooth_track(t, xy, covariance=covariance).velocity_mps.T) - 8.0).max())
    # Without usual accelerations it is 0.47 and 0.64 m/s.
    assert np.median(off) < {2.0: 0.44, 10.0: 0.625}[rate_hz]


def test_sigma_grows_beyond_both_ends_as_vehicles_move() -> None:
    """A calm motion says little about what came before and after it."""
    t = DT * np.arange(40)
    asked = np.arange(-1.0, 5.0, DT)
    noisy = straight(t) + np.random.default_rng(0).normal(0, 0.05, (40, 2))
    path = smooth_track(t, noisy, sigma_m=0.05, at_s=asked, motion=MotionModel(1e-3))
    sigma = np.sqrt(np.trace(path.covariance, axis1=1, axis2=2) / 2)
    assert np.all(np.diff(sigma[:10]) < 0)
    assert np.all(np.diff(sigma[-10:]) > 0)
    # White jerk alone: its density, times the fifth power of the time over 20.
    assert sigma[-1] ** 2 > 0.05 * (asked[-1] - t[-1]) ** 5 / 20
    assert sigma[len(sigma) // 2] < 0.05


@pytest.mark.parametrize("pulled_m", [0.6, 0.9])
@pytest.mark.matrix
@pytest.mark.parametrize("seed", range(3))
def test_what_comes_to_rest_does_not_turn_where_its_last_boxes_are_pulled_aside(pulled_m: float, seed: int) -> None:
    """Of a car that is hidden little by little, one corner is left, with which the center of its box seems to drive off."""
    t = np.arange(0.0, 4.7, DT)
    noisy = braked(t, 2.5) + np.random.default_rng(seed).normal(0, 0.02, (len(t), 2))
    noisy[-4:] += np.outer([0.25, 0.5, 0.75, 1.0], [pulled_m / 3, pulled_m])
    covariance = np.tile(0.17**2 * np.eye(2), (len(t), 1, 1))
    path = smooth_track(t, noisy, covariance=covariance, motion=MotionModel(heading_rad=0.0))
    assert np.abs(path.yaw_rad).max() < 0.05


@pytest.mark.parametrize("radius_m", [4.5, 6.0])
def test_a_slow_turn_as_tight_as_a_car_can_is_followed(radius_m: float) -> None:
    t = np.arange(0.0, 7.0, DT)
    truth = 2.0 * t / radius_m
    circle = radius_m * np.column_stack([np.sin(truth), 1 - np.cos(truth)])
    noisy = circle + np.random.default_rng(5).normal(0, 0.05, (len(t), 2))
    path = smooth_track(t, noisy, covariance=np.tile(0.1**2 * np.eye(2), (len(t), 1, 1)))
    assert np.abs(wrap_angle(path.yaw_rad - truth))[5:-5].max() < 0.15
    assert np.abs(wrap_angle(path.yaw_rad - truth)).max() < 0.3


def test_of_courses_too_different_for_the_way_between_them_the_surer_one_is_known() -> None:
    velocity = np.array([[4.0, 0.0], [3.0, 0.0], [1.5, 0.9], [0.0, 1.2], [-1.5, 0.0]])
    xy = np.array([[0.0, 0.0], [1.0, 0.0], [1.5, 0.0], [1.6, 0.0], [1.7, 0.0]])
    covariance = np.tile(0.1**2 * np.eye(2), (5, 1, 1))
    # 0.54 rad are too much for half a meter, a right angle is for 0.1 m; backward is no turn.
    found = course_is_known(xy, velocity, covariance, correlated=True)
    assert found.tolist() == [True, True, False, False, True]
    # As far from each other as that, or of unknown direction, all of them are.
    assert course_is_known(10 * xy, velocity, covariance, correlated=True)[:3].all()
    assert course_is_known(xy, velocity, 400 * covariance, correlated=True).all()
    assert course_is_known(xy, velocity, covariance, correlated=True, holonomic=True).all()


@pytest.mark.parametrize("density", [0.3, 1.0])
def test_drawn_motions_are_followed_as_well_as_is_possible(density: float) -> None:
    """No estimator passes the posterior Cramer-Rao bound on average; one that knows neither noise nor motion nears it."""
    ratio = maneuvers.drawn_error_m(density, 0.1, seeds=8) / maneuvers.cramer_rao_m(density, 0.1)
    assert 0.85 < ratio < 1.1


def test_maneuvers_are_followed_nearly_as_well_as_by_who_is_told_their_jerk() -> None:
    error_m, constant_m, following_m = maneuvers.maneuver_bounds("turn", 0.3, seeds=3)
    assert following_m < constant_m
    assert 0.8 * constant_m < error_m < 1.2 * following_m
