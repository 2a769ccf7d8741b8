"""Normalized correspondences of a camera stream, errors of homographies, and their refinement over inliers.

Within the estimators a homography maps the ground to the image, because pixel noise is the same everywhere in the image,
while its effect on the ground grows with the square of the range.
"""

from __future__ import annotations

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

    def scale_noise(self, image: float, ground: float) -> NormalizedCorrespondences:
        """Scale the standard deviations of pixels and ground positions by these factors."""
        return replace(self, sigma_image=self.sigma_image * image, sigma_ground=self.sigma_ground * ground)

    def to_ground_H_image(self, image_H_ground: Array) -> Array:
        """Convert (..., 3, 3) to pixels and m, third row scaled to a unit vector, positive below the horizon."""
        return scaled(np.linalg.inv(self.ground_N_m) @ np.linalg.inv(image_H_ground) @ self.image_N_px)


def scaled(h: Array) -> Array:
    """Scale homographies (..., 3, 3) so that their third rows are unit vectors."""
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

    Sampson's distance: the error of the cross-multiplied equations weighted by its first-order covariance. Errors, depth
    and covariance are linear in products of the coordinates, so one matrix product gives them for all homographies.
    """
    # Factors (6, K, 12) of `products` that give two errors, the depth and three entries of the covariance.
    c, (a, b, d) = np.zeros((6, len(image_H_ground), 12)), image_H_ground.transpose(1, 0, 2)
    c[0, :, 0:3], c[0, :, 3:6] = -a, d
    c[1, :, 0:3], c[1, :, 6:9] = -b, d
    c[2, :, 0:3] = d
    by_ground = data.sigma_ground * image_H_ground[:, :, :2]
    (aa, ab, ad), (_, bb, bd), (_, _, dd) = (by_ground @ by_ground.swapaxes(1, 2)).transpose(1, 2, 0)
    c[3, :, 2], c[3, :, 5], c[3, :, 9] = aa, -2 * ad, dd
    c[4, :, 2], c[4, :, 8], c[4, :, 10] = bb, -2 * bd, dd
    c[5, :, 2], c[5, :, 5], c[5, :, 8], c[5, :, 11] = ab, -bd, -ad, dd
    kind = data.products.dtype
    ex, ey, w, cuu, cvv, cuv = (c.reshape(-1, 12).astype(kind) @ data.products).reshape(6, len(image_H_ground), -1)
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


def bounded_losses(
    data: NormalizedCorrespondences, image_H_ground: Array, pitch_sigma: float = 0.0
) -> NDArray[np.floating[Any]]:
    """Compute the mean squared whitened error (K,), each cut at `CHI2_2DOF_99`, of homographies (K, 3, 3)."""
    squared = squared_errors(data, image_H_ground, pitch_sigma)
    return np.asarray(np.fmin(squared, squared.dtype.type(CHI2_2DOF_99), out=squared).mean(axis=1))


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
# Refinement ends when the summed squared error falls by less than this.
MIN_LOSS_DECREASE = 0.02


@dataclass(frozen=True, eq=False)
class Linearization:
    """Errors of K homographies on N correspondences, linearized, in normalized units."""

    error: Array  # (K, 2, N): whitened errors in the image
    squared: Array  # (K, N): squared norms of `error`; infinite behind the camera
    slope: Array  # (K, 9, 2, N): derivatives of `error` by the nine elements of the homography
    projected: Array  # (K, 2, N): ground positions projected into the image
    ground: Array  # (3, K, N): covariance in the image (uu, uv, vv) of ground noise of standard deviation 1
    # (3, K, N): cholesky factors of the inverse covariance: scale of u, scale of v, and the shear of v by u
    whiten: Array


def linearize(data: NormalizedCorrespondences, h: Array, warps: Array | None = None) -> Linearization:
    """Linearize the errors of homographies (K, 3, 3), ground to image.

    `warps` (N, 3, 3) are homographies of the image applied to each correspondence on top of `h`, as a pitching camera
    has; the derivatives ignore them, since they are near the identity.
    """
    count = len(h)
    q = (h.reshape(-1, 3) @ data.ground).reshape(count, 3, -1)
    if warps is not None:
        q = np.einsum("nij,kjn->kin", warps, q)
    front = q[:, 2] > 0
    depth = 1.0 / np.where(front, q[:, 2], 1.0)
    projected = q[:, :2] * depth[:, None]
    u, v = projected[:, 0], projected[:, 1]
    a, b, c = h[:, 0, :2, None] * depth[:, None], h[:, 1, :2, None] * depth[:, None], h[:, 2, :2, None] * depth[:, None]
    # Derivatives (K, N) of the pixel by the ground position, and the covariance that ground noise has in the image.
    ux, uy = a[:, 0] - u * c[:, 0], a[:, 1] - u * c[:, 1]
    vx, vy = b[:, 0] - v * c[:, 0], b[:, 1] - v * c[:, 1]
    ground = np.empty((3, count, len(data.tick)))
    ground[0], ground[1], ground[2] = ux * ux + uy * uy, ux * vx + uy * vy, vx * vx + vy * vy
    cuu, cuv = data.sigma_ground**2 * ground[:2]
    cuu += data.sigma_image**2
    shear = cuv / cuu
    # The determinant as a sum of squares has no cancellation, even where a hypothesis folds the ground to a line.
    area = data.sigma_image**2 * (cuu + data.sigma_ground**2 * ground[2])
    area += data.sigma_ground**4 * (ux * vy - uy * vx) ** 2
    whiten = np.empty_like(ground)
    np.sqrt(area, out=area)
    np.sqrt(cuu, out=cuu)
    wu = np.divide(1.0, cuu, out=whiten[0])
    wv = np.divide(cuu, area, out=whiten[1])
    whiten[2] = shear
    error = projected - data.image
    error[:, 1] -= shear * error[:, 0]
    error[:, 0] *= wu
    error[:, 1] *= wv
    squared = error[:, 0] * error[:, 0] + error[:, 1] * error[:, 1]
    squared[~front] = np.inf
    scaled = data.ground * depth[:, None]
    slope = np.empty((count, 9, 2, data.image.shape[1]))
    np.multiply(scaled, wu[:, None], out=slope[:, 0:3, 0])
    slope[:, 3:6, 0] = 0.0
    np.multiply(slope[:, 0:3, 0], -u[:, None], out=slope[:, 6:9, 0])
    np.multiply(scaled, wv[:, None], out=slope[:, 3:6, 1])
    np.multiply(slope[:, 3:6, 1], -shear[:, None], out=slope[:, 0:3, 1])
    np.multiply(slope[:, 3:6, 1], (shear * u - v)[:, None], out=slope[:, 6:9, 1])
    return Linearization(error, squared, slope, projected, ground, whiten)


def refine_many(data: NormalizedCorrespondences, h: Array, gates: tuple[float, ...]) -> Array:
    """Take one Gauss-Newton step of all homographies (K, 3, 3) for each of `gates` on the squared error; none where undetermined."""
    for gate in gates:
        h = _homography_steps(linearize(data, h), h, gate)
    return h


_DAMPING = 1e-14 * np.eye(9)


def _homography_steps(linear: Linearization, h: Array, gate: float) -> Array:
    """Take a Gauss-Newton step of each homography (K, 3, 3), over rows whose squared error is below `gate`; none where undetermined."""
    use, count = linear.squared < gate, len(h)
    slope = (linear.slope * use[:, None, None]).reshape(count, 9, -1)
    normal, right = slope @ slope.swapaxes(1, 2), slope @ linear.error.reshape(count, -1, 1)
    # The scale of a homography is free: steps are taken across it, never along it.
    along = h.reshape(count, 9, 1) / np.linalg.norm(h, axis=(1, 2))[:, None, None]
    size = np.trace(normal, axis1=1, axis2=2)[:, None, None] / 9
    enough = use.sum(axis=1) >= 4
    normal = np.where(enough[:, None, None], normal + size * (along @ along.swapaxes(1, 2) + _DAMPING), np.eye(9))
    try:
        step = -np.linalg.solve(normal, right)
    except np.linalg.LinAlgError:
        return h
    moved = h.reshape(count, 9, 1) + np.where(
        enough[:, None, None] & np.isfinite(step).all(axis=1, keepdims=True), step, 0.0
    )
    return np.asarray(moved / np.sqrt((moved * moved).sum(axis=1, keepdims=True))).reshape(count, 3, 3)


def refine(
    data: NormalizedCorrespondences, h: Array, rounds: int, image_K: Array | None = None
) -> tuple[Array, Linearization]:
    """Minimize the bounded loss from `h` (3, 3); with intrinsics `image_K` (3, 3) over the poses of that camera."""
    linear = linearize(data, h[None])
    loss = float(np.minimum(linear.squared, CHI2_2DOF_99).sum())
    for _ in range(rounds):
        proposed = newton_step(linear, h, image_K)
        proposed_linear = linearize(data, proposed[None])
        proposed_loss = float(np.minimum(proposed_linear.squared, CHI2_2DOF_99).sum())
        if proposed_loss >= loss:
            break
        decrease, h, linear, loss = loss - proposed_loss, proposed, proposed_linear, proposed_loss
        if decrease < MIN_LOSS_DECREASE:
            break
    return h, linear


def newton_step(
    linear: Linearization, h: Array, image_K: Array | None = None, gate: float = CHI2_2DOF_99, k: int = 0
) -> Array:
    """Take a Gauss-Newton step from `h` (3, 3), the `k`-th linearized; returns `h` if the step is undetermined."""
    if image_K is None:
        return np.asarray(_homography_steps(linear, h[None], gate)[0])
    use, basis = linear.squared[k] < gate, pose_tangent(image_K, h)
    slope = (linear.slope[k] * use).reshape(9, -1)
    normal, right = basis.T @ (slope @ slope.T) @ basis, basis.T @ (slope @ linear.error[k].ravel())
    size = np.sqrt(np.maximum(np.diagonal(normal), 1e-300))
    try:
        along = np.linalg.solve(normal / size[:, None] / size + 1e-14 * np.eye(len(size)), right / size) / size
    except np.linalg.LinAlgError:
        return h
    moved = h - (basis @ along).reshape(3, 3)
    if np.count_nonzero(use) < 4 or not np.isfinite(moved).all():
        return h
    return np.asarray(nearest_poses(image_K, moved[None])[0], dtype=np.float64)


def scale_free_basis(h: Array) -> Array:
    """Build the orthonormal directions (9, 8) perpendicular to a homography (3, 3), whose scale is free."""
    # The reflection that takes the homography to an axis takes the other axes to its orthogonal complement (Householder).
    v = h.ravel() / np.linalg.norm(h)
    largest = int(np.argmax(np.abs(v)))
    v[largest] += np.sign(v[largest])
    across = [k for k in range(9) if k != largest]
    out = v[:, None] * (-v[across] / abs(v[largest]))
    out[across, range(8)] += 1.0
    return np.asarray(out)


def noise_factors(data: NormalizedCorrespondences, linear: Linearization, parameters: float = 8) -> tuple[float, float]:
    """Estimate from the inliers by which factors the noise of pixels and of ground positions exceeds the assumed one.

    `parameters` is the number of fitted parameters, subtracted from the degrees of freedom.

    Variance components by one step of Fisher scoring of the normal likelihood, with the assumed noise as prior.
    """
    use = linear.squared[0] < CHI2_2DOF_99
    count = int(use.sum())
    if 2 * count <= parameters:
        return 1.0, 1.0
    wu, wv, shear = (a[0, use] for a in linear.whiten)
    error = linear.error[0][:, use]
    # Inverse covariance, and the errors multiplied by it.
    icc = wv * wv
    iuv, iuu = -shear * icc, wu * wu + shear * shear * icc
    zv = wv * error[1]
    zu = wu * error[0] - shear * zv
    guu, guv, gvv = linear.ground[:, 0, use] * data.sigma_ground**2
    pixel = data.sigma_image**2
    # Inverse covariance times the covariance of the ground noise: a 2x2 matrix for each correspondence.
    auu, auv, avu, avv = iuu * guu + iuv * guv, iuu * guv + iuv * gvv, iuv * guu + icc * guv, iuv * guv + icc * gvv
    score = np.array([pixel * (zu @ zu + zv @ zv), (zu * zu) @ guu + 2 * (zu * zv) @ guv + (zv * zv) @ gvv])
    cross = float(pixel * (auu @ iuu + (auv + avu) @ iuv + avv @ icc))
    of_pixels, of_ground = pixel**2 * (iuu @ iuu + 2 * iuv @ iuv + icc @ icc), auu @ auu + 2 * auv @ avu + avv @ avv
    fisher = np.array([[of_pixels, cross], [cross, of_ground]])
    score *= 2 * count / (2 * count - parameters) / TRUNCATED_VARIANCE_SHARE
    variances = np.linalg.solve(fisher + NOISE_PRIOR_ROWS * np.eye(2), score + NOISE_PRIOR_ROWS)
    factors = np.sqrt(np.clip(variances, MAX_NOISE_FACTOR**-2, MAX_NOISE_FACTOR**2))
    return float(factors[0]), float(factors[1])
