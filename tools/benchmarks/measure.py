"""What each way of measuring is worth: error of place, size and yaw by range, `paper` beside `robust`, on logs with labels.

    python tools/bench.py measure LOG ...

Every measurement is compared with the nearest labeled object of its kind within 4 m; yaw counts up to half turns. NEES is
the squared error over its covariance and dimensions: 1 where the covariance is honest.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.table import markdown
from log2sim import Config, Scenario, open_log
from log2sim.datatypes import GROUP_OF, Log, Measurements
from log2sim.evaluation.metrics.truth import truth_from_log
from log2sim.files.stages import StageClock
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
    """Print one table a log."""
    for path in logs:
        log = open_log(path)
        truth = Scenario.load(path / "truth.json") if (path / "truth.json").exists() else truth_from_log(log)
        rows = []
        for mode in ("paper", "robust"):
            errors = list(_errors(_measured(log, mode), truth))
            for low, high in RANGES_M:
                rows.append([mode, f"{low:g}-{high:g}", *_figures([e for e in errors if low <= e["range_m"] < high])])
        print(f"{log.name}: boxes of the log, vehicles\n{markdown(['mode', 'range m', *COLUMNS], rows)}\n")


def _measured(log: Log, mode: str) -> Sequence[Measurements]:
    config = Config.load(detect={"name": "labels"}, measure={"mode": mode})
    cameras = tuple(log.cameras)
    schedule = synchronize(log, cameras)
    detector = create_detector(config.detect.name, log)
    plan = make_plan(log, config, select_sensors(log, config), schedule.t_ns)
    detectors = Detectors(detector, None)
    return observe(log, schedule, plan, detectors=detectors, config=config, clock=StageClock()).measurements


def _errors(measured: Sequence[Measurements], truth: Scenario) -> Iterator[dict[str, Any]]:
    agents = [a for a in truth.others if GROUP_OF[a.category] == "vehicle"]
    for rows in measured:
        for i in range(len(rows)):
            if rows.source[i] == "lidar" and GROUP_OF[str(rows.category[i])] == "vehicle":
                yield _error(rows, i, agents, truth.t0_ns)


def _error(rows: Measurements, i: int, agents: Sequence[Any], t0_ns: int) -> dict[str, Any]:
    """Errors of one row; of none but the range where no labeled object is near."""
    place = rows.center_m[i, :2]
    toward = place - rows.sensor_m[i, :2]
    out: dict[str, Any] = {"range_m": float(np.hypot(*toward)), "found": False}
    best = NEAREST_M
    for agent in agents:
        state = agent.at((rows.t_ns[i] - t0_ns) / 1e9, margin_s=0.1)
        if not state.valid[0]:
            continue
        error = place - [state.x_m[0], state.y_m[0]]
        if np.hypot(*error) < best:
            best = float(np.hypot(*error))
            size = np.abs(provisional_sizes(rows)[i] - agent.size_m[:2])
            turn = (rows.yaw_rad[i] - state.yaw_rad[0] + np.pi / 2) % np.pi - np.pi / 2
            out |= {
                "found": True, "error_m": best, "depth_m": float(error @ toward) / out["range_m"],
                "size_m": float(np.mean(size)), "yaw_deg": float(np.degrees(abs(turn))),
                "nees": float(error @ np.linalg.solve(rows.covariance[i], error)) / 2,
            }  # fmt: skip
    return out


def _figures(rows: Sequence[dict[str, Any]]) -> list[str]:
    found = [r for r in rows if r["found"]]
    if not found:
        return [str(len(rows)), "0", *["-"] * (len(COLUMNS) - 2)]
    column = {k: np.array([r[k] for r in found]) for k in ("error_m", "depth_m", "size_m", "yaw_deg", "nees")}
    return [
        str(len(rows)),
        f"{len(found) / len(rows):.2f}",
        f"{np.median(column['error_m']):.2f}",
        f"{np.sqrt(np.mean(column['error_m'] ** 2)):.2f}",
        f"{np.median(column['depth_m']):+.2f}",
        f"{np.median(column['size_m']):.2f}",
        f"{np.median(column['yaw_deg']):.1f}",
        f"{np.mean(column['nees']):.1f}",
        f"{np.median(column['nees']):.2f}",
    ]
