"""Agents of all tracks: static ones get one pose, moving ones a trajectory, and both are matched with the LiDAR points."""

from __future__ import annotations

from collections.abc import Sequence

from log2sim.agents.candidate import AgentCandidate, Timeline
from log2sim.agents.hypotheses import explain_track
from log2sim.agents.moving import moving_candidate
from log2sim.agents.static import static_candidates
from log2sim.datatypes import Obstacles, Track


def estimate_agents(
    tracks: Sequence[Track],
    obstacles: Sequence[Obstacles | None],
    timeline: Timeline,
    *,
    smooth: bool,
) -> list[AgentCandidate]:
    """Make a candidate of every object that the tracks show, moving ones first.

    Parameters
    ----------
    obstacles : T clouds, None at ticks without LiDAR
    smooth : bool
        Whether trajectories are smoothed.
    """
    parts = [part for track in tracks for part in explain_track(track)]
    candidates = [moving_candidate(p.track, obstacles, timeline, smooth=smooth) for p in parts if not p.static]
    return candidates + static_candidates([p for p in parts if p.static], obstacles, timeline)
