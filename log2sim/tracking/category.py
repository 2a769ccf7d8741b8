"""The category of a track, decided from the detector scores and the speed of all its measurements."""

from __future__ import annotations

import numpy as np

from log2sim.datatypes import Measurements
from log2sim.geometry import NS_PER_S

# People run at up to 3 m/s in traffic; the speed is measured over this time, in which noise moves a center little.
MAX_PEDESTRIAN_SPEED_MPS = 3.0
SPEED_BASELINE_S = 0.6
# Quantile of a track's speeds that has to exceed the limit, so that a few wrong positions do not.
SPEED_QUANTILE = 0.75


def decide_category(m: Measurements) -> str:
    """Decide the category of a track from its measurements, which are sorted by time.

    It is the one with most of the score; a pedestrian faster than people run is a cyclist whose bicycle the detector
    missed.
    """
    category = voted_category(m)
    return "cyclist" if category == "pedestrian" and _speed_mps(m) > MAX_PEDESTRIAN_SPEED_MPS else category


def voted_category(m: Measurements) -> str:
    """Return the category with most of the score; ties go to the first by name."""
    names, index = np.unique(m.category, return_inverse=True)
    return str(names[np.argmax(np.bincount(index, weights=m.score))])


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
