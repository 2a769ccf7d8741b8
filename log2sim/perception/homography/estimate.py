"""Image-to-ground homographies from correspondences of many ticks: by frame, best frame, time-aware RANSAC, calibrated.

A homography `ground_H_image` (3, 3) maps pixels (u, v, 1) to ground positions (x forward, y left) in m. It is scaled so
that its third row is a unit vector and gives a positive number below the horizon.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from log2sim.geometry import Array
from log2sim.perception.homography.pitch_roll import NOD_PX, fit_moving
from log2sim.perception.homography.ransac import EFFORT_OF_A_FRAME, EFFORTS, Efforts, Found, judge, search
from log2sim.perception.homography.refine import linearize
from log2sim.perception.homography.stream import BOUND, Stream, losses

METHODS = ("time-aware", "calibrated", "min-frame", "per-frame", "straw-man")
# Sizes of cars differ by about so much, and so does a range that is told from a size.
SIZE_SHARE = 0.1
# Intrinsics of a lens of 1e5 px have a condition of 1e5.
MOST_CONDITION = 1e12


@dataclass(frozen=True, eq=False)
class HomographyFit:
    """A homography and its health.

    `ok` False comes with a `reason` and NaN in `ground_H_image`. `inliers` (N,) bool of the final model, `error_m` their
    median distance on the ground, `condition` s1/s8 of the normalized design matrix of the inliers, `per_tick` (T, 3, 3)
    one homography a tick in the order of `ticks` (T,), where the method has them, NaN where a tick has none. `sigma_m` is
    the homography's own standard deviation, at one spread of the inliers from their middle.
    """

    ok: bool
    reason: str
    ground_H_image: Array
    inliers: NDArray[np.bool_]
    error_m: float
    condition: float
    ticks: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    per_tick: Array | None = None
    sigma_m: float = float("nan")


def estimate_homography(
    uv_px: ArrayLike,
    xy_m: ArrayLike,
    tick: ArrayLike,
    *,
    method: str = "time-aware",
    rng: np.random.Generator,
    K: ArrayLike | None = None,
    per_tick: bool = False,
    xy_by_size_m: ArrayLike | None = None,
    hypotheses: int | None = None,
    sigma_px: float = 1.5,
    sigma_m: float = 0.1,
) -> HomographyFit:
    """Estimate the homography of a camera stream.

    Parameters
    ----------
    uv_px : (N, 2) pixels, free of lens distortion
    xy_m : (N, 2) ground positions, x forward, y left, in a frame that moves with the camera
    tick : (N,) which frame each correspondence comes from
    method : "time-aware", "calibrated", "min-frame", "per-frame" or "straw-man"
    rng : numpy.random.Generator
    K : (3, 3) intrinsics in px, which "calibrated" needs
    per_tick : bool
        For cameras that pitch, with "time-aware" and "calibrated": pitch and roll of each tick on top of the stream's
        homography. "per-frame" and "straw-man" have one homography a tick in any case, "min-frame" never.
    xy_by_size_m : (N, 2) ground positions that average sizes tell (`ground_from_sizes`), which "straw-man" needs; its
        `error_m` is the distance to `xy_m` all the same
    hypotheses : int, optional
        Sets of four to draw, for the stream or for each frame; without it as many as the data need.
    sigma_px, sigma_m : float
        Standard deviations of the pixels and of the ground positions, as far as known: they are estimated anew from the
        inliers, within a factor of 4.

    Notes
    -----
    "per-frame" is a RANSAC for each frame, and "straw-man" (Bhardwaj & Kalra) the same with ground positions that average
    sizes tell instead of a LiDAR. "min-frame" is their answer: of all frames' homographies the one with the least error
    over all frames. "time-aware" draws one half of its hypotheses from single frames, where correspondences share the
    camera's momentary pose, the other half from all, scores each over all frames and obstacles with a bounded loss of the
    error in units of its expected size, and refines the best over all of its inliers.
    "calibrated" does the same over the six parameters of the pose of a camera whose intrinsics are known.
    """
    uv, xy, frame = np.asarray(uv_px, float), np.asarray(xy_m, float), np.asarray(tick)
    if uv.shape != xy.shape or uv.ndim != 2 or uv.shape[1] != 2 or frame.shape != (len(uv),):
        raise ValueError(f"uv_px and xy_m must be (N, 2) and tick (N,), got {uv.shape}, {xy.shape}, {frame.shape}")
    if method not in METHODS:
        raise ValueError(f"unknown method '{method}'; known: {', '.join(METHODS)}")
    intrinsics = np.zeros(0) if K is None else np.asarray(K, float)
    if method == "calibrated" and intrinsics.shape != (3, 3):
        raise ValueError(f"method 'calibrated' needs the intrinsics K (3, 3), got shape {intrinsics.shape}")
    measured = xy
    if method == "straw-man":
        xy = _sized(xy_by_size_m, uv.shape)
        sigma_m = max(sigma_m, SIZE_SHARE * _reach_m(xy))
    ticks, number = np.unique(frame, return_inverse=True)
    rows = np.flatnonzero(np.isfinite(uv[:, 0]) & np.isfinite(uv[:, 1]) & np.isfinite(xy[:, 0]) & np.isfinite(xy[:, 1]))
    if len(rows) < 4:
        return refused(f"{len(rows)} correspondences, at least 4 are needed", len(uv), ticks)
    rows = rows[np.argsort(number[rows], kind="stable")]
    present, dense = np.unique(number[rows], return_inverse=True)
    stream = Stream.of(uv[rows], xy[rows], dense, sigma_px, sigma_m)
    of_stream = method in ("time-aware", "calibrated")
    if of_stream:
        image_K = stream.image_N_px @ intrinsics if method == "calibrated" else None
        if image_K is not None and not (np.isfinite(intrinsics).all() and np.linalg.cond(intrinsics) < MOST_CONDITION):
            return refused("the intrinsics K are singular", len(uv), ticks)
        fit = _of_stream(stream, rng, image_K, _efforts(hypotheses, EFFORTS), per_tick=per_tick)
    else:
        fit = _of_frames(stream, rng, _efforts(hypotheses, EFFORT_OF_A_FRAME), keep_all=method != "min-frame")
    fit = _restored(fit, ticks, present, rows, len(uv), of_stream)
    if method == "straw-man" and fit.ok:
        away = np.hypot(*(apply_homography(fit.ground_H_image, uv)[0] - measured)[fit.inliers].T)
        fit = replace(fit, error_m=float(np.nanmedian(away)) if np.isfinite(away).any() else float("nan"))
    return fit


def _efforts(hypotheses: int | None, usual: Efforts) -> Efforts:
    """So many sets of four, of which an eighth is scored as usual, or the usual ones."""
    return usual if hypotheses is None else ((hypotheses, max(hypotheses // 8, 8), 0.0),)


def _restored(
    fit: HomographyFit,
    ticks: NDArray[Any],
    present: NDArray[np.int64],
    rows: NDArray[np.int64],
    count: int,
    of_stream: bool,
) -> HomographyFit:
    """A fit of some rows and ticks as one of all that were given."""
    inliers = np.zeros(count, dtype=bool)
    inliers[rows] = fit.inliers
    each = fit.per_tick
    if each is not None:
        # Where nothing was seen in a tick, what adds to the stream is as unknown as it is small.
        each = np.repeat((fit.ground_H_image if of_stream else np.full((3, 3), np.nan))[None], len(ticks), axis=0)
        each[present] = fit.per_tick
    return replace(fit, inliers=inliers, ticks=ticks, per_tick=each)


def _sized(xy_by_size_m: ArrayLike | None, shape: tuple[int, ...]) -> Array:
    """The straw man's ground positions (N, 2), checked."""
    if xy_by_size_m is None or np.shape(xy_by_size_m) != shape:
        raise ValueError("method 'straw-man' needs the ground positions by average sizes, xy_by_size_m (N, 2)")
    return np.asarray(xy_by_size_m, float)


def _reach_m(xy: Array) -> float:
    """Twice the spread of positions (N, 2), about the range of what a camera sees; the same wherever the origin is."""
    known = xy[np.isfinite(xy).all(axis=1)]
    return 2.0 * float(np.sqrt(known.var(axis=0).sum())) if len(known) else 0.0


def ground_from_sizes(uv_px: Array, height_px: Array, height_m: Array, K: Array, ego_T_cam: Array) -> Array:
    """Ground positions (N, 2) of feet (N, 2) from how high (N,) objects of average heights (N,) look: the straw man's ruler.

    `ego_T_cam` (4, 4) is where the camera stands and which way it looks.
    """
    depth = K[1, 1] * height_m / np.where(height_px > 0, height_px, np.nan)
    rays = np.column_stack([(uv_px - K[:2, 2]) / K[[0, 1], [0, 1]], np.ones(len(uv_px))])
    return np.asarray((rays * depth[:, None]) @ ego_T_cam[:2, :3].T + ego_T_cam[:2, 3])


def apply_homography(ground_H_image: Array, uv_px: ArrayLike) -> tuple[Array, NDArray[np.bool_]]:
    """Ground positions (N, 2) of pixels (N, 2) and whether they lie below the horizon (N,); NaN where not."""
    uv = np.asarray(uv_px, dtype=np.float64).reshape(-1, 2)
    q = uv @ ground_H_image[:, :2].T + ground_H_image[:, 2]
    below = q[:, 2] > 0
    return np.where(below[:, None], q[:, :2] / np.where(below, q[:, 2], 1.0)[:, None], np.nan), below


def jacobian(ground_H_image: Array, uv_px: ArrayLike) -> Array:
    """How far the ground position moves per pixel (N, 2, 2), m/px; grows without bound toward the horizon."""
    uv = np.asarray(uv_px, dtype=np.float64).reshape(-1, 2)
    q = uv @ ground_H_image[:, :2].T + ground_H_image[:, 2]
    xy = q[:, :2] / q[:, 2:]
    return (ground_H_image[None, :2, :2] - xy[:, :, None] * ground_H_image[None, 2:, :2]) / q[:, 2, None, None]


def refused(reason: str, count: int, ticks: NDArray[Any] | None = None) -> HomographyFit:
    """A fit that is none, with the reason."""
    ticks = np.zeros(0, dtype=np.int64) if ticks is None else ticks
    none = np.full((3, 3), np.nan)
    return HomographyFit(False, reason, none, np.zeros(count, dtype=bool), float("nan"), float("inf"), ticks)


def _of_stream(
    stream: Stream, rng: np.random.Generator, image_K: Array | None, efforts: Efforts, *, per_tick: bool
) -> HomographyFit:
    """One homography over all ticks, and where asked what each tick adds to it."""
    nod = NOD_PX * stream.image_N_px[0, 0] if per_tick else 0.0
    found = search(stream, rng, nod=nod, image_K=image_K, efforts=efforts)
    if found.h is None:
        return refused("every sample of four is collinear or coincident", stream.image.shape[1])
    if not per_tick:
        return _fit(found, image_K)
    moving = fit_moving(stream, found.h, image_K)
    warps = moving.warps[stream.tick]
    fit = _fit(Found(moving.image_H_ground, moving.stream, moving.at, warps, moving.spent), image_K)
    if not fit.ok:
        return fit
    return replace(fit, per_tick=stream.to_ground_H_image(moving.warps @ moving.image_H_ground))


def _of_frames(stream: Stream, rng: np.random.Generator, efforts: Efforts, *, keep_all: bool) -> HomographyFit:
    """One RANSAC for each frame; then the one with the least error over all frames."""
    each = np.full((len(stream.start), 3, 3), np.nan)
    found: list[Array] = []
    for k, (start, count) in enumerate(zip(stream.start, stream.count)):
        if count < 4:
            continue
        own = search(stream.take(slice(start, start + count)), rng, efforts=efforts)
        fit = _fit(own, None)
        if fit.ok and own.h is not None:
            each[k] = fit.ground_H_image
            found.append(own.h)
    if not found:
        return refused("no frame has correspondences that determine a homography", stream.image.shape[1])
    best = found[int(np.argmin(losses(stream, np.array(found))))]
    fit = _fit(Found(best, stream, linearize(stream, best[None])), None)
    return replace(fit, per_tick=each if keep_all and fit.ok else None)


def _fit(found: Found, image_K: Array | None) -> HomographyFit:
    """The fit with its health, in px and m."""
    stream, count = found.stream, found.stream.image.shape[1]
    if found.h is None or found.at is None:
        return refused("every sample of four is collinear or coincident", count)
    health = judge(stream, found.h, found.at, image_K, found.spent)
    if not health.ok:
        return refused(health.reason, count)
    inliers = found.at.squared[0] < BOUND
    ground_H_image = stream.to_ground_H_image(found.h)
    seen = np.vstack([stream.image, np.ones((1, count))])
    if found.warps is not None:
        seen = np.linalg.solve(found.warps, seen.T[:, :, None])[:, :, 0].T
    back = np.linalg.inv(found.h) @ seen
    error = np.hypot(*(back[:2] / back[2] - stream.ground[:2])[:, inliers]) / stream.ground_N_m[0, 0]
    return HomographyFit(
        True, "", ground_H_image, inliers, float(np.median(error)), health.condition, sigma_m=health.sigma_m
    )
