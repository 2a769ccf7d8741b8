"""Evidence for a candidate over the whole log: detections, rays, and whether anything moves like it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from log2sim.agents.candidate import AgentCandidate, Timeline
from log2sim.agents.plausibility.free_space import SOLID, WHOLE, RayCounts, count_rays
from log2sim.agents.plausibility.structure import structure_shares
from log2sim.agents.support import Support
from log2sim.datatypes import Obstacles
from log2sim.geometry import Array

# A detection is never surer than this: 3 nats.
MAX_SCORE = 0.95
# A tick has at least so many rays that met the place of the agent, and no more that ended before it: with fewer only the
# border of what hides it shows.
MIN_RAYS = 8
# At a tick most rays go through: nothing is there.
EMPTY_SHARE = 0.5
# Nats of the rays of a tick: all of them end in what is there; more are not believed, since rays of one tick err alike.
RAY_NATS = 2.0
# Nats of a tick of a motion that no road user has.
MOTION_NATS = 1.0
# Rays toward a hidden place before it is said to be hidden.
MIN_HIDDEN_RAYS = 30
# Farther apart, a camera sees what is hidden from a LiDAR.
SAME_VIEW_M = 3.0


def weigh(
    candidates: Sequence[AgentCandidate], clouds: Sequence[Obstacles | None], timeline: Timeline
) -> list[AgentCandidate]:
    """Return the candidates with what the LiDAR says about them, and with all evidence for them.

    Notes
    -----
    Evidence is a sum over ticks of nats for the agent against nothing: of each detection by its score, of the rays by the
    share that goes through, and less for a motion that breaks the limits of road users.
    """
    agents = [c.agent for c in candidates]
    rays = count_rays(agents, clouds, timeline, SOLID)
    structure = structure_shares(agents, clouds, timeline)
    hidden = _hidden(candidates, clouds, timeline)
    return [
        replace(
            candidate,
            support=_support(rays, k, float(structure[k]), bool(hidden[k])),
            evidence=_nats(candidate, rays.inside[k], rays.through[k]),
        )
        for k, candidate in enumerate(candidates)
    ]


def _support(rays: RayCounts, k: int, in_structure: float, hidden: bool) -> Support:
    """Sum the rays of one agent over its ticks; those at which it is mostly hidden say nothing."""
    met = rays.inside[k] + rays.through[k]
    seen = met >= rays.before[k]
    decided = seen & (met >= MIN_RAYS)
    return Support(
        inside=int(rays.inside[k, seen].sum()),
        through=int(rays.through[k, seen].sum()),
        before=int(rays.before[k].sum()),
        decided_ticks=int(decided.sum()),
        empty_ticks=int((decided & (rays.through[k] > EMPTY_SHARE * met)).sum()),
        in_structure=in_structure,
        hidden=hidden,
    )


def _hidden(
    candidates: Sequence[AgentCandidate], clouds: Sequence[Obstacles | None], timeline: Timeline
) -> NDArray[np.bool_]:
    """Mark (A,) the candidates without LiDAR points toward which no ray ever gets, though cameras see from the same place."""
    hidden = np.zeros(len(candidates), dtype=bool)
    cloud = next((c for c in clouds if c is not None), None)
    rows = [k for k, c in enumerate(candidates) if not (c.track.measurements.points > 0).any()]
    if cloud is None or not rows:
        return hidden
    rays = count_rays([candidates[k].agent for k in rows], clouds, timeline, WHOLE)
    met, before = (rays.inside + rays.through).sum(axis=1), rays.before.sum(axis=1)
    hidden[rows] = (met == 0) & (before >= MIN_HIDDEN_RAYS) & [_same_view(candidates[k], clouds) for k in rows]
    return hidden


def _same_view(candidate: AgentCandidate, clouds: Sequence[Obstacles | None]) -> bool:
    """Return whether the cameras that detect a candidate are where the LiDARs are."""
    track = candidate.track
    for tick, sensor in zip(track.tick.tolist(), track.measurements.sensor_m):
        cloud = clouds[tick]
        if cloud is not None:
            return bool(np.linalg.norm(sensor - cloud.origin - cloud.sensor) <= SAME_VIEW_M)
    return False


def _nats(candidate: AgentCandidate, inside: NDArray[np.int64], through: NDArray[np.int64]) -> float:
    """Sum the evidence for one candidate, given its rays (T,)."""
    detections = -np.log1p(-MAX_SCORE * candidate.track.measurements.score).sum()
    met = inside + through
    decided = met >= MIN_RAYS
    rays: Array = RAY_NATS * (1 - 2 * through[decided] / met[decided])
    impossible = MOTION_NATS * len(candidate.agent.waypoints) if candidate.agent.doubts else 0.0
    return float(detections + rays.sum() - impossible)
