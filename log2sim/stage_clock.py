"""Seconds and peak memory of every stage, taken around the stages and never by them."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


class StageClock:
    """Adds up the time of named stages; a stage inside another stops the outer one's clock.

    Not for use from several threads: what a worker does in the background is not a stage's time but its waiting is.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.peak_mib: dict[str, float] = {}
        self._running: list[tuple[str, float]] = []
        self._start = time.perf_counter()

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Count the time of the block for `name`."""
        now = time.perf_counter()
        if self._running:
            outer, since = self._running[-1]
            self._add(outer, now - since)
        self._running.append((name, now))
        try:
            yield
        finally:
            _, since = self._running.pop()
            now = time.perf_counter()
            self._add(name, now - since)
            self.peak_mib[name] = peak_memory_mib()
            if self._running:
                self._running[-1] = (self._running[-1][0], now)

    def _add(self, name: str, seconds: float) -> None:
        self.seconds[name] = self.seconds.get(name, 0.0) + seconds

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


def peak_memory_mib() -> float:
    """Largest resident memory of the process so far, MiB."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1024.0 if sys.platform != "darwin" else peak / 1024.0**2
