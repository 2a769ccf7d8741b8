"""A policy that sees others late and not quite where they are, as sensors and their processing show them."""

from __future__ import annotations

import zlib
from collections import deque
from dataclasses import dataclass, fields, replace
from functools import cache

import numpy as np

from log2sim.datatypes import Scenario
from log2sim.errors import ConfigError
from log2sim.simulation.policy import Controls, Observation, Others, Policy, load_policy, query_policy, reset_policy

CORRELATION_S = 0.5  # for how long an error of a place lasts: trackers average over some sweeps


@dataclass(frozen=True)
class Sensing:
    """What lies between others and a policy."""

    # s: of each observation, normal and never negative; what comes late is passed over where a newer one is there
    # already; likewise `latency_sigma_s`.
    latency_s: float = 0.0
    latency_sigma_s: float = 0.0
    noise_m: float = 0.0  # m: standard deviation of the places of others on both axes, correlated over `CORRELATION_S`

    def __bool__(self) -> bool:
        """Whether anything is late or off."""
        return any(getattr(self, f.name) > 0 for f in fields(self))


@dataclass(frozen=True)
class NamedPolicy:
    """A policy that every process loads by its name when it first drives there, so that it can be sent to any worker."""

    name: str  # as `load_policy` takes it
    sensing: Sensing

    def reset(self, scenario: Scenario) -> None:
        """Prepare for a replay."""
        reset_policy(_loaded(self), scenario)

    def __call__(self, observation: Observation) -> Controls:
        """Return the controls of the policy."""
        return query_policy(_loaded(self), observation)


@cache
def _loaded(named: NamedPolicy) -> Policy:
    policy = load_policy(named.name)
    return DelayedPolicy(policy, named.sensing) if named.sensing else policy


def parse_sensing(latency: str, noise_m: float) -> Sensing:
    """Return sensors of a latency such as "0.2", or "0.2:0.05" with its standard deviation; raise `ConfigError` for others."""
    try:
        values = [float(part) for part in latency.split(":")]
    except ValueError:
        values = []
    if not 1 <= len(values) <= 2 or not all(0 <= v <= 10 for v in values):
        raise ConfigError(f"--latency {latency}: expected MEAN or MEAN:SIGMA in s, each from 0 to 10, such as 0.2:0.05")
    return Sensing(values[0], values[1] if len(values) > 1 else 0.0, noise_m)


class DelayedPolicy:
    """A policy behind sensors; the same scenario has the same errors.

    What the policy knows of the ego, its route and its path is exact and current. `observation.sweep` is not delayed.
    """

    def __init__(self, policy: Policy, sensing: Sensing) -> None:
        self.policy, self.sensing = policy, sensing
        self._begin(0)

    def reset(self, scenario: Scenario) -> None:
        """Prepare for a replay."""
        seed = 0
        for agent in scenario.agents:
            seed = zlib.crc32(agent.waypoints.x_m.tobytes(), zlib.crc32(agent.waypoints.t_s.tobytes(), seed))
        self._begin(seed)
        reset_policy(self.policy, scenario)

    def _begin(self, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        self._coming: deque[tuple[float, float, Others]] = deque()
        self._errors: dict[str, complex] = {}
        self._seen: Others | None = None
        self._since_s = -np.inf

    def __call__(self, observation: Observation) -> Controls:
        """Return the controls of the policy by what has arrived."""
        s, now_s = self.sensing, observation.t_s
        late_s = max(s.latency_s + s.latency_sigma_s * float(self._rng.standard_normal()), 0.0)
        self._coming.append((now_s + late_s, now_s, self._measured(observation)))
        arrived = [c for c in self._coming if c[0] <= now_s + 1e-9]
        self._coming = deque(c for c in self._coming if c[0] > now_s + 1e-9)
        for _, stamp_s, others in arrived:
            if stamp_s > self._since_s:
                self._since_s, self._seen = stamp_s, others
        nothing = Others(*(getattr(observation.others, f.name)[:0] for f in fields(Others)))
        return query_policy(self.policy, replace(observation, others=nothing if self._seen is None else self._seen))

    def _measured(self, observation: Observation) -> Others:
        """Return others with errors of their places."""
        others = observation.others
        if not (self.sensing.noise_m and len(others)):
            return others
        kept = float(np.exp(-observation.dt_s / CORRELATION_S))
        for id in others.id.tolist():
            drawn = complex(*self._rng.standard_normal(2)) * self.sensing.noise_m
            self._errors[id] = self._errors[id] * kept + drawn * np.sqrt(1 - kept**2) if id in self._errors else drawn
        error = np.array([self._errors[id] for id in others.id.tolist()])
        return replace(others, x_m=others.x_m + error.real, y_m=others.y_m + error.imag)
