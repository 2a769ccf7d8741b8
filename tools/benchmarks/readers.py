"""What opening and reading of logs costs: python tools/bench.py readers LOG [LOG ...] [--sequence NAME]

For every log: seconds to open it, bytes read for that of the bytes that it has, and the median time to read and decode one
sweep and one image. Bytes are those that the process asked the system for (/proc/self/io, Linux).
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
from entry import parser_of

from log2sim.datatypes import Stream
from log2sim.errors import RecordError
from log2sim.logs.opening import open_log

MAX_RECORDS = 20
IO = Path("/proc/self/io")


def bytes_read() -> int:
    """Bytes that this process has read so far."""
    return int(IO.read_text().split()[1])


def bytes_of(path: Path) -> int:
    """Bytes of a file or of all files of a folder."""
    files = [path] if path.is_file() else [p for p in path.rglob("*") if p.is_file()]
    return sum(p.stat().st_size for p in files)


def median_ms(streams: list[Stream]) -> float:
    """Median time to read a record, of up to `MAX_RECORDS` records spread over each stream."""
    times = []
    for stream in streams:
        for i in np.unique(np.linspace(0, len(stream.t_ns) - 1, MAX_RECORDS).astype(int)):
            begin = time.perf_counter()
            try:
                stream.read(int(i))
            except RecordError:
                continue
            times.append(1e3 * (time.perf_counter() - begin))
    return float(np.median(times)) if times else float("nan")


def main(arguments: list[str] | None = None) -> None:
    parser = parser_of(__doc__)
    parser.add_argument("logs", nargs="+", type=Path)
    parser.add_argument("--sequence")
    options = parser.parse_args(arguments)
    print("| log | format | streams | records | opened in s | bytes read | bytes | ms a sweep | ms an image |")
    print("|---|---|---|---|---|---|---|---|---|")
    for path in options.logs:
        # The first opening imports the reader and what it needs.
        open_log(path, sequence=options.sequence)
        before, begin = bytes_read(), time.perf_counter()
        log = open_log(path, sequence=options.sequence)
        seconds, read = time.perf_counter() - begin, bytes_read() - before
        records = sum(len(s.t_ns) for s in log.streams.values())
        sweeps, images = (median_ms([log.streams[n] for n in names]) for names in (log.lidars, log.cameras))
        print(
            f"| {log.name} | {log.format} | {len(log.streams)} | {records} | {seconds:.3f} | {read / 1e6:.2f} MB | "
            f"{bytes_of(path) / 1e6:.1f} MB | {sweeps:.1f} | {images:.1f} |",
            flush=True,
        )
