"""Agent candidates: agents made of tracks, before they are judged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from log2sim.agents.size import TrackGeometry
from log2sim.datatypes import GROUP_OF, Agent, Finding, Track, Waypoints
from log2sim.geometry import NS_PER_S, Array


def spans_of(mask: NDArray[np.bool_]) -> list[NDArray[np.intp]]:
    """Return the rows of each run of True in a mask (T,), in their order."""
    rows = np.flatnonzero(mask)
    return np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1) if len(rows) else []


# Distance from the rear axle to the box center as a share of the length: BMW 320i of CommonRoad's vehicle models, rounded.
REAR_AXLE_SHARE = {"vehicle": 0.28, "two_wheeler": 0.3}


@dataclass(frozen=True, eq=False)
class Timeline:
    """The ticks of a run."""

    t_ns: NDArray[np.int64]  # (T,)
    t0_ns: int  # start of the scenario

    def seconds(self, t_ns: NDArray[np.int64]) -> Array:
        """Convert stamps to seconds since the start."""
        return np.asarray((t_ns - self.t0_ns) / NS_PER_S, dtype=np.float64)


@dataclass(frozen=True, eq=False)
class AgentCandidate:
    """An agent made of one track, with what it is made of."""

    agent: Agent
    track: Track  # whose measurements, one at each of its ticks, the agent is made of
    geometry: TrackGeometry  # size of the track, and positions at its measurements
    # As many independent ticks as those at which points fit the predicted box at places without a detection, free at other
    # times
    followed: float = 0.0

    def doubted(self, doubts: Sequence[Finding]) -> Self:
        """Return the candidate with more doubts of its agent."""
        return replace(self, agent=replace(self.agent, doubts=(*self.agent.doubts, *doubts))) if doubts else self


def candidate_of(
    track: Track, geometry: TrackGeometry, waypoints: Waypoints, quality: dict[str, Any], *, static: bool
) -> AgentCandidate:
    """Make a candidate of a track, its geometry and waypoints; `quality` is added to that of the track."""
    length, width, height = (float(v) for v in geometry.size_m)
    m = track.measurements
    of_track = {
        "detections": len(m),
        "without_lidar": int((m.source != "lidar").sum()),
        "points_median": float(np.median(m.points)),
        "score_max": round(float(m.score.max()), 4),
    }
    agent = Agent(
        id="",
        category=track.category,
        size_m=(length, width, height),
        waypoints=waypoints,
        static=static,
        rear_axle_offset_m=round(REAR_AXLE_SHARE.get(GROUP_OF[track.category], 0.0) * length, 3),
        quality=of_track | quality,
    )
    return AgentCandidate(agent, track, geometry)


def name_agents(candidates: Sequence[AgentCandidate]) -> list[AgentCandidate]:
    """Sort candidates by their first time and name their agents by category and number, such as "car-1"."""
    ordered = sorted(candidates, key=lambda c: (float(c.agent.waypoints.t_s[0]), float(c.agent.waypoints.x_m[0])))
    count: dict[str, int] = {}
    named = []
    for candidate in ordered:
        category = candidate.agent.category
        count[category] = count.get(category, 0) + 1
        named.append(replace(candidate, agent=replace(candidate.agent, id=f"{category}-{count[category]}")))
    return named
