"""Agent candidates: an agent made of a track, with the evidence for it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from log2sim.agents.confirmation import agent_confidence, is_confirmed
from log2sim.agents.size import TrackGeometry
from log2sim.agents.support import Support
from log2sim.datatypes import GROUP_OF, Agent, Doubt, Track, Waypoints
from log2sim.geometry import NS_PER_S, Array

# Distance from the rear axle to the box center as a share of the length: BMW 320i of CommonRoad's vehicle models, rounded.
REAR_AXLE_SHARE = {"vehicle": 0.28, "two_wheeler": 0.3}


@dataclass(frozen=True, eq=False)
class Timeline:
    """The ticks of a run.

    Attributes
    ----------
    t_ns : (T,) int64
    t0_ns : int
        Start of the scenario.
    """

    t_ns: NDArray[np.int64]
    t0_ns: int

    def seconds(self, t_ns: NDArray[np.int64]) -> Array:
        """Convert stamps to seconds since the start."""
        return np.asarray((t_ns - self.t0_ns) / NS_PER_S, dtype=np.float64)


@dataclass(frozen=True, eq=False)
class AgentCandidate:
    """An agent made of one track, with what it is made of.

    Attributes
    ----------
    agent : Agent
    evidence : float
        Sum of the scores of its detections; in nats, with all other evidence, once it is weighed.
    confirmed : bool
        Whether the confidence of the track suffices.
    track : Track
        Whose measurements, one at each of its ticks, the agent is made of.
    geometry : TrackGeometry
        Size of the track, and positions at its measurements.
    support : Support, optional
        What the points of the LiDAR say about it, once it is weighed.
    """

    agent: Agent
    evidence: float
    confirmed: bool
    track: Track
    geometry: TrackGeometry
    support: Support | None = None

    def doubted(self, doubts: Sequence[Doubt]) -> Self:
        """Return the candidate with more doubts of its agent."""
        return replace(self, agent=replace(self.agent, doubts=(*self.agent.doubts, *doubts))) if doubts else self


def candidate_of(
    track: Track,
    geometry: TrackGeometry,
    waypoints: Waypoints,
    quality: dict[str, Any],
    *,
    static: bool,
    followed: float = 0.0,
) -> AgentCandidate:
    """Make a candidate of a track, its geometry, waypoints and `followed_confidence`; `quality` is added to that of the track."""
    m = track.measurements
    length, width, height = (float(v) for v in geometry.size_m)
    agent = Agent(
        id="",
        category=track.category,
        size_m=(length, width, height),
        waypoints=waypoints,
        static=static,
        rear_axle_offset_m=round(REAR_AXLE_SHARE.get(GROUP_OF[track.category], 0.0) * length, 3),
        confidence=float(np.clip(agent_confidence(track, followed), 0.0, 1.0)),
        quality=_quality_of(track) | quality,
    )
    return AgentCandidate(
        agent, float(m.score.sum()), is_confirmed(track, typical=geometry.is_likely, followed=followed), track, geometry
    )


def confirm(candidates: Sequence[AgentCandidate]) -> list[AgentCandidate]:
    """Keep the confirmed candidates."""
    return [c for c in candidates if c.confirmed]


def _quality_of(track: Track) -> dict[str, Any]:
    m = track.measurements
    return {
        "detections": len(m),
        "without_lidar": int((m.source != "lidar").sum()),
        "points_median": float(np.median(m.points)),
        "score_max": round(float(m.score.max()), 4),
    }
