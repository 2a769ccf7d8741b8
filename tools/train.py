"""Training of networks: `python tools/train.py` lists them, `python tools/train.py NAME --help` says what one takes."""

import sys

from entry import run_named

if __name__ == "__main__":
    sys.exit(run_named("training"))
