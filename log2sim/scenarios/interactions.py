"""Tags of two agents: following, cut-ins, overtaking, crossing paths and near misses.

The other agent is the one whose path and lane count: where it drives in the scenario, so that bends of the road need no map.
Terms as in ISO 34502:2022 (cut-in, cut-out, deceleration), ISO 34504:2024 and UN Regulation 157.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from log2sim.datatypes import Tag
from log2sim.geometry import Array, box_corners_bev, wrap_angle
from log2sim.scenarios import traffic as motion
from log2sim.scenarios.criticality import deceleration_to_avoid, encroachment_time, time_headway, time_to_collision
from log2sim.scenarios.maneuvers import BREAK, MOVING_MPS, lateral_extent, tag_of
from log2sim.simulation.metrics.collisions import BoxTracks
from log2sim.simulation.metrics.conflicts import post_encroachment_times, time_to_touch
from log2sim.simulation.prediction.motion_table import TICK_S

FOLLOWING_S = 3.0
"""Time headway up to which a vehicle follows another (HCM 2016, percent time spent following)."""

LEADING_S = 4.0
"""Time headway up to which a vehicle that changes lanes cuts in or out: with more, drivers choose their speed freely."""

APPROACHING_MPS, APPROACHING_S = 2.0, 10.0
"""Closing speed and time to collision of who approaches another."""

CROSSING_S = 5.0
"""Two agents whose paths cross are paired where the second is there within this time after the first."""

NEAR_TTC_S, NEAR_PET_S, NEAR_DRAC_MPS2 = 1.5, 1.0, 3.35
"""Limits of near misses: TTC of Hyden (1987), PET of Allen, Shin and Cooper (1978), DRAC of Archer (2005)."""

JOINING_RAD = np.radians(25.0)
"""An agent that enters a lane at a larger angle turns into it; in lane changes the angle is below 10 degrees."""

ONCOMING_RAD = np.radians(135.0)
MOST_PER_TICK_M = 5.0  # by which one gets ahead of another within a tick: 50 m/s
WINDOW = round(4.0 / TICK_S)  # ticks around a lane's edge in which a lane change is looked at


def pair_tags(traffic: motion.Traffic) -> Iterator[Tag]:
    """Find what agents do to each other."""
    for r in range(len(traffic.ids)):
        beside = traffic.beside(r)
        if beside is None:
            continue
        unseen = traffic.beside_unseen(r, beside)
        for o in np.flatnonzero(np.isfinite(beside.ahead_m).any(axis=1)).tolist():
            yield from _following(traffic, beside, r, o)
            if traffic.wheeled[o] and not traffic.table.agents[o].static:
                yield from _lane_changes(traffic, unseen, r, o)
                yield from _overtaking(traffic, unseen, r, o)
                yield from _oncoming(traffic, beside, r, o)
            elif traffic.table.group[o] == "pedestrian":
                yield from _stepping_out(traffic, beside, r, o)
    yield from _crossings(traffic)


def lane_measures(
    traffic: motion.Traffic, b: motion.Beside, r: int, o: motion.Index, n: motion.Index
) -> dict[str, Array]:
    """Return gap, relative speed and measures of criticality (N,) of agent `r` behind others (N,) at ticks (N,)."""
    pace = traffic.continued.speed_mps
    gap, own, speed = b.gap_m[o, n], pace[r, n], pace[o, n] * np.cos(b.turn_rad[o, n])
    return {
        "gap_m": gap, "relative_speed_mps": -(own - speed), "ttc_s": time_to_collision(gap, own - speed),
        "time_headway_s": time_headway(gap, own), "drac_mps2": deceleration_to_avoid(gap, own - speed),
    }  # fmt: skip


def _at(measures: dict[str, Array], n: int) -> dict[str, float]:
    return {name: float(values[n]) for name, values in measures.items()}


def _following(traffic: motion.Traffic, b: motion.Beside, r: int, o: int) -> Iterator[Tag]:
    """Find when `r` follows or approaches `o`, and where that is a near miss."""
    if not (traffic.wheeled[o] and (b.leader == o).any()):
        return
    measures = lane_measures(traffic, b, r, np.full(len(b.leader), o), np.arange(len(b.leader)))
    gap, relative, ttc, headway, drac = measures.values()
    own, closing = traffic.speed_mps[r], -relative
    ahead = (b.leader == o) & (own >= MOVING_MPS) & (gap > 0)
    sigma_m, sigma_mps = (np.hypot(s[r], s[o]) for s in (traffic.sigma_m, traffic.sigma_speed_mps))

    def within(half_m: float, n: int) -> float:
        return motion.probability_above(half_m - np.abs(b.aside_m[o, n]), 0.0, b.sigma_m[o, n])

    follows = ahead & (np.abs(closing) < APPROACHING_MPS) & (headway < FOLLOWING_S) & (own + relative > 1.0)
    for i, j in motion.runs(follows, round(1.0 / TICK_S), BREAK):
        n, lasts_s = i + int(np.argmin(headway[i : j + 1])), (j - i) * TICK_S
        yield tag_of(traffic, "following", r, (i, n, j), within(b.half_m, n), o, duration_s=lasts_s, **_at(measures, n))
    for i, j in motion.runs(ahead & (closing >= APPROACHING_MPS) & (ttc < APPROACHING_S), round(0.5 / TICK_S), BREAK):
        n = i + int(np.argmin(ttc[i : j + 1]))
        sure = within(b.half_m, n) * motion.probability_above(closing[n], 0.0, sigma_mps[n])
        yield tag_of(traffic, "approaching", r, (i, n, j), sure, o, **_at(measures, n))
    width = traffic.table.size_m[[r, o], 1].sum() / 2
    on_course = np.abs(b.aside_m[o]) < width
    near = ahead & on_course & (closing > 1.0) & ((ttc < NEAR_TTC_S) | (drac > NEAR_DRAC_MPS2))
    for i, j in motion.runs(near, 2):
        n, peak = i + int(np.argmin(ttc[i : j + 1])), i + int(np.argmax(drac[i : j + 1]))
        # Of gap / closing speed and of DRAC, by the errors of both.
        sigma_ttc = np.hypot(sigma_m[n] / closing[n], gap[n] * sigma_mps[n] / closing[n] ** 2)
        sigma_drac = drac[peak] * np.hypot(2 * sigma_mps[n] / closing[peak], sigma_m[n] / max(gap[peak], 0.1))
        by_drac = motion.probability_above(drac[peak], NEAR_DRAC_MPS2, sigma_drac)
        sure = max(motion.probability_above(-ttc[n], -NEAR_TTC_S, sigma_ttc), by_drac) * within(width, n)
        yield tag_of(traffic, "near_miss", r, (i, n, j), sure, o, **{**_at(measures, n), "drac_mps2": drac[peak]})


def _lane_changes(traffic: motion.Traffic, b: motion.Beside, r: int, o: int) -> Iterator[Tag]:
    """Find when `o` comes into the lane of `r` ahead of it, or leaves it there; also within `UNSEEN_S` before and after both were seen."""
    on = traffic.continued
    known = np.isfinite(b.aside_m[o]) & (b.ahead_m[o] > 0)
    inside = b.in_lane[o]
    off = np.abs(b.aside_m[o])
    for n in (np.flatnonzero(inside[1:] != inside[:-1]) + 1).tolist():
        enters = bool(inside[n])
        beyond = ~(off[:n] < b.half_m) if enters else ~(off[:n] > b.half_m)
        crossing = int(np.flatnonzero(beyond)[-1]) + 1 if beyond.any() else 0
        first, last = max(crossing - WINDOW, 0), min(max(crossing, n) + WINDOW, len(known) - 1)
        if crossing == 0 or not known[crossing - 1 : n + 1].all() or not b.same_way[o, n if enters else crossing - 1]:
            continue
        while not known[first]:
            first += 1
        while not known[last]:
            last -= 1
        begin, end, lateral = lateral_extent(b.aside_m[o, first : last + 1], crossing - first)
        begin, end = first + begin, first + end
        measures = _at(lane_measures(traffic, b, r, np.array([o]), np.array([crossing])), 0)
        span = slice(crossing - 1, crossing + WINDOW) if enters else slice(max(crossing - WINDOW, 0), crossing + 1)
        led = b.leader[span] == o
        if on.speed_mps[[r, o], crossing].min() < MOVING_MPS or not led.any():
            continue
        if measures["time_headway_s"] > LEADING_S:
            continue
        # Who joins turns itself; who was there before the other turned in behind it does not.
        turn = abs(motion.turned(on.course_rad[o], begin, end))
        joins = enters and np.abs(b.turn_rad[o, begin : crossing + 1]).max() > JOINING_RAD and turn > JOINING_RAD
        if not joins and (turn > JOINING_RAD or not _is_change_of(traffic, b, r, o, crossing)):
            continue
        before, after = np.arange(begin, crossing + 1), np.arange(crossing, end + 1)
        outer, inner = (before, after) if enters else (after, before)
        beyond, within = outer[np.nanargmax(off[outer])], inner[np.nanargmin(off[inner])]
        sure = motion.probability_above(off[beyond], b.half_m, b.sigma_m[o, beyond])
        sure *= motion.probability_above(-off[within], -b.half_m, b.sigma_m[o, within])
        sure *= motion.probability_above(b.ahead_m[o, crossing], 0.0, np.hypot(*on.sigma_m[[r, o], crossing]))
        tag = "merging" if joins else "cut_in" if enters else "cut_out"
        yield tag_of(traffic, tag, o, (begin, crossing, end), sure, r, lateral_speed_mps=abs(lateral), duration_s=(end - begin) * TICK_S,
                     side=np.sign(-lateral if enters else lateral), **measures)  # fmt: skip


def _is_change_of(traffic: motion.Traffic, b: motion.Beside, r: int, o: int, n: int) -> bool:
    """Return whether it is `o` that crosses the edge of a lane at a tick, and not the path of `r` that does, now or on its way there."""
    found = traffic.path(r)
    if found is None:
        return False
    seen = np.flatnonzero(np.isfinite(traffic.drift_mps[[r, o]]).all(axis=0) & np.isfinite(b.ahead_m[o]))
    if not len(seen):
        return False
    n = int(seen[np.abs(seen - n).argmin()])
    arrives = found.station_m <= found.station_m[n] + b.ahead_m[o, n]  # False for NaN
    last = max(int(np.flatnonzero(arrives)[-1]), n)
    own = np.abs(traffic.drift_mps[r, n : last + 1])
    return bool(np.nanmax(own, initial=0.0) < motion.KEEPING_MPS and not abs(traffic.drift_mps[o, n]) <= own[-1])


def _overtaking(traffic: motion.Traffic, b: motion.Beside, r: int, o: int) -> Iterator[Tag]:
    """Find when `o` passes `r`: from behind its rear to ahead of its front, while both go the same way.

    For `UNSEEN_S` before and after both were seen their speeds are supposed to be those of then.
    """
    on, reach = traffic.continued, (traffic.table.size_m[r, 0] + traffic.table.size_m[o, 0]) / 2
    slower, faster, sigma = on.speed_mps[r], on.speed_mps[o] - on.speed_mps[r], np.hypot(on.sigma_m[r], on.sigma_m[o])
    ahead, aside, same = b.ahead_m[o], b.aside_m[o], b.same_way[o]
    passed = motion.latched(ahead > reach, ahead < -reach, np.ones(len(ahead), dtype=bool))
    for n in (np.flatnonzero(passed[1:] & ~passed[:-1]) + 1).tolist():
        start = int(np.flatnonzero(ahead[:n] < -reach)[-1])
        part = slice(start, n + 1)
        if not (np.isfinite(ahead[part]).all() and same[part].all() and (slower[part] >= MOVING_MPS).all()):
            continue
        # Two lanes beside, since farther is another carriageway; and where the path of `r` jumps, nobody passes.
        if np.abs(aside[part]).max() > 4.5 * b.half_m or np.diff(ahead[part]).max() > MOST_PER_TICK_M:
            continue
        middle = start + int(np.argmin(np.abs(ahead[part])))
        sure = motion.probability_above(-ahead[start], 0.0, sigma[start])
        sure *= motion.probability_above(ahead[n], 0.0, sigma[n])
        clearance = abs(aside[middle]) - traffic.table.size_m[[r, o], 1].sum() / 2
        yield tag_of(traffic, "overtaking", o, (start, middle, n), sure, r, lateral_gap_m=clearance, side=np.sign(aside[middle]),
                     relative_speed_mps=faster[middle], duration_s=(n - start) * TICK_S)  # fmt: skip


def _oncoming(traffic: motion.Traffic, b: motion.Beside, r: int, o: int) -> Iterator[Tag]:
    """Find when `o` comes toward `r` where `r` will drive, within `CROSSING_S`."""
    width = traffic.table.size_m[[r, o], 1].sum() / 2 - motion.SIDE_M
    speed, own = traffic.speed_mps[o], traffic.speed_mps[r]
    ttc = time_to_collision(b.gap_m[o], own + speed)
    state = (np.abs(b.turn_rad[o]) > ONCOMING_RAD) & (np.abs(b.aside_m[o]) < width) & (b.ahead_m[o] > 0)
    state &= ttc < CROSSING_S
    for i, j in motion.runs(state & (speed > MOVING_MPS) & (own > MOVING_MPS), round(0.3 / TICK_S), BREAK):
        n = i + int(np.argmin(np.where(ttc[i : j + 1] > 0, ttc[i : j + 1], np.inf)))
        sure = motion.probability_above(width - np.abs(b.aside_m[o, i : j + 1].min()), 0.0, b.sigma_m[o, n])
        yield tag_of(traffic, "oncoming_in_lane", o, (i, n, j), sure, r, gap_m=b.gap_m[o, n], ttc_s=ttc[n], relative_speed_mps=own[n] + speed[n], overlap_m=width + motion.SIDE_M - abs(b.aside_m[o, n]))  # fmt: skip


def _stepping_out(traffic: motion.Traffic, b: motion.Beside, r: int, o: int) -> Iterator[Tag]:
    """Find when a pedestrian who was hidden from `r` comes into its lane ahead of it."""
    inside = b.in_lane[o]
    for n in (np.flatnonzero(inside[1:] & ~inside[:-1]) + 1).tolist():
        speed = traffic.speed_mps[r, n]
        arrives_s = float(time_headway(b.ahead_m[o, n], speed))
        known = np.isfinite(b.ahead_m[o, n - 1 : n + 1]).all() and b.ahead_m[o, n] > 0
        if not known or speed < MOVING_MPS or arrives_s >= CROSSING_S:
            continue
        ticks = np.arange(max(n - WINDOW, 0), n + 1)
        ticks = ticks[np.isfinite(traffic.place_m[r, ticks])]
        present = ticks[np.isfinite(traffic.place_m[o, ticks])]
        first = int(present[0])
        places = traffic.place_m[o]
        velocity = (places[n] - places[first]) / (n - first) if n > first else 0.0
        # Before it was seen first it walked the same way.
        place = np.where(ticks < first, places[first] + (ticks - first) * velocity, places[ticks])
        hidden = _hidden(traffic, traffic.place_m[r, ticks], place, ticks, (r, o))
        if not hidden.any() or hidden[-1]:
            continue
        seen = int(ticks[np.flatnonzero(hidden)[-1]]) + 1
        sure = motion.probability_above(b.half_m + 0.5 - np.abs(b.aside_m[o, n]), 0.0, b.sigma_m[o, n])
        yield tag_of(traffic, "stepping_out", o, (seen, n, n), sure, r, visible_s=(n - seen) * TICK_S, speed_mps=traffic.speed_mps[o, n],
                     ttc_s=arrives_s, gap_m=b.gap_m[o, n])  # fmt: skip


def _hidden(traffic: motion.Traffic, eye: Array, place: Array, ticks: Array, pair: tuple[int, int]) -> Array:
    """Return whether the line of sight (N,) from an eye to a place crosses the box of a third road user."""
    import shapely

    t = traffic.table
    hidden = np.zeros(len(ticks), dtype=bool)
    ends = np.stack([eye, place], axis=1)
    sight = shapely.linestrings(np.stack([ends.real, ends.imag], axis=2))
    for k in range(len(traffic.ids)):
        if k in pair or not traffic.wheeled[k] or t.size_m[k, 2] <= 1.0:
            continue
        there = np.flatnonzero(t.present[k, ticks])
        if len(there):  # half as wide as it is, since who is hidden in part is seen
            rows = ticks[there]
            corners = box_corners_bev(t.xy_m[k, rows], t.size_m[k, 0], t.size_m[k, 1] / 2, t.yaw_rad[k, rows])
            hidden[there] |= shapely.intersects(sight[there], shapely.polygons(corners))
    return hidden


def _crossings(traffic: motion.Traffic) -> Iterator[Tag]:
    """Find whose paths cross, who turns across the path of oncoming traffic, and near misses there."""
    t, on = traffic.table, traffic.continued
    height = t.center_m[..., 2].copy()
    for k in np.flatnonzero(t.present.any(axis=1)).tolist():
        height[k, ~t.present[k]] = np.median(height[k, t.present[k]])
    speed = np.where(t.present, t.speed_mps, on.speed_mps)
    x, y, z, yaw, pace = (c.T for c in (on.place_m.real, on.place_m.imag, height, on.yaw_rad, speed))
    found = post_encroachment_times(BoxTracks(x, y, z, yaw, pace, t.size_m), TICK_S)
    last = len(t.t_s) - 1
    for a, c, left, came in zip(*(v.tolist() for v in (found.first, found.second, found.left_row, found.came_row))):
        pet = (came - left) * TICK_S
        i, j = min(int(left), last), min(int(np.ceil(came)), last)
        speed_a, speed_c = on.speed_mps[a, i], on.speed_mps[c, j]
        if pet > CROSSING_S or min(speed_a, speed_c) < 0.5 or not (traffic.wheeled[a] or traffic.wheeled[c]):
            continue
        angle = float(abs(wrap_angle(on.course_rad[a, i] - on.course_rad[c, j])))
        if not motion.SAME_WAY_RAD <= angle <= np.pi - JOINING_RAD:
            continue
        begin, ttc, touch = _planar_ttc(traffic, a, c, j)
        sigma_s = float(np.hypot(on.sigma_m[a, i] / speed_a, on.sigma_m[c, j] / speed_c))
        sure = motion.probability_above(CROSSING_S - pet, 0.0, sigma_s)
        way_m = t.size_m[a, 0] + t.size_m[c, 1]
        measures = {
            "pet_s": pet, "angle_rad": angle, "speed_mps": speed_a, "other_speed_mps": speed_c, "ttc_s": ttc,
            "encroachment_time_s": float(encroachment_time(np.asarray(speed_a), np.asarray(way_m))),
        }  # fmt: skip
        yield tag_of(traffic, "crossing_path", a, (min(begin, i), i, j), sure, c, **measures)
        for one, two, n in ((a, c, i), (c, a, j)):
            if traffic.wheeled[one] and traffic.wheeled[two] and _turns_across(traffic, one, two, n, begin):
                yield tag_of(traffic, "turning_across", one, (min(begin, i), n, j), sure, two, **measures)
        if pet < NEAR_PET_S or ttc < NEAR_TTC_S:
            near = max(motion.probability_above(by_s, 0.0, sigma_s) for by_s in (NEAR_PET_S - pet, NEAR_TTC_S - ttc))
            yield tag_of(traffic, "near_miss", a, (min(touch, i), i, j), near, c, **measures)


def _planar_ttc(traffic: motion.Traffic, a: int, c: int, until: int) -> tuple[int, float, int]:
    """Return the first tick within `CROSSING_S` before one at which both are there, the least TTC in the plane since then, and when."""
    t = traffic.table
    ticks = np.arange(max(until - round(2 * CROSSING_S / TICK_S), 0), until + 1)
    ticks = ticks[t.present[a, ticks] & t.present[c, ticks]]
    if not len(ticks):
        return until, np.inf, until
    apart = traffic.place_m[c, ticks] - traffic.place_m[a, ticks]
    velocity = [traffic.speed_mps[k, ticks] * np.exp(1j * traffic.course_rad[k, ticks]) for k in (a, c)]
    rate = velocity[1] - velocity[0]
    size = [np.broadcast_to(t.size_m[k, :2], (len(ticks), 2)) for k in (a, c)]
    times = time_to_touch(apart.real, apart.imag, rate.real, rate.imag, t.yaw_rad[a, ticks], t.yaw_rad[c, ticks], *size)
    n = int(np.argmin(times))
    return int(ticks[0]), float(times[n]), int(ticks[n])


def _turns_across(traffic: motion.Traffic, one: int, two: int, n: int, begin: int) -> bool:
    """Return whether `one`, which is at the crossing at tick `n`, turned before the oncoming `two`."""
    course = traffic.course_rad
    known = np.flatnonzero(np.isfinite(course[one, begin : n + 1]) & np.isfinite(course[two, begin : n + 1])) + begin
    if not len(known):
        return False
    came = abs(wrap_angle(course[one, known] - course[two, known]))
    first = int(known[np.argmax(came)])
    straight = abs(float(wrap_angle(course[two, known[-1]] - course[two, first]))) < np.radians(30)
    turns = abs(float(wrap_angle(course[one, n] - course[one, first]))) > np.radians(25)
    return bool(came.max() > ONCOMING_RAD and straight and turns)
