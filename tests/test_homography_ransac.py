"""Parts of the homography estimators against closed forms and second methods, and what they reach on pitching cameras."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from log2sim.geometry import apply_homography, rotation_from_rpy
from log2sim.perception.homography.correspondences import Correspondences
from log2sim.perception.homography.estimate import EstimationOptions, estimate_homography
from log2sim.perception.homography.fit import HomographyFit, draw_samples, ground_covariances, solve_samples
from log2sim.perception.homography.normalized import (
    NormalizedCorrespondences,
    linearize,
    nearest_poses,
    noise_factors,
    scale_free_basis,
    squared_errors,
)

K = np.array([[2050.0, 0.0, 960.0], [0.0, 2050.0, 640.0], [0.0, 0.0, 1.0]])
HEIGHT_M = 2.1
AXES = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
NEAR_M, FAR_M = (6.0, 10.0, 15.0, 25.0), (30.0, 40.0, 50.0, 60.0)


def image_H_ground(pitch_deg: float = 2.0, roll_deg: float = 0.0) -> np.ndarray:
    """Flat ground to the image of a camera 2.1 m above it."""
    cam_R_ground = AXES @ rotation_from_rpy(np.radians(roll_deg), np.radians(pitch_deg), 0.0).T
    return K @ np.column_stack([cam_R_ground[:, :2], cam_R_ground @ [0.0, 0.0, -HEIGHT_M]])


def through(h: np.ndarray, points: np.ndarray) -> np.ndarray:
    q = points @ h[:, :2].T + h[:, 2]
    return q[:, :2] / q[:, 2:]


@dataclass
class PitchingStream:
    """A stream of box feet seen by a camera that may pitch and roll in each tick."""

    uv: np.ndarray
    xy: np.ndarray
    tick: np.ndarray
    clean: np.ndarray
    poses: np.ndarray

    def fit(self, method: str = "time-aware", seed: int = 0, **more: object) -> HomographyFit:
        by_size = more.pop("xy_by_size", None)
        correspondences = Correspondences(self.uv, self.xy, self.tick, by_size)  # type: ignore[arg-type]
        options = EstimationOptions(method, **{"K": K, **more})  # type: ignore[arg-type]
        return estimate_homography(correspondences, options, rng=np.random.default_rng(seed))

    def error_m(self, each: np.ndarray, ranges_m: tuple[float, ...]) -> float:
        """Median distance on the ground between what homographies of all ticks and the truth say of the same pixels."""
        ground = np.array([[x, y] for x in ranges_m for y in (-0.35 * x, 0.0, 0.35 * x) if abs(y) < 12])
        uv = through(image_H_ground(), ground)
        truth = [through(np.linalg.inv(h), uv) for h in self.poses]
        found = [through(h, uv) for h in np.broadcast_to(each, (len(self.poses), 3, 3))]
        return float(np.median(np.hypot(*np.moveaxis(np.array(found) - truth, -1, 0))))


def pitching_stream(
    seed: int, pitch_deg: float = 0.0, *, cars: int = 10, ticks: int = 40, noise_px: float = 1.0, outliers: float = 0.3
) -> PitchingStream:
    """Cars 6-60 m ahead, two feet each; in each tick the same number of outliers, half of them swapped, half too high."""
    rng = np.random.default_rng([seed, 77])
    x, y = rng.uniform(6.0, 60.0, (ticks, cars)), rng.uniform(-9.0, 9.0, (ticks, cars))
    y = np.clip(y, -0.42 * x, 0.42 * x)
    uv, xy, clean, poses = [], [], [], []
    for k in range(ticks):
        feet = np.concatenate([np.column_stack([x[k], y[k] + s]) for s in (0.9, -0.9)])
        poses.append(image_H_ground(2.0 + pitch_deg * rng.normal(), pitch_deg * rng.normal()))
        pixel = through(poses[-1], feet) + rng.normal(0.0, noise_px, feet.shape)
        ground = feet + rng.normal(0.0, 0.05, feet.shape)
        wrong = rng.permutation(2 * cars)[: round(2 * cars * outliers)]
        swapped, high = wrong[::2], wrong[1::2]
        ground[swapped] = np.roll(feet, 3, axis=0)[swapped] + rng.normal(0.0, 0.3, (len(swapped), 2))
        pixel[high, 1] -= rng.uniform(20.0, 150.0, len(high))
        uv.append(pixel)
        xy.append(ground)
        clean.append(~np.isin(np.arange(2 * cars), wrong))
    tick = np.repeat(np.arange(ticks), 2 * cars)
    return PitchingStream(np.concatenate(uv), np.concatenate(xy), tick, np.concatenate(clean), np.array(poses))


def make_stream(seed: int = 0, **changes: float) -> NormalizedCorrespondences:
    world = pitching_stream(seed, **changes)  # type: ignore[arg-type]
    return NormalizedCorrespondences.of(world.uv, world.xy, world.tick, 1.0, 0.05)


# The camera that pitches.


@pytest.mark.parametrize("method", ["time-aware", "calibrated"])
def test_a_camera_that_pitches_by_a_tenth_of_a_degree_is_followed(method: str) -> None:
    near, far, still = [], [], []
    for seed in range(4):
        world = pitching_stream(seed, 0.1)
        fit = world.fit(method, pitch_roll=True)
        assert fit.ok, fit.reason
        assert fit.per_tick is not None
        near.append(world.error_m(fit.per_tick, NEAR_M))
        own = np.concatenate([apply_homography(h, world.uv[world.tick == t])[0] for t, h in enumerate(fit.per_tick)])
        away = np.hypot(*(own - world.xy)[fit.inliers].T)
        assert fit.error_m == pytest.approx(np.median(away), rel=1e-3)
        far.append(world.error_m(fit.per_tick, FAR_M))
        still.append(world.error_m(fit.ground_H_image, FAR_M))
    assert np.median(near) < 0.02
    assert np.median(far) < 0.115
    assert min(still) > 0.4  # one homography cannot follow


@pytest.mark.parametrize("method", ["time-aware", "calibrated"])
def test_a_camera_that_stands_still_gets_one_homography_though_more_are_asked_for(method: str) -> None:
    world = pitching_stream(5)
    fit = world.fit(method, pitch_roll=True)
    assert fit.per_tick is not None
    assert fit.jitter_m < 1e-9
    assert world.error_m(fit.per_tick, FAR_M) < 0.06
    assert world.fit(method).per_tick is None


# Few correspondences, many outliers.


@pytest.mark.parametrize("method", ["time-aware", "calibrated"])
@pytest.mark.parametrize(("cars", "outliers"), [(3, 0.6), (2, 0.5), (10, 0.7)])
def test_many_outliers_are_overcome_even_where_no_frame_has_four_good_correspondences(
    cars: int, outliers: float, method: str
) -> None:
    for seed in range(4):
        world = pitching_stream(seed, cars=cars, outliers=outliers)
        fit = world.fit(method)
        assert fit.ok, fit.reason
        away = through(fit.ground_H_image, through(image_H_ground(), world.xy)) - world.xy
        assert np.median(np.hypot(*away[world.clean].T)) < 0.1
        assert (fit.inliers & ~world.clean).sum() <= 0.02 * len(world.tick)


def test_a_homography_knows_how_sure_it_is() -> None:
    ratios = []
    for seed in range(30):
        world = pitching_stream(seed, cars=4, ticks=10, outliers=0.2)
        fit = world.fit()
        middle, spread = world.xy[fit.inliers].mean(axis=0), world.xy[fit.inliers].std(axis=0)
        reach = float(np.sqrt((spread**2).sum() / 2))
        probes = middle + reach * np.array([[1.0, 0], [-1, 0], [0, 1], [0, -1]])
        away = through(fit.ground_H_image, through(image_H_ground(), probes)) - probes
        ratios.append(np.hypot(*away.T).max() / fit.sigma_m)
    assert 0.5 < np.sqrt(np.mean(np.square(ratios))) < 1.6


@pytest.mark.parametrize("pitch_deg", [0.0, 0.1], ids=["fixed", "pitching"])
@pytest.mark.parametrize("method", ["time-aware", "calibrated"])
def test_the_covariance_of_a_homography_is_that_of_its_errors_near_and_far(method: str, pitch_deg: float) -> None:
    ground = np.array([[x, y] for x in (*NEAR_M, *FAR_M) for y in (-0.3 * x, 0.3 * x)])
    uv, near = through(image_H_ground(), ground), ground[:, 0] <= NEAR_M[-1]
    nees = []
    for seed in range(16):
        world = pitching_stream(seed, pitch_deg, ticks=20)
        fit = world.fit(method, pitch_roll=pitch_deg > 0)
        for tick in range(0, 20, 3) if pitch_deg else [0]:
            h, covariance = fit.at_tick(tick), fit.covariance_at(tick)
            assert h is not None
            assert covariance is not None
            away = through(h, uv) - through(np.linalg.inv(world.poses[tick]), uv)
            each = np.linalg.solve(ground_covariances(h, covariance, uv), away[:, :, None])[:, :, 0]
            squared = (away * each).sum(axis=1) / 2
            nees.append((squared[near].mean(), squared[~near].mean()))
    assert ((np.mean(nees, axis=0) > 0.6) & (np.mean(nees, axis=0) < 1.6)).all()


@pytest.mark.parametrize(("outliers", "noise_px"), [(0.6, 0.5), (0.6, 2.0)])
def test_many_outliers_do_not_widen_the_covariance(outliers: float, noise_px: float) -> None:
    ground = np.array([[x, y] for x in (*NEAR_M, *FAR_M) for y in (-0.3 * x, 0.3 * x)])
    uv, nees = through(image_H_ground(), ground), []
    for seed in range(60):
        world = pitching_stream(seed, ticks=20, outliers=outliers, noise_px=noise_px)
        fit = world.fit()
        assert fit.covariance is not None
        away = through(fit.ground_H_image, uv) - ground
        each = np.linalg.solve(ground_covariances(fit.ground_H_image, fit.covariance, uv), away[:, :, None])
        nees.append((away * each[:, :, 0]).sum(axis=1).mean() / 2)
    assert 0.75 < np.mean(nees) < 1.3


# Calibrated.


def test_calibrated_beats_what_eight_parameters_allow() -> None:
    def limit(world: PitchingStream) -> np.ndarray:
        uv, xy = world.uv[world.clean], world.xy[world.clean]
        s = NormalizedCorrespondences.of(uv, xy, np.zeros(len(uv), dtype=np.int64), 1.0, 0.05)
        h = s.image_N_px @ image_H_ground() @ np.linalg.inv(s.ground_N_m)
        for _ in range(6):  # Gauss-Newton over the clean correspondences alone, from the truth
            at = linearize(s, h)
            whiten = np.linalg.cholesky(at.weight.transpose(2, 0, 1)).transpose(0, 2, 1)
            error, slope = at.projected - s.image, scale_free_basis(h).T @ at.slope.reshape(9, -1)
            slope, error = (np.einsum("nij,kjn->kin", whiten, a.reshape(-1, 2, len(whiten))) for a in (slope, error))
            step = np.linalg.lstsq(slope.reshape(8, -1).T, -error.ravel(), rcond=None)[0]
            h = h + (scale_free_basis(h) @ step).reshape(3, 3)
        return s.to_ground_H_image(h)

    ours, eight = [], []
    for seed in range(10):
        world = pitching_stream(seed, cars=3, ticks=20)
        fit = world.fit("calibrated")
        assert fit.ok
        ours.append(world.error_m(fit.ground_H_image, NEAR_M))
        eight.append(world.error_m(limit(world), NEAR_M))
    assert np.mean(ours) < 0.85 * np.mean(eight)


def test_nearest_pose_is_the_polar_part() -> None:
    rng = np.random.default_rng(0)
    h = rng.normal(size=(20, 3, 3))
    for found, given in zip(nearest_poses(K, h), h):
        m = np.linalg.inv(K) @ given
        u, s, vt = np.linalg.svd(m[:, :2], full_matrices=False)
        expected = K @ np.column_stack([u @ vt, m[:, 2] / s.mean()])
        np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-6)
    assert np.isnan(nearest_poses(K, np.ones((1, 3, 3)))).any()


# Parts.


@pytest.mark.parametrize("across_ticks", [False, True])
def test_hypotheses_see_their_own_points_in_front_and_exactly(across_ticks: bool) -> None:
    stream = make_stream(outliers=0.3)
    rows = draw_samples(stream, np.random.default_rng(2), 300, across_ticks=across_ticks)
    solved = [solve_samples(stream, quad[:, None], max_hypotheses=5) for quad in rows.T]
    assert sum(map(len, solved)) > 100
    for quad, found in zip(rows.T, solved):
        for h in found:
            q = h @ stream.ground[:, quad]
            assert (q[2] > 0).all()
            np.testing.assert_allclose(q[:2] / q[2], stream.image[:, quad], atol=1e-6)


def test_squared_errors_are_those_of_the_definition() -> None:
    stream = make_stream(3)
    h = stream.image_N_px @ image_H_ground(2.05, 0.1) @ np.linalg.inv(stream.ground_N_m)
    ours = squared_errors(stream.products, stream.sigma_image, stream.sigma_ground, np.stack([h, -h]))
    for k in range(0, 800, 37):
        (u, v), p = stream.image[:, k], stream.ground[:, k]
        q = h @ p
        equations = np.array([u * q[2] - q[0], v * q[2] - q[1]])
        by_ground = np.outer([u, v], h[2, :2]) - h[:2, :2]
        spread = q[2] ** 2 * stream.sigma_image**2 * np.eye(2)
        spread += stream.sigma_ground**2 * by_ground @ by_ground.T
        assert ours[0, k] == pytest.approx(equations @ np.linalg.solve(spread, equations), rel=1e-6)
    assert np.isinf(ours[1]).all()  # everything behind the camera


def test_derivatives_of_errors_are_those_of_differences() -> None:
    stream = make_stream(4)
    h = stream.image_N_px @ image_H_ground() @ np.linalg.inv(stream.ground_N_m)
    at = linearize(stream, h)
    step = 1e-7
    for k in range(9):
        aside = np.eye(9)[k].reshape(3, 3) * step
        a, b = (linearize(stream, g).projected for g in (h + aside, h - aside))
        np.testing.assert_allclose(at.slope[k], (a - b) / (2 * step), rtol=1e-4, atol=1e-4)


def test_single_precision_takes_no_error_for_negative() -> None:
    # Homographies that fold the ground to a line leave covariances whose determinant is rounding.
    stream, rng = make_stream(3), np.random.default_rng(0)
    folding = rng.normal(size=(300, 3, 1)) * rng.normal(size=(300, 1, 3)) + 1e-4 * rng.normal(size=(300, 3, 3))
    single, double = (
        squared_errors(stream.products.astype(kind), 1e-4, 0.1, folding) for kind in (np.float32, np.float64)
    )
    assert single.dtype == np.float32
    assert single.min() >= 0
    assert double.min() >= 0


def test_normal_equations_are_the_sums_over_the_rows() -> None:
    stream = make_stream(4)
    h = stream.image_N_px @ image_H_ground() @ np.linalg.inv(stream.ground_N_m)
    at, share = linearize(stream, h), np.random.default_rng(0).random(len(stream.tick))
    by_row, error = at.slope.transpose(2, 1, 0), (at.projected - stream.image).T
    weighted = share[:, None, None] * at.weight.transpose(2, 0, 1)
    normal, right = at.normal_equations(share)
    np.testing.assert_allclose(normal, (by_row.swapaxes(1, 2) @ weighted @ by_row).sum(axis=0), rtol=1e-9, atol=1e-6)
    expected = (by_row.swapaxes(1, 2) @ weighted @ error[:, :, None]).sum(axis=0)[:, 0]
    np.testing.assert_allclose(right, expected, rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(at.squared, np.einsum("ni,nij,nj->n", error, at.weight.transpose(2, 0, 1), error))


@pytest.mark.parametrize(("pixel", "place"), [(1.0, 1.0), (2.0, 0.5), (0.5, 2.0), (0.7, 0.7)])
def test_noise_is_found_from_the_errors(pixel: float, place: float) -> None:
    world = pitching_stream(6, outliers=0.0)
    stream = NormalizedCorrespondences.of(world.uv, world.xy, world.tick, 1.0 / pixel, 0.05 / place)
    h = stream.image_N_px @ image_H_ground() @ np.linalg.inv(stream.ground_N_m)
    for _ in range(6):
        stream = stream.scale_noise(*noise_factors(linearize(stream, h), 0))
    believed = stream.sigma_image / stream.image_N_px[0, 0], stream.sigma_ground / stream.ground_N_m[0, 0]
    assert believed == pytest.approx((1.0, 0.05), rel=0.12)


# The straw man.


def test_the_straw_man_is_as_good_as_its_sizes_and_says_how_far_off_it_is() -> None:
    world = pitching_stream(8, outliers=0.0)
    right = world.fit("straw-man", xy_by_size=world.xy)
    assert world.error_m(right.ground_H_image, NEAR_M) < 0.5
    wrong = world.fit("straw-man", xy_by_size=1.15 * world.xy)
    assert wrong.ok
    assert wrong.per_tick is not None
    away = np.median(np.hypot(*(0.15 * world.xy).T))
    assert wrong.error_m == pytest.approx(away, rel=0.2)
    assert world.fit("time-aware").error_m < 0.02 * wrong.error_m * 5
    with pytest.raises(ValueError, match="average sizes"):
        world.fit("straw-man")


# Extremes.


@pytest.mark.parametrize("pitch_roll", [False, True])
@pytest.mark.parametrize("method", ["time-aware", "calibrated"])
def test_a_line_a_place_and_a_tick_alone_are_refused_or_right(method: str, pitch_roll: bool) -> None:
    x = np.linspace(8.0, 50.0, 60)
    tick = np.arange(60) // 6
    rng = np.random.default_rng(0)
    for xy in (np.column_stack([x, 0.2 * x + 1]), np.column_stack([x, 0 * x]), np.tile([[20.0, 1.0]], (60, 1))):
        for noise_px in (0.0, 1.0):
            uv = through(image_H_ground(), xy) + rng.normal(0.0, noise_px, (60, 2))
            fit = PitchingStream(uv, xy, tick, np.ones(60, bool), np.empty(0)).fit(method, pitch_roll=pitch_roll)
            assert not fit.ok
            assert len(fit.reason) > 20
    alone = pitching_stream(2, ticks=1, outliers=0.2)
    fit = alone.fit(method, pitch_roll=pitch_roll)
    assert fit.ok, fit.reason
    assert alone.error_m(fit.ground_H_image, NEAR_M) < 0.5
