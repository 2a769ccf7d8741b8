"""Time and memory of an index of many scenarios, made on a local Dask cluster, and of the questions that it answers.

    python tools/bench.py find FOLDER [--scenarios 10000] [--jobs 2]

Each scenario is random traffic of its own seed (`tools/bench.py tags`), three vehicles and the ego for 8 s at 2 Hz, whose hard brakings are known.
All is written anew by each call; a question opens it as `log2sim find` does.
"""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path

from entry import parser_of

from benchmarks.tags import traffic
from log2sim.batch.run import local_workers
from log2sim.cli.situations import map_on_workers
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


def main(arguments: list[str] | None = None) -> None:
    """Write the scenarios, index them, ask and print a table."""
    parser = parser_of(__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scenarios", type=int, default=10_000)
    parser.add_argument("--jobs", type=int, default=2)
    asked = parser.parse_args(arguments)
    folder = asked.folder / "scenarios"
    begin = spent_s()
    known = sum(map_in_processes(partial(write, folder), range(asked.scenarios), asked.jobs))
    say("written", begin)
    begin = spent_s()
    with local_workers(asked.jobs) as workers:
        index = open_index(folder, fresh=True, map_files=partial(map_on_workers, workers.client))
        peaks = workers.client.run(peak_memory_mib)
    say(f"{index.scenarios} scenarios indexed, {len(index.table)} tags, {len(index.problems)} left out", begin)
    print(f"memory: {peak_memory_mib():.0f} MiB, of a worker {max(peaks.values()):.0f} MiB")
    print(f"{INDEX_FILE}: {(folder / INDEX_FILE).stat().st_size / 1e6:.1f} MB; hard brakings made: {known}")
    for question in QUESTIONS:
        begin, wall = time.process_time(), time.perf_counter()
        index = open_index(folder)
        opened = time.perf_counter()
        hits = len(ask(index, question).rows)
        wall, opened = time.perf_counter() - wall, time.perf_counter() - opened
        print(
            f"{wall:.2f} s, {opened:.2f} s of it after opening, CPU {time.process_time() - begin:.2f} s, {hits} hits: {question}"
        )


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


def say(what: str, begin: tuple[float, float]) -> None:
    """Print the time since a moment."""
    wall, cpu = (now - then for now, then in zip(spent_s(), begin))
    print(f"{what}: {wall:.1f} s, CPU {cpu:.1f} s")
