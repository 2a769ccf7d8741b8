"""What a scenario says beyond the motion of its agents: lanes, colors of vehicles, traffic lights.

It is read from the recording once the agents are known: moving ones are left out of the map of the ground, pictures of
vehicles are chosen by where they are, and lanes are inferred from where they drove, too.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from typing import Any

from log2sim.config import MapConfig
from log2sim.datatypes import Log, MapFeatures, Marking, RoadBorder, Scenario, Signal
from log2sim.errors import LogError
from log2sim.files.processes import in_background, map_in_processes
from log2sim.files.stages import StageClock
from log2sim.geometry import PoseTrack
from log2sim.localization.pose_refinement import place_as_given
from log2sim.localization.replaced import replace_poses
from log2sim.perception.first_pass import Observations
from log2sim.perception.frames import read_pictures
from log2sim.perception.records import RecordSource
from log2sim.perception.run_detectors import StageCache
from log2sim.plan import Decision, Plan, Stage
from log2sim.road.builder import GroundMapBuilder
from log2sim.road.colors import ColorSampler
from log2sim.road.lane_graph import infer_lanes
from log2sim.road.map_parts import Part, join_parts, parts_of
from log2sim.road.markings import find_markings
from log2sim.road.signals import find_signals


def describe(
    scenario: Scenario,
    log: Log,
    plan: Plan,
    observations: Observations,
    *,
    settings: MapConfig,
    for_map: PoseTrack | None,
    earlier: StageCache | None,
    jobs: int,
    clock: StageClock,
    progress: Callable[[str, int, int], None],
) -> tuple[Scenario, list[Decision], dict[str, Any]]:
    """Add what the plan keeps of lanes, colors and traffic lights to a scenario; with what the stages did, and figures of the report.

    `observations`: what the first pass found of the records. `for_map`: poses by which the ground is drawn, None for those of the
    log. `earlier`: where maps of earlier runs are known. `jobs`: with more than one, vehicles and lights are looked at in a process of
    their own while the ground is drawn, and parts of a large map at the same time.
    """
    log = log.changed(cameras={name: log.cameras[name] for name in plan.cameras})
    drawn = log if for_map is None else replace_poses(log, for_map)
    records = (observations.records or RecordSource(log)).of(drawn)
    parts, features = list[Part](), MapFeatures() if plan.keeps(Stage.LANES) else None
    if features is not None:
        try:
            parts = parts_of(drawn, scenario, settings.cell_m)
        except LogError as problem:
            features = MapFeatures(notes=(f"no map of the ground: {problem}",))
    look = partial(_appearance, scenario, log, plan, observations, records, earlier)
    with clock.stage("appearance"), in_background(look, jobs if plan.keeps(Stage.COLORS) else 1) as appearance:
        found = list[MapFeatures]()
        shared = min(jobs, len(parts)) if len(parts) > 1 else 1
        # Other processes have clocks of their own, and show no progress.
        reported = (clock, progress) if shared == 1 else (StageClock(), lambda stage, done, total: None)
        draw = partial(_draw, drawn, scenario, settings, records, earlier, *reported)
        with nullcontext() if shared == 1 else clock.stage("pictures", progress):
            for made, known, failed in map_in_processes(draw, parts, shared):
                found.append(made)
                if shared > 1:
                    progress("pictures", len(found), len(parts))
                records.add({}, failed)
                if earlier is not None:
                    earlier.add(known)
        if parts:
            features = join_parts(parts, found).moved(lambda points_m: place_as_given(points_m, drawn, log))
        if features is not None:
            with clock.stage("lanes", progress):
                lanes, notes = infer_lanes(features.markings, features.borders, scenario)
                features = replace(features, lanes=lanes, notes=(*features.notes, *notes))
        (colors, uncolored, signals, seen_lights), known = appearance()
        if earlier is not None:
            earlier.add(known)
    agents = tuple(replace(agent, color=colors.get(agent.id, agent.color)) for agent in scenario.agents)
    described = replace(scenario, map_features=features, agents=agents, signals=signals)
    colored = sum(agent.color is not None for agent in described.others)
    said = {
        Stage.LANES: "" if features is None else f"{len(features.markings)} markings, {len(features.lanes)} lanes",
        Stage.COLORS: "; ".join([f"colors of {colored} vehicles", *uncolored]),
        Stage.SIGNALS: seen_lights,
    }
    planned = [next(d for d in plan.decisions if d.stage is stage) for stage in said]
    decisions = [replace(d, reason=said[d.stage]) if d.kept else d for d in planned]
    mapped = None
    if features is not None:
        kinds, origins = (m.kind for m in features.markings), (lane.inferred_from for lane in features.lanes)
        mapped = {"markings": dict(Counter(kinds)), "borders": len(features.borders), "lanes": dict(Counter(origins))}
        mapped |= {"notes": list(features.notes)}
    figures = {
        "map_features": mapped,
        "colors": dict(Counter(str(agent.color["name"]) for agent in agents if agent.color is not None)),
        "signals": len(signals),
    }
    return described, decisions, figures


def _draw(
    log: Log,
    scenario: Scenario,
    settings: MapConfig,
    records: RecordSource,
    earlier: StageCache | None,
    clock: StageClock,
    progress: Callable[[str, int, int], None],
    part: Part,
) -> tuple[MapFeatures, list[str], dict[str, list[str]]]:
    """Draw the ground of a part and find markings and borders on it; with what stages were known, and the records that cannot be read."""
    records = records.of(log)
    records.watch = records.watch.copied()  # so that no part depends on those before it
    builder = GroundMapBuilder(log, scenario, settings, records, area_m=part.area_m)

    def draw() -> MapFeatures:
        with clock.stage("pictures", progress):
            builder.lay_pictures(lambda done, total: progress("pictures", done, total))
        with clock.stage("lanes", progress):
            ground = builder.build()
            markings, borders, notes = find_markings(ground)
            return MapFeatures(markings, borders, notes=(*ground.notes, *notes))

    if earlier is None:
        return draw(), [], records.failed
    of = [*builder.inputs(), log.ego]
    return earlier.known("map", log, of, (MapFeatures, Marking, RoadBorder), draw), earlier.found, records.failed


def _appearance(
    scenario: Scenario,
    log: Log,
    plan: Plan,
    observations: Observations,
    records: RecordSource,
    earlier: StageCache | None,
) -> tuple[tuple[dict[str, dict[str, Any]], tuple[str, ...], tuple[Signal, ...], str], list[str]]:
    """Return the colors of vehicles by id and which have none, the traffic lights and how many were seen; and what stages were known."""

    def look() -> tuple[dict[str, dict[str, Any]], tuple[str, ...], tuple[Signal, ...], str]:
        colors, uncolored = dict[str, dict[str, Any]](), tuple[str, ...]()
        if plan.keeps(Stage.COLORS):
            sampler = ColorSampler(log, scenario)
            for frame in read_pictures(records, sampler.frames()):
                sampler.add(*frame)
            colors, uncolored = sampler.colors(), sampler.notes()
        signals = find_signals(log, scenario, observations.lights) if plan.keeps(Stage.SIGNALS) else ((), "")
        return colors, uncolored, *signals

    keeps = [plan.keeps(stage) for stage in (Stage.COLORS, Stage.SIGNALS)]
    if earlier is None or not any(keeps):
        return look(), []
    of = [keeps, scenario.t0_ns, scenario.duration_s, scenario.agents, observations.lights]
    of.append([records.watch.known(name) for name in log.cameras])
    return earlier.known("appearance", log, of, (Signal,), look), earlier.found
