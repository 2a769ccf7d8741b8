"""Within the environment `carla`: what carla.Map makes of a road. Arguments: road.xodr, points.json [[x, y, z], ...].

Prints how far the points are from the middle of their lane across and in height and beyond its edge, and the lanes they are on.
"""

import json
import math
import sys
from pathlib import Path

import carla

road, points = (Path(a).read_text(encoding="utf-8") for a in sys.argv[1:])
world = carla.Map("road", road)
aside, above, beyond, lanes = [], [], [], set()
for x, y, z in json.loads(points):
    # CARLA's axes are left-handed: y to the right.
    found = world.get_waypoint(carla.Location(x, -y, z), project_to_road=True, lane_type=carla.LaneType.Driving)
    middle = found.transform.location
    aside.append(math.hypot(middle.x - x, middle.y + y))
    beyond.append(aside[-1] - found.lane_width / 2)
    above.append(abs(middle.z - z))
    lanes.add((found.road_id, found.lane_id))
json.dump(
    {"aside_m": max(aside), "above_m": max(above), "over_edge_m": max(beyond), "lanes": sorted(lanes)}, sys.stdout
)
