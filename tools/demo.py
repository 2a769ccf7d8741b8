"""Runs log2sim on its sample and prints what it did: a table of stages and seconds, and the errors against the truth."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
OUT = "out/demo"
SCENARIO, REPLAY, SAMPLE = f"{OUT}/scenario.json", f"{OUT}/replay.json", "samples/crossing"
COMMANDS = (
    ("reconstruct", SAMPLE, "--out", SCENARIO, "--report", f"{OUT}/report.json"),
    ("replay", SCENARIO, "--out", REPLAY),
    ("evaluate", SCENARIO, "--truth", SAMPLE, "--range", "40", "--out", f"{OUT}/metrics.json"),
    ("plot", SCENARIO, "--replay", REPLAY, "--truth", SAMPLE, "--out", f"{OUT}/tracks.png"),
    ("view", SCENARIO, "--replay", REPLAY, "--truth", SAMPLE, "--out", f"{OUT}/view.html"),
    ("export", SCENARIO, "--to", "openscenario", "--out", f"{OUT}/openscenario"),
)


def main() -> None:
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
