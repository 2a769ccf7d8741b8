"""Static agents: one pose for all ticks of a track that does not move."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from log2sim.agents.candidate import AgentCandidate, Timeline, candidate_of
from log2sim.agents.lidar_tracking import BoxState, track_with_lidar
from log2sim.agents.size import static_geometry
from log2sim.datatypes import Obstacles, Track, Waypoints


def static_candidate(track: Track, obstacles: Sequence[Obstacles | None], timeline: Timeline) -> AgentCandidate:
    """Make an agent with one pose, at the ticks of its track and wherever LiDAR points match its box.

    Its yaw is known up to half a turn.
    """
    geometry = static_geometry(track)
    xy, z = geometry.xy_m[0], float(np.median(geometry.z_m))
    yaw = 0.0 if geometry.yaw_rad is None else float(np.nan_to_num(geometry.yaw_rad))
    start_ns = int(timeline.t_ns[track.tick[0]])
    box = BoxState(start_ns, xy, np.zeros(2), yaw, geometry.size_m, z - geometry.size_m[2] / 2)
    others = np.setdiff1d(np.arange(len(timeline.t_ns)), track.tick).tolist()
    matches = track_with_lidar(obstacles, others, timeline.t_ns, box)
    observed = np.union1d(track.tick, np.array([m.tick for m in matches], dtype=np.int64))
    life = np.unique(observed[[0, -1]])
    n = len(life)
    sigma = float(np.sqrt(np.trace(np.median(geometry.covariance, axis=0)) / 2))
    waypoints = Waypoints(
        t_s=timeline.seconds(timeline.t_ns[life]),
        x_m=np.full(n, xy[0]),
        y_m=np.full(n, xy[1]),
        z_m=np.full(n, z),
        yaw_rad=np.full(n, yaw),
        speed_mps=np.zeros(n),
        observed=np.ones(n, dtype=bool),
        sigma_xy_m=np.full(n, sigma),
    )
    share = len(observed) / (observed[-1] - observed[0] + 1)
    quality = {"lidar_only": len(matches), "observed_share": round(float(share), 3)}
    return candidate_of(track, geometry, waypoints, quality, static=True)
