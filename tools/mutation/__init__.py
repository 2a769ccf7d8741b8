"""Damaged inputs for every command: how they are made, run, watched and judged. `tools/mutate.py` runs it."""

import sys
from pathlib import Path

# The logs are written by the encoders of the tests.
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests"))
