"""Worlds whose maneuvers are known in closed form, for the benchmark of tags and its tests.

Random traffic on straight and bent roads with three lanes, on both sides of the road, at 2 to 20 Hz, with and without a map, and
junctions with turns, crossings and people who step out between parked cars. The truth comes from the stations and lanes of the
vehicles on their road alone. Events whose quantities are within a tenth of the limits that define them count neither way.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from log2sim.datatypes import Agent, MapFeatures, MapLane, Marking, Scenario, Signal, Waypoints
from log2sim.geometry import wrap_angle
from log2sim.synth.scene import Scene, scene_from_table

LANE_M, LANES = 3.5, 3
CAR, PERSON = (4.4, 1.8, 1.5), (0.6, 0.6, 1.7)
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


def maybe(tags: Sequence[str], one: str, two: str, times: Sequence[float]) -> list[Event]:
    """List what may be called so, by either of two at any of some times."""
    pairs = ((one, two), (two, one))
    return [Event(tag, a, b, t, sure=False) for tag in tags for a, b in pairs for t in times]


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


def quintic(u: np.ndarray) -> np.ndarray:
    """Rise from 0 to 1 without jerk at the ends (Papadimitriou and Tomizuka 2003)."""
    u = np.clip(u, 0.0, 1.0)
    return u**3 * (10 - 15 * u + 6 * u**2)


def traffic(seed: int, *, rate_hz: float = 10.0, bend_1pm: float = 0.0, keeps_right: bool = True, lanes: bool = False,
            noise_m: float = 0.0, duration_s: float = 14.0, count: int = 10, braking: float = 0.25) -> World:  # fmt: skip
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
        if rng.random() < braking:
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
        apart = [(np.abs(s - old.s) >= CAR[0] + 2.0) | (np.abs(d - old.d) >= CAR[1] + 0.5) for old in vehicles]
        if speed.min() > 5.0 and np.all(apart):
            vehicles.append(Vehicle(name, s, d, speed, changes, brakes))
    sign = 1.0 if keeps_right else -1.0
    agents = tuple(
        _agent(v.id, *_on_road(v.s, sign * v.d, bend_1pm), t, v.speed, rate_hz, noise_m, rng) for v in vehicles
    )
    features = MapFeatures(lanes=_map_lanes(bend_1pm, sign)) if lanes else None
    name = f"traffic {seed}, {rate_hz:g} Hz, bend {bend_1pm:g}, {'right' if keeps_right else 'left'}, {'lanes' if lanes else 'no lanes'}"
    scenario = Scenario(name, 0, duration_s, agents, map_features=features)
    tags = ("cut_in", "cut_out", "overtaking", "hard_braking", *(("lane_change",) if lanes else ()))
    return World(scenario, list(_road_events(vehicles, t, lanes=lanes)), tags)


def motorway(seed: int) -> Scene:
    """Make a scene of random traffic for 8 s around a car with a LiDAR: its rate, the bend and the side follow from the seed."""
    rates, bends = (10.0, 10.0, 5.0, 20.0, 2.0, 10.0, 5.0, 2.0), (0.0, 1 / 400, 0.0, 0.0, 0.0, WINDING, 1 / 400, 0.0)
    kind = seed % len(rates)
    bend, right = bends[kind], kind in (0, 3, 4, 5, 6)
    # A scene's vehicles brake with up to 3 m/s2.
    world = traffic(seed, rate_hz=20.0, bend_1pm=bend, keeps_right=right, duration_s=8.0, count=14, braking=0.0)

    def driver(agent: Agent, axle_m: float) -> dict[str, object]:
        w = agent.waypoints
        way = (w.x_m - axle_m * np.cos(w.yaw_rad), w.y_m - axle_m * np.sin(w.yaw_rad), w.speed_mps)
        return {"size_m": CAR, "waypoints": np.column_stack(way)[::10].round(3).tolist(), "rounding_m": 12.0}

    ego, *others = world.scenario.agents
    s = np.arange(-200.0, 700.0, 10.0)
    middle = np.column_stack(_on_road(s, np.full(len(s), LANE_M if right else -LANE_M), bend))
    return scene_from_table({
        "name": f"motorway {seed}", "duration_s": 8.0, "traffic": "right" if right else "left", "ego": driver(ego, 1.4),
        "agent": [{"id": a.id, "category": "car", **driver(a, 0.3 * CAR[0])} for a in others],
        "road": [{"line": middle.round(2).tolist(), "width_m": LANES * LANE_M + 1.5, "lanes": LANES, "lanes_back": 0, "side_inset_m": 0.75,
                  "sidewalk_m": 0.0}],
        "lidar": [{"name": "roof", "position_m": [1.2, 0.0, 1.9], "elevation_deg": [-16.0, 4.0], "channels": 40, "rate_hz": rates[kind],
                   "offset_s": 0.08, "range_m": 100.0}],
    })  # fmt: skip


def _on_road(s: np.ndarray, d: np.ndarray, bend: float) -> tuple[np.ndarray, np.ndarray]:
    """Place stations and offsets on a road of even curvature; one of `WINDING` turns left and right along 500 m."""
    at = np.arange(-300.0, 1200.0, 0.1)
    curvature = np.sin(2 * np.pi * at / 500.0) / 300.0 if bend == WINDING else np.full(len(at), bend)
    heading = np.cumsum(curvature) * 0.1
    middle = np.cumsum(np.cos(heading)) * 0.1, np.cumsum(np.sin(heading)) * 0.1
    x, y, h = (np.interp(s, at, c) for c in (*middle, heading))
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
           rng: np.random.Generator, category: str = "car", size: tuple = CAR) -> Agent:  # fmt: skip
    yaw = np.unwrap(np.arctan2(np.gradient(y), np.gradient(x)))
    pace = np.hypot(np.gradient(x, t), np.gradient(y, t)) if speed is None else speed
    moves = pace > 0.05
    yaw = np.interp(t, t[moves], yaw[moves]) if moves.any() else np.zeros(len(t))
    at = np.arange(0.0, t[-1] + 1e-9, 1.0 / rate_hz)
    n = len(at)
    columns = [np.interp(at, t, c) for c in (x, y, yaw, pace)]
    known = {}
    if noise_m:
        columns = [c + sigma * rng.standard_normal(n) for c, sigma in zip(columns, (noise_m, noise_m, 0.02, 0.3))]
        known = {"sigma_yaw_rad": np.full(n, 0.02), "sigma_speed_mps": np.full(n, 0.3)}
    xs, ys, yaws, speeds = columns
    height, sigma_m = np.full(n, size[2] / 2), np.full(n, noise_m)
    w = Waypoints(at, xs, ys, height, wrap_angle(yaws), np.maximum(speeds, 0.0), np.ones(n, bool), sigma_m, **known)
    return Agent(id, category, size, w, static=not moves.any())


def route(points: Sequence[tuple[float, float]], radius_m: float) -> np.ndarray:
    """Points (K, 2) 5 cm apart on a polyline whose corners are arcs."""
    corners = [complex(*p) for p in points]
    parts = [np.array(corners[:1])]
    for before, at, after in zip(corners, corners[1:], corners[2:]):
        one, two = (at - before) / abs(at - before), (after - at) / abs(after - at)
        turn = float(np.angle(two / one))
        cut = radius_m * abs(np.tan(turn / 2))
        angle = np.linspace(0.0, turn, max(int(abs(turn) * radius_m / 0.05), 2))
        side = 1j * np.sign(turn)
        center = at - one * cut + one * side * radius_m
        parts.append(center - one * np.exp(1j * angle) * side * radius_m)
    parts.append(np.array(corners[-1:]))
    line = np.concatenate(parts)
    way = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(line)))])
    kept = np.concatenate([[True], np.diff(way) > 1e-9])
    at = np.arange(0.0, way[-1], 0.05)
    line = np.interp(at, way[kept], line[kept])
    return np.column_stack([line.real, line.imag])


def along(line: np.ndarray, s: np.ndarray) -> list[np.ndarray]:
    """Places x, y (K,) at stations of a route."""
    return [np.interp(s, np.arange(len(line)) * 0.05, c) for c in line.T]


@dataclass
class Stage:
    """A scripted scene: agents on routes with stations over time; mirrored for traffic on the left."""

    rng: np.random.Generator
    rate_hz: float
    mirrored: bool
    noise_m: float
    duration_s: float = 12.0
    agents: list[Agent] = field(default_factory=list)

    @property
    def t(self) -> np.ndarray:
        return np.arange(0.0, self.duration_s + FINE_S / 2, FINE_S)

    def add(self, id: str, line: np.ndarray, speed: np.ndarray | float, start_m: float = 0.0, category: str = "car",
            size: tuple = CAR) -> np.ndarray:  # fmt: skip
        """Add an agent and return its stations; the route is long enough for it."""
        pace = np.broadcast_to(np.asarray(speed, dtype=float), self.t.shape)
        s = start_m + np.concatenate([[0.0], np.cumsum((pace[1:] + pace[:-1]) / 2) * FINE_S])
        assert s[-1] <= (len(line) - 1) * 0.05 + 0.1, id
        x, y = along(line, s)
        y = -y if self.mirrored else y
        agent = _agent(id, x, y, self.t, pace.copy(), self.rate_hz, self.noise_m, self.rng, category, size)
        if not pace.any():
            heading = np.arctan2(*((line[1] - line[0]) * [1, -1 if self.mirrored else 1])[::-1])
            w = agent.waypoints
            agent = replace(agent, waypoints=replace(w, yaw_rad=np.full(len(w), heading)))
        self.agents.append(agent)
        return s

    def world(self, name: str, events: Sequence[Event], tags: tuple[str, ...], **parts: object) -> World:
        side = "left" if self.mirrored else "right"
        label = f"{name}, {self.rate_hz:g} Hz, {side}"
        return World(Scenario(label, 0, self.duration_s, tuple(self.agents), **parts), list(events), tags)


JUNCTION_TAGS = ("turning", "u_turn", "turning_across", "crossing_path", "merging", "stepping_out", "oncoming_in_lane", "stopping",
                 "starting", "standing", "standing_at_light", "standing_at_crosswalk", "following", "approaching", "near_miss",
                 "cut_in", "cut_out", "overtaking", "hard_braking")  # fmt: skip


def ramp(t: np.ndarray, begin_s: float, accel: float, low: float, high: float, before: float) -> np.ndarray:
    """Speed that changes from a time on at a rate, within limits."""
    return np.clip(before + accel * np.maximum(t - begin_s, 0.0), low, high)


def turn_across(stage: Stage) -> World:
    """A car turns to the far side before an oncoming one, or behind it."""
    rng = stage.rng
    v, u = rng.uniform(5.0, 8.0), rng.uniform(8.0, 13.0)
    line = route([(-80, -1.75), (1.75, -1.75), (1.75, 90)], 8.0)
    s = stage.add("ego", line, v, start_m=rng.uniform(20, 40))
    # Where the ego is in the oncoming lane: its center at y = 1.75.
    x, y = along(line, s)
    there = stage.t[np.argmax(y > 1.75)]
    gap = rng.choice([-1.0, 1.0]) * rng.uniform(1.8, 3.5)  # when the oncoming one is there, later or earlier
    begin = x[np.argmax(y > 1.75)] + u * (there + gap)
    stage.add("car-1", route([(250, 1.75), (-250, 1.75)], 5.0), u, start_m=250 - begin)
    last = there + max(gap, 0.0) < stage.t[-1] - 1.0
    first, second = ("ego", "car-1") if gap > 0 else ("car-1", "ego")
    turned = stage.t[np.argmax(np.abs(s - (s[np.argmax(y > 0)])) < 0.2)]
    events = [
        Event("turning", "ego", None, turned), Event("turning_across", "ego", "car-1", there, sure=last),
        Event("crossing_path", first, second, there + min(gap, 0.0), sure=last),
        *maybe(("oncoming_in_lane",), "car-1", "ego", (there,)), *maybe(("near_miss",), first, second, (there, there + gap)),
    ]  # fmt: skip
    return stage.world("turn across", events, JUNCTION_TAGS)


def crossing(stage: Stage) -> World:
    """Two cars cross at a right angle."""
    rng = stage.rng
    v, u = rng.uniform(6.0, 12.0, 2)
    there, gap = rng.uniform(4.0, 6.0), rng.uniform(0.5, 6.5)  # between the moments at which their centers cross
    stage.add("ego", route([(-200, 0), (300, 0)], 5.0), v, start_m=200 - v * there)
    stage.add("car-1", route([(0, -200), (0, 300)], 5.0), u, start_m=200 - u * (there + gap))
    # The ego has left the crossing when its rear has passed the width of the other, which comes with its front.
    pet = gap - (CAR[0] + CAR[1]) / 2 / v - (CAR[0] + CAR[1]) / 2 / u
    events = [Event("crossing_path", "ego", "car-1", there, sure=not _near(pet, 5.0) and pet > 0)] if pet < 5.5 else []
    events += [Event("near_miss", "ego", "car-1", there, sure=0 < pet < 0.9)] if pet < 1.3 else []
    return stage.world(f"crossing, PET {pet:.2f} s", events, JUNCTION_TAGS if pet > 0 else ())


def merge(stage: Stage) -> World:
    """A car turns into the road of another ahead of it."""
    rng = stage.rng
    v, u = rng.uniform(8.0, 11.0), rng.uniform(5.0, 6.5)
    line = route([(0, -60), (0, -1.75), (150, -1.75)], 7.0)
    start = rng.uniform(20.0, 35.0)
    s = stage.add("car-1", line, u, start_m=start)
    enters = stage.t[np.argmax(along(line, s)[1] > -3.5)]
    turns = stage.t[np.argmax(s > 60 - 1.75 - 7.0 + 5.5)]
    behind = rng.uniform(14.0, 25.0)
    speed = ramp(stage.t, enters - 0.5, -rng.uniform(1.0, 2.0), u, v, v)
    way = np.interp(enters, stage.t, np.cumsum(speed) * FINE_S)
    stage.add("ego", route([(-200, -1.75), (300, -1.75)], 5.0), speed, start_m=200 - behind - way)
    events = [
        Event("merging", "car-1", "ego", enters), Event("turning", "car-1", None, turns),
        *maybe(("following", "approaching"), "ego", "car-1", (enters, enters + 2, enters + 4)),
        *maybe(("crossing_path", "near_miss"), "ego", "car-1", (enters,)),
    ]  # fmt: skip
    return stage.world("merge", events, JUNCTION_TAGS)


def step_out(stage: Stage) -> World:
    """Somebody steps out between parked cars, or walks the same way in the open."""
    rng = stage.rng
    hidden = rng.random() < 0.6
    v, walk = rng.uniform(7.0, 11.0), rng.uniform(1.2, 1.8)
    enters = rng.uniform(4.0, 6.0)  # the lane of the ego, whose center is 2.6 m from the parked cars' middle
    ahead = rng.uniform(10.0, 20.0)
    stage.add("ego", route([(-200, 0), (300, 0)], 5.0), v, start_m=200 - ahead - v * enters)
    if hidden:
        for k in range(4):
            stage.add(f"parked-{k}", route([(-24.0 + 5.6 * k, -2.9), (0, -2.9)], 1.0), 0.0)
    line, begin = route([(0.2, -40), (0.2, 40)], 1.0), 40 - 1.75 - walk * enters
    stage.add("pedestrian-1", line, walk, start_m=begin, category="pedestrian", size=PERSON)
    events = [Event("stepping_out", "pedestrian-1", "ego", enters)] if hidden else []
    events += maybe(("crossing_path", "near_miss"), "ego", "pedestrian-1", (enters, enters + 1.5))
    return stage.world(f"step out, {'hidden' if hidden else 'seen'}", events, JUNCTION_TAGS)


def wait_at_light(stage: Stage) -> World:
    """A car brakes for a red light behind a crosswalk, stands, and starts; another follows it."""
    rng = stage.rng
    v, decel = rng.uniform(8.0, 12.0), rng.uniform(1.5, 2.6)
    brakes = rng.uniform(1.0, 2.0)
    stops = brakes + v / decel
    goes = stops + rng.uniform(2.0, 3.0)
    stage.duration_s = goes + 4.0
    speed = np.where(stage.t < goes, ramp(stage.t, brakes, -decel, 0.0, v, v), ramp(stage.t, goes, 1.8, 0.0, 12.0, 0.0))
    way = float(np.cumsum(speed)[np.searchsorted(stage.t, stops)] * FINE_S)
    line = route([(-300, 0), (300, 0)], 5.0)
    stage.add("ego", line, speed, start_m=300 - way)  # it stands with its center at x = 0
    sign = -1.0 if stage.mirrored else 1.0
    light = Signal("light", np.array([12.0, sign * 3.0, 4.0]), np.pi, np.array([0.0, goes]), np.array(["red", "green"]))
    outline = np.array([[4.0, -5, 0], [7.0, -5, 0], [7.0, 5, 0], [4.0, 5, 0]])
    walk = MapFeatures(markings=(Marking("walk", "crosswalk", outline, 3.0),))
    events = [
        Event("stopping", "ego", None, stops), Event("standing", "ego", None, stops), Event("starting", "ego", None, goes),
        Event("standing_at_light", "ego", None, stops), Event("standing_at_crosswalk", "ego", None, stops),
    ]  # fmt: skip
    return stage.world("light", events, JUNCTION_TAGS, signals=(light,), map_features=walk)


def follow(stage: Stage) -> World:
    """A car follows another, or comes nearer to it, which stands for a queue."""
    rng = stage.rng
    u = rng.uniform(6.0, 14.0)
    nears = rng.random() < 0.5
    v = u + (rng.uniform(3.0, 5.0) if nears else rng.uniform(-0.8, 0.8))
    gap = rng.uniform(40.0, 50.0) if nears else v * rng.uniform(0.8, 2.0)
    stage.add("car-1", route([(0, 0), (600, 0)], 5.0), u, start_m=100 + gap + CAR[0])
    speed = np.full(len(stage.t), v)
    if nears:  # it brakes to the speed of the other when 10 m are left
        speed = ramp(stage.t, (gap - 18) / (v - u), -1.5, u, v, v)
    stage.add("ego", route([(0, 0), (600, 0)], 5.0), speed, start_m=100)
    if nears:
        events = [Event("approaching", "ego", "car-1", (gap - 18) / (v - u))]
        events += maybe(("following",), "ego", "car-1", (0.5, 3.0, 6.0, 9.0, 11.5))
    else:  # one event over all the time, whose moment is that of the least headway
        events = [Event("following", "ego", "car-1", 0.0 if v < u else 12.0)]
    return stage.world(f"follow, {'nears' if nears else 'follows'}", events, JUNCTION_TAGS)


def turn_back(stage: Stage) -> World:
    """A car turns back within the road."""
    rng = stage.rng
    v, radius = rng.uniform(3.5, 5.0), rng.uniform(5.0, 7.0)
    line = route([(-80, -radius), (30, -radius), (30, radius), (-120, radius)], radius - 0.01)
    s = stage.add("ego", line, v, start_m=110 - radius - v * 4.0)
    middle = stage.t[np.argmax(s > 110 - radius + np.pi * radius / 2)]
    return stage.world("turn back", [Event("u_turn", "ego", None, middle)], JUNCTION_TAGS)


def oncoming(stage: Stage) -> World:
    """A car passes a slower one in the lane of oncoming traffic."""
    rng = stage.rng
    v, u, w = rng.uniform(13.0, 16.0), rng.uniform(6.0, 8.0), rng.uniform(8.0, 12.0)
    out_s, lasts = 2.0, 2.5
    d = 3.5 * quintic((stage.t - out_s) / lasts) - 3.5 * quintic((stage.t - out_s - lasts - 2.5) / lasts)
    back = out_s + lasts * 1.5 + 2.5
    s = np.cumsum(np.full(len(stage.t), v)) * FINE_S
    beside = out_s + lasts + 1.0
    x0 = -v * beside + u * beside  # beside the slower one then
    x, y = x0 + s, -1.75 + d
    y = -y if stage.mirrored else y
    stage.agents.append(_agent("car-1", x, y, stage.t, None, stage.rate_hz, stage.noise_m, stage.rng))
    stage.add("car-2", route([(0, -1.75), (400, -1.75)], 5.0), u, start_m=0.0)
    # The oncoming one meets it two to three seconds after it is back.
    meet = back + rng.uniform(1.5, 2.5)
    at = x0 + v * meet
    stage.add("ego", route([(at + w * meet, 1.75), (at - 300, 1.75)], 5.0), w)
    follows = ("cut_in", "cut_out", "approaching", "near_miss", "following")
    times = (1, 2, 3.25, beside, back - 1, back, back + 2)
    events = [
        Event("overtaking", "car-1", "car-2", beside), Event("oncoming_in_lane", "car-1", "ego", back - 1.0, sure=meet - back < 4.0),
        *maybe(("oncoming_in_lane", "near_miss", "crossing_path"), "car-1", "ego", (beside, back, meet)),
        *maybe(follows, "car-1", "car-2", times),
    ]  # fmt: skip
    return stage.world("oncoming", events, JUNCTION_TAGS)


SCRIPTS = (turn_across, crossing, merge, step_out, wait_at_light, follow, turn_back, oncoming)


def scripted(count: int, noise_m: float, first: int = 0):
    """Yield scripted scenes with random parameters, at several rates and on both sides of traffic."""
    for seed in range(first, first + count):
        for k, script in enumerate(SCRIPTS):
            rng = np.random.default_rng([seed, k])
            yield script(Stage(rng, float(rng.choice([2.0, 5.0, 10.0, 20.0])), bool(seed % 2), noise_m))


def _near(value: float, limit: float) -> bool:
    return abs(value - limit) < 0.1 * limit


def _road_events(vehicles: Sequence[Vehicle], t: np.ndarray, *, lanes: bool):
    """Yield the maneuvers by the definitions: a lane change crosses where the center does, ahead of the nearest one there."""
    for v in vehicles:
        for at in v.brakes:
            yield Event("hard_braking", v.id, None, at)
        for at, one, two in v.changes:
            n = round(at / FINE_S)
            if lanes:
                yield Event("lane_change", v.id, None, at)
            for tag, target in (("cut_in", two), ("cut_out", one)):
                # Who is in the lane, or crosses its edge about then.
                there = [o for o in vehicles if abs(o.d[n] - target * LANE_M) < LANE_M / 2 + 0.3]
                behind = [o for o in there if o is not v and o.s[n] < v.s[n]]
                for k, o in enumerate(sorted(behind, key=lambda o: -o.s[n])):
                    headway = (v.s[n] - o.s[n] - CAR[0]) / o.speed[n]
                    # Who changes lanes as well may be called either.
                    busy = any(abs(at - b) < 5.0 for b, *_ in o.changes)
                    near = [b for b in vehicles if b not in (o, v) and abs(b.d[n] - target * LANE_M) < LANE_M]
                    between = any(o.s[n] < b.s[n] < v.s[n] + 5.0 for b in near)
                    if k == 0 and headway <= 4.0 * 1.1:
                        yield Event(tag, v.id, o.id, at, sure=not (_near(headway, 4.0) or busy or between))
                    elif headway < 4.4:
                        yield Event(tag, v.id, o.id, at, sure=False)
    for a, b in itertools.permutations(vehicles, 2):
        ahead, reach = a.s - b.s, CAR[0]
        ups = np.flatnonzero((ahead[1:] > reach) & (ahead[:-1] <= reach)) + 1
        for n in ups.tolist():
            before = np.flatnonzero(ahead[:n] < -reach)
            if len(before) and ahead[before[-1] : n].max() <= reach:
                beside = np.abs(a.d - b.d)[before[-1] : n].max()
                middle = t[before[-1] + int(np.argmin(np.abs(ahead[before[-1] : n])))]
                # Passing ends too near to the end of the log to be told from driving beside.
                sure = beside < 2.1 * LANE_M and t[n] < t[-1] - 0.2 and t[before[-1]] > 0.2
                yield Event("overtaking", a.id, b.id, middle, sure)


def variants(count: int, noise_m: float, first: int = 0):
    """Yield random traffic of all kinds."""
    kinds = list(itertools.product((2.0, 5.0, 10.0, 20.0), (0.0, 1 / 400, WINDING), (True, False), (False, True)))
    for seed in range(first, first + count):
        rate_hz, bend, right, lanes = kinds[(seed * 7) % len(kinds)]
        yield traffic(seed, rate_hz=rate_hz, bend_1pm=bend, keeps_right=right, lanes=lanes, noise_m=noise_m)
