"""The probability that an agent is right, by the evidence for it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace

import numpy as np

from log2sim.agents.candidate import AgentCandidate, Timeline
from log2sim.agents.confidence.evidence import Evidence, evidence_of
from log2sim.agents.confidence.systematic import with_systematic_errors
from log2sim.agents.confidence.weights import WITH_LIDAR, WITHOUT_LIDAR
from log2sim.log_odds import probability_of

# Never 0 or 1: an agent may be right or wrong for a reason that no evidence shows.
MIN_CONFIDENCE, MAX_CONFIDENCE = 0.01, 0.99


def rate_agents(candidates: Sequence[AgentCandidate], timeline: Timeline, *, lidar: bool) -> list[AgentCandidate]:
    """Give judged candidates the probability that they are right as confidence, and systematic errors in their sigmas.

    `lidar` states whether a LiDAR was there to observe them.
    """
    return [_rated(candidate, timeline, lidar=lidar) for candidate in candidates]


def confidence_of(evidence: Evidence, *, lidar: bool) -> float:
    """Return the probability that an agent with this evidence is right.

    Notes
    -----
    Where there is a LiDAR, an agent without points is rather wrong; without one, nothing has points, and what the images
    say of the distance counts instead. Each case has weights of its own.

    Right is what `evaluate` finds right: at no more than a fifth of its ticks invented, a duplicate, in the ego, or with a
    wrong speed, motion, direction or size. Logistic regression; each weight has the sign of its reason
    (`evidence.SIGNS`).
    """
    values = {"bias": 1.0, **asdict(evidence)}
    log_odds = sum(weight * values[name] for name, weight in (WITH_LIDAR if lidar else WITHOUT_LIDAR).items())
    return float(np.clip(probability_of(log_odds), MIN_CONFIDENCE, MAX_CONFIDENCE))


def _rated(candidate: AgentCandidate, timeline: Timeline, *, lidar: bool) -> AgentCandidate:
    evidence = evidence_of(candidate, timeline)
    confidence = confidence_of(evidence, lidar=lidar)
    waypoints = with_systematic_errors(candidate, evidence, confidence, timeline)
    return replace(candidate, agent=replace(candidate.agent, confidence=confidence, waypoints=waypoints))
