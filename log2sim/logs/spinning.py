"""Times at which a spinning LiDAR scans directions: a labeled box fits the points, so it has the time of its direction."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array


def compute_turn_share(xy_lidar: Array, start_azimuth_rad: float = np.pi) -> Array:
    """Compute the share of a clockwise turn after which a LiDAR scans directions.

    Parameters
    ----------
    xy_lidar : (N, >= 2) float64, m
        Points, from the LiDAR.
    start_azimuth_rad : float, rad
        Direction in which the turn starts and ends, counter-clockwise from x, in (-pi, pi].

    Returns
    -------
    (N,) float64
        0 to 1; 1 only for directions that end the turn.
    """
    turned = (start_azimuth_rad - np.arctan2(xy_lidar[:, 1], xy_lidar[:, 0])) / (2 * np.pi)
    return np.asarray(turned + (turned < 0))


def compute_scan_offset_ns(xy_lidar: Array, turn_ns: int) -> NDArray[np.int64]:
    """Compute the time (N,) at which a LiDAR scans directions, relative to the end of its turn.

    Parameters
    ----------
    xy_lidar : (N, >= 2) float64, m
        Points, from the LiDAR, which turns clockwise and starts and ends in the direction of -x.
    turn_ns : int
        Duration of the turn.
    """
    return np.round((compute_turn_share(xy_lidar) - 1) * turn_ns).astype(np.int64)


def select_spaced(t_ns: NDArray[np.int64], track_id: NDArray[np.str_], min_step_ns: int) -> NDArray[np.intp]:
    """Select the rows (M,) that keep the stamps of each track apart.

    An object that crosses the direction in which the turns start is scanned at the end of one turn and at the start of the
    next: the later one is dropped.

    Parameters
    ----------
    t_ns : (N,) int64
        Those of each track in the order of the turns.
    track_id : (N,) str
    min_step_ns : int
        Rows sooner after the last one that was kept of their track are dropped.
    """
    last: dict[str, int] = {}
    keep = []
    for row, (t, track) in enumerate(zip(t_ns.tolist(), track_id.tolist())):
        if track not in last or t - last[track] >= min_step_ns:
            last[track] = t
            keep.append(row)
    return np.array(keep, dtype=np.intp)
