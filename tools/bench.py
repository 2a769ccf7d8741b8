"""Benchmarks: `python tools/bench.py` lists them, `python tools/bench.py NAME --help` says what one takes."""

import sys

from entry import run_named

if __name__ == "__main__":
    sys.exit(run_named("benchmarks"))
