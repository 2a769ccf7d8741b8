"""Robust estimation of one homography from a stream: hypotheses, local optimization, noise, and whether to believe it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.topdown.hypotheses import best_hypotheses, draw, solve
from log2sim.topdown.pose import nearest_poses, refine_pose, tangent
from log2sim.topdown.refine import Linearized, linearize, noise, refine, refine_many
from log2sim.topdown.stream import BOUND, Stream, losses, normalization

# Sets of four that are drawn, how many of them are scored, and the share of inliers below which the next line is tried.
EFFORTS = ((500, 64, 0.36), (3000, 256, 0.0))
EFFORT_OF_A_FRAME = ((120, 48, 0.5), (500, 96, 0.0))
POLISHED = 4
POLISH_ROWS = 160
POLISH_BOUNDS = (4 * BOUND, 2 * BOUND, BOUND)
# Normalized DLT: s8/s1 is about 0.3 for spread points and 1e-17 for collinear ones.
LEAST_S8_S1 = 2e-3
LEAST_INLIERS = 6
LEAST_SHARE = 0.2
# A homography that is less sure than this share of the inliers' spread, at that distance from their middle, is none.
MOST_UNSURE = 0.25


@dataclass(frozen=True, eq=False)
class Found:
    """A homography (3, 3), ground to image in normalized units; the stream with its noise as found; the errors.

    `h` is None where no four correspondences determine one.
    """

    h: Array | None
    stream: Stream
    at: Linearized | None = None


def search(
    stream: Stream,
    rng: np.random.Generator,
    *,
    nod: float = 0.0,
    image_K: Array | None = None,
    efforts: tuple[tuple[int, int, float], ...] = EFFORTS,
) -> Found:
    """The homography that most correspondences agree with, refined over all of them.

    `nod`: standard deviation of a shift along v that is different in each tick; `image_K`: intrinsics, where known.
    """
    tried = np.zeros((0, 3, 3))
    for count, keep, share in efforts:
        rows = np.concatenate([draw(stream, rng, count // 2, across=a) for a in (False, True)], axis=1)
        found = solve(stream, rows, keep)
        if image_K is not None and len(found):
            found = nearest_poses(image_K, found)
            found = found[np.isfinite(found).all(axis=(1, 2))]
        if len(found):
            found = best_hypotheses(stream, found, rng, nod, POLISHED)
            tried = np.concatenate([tried, _polish(stream, found, rng, nod, image_K)])
            loss = losses(stream, tried, nod)
            tried = tried[np.argsort(loss, kind="stable")[:1]]
            if loss.min() < (1 - share) * BOUND:
                break
    if len(tried) == 0:
        return Found(None, stream)
    if nod:
        return Found(tried[0], stream)
    return settle(stream, tried[0], image_K)


def _polish(stream: Stream, found: Array, rng: np.random.Generator, nod: float, image_K: Array | None) -> Array:
    """A few steps of hypotheses (K, 3, 3) over some of the correspondences."""
    rows = stream.image.shape[1]
    part = stream if rows <= 2 * POLISH_ROWS else stream.take(np.sort(rng.permutation(rows)[:POLISH_ROWS]))
    part = replace(part, sigma_image=float(np.hypot(part.sigma_image, nod)))
    if image_K is None:
        return refine_many(part, found, POLISH_BOUNDS)
    return np.array([refine_pose(part, image_K, h, (*POLISH_BOUNDS, BOUND))[0] for h in found])


def settle(stream: Stream, h: Array, image_K: Array | None) -> Found:
    """Refine over all inliers, with the noise that they show."""
    for rounds in (2, 2, 3):
        if image_K is None:
            h, at = refine(stream, h, rounds)
        else:
            h, at = refine_pose(stream, image_K, h, (BOUND,) * (rounds + 1))
        if rounds == 2:
            stream = stream.with_noise(*noise(stream, at, 8 if image_K is None else 6))
    return Found(h, stream, linearize(stream, h[None]))


@dataclass(frozen=True)
class Health:
    """Whether a homography is believed, and why not; its condition s1/s8 and its own standard deviation on the ground."""

    ok: bool
    reason: str
    condition: float
    sigma_m: float


def judge(stream: Stream, h: Array, at: Linearized, image_K: Array | None) -> Health:
    """Judge a homography by how many correspondences agree with it and what these determine."""
    inliers, rows = at.squared[0] < BOUND, stream.image.shape[1]
    count = int(inliers.sum())
    least = 4 if rows < LEAST_INLIERS else LEAST_INLIERS
    needed = max(least, int(np.ceil(LEAST_SHARE * rows)))
    if count < needed:
        reason = f"{count} of {rows} correspondences agree, at least {needed} are needed"
        return Health(False, reason, float("inf"), float("inf"))
    s = singular_values(stream, inliers)
    condition = float(s[0] / s[7]) if s[7] > 0 else float("inf")
    if image_K is None and s[7] < LEAST_S8_S1 * s[0]:
        return Health(
            False, f"the {count} correspondences that agree lie on a line or a point", condition, float("inf")
        )
    unsure = predicted_sigma(stream, h, at, inliers, image_K)
    sigma_m = float(unsure[0] / stream.ground_N_m[0, 0])
    if not unsure[0] < MOST_UNSURE * unsure[1]:
        reason = (
            f"the {count} correspondences that agree do not determine a homography: it would be off by "
            f"{sigma_m:.1f} m where they spread over {unsure[1] / stream.ground_N_m[0, 0]:.1f} m"
        )
        return Health(False, reason, condition, sigma_m)
    return Health(True, "", condition, sigma_m)


def predicted_sigma(
    stream: Stream, h: Array, at: Linearized, use: NDArray[np.bool_], image_K: Array | None
) -> tuple[float, float]:
    """Standard deviation on the ground at one spread of the inliers from their middle, and that spread; normalized units."""
    basis = np.linalg.svd(h.reshape(1, 9))[2][1:].T if image_K is None else tangent(image_K, h)
    slope = basis.T @ (at.slope[0] * use).reshape(9, -1)
    normal = slope @ slope.T
    middle = stream.ground[:2, use].mean(axis=1)
    spread = float(np.sqrt(((stream.ground[:2, use] - middle[:, None]) ** 2).sum(axis=0).mean() / 2))
    size = np.sqrt(np.maximum(np.diagonal(normal), 1e-300))
    scaled = normal / size[:, None] / size
    if spread == 0 or not np.linalg.cond(scaled) < 1e13:
        return float("inf"), spread
    spread_of_h = basis @ (np.linalg.inv(scaled) / size[:, None] / size) @ basis.T
    probes = np.vstack([middle[:, None] + spread * np.array([[1.0, -1, 0, 0], [0, 0, 1, -1]]), np.ones((1, 4))])
    q = h @ probes
    worst = 0.0
    for p, (x, y, w) in zip(probes.T, q.T):
        if w <= 0:
            continue
        by_h = np.zeros((2, 9))
        by_h[0, 0:3] = by_h[1, 3:6] = p / w
        by_h[:, 6:] = -np.outer([x, y], p) / w**2
        by_ground = (h[:2, :2] - np.outer([x, y], h[2, :2]) / w) / w
        on_ground = np.linalg.solve(by_ground, by_h)
        worst = max(worst, float(np.trace(on_ground @ spread_of_h @ on_ground.T)))
    return float(np.sqrt(worst)) if worst > 0 else float("inf"), spread


def singular_values(stream: Stream, use: NDArray[np.bool_]) -> Array:
    """Singular values (9,), descending, of the DLT's design matrix of correspondences normalized among themselves."""
    uv, xy = stream.image[:, use].T, stream.ground[:2, use].T
    a, b = normalization(uv), normalization(xy)
    p = np.column_stack([uv * a[0, 0] + a[:2, 2], np.ones(len(uv))])
    x, y = (xy * b[0, 0] + b[:2, 2]).T
    one, by_x, by_y, by_both = ((p.T * w) @ p for w in (np.ones_like(x), -x, -y, x * x + y * y))
    zero = np.zeros((3, 3))
    gram = np.block([[one, zero, by_x], [zero, one, by_y], [by_x, by_y, by_both]])
    return np.sqrt(np.clip(np.linalg.eigvalsh(gram)[::-1], 0.0, None))
