"""Map features and traffic lights as the columns of a page."""

from __future__ import annotations

from typing import Any

import numpy as np

from log2sim.datatypes import MIN_TRUSTED_CONFIDENCE, MapFeatures, Scenario
from log2sim.geometry import Array
from log2sim.visualization.page.columns import SCALES, second_differences
from log2sim.visualization.plot.road_features import lane_arrows, lane_outline

TOLERANCE_M = 0.02
"""Points of a line that lie so near to the line through the others are left out; a browser shows no less than 2.5 mm."""


def feature_columns(scenario: Scenario) -> dict[str, Any]:
    """Return faces and arrows of lanes, lines and areas of markings, borders, and traffic lights; empty where there are none."""
    features = scenario.map_features or MapFeatures()
    return {
        "lanes": [
            {"outline": _columns(lane_outline(lane)), "arrows": [_columns(a) for a in lane_arrows(lane)]}
            for lane in features.lanes
        ],
        "borders": [_columns(border.points_m) for border in features.borders],
        "markings": [
            {
                **_columns(marking.points_m),
                "kind": marking.kind,
                "yellow": marking.color == "yellow",
                "width_m": round(marking.width_m, 3),
                "doubtful": marking.confidence < MIN_TRUSTED_CONFIDENCE,
            }
            for marking in features.markings
        ],
        "signals": [
            {
                "id": signal.id,
                "at_m": [round(float(v), 2) for v in signal.position_m[:2]],
                "t_s": [round(float(t), 3) for t in signal.t_s],
                "state": [str(state) for state in signal.state],
            }
            for signal in scenario.signals
        ],
        "notes": list(features.notes),
    }


def _columns(points_m: Array) -> dict[str, list[int]]:
    """Return x and y of points (N, 2 or more) without those that lie on the line through the others."""
    from skimage.measure import approximate_polygon

    kept = approximate_polygon(np.asarray(points_m)[:, :2], TOLERANCE_M)
    return {key: second_differences(column, SCALES[key]) for key, column in zip(("x_m", "y_m"), kept.T)}
