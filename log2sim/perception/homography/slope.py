"""A road that changes its slope: two planes that meet in a line of the map, where held-out errors ask for them.

A homography holds for one plane. Where the road bends up or down ahead of a camera, what is beyond the bend is placed too far or
too near, by more than a tenth of its range for a few percent of slope. The line stays in the map while the ego drives toward it
and past it: beyond is what lies on the other side of the line than the ego.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from log2sim.files.arrays import Columns
from log2sim.geometry import CHI2_2DOF_99, Array
from log2sim.perception.homography.correspondences import Correspondences
from log2sim.perception.homography.estimate import FOOT_SIGMA_M, FOOT_SIGMA_PX, MIN_FEET
from log2sim.perception.homography.fit import HomographyFit, RoadSlope, by_elements
from log2sim.perception.homography.normalized import TRUNCATED_VARIANCE_SHARE, scale_free_basis, scaled
from log2sim.perception.homography.pitch_roll import (
    CHI2_2DOF_50,
    MIN_SIGNIFICANCE_SIGMA,
    HeldOutErrors,
    stabilized,
    stabilizing_warps,
)

# Lines that are tried: directions over half a circle, and places at quantiles of the correspondences; with fewer of them beyond
# than the first they do not tell a slope.
DIRECTIONS, QUANTILES = 12, np.linspace(0.1, 0.9, 12)
# The line is chosen anew so often, each time followed by so many steps; the last ones leave out rows beyond the gate.
SEARCHES, STEPS, LAST_STEPS = 3, 4, 4
# Standard deviations of one step: slope, m a meter; rotation of the line, rad; shift of the line, m. Roads have slopes of some
# percent, and lines are tried nearer to each other than these.
STEP_SIGMAS = np.array([0.1, 0.1, 3.0])
# Correspondences in a square of this size are held out together: an object that stands is off by the same at all ticks.
CELL_M = 4.0


@dataclass(frozen=True, eq=False)
class _Rows(Columns):
    """Correspondences of one camera."""

    uv: Array  # (N, 2): stabilized, px
    xy1: Array  # (N, 3): ground positions (x, y, 1), m, frame of the homography
    xy_map: Array  # (N, 2): the same in the map
    base_map: Array  # (N, 2): where the ego was, m, map
    whiten: Array  # (N, 2, 2): makes pixel errors of unit variance


@dataclass(frozen=True, eq=False)
class _Planes:
    """Two planes; one, where `change` is 0."""

    image_H_ground: Array  # (3, 3): of the plane under the ego
    change: float = 0.0  # slope beyond the line against it
    direction_rad: float = 0.0  # of the normal of the line in the map
    offset_m: float = 0.0  # of the line from the origin of the map

    @property
    def line(self) -> Array:
        return np.array([np.cos(self.direction_rad), np.sin(self.direction_rad), -self.offset_m])


def fit_slope(fit: HomographyFit, data: Correspondences, K: Array, map_T_base: dict[int, Array]) -> HomographyFit:
    """Fit two planes instead of one to correspondences, and keep them if they lower errors at places that are held out.

    `data`: of feet; ticks without a pose are left out. `K`: (3, 3). `map_T_base`: (4, 4) by tick, of the ground positions' frame.
    """
    known = np.isin(data.tick, list(map_T_base)) & np.isfinite(np.column_stack([data.uv, data.xy_ego])).all(axis=1)
    if not fit.ok or np.count_nonzero(known) < MIN_FEET:
        return fit
    data = data.take(known)
    rows = _rows(fit, data, map_T_base)
    start = _Planes(np.asarray(np.linalg.inv(fit.ground_H_image), dtype=np.float64))
    cell = np.floor(rows.xy_map / CELL_M).astype(np.int64)
    place, parity = np.unique(cell, axis=0, return_inverse=True)[1].ravel(), cell.sum(axis=1) % 2
    if np.bincount(parity, minlength=2).min() < MIN_FEET // 4:
        return fit
    # A bend that the ego comes near looks like an ego that pitches: two planes may also take the place of its angles, and do if
    # that is as good.
    kinds = [rows] if fit.per_tick is None else [replace(rows, uv=data.uv), rows]
    judged = [_held_out(rows, kind, start, K, place, parity) for kind in kinds]
    best = int(np.argmin([np.minimum(errors.squared[1], CHI2_2DOF_99).mean() for errors in judged]))
    significance = judged[best].significance()
    if not significance > MIN_SIGNIFICANCE_SIGMA:
        return fit
    planes, covariance = _refine(kinds[best], _search(kinds[best], start, K), K, two_planes=True)
    back = np.linalg.inv(planes.image_H_ground)
    size = np.linalg.norm(back[2])
    to_ground = -by_elements(back, back) / size
    before, after = np.median(judged[best].distance_px, axis=1).tolist()
    slope = RoadSlope(planes.line, planes.change, float(np.sqrt(covariance[9, 9])), (before, after), significance)
    h, keeps = back / size, fit.per_tick is not None and best == 1
    return replace(
        fit,
        ground_H_image=h,
        covariance=to_ground @ covariance[:9, :9] @ to_ground.T,
        per_tick=scaled(h @ stabilizing_warps(fit)) if keeps else None,
        tick_sigmas=h @ np.linalg.inv(fit.ground_H_image) @ fit.tick_sigmas
        if keeps and fit.tick_sigmas is not None
        else None,
        pitch_roll=fit.pitch_roll if keeps or fit.pitch_roll is None else replace(fit.pitch_roll, per_tick=False),
        slope=slope,
    )


def _held_out(
    rows: _Rows, bent: _Rows, start: _Planes, K: Array, place: NDArray[np.int64], parity: NDArray[np.int64]
) -> HeldOutErrors:
    """Compute the errors of rows with one plane, and of the same rows, `bent`, with two, each fitted to the places of the other half."""
    parts = []
    for k in range(2):
        training, test = parity != k, parity == k
        one = _refine(rows.take(training), start, K, two_planes=False)[0]
        errors = [_errors(rows.take(test), one, K), _errors(bent.take(test), _search(bent.take(training), start, K), K)]
        squared, distance = np.stack([(e**2).sum(axis=1) for e, _ in errors]), np.stack([d for _, d in errors])
        parts.append(HeldOutErrors(place[test], squared, distance))
    return HeldOutErrors.join(parts)


def slope_homography(
    slope: RoadSlope, ground_H_image: Array, K: Array, map_T_base: Array, uv: Array
) -> tuple[Array, Array] | None:
    """Return the homography (3, 3) of the plane beyond the line, and by how much it changes with one sigma of the slope (3, 3).

    `ground_H_image`: (3, 3), that of the plane under the ego. `K`: (3, 3). `map_T_base`: (4, 4), of the frame of the ground
    positions. None where a pixel `uv` (2,) shows the plane under the ego.
    """
    line = np.append(slope.line[:2] @ map_T_base[:2, :2], slope.line[:2] @ map_T_base[:2, 3] + slope.line[2])
    line = -line if line[2] > 0 else line
    # Its image divides the picture, also where the road rises above the horizon of the plane under the ego.
    if line @ ground_H_image @ [*uv, 1.0] <= 0:
        return None
    image_H_ground = np.asarray(np.linalg.inv(ground_H_image), dtype=np.float64)
    by_change = np.outer(image_of_up(image_H_ground, K), line)
    back = np.linalg.inv(image_H_ground + slope.change * by_change)
    size = np.linalg.norm(back[2])
    return back / size, -slope.sigma * back @ by_change @ back / size


def image_of_up(image_H_ground: Array, K: Array) -> Array:
    """Compute the image (3,) of the direction up in units of a homography (3, 3) of a camera with intrinsics (3, 3), px a meter."""
    x, y = (np.linalg.inv(K) @ image_H_ground)[:, :2].T
    return np.asarray(K @ np.cross(x, y) / np.sqrt(np.linalg.norm(x) * np.linalg.norm(y)))


def _rows(fit: HomographyFit, data: Correspondences, map_T_base: dict[int, Array]) -> _Rows:
    uv = data.uv if fit.per_tick is None else stabilized(data, fit).uv
    poses = np.array([map_T_base[t] for t in data.tick.tolist()])
    xy1 = np.column_stack([data.xy_ego, np.ones(len(data))])
    h = np.linalg.inv(fit.ground_H_image)
    q = xy1 @ h.T
    depth = np.where(q[:, 2:] > 0, q[:, 2:], np.inf)
    by_ground = (h[:2, :2] - (q[:, :2] / depth)[:, :, None] * h[2, :2]) / depth[:, :, None]
    covariance = FOOT_SIGMA_PX**2 * np.eye(2) + FOOT_SIGMA_M**2 * by_ground @ by_ground.swapaxes(1, 2)
    xy_map = (poses[:, :2, :2] @ data.xy_ego[:, :, None])[:, :, 0] + poses[:, :2, 3]
    return _Rows(uv, xy1, xy_map, poses[:, :2, 3], np.linalg.inv(np.linalg.cholesky(covariance)))


def _beyond(rows: _Rows, normal: Array, offset_m: Array) -> tuple[Array, Array]:
    """Compute how far (..., N) rows are beyond lines of normals (..., 2), 0 on the side of the ego, and where that grows: -1, 0, 1."""
    side = np.where(normal @ rows.base_map.T > offset_m[..., None], -1.0, 1.0)
    far = side * (normal @ rows.xy_map.T - offset_m[..., None])
    return np.maximum(far, 0.0), side * (far > 0)


def _project(rows: _Rows, planes: _Planes, K: Array) -> tuple[Array, Array, Array, Array]:
    """Return pixel errors (N, 2), whitened pixel changes by the image point (N, 2, 3), the image of up, and distances beyond."""
    up = image_of_up(planes.image_H_ground, K)
    beyond = _beyond(rows, planes.line[:2], np.array(planes.offset_m))[0]
    q = rows.xy1 @ planes.image_H_ground.T + planes.change * beyond[:, None] * up
    depth = np.where(q[:, 2:] > 0, q[:, 2:], np.nan)
    seen = q[:, :2] / depth
    by_point = np.concatenate([np.repeat(np.eye(2)[None], len(q), axis=0), -seen[:, :, None]], axis=2)
    return rows.uv - seen, rows.whiten @ (by_point / depth[:, :, None]), up, beyond


def _errors(rows: _Rows, planes: _Planes, K: Array) -> tuple[Array, Array]:
    """Return whitened errors (N, 2), and distances (N,), px; infinite behind the camera."""
    error = _project(rows, planes, K)[0]
    whitened = (rows.whiten @ error[:, :, None])[:, :, 0]
    return np.nan_to_num(whitened, nan=np.inf), np.nan_to_num(np.hypot(*error.T), nan=np.inf)


def _weights(squared: Array, *, gated: bool) -> tuple[Array, float]:
    """Return the weights (N,) of rows, and the variance of the noise; Cauchy's weights unless rows are left out by a gate."""
    variance = max(float(np.median(squared)) / CHI2_2DOF_50, 1e-12)
    if gated:
        return (squared < CHI2_2DOF_99 * variance).astype(np.float64), variance
    return 1 / (1 + squared / (4 * variance)), variance


def _by_homography(rows: _Rows, planes: _Planes, by_point: Array) -> Array:
    """Compute the derivatives (N, 2, 8) of whitened pixels by a homography across its scale."""
    by_h = (by_point[:, :, :, None] * rows.xy1[:, None, None, :]).reshape(len(rows.uv), 2, 9)
    return np.asarray(np.nan_to_num(by_h) @ scale_free_basis(planes.image_H_ground))


def _refine(rows: _Rows, planes: _Planes, K: Array, *, two_planes: bool) -> tuple[_Planes, Array]:
    """Take Gauss-Newton steps; returns the planes and the covariance (12, 12) of homography, slope, direction and offset."""
    for step in range(STEPS + LAST_STEPS):
        error, by_point, up, beyond = _project(rows, planes, K)
        whitened = np.nan_to_num((rows.whiten @ error[:, :, None])[:, :, 0], nan=1e6)
        weight, variance = _weights((whitened**2).sum(axis=1), gated=step >= STEPS)
        design = _by_homography(rows, planes, by_point)
        if two_planes:
            turn = np.array([-planes.line[1], planes.line[0]])
            grows = planes.change * _beyond(rows, planes.line[:2], np.array(planes.offset_m))[1]
            by_height = np.nan_to_num(by_point @ up)
            columns = np.stack([beyond, grows * (rows.xy_map @ turn), -grows], axis=1)
            design = np.concatenate([design, by_height[:, :, None] * columns[:, None, :]], axis=2)
        flat = (design * weight[:, None, None]).reshape(-1, design.shape[2])
        normal = flat.T @ design.reshape(-1, design.shape[2])
        prior = variance * STEP_SIGMAS**-2.0
        damped = normal + np.diag(np.append(np.zeros(8), prior)[: len(normal)])
        size = np.sqrt(np.maximum(np.diagonal(damped), 1e-24))
        inverse = np.linalg.inv(damped / size[:, None] / size + 1e-12 * np.eye(len(size))) / size[:, None] / size
        moved = inverse @ (flat.T @ whitened.ravel())
        basis = scale_free_basis(planes.image_H_ground)
        h = planes.image_H_ground + (basis @ moved[:8]).reshape(3, 3)
        more = moved[8:] if two_planes else np.zeros(3)
        planes = _Planes(h, planes.change + more[0], planes.direction_rad + more[1], planes.offset_m + more[2])
    spread = np.zeros((12, len(size)))
    spread[:9, :8] = basis
    spread[9:, 8:] = np.eye(3)[:, : len(size) - 8]
    return planes, variance / TRUNCATED_VARIANCE_SHARE * spread @ inverse @ spread.T


def _search(rows: _Rows, start: _Planes, K: Array) -> _Planes:
    """Find the two planes of least bounded error."""
    angle = np.repeat(np.arange(DIRECTIONS) * np.pi / DIRECTIONS, len(QUANTILES))
    normal = np.column_stack([np.cos(angle), np.sin(angle)])
    offset = np.quantile(normal[:: len(QUANTILES)] @ rows.xy_map.T, QUANTILES, axis=1).T.ravel()
    beyond = _beyond(rows, normal, offset)[0]
    best, least, planes = start, np.inf, start
    for _ in range(SEARCHES):
        # What each line explains of what the homography leaves, by the weights of the rows as they are (one slope each).
        error, by_point, up, own = _project(rows, planes, K)
        by_height = np.nan_to_num(by_point @ up)
        whitened = np.nan_to_num((rows.whiten @ error[:, :, None])[:, :, 0], nan=1e6)
        root = np.sqrt(_weights((whitened**2).sum(axis=1), gated=False)[0])
        across = np.linalg.qr((_by_homography(rows, planes, by_point) * root[:, None, None]).reshape(-1, 8))[0]
        left = ((whitened + planes.change * own[:, None] * by_height) * root[:, None]).ravel()
        columns = (beyond[:, :, None] * (by_height * root[:, None])[None]).reshape(len(beyond), -1)
        pull, inner = columns @ (left - across @ (across.T @ left)), columns @ across
        information = (columns**2).sum(axis=1) - (inner**2).sum(axis=1) + 1e-12
        k = int(np.argmax(pull**2 / information))
        begun = _Planes(planes.image_H_ground, float(pull[k] / information[k]), float(angle[k]), float(offset[k]))
        planes = _refine(rows, begun, K, two_planes=True)[0]
        squared = (_errors(rows, planes, K)[0] ** 2).sum(axis=1)
        loss = float(np.minimum(squared, CHI2_2DOF_99 * np.median(squared) / CHI2_2DOF_50).sum())
        if loss < least:
            best, least = planes, loss
    return best
