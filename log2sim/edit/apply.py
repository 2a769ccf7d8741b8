"""Applies edits to a scenario, checks what came of them, and records them in its provenance."""

from __future__ import annotations

from collections.abc import Iterator, Sequence, Set
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from log2sim.datatypes import GROUP_OF, Agent, Scenario
from log2sim.datatypes.categories import MAX_ACCELERATION_MPS2, MAX_CURVATURE_1PM
from log2sim.edit.edits import MIN_PATH_MPS, Add, Agents, Edit, Only, Remove, chords
from log2sim.errors import CheckFailed, ConfigError, ScenarioError
from log2sim.files.plugins import nearest
from log2sim.simulation.metrics.all_metrics import OFF_PATH_M
from log2sim.simulation.metrics.collisions import SAME_CONTACT_S
from log2sim.simulation.reference import MAX_TWO_WHEELER_CURVATURE_1PM
from log2sim.simulation.runner import replay

# The limits that a replay flags; pedestrians turn on the spot.
CURVATURE_LIMITS_1PM = {"vehicle": MAX_CURVATURE_1PM, "two_wheeler": MAX_TWO_WHEELER_CURVATURE_1PM}
STEP_S = 0.05
RELATIVE_TOLERANCE = 1 + 1e-6
MAX_LISTED = 12  # ids in a message


def _collisions(before: Scenario, after: Scenario, changed: Set[str]) -> Iterator[str]:
    """Yield overlaps of boxes where the source has none of the same two agents within `SAME_CONTACT_S`."""
    if not changed:
        return
    known: dict[frozenset[str], list[tuple[float, float]]] = {}
    for event in _overlaps(before, changed):
        known.setdefault(frozenset(event["agents"]), []).append((event["t_s"], event["until_s"]))
    for event in _overlaps(after, changed):
        begin_s, until_s = event["t_s"], event["until_s"]
        spans = known.get(frozenset(event["agents"]), [])
        if not any(b - SAME_CONTACT_S <= until_s and begin_s <= u + SAME_CONTACT_S for b, u in spans):
            yield (
                f"agents '{event['agents'][0]}' and '{event['agents'][1]}' collide at {begin_s:.2f} s "
                f"at {event['relative_speed_mps']:.1f} m/s, which the source does not have"
            )


def _overlaps(scenario: Scenario, changed: Set[str]) -> Sequence[dict[str, Any]]:
    """Return the collisions of an exact replay: pairs of boxes of which one moves or was moved."""
    agents = (replace(a, static=a.static and not (a.id in changed and len(a.waypoints) > 1)) for a in scenario.agents)
    replayed = replay(replace(scenario, agents=tuple(agents)), mode="exact", dt_s=STEP_S)
    collisions: Sequence[dict[str, Any]] = replayed.metrics["collisions"]
    return collisions


def _peaks(agent: Agent) -> dict[str, tuple[float, float]]:
    """Return the largest acceleration, m/s2, longitudinal and lateral combined, and curvature, 1/m, between two waypoints, with their times.

    The curvature is 0 where the agent stands.
    """
    w = agent.waypoints
    if len(w) < 2:
        return dict.fromkeys(("acceleration", "curvature"), (0.0, float(w.t_s[0])))
    span, speed, (chord, turn) = np.diff(w.t_s), (w.speed_mps[1:] + w.speed_mps[:-1]) / 2, chords(w)
    moves = np.abs(chord) > MIN_PATH_MPS * span
    columns = {
        "acceleration": np.hypot(np.diff(w.speed_mps), speed * turn) / span,
        "curvature": np.divide(np.abs(turn), np.abs(chord), out=np.zeros(len(turn)), where=moves),
    }
    # The first of those that are equal up to rounding.
    at = {what: int(np.argmax(values >= values.max() / RELATIVE_TOLERANCE)) for what, values in columns.items()}
    return {what: (float(columns[what][k]), float(w.t_s[k] + w.t_s[k + 1]) / 2) for what, k in at.items()}


@dataclass(frozen=True, eq=False)
class Edited:
    """The edited scenario, and problems that its source does not have."""

    scenario: Scenario
    warnings: tuple[str, ...]  # new collisions and infeasible motion

    def require_clean(self) -> None:
        """Raise `CheckFailed` with all warnings, if there are any."""
        if self.warnings:
            raise CheckFailed("the edits break limits:\n  " + "\n  ".join(self.warnings))


def edit(scenario: Scenario, edits: Sequence[Edit]) -> Edited:
    """Apply edits in the order given.

    Raises `ConfigError` for no edits, an unknown or removed agent, the same edit twice, no agent left, or an impossible
    edit: the speed of a static agent, a path shifted beyond its center of curvature, a trajectory without waypoints.

    `edits`: each kind of motion at most once for an agent. Returns the scenario, longer where an agent now lives beyond its end, with
    the edits and the digest of the source appended to `provenance["edits"]`; and warnings of new collisions and infeasible motion.
    """
    if not edits:
        raise ConfigError("no edits; say what to change, such as a shift of one agent")
    # Unknown agents are refused, and a second value for the same edit.
    known, seen = [a.id for a in scenario.agents], set()
    for step in edits:
        for name in step.names:
            if name not in known:
                more = len(known) - MAX_LISTED
                some = ", ".join(known[:MAX_LISTED]) + f" and {more} more" * (more > 0)
                raise ConfigError(f"{step.kind}: no agent '{name}'{nearest(name, known)}; known: {some}")
            if (step.kind, name) in seen and not isinstance(step, Only | Remove | Add):
                raise ConfigError(f"{step.kind}: agent '{name}' is named twice; give one value")
            seen.add((step.kind, name))
    agents: Agents = {a.id: a for a in scenario.agents}
    for step in edits:
        gone = next((name for name in step.names if name not in agents), None)
        if gone is not None:
            raise ConfigError(f"{step.kind}: agent '{gone}' is left out by another edit; drop one of the two")
        agents = step.applied(agents)
        if not agents:
            raise ConfigError(f"{step.kind}: leaves out every agent of '{scenario.name}'; keep at least one")
    duration_s = max(scenario.duration_s, *(float(a.waypoints.t_s[-1]) for a in agents.values()))
    earlier = scenario.provenance.get("edits", [])
    if not isinstance(earlier, list):
        raise ScenarioError(f"provenance.edits is {type(earlier).__name__}, expected the list of earlier edits")
    run = {"source_digest": scenario.digest, "edits": [e.to_dict() for e in edits]}
    provenance = {**scenario.provenance, "edits": [*earlier, run]}
    edited = replace(scenario, agents=tuple(agents.values()), duration_s=duration_s, provenance=provenance, tags=None)
    source = {a.id: a for a in scenario.agents}
    changed = [a for a in edited.agents if a is not source.get(a.id)]
    return Edited(edited, find_problems(scenario, edited, changed))


def find_problems(source: Scenario, changed: Scenario, agents: Sequence[Agent]) -> tuple[str, ...]:
    """Say what is wrong with a changed scenario and not with its source, a line each, with agent, time and value.

    `agents`: those of the changed scenario that were changed. New collisions, accelerations and curvatures that no vehicle reaches, and
    agents whose vehicle model cannot keep on their paths.
    """
    known, lines = {a.id: a for a in source.agents}, []
    for agent in agents:  # acceleration and curvature beyond their limits and beyond those of the source
        before = _peaks(known[agent.id]) if agent.id in known else {}
        for what, (peak, t_s) in _peaks(agent).items():
            limit, unit = MAX_ACCELERATION_MPS2, "m/s2"
            if what == "curvature":
                limit, unit = CURVATURE_LIMITS_1PM.get(GROUP_OF[agent.category], np.inf), "1/m"
            if peak > max(limit, before.get(what, (0.0, 0.0))[0]) * RELATIVE_TOLERANCE:
                lines.append(f"agent '{agent.id}': {what} {peak:.3g} {unit} at {t_s:.2f} s, limit {limit:g} {unit}")
    moving = tuple(a for a in agents if not a.static and GROUP_OF[a.category] != "pedestrian")
    if not lines and moving:  # agents that their vehicle model cannot keep on the path, though it could on the source's

        def off_path(scenario: Scenario) -> dict[str, float]:  # with the largest distance across it, m
            figures = replay(scenario, dt_s=STEP_S).metrics["by_agent"]
            across = {name: entry.get("cross_track_max_m") for name, entry in figures.items()}
            return {name: float(value) for name, value in across.items() if value is not None and value > OFF_PATH_M}

        now = off_path(replace(changed, agents=moving))
        same = tuple(a for a in source.agents if a.id in now and not a.static)
        then = off_path(replace(source, agents=same)) if same else {}
        lines += [
            f"agent '{name}': its vehicle model leaves the path by {now[name]:.2f} m, limit {OFF_PATH_M:g} m"
            for name in (a.id for a in moving)
            if now.get(name, 0.0) > then.get(name, 0.0)
        ]
    return (*_collisions(source, changed, {a.id for a in agents}), *lines)
