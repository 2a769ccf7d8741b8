"""Log readers and the writer of native log folders: a folder of recorded data in, a `Log` out."""

from __future__ import annotations

from log2sim.logs.opening import Reader, find_reader, open_log

__all__ = ["Reader", "find_reader", "open_log"]
