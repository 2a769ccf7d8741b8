"""Trajectories of OpenSCENARIO files: the timed vertices of each entity, and entities that only have a position."""

from __future__ import annotations

from xml.etree.ElementTree import Element

import numpy as np

from log2sim.errors import ScenarioError
from log2sim.export.xml_text import require_number
from log2sim.geometry import Array

VERTEX_LIMIT = 10_000_000
# Headings may count whole turns; of larger ones not even the direction is left.
MAX_HEADING_RAD = 1e6


def vertices_by_entity(root: Element) -> dict[str, Array]:
    """Return by entity the vertices (V, 5) t, x, y, z, heading of all its trajectories.

    Many entities may share one trajectory, so a small file may expand to very many vertices: they are counted per
    entity.
    """
    found: dict[str, list[Array]] = {}
    count = 0
    for group in root.iter("ManeuverGroup"):
        names = [ref.get("entityRef", "") for ref in group.iterfind("Actors/EntityRef")]
        for follow in group.iter("FollowTrajectoryAction") if names else ():
            rows = _polyline(follow, f"entity '{names[0][:100]}'")
            count += len(names) * len(rows)
            if count > VERTEX_LIMIT:
                raise ScenarioError(
                    f"its entities have more than {VERTEX_LIMIT} vertices together; cut the file into parts"
                )
            for name in names:
                found.setdefault(name, []).append(rows)
    return {name: np.concatenate(parts) for name, parts in found.items()}


def _polyline(follow: Element, where: str) -> Array:
    timing = follow.find("TimeReference/Timing")
    if timing is None or timing.get("domainAbsoluteRelative") != "absolute":
        raise ScenarioError(
            f"{where}: its trajectory has no <Timing> with an absolute domain; without it nothing has a time"
        )
    nodes = list(follow.iter("Vertex"))
    if not nodes:
        raise ScenarioError(f"{where}: its trajectory has no vertices of a polyline, expected at least one")
    scale, offset = (require_number(timing.get(key), f"{where}: Timing {key}") for key in ("scale", "offset"))
    rows = np.array([[require_number(n.get("time"), f"{where}: Vertex time"), *_pose(n, where)] for n in nodes])
    rows[:, 0] = offset + scale * rows[:, 0]
    return _with_headings(rows)


def _with_headings(rows: Array) -> Array:
    """Fill in the direction of travel for vertices (V, 5) without a heading: leaving it out does not mean 0."""
    absent = np.isnan(rows[:, 4])
    steps = np.diff(rows[:, 1:3], axis=0)
    moving = np.flatnonzero(np.hypot(*steps.T) > 0)
    if absent.any():
        travel = np.zeros(len(rows))
        if len(moving):
            last = moving[np.clip(np.searchsorted(moving, np.arange(len(rows)), side="right") - 1, 0, None)]
            travel = np.arctan2(steps[last, 1], steps[last, 0])
        rows[absent, 4] = travel[absent]
    return rows


def _pose(node: Element, where: str) -> list[float]:
    """Return x, y, z, heading of the `WorldPosition` within an element; NaN for a missing heading."""
    world = node.find("Position/WorldPosition")
    if world is None:
        raise ScenarioError(f"{where}: a position that is no <WorldPosition>; only those can be read without the road")
    x, y, z = (
        require_number(world.get(key, "0" if key == "z" else None), f"{where}: WorldPosition {key}") for key in "xyz"
    )
    text = world.get("h")
    heading = float("nan") if text is None else require_number(text, f"{where}: WorldPosition h")
    if abs(heading) > MAX_HEADING_RAD:
        raise ScenarioError(f"{where}: WorldPosition h is {heading:g}, expected radians")
    return [x, y, z, heading]


def initial_positions(root: Element) -> dict[str, Element]:
    """Return by entity its initial position in the file."""
    found: dict[str, Element] = {}
    for private in root.iterfind("Storyboard/Init/Actions/Private"):
        teleport = private.find("PrivateAction/TeleportAction")
        if teleport is not None:
            found.setdefault(private.get("entityRef", ""), teleport)
    return found


def stationary_vertices(start: Element | None, where: str, last_s: float) -> Array:
    """Return vertices (2, 5) of an entity that stands at its initial position."""
    if start is None:
        raise ScenarioError(f"{where}: has neither a trajectory nor a position at the start; nothing says where it is")
    pose = _pose(start, where)
    result: Array = np.nan_to_num(np.array([[0.0, *pose], [max(last_s, 1e-3), *pose]]))
    return result


def speeds_of(vertices: Array) -> Array:
    """Return the speed (V,) along the heading from vertices (V, 5)."""
    t, x, y, _, heading = vertices.T
    if len(t) < 2 or np.any(np.diff(t) <= 0):
        return np.zeros(len(t))
    result: Array = np.gradient(x, t) * np.cos(heading) + np.gradient(y, t) * np.sin(heading)
    return result
