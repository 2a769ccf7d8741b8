"""Where a replay has collisions that its log has not."""

from __future__ import annotations

from typing import Any

import numpy as np

from log2sim.geometry import Array


def hits_of(replay: Any) -> tuple[Array, Array]:
    """Times (K,) at which new collisions begin, and the places (K, 2) halfway between the centers of the boxes."""
    if replay is None:
        return np.zeros(0), np.zeros((0, 2))
    events = [e for e in replay.metrics.get("collisions", ()) if not e["in_log"]]
    agents = {a.id: a for a in replay.agents}
    places = [
        np.mean(
            [[np.interp(e["t_s"], agents[k].t_s, c) for c in (agents[k].x_m, agents[k].y_m)] for k in e["agents"]],
            axis=0,
        )
        for e in events
    ]
    return np.array([e["t_s"] for e in events], dtype=np.float64), np.array(places, dtype=np.float64).reshape(-1, 2)
