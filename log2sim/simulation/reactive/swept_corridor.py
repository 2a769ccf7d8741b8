"""Where boxes reach into the corridor that an agent will sweep along its own path."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.simulation.reactive.path_table import PathTable

HORIZON_S = np.arange(0.0, 3.01, 0.25)
"""Times (H,) ahead at which others are predicted: a car that crosses at 20 m/s moves by its length in between."""


class PredictedBoxes(NamedTuple):
    """Boxes of the other agents of pairs (P,) at the times of the horizon (H,).

    Attributes
    ----------
    x_m, y_m, yaw_rad, speed_mps : (P, H) float64
    length_m, width_m : (P,) float64
    """

    x_m: Array
    y_m: Array
    yaw_rad: Array
    speed_mps: Array
    length_m: Array
    width_m: Array


class SweptCorridor(NamedTuple):
    """The corridors that agents (P,) will sweep.

    Attributes
    ----------
    agent : (P,) int
        Whose path.
    distance_m : (P,) float64
        Present distance along it.
    length_m, width_m : (P,) float64
    pace_mps : (P,) float64
    progress_m : (P, H) float64
        How far they intend to go from here until the times of the horizon.
    reach_m : float
        Look-ahead distance.
    """

    agent: NDArray[np.intp]
    distance_m: Array
    length_m: Array
    width_m: Array
    pace_mps: Array
    progress_m: Array
    reach_m: float


class SafetyMargins(NamedTuple):
    """Margins that are kept to other agents.

    Attributes
    ----------
    side_m : float
        On both sides of the corridor.
    crossing_m, crossing_s : float
        Before a crossing agent, as a distance and as a time.
    behind_m : float
        How far behind the agent's progress another center still counts as ahead.
    """

    side_m: float
    crossing_m: float
    crossing_s: float
    behind_m: float


class Leaders(NamedTuple):
    """What agents (P,) have to keep clear of.

    Attributes
    ----------
    gap_m : (P,) float64
        From the front bumper; inf without a leader.
    speed_mps : (P,) float64
        Of the leader, along the path.
    ahead_s : (P,) float64
        When it is in the corridor; 0 if it is now.
    own_t_s : (P,) float64
        The scenario's time of the agent at that place.
    """

    gap_m: Array
    speed_mps: Array
    ahead_s: Array
    own_t_s: Array


def leaders(paths: PathTable, corridor: SweptCorridor, boxes: PredictedBoxes, margins: SafetyMargins) -> Leaders:
    """Find for each pair what the agent has to keep clear of in the other's box, now or within the horizon.

    Notes
    -----
    A box that is in the corridor and will stay there is followed. A crossing box counts if the agent, at its intended
    progress, comes near it while it is in the corridor. Boxes whose center is behind that of the agent never count. For a
    box that moves along the path while it enters, the gap is reduced by its motion until then, so a cut-in is a leader.
    Cost: P H reach / 4 distances.
    """
    c = corridor
    foot = paths.foot(c.agent, c.distance_m, c.reach_m, boxes.x_m, boxes.y_m)
    cos, sin = np.cos(boxes.yaw_rad), np.sin(boxes.yaw_rad)
    turn_cos, turn_sin = cos * foot.cos + sin * foot.sin, sin * foot.cos - cos * foot.sin
    half_length, half_width = boxes.length_m[:, None] / 2, boxes.width_m[:, None] / 2
    within = c.width_m[:, None] / 2 + margins.side_m
    center = foot.distance_m + foot.ahead_m - c.distance_m[:, None]
    inside = np.abs(foot.left_m) < within + half_length * np.abs(turn_sin) + half_width * np.abs(turn_cos)
    ahead = center > c.progress_m - margins.behind_m
    # A box that is once behind within the corridor approaches from behind: the other driver is responsible.
    inside &= ahead & ~np.logical_or.accumulate(inside & ~ahead, axis=1)
    gap = center + _nearest_edge(foot.left_m, turn_cos, turn_sin, half_length, half_width, within)
    gap -= c.length_m[:, None] / 2

    stays = inside[:, 0] & inside[:, -1]
    met = inside & (gap <= c.progress_m + margins.crossing_m + margins.crossing_s * c.pace_mps[:, None])
    first = np.where(stays, 0, np.argmax(met, axis=1))
    row = np.arange(len(first))
    ahead_s, speed = HORIZON_S[first], (boxes.speed_mps * turn_cos)[row, first]
    now = gap[row, first] - np.maximum(speed, 0.0) * ahead_s
    own_t_s = foot.t_s[row, first]
    return Leaders(
        np.where(stays | met.any(axis=1), now, np.inf), speed, ahead_s, np.where(np.isnan(own_t_s), np.inf, own_t_s)
    )


def _nearest_edge(left: Array, cos: Array, sin: Array, half_length: Array, half_width: Array, within: Array) -> Array:
    """Return how far ahead of their center (so negative) rectangles begin within the corridor |y| < `within`, in m.

    `left` is the lateral position of the center, `cos`, `sin` the relative heading. The rearmost corner counts if it is
    inside, else the point where the edge that leads inward from there enters.
    """
    forward, upward = np.where(cos >= 0, 1.0, -1.0), np.where(sin >= 0, 1.0, -1.0)
    corner_x = -(np.abs(cos) * half_length + np.abs(sin) * half_width)
    corner_y = left - forward * sin * half_length + upward * cos * half_width
    beside = np.maximum(np.abs(corner_y) - within, 0.0)
    # Two edges meet in the corner: the long side leads to the left where forward and upward agree, the short one to the right.
    long_side = (forward == upward) == (corner_y < 0)
    across = np.where(long_side, np.abs(sin), np.abs(cos))
    ahead = np.where(long_side, np.abs(cos), np.abs(sin))
    result: Array = corner_x + beside * np.divide(
        ahead, across, out=np.zeros_like(across), where=(across > 0) & (beside > 0)
    )
    return result
