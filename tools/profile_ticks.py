"""Where the time of a run goes, beside the floor: decoding its pictures and reading its clouds once.

    OPENBLAS_NUM_THREADS=1 python tools/profile_ticks.py LOG ... --detector NAME

Runs and floors take turns; medians of their wall and processor times are shown. The floor is measured with one thread and
with as many as there are cores. Processor time is told apart as seconds of the log (a fixed number of records is looked at: poses, clocks,
mounts, what is loaded), milliseconds of a tick, and seconds of 100 m of way (map and lanes). Kept detections are not used.
"""

from __future__ import annotations

import os
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks.table import markdown
from entry import run

from log2sim.config import Config
from log2sim.datatypes import Log
from log2sim.errors import Log2SimError
from log2sim.files.stages import cpu_seconds
from log2sim.logs.opening import open_log
from log2sim.perception.records import RecordSource
from log2sim.perception.sync import Schedule
from log2sim.pipeline import infer_scenario, observe_log, start
from log2sim.report import Run

DETECTORS = ("labels", "lidar:vehicle", "labels+lidar:vehicle", "ssd-mobilenet-v2+lidar:vehicle")
WARM_UP_TICKS = 4
# Stages that look at so many records of a log at most, and those that draw the ground along the way; all others go tick by tick.
OF_LOG, OF_WAY = ("poses", "calibration", "registration", "sync"), ("pictures", "lanes")


@dataclass
class Times:
    """Seconds on the wall and of the processor."""

    wall_s: float
    cpu_s: float


@dataclass
class Measured:
    """One run: its times, and those of its stages."""

    times: Times
    ticks: int
    way_m: float
    stages: dict[str, Times]


def times_of(call: Callable[[], Any]) -> tuple[Any, Times]:
    """What a call returns, and its times."""
    wall, cpu = time.perf_counter(), cpu_seconds()
    out = call()
    return out, Times(time.perf_counter() - wall, cpu_seconds() - cpu)


def records_of(schedule: Schedule) -> list[tuple[str, int]]:
    """The records that the ticks use, each once, in the order of the ticks."""
    found: dict[tuple[str, int], None] = {}
    for tick in range(len(schedule)):
        for name, index in schedule.frames.items():
            found[name, int(index[tick])] = None
        for name, rows in schedule.sweeps.items():
            for i in rows[:, tick].tolist():
                found[name, i] = None
    return [(name, i) for name, i in found if i >= 0]


def floor_of(log: Log, wanted: Sequence[tuple[str, int]], threads: int) -> Times:
    """Times to read and decode records with some threads."""
    records = RecordSource(log)

    def read_all() -> None:
        with ThreadPoolExecutor(threads) as pool:
            for _ in pool.map(lambda record: records.get(*record), wanted):
                pass

    return times_of(read_all)[1]


def measure(path: Path, config: Config, jobs: int | None = None) -> tuple[Measured, Schedule]:
    """Run all stages on a log that is opened anew."""
    log = open_log(path)

    def reconstruct() -> Run:
        run = start(log, config, cache=False, jobs=jobs)
        infer_scenario(run, observe_log(run))
        return run

    run, times = times_of(reconstruct)
    stages = {name: Times(seconds, run.clock.cpu_seconds[name]) for name, seconds in run.clock.seconds.items()}
    return Measured(times, len(run.schedule), way_of(run), stages), run.schedule


def way_of(run: Run) -> float:
    """How far the ego goes from the first to the last tick, m; 0 without known poses."""
    if run.log.ego is None:
        return 0.0
    poses, known = run.log.ego.at(run.schedule.t_ns)
    return float(np.linalg.norm(np.diff(poses[known, :3, 3], axis=0), axis=1).sum())


def config_of(log: Log, detector: str, ticks: int, settings: Sequence[str]) -> Config:
    """Settings of a run of the first ticks."""
    config = Config.load(None, settings, detect={"name": detector})
    if ticks:
        cameras = list(log.cameras) if config.detect.in_images else []
        preferred = log.reference_camera if log.reference_camera in cameras else None
        most = max(log.lidars, key=lambda name: len(log.streams[name].t_ns), default="")
        t_ns = log.streams[preferred or (cameras[0] if cameras else most)].t_ns
        last = min(ticks, len(t_ns)) - 1
        return config.changed(stop_s=float(t_ns[last] - t_ns[0]) * 1e-9 + 1e-4)
    return config


def profile(
    path: Path, detectors: Sequence[str], ticks: int, repeats: int, jobs: int | None, settings: Sequence[str]
) -> Iterator[dict[str, Any]]:
    """Figures of a log with each detector."""
    log, threads = open_log(path), sorted({1, len(os.sched_getaffinity(0))})
    configs: dict[str, Config] = {}
    for detector in detectors:
        try:
            measure(path, config_of(log, detector, WARM_UP_TICKS, settings))
            configs[detector] = config_of(log, detector, ticks, settings)
        except Log2SimError as problem:
            print(f"{log.name}, {detector}: left out: {problem}", file=sys.stderr)
    runs: dict[str, list[Measured]] = {name: [] for name in configs}
    floors: dict[str, dict[int, list[Times]]] = {name: {n: [] for n in threads} for name in configs}
    for _ in range(repeats):
        for name, config in configs.items():
            measured, schedule = measure(path, config, jobs)
            runs[name].append(measured)
            for count, of in floors[name].items():
                of.append(floor_of(open_log(path), records_of(schedule), count))
    for name, of_name in runs.items():
        yield figures(log, name, of_name, floors[name])


def figures(log: Log, detector: str, runs: list[Measured], floors: dict[int, list[Times]]) -> dict[str, Any]:
    """Medians of the runs and floors of one detector; ms are a tick."""
    ticks = runs[0].ticks

    def ms(values: list[float]) -> float:
        return round(1e3 * statistics.median(values) / ticks, 2)

    wall, cpu = ms([r.times.wall_s for r in runs]), ms([r.times.cpu_s for r in runs])
    floor = {n: {"wall": ms([t.wall_s for t in f]), "cpu": ms([t.cpu_s for t in f])} for n, f in floors.items()}
    of_way = statistics.median(sum(r.stages[k].cpu_s for k in OF_WAY if k in r.stages) for r in runs)
    each = [sum(v.cpu_s for k, v in r.stages.items() if k not in (*OF_LOG, *OF_WAY)) for r in runs]
    fixed_s = statistics.median(r.times.cpu_s - e for r, e in zip(runs, each)) - of_way
    detecting = ms([r.stages["detect"].cpu_s for r in runs]) if "detect" in runs[0].stages else 0.0
    return {
        "log": log.name,
        "detector": detector,
        "ticks": ticks,
        "repeats": len(runs),
        "ticks_per_second": round(1e3 / wall, 2),
        "wall_ms": wall,
        "cpu_ms": cpu,
        "cpu_of_log_s": round(fixed_s, 2),
        "cpu_of_tick_ms": ms(each),
        "cpu_of_100_m_s": round(100 * of_way / runs[0].way_m, 2) if runs[0].way_m else None,
        "detector_cpu_ms": round(detecting, 2),
        "floor_ms": floor,
        "cpu_over_floor": round(cpu / floor[1]["cpu"], 2),
        "without_detector_over_floor": round((cpu - detecting) / floor[1]["cpu"], 2),
        "stages_ms": {
            k: {"wall": ms([r.stages[k].wall_s for r in runs]), "cpu": ms([r.stages[k].cpu_s for r in runs])}
            for k in runs[0].stages
        },
    }


def show(found: list[dict[str, Any]]) -> str:
    """Tables of rates and stages."""
    rates, rest = [], []
    for f in found:
        one, most = min(f["floor_ms"]), max(f["floor_ms"])
        rates.append([
            f["log"], f"`{f['detector']}`", str(f["ticks"]), f"{f['ticks_per_second']:.2f}", f"{f['wall_ms']:.0f}",
            f"{f['cpu_ms']:.0f}", f"{f['cpu_of_log_s']:.2f}", f"{f['cpu_of_tick_ms']:.0f}", f"{f['cpu_of_100_m_s']}",
            f"{f['detector_cpu_ms']:.0f}", f"{f['floor_ms'][one]['cpu']:.0f}",
            f"{f['floor_ms'][most]['wall']:.0f}", f"{f['cpu_over_floor']:.2f}",
            f"{f['without_detector_over_floor']:.2f}",
        ])  # fmt: skip
        rest.append(f"\n{f['log']}, `{f['detector']}`, ms a tick\n")
        stages = f["stages_ms"].items()
        rest.append(markdown(["stage", "wall", "cpu"], [[k, f"{v['wall']:.1f}", f"{v['cpu']:.1f}"] for k, v in stages]))
    head = [
        "log", "detector", "ticks", "ticks/s", "wall ms", "cpu ms", "s a log", "ms a tick", "s a 100 m", "detector cpu", "floor cpu", "floor wall, all threads",
        "cpu / floor", "without detector / floor",
    ]  # fmt: skip
    return "\n".join([markdown(head, rates), *rest])


def main(
    logs: list[Path], detector: list[str] = list(DETECTORS), ticks: int = 0, repeats: int = 3, jobs: int | None = None, set: list[str] = [],
) -> None:  # fmt: skip
    """Print the tables of the first ticks of logs, or of all, by so many processes; `set` SECTION.KEY=VALUE as of reconstruct."""
    if os.environ.get("OPENBLAS_NUM_THREADS") != "1":
        print("OPENBLAS_NUM_THREADS is not 1: times will swing", file=sys.stderr)
    print(show([found for path in logs for found in profile(path, detector, ticks, repeats, jobs, set)]))


if __name__ == "__main__":
    run(main, __doc__)
