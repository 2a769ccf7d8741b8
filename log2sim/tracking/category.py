"""The category of a track, decided from the detector scores and the motion of all its measurements."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import GROUP_OF, Measurements
from log2sim.geometry import NS_PER_S, Array

# People run at up to 3 m/s in traffic; the speed is measured over this time, in which noise moves a center little.
MAX_PEDESTRIAN_SPEED_MPS = 3.0
SPEED_BASELINE_S = 0.6
# Quantile of a track's speeds that has to exceed the limit, so that a few wrong positions do not.
SPEED_QUANTILE = 0.75
# A bicycle that got farther than its own length and the errors of both positions moved, and none moves without a rider.
MIN_RIDDEN_M = 3.0
# Share of the measurements of a ridden bicycle that show the rider, who is larger than the bicycle.
MIN_RIDER_SHARE = 0.25
# Measurements at either end of a track whose median position counts, so that single wrong ones do not.
END_MEASUREMENTS = 5
# Errors of the positions at both ends of a shorter track may make up that speed.
MIN_FAST_S = 1.0


def decide_category(m: Measurements) -> str:
    """Decide the category of a track from its measurements, which are sorted by time.

    It is the one with most of the score; a pedestrian faster than people run is a cyclist whose bicycle the detector
    missed, and a bicycle that moves and sometimes shows a rider has one.
    """
    category = voted_category(m)
    if category == "pedestrian" and _speed_mps(m) > MAX_PEDESTRIAN_SPEED_MPS:
        return "cyclist"
    if (
        category == "bicycle"
        and _displacement_m(m) > MIN_RIDDEN_M
        and (m.category != category).mean() >= MIN_RIDER_SHARE
    ):
        return "cyclist"
    return category


def gets_on_fast(m: Measurements) -> bool:
    """Return whether a track gets on faster than people run, from one end to the other, which takes `MIN_FAST_S` or more.

    Errors of single positions make a pedestrian fast for a moment, but do not carry it away.
    """
    if (m.t_ns[-1] - m.t_ns[0]) / NS_PER_S < MIN_FAST_S:
        return False
    count = min(END_MEASUREMENTS, len(m) // 2)
    between_s = float(np.median(m.t_ns[-count:]) - np.median(m.t_ns[:count])) / NS_PER_S
    return _displacement_m(m) > MAX_PEDESTRIAN_SPEED_MPS * between_s


def voted_category(m: Measurements) -> str:
    """Return the category with most of the score of the group that has most of it; ties go to the first by name.

    Notes
    -----
    A motorcycle, a bicycle and their riders have much the same points but look different: within two-wheelers the
    measurements with an image decide, if there are any.
    """
    groups = np.array([GROUP_OF[c] for c in m.category.tolist()])
    group = _most_scored(groups, m.score)
    voters = groups == group
    with_image = voters & (m.camera != "")
    if group == "two_wheeler" and with_image.any():
        voters = with_image
    return _most_scored(m.category[voters], m.score[voters])


def _most_scored(names: NDArray[np.str_], score: Array) -> str:
    """Return the name, of names (n,), with the largest sum of scores (n,)."""
    unique, index = np.unique(names, return_inverse=True)
    return str(unique[np.argmax(np.bincount(index, weights=score))])


def _displacement_m(m: Measurements) -> float:
    """Return the distance between the median positions at both ends of a track."""
    count = min(END_MEASUREMENTS, len(m) // 2)
    if count == 0:
        return 0.0
    first, last = np.median(m.center_m[:count, :2], axis=0), np.median(m.center_m[-count:, :2], axis=0)
    return float(np.hypot(*(last - first)))


def _speed_mps(m: Measurements) -> float:
    """Return the robust maximum of the speeds over `SPEED_BASELINE_S`; 0 for a shorter track."""
    t = (m.t_ns - m.t_ns[0]) / NS_PER_S
    later = np.searchsorted(t, t + SPEED_BASELINE_S)
    start = np.flatnonzero(later < len(t))
    later = later[start]
    if len(start) == 0:
        return 0.0
    distance = np.hypot(*(m.center_m[later, :2] - m.center_m[start, :2]).T)
    return float(np.quantile(distance / (t[later] - t[start]), SPEED_QUANTILE))
