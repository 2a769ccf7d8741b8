"""What the boxes of a 3D detector say about a whole track: size, axis and center."""

from __future__ import annotations

import numpy as np

from log2sim.datatypes import BoxEvidence
from log2sim.geometry import Array
from log2sim.perception.box_completion import box_sigma

# Errors of one detector about one object are alike at neighboring ticks: correlation between any two of them.
TICK_CORRELATION = 0.5
# So many places of a long track do for how much its ticks have in common.
MAX_PLACES = 200


def independent(count: int) -> float:
    """Return how many independent ticks are worth as much as `count` correlated ones, at most 1 / `TICK_CORRELATION`."""
    return count / (1 + (count - 1) * TICK_CORRELATION) if count else 0.0


def independent_along(xy_m: Array, length_m: float) -> float:
    """Return how many independent ticks are worth as much as those at which an object of a length was at places (n, 2).

    What a detector mistakes for a road user stays where it is. Something that moves on is seen from other sides and before other
    things, so that errors at two places are the less alike the more lengths they are from each other.
    """
    count = min(len(xy_m), MAX_PLACES)
    places = xy_m[np.linspace(0, len(xy_m) - 1, count).round().astype(np.intp)]
    apart_m = np.hypot(*(places[:, None] - places[None]).transpose(2, 0, 1))
    alike = TICK_CORRELATION * np.exp(-apart_m / length_m)
    np.fill_diagonal(alike, 1.0)
    return float(count**2 / alike.sum())


def typical_box_size(m: BoxEvidence) -> Array | None:
    """Return the size (3,) of the boxes of a track, the median weighted by their points; None without boxes."""
    rows = np.flatnonzero(np.isfinite(m.box_yaw_rad))
    if len(rows) == 0:
        return None
    weight = box_sigma(m.points[rows]) ** -2
    return np.array([weighted_median(m.box_size_m[rows, axis], weight) for axis in range(3)])


def mean_box_center(m: BoxEvidence) -> tuple[Array, float]:
    """Return the robust mean (2,) of the box centers of a track that stands, and its standard deviation; NaN without boxes."""
    rows = np.flatnonzero(np.isfinite(m.box_yaw_rad))
    if len(rows) == 0:
        return np.full(2, np.nan), np.nan
    sigma = box_sigma(m.points[rows])
    center = np.array([weighted_median(m.box_center_m[rows, axis], sigma**-2) for axis in range(2)])
    return center, float(np.median(sigma)) / np.sqrt(independent(len(rows)))


def mean_box_axis(m: BoxEvidence) -> float | None:
    """Return the mean yaw of the boxes of a track, in rad up to half turns; None without boxes."""
    rows = np.flatnonzero(np.isfinite(m.box_yaw_rad))
    if len(rows) == 0:
        return None
    weight, doubled = box_sigma(m.points[rows]) ** -2, 2 * m.box_yaw_rad[rows]
    return float(np.arctan2(weight @ np.sin(doubled), weight @ np.cos(doubled))) / 2


def weighted_median(values: Array, weight: Array) -> float:
    """Return the smallest of the values (N,), N > 0, that half of the weight (N,) does not exceed."""
    return weighted_quantile(values, weight, 0.5)


def weighted_quantile(values: Array, weight: Array, share: float) -> float:
    """Return the smallest of the values (N,), N > 0, that hold a share of the weight (N,) together with all smaller ones."""
    order = np.argsort(values, kind="stable")
    reached = np.cumsum(weight[order])
    return float(values[order[np.searchsorted(reached, reached[-1] * share)]])
