"""Whether given poses are good enough, by what the LiDAR shows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from log2sim.datatypes import Log
from log2sim.documents import rounded
from log2sim.geometry import Array, PoseTrack
from log2sim.localization.odometry import Odometry
from log2sim.localization.scatter import Scatter, compare_poses

# Given poses are replaced where surroundings show that they are off by more than this against each other. Smoothing takes ego
# positions for right to 0.02 m, 0.03 m between two of them; odometry errs by as much.
MIN_EXCESS_M = 0.05
MIN_WORSE_SHARE = 0.75
# Odometry replaces given poses only if nearly all sweeps are registered and hold every direction of motion.
MAX_UNSURE_SHARE = 0.1
PAIRS_OF = ("apart", "neighbors")

Figures = dict[str, float | None]


@dataclass(frozen=True, eq=False)
class Verdict:
    """Whether given poses are kept.

    Attributes
    ----------
    keep : bool
    reason : str
        For people.
    excess_m, scatter_m : dict
        See `PoseChoice`.
    """

    keep: bool
    reason: str
    excess_m: Figures
    scatter_m: dict[str, Figures]


def compare_with_given(log: Log, found: Odometry, track: PoseTrack) -> Verdict:
    """Compare the given poses of a log with those of odometry, `track`, by the scatter of upright surfaces.

    Notes
    -----
    Odometry is fitted to the very sweeps that judge it, so that it is always somewhat sharper: given poses are replaced only
    where they are worse by more than `MIN_EXCESS_M`, in most pairs. What no surface holds, such as the way along a tunnel,
    shows in neither scatter; there given poses are kept.
    """
    assert log.ego is not None
    both = compare_poses(log, found.lidar, {"given": log.ego, "lidar": track}, found.t_ns)
    scatter = {source: {name: _rms(_column(rows, name)) for name in PAIRS_OF} for source, rows in both.items()}
    excess = {name: _excess(_column(both["given"], name), _column(both["lidar"], name)) for name in PAIRS_OF}
    words, unsure = _words(scatter, both["given"].apart_s), unsure_share(found)
    if unsure > MAX_UNSURE_SHARE:
        return Verdict(True, f"LiDAR odometry is not sure of {unsure:.0%} of the sweeps; {words}", excess, scatter)
    worse = any(
        value is not None
        and value > MIN_EXCESS_M
        and _worse_share(_column(both["given"], name), _column(both["lidar"], name)) >= MIN_WORSE_SHARE
        for name, value in excess.items()
    )
    more = "more" if worse else "no more"
    return Verdict(not worse, f"{words}; the given poses are off by {more} than {MIN_EXCESS_M} m", excess, scatter)


def unsure_share(found: Odometry) -> float:
    """Compute the share of sweeps without a pose, or with one that is predicted or poorly held in one direction."""
    sure = np.sum(~(found.degenerate | found.predicted))
    return 1.0 - float(sure) / max(found.sweeps, 1)


def _column(rows: Scatter, name: str) -> Array:
    return rows.apart_m if name == "apart" else rows.neighbors_m


def _excess(given: Array, lidar: Array) -> float | None:
    """Compute how far given poses are off: the root of the difference of both mean squares; None without a pair."""
    usable = np.isfinite(given) & np.isfinite(lidar)
    if not usable.any():
        return None
    difference = float(np.mean(given[usable] ** 2) - np.mean(lidar[usable] ** 2))
    return rounded(float(np.sqrt(max(difference, 0.0))), 4)


def _worse_share(given: Array, lidar: Array) -> float:
    """Compute the share of pairs in which given poses are worse."""
    usable = np.isfinite(given) & np.isfinite(lidar)
    return float(np.mean(given[usable] > lidar[usable]))


def _rms(values: Array) -> float | None:
    finite = values[np.isfinite(values)]
    return rounded(float(np.sqrt(np.mean(finite**2))), 4) if len(finite) else None


def _words(scatter: dict[str, Figures], apart_s: float) -> str:
    """Describe both scatters in words."""
    parts = []
    for name, pairs in (("apart", f"in sweeps {apart_s:.1f} s apart"), ("neighbors", "in successive sweeps")):
        given, lidar = scatter["given"][name], scatter["lidar"][name]
        if given is not None and lidar is not None:
            parts.append(f"{pairs} {given:.3f} m with the given poses and {lidar:.3f} m with odometry")
    return f"upright surfaces differ {', '.join(parts)}" if parts else "no upright surface to compare"
