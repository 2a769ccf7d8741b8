"""Which way strips of road lead: that of the traffic on them, else as the side of the road on which it keeps tells."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from log2sim.datatypes import Marking, RoadBorder
from log2sim.geometry import wrap_angle
from log2sim.lanes.graph.beside import Beside, find_beside
from log2sim.lanes.graph.driven_paths import DrivenPath
from log2sim.lanes.graph.matching import MAX_TURN_RAD
from log2sim.lanes.graph.strips import LaneStrip

ONCOMING_M = 15.0
"""Traffic that comes towards a vehicle within this distance is on the same road: two lanes each way and a strip between."""

DRIVEN, OUTER, INNER, UNKNOWN = 0.98, 0.9, 0.7, 0.5
"""Probabilities of a direction: somebody drives that way; the lane beside it, away from oncoming traffic, must lead the same way;
the one towards oncoming traffic may lead either way; nothing is known. Not measured, but for the order."""


SURE = 0.65
"""Directions of lanes that somebody drives or that lie next to such a one, not those told across two lines."""


def find_side_of_traffic(paths: Sequence[DrivenPath]) -> int:
    """Return 1 where oncoming traffic passes to the left (right-hand traffic), -1 where to the right, 0 if none is seen."""
    votes = 0.0
    for k, one in enumerate(paths):
        for two in paths[k + 1 :]:
            low, high = one.line.bounds_m
            if np.any(two.line.bounds_m[0] - ONCOMING_M > high) or np.any(two.line.bounds_m[1] + ONCOMING_M < low):
                continue
            at = one.line.project(two.line.points_m[:, :2], two.line.heading_rad + np.pi)
            meets = at.inside & (np.abs(at.aside_m) <= ONCOMING_M) & (np.abs(at.turn_rad) <= MAX_TURN_RAD / 2)
            votes += float(np.sign(at.aside_m[meets]).sum())
    return int(np.sign(votes))


def direct_strips(
    strips: Sequence[LaneStrip], paths: Sequence[DrivenPath], sides: Mapping[str, Marking | RoadBorder]
) -> list[LaneStrip]:
    """Turn strips the way that they lead, with the probability of it."""
    found = [_driven(strip, paths) for strip in strips]
    traffic = find_side_of_traffic(paths) or 1
    beside = find_beside([strip.line for strip in found])
    for _ in range(len(found)):
        known = [strip.directed > UNKNOWN for strip in found]
        news = {}
        for pair in beside:
            if known[pair.route] and not known[pair.other] and pair.other not in news:
                alone = not _has_more(beside, pair)
                news[pair.other] = _from_neighbor(found[pair.route], found[pair.other], pair, (traffic, alone), sides)
        if not news:
            break
        turned = {k: strip.line is not found[k].line for k, strip in news.items()}
        found = [news.get(k, strip) for k, strip in enumerate(found)]
        if any(turned.values()):
            beside = find_beside([strip.line for strip in found])
    medians = _find_medians(found, beside, sides)
    return [strip for k, strip in enumerate(found) if k not in medians]


def _find_medians(
    strips: Sequence[LaneStrip], beside: Sequence[Beside], sides: Mapping[str, Marking | RoadBorder]
) -> set[int]:
    """Return strips that nobody drives, behind solid lines, between lanes that surely lead opposite ways."""
    ways: dict[int, set[tuple[bool, bool]]] = {}
    for pair in beside:
        if strips[pair.other].directed >= SURE:
            ways.setdefault(pair.route, set()).add((bool(pair.aside_m[0] > 0), pair.same_way))
    found = set()
    for k, strip in enumerate(strips):
        lines = [sides.get(name) for name in (strip.left, strip.right)]
        closed = all(isinstance(line, RoadBorder) or (line is not None and line.kind == "solid") for line in lines)
        apart = {(True, True), (False, False)}, {(True, False), (False, True)}
        if closed and strip.directed < DRIVEN and ways.get(k, set()) in apart:
            found.add(k)
    return found


def _driven(strip: LaneStrip, paths: Sequence[DrivenPath]) -> LaneStrip:
    """Turn a strip the way that most vehicles drive it, by the lengths of their paths on it."""
    along = 0
    for path in paths:
        for sign, turned in ((1, 0.0), (-1, np.pi)):
            at = strip.line.project(path.line.points_m[:, :2], path.line.heading_rad + turned)
            half = np.interp(at.s_m, strip.width_s_m, strip.width_m) / 2
            inside = at.inside & (np.abs(at.aside_m) <= half) & (np.abs(wrap_angle(at.turn_rad)) <= MAX_TURN_RAD)
            along += sign * int(inside.sum())
    if along == 0:
        return strip
    return replace(strip if along > 0 else strip.reversed(), directed=DRIVEN)


def _has_more(beside: Sequence[Beside], pair: Beside) -> bool:
    """Whether a road has more lanes than two strips side by side."""
    both = {pair.route, pair.other}
    return any(other.route in both and other.other not in both for other in beside)


def _from_neighbor(
    known: LaneStrip, strip: LaneStrip, pair: Beside, road: tuple[int, bool], sides: Mapping[str, Marking | RoadBorder]
) -> LaneStrip:
    """Turn a strip by the one beside it: outside of it the same way, towards oncoming traffic by the line between them.

    `road` is the side of traffic, and whether there are just these two: a dashed line in the middle of a road with two lanes
    parts its directions, one between more lanes those of one direction.
    """
    traffic, alone = road
    inner = pair.aside_m[0] * traffic > 0
    between = sides.get(known.left if pair.aside_m[0] > 0 else known.right)
    same, probability = True, OUTER
    if inner:
        dashed = isinstance(between, Marking) and between.kind == "dashed" and between.color != "yellow"
        same, probability = dashed and not alone, INNER
    turned = strip if pair.same_way == same else strip.reversed()
    return replace(turned, directed=probability * known.directed)
