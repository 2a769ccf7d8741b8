"""What a scenario says beyond the motion of its agents: lanes, colors of vehicles, traffic lights.

It is read from the recording once the agents are known: moving ones are left out of the map of the ground, pictures of
vehicles are chosen by where they are, and lanes are inferred from where they drove, too.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from log2sim.config import Config
from log2sim.datatypes import Agent, Log, MapFeatures, Scenario
from log2sim.errors import LogError
from log2sim.files.stages import StageClock
from log2sim.localization.pose_refinement import MAX_KEYFRAMES, place_as_given, refine_poses
from log2sim.perception.frames import KeepingReader, PictureConsumer, RecordReader, look_again
from log2sim.perception.traffic_light_boxes import LightBox
from log2sim.plan import Decision, Outcome, Plan, Stage
from log2sim.road.builder import GroundMapBuilder
from log2sim.road.colors import ColorSampler
from log2sim.road.lane_graph import infer_lanes
from log2sim.road.markings import find_markings
from log2sim.road.signals import find_signals


@dataclass(frozen=True, eq=False)
class Description:
    """A described scenario.

    Attributes
    ----------
    outcomes : tuple of Outcome
        Of the stages of the description.
    figures : dict
        For the report: "map_features", "colors", "signals".
    unreadable : dict
        Records that could not be read, by stream, for the report.
    """

    scenario: Scenario
    outcomes: tuple[Outcome, ...]
    figures: dict[str, Any]
    unreadable: dict[str, Any]


def describe(
    scenario: Scenario,
    log: Log,
    config: Config,
    plan: Plan,
    lights: Sequence[LightBox],
    clock: StageClock,
    progress: Callable[[str, int, int], None],
) -> Description:
    """Add what the plan keeps of lanes, colors and traffic lights to a scenario.

    Parameters
    ----------
    lights : sequence of LightBox
        Traffic lights in frames, from the first pass.
    progress : callable
        Called as `progress(stage, done, total)`.
    """
    log = log.changed(cameras={name: log.cameras[name] for name in plan.cameras})
    reader = KeepingReader(log, MAX_KEYFRAMES)
    with clock.stage("map poses", progress):
        started = start_map(scenario, log, config, reader) if plan.keeps(Stage.LANES) else None
    colors = ColorSampler(log, scenario) if plan.keeps(Stage.COLORS) else None
    builder = None if started is None else started.builder
    consumers: list[PictureConsumer] = [consumer for consumer in (builder, colors) if consumer is not None]
    with clock.stage("pictures", progress):
        look_again(log, reader, consumers, lambda done, total: progress("pictures", done, total))
    with clock.stage("lanes", progress):
        features = None if started is None else with_lanes(read_map(started, log, reader), scenario)
    with clock.stage("colors"):
        agents = scenario.agents if colors is None else with_colors(scenario.agents, colors)
    with clock.stage("signals"):
        signals, seen = find_signals(log, scenario, lights) if plan.keeps(Stage.SIGNALS) else ((), "")
    described = replace(scenario, map_features=features, agents=agents, signals=signals)
    figures = {"map_features": count_features(features), "colors": count_colors(agents), "signals": len(signals)}
    uncolored = () if colors is None else colors.notes()
    return Description(described, outcomes_of(plan, described, seen, uncolored), figures, reader.summary())


@dataclass(frozen=True, eq=False)
class StartedMap:
    """A map of the ground that is being made.

    Attributes
    ----------
    log : Log
        With the poses that the map is made by.
    builder : GroundMapBuilder or None
        None where no map can be made.
    notes : tuple of str
        Why not.
    """

    log: Log
    builder: GroundMapBuilder | None
    notes: tuple[str, ...] = ()


def start_map(scenario: Scenario, log: Log, config: Config, reader: RecordReader) -> StartedMap:
    """Refine the poses for a map of the ground, and choose what it is made of."""
    log = refine_poses(log, scenario, reader)
    try:
        return StartedMap(log, GroundMapBuilder(log, scenario, config.map, reader))
    except LogError as problem:
        return StartedMap(log, None, (f"no map of the ground: {problem}",))


def read_map(started: StartedMap, log: Log, reader: KeepingReader) -> MapFeatures:
    """Find markings and borders in the map, if there is one, and put them where the poses of the log have them."""
    if started.builder is None:
        return MapFeatures(notes=started.notes)
    ground = started.builder.build()
    reader.forget()
    markings, borders, notes = find_markings(ground)
    features = MapFeatures(markings, borders, notes=(*ground.notes, *notes))
    return features.moved(lambda points_m: place_as_given(points_m, started.log, log))


def with_lanes(features: MapFeatures, scenario: Scenario) -> MapFeatures:
    """Add the lanes between markings and where agents drove."""
    lanes, notes = infer_lanes(features.markings, features.borders, scenario)
    return replace(features, lanes=lanes, notes=(*features.notes, *notes))


def with_colors(agents: tuple[Agent, ...], sampler: ColorSampler) -> tuple[Agent, ...]:
    """Return the agents with the colors that were found."""
    found = sampler.colors()
    return tuple(replace(agent, color=found.get(agent.id, agent.color)) for agent in agents)


def outcomes_of(plan: Plan, scenario: Scenario, seen_lights: str, uncolored: Sequence[str]) -> tuple[Outcome, ...]:
    """Say what came of the stages of the description."""
    features, colored = scenario.map_features, sum(agent.color is not None for agent in scenario.others)
    said = {
        Stage.LANES: "" if features is None else f"{len(features.markings)} markings, {len(features.lanes)} lanes",
        Stage.COLORS: "; ".join([f"colors of {colored} vehicles", *uncolored]),
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
