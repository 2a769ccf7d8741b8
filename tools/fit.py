"""Fits of constants of the method: `python tools/fit.py` lists them, `python tools/fit.py NAME --help` says what one takes."""

import sys

from entry import run_named

if __name__ == "__main__":
    sys.exit(run_named("fits"))
