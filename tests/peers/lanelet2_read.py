"""Reads a Lanelet2 map by its own package: what routing finds in it, as JSON on standard output.

python tests/peers/lanelet2_read.py MAP.osm LATITUDE LONGITUDE
"""

from __future__ import annotations

import json
import sys

import lanelet2
from lanelet2.projection import UtmProjector


def main() -> None:
    path, latitude, longitude = sys.argv[1], float(sys.argv[2]), float(sys.argv[3])
    projector = UtmProjector(lanelet2.io.Origin(latitude, longitude))
    found, errors = lanelet2.io.loadRobust(path, projector)
    rules = lanelet2.traffic_rules.create(
        lanelet2.traffic_rules.Locations.Germany, lanelet2.traffic_rules.Participants.Vehicle
    )
    graph = lanelet2.routing.RoutingGraph(found, rules)
    roads = [lane for lane in found.laneletLayer if lane.attributes["subtype"] == "road"]

    def name(lane: lanelet2.core.Lanelet) -> str:
        return str(lane.attributes["log2sim_id"])

    def edge(line: lanelet2.core.LineString3d) -> list[list[float]]:
        places = [projector.reverse(lanelet2.core.BasicPoint3d(p.x, p.y, p.z)) for p in line]
        return [[p.lon, p.lat, p.alt] for p in places]

    beside = {
        name(lane): [None if b is None else name(b) for b in (graph.left(lane), graph.adjacentLeft(lane))]
        for lane in roads
    }
    out = {
        "errors": list(errors),
        "following": {name(lane): [name(other) for other in graph.following(lane)] for lane in roads},
        "left": beside,
        "edges": {name(lane): [edge(lane.leftBound), edge(lane.rightBound)] for lane in roads},
        "lights": {
            name(lane): [
                [sorted(str(line.attributes["log2sim_id"]) for line in rule.trafficLights), rule.stopLine is not None]
                for rule in lane.trafficLights()
            ]
            for lane in roads
        },
        "signs": {
            name(lane): [
                [rule.type() if callable(rule.type) else rule.type, len(rule.refLines())]
                for rule in lane.regulatoryElements
                if isinstance(rule, lanelet2.core.TrafficSign)
            ]
            for lane in roads
        },
        "complaints": graph.checkValidity(),
        "crosswalks": sum(lane.attributes["subtype"] == "crosswalk" for lane in found.laneletLayer),
    }
    sys.stdout.write(json.dumps(out))


if __name__ == "__main__":
    main()
