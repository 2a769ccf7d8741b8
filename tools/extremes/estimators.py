"""Extremes of single estimators: homographies that little determines, times and motions at the ends of what there is.

What `tests/test_homography.py`, `test_smooth.py`, `test_track.py` and `test_geometry.py` claim of them is not said again here.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from extremes.table import FAR_M, Outcome, case
from log2sim.agents.smooth.smoother import smooth_track
from log2sim.datatypes import Detections, Measurements
from log2sim.geometry import NS_PER_S, Array, Camera, apply_homography, inverse, transform
from log2sim.perception.homography.correspondences import Correspondences
from log2sim.perception.homography.estimate import EstimationOptions, estimate_homography, fit_camera
from log2sim.perception.homography.fit import HomographyFit
from log2sim.perception.homography.place import place_obstacle
from log2sim.tracking.tracker import track

METHODS = ("time-aware", "min-frame", "per-frame")
PROBES_M = np.array([[x, y] for x in (8.0, 15.0, 30.0) for y in (-0.3 * x, 0.0, 0.3 * x)])
LANE_M = np.column_stack([np.linspace(7.0, 45.0, 60), np.full(60, -1.75)])


def true_homography() -> tuple[Camera, Array]:
    """A camera 1.6 m above the ground that looks down by 4 degrees, and its `ground_H_image` (3, 3)."""
    p = np.radians(4.0)
    rotation = np.array([[0, -np.sin(p), np.cos(p)], [-1, 0, 0], [0, -np.cos(p), -np.sin(p)]])
    k = np.array([[1000.0, 0.0, 640.0], [0.0, 1000.0, 360.0], [0.0, 0.0, 1.0]])
    ego_T_cam = transform(rotation, np.array([1.5, 0.2, 1.6]))
    return Camera("front", 1280, 720, k, "ego", ego_T_cam), np.linalg.inv(k @ inverse(ego_T_cam)[:3, [0, 1, 3]])


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


def fits_of(xy: Array, uv: Array | None = None, ticks: int = 10, noise_px: float = 0.5) -> list[HomographyFit]:
    """What every method makes of the same correspondences, whose pixels get noise."""
    uv, rng = seen_at(xy) if uv is None else uv, np.random.default_rng(0)
    noisy, tick = uv + rng.normal(0.0, noise_px, uv.shape), np.arange(len(xy)) * ticks // max(len(xy), 1)
    options = [EstimationOptions(m, sigma_px=1.0, sigma_m=0.02) for m in METHODS]
    return [estimate_homography(Correspondences(noisy, xy, tick), o, rng=np.random.default_rng(1)) for o in options]


def right_or_refused(fits: list[HomographyFit], within_m: float, *, refusable: bool) -> Outcome:
    """Every method is right within a distance; or, where that is allowed, says that it is not."""
    errors = [homography_error_m(f) for f in fits if f.ok]
    ok = (refusable or len(errors) == len(fits)) and all(e <= within_m for e in errors)
    refused = next((f.reason for f in fits if not f.ok), "")
    found = f"{len(errors)} of {len(fits)} methods right" if errors else f"refused: {refused}"
    conditions = [f.condition for f in fits if f.ok]
    return Outcome(ok, found if ok else f"wrong: {found}", max(conditions, default=None), max(errors, default=None))


UNDETERMINED = {
    "0 correspondences": np.zeros((0, 2)),
    "3 correspondences": PROBES_M[[0, 4, 8]],
    "collinear (cars of one lane)": LANE_M,
    "collinear but one": np.concatenate([[[7.0, 4.0]], LANE_M[1:]]),
    "coincident (one parked car)": np.tile([[20.0, 3.0]], (60, 1)),
    "two parked cars": np.tile([[12.0, -3.0], [30.0, 4.0]], (30, 1)),
}


def refused_by_all(xy: Array) -> Outcome:
    fits = fits_of(xy)
    ok = all(not f.ok and f.reason and np.isnan(f.ground_H_image).all() for f in fits)
    condition = next((f.condition for f in fits if np.isfinite(f.condition)), None)
    return Outcome(ok, f"refused: {fits[0].reason}" if ok else "called a success", condition)


for _name, _xy in UNDETERMINED.items():
    case(f"homography: {_name}", "refused with a reason")(lambda xy=_xy: refused_by_all(xy))


@case("homography: 4 correspondences of one frame", "right")
def four_correspondences() -> Outcome:
    return right_or_refused(fits_of(PROBES_M[[0, 2, 6, 8]], ticks=1, noise_px=0.0), 1e-6, refusable=False)


@case("homography: collinear but for 0.2 m of noise", "right within 1 m or refused, never wrong and called a success")
def collinear_with_noise() -> Outcome:
    xy = np.column_stack([np.linspace(7.0, 45.0, 200), np.full(200, -1.75)])
    noise = np.random.default_rng(8).normal(0.0, 0.2, xy.shape)
    return right_or_refused(fits_of(xy + noise, seen_at(xy)), 1.0, refusable=True)


@case("homography: two lanes", "time-aware is right")
def two_lanes() -> Outcome:
    xy = np.column_stack([np.linspace(7.0, 45.0, 120), np.where(np.arange(120) % 2, -1.75, 1.75)])
    return right_or_refused(fits_of(xy)[:1], 0.2, refusable=False)


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
    uv, wrong = seen_at(xy), rng.permutation(600) < round(share * 600)
    uv[wrong] = rng.uniform([0, 380], [1280, 720], (int(wrong.sum()), 2))
    return fits_of(xy, uv, ticks=60)


@case("homography: 60 % outliers", "time-aware is right")
def many_outliers() -> Outcome:
    return right_or_refused(with_outliers(0.60)[:1], 0.3, refusable=False)


@case("homography: 95 % outliers", "right or refused, never wrong and called a success")
def most_outliers() -> Outcome:
    return right_or_refused(with_outliers(0.95), 0.5, refusable=True)


@case(
    "horizon: at, above and a hundredth of a pixel below it",
    "no ground position; finite and far; no obstacle is placed",
)
def horizon() -> Outcome:
    camera, h = true_homography()
    v = 360.0 - 1000.0 * np.tan(np.radians(4.0))
    places, below = apply_homography(h, np.array([[640.0, v - d] for d in (-0.01, 0.01, 1.0, 100.0)]))
    placed = [
        place_obstacle(h, camera, np.array([600.0, 200.0, 680.0, b]), "car", camera.mount_T_cam)
        for b in (v - 1, v + 0.01)
    ]
    ok = below.tolist() == [True, False, False, False] and np.isnan(places[1:]).all() and places[0, 0] > 1e4
    return Outcome(bool(ok) and placed == [None, None], f"{places[0, 0]:.3g} m away")


# --- motion


@case("smoothing: stamps 1 us apart", "finite and within 3 sigma")
def microsecond() -> Outcome:
    t = np.sort(np.r_[np.arange(50) * 0.1, np.arange(10, 40) * 0.1 + 1e-6])
    truth = np.column_stack([10.0 * t, 0 * t])
    result = smooth_track(t, truth + np.random.default_rng(5).normal(0.0, 0.1, truth.shape), sigma_m=0.1)
    finite = all(np.isfinite(getattr(result, k)).all() for k in ("xy_m", "velocity_mps", "yaw_rad", "covariance"))
    error = float(np.hypot(*(result.xy_m - truth).T).max())
    return Outcome(finite and error <= 0.3, "finite, near" if finite else "not finite", None, error)


@case("smoothing: at UTM coordinates of 5e6 m", "as at the origin to 1e-6 m")
def smoothing_far() -> Outcome:
    t = np.arange(80) * 0.1
    xy = np.round(np.column_stack([10.0 * t, 0 * t]) + np.random.default_rng(6).normal(0.0, 0.1, (80, 2)), 3)
    near, far = (smooth_track(t, xy + shift, sigma_m=0.1) for shift in (np.zeros(2), FAR_M))
    error = float(np.abs(far.xy_m - FAR_M - near.xy_m).max())
    return Outcome(error <= 1e-6, "the same", None, error)


def measured(xy: Array, t_ns: int) -> Measurements:
    """Cars measured at places (M, 2), each with its number in the name of its camera, which tracking does not read."""
    n = len(xy)
    detections = Detections(np.zeros((n, 4)), np.full(n, 0.9), np.full(n, "car"))
    rows = Measurements.unplaced(detections, t_ns=t_ns, camera="", sensor_m=np.zeros(3))
    return replace(
        rows, camera=np.arange(n).astype("<U16"), center_m=np.column_stack([xy, np.zeros(n)]), yaw_rad=np.zeros(n),
        covariance=np.tile(0.01 * np.eye(2), (n, 1, 1)), points=np.full(n, 50), source=np.full(n, "lidar"),
    )  # fmt: skip


def tracks_of(start: Array, velocity: Array, ticks_ns: Array) -> Outcome:
    """One track for each car (M, 2), with all its measurements."""
    ticks, rng = np.asarray(ticks_ns, dtype=np.int64), np.random.default_rng(7)
    places = [start + velocity * ((t - ticks[0]) / NS_PER_S) + rng.normal(0, 0.05, start.shape) for t in ticks]
    found = [measured(xy, int(t)) for xy, t in zip(places, ticks)]
    tracks = track(found, ticks, birth_score=0.4, max_gap_s=3.0, min_life_s=0.3)
    whole = sum(len(t) == len(ticks) and len(set(t.measurements.camera.tolist())) == 1 for t in tracks)
    words = f"{len(tracks)} tracks, {whole} of them whole"
    return Outcome(len(tracks) == len(start) == whole, words, None, float(len(start) - whole), "cars lost")


@case("tracking: 500 agents", "500 tracks, no identity lost")
def crowd() -> Outcome:
    x, y = np.meshgrid(np.arange(25) * 9.0, np.arange(20) * 6.0)
    velocity = np.column_stack([np.where((y.ravel() / 6.0) % 2 == 0, 8.0, -8.0), np.zeros(500)])
    return tracks_of(np.column_stack([x.ravel(), y.ravel()]), velocity, np.arange(8) * 100_000_000)


@case("tracking: stamps of 1.7e18 ns, negative ones, and one frame", "no identity lost")
def strange_stamps() -> Outcome:
    start, velocity, step = np.array([[0.0, 0.0], [0.0, 4.0]]), np.array([[10.0, 0.0], [-10.0, 0.0]]), 100_000_000
    late = tracks_of(start, velocity, 1_700_000_000_000_000_000 + np.arange(20) * step)
    early = tracks_of(start, velocity, (np.arange(20) - 10) * step)
    one = tracks_of(2 * start, 0 * velocity, np.array([0]))
    return next((outcome for outcome in (late, early, one) if not outcome.ok), late)


@case("tracking: a gap of 10 s", "a moving car is not bridged over it")
def tracking_gap() -> Outcome:
    ticks = np.r_[np.arange(20), 120 + np.arange(20)] * 100_000_000
    found = [measured(np.array([[10.0 * t / NS_PER_S, 0.0]]), int(t)) for t in ticks]
    tracks = track(found, ticks, birth_score=0.4, max_gap_s=3.0, min_life_s=0.3)
    return Outcome(len(tracks) == 2, f"{len(tracks)} tracks")
