"""What opening and reading of logs costs: python tools/bench.py readers LOG ...

For every log: seconds to open it, bytes read for that of the bytes that it has, and the median time to read and decode one
sweep and one image. Bytes are those that the process asked the system for (/proc/self/io, Linux).
"""

from __future__ import annotations

import time
from contextlib import suppress
from pathlib import Path

import numpy as np

from benchmarks.table import markdown
from log2sim.datatypes import Stream
from log2sim.errors import RecordError
from log2sim.logs.opening import open_log

MAX_RECORDS = 20
HEAD = ["log", "format", "streams", "records", "opened in s", "bytes read", "bytes", "ms a sweep", "ms an image"]


def bytes_read() -> int:
    """Bytes that this process has read so far."""
    return int(Path("/proc/self/io").read_text().split()[1])


def median_ms(streams: list[Stream]) -> float:
    """Median time to read a record, of up to `MAX_RECORDS` records spread over each stream."""
    times = []
    for stream in streams:
        for i in np.unique(np.linspace(0, len(stream.t_ns) - 1, MAX_RECORDS).astype(int)):
            begin = time.perf_counter()
            with suppress(RecordError):
                stream.read(int(i))
                times.append(1e3 * (time.perf_counter() - begin))
    return float(np.median(times)) if times else float("nan")


def main(logs: list[Path]) -> None:
    rows = []
    for path in logs:
        open_log(path)  # imports the reader and what it needs
        before, begin = bytes_read(), time.perf_counter()
        log = open_log(path)
        seconds, read = time.perf_counter() - begin, bytes_read() - before
        size = sum(p.stat().st_size for p in (path, *path.rglob("*")) if p.is_file())
        times = [f"{median_ms([log.streams[n] for n in names]):.1f}" for names in (log.lidars, log.cameras)]
        records = sum(len(s.t_ns) for s in log.streams.values())
        sizes = [f"{read / 1e6:.2f} MB", f"{size / 1e6:.1f} MB"]
        rows.append([log.name, log.format, str(len(log.streams)), str(records), f"{seconds:.3f}", *sizes, *times])
    print(markdown(HEAD, rows))
