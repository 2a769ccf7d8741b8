"""The probability that an agent is right, by the evidence for it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace

import numpy as np

from log2sim.agents.candidate import AgentCandidate, Timeline
from log2sim.agents.confidence.evidence import Evidence, evidence_of
from log2sim.agents.confidence.systematic import with_systematic_errors
from log2sim.agents.confidence.weights import BIAS, WEIGHTS
from log2sim.log_odds import probability_of

# Never 0 or 1: an agent may be right or wrong for a reason that no evidence shows.
MIN_CONFIDENCE, MAX_CONFIDENCE = 0.01, 0.99


def rate_agents(candidates: Sequence[AgentCandidate], timeline: Timeline) -> list[AgentCandidate]:
    """Give judged candidates the probability that they are right as confidence, and systematic errors in their sigmas."""
    return [_rated(candidate, timeline) for candidate in candidates]


def confidence_of(evidence: Evidence) -> float:
    """Return the probability that an agent with this evidence is right.

    Notes
    -----
    Right is what `evaluate` finds right: at no more than a fifth of its ticks invented, a duplicate, in the ego, or with a
    wrong speed, motion, direction or size. Logistic regression; each weight has the sign of its reason
    (`evidence.SIGNS`).
    """
    log_odds = BIAS + sum(WEIGHTS[name] * value for name, value in asdict(evidence).items())
    return float(np.clip(probability_of(log_odds), MIN_CONFIDENCE, MAX_CONFIDENCE))


def _rated(candidate: AgentCandidate, timeline: Timeline) -> AgentCandidate:
    evidence = evidence_of(candidate, timeline)
    confidence = confidence_of(evidence)
    waypoints = with_systematic_errors(candidate, evidence, confidence, timeline)
    return replace(candidate, agent=replace(candidate.agent, confidence=confidence, waypoints=waypoints))
