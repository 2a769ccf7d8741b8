"""Where the time of a run goes, beside the floor: decoding its pictures and reading its clouds once.

    OPENBLAS_NUM_THREADS=1 python tools/profile_ticks.py LOG ... --detector NAME

Runs and floors take turns; medians of their wall and processor times are shown, in milliseconds a tick. The floor is measured with one
thread and with as many as there are cores. Kept detections are not used.
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

from benchmarks.table import markdown
from entry import run

from log2sim.config import Config
from log2sim.errors import Log2SimError
from log2sim.files.stages import cpu_seconds
from log2sim.logs.opening import open_log
from log2sim.perception.records import RecordSource
from log2sim.perception.sync import Schedule
from log2sim.pipeline import infer_scenario, observe_log, start
from log2sim.report import Run

DETECTORS = ("labels", "lidar:vehicle", "labels+lidar:vehicle", "ssd-mobilenet-v2+lidar:vehicle")
WARM_UP_S = 0.4
HEAD = [
    "log", "detector", "ticks", "ticks/s", "wall ms", "cpu ms", "detector cpu", "floor cpu", "floor wall, all threads", "cpu / floor",
    "without detector / floor",
]  # fmt: skip


Times = tuple[float, float]  # seconds on the wall and of the processor


@dataclass
class Measured:
    """One run: its times, and those of its stages."""

    times: Times
    ticks: int
    stages: dict[str, Times]


def times_of(call: Callable[[], Any]) -> tuple[Any, Times]:
    """What a call returns, and its times."""
    wall, cpu = time.perf_counter(), cpu_seconds()
    out = call()
    return out, (time.perf_counter() - wall, cpu_seconds() - cpu)


def floor_of(path: Path, schedule: Schedule, threads: int) -> Times:
    """Times to read and decode the records that the ticks use, each once and in the order of the ticks, with some threads."""
    found: dict[tuple[str, int], None] = {}
    for tick in range(len(schedule)):
        for name, index in schedule.frames.items():
            found[name, int(index[tick])] = None
        for name, rows in schedule.sweeps.items():
            for i in rows[:, tick].tolist():
                found[name, i] = None
    wanted, records = [record for record in found if record[1] >= 0], RecordSource(open_log(path))

    def read_all() -> None:
        with ThreadPoolExecutor(threads) as pool:
            for _ in pool.map(lambda record: records.get(*record), wanted):
                pass

    return times_of(read_all)[1]


def measure(path: Path, config: Config) -> tuple[Measured, Schedule]:
    """Run all stages on a log that is opened anew."""
    log = open_log(path)

    def reconstruct() -> Run:
        run = start(log, config, cache=False)
        infer_scenario(run, observe_log(run))
        return run

    run, times = times_of(reconstruct)
    stages = {name: (seconds, run.clock.cpu_seconds[name]) for name, seconds in run.clock.seconds.items()}
    return Measured(times, len(run.schedule), stages), run.schedule


def profile(path: Path, detectors: Sequence[str], repeats: int) -> Iterator[tuple[list[str], str]]:
    log, threads = open_log(path), sorted({1, len(os.sched_getaffinity(0))})
    configs: dict[str, Config] = {}
    for detector in detectors:
        config = Config.load(detect={"name": detector})
        try:
            measure(path, config.changed(stop_s=WARM_UP_S))
            configs[detector] = config
        except Log2SimError as problem:
            print(f"{log.name}, {detector}: left out: {problem}", file=sys.stderr)
    runs: dict[str, list[Measured]] = {name: [] for name in configs}
    floors: dict[str, dict[int, list[Times]]] = {name: {n: [] for n in threads} for name in configs}
    for _ in range(repeats):
        for name, config in configs.items():
            measured, schedule = measure(path, config)
            runs[name].append(measured)
            for count, of in floors[name].items():
                of.append(floor_of(path, schedule, count))
    for name, of_name in runs.items():
        yield figures(log.name, name, of_name, floors[name])


def figures(log: str, detector: str, runs: list[Measured], floors: dict[int, list[Times]]) -> tuple[list[str], str]:
    """Medians of the runs and floors of one detector: a row of the table, and a table of its stages."""

    def ms(times: Sequence[Times]) -> list[float]:
        return [1e3 / runs[0].ticks * statistics.median(of) for of in zip(*times)]

    (wall, cpu), floor, most = ms([r.times for r in runs]), ms(floors[1])[1], ms(floors[max(floors)])[0]
    stages = {name: ms([r.stages[name] for r in runs]) for name in runs[0].stages}
    detecting = stages.get("detect", [0.0, 0.0])[1]
    row = [
        log, f"`{detector}`", str(runs[0].ticks), f"{1e3 / wall:.2f}", *(f"{v:.0f}" for v in (wall, cpu, detecting, floor, most)),
        f"{cpu / floor:.2f}", f"{(cpu - detecting) / floor:.2f}",
    ]  # fmt: skip
    table = markdown(["stage", "wall", "cpu"], [[name, *(f"{v:.1f}" for v in of)] for name, of in stages.items()])
    return row, f"\n{log}, `{detector}`, ms a tick\n\n{table}"


def main(logs: list[Path], detector: list[str] = list(DETECTORS), repeats: int = 3) -> None:
    if os.environ.get("OPENBLAS_NUM_THREADS") != "1":
        print("OPENBLAS_NUM_THREADS is not 1: times will swing", file=sys.stderr)
    found = [one for path in logs for one in profile(path, detector, repeats)]
    print(markdown(HEAD, [row for row, _ in found]), *(stages for _, stages in found), sep="\n")


if __name__ == "__main__":
    run(main, __doc__)
