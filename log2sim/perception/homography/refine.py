"""Refinement of homographies over all of their inliers: Gauss-Newton on whitened errors with a bounded loss."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.perception.homography.normalized import CHI2_2DOF_99, NormalizedCorrespondences
from log2sim.perception.homography.planar_pose import nearest_unit_pose, pose_tangent

# The assumed noise counts as a prior worth this many correspondences; an estimate departs from it by this factor at most.
NOISE_PRIOR_ROWS = 20.0
MAX_NOISE_FACTOR = 4.0
# E[x^2 | x^2 < 9.21] / 2 for a chi-squared variable with 2 degrees of freedom: 1 - 4.605 * 0.01 / 0.99.
TRUNCATED_VARIANCE_SHARE = 0.953
# Refinement ends when the summed squared error falls by less than this.
MIN_LOSS_DECREASE = 0.02


@dataclass(frozen=True, eq=False)
class Linearization:
    """Errors of K homographies on N correspondences, linearized, in normalized units.

    Attributes
    ----------
    error : (K, 2, N) float64
        Whitened errors in the image.
    squared : (K, N) float64
        Squared norms of `error`; infinite behind the camera.
    slope : (K, 9, 2, N) float64
        Derivatives of `error` by the nine elements of the homography.
    projected : (K, 2, N) float64
        Ground positions projected into the image.
    ground : (3, K, N) float64
        Covariance in the image (uu, uv, vv) of ground noise of standard deviation 1.
    whiten : (3, K, N) float64
        Cholesky factors of the inverse covariance: scale of u, scale of v, and the shear of v by u.
    """

    error: Array
    squared: Array
    slope: Array
    projected: Array
    ground: Array
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
    """Take one Gauss-Newton step of all homographies (K, 3, 3) for each of `gates` on the squared error."""
    h = h / np.linalg.norm(h, axis=(1, 2), keepdims=True)
    for gate in gates:
        linear = linearize(data, h)
        h = np.asarray(h + newton_steps(linear, linear.squared < gate, h))
        h /= np.linalg.norm(h, axis=(1, 2), keepdims=True)
    return h


def refine(data: NormalizedCorrespondences, h: Array, rounds: int, image_K: Array | None = None) -> Array:
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
    return h


def newton_step(
    linear: Linearization, h: Array, image_K: Array | None = None, gate: float = CHI2_2DOF_99, k: int = 0
) -> Array:
    """Take a Gauss-Newton step from `h` (3, 3), the `k`-th linearized; returns `h` if the step is undetermined."""
    use = linear.squared[k] < gate
    basis = scale_free_basis(h) if image_K is None else pose_tangent(image_K, h)
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
    return np.asarray(moved / np.linalg.norm(moved)) if image_K is None else nearest_unit_pose(image_K, moved)


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


def newton_steps(linear: Linearization, use: NDArray[np.bool_], h: Array) -> Array:
    """Compute Gauss-Newton steps (K, 3, 3) over the correspondences in `use` (K, N); zero where undetermined."""
    count = len(h)
    slope = (linear.slope * use[:, None, None]).reshape(count, 9, -1)
    normal, right = slope @ slope.swapaxes(1, 2), slope @ linear.error.reshape(count, -1, 1)
    # The scale of a homography is free: steps are taken across it, never along it.
    along = h.reshape(count, 9, 1)
    size = np.trace(normal, axis1=1, axis2=2)[:, None, None] / 9
    normal += size * (along @ along.swapaxes(1, 2)) + 1e-14 * size * np.eye(9)
    enough = np.count_nonzero(use, axis=1) >= 4
    normal[~enough] = np.eye(9)
    try:
        step = -np.linalg.solve(normal, right).reshape(count, 3, 3)
    except np.linalg.LinAlgError:
        return np.zeros((count, 3, 3))
    return np.where((enough & np.isfinite(step).all(axis=(1, 2)))[:, None, None], step, 0.0)


def noise_factors(data: NormalizedCorrespondences, linear: Linearization, parameters: float = 8) -> tuple[float, float]:
    """Estimate from the inliers by which factors the noise of pixels and of ground positions exceeds the assumed one.

    `parameters` is the number of fitted parameters, subtracted from the degrees of freedom.

    Notes
    -----
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
    fisher = np.array(
        [
            [pixel**2 * (iuu @ iuu + 2 * iuv @ iuv + icc @ icc), cross],
            [cross, auu @ auu + 2 * auv @ avu + avv @ avv],
        ]
    )
    score *= 2 * count / (2 * count - parameters) / TRUNCATED_VARIANCE_SHARE
    variances = np.linalg.solve(fisher + NOISE_PRIOR_ROWS * np.eye(2), score + NOISE_PRIOR_ROWS)
    factors = np.sqrt(np.clip(variances, MAX_NOISE_FACTOR**-2, MAX_NOISE_FACTOR**2))
    return float(factors[0]), float(factors[1])
