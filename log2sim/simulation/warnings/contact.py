"""Whether and when two boxes meet that move as expected, with the probability that their errors leave."""

from __future__ import annotations

from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.simulation.metrics.time_to_collision import touching
from log2sim.simulation.warnings.expected_paths import ExpectedPaths

QUANTILES = 9
"""Of the errors along and across, so that a probability is exact to a hundredth; odd, so that one of them is no error."""

CHUNK = 256
"""Pairs of ways that are compared at once."""

REACH_SIGMA = 2.0
"""Beyond the outermost quantile, which is 1.6 standard deviations off, so that nothing is missed by looking no farther."""

MIN_TRAVEL_M = 1e-6
"""An ego that moves by less between leads stands."""


class Contacts(NamedTuple):
    """Expected contacts of C pairs of ways.

    Attributes
    ----------
    probability : (C,) float64
        That they meet within the horizon.
    time_s : (C,) float64, s
        Until they do: as expected without error; where that does not meet, the median of the times of errors that do.
        Infinite where none does.
    """

    probability: Array
    time_s: Array


def expected_contacts(ego: ExpectedPaths, others: ExpectedPaths, lead_s: Array) -> Contacts:
    """Compare C ways of the ego with one of another agent each, at leads (H,).

    Notes
    -----
    The errors of an agent at different leads are one: who is faster than expected is so throughout. They are normal along and
    across its course, with those of the ego added, and each takes `QUANTILES` values of equal probability; the probability is
    the share of the pairs of values with which the boxes meet. Between leads both move straight, and the time is exact. A
    first contact does not count where the ego stands by then, or is hit from behind, which its braking would not help, nor
    where boxes overlap already.
    """
    probability, time = np.zeros(len(ego.size_m)), np.full(len(ego.size_m), np.inf)
    near = np.flatnonzero(_in_reach(ego, others))
    for begin in range(0, len(near), CHUNK):
        rows = near[begin : begin + CHUNK]
        times = _contact_times(ego.take(rows), others.take(rows), lead_s)
        met = np.isfinite(times)
        probability[rows] = met.mean(axis=1)
        middle = times[:, times.shape[1] // 2]
        some = met.any(axis=1)
        median = np.full(len(rows), np.inf)
        median[some] = np.nanmedian(np.where(met, times, np.nan)[some], axis=1)
        time[rows] = np.where(np.isfinite(middle), middle, median)
    return Contacts(probability, time)


def _in_reach(ego: ExpectedPaths, others: ExpectedPaths) -> NDArray[np.bool_]:
    """Whether two ways come so near that their boxes may meet with any of the errors."""
    radius = (np.hypot(*ego.size_m.T) + np.hypot(*others.size_m.T)) / 2
    step = np.abs(np.diff(others.position_m - ego.position_m, axis=1)).max(axis=1, initial=0.0)
    sigma = np.hypot(others.sigma_m, ego.sigma_m)
    room = radius + step + REACH_SIGMA * np.hypot(sigma[..., 0], sigma[..., 1]).max(axis=1)
    return np.asarray(np.abs(others.position_m - ego.position_m).min(axis=1) <= room)


def _contact_times(ego: ExpectedPaths, others: ExpectedPaths, lead_s: Array) -> Array:
    """Return for pairs (C,) and all errors (K,) the times (C, K) of the first contact, infinite without."""
    along, across = _errors()
    sigma = np.hypot(others.sigma_m, ego.sigma_m)[:, None]
    off = sigma[..., 0] * along[:, None] + 1j * sigma[..., 1] * across[:, None]
    apart = (others.position_m - ego.position_m)[:, None] + off * others.course[:, None]
    span = np.diff(lead_s)
    start, rate = apart[..., :-1], np.diff(apart, axis=-1) / span
    shape = start.shape
    own, other = (np.broadcast_to(_middle(w.yaw_rad)[:, None], shape).ravel() for w in (ego, others))
    sizes = (np.broadcast_to(w.size_m[:, None, None], (*shape, 2)).reshape(-1, 2) for w in (ego, others))
    flat, speed = start.ravel(), rate.ravel()
    enter, leave = touching(flat.real, flat.imag, speed.real, speed.imag, own, other, *sizes)
    enter = np.maximum(enter, 0.0)
    meets = (enter < leave) & (enter <= np.broadcast_to(span, shape).ravel())
    then = np.where(meets, enter, 0.0)
    travel = np.diff(ego.position_m, axis=1)
    forward = np.where((travel * np.exp(-1j * _middle(ego.yaw_rad))).real < 0, -1.0, 1.0)
    moves = np.broadcast_to((np.abs(travel) > MIN_TRAVEL_M)[:, None], shape)
    ahead = ((flat + then * speed) * np.exp(-1j * own)).real.reshape(shape) * forward[:, None]
    times = np.where(meets, then + np.broadcast_to(lead_s[:-1], shape).ravel(), np.inf).reshape(shape)
    first = times.argmin(axis=-1)[..., None]
    counts = (ahead > -ego.size_m[:, :1, None] / 2) & moves
    time, counts = (np.take_along_axis(c, first, axis=-1)[..., 0] for c in (times, counts))
    return np.where(counts & (time > 0), time, np.inf)


def _errors() -> tuple[Array, Array]:
    """Return pairs of errors (K,), (K,) in standard deviations that are equally probable."""
    normal = NormalDist()
    values = np.array([normal.inv_cdf((k + 0.5) / QUANTILES) for k in range(QUANTILES)])
    return np.repeat(values, QUANTILES), np.tile(values, QUANTILES)


def _middle(yaw_rad: Array) -> Array:
    """Return the yaws (C, H - 1) in the middle between leads."""
    turn = np.angle(np.exp(1j * np.diff(yaw_rad, axis=1)))
    return np.asarray(yaw_rad[:, :-1] + turn / 2)
