"""How well and how fast agents follow their waypoints: tracking errors by control step, and speed by number of agents.

    python tools/bench.py replay samples/crossing/truth.json scenario.json ...

Errors over all followers of a scenario, and the worst agent by each. Speed: cars on rings that change their speed, stepped
at 10 ms on one core; building the references (once, before the first step) and measuring the result are told apart.
"""

from __future__ import annotations

import statistics
import time
from itertools import pairwise
from pathlib import Path

import numpy as np

from benchmarks.table import markdown
from log2sim.datatypes import Agent, Scenario, Waypoints
from log2sim.geometry import wrap_angle
from log2sim.simulation.runner import replay

STEPS_S = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1)
LIMITS = {"cross_track_rms_m": 0.10, "cross_track_max_m": 0.35, "along_track_rms_m": 0.3, "speed_rms_mps": 0.3}
COUNTS, MODELS, SPEED_DT_S, DRIVE_S, LOG_S = (1, 10, 100, 1000), ("auto", "dynamic"), 0.01, 40.0, 0.1
SPEED_HEAD = ["model", "agents", "us a step", "agents x steps a second", "times real time", "s before", "s after", "whole replay"]  # fmt: skip


def main(scenarios: list[Path]) -> None:
    head = ["scenario", "dt ms", "followers", *(key.replace("_", " ") for key in LIMITS), "agents beyond a limit"]
    print(markdown(head, [tracking_row(path, dt_s) for path in scenarios for dt_s in STEPS_S]))
    rows = [speed_row(count, model) for model in MODELS for count in COUNTS]
    print(f"\n{markdown(SPEED_HEAD, rows)}")


def tracking_row(path: Path, dt_s: float) -> list[str]:
    """Errors of all followers at a control step, in brackets those of the worst agent, and which agents are beyond a limit."""
    done = replay(Scenario.load(path), dt_s=dt_s)
    own = {a.id: done.metrics["by_agent"][a.id] for a in done.agents if a.driver == "pid"}
    errors = [f"{done.metrics[key]:.3f} ({max(m[key] for m in own.values()):.3f})" if own else "-" for key in LIMITS]
    beyond = sorted(name for name, metrics in own.items() if any(metrics[k] > v for k, v in LIMITS.items()))
    return [path.name, f"{dt_s * 1e3:g}", str(len(own)), *errors, ", ".join(beyond) or "none"]


def ring_car(index: int, duration_s: float) -> Agent:
    """A car on a ring of its own, whose speed swings between 6 and 10 m/s; every fifth stops at its slowest."""
    t = np.arange(round(duration_s / LOG_S) + 1) * LOG_S
    speed = 8.0 + 2.0 * np.sin(0.3 * t + index)
    if index % 5 == 0:
        speed = np.maximum(3.0 * (speed - 7.0), 0.0)
    way = np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) / 2 * LOG_S)])
    radius, offset = 40.0 + index % 20, 1.3  # at most 2.5 m/s2 sideways
    yaw = way / radius
    x, y = radius * np.sin(yaw) + offset * np.cos(yaw), radius * (1 - np.cos(yaw)) + offset * np.sin(yaw)
    columns = (t, x + 150.0 * (index % 32), y + 150.0 * (index // 32), 0 * t, wrap_angle(yaw), speed)
    waypoints = Waypoints(*columns, observed=np.ones(len(t), dtype=bool), sigma_xy_m=np.full(len(t), 0.05))
    return Agent(f"car-{index}", "car", (4.4, 1.8, 1.5), waypoints, rear_axle_offset_m=offset)


def speed_row(count: int, model: str) -> list[str]:
    """Processor time that a replay of so many cars takes: by step in the long run, and around the steps."""
    scenario = Scenario("rings", 0, DRIVE_S, tuple(ring_car(k, DRIVE_S) for k in range(count)))
    told: list[tuple[int, float]] = []
    begin = time.process_time()
    done = replay(scenario, dt_s=SPEED_DT_S, model=model, progress=lambda n, _: told.append((n, time.process_time())))
    end = time.process_time()
    # The first stretch holds the references and the agents' arrivals; the others hold look-ups, control, model and storing.
    stretches = [(n1 - n0, t1 - t0) for (n0, t0), (n1, t1) in pairwise(told)]
    longest = max(count for count, _ in stretches)
    step_s = statistics.median(seconds / count for count, seconds in stretches if count == longest)
    before_s, after_s = told[0][1] - begin - told[0][0] * step_s, end - told[-1][1]
    return [
        f"{model}: {', '.join(sorted({a.model for a in done.agents}))}", str(count), f"{step_s * 1e6:.0f}", f"{count / step_s:,.0f}",
        f"{SPEED_DT_S / step_s:.0f}", f"{before_s:.2f}", f"{after_s:.2f}", f"{DRIVE_S / (end - begin):.1f}",
    ]  # fmt: skip
