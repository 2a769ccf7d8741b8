"""Within the environment `scenariogeneration`: the entities and trajectories that it reads in a .xosc file."""

import json
import sys
from pathlib import Path

from scenariogeneration import xosc

scenario = xosc.ParseOpenScenario(sys.argv[1])
root = scenario.get_element()
vertices = {}
for group in root.iter("ManeuverGroup"):
    name = group.find("Actors/EntityRef").get("entityRef")
    vertices[name] = [
        [float(v.get("time")), *(float(v.find("Position/WorldPosition").get(k)) for k in "xyzh")]
        for v in group.iter("Vertex")
    ]
names = [o.name for o in scenario.entities.scenario_objects]
Path(sys.argv[2]).write_text(json.dumps({"entities": names, "vertices": vertices}), encoding="utf-8")
