"""The simulator shim: scenarios as vehicles that follow their waypoints, and a place for the user's own ego."""

from __future__ import annotations

import sys
from types import ModuleType
from typing import Any

from log2sim.replay.assess.limits import check_limits, check_strict, parse_limits, require_strict
from log2sim.replay.policy import Controls, EgoState, Observation, Others, PathAhead, Policy, Route
from log2sim.replay.policy_name import load_policy
from log2sim.replay.result import AgentReplay, Commands, Replay, to_scenario
from log2sim.replay.rollout import World
from log2sim.replay.run import open_world, replay
from log2sim.replay.simulator import host_named

__all__ = [
    "AgentReplay",
    "Commands",
    "Controls",
    "EgoState",
    "Observation",
    "Others",
    "PathAhead",
    "Policy",
    "Replay",
    "Route",
    "World",
    "check_limits",
    "check_strict",
    "host_named",
    "load_policy",
    "open_world",
    "parse_limits",
    "replay",
    "require_strict",
    "to_scenario",
]


class _CallablePackage(ModuleType):
    """Once this package is imported, Python binds it as `log2sim.replay`, hiding the function of that name: so it is called."""

    def __call__(self, *args: Any, **kwargs: Any) -> Replay:
        return replay(*args, **kwargs)


sys.modules[__name__].__class__ = _CallablePackage
