"""Summary of a scenario in numbers: its agents, what the ground shows, and how the ego keeps its lane."""

from __future__ import annotations

from collections import Counter
from typing import Any

from log2sim.datatypes import MapFeatures, Scenario
from log2sim.lanes.graph.lane_graph import infer_lanes
from log2sim.lanes.lane_keeping import summarize_lane_keeping


def summarize_scenario(scenario: Scenario) -> dict[str, Any]:
    """Summarize a scenario as a JSON document: agents without the ego; lanes that it does not hold are inferred from paths."""
    features = scenario.map_features or MapFeatures()
    lanes, notes = features.lanes, features.notes
    if not lanes:
        lanes, more = infer_lanes(features.markings, features.borders, scenario)
        notes = (*notes, *more)
    agents = scenario.others
    return {
        "name": scenario.name,
        "t0_ns": scenario.t0_ns,
        "duration_s": scenario.duration_s,
        "agents": {
            "count": len(agents),
            "moving": sum(not agent.static for agent in agents),
            "doubtful": sum(agent.is_doubtful for agent in agents),
            "categories": dict(sorted(Counter(agent.category for agent in agents).items())),
            "colors": dict(sorted(Counter(a.color["name"] for a in agents if a.color is not None).items())),
        },
        "ego": None if scenario.ego is None else {"doubtful": scenario.ego.is_doubtful},
        "markings": dict(sorted(Counter(marking.kind for marking in features.markings).items())),
        "borders": dict(sorted(Counter(border.kind for border in features.borders).items())),
        "lanes": {
            "count": len(lanes),
            "junctions": len({lane.junction for lane in lanes} - {None}),
            "inferred_from": dict(sorted(Counter(lane.inferred_from for lane in lanes).items())),
            "in_file": bool(features.lanes),
        },
        "signals": len(scenario.signals),
        "ego_in_lane": None if scenario.ego is None else summarize_lane_keeping(scenario.ego, lanes),
        "notes": list(notes),
    }
