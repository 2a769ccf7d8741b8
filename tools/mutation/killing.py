"""Ends commands by SIGKILL at random moments and looks at what is left.

After each a result at --out is whole or not there, and where one was there before it is the old or the new one. The same
command once more then succeeds, and nothing of the dead one is left.
"""

from __future__ import annotations

import os
import shutil
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from log2sim.cli import entry
from mutation.bases import write_base
from mutation.supervising import import_everything

# After the first file appears, results are renamed within so long: moments of half of the kills.
WRITING_S = 0.05
POLL_S = 0.0003


@dataclass(frozen=True)
class Command:
    """A command whose results are all that is in the folder `out` afterwards."""

    name: str
    arguments: Callable[[Path], list[object]]


@dataclass(frozen=True)
class Killed:
    """What one kill left: "nothing", "whole", "old" or "torn"; and what the next run left that is no result."""

    command: str
    after_s: float
    left: str
    words: str = ""


def commands(folder: Path) -> list[Command]:
    """The commands that write, each with its smallest input."""
    log, scenario = write_base("native", folder / "log"), write_base("scenario", folder / "scenario")
    scene = folder / "scene.toml"
    scene.write_text(_short_scene(), encoding="utf-8")
    return [
        Command("reconstruct", lambda out: [
            "reconstruct", log, "--detector", "labels", "--out", out / "s.json", "--report", out / "r.json", "--topdown", out / "t.png"]),
        Command("replay", lambda out: ["replay", scenario, "--out", out / "r.json"]),
        Command("convert", lambda out: ["convert", log, "--out", out / "log"]),
        Command("synth", lambda out: ["synth", scene, "--out", out / "log"]),
        Command("export", lambda out: ["export", scenario, "--to", "openscenario", "--out", out / "x"]),
        Command("export", lambda out: ["export", scenario, "--to", "csv", "--out", out / "x"]),
        Command("edit", lambda out: ["edit", scenario, "--speed", "ego=1.1", "--out", out / "e.json"]),
        Command("evaluate", lambda out: ["evaluate", scenario, "--truth", scenario, "--out", out / "m.json", "--plot", out / "m.png"]),
    ]  # fmt: skip


def _short_scene() -> str:
    """The scene of the test worlds as TOML."""
    from worlds import tiny_toml

    return tiny_toml(duration_s=0.3)


def kill_many(folder: Path, count: int, seed: int = 0) -> Iterator[Killed]:
    """Kill runs of the commands in turn; every other one has the result of an earlier run to replace."""
    import_everything()
    rng = np.random.default_rng(seed)
    known: dict[int, tuple[float, dict[str, int]]] = {}
    all_commands = commands(folder)
    for k in range(count):
        number = k % len(all_commands)
        command, out = all_commands[number], folder / "out"
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir()
        if number not in known:
            start = time.monotonic()
            _run(command.arguments(out))
            known[number] = (time.monotonic() - start, names_and_sizes(out))
        lasts_s, whole = known[number]
        replaces = k // len(all_commands) % 2 == 1
        if not replaces:
            shutil.rmtree(out)
            out.mkdir()
        elif not names_and_sizes(out):
            _run(command.arguments(out))
        before = names_and_inodes(out)
        arguments = [*command.arguments(out), *(["--overwrite"] if replaces else [])]
        after_s = _kill(arguments, out, set(before), rng, lasts_s)
        left, words = _what_is_left(out, before, whole)
        code = _run([*command.arguments(out), "--overwrite"])
        strangers = [p.name for p in out.rglob(".*")]
        if left != "torn" and (code or strangers):
            left, words = "torn", f"the next run: exit code {code}, left {', '.join(strangers)}"
        yield Killed(command.name, after_s, left, words)


def names_and_sizes(out: Path) -> dict[str, int]:
    """The files of a result by their size, without temporary ones."""
    files = (p for p in sorted(out.rglob("*")) if p.is_file())
    return {n: p.stat().st_size for p in files if not is_temporary(n := str(p.relative_to(out)))}


def is_temporary(name: str) -> bool:
    """Whether a file is hidden or in a hidden folder; exports into a folder that exists are made in it."""
    return any(part.startswith(".") for part in Path(name).parts)


def names_and_inodes(out: Path) -> dict[str, int]:
    return {str(p.relative_to(out)): p.stat().st_ino for p in out.rglob("*") if p.is_file()}


def _what_is_left(out: Path, before: dict[str, int], whole: dict[str, int]) -> tuple[str, str]:
    found, inodes = names_and_sizes(out), {n: i for n, i in names_and_inodes(out).items() if not is_temporary(n)}
    if inodes == before:
        return ("old" if before else "nothing"), ""
    if before and not found:
        return "torn", "the old result is gone, the new one is not there"
    if set(found) != set(whole):
        return "torn", f"there are {', '.join(sorted(found))}"
    # Reports hold times that were measured, whose digits vary.
    odd = [n for n in found if abs(found[n] - whole[n]) > max(64, 0.05 * whole[n])]
    stale = [n for n in found if n in before and inodes[n] == before[n]]
    if odd or stale:
        return "torn", f"not whole: {', '.join(odd)}; of the old result: {', '.join(stale)}"
    return "whole", ""


def _kill(arguments: list[object], out: Path, before: set[str], rng: np.random.Generator, lasts_s: float) -> float:
    """Run a command and kill it, at a random moment or soon after it began to write; return when."""
    start, waits_for_writing = time.monotonic(), rng.random() < 0.5
    moment_s = float(rng.uniform(0.0, WRITING_S if waits_for_writing else 1.1 * lasts_s))
    process = _start(arguments)
    begun = None if waits_for_writing else start
    while os.waitpid(process, os.WNOHANG)[0] == 0:
        now = time.monotonic()
        if begun is None and any(p.name not in before and p.suffix != ".lock" for p in out.iterdir()):
            begun = now
        if begun is not None and now - begun >= moment_s:
            os.kill(process, signal.SIGKILL)
            os.waitpid(process, 0)
            break
        time.sleep(POLL_S)
    return time.monotonic() - start


def _run(arguments: list[object]) -> int:
    """Run a command to its end in a process of its own; return its exit code."""
    return os.waitstatus_to_exitcode(os.waitpid(_start(arguments), 0)[1])


def _start(arguments: list[object]) -> int:
    process = os.fork()
    if process:
        return process
    try:
        silent = os.open(os.devnull, os.O_RDWR)
        for stream in (0, 1, 2):
            os.dup2(silent, stream)
        sys.argv = ["log2sim", *map(str, arguments)]
        entry.main()
    except SystemExit as stop:
        os._exit(int(stop.code or 0))
    finally:
        os._exit(99)


def main(folder: Path, count: int, seed: int) -> int:
    """Print a table of commands by what was left; 1 when anything was torn."""
    found = []
    for killed in kill_many(folder, count, seed):
        found.append(killed)
        if killed.left == "torn":
            print(f"torn: {killed.command} after {killed.after_s:.3f} s: {killed.words}", flush=True)
    kinds = ("nothing", "old", "whole", "torn")
    print("| command | " + " | ".join((*kinds, "kills")) + " |\n|---|" + "---|" * (len(kinds) + 1))
    for name in (*dict.fromkeys(k.command for k in found), "all"):
        counts = Counter(k.left for k in found if name in (k.command, "all"))
        print(f"| {name} | " + " | ".join(str(counts[kind]) for kind in kinds) + f" | {sum(counts.values())} |")
    shutil.rmtree(folder, ignore_errors=True)
    return int(any(k.left == "torn" for k in found))
