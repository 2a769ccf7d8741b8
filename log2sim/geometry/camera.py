"""Projection of points into images and back to rays, also with lines exposed one after the other, and homographies of the ground.

The lens models are those of OpenCV: "brown" is Brown-Conrady with k1, k2, p1, p2, k3 and the rational k4..k6, "fisheye" is Kannala-Brandt.

A homography `ground_H_image` (3, 3) maps pixels (u, v, 1), free of lens distortion, to ground positions (x, y) in m. With
a third row that is positive below the horizon its sign tells which pixels see the ground.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import ArrayLike, NDArray

from log2sim.files.documents import short_repr
from log2sim.geometry.transforms import NS_PER_S, Array, apply, inverse

MIN_DEPTH_M = 0.1
"""Points nearer to the image plane, or behind it, are not projected."""

DISTORTION_LENGTHS: Mapping[str, tuple[int, ...]] = {"none": (0,), "brown": (4, 5, 8), "fisheye": (4,)}
"""How many values the distortion of a lens model may have."""

# Undistortion: entries of the table of initial values, iterations of Newton's method.
_TABLE_SIZE = 1024
_ITERATIONS = 12
_TOLERANCE_PX = 1e-6


Mount = Literal["ego", "map"]


@dataclass(frozen=True)
class RollingShutter:
    """Reading of an image line by line."""

    # Way in the image in which lines, or columns, are read one after the other
    direction: Literal["down", "up", "right", "left"]
    readout_s: float  # from the first line to the last


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera with lens distortion."""

    __repr__ = short_repr

    name: str
    width_px: int
    height_px: int
    K: Array  # (3, 3), px: camera matrix
    mount: Mount  # whether it is fixed on the vehicle or at the roadside
    mount_T_cam: Array  # (4, 4)
    distortion_model: str = "none"  # "none", "brown" or "fisheye"
    # In OpenCV's order: k1, k2, p1, p2[, k3[, k4, k5, k6]] for "brown", k1..k4 for "fisheye"
    distortion: tuple[float, ...] = ()
    rolling_shutter: RollingShutter | None = None  # None for a global shutter, or where the log does not state it

    @property
    def rectified(self) -> bool:
        """Whether the images are free of lens distortion."""
        return not _is_distorted(self)


def project(camera: Camera, points_cam: NDArray[np.floating[Any]]) -> tuple[Array, NDArray[np.bool_]]:
    """Project points (N, 3), m, cam frame.

    Returns `uv_px`: (N, 2): NaN for a point that is not in front of the camera, or outside the invertible range of the lens
    model; `valid`: (N,): in front of the camera and inside the image.
    """
    points = np.asarray(points_cam)
    front = points[:, 2] > MIN_DEPTH_M
    index = None if front.all() else np.flatnonzero(front)
    # Column by column: rows of two are slow.
    x, y, z = points.T if index is None else (column[index] for column in points.T)
    x, y = x / z, y / z
    if _is_distorted(camera):
        usable = _before_fold(camera, x, y)
        x, y = _distorted(camera, np.where(usable, x, np.nan), np.where(usable, y, np.nan))
    u, v = (row[0] * x + row[1] * y + row[2] for row in camera.K[:2])
    with np.errstate(invalid="ignore"):
        shown = (u >= 0) & (u < camera.width_px) & (v >= 0) & (v < camera.height_px)
    if index is None:
        return np.stack([u, v], axis=1), shown
    uv, inside = np.full((len(points), 2), np.nan), np.zeros(len(points), dtype=bool)
    uv[index, 0], uv[index, 1], inside[index] = u, v, shown
    return uv, inside


def _is_distorted(camera: Camera) -> bool:
    return camera.distortion_model != "none" and any(camera.distortion)


def _before_fold(camera: Camera, x: Array, y: Array) -> NDArray[np.bool_]:
    """Mark (N,) the rays at which the radius in the image still increases with that of the ray."""
    before: NDArray[np.bool_] = x * x + y * y < fold_radius(camera) ** 2
    if camera.distortion_model == "brown":
        # The tangential terms fold too, but only beyond three times the view.
        before &= np.abs(x) <= 1.5 * camera.width_px / camera.K[0, 0]
        before &= np.abs(y) <= 1.5 * camera.height_px / camera.K[1, 1]
    return before


def fold_radius(camera: Camera) -> float:
    """Compute the radius of rays, at depth 1, up to which the radius in the image increases; infinite when it always does.

    Beyond it a point far outside the view would be projected into the image. It is the first zero of the derivative of the
    radial part, or the pole of the rational model.
    """
    return _fold_radius(camera.distortion_model, tuple(camera.distortion)) if _is_distorted(camera) else float("inf")


@lru_cache(maxsize=256)
def _fold_radius(model: str, distortion: tuple[float, ...]) -> float:
    if not np.isfinite(distortion).all():
        return 0.0
    if model == "fisheye":
        k1, k2, k3, k4 = _padded(distortion, 4)
        angle_squared = _first_positive_root(Polynomial([1, 3 * k1, 5 * k2, 7 * k3, 9 * k4]))
        return float(np.tan(np.sqrt(angle_squared))) if angle_squared < (np.pi / 2) ** 2 else float("inf")
    k1, k2, _, _, k3, k4, k5, k6 = _padded(distortion, 8)
    above, below, s = Polynomial([1, k1, k2, k3]), Polynomial([1, k4, k5, k6]), Polynomial([0, 1])
    slope = (above + 2 * s * above.deriv()) * below - 2 * s * above * below.deriv()
    return float(np.sqrt(min(_first_positive_root(slope), _first_positive_root(below))))


def _first_positive_root(polynomial: Polynomial) -> float:
    """Find the smallest positive root of a polynomial that is 1 at 0; infinite without one, 0 where coefficients are not finite.

    Its inverse is a root of the polynomial of the reversed coefficients, whose leading one is 1: however small the last ones are,
    nothing is divided by them.
    """
    if not np.isfinite(polynomial.coef).all():
        return 0.0
    inverses = np.asarray(Polynomial(polynomial.coef[::-1]).roots(), dtype=complex)
    real = inverses.real[(np.abs(inverses.imag) <= 1e-9 * np.abs(inverses)) & (inverses.real > 0)]
    return float(1 / real.max()) if len(real) else float("inf")


def distort(camera: Camera, xy: Array) -> Array:
    """Apply the lens distortion to normalized image coordinates (N, 2)."""
    return np.stack(_distorted(camera, xy[:, 0], xy[:, 1]), axis=1) if _is_distorted(camera) else xy


def _distorted(camera: Camera, x: Array, y: Array) -> tuple[Array, Array]:
    """Apply the lens distortion to normalized image coordinates x (N,) and y (N,)."""
    r2 = x * x + y * y
    if camera.distortion_model == "fisheye":
        k1, k2, k3, k4 = _padded(camera.distortion, 4)
        r = np.sqrt(r2)
        angle = np.arctan(r)
        a2 = angle * angle
        bent = angle * (1 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))))
        scale = np.divide(bent, r, out=np.ones_like(r), where=r > 0)
        return x * scale, y * scale
    k1, k2, p1, p2, k3, k4, k5, k6 = _padded(camera.distortion, 8)
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    if k4 or k5 or k6:
        radial = radial / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    if not (p1 or p2):
        return x * radial, y * radial
    return (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y)


def undistort(camera: Camera, uv_px: Array) -> Array:
    """Compute normalized image coordinates (N, 2) of pixels (N, 2): rays are (x, y, 1) in the cam frame.

    NaN for pixels outside the invertible range of the lens model.

    Newton's method on the whole model, from the radial part inverted by a table. The usual fixed-point iteration diverges
    under strong distortion and converges slowly near the fold.
    """
    target = (np.asarray(uv_px, dtype=np.float64) - camera.K[:2, 2]) @ np.linalg.inv(camera.K[:2, :2]).T
    if not _is_distorted(camera):
        return target
    tolerance = _TOLERANCE_PX / max(camera.K[0, 0], camera.K[1, 1])
    # The radial part, which is odd in x where the tangential terms are even; beyond the fold the last ray before it.
    radius = np.tan(np.linspace(0.0, np.arctan(fold_radius(camera)), _TABLE_SIZE))[:-1]
    ahead = np.column_stack([radius, np.zeros(_TABLE_SIZE - 1)])
    bent = (distort(camera, ahead) - distort(camera, -ahead))[:, 0] / 2
    wanted = np.hypot(target[:, 0], target[:, 1])
    start = np.interp(wanted, np.maximum.accumulate(bent), radius)
    xy = target * np.divide(start, wanted, out=np.ones_like(wanted), where=wanted > 0)[:, None]
    for _ in range(_ITERATIONS):
        error = distort(camera, xy) - target
        if not np.any(np.abs(error) > 1e-3 * tolerance):
            break
        # J step = error, with the Jacobian J of the lens by central differences; no step where it is singular.
        width, columns = 1e-6 * np.maximum(1.0, np.abs(xy).max(axis=1, initial=0.0)), []
        for axis in range(2):
            aside = np.zeros_like(xy)
            aside[:, axis] = width
            columns.append((distort(camera, xy + aside) - distort(camera, xy - aside)) / (2 * width[:, None]))
        (a, c), (b, d) = columns[0].T, columns[1].T
        determinant = a * d - b * c
        adjugate = np.stack([d * error[:, 0] - b * error[:, 1], a * error[:, 1] - c * error[:, 0]], axis=1)
        regular = (determinant != 0)[:, None]
        xy = xy - np.divide(adjugate, determinant[:, None], out=np.zeros_like(xy), where=regular)
    error = np.abs(distort(camera, xy) - target).max(axis=1, initial=0.0)
    found = (error <= tolerance) & _before_fold(camera, xy[:, 0], xy[:, 1])
    return np.where(found[:, None], xy, np.nan)


def _padded(coefficients: tuple[float, ...], count: int) -> tuple[float, ...]:
    return tuple(coefficients) + (0.0,) * (count - len(coefficients))


# Poses during the readout; between them image coordinates are interpolated. A camera that turns at 1 rad/s with 2000 px focal
# length and 0.1 s of readout moves its image by 12 px between two of them, which interpolation follows to less than 0.1 px.
KNOTS = 17
ITERATIONS = 3


def line_time_s(camera: Camera, uv_px: Array) -> Array:
    """Compute when the lines of pixels (N, 2) are exposed, s (N,), relative to the middle of the image; 0 for a global shutter.

    Pixels outside the image take the time of its border, those of NaN that of the middle.
    """
    shutter = camera.rolling_shutter
    if shutter is None:
        return np.zeros(len(uv_px))
    along, size_px = (1, camera.height_px) if shutter.direction in ("down", "up") else (0, camera.width_px)
    share = np.nan_to_num(np.clip(uv_px[:, along] / size_px, 0.0, 1.0) - 0.5)
    sign = 1.0 if shutter.direction in ("down", "right") else -1.0
    return np.asarray(sign * shutter.readout_s * share)


def line_stamps_ns(camera: Camera, t_ns: int, uv_px: Array) -> NDArray[np.int64]:
    """Compute at which absolute stamps (N,) the lines of pixels (N, 2) of an image of the stamp `t_ns` are exposed."""
    return t_ns + np.round(line_time_s(camera, uv_px) * NS_PER_S).astype(np.int64)


def project_moving(
    camera: Camera, points: NDArray[np.floating[Any]], cam_T_points: Callable[[Array], Array]
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Project points (N, 3), m, through a camera that moves while its image is read.

    `points`: (N, 3), m: in a frame in which they stand still. `cam_T_points`: transforms (K, 4, 4) from that frame to the
    camera at times (K,), s, relative to the middle of the image.

    Returns `uv_px`: (N, 2): NaN where `project` gives NaN; `depth_m`: (N,): along the optical axis at the time of the point's
    line; `valid`: (N,): in front of the camera and inside the image.

    The line in which a point appears depends on the pose at the time of that line: a fixed point, found by iteration from the
    pose of the middle. It converges while the image of a point moves by less than the readout does.
    """
    shutter = camera.rolling_shutter
    if shutter is None or shutter.readout_s <= 0:
        local = apply(cam_T_points(np.zeros(1))[0], points)
        uv, valid = project(camera, local)
        return uv, local[:, 2], valid
    times = np.linspace(-0.5, 0.5, KNOTS) * shutter.readout_s
    transforms = cam_T_points(times)
    uv = project(camera, apply(transforms[KNOTS // 2], points))[0]
    depth = np.zeros(len(points))
    for _ in range(ITERATIONS):
        # Projections and depths by the two poses around the time of each line, interpolated.
        place = (line_time_s(camera, uv) / shutter.readout_s + 0.5) * (KNOTS - 1)
        before = np.minimum(place.astype(np.int64), KNOTS - 2)
        weight, uv, depth = place - before, np.zeros((len(points), 2)), np.zeros(len(points))
        for k in np.unique(before):
            rows = before == k
            for knot, share in ((k, 1 - weight[rows]), (k + 1, weight[rows])):
                local = apply(transforms[knot], points[rows])
                uv[rows] += share[:, None] * project(camera, local)[0]
                depth[rows] += share * local[:, 2]
    with np.errstate(invalid="ignore"):
        valid = np.all((uv >= 0) & (uv < [camera.width_px, camera.height_px]), axis=1)
    return uv, depth, valid


MIN_CAMERA_HEIGHT_M = 1e-3


def ground_homography(camera: Camera, dst_T_cam: Array, ground_z_m: float = 0.0) -> Array:
    """Compute `ground_H_image` (3, 3) of the plane z = `ground_z_m` from a camera's calibration.

    `camera`: its lens distortion does not enter: pixels are to be undistorted. `dst_T_cam` (4, 4): pose of the camera in the
    frame of the ground positions. `ground_z_m`: height of the ground in that frame, m. Returns (3, 3) float64: its third row,
    applied to a pixel, is the inverse depth of the ground seen there: positive below the horizon. Raises `ValueError` when
    the camera lies in the plane, which it then sees edge-on.
    """
    if abs(dst_T_cam[2, 3] - ground_z_m) < MIN_CAMERA_HEIGHT_M:
        plane = f"the ground plane z = {ground_z_m:g} m"
        raise ValueError(f"camera '{camera.name}' lies in {plane} and cannot look onto it")
    cam_T_dst = inverse(np.asarray(dst_T_cam, dtype=np.float64))
    r, t = cam_T_dst[:3, :3], cam_T_dst[:3, 3]
    image_H_ground = camera.K @ np.column_stack([r[:, 0], r[:, 1], r[:, 2] * ground_z_m + t])
    return np.linalg.inv(image_H_ground).astype(np.float64)


def apply_homography(ground_H_image: Array, uv_px: ArrayLike) -> tuple[Array, NDArray[np.bool_]]:
    """Map pixels (N, 2) to the ground.

    Returns `xy_m`: (N, 2): ground positions; NaN at and above the horizon; `below`: (N,): whether the pixels lie below it.
    """
    uv = np.asarray(uv_px, dtype=np.float64).reshape(-1, 2)
    q = uv @ ground_H_image[:, :2].T + ground_H_image[:, 2]
    below = q[:, 2] > 0
    return np.where(below[:, None], q[:, :2] / np.where(below, q[:, 2], 1.0)[:, None], np.nan), below


def homography_jacobian(ground_H_image: Array, uv_px: ArrayLike) -> Array:
    """Compute the derivatives (N, 2, 2) of ground positions by pixels (N, 2), m/px; unbounded at the horizon."""
    uv = np.asarray(uv_px, dtype=np.float64).reshape(-1, 2)
    q = uv @ ground_H_image[:, :2].T + ground_H_image[:, 2]
    xy = q[:, :2] / q[:, 2:]
    slope = ground_H_image[None, :2, :2] - xy[:, :, None] * ground_H_image[None, 2:, :2]
    return np.asarray(slope / q[:, 2, None, None])
