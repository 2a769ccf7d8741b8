"""What the boxes of a 3D detector say about the front of a track."""

from __future__ import annotations

import numpy as np

from log2sim.agents.box_votes import independent
from log2sim.datatypes import BoxEvidence
from log2sim.geometry import Array
from log2sim.log_odds import log_odds_of

# A probability nearer to 1 is not believed: networks are surer than right.
MAX_HEADING_SCORE = 0.99
# A box turned farther than this from the axis of the object says nothing about its front.
MIN_AXIS_COS = 0.7


def heading_log_odds(m: BoxEvidence, yaw_rad: Array | float) -> float:
    """Return the log-odds that the object of a track points along a yaw rather than backward; 0 without boxes.

    Notes
    -----
    The sum of the log-odds of all ticks, scaled down to that of as many independent ones (`independent`).
    """
    rows = np.flatnonzero(np.isfinite(m.box_yaw_rad))
    along = np.cos(m.box_yaw_rad[rows] - np.broadcast_to(yaw_rad, len(m.t_ns))[rows])
    rows, along = rows[np.abs(along) >= MIN_AXIS_COS], along[np.abs(along) >= MIN_AXIS_COS]
    if len(rows) == 0:
        return 0.0
    p = np.clip(m.heading_score[rows], 0.5, MAX_HEADING_SCORE)
    votes = np.sign(along) * log_odds_of(p)
    return float(votes.mean()) * independent(len(rows))
