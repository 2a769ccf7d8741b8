"""RANSAC hypotheses: homographies through samples of four correspondences, drawn, solved and scored in batches."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.perception.homography.normalized import NormalizedCorrespondences, bounded_losses

# No three of four points may be collinear: twice the area of their smallest triangle, for data of spread 1.
MIN_TRIANGLE_AREA = 1e-7
# Rows that all hypotheses are scored on before the better ones are scored on all rows.
PRESCORE_ROWS = 80
# A homography through four noisy points misses the other points by more than the noise, so hypotheses are scored with
# standard deviations this much larger.
MINIMAL_SAMPLE_SIGMA_SCALE = 2.0


def draw_samples(
    data: NormalizedCorrespondences, rng: np.random.Generator, count: int, *, across_ticks: bool
) -> NDArray[np.int64]:
    """Draw rows (4, count), each sample from one tick or, with `across_ticks`, from all; rows may repeat."""
    rows, chance = data.image.shape[1], rng.random((4, count))
    if across_ticks:
        return np.asarray((chance * rows).astype(np.int64))
    # Larger ticks hold more samples of four, so a tick is drawn in proportion to its size.
    which = data.tick[(rng.random(count) * rows).astype(np.int64)]
    return np.asarray(data.start[which] + (chance * data.count[which]).astype(np.int64))


def solve_samples(data: NormalizedCorrespondences, rows: NDArray[np.int64], max_hypotheses: int) -> Array:
    """Solve for homographies (K, 3, 3), ground to image, through four correspondences each (4, count).

    Samples with three collinear points and samples with a point behind the camera are left out. Of the rest the
    `max_hypotheses` samples of the largest spread are kept.

    Notes
    -----
    Three points are a basis in which the fourth has coordinates that are areas of triangles, so the homography between
    two such bases needs no decomposition (Hartley & Zisserman, Multiple View Geometry, 2004, section 2.3).
    """
    in_image, on_ground = _triangle_areas(data.image[:, rows]), _triangle_areas(data.ground[:2, rows])
    min_image, min_ground = (np.abs(a).min(axis=0) for a in (in_image, on_ground))
    # The depths of the four points have one sign if the signs of the areas agree, or disagree, for all triangles.
    agree = (in_image * on_ground > 0).sum(axis=0)
    spread = min_image * min_ground
    one_side = (agree == 0) | (agree == 4)
    usable = np.flatnonzero(one_side & (min_image > MIN_TRIANGLE_AREA) & (min_ground > MIN_TRIANGLE_AREA))
    if len(usable) > max_hypotheses:
        usable = usable[np.argpartition(-spread[usable], max_hypotheses)[:max_hypotheses]]
    depth = np.abs(in_image[:3, usable] / on_ground[:3, usable]) * np.sign(on_ground[3, usable])
    columns = np.empty((len(usable), 3, 3))
    columns[:, :2] = (data.image[:, rows[:3, usable]] * depth).transpose(2, 0, 1)
    columns[:, 2] = depth.T
    return np.asarray(columns @ _adjugate(data.ground[:2, rows[:3, usable]]), dtype=np.float64)


def _triangle_areas(points: Array) -> Array:
    """Compute twice the signed areas (4, count) of the triangles of points (2, 4, count).

    In rows 0 to 2 the fourth point replaces one of the first three; row 3 is the triangle of the first three.
    """
    ax, bx, cx = points[0, 1:] - points[0, 0]
    ay, by, cy = points[1, 1:] - points[1, 0]
    ab, ac, bc = ax * by - ay * bx, ax * cy - ay * cx, bx * cy - by * cx
    return np.stack([ab - ac + bc, -bc, ac, ab])


def _adjugate(points: Array) -> Array:
    """Compute the adjugates (count, 3, 3) of the homogeneous matrices of three points (2, 3, count) each."""
    out = np.empty((points.shape[2], 3, 3))
    for k in range(3):
        (ax, bx), (ay, by) = points[:, [(k + 1) % 3, (k + 2) % 3]]
        out[:, k, 0], out[:, k, 1], out[:, k, 2] = ay - by, bx - ax, ax * by - ay * bx
    return out


def best_hypotheses(
    data: NormalizedCorrespondences, h: Array, rng: np.random.Generator, pitch_sigma: float, count: int
) -> Array:
    """Return the `count` homographies (K, 3, 3) of least bounded loss; only the best on some rows are scored on all."""
    rows = data.image.shape[1]
    if rows > 2 * PRESCORE_ROWS and len(h) > 2 * count:
        some = data.coarse(np.sort(rng.permutation(rows)[:PRESCORE_ROWS]), MINIMAL_SAMPLE_SIGMA_SCALE)
        h = h[np.argsort(bounded_losses(some, h, pitch_sigma), kind="stable")[: 2 * count]]
    loss = bounded_losses(data.coarse(slice(None), MINIMAL_SAMPLE_SIGMA_SCALE), h, pitch_sigma)
    return np.asarray(h[np.argsort(loss, kind="stable")[:count]])
