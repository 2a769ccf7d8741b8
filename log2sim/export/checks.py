"""What players of scenario formats rely on and their own checkers miss, looked at before anything is written."""

from __future__ import annotations

import numpy as np

from log2sim.errors import ScenarioError
from log2sim.scenario import Agent, Scenario


def require_exportable(scenario: Scenario) -> None:
    """Raise `ScenarioError` with all that is wrong with a scenario, naming the agents."""
    wrong = [problem for agent in scenario.agents for problem in _problems(agent)]
    if not scenario.agents:
        wrong = ["it has no agents"]
    if wrong:
        raise ScenarioError(f"scenario '{scenario.name}' cannot be exported:\n  " + "\n  ".join(wrong))


def _problems(agent: Agent) -> list[str]:
    where, w = f"agent '{agent.id}'", agent.waypoints
    if len(w) == 0:
        return [f"{where}: has no waypoints, expected at least one"]
    wrong = []
    if np.any(np.diff(w.t_s) <= 0):
        k = int(np.argmax(np.diff(w.t_s) <= 0)) + 1
        wrong.append(f"{where}: waypoints.t_s does not increase at index {k} ({w.t_s[k]:g} s)")
    if not all(np.isfinite(getattr(w, key)).all() for key in w.FLOATS):
        wrong.append(f"{where}: a waypoint is not finite")
    if not min(agent.size_m) > 0:
        wrong.append(f"{where}: size {agent.size_m} m, expected positive lengths")
    return wrong
