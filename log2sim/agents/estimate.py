"""Agents of all tracks: static ones get one pose, moving ones a trajectory, and both are matched with the LiDAR points."""

from __future__ import annotations

from collections.abc import Sequence

from log2sim.agents.candidate import AgentCandidate, Timeline
from log2sim.agents.moving import moving_candidate
from log2sim.agents.standing import is_static
from log2sim.agents.static import static_candidate
from log2sim.datatypes import Obstacles, Track


def estimate_agents(
    tracks: Sequence[Track],
    obstacles: Sequence[Obstacles | None],
    timeline: Timeline,
    *,
    smooth: bool,
) -> list[AgentCandidate]:
    """Make a candidate of every track, moving ones first.

    Parameters
    ----------
    obstacles : T clouds, None at ticks without LiDAR
    smooth : bool
        Whether trajectories are smoothed.
    """
    static = [is_static(track) for track in tracks]
    candidates = [moving_candidate(t, obstacles, timeline, smooth=smooth) for t, s in zip(tracks, static) if not s]
    return candidates + [static_candidate(t, obstacles, timeline) for t, s in zip(tracks, static) if s]
