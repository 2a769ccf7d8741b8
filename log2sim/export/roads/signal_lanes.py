"""Which lanes a traffic light is for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from log2sim.datatypes import MapLane, Signal
from log2sim.geometry import wrap_angle
from log2sim.lanes.graph.polyline import Polyline

FACING_RAD = float(np.deg2rad(40.0))
"""Lamps face the traffic that they are for; posts beside the road turn them by some degrees towards it."""

REACH_M = 40.0
"""A light beyond a junction is at most so far from where its lanes end: across six lanes and two sidewalks."""

ASIDE_M = 12.0
"""It is at most so far beside the middle of a lane: three lanes and a sidewalk."""


def signal_lanes(signal: Signal, lanes: Sequence[MapLane]) -> list[MapLane]:
    """Return the lanes into a junction that lead towards the face of a light; none where its heading is unknown."""
    if signal.heading_rad is None:
        return []
    by_id = {lane.id: lane for lane in lanes}
    found = []
    for lane in lanes:
        inside = [name for name in lane.successors if by_id[name].junction is not None]
        if lane.junction is not None or not inside:
            continue
        heading = float(Polyline(lane.points_m).heading_rad[-1])
        dx, dy = (signal.position_m - lane.points_m[-1])[:2]
        ahead, aside = dx * np.cos(heading) + dy * np.sin(heading), dy * np.cos(heading) - dx * np.sin(heading)
        facing = abs(float(wrap_angle(np.array([signal.heading_rad - heading - np.pi]))[0])) <= FACING_RAD
        if facing and -MARGIN_M <= ahead <= REACH_M and abs(aside) <= ASIDE_M:
            found.append(lane)
    return found


MARGIN_M = 5.0
"""Lights before the junction stand at the stop line, which may be behind where the lane ends."""
