"""Refinement of homographies over all of their inliers: Gauss-Newton on whitened errors with a bounded loss."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.perception.homography.pose import tangent, unit_pose
from log2sim.perception.homography.stream import BOUND, Stream

# An estimate of the noise starts from what is believed of it, worth so many correspondences, and stays within a factor.
BELIEVED_ROWS = 20.0
NOISE_FACTOR = 4.0
# Of a normal error's square that is cut at BOUND so much remains.
CUT_SHARE = 0.953
LEAST_GAIN = 0.02


@dataclass(frozen=True, eq=False)
class Linearized:
    """Errors at homographies and their derivatives.

    `error` (K, 2, N) in the image, `slope` (K, 9, 2, N) of it by the homography's elements, both whitened, `squared`
    (K, N), `projected` (K, 2, N), and what else the weights are made of: the `ground` part of the covariance (3, K, N)
    and the `whiten`ing (3, K, N).
    """

    error: Array
    squared: Array
    slope: Array
    projected: Array
    ground: Array
    whiten: Array


def linearize(stream: Stream, h: Array, warps: Array | None = None) -> Linearized:
    """Errors of homographies (K, 3, 3), ground to image, and their derivatives.

    `warps` (N, 3, 3) moves the image of each correspondence, as a pitching camera does; derivatives ignore that.
    """
    count = len(h)
    q = (h.reshape(-1, 3) @ stream.ground).reshape(count, 3, -1)
    if warps is not None:
        q = np.einsum("nij,kjn->kin", warps, q)
    front = q[:, 2] > 0
    depth = 1.0 / np.where(front, q[:, 2], 1.0)
    projected = q[:, :2] * depth[:, None]
    u, v = projected[:, 0], projected[:, 1]
    a, b, c = h[:, 0, :2, None] * depth[:, None], h[:, 1, :2, None] * depth[:, None], h[:, 2, :2, None] * depth[:, None]
    # Motion in the image (K, N) by motion on the ground, and the covariance that noise on the ground has there.
    ux, uy = a[:, 0] - u * c[:, 0], a[:, 1] - u * c[:, 1]
    vx, vy = b[:, 0] - v * c[:, 0], b[:, 1] - v * c[:, 1]
    ground = np.empty((3, count, len(stream.tick)))
    ground[0], ground[1], ground[2] = ux * ux + uy * uy, ux * vx + uy * vy, vx * vx + vy * vy
    cuu, cuv = stream.sigma_ground**2 * ground[:2]
    cuu += stream.sigma_image**2
    shear = cuv / cuu
    # The determinant is a sum of squares and so has no cancellation, even where a hypothesis folds the ground to a line.
    area = stream.sigma_image**2 * (cuu + stream.sigma_ground**2 * ground[2])
    area += stream.sigma_ground**4 * (ux * vy - uy * vx) ** 2
    whiten = np.empty_like(ground)
    np.sqrt(area, out=area)
    np.sqrt(cuu, out=cuu)
    wu = np.divide(1.0, cuu, out=whiten[0])
    wv = np.divide(cuu, area, out=whiten[1])
    whiten[2] = shear
    error = projected - stream.image
    error[:, 1] -= shear * error[:, 0]
    error[:, 0] *= wu
    error[:, 1] *= wv
    squared = error[:, 0] * error[:, 0] + error[:, 1] * error[:, 1]
    squared[~front] = np.inf
    scaled = stream.ground * depth[:, None]
    slope = np.empty((count, 9, 2, stream.image.shape[1]))
    np.multiply(scaled, wu[:, None], out=slope[:, 0:3, 0])
    slope[:, 3:6, 0] = 0.0
    np.multiply(slope[:, 0:3, 0], -u[:, None], out=slope[:, 6:9, 0])
    np.multiply(scaled, wv[:, None], out=slope[:, 3:6, 1])
    np.multiply(slope[:, 3:6, 1], -shear[:, None], out=slope[:, 0:3, 1])
    np.multiply(slope[:, 3:6, 1], (shear * u - v)[:, None], out=slope[:, 6:9, 1])
    return Linearized(error, squared, slope, projected, ground, whiten)


def refine_many(stream: Stream, h: Array, bounds: tuple[float, ...]) -> Array:
    """Gauss-Newton steps of homographies (K, 3, 3) at once, one for each of `bounds` on the squared error."""
    h = h / np.linalg.norm(h, axis=(1, 2), keepdims=True)
    for bound in bounds:
        at = linearize(stream, h)
        h = np.asarray(h + newton_steps(at, at.squared < bound, h))
        h /= np.linalg.norm(h, axis=(1, 2), keepdims=True)
    return h


def refine(stream: Stream, h: Array, rounds: int, image_K: Array | None = None) -> Array:
    """The homography (3, 3) of least bounded loss near `h`; with intrinsics `image_K` (3, 3) that of a camera."""
    at = linearize(stream, h[None])
    loss = float(np.minimum(at.squared, BOUND).sum())
    for _ in range(rounds):
        proposed = step(at, h, image_K)
        there = linearize(stream, proposed[None])
        value = float(np.minimum(there.squared, BOUND).sum())
        if value >= loss:
            break
        gain, h, at, loss = loss - value, proposed, there, value
        if gain < LEAST_GAIN:
            break
    return h


def step(at: Linearized, h: Array, image_K: Array | None = None, bound: float = BOUND, k: int = 0) -> Array:
    """A homography (3, 3) after a Gauss-Newton step from `h`, the `k`-th of those linearized; `h` where there is none."""
    use = at.squared[k] < bound
    basis = free_directions(h) if image_K is None else tangent(image_K, h)
    slope = (at.slope[k] * use).reshape(9, -1)
    normal, right = basis.T @ (slope @ slope.T) @ basis, basis.T @ (slope @ at.error[k].ravel())
    size = np.sqrt(np.maximum(np.diagonal(normal), 1e-300))
    try:
        along = np.linalg.solve(normal / size[:, None] / size + 1e-14 * np.eye(len(size)), right / size) / size
    except np.linalg.LinAlgError:
        return h
    moved = h - (basis @ along).reshape(3, 3)
    if np.count_nonzero(use) < 4 or not np.isfinite(moved).all():
        return h
    return moved / np.linalg.norm(moved) if image_K is None else unit_pose(image_K, moved)


def free_directions(h: Array) -> Array:
    """Directions (9, 8) across the scale of a homography (3, 3)."""
    # The reflection that takes the homography to an axis takes the other axes to what is across it (Householder).
    v = h.ravel() / np.linalg.norm(h)
    largest = int(np.argmax(np.abs(v)))
    v[largest] += np.sign(v[largest])
    across = [k for k in range(9) if k != largest]
    out = v[:, None] * (-v[across] / abs(v[largest]))
    out[across, range(8)] += 1.0
    return out


def newton_steps(at: Linearized, use: NDArray[np.bool_], h: Array) -> Array:
    """Gauss-Newton steps (K, 3, 3) over the correspondences in `use` (K, N); zero where these determine none."""
    count = len(h)
    slope = (at.slope * use[:, None, None]).reshape(count, 9, -1)
    normal, right = slope @ slope.swapaxes(1, 2), slope @ at.error.reshape(count, -1, 1)
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


def noise(stream: Stream, at: Linearized, parameters: int = 8) -> tuple[float, float]:
    """How many times larger than believed the noise of pixels and of ground positions is, from the inliers' errors.

    Notes
    -----
    Variance components by Fisher scoring of the normal likelihood; what was believed counts as some further inliers.
    """
    use = at.squared[0] < BOUND
    count = int(use.sum())
    if 2 * count <= parameters:
        return 1.0, 1.0
    wu, wv, shear = (a[0, use] for a in at.whiten)
    error = at.error[0][:, use]
    # Inverse covariance, and the errors through it.
    icc = wv * wv
    iuv, iuu = -shear * icc, wu * wu + shear * shear * icc
    zv = wv * error[1]
    zu = wu * error[0] - shear * zv
    guu, guv, gvv = at.ground[:, 0, use] * stream.sigma_ground**2
    pixel = stream.sigma_image**2
    # Covariance of the ground part through the inverse: a 2x2 matrix for each correspondence.
    auu, auv, avu, avv = iuu * guu + iuv * guv, iuu * guv + iuv * gvv, iuv * guu + icc * guv, iuv * guv + icc * gvv
    told = np.array([pixel * (zu @ zu + zv @ zv), (zu * zu) @ guu + 2 * (zu * zv) @ guv + (zv * zv) @ gvv])
    cross = float(pixel * (auu @ iuu + (auv + avu) @ iuv + avv @ icc))
    fisher = np.array(
        [
            [pixel**2 * (iuu @ iuu + 2 * iuv @ iuv + icc @ icc), cross],
            [cross, auu @ auu + 2 * auv @ avu + avv @ avv],
        ]
    )
    told *= 2 * count / (2 * count - parameters) / CUT_SHARE
    factors = np.linalg.solve(fisher + BELIEVED_ROWS * np.eye(2), told + BELIEVED_ROWS)
    within = np.sqrt(np.clip(factors, NOISE_FACTOR**-2, NOISE_FACTOR**2))
    return float(within[0]), float(within[1])
