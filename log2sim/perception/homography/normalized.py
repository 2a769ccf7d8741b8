"""Normalized correspondences of a camera stream, errors of homographies, and their refinement over inliers.

Within the estimators a homography maps the ground to the image, because pixel noise is the same everywhere in the image,
while its effect on the ground grows with the square of the range.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import CHI2_2DOF_99, Array

# `CHI2_2DOF_99` is the inlier gate on a squared whitened error, and the value at which the bounded loss is cut.


@dataclass(frozen=True, eq=False)
class NormalizedCorrespondences:
    """Correspondences scaled to mean 0 and spread 1 in the image and on the ground (Hartley, 1997), sorted by tick."""

    image: Array  # (2, N): normalized pixels
    ground: Array  # (3, N): normalized ground positions, homogeneous
    tick: NDArray[np.int64]  # (N,): tick of each correspondence, numbered from 0, ascending
    start: NDArray[np.int64]  # (T,): first row of each tick
    sigma_image: float  # `sigma_image`, `sigma_ground`: standard deviations of `image` and `ground`, normalized units
    sigma_ground: float
    image_N_px: Array  # `image_N_px`, `ground_N_m`: (3, 3): the similarities that normalize pixels and ground positions
    ground_N_m: Array

    @classmethod
    def of(
        cls, uv_px: Array, xy_m: Array, tick: NDArray[np.int64], sigma_px: float, sigma_m: float
    ) -> NormalizedCorrespondences:
        """Normalize pixels (N, 2) and ground positions (N, 2) whose ticks (N,) ascend."""
        image_N_px, image = normalize(np.ascontiguousarray(uv_px.T))
        ground_N_m, ground_xy = normalize(np.ascontiguousarray(xy_m.T))
        ground = np.concatenate([ground_xy, np.ones((1, len(uv_px)))])
        first = first_of_each(tick)
        sigmas = sigma_px * image_N_px[0, 0], sigma_m * ground_N_m[0, 0]
        return cls(image, ground, np.cumsum(first) - 1, np.flatnonzero(first), *sigmas, image_N_px, ground_N_m)

    @cached_property
    def count(self) -> NDArray[np.int64]:
        """Correspondences of each tick (T,)."""
        return np.diff(self.start, append=self.image.shape[1])

    @cached_property
    def ground_products(self) -> Array:
        """Products (6, N) of ground coordinates: x x, x y, x, y y, y, 1."""
        x, y, _ = self.ground
        return np.concatenate([self.ground * x, self.ground[1:] * y, self.ground[2:]])

    @cached_property
    def products(self) -> NDArray[np.floating[Any]]:
        """Products (12, N): ground x, y, 1; the same times u; the same times v; then u u, v v, u v."""
        (u, v), ground = self.image, self.ground
        return np.concatenate([ground, ground * u, ground * v, self.image * self.image, (u * v)[None]])

    def take(self, rows: Any) -> NormalizedCorrespondences:
        """Select rows in the same units, as if of one tick."""
        image, ground = self.image[:, rows], self.ground[:, rows]
        tick, start = np.zeros(image.shape[1], dtype=np.int64), np.zeros(1, dtype=np.int64)
        return replace(self, image=image, ground=ground, tick=tick, start=start)

    def scale_noise(self, image: float, ground: float) -> NormalizedCorrespondences:
        """Scale the standard deviations of pixels and ground positions by these factors."""
        return replace(self, sigma_image=self.sigma_image * image, sigma_ground=self.sigma_ground * ground)

    def to_ground_H_image(self, image_H_ground: Array) -> Array:
        """Convert (..., 3, 3) to pixels and m, third row scaled to a unit vector, positive below the horizon."""
        return scaled(np.linalg.inv(self.ground_N_m) @ np.linalg.inv(image_H_ground) @ self.image_N_px)


def first_of_each(tick: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Mark the first row of each tick (N,), ascending."""
    first = np.ones(len(tick), dtype=bool)
    np.not_equal(tick[1:], tick[:-1], out=first[1:])
    return first


def scaled(h: Array) -> Array:
    """Scale homographies (..., 3, 3) so that their third rows are unit vectors."""
    return np.asarray(h / np.linalg.norm(h[..., 2, :], axis=-1)[..., None, None], dtype=np.float64)


def normalize(points: Array) -> tuple[Array, Array]:
    """Return the similarity (3, 3) that gives points (2, N) mean 0 and spread 1 an axis, and the normalized points."""
    center = points.sum(axis=1) / points.shape[1]
    offset = points - center[:, None]
    spread = float(np.sqrt(np.vdot(offset, offset) / offset.size))
    scale = 1.0 / spread if spread > 0 else 1.0
    offset *= scale
    x, y = (-scale * center).tolist()
    return np.array([[scale, 0.0, x], [0.0, scale, y], [0.0, 0.0, 1.0]]), offset


# Share of the variance along v that is independent of u, below which single precision does not tell it from zero.
MIN_OWN_VARIANCE = 1e-5


def squared_errors(
    products: NDArray[np.floating[Any]], sigma_image: float, sigma_ground: float, image_H_ground: Array
) -> NDArray[np.floating[Any]]:
    """Compute squared whitened errors (K, N) of homographies (K, 3, 3) in the precision of `products`; infinite behind the camera.

    `products` (12, N): of `NormalizedCorrespondences`. `sigma_image`, `sigma_ground`: standard deviations, normalized units.

    Sampson's distance: the error of the cross-multiplied equations weighted by its first-order covariance. Errors, depth
    and covariance are linear in products of the coordinates, so one matrix product gives them for all homographies.
    """
    # Factors (6, K, 12) of `products` that give two errors, the depth and three entries of the covariance.
    c, (a, b, d) = np.zeros((6, len(image_H_ground), 12), products.dtype), image_H_ground.transpose(1, 0, 2)
    c[0, :, 0:3], c[0, :, 3:6] = -a, d
    c[1, :, 0:3], c[1, :, 6:9] = -b, d
    c[2, :, 0:3] = d
    x, y = (sigma_ground * image_H_ground[:, :, :2]).transpose(2, 0, 1)
    (aa, ab, ad), (_, bb, bd), (_, _, dd) = (x[:, :, None] * x[:, None] + y[:, :, None] * y[:, None]).transpose(1, 2, 0)
    c[3, :, 2], c[3, :, 5], c[3, :, 9] = aa, -2 * ad, dd
    c[4, :, 2], c[4, :, 8], c[4, :, 10] = bb, -2 * bd, dd
    c[5, :, 2], c[5, :, 5], c[5, :, 8], c[5, :, 11] = ab, -bd, -ad, dd
    ex, ey, w, cuu, cvv, cuv = (c.reshape(-1, 12) @ products).reshape(6, len(image_H_ground), products.shape[1])
    pixel = w * w
    pixel *= sigma_image**2
    cuu += pixel
    cvv += pixel
    # By the errors along u, and across it: a sum of squares, so that rounding makes no error negative.
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        shear = cuv / cuu
        cuv *= shear
        own = cvv - cuv
        shear *= ex
        ey -= shear
        ex *= ex
        ex /= cuu
        ey *= ey
        ey /= own
        ex += ey
    cvv *= MIN_OWN_VARIANCE
    np.copyto(ex, np.inf, where=~((w > 0) & (own > cvv)))
    return np.asarray(ex)


def bounded_losses(
    products: NDArray[np.floating[Any]], sigma_image: float, sigma_ground: float, image_H_ground: Array
) -> NDArray[np.floating[Any]]:
    """Compute the mean squared whitened error (K,), each cut at `CHI2_2DOF_99`, of homographies (K, 3, 3)."""
    squared = squared_errors(products, sigma_image, sigma_ground, image_H_ground)
    return np.asarray(np.minimum(squared, CHI2_2DOF_99, out=squared).mean(axis=1))


def nearest_poses(image_K: Array, h: Array) -> Array:
    """Find the nearest homographies (K, 3, 3), ground to normalized image, that a camera `image_K` (3, 3) can have.

    The first two columns of `inv(image_K) @ h` are the ground axes in the camera frame, so they must be orthogonal and
    of equal length. Columns that are zero or parallel give NaN.

    The polar factor of these two columns is the nearest such matrix in the Frobenius norm (Zhang, 2000, appendix C).
    """
    m = np.linalg.inv(image_K) @ h
    axes = m[:, :, :2]
    gram = axes.swapaxes(1, 2) @ axes
    # Inverse square root of a symmetric 2x2 matrix in closed form.
    root_of_determinant = np.sqrt(np.maximum(gram[:, 0, 0] * gram[:, 1, 1] - gram[:, 0, 1] ** 2, 0.0))
    total = np.sqrt(gram[:, 0, 0] + gram[:, 1, 1] + 2 * root_of_determinant)
    with np.errstate(divide="ignore", invalid="ignore"):
        adjugate = np.empty_like(gram)
        adjugate[:, 0, 0], adjugate[:, 1, 1] = gram[:, 1, 1] + root_of_determinant, gram[:, 0, 0] + root_of_determinant
        adjugate[:, 0, 1] = adjugate[:, 1, 0] = -gram[:, 0, 1]
        orthogonal = axes @ (adjugate / (root_of_determinant * total)[:, None, None])
        scale = total / 2
        pose = np.concatenate([orthogonal, m[:, :, 2:] / scale[:, None, None]], axis=2)
    return np.asarray(image_K @ pose)


def pose_tangent(image_K: Array, h: Array) -> Array:
    """Compute the derivatives (9, 6) of a camera's homography (3, 3) by small rotations and shifts of the camera."""
    pose = np.linalg.inv(image_K) @ h
    pose = pose / np.sqrt(np.linalg.norm(pose[:, 0]) * np.linalg.norm(pose[:, 1]))
    change = np.zeros((6, 3, 3))
    for k, axis in enumerate(np.eye(3)):
        change[k, :, :2] = np.cross(axis, pose[:, :2].T).T
        change[3 + k, :, 2] = axis
    return np.asarray((image_K @ change).reshape(6, 9).T)


# The assumed noise counts as a prior worth this many correspondences; an estimate departs from it by this factor at most.
NOISE_PRIOR_ROWS = 20.0
MAX_NOISE_FACTOR = 4.0
# E[x^2 | x^2 < 9.21] / 2 for a chi-squared variable with 2 degrees of freedom: 1 - 4.605 * 0.01 / 0.99.
TRUNCATED_VARIANCE_SHARE = 0.953
# Refinement ends where the summed squared error would fall by less than this.
MIN_LOSS_DECREASE = 0.02


@dataclass(frozen=True, eq=False)
class Linearization:
    """Errors of a homography on N correspondences, linearized, in normalized units."""

    data: NormalizedCorrespondences
    h: Array  # (3, 3): ground to image
    projected: Array  # (2, N): ground positions projected into the image
    scale: Array  # (N,): reciprocal depths of the ground positions; 1 behind the camera
    spread: Array  # (2, 2, N): covariance in the image of ground noise of standard deviation 1
    weight: Array  # (2, 2, N): inverse covariance of the errors in the image
    pull: Array  # (2, N): the errors in the image times `weight`
    squared: Array  # (N,): squared whitened errors; infinite behind the camera

    @cached_property
    def inliers(self) -> NDArray[np.bool_]:
        """Whether the squared error of each row (N,) is below the gate."""
        return self.squared < CHI2_2DOF_99

    @cached_property
    def loss(self) -> float:
        """Sum of the squared whitened errors, each cut at `CHI2_2DOF_99`."""
        return float(np.minimum(self.squared, CHI2_2DOF_99).sum())

    @cached_property
    def inlier_equations(self) -> tuple[Array, Array]:
        """Normal equations of the inliers."""
        return self.normal_equations(self.inliers)

    @property
    def bounded_weights(self) -> NDArray[np.floating[Any]]:
        """Weights (N,) of the rows that fade with the squared error, a quarter at the gate (Geman & McClure, 1985)."""
        return np.asarray((CHI2_2DOF_99 / (CHI2_2DOF_99 + self.squared)) ** 2)

    @property
    def slope(self) -> Array:
        """Derivatives (9, 2, N) of `projected` by the elements of the homography."""
        out, by_depth = np.zeros((3, 3, 2, len(self.scale))), self.data.ground * self.scale
        out[0, :, 0] = out[1, :, 1] = by_depth
        out[2] = -by_depth[:, None] * self.projected
        return out.reshape(9, 2, -1)

    def normal_equations(self, share: NDArray[Any]) -> tuple[Array, Array]:
        """Sum the normal matrix (9, 9) and the right side (9,) of the homography's elements over the rows, of which `share` (N,) counts.

        A row's normal matrix is the Kronecker product of two symmetric 3x3 matrices, of the image and of the ground, so that
        one matrix product sums those of all rows.
        """
        projected, weight = self.projected, self.weight
        image, across = np.empty((10, len(share))), weight[0] * projected[0] + weight[1] * projected[1]
        image[0:4] = weight.reshape(4, -1)
        np.negative(across, out=image[4:6])
        image[6] = (across * projected).sum(axis=0)
        image[7:9] = self.pull
        image[9] = -(self.pull * projected).sum(axis=0)
        image *= share * self.scale
        image[:7] *= self.scale
        sums = image @ self.data.ground_products.T
        return sums.take(_IN_SUMS), sums[7:].take([2, 4, 5], axis=1).ravel()


# Where the elements of a normal matrix (9, 9) lie in the sums (10, 6), by image row, ground row, image column, ground column.
_OF_IMAGE = np.array([[0, 1, 4], [2, 3, 5], [4, 5, 6]])[:, None, :, None]
_OF_GROUND = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])[None, :, None, :]
_IN_SUMS = (6 * _OF_IMAGE + _OF_GROUND).reshape(9, 9)
_ADJUGATE_SIGNS = np.array([[1.0, -1.0], [-1.0, 1.0]])[:, :, None]


def linearize(data: NormalizedCorrespondences, h: Array, warps: Array | None = None) -> Linearization:
    """Linearize the errors of a homography (3, 3), ground to image.

    `warps` (N, 3, 3) are homographies of the image applied to each correspondence on top of `h`, as a pitching camera
    has; the derivatives ignore them, since they are near the identity.
    """
    q = h @ data.ground
    if warps is not None:
        q = np.einsum("nij,jn->in", warps, q)
    front = q[2] > 0
    scale = 1.0 / np.where(front, q[2], 1.0)
    projected = q[:2] * scale
    # Derivatives (2, N) of the pixel by the ground position's x and y, and the covariance that ground noise has in the image.
    by_x, by_y = ((h[:2, :2, None] - projected[:, None] * h[2, :2, None]) * scale).swapaxes(0, 1)
    spread = by_x[:, None] * by_x + by_y[:, None] * by_y
    pixel, place = data.sigma_image**2, data.sigma_ground**2
    covariance = place * spread
    covariance[0, 0] += pixel
    covariance[1, 1] += pixel
    # The determinant as a sum of squares has no cancellation, even where a hypothesis folds the ground to a line.
    area = (place * (by_x[0] * by_y[1] - by_x[1] * by_y[0])) ** 2
    area += pixel * (covariance[0, 0] + covariance[1, 1] - pixel)
    weight = covariance[::-1, ::-1] * _ADJUGATE_SIGNS
    weight /= area
    error = projected - data.image
    pull = weight[0] * error[0] + weight[1] * error[1]
    squared = (pull * error).sum(axis=0)
    squared[~front] = np.inf
    return Linearization(data, h, projected, scale, spread, weight, pull, squared)


_DAMPING = 1e-14 * np.eye(9)


def newton_step(
    linear: Linearization, image_K: Array | None = None, share: NDArray[Any] | None = None
) -> tuple[Array, float]:
    """Take a Gauss-Newton step over the inliers, or over the rows of which `share` (N,) counts; none where they do not determine it.

    Returns the homography (3, 3), and by how much the sum of the squared errors should fall. With intrinsics `image_K` (3, 3) it
    is a step of that camera's pose.
    """
    h, rows = linear.h, linear.inliers if share is None else share
    if np.count_nonzero(rows) < 4:
        return h, 0.0
    normal, right = linear.inlier_equations if share is None else linear.normal_equations(rows)
    if image_K is None:
        # The scale of a homography is free: steps are taken across it, never along it.
        along, basis = h.reshape(9, 1) / math.sqrt(np.vdot(h, h)), None
        normal = normal + normal.trace() / 9 * (along @ along.T + _DAMPING)
    else:
        basis = pose_tangent(image_K, h)
        basis = basis / np.sqrt(np.maximum((basis * (normal @ basis)).sum(axis=0), 1e-300))
        normal, right = basis.T @ normal @ basis + _DAMPING[:6, :6], basis.T @ right
    try:
        step = np.linalg.solve(normal, right)
    except np.linalg.LinAlgError:
        return h, 0.0
    moved, decrease = h - (step if basis is None else basis @ step).reshape(3, 3), float(step @ right)
    if not math.isfinite(decrease):
        return h, 0.0
    if image_K is None:
        return np.asarray(moved / math.sqrt(np.vdot(moved, moved))), decrease
    return np.asarray(nearest_poses(image_K, moved[None])[0], dtype=np.float64), decrease


def refine(linear: Linearization, rounds: int, image_K: Array | None = None) -> Linearization:
    """Minimize the bounded loss; with intrinsics `image_K` (3, 3) over the poses of that camera."""
    for _ in range(rounds):
        h, decrease = newton_step(linear, image_K)
        if decrease < MIN_LOSS_DECREASE:
            break
        proposed = linearize(linear.data, h)
        if proposed.loss >= linear.loss:
            break
        linear = proposed
    return linear


def scale_free_basis(h: Array) -> Array:
    """Build the orthonormal directions (9, 8) perpendicular to a homography (3, 3), whose scale is free."""
    # The reflection that takes the homography to an axis takes the other axes to its orthogonal complement (Householder).
    v = h.ravel() / np.linalg.norm(h)
    largest = int(np.abs(v).argmax())
    v[largest] += math.copysign(1.0, v[largest])
    across = np.arange(9) != largest
    return np.asarray(np.eye(9)[:, across] - v[:, None] * (v[across] / abs(v[largest])))


def noise_factors(linear: Linearization, parameters: float = 8) -> tuple[float, float]:
    """Estimate from the inliers by which factors the noise of pixels and of ground positions exceeds the assumed one.

    `parameters` is the number of fitted parameters, subtracted from the degrees of freedom.

    Variance components by one step of Fisher scoring of the normal likelihood, with the assumed noise as prior.
    """
    use, pixel, place = linear.inliers, linear.data.sigma_image**2, linear.data.sigma_ground**2
    count = int(np.count_nonzero(use))
    if 2 * count <= parameters:
        return 1.0, 1.0
    weight, pull, spread = linear.weight * use, linear.pull * use, place * linear.spread
    # Products (2, 2, N) and (2, N) of `weight` with the covariance of the ground noise, and of that with `pull`.
    of_ground = weight[:, :1] * spread[0] + weight[:, 1:] * spread[1]
    spread_pull = spread[0] * pull[0] + spread[1] * pull[1]
    # Two normal equations, each with the prior.
    share = 2 * count / (2 * count - parameters) / TRUNCATED_VARIANCE_SHARE
    of_pixel = share * pixel * float(np.vdot(pull, pull)) + NOISE_PRIOR_ROWS
    of_place = share * float(np.vdot(pull, spread_pull)) + NOISE_PRIOR_ROWS
    a = pixel**2 * float(np.vdot(weight, weight)) + NOISE_PRIOR_ROWS
    b = pixel * float(np.vdot(weight, of_ground))
    c = float(np.vdot(of_ground, of_ground.swapaxes(0, 1))) + NOISE_PRIOR_ROWS
    determinant = a * c - b * b
    variances = (c * of_pixel - b * of_place) / determinant, (a * of_place - b * of_pixel) / determinant
    least, most = MAX_NOISE_FACTOR**-2, MAX_NOISE_FACTOR**2
    image, ground = (math.sqrt(min(max(v, least), most)) for v in variances)
    return image, ground
