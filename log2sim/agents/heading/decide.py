"""Which end of each candidate is the front: all evidence of all candidates together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from log2sim.agents.candidate import AgentCandidate, Timeline
from log2sim.agents.heading.box_headings import heading_log_odds
from log2sim.agents.heading.continuation import continued_log_odds
from log2sim.agents.heading.course import course_log_odds
from log2sim.agents.heading.outline import outline_log_odds
from log2sim.agents.heading.rows import find_rows, headings_of
from log2sim.agents.heading.traffic import PARALLEL_SIGMA_RAD, side_log_odds, street_axis, street_log_odds
from log2sim.agents.motion_doubts import motion_doubts
from log2sim.agents.smooth.heading import UNKNOWN_YAW_RAD
from log2sim.datatypes import GROUP_OF, Doubt, Waypoints
from log2sim.geometry import Array, wrap_angle

# Slower vehicles do not show the direction of traffic, nor do those that may drive in reverse.
MIN_FLOW_SPEED_MPS, MIN_FLOW_LOG_ODDS = 1.5, 3.0
# The LiDAR network and the outline see the same points, so that together they know less than the sum.
POINTS_SHARE = 0.7
# A vehicle without a yaw is laid along a street that it rather belongs to than not.
MIN_STREET_SHARE = 0.5
# Less likely headings are doubted: of those that are, at least one in three is wrong.
MIN_HEADING_CONFIDENCE = 0.7


def decide_headings(candidates: Sequence[AgentCandidate], ego_path: Array, timeline: Timeline) -> list[AgentCandidate]:
    """Decide which end of the vehicles and two-wheelers is the front.

    Each keeps its yaw or is turned round as a whole. How likely its heading is goes to its quality as
    `heading_confidence`; an unlikely one is doubted.

    Parameters
    ----------
    candidates : sequence of AgentCandidate
        With a yaw, known up to half a turn, and a speed along it.
    ego_path : (K, 3) float64
        x, y and heading of the ego.
    timeline : Timeline

    Notes
    -----
    What is known of each alone (motion, boxes of a 3D detector, the outline of its points) is combined with the direction
    of traffic beside it and with its neighbors (`rows.headings_of`), for traffic on either side of the road.
    """
    of = [k for k, c in enumerate(candidates) if GROUP_OF[c.agent.category] in ("vehicle", "two_wheeler")]
    if not of:
        return list(candidates)
    road_users = [candidates[k] for k in of]
    alone = np.array([_own_log_odds(c, timeline) for c in road_users])
    own = continued_log_odds([c.agent.waypoints for c in road_users], alone)
    paths = [_path_of(c, odds) for c, odds in zip(road_users, own.tolist())]
    road_users = [_along_street(c, [ego_path, *paths]) for c in road_users]
    poses = np.array([_middle_pose(c.agent.waypoints) for c in road_users])
    street = np.zeros((2, len(of)))
    for k, pose in enumerate(poses):
        others = [ego_path, *paths[:k], *paths[k + 1 :]]
        street[:, k] = [street_log_odds(pose, others, keeps_right=right) for right in (True, False)]
    stands = np.flatnonzero([c.agent.static for c in road_users])
    rows = find_rows(poses, np.array([c.agent.size_m[0] for c in road_users]), stands)
    chance = headings_of(rows, own, street, side_log_odds([ego_path, *paths]))
    decided = list(candidates)
    for k, candidate, along in zip(of, road_users, chance.tolist()):
        decided[k] = _decided(candidate, along)
    return decided


def _own_log_odds(candidate: AgentCandidate, timeline: Timeline) -> float:
    """Return the log-odds that a candidate points along its yaw, by what is known of it alone."""
    agent, m = candidate.agent, candidate.track.measurements
    w, t_s = agent.waypoints, timeline.seconds(m.t_ns)
    odds = heading_log_odds(m, np.interp(t_s, w.t_s, np.unwrap(w.yaw_rad)))
    if GROUP_OF[agent.category] == "vehicle":
        outline = outline_log_odds(candidate.track, w, t_s, agent.size_m)
        odds = POINTS_SHARE * (odds + outline) if odds and outline else odds + outline
    return odds if agent.static else odds + course_log_odds(w, agent.size_m[0])


def _path_of(candidate: AgentCandidate, log_odds: float) -> Array:
    """Return x, y and heading (K, 3) at the waypoints at which a candidate shows the direction of traffic."""
    w = candidate.agent.waypoints
    moving = (np.abs(w.speed_mps) > MIN_FLOW_SPEED_MPS) & candidate.confirmed & (abs(log_odds) > MIN_FLOW_LOG_ODDS)
    yaw = w.yaw_rad[moving] + (0.0 if log_odds > 0 else np.pi)
    return np.stack([w.x_m[moving], w.y_m[moving], yaw], axis=1)


def _along_street(candidate: AgentCandidate, paths: Sequence[Array]) -> AgentCandidate:
    """Lay a candidate that stands and of whose yaw nothing is known along the street."""
    w, known = candidate.agent.waypoints, candidate.geometry.yaw_rad
    if not candidate.agent.static or (known is not None and np.isfinite(known)):
        return candidate
    yaw, belongs = street_axis(np.array([w.x_m[0], w.y_m[0]]), paths)
    if belongs < MIN_STREET_SHARE:
        return candidate
    sigma = np.sqrt(belongs * PARALLEL_SIGMA_RAD**2 + (1 - belongs) * UNKNOWN_YAW_RAD**2)
    n = len(w.t_s)
    w = replace(w, yaw_rad=np.full(n, wrap_angle(yaw)), sigma_yaw_rad=np.full(n, sigma))
    return replace(candidate, agent=replace(candidate.agent, waypoints=w))


def _middle_pose(w: Waypoints) -> Array:
    """Return x, y and yaw (3,) of the waypoint in the middle."""
    k = len(w.t_s) // 2
    return np.array([w.x_m[k], w.y_m[k], w.yaw_rad[k]])


def _decided(candidate: AgentCandidate, along: float) -> AgentCandidate:
    """Turn a candidate to its likelier heading, given the probability of its yaw, and doubt it if that is unlikely too."""
    agent, confidence = candidate.agent, max(along, 1 - along)
    if along < 0.5:
        w = agent.waypoints
        w = replace(w, yaw_rad=wrap_angle(w.yaw_rad + np.pi), speed_mps=0.0 - w.speed_mps)  # never -0.0
        kept = [doubt for doubt in agent.doubts if doubt.flag not in ("speed", "reversing")]
        agent = replace(agent, waypoints=w, doubts=(*kept, *motion_doubts(agent.category, w)))
    agent = replace(agent, quality={**agent.quality, "heading_confidence": round(confidence, 3)})
    doubts = (
        [Doubt("heading_ambiguous", "front and back may be swapped")] if confidence < MIN_HEADING_CONFIDENCE else []
    )
    return replace(candidate, agent=agent).doubted(doubts)
