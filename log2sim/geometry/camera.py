"""Projection of points into images and back to rays, for pinhole cameras with and without lens distortion.

Models are OpenCV's: "brown" is Brown-Conrady with k1, k2, p1, p2, k3 and the rational k4..k6, "fisheye" is Kannala-Brandt.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

from log2sim.geometry.transforms import Array

NEAREST_DEPTH_M = 0.1
# Corners of a box joined by edges, as `geometry.box_corners` orders them; the last two cross out the front.
_EDGES = (
    (0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7),
    (0, 7), (3, 4),
)  # fmt: skip
# Undistortion: rays of the start table, and rounds of Newton's method, which doubles the digits of that start.
_TABLE = 1024
_ROUNDS = 12
_TOLERANCE_PX = 1e-6


def project(camera: Camera, points_cam: NDArray[np.floating[Any]]) -> tuple[Array, NDArray[np.bool_]]:
    """Project points (N, 3), m, cam frame.

    Returns
    -------
    uv_px : (N, 2) float64
        NaN where the point is not in front of the camera, or so far aside that the lens model has folded back.
    valid : (N,) bool
        In front of the camera and inside the image.
    """
    points = np.asarray(points_cam)
    front = points[:, 2] > NEAREST_DEPTH_M
    uv = np.full((len(points), 2), np.nan)
    xy = points[front, :2] / points[front, 2:]
    if _bends(camera):
        seen = _before_fold(camera, xy)
        xy = distort(camera, np.where(seen[:, None], xy, np.nan))
    uv[front] = xy @ camera.K[:2, :2].T + camera.K[:2, 2]
    with np.errstate(invalid="ignore"):
        inside = (uv[:, 0] >= 0) & (uv[:, 0] < camera.width_px) & (uv[:, 1] >= 0) & (uv[:, 1] < camera.height_px)
    return uv, inside


def box_lines(camera: Camera, corners_cam: Array) -> Array:
    """Edges (E, 2, 2) in px of a box with corners (8, 3) in the cam frame, clipped at the near plane.

    Notes
    -----
    A straight edge is bent by a distorting lens; it is cut into eight pieces then.
    """
    ends = np.array([[corners_cam[a], corners_cam[b]] for a, b in _EDGES])
    ends = ends[(ends[..., 2] > 1.01 * NEAREST_DEPTH_M).any(axis=1)]
    if len(ends) == 0:
        return np.zeros((0, 2, 2))
    near = 1.01 * NEAREST_DEPTH_M
    for a, b in ((0, 1), (1, 0)):
        behind = ends[:, a, 2] < near
        p, q = ends[behind, a], ends[behind, b]
        ends[behind, a] = q + (p - q) * ((q[:, 2] - near) / (q[:, 2] - p[:, 2]))[:, None]
    pieces = 1 if camera.distortion_model == "none" else 8
    f = np.linspace(0, 1, pieces + 1)[None, :, None]
    points = ends[:, None, 0] * (1 - f) + ends[:, None, 1] * f
    uv = project(camera, points.reshape(-1, 3))[0].reshape(len(ends), pieces + 1, 2)
    lines = np.stack([uv[:, :-1], uv[:, 1:]], axis=2).reshape(-1, 2, 2)
    low, high = lines.min(axis=1), lines.max(axis=1)
    touches = (high >= 0).all(axis=1) & (low[:, 0] < camera.width_px) & (low[:, 1] < camera.height_px)
    return np.asarray(lines[touches & np.isfinite(lines).all(axis=(1, 2))])


def _bends(camera: Camera) -> bool:
    return camera.distortion_model != "none" and any(camera.distortion)


def _before_fold(camera: Camera, xy: Array) -> NDArray[np.bool_]:
    """Whether rays (N, 2) lie where the lens model still moves outwards."""
    seen: NDArray[np.bool_] = (xy * xy).sum(axis=1) < fold_radius(camera) ** 2
    if camera.distortion_model == "brown":
        # The tangential terms fold too, but only far outside the view; thrice the view is seen by no such lens.
        half_view = 1.5 * np.array([camera.width_px / camera.K[0, 0], camera.height_px / camera.K[1, 1]])
        seen &= np.all(np.abs(xy) <= half_view, axis=1)
    return seen


def fold_radius(camera: Camera) -> float:
    """Radius in normalized coordinates up to which the lens model moves outwards; infinite when it always does.

    Notes
    -----
    Beyond it the polynomial turns back, so a point far outside the view would appear inside the image. It is the first
    zero of the derivative of the radial part, or the pole of the rational model.
    """
    return _fold_radius(camera.distortion_model, tuple(camera.distortion)) if _bends(camera) else float("inf")


@lru_cache(maxsize=256)
def _fold_radius(model: str, distortion: tuple[float, ...]) -> float:
    if model == "fisheye":
        k1, k2, k3, k4 = _padded(distortion, 4)
        angle_squared = _first_positive_root(Polynomial([1, 3 * k1, 5 * k2, 7 * k3, 9 * k4]))
        return float(np.tan(np.sqrt(angle_squared))) if angle_squared < (np.pi / 2) ** 2 else float("inf")
    k1, k2, _, _, k3, k4, k5, k6 = _padded(distortion, 8)
    above, below, s = Polynomial([1, k1, k2, k3]), Polynomial([1, k4, k5, k6]), Polynomial([0, 1])
    slope = (above + 2 * s * above.deriv()) * below - 2 * s * above * below.deriv()
    return float(np.sqrt(min(_first_positive_root(slope), _first_positive_root(below))))


def _first_positive_root(polynomial: Polynomial) -> float:
    roots = np.asarray(polynomial.trim().roots(), dtype=complex)
    real = roots.real[(np.abs(roots.imag) <= 1e-9 * np.abs(roots)) & (roots.real > 0)]
    return float(real.min()) if len(real) else float("inf")


def distort(camera: Camera, xy: Array) -> Array:
    """Apply the lens to normalized image coordinates (N, 2)."""
    if not _bends(camera):
        return xy
    x, y = xy[:, 0], xy[:, 1]
    r2 = x * x + y * y
    if camera.distortion_model == "fisheye":
        k1, k2, k3, k4 = _padded(camera.distortion, 4)
        r = np.sqrt(r2)
        angle = np.arctan(r)
        a2 = angle * angle
        bent = angle * (1 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))))
        scale = np.divide(bent, r, out=np.ones_like(r), where=r > 0)
        return xy * scale[:, None]
    k1, k2, p1, p2, k3, k4, k5, k6 = _padded(camera.distortion, 8)
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    return np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=1,
    )


def undistort(camera: Camera, uv_px: Array) -> Array:
    """Normalized image coordinates (N, 2) of pixels (N, 2): rays are (x, y, 1) in the cam frame.

    NaN for pixels that the lens model reaches from no ray in front of the camera before it folds back.

    Notes
    -----
    The radial part alone, inverted by table, starts Newton's method on the whole model. A fixed-point iteration would
    diverge where pixels move more than twice as far as rays, and creep near the fold.
    """
    target = (np.asarray(uv_px, dtype=np.float64) - camera.K[:2, 2]) @ np.linalg.inv(camera.K[:2, :2]).T
    if not _bends(camera):
        return target
    tolerance = _TOLERANCE_PX / max(camera.K[0, 0], camera.K[1, 1])
    xy = _radial_start(camera, target)
    for _ in range(_ROUNDS):
        error = distort(camera, xy) - target
        if not np.any(np.abs(error) > 1e-3 * tolerance):
            break
        xy = xy - _newton_step(camera, xy, error)
    error = np.abs(distort(camera, xy) - target).max(axis=1, initial=0.0)
    found = (error <= tolerance) & _before_fold(camera, xy)
    return np.where(found[:, None], xy, np.nan)


def _radial_start(camera: Camera, target: Array) -> Array:
    """Rays (N, 2) that the radial part of the lens bends to `target` (N, 2); the last one before the fold beyond it."""
    radius = np.tan(np.linspace(0.0, np.arctan(fold_radius(camera)), _TABLE))[:-1]
    ahead = np.column_stack([radius, np.zeros(_TABLE - 1)])
    # The odd part along x is the radial one; the tangential terms are even.
    bent = (distort(camera, ahead) - distort(camera, -ahead))[:, 0] / 2
    wanted = np.hypot(target[:, 0], target[:, 1])
    start = np.interp(wanted, np.maximum.accumulate(bent), radius)
    return np.asarray(target * np.divide(start, wanted, out=np.ones_like(wanted), where=wanted > 0)[:, None])


def _newton_step(camera: Camera, xy: Array, error: Array) -> Array:
    """Solve J step = error (N, 2) with the derivative of the lens taken by differences; 0 where it is singular."""
    width = 1e-6 * np.maximum(1.0, np.abs(xy).max(axis=1, initial=0.0))
    columns = []
    for axis in range(2):
        aside = np.zeros_like(xy)
        aside[:, axis] = width
        columns.append((distort(camera, xy + aside) - distort(camera, xy - aside)) / (2 * width[:, None]))
    (a, c), (b, d) = columns[0].T, columns[1].T
    determinant = a * d - b * c
    adjugate = np.stack([d * error[:, 0] - b * error[:, 1], a * error[:, 1] - c * error[:, 0]], axis=1)
    return np.divide(adjugate, determinant[:, None], out=np.zeros_like(xy), where=(determinant != 0)[:, None])


def _padded(coefficients: tuple[float, ...], count: int) -> tuple[float, ...]:
    return tuple(coefficients) + (0.0,) * (count - len(coefficients))


Mount = Literal["ego", "map"]


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera: `K` (3, 3) px, `mount_T_cam` (4, 4), distortion in OpenCV's order.

    `distortion_model` is "none", "brown" (k1, k2, p1, p2[, k3[, k4, k5, k6]]) or "fisheye" (k1..k4, Kannala-Brandt).
    """

    name: str
    width_px: int
    height_px: int
    K: Array
    mount: Mount
    mount_T_cam: Array
    distortion_model: str = "none"
    distortion: tuple[float, ...] = ()
