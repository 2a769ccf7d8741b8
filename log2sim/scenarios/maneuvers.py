"""Tags of single agents: lanes, lane changes, turns, starting, stopping, standing and hard braking.

Terms as in ISO 34504:2024 (scenario categorization, activities of road users) and de Gelder, Manders, Grappiolo, Paardekooper,
Op den Camp, De Schutter, "Real-world scenario mining for the assessment of automated vehicles" (ITSC 2020).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from log2sim.datatypes import STANDSTILL_MPS, Tag
from log2sim.geometry import Array, wrap_angle
from log2sim.scenarios.traffic import LANE_CHANGE_S, Mask, Traffic, latched, probability_above, runs, turned
from log2sim.simulation.driver_paths import STOP_STATES, light_ahead
from log2sim.simulation.prediction.motion_table import TICK_S

COMFORTABLE_MPS2 = 3.4
"""Deceleration that most drivers find comfortable (AASHTO, "Green Book" 2018, 3.2.2)."""

MAX_BRAKING_MPS2 = 11.0
"""No brakes decelerate harder on tires for the road (ABS tests on dry asphalt: 9 to 11 m/s2)."""

MOVING_MPS = 2.0
"""From this speed on an agent counts as moving: faster than people walk, and than smoothed speeds of standing agents err."""

TURN_RAD, BACK_RAD = np.radians(60.0), np.radians(150.0)
"""Turns at junctions, and back to where the agent came from; bends of roads are wider than `TURN_WITHIN_M`."""

TURN_WITHIN_M = 40.0
"""Within which a vehicle turns at a junction: a quarter of a circle of 25 m."""

LEAST_RADIUS_M = 1.5
"""Smaller turning circles are of boxes of standing agents and of headings that flip, not driven."""

LEAST_SHIFT_M = 1.0
"""A lane change goes at least so far to the side: where lanes of a map overlap, agents that go straight on leave one for another."""

BREAK = round(0.5 / TICK_S)
"""Ticks that an activity may be interrupted for."""

LATERAL_MPS = 0.2
"""Lateral speed at which a lane change begins and ends: drivers who keep a lane are slower (de Gelder et al. 2020)."""

CROSSWALK_M = 8.0
"""How far ahead of its front the crosswalk is that an agent stands at."""


def single_tags(traffic: Traffic) -> Iterator[Tag]:
    """Find what each agent does by itself."""
    moves = np.nan_to_num(traffic.speed_mps).max(axis=1, initial=0.0) >= MOVING_MPS
    lane_of = traffic.lane_of if traffic.lanes else None
    for k in range(len(traffic.ids)):
        walks = traffic.table.group[k] == "pedestrian"
        if traffic.wheeled[k] and lane_of is not None:
            yield from _lanes(traffic, k)
        if moves[k] and (traffic.wheeled[k] or walks):
            yield from _starts_and_stops(traffic, k)
        if moves[k] and traffic.wheeled[k]:
            yield from _turns(traffic, k)
            yield from _hard_braking(traffic, k)


def tag_of(traffic: Traffic, tag: str, agent: int, span: tuple[int, int, int], probability: float, other: int | None = None,
           **quantities: float) -> Tag:  # fmt: skip
    """Make a tag of first, defining and last tick; its probability is times that of the agents, and infinite quantities are left out."""
    start, t, end = (round(float(traffic.table.t_s[n]), 3) for n in span)
    sure = traffic.confidence[agent] * (1.0 if other is None else traffic.confidence[other])
    known = {name: round(float(value), 4) for name, value in quantities.items() if np.isfinite(value)}
    return Tag(
        tag, traffic.ids[agent], start, t, end, round(float(np.clip(probability * sure, 0.0, 1.0)), 4),
        None if other is None else traffic.ids[other], None, known,
    )  # fmt: skip


def _lanes(traffic: Traffic, k: int) -> Iterator[Tag]:
    """Find in which lanes an agent is, and when it changes between lanes beside each other."""
    lane_of = traffic.lane_of[k]
    changes = np.flatnonzero(np.diff(lane_of)) + 1
    edges = [0, *changes.tolist(), len(lane_of)]
    stays = [(i, j - 1, int(lane_of[i])) for i, j in itertools.pairwise(edges) if lane_of[i] >= 0]
    for i, j, lane in stays:
        at = _in_lane(traffic, k, lane, i, j)
        inside = probability_above(np.median(at[1] - np.abs(at[0])), 0.0, np.median(traffic.sigma_m[k, i : j + 1]))
        known = traffic.lanes[lane][0]
        yield replace(tag_of(traffic, "in_lane", k, (i, i, j), inside * known.confidence), lane=known.id)
    # Beyond 1 s an agent is in a lane; who crosses an edge for less keeps to its own.
    kept = [stay for stay in stays if (stay[1] - stay[0]) * TICK_S >= 1.0]
    for (_, i, one), (j, _, two) in itertools.pairwise(kept):
        if one != two and (j - i) * TICK_S < LANE_CHANGE_S and _are_beside(traffic, one, two):
            yield from _change_between(traffic, k, one, two, (i, j))


def _are_beside(traffic: Traffic, one: int, two: int) -> bool:
    """Return whether two lanes lie side by side, or one goes on where the other's neighbor ends."""
    a, b = traffic.lanes[one][0], traffic.lanes[two][0]
    besides = [{lane.left_lane, lane.right_lane, lane.opposite} for lane in (a, b)]
    if b.id in besides[0] or a.id in besides[1]:
        return True
    if b.id in a.successors or a.id in b.successors:
        return False
    return any(beside & {*lane.predecessors, *lane.successors} for beside, lane in zip(besides, (b, a)))


def _change_between(traffic: Traffic, k: int, one: int, two: int, edge: tuple[int, int]) -> Iterator[Tag]:
    """Describe a lane change: it begins and ends where the lateral speed does, and crosses where the center does."""
    crossing, reach = (edge[0] + edge[1] + 1) // 2, round(LANE_CHANGE_S / TICK_S)
    first, last = max(crossing - reach, 0), min(crossing + reach, len(traffic.table.t_s) - 1)
    aside, _ = _in_lane(traffic, k, two, first, last)
    begin, end, lateral = lateral_extent(aside, crossing - first)
    before = _in_lane(traffic, k, one, max(edge[0] - 5, 0), edge[0])
    after = _in_lane(traffic, k, two, edge[1], min(edge[1] + 5, len(traffic.table.t_s) - 1))
    sigma = traffic.sigma_m[k, crossing]
    certain = min(probability_above(np.max(half - np.abs(off)), 0.0, sigma) for off, half in (before, after))
    lane = traffic.lanes[two][0]
    certain *= lane.confidence * traffic.lanes[one][0].confidence
    if abs(aside[end] - aside[begin]) < LEAST_SHIFT_M:
        return
    span = (first + begin, crossing, first + end)
    yield replace(
        tag_of(
            traffic, "lane_change", k, span, certain, lateral_speed_mps=lateral, speed_mps=traffic.speed_mps[k, crossing],
            duration_s=(end - begin) * TICK_S, lateral_m=aside[end] - aside[begin],
        ),
        lane=lane.id,
    )  # fmt: skip


def _in_lane(traffic: Traffic, k: int, lane: int, first: int, last: int) -> tuple[Array, Array]:
    """Return how far to the left of a lane's middle an agent is, and half the lane's width, at ticks from one to another."""
    place = traffic.place_m[k, first : last + 1]
    known, line = traffic.lanes[lane]
    xy = np.nan_to_num(np.column_stack([place.real, place.imag]))
    at = line.project(xy, np.nan_to_num(traffic.course_rad[k, first : last + 1]))
    share = at.s_m / max(line.length_m, 1e-9)
    width = np.interp(share, np.linspace(0, 1, len(known.width_m)), known.width_m)
    return np.where(np.isfinite(place), at.aside_m, np.nan), width / 2


def lateral_extent(aside_m: Array, crossing: int) -> tuple[int, int, float]:
    """Return the first and last of the ticks about `crossing` at which an offset (T,) changes as fast as in a lane change, and its rate then."""
    lateral = np.gradient(aside_m) / TICK_S if len(aside_m) > 1 else np.zeros(1)
    sign = np.sign(lateral[crossing]) or 1.0
    slow = ~(lateral * sign > LATERAL_MPS)  # where it is not known, too
    before, after = np.flatnonzero(slow[: crossing + 1]), np.flatnonzero(slow[crossing:])
    begin = int(before[-1]) + 1 if len(before) else 0
    end = crossing + int(after[0]) - 1 if len(after) else len(slow) - 1
    return min(begin, crossing), max(end, crossing), float(lateral[crossing])


def _starts_and_stops(traffic: Traffic, k: int) -> Iterator[Tag]:
    """Find when an agent starts, brakes to standstill and stands."""
    speed, sigma = traffic.speed_mps[k], traffic.sigma_speed_mps[k]
    stands = latched(speed <= STANDSTILL_MPS, speed > 1.0, speed <= STANDSTILL_MPS) & np.isfinite(speed)
    walks = traffic.table.group[k] == "pedestrian"
    moving = 0.8 if walks else MOVING_MPS
    for i, last in runs(stands, round(1.0 / TICK_S)):
        j = i + int(np.flatnonzero(~(speed[i : last + 1] > STANDSTILL_MPS))[-1])
        place = traffic.place_m[k, i : j + 1]
        still = probability_above(1.0, float(np.median(speed[i : j + 1])), float(np.median(sigma[i : j + 1])))
        yield tag_of(traffic, "standing", k, (i, i, j), still, duration_s=(j - i) * TICK_S)
        yield from _waits(traffic, k, (i, i, j), still, place[len(place) // 2])
        # Before it stands it slowed down from when it was last not slowing, and likewise after.
        slowing = np.flatnonzero(~(traffic.accel_mps2[k, :i] < -0.1)) if i else np.zeros(0, dtype=np.intp)
        begin = int(slowing[-1]) + 1 if len(slowing) else 0
        if begin < i and speed[begin] >= moving:
            sure = probability_above(speed[begin], STANDSTILL_MPS, sigma[begin])
            yield tag_of(traffic, "stopping", k, (begin, i, i), sure, speed_mps=speed[begin], deceleration_mps2=-np.nanmin(traffic.accel_mps2[k, begin : i + 1]), duration_s=(i - begin) * TICK_S)  # fmt: skip
        rising = np.flatnonzero(~(traffic.accel_mps2[k, j + 1 :] > 0.1))
        end = j + int(rising[0]) if len(rising) else len(speed) - 1
        if end > j and speed[end] >= moving:
            sure = probability_above(speed[end], STANDSTILL_MPS, sigma[end])
            yield tag_of(traffic, "starting", k, (j, j, end), sure, speed_mps=speed[end], acceleration_mps2=np.nanmax(traffic.accel_mps2[k, j : end + 1]), duration_s=(end - j) * TICK_S)  # fmt: skip


def _waits(traffic: Traffic, k: int, span: tuple[int, int, int], still: float, place: complex) -> Iterator[Tag]:
    """Find what an agent that stands waits at: a light that faces it and shows red, or a crosswalk."""
    if not traffic.wheeled[k]:
        return
    scenario, turn = traffic.scenario, np.exp(-1j * traffic.course_rad[k, span[1]])
    front_m = traffic.table.size_m[k, 0] / 2
    times = traffic.table.t_s[span[0] : span[2] + 1]
    for signal in scenario.signals:
        way = light_ahead(signal, place + front_m / turn, -float(np.angle(turn)))
        red = np.isin(signal.at(times), STOP_STATES)
        if way is not None and red.any():
            n = span[0] + np.flatnonzero(red)
            yield tag_of(traffic, "standing_at_light", k, (int(n[0]), int(n[0]), int(n[-1])), still * signal.confidence, gap_m=way[0], duration_s=(n[-1] - n[0]) * TICK_S)  # fmt: skip
            break
    for marking in scenario.map_features.markings if scenario.map_features else ():
        if marking.kind != "crosswalk":
            continue
        corner = (marking.points_m[:, 0] + 1j * marking.points_m[:, 1] - place) * turn
        gap_m = corner.real.min() - front_m
        if -1.0 < gap_m < CROSSWALK_M and corner.imag.min() < 1.0 and corner.imag.max() > -1.0:
            yield tag_of(traffic, "standing_at_crosswalk", k, span, still * marking.confidence, gap_m=gap_m, duration_s=(span[2] - span[0]) * TICK_S)  # fmt: skip
            break


def _turns(traffic: Traffic, k: int) -> Iterator[Tag]:
    """Find turns at junctions and back, where the course turns on a short way."""
    course, speed = traffic.course_rad[k], np.nan_to_num(traffic.speed_mps[k])
    known = np.isfinite(course) & (speed > 0.5)
    step = np.zeros(len(course))
    step[1:] = np.where(known[1:] & known[:-1], wrap_angle(np.diff(np.nan_to_num(course))), 0.0)
    bend = np.divide(step, speed * TICK_S, out=np.zeros_like(step), where=speed > 0.5)
    for sign in (1.0, -1.0):
        # Turning on circles of less than 50 m, with breaks of up to a second.
        tight = bend * sign > 1.0 / 50.0
        gaps = runs(~tight)
        for i, j in gaps:
            if i > 0 and j < len(tight) - 1 and (j - i + 1) * TICK_S <= 1.0:
                tight[i : j + 1] = True
        for i, j in runs(tight):
            angle = turned(course, max(i - 1, 0), j)
            way_m = float(speed[i : j + 1].sum() * TICK_S)
            radius_m = way_m / abs(angle) if angle else np.inf
            within_m = TURN_WITHIN_M * max(1.0, abs(angle) / (np.pi / 2))  # False where the angle is NaN
            if not (radius_m >= LEAST_RADIUS_M and abs(angle) >= TURN_RAD and way_m <= within_m):
                continue
            tag, limit = ("u_turn", BACK_RAD) if abs(angle) >= BACK_RAD else ("turning", TURN_RAD)
            sigma = np.sqrt(2.0) * np.median(traffic.sigma_m[k, i : j + 1]) / max(way_m / 2, 1.0)
            yield tag_of(traffic, tag, k, (i, (i + j) // 2, j), probability_above(abs(angle), limit, sigma), angle_rad=angle, radius_m=radius_m, speed_mps=speed[i : j + 1].min())  # fmt: skip


def _hard_braking(traffic: Traffic, k: int) -> Iterator[Tag]:
    """Find where an agent decelerates by more than `COMFORTABLE_MPS2` for at least 0.5 s."""
    accel, speed = traffic.accel_mps2[k], traffic.speed_mps[k]
    hard: Mask = (accel < -COMFORTABLE_MPS2) & np.isfinite(accel)
    for i, j in runs(hard, round(0.5 / TICK_S) + 1, BREAK):
        n = i + int(np.argmin(accel[i : j + 1]))
        # It is the log that jumps where no brakes are as hard, where the speed is soon what it was, and where it was lower just before.
        middle = (speed[i] + speed[j]) / 2
        before, after = speed[max(i - BREAK, 0) : i], speed[j + 1 : j + 1 + BREAK]
        jumps = (np.nanmedian(before) < middle) if np.isfinite(before).any() else False
        jumps |= (np.nanmedian(after) > middle) if np.isfinite(after).any() else False
        if -accel[n] > MAX_BRAKING_MPS2 or jumps or speed[i] < MOVING_MPS:
            continue
        # Two speeds half a second apart, whose errors are independent, tell the deceleration.
        sigma = np.sqrt(2.0) * traffic.sigma_speed_mps[k, n] / max((j - i) * TICK_S, 0.5)
        yield tag_of(traffic, "hard_braking", k, (i, n, j), probability_above(-accel[n], COMFORTABLE_MPS2, sigma), deceleration_mps2=-accel[n], speed_mps=speed[i], speed_change_mps=speed[i] - speed[j], duration_s=(j - i) * TICK_S)  # fmt: skip
