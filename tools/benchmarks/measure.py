"""What each way of measuring is worth: error of place, size and yaw by range, `paper` beside `robust`, on logs with labels.

    python tools/bench.py measure LOG ...

Every measurement is compared with the nearest labeled object of its kind within 4 m; yaw counts up to half turns. NEES is
the squared error over its covariance and dimensions: 1 where the covariance is honest.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.table import markdown
from log2sim import Config, Scenario, open_log
from log2sim.datatypes import GROUP_OF, Agent, Measurements
from log2sim.evaluation.metrics.truth import truth_from_log
from log2sim.files.stages import StageClock
from log2sim.geometry import Array
from log2sim.perception.boxes import provisional_sizes
from log2sim.perception.detect.detectors import create_detector
from log2sim.perception.first_pass import observe
from log2sim.perception.run_detectors import Detectors
from log2sim.perception.sync import synchronize
from log2sim.plan import make_plan, select_sensors

NEAREST_M = 4.0
RANGES_M = ((0.0, 20.0), (20.0, 40.0), (40.0, 60.0))
COLUMNS = ("rows", "found", "median m", "RMSE m", "depth m", "size m", "yaw deg", "NEES", "median")


def main(logs: list[Path]) -> None:
    for path in logs:
        log = open_log(path)
        truth = Scenario.load(path / "truth.json") if (path / "truth.json").exists() else truth_from_log(log)
        vehicles = [a for a in truth.others if GROUP_OF[a.category] == "vehicle"]
        rows = []
        for mode in ("paper", "robust"):
            config = Config.load(detect={"name": "labels"}, measure={"mode": mode})
            schedule = synchronize(log, tuple(log.cameras))
            plan = make_plan(log, config, select_sensors(log, config), schedule.t_ns)
            detectors = Detectors(create_detector("labels", log), None)
            seen = observe(log, schedule, plan, detectors=detectors, config=config, clock=StageClock()).measurements
            errors = np.array([
                error_of(m, i, vehicles, truth.t0_ns) for m in seen for i in range(len(m))
                if m.source[i] == "lidar" and GROUP_OF[str(m.category[i])] == "vehicle"
            ]).reshape(-1, 6)  # fmt: skip
            for low, high in RANGES_M:
                within = errors[(errors[:, 0] >= low) & (errors[:, 0] < high), 1:]
                rows.append([mode, f"{low:g}-{high:g}", *figures(within)])
        print(f"{log.name}: boxes of the log, vehicles\n{markdown(['mode', 'range m', *COLUMNS], rows)}\n")


def error_of(rows: Measurements, i: int, agents: Sequence[Agent], t0_ns: int) -> list[float]:
    """Range of a row, and the errors of its place, depth, size and yaw and its NEES, which are NaN where no labeled object is near."""
    place = rows.center_m[i, :2]
    toward = place - rows.sensor_m[i, :2]
    away = float(np.hypot(*toward))
    best, out = NEAREST_M, [np.nan] * 5
    for agent in agents:
        state = agent.at((rows.t_ns[i] - t0_ns) / 1e9, margin_s=0.1)
        error = place - [state.x_m[0], state.y_m[0]]
        if state.valid[0] and np.hypot(*error) < best:
            best = float(np.hypot(*error))
            size = np.abs(provisional_sizes(rows)[i] - agent.size_m[:2])
            turn = (rows.yaw_rad[i] - state.yaw_rad[0] + np.pi / 2) % np.pi - np.pi / 2
            nees = float(error @ np.linalg.solve(rows.covariance[i], error)) / 2
            out = [best, float(error @ toward) / away, float(np.mean(size)), float(np.degrees(abs(turn))), nees]
    return [away, *out]


def figures(errors: Array) -> list[str]:
    """A row of the table from the errors (N, 5) of some measurements."""
    found = errors[np.isfinite(errors[:, 0])]
    if not len(found):
        return [str(len(errors)), "0", *["-"] * (len(COLUMNS) - 2)]
    place, depth, size, yaw, nees = np.median(found, axis=0)
    rmse, mean = np.sqrt(np.mean(found[:, 0] ** 2)), np.mean(found[:, 4])
    shares = f"{len(found) / len(errors):.2f}", f"{place:.2f}", f"{rmse:.2f}", f"{depth:+.2f}", f"{size:.2f}"
    return [str(len(errors)), *shares, f"{yaw:.1f}", f"{mean:.1f}", f"{nees:.2f}"]
