"""Applies edits to a scenario, checks the result and records the edits in its provenance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from log2sim.datatypes import Scenario
from log2sim.edit.checks import warnings_of
from log2sim.edit.edits import Add, Agents, Edit, Only, Remove
from log2sim.errors import CheckFailed, ConfigError, ScenarioError
from log2sim.registry import nearest


@dataclass(frozen=True, eq=False)
class Edited:
    """The edited scenario, and problems that its source does not have.

    Attributes
    ----------
    scenario : Scenario
    warnings : tuple of str
        New collisions and infeasible motion.
    """

    scenario: Scenario
    warnings: tuple[str, ...]

    def require_clean(self) -> None:
        """Raise `CheckFailed` with all warnings, if there are any."""
        if self.warnings:
            raise CheckFailed("the edits break limits:\n  " + "\n  ".join(self.warnings))


def edit(scenario: Scenario, edits: Sequence[Edit]) -> Edited:
    """Apply edits in the order given.

    Parameters
    ----------
    scenario : Scenario
    edits : sequence of Only, Remove, DropDoubtful, Replace, Add, Speed, Lateral, CutIn, Shift
        Each kind of motion at most once for an agent.

    Returns
    -------
    Edited
        The scenario, longer where an agent now lives beyond its end, with the edits and the digest of the source appended to
        `provenance["edits"]`; and warnings of new collisions and infeasible motion.

    Raises
    ------
    ConfigError
        For no edits, an unknown or removed agent, the same edit twice, no agent left, or an impossible edit: the speed of a
        static agent, a path shifted beyond its center of curvature, a trajectory without waypoints left.
    """
    if not edits:
        raise ConfigError("no edits; say what to change, such as a shift of one agent")
    _check_names(scenario, edits)
    agents: Agents = {a.id: a for a in scenario.agents}
    for step in edits:
        gone = next((name for name in step.names if name not in agents), None)
        if gone is not None:
            raise ConfigError(f"{step.kind}: agent '{gone}' is left out by another edit; drop one of the two")
        agents = step.applied(agents)
        if not agents:
            raise ConfigError(f"{step.kind}: leaves out every agent of '{scenario.name}'; keep at least one")
    end_s = max(float(a.waypoints.t_s[-1]) for a in agents.values())
    edited = replace(
        scenario,
        agents=tuple(agents.values()),
        duration_s=max(scenario.duration_s, end_s),
        provenance={**scenario.provenance, "edits": _history(scenario, edits)},
    )
    return Edited(edited, warnings_of(scenario, edited))


def _check_names(scenario: Scenario, edits: Sequence[Edit]) -> None:
    """Refuse unknown agents, and a second value for the same edit."""
    known, seen = [a.id for a in scenario.agents], set()
    for step in edits:
        for name in step.names:
            if name not in known:
                raise ConfigError(f"{step.kind}: no agent '{name}'{nearest(name, known)}; known: {_some(known)}")
            if (step.kind, name) in seen and not isinstance(step, Only | Remove | Add):
                raise ConfigError(f"{step.kind}: agent '{name}' is named twice; give one value")
            seen.add((step.kind, name))


def _some(ids: Sequence[str], most: int = 12) -> str:
    rest = len(ids) - most
    return ", ".join(ids[:most]) + (f" and {rest} more" if rest > 0 else "")


def _history(scenario: Scenario, edits: Sequence[Edit]) -> list[Any]:
    """Append these edits to the earlier ones, one entry a run."""
    earlier = scenario.provenance.get("edits", [])
    if not isinstance(earlier, list):
        raise ScenarioError(f"provenance.edits is {type(earlier).__name__}, expected the list of earlier edits")
    return [*earlier, {"source_digest": scenario.digest, "edits": [e.to_dict() for e in edits]}]
