"""Simulate scenarios: vehicles follow their trajectories, and the user's policy may drive the ego."""

from __future__ import annotations

from log2sim.simulation.expected_motion import WarningSettings
from log2sim.simulation.metrics.all_metrics import check_limits, check_strict, parse_limits, require_strict
from log2sim.simulation.policy import Controls, EgoState, Observation, Others, PathAhead, Policy, Route, load_policy
from log2sim.simulation.result import AgentReplay, Commands, Replay, to_scenario
from log2sim.simulation.runner import World, external_simulator, open_world, replay
from log2sim.simulation.warnings import BrakeWhenWarned, warn

__all__ = [
    "AgentReplay", "BrakeWhenWarned", "Commands", "Controls", "EgoState", "Observation", "Others", "PathAhead",
    "Policy", "Replay", "Route", "WarningSettings", "World", "check_limits", "check_strict", "external_simulator",
    "load_policy", "open_world", "parse_limits", "replay", "require_strict", "to_scenario", "warn",
]  # fmt: skip
