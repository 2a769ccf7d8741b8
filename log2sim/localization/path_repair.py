"""Repair of a path: parts that are off are moved back to the others, samples that cannot be right are bridged."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.localization.path_fit import FittedPath, PathPrior, fit_path
from log2sim.localization.path_noise import noise_of
from log2sim.localization.path_parts import (
    MAX_REST,
    MAX_SIGMAS,
    Part,
    Samples,
    Skip,
    find_parts,
    find_skips,
    is_skip,
)

# A gap is bridged by the samples this near to its ends, and by some where they are sparse; more change nothing.
WINDOW_S, MIN_SIDE, MAX_SIDE = 1.5, 4, 30
# Third differences of sparse samples hold the motion itself, so they do not tell the noise.
MAX_DENSE_S = 0.25
# Of samples farther apart a step that stays is only reported: that a vehicle stopped or jumped before may not show in them.
MAX_LASTING_S = 0.15


@dataclass(frozen=True)
class Limits:
    """What is possible for a path and what is worth a repair, in units u: m or rad.

    Attributes
    ----------
    max_change : float, u/s2
        Largest second derivative of a vehicle's path.
    prior : PathPrior
    min_step : float, u
        Repairs that move samples by less are not made.
    min_lasting_step : float, u
        The same for a step that stays: a smaller one may be an end of a short jump whose other end is hidden in noise.
    usual_sigma : float, u
        Standard deviation of samples whose noise does not show because they are few or sparse.
    """

    max_change: float
    prior: PathPrior
    min_step: float
    min_lasting_step: float
    usual_sigma: float


@dataclass(frozen=True, eq=False)
class RepairedPath:
    """A path whose faults are taken out.

    Attributes
    ----------
    limits : Limits
    values : (P, D) float64, u
    sigma : (P,) float64, u
        Standard deviation of what the repair adds, 0 where a sample is as it was.
    noise : float, u
        Standard deviation of the noise of the samples.
    moved, bridged, at_rest : (P,) bool
        Whether a sample was moved with its part, or replaced by what the samples around suggest; whether it stayed in its
        place while the vehicle moved.
    skips : tuple of Skip
        Steps that stay, and that may be of the stamps or one end of a jump: these samples are as they were.
    """

    limits: Limits
    values: Array
    sigma: Array
    noise: float
    moved: NDArray[np.bool_]
    bridged: NDArray[np.bool_]
    at_rest: NDArray[np.bool_]
    skips: tuple[Skip, ...] = ()


def repair_path(t_s: Array, values: Array, limits: Limits, wrong: NDArray[np.bool_] | None = None) -> RepairedPath:
    """Find and repair the faults of a path.

    Parameters
    ----------
    t_s : (P,) float64, s
    values : (P, D) float64, u
    limits : Limits
    wrong : (P,) bool, optional
        Samples that are known to be wrong.
    """
    rows = np.arange(len(t_s)) if wrong is None else np.flatnonzero(~wrong)
    new, sigma = values.copy(), np.zeros(len(t_s))
    none = np.zeros(len(t_s), dtype=bool)
    if not len(rows):
        return RepairedPath(limits, new, sigma, 0.0, none, none.copy(), none.copy())
    scatter = noise_of(t_s[rows], values[rows], limits.usual_sigma)
    samples = Samples(t_s[rows], values[rows], limits.max_change, scatter)
    dense = len(rows) > 1 and float(np.median(np.diff(samples.t_s))) < MAX_DENSE_S
    noise = scatter if dense else min(scatter, limits.usual_sigma)
    parts = find_parts(samples)
    moved, at_rest, known = none.copy(), none.copy(), none.copy()
    offsets = _offsets(samples, parts, noise, limits)
    for part, offset, offset_sigma in offsets:
        of_part = rows[part.rows]
        if part.at_rest:
            at_rest[of_part] = True
            continue
        known[of_part] = offset_sigma < limits.min_step
        if not known[of_part].all():
            continue
        if float(np.linalg.norm(offset, axis=1).max()) >= limits.min_step:
            new[of_part] -= offset
            sigma[of_part], moved[of_part] = offset_sigma, True
    used = sorted((part for part, _, _ in offsets), key=lambda part: int(part.rows[0]))
    skips = [Skip(int(rows[s.first]), int(rows[s.last]), s.size) for s in find_skips(samples, used)]
    for skip in skips:
        known[skip.first : skip.last] |= ~at_rest[skip.first : skip.last]
    bridged = ~known
    for first, stop in runs_of(bridged):
        fitted = bridge(t_s, new, known, t_s[first:stop], noise, limits.prior)
        if fitted is None:
            bridged[first:stop] = False
            continue
        off = np.linalg.norm(fitted.value - values[first:stop], axis=1).max()
        if off < limits.min_step and (wrong is None or not wrong[first:stop].any()):
            bridged[first:stop] = False
            at_rest[first:stop] = False
            continue
        new[first:stop], sigma[first:stop] = fitted.value, fitted.sigma
    return RepairedPath(limits, new, sigma, noise, moved, bridged, at_rest & bridged, tuple(skips))


def runs_of(marked: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """List the runs of marked rows: the first row of each and the one after its last."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], marked, [False]]).astype(np.int8)))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist()))


def bridge(
    t_s: Array, values: Array, known: NDArray[np.bool_], asked_s: Array, noise: float, prior: PathPrior
) -> FittedPath | None:
    """Interpolate or extrapolate a path at asked times by the known samples around them; None without any."""
    rows = np.flatnonzero(known)
    before, after = rows[t_s[rows] < asked_s[0]], rows[t_s[rows] > asked_s[-1]]
    inside = rows[(t_s[rows] >= asked_s[0]) & (t_s[rows] <= asked_s[-1])]
    near = np.concatenate(
        [_side(t_s, before, asked_s[0], last=True), inside, _side(t_s, after, asked_s[-1], last=False)]
    )
    if not len(near):
        return None
    return fit_path(t_s[near], values[near], noise, asked_s, prior)


def _side(t_s: Array, rows: NDArray[np.intp], edge_s: float, *, last: bool) -> NDArray[np.intp]:
    """Choose samples on one side of a time: those within `WINDOW_S` of the nearest one, thinned, and some where they are sparse."""
    if not len(rows):
        return rows
    nearest = t_s[rows[-1 if last else 0]]
    near = rows[np.abs(t_s[rows] - nearest) <= WINDOW_S]
    if len(near) < MIN_SIDE:
        near = rows[-MIN_SIDE:] if last else rows[:MIN_SIDE]
    keep = np.linspace(0, len(near) - 1, min(len(near), MAX_SIDE)).round().astype(np.intp)
    return np.asarray(near[keep])


def _offsets(samples: Samples, parts: list[Part], noise: float, limits: Limits) -> list[tuple[Part, Array, float]]:
    """Estimate how far the samples of each part are off those of the right parts: offsets (n, D) and their standard deviation."""
    moving = [part for part in parts if not part.at_rest]
    sparse = float(np.median(np.diff(samples.t_s, prepend=-1.0))) > MAX_LASTING_S
    none = np.zeros((1, samples.values.shape[1]))
    steps = [_step(samples, first, second, noise, limits) for first, second in pairwise(moving)]
    out: list[tuple[Part, Array, float]] = [(part, none, 0.0) for part in parts if part.at_rest or part.right]
    right = [k for k, part in enumerate(moving) if part.right]
    for k, part in enumerate(moving):
        if part.right:
            continue
        left, end = max((r for r in right if r < k), default=None), min((r for r in right if r > k), default=None)
        from_left = None if left is None else _sum_of(steps[left:k])
        from_right = None if end is None else _sum_of(steps[k:end])
        offset, sigma = _blended(samples.t_s[part.rows], from_left, from_right)
        lasts = from_left is None or from_right is None
        between = moving[left or 0 : k + 1] if end is None else moving[k : end + 1]
        skips = lasts and all(is_skip(samples, one, other) for one, other in pairwise(between))
        if skips or (lasts and (sparse or float(np.linalg.norm(offset)) < limits.min_lasting_step)):
            out.append((Part(part.rows), none, 0.0))
        else:
            out.append((part, offset, sigma))
    return out


def _step(samples: Samples, first: Part, second: Part, noise: float, limits: Limits) -> tuple[Array, float]:
    """Estimate by how much the path steps between two parts, and the standard deviation."""
    if first.right and second.right:
        return np.zeros(samples.values.shape[1]), 0.0
    before = _side(samples.t_s, first.rows, 0.0, last=True)
    after = _side(samples.t_s, second.rows, 0.0, last=False)
    near = np.concatenate([before, after])
    is_after = np.arange(len(near)) >= len(before)
    t = samples.t_s[near]
    fitted = fit_path(t, samples.values[near], noise, t[:1], limits.prior, after=is_after)
    return fitted.step, fitted.step_sigma


def _sum_of(steps: list[tuple[Array, float]]) -> tuple[Array, float]:
    """Add steps and their variances."""
    return np.sum([step for step, _ in steps], axis=0), float(np.sqrt(sum(sigma**2 for _, sigma in steps)))


def _blended(
    t_s: Array, from_left: tuple[Array, float] | None, from_right: tuple[Array, float] | None
) -> tuple[Array, float]:
    """Join what the right parts before and after a part say about its offset; it drifts from one to the other if they differ."""
    if from_left is None or from_right is None:
        known = from_left if from_left is not None else None
        if known is not None:
            return known[0][None], known[1]
        assert from_right is not None
        return -from_right[0][None], from_right[1]
    (start, start_sigma), (end, end_sigma) = from_left, from_right
    both = np.hypot(start_sigma, end_sigma)
    if float(np.linalg.norm(start + end)) > MAX_SIGMAS * both + MAX_REST:
        share = ((t_s - t_s[0]) / max(float(np.ptp(t_s)), 1e-9))[:, None]
        return np.asarray((1 - share) * start - share * end), float(both)
    weight = end_sigma**2 / max(both**2, 1e-12)
    return (weight * start - (1 - weight) * end)[None], float(start_sigma * end_sigma / max(both, 1e-12))
