"""Pitch and roll of a camera in each tick, on top of the homography of its stream.

The two angles of a tick have a zero-mean normal prior whose standard deviation is estimated from all ticks (empirical
Bayes), so that ticks with few correspondences stay near the stream's homography.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.perception.homography.normalized import CHI2_2DOF_99, NormalizedCorrespondences
from log2sim.perception.homography.planar_pose import nearest_unit_pose, pose_tangent
from log2sim.perception.homography.refine import Linearization, linearize, noise_factors, scale_free_basis

# Standard deviations of pitch, as a shift along v, and of roll, before they are estimated.
PITCH_SIGMA_PX = 4.0
ROLL_SIGMA_RAD = 2e-3
ROUNDS = 5
# Of the shifts that single correspondences of a tick ask for so many are tried, each against so many correspondences.
MAX_CANDIDATES, MAX_VOTERS = 24, 96
# Angles count as movement when their chi-squared statistic exceeds its mean by this many standard deviations.
MIN_SIGNIFICANCE_SIGMA = 3.0


@dataclass(frozen=True, eq=False)
class _Angles:
    """Angles of all ticks.

    Attributes
    ----------
    value : (T, 2) float64
        Pitch, as a shift along v in normalized units or rad, and roll, rad.
    sigma : (2,) float64
        Standard deviations of their priors.
    significant : (2,) bool
        Whether they are fitted at all.
    generators : (2, 3, 3) float64
        Image motions by an angle of 1.
    """

    value: Array
    sigma: Array
    significant: NDArray[np.bool_]
    generators: Array

    def warps(self) -> Array:
        """Build the image homographies (T, 3, 3), to second order."""
        first = np.einsum("tk,kij->tij", self.value, self.generators)
        return np.asarray(np.eye(3) + first + first @ first / 2)


@dataclass(frozen=True, eq=False)
class PitchRollFit:
    """A stream's homography with pitch and roll of each tick, in normalized units.

    Attributes
    ----------
    image_H_ground : (3, 3) float64
        Homography of the stream.
    warps : (T, 3, 3) float64
        Image homography of each tick on top of it.
    data : NormalizedCorrespondences
        All correspondences, with the noise as estimated.
    linear : Linearization
        Errors of the final homographies.
    effective_parameters : float
        Effective number of parameters of the angles: each counts by how little the prior determines it.
    """

    image_H_ground: Array
    warps: Array
    data: NormalizedCorrespondences
    linear: Linearization
    effective_parameters: float


def fit_pitch_roll(data: NormalizedCorrespondences, h: Array, image_K: Array | None) -> PitchRollFit:
    """Fit the stream's homography and the angles of all ticks together, starting from `h` (3, 3).

    Notes
    -----
    Each tick's shift starts at the candidate that most of its correspondences agree with. Then Gauss-Newton over the
    homography and all angles, which are coupled only through the homography, so that a tick costs a 2x2 system (Schur's
    complement). Noise and standard deviations of the angles are estimated anew after each step.
    """
    sigma = np.array([PITCH_SIGMA_PX * data.image_N_px[0, 0], ROLL_SIGMA_RAD])
    angles = _Angles(np.zeros((len(data.start), 2)), sigma, np.ones(2, dtype=bool), _generators(data, image_K))
    noisy = data
    for k in range(ROUNDS):
        if k < 2:  # again in the second round, with the homography and the standard deviation fitted in the first
            shift = _consensus_shift(data, h, angles.sigma[0])
            angles = replace(angles, value=np.column_stack([shift, angles.value[:, 1]]))
        linear = linearize(noisy, h[None], angles.warps()[noisy.tick])
        h, angles, information = _step(noisy, h, linear, angles, image_K)
        if k >= 1:
            noisy = noisy.with_noise(*noise_factors(noisy, linear, 8 + 2 * len(angles.value)))
        variance = 1.0 / (information + 1.0 / angles.sigma**2)
        if k == ROUNDS - 2:
            significant = _is_significant(angles, information)
            angles = replace(angles, value=angles.value * significant, significant=significant)
        sigma = np.sqrt(np.maximum((angles.value**2 + variance).mean(axis=0), angles.sigma**2 / 25))
        angles = replace(angles, sigma=sigma)
    warps = angles.warps()
    effective_parameters = float((angles.significant * information * variance).sum())
    return PitchRollFit(h, warps, noisy, linearize(noisy, h[None], warps[noisy.tick]), effective_parameters)


def _is_significant(angles: _Angles, information: Array) -> NDArray[np.bool_]:
    """Test whether pitch and roll (2,) differ from zero over the ticks by more than noise explains."""
    sigma = angles.sigma
    informed = information > 0.01 / sigma**2
    information = np.where(informed, information, 1.0)
    # The estimates as they would be without the prior, which shrinks them.
    unshrunk = angles.value * (1.0 + 1.0 / (sigma**2 * information))
    excess = np.where(informed, unshrunk**2 * information - 1.0, 0.0).sum(axis=0)
    return np.asarray(excess > MIN_SIGNIFICANCE_SIGMA * np.sqrt(2.0 * np.maximum(informed.sum(axis=0), 1)))


def _generators(data: NormalizedCorrespondences, image_K: Array | None) -> Array:
    """Build the image motions (2, 3, 3) of pitch, as a shift along v, and of roll, in normalized units.

    Without intrinsics pitch shifts the image and roll rotates it about the mean of the correspondences: for a tenth of a
    degree the difference is below a tenth of a pixel.
    """
    if image_K is None:
        return np.array([[[0, 0, 0], [0, 0, 1], [0, 0, 0]], [[0, -1, 0], [1, 0, 0], [0, 0, 0]]], dtype=np.float64)
    pitch = np.array([[0.0, 0, 0], [0, 0, 1], [0, -1, 0]]) / image_K[1, 1]
    roll = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 0]])
    return np.asarray(image_K @ np.array([pitch, roll]) @ np.linalg.inv(image_K))


def _consensus_shift(data: NormalizedCorrespondences, h: Array, sigma: float) -> Array:
    """Find the shift along v (T,) of least bounded loss in each tick, among those that its correspondences ask for."""
    linear = linearize(data, h[None])
    wu, wv, shear = linear.whiten[:, 0]
    eu, ev = linear.projected[0] - data.image
    # In ticks with very many correspondences an even selection votes.
    count = data.count[data.tick]
    slots = np.minimum(count, MAX_VOTERS)
    column = (np.arange(len(count)) - data.start[data.tick]) * slots // count
    width = int(slots.max())
    table = np.full((3, len(data.start), width), np.nan)
    table[:, data.tick, column] = np.stack([-(ev - shear * eu), wv, (eu * wu) ** 2])
    asked, weight, squared_u = table
    some = asked[:, :: max(width // MAX_CANDIDATES, 1)]
    candidates = np.concatenate([np.zeros((len(asked), 1)), some], axis=1)
    residual = (asked[:, None, :] - candidates[:, :, None]) * weight[:, None, :]
    bounded = np.fmin(residual * residual + squared_u[:, None, :], CHI2_2DOF_99)
    bounded[np.broadcast_to(np.isnan(asked)[:, None, :], bounded.shape)] = 0.0
    loss = bounded.sum(axis=2) + (candidates / sigma) ** 2
    loss[np.isnan(candidates)] = np.inf
    return np.asarray(candidates[np.arange(len(asked)), np.argmin(loss, axis=1)])


def _step(
    data: NormalizedCorrespondences, h: Array, linear: Linearization, angles: _Angles, image_K: Array | None
) -> tuple[Array, _Angles, Array]:
    """Take one Gauss-Newton step: homography (3, 3), angles, and the information (T, 2) of each tick on them."""
    use = linear.squared[0] < CHI2_2DOF_99
    by_h = linear.slope[0] * use
    error = linear.error[0] * use
    by_angle = _angle_slopes(linear, angles.generators) * use * angles.significant[:, None, None]
    basis = scale_free_basis(h) if image_K is None else pose_tangent(image_K, h)
    by_h = (basis.T @ by_h.reshape(9, -1)).reshape(-1, *by_h.shape[1:])

    def by_tick(a: Array, b: Array) -> Array:
        """Sum the products (T, n, m) of two sets of rows (n, 2, N), (m, 2, N) over each tick."""
        products = a[:, None, 0] * b[:, 0] + a[:, None, 1] * b[:, 1]
        return np.asarray(np.add.reduceat(products, data.start, axis=-1).transpose(2, 0, 1))

    own = by_tick(by_angle, by_angle) + np.diag(1.0 / angles.sigma**2)
    shared = by_tick(by_h, by_angle)
    pull = by_tick(by_angle, error[None])[:, :, 0] + angles.value / angles.sigma**2
    gain = shared @ np.linalg.inv(own)
    flat = by_h.reshape(len(by_h), -1)
    normal = flat @ flat.T - (gain @ shared.swapaxes(1, 2)).sum(axis=0)
    right = flat @ error.ravel() - (gain @ pull[:, :, None]).sum(axis=0)[:, 0]
    try:
        step = -np.linalg.solve(normal, right)
    except np.linalg.LinAlgError:
        step = np.zeros(len(right))
    angle_step = -np.linalg.solve(own, pull[:, :, None] + shared.swapaxes(1, 2) @ step[None, :, None])[:, :, 0]
    moved = h + (basis @ step).reshape(3, 3)
    moved = moved / np.linalg.norm(moved) if image_K is None else nearest_unit_pose(image_K, moved)
    information = np.diagonal(own, axis1=1, axis2=2) - 1.0 / angles.sigma**2
    value = (angles.value + angle_step) * angles.significant
    return np.asarray(moved), replace(angles, value=value), information


def _angle_slopes(linear: Linearization, generators: Array) -> Array:
    """Compute the derivatives (2, 2, N) of the whitened errors by the two angles."""
    u, v = linear.projected[0]
    wu, wv, shear = linear.whiten[:, 0]
    out = np.empty((2, 2, len(u)))
    for k, g in enumerate(generators):
        dw = g[2, 0] * u + g[2, 1] * v + g[2, 2]
        du = g[0, 0] * u + g[0, 1] * v + g[0, 2] - u * dw
        dv = g[1, 0] * u + g[1, 1] * v + g[1, 2] - v * dw
        out[k, 0] = du * wu
        out[k, 1] = (dv - shear * du) * wv
    return out
