"""Compare the single estimators of log2sim with their peers in one process and write the tables of BENCHMARKS.md.

    OPENBLAS_NUM_THREADS=1 python tools/bench.py [homography] [projection] [smoothing] [--quick] [--write BENCHMARKS.md]

Peers beyond log2sim's own dependencies are used where they are installed: poselib, pycolmap, filterpy, numba.
"""

from __future__ import annotations

import argparse
import importlib
import os
import platform
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from bench_table import replace_section

SECTIONS = ("homography", "projection", "smoothing")
PACKAGES = (
    "numpy",
    "scipy",
    "opencv-contrib-python-headless",
    "scikit-image",
    "poselib",
    "pycolmap",
    "filterpy",
    "numba",
)


def versions() -> str:
    """Which versions of what was compared."""
    found = []
    for name in PACKAGES:
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            found.append(f"{name} not installed (pip install {name})")
    return ", ".join(found)


def main() -> int:
    """Run the sections that are asked for, all by default."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sections", nargs="*", metavar="SECTION", help=f"of {', '.join(SECTIONS)}; all by default")
    parser.add_argument("--quick", action="store_true", help="fewer repeats, to see that everything runs")
    parser.add_argument("--write", type=Path, metavar="FILE.md", help="put each table between its markers in this file")
    options = parser.parse_args()
    unknown = [s for s in options.sections if s not in SECTIONS]
    if unknown:
        parser.error(f"unknown section '{unknown[0]}'; known: {', '.join(SECTIONS)}")
    if os.environ.get("OPENBLAS_NUM_THREADS") != "1":
        print("OPENBLAS_NUM_THREADS is not 1: times will swing", file=sys.stderr)
    for name in options.sections or SECTIONS:
        title, body = importlib.import_module(f"bench_{name}").run(quick=options.quick)
        flags = " --quick" if options.quick else ""
        command = f"OPENBLAS_NUM_THREADS=1 python tools/bench.py {name}{flags} --write BENCHMARKS.md"
        text = f"## {title}\n\n`{command}`\n\n{body}\n\nPython {platform.python_version()}, {versions()}."
        print(text + "\n", flush=True)
        if options.write:
            replace_section(options.write, name, text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
