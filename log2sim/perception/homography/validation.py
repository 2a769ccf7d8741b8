"""Acceptance of a fitted homography: enough inliers, and inliers that determine it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.perception.homography.normalized import CHI2_2DOF_99, NormalizedCorrespondences, normalize
from log2sim.perception.homography.planar_pose import pose_tangent
from log2sim.perception.homography.refine import Linearization, scale_free_basis

# Ratio of the eighth to the first singular value of the normalized DLT matrix: about 0.3 for points that spread over the
# view, 1e-17 for collinear points.
MIN_S8_S1 = 2e-3
# Six correspondences exceed the eight parameters by four equations; of fewer rows all four of a minimal sample.
MIN_INLIERS = 6
MIN_INLIER_SHARE = 0.2
# Largest predicted standard deviation on the ground, one spread of the inliers from their mean, as a share of the spread.
MAX_RELATIVE_SIGMA = 0.25
# Ground points at which it is predicted, in units of that spread.
PROBES = np.array([[1.0, -1.0, 0.0, 0.0], [0.0, 0.0, 1.0, -1.0]])


@dataclass(frozen=True)
class FitHealth:
    """Whether a homography is accepted.

    Attributes
    ----------
    ok : bool
    reason : str
        Why it is refused, "" otherwise.
    condition : float
        Ratio s1/s8 of the singular values of the normalized design matrix.
    sigma_m : float
        Predicted standard deviation on the ground, m, one spread of the inliers from their mean.
    """

    ok: bool
    reason: str
    condition: float
    sigma_m: float


def validate_fit(
    data: NormalizedCorrespondences,
    h: Array,
    linear: Linearization,
    image_K: Array | None,
    effective_parameters: float = 0.0,
) -> FitHealth:
    """Accept or refuse a homography (3, 3) by the number and the geometry of its inliers.

    Every two `effective_parameters` of single ticks make one correspondence an inlier without evidence, so as many
    inliers more are required.
    """
    inliers, rows = linear.squared[0] < CHI2_2DOF_99, data.image.shape[1]
    count = int(inliers.sum())
    minimum = 4 if rows < MIN_INLIERS else MIN_INLIERS
    absorbed = effective_parameters / 2
    needed = max(minimum, int(np.ceil(absorbed + MIN_INLIER_SHARE * (rows - absorbed))))
    if count < needed:
        reason = f"{count} of {rows} correspondences agree, at least {needed} are needed"
        return FitHealth(False, reason, float("inf"), float("inf"))
    s = singular_values(data, inliers)
    condition = float(s[0] / s[7]) if s[7] > 0 else float("inf")
    if image_K is None and s[7] < MIN_S8_S1 * s[0]:
        reason = f"the {count} correspondences that agree lie on a line or a point"
        return FitHealth(False, reason, condition, float("inf"))
    sigma, spread = predicted_sigma(data, h, linear, inliers, image_K)
    sigma_m = float(sigma / data.ground_N_m[0, 0])
    if not sigma < MAX_RELATIVE_SIGMA * spread:
        reason = (
            f"the {count} correspondences that agree do not determine a homography: it would be off by "
            f"{sigma_m:.1f} m where they spread over {spread / data.ground_N_m[0, 0]:.1f} m"
        )
        return FitHealth(False, reason, condition, sigma_m)
    return FitHealth(True, "", condition, sigma_m)


def predicted_sigma(
    data: NormalizedCorrespondences, h: Array, linear: Linearization, use: NDArray[np.bool_], image_K: Array | None
) -> tuple[float, float]:
    """Predict the standard deviation on the ground one spread of the inliers from their mean.

    Returns
    -------
    sigma, spread : float
        The standard deviation and that spread, normalized units.
    """
    basis = scale_free_basis(h) if image_K is None else pose_tangent(image_K, h)
    slope = (linear.slope[0] * use).reshape(9, -1)
    normal = basis.T @ (slope @ slope.T) @ basis
    ground_xy = data.ground[:2, use]
    mean = ground_xy.mean(axis=1, keepdims=True)
    spread = float(np.sqrt(((ground_xy - mean) ** 2).sum(axis=0).mean() / 2))
    size = np.sqrt(np.maximum(np.diagonal(normal), 1e-300))
    scaled = normal / size[:, None] / size
    try:
        inverse = np.linalg.inv(scaled)
    except np.linalg.LinAlgError:
        return float("inf"), spread
    if spread == 0 or not np.abs(inverse).max() < 1e13:
        return float("inf"), spread
    probes = np.vstack([mean + spread * PROBES, np.ones((1, 4))])
    q = h @ probes
    probes, q = probes[:, q[2] > 0], q[:, q[2] > 0]
    uv = q[:2] / q[2]
    by_h = np.zeros((probes.shape[1], 2, 9))
    by_h[:, 0, 0:3] = by_h[:, 1, 3:6] = (probes / q[2]).T
    by_h[:, :, 6:] = -uv.T[:, :, None] * by_h[:, :1, 0:3]
    by_ground = (h[:2, :2] - uv.T[:, :, None] * h[2, :2]) / q[2][:, None, None]
    by_parameters = np.linalg.solve(by_ground, by_h @ basis) / size
    variance = np.einsum("nij,jk,nik->n", by_parameters, inverse, by_parameters)
    return (float(np.sqrt(variance.max())) if len(variance) else float("inf")), spread


def singular_values(data: NormalizedCorrespondences, use: NDArray[np.bool_]) -> Array:
    """Compute the singular values (9,), descending, of the DLT matrix of the rows in `use`, normalized anew."""
    (u, v), (x, y) = (normalize(a[:2, use])[1] for a in (data.image, data.ground))
    p = np.stack([u, v, np.ones_like(u)])
    gram = np.zeros((9, 9))
    gram[0:3, 0:3] = gram[3:6, 3:6] = p @ p.T
    gram[0:3, 6:9] = gram[6:9, 0:3] = -(p * x) @ p.T
    gram[3:6, 6:9] = gram[6:9, 3:6] = -(p * y) @ p.T
    gram[6:9, 6:9] = (p * (x * x + y * y)) @ p.T
    return np.asarray(np.sqrt(np.clip(np.linalg.eigvalsh(gram)[::-1], 0.0, None)))
