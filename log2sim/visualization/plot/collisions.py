"""Collisions of a replay that its scenario does not have."""

from __future__ import annotations

from typing import Any

import numpy as np

from log2sim.geometry import Array
from log2sim.simulation.metrics.collisions import REPLAY


def new_collisions(replay: Any) -> tuple[Array, Array]:
    """Find the collisions of a replay that its scenario does not have.

    Returns
    -------
    t_s : (K,) float64
        When each begins.
    xy_m : (K, 2) float64
        Midpoints between the centers of both boxes, map frame.
    """
    if replay is None:
        return np.zeros(0), np.zeros((0, 2))
    events = [e for e in replay.metrics.get("collisions", ()) if e["belongs_to"] == REPLAY]
    agents = {a.id: a for a in replay.agents}
    places = [
        np.mean(
            [[np.interp(e["t_s"], agents[k].t_s, c) for c in (agents[k].x_m, agents[k].y_m)] for k in e["agents"]],
            axis=0,
        )
        for e in events
    ]
    return np.array([e["t_s"] for e in events], dtype=np.float64), np.array(places, dtype=np.float64).reshape(-1, 2)
