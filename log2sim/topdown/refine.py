"""Refinement of homographies over all of their inliers: Gauss-Newton on whitened errors with a bounded loss."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.topdown.stream import BOUND, Stream

# An estimate of the noise starts from what is believed of it, worth so many correspondences, and stays within a factor.
BELIEVED_ROWS = 20.0
NOISE_FACTOR = 4.0
# Of a normal error's square that is cut at BOUND so much remains.
CUT_SHARE = 0.953


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
    # Motion in the image (K, 2, 2, N) by motion on the ground.
    j = (h[:, :2, :2, None] - projected[:, :, None] * h[:, 2, None, :2, None]) * depth[:, None, None]
    ground = np.stack([(a * b).sum(axis=1) for a, b in ((j[:, 0], j[:, 0]), (j[:, 0], j[:, 1]), (j[:, 1], j[:, 1]))])
    cuu, cuv, cvv = stream.sigma_ground**2 * ground
    cuu += stream.sigma_image**2
    shear = cuv / cuu
    wu, wv = 1.0 / np.sqrt(cuu), 1.0 / np.sqrt(cvv + stream.sigma_image**2 - cuv * shear)
    error = projected - stream.image
    error[:, 1] -= shear * error[:, 0]
    error[:, 0] *= wu
    error[:, 1] *= wv
    squared = np.where(front, (error * error).sum(axis=1), np.inf)
    scaled = stream.ground * depth[:, None]
    slope = np.empty((count, 9, 2, stream.image.shape[1]))
    slope[:, 0:3, 0] = scaled * wu[:, None]
    slope[:, 3:6, 0] = 0.0
    slope[:, 6:9, 0] = slope[:, 0:3, 0] * -u[:, None]
    slope[:, 3:6, 1] = scaled * wv[:, None]
    slope[:, 0:3, 1] = slope[:, 3:6, 1] * -shear[:, None]
    slope[:, 6:9, 1] = slope[:, 3:6, 1] * (shear * u - v)[:, None]
    return Linearized(error, squared, slope, projected, ground, np.stack([wu, wv, shear]))


def refine_many(stream: Stream, h: Array, bounds: tuple[float, ...]) -> Array:
    """Gauss-Newton steps of homographies (K, 3, 3) at once, one for each of `bounds` on the squared error."""
    h = h / np.linalg.norm(h, axis=(1, 2), keepdims=True)
    for bound in bounds:
        at = linearize(stream, h)
        h = np.asarray(h + newton_steps(at, at.squared < bound, h))
        h /= np.linalg.norm(h, axis=(1, 2), keepdims=True)
    return h


def refine(stream: Stream, h: Array, rounds: int) -> tuple[Array, Linearized]:
    """The homography (3, 3) of least bounded loss near `h`, and its errors."""
    best = h / np.linalg.norm(h)
    at = linearize(stream, best[None])
    loss = float(np.minimum(at.squared, BOUND).sum())
    for _ in range(rounds):
        proposed = best + newton_steps(at, at.squared < BOUND, best[None])[0]
        proposed /= np.linalg.norm(proposed)
        there = linearize(stream, proposed[None])
        value = float(np.minimum(there.squared, BOUND).sum())
        if value >= loss:
            break
        gain, best, at, loss = loss - value, proposed, there, value
        if gain < 1e-4:
            break
    return best, at


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
