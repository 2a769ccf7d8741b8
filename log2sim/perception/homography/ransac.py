"""Robust estimation of one homography from a stream: hypotheses, local optimization, noise, and whether to believe it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.perception.homography.hypotheses import best_hypotheses, draw, solve
from log2sim.perception.homography.pose import nearest_poses, tangent
from log2sim.perception.homography.refine import (
    Linearized,
    free_directions,
    linearize,
    noise,
    refine,
    refine_many,
    step,
)
from log2sim.perception.homography.stream import BOUND, Stream, losses, normalized, squared_errors

Efforts = tuple[tuple[int, int, float], ...]
# Sets of four that are drawn, how many of them are scored, and the share of inliers below which the next line is tried.
EFFORTS = ((500, 64, 0.35), (3000, 256, 0.0))
EFFORT_OF_A_FRAME = ((120, 48, 0.5), (500, 96, 0.0))
POLISHED, POSES_POLISHED = 3, 2
POLISH_ROWS = 160
POLISH_BOUNDS = (4 * BOUND, 1.5 * BOUND)
# The pose nearest to a homography misses what that fits, most of all where correspondences are few.
POSE_BOUNDS = (100 * BOUND, 16 * BOUND, 4 * BOUND, BOUND)
# Normalized DLT: s8/s1 is about 0.3 for spread points and 1e-17 for collinear ones.
LEAST_S8_S1 = 2e-3
LEAST_INLIERS = 6
LEAST_SHARE = 0.2
# A homography that is less sure than this share of the inliers' spread, at that distance from their middle, is none.
MOST_UNSURE = 0.25
PROBES = np.array([[1.0, -1.0, 0.0, 0.0], [0.0, 0.0, 1.0, -1.0]])
NEAR_BOUND = 8 * BOUND
NOISE_ROUNDS, FINAL_ROUNDS = 1, 2


@dataclass(frozen=True, eq=False)
class Found:
    """A homography (3, 3), ground to image in normalized units; the stream with its noise as found; the errors.

    `h` is None where no four correspondences determine one; `warps` (N, 3, 3) is what each one's tick adds,
    with so many parameters `spent` on it.
    """

    h: Array | None
    stream: Stream
    at: Linearized | None = None
    warps: Array | None = None
    spent: float = 0.0


def search(
    stream: Stream,
    rng: np.random.Generator,
    *,
    nod: float = 0.0,
    image_K: Array | None = None,
    efforts: Efforts = EFFORTS,
) -> Found:
    """The homography that most correspondences agree with, refined over all of them.

    `nod`: standard deviation of a shift along v that is different in each tick; `image_K`: intrinsics, where known.
    """
    tried = np.zeros((0, 3, 3))
    for count, keep, share in efforts:
        rows = np.concatenate([draw(stream, rng, count // 2, across=a) for a in (False, True)], axis=1)
        found = solve(stream, rows, keep)
        if len(found):
            found = best_hypotheses(stream, found, rng, nod, POLISHED)
            tried = np.concatenate([tried, _polish(stream, found, rng, nod, image_K)])
        if len(tried):
            squared = squared_errors(stream, tried, nod)
            best = int(np.argmin(np.minimum(squared, BOUND).sum(axis=1)))
            tried = tried[[best]]
            if np.count_nonzero(squared[best] < BOUND) > share * squared.shape[1]:
                break
    if len(tried) == 0:
        return Found(None, stream)
    return Found(tried[0], stream) if nod else settle(stream, tried[0], image_K)


def _polish(stream: Stream, found: Array, rng: np.random.Generator, nod: float, image_K: Array | None) -> Array:
    """A few steps of hypotheses (K, 3, 3) over some of the correspondences."""
    rows = stream.image.shape[1]
    part = stream if rows <= 2 * POLISH_ROWS else stream.take(np.sort(rng.permutation(rows)[:POLISH_ROWS]))
    part = replace(part, sigma_image=float(np.hypot(part.sigma_image, nod)))
    found = refine_many(part, found, POLISH_BOUNDS)
    if image_K is None:
        return found
    poses = nearest_poses(image_K, found[np.argsort(losses(part, found), kind="stable")[:POSES_POLISHED]])
    poses = poses[np.isfinite(poses).all(axis=(1, 2))]
    for bound in POSE_BOUNDS if len(poses) else ():
        at = linearize(part, poses)
        poses = np.array([step(at, h, image_K, bound, k) for k, h in enumerate(poses)])
    return poses


def settle(stream: Stream, h: Array, image_K: Array | None) -> Found:
    """Refine over all inliers, with the noise that they show."""
    # What is far off now will not come into the bound; leaving it out saves half of the time among many outliers.
    near = np.flatnonzero(squared_errors(stream, h[None])[0] < NEAR_BOUND)
    if len(near) < 4:
        return Found(h, stream, linearize(stream, h[None]))
    part, parameters = stream.take(near), 8 if image_K is None else 6
    for _ in range(NOISE_ROUNDS):
        at = linearize(part, h[None])
        h = step(at, h, image_K)
        part = part.with_noise(*noise(part, at, parameters))
    h = refine(part, h, FINAL_ROUNDS, image_K)
    stream = replace(stream, sigma_image=part.sigma_image, sigma_ground=part.sigma_ground)
    return Found(h, stream, linearize(stream, h[None]))


@dataclass(frozen=True)
class Health:
    """Whether a homography is believed, and why not; its condition s1/s8 and its own standard deviation on the ground."""

    ok: bool
    reason: str
    condition: float
    sigma_m: float


def judge(stream: Stream, h: Array, at: Linearized, image_K: Array | None, spent: float = 0.0) -> Health:
    """Judge a homography by how many correspondences agree with it and what these determine.

    Two parameters `spent` on ticks make one correspondence agree that then proves nothing.
    """
    inliers, rows = at.squared[0] < BOUND, stream.image.shape[1]
    count = int(inliers.sum())
    least = 4 if rows < LEAST_INLIERS else LEAST_INLIERS
    needed = max(least, int(np.ceil(spent / 2 + LEAST_SHARE * (rows - spent / 2))))
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
    basis = free_directions(h) if image_K is None else tangent(image_K, h)
    slope = (at.slope[0] * use).reshape(9, -1)
    normal = basis.T @ (slope @ slope.T) @ basis
    places = stream.ground[:2, use]
    middle = places.mean(axis=1, keepdims=True)
    spread = float(np.sqrt(((places - middle) ** 2).sum(axis=0).mean() / 2))
    size = np.sqrt(np.maximum(np.diagonal(normal), 1e-300))
    scaled = normal / size[:, None] / size
    try:
        inverse = np.linalg.inv(scaled)
    except np.linalg.LinAlgError:
        return float("inf"), spread
    if spread == 0 or not np.abs(inverse).max() < 1e13:
        return float("inf"), spread
    probes = np.vstack([middle + spread * PROBES, np.ones((1, 4))])
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


def singular_values(stream: Stream, use: NDArray[np.bool_]) -> Array:
    """Singular values (9,), descending, of the DLT's design matrix of correspondences normalized among themselves."""
    (u, v), (x, y) = (normalized(a[:2, use])[1] for a in (stream.image, stream.ground))
    p = np.stack([u, v, np.ones_like(u)])
    gram = np.zeros((9, 9))
    gram[0:3, 0:3] = gram[3:6, 3:6] = p @ p.T
    gram[0:3, 6:9] = gram[6:9, 0:3] = -(p * x) @ p.T
    gram[3:6, 6:9] = gram[6:9, 3:6] = -(p * y) @ p.T
    gram[6:9, 6:9] = (p * (x * x + y * y)) @ p.T
    return np.sqrt(np.clip(np.linalg.eigvalsh(gram)[::-1], 0.0, None))
