"""Reads a scenario of CommonRoad with CommonRoad's own software and prints what it finds as JSON.

Runs in an environment of its own: `python commonroad_read.py FILE.xml EGO.json`, the latter a list of the ego's
[x, y, yaw, length, width] at every step.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import commonroad
import numpy as np
from commonroad.common.file_reader import CommonRoadFileReader
from commonroad.scenario.state import CustomState
from lxml import etree


def complaints(file):
    """What the schema says of the file."""
    (definition,) = Path(commonroad.__file__).parent.glob("*/xml_definition_files/XML_commonRoad_XSD.xsd")
    schema = etree.XMLSchema(etree.parse(definition))
    schema.validate(etree.parse(file))
    return [e.message for e in schema.error_log]


def poses(obstacle, steps):
    """x, y, yaw and speed of an obstacle at each step; None where it is not there."""
    states = [obstacle.state_at_time(k) for k in range(steps)]
    return [None if s is None else [*map(float, s.position), s.orientation, s.velocity] for s in states]


def collisions(scenario, ego):
    """Steps at which CommonRoad's collision checker finds the ego in an obstacle; None without the checker."""
    try:
        from commonroad_dc import pycrcc
        from commonroad_dc.collision.collision_detection.pycrcc_collision_dispatch import create_collision_checker
    except ImportError:
        return None
    checker = create_collision_checker(scenario)
    boxes = [pycrcc.RectOBB(length / 2, width / 2, yaw, x, y) for x, y, yaw, length, width in ego]
    return [k for k, box in enumerate(boxes) if checker.time_slice(k).collide(box)]


def main(file, ego_file):
    ego = json.loads(Path(ego_file).read_text())
    scenario, problems = CommonRoadFileReader(file).open()
    (problem,) = problems.planning_problem_dict.values()
    start, (x, y, yaw, *_), last = problem.initial_state, ego[-1], len(ego) - 1
    speed = problem.goal.state_list[0].velocity
    arrived = CustomState(
        time_step=last, position=np.array([x, y]), orientation=yaw, velocity=(speed.start + speed.end) / 2
    )
    found = {
        "complaints": complaints(file),
        "id": str(scenario.scenario_id),
        "start": [*map(float, start.position), start.orientation, start.velocity],
        "obstacles": {
            o.obstacle_id: {
                "type": o.obstacle_type.value,
                "role": o.obstacle_role.value,
                "size": [o.obstacle_shape.length, o.obstacle_shape.width],
                "poses": poses(o, len(ego)),
            }
            for o in scenario.obstacles
        },
        "collisions": collisions(scenario, ego),
        "ego_on_lanelet": [
            bool(ids) for ids in scenario.lanelet_network.find_lanelet_by_position([e[:2] for e in ego])
        ],
        "arrived": bool(problem.goal.is_reached(arrived)),
        "lanelets_valid": [let.polygon.shapely_object.is_valid for let in scenario.lanelet_network.lanelets],
    }
    json.dump(found, sys.stdout)


main(*sys.argv[1:])
