"""Make samples/crossing from samples/crossing.toml again; the same bytes for the same seed and library versions.

python tools/make_sample.py [DIR]
"""

import sys
from pathlib import Path

from entry import SAMPLES

from log2sim.synth.scene import load_scene
from log2sim.synth.synthesis import write_synthetic

SEED, JPEG_QUALITY, LIMIT_BYTES = 1, 58, 8_500_000

if __name__ == "__main__":
    out = Path(sys.argv[1]) if len(sys.argv) > 1 else SAMPLES / "crossing"
    write_synthetic(load_scene(SAMPLES / "crossing.toml"), out, seed=SEED, overwrite=True, jpeg_quality=JPEG_QUALITY)
    size = sum(path.stat().st_size for path in out.rglob("*") if path.is_file())
    print(f"{out}: {size / 1e6:.2f} MB")
    sys.exit(size >= LIMIT_BYTES)
