"""How many threads a process may use."""

from __future__ import annotations

import os

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
