"""Where an export puts its origin, so that players that count in float32 keep every agent within half a millimeter."""

from __future__ import annotations

import numpy as np

from log2sim.scenario import Scenario

# float32 steps by 1 mm from 8192 m on.
NEAR_M = 8192.0
STEP_M = 1000.0


def origin_m(scenario: Scenario) -> tuple[float, float]:
    """Whole kilometers x, y to subtract from all positions: zero while all are near the map's origin."""
    xy = np.concatenate([np.column_stack([a.waypoints.x_m, a.waypoints.y_m]) for a in scenario.agents])
    if np.abs(xy).max() <= NEAR_M:
        return 0.0, 0.0
    middle = (xy.min(axis=0) + xy.max(axis=0)) / 2
    x, y = np.round(middle / STEP_M) * STEP_M
    return float(x), float(y)
