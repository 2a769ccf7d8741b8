"""OpenSCENARIO and OpenDRIVE files as a simple player reads them, written apart from what writes them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from log2sim.geometry import Array


@dataclass(frozen=True, eq=False)
class Entity:
    """One entity: its definition, its vertices (V, 5) t, x, y, z, h and where the storyboard puts and ends it."""

    name: str
    node: Element
    vertices: Array
    init: Element | None
    events: dict[str, Element]

    @property
    def body(self) -> Element:
        return self.node[0]

    def properties(self) -> dict[str, str]:
        return {p.attrib["name"]: p.attrib["value"] for p in self.body.iterfind("Properties/Property")}

    def box_at(self, t_s: float) -> Array:
        """Box center x, y, z and heading (4,) at a time: positions along the chord, headings along the shorter arc."""
        t = self.vertices[:, 0]
        k = int(np.clip(np.searchsorted(t, t_s, side="right") - 1, 0, len(t) - 2))
        f = (t_s - t[k]) / (t[k + 1] - t[k])
        a, b = self.vertices[k, 1:], self.vertices[k + 1, 1:]
        turn = (b[3] - a[3] + np.pi) % (2 * np.pi) - np.pi
        x, y, z = a[:3] + f * (b[:3] - a[:3])
        h = a[3] + f * turn
        cx, cy, cz = (float(self.body.find("BoundingBox/Center").attrib[k]) for k in "xyz")
        return np.array([x + cx * np.cos(h) - cy * np.sin(h), y + cx * np.sin(h) + cy * np.cos(h), z + cz, h])


def play(path: Path) -> dict[str, Entity]:
    """All entities of a file by name."""
    root = ElementTree.parse(path).getroot()
    found = {}
    for node in root.iterfind("Entities/ScenarioObject"):
        name = node.attrib["name"]
        groups = [
            g for g in root.iter("ManeuverGroup") if [e.attrib["entityRef"] for e in g.iter("EntityRef")] == [name]
        ]
        rows = [
            [float(v.attrib["time"]), *(float(v.find("Position/WorldPosition").attrib[k]) for k in "xyzh")]
            for g in groups
            for v in g.iter("Vertex")
        ]
        privates = [p for p in root.iter("Private") if p.attrib["entityRef"] == name]
        events = {e.attrib["name"].removeprefix(name).strip(): e for g in groups for e in g.iter("Event")}
        found[name] = Entity(name, node, np.array(rows), privates[0] if privates else None, events)
    return found


def trigger_s(event: Element) -> float:
    """When an event starts, by its only condition."""
    (condition,) = event.find("StartTrigger").iter("SimulationTimeCondition")
    value = float(condition.attrib["value"])
    return value + 1e-6 if condition.attrib["rule"] == "greaterThan" else value


@dataclass(frozen=True, eq=False)
class Sampled:
    """A road walked in small steps: `s_m` (N,), its reference line (N, 3) x, y, z, and centers and widths of lanes by their ids."""

    road: Element
    s_m: Array
    line: Array
    centers: dict[int, Array]
    widths: dict[int, Array]


def walk(road: Element, step_m: float = 0.02) -> Sampled:
    """Integrate a road's curvature from the start of every geometry in steps of at most `step_m`."""
    s, xyh = [], []
    for geometry in road.iterfind("planView/geometry"):
        s0, x, y, h, length = (float(geometry.attrib[k]) for k in ("s", "x", "y", "hdg", "length"))
        arc = geometry.find("arc")
        curvature = 0.0 if arc is None else float(arc.attrib["curvature"])
        n = max(int(np.ceil(length / step_m)), 1)
        along = np.linspace(0.0, length, n + 1)
        heading = h + curvature * along
        middle = h + curvature * (along[1:] + along[:-1]) / 2
        s.append(s0 + along)
        dx, dy = (np.concatenate([[0.0], np.cumsum(f(middle) * length / n)]) for f in (np.cos, np.sin))
        xyh.append(np.column_stack([x + dx, y + dy, heading]))
    stations, points = np.concatenate(s), np.concatenate(xyh)
    z = _cubics(road.findall("elevationProfile/elevation"), "s", stations)
    line = np.column_stack([points[:, :2], z])
    return Sampled(road, stations, line, *_lanes(road, stations, line, points[:, 2]))


def _cubics(nodes: list[Element], station: str, s_m: Array) -> Array:
    out = np.zeros(len(s_m))
    for node in nodes:
        s0, a, b, c, d = (float(node.attrib[k]) for k in (station, "a", "b", "c", "d"))
        ds = s_m - s0
        out = np.where(ds >= 0, a + b * ds + c * ds**2 + d * ds**3, out)
    return out


def _lanes(road: Element, s_m: Array, line: Array, heading: Array) -> tuple[dict[int, Array], dict[int, Array]]:
    offset = _cubics(road.findall("lanes/laneOffset"), "s", s_m)
    (section,) = road.findall("lanes/laneSection")
    left = np.column_stack([-np.sin(heading), np.cos(heading), np.zeros(len(s_m))])
    found, widths = {}, {}
    for side, sign in (("left", 1.0), ("right", -1.0)):
        edge = offset.copy()
        for lane in sorted(section.iterfind(f"{side}/lane"), key=lambda n: abs(int(n.attrib["id"]))):
            width = _cubics(lane.findall("width"), "sOffset", s_m)
            widths[int(lane.attrib["id"])] = width
            found[int(lane.attrib["id"])] = line + (edge + sign * width / 2)[:, None] * left
            edge = edge + sign * width
    return found, widths


def roads(path: Path, step_m: float = 0.02) -> list[Sampled]:
    """All roads of a file, walked."""
    return [walk(road, step_m) for road in ElementTree.parse(path).getroot().iterfind("road")]


def distance(points: Array, line: Array) -> Array:
    """Distance (N,) of points (N, 2) from a line given by samples (M, 2), to its chords."""
    from scipy.spatial import cKDTree

    best = np.full(len(points), np.inf)
    for near in cKDTree(line).query(points, k=4)[1].T:  # where a road crosses itself the nearest is not the best
        for shift in (-1, 0):
            a, b = (line[np.clip(near + shift + k, 0, len(line) - 1)] for k in (0, 1))
            span = b - a
            length2 = np.maximum((span**2).sum(axis=1), 1e-30)
            f = np.clip(((points - a) * span).sum(axis=1) / length2, 0, 1)
            best = np.minimum(best, np.hypot(*(points - a - f[:, None] * span).T))
    return best
