"""Traffic that passes a vehicle: on which side of the road it drives, and which way vehicles next to its path face."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from log2sim.geometry import Array
from log2sim.log_odds import log_odds_of

# Vehicles that meet on one road pass each other within the road's width, and farther to the side than vehicles of one lane.
ROAD_M, LANE_M = 20.0, 1.8
PATH_SAMPLES = 40
OPPOSITE_COS = -0.7
# Two thirds of the world's people and 72 % of its roads keep right (Lucas, "Which side of the road do they drive on?", 2005).
USUALLY_RIGHT = 0.72
# Log-odds of each pair that meets: one in twenty meets on a car park, or at a turn, or one of both overtakes.
MEETING_LOG_ODDS, MAX_SIDE_LOG_ODDS = 3.0, 6.0
# Probability that a vehicle standing next to the path of another one faces in the direction of that side: in its own lane (a
# queue), at the near curb, between it and the next lane (the lane may be of either direction), and beyond (unless the street is one-way).
IN_LANE, NEAR_CURB, NEXT_LANE, BEYOND = 0.97, 0.92, 0.7, 0.85
# A vehicle's center is in the lane of a path that is nearer than half the width left in a lane of 3.5 m plus half a car; the lane
# beyond the next begins one and a half lanes away.
IN_LANE_M, BEYOND_M = 1.2, 4.5
# Standard deviation of the yaw between a street and vehicles parked along it, and lengths over which a street is known to go on
# ahead and to the side: streets bend, and farther to the side is another street or a yard.
PARALLEL_SIGMA_RAD, AHEAD_M, STREET_M, ASIDE_M = 0.15, 25.0, 9.0, 3.0
# A path that far away belongs to the street with a probability of less than 1e-5.
FAR_M = 500.0


def side_log_odds(paths: Sequence[Array]) -> float:
    """Return the log-odds that traffic keeps to the right, from vehicles that meet each other.

    Parameters
    ----------
    paths : sequence of (K, 3) float64
        x, y in m and heading in rad of each vehicle that moved, the ego among them.

    Notes
    -----
    Each pair of vehicles of opposite headings has one vote: where the oncoming one passes on the left, traffic keeps
    right.
    """
    votes = 0.0
    thinned = [p[np.linspace(0, len(p) - 1, min(len(p), PATH_SAMPLES)).astype(np.intp)] for p in paths if len(p)]
    extents = np.array([[*p[:, :2].min(axis=0), *p[:, :2].max(axis=0)] for p in thinned]).reshape(-1, 4)
    apart = np.any(extents[:, None, :2] - extents[None, :, 2:] > ROAD_M, axis=2)
    for i, j in zip(*np.nonzero(np.triu(~(apart | apart.T), 1))):
        one, other = thinned[i], thinned[j]
        to = other[None, :, :2] - one[:, None, :2]
        c, s = np.cos(one[:, 2])[:, None], np.sin(one[:, 2])[:, None]
        left = c * to[..., 1] - s * to[..., 0]
        near = np.hypot(to[..., 0], to[..., 1]) < ROAD_M
        meets = near & (np.cos(one[:, None, 2] - other[None, :, 2]) < OPPOSITE_COS) & (np.abs(left) > LANE_M)
        if meets.any():
            votes += np.sign(np.median(left[meets]))
    evidence = np.clip(MEETING_LOG_ODDS * votes, -MAX_SIDE_LOG_ODDS, MAX_SIDE_LOG_ODDS)
    return float(log_odds_of(USUALLY_RIGHT) + evidence)


def street_log_odds(pose: Array, paths: Sequence[Array], *, keeps_right: bool) -> float:
    """Return the log-odds that the street's direction where something stands is along its yaw, by the traffic next to it.

    Parameters
    ----------
    pose : (3,) float64
        x, y in m and yaw in rad.
    paths : sequence of (K, 3) float64
        As in `side_log_odds`.
    keeps_right : bool

    Notes
    -----
    The mean over the paths, the nearer the heavier. A path says the less the farther it is and the less parallel, so nothing
    follows the traffic of another street.
    """
    odds, weights = [], []
    for passing in _passing_by(pose[:2], paths, float(pose[2])):
        along = _direction_at(passing.left_m if keeps_right else -passing.left_m)
        chance = 0.5 + passing.belongs * (along - 0.5)
        sign = 1.0 if np.cos(passing.heading_rad - pose[2]) > 0 else -1.0
        odds.append(sign * float(log_odds_of(chance)))
        weights.append(passing.weight)
    total = float(np.sum(weights))
    return float(np.dot(weights, odds) / total) if total > 0 else 0.0


def street_axis(xy: Array, paths: Sequence[Array]) -> tuple[float, float]:
    """Return the yaw in rad, up to half turns, of the street at a place (2,), and the probability that it belongs to it."""
    surest = max(_passing_by(xy, paths, None), key=lambda passing: passing.belongs, default=None)
    return (0.0, 0.0) if surest is None else (surest.heading_rad, surest.belongs)


@dataclass(frozen=True)
class _Passing:
    """How a path passes a place.

    Attributes
    ----------
    left_m : float
        Of the place, to the left of the path.
    heading_rad : float
        Of the path.
    belongs : float
        Probability that the place belongs to its street.
    """

    left_m: float
    heading_rad: float
    belongs: float

    @property
    def weight(self) -> float:
        """Of what the path says, beside other paths."""
        return self.belongs / (1.0 + abs(self.left_m) / 2) ** 2


def _passing_by(xy: Array, paths: Sequence[Array], yaw_rad: float | None) -> list[_Passing]:
    """Find how each path passes a place (2,), or something there with a yaw, which should be parallel."""
    found = []
    for path in paths:
        if len(path) == 0 or np.abs(path[:, :2] - xy).max(axis=1).min() > FAR_M:
            continue
        to = xy - path[:, :2]
        c, s = np.cos(path[:, 2]), np.sin(path[:, 2])
        ahead, left = to[:, 0] * c + to[:, 1] * s, -to[:, 0] * s + to[:, 1] * c
        turned = np.zeros(len(path)) if yaw_rad is None else np.sin(path[:, 2] - yaw_rad) / PARALLEL_SIGMA_RAD
        aside = np.maximum(np.abs(left) - STREET_M, 0.0)
        belongs = np.exp(-(turned**2) / 2 - np.abs(ahead) / AHEAD_M - aside / ASIDE_M)
        k = int(np.argmax(belongs))
        found.append(_Passing(float(left[k]), float(path[k, 2]), float(belongs[k])))
    return found


def _direction_at(left_m: float) -> float:
    """Return the probability that the street goes the way of a path at a place left of it, where traffic keeps right."""
    if abs(left_m) < IN_LANE_M:
        return IN_LANE
    if left_m < 0:
        return NEAR_CURB
    return 1.0 - (NEXT_LANE if left_m < BEYOND_M else BEYOND)
