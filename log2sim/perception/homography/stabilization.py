"""Decision by held-out errors whether each tick gets its own pitch and roll, and the homographies that follow.

A vehicle pitches when it brakes, so the ground moves in its cameras. Angles estimated from one part of the correspondences
are accepted if they lower the errors of the other part. The pixels are then stabilized by them, and the stream's
homography is fitted to the stabilized pixels as to those of a camera that does not move.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.perception.homography.correspondences import Correspondences
from log2sim.perception.homography.fit import HomographyFit
from log2sim.perception.homography.normalized import CHI2_2DOF_99

# Median of chi-squared with 2 degrees of freedom.
CHI2_2DOF_50 = 1.386
# Held-out errors must fall by this many standard errors, which are estimated from the spread of the fall over the ticks.
MIN_SIGNIFICANCE_SIGMA = 3.0
# With fewer ticks the spread over them is not known.
MIN_TICKS = 8
# Distance in the image, as a share of the focal length, at which the roll of a warp is read.
ROLL_ARM = 0.2


@dataclass(frozen=True, eq=False)
class HeldOutErrors:
    """Errors of held-out correspondences with one homography and with one a tick.

    Attributes
    ----------
    tick : (N,) int64
    squared : (2, N) float64
        Squared whitened errors, of the fixed and of the moving camera.
    distance_px : (2, N) float64
    """

    tick: NDArray[np.int64]
    squared: Array
    distance_px: Array

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


def stabilizing_warps(moving: HomographyFit) -> Array:
    """Compute the image homographies (T, 3, 3), px, that undo the pitch and roll of each tick."""
    assert moving.per_tick is not None
    warps = np.linalg.inv(moving.ground_H_image) @ moving.per_tick
    return np.asarray(warps / warps[:, 2:, 2:])


def stabilized(correspondences: Correspondences, moving: HomographyFit) -> Correspondences:
    """Undo the pitch and roll of each tick in the pixels; ticks that `moving` does not have are left as they are."""
    warps = _of_ticks(stabilizing_warps(moving), moving.ticks, correspondences.tick)
    q = np.einsum("nij,nj->ni", warps, np.column_stack([correspondences.uv, np.ones(len(correspondences))]))
    return replace(correspondences, uv=q[:, :2] / q[:, 2:])


def _of_ticks(values: Array, ticks: NDArray[np.int64], tick: NDArray[np.int64]) -> Array:
    """Look up the matrices (N, 3, 3) of ticks (N,); the identity where there is none."""
    index = np.clip(np.searchsorted(ticks, tick), 0, len(ticks) - 1)
    return np.where((ticks[index] == tick)[:, None, None], values[index], np.eye(3))


def held_out_errors(
    fixed: tuple[HomographyFit, Correspondences],
    moving: tuple[HomographyFit, Correspondences],
    sigma_px: float,
    sigma_m: float,
) -> HeldOutErrors:
    """Compute the errors of the same correspondences, raw and stabilized, with the homographies fitted to each."""
    errors = [_image_errors(fit.ground_H_image, data, sigma_px, sigma_m) for fit, data in (fixed, moving)]
    squared, distance = (np.stack([e[k] for e in errors]) for k in range(2))
    return HeldOutErrors(fixed[1].tick, squared, distance)


def _image_errors(
    ground_H_image: Array, correspondences: Correspondences, sigma_px: float, sigma_m: float
) -> tuple[Array, Array]:
    """Compute squared whitened errors (N,) and distances (N,), px; infinite behind the camera."""
    h = np.linalg.inv(ground_H_image)
    q = correspondences.xy_ego @ h[:, :2].T + h[:, 2]
    front = q[:, 2] > 0
    depth = np.where(front, q[:, 2], 1.0)[:, None]
    projected = q[:, :2] / depth
    slope = (h[:2, :2] - projected[:, :, None] * h[2, :2]) / depth[:, :, None]
    covariance = sigma_px**2 * np.eye(2) + sigma_m**2 * slope @ slope.swapaxes(1, 2)
    error = correspondences.uv - projected
    squared = np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[:, :, None])[:, :, 0])
    return np.where(front, squared, np.inf), np.where(front, np.hypot(*error.T), np.inf)


def two_folds(correspondences: Correspondences) -> list[tuple[Correspondences, Correspondences]]:
    """Split every tick's correspondences in turn into a training and a test half, and the other way round."""
    order = np.argsort(correspondences.tick, kind="stable")
    tick = correspondences.tick[order]
    rank = np.arange(len(tick)) - np.searchsorted(tick, tick)
    first, second = (correspondences.take(order[rank % 2 == k]) for k in range(2))
    return [(first, second), (second, first)]


def angle_sigmas_deg(moving: HomographyFit, K: Array) -> tuple[float, float]:
    """Compute the standard deviations of pitch and roll over the ticks, degrees, for intrinsics (3, 3)."""
    center, arm = K[:2, 2], np.array([ROLL_ARM * K[0, 0], 0.0])
    q = np.linalg.inv(stabilizing_warps(moving)) @ np.column_stack([[*center, 1.0], [*(center + arm), 1.0]])
    uv = q[:, :2] / q[:, 2:]
    pitch = np.arctan((uv[:, 1, 0] - center[1]) / K[1, 1])
    du, dv = (uv[:, :, 1] - uv[:, :, 0]).T
    return float(np.degrees(pitch.std())), float(np.degrees(np.arctan2(dv, du).std()))
