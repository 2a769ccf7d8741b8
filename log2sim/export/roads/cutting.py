"""Cuts lanes so that those side by side begin and end together, as lanes of one road do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from log2sim.datatypes import MapLane
from log2sim.lanes.graph.beside import Beside, find_beside
from log2sim.lanes.graph.polyline import Polyline

ALIGNED_M = 0.3
"""Lanes side by side whose ends are farther apart along the road than this are roads of their own."""


def is_connection(lane: MapLane, by_id: Mapping[str, MapLane]) -> bool:
    """Whether a lane of a junction leads from one lane outside to another."""
    if lane.junction is None or len(lane.predecessors) != 1 or len(lane.successors) != 1:
        return False
    return all(by_id[name].junction is None for name in (*lane.predecessors, *lane.successors))


def cut_together(lanes: Sequence[MapLane]) -> list[MapLane]:
    """Cut lanes outside of junctions where one beside them begins or ends; name for each part its neighbors.

    A part is linked with those before and after it, and lanes with the first and last parts of what they were linked with.
    """
    by_id = {lane.id: lane for lane in lanes}
    plain = [lane for lane in lanes if not is_connection(lane, by_id)]
    lines = [Polyline.through(lane.points_m) for lane in plain]
    beside = find_beside(lines)
    stations = _stations(lines, beside)
    names = {
        lane.id: [lane.id] if len(at) == 2 else [f"{lane.id}/{k}" for k in range(1, len(at))]
        for lane, at in zip(plain, stations)
    }
    names |= {lane.id: [lane.id] for lane in lanes if lane.id not in names}
    found = []
    for lane in lanes:
        before = tuple(names[name][-1] for name in lane.predecessors)
        after = tuple(names[name][0] for name in lane.successors)
        links = [before, *((name,) for name in names[lane.id]), after]
        for k, name in enumerate(names[lane.id]):
            known = {
                key: other if other is None or names[other] == [other] else None
                for key in ("left_lane", "right_lane", "opposite")
                for other in (getattr(lane, key) if len(names[lane.id]) == 1 else None,)
            }
            part = replace(lane, id=name, predecessors=links[k], successors=links[k + 2], **known)
            if len(names[lane.id]) > 1 or lane in plain:
                row = plain.index(lane)
                part = _part(part, lines[row], stations[row][k : k + 2], cut=len(names[lane.id]) > 1)
                part = replace(part, **_neighbors(row, stations, k, beside, plain, names))
            found.append(part)
    return found


def _stations(lines: Sequence[Polyline], beside: Sequence[Beside]) -> list[list[float]]:
    """Return where each line is cut, its ends included: at cuts of those beside it, until there are no more."""
    cuts = [[0.0, line.length_m] for line in lines]
    for _ in lines:
        added = False
        for pair in beside:
            for s in cuts[pair.route]:
                if pair.s_m[0] - 1e-3 <= s <= pair.s_m[-1] + 1e-3:
                    there = float(np.interp(s, pair.s_m, pair.other_s_m))
                    if min(abs(there - c) for c in cuts[pair.other]) > ALIGNED_M:
                        cuts[pair.other].append(there)
                        added = True
        if not added:
            break
    return [sorted(at) for at in cuts]


def _part(lane: MapLane, line: Polyline, span_m: Sequence[float], *, cut: bool) -> MapLane:
    """Return what lies between two stations of a lane that was cut."""
    if not cut:
        return lane
    points = line.part(span_m[0], span_m[1])
    ahead = span_m[0] + Polyline(points).s_m
    share = Polyline(lane.points_m).s_m
    return replace(lane, points_m=points, width_m=np.interp(ahead, share, lane.width_m))


def _neighbors(
    row: int,
    stations: Sequence[Sequence[float]],
    k: int,
    beside: Sequence[Beside],
    plain: Sequence[MapLane],
    names: Mapping[str, Sequence[str]],
) -> dict[str, str]:
    """Return the parts of other lanes beside the middle of part k of a lane; who drives the other way is to the left."""
    middle = (stations[row][k] + stations[row][k + 1]) / 2
    found = {}
    for pair in beside:
        if pair.route == row and pair.s_m[0] <= middle <= pair.s_m[-1]:
            left = float(np.interp(middle, pair.s_m, pair.aside_m)) > 0
            there = float(np.interp(middle, pair.s_m, pair.other_s_m))
            at = int(np.searchsorted(stations[pair.other], there)) - 1
            parts = names[plain[pair.other].id]
            name = parts[min(max(at, 0), len(parts) - 1)]
            if pair.same_way:
                found["left_lane" if left else "right_lane"] = name
            elif left:
                found["opposite"] = name
    return found
