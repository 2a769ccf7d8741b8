"""Error against run time of methods and settings on one log."""

from __future__ import annotations

from log2sim.evaluation.bench.benchmark import Benchmark, Panel, bench
from log2sim.evaluation.bench.scores import ScoreScope

__all__ = ["Benchmark", "Panel", "ScoreScope", "bench"]
