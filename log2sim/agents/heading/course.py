"""What motion says about the front of a vehicle: it drives forward, but maneuvers slowly in reverse."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from log2sim.agents.heading.box_headings import MAX_HEADING_SCORE, MIN_AXIS_COS
from log2sim.config_sections import TrackConfig
from log2sim.datatypes import GROUP_OF, Boxes3D, Measurements, Waypoints
from log2sim.geometry import NS_PER_S, Array, wrap_angle
from log2sim.log_odds import log_odds_of, probability_of
from log2sim.tracking.merging import VELOCITY_WINDOW_S, velocities
from log2sim.tracking.motion import CENTER_SIGMA_M
from log2sim.tracking.tracker import track

# Log-odds that an object moves forward: of slow ones, one in five reverses, at 3 m/s one in a thousand.
FORWARD_LOG_ODDS, FORWARD_LOG_ODDS_PER_MPS, MAX_FORWARD_LOG_ODDS = 1.4, 2.0, 9.0
# A way shorter than so many standard deviations of its ends may be noise.
CERTAIN_SIGMAS = 4.0


def forward_log_odds(speed_mps: float) -> float:
    """Return the log-odds, in nats, that something that moves at a speed, at least 0, moves forward."""
    return FORWARD_LOG_ODDS + FORWARD_LOG_ODDS_PER_MPS * speed_mps


def course_log_odds(w: Waypoints, length_m: float) -> float:
    """Return the log-odds that the front of a vehicle is where its yaw points, by the ways that it drives either way.

    Notes
    -----
    The center of a standing vehicle seems to move by up to its length while more and more of it comes into view.
    """
    step_s = np.gradient(w.t_s) if len(w.t_s) > 1 else np.zeros(1)
    certain_m = max(length_m, CERTAIN_SIGMAS * float(np.median(w.sigma_xy_m)))
    return _one_way(np.maximum(w.speed_mps, 0.0), step_s, certain_m) - _one_way(
        np.maximum(-w.speed_mps, 0.0), step_s, certain_m
    )


def _one_way(speed_mps: Array, step_s: Array, certain_m: float) -> float:
    """Return the log-odds for the direction in which something drives at speeds (T,), 0 at other times."""
    distance_m, time_s = float(speed_mps @ step_s), float(step_s[speed_mps > 0].sum())
    if time_s <= 0:
        return 0.0
    return min(forward_log_odds(distance_m / time_s), MAX_FORWARD_LOG_ODDS) * min(distance_m / certain_m, 1.0)


def turn_to_courses(found: Sequence[Boxes3D], t_ns: NDArray[np.int64], config: TrackConfig) -> list[Boxes3D]:
    """Turn the boxes of T sweeps round whose objects move the other way, and give all that move the probability of their front.

    Parameters
    ----------
    found : T Boxes3D
        Map frame.
    t_ns : (T,) int64
        Stamps of the sweeps.
    config : TrackConfig

    Notes
    -----
    Boxes are tracked. What a track moves around a sweep counts beside what the detector says of its box there; what stands, is
    in one sweep alone, or is laid across its course stays as it is.
    """
    rows = [_placed(boxes) for boxes in found]
    yaw, score = [b.yaw_rad.copy() for b in found], [b.heading_score.copy() for b in found]
    for one in track(rows, t_ns, **config.model_dump()):
        m, group, velocity = one.measurements, GROUP_OF[one.category], velocities(one)
        speed, course = np.hypot(*velocity.T), np.arctan2(velocity[:, 1], velocity[:, 0])
        t_s = (m.t_ns - m.t_ns[0]) / NS_PER_S
        window_s = np.minimum(t_s + VELOCITY_WINDOW_S, t_s[-1]) - np.maximum(t_s - VELOCITY_WINDOW_S, 0.0)
        along = np.cos(m.box_yaw_rad - course)
        certain_m = CERTAIN_SIGMAS * CENTER_SIGMA_M[group]
        # People are about as wide as long, so that their boxes have no axis.
        moves = (speed * window_s >= certain_m) & ((np.abs(along) >= MIN_AXIS_COS) | (group == "pedestrian"))
        for k in np.flatnonzero(moves):
            tick = int(one.tick[k])
            row = int(np.argmin(np.abs(found[tick].center_m - m.box_center_m[k]).sum(axis=1)))
            own = float(log_odds_of(np.clip(m.heading_score[k], 0.5, MAX_HEADING_SCORE)))
            odds = own + np.sign(along[k]) * min(forward_log_odds(float(speed[k])), MAX_FORWARD_LOG_ODDS)
            score[tick][row] = probability_of(abs(odds))
            if odds < 0:
                yaw[tick][row] = wrap_angle(yaw[tick][row] + np.pi)
    return [replace(b, yaw_rad=y, heading_score=s) for b, y, s in zip(found, yaw, score)]


def _placed(boxes: Boxes3D) -> Measurements:
    """Return a row for each box, placed at its center as exactly as centers of boxes are."""
    sigma = np.array([CENTER_SIGMA_M[GROUP_OF[str(c)]] for c in boxes.category])
    return replace(
        Measurements.of_boxes(boxes, np.zeros(3)),
        center_m=boxes.center_m,
        covariance=sigma[:, None, None] ** 2 * np.eye(2),
        source=np.full(len(boxes), "lidar", dtype="<U16"),
    )
