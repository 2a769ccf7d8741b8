"""Runs log2sim on its sample and prints what it did: a table of stages and seconds, and the errors against the truth."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
OUT = Path("out")
SAMPLE = Path("samples") / "crossing"
COMMANDS = (
    ("reconstruct", str(SAMPLE), "--out", "out/scenario.json", "--report", "out/report.json"),
    ("replay", "out/scenario.json", "--out", "out/replay.json"),
    ("evaluate", "out/scenario.json", "--truth", str(SAMPLE), "--range", "40", "--out", "out/metrics.json"),
    ("plot", "out/scenario.json", "--replay", "out/replay.json", "--truth", str(SAMPLE), "--out", "out/tracks.png"),
    ("view", "out/scenario.json", "--replay", "out/replay.json", "--truth", str(SAMPLE), "--out", "out/view.html"),
    ("export", "out/scenario.json", "--to", "openscenario", "--out", "out/openscenario"),
)  # fmt: skip


def main() -> None:
    """Run the commands, then print the stages."""
    for command in COMMANDS:
        print(f"$ log2sim {' '.join(command)}", flush=True)
        subprocess.run([sys.executable, "-m", "log2sim", *command, "--overwrite"], cwd=ROOT, check=True)
    report = json.loads((ROOT / OUT / "report.json").read_text(encoding="utf-8"))
    print(f"\n{'stage':<16}{'seconds':>10}{'ticks/s':>12}")
    for row in report["stages"]:
        print(f"{row['stage']:<16}{row['seconds']:>10.2f}{row['ticks_per_second'] or 0:>12.1f}")
    print(f"{'all':<16}{report['seconds']:>10.2f}{report['ticks_per_second']:>12.1f}")
    print(f"\nwritten to {OUT}/: scenario.json report.json replay.json metrics.json tracks.png view.html openscenario/")


if __name__ == "__main__":
    main()
