"""When the sensors of each end measured an agent."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from log2sim.agents.candidate import AgentCandidate, Timeline
from log2sim.datatypes import ENDS, Agent, Span
from log2sim.tracking.forward import MAX_MISSES


def with_observers(candidate: AgentCandidate, agent: Agent, timeline: Timeline) -> Agent:
    """Return an agent with the spans of time in which each end measured the candidate that it was made of."""
    track = candidate.track
    spans = {
        end: spans_of_ticks(track.tick[seen], timeline)
        for end, seen in zip(ENDS, track.measurements.seen_by.T)
        if seen.any()
    }
    return replace(agent, observed_by=spans)


def spans_of_ticks(tick: NDArray[np.int64], timeline: Timeline) -> tuple[Span, ...]:
    """Return the spans, s, of rising ticks (n,); one goes on over as many missing ticks as a track does."""
    t_s = timeline.seconds(timeline.t_ns[tick])
    parts = np.split(t_s, np.flatnonzero(np.diff(tick) > MAX_MISSES + 1) + 1)
    return tuple((float(part[0]), float(part[-1])) for part in parts)
