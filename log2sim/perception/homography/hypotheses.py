"""Hypotheses of RANSAC: homographies through four correspondences, drawn, solved and scored many at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.perception.homography.stream import Stream, losses

# Of four points no three may lie on a line: twice the area of their smallest triangle, where the data have spread 1.
LEAST_AREA = 1e-7
COARSE_ROWS = 80
# Four noisy points miss the others by more than the noise, so hypotheses are scored with a wider bound.
WIDER = 2.0


def draw(stream: Stream, rng: np.random.Generator, count: int, *, across: bool) -> NDArray[np.int64]:
    """Rows (4, count) of correspondences of one tick each, or with `across` of any ticks; some rows may repeat."""
    rows, chance = stream.image.shape[1], rng.random((4, count))
    if across:
        return (chance * rows).astype(np.int64)
    # Larger ticks hold more sets of four, so a tick is drawn in proportion to its size.
    which = stream.tick[(rng.random(count) * rows).astype(np.int64)]
    return stream.start[which] + (chance * stream.count[which]).astype(np.int64)


def solve(stream: Stream, rows: NDArray[np.int64], keep: int) -> Array:
    """Homographies (K, 3, 3), ground to image, through four correspondences each (4, count).

    Left out are sets with three points on a line, and those with a point behind the camera. Of the rest the `keep` sets
    that spread farthest remain.

    Notes
    -----
    Three points are a basis in which the fourth has coordinates that are areas of triangles, so the homography that takes
    one such frame to the other needs no decomposition (Hartley & Zisserman, Multiple View Geometry, 2004, section 2.3).
    """
    at_image, at_ground = _areas(stream.image[:, rows]), _areas(stream.ground[:2, rows])
    least_image, least_ground = (np.abs(a).min(axis=0) for a in (at_image, at_ground))
    # Depths of the four points have one sign where signs of areas agree or disagree for all triangles alike.
    agree = (at_image * at_ground > 0).sum(axis=0)
    spread = least_image * least_ground
    sound = np.flatnonzero(((agree == 0) | (agree == 4)) & (least_image > LEAST_AREA) & (least_ground > LEAST_AREA))
    if len(sound) > keep:
        sound = sound[np.argpartition(-spread[sound], keep)[:keep]]
    depth = np.abs(at_image[:3, sound] / at_ground[:3, sound]) * np.sign(at_ground[3, sound])
    columns = np.empty((len(sound), 3, 3))
    columns[:, :2] = (stream.image[:, rows[:3, sound]] * depth).transpose(2, 0, 1)
    columns[:, 2] = depth.T
    return np.asarray(columns @ _dual(stream.ground[:2, rows[:3, sound]]), dtype=np.float64)


def _areas(points: Array) -> Array:
    """Twice the areas (4, count) of triangles of points (2, 4, count): with the fourth in place of one of three, and of these."""
    ax, bx, cx = points[0, 1:] - points[0, 0]
    ay, by, cy = points[1, 1:] - points[1, 0]
    ab, ac, bc = ax * by - ay * bx, ax * cy - ay * cx, bx * cy - by * cx
    return np.stack([ab - ac + bc, -bc, ac, ab])


def _dual(points: Array) -> Array:
    """Lines (count, 3, 3) through two of three points (2, 3, count) each: the adjugate of their frame."""
    out = np.empty((points.shape[2], 3, 3))
    for k in range(3):
        (ax, bx), (ay, by) = points[:, [(k + 1) % 3, (k + 2) % 3]]
        out[:, k, 0], out[:, k, 1], out[:, k, 2] = ay - by, bx - ax, ax * by - ay * bx
    return out


def best_hypotheses(stream: Stream, found: Array, rng: np.random.Generator, nod: float, keep: int) -> Array:
    """The `keep` best of homographies (K, 3, 3): all on some of the correspondences, the better ones on all."""
    rows = stream.image.shape[1]
    if rows > 2 * COARSE_ROWS and len(found) > 2 * keep:
        some = stream.coarse(np.sort(rng.permutation(rows)[:COARSE_ROWS]), WIDER)
        found = found[np.argsort(losses(some, found, nod), kind="stable")[: 2 * keep]]
    loss = losses(stream.coarse(slice(None), WIDER), found, nod)
    return np.asarray(found[np.argsort(loss, kind="stable")[:keep]])
