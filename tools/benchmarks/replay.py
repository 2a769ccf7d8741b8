"""How well and how fast agents follow their waypoints: tracking errors by control step, and speed by number of agents.

python tools/bench.py replay [SCENARIO ...] [--dt SECONDS ...] [--agents N ...] [--models NAME ...] [--out FILE.json]

Errors over all followers of a scenario, and the worst agent by each. Speed: cars on rings that change their speed, stepped
at 10 ms on one core; building the references (once, before the first step) and measuring the result are told apart.
"""

from __future__ import annotations

import json
import statistics
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from entry import parser_of

from benchmarks.table import markdown
from log2sim.datatypes import Agent, Scenario, Waypoints
from log2sim.geometry import wrap_angle
from log2sim.simulation.runner import replay

SAMPLE = Path(__file__).resolve().parents[2] / "samples" / "crossing" / "truth.json"
STEPS_S = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1)
LIMITS = {"cross_track_rms_m": 0.10, "cross_track_max_m": 0.35, "along_track_rms_m": 0.3, "speed_rms_mps": 0.3}
COUNTS = (1, 10, 100, 1000)
MODELS = ("auto", "dynamic")
SPEED_DT_S = 0.01
DRIVE_S = 40.0
LOG_S = 0.1


def main(arguments: list[str] | None = None) -> int:
    """Measure, print both tables and write the rows; 1 when an error of all followers together is beyond its limit."""
    parser = parser_of(__doc__)
    parser.add_argument("scenarios", nargs="*", type=Path, help="scenario files; the sample's truth by default")
    parser.add_argument("--dt", nargs="*", type=float, default=STEPS_S, help="control steps in s")
    parser.add_argument(
        "--agents", nargs="*", type=int, default=COUNTS, help="numbers of agents whose speed is measured"
    )
    parser.add_argument("--models", nargs="*", default=MODELS, help="vehicle models whose speed is measured")
    parser.add_argument("--out", type=Path, help="also write the rows here")
    options = parser.parse_args(arguments)
    tracking = [row for path in options.scenarios or [SAMPLE] for row in tracking_rows(path, options.dt)]
    print(tracking_table(tracking))
    speed = [speed_row(count, model) for model in options.models for count in options.agents]
    print(f"\n{speed_table(speed)}")
    if options.out:
        options.out.write_text(json.dumps({"tracking": tracking, "speed": speed}, indent=1) + "\n", encoding="utf-8")
    return int(any(row[key] > limit for row in tracking for key, limit in LIMITS.items()))


def tracking_rows(path: Path, steps_s: list[float]) -> list[dict[str, Any]]:
    """Errors of a scenario at control steps: of all followers, of the worst one, and which agents are beyond a limit."""
    scenario, rows = Scenario.load(path), []
    for dt_s in steps_s:
        done = replay(scenario, dt_s=dt_s)
        followers = [a.id for a in done.agents if a.driver == "pid"]
        by_agent = {k: done.metrics["by_agent"][k] for k in followers}
        worst = {key: max(by_agent, key=lambda k, key=key: by_agent[k][key], default=None) for key in LIMITS}
        rows.append(
            {
                "scenario": path.name,
                "dt_s": dt_s,
                "followers": len(followers),
                **{key: done.metrics[key] for key in LIMITS},
                "worst": {key: {"agent": k, "value": by_agent[k][key]} for key, k in worst.items() if k},
                "beyond": sorted(k for k in followers if any(by_agent[k][key] > v for key, v in LIMITS.items())),
            }
        )
    return rows


def tracking_table(rows: list[dict[str, Any]]) -> str:
    """The rows as Markdown: each error of all followers, and in brackets that of the worst agent."""
    head = ["scenario", "dt ms", "followers", *(key.replace("_", " ") for key in LIMITS), "agents beyond a limit"]
    lines = []
    for row in rows:
        errors = [f"{row[k]:.3f} ({row['worst'][k]['value']:.3f})" if k in row["worst"] else "-" for k in LIMITS]
        beyond = ", ".join(row["beyond"]) or "none"
        lines.append([row["scenario"], f"{row['dt_s'] * 1e3:g}", str(row["followers"]), *errors, beyond])
    return markdown(head, lines)


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


def speed_row(count: int, model: str = "auto", duration_s: float = DRIVE_S) -> dict[str, Any]:
    """Seconds of processor time that a replay of so many cars takes: by step in the long run, and around the steps."""
    scenario = Scenario("rings", 0, duration_s, tuple(ring_car(k, duration_s) for k in range(count)))
    told: list[tuple[int, float]] = []
    begin = time.process_time()
    done = replay(
        scenario, dt_s=SPEED_DT_S, model=model, progress=lambda steps, _: told.append((steps, time.process_time()))
    )
    end = time.process_time()
    # The first stretch holds the references and the agents' arrivals; the others hold look-ups, control, model and storing.
    stretches = [(n1 - n0, t1 - t0) for (n0, t0), (n1, t1) in pairwise(told)]
    longest = max(count for count, _ in stretches)
    step_s = statistics.median(seconds / count for count, seconds in stretches if count == longest)
    return {
        "agents": count,
        "model": model,
        "moved_by": sorted({a.model for a in done.agents}),
        "dt_s": SPEED_DT_S,
        "step_us": step_s * 1e6,
        "agent_steps_per_s": count / step_s,
        "times_real_time": SPEED_DT_S / step_s,
        "before_s": told[0][1] - begin - told[0][0] * step_s,
        "after_s": end - told[-1][1],
        "whole_times_real_time": duration_s / (end - begin),
    }


def speed_table(rows: list[dict[str, Any]]) -> str:
    """The rows as Markdown."""
    head = [
        "model",
        "agents",
        "us a step",
        "agents x steps a second",
        "times real time",
        "s before",
        "s after",
        "whole replay",
    ]
    return markdown(
        head,
        [
            [
                f"{row['model']}: {', '.join(row['moved_by'])}", str(row["agents"]), f"{row['step_us']:.0f}", f"{row['agent_steps_per_s']:,.0f}", f"{row['times_real_time']:.0f}",
                f"{row['before_s']:.2f}", f"{row['after_s']:.2f}", f"{row['whole_times_real_time']:.1f}",
            ]
            for row in rows
        ],
    )  # fmt: skip
