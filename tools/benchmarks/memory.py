"""Peak memory of a reconstruction against the length of its log, which is driven several times in a row.

    python tools/bench.py memory LOG [--times 1 4 16] [--detector NAME]

Each length runs in a process of its own. The table has the peak by stage and what a tick more adds to it.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from entry import parser_of

from benchmarks.table import markdown

RUN = """
import json, sys
from entry import parser_of
from log2sim import Config, open_log, reconstruct
from benchmarks.looped_log import loop_log
path, times, settings = json.loads(sys.argv[1])
result = reconstruct(loop_log(open_log(path), times), Config.load(**settings))
print(json.dumps({"ticks": result.report["ticks"], "stages": result.report["stages"], "agents": len(result.scenario.agents)}))
"""


def measure(path: str, times: int, settings: dict[str, Any]) -> dict[str, Any]:
    """Reconstruct a log that is driven several times in a row; returns ticks, agents and the report's stages."""
    job = json.dumps([path, times, settings])
    ran = subprocess.run(
        [sys.executable, "-c", RUN, job], capture_output=True, text=True, check=False, cwd=Path(__file__).parents[1]
    )
    if ran.returncode:
        raise SystemExit(ran.stderr)
    found: dict[str, Any] = json.loads(ran.stdout.splitlines()[-1])
    return found


def peak_of(measured: dict[str, Any]) -> float:
    """Peak of all stages, MiB."""
    return max(float(stage["peak_memory_mib"]) for stage in measured["stages"])


def growth_kib(one: dict[str, Any], other: dict[str, Any]) -> float:
    """What each tick more of the second run adds to the peak of the first, KiB."""
    return 1024 * (peak_of(other) - peak_of(one)) / (other["ticks"] - one["ticks"])


def rows_of(runs: Sequence[dict[str, Any]]) -> list[list[str]]:
    """One row a stage and one for what a tick adds, one column a run."""
    names = list(dict.fromkeys(stage["stage"] for run in runs for stage in run["stages"]))
    by_name = [{stage["stage"]: stage["peak_memory_mib"] for stage in run["stages"]} for run in runs]
    rows = [[name, *(f"{peaks[name]:.0f} MiB" if name in peaks else "-" for peaks in by_name)] for name in names]
    rows.append(["agents", *(str(run["agents"]) for run in runs)])
    added = ["-", *(f"{growth_kib(runs[0], run):.1f} KiB" for run in runs[1:])]
    return [*rows, ["each tick more", *added]]


def main(arguments: list[str] | None = None) -> int:
    """Print the table."""
    parser = parser_of(__doc__)
    parser.add_argument("log")
    parser.add_argument("--times", type=int, nargs="+", default=[1, 4, 16])
    parser.add_argument("--detector", default="lidar:vehicle")
    options = parser.parse_args(arguments)
    settings = {"detect": {"name": options.detector}}
    runs = [measure(str(Path(options.log).resolve()), times, settings) for times in options.times]
    print(markdown(["peak at the end of", *(f"{run['ticks']} ticks" for run in runs)], rows_of(runs)))
    return 0
