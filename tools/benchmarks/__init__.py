"""Benchmarks, run by `tools/bench.py`."""
