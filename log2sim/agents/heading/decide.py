"""The headings of all candidates that stand, decided after those that move, since parked vehicles point with the traffic."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from log2sim.agents.candidate import AgentCandidate, confirm
from log2sim.agents.heading.box_headings import heading_log_odds
from log2sim.agents.heading.traffic import Side, parked_heading, side_of_traffic
from log2sim.datatypes import GROUP_OF
from log2sim.geometry import Array

# Slower vehicles do not show the direction of traffic.
MIN_FLOW_SPEED_MPS = 1.5


def decide_headings(candidates: Sequence[AgentCandidate], ego_path: Array) -> list[AgentCandidate]:
    """Decide which end of the candidates that stand is the front.

    Parameters
    ----------
    candidates : sequence of AgentCandidate
        Those that stand with one yaw, known up to half a turn.
    ego_path : (K, 3) float64
        x, y and heading of the ego.
    """
    traffic = [c for c in confirm(candidates) if GROUP_OF[c.agent.category] == "vehicle" and not c.agent.static]
    paths = [ego_path, *(_path_of(c) for c in traffic)]
    flow, side = np.concatenate(paths), side_of_traffic(paths)
    return [_decided(c, flow, side) if c.agent.static else c for c in candidates]


def _path_of(candidate: AgentCandidate) -> Array:
    """Return x, y and heading (K, 3) at the waypoints at which a candidate moves."""
    w = candidate.agent.waypoints
    moving = np.abs(w.speed_mps) > MIN_FLOW_SPEED_MPS
    return np.stack([w.x_m[moving], w.y_m[moving], w.yaw_rad[moving]], axis=1)


def _decided(candidate: AgentCandidate, flow: Array, side: Side) -> AgentCandidate:
    """Turn a candidate that stands to where the traffic (K, 3) and its boxes say that it points."""
    agent, w = candidate.agent, candidate.agent.waypoints
    flow = flow if GROUP_OF[agent.category] in ("vehicle", "two_wheeler") else np.zeros((0, 3))
    xy, yaw = np.array([w.x_m[0], w.y_m[0]]), float(w.yaw_rad[0])
    odds = heading_log_odds(candidate.track.measurements, yaw)
    yaw = parked_heading(yaw, xy, flow, side=side, log_odds=odds)
    return replace(candidate, agent=replace(agent, waypoints=replace(w, yaw_rad=np.full(len(w.t_s), yaw))))
