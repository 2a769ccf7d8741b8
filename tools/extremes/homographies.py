"""Extremes of the homography: what does not determine one, what lies at the horizon, what is mostly wrong."""

from __future__ import annotations

import numpy as np

from extremes.table import Outcome, case
from log2sim.geometry import Array, Camera, apply_homography, inverse, transform
from log2sim.perception.homography.correspondences import Correspondences
from log2sim.perception.homography.estimate import EstimationOptions, estimate_homography, fit_camera, place_obstacle
from log2sim.perception.homography.fit import HomographyFit

METHODS = ("time-aware", "min-frame", "per-frame")
PROBES_M = np.array([[x, y] for x in (8.0, 15.0, 30.0) for y in (-0.3 * x, 0.0, 0.3 * x)])


def true_homography() -> tuple[Camera, Array]:
    """A camera 1.6 m above the ground that looks down by 4 degrees, and its `ground_H_image` (3, 3)."""
    p = np.radians(4.0)
    rotation = np.array([[0, -np.sin(p), np.cos(p)], [-1, 0, 0], [0, -np.cos(p), -np.sin(p)]])
    k = np.array([[1000.0, 0.0, 640.0], [0.0, 1000.0, 360.0], [0.0, 0.0, 1.0]])
    ego_T_cam = transform(rotation, np.array([1.5, 0.2, 1.6]))
    image_H_ground = k @ inverse(ego_T_cam)[:3, [0, 1, 3]]
    return Camera("front", 1280, 720, k, "ego", ego_T_cam), np.linalg.inv(image_H_ground)


def seen_at(xy: Array) -> Array:
    """Exact pixels (N, 2) of ground positions (N, 2)."""
    q = np.column_stack([xy, np.ones(len(xy))]) @ np.linalg.inv(true_homography()[1]).T
    return q[:, :2] / q[:, 2:]


def spread(count: int, rng: np.random.Generator) -> Array:
    """Ground positions (N, 2) all over the view."""
    x = rng.uniform(7.0, 45.0, count)
    return np.column_stack([x, x * rng.uniform(-0.5, 0.5, count)])


def homography_error_m(fit: HomographyFit) -> float:
    """Largest distance on the ground at places up to 30 m away; infinite where one has no ground position."""
    places, below = apply_homography(fit.ground_H_image, seen_at(PROBES_M))
    return float(np.hypot(*(places - PROBES_M).T).max()) if below.all() else float("inf")


def fits_of(xy: Array, uv: Array, ticks: int = 10, noise_px: float = 0.5) -> list[HomographyFit]:
    """What every method makes of the same correspondences, whose pixels get noise."""
    rng = np.random.default_rng(0)
    noisy, tick = uv + rng.normal(0.0, noise_px, uv.shape), np.arange(len(xy)) * ticks // max(len(xy), 1)
    correspondences = Correspondences(noisy, xy, tick)
    return [
        estimate_homography(
            correspondences, EstimationOptions(m, sigma_px=1.0, sigma_m=0.02), rng=np.random.default_rng(1)
        )
        for m in METHODS
    ]


def all_refused(fits: list[HomographyFit]) -> Outcome:
    ok = all(not f.ok and f.reason and np.isnan(f.ground_H_image).all() for f in fits)
    condition = next((f.condition for f in fits if np.isfinite(f.condition)), None)
    return Outcome(
        ok, f"refused: {fits[0].reason}" if ok else f"called a success by {sum(f.ok for f in fits)} methods", condition
    )


def right_or_refused(fits: list[HomographyFit], within_m: float, *, refusable: bool) -> Outcome:
    """Every method is right within a distance; or, where that is allowed, says that it is not."""
    errors = [homography_error_m(f) for f in fits if f.ok]
    ok = (refusable or len(errors) == len(fits)) and all(e <= within_m for e in errors)
    refused = next((f.reason for f in fits if not f.ok), "")
    found = f"{len(errors)} of {len(fits)} methods right" if errors else f"refused: {refused}"
    conditions = [f.condition for f in fits if f.ok]
    return Outcome(ok, found if ok else f"wrong: {found}", max(conditions, default=None), max(errors, default=None))


@case("homography: 0 correspondences", "refused with a reason")
def no_correspondence() -> Outcome:
    return all_refused(fits_of(np.zeros((0, 2)), np.zeros((0, 2))))


@case("homography: 3 correspondences", "refused with a reason")
def three_correspondences() -> Outcome:
    xy = PROBES_M[[0, 4, 8]]
    return all_refused(fits_of(xy, seen_at(xy)))


@case("homography: 4 correspondences of one frame", "right")
def four_correspondences() -> Outcome:
    xy = PROBES_M[[0, 2, 6, 8]]
    return right_or_refused(fits_of(xy, seen_at(xy), ticks=1, noise_px=0.0), 1e-6, refusable=False)


@case("homography: collinear (cars of one lane)", "refused with a reason")
def collinear() -> Outcome:
    x = np.linspace(7.0, 45.0, 60)
    xy = np.column_stack([x, np.full(60, -1.75)])
    return all_refused(fits_of(xy, seen_at(xy)))


@case("homography: collinear but one", "refused with a reason")
def collinear_but_one() -> Outcome:
    x = np.linspace(7.0, 45.0, 60)
    xy = np.column_stack([x, np.r_[4.0, np.full(59, -1.75)]])
    return all_refused(fits_of(xy, seen_at(xy)))


@case("homography: collinear but for 0.2 m of noise", "right within 1 m or refused, never wrong and called a success")
def collinear_with_noise() -> Outcome:
    x, rng = np.linspace(7.0, 45.0, 200), np.random.default_rng(8)
    xy = np.column_stack([x, np.full(200, -1.75)])
    return right_or_refused(fits_of(xy + rng.normal(0.0, 0.2, xy.shape), seen_at(xy)), 1.0, refusable=True)


@case("homography: two lanes", "time-aware is right")
def two_lanes() -> Outcome:
    x = np.linspace(7.0, 45.0, 120)
    xy = np.column_stack([x, np.where(np.arange(120) % 2, -1.75, 1.75)])
    return right_or_refused(fits_of(xy, seen_at(xy))[:1], 0.2, refusable=False)


@case("homography: coincident (one parked car)", "refused with a reason")
def coincident() -> Outcome:
    xy = np.tile([[20.0, 3.0]], (60, 1))
    return all_refused(fits_of(xy, seen_at(xy)))


@case("homography: two parked cars", "refused with a reason")
def two_places() -> Outcome:
    xy = np.tile([[12.0, -3.0], [30.0, 4.0]], (30, 1))
    return all_refused(fits_of(xy, seen_at(xy)))


@case("homography: collinear obstacles, LiDAR ground beside them", "solved by the ground points, right")
def collinear_with_ground() -> Outcome:
    rng, x = np.random.default_rng(2), np.linspace(7.0, 45.0, 100)
    lane, ground = np.column_stack([x, np.full(100, -1.75)]), spread(400, rng)
    feet = Correspondences(seen_at(lane), lane, np.arange(100))
    points = Correspondences(seen_at(ground) + rng.normal(0, 0.5, ground.shape), ground, np.arange(400) // 4)
    fit, source = fit_camera(feet, points, EstimationOptions(), rng=rng)
    error = homography_error_m(fit) if fit.ok else None
    return Outcome(fit.ok and "ground" in source and error is not None and error < 0.15, source, fit.condition, error)


def with_outliers(share: float) -> list[HomographyFit]:
    rng = np.random.default_rng(3)
    xy = spread(600, rng)
    uv = seen_at(xy)
    wrong = rng.permutation(600) < round(share * 600)
    uv[wrong] = rng.uniform([0, 380], [1280, 720], (int(wrong.sum()), 2))
    return fits_of(xy, uv, ticks=60)


@case("homography: 60 % outliers", "time-aware is right")
def many_outliers() -> Outcome:
    return right_or_refused(with_outliers(0.60)[:1], 0.3, refusable=False)


@case("homography: 95 % outliers", "right or refused, never wrong and called a success")
def most_outliers() -> Outcome:
    return right_or_refused(with_outliers(0.95), 0.5, refusable=True)


@case("homography: NaN and inf among the correspondences", "right, they are not inliers")
def not_finite() -> Outcome:
    xy = spread(120, np.random.default_rng(4))
    uv = seen_at(xy)
    uv[::10, 0], xy[5::10, 1] = np.nan, np.inf
    fits = fits_of(xy, uv)
    outcome = right_or_refused(fits[:1], 0.15, refusable=False)
    inliers = fits[0].inliers[::10].any() or fits[0].inliers[5::10].any()
    return Outcome(outcome.ok and not inliers, outcome.found, outcome.condition, outcome.error)


@case("horizon: at and above it", "no ground position")
def horizon() -> Outcome:
    camera, h = true_homography()
    v = 360.0 - 1000.0 * np.tan(np.radians(4.0))
    uv = np.array([[640.0, v - d] for d in (0.01, 1.0, 100.0)])
    places, below = apply_homography(h, uv)
    located = place_obstacle(h, camera, np.array([600.0, 200.0, 680.0, v - 1.0]), "car", np.zeros(2))
    ok = not below.any() and np.isnan(places).all() and located is None
    return Outcome(bool(ok), "none" if ok else "a place above the horizon")


@case("horizon: a hundredth of a pixel below it", "finite and far, and no obstacle is placed there")
def near_horizon() -> Outcome:
    camera, h = true_homography()
    v = 360.0 - 1000.0 * np.tan(np.radians(4.0)) + 0.01
    place, below = apply_homography(h, np.array([[640.0, v]]))
    located = place_obstacle(h, camera, np.array([600.0, 200.0, 680.0, v]), "car", np.zeros(2))
    ok = bool(below[0] and np.isfinite(place).all() and place[0, 0] > 1e4 and located is None)
    return Outcome(ok, f"{place[0, 0]:.3g} m away, {'not placed' if located is None else 'placed'}")
