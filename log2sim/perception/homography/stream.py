"""Correspondences of a camera stream in normalized units, and how far homographies miss them.

Within the estimators a homography maps the ground to the image, since pixels carry noise that is the same everywhere
there, while on the ground it grows with the square of the range.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array

# Bounded loss: a squared error beyond this counts no further (chi-squared, 2 degrees of freedom, 99 %).
BOUND = 9.21


@dataclass(frozen=True, eq=False)
class Stream:
    """Correspondences in units in which both sides have mean 0 and spread 1 (Hartley, 1997), in the order of their ticks.

    `image` (2, N), `ground` (3, N) homogeneous, `tick` (N,) numbered from 0, `start` (T,) the first row of each tick,
    standard deviations `sigma_image` and `sigma_ground`, and the two normalizations (3, 3).
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
    def of(cls, uv_px: Array, xy_m: Array, tick: NDArray[np.int64], sigma_px: float, sigma_m: float) -> Stream:
        """Normalize correspondences (N, 2), (N, 2), (N,) whose ticks ascend."""
        image_N_px, image = normalized(np.ascontiguousarray(uv_px.T))
        ground_N_m, places = normalized(np.ascontiguousarray(xy_m.T))
        ground = np.concatenate([places, np.ones((1, len(uv_px)))])
        start = np.flatnonzero(np.diff(tick, prepend=tick[0] - 1))
        sigmas = sigma_px * image_N_px[0, 0], sigma_m * ground_N_m[0, 0]
        return cls(image, ground, tick, start, *sigmas, image_N_px, ground_N_m)

    @cached_property
    def count(self) -> NDArray[np.int64]:
        """Correspondences of each tick (T,)."""
        return np.diff(self.start, append=self.image.shape[1])

    @cached_property
    def products(self) -> NDArray[np.floating[Any]]:
        """Products (12, N) of ground and image coordinates: x, y, 1, each alone, with u and with v; then u u, v v, u v."""
        (u, v), ground = self.image, self.ground
        return np.concatenate([ground, ground * u, ground * v, [u * u, v * v, u * v]])

    def coarse(self, rows: Any, sigma_scale: float) -> Stream:
        """A part of the correspondences with wider noise and in single precision, to score hypotheses."""
        part = self.take(rows, sigma_scale)
        part.__dict__["products"] = self.products[:, rows].astype(np.float32)
        return part

    def take(self, rows: Any, sigma_scale: float = 1.0) -> Stream:
        """A part of the correspondences in the same units, its ticks numbered anew."""
        tick = self.tick[rows]
        first = np.concatenate([[True], tick[1:] != tick[:-1]])
        start = np.flatnonzero(first)
        tick = np.cumsum(first) - 1
        sigmas = self.sigma_image * sigma_scale, self.sigma_ground * sigma_scale
        return Stream(self.image[:, rows], self.ground[:, rows], tick, start, *sigmas, self.image_N_px, self.ground_N_m)

    def with_noise(self, image: float, ground: float) -> Stream:
        """The same correspondences with so many times larger noise of pixels and of ground positions."""
        return replace(self, sigma_image=self.sigma_image * image, sigma_ground=self.sigma_ground * ground)

    def to_ground_H_image(self, image_H_ground: Array) -> Array:
        """From normalized units to pixels and m, scaled so that the third row is a unit vector, positive on the ground."""
        h = np.linalg.inv(self.ground_N_m) @ np.linalg.inv(image_H_ground) @ self.image_N_px
        return np.asarray(h / np.linalg.norm(h[..., 2, :], axis=-1)[..., None, None], dtype=np.float64)


def normalized(points: Array) -> tuple[Array, Array]:
    """The similarity (3, 3) that gives points (2, N) mean 0 and spread 1 along each axis, and the points so moved."""
    center = points.mean(axis=1, keepdims=True)
    away = points - center
    spread = float(np.sqrt((away * away).mean()))
    scale = 1.0 / spread if spread > 0 else 1.0
    away *= scale
    to_unit = np.array([[scale, 0, -scale * center[0, 0]], [0, scale, -scale * center[1, 0]], [0, 0, 1.0]])
    return to_unit, away


def squared_errors(stream: Stream, image_H_ground: Array, nod: float = 0.0) -> Array:
    """Squared errors (K, N) of homographies (K, 3, 3) in units of their expected size; infinite where not in front.

    `nod` is a further standard deviation along v, for cameras that pitch.

    Notes
    -----
    Sampson's distance: the error of the cross-multiplied equations by their covariance to first order. Errors, depth and
    covariance are linear in products of the coordinates, so that one matrix product gives them for all homographies.
    """
    kind = stream.products.dtype
    terms = (_coefficients(image_H_ground, stream.sigma_ground**2).astype(kind) @ stream.products).reshape(
        6, len(image_H_ground), -1
    )
    ex, ey, w, cuu, cvv, cuv = terms
    pixel = w * w
    cvv += kind.type(stream.sigma_image**2 + nod**2) * pixel
    pixel *= kind.type(stream.sigma_image**2)
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


def _coefficients(h: Array, place: float) -> Array:
    """What `Stream.products` has to be multiplied with (6 K, 12) for two errors, depth and three parts of a covariance."""
    c = np.zeros((6, len(h), 12))
    a, b, d = h[:, 0], h[:, 1], h[:, 2]
    c[0, :, 0:3], c[0, :, 3:6] = -a, d
    c[1, :, 0:3], c[1, :, 6:9] = -b, d
    c[2, :, 0:3] = d
    aa, bb, dd, ab, ad, bd = (
        place * (p[:, 0] * q[:, 0] + p[:, 1] * q[:, 1]) for p, q in ((a, a), (b, b), (d, d), (a, b), (a, d), (b, d))
    )
    c[3, :, 2], c[3, :, 5], c[3, :, 9] = aa, -2 * ad, dd
    c[4, :, 2], c[4, :, 8], c[4, :, 10] = bb, -2 * bd, dd
    c[5, :, 2], c[5, :, 5], c[5, :, 8], c[5, :, 11] = ab, -bd, -ad, dd
    return c.reshape(-1, 12)


def losses(stream: Stream, image_H_ground: Array, nod: float = 0.0) -> Array:
    """Mean bounded squared errors (K,) of homographies (K, 3, 3)."""
    squared = squared_errors(stream, image_H_ground, nod)
    return np.asarray(np.fmin(squared, squared.dtype.type(BOUND), out=squared).mean(axis=1))
