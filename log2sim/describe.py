"""What a scenario says beyond the motion of its agents: lanes, colors of vehicles, traffic lights.

It is read from the recording once the agents are known: moving ones are left out of the map of the ground, pictures of
vehicles are chosen by where they are, and lanes are inferred from where they drove, too.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from log2sim.appearance.colors import ColorSampler
from log2sim.config import Config
from log2sim.datatypes import Agent, Log, MapFeatures, Scenario
from log2sim.errors import LogError
from log2sim.lanes.detection.markings import find_markings
from log2sim.lanes.graph.lane_graph import infer_lanes
from log2sim.mapping.builder import GroundMapBuilder
from log2sim.mapping.pose_refinement import place_as_given, refine_poses
from log2sim.outcome import Outcome
from log2sim.perception.first_pass import Observations
from log2sim.perception.frames import RecordReader
from log2sim.perception.picture_pass import PictureConsumer, look_again
from log2sim.plan import Decision, Plan, Stage
from log2sim.signals.traffic_lights import find_signals
from log2sim.stage_clock import StageClock


@dataclass(frozen=True, eq=False)
class Recorded:
    """What a scenario was made from, and how.

    Attributes
    ----------
    log : Log
        With the sensors that were used.
    config : Config
    plan : Plan
    observations : Observations
    clock : StageClock
    report_progress : callable
        Called as `report_progress(stage, done, total)`.
    """

    log: Log
    config: Config
    plan: Plan
    observations: Observations
    clock: StageClock
    report_progress: Callable[[str, int, int], None]


@dataclass(frozen=True, eq=False)
class Description:
    """A described scenario.

    Attributes
    ----------
    scenario : Scenario
    outcomes : tuple of Outcome
        Of the stages of the description.
    figures : dict
        For the report: "map_features", "colors", "signals".
    reader : RecordReader
        What could not be read.
    """

    scenario: Scenario
    outcomes: tuple[Outcome, ...]
    figures: dict[str, Any]
    reader: RecordReader


def describe(scenario: Scenario, recorded: Recorded) -> Description:
    """Add what the plan keeps of lanes, colors and traffic lights to a scenario."""
    log, plan = recorded.log, recorded.plan
    reader, notes = RecordReader(log), []
    mapped, ground, colors = log, None, None
    if plan.keeps(Stage.LANES):
        try:
            mapped = refine_poses(log, scenario, reader)
            ground = GroundMapBuilder(mapped, scenario, recorded.config.map, reader)
        except LogError as problem:
            notes.append(f"no map of the ground: {problem}")
    if plan.keeps(Stage.COLORS):
        colors = ColorSampler(log, scenario)
    consumers: list[PictureConsumer] = [consumer for consumer in (ground, colors) if consumer is not None]
    with recorded.clock.stage("pictures"):
        look_again(log, reader, consumers, lambda done, total: recorded.report_progress("pictures", done, total))
    with recorded.clock.stage("lanes"):
        features = None
        if plan.keeps(Stage.LANES):
            shown = read_map(ground, notes).moved(lambda points_m: place_as_given(points_m, mapped, log))
            features = with_lanes(shown, scenario)
    with recorded.clock.stage("colors"):
        agents = scenario.agents if colors is None else with_colors(scenario.agents, colors)
    with recorded.clock.stage("signals"):
        lights = recorded.observations.lights
        signals, seen = find_signals(log, scenario, lights) if plan.keeps(Stage.SIGNALS) else ((), "")
    described = replace(scenario, map_features=features, agents=agents, signals=signals)
    figures = {"map_features": count_features(features), "colors": count_colors(agents), "signals": len(signals)}
    return Description(described, outcomes_of(plan, described, seen), figures, reader)


def read_map(ground: GroundMapBuilder | None, notes: Sequence[str]) -> MapFeatures:
    """Find markings and borders in the map of the ground, if there is one."""
    if ground is None:
        return MapFeatures(notes=tuple(notes))
    seen = ground.build()
    markings, borders, more = find_markings(seen)
    return MapFeatures(markings, borders, notes=(*notes, *seen.notes, *more))


def with_lanes(features: MapFeatures, scenario: Scenario) -> MapFeatures:
    """Add the lanes between markings and where agents drove."""
    lanes, notes = infer_lanes(features.markings, features.borders, scenario)
    return replace(features, lanes=lanes, notes=(*features.notes, *notes))


def with_colors(agents: tuple[Agent, ...], sampler: ColorSampler) -> tuple[Agent, ...]:
    """Return the agents with the colors that were found."""
    found = sampler.colors()
    return tuple(replace(agent, color=found.get(agent.id, agent.color)) for agent in agents)


def outcomes_of(plan: Plan, scenario: Scenario, seen_lights: str) -> tuple[Outcome, ...]:
    """Say what came of the stages of the description."""
    features, colored = scenario.map_features, sum(agent.color is not None for agent in scenario.others)
    said = {
        Stage.LANES: "" if features is None else f"{len(features.markings)} markings, {len(features.lanes)} lanes",
        Stage.COLORS: f"colors of {colored} of {len(scenario.others)} agents",
        Stage.SIGNALS: seen_lights,
    }
    decisions = [plan.decision(stage) for stage in said]
    return tuple(Outcome(Decision(d.stage, d.kept, said[d.stage] if d.kept else d.reason)) for d in decisions)


def count_features(features: MapFeatures | None) -> dict[str, Any] | None:
    """Count markings by kind, borders, and lanes by what they are inferred from; None where they were not looked for."""
    if features is None:
        return None
    return {
        "markings": dict(Counter(marking.kind for marking in features.markings)),
        "borders": len(features.borders),
        "lanes": dict(Counter(lane.inferred_from for lane in features.lanes)),
        "notes": list(features.notes),
    }


def count_colors(agents: tuple[Agent, ...]) -> dict[str, int]:
    """Count agents by the name of their color."""
    return dict(Counter(str(agent.color["name"]) for agent in agents if agent.color is not None))
