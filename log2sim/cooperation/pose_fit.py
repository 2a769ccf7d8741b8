"""Error of a roadside unit's pose and clock from all that ties it to the ego's map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.cooperation.structure import Surfaces
from log2sim.geometry import Array

# What an error may be before anything is known; a direction that nothing holds stays where it was.
PRIOR_SIGMA = np.array([0.5, 0.5, 0.5, np.radians(2.0), np.radians(2.0), np.radians(2.0), 0.3])
DELAY = 6
MAD_TO_SIGMA = 1.4826
MIN_SCALE_M = 0.02
# Points so many standard deviations off count half.
CAUCHY = 2.0
# Points on surfaces that face one way err together, as those on all posts do: by so much, m.
PLANE_BIAS_M, POST_BIAS_M = 0.02, 0.1
# Pieces that are matched by mistake decide where few hold a direction: so many pieces count half. A turn moves points at this
# distance as much as a translation does.
FEW_PIECES, LEVER_M = 30.0, 15.0
MIN_NORMAL_Z = 0.8
# Points nearer than this to a surface lie on it.
ON_SURFACE_M = 0.1


@dataclass(frozen=True, eq=False)
class Evidence:
    """What some observations say about a correction: translation, m, and rotation vector, rad, of the site, and delay, s.

    Attributes
    ----------
    information : (7, 7) float64
    gradient : (7,) float64
        Of half the sum of weighted squares at the correction so far.
    """

    information: Array
    gradient: Array


@dataclass(frozen=True, eq=False)
class MatchedStructure:
    """Points of the road on surfaces of the vehicle.

    Attributes
    ----------
    evidence : Evidence
    points : int
        Matched points.
    on_surface : int
        Those within `ON_SURFACE_M`.
    rms_m : float, m
        Robust, of the distances along the normals.
    """

    evidence: Evidence
    points: int
    on_surface: int
    rms_m: float


def match_structure(surfaces: Surfaces, road_m: Array, correction: Array, within_m: float) -> MatchedStructure | None:
    """Match points (N, 3) of the road, corrected by a transform (4, 4), with surfaces of the vehicle; None with too few.

    Notes
    -----
    Point-to-plane ICP (Chen, Medioni, IVC 1992) with Cauchy weights; posts hold points in two directions.
    """
    at = road_m @ correction[:3, :3].T + correction[:3, 3]
    away, index = surfaces.tree.query(at, distance_upper_bound=np.hypot(within_m, surfaces.reach_m.max()))
    found = np.flatnonzero(np.isfinite(away))
    off = at[found] - surfaces.xyz_m[index[found]]
    first = np.einsum("kj,kj->k", surfaces.normals[index[found], 0], off)
    along_m = np.sqrt(np.maximum(away[found] ** 2 - first**2, 0.0))
    near = (np.abs(first) < within_m) & (along_m < np.maximum(surfaces.reach_m[index[found]], within_m))
    found, off, first = found[near], off[near], first[near]
    if len(found) < FEW_PIECES:
        return None
    at, piece = at[found], index[found]
    post = surfaces.post[piece]
    normals = np.concatenate([surfaces.normals[piece, 0], surfaces.normals[piece[post], 1]])
    at, off = np.concatenate([at, at[post]]), np.concatenate([off, off[post]])
    residual = np.einsum("kj,kj->k", normals, off)
    jacobian = np.hstack([normals, np.cross(at, normals)])
    share, weight = _weights(normals, residual, np.concatenate([post, post[post]]))
    return MatchedStructure(
        _damped(jacobian, residual, share, weight),
        len(found),
        int((np.abs(first) < ON_SURFACE_M).sum()),
        MAD_TO_SIGMA * float(np.median(np.abs(first))),
    )


def _weights(normals: Array, residual: Array, post: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Weigh rows (K,): the share that each counts by Cauchy's function, and the inverse variance with what rows have in common."""
    up = ~post & (np.abs(normals[:, 2]) > MIN_NORMAL_Z)
    along = ~post & ~up & (np.abs(normals[:, 0]) > np.abs(normals[:, 1]))
    share, weight = np.zeros(len(residual)), np.zeros(len(residual))
    for group, bias_m in (
        (up, PLANE_BIAS_M),
        (along, PLANE_BIAS_M),
        (~post & ~up & ~along, PLANE_BIAS_M),
        (post, POST_BIAS_M),
    ):
        if not group.any():
            continue
        scale = max(MAD_TO_SIGMA * float(np.median(np.abs(residual[group]))), MIN_SCALE_M)
        share[group] = 1.0 / (1.0 + (residual[group] / (CAUCHY * scale)) ** 2)
        weight[group] = share[group] / (scale**2 + float(share[group].sum()) * bias_m**2)
    return share, weight


def _damped(jacobian: Array, residual: Array, share: Array, weight: Array) -> Evidence:
    """Weaken what rows (K, 6) say about directions that few of them hold, as the noise of normals makes it up."""
    scaled = jacobian * np.array([1.0, 1.0, 1.0, 1 / LEVER_M, 1 / LEVER_M, 1 / LEVER_M])
    pieces, directions = np.linalg.eigh((scaled * share[:, None]).T @ scaled)
    pieces = np.maximum(pieces, 0.0)
    trust = (directions * np.sqrt(pieces / (pieces + FEW_PIECES))) @ directions.T
    information = (scaled * weight[:, None]).T @ scaled
    best = np.linalg.pinv(information, rcond=1e-9, hermitian=True) @ ((scaled * weight[:, None]).T @ residual)
    trusted = trust @ information @ trust
    unscale = np.array([1.0, 1.0, 1.0, LEVER_M, LEVER_M, LEVER_M])
    full, gradient = np.zeros((7, 7)), np.zeros(7)
    full[:6, :6] = trusted * unscale * unscale[:, None]
    gradient[:6] = (trusted @ best) * unscale
    return Evidence(full, gradient)


def solve(evidence: Sequence[Evidence], so_far: Array) -> tuple[Array, Array]:
    """Find the step (7,) that fits best and the covariance (7, 7) of the whole, given what was corrected so far (7,)."""
    information, gradient = np.diag(PRIOR_SIGMA**-2.0), PRIOR_SIGMA**-2.0 * so_far
    for part in evidence:
        information = information + part.information
        gradient = gradient + part.gradient
    covariance = np.linalg.inv(information)
    return np.asarray(-covariance @ gradient), np.asarray(covariance)
