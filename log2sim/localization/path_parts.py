"""Parts of a path between which it jumps or stops in a way that no vehicle moves.

Positions or yaws are samples of a path, in units u: m or rad. Where the second derivative is beyond what vehicles do, by more
than noise explains, the path breaks. What lies between two breaks is a part; the parts that one vehicle can have driven, and
that last longest together, are right.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.localization.path_noise import SPANS_S

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
# Successive samples that repeat one, at least.
MIN_SAME = 3
# Parts farther back are no longer compared: between them almost any motion is possible.
MAX_COMPARED = 30


@dataclass(frozen=True, eq=False)
class Samples:
    """Samples of a path.

    Attributes
    ----------
    t_s : (P,) float64, s
        Strictly increasing.
    values : (P, D) float64, u
    max_change : float, u/s2
        Largest second derivative of a vehicle's path.
    sigma : float, u
        Standard deviation of their noise, see `noise_of`.
    """

    t_s: Array
    values: Array
    max_change: float
    sigma: float


@dataclass(frozen=True, eq=False)
class Part:
    """Successive samples that a vehicle can have driven.

    Attributes
    ----------
    rows : (n,) int
        Rows of `Samples`.
    right : bool
        Whether it belongs to the parts that are taken for right.
    at_rest : bool
        Whether it stays in one place although the path enters or leaves it at a speed.
    """

    rows: NDArray[np.intp]
    right: bool = True
    at_rest: bool = False


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
    edges = np.flatnonzero(np.diff(np.concatenate([[True], broken, [True]]).astype(np.int8)))
    cores = [np.arange(first, end) for first, end in zip(edges[::2].tolist(), edges[1::2].tolist())]
    if not cores:
        return []
    grown = _grown(samples, cores)
    rows = [r for part in grown[:-1] for r in _without_rest(samples, part)] + grown[-1:]
    parts = [Part(r) for r in rows]
    return _choose(samples, _marked_at_rest(samples, parts))


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


def _grown(samples: Samples, cores: list[NDArray[np.intp]]) -> list[NDArray[np.intp]]:
    """Add to parts the samples beside them that continue their motion."""
    grown, taken = [], 0
    for k, core in enumerate(cores):
        limit = cores[k + 1][0] if k + 1 < len(cores) else len(samples.t_s)
        start, stop = int(core[0]), int(core[-1]) + 1
        head, tail = _end(samples, core, first=True), _end(samples, core, first=False)
        while start > taken and _continues(samples, head, start - 1):
            start -= 1
        while stop < limit and _continues(samples, tail, stop):
            stop += 1
        grown.append(np.arange(start, stop))
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
    t, t_end = samples.t_s[rows], float(samples.t_s[rows[0 if first else -1]])
    near = np.abs(t - t_end) <= END_S
    if near.sum() < 3 and len(rows) >= 3:
        near = np.zeros(len(rows), dtype=bool)
        near[: 3 if first else None] = first
        near[None if first else -3 :] |= not first
    used, span = rows[near], float(np.ptp(t[near]))
    if len(used) < 2 or span < MIN_END_S:
        value = samples.values[rows[0 if first else -1]]
        none = np.zeros_like(value)
        return _End(t_end, value, none, none, samples.sigma, 0.0, UNKNOWN_RATE)
    degree = 2 if len(used) > 2 and span >= END_S / 2 else 1
    powers = np.vander(samples.t_s[used] - t_end, degree + 1, increasing=True)
    solution = np.linalg.lstsq(powers, samples.values[used], rcond=None)[0]
    spread = np.sqrt(np.diag(np.linalg.inv(powers.T @ powers))) * samples.sigma
    slack = MAX_JERK * span**2 / 12 if degree == 2 else samples.max_change * span / 2
    change = 2 * solution[2] if degree == 2 else np.zeros_like(solution[0])
    return _End(t_end, solution[0], solution[1], change, float(spread[0]), float(spread[1]), slack)


def _without_rest(samples: Samples, rows: NDArray[np.intp]) -> list[NDArray[np.intp]]:
    """Divide a part that ends in one place, at which the path goes on with a break, unless the vehicle stopped there by itself."""
    same = (samples.values[rows] == samples.values[rows[-1]]).all(axis=1)
    moving = len(rows) - int(np.argmin(same[::-1])) if not same.all() else 0
    if len(rows) - moving < MIN_SAME or moving < MIN_SAME:
        return [rows]
    end = _end(samples, rows[:moving], first=False)
    place = samples.values[rows[-1]]
    rest = _End(float(samples.t_s[rows[moving]]), place, np.zeros_like(place), np.zeros_like(place), 0.0, 0.0, 0.0)
    return [rows] if _same_rate(samples, end, rest, USUAL_CHANGE_SHARE) else [rows[:moving], rows[moving:]]


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


def _is_possible(samples: Samples, end: _End, start: _End) -> bool:
    """Return whether a vehicle can get from the end of a part to the start of a later one."""
    off, most = _step_and_limit(samples, end, start)
    return _same_rate(samples, end, start) and float(np.linalg.norm(off)) <= most


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
    """A step between two parts that are used as they are.

    Attributes
    ----------
    first, last : int
        Rows of the last sample before the step and of the first one after it.
    size : float, u
    """

    first: int
    last: int
    size: float


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
        earlier = [(best[j][0], j) for j in before if _is_possible(samples, tails[j], heads[k])]
        total, from_part = max(earlier, default=(0.0, None), key=lambda e: e[0])
        best[k] = (total + float(np.ptp(samples.t_s[parts[k].rows])), from_part)
    chosen: set[int] = set()
    k_next = max(best, key=lambda k: best[k][0], default=None)
    while k_next is not None:
        chosen.add(k_next)
        k_next = best[k_next][1]
    return [Part(part.rows, k in chosen, part.at_rest) for k, part in enumerate(parts)]
