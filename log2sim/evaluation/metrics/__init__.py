"""Error metrics of a scenario against truth."""

from __future__ import annotations

from log2sim.evaluation.metrics.evaluator import evaluate
from log2sim.evaluation.metrics.truth import truth_from_log

__all__ = ["evaluate", "truth_from_log"]
