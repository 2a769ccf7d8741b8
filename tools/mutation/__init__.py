"""Damaged inputs for every command: how they are made, run, watched and judged. `tools/mutate.py` runs it."""
