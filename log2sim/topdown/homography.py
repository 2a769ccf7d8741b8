"""Image-to-ground homographies from correspondences of many ticks: per frame, best frame, or time-aware RANSAC.

A homography `ground_H_image` (3, 3) maps pixels (u, v, 1) to ground positions (x forward, y left) in m. It is scaled so
that its third row gives a positive number below the horizon.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from log2sim.geometry import Array

METHODS = ("time-aware", "min-frame", "per-frame")
HYPOTHESES = 300
HYPOTHESES_A_FRAME = 60
SAMPLED_TRIES = 4
# Bounded loss: an error of more than 3 sigma in both directions counts no further (chi-squared, 2 degrees, 99 %).
BOUND = 9.21
REFINE_ROUNDS = 10
# Normalized DLT: s8/s1 is about 0.3 for spread points and 1e-17 for collinear ones; near 1 in s8/s9 is noise.
LEAST_S8_S1 = 2e-3
LEAST_S8_S9 = 3.0
LEAST_INLIERS = 6
LEAST_SHARE = 0.2


@dataclass(frozen=True, eq=False)
class HomographyFit:
    """A homography and its health.

    `ok` False comes with a `reason` and NaN in `ground_H_image`. `inliers` (N,) bool of the final model, `error_m` their
    median distance on the ground, `condition` s1/s8 of the normalized design matrix of the inliers, `per_tick` (T, 3, 3)
    one homography a tick in the order of `ticks` (T,), where the method has them, NaN where a tick has none.
    """

    ok: bool
    reason: str
    ground_H_image: Array
    inliers: NDArray[np.bool_]
    error_m: float
    condition: float
    ticks: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    per_tick: Array | None = None


def estimate_homography(
    uv_px: ArrayLike,
    xy_m: ArrayLike,
    tick: ArrayLike,
    *,
    method: str = "time-aware",
    rng: np.random.Generator,
    sigma_px: float = 1.5,
    sigma_m: float = 0.1,
) -> HomographyFit:
    """Estimate the homography of a camera stream.

    Parameters
    ----------
    uv_px : (N, 2) pixels, free of lens distortion
    xy_m : (N, 2) ground positions, x forward, y left, in a frame that moves with the camera
    tick : (N,) which frame each correspondence comes from
    method : "time-aware", "min-frame" or "per-frame"
    rng : numpy.random.Generator
    sigma_px, sigma_m : float
        Standard deviations of the pixels and of the ground positions.

    Notes
    -----
    "per-frame" is the straw man of Bhardwaj & Kalra, a RANSAC for each frame, and "min-frame" their answer: of all frames'
    homographies the one with the least error over all frames. "time-aware" draws its hypotheses from single frames, where
    correspondences share the camera's momentary pose, scores each over all frames and obstacles with a bounded loss of the
    error on the ground in units of its expected size at that range, and refines the best over all of its inliers.
    """
    uv, xy, frame = np.asarray(uv_px, float), np.asarray(xy_m, float), np.asarray(tick)
    if uv.shape != xy.shape or uv.ndim != 2 or uv.shape[1] != 2 or frame.shape != (len(uv),):
        raise ValueError(f"uv_px and xy_m must be (N, 2) and tick (N,), got {uv.shape}, {xy.shape}, {frame.shape}")
    if method not in METHODS:
        raise ValueError(f"unknown method '{method}'; known: {', '.join(METHODS)}")
    finite = np.isfinite(uv).all(axis=1) & np.isfinite(xy).all(axis=1)
    ticks = np.unique(frame)
    if finite.sum() < 4:
        return refused(f"{int(finite.sum())} correspondences, at least 4 are needed", len(uv), ticks)
    problem = _Problem.of(uv[finite], xy[finite], frame[finite], sigma_px, sigma_m)
    if method == "time-aware":
        fit = problem.time_aware(rng)
    else:
        fit = problem.by_frames(rng, ticks, keep_all=method == "per-frame")
    inliers = np.zeros(len(uv), dtype=bool)
    inliers[np.flatnonzero(finite)[fit.inliers]] = True
    return HomographyFit(
        fit.ok, fit.reason, fit.ground_H_image, inliers, fit.error_m, fit.condition, ticks, fit.per_tick
    )


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


@dataclass(frozen=True, eq=False)
class _Problem:
    """Correspondences in units in which both sides have mean 0 and spread 1 (Hartley, 1997)."""

    uv: Array
    xy: Array
    frame: NDArray[Any]
    sigma_uv: float
    sigma_xy: float
    uv_N_px: Array
    xy_N_m: Array

    @classmethod
    def of(cls, uv: Array, xy: Array, frame: NDArray[Any], sigma_px: float, sigma_m: float) -> _Problem:
        uv_n, xy_n = _normalization(uv), _normalization(xy)
        return cls(
            uv * uv_n[0, 0] + uv_n[:2, 2],
            xy * xy_n[0, 0] + xy_n[:2, 2],
            frame,
            sigma_px * uv_n[0, 0],
            sigma_m * xy_n[0, 0],
            uv_n,
            xy_n,
        )

    def time_aware(self, rng: np.random.Generator) -> HomographyFit:
        candidates = self._sample(rng, HYPOTHESES)
        return self._finish(candidates, np.ones(len(self.uv), dtype=bool))

    def by_frames(self, rng: np.random.Generator, ticks: NDArray[Any], *, keep_all: bool) -> HomographyFit:
        """One RANSAC for each frame; then the one with the least error over all frames."""
        each = np.full((len(ticks), 3, 3), np.nan)
        fits: list[HomographyFit] = []
        for k, t in enumerate(ticks):
            own = self.frame == t
            if own.sum() < 4:
                continue
            single = _Problem(
                self.uv[own], self.xy[own], self.frame[own], self.sigma_uv, self.sigma_xy, self.uv_N_px, self.xy_N_m
            )
            fit = single._finish(single._sample(rng, HYPOTHESES_A_FRAME), np.ones(int(own.sum()), dtype=bool))
            if fit.ok:
                each[k] = fit.ground_H_image
                fits.append(fit)
        if not fits:
            return refused("no frame has correspondences that determine a homography", len(self.uv), ticks)
        normalized = np.array([self.xy_N_m @ f.ground_H_image @ np.linalg.inv(self.uv_N_px) for f in fits])
        best = int(np.argmin(self._loss(normalized).mean(axis=1)))
        result = self._health(normalized[best])
        per_tick = each if keep_all else None
        return HomographyFit(
            result.ok,
            result.reason,
            result.ground_H_image,
            result.inliers,
            result.error_m,
            result.condition,
            ticks,
            per_tick,
        )

    def _sample(self, rng: np.random.Generator, count: int) -> Array:
        """Homographies (K, 3, 3) through four correspondences of one frame each, normalized units."""
        order = np.argsort(self.frame, kind="stable")
        _, start, size = np.unique(self.frame[order], return_index=True, return_counts=True)
        usable = size >= 4
        if not usable.any():  # no frame has four: the whole stream is one frame, for want of better
            start, size, usable = np.array([0]), np.array([len(order)]), np.array([True])
        share = size[usable] / size[usable].sum()
        drawn = rng.choice(np.flatnonzero(usable), size=count * SAMPLED_TRIES, p=share)
        picks = np.argsort(
            rng.random((len(drawn), int(size.max()))) + (np.arange(size.max()) >= size[drawn, None]), axis=1
        )
        rows = order[start[drawn, None] + picks[:, :4]]
        spread = _smallest_triangle(self.uv[rows]) * _smallest_triangle(self.xy[rows])
        rows = rows[np.argsort(-spread, kind="stable")[: count * 2]]
        rows = rows[_smallest_triangle(self.xy[rows]) > 1e-9]
        return _solve_minimal(self.uv[rows], self.xy[rows])

    def _finish(self, candidates: Array, use: NDArray[np.bool_]) -> HomographyFit:
        if len(candidates) == 0:
            return refused("every sample of four is collinear or coincident", len(self.uv))
        loss = self._loss(candidates).mean(axis=1)
        best, best_loss = candidates[int(np.argmin(loss))], float("inf")
        for k in np.argsort(loss, kind="stable")[:3]:
            refined = self._refine(candidates[k])
            value = float(self._loss(refined[None]).mean())
            if value < best_loss:
                best, best_loss = refined, value
        return self._health(best)

    def _whitened(self, h: Array) -> tuple[Array, Array]:
        """Errors (K, N, 2) on the ground and their expected variances (K, N, 2), along each axis, for (K, 3, 3)."""
        q = np.einsum("kij,nj->kni", h[:, :, :2], self.uv) + h[:, None, :, 2]
        w = q[..., 2:]
        safe = np.where(np.abs(w) > 1e-12, w, 1e-12)
        xy = q[..., :2] / safe
        slope = (h[:, None, :2, :2] - xy[..., None] * h[:, None, 2:, :2]) / safe[..., None]
        variance = self.sigma_xy**2 + self.sigma_uv**2 * (slope**2).sum(axis=-1)
        error = np.where(w > 0, xy - self.xy, np.inf)
        return error, variance

    def _loss(self, h: Array) -> Array:
        """Bounded squared errors (K, N) in units of their expected size."""
        error, variance = self._whitened(h)
        return np.minimum((error**2 / variance).sum(axis=-1), BOUND)

    def _refine(self, h: Array) -> Array:
        """Gauss-Newton over the inliers on the whitened ground error, eight parameters."""
        current, value = h / h[2, 2] if abs(h[2, 2]) > 1e-9 else h, np.inf
        for _ in range(REFINE_ROUNDS):
            error, variance = (a[0] for a in self._whitened(current[None]))
            squared = (error**2 / variance).sum(axis=-1)
            use = squared < BOUND
            if use.sum() < 4:
                break
            step = self._step(current, error[use], variance[use], use)
            if step is None:
                break
            proposed = current + step
            proposed_value = float(self._loss(proposed[None]).mean())
            if proposed_value >= value - 1e-9:
                break
            current, value = proposed, proposed_value
        return current

    def _step(self, h: Array, error: Array, variance: Array, use: NDArray[np.bool_]) -> Array | None:
        p = np.column_stack([self.uv[use], np.ones(int(use.sum()))])
        w = p @ h[2]
        xy = error + self.xy[use]
        rows = np.zeros((len(p), 2, 9))
        for axis in range(2):
            rows[:, axis, 3 * axis : 3 * axis + 3] = p / w[:, None]
            rows[:, axis, 6:] = -xy[:, axis, None] * p / w[:, None]
        scale = 1.0 / np.sqrt(variance)
        a = (rows * scale[..., None]).reshape(-1, 9)
        b = (error * scale).ravel()
        # The scale of a homography is free: steps are taken across it, never along it.
        direction = h.ravel() / np.linalg.norm(h)
        normal = a.T @ a
        normal += np.trace(normal) * np.outer(direction, direction)
        try:
            return np.asarray(-np.linalg.solve(normal, a.T @ b).reshape(3, 3), dtype=np.float64)
        except np.linalg.LinAlgError:
            return None

    def _health(self, h: Array) -> HomographyFit:
        """Judge a homography in normalized units and bring it to pixels and meters."""
        error, variance = (a[0] for a in self._whitened(h[None]))
        inliers = (error**2 / variance).sum(axis=-1) < BOUND
        count = int(inliers.sum())
        needed = max(4 if len(self.uv) < LEAST_INLIERS else LEAST_INLIERS, int(np.ceil(LEAST_SHARE * len(self.uv))))
        if count < needed:
            return refused(
                f"{count} of {len(self.uv)} correspondences agree, at least {needed} are needed", len(self.uv)
            )
        s = _design_singular_values(self.uv[inliers], self.xy[inliers])
        if s[7] < LEAST_S8_S1 * s[0]:
            return refused(f"the {count} correspondences that agree lie on a line or a point", len(self.uv))
        if count > 4 and s[7] < LEAST_S8_S9 * s[8]:
            return refused(
                "the correspondences do not determine a homography: noise is as large as what they tell", len(self.uv)
            )
        ground_H_image = np.linalg.inv(self.xy_N_m) @ h @ self.uv_N_px
        ground_H_image /= np.linalg.norm(ground_H_image[2])
        error_m = float(np.median(np.hypot(*error[inliers].T))) / self.xy_N_m[0, 0]
        return HomographyFit(True, "", ground_H_image, inliers, error_m, float(s[0] / s[7]))


def _normalization(points: Array) -> Array:
    center = points.mean(axis=0)
    spread = np.sqrt(((points - center) ** 2).sum(axis=1).mean() / 2)
    scale = 1.0 / spread if spread > 0 else 1.0
    return np.array([[scale, 0, -scale * center[0]], [0, scale, -scale * center[1]], [0, 0, 1.0]])


def _smallest_triangle(quads: Array) -> Array:
    """Area of the smallest triangle (K,) among four points (K, 4, 2): zero when three of them are collinear."""
    areas = []
    for skip in range(4):
        a, b, c = (quads[:, i] for i in range(4) if i != skip)
        areas.append(np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]) / 2)
    return np.min(areas, axis=0)


def _solve_minimal(uv: Array, xy: Array) -> Array:
    """Homographies (K, 3, 3) through four correspondences each (K, 4, 2), with w > 0 at all four; others are left out."""
    design = _design(uv, xy)
    # An 8x9 economy SVD lacks the null vector; a ninth row of zeros brings it back.
    _, _, vt = np.linalg.svd(np.concatenate([design, np.zeros((len(design), 1, 9))], axis=1))
    h = vt[:, -1].reshape(-1, 3, 3)
    w = np.einsum("kj,knj->kn", h[:, 2, :2], uv) + h[:, 2, 2, None]
    h = h * np.sign(w[:, :1, None])
    return h[(w * np.sign(w[:, :1]) > 0).all(axis=1)]


def _design(uv: Array, xy: Array) -> Array:
    """DLT rows (..., 2N, 9) of correspondences (..., N, 2)."""
    p = np.concatenate([uv, np.ones((*uv.shape[:-1], 1))], axis=-1)
    zero = np.zeros_like(p)
    first = np.concatenate([p, zero, -xy[..., :1] * p], axis=-1)
    second = np.concatenate([zero, p, -xy[..., 1:] * p], axis=-1)
    return np.concatenate([first, second], axis=-2)


def _design_singular_values(uv: Array, xy: Array) -> Array:
    """Singular values (9,) of the design matrix of points normalized among themselves."""
    uv_n, xy_n = _normalization(uv), _normalization(xy)
    a = _design(uv * uv_n[0, 0] + uv_n[:2, 2], xy * xy_n[0, 0] + xy_n[:2, 2])
    return np.sqrt(np.clip(np.linalg.eigvalsh(a.T @ a)[::-1], 0.0, None))
