"""Cuts lanes so that those side by side begin and end together, as lanes of one road do."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from log2sim.datatypes import MapLane
from log2sim.geometry import Polyline
from log2sim.road.routes import Beside, find_beside

ALIGNED_M = 0.3  # lanes side by side whose ends are farther apart along the road than this are roads of their own
# An end that is linked with nothing may move back by so much: a vehicle beyond it still stands on the road with its
# rear.
FREE_M = 1.0


def is_connection(lane: MapLane, by_id: Mapping[str, MapLane]) -> bool:
    """Whether a lane of a junction leads from one lane outside to another."""
    if lane.junction is None or len(lane.predecessors) != 1 or len(lane.successors) != 1:
        return False
    return all(by_id[name].junction is None for name in (*lane.predecessors, *lane.successors))


def cut_together(lanes: Sequence[MapLane], refused: Collection[frozenset[str]] = ()) -> list[MapLane]:
    """Cut lanes outside of junctions where one beside them begins or ends; name for each part its neighbors.

    A part is linked with those before and after it, and lanes with the first and last parts of what they were linked with. The
    part k of a lane is called as the lane with "/k". Pairs of lanes that are `refused` are not taken for side by side.
    """
    by_id = {lane.id: lane for lane in lanes}
    plain = [lane for lane in lanes if not is_connection(lane, by_id)]
    lines = [Polyline.through(lane.points_m) for lane in plain]
    beside = [b for b in find_beside(lines) if _may_share(plain[b.route], plain[b.other], b, refused)]
    for b in list(beside):  # the same stretch as the other line has it
        order = slice(None, None, 1 if b.same_way else -1)
        aside = -b.aside_m if b.same_way else b.aside_m
        beside.append(Beside(b.other, b.route, b.other_s_m[order], b.s_m[order], aside[order], b.same_way))
    stations = _stations(plain, lines, beside)
    names = {lane.id: [lane.id] for lane in lanes}
    for lane, at in zip(plain, stations):
        if len(at) > 2:
            names[lane.id] = [f"{lane.id}/{k}" for k in range(1, len(at))]
    rows = {lane.id: row for row, lane in enumerate(plain)}
    found = []
    for lane in lanes:
        before = tuple(names[name][-1] for name in lane.predecessors)
        after = tuple(names[name][0] for name in lane.successors)
        links = [before, *((name,) for name in names[lane.id]), after]
        for k, name in enumerate(names[lane.id]):
            known: dict[str, Any] = {}
            for side in ("left_lane", "right_lane", "opposite"):
                other = getattr(lane, side)
                whole = other is not None and names[lane.id] == [lane.id] and names[other] == [other]
                known[side] = other if whole and frozenset((lane.id, other)) not in refused else None
            part = replace(lane, id=name, predecessors=links[k], successors=links[k + 2], **known)
            if lane.id in rows:
                row = rows[lane.id]
                begin_m, end_m = stations[row][k : k + 2]
                if begin_m != 0.0 or end_m != lines[row].length_m:
                    points = lines[row].part(begin_m, end_m)
                    ahead = begin_m + Polyline(points).s_m
                    width = np.interp(ahead, Polyline(part.points_m).s_m, part.width_m)
                    part = replace(part, points_m=points, width_m=width)
                part = replace(part, **_neighbors(row, stations, k, beside, plain, names))
            found.append(part)
    return found


def _may_share(lane: MapLane, other: MapLane, pair: Beside, refused: Collection[frozenset[str]]) -> bool:
    """Whether lanes side by side may share a road: neither has another neighbor there, and who drives the other way is to the left."""
    left = float(np.median(pair.aside_m)) > 0
    if frozenset((lane.id, other.id)) in refused or not (pair.same_way or left):
        return False
    if not pair.same_way:
        own, theirs = lane.opposite, other.opposite
    elif left:
        own, theirs = lane.left_lane, other.right_lane
    else:
        own, theirs = lane.right_lane, other.left_lane
    return own in (None, other.id) and theirs in (None, lane.id)


def _stations(lanes: Sequence[MapLane], lines: Sequence[Polyline], beside: Sequence[Beside]) -> list[list[float]]:
    """Return where each line is cut, its ends included: at cuts of those beside it, until there are no more."""
    cuts = [[0.0, line.length_m] for line in lines]
    free = [(not lane.predecessors, not lane.successors) for lane in lanes]
    for _ in lines:
        before = [list(at) for at in cuts]
        for pair in beside:
            for s in before[pair.route]:
                if pair.s_m[0] - ALIGNED_M <= s <= pair.s_m[-1] + ALIGNED_M:
                    _cut_at(cuts[pair.other], float(np.interp(s, pair.s_m, pair.other_s_m)), free[pair.other])
        if cuts == before:
            break
    return cuts


def _cut_at(cuts: list[float], s: float, free: tuple[bool, bool]) -> None:
    """Add a cut to those in order unless there is one; near an end that is free, move the end."""
    nearest = min(range(len(cuts)), key=lambda k: abs(cuts[k] - s))
    if abs(cuts[nearest] - s) <= ALIGNED_M or not cuts[0] < s < cuts[-1]:
        return
    if s - cuts[0] <= FREE_M and free[0] and len(cuts) > 1:
        cuts[0] = s
    elif cuts[-1] - s <= FREE_M and free[1]:
        cuts[-1] = s
    else:
        cuts.append(s)
        cuts.sort()


def _neighbors(
    row: int,
    stations: Sequence[Sequence[float]],
    k: int,
    beside: Sequence[Beside],
    plain: Sequence[MapLane],
    names: Mapping[str, Sequence[str]],
) -> dict[str, Any]:
    """Return the parts of other lanes beside the middle of part k of a lane; who drives the other way is to the left."""
    middle = (stations[row][k] + stations[row][k + 1]) / 2
    found = {}
    for pair in beside:
        if pair.route == row and pair.s_m[0] <= middle <= pair.s_m[-1]:
            left = float(np.median(pair.aside_m)) > 0
            there = float(np.interp(middle, pair.s_m, pair.other_s_m))
            at = int(np.searchsorted(stations[pair.other], there)) - 1
            parts = names[plain[pair.other].id]
            name = parts[min(max(at, 0), len(parts) - 1)]
            if pair.same_way:
                found["left_lane" if left else "right_lane"] = name
            else:
                found["opposite"] = name
    return found
