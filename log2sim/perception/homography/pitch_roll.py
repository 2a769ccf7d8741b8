"""Pitch and roll of a camera in each tick on top of the homography of its stream, where held-out errors ask for them.

The two angles of a tick have a zero-mean normal prior whose standard deviation is estimated from all ticks (empirical
Bayes), so that ticks with few correspondences stay near the stream's homography.

A vehicle pitches when it brakes, so the ground moves in its cameras. Angles estimated from one part of the correspondences
are accepted if they lower the errors of the other part. The pixels are then stabilized by them, and the stream's
homography is fitted to the stabilized pixels as to those of a camera that does not move.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import CHI2_2DOF_99, Array
from log2sim.perception.homography.correspondences import Correspondences
from log2sim.perception.homography.fit import HomographyFit, PitchRoll, RobustFit
from log2sim.perception.homography.normalized import (
    Linearization,
    NormalizedCorrespondences,
    linearize,
    nearest_poses,
    noise_factors,
    pose_tangent,
    scale_free_basis,
)

# Standard deviations of pitch, as a shift along v, and of roll, before they are estimated.
PITCH_SIGMA_PX = 4.0
ROLL_SIGMA_RAD = 2e-3
ROUNDS = 5
# Of the shifts that single correspondences of a tick ask for so many are tried, each against so many correspondences.
MAX_CANDIDATES, MAX_VOTERS = 24, 96
# Angles count as movement when their chi-squared statistic exceeds its mean by this many standard deviations.
MIN_SIGNIFICANCE_SIGMA = 3.0


@dataclass(frozen=True, eq=False)
class _Angles:
    """Angles of all ticks."""

    value: Array  # (T, 2): pitch, as a shift along v in normalized units or rad, and roll, rad
    sigma: Array  # (2,): standard deviations of their priors
    significant: NDArray[np.bool_]  # (2,): whether they are fitted at all
    generators: Array  # (2, 3, 3): image motions by an angle of 1

    def warps(self) -> Array:
        """Build the image homographies (T, 3, 3), to second order."""
        first = np.einsum("tk,kij->tij", self.value, self.generators)
        return np.asarray(np.eye(3) + first + first @ first / 2)


def fit_pitch_roll(data: NormalizedCorrespondences, h: Array, image_K: Array | None) -> tuple[RobustFit, Array, Array]:
    """Fit the stream's homography and the angles of all ticks together, starting from `h` (3, 3).

    Returns the fit; the image homography of each tick on top of it (T, 3, 3); and the image motions (T, 2, 3, 3) by one standard
    deviation of its two angles. An angle counts among the effective parameters by how little its prior determines it.

    Each tick's shift starts at the candidate that most of its correspondences agree with. Then Gauss-Newton over the
    homography and all angles, which are coupled only through the homography, so that a tick costs a 2x2 system (Schur's
    complement). Noise and standard deviations of the angles are estimated anew after each step.
    """
    sigma = np.array([PITCH_SIGMA_PX * data.image_N_px[0, 0], ROLL_SIGMA_RAD])
    # Without intrinsics pitch shifts the image and roll rotates it about the mean of the correspondences: for a tenth of a degree
    # the difference is below a tenth of a pixel.
    shift, roll = np.array([[0.0, 0, 0], [0, 0, 1], [0, 0, 0]]), np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 0]])
    generators = np.array([shift, roll])
    if image_K is not None:
        pitch = np.array([[0.0, 0, 0], [0, 0, 1], [0, -1, 0]]) / image_K[1, 1]
        generators = image_K @ np.array([pitch, roll]) @ np.linalg.inv(image_K)
    angles = _Angles(np.zeros((len(data.start), 2)), sigma, np.ones(2, dtype=bool), generators)
    noisy = data
    for k in range(ROUNDS):
        if k < 2:  # again in the second round, with the homography and the standard deviation fitted in the first
            linear = linearize(data, h)
            along_v = linear.pull[1] / linear.weight[1, 1]
            # In ticks with very many correspondences an even selection votes.
            count = data.count[data.tick]
            slots = np.minimum(count, MAX_VOTERS)
            column = (np.arange(len(count)) - data.start[data.tick]) * slots // count
            table = np.full((3, len(data.start), int(slots.max())), np.nan)
            table[:, data.tick, column] = [
                -along_v,
                np.sqrt(linear.weight[1, 1]),
                linear.squared - along_v * linear.pull[1],
            ]
            asked, weight, squared_u = table
            some = asked[:, :: max(asked.shape[1] // MAX_CANDIDATES, 1)]
            candidates = np.concatenate([np.zeros((len(asked), 1)), some], axis=1)
            residual = (asked[:, None, :] - candidates[:, :, None]) * weight[:, None, :]
            bounded = np.fmin(residual * residual + squared_u[:, None, :], CHI2_2DOF_99)
            bounded[np.broadcast_to(np.isnan(asked)[:, None, :], bounded.shape)] = 0.0
            loss = bounded.sum(axis=2) + (candidates / angles.sigma[0]) ** 2
            loss[np.isnan(candidates)] = np.inf
            shift = candidates[np.arange(len(asked)), np.argmin(loss, axis=1)]
            angles = replace(angles, value=np.column_stack([shift, angles.value[:, 1]]))
        linear = linearize(noisy, h, angles.warps()[noisy.tick])
        h, angles, information = _step(linear, angles, image_K)
        if k >= 1:
            noisy = noisy.scale_noise(*noise_factors(linear, 8 + 2 * len(angles.value)))
        variance = 1.0 / (information + 1.0 / angles.sigma**2)
        if k == ROUNDS - 2:
            # Whether they differ from zero over the ticks by more than noise explains, as they would be without the prior, which
            # shrinks them.
            informed = information > 0.01 / angles.sigma**2
            known = np.where(informed, information, 1.0)
            unshrunk = angles.value * (1.0 + 1.0 / (angles.sigma**2 * known))
            excess = np.where(informed, unshrunk**2 * known - 1.0, 0.0).sum(axis=0)
            noise = np.sqrt(2.0 * np.maximum(informed.sum(axis=0), 1))
            significant = np.asarray(excess > MIN_SIGNIFICANCE_SIGMA * noise)
            angles = replace(angles, value=angles.value * significant, significant=significant)
        sigma = np.sqrt(np.maximum((angles.value**2 + variance).mean(axis=0), angles.sigma**2 / 25))
        angles = replace(angles, sigma=sigma)
    warps = angles.warps()
    of_rows, parameters = warps[noisy.tick], float((angles.significant * information * variance).sum())
    tick_sigmas = (np.sqrt(variance) * angles.significant)[:, :, None, None] * angles.generators
    return RobustFit(noisy, linearize(noisy, h, of_rows), of_rows, parameters), warps, tick_sigmas


def _step(linear: Linearization, angles: _Angles, image_K: Array | None) -> tuple[Array, _Angles, Array]:
    """Take one Gauss-Newton step: homography (3, 3), angles, and the information (T, 2) of each tick on them."""
    use, h = linear.inliers, linear.h
    # Derivatives (2, 2, N) of the projected positions by the two angles, and these times the inverse covariance of the errors.
    (u, v), (wu, wv) = linear.projected, linear.weight * use
    by_angle = np.empty((2, 2, len(u)))
    for k, g in enumerate(angles.generators):
        dw = g[2, 0] * u + g[2, 1] * v + g[2, 2]
        by_angle[k] = g[0, 0] * u + g[0, 1] * v + g[0, 2] - u * dw, g[1, 0] * u + g[1, 1] * v + g[1, 2] - v * dw
    by_angle *= angles.significant[:, None, None]
    weighted = by_angle[:, :1] * wu + by_angle[:, 1:] * wv
    basis = scale_free_basis(h) if image_K is None else pose_tangent(image_K, h)
    by_h = (basis.T @ linear.slope.reshape(9, -1)).reshape(-1, 2, len(u))
    normal, right = linear.inlier_equations

    def by_tick(a: Array, b: Array) -> Array:
        """Sum the products (T, n, m) of two sets of rows (n, 2, N), (m, 2, N) over each tick."""
        products = a[:, None, 0] * b[:, 0] + a[:, None, 1] * b[:, 1]
        return np.asarray(np.add.reduceat(products, linear.data.start, axis=-1).transpose(2, 0, 1))

    own = by_tick(by_angle, weighted) + np.diag(1.0 / angles.sigma**2)
    shared = by_tick(by_h, weighted)
    pull = by_tick(by_angle, (linear.pull * use)[None])[:, :, 0] + angles.value / angles.sigma**2
    gain = shared @ np.linalg.inv(own)
    normal = basis.T @ normal @ basis - (gain @ shared.swapaxes(1, 2)).sum(axis=0)
    right = basis.T @ right - (gain @ pull[:, :, None]).sum(axis=0)[:, 0]
    try:
        step = -np.linalg.solve(normal, right)
    except np.linalg.LinAlgError:
        step = np.zeros(len(right))
    angle_step = -np.linalg.solve(own, pull[:, :, None] + shared.swapaxes(1, 2) @ step[None, :, None])[:, :, 0]
    moved = h + (basis @ step).reshape(3, 3)
    moved = moved / np.linalg.norm(moved) if image_K is None else nearest_poses(image_K, moved[None])[0]
    information = np.diagonal(own, axis1=1, axis2=2) - 1.0 / angles.sigma**2
    value = (angles.value + angle_step) * angles.significant
    return np.asarray(moved), replace(angles, value=value), information


# Median of chi-squared with 2 degrees of freedom.
CHI2_2DOF_50 = 1.386
# With fewer ticks the spread over them is not known.
MIN_TICKS = 8


@dataclass(frozen=True, eq=False)
class HeldOutErrors:
    """Errors of held-out correspondences with one homography and with one a tick."""

    tick: NDArray[np.int64]  # (N,)
    squared: Array  # (2, N): squared whitened errors, of the fixed and of the moving camera
    distance_px: Array  # (2, N)

    @classmethod
    def join(cls, parts: Sequence[HeldOutErrors]) -> HeldOutErrors:
        """Concatenate the errors of several folds."""
        columns = ("tick", "squared", "distance_px")
        return cls(*(np.concatenate([getattr(p, name) for p in parts], axis=-1) for name in columns))

    def significance(self) -> float:
        """Compute the fall of the bounded loss in units of its standard error over the ticks.

        The loss is that of the noise which the better of the two shows, so that the gate is neither too wide nor too narrow.
        """
        variance = np.median(self.squared, axis=1).min() / CHI2_2DOF_50
        if not 0 < variance < np.inf:
            return 0.0
        loss = np.minimum(self.squared / variance, CHI2_2DOF_99)
        number = np.unique(self.tick, return_inverse=True)[1]
        fall = np.bincount(number, loss[0] - loss[1])
        error = float(fall.std()) / np.sqrt(len(fall))
        return float(fall.mean() / error) if error > 0 and len(fall) >= MIN_TICKS else 0.0

    def decide(self, source: str, sigmas_deg: tuple[float, float], *, moves: bool) -> PitchRoll:
        """Accept or refuse angles from a source, of which it is known whether they differ from none at all."""
        significance = self.significance() if moves else 0.0
        before, after = np.median(self.distance_px, axis=1).tolist()
        return PitchRoll(significance > MIN_SIGNIFICANCE_SIGMA, source, *sigmas_deg, (before, after), significance)


def stabilizing_warps(moving: HomographyFit) -> Array:
    """Compute the image homographies (T, 3, 3), px, that undo the pitch and roll of each tick."""
    assert moving.per_tick is not None
    warps = np.linalg.inv(moving.ground_H_image) @ moving.per_tick
    return np.asarray(warps / warps[:, 2:, 2:])


def stabilized(correspondences: Correspondences, moving: HomographyFit) -> Correspondences:
    """Undo the pitch and roll of each tick in the pixels; ticks that `moving` does not have are left as they are."""
    index = np.clip(np.searchsorted(moving.ticks, correspondences.tick), 0, len(moving.ticks) - 1)
    known = (moving.ticks[index] == correspondences.tick)[:, None, None]
    warps = np.where(known, stabilizing_warps(moving)[index], np.eye(3))
    q = np.einsum("nij,nj->ni", warps, np.column_stack([correspondences.uv, np.ones(len(correspondences))]))
    return replace(correspondences, uv=q[:, :2] / q[:, 2:])


def held_out_errors(
    fixed: tuple[HomographyFit, Correspondences],
    moving: tuple[HomographyFit, Correspondences],
    sigma_px: float,
    sigma_m: float,
) -> HeldOutErrors:
    """Compute the errors of the same correspondences, raw and stabilized, with the homographies fitted to each."""
    squared, distance = [], []
    for fit, data in (fixed, moving):
        h = np.linalg.inv(fit.ground_H_image)
        q = data.xy_ego @ h[:, :2].T + h[:, 2]
        front = q[:, 2] > 0
        depth = np.where(front, q[:, 2], 1.0)[:, None]
        projected = q[:, :2] / depth
        slope = (h[:2, :2] - projected[:, :, None] * h[2, :2]) / depth[:, :, None]
        covariance = sigma_px**2 * np.eye(2) + sigma_m**2 * slope @ slope.swapaxes(1, 2)
        error = data.uv - projected
        whitened = np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[:, :, None])[:, :, 0])
        squared.append(np.where(front, whitened, np.inf))  # infinite behind the camera
        distance.append(np.where(front, np.hypot(*error.T), np.inf))
    return HeldOutErrors(fixed[1].tick, np.stack(squared), np.stack(distance))
