"""Precision and recall of tags in worlds whose maneuvers are known in closed form.

    python tools/bench.py tags [--worlds 40] [--noise 0.2] [--rendered SCENARIO.json TRUTH.json ...]

Random traffic on straight and bent roads with three lanes, on both sides of the road, at 2 to 20 Hz, with and without a map, and
junctions with turns, crossings and people who step out between parked cars. The truth comes from the stations and lanes of the
vehicles on their road alone. Events whose quantities are within a tenth of the limits that define them count neither way.
"""

from __future__ import annotations

import itertools
import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from entry import parser_of

from log2sim.datatypes import Agent, MapFeatures, MapLane, Scenario, Tag, Waypoints
from log2sim.geometry import wrap_angle
from log2sim.scenarios.tagging import find_tags

LANE_M, LANES = 3.5, 3
CAR, PERSON = (4.4, 1.8, 1.5), (0.6, 0.6, 1.7)
WITHIN_S = 1.5  # of a tag's moment and the true one's
FINE_S = 0.01
WINDING = np.inf


@dataclass(frozen=True)
class Event:
    """A maneuver that there is, or, with `sure` False, one that may be called so."""

    tag: str
    agent: str
    other: str | None
    t_s: float
    sure: bool = True


@dataclass
class World:
    """A scenario and its maneuvers."""

    scenario: Scenario
    events: list[Event] = field(default_factory=list)
    tags: tuple[str, ...] = ()  # that `events` are complete for


@dataclass
class Vehicle:
    """Station and offset (K,) on a road at fine times, as functions of closed form."""

    id: str
    s: np.ndarray
    d: np.ndarray
    speed: np.ndarray
    changes: list[tuple[float, int, int]]  # time at which the center crosses, lane before and after
    brakes: list[float] = field(default_factory=list)

    def lane(self) -> np.ndarray:
        """Lane (K,) that the center is in."""
        return np.clip((self.d / LANE_M).round().astype(int), 0, LANES - 1)


def quintic(u: np.ndarray) -> np.ndarray:
    """Rise from 0 to 1 without jerk at the ends (Papadimitriou and Tomizuka 2003)."""
    u = np.clip(u, 0.0, 1.0)
    return u**3 * (10 - 15 * u + 6 * u**2)


def traffic(seed: int, *, rate_hz: float = 10.0, bend_1pm: float = 0.0, keeps_right: bool = True, lanes: bool = False,
            noise_m: float = 0.0, duration_s: float = 14.0, count: int = 10) -> World:  # fmt: skip
    """Make random traffic with lane changes and hard braking on a road with three lanes in one direction."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, duration_s + FINE_S / 2, FINE_S)
    vehicles: list[Vehicle] = []
    for _ in range(400):
        if len(vehicles) == count:
            break
        name = "ego" if not vehicles else f"car-{len(vehicles)}"
        lane, begin = int(rng.integers(LANES)), rng.uniform(-60.0, 60.0)
        base = rng.uniform(18.0, 30.0) + 2.0 * lane
        accel = np.zeros(len(t))
        brakes = []
        if rng.random() < 0.25:
            at, hard = rng.uniform(2.0, duration_s - 4.0), rng.uniform(4.2, 7.0)
            # It builds up and decays within 0.4 s, as brakes do, and lasts for a second and more.
            lasts = rng.uniform(1.2, 1.8)
            accel -= hard * (quintic((t - at) / 0.4) - quintic((t - at - lasts) / 0.4))
            brakes.append(at + (lasts + 0.4) / 2)
        speed = base + np.cumsum(accel) * FINE_S
        s = begin + np.cumsum(speed) * FINE_S
        d, changes, now, free = np.full(len(t), lane * LANE_M), [], lane, 1.0
        while rng.random() < 0.6 and free < duration_s - 6.0:
            at, lasts = free + rng.uniform(0.0, 3.0), rng.uniform(3.0, 6.0)
            to = int(np.clip(now + rng.choice([-1, 1]), 0, LANES - 1))
            if to != now and at + lasts < duration_s - 0.5:
                d = d + (to - now) * LANE_M * quintic((t - at) / lasts)
                changes.append((at + lasts / 2, now, to))
                now = to
            free = at + lasts + 1.0
        new = Vehicle(name, s, d, speed, changes, brakes)
        if speed.min() > 5.0 and not any(_touch(new, old) for old in vehicles):
            vehicles.append(new)
    sign = 1.0 if keeps_right else -1.0
    agents = tuple(_agent(v.id, *_on_road(v.s, sign * v.d, bend_1pm), t, v.speed, rate_hz, noise_m, rng) for v in vehicles)
    features = MapFeatures(lanes=_map_lanes(bend_1pm, sign)) if lanes else None
    name = f"traffic {seed}, {rate_hz:g} Hz, bend {bend_1pm:g}, {'right' if keeps_right else 'left'}, {'lanes' if lanes else 'no lanes'}"
    scenario = Scenario(name, 0, duration_s, agents, map_features=features)
    tags = ("cut_in", "cut_out", "overtaking", "hard_braking", *(("lane_change",) if lanes else ()))
    return World(scenario, list(_road_events(vehicles, t, lanes=lanes)), tags)


def _touch(a: Vehicle, b: Vehicle) -> bool:
    return bool(((np.abs(a.s - b.s) < CAR[0] + 2.0) & (np.abs(a.d - b.d) < CAR[1] + 0.5)).any())


def _on_road(s: np.ndarray, d: np.ndarray, bend: float) -> tuple[np.ndarray, np.ndarray]:
    """Place stations and offsets on a road of even curvature; one of `WINDING` turns left and right along 500 m."""
    at = np.arange(-300.0, 1200.0, 0.1)
    curvature = np.sin(2 * np.pi * at / 500.0) / 300.0 if bend == WINDING else np.full(len(at), bend)
    heading = np.cumsum(curvature) * 0.1
    x, y, h = (np.interp(s, at, c) for c in (np.cumsum(np.cos(heading)) * 0.1, np.cumsum(np.sin(heading)) * 0.1, heading))
    return x - d * np.sin(h), y + d * np.cos(h)


def _map_lanes(bend: float, sign: float) -> tuple[MapLane, ...]:
    s = np.arange(-120.0, 600.0, 4.0)
    made = []
    for k in range(LANES):
        x, y = _on_road(s, np.full(len(s), sign * k * LANE_M), bend)
        up, down = (f"lane-{k + 1}" if k + 1 < LANES else None), (f"lane-{k - 1}" if k else None)
        left, right = (up, down) if sign > 0 else (down, up)
        points = np.column_stack([x, y, np.zeros(len(s))])
        made.append(MapLane(f"lane-{k}", points, np.full(len(s), LANE_M), left_lane=left, right_lane=right))
    return tuple(made)


def _agent(id: str, x: np.ndarray, y: np.ndarray, t: np.ndarray, speed: np.ndarray | None, rate_hz: float, noise_m: float,
           rng: np.random.Generator, category: str = "car", size: tuple = CAR, begin_s: float = 0.0) -> Agent:  # fmt: skip
    yaw = np.unwrap(np.arctan2(np.gradient(y), np.gradient(x)))
    pace = np.hypot(np.gradient(x, t), np.gradient(y, t)) if speed is None else speed
    moves = pace > 0.05
    yaw = np.interp(t, t[moves], yaw[moves]) if moves.any() else np.zeros(len(t))
    at = np.arange(0.0, t[-1] + 1e-9, 1.0 / rate_hz)
    at = at[at >= begin_s]
    columns = [np.interp(at, t, c) for c in (x, y, yaw, pace)]
    n = len(at)
    noise = [noise_m * rng.standard_normal(n), noise_m * rng.standard_normal(n), 0.02 * rng.standard_normal(n), 0.3 * rng.standard_normal(n)]
    if noise_m:
        columns = [c + e for c, e in zip(columns, noise)]
    xs, ys, yaws, speeds = columns
    sigma = np.full(n, noise_m)
    known = {"sigma_yaw_rad": np.full(n, 0.02), "sigma_speed_mps": np.full(n, 0.3)} if noise_m else {}
    w = Waypoints(at, xs, ys, np.full(n, size[2] / 2), wrap_angle(yaws), np.maximum(speeds, 0.0), np.ones(n, bool), sigma, **known)
    static = bool(not moves.any())
    return Agent(id, category, size, w, static=static)


def _near(value: float, limit: float) -> bool:
    return abs(value - limit) < 0.1 * limit


def _road_events(vehicles: Sequence[Vehicle], t: np.ndarray, *, lanes: bool):
    """Yield the maneuvers by the definitions: a lane change crosses where the center does, ahead of the nearest one there."""
    lane = {v.id: v.lane() for v in vehicles}
    for v in vehicles:
        for at in v.brakes:
            yield Event("hard_braking", v.id, None, at)
        for at, one, two in v.changes:
            n = round(at / FINE_S)
            if lanes:
                yield Event("lane_change", v.id, None, at)
            for tag, target in (("cut_in", two), ("cut_out", one)):
                behind = [o for o in vehicles if o is not v and o.s[n] < v.s[n] and _in(o, lane, n, target)]
                for k, o in enumerate(sorted(behind, key=lambda o: -o.s[n])):
                    headway = (v.s[n] - o.s[n] - CAR[0]) / o.speed[n]
                    busy = any(abs(at - b) < 5.0 for b, *_ in o.changes)  # who changes lanes as well may be called either
                    between = [b for b in vehicles if b not in (o, v) and o.s[n] < b.s[n] < v.s[n] + 5.0 and abs(b.d[n] - target * LANE_M) < LANE_M]
                    if k == 0 and headway <= 4.0 * 1.1:
                        yield Event(tag, v.id, o.id, at, sure=not (_near(headway, 4.0) or busy or between))
                    elif headway < 4.4:
                        yield Event(tag, v.id, o.id, at, sure=False)
    for a, b in itertools.permutations(vehicles, 2):
        ahead = a.s - b.s
        reach = CAR[0]
        ups = np.flatnonzero((ahead[1:] > reach) & (ahead[:-1] <= reach)) + 1
        for n in ups.tolist():
            before = np.flatnonzero(ahead[:n] < -reach)
            if len(before) and ahead[before[-1] : n].max() <= reach:
                beside = np.abs(a.d - b.d)[before[-1] : n].max()
                middle = t[before[-1] + int(np.argmin(np.abs(ahead[before[-1] : n])))]
                # Passing ends too near to the end of the log to be told from driving beside.
                yield Event("overtaking", a.id, b.id, middle, sure=beside < 2.1 * LANE_M and t[n] < t[-1] - 0.2 and t[before[-1]] > 0.2)


def _in(o: Vehicle, lane: dict[str, np.ndarray], n: int, target: int) -> bool:
    """Whether a vehicle is in a lane, or crosses its edge about then."""
    return abs(o.d[n] - target * LANE_M) < LANE_M / 2 + 0.3


def score(worlds: Sequence[World], found: Sequence[Sequence[Tag]]) -> dict[str, tuple[int, int, int, float, list[str]]]:
    """Count true, invented and missed tags of each kind, with the mean error of their moments, s, and what was wrong."""
    counts: dict[str, list] = defaultdict(lambda: [0, 0, 0, [], []])
    for world, tags in zip(worlds, found):
        left = list(world.events)
        for tag in (g for g in tags if g.tag in world.tags and g.probability >= 0.5):
            fits = [e for e in left if (e.tag, e.agent) == (tag.tag, tag.agent) and e.other in (tag.other, None) and abs(e.t_s - tag.t_s) <= WITHIN_S]
            row = counts[tag.tag]
            if fits:
                best = min(fits, key=lambda e: abs(e.t_s - tag.t_s))
                left.remove(best)
                if best.sure:
                    row[0] += 1
                    row[3].append(abs(best.t_s - tag.t_s))
            else:
                row[1] += 1
                row[4].append(f"invented {world.scenario.name}: {tag.tag} {tag.agent} {tag.other} {tag.start_s}-{tag.t_s}-{tag.end_s} p {tag.probability} {dict(tag.quantities)}")
        for event in left:
            if event.sure:
                counts[event.tag][2] += 1
                counts[event.tag][4].append(f"missed {world.scenario.name}: {event}")
    return {k: (v[0], v[1], v[2], float(np.mean(v[3])) if v[3] else 0.0, v[4]) for k, v in counts.items()}


def f1(true: int, invented: int, missed: int) -> float:
    """Harmonic mean of precision and recall."""
    return 2 * true / max(2 * true + invented + missed, 1)


def variants(count: int, noise_m: float):
    """Yield random traffic of all kinds."""
    kinds = list(itertools.product((2.0, 5.0, 10.0, 20.0), (0.0, 1 / 400, WINDING), (True, False), (False, True)))
    for seed in range(count):
        rate_hz, bend, right, lanes = kinds[(seed * 7) % len(kinds)]
        yield traffic(seed, rate_hz=rate_hz, bend_1pm=bend, keeps_right=right, lanes=lanes, noise_m=noise_m)


def main(arguments: list[str] | None = None) -> None:
    """Print a table."""
    parser = parser_of(__doc__)
    parser.add_argument("--worlds", type=int, default=48)
    parser.add_argument("--noise", type=float, default=0.0, help="standard deviation of places, m")
    parser.add_argument("--wrong", action="store_true", help="list what was wrong")
    asked = parser.parse_args(arguments)
    worlds = list(variants(asked.worlds, asked.noise))
    begin = time.process_time()
    found = [find_tags(w.scenario) for w in worlds]
    spent = time.process_time() - begin
    print(f"{'tag':22} {'true':>5} {'invented':>8} {'missed':>6} {'precision':>9} {'recall':>6} {'F1':>6} {'error s':>7}")
    for tag, (true, invented, missed, error_s, wrong) in sorted(score(worlds, found).items()):
        print(
            f"{tag:22} {true:5} {invented:8} {missed:6} {true / max(true + invented, 1):9.3f} {true / max(true + missed, 1):6.3f} "
            f"{f1(true, invented, missed):6.3f} {error_s:7.2f}"
        )
        for line in wrong if asked.wrong else ():
            print("   ", line)
    print(f"{len(worlds)} scenarios in {spent:.1f} s of processor time, {len(worlds) / max(spent, 1e-9):.1f} a second")
