"""The table of extremes: named cases with the outcome that each must have. Tests and `stability.py` run the same ones.

A case says what it found and whether that is what is required; it never raises for a wrong outcome.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from log2sim.geometry import NS_PER_S, Array, PoseTrack, inverse, rotation_from_rpy, transform, wrap_angle, yaw_of
from log2sim.smooth import SmoothedTrack, signed_speed, smooth_track
from log2sim.topdown import Correspondences, HomographyFit, estimate_homography, fit_camera, locate
from log2sim.topdown.homography import apply_homography
from log2sim.track import track
from log2sim.types import Camera, Measurements

METHODS = ("time-aware", "min-frame", "per-frame")
PROBES_M = np.array([[x, y] for x in (8.0, 15.0, 30.0) for y in (-0.3 * x, 0.0, 0.3 * x)])
FAR_M = np.array([691_000.0, 5_334_000.0])


@dataclass(frozen=True)
class Outcome:
    """What a case found: whether it is as required, in words, and the condition number and error where there are any."""

    ok: bool
    found: str
    condition: float | None = None
    error: float | None = None
    unit: str = "m"


@dataclass(frozen=True)
class Case:
    """A named extreme, what is required of it, and how to run it."""

    name: str
    required: str
    run: Callable[[], Outcome]


CASES: list[Case] = []


def case(name: str, required: str) -> Callable[[Callable[[], Outcome]], Callable[[], Outcome]]:
    """Put a function into the table."""

    def add(run: Callable[[], Outcome]) -> Callable[[], Outcome]:
        CASES.append(Case(name, required, run))
        return run

    return add


# --- the homography


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
    return [
        estimate_homography(noisy, xy, tick, method=m, rng=np.random.default_rng(1), sigma_px=1.0, sigma_m=0.02)
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
    fit, source = fit_camera(feet, points, method="time-aware", rng=rng)
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
    fit = HomographyFit(True, "", h, np.ones(4, bool), 0.0, 5.0)
    located = locate(fit, camera, np.array([600.0, 200.0, 680.0, v - 1.0]), "car", np.zeros(2))
    ok = not below.any() and np.isnan(places).all() and located is None
    return Outcome(bool(ok), "none" if ok else "a place above the horizon")


@case("horizon: a hundredth of a pixel below it", "finite and far, and no obstacle is placed there")
def near_horizon() -> Outcome:
    camera, h = true_homography()
    v = 360.0 - 1000.0 * np.tan(np.radians(4.0)) + 0.01
    place, below = apply_homography(h, np.array([[640.0, v]]))
    fit = HomographyFit(True, "", h, np.ones(4, bool), 0.0, 5.0)
    located = locate(fit, camera, np.array([600.0, 200.0, 680.0, v]), "car", np.zeros(2))
    ok = bool(below[0] and np.isfinite(place).all() and place[0, 0] > 1e4 and located is None)
    return Outcome(ok, f"{place[0, 0]:.3g} m away, {'not placed' if located is None else 'placed'}")


# --- smoothing and poses


def smoothed_error_m(result: SmoothedTrack, truth: Array) -> float:
    return float(np.hypot(*(result.xy_m - truth).T).max())


def smoothing(t: Array, truth: Array, sigma_m: float, **options: float) -> SmoothedTrack:
    noise = np.random.default_rng(5).normal(0.0, sigma_m, truth.shape)
    return smooth_track(t, truth + noise, sigma_m=sigma_m, **options)


def straight(t: Array, speed_mps: float) -> Array:
    return np.column_stack([speed_mps * t, np.zeros(len(t))])


def judged(result: SmoothedTrack, truth: Array, within_m: float, found: str = "") -> Outcome:
    finite = all(np.isfinite(getattr(result, k)).all() for k in ("xy_m", "velocity_mps", "yaw_rad", "covariance"))
    error = smoothed_error_m(result, truth)
    return Outcome(
        bool(finite and error <= within_m), found or ("finite, near" if finite else "not finite"), None, error
    )


@case("smoothing: stamps 1 us apart", "finite and within 3 sigma")
def microsecond() -> Outcome:
    t = np.sort(np.r_[np.arange(50) * 0.1, np.arange(10, 40) * 0.1 + 1e-6])
    return judged(smoothing(t, straight(t, 10.0), 0.1), straight(t, 10.0), 0.3)


@case("smoothing: a gap of 10 s", "finite, near before and after, covariance says that it is a guess")
def gap() -> Outcome:
    t = np.r_[np.arange(30) * 0.1, 13.0 + np.arange(30) * 0.1]
    at = np.arange(0.0, 16.0, 0.1)
    noisy = straight(t, 10.0) + np.random.default_rng(5).normal(0.0, 0.1, (60, 2))
    result = smooth_track(t, noisy, sigma_m=0.1, at_s=at)
    sigma = np.sqrt(np.trace(result.covariance, axis1=1, axis2=2))
    away = np.hypot(*(result.xy_m - straight(at, 10.0)).T)
    seen = (at < 2.95) | (at > 12.95)
    ok = away[seen].max() < 0.3 and sigma[~seen].max() > 10 * sigma[seen].max() and (away <= 4 * sigma + 0.05).all()
    return Outcome(
        bool(ok),
        f"sigma {sigma[~seen].max():.2g} m in the gap, {sigma[seen].max():.2g} m outside",
        None,
        float(away[seen].max()),
    )


@case("smoothing: steps of 1 ms", "finite and within 3 sigma")
def milliseconds() -> Outcome:
    t = np.arange(1000) * 1e-3
    return judged(smoothing(t, straight(t, 10.0), 0.1), straight(t, 10.0), 0.3)


@case("smoothing: steps of 1 s", "finite and within 3 sigma")
def seconds() -> Outcome:
    t = np.arange(40.0)
    return judged(smoothing(t, straight(t, 10.0), 0.1), straight(t, 10.0), 0.3)


@case("smoothing: 60 m/s", "finite and within 3 sigma, speed within 1 m/s")
def fast() -> Outcome:
    t = np.arange(80) * 0.1
    result = smoothing(t, straight(t, 60.0), 0.1)
    outcome = judged(result, straight(t, 60.0), 0.3)
    off = float(np.abs(np.hypot(*result.velocity_mps.T)[5:-5] - 60.0).max())
    return Outcome(outcome.ok and off < 1.0, f"speed off by {off:.2g} m/s", None, outcome.error)


@case("smoothing: standstill", "stays within 3 sigma and its heading turns by less than a degree")
def standstill() -> Outcome:
    t = np.arange(80) * 0.1
    result = smoothing(t, np.zeros((80, 2)), 0.1, yaw_hint_rad=0.7)
    turned = float(np.rad2deg(np.abs(wrap_angle(result.yaw_rad - 0.7)).max()))
    outcome = judged(result, np.zeros((80, 2)), 0.3)
    return Outcome(outcome.ok and turned < 1.0, f"turns {turned:.2g} degrees", None, outcome.error)


@case("smoothing: reversing", "heading kept, speed negative")
def reversing() -> Outcome:
    t = np.arange(80) * 0.1
    truth = np.column_stack([np.where(t < 4.0, 3.0 * t, 12.0 - 3.0 * (t - 4.0)), np.zeros(80)])
    result = smoothing(t, truth, 0.05)
    away = float(np.rad2deg(np.abs(wrap_angle(result.yaw_rad)).max()))
    speed = signed_speed(result.velocity_mps, result.yaw_rad)
    ok = away < 15.0 and speed[:30].min() > 2.0 and speed[-30:].max() < -2.0
    return Outcome(bool(ok), f"speed {speed[-1]:.2g} m/s", None, away, "degrees")


@case("smoothing: yaw across +-pi", "runs on, in [-pi, pi), within 3 degrees")
def half_turn() -> Outcome:
    t = np.arange(120) * 0.1
    angle = 0.4 * t
    truth = 20.0 * np.column_stack([np.sin(angle), 1 - np.cos(angle)])
    result = smoothing(t, truth, 0.05)
    off = float(np.rad2deg(np.abs(wrap_angle(result.yaw_rad - angle))[3:-3].max()))
    inside = (result.yaw_rad >= -np.pi).all() and (result.yaw_rad < np.pi).all()
    return Outcome(bool(off < 3.0 and inside and angle[-1] > np.pi), "follows the turn", None, off, "degrees")


@case("smoothing: at UTM coordinates of 5e6 m", "as at the origin to 1e-6 m")
def smoothing_far() -> Outcome:
    t = np.arange(80) * 0.1
    xy = np.round(straight(t, 10.0) + np.random.default_rng(6).normal(0.0, 0.1, (80, 2)), 3)
    near, far = (smooth_track(t, xy + shift, sigma_m=0.1) for shift in (np.zeros(2), FAR_M))
    error = float(np.abs(far.xy_m - FAR_M - near.xy_m).max())
    return Outcome(error <= 1e-6, "the same", None, error)


@case("poses: yaw across +-pi", "interpolated along the shorter arc")
def pose_half_turn() -> Outcome:
    yaw = np.deg2rad([179.0, -179.0])
    poses = PoseTrack(np.array([0, 100_000_000]), transform(rotation_from_rpy(0.0, 0.0, yaw), np.zeros((2, 3))))
    error = float(np.rad2deg(abs(wrap_angle(yaw_of(poses.at([50_000_000])[0])[0] - np.pi))))
    return Outcome(error < 1e-9, "half way at 180 degrees", None, error, "degrees")


@case("poses: a gap of 10 s", "not bridged")
def pose_gap() -> Outcome:
    t_ns = np.r_[np.arange(5), 100 + np.arange(5)] * 100_000_000
    poses = PoseTrack(t_ns, np.tile(np.eye(4), (10, 1, 1)))
    known = poses.at([200_000_000, 5_000_000_000, 10_200_000_000])[1]
    return Outcome(known.tolist() == [True, False, True], "unknown in the gap" if not known[1] else "bridged")


# --- tracking


def measured(xy: Array, t_ns: int) -> Measurements:
    """Cars measured at places (M, 2), each with its number in the name of its camera, which tracking does not read."""
    n = len(xy)
    blank = {k: np.zeros((n, *v.shape[1:]), v.dtype) for k, v in vars(Measurements.empty()).items() if k != "cluster"}
    blank |= {
        "t_ns": np.full(n, t_ns, dtype=np.int64), "category": np.full(n, "car"), "score": np.full(n, 0.9),
        "camera": np.arange(n).astype("<U16"), "center_m": np.column_stack([xy, np.zeros(n)]),
        "size_m": np.tile([4.4, 1.8, 1.5], (n, 1)), "covariance": np.tile(0.01 * np.eye(2), (n, 1, 1)),
        "points": np.full(n, 50), "source": np.full(n, "lidar"),
    }  # fmt: skip
    return Measurements(**blank, cluster=(np.zeros((0, 3)),) * n)


def tracks_of(start: Array, velocity: Array, ticks_ns: Array) -> Outcome:
    """One track for each car (M, 2), with all its measurements."""
    ticks = np.asarray(ticks_ns, dtype=np.int64)
    rng = np.random.default_rng(7)
    found = [
        measured(start + velocity * ((t - ticks[0]) / NS_PER_S) + rng.normal(0, 0.05, start.shape), int(t))
        for t in ticks
    ]
    tracks = track(found, ticks, birth_score=0.4, max_gap_s=3.0, min_life_s=0.3)
    whole = sum(len(t) == len(ticks) and len(set(t.measurements.camera.tolist())) == 1 for t in tracks)
    lost = len(start) - whole
    return Outcome(
        len(tracks) == len(start) == whole,
        f"{len(tracks)} tracks, {whole} of them whole",
        None,
        float(lost),
        "cars lost",
    )


@case("tracking: 500 agents", "500 tracks, no identity lost")
def crowd() -> Outcome:
    x, y = np.meshgrid(np.arange(25) * 9.0, np.arange(20) * 6.0)
    start = np.column_stack([x.ravel(), y.ravel()])
    velocity = np.column_stack([np.where(np.arange(500) % 2, 8.0, -8.0), np.zeros(500)])
    velocity[:, 0] = np.where((y.ravel() / 6.0) % 2 == 0, 8.0, -8.0)
    return tracks_of(start, velocity, np.arange(8) * 100_000_000)


@case("tracking: stamps of 1.7e18 ns", "no identity lost")
def late_stamps() -> Outcome:
    return tracks_of(
        np.array([[0.0, 0.0], [0.0, 4.0]]),
        np.array([[10.0, 0.0], [-10.0, 0.0]]),
        1_700_000_000_000_000_000 + np.arange(20) * 100_000_000,
    )


@case("tracking: negative stamps, and zero among them", "no identity lost")
def negative_stamps() -> Outcome:
    return tracks_of(
        np.array([[0.0, 0.0], [0.0, 4.0]]), np.array([[10.0, 0.0], [-10.0, 0.0]]), (np.arange(20) - 10) * 100_000_000
    )


@case("tracking: one frame", "a track for each")
def one_frame_tracks() -> Outcome:
    return tracks_of(np.array([[0.0, 0.0], [0.0, 8.0]]), np.zeros((2, 2)), np.array([0]))


@case("tracking: a gap of 10 s", "a moving car is not bridged over it")
def tracking_gap() -> Outcome:
    ticks = np.r_[np.arange(20), 120 + np.arange(20)] * 100_000_000
    found = [measured(np.array([[10.0 * t / NS_PER_S, 0.0]]), int(t)) for t in ticks]
    tracks = track(found, ticks, birth_score=0.4, max_gap_s=3.0, min_life_s=0.3)
    return Outcome(len(tracks) == 2, f"{len(tracks)} tracks")


@case("tracking: empty frames", "no track, no error")
def empty_tracks() -> Outcome:
    ticks = np.arange(10) * 100_000_000
    tracks = track([Measurements.empty()] * 10, ticks, birth_score=0.4, max_gap_s=3.0, min_life_s=0.3)
    return Outcome(tracks == [], f"{len(tracks)} tracks")
