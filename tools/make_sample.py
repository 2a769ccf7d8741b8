"""Make samples/crossing from samples/crossing.toml again; the same bytes for the same seed and library versions.

python tools/make_sample.py [DIR]
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from log2sim.synth.scene import load_scene
from log2sim.synth.synthesis import write_synthetic

SAMPLES = Path(__file__).resolve().parent.parent / "samples"
SEED = 1
JPEG_QUALITY = 58
LIMIT_BYTES = 8_500_000


def main() -> int:
    """Write the sample and check that it is small enough to ship."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "out", nargs="?", metavar="DIR", type=Path, default=SAMPLES / "crossing", help="folder to write"
    )
    out = parser.parse_args().out
    begin = time.perf_counter()
    scene = load_scene(SAMPLES / "crossing.toml")
    write_synthetic(scene, out, seed=SEED, overwrite=True, jpeg_quality=JPEG_QUALITY)
    size = sum(path.stat().st_size for path in out.rglob("*") if path.is_file())
    print(f"{out}: {size / 1e6:.2f} MB in {time.perf_counter() - begin:.0f} s")
    return 0 if size < LIMIT_BYTES else 1


if __name__ == "__main__":
    sys.exit(main())
