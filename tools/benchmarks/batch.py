"""Rate, failures, memory and overhead of `log2sim batch` on many small logs that are written for it.

    python tools/bench.py batch FOLDER --logs 10000 --jobs 2
    python tools/bench.py batch FOLDER --logs 1000 --jobs 2 --scenarios

One short drive is synthesized; each log is a copy of it at another time and place, with records that are links to the same files, so that
10,000 logs take seconds to write. All of them must give the same number of agents, but for those that are damaged on purpose.
With --scenarios it replays scenarios of random traffic instead, eight vehicles over 20 s, a hundred of them different.
FOLDER/logs is written once; FOLDER/out goes on where an earlier call was stopped, so remove it for a new measurement.
"""

from __future__ import annotations

import os
import resource
import shutil
import time
from collections import Counter
from pathlib import Path
from typing import Any

from worlds import CAR, tiny_table

from benchmarks.tag_worlds import traffic
from log2sim.batch import plan_batch, run_batch
from log2sim.batch.discovery import SCENARIO
from log2sim.batch.folder import sum_up
from log2sim.batch.run import local_workers
from log2sim.cli.progress import progress
from log2sim.config import Config
from log2sim.logs.native.writer import write_log
from log2sim.scenarios.index import SCENARIO_FILE
from log2sim.synth.scene import scene_from_table
from log2sim.synth.synthesis import synthesize

LIDAR = {"channels": 16, "elevation_deg": [-15.0, 3.0], "azimuth_deg": [-40.0, 40.0]}
SCENE: dict[str, Any] = {
    "name": "short", "duration_s": 0.5, "ego": {"waypoints": [[0.0, 0.0, 5.0], [20.0, 0.0, 5.0]], "poses": "poses"},
    "agent": [{**CAR, "waypoints": [[16.0, 2.0, 6.0], [40.0, 2.0, 6.0]]}],
    "camera": [{"name": "front", "position_m": [1.7, 0.0, 1.5], "size_px": [320, 200]}],
    "lidar": [{**tiny_table()["lidar"][0], **LIDAR}],
}  # fmt: skip
SETTINGS = ("map.lanes=false", "appearance.colors=false", "appearance.signals=false")
SHIFTED = {"t_ns": 10**12, "x_m": 7.0, "y_m": -7.0}  # between a log and the next one
DAMAGED, DIFFERENT = 10, 100


def main(folder: Path, logs: int = 10_000, jobs: int = 2, scenarios: bool = False) -> None:
    """Write the logs, of which ten have an index that is cut off, run them and print a table."""
    root = folder / "logs"
    if not root.exists() and scenarios:
        for k in range(logs):
            (root / f"{k:06d}").mkdir(parents=True)
            if k < DIFFERENT:
                traffic(k, count=8, duration_s=20.0).scenario.save(root / f"{k:06d}" / SCENARIO_FILE)
            else:
                os.link(root / f"{k % DIFFERENT:06d}" / SCENARIO_FILE, root / f"{k:06d}" / SCENARIO_FILE)
    elif not root.exists():
        write_logs(root, logs)
    for name, value in measure(root, folder / "out", jobs, SCENARIO if scenarios else "auto").items():
        print(f"{name:32}  {value}")


def write_logs(root: Path, count: int) -> None:
    """Write so many logs, of which some are damaged."""
    began, unfinished, base = time.perf_counter(), root.with_name(f"{root.name}.part"), root.with_name("drive")
    for left in (unfinished, base):
        shutil.rmtree(left, ignore_errors=True)
    log, _ = synthesize(scene_from_table(tiny_table(**SCENE)))
    write_log(log, base)
    tables = {path.relative_to(base): path.read_text() for path in base.rglob("*.csv")}
    records = [path.relative_to(base) for path in base.rglob("*") if path.suffix in (".npz", ".jpg")]
    spoiled = set(range(count - 1, -1, -max(count // DAMAGED, 1))[:DAMAGED])
    for k in range(count):
        target = unfinished / f"drive-{k:06d}"
        for name, text in tables.items():
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            (target / name).write_text(shifted(text, k))
        for name in records:
            os.link(base / name, target / name)
        manifest = (base / "log.json").read_text()
        (target / "log.json").write_text(manifest[: len(manifest) // 2] if k in spoiled else manifest)
    unfinished.rename(root)
    print(f"{count} logs written in {time.perf_counter() - began:.1f} s, {len(spoiled)} of them damaged")


def shifted(table: str, steps: int) -> str:
    """Return a table of CSV with stamps and places that are so many steps later and farther."""
    head, *lines = table.splitlines()
    names = head.split(",")

    def moved(name: str, text: str) -> str:
        if name not in SHIFTED:
            return text
        return str((int if name == "t_ns" else float)(text) + steps * SHIFTED[name])

    rows = [",".join(map(moved, names, line.split(","))) for line in lines]
    return "\n".join([head, *rows]) + "\n"


def measure(root: Path, out: Path, jobs: int, format: str) -> dict[str, str]:
    """Run the batch: what ran, how fast, and what it cost beside the logs themselves."""
    began = time.perf_counter()
    batch = plan_batch(root, out, Config.load(None, SETTINGS, detect={"name": "lidar:labels"}), format=format)
    found_s, missing = time.perf_counter() - began, {job.name for job in batch.missing}

    def spent() -> list[float]:
        used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
        return [time.perf_counter(), *(u.ru_utime + u.ru_stime for u in used)]

    before = spent()
    with progress() as report:
        rows = run_batch(batch, lambda: local_workers(jobs), progress=lambda done, total: report("logs", done, total))
    wall, own, workers = (b - a for a, b in zip(before, spent()))
    rows = [row for row in rows if row.name in missing]
    count, sums = len(rows), sum_up(rows)
    in_logs = sum(row.cpu_s or 0.0 for row in rows)
    peaks = [row.peak_memory_mib for row in rows if row.peak_memory_mib is not None]
    kinds = Counter(row.error_kind for row in rows if not row.is_done)
    failed = ", ".join(f"{count} {kind}" for kind, count in sorted(kinds.items())) or "none"
    return {
        "logs run": f"{count}, {sums['done']:.0f} done, {sums['failed']:.0f} failed ({failed})",
        "run twice": str(sum(row.attempts > 1 for row in rows)),
        "agents a log": ", ".join(map(str, sorted({row.agents for row in rows if row.agents is not None}))),
        "finding the logs": f"{found_s:.1f} s",
        "wall time": f"{wall:.1f} s, {count / wall:.1f} logs/s with {jobs} workers",
        "CPU time": f"{own + workers:.1f} s",
        "of a log": f"{1000 * in_logs / count:.1f} ms",
        "of a worker beside the logs": f"{1000 * (workers - in_logs) / count:.1f} ms a log, its start among them",
        "of client and scheduler": f"{1000 * own / count:.2f} ms a log",
        "memory of client and scheduler": f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MiB",
        "memory of a worker": f"{max(peaks[: len(peaks) // 10 or 1]):.0f} MiB in the first tenth, {max(peaks):.0f} MiB in all",
    }
