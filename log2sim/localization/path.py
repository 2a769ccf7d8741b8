"""The most probable path through noisy samples, parts of it that jump or stop, and their repair.

Positions or yaws are samples of a path, in units u: m or rad. Where the second derivative is beyond what vehicles do, by more
than noise explains, the path breaks. What lies between two breaks is a part; the parts that one vehicle can have driven, and
that last longest together, are right.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array, runs_of

# Derivatives are taken over these times: the first finds jumps and sudden stops, the second jumps that take a while. Shorter ones
# would find the vibration of the vehicle and the last digits of stored poses.
SPANS_S = (0.1, 0.3)
# Third differences need some rows for a median.
MIN_ROWS_FOR_NOISE, MIN_NOISE_SIGMA = 8, 1e-3
# Errors are independent where over this many times the time they grow by less than this: halfway from 1 to the root of 3.
WHITENESS_SPAN, MAX_GROWTH = 3.0, 1.3


def noise_of(t_s: Array, values: Array, usual_sigma: float) -> float:
    """Estimate the standard deviation, u, of the noise of samples (P, D); the usual one for few samples.

    From third differences over the shortest of `SPANS_S`. The median absolute value, 0.6745 standard deviations of a Gaussian, is
    insensitive to jumps (Rousseeuw and Croux, J. Am. Stat. Assoc. 88, 1993). Slow errors, such as those of a GNSS that drifts, do
    not show; where samples are sparse the third derivative of the motion itself counts as noise.
    """
    rows, differences = _third_differences(t_s, values, SPANS_S[0])
    if len(rows) < MIN_ROWS_FOR_NOISE:
        return usual_sigma
    spread = np.median(np.abs(differences), axis=0) / 0.6745
    return max(float(np.sqrt(np.mean(spread**2))), MIN_NOISE_SIGMA)


def independent_noise(t_s: Array, xy_m: Array) -> float:
    """Estimate the standard deviation, m, of the errors of positions (P, 2) across the path that change from sample to sample.

    Across the path stamps that are off change nothing. 0 where errors last, as those of a GNSS that drifts: over three times the
    time such errors grow by its root, while independent ones stay.
    """
    period = float(np.median(np.diff(t_s))) if len(t_s) > MIN_ROWS_FOR_NOISE else 0.0
    if period <= 0:
        return 0.0
    near, far = (_noise_across(t_s, xy_m, span) for span in (period, WHITENESS_SPAN * period))
    return near if far < MAX_GROWTH * near else 0.0


def _noise_across(t_s: Array, xy_m: Array, span_s: float) -> float:
    """Estimate the noise, m, of positions (P, 2) across the path from third differences over a time; 0 for few."""
    rows, differences = _third_differences(t_s, xy_m, span_s)
    along = xy_m[rows[:, -1]] - xy_m[rows[:, 0]]
    length = np.linalg.norm(along, axis=1)
    moving = length > 0
    if moving.sum() < MIN_ROWS_FOR_NOISE:
        return 0.0
    across = (differences[:, 1] * along[:, 0] - differences[:, 0] * along[:, 1])[moving] / length[moving]
    return float(np.median(np.abs(across))) / 0.6745


def _third_differences(t_s: Array, values: Array, span_s: float) -> tuple[NDArray[np.intp], Array]:
    """Compute third differences (n, D) of samples some time apart, with the standard deviation of the samples; their rows (n, 4)."""
    steps = [np.arange(len(t_s))]
    for _ in range(3):
        after = np.searchsorted(t_s, t_s[np.minimum(steps[-1], len(t_s) - 1)] + span_s * 0.99)
        steps.append(np.where(steps[-1] < len(t_s), after, len(t_s)))
    rows = np.stack(steps, axis=1)
    rows = rows[rows[:, -1] < len(t_s)]
    # Weights of the divided difference: the inverse products of each time's distances to the other three.
    t = t_s[rows] / span_s
    weights = 1.0 / (t[:, :, None] - t[:, None, :] + np.eye(4)).prod(axis=2)
    return rows, np.einsum("nj,njk->nk", weights, values[rows]) / np.linalg.norm(weights, axis=1, keepdims=True)


# A step between two parts of a path may have any size up to some of these.
STEP_PRIOR = 100.0
# Samples are never taken for more exact, which keeps the equations solvable.
MIN_SIGMA = 1e-3


@dataclass(frozen=True)
class PathPrior:
    """What is known of a path before it is measured, in units u: m of a position, rad of an angle."""

    density: float  # spectral density of the third derivative, white noise
    # `place`, `rate`, `change`: u, u/s, u/s2: standard deviations of the first value about the first sample, and of its
    # first and second derivative
    place: float
    rate: float
    change: float


# Accelerations in traffic of 1.5 m/s2 that last for some 1.5 s (Singer, IEEE Trans. AES 6, 1970): 2 * 1.5**2 / 1.5.
POSITION_PRIOR = PathPrior(density=3.0, place=100.0, rate=50.0, change=2.0)
# Yaw accelerations of 0.3 rad/s2 that last as long.
YAW_PRIOR = PathPrior(density=0.12, place=4.0, rate=1.0, change=0.5)


@dataclass(frozen=True, eq=False)
class FittedPath:
    """A path at the times that were asked for."""

    value: Array  # (T, D)
    sigma: Array  # (T,): standard deviation of each coordinate
    step: Array  # (D,): how far the samples after the step are off those before it; 0 without a step
    step_sigma: float


def fit_path(
    t_s: Array,
    samples: Array,
    sigma: float,
    asked_s: Array,
    prior: PathPrior,
    *,
    after: NDArray[np.bool_] | None = None,
) -> FittedPath:
    """Fit a path to samples (n, D) at times (n,) and evaluate it at others (T,), in units u of the samples.

    `sigma`: standard deviation of each sample. `after` (n,): samples that are off all others by one unknown step.

    Gaussian process regression with the kernel of a twice integrated acceleration whose derivative is white noise; it equals
    the fixed-interval smoother of the constant-acceleration model and a smoothing spline of fifth degree (Wahba, J. Royal Stat.
    Soc. B 40, 1978). Cost O(n^3): for some hundred samples around a gap.
    """
    start = min(float(t_s.min()), float(asked_s.min()))
    t, asked = t_s - start, asked_s - start
    base = samples[0]
    shifted = np.zeros(len(t)) if after is None else after.astype(np.float64)
    noise = max(sigma, MIN_SIGMA) ** 2
    # Value, rate and change at the start and the step are estimated apart from the rest, which keeps the digits of both.
    terms, asked_terms = np.column_stack([_powers(t), shifted]), np.column_stack([_powers(asked), np.zeros(len(asked))])
    scale = np.array([prior.place, prior.rate, prior.change, STEP_PRIOR])
    factor = np.linalg.cholesky(prior.density * _wandering(t, t) + noise * np.eye(len(t)))
    design = np.linalg.solve(factor, terms * scale)
    measured = np.linalg.solve(factor, samples - base)
    cross = np.linalg.solve(factor, prior.density * _wandering(t, asked))
    covariance = np.linalg.inv(design.T @ design + np.eye(len(scale)))
    found = covariance @ design.T @ measured
    reach = asked_terms * scale - cross.T @ design
    variance = prior.density * asked**5 / 20 - np.sum(cross**2, axis=0) + np.sum((reach @ covariance) * reach, axis=1)
    return FittedPath(
        base + reach @ found + cross.T @ measured,
        np.sqrt(np.maximum(variance, 0.0)),
        STEP_PRIOR * found[3],
        STEP_PRIOR * float(np.sqrt(covariance[3, 3])) if shifted.any() else 0.0,
    )


def _powers(t_s: Array) -> Array:
    """Return what value, rate and change at the start contribute at times (n,) after it: (n, 3)."""
    return np.stack([np.ones(len(t_s)), t_s, t_s**2 / 2], axis=1)


def _wandering(first_s: Array, second_s: Array) -> Array:
    """Compute the covariances (n, m) of white noise that is integrated three times, of unit density, at times (n,) and (m,)."""
    a, b = first_s[:, None], second_s[None, :]
    early, apart = np.minimum(a, b), np.abs(a - b)
    return np.asarray(early**5 / 20 + apart * early**4 / 8 + apart**2 * early**3 / 12)


# Each block is smoothed with the samples this long before and after it; those farther away change nothing.
BLOCK_S, MARGIN_S = 1.0, 1.0
# More samples of a block and its margins are averaged in groups, within which a vehicle moves steadily.
MAX_SAMPLES = 150


def smooth_path(
    t_s: Array, values: Array, measured: NDArray[np.bool_], noise: float, prior: PathPrior
) -> tuple[Array, Array]:
    """Smooth the measured samples (P, D) of a path, in units u, whose noise is independent; the others stay as they are.

    Also returns the standard deviations (P,) of the smoothed samples, 0 of the others.
    """
    out, sigma = values.copy(), np.zeros(len(t_s))
    rows = np.flatnonzero(measured)
    t = t_s[rows]
    done = 0
    while done < len(rows):
        stop = int(np.searchsorted(t, t[done] + BLOCK_S))
        first, last = np.searchsorted(t, [t[done] - MARGIN_S, t[stop - 1] + MARGIN_S])
        near = rows[first:last]
        size = -(-len(near) // MAX_SAMPLES)
        groups = np.arange(0, len(near), size)
        counts = np.diff(np.append(groups, len(near)))
        mean_t = np.add.reduceat(t_s[near], groups) / counts
        mean = np.add.reduceat(values[near], groups, axis=0) / counts[:, None]
        block = rows[done:stop]
        fitted = fit_path(mean_t, mean, noise / np.sqrt(size), t_s[block], prior)
        out[block], sigma[block] = fitted.value, fitted.sigma
        done = stop
    return out, sigma


# Of a normal distribution 6e-7 are beyond: one sample of the longest logs.
MAX_SIGMAS = 5.0
# The rate at the end of a part is fitted to this time of it.
END_S = 0.5
MIN_END_S = 0.05
# Vehicles change their acceleration by up to this in a second, which a parabola does not follow, u/s3.
MAX_JERK = 10.0
# A rate that is not known, u/s.
UNKNOWN_RATE = 60.0
# A part that covers less is at rest, u; in noisier logs as many standard deviations, which some hundred samples cover.
MAX_REST, MAX_REST_SIGMAS = 0.05, 10.0
# Stamps of recorded drives miss some frames, or are assumed to be regular: then the path steps forward by up to this time of driving.
MAX_SKIP_S = 0.25
# Vehicles that drive off or stop change their speed by less than this share of what they can.
USUAL_CHANGE_SHARE = 1 / 3
# Parts farther back are no longer compared: between them almost any motion is possible.
MAX_COMPARED = 30


@dataclass(frozen=True, eq=False)
class Samples:
    """Samples of a path."""

    t_s: Array  # (P,): strictly increasing
    values: Array  # (P, D) u
    max_change: float  # u/s2: largest second derivative of a vehicle's path
    sigma: float  # u: standard deviation of their noise, see `noise_of`


@dataclass(frozen=True, eq=False)
class Part:
    """Successive samples that a vehicle can have driven."""

    rows: NDArray[np.intp]  # (n,) int: rows of `Samples`
    right: bool = True  # whether it belongs to the parts that are taken for right
    at_rest: bool = False  # whether it stays in one place although the path enters or leaves it at a speed


@dataclass(frozen=True, eq=False)
class _End:
    """Time, value, rate and change (D,) at an end of a part, standard deviations, and by how much the rate may be off besides."""

    t_s: float
    value: Array
    rate: Array
    change: Array
    sigma: float
    rate_sigma: float
    rate_slack: float


def find_parts(samples: Samples) -> list[Part]:
    """Divide samples where the path breaks; one part holds all of them where it does not."""
    broken = find_breaks(samples)
    if not broken.any():
        return [Part(np.arange(len(samples.t_s)))]
    cores = [np.arange(first, end) for first, end in runs_of(~broken)]
    if not cores:
        return []
    return _choose(samples, _marked_at_rest(samples, _grown(samples, cores)))


def find_breaks(samples: Samples) -> NDArray[np.bool_]:
    """Mark the samples (P,) around which the second derivative is beyond a vehicle's and beyond noise."""
    t, values = samples.t_s, samples.values
    broken = np.zeros(len(t), dtype=bool)
    for span in SPANS_S:
        before = np.searchsorted(t, t - span * 0.99, side="right") - 1
        after = np.searchsorted(t, t + span * 0.99)
        i = np.flatnonzero((before >= 0) & (after < len(t)))
        b, a = before[i], after[i]
        first, second = t[i] - t[b], t[a] - t[i]
        change = (values[a] - values[i]) / second[:, None] - (values[i] - values[b]) / first[:, None]
        scale = 2.0 / (first + second)
        noise = samples.sigma * np.sqrt(first**-2 + second**-2 + (1 / first + 1 / second) ** 2)
        # A wrong pair of samples shows in the mean; what a vehicle can do in the time of both is possible.
        broken[i] |= np.linalg.norm(change, axis=1) * scale > samples.max_change + MAX_SIGMAS * noise * scale
    return broken


def _grown(samples: Samples, cores: list[NDArray[np.intp]]) -> list[Part]:
    """Make parts of their cores and the samples beside them that continue their motion."""
    grown, taken = [], 0
    for k, core in enumerate(cores):
        limit = cores[k + 1][0] if k + 1 < len(cores) else len(samples.t_s)
        start, stop = int(core[0]), int(core[-1]) + 1
        head, tail = _end(samples, core, first=True), _end(samples, core, first=False)
        while start > taken and _continues(samples, head, start - 1):
            start -= 1
        while stop < limit and _continues(samples, tail, stop):
            stop += 1
        grown.append(Part(np.arange(start, stop)))
        taken = stop
    return grown


def _continues(samples: Samples, end: _End, row: int) -> bool:
    """Return whether a sample is where a vehicle can be that was at an end of a part."""
    dt = samples.t_s[row] - end.t_s
    off = float(np.linalg.norm(samples.values[row] - end.value - end.rate * dt - end.change * dt**2 / 2))
    sigma = np.sqrt(samples.sigma**2 + end.sigma**2 + (end.rate_sigma * dt) ** 2)
    # Something is wrong near here, so samples that a vehicle reaches by full brakes only are not added.
    return off <= MAX_JERK * float(abs(dt)) ** 3 / 6 + MAX_SIGMAS * float(sigma)


def _end(samples: Samples, rows: NDArray[np.intp], *, first: bool) -> _End:
    """Fit value and rate at an end of a part: a parabola to its last samples, a line to few of them."""
    end = rows[0 if first else -1]
    t_end, value = float(samples.t_s[end]), samples.values[end]
    used = rows[np.abs(samples.t_s[rows] - t_end) <= END_S]
    if len(used) < 3 <= len(rows):
        used = rows[:3] if first else rows[-3:]
    span = float(np.ptp(samples.t_s[used]))
    if len(used) < 2 or span < MIN_END_S:
        none = np.zeros_like(value)
        return _End(t_end, value, none, none, samples.sigma, 0.0, UNKNOWN_RATE)
    degree = 2 if len(used) > 2 and span >= END_S / 2 else 1
    powers = np.vander(samples.t_s[used] - t_end, degree + 1, increasing=True)
    solution = np.linalg.lstsq(powers, samples.values[used], rcond=None)[0]
    spread = np.sqrt(np.diag(np.linalg.inv(powers.T @ powers))) * samples.sigma
    slack = MAX_JERK * span**2 / 12 if degree == 2 else samples.max_change * span / 2
    change = 2 * solution[2] if degree == 2 else np.zeros_like(solution[0])
    return _End(t_end, solution[0], solution[1], change, float(spread[0]), float(spread[1]), slack)


def _marked_at_rest(samples: Samples, parts: list[Part]) -> list[Part]:
    """Mark the parts that stay in one place although no vehicle stops or starts as suddenly as the path around them."""
    heads = [_end(samples, part.rows, first=True) for part in parts]
    tails = [_end(samples, part.rows, first=False) for part in parts]
    sudden = [not _same_rate(samples, tail, head, USUAL_CHANGE_SHARE) for tail, head in zip(tails, heads[1:])]
    most = max(MAX_REST, MAX_REST_SIGMAS * samples.sigma)
    stays = [float(np.linalg.norm(np.ptp(samples.values[part.rows], axis=0))) <= most for part in parts]
    at_rest = [stays[k] and any(sudden[max(k - 1, 0) : k + 1]) for k in range(len(parts))]
    for k, other in [*pairwise(range(len(parts))), *((k + 1, k) for k in reversed(range(len(parts) - 1)))]:
        # Parts in the place of one that is at rest are at rest as well.
        apart = samples.values[parts[k].rows[-1]] - samples.values[parts[other].rows[0]]
        at_rest[other] |= at_rest[k] and stays[other] and float(np.linalg.norm(apart)) <= most
    return [Part(part.rows, part.right, rests) for part, rests in zip(parts, at_rest)]


def _same_rate(samples: Samples, end: _End, start: _End, share: float = 1.0) -> bool:
    """Return whether a vehicle changes from the rate at an end of a part to that at the start of a later one by a share of what it can."""
    sigma = np.hypot(end.rate_sigma, start.rate_sigma)
    off = float(np.linalg.norm(start.rate - end.rate))
    slack = end.rate_slack + start.rate_slack
    return off <= share * samples.max_change * (start.t_s - end.t_s) + slack + MAX_SIGMAS * float(sigma)


def is_skip(samples: Samples, first: Part, second: Part) -> bool:
    """Return whether the path steps forward between two parts as it would if stamps missed some time."""
    end, start = _end(samples, first.rows, first=False), _end(samples, second.rows, first=True)
    off, most = _step_and_limit(samples, end, start)
    rate = (end.rate + start.rate) / 2
    speed = float(np.linalg.norm(rate))
    if not _same_rate(samples, end, start) or max(end.rate_slack, start.rate_slack) >= speed:
        return False
    forward = float(off @ rate) / speed
    across = float(np.linalg.norm(off - forward * rate / speed))
    return 0 < forward <= MAX_SKIP_S * speed and across <= most + forward / 10


def _step_and_limit(samples: Samples, end: _End, start: _End) -> tuple[Array, float]:
    """Compute how far the start of a part is from where the end of an earlier one leads, and how far it may be."""
    dt = start.t_s - end.t_s
    sigma = np.sqrt(end.sigma**2 + start.sigma**2 + (end.rate_sigma**2 + start.rate_sigma**2) * dt**2 / 4)
    slack = (end.rate_slack + start.rate_slack) / 2 * dt
    # Full throttle for half of the time and full brakes for the other half.
    most = samples.max_change * dt**2 / 4 + slack + MAX_SIGMAS * float(sigma)
    return start.value - end.value - (end.rate + start.rate) / 2 * dt, most


@dataclass(frozen=True)
class Skip:
    """A step between two parts that are used as they are."""

    first: int  # `first`, `last`: rows of the last sample before the step and of the first one after it
    last: int
    size: float  # u


def find_skips(samples: Samples, parts: list[Part]) -> list[Skip]:
    """List the steps between right parts."""
    right, out = [part for part in parts if part.right], []
    for one, other in pairwise(right):
        off, most = _step_and_limit(
            samples, _end(samples, one.rows, first=False), _end(samples, other.rows, first=True)
        )
        if np.linalg.norm(off) > most:
            out.append(Skip(int(one.rows[-1]), int(other.rows[0]), float(np.linalg.norm(off))))
    return out


def _choose(samples: Samples, parts: list[Part]) -> list[Part]:
    """Take the parts for right that one vehicle can have driven and that last longest together."""
    moving = [k for k, part in enumerate(parts) if not part.at_rest]
    heads = {k: _end(samples, parts[k].rows, first=True) for k in moving}
    tails = {k: _end(samples, parts[k].rows, first=False) for k in moving}
    best: dict[int, tuple[float, int | None]] = {}
    for n, k in enumerate(moving):
        before = moving[max(n - MAX_COMPARED, 0) : n]
        earlier = []  # parts from whose end a vehicle can get to the start of this one
        for j in before:
            off, most = _step_and_limit(samples, tails[j], heads[k])
            if _same_rate(samples, tails[j], heads[k]) and np.linalg.norm(off) <= most:
                earlier.append((best[j][0], j))
        total, from_part = max(earlier, default=(0.0, None), key=lambda e: e[0])
        best[k] = (total + float(np.ptp(samples.t_s[parts[k].rows])), from_part)
    chosen: set[int] = set()
    k_next = max(best, key=lambda k: best[k][0], default=None)
    while k_next is not None:
        chosen.add(k_next)
        k_next = best[k_next][1]
    return [Part(part.rows, k in chosen, part.at_rest) for k, part in enumerate(parts)]


# A gap is bridged by the samples this near to its ends, and by some where they are sparse; more change nothing.
WINDOW_S, MIN_SIDE, MAX_SIDE = 1.5, 4, 30
# Third differences of sparse samples hold the motion itself, so they do not tell the noise.
MAX_DENSE_S = 0.25
# Of samples farther apart a step that stays is only reported: that a vehicle stopped or jumped before may not show in them.
MAX_LASTING_S = 0.15


@dataclass(frozen=True)
class Limits:
    """What is possible for a path and what is worth a repair, in units u: m or rad."""

    max_change: float  # u/s2: largest second derivative of a vehicle's path
    prior: PathPrior
    min_step: float  # u: repairs that move samples by less are not made
    # u: the same for a step that stays: a smaller one may be an end of a short jump whose other end is hidden in noise
    min_lasting_step: float
    usual_sigma: float  # u: standard deviation of samples whose noise does not show because they are few or sparse


@dataclass(frozen=True, eq=False)
class RepairedPath:
    """A path whose faults are taken out."""

    limits: Limits
    values: Array  # (P, D) u
    sigma: Array  # (P,) u: standard deviation of what the repair adds, 0 where a sample is as it was
    noise: float  # u: standard deviation of the noise of the samples
    # `moved`, `bridged`, `at_rest`: (P,): whether a sample was moved with its part, or replaced by what the
    # samples around suggest; whether it stayed in its place while the vehicle moved
    moved: NDArray[np.bool_]
    bridged: NDArray[np.bool_]
    at_rest: NDArray[np.bool_]
    # Steps that stay, and that may be of the stamps or one end of a jump: these samples are as they were
    skips: tuple[Skip, ...] = ()


def repair_path(t_s: Array, values: Array, limits: Limits, wrong: NDArray[np.bool_] | None = None) -> RepairedPath:
    """Find and repair the faults of a path, samples (P, D) u at times (P,); `wrong` (P,) are known to be so."""
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
        fitted = bridge(t_s, new, known, t_s[first:stop], noise=noise, prior=limits.prior)
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


def bridge(
    t_s: Array, values: Array, known: NDArray[np.bool_], asked_s: Array, *, noise: float, prior: PathPrior
) -> FittedPath | None:
    """Interpolate or extrapolate a path at asked times by the known samples around them; None without any."""
    rows = np.flatnonzero(known)
    before, after = rows[t_s[rows] < asked_s[0]], rows[t_s[rows] > asked_s[-1]]
    inside = rows[(t_s[rows] >= asked_s[0]) & (t_s[rows] <= asked_s[-1])]
    near = np.concatenate([_side(t_s, before, last=True), inside, _side(t_s, after, last=False)])
    if not len(near):
        return None
    return fit_path(t_s[near], values[near], noise, asked_s, prior)


def _side(t_s: Array, rows: NDArray[np.intp], *, last: bool) -> NDArray[np.intp]:
    """Choose the last or first of some samples: those within `WINDOW_S` of the nearest one, thinned, and some where they are sparse."""
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
    before = _side(samples.t_s, first.rows, last=True)
    after = _side(samples.t_s, second.rows, last=False)
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
    if from_right is None:
        assert from_left is not None
        return from_left[0][None], from_left[1]
    if from_left is None:
        return -from_right[0][None], from_right[1]
    (start, start_sigma), (end, end_sigma) = from_left, from_right
    both = np.hypot(start_sigma, end_sigma)
    if float(np.linalg.norm(start + end)) > MAX_SIGMAS * both + MAX_REST:
        share = ((t_s - t_s[0]) / max(float(np.ptp(t_s)), 1e-9))[:, None]
        return np.asarray((1 - share) * start - share * end), float(both)
    weight = end_sigma**2 / max(both**2, 1e-12)
    return (weight * start - (1 - weight) * end)[None], float(start_sigma * end_sigma / max(both, 1e-12))
