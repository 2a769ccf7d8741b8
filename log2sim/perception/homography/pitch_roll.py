"""What a camera that pitches and rolls adds to the homography of its stream: two small angles a tick.

Angles are drawn to zero by how much the camera moves in the whole stream, so that ticks with few correspondences stay
near the stream's homography.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.perception.homography.pose import tangent, unit_pose
from log2sim.perception.homography.refine import Linearized, free_directions, linearize, noise
from log2sim.perception.homography.stream import BOUND, Stream

# How much a camera is believed to move before it is known: pixels along v, and angle of roll.
NOD_PX = 4.0
ROLL_RAD = 2e-3
ROUNDS = 5
MOST_CANDIDATES, MOST_VOTERS = 24, 96
# A movement is real where it is larger than noise makes it by more than so many standard deviations.
REAL = 3.0


@dataclass(frozen=True, eq=False)
class Moving:
    """A stream's homography (3, 3), ground to image in normalized units, the `warps` (T, 3, 3) of the image that come
    on top of it in each tick, the stream with its noise as found, the errors, and how many parameters were `spent` on
    angles, counted by how far these were left free.
    """

    image_H_ground: Array
    warps: Array
    stream: Stream
    at: Linearized
    spent: float


def fit_moving(stream: Stream, h: Array, image_K: Array | None) -> Moving:
    """Fit the stream's homography and the angles of each tick together, starting from `h` (3, 3).

    Notes
    -----
    Each tick's shift starts at the one of its correspondences that most others agree with. Then Gauss-Newton over the
    homography and all angles, which couple only through the homography, so that a tick costs a 2x2 system (Schur's
    complement); after each step noise and movement are estimated anew.
    """
    generators = _generators(stream, image_K)
    spread = np.array([NOD_PX * stream.image_N_px[0, 0], ROLL_RAD])
    angles = np.zeros((len(stream.start), 2))
    real = np.ones(2, dtype=bool)
    best = stream
    for k in range(ROUNDS):
        if k < 2:  # the second time with a homography and a spread that fit this camera
            angles[:, 0] = _agreed_shift(stream, h, spread[0])
        warps = _warps(generators, angles)
        at = linearize(best, h[None], warps[best.tick])
        h, angles, information = _step(best, h, angles, at, generators, spread, real, image_K)
        if k >= 1:
            best = best.with_noise(*noise(best, at, 8 + 2 * len(angles)))
        variance = 1.0 / (information + 1.0 / spread**2)
        if k == ROUNDS - 2:
            real = _is_real(angles, information, spread)
            angles = angles * real
        spread = np.sqrt(np.maximum((angles**2 + variance).mean(axis=0), spread**2 / 25))
    warps = _warps(generators, angles)
    spent = float((real * information * variance).sum())
    return Moving(h, warps, best, linearize(best, h[None], warps[best.tick]), spent)


def _is_real(angles: Array, information: Array, spread: Array) -> NDArray[np.bool_]:
    """Whether pitch and roll (2,) differ from zero over the ticks by more than noise makes them."""
    told = information > 0.01 / spread**2
    information = np.where(told, information, 1.0)
    # What was drawn to zero by the spread as it would be without that.
    free = angles * (1.0 + 1.0 / (spread**2 * information))
    excess = np.where(told, free**2 * information - 1.0, 0.0).sum(axis=0)
    return np.asarray(excess > REAL * np.sqrt(2.0 * np.maximum(told.sum(axis=0), 1)))


def _generators(stream: Stream, image_K: Array | None) -> Array:
    """Image motions (2, 3, 3) of pitch, as a shift along v, and of roll, in normalized units.

    Without intrinsics pitch shifts the image and roll turns it about the middle of the correspondences: for a tenth of a
    degree the difference is below a tenth of a pixel.
    """
    if image_K is None:
        return np.array([[[0, 0, 0], [0, 0, 1], [0, 0, 0]], [[0, -1, 0], [1, 0, 0], [0, 0, 0]]], dtype=np.float64)
    pitch = np.array([[0.0, 0, 0], [0, 0, 1], [0, -1, 0]]) / image_K[1, 1]
    roll = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 0]])
    return np.asarray(image_K @ np.array([pitch, roll]) @ np.linalg.inv(image_K))


def _warps(generators: Array, angles: Array) -> Array:
    """Homographies of the image (T, 3, 3) for angles (T, 2), to second order."""
    first = np.einsum("tk,kij->tij", angles, generators)
    return np.asarray(np.eye(3) + first + first @ first / 2)


def _agreed_shift(stream: Stream, h: Array, spread: float) -> Array:
    """Shift along v (T,) that most correspondences of a tick agree with, of those that one of them asks for."""
    at = linearize(stream, h[None])
    wu, wv, shear = at.whiten[:, 0]
    eu, ev = at.projected[0] - stream.image
    # Of ticks with very many correspondences an even part votes.
    count = stream.count[stream.tick]
    slots = np.minimum(count, MOST_VOTERS)
    column = (np.arange(len(count)) - stream.start[stream.tick]) * slots // count
    width = int(slots.max())
    table = np.full((3, len(stream.start), width), np.nan)
    table[:, stream.tick, column] = np.stack([-(ev - shear * eu), wv, (eu * wu) ** 2])
    asked, weight, aside = table
    some = asked[:, :: max(width // MOST_CANDIDATES, 1)]
    candidates = np.concatenate([np.zeros((len(asked), 1)), some], axis=1)
    apart = (asked[:, None, :] - candidates[:, :, None]) * weight[:, None, :]
    bounded = np.fmin(apart * apart + aside[:, None, :], BOUND)
    bounded[np.broadcast_to(np.isnan(asked)[:, None, :], bounded.shape)] = 0.0
    loss = bounded.sum(axis=2) + (candidates / spread) ** 2
    loss[np.isnan(candidates)] = np.inf
    return np.asarray(candidates[np.arange(len(asked)), np.argmin(loss, axis=1)])


def _step(
    stream: Stream,
    h: Array,
    angles: Array,
    at: Linearized,
    generators: Array,
    spread: Array,
    real: Array,
    image_K: Array | None,
) -> tuple[Array, Array, Array]:
    """One Gauss-Newton step: homography (3, 3), angles (T, 2), and the information (T, 2) that each tick has on them."""
    use = at.squared[0] < BOUND
    wide = at.slope[0] * use
    error = at.error[0] * use
    turn = _turn_slopes(at, generators) * use * real[:, None, None]
    basis = free_directions(h) if image_K is None else tangent(image_K, h)
    wide = (basis.T @ wide.reshape(9, -1)).reshape(-1, *wide.shape[1:])

    def by_tick(a: Array, b: Array) -> Array:
        """Products (T, n, m) of two sets of rows (n, 2, N), (m, 2, N), summed over each tick."""
        products = a[:, None, 0] * b[:, 0] + a[:, None, 1] * b[:, 1]
        return np.asarray(np.add.reduceat(products, stream.start, axis=-1).transpose(2, 0, 1))

    own = by_tick(turn, turn) + np.diag(1.0 / spread**2)
    shared = by_tick(wide, turn)
    pull = by_tick(turn, error[None])[:, :, 0] + angles / spread**2
    gain = shared @ np.linalg.inv(own)
    flat = wide.reshape(len(wide), -1)
    normal = flat @ flat.T - (gain @ shared.swapaxes(1, 2)).sum(axis=0)
    right = flat @ error.ravel() - (gain @ pull[:, :, None]).sum(axis=0)[:, 0]
    try:
        step = -np.linalg.solve(normal, right)
    except np.linalg.LinAlgError:
        step = np.zeros(len(right))
    turned = -np.linalg.solve(own, pull[:, :, None] + shared.swapaxes(1, 2) @ step[None, :, None])[:, :, 0]
    moved = h + (basis @ step).reshape(3, 3)
    moved = moved / np.linalg.norm(moved) if image_K is None else unit_pose(image_K, moved)
    information = np.diagonal(own, axis1=1, axis2=2) - 1.0 / spread**2
    return moved, (angles + turned) * real, information


def _turn_slopes(at: Linearized, generators: Array) -> Array:
    """Derivatives (2, 2, N) of the whitened errors by the two angles."""
    u, v = at.projected[0]
    wu, wv, shear = at.whiten[:, 0]
    out = np.empty((2, 2, len(u)))
    for k, g in enumerate(generators):
        away = g[2, 0] * u + g[2, 1] * v + g[2, 2]
        du = g[0, 0] * u + g[0, 1] * v + g[0, 2] - u * away
        dv = g[1, 0] * u + g[1, 1] * v + g[1, 2] - v * away
        out[k, 0] = du * wu
        out[k, 1] = (dv - shear * du) * wv
    return out
