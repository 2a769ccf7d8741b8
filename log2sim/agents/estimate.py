"""Agents of all tracks: static ones get one pose, moving ones a trajectory, and both are matched with the LiDAR points."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from log2sim.agents.candidate import AgentCandidate, Timeline, confirm
from log2sim.agents.moving import moving_candidate
from log2sim.agents.standing import is_static, side_of_traffic
from log2sim.agents.static import static_candidate
from log2sim.datatypes import GROUP_OF, Obstacles, Track
from log2sim.geometry import Array

# Slower vehicles do not show the direction of traffic.
MIN_FLOW_SPEED_MPS = 1.5


def estimate_agents(
    tracks: Sequence[Track],
    obstacles: Sequence[Obstacles | None],
    timeline: Timeline,
    ego_path: Array,
    *,
    smooth: bool,
) -> list[AgentCandidate]:
    """Make a candidate of every track, moving ones first, since parked vehicles point with the moving traffic.

    Parameters
    ----------
    obstacles : T clouds, None at ticks without LiDAR
    ego_path : (K, 3) float64
        x, y and heading of the ego.
    smooth : bool
        Whether trajectories are smoothed.
    """
    static = [is_static(track) for track in tracks]
    candidates = [moving_candidate(t, obstacles, timeline, smooth=smooth) for t, s in zip(tracks, static) if not s]
    traffic = [c for c in confirm(candidates) if GROUP_OF[c.agent.category] == "vehicle"]
    paths = [ego_path, *(_path_of(c) for c in traffic)]
    flow, side = np.concatenate(paths), side_of_traffic(paths)
    return candidates + [static_candidate(t, obstacles, timeline, flow, side) for t, s in zip(tracks, static) if s]


def _path_of(candidate: AgentCandidate) -> Array:
    """Return x, y and heading (K, 3) at the waypoints at which a candidate moves."""
    w = candidate.agent.waypoints
    moving = np.abs(w.speed_mps) > MIN_FLOW_SPEED_MPS
    return np.stack([w.x_m[moving], w.y_m[moving], w.yaw_rad[moving]], axis=1)
