"""Time and memory of every stage, taken around it, and how many threads a process may use."""

from __future__ import annotations

import os
import resource
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


class StageClock:
    """Adds up the time of named stages; a stage inside another stops the outer one's clock.

    Not for use from several threads: what a worker does in the background is not a stage's time but its waiting is.

    `seconds`: by stage, on the wall. `cpu_seconds`: by stage, of the processor; what threads spend meanwhile counts, and
    processes that end meanwhile.
    `peak_mib`: largest resident memory of the process up to the end of each stage, MiB.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.cpu_seconds: dict[str, float] = {}
        self.peak_mib: dict[str, float] = {}
        self._running: list[tuple[str, float, float]] = []
        self._start = time.perf_counter()

    @contextmanager
    def stage(self, name: str, progress: Callable[[str, int, int], None] | None = None) -> Iterator[None]:
        """Count the time of the block for `name`; `progress`, if given, is told when it begins: `progress(name, 0, 0)`."""
        if progress is not None:
            progress(name, 0, 0)
        if self._running:
            self._add()
        self._running.append((name, time.perf_counter(), cpu_seconds()))
        try:
            yield
        finally:
            self._add()
            self._running.pop()
            self.peak_mib[name] = peak_memory_mib()
            if self._running:
                self._running[-1] = (self._running[-1][0], time.perf_counter(), cpu_seconds())

    def add(self, other: StageClock, jobs: int) -> None:
        """Add what another clock counted in one of several processes, which run side by side: their share on the wall."""
        for name, seconds in other.seconds.items():
            self.seconds[name] = self.seconds.get(name, 0.0) + seconds / jobs
            self.cpu_seconds[name] = self.cpu_seconds.get(name, 0.0) + other.cpu_seconds[name]
            self.peak_mib[name] = max(self.peak_mib.get(name, 0.0), other.peak_mib[name])

    def _add(self) -> None:
        """Add what the innermost stage took since it was entered or went on."""
        name, since, cpu_since = self._running[-1]
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - since
        self.cpu_seconds[name] = self.cpu_seconds.get(name, 0.0) + cpu_seconds() - cpu_since

    def table(self, ticks: int) -> list[dict[str, Any]]:
        """Rows of the report: stage, seconds, ticks per second, peak memory of the process up to its end."""
        return [
            {
                "stage": name,
                "seconds": round(spent, 4),
                "ticks_per_second": round(ticks / spent, 2) if spent > 0 else None,
                "peak_memory_mib": round(self.peak_mib[name], 1),
            }
            for name, spent in self.seconds.items()
        ]

    def total(self) -> float:
        """Seconds since this clock was made."""
        return time.perf_counter() - self._start


def cpu_seconds() -> float:
    """Seconds of the processor that this process and those that it started, as far as they ended, have spent."""
    times = os.times()
    return time.process_time() + times.children_user + times.children_system


def peak_memory_mib() -> float:
    """Largest resident memory of the process so far, MiB."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1024.0 if sys.platform != "darwin" else peak / 1024.0**2


LIMIT_VARIABLE = "OMP_NUM_THREADS"
"""Where processes share a machine, this says how many threads each may use (OpenMP 5.2, section 21.1.2). Dask sets it to 1 for its workers."""
VARIABLES = (LIMIT_VARIABLE, "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
"""What the libraries below NumPy and OpenCV read when they are loaded."""


def usable_threads() -> int:
    """Return the number of cores that this process may use, or what `OMP_NUM_THREADS` limits it to."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    limit = os.environ.get(LIMIT_VARIABLE, "")
    return min(cores, int(limit)) if limit.isascii() and limit.isdecimal() and int(limit) > 0 else cores


def thread_limits(count: int) -> dict[str, str]:
    """Return the variables of the environment that hold a new process to a number of threads."""
    return {name: str(count) for name in VARIABLES}
