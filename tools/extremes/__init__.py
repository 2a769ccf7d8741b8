"""The table of extremes: tests and `tools/stability.py` run the same cases."""

from extremes import estimators, logs  # noqa: F401  they put their cases into the table
from extremes.table import CASES, Case, Outcome, outcome_of

__all__ = ["CASES", "Case", "Outcome", "outcome_of"]
