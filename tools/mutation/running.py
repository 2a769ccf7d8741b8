"""Runs the commands on one damaged input, in this process, and records what came of it."""

from __future__ import annotations

import hashlib
import json
import os
import re
import resource
import shutil
import time
import zlib
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import typer.main
from command_line import run

from log2sim.datatypes import Scenario
from mutation.bases import LOGS, SCENARIO, WITHOUT_LABELS, XOSC

EXPORTS = ("openscenario", "carla", "csv", "scenarionet", "commonroad", "osi", "mcap")
MEMORY_BYTES = 2 * 1024**3
# Fields of a scenario that name its source, and others of a report that are measured.
_NOT_CONTENT = ("provenance", "stages")
_TELLING = re.compile(r"^(note|warning|poses|limit exceeded|the ego is doubtful|left out)")


Watched = Callable[[], AbstractContextManager[object]]


@dataclass(frozen=True)
class Outcome:
    """What one command left: exit code, text, what it made, and what it told that is not in the tables of a sound run."""

    command: str
    code: int
    errors: str
    told: frozenset[str]
    content: str
    left: tuple[str, ...] = ()


@dataclass
class Ran:
    """All commands on one input."""

    outcomes: list[Outcome] = field(default_factory=list)
    outside: list[str] = field(default_factory=list)
    seconds: float = 0.0
    peak_bytes: int = 0


def variant_of(index: int) -> int:
    """Which of several uses of an input is tried: a number that does not repeat with the order of the kinds."""
    return zlib.crc32(str(index).encode())


def commands_for(kind: str, path: Path, out: Path, variant: int) -> list[list[object]]:
    """What a user runs on such an input; the last one makes the result that is judged."""
    if kind in LOGS:
        labels = ("labels", "lidar:labels")[variant // 4 % 2]
        detector = "lidar:vehicle" if kind in WITHOUT_LABELS else labels
        looks: Sequence[list[object]] = ([["inspect", path]], [["validate", path]], [], [])[variant % 4]
        return [
            *looks,
            ["reconstruct", path, "--detector", detector, "--out", out / "s.json", "--report", out / "r.json"],
        ]
    if kind == XOSC:
        return [["import", path, "--out", out / "s.json"]]
    assert kind == SCENARIO
    uses: Sequence[list[object]] = (
        ["replay", path, "--out", out / "r.json"],
        ["replay", path, "--mode", "exact", "--agents", "reactive"],
        ["evaluate", path, "--truth", path, "--out", out / "m.json"],
        ["edit", path, "--speed", "ego=1.1", "--out", out / "e.json"],
        ["plot", path, "--out", out / "p.png"],
        ["view", path, "--out", out / "v.html"],
        ["validate", path],
        *(["export", path, "--to", name, "--out", out / name] for name in EXPORTS),
    )
    return [uses[variant % len(uses)]]


def run_commands(
    kind: str, path: Path, out: Path, commands: Sequence[list[object]], watched: Watched = nullcontext
) -> list[Outcome]:
    """Run commands on an input; nothing that one leaves stays."""
    outcomes = []
    for arguments in commands:
        out.mkdir()
        with watched():
            ran = run(*arguments)
        content = _content(kind, path, out) if ran.code == 0 else ""
        told = frozenset(line for line in (ran.out + "\n" + ran.err).splitlines() if _TELLING.match(line))
        told |= _told_in_report(out / "r.json") if kind in LOGS else frozenset()
        # Sound and damaged inputs lie in different folders.
        told = frozenset(line.replace(str(path.parent), "IN").strip() for line in told)
        left = tuple(sorted(p.name for p in out.rglob("*"))) if ran.code else tuple(p.name for p in out.glob(".*"))
        outcomes.append(Outcome(str(arguments[0]), ran.code, ran.err, told, content, left))
        shutil.rmtree(out)
    return outcomes


def measured(kind: str, path: Path, out: Path, variant: int, watched: Watched) -> Ran:
    """Run the commands of an input with a limit of memory; measure the time and the peak of memory."""
    _forget_peak()
    hard = resource.getrlimit(resource.RLIMIT_AS)[1]
    resource.setrlimit(resource.RLIMIT_AS, (_status_bytes("VmSize") + MEMORY_BYTES, hard))
    start = time.process_time()
    try:
        outcomes = run_commands(kind, path, out, commands_for(kind, path, out, variant), watched)
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (hard, hard))
    return Ran(outcomes, [], time.process_time() - start, _status_bytes("VmHWM"))


def _content(kind: str, path: Path, out: Path) -> str:
    """A digest of what the result says, without the names of its source and without times that were measured."""
    source = out / "s.json" if kind != SCENARIO else path
    if not source.exists():
        return ""
    document = Scenario.load(source).to_dict()
    for key in _NOT_CONTENT:
        document.pop(key)
    if kind == XOSC:
        document.pop("name")  # of the file, where its header has none
    return hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()


def _told_in_report(path: Path) -> frozenset[str]:
    """What a report says of records that were not used, and of faults."""
    if not path.exists():
        return frozenset()
    report: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    parts = {key: report.get(key) for key in ("unreadable", "without_pose", "faults")}
    return frozenset(
        [*(f"{k}: {json.dumps(v, sort_keys=True)}" for k, v in parts.items() if v), *map(str, report["log"]["notes"])]
    )


def _forget_peak() -> None:
    """Let the peak of the memory begin anew (Linux)."""
    with open("/proc/self/clear_refs", "w") as file:
        file.write("5")


def _status_bytes(name: str) -> int:
    with open("/proc/self/status") as file:
        line = next(line for line in file if line.startswith(name))
    return int(line.split()[1]) * 1024


def prepare_process() -> None:
    """One core, since threads of libraries would not live on in a forked process; the command line is put together once."""
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    import cv2

    cv2.setNumThreads(1)
    typer.main.get_command = cache(typer.main.get_command)
