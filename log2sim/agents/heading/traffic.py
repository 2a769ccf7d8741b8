"""The side of the road that traffic keeps to, and which way vehicles parked beside it point."""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from itertools import combinations

import numpy as np

from log2sim.geometry import Array, wrap_angle


class Side(IntEnum):
    """Side of the road that traffic keeps to."""

    RIGHT = 1
    LEFT = -1


# Vehicles that meet on one road pass each other within the road's width, and farther to the side than vehicles of one lane.
ROAD_M, LANE_M = 20.0, 1.8
PATH_SAMPLES = 40
OPPOSITE_COS, PARALLEL_COS = -0.7, 0.7
REACH_M = 40.0
# Log-odds that a parked vehicle points with the traffic: five of six do where the rule is to, fewer on car parks.
FLOW_LOG_ODDS = 1.6
# Assumed where no traffic meets: two thirds of the world's people and 72 % of its roads keep right (Lucas, "Which side of the
# road do they drive on?", 2005).
USUAL_SIDE = Side.RIGHT


def side_of_traffic(paths: Sequence[Array]) -> Side:
    """Infer the side of the road that traffic keeps to, from vehicles that meet each other.

    Parameters
    ----------
    paths : sequence of (K, 3) float64
        x, y in m and heading in rad of each vehicle that moved, the ego among them.

    Returns
    -------
    side : Side
        `Side.RIGHT` or `Side.LEFT`; `USUAL_SIDE` where no two vehicles meet, or as many on the one side as on the other.

    Notes
    -----
    Each pair of vehicles of opposite headings has one vote: where the oncoming one passes on the left, traffic keeps
    right.
    """
    votes = 0.0
    thinned = [p[np.linspace(0, len(p) - 1, min(len(p), PATH_SAMPLES)).astype(np.intp)] for p in paths if len(p)]
    for one, other in combinations(thinned, 2):
        to = other[None, :, :2] - one[:, None, :2]
        c, s = np.cos(one[:, 2])[:, None], np.sin(one[:, 2])[:, None]
        left = c * to[..., 1] - s * to[..., 0]
        near = np.hypot(to[..., 0], to[..., 1]) < ROAD_M
        meets = near & (np.cos(one[:, None, 2] - other[None, :, 2]) < OPPOSITE_COS) & (np.abs(left) > LANE_M)
        if meets.any():
            votes += np.sign(np.median(left[meets]))
    return Side(int(np.sign(votes))) if votes else USUAL_SIDE


def parked_heading(yaw_rad: float, xy: Array, flow: Array, *, side: Side = USUAL_SIDE, log_odds: float = 0.0) -> float:
    """Choose between the two directions of a parked vehicle: that of the traffic on its side of the road.

    Parameters
    ----------
    yaw_rad : float
        Known up to half a turn.
    xy : (2,) float64, m
    flow : (K, 3) float64
        x, y in m and heading in rad of vehicles that moved; without any near enough the yaw stays as it is.
    side : Side
        From `side_of_traffic`.
    log_odds : float
        That it points along the yaw and not backward, from elsewhere.

    Notes
    -----
    A vehicle parked on a moving vehicle's own side of the road points along its path, one parked beyond the oncoming lane
    against it. Every position of every path votes, weighted by its nearness.
    """
    if log_odds + FLOW_LOG_ODDS * _flow_vote(yaw_rad, xy, flow, side) >= 0:
        return float(wrap_angle(yaw_rad))
    return float(wrap_angle(yaw_rad + np.pi))


def _flow_vote(yaw_rad: float, xy: Array, flow: Array, side: Side) -> float:
    """Return 1 where traffic nearby speaks for a yaw, -1 where it speaks for the opposite one, 0 without any."""
    if len(flow) == 0:
        return 0.0
    to = xy - flow[:, :2]
    c, s = np.cos(flow[:, 2]), np.sin(flow[:, 2])
    along, left = to[:, 0] * c + to[:, 1] * s, -to[:, 0] * s + to[:, 1] * c
    parallel = np.abs(np.cos(flow[:, 2] - yaw_rad)) > PARALLEL_COS
    near = parallel & (np.abs(along) < REACH_M) & (np.abs(left) < REACH_M / 3)
    if not near.any():
        return 0.0
    direction = np.where(side * left[near] > LANE_M, -1.0, 1.0)
    weight = 1.0 / (1.0 + np.abs(left[near]) / 2 + np.abs(along[near]) / 10) ** 2
    return float(np.sign(np.sum(weight * direction * np.sign(np.cos(flow[near, 2] - yaw_rad)))))
