"""Random traffic with known truth for measuring predictions: drivers who follow each other, turn, stop at lights and start,
riders and people who stroll, turn and wait. Seen with noise, its states are smoothed over the whole log or over the past only."""

from __future__ import annotations

import itertools
import time
from collections import defaultdict
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.table import markdown
from log2sim.agents.smooth import MotionModel, smooth_track
from log2sim.datatypes import Agent, Scenario, Waypoints
from log2sim.geometry import wrap_angle
from log2sim.geometry.statistics import CHI2_2DOF_95
from log2sim.simulation.prediction.motion_table import MotionTable, table_of
from log2sim.simulation.prediction.prediction import METHODS, leads_of, predict_table
from log2sim.synth.actors import RoundedPath

Array = NDArray[np.float64]
TICK_S, DURATION_S, WARM_UP_S = 0.1, 20.0, 15.0
TICKS_S = np.arange(round(DURATION_S / TICK_S) + 1) * TICK_S
# Intelligent driver model (Treiber, Hennecke, Helbing 2000), city values: drivers differ by a fifth.
ACCELERATION_MPS2, DECELERATION_MPS2, HEADWAY_S, GAP_M = 1.5, 2.0, 1.4, 2.0
# Comfortable lateral acceleration in turns, and how the speed of a free driver wanders.
LATERAL_MPS2, WANDER_MPS, WANDER_S = 2.0, 0.6, 5.0
CARS_A_LANE, PEDESTRIANS, CYCLISTS = 4, 4, 2
SIGMA_M = {"car": 0.12, "cyclist": 0.08, "pedestrian": 0.06}
SIZE_M = {"car": (4.4, 1.8, 1.5), "cyclist": (1.75, 0.65, 1.75), "pedestrian": (0.6, 0.6, 1.75)}
ROUTES = ("straight", "left", "right", "curve", "lane change")


@dataclass(frozen=True, eq=False)
class Course:
    """Columns (T, 2), m, and (T,), m/s and rad, of one agent every `TICK_S`."""

    category: str
    xy_m: Array
    speed_mps: Array
    yaw_rad: Array


def courses(seed: int) -> list[Course]:
    """All agents of one crossing."""
    rng = np.random.default_rng(seed)
    out = []
    for k in range(3):
        angle = rng.uniform(0, 2 * np.pi)
        turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        lane = _route(ROUTES[(seed + k) % len(ROUTES)], rng)
        out += _queue(lane @ turn + rng.normal(0, 60.0, 2), "car", CARS_A_LANE, rng)
        if k < CYCLISTS:
            out += _queue(_route(ROUTES[(seed + k + 1) % 4], rng) @ turn, "cyclist", 1, rng)
    return [*out, *(_stroll(rng) for _ in range(PEDESTRIANS))]


def _route(kind: str, rng: np.random.Generator) -> Array:
    """Corners of a way through a crossing at the origin."""
    if kind in ("left", "right"):
        side = 1.0 if kind == "left" else -1.0
        return np.array([[-400.0, 0.0], [0.0, 0.0], [0.0, side * 400.0]])
    if kind == "curve":
        radius = rng.uniform(40.0, 150.0)
        angle = np.linspace(0.0, 1.5, 40)
        bend = radius * np.column_stack([np.sin(angle), 1 - np.cos(angle)])
        exit_ = bend[-1] + 300.0 * np.array([np.cos(1.5), np.sin(1.5)])
        return np.vstack([[[-400.0, 0.0]], bend, [exit_]])
    if kind == "lane change":
        return np.array([[-400.0, 0.0], [-20.0, 0.0], [25.0, 3.5], [400.0, 3.5]])
    return np.array([[-400.0, 0.0], [400.0, 0.0]])


def _queue(corners: Array, category: str, count: int, rng: np.random.Generator) -> list[Course]:
    """Road users behind each other on one way; a light at its crossing is red for some time."""
    path = RoundedPath(corners, rng.uniform(25.0, 45.0) if category == "car" else 12.0)
    s = np.arange(0.0, path.length_m, 1.0)
    yaw = np.unwrap(path.at(s)[1])
    bend = np.abs(np.gradient(yaw, s))
    wish = rng.uniform(8.0, 15.0, count) if category == "car" else rng.uniform(3.5, 7.0, count)
    # Drivers look ahead: the speed of a turn holds from where comfortable braking must begin.
    limit = np.sqrt(LATERAL_MPS2 / np.maximum(bend, 1e-4))
    for k in range(len(s) - 2, -1, -1):
        limit[k] = min(limit[k], np.sqrt(limit[k + 1] ** 2 + 2 * 1.2 * 1.0))
    steps = round((WARM_UP_S + DURATION_S) / TICK_S) + 1
    crossing = path.length_m / 2
    red = (10.0 + rng.uniform(0, 8.0), 10.0 + rng.uniform(6.0, 22.0)) if rng.random() < 0.6 else (0.0, 0.0)
    at = crossing - 120.0 - np.cumsum(rng.uniform(12.0, 35.0, count)) + rng.uniform(-20, 90)
    speed, wander = wish.copy(), np.zeros(count)
    own = rng.uniform(0.8, 1.2, count)
    ways, speeds = np.empty((steps, count)), np.empty((steps, count))
    noise = WANDER_MPS * np.sqrt(2 * TICK_S / WANDER_S)
    for n in range(steps):
        ways[n], speeds[n] = at, speed
        t = n * TICK_S
        wander += -wander * TICK_S / WANDER_S + noise * rng.normal(size=count)
        wanted = np.maximum(np.minimum(wish + wander, np.interp(at, s, limit)), 0.5)
        ahead = np.append(np.inf, at[:-1] - 4.5)
        ahead_v = np.append(0.0, speed[:-1])
        stops = (red[0] < t < red[1]) & (at < crossing - 8.0) & (speed**2 / 6.0 < crossing - 8.0 - at)
        ahead_v = np.where(stops & (crossing - 8.0 < ahead), 0.0, ahead_v)
        ahead = np.where(stops, np.minimum(ahead, crossing - 6.0), ahead)
        gap = np.maximum(ahead - at, 0.1)
        closing = speed * (speed - ahead_v) / (2 * np.sqrt(ACCELERATION_MPS2 * DECELERATION_MPS2))
        needed = GAP_M + speed * HEADWAY_S * own + closing
        rate = own * ACCELERATION_MPS2 * (1 - (speed / wanted) ** 4 - (np.maximum(needed, 0.0) / gap) ** 2)
        speed = np.maximum(speed + np.clip(rate, -7.0, 2.5) * TICK_S, 0.0)
        at = at + speed * TICK_S
    first = round(WARM_UP_S / TICK_S)
    out = []
    for k in range(count):
        xy, heading = path.at(ways[first:, k])
        sway = 0.15 * np.sin(2 * np.pi * ways[first:, k] / 60.0 + rng.uniform(0, 6.3))  # keeping to a lane
        xy = xy + sway[:, None] * np.column_stack([-np.sin(heading), np.cos(heading)])
        out.append(Course(category, xy, speeds[first:, k], heading))
    return out


def _stroll(rng: np.random.Generator) -> Course:
    """A pedestrian who keeps speed and course for some seconds each, waits now and then, and takes 0.7 s for a change."""
    steps = round(DURATION_S / TICK_S) + 1
    pace = rng.uniform(0.9, 1.8)
    speed, yaw = np.empty(steps), np.empty(steps)
    now, course = pace, rng.uniform(0, 2 * np.pi)
    wanted, aim = pace, course
    for n in range(steps):
        if rng.random() < TICK_S / 6.0:
            aim += rng.normal(0, 0.6)
        if rng.random() < TICK_S / (8.0 if wanted > 0 else 4.0):
            wanted = 0.0 if wanted > 0 and rng.random() < 0.5 else pace * rng.uniform(0.8, 1.2)
        now += (wanted - now) * TICK_S / 0.7
        course += (aim - course) * TICK_S / 0.7
        speed[n], yaw[n] = (now if now > 0.05 else 0.0), course
    step = speed[:-1, None] * TICK_S * np.column_stack([np.cos(yaw[:-1]), np.sin(yaw[:-1])])
    return Course("pedestrian", rng.normal(0, 30.0, 2) + np.vstack([np.zeros(2), np.cumsum(step, axis=0)]), speed, yaw)


def true_scenario(found: list[Course]) -> Scenario:
    return _scenario([_agent(k, c, c.xy_m, c.speed_mps, c.yaw_rad, np.zeros(len(c.xy_m))) for k, c in enumerate(found)])


def smoothed_scenario(found: list[Course], seed: int) -> Scenario:
    """The scenario that a reconstruction makes of noisy positions: smoothed over the whole log."""
    agents = []
    for k, course in enumerate(found):
        path = smooth_track(TICKS_S, noisy(course, k, seed), sigma_m=SIGMA_M[course.category], motion=_motion(course))
        sigma = np.sqrt(np.trace(path.covariance, axis1=1, axis2=2) / 2)
        agents.append(_agent(k, course, path.xy_m, np.hypot(*path.velocity_mps.T), path.yaw_rad, sigma))
    return _scenario(agents)


def noisy(course: Course, k: int, seed: int) -> Array:
    """Measured positions (T, 2)."""
    rng = np.random.default_rng([seed, k])
    return course.xy_m + rng.normal(0, SIGMA_M[course.category], course.xy_m.shape)


def _motion(course: Course) -> MotionModel:
    return MotionModel(holonomic=course.category == "pedestrian")


def _agent(k: int, course: Course, xy: Array, speed: Array, yaw: Array, sigma: Array) -> Agent:
    n = len(xy)
    w = Waypoints(TICKS_S, xy[:, 0], xy[:, 1], np.zeros(n), wrap_angle(yaw), speed, np.ones(n, bool), sigma)
    return Agent(f"{course.category}_{k}", course.category, SIZE_M[course.category], w)


def _scenario(agents: list[Agent]) -> Scenario:
    return Scenario("random crossing", 0, DURATION_S, tuple(agents))


LEADS_S = (1, 2, 3)
MOVING_MPS = 0.15
# Before, too little is known of an agent for a fair comparison.
BEGIN_S = 3.0


def main(seeds: int = 4, past: bool = False) -> None:
    """Print the table; with `past` also of states smoothed over the past only."""
    sums: dict[tuple[str, str, int], list[tuple[Array, Array]]] = defaultdict(list)
    spent, count = 0.0, 0
    for seed in range(seeds):
        drawn = courses(seed)
        truth = table_of(true_scenario(drawn))
        tables = {"truth": truth, "whole log": table_of(smoothed_scenario(drawn, seed))}
        if past:
            tables["past only"] = causal_table(truth, drawn, seed)
        tables["differences"] = difference_table(truth, drawn, seed)
        for source, table in tables.items():
            start = time.process_time()
            found = predict_table(table, leads_of(3.0))
            spent, count = spent + time.process_time() - start, count + len(found.row)
            moves = np.abs(truth.velocity_mps[found.row, found.tick]) > MOVING_MPS
            moves &= truth.t_s[found.tick] >= BEGIN_S
            for (method, forecast), lead in itertools.product(found.forecasts.items(), LEADS_S):
                later, h = truth.later(round(lead / truth.tick_s))[0], 2 * lead - 1
                error = (forecast.position_m[:, h] - later[found.row, found.tick]) * forecast.course[:, h].conj()
                squared = (error.real / forecast.sigma_m[:, h, 0]) ** 2 + (error.imag / forecast.sigma_m[:, h, 1]) ** 2
                chosen = moves & np.isfinite(error)
                sums[source, method, lead].append((np.abs(error[chosen]), squared[chosen]))
    rows = []
    for source, method in dict.fromkeys(key[:2] for key in sums):
        cells = []
        for lead in LEADS_S:
            distance, squared = (np.concatenate(c) for c in zip(*sums[source, method, lead]))
            cells.append(f"{distance.mean():.2f} / {squared.mean() / 2:.2f} / {(squared < CHI2_2DOF_95).mean():.2f}")
        rows.append([source, method, *cells])
    print(markdown(["states", "method", *(f"FDE m / NEES / in 95 %, {s} s" for s in LEADS_S)], rows))
    print(f"{count} agent-ticks, {len(METHODS)} methods: {1e4 * spent / count:.2f} s for 10,000")


def causal_table(truth: MotionTable, courses: list[Course], seed: int) -> MotionTable:
    """States smoothed at each tick over what was measured in the 5 s up to then."""
    position, velocity = np.empty_like(truth.position_m), np.empty_like(truth.velocity_mps)
    for k, course in enumerate(courses):
        measured, sigma_m, motion = noisy(course, k, seed), SIGMA_M[course.category], _motion(course)
        for n in range(len(TICKS_S)):
            past = slice(max(0, n - 50), n + 1)
            at_s = TICKS_S[n : n + 1]
            path = smooth_track(TICKS_S[past], measured[past], sigma_m=sigma_m, motion=motion, at_s=at_s)
            position[k, n], velocity[k, n] = path.xy_m[0] @ [1, 1j], path.velocity_mps[0] @ [1, 1j]
    return _with(truth, position, velocity, courses)


def difference_table(truth: MotionTable, courses: list[Course], seed: int) -> MotionTable:
    """Measured positions, with the differences to the ones before as velocities."""
    position = np.array([noisy(course, k, seed) @ [1, 1j] for k, course in enumerate(courses)])
    velocity = np.diff(position, axis=1, prepend=position[:, :1]) / truth.tick_s
    velocity[:, 0] = velocity[:, 1]
    return _with(truth, position, velocity, courses)


def _with(truth: MotionTable, position: np.ndarray, velocity: np.ndarray, courses: list[Course]) -> MotionTable:
    sigma = np.array([SIGMA_M[c.category] for c in courses])[:, None] * np.ones(position.shape)
    center = np.stack([position.real, position.imag, 0.0 * sigma], axis=-1)
    states = truth.t_s, center, np.angle(velocity), np.abs(velocity)
    return MotionTable(truth.agents, *states, truth.tick_s, velocity, sigma, truth.observed, truth.piece)
