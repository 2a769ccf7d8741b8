"""Normalized correspondences of a camera stream, and the errors of homographies on them.

Within the estimators a homography maps the ground to the image, because pixel noise is the same everywhere in the image,
while its effect on the ground grows with the square of the range.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array

# 99 % quantile of chi-squared with 2 degrees of freedom: the inlier gate on a squared whitened error, and the value at
# which the bounded loss is cut.
CHI2_2DOF_99 = 9.21


@dataclass(frozen=True, eq=False)
class NormalizedCorrespondences:
    """Correspondences scaled to mean 0 and spread 1 in the image and on the ground (Hartley, 1997), sorted by tick.

    Attributes
    ----------
    image : (2, N) float64
        Normalized pixels.
    ground : (3, N) float64
        Normalized ground positions, homogeneous.
    tick : (N,) int64
        Tick of each correspondence, numbered from 0, ascending.
    start : (T,) int64
        First row of each tick.
    sigma_image, sigma_ground : float
        Standard deviations of `image` and `ground`, normalized units.
    image_N_px, ground_N_m : (3, 3) float64
        The similarities that normalize pixels and ground positions.
    """

    image: Array
    ground: Array
    tick: NDArray[np.int64]
    start: NDArray[np.int64]
    sigma_image: float
    sigma_ground: float
    image_N_px: Array
    ground_N_m: Array

    @classmethod
    def of(
        cls, uv_px: Array, xy_m: Array, tick: NDArray[np.int64], sigma_px: float, sigma_m: float
    ) -> NormalizedCorrespondences:
        """Normalize pixels (N, 2) and ground positions (N, 2) whose ticks (N,) ascend."""
        image_N_px, image = normalize(np.ascontiguousarray(uv_px.T))
        ground_N_m, ground_xy = normalize(np.ascontiguousarray(xy_m.T))
        ground = np.concatenate([ground_xy, np.ones((1, len(uv_px)))])
        start = np.flatnonzero(np.diff(tick, prepend=tick[0] - 1))
        sigmas = sigma_px * image_N_px[0, 0], sigma_m * ground_N_m[0, 0]
        return cls(image, ground, tick, start, *sigmas, image_N_px, ground_N_m)

    @cached_property
    def count(self) -> NDArray[np.int64]:
        """Correspondences of each tick (T,)."""
        return np.diff(self.start, append=self.image.shape[1])

    @cached_property
    def products(self) -> NDArray[np.floating[Any]]:
        """Products (12, N): ground x, y, 1; the same times u; the same times v; then u u, v v, u v."""
        (u, v), ground = self.image, self.ground
        return np.concatenate([ground, ground * u, ground * v, [u * u, v * v, u * v]])

    def coarse(self, rows: Any, sigma_scale: float) -> NormalizedCorrespondences:
        """Select rows with enlarged noise and single-precision products, for scoring hypotheses."""
        part = self.take(rows, sigma_scale)
        part.__dict__["products"] = self.products[:, rows].astype(np.float32)
        return part

    def take(self, rows: Any, sigma_scale: float = 1.0) -> NormalizedCorrespondences:
        """Select rows in the same units and renumber the ticks."""
        tick = self.tick[rows]
        first = np.concatenate([[True], tick[1:] != tick[:-1]])
        start = np.flatnonzero(first)
        tick = np.cumsum(first) - 1
        sigmas = self.sigma_image * sigma_scale, self.sigma_ground * sigma_scale
        normalizations = self.image_N_px, self.ground_N_m
        return NormalizedCorrespondences(
            self.image[:, rows], self.ground[:, rows], tick, start, *sigmas, *normalizations
        )

    def with_noise(self, image: float, ground: float) -> NormalizedCorrespondences:
        """Scale the standard deviations of pixels and ground positions by these factors."""
        return replace(self, sigma_image=self.sigma_image * image, sigma_ground=self.sigma_ground * ground)

    def to_ground_H_image(self, image_H_ground: Array) -> Array:
        """Convert (..., 3, 3) to pixels and m, third row scaled to a unit vector, positive below the horizon."""
        h = np.linalg.inv(self.ground_N_m) @ np.linalg.inv(image_H_ground) @ self.image_N_px
        return np.asarray(h / np.linalg.norm(h[..., 2, :], axis=-1)[..., None, None], dtype=np.float64)


def normalize(points: Array) -> tuple[Array, Array]:
    """Return the similarity (3, 3) that gives points (2, N) mean 0 and spread 1 an axis, and the normalized points."""
    center = points.mean(axis=1, keepdims=True)
    offset = points - center
    spread = float(np.sqrt((offset * offset).mean()))
    scale = 1.0 / spread if spread > 0 else 1.0
    offset *= scale
    similarity = np.array([[scale, 0, -scale * center[0, 0]], [0, scale, -scale * center[1, 0]], [0, 0, 1.0]])
    return similarity, offset


def squared_errors(
    data: NormalizedCorrespondences, image_H_ground: Array, pitch_sigma: float = 0.0
) -> NDArray[np.floating[Any]]:
    """Compute squared whitened errors (K, N) of homographies (K, 3, 3); infinite behind the camera.

    `pitch_sigma` is a further standard deviation along v, for cameras that pitch, in normalized units.

    Notes
    -----
    Sampson's distance: the error of the cross-multiplied equations weighted by its first-order covariance. Errors, depth
    and covariance are linear in products of the coordinates, so one matrix product gives them for all homographies.
    """
    kind = data.products.dtype
    terms = (_coefficients(image_H_ground, data.sigma_ground**2).astype(kind) @ data.products).reshape(
        6, len(image_H_ground), -1
    )
    ex, ey, w, cuu, cvv, cuv = terms
    pixel = w * w
    cvv += kind.type(data.sigma_image**2 + pitch_sigma**2) * pixel
    pixel *= kind.type(data.sigma_image**2)
    cuu += pixel
    area = cuu * cvv
    area -= cuv * cuv
    cuv *= ex
    cuv *= ey
    cuv *= kind.type(2.0)
    ex *= ex
    ex *= cvv
    ex -= cuv
    ey *= ey
    ey *= cuu
    ex += ey
    with np.errstate(divide="ignore", invalid="ignore"):
        ex /= area
    ex[~(w > 0)] = np.inf
    return np.asarray(ex)


def _coefficients(h: Array, ground_variance: float) -> Array:
    """Build the factors (6 K, 12) of `products` that give two errors, the depth and three entries of the covariance."""
    c = np.zeros((6, len(h), 12))
    a, b, d = h[:, 0], h[:, 1], h[:, 2]
    c[0, :, 0:3], c[0, :, 3:6] = -a, d
    c[1, :, 0:3], c[1, :, 6:9] = -b, d
    c[2, :, 0:3] = d
    aa, bb, dd, ab, ad, bd = (
        ground_variance * (p[:, 0] * q[:, 0] + p[:, 1] * q[:, 1])
        for p, q in ((a, a), (b, b), (d, d), (a, b), (a, d), (b, d))
    )
    c[3, :, 2], c[3, :, 5], c[3, :, 9] = aa, -2 * ad, dd
    c[4, :, 2], c[4, :, 8], c[4, :, 10] = bb, -2 * bd, dd
    c[5, :, 2], c[5, :, 5], c[5, :, 8], c[5, :, 11] = ab, -bd, -ad, dd
    return c.reshape(-1, 12)


def bounded_losses(
    data: NormalizedCorrespondences, image_H_ground: Array, pitch_sigma: float = 0.0
) -> NDArray[np.floating[Any]]:
    """Compute the mean squared whitened error (K,), each cut at `CHI2_2DOF_99`, of homographies (K, 3, 3)."""
    squared = squared_errors(data, image_H_ground, pitch_sigma)
    return np.asarray(np.fmin(squared, squared.dtype.type(CHI2_2DOF_99), out=squared).mean(axis=1))
