"""When agents are known: what chosen ends have observed of them, as a tracker knows it that looks at nothing later."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import ENDS, Agent, Scenario, Span
from log2sim.geometry import Array
from log2sim.tracking.forward import CONFIRMED_AGE_S, TENTATIVE_HITS

MIN_INTERVAL_S = 0.1
"""Between observations: most LiDARs turn ten times a second. Logs with fewer ticks are observed at these."""

_MARGIN_S = 1e-6


@dataclass(frozen=True, eq=False)
class Known:
    """What is known of A agents at T ticks.

    An agent is known from its third observation on (`TENTATIVE_HITS`), which is when trackers take it for an object, until it
    was not observed for `CONFIRMED_AGE_S`. A static one stays known.

    Attributes
    ----------
    since_s : (A,) float64, s
        When each agent is first known; infinite for those that never are.
    source : (A, T) int
        Tick of the last observation, where an agent is known; else -1.
    observed : (A, T) bool
    count : (A, T) int
        Observations since the agent was found, at least 0.
    piece : (A, T) int
        Rises by one when an agent is found again after it was lost; -1 before the first observation.
    """

    since_s: Array
    source: NDArray[np.intp]
    observed: NDArray[np.bool_]
    count: NDArray[np.intp]
    piece: NDArray[np.intp]


def known_agents(
    agents: Sequence[Agent],
    spans: Sequence[Sequence[Span]],
    t_s: Array,
    interval_s: float,
    present: NDArray[np.bool_],
) -> Known:
    """Find at ticks (T,) what is known of agents (A,), which are present (A, T) and observed every `interval_s` in spans."""
    shape = (len(agents), len(t_s))
    since = np.full(len(agents), np.inf)
    source, piece = np.full(shape, -1, dtype=np.intp), np.full(shape, -1, dtype=np.intp)
    observed, count = np.zeros(shape, dtype=bool), np.zeros(shape, dtype=np.intp)
    ticks = np.arange(len(t_s))
    confirmed_s = (TENTATIVE_HITS - 1) * interval_s
    for k, agent in enumerate(agents):
        kept_s = np.inf if agent.static else max(CONFIRMED_AGE_S, 1.5 * interval_s)
        for number, runs in enumerate(_pieces(spans[k], kept_s)):
            start, end = runs[0][0], runs[-1][1]
            seen = np.zeros(len(t_s), dtype=bool)
            for first, last in runs:
                seen |= (t_s >= first - _MARGIN_S) & (t_s <= last + _MARGIN_S) & present[k]
            observed[k] |= seen
            after = t_s >= start - _MARGIN_S
            piece[k, after] = number
            age = np.where(np.isfinite(start), t_s - start, np.inf)
            count[k, after] = np.minimum(age[after] / interval_s + _MARGIN_S, len(t_s)).astype(np.intp) + 1
            if end - start < confirmed_s - _MARGIN_S:
                continue
            since[k] = min(since[k], max(start + confirmed_s, float(t_s[0])))
            latest = np.maximum.accumulate(np.where(seen, ticks, -1))
            there = (t_s >= start + confirmed_s - _MARGIN_S) & (latest >= 0) & (t_s <= end + kept_s + _MARGIN_S)
            source[k, there] = latest[there]
    return Known(since, source, observed, count, piece)


def _pieces(spans: Sequence[Span], kept_s: float) -> list[list[Span]]:
    """Join spans in order of time whose gaps a tracker bridges."""
    pieces: list[list[Span]] = []
    for span in sorted(spans):
        if pieces and span[0] - max(last for _, last in pieces[-1]) <= kept_s:
            pieces[-1].append(span)
        else:
            pieces.append([span])
    return pieces


def observed_spans(agent: Agent, ends: Sequence[str]) -> tuple[Span, ...]:
    """Return the spans, s, in which chosen ends observe an agent.

    Agents that do not say which end observed them are observed where their waypoints are, or, in truth, where they are visible:
    in scenarios of a single end these are all.
    """
    if agent.observed_by:
        return tuple(sorted(span for end in ends for span in agent.observed_by.get(end, ())))
    if agent.is_permanent:
        return ((-np.inf, np.inf),)
    w = agent.waypoints
    seen = w.observed if w.visible is None else w.observed & w.visible
    edges = np.flatnonzero(np.diff(np.concatenate([[False], seen, [False]]).astype(np.int8)))
    return tuple((float(w.t_s[a]), float(w.t_s[b - 1])) for a, b in zip(edges[::2], edges[1::2]))


def ends_of(scenario: Scenario) -> tuple[str, ...]:
    """Return the ends whose sensors observed any agent; none where the scenario does not say."""
    return tuple(end for end in ENDS if any(a.observed_by.get(end) for a in scenario.agents))


def observation_interval_s(scenario: Scenario) -> float:
    """Return the time between observations in s: the least between waypoints, at least `MIN_INTERVAL_S`."""
    steps = [float(np.diff(a.waypoints.t_s).min()) for a in scenario.agents if len(a.waypoints) > 1]
    return max(min(steps, default=MIN_INTERVAL_S), MIN_INTERVAL_S)
