"""Time and memory of an index of many scenarios, made on a local Dask cluster, and of the questions that it answers.

    python tools/bench.py find FOLDER --jobs 2

Each scenario is random traffic of its own seed (`tools/bench.py tags`), three vehicles and the ego for 8 s at 2 Hz, whose hard brakings are known.
All is written anew by each call; a question opens it as `log2sim find` does.
"""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path

from benchmarks.tag_worlds import traffic
from log2sim.batch.run import local_workers
from log2sim.files.cluster import map_on_workers
from log2sim.files.processes import map_in_processes
from log2sim.files.stages import cpu_seconds, peak_memory_mib
from log2sim.scenarios.index import INDEX_FILE, open_index
from log2sim.scenarios.query import ask

QUESTIONS = (
    "hard_braking",
    "cut_in and ttc_s < 2 and ego.speed_mps > 10",
    "cut_in and hard_braking.deceleration_mps2 > 5",
    "following and time_headway_s < 1 and agent.speed_mps > 20",
    "overtaking and not lane_change or near_miss",
)


def main(folder: Path, scenarios: int = 10_000, jobs: int = 2) -> None:
    """Write the scenarios, index them, ask and print what it took."""
    folder /= "scenarios"
    begin = spent_s()
    known = sum(map_in_processes(partial(write, folder), range(scenarios), jobs))
    print(f"written: {took(begin)}")
    begin = spent_s()
    with local_workers(jobs) as workers:
        index = open_index(folder, fresh=True, map_files=partial(map_on_workers, workers.client))
        peaks = workers.client.run(peak_memory_mib)
    print(
        f"{index.scenarios} scenarios indexed, {len(index.table)} tags, {len(index.problems)} left out: {took(begin)}"
    )
    print(f"memory: {peak_memory_mib():.0f} MiB, of a worker {max(peaks.values()):.0f} MiB")
    print(f"{INDEX_FILE}: {(folder / INDEX_FILE).stat().st_size / 1e6:.1f} MB; hard brakings made: {known}")
    for question in QUESTIONS:
        begin = spent_s()
        hits = len(ask(open_index(folder), question).rows)
        print(f"{took(begin)}, {hits} hits: {question}")


def write(folder: Path, seed: int) -> int:
    """Write the scenario of a seed; return how many hard brakings are in it."""
    path = folder / f"{seed // 1000:03}" / f"{seed:06}" / "scenario.json"
    world = traffic(seed, rate_hz=2.0, duration_s=8.0, count=4)
    path.parent.mkdir(parents=True, exist_ok=True)
    world.scenario.save(path)
    return sum(event.tag == "hard_braking" and event.sure for event in world.events)


def spent_s() -> tuple[float, float]:
    """Wall time and processor time of this process and of those that it waited for."""
    return time.perf_counter(), cpu_seconds()


def took(begin: tuple[float, float]) -> str:
    """The time since a moment, in words."""
    wall, cpu = (now - then for now, then in zip(spent_s(), begin))
    return f"{wall:.2f} s, CPU {cpu:.2f} s"
