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
from pathlib import Path

import numpy as np

from log2sim.cli import entry
from mutation.bases import write_base
from mutation.supervising import import_everything

# After the first file appears, results are renamed within so long: moments of half of the kills.
WRITING_S = 0.05
POLL_S = 0.0003
KINDS = ("nothing", "old", "whole", "torn")

# Name of a command and its arguments; all results are in the folder that it gets.
Command = tuple[str, Callable[[Path], list[object]]]


def commands(folder: Path) -> list[Command]:
    """The commands that write, each with its smallest input."""
    from worlds import tiny_toml

    log, scenario = write_base("native", folder / "log"), write_base("scenario", folder / "scenario")
    scene = folder / "scene.toml"
    scene.write_text(tiny_toml(duration_s=0.3), encoding="utf-8")
    return [
        ("reconstruct", lambda out: [log, "--detector", "labels", "--out", out / "s.json", "--report", out / "r.json", "--topdown", out / "t.png"]),
        ("replay", lambda out: [scenario, "--out", out / "r.json"]),
        ("convert", lambda out: [log, "--out", out / "log"]),
        ("synth", lambda out: [scene, "--out", out / "log"]),
        ("export", lambda out: [scenario, "--to", "openscenario", "--out", out / "x"]),
        ("export", lambda out: [scenario, "--to", "csv", "--out", out / "x"]),
        ("edit", lambda out: [scenario, "--speed", "ego=1.1", "--out", out / "e.json"]),
        ("evaluate", lambda out: [scenario, "--truth", scenario, "--out", out / "m.json", "--plot", out / "m.png"]),
    ]  # fmt: skip


def kill_many(folder: Path, count: int, seed: int = 0) -> Iterator[tuple[str, float, str, str]]:
    """Kill runs of the commands in turn; every other one has the result of an earlier run to replace.

    Yields the name, the seconds after which it was killed, one of `KINDS`, and what is wrong.
    """
    import_everything()
    rng = np.random.default_rng(seed)
    known: dict[int, tuple[float, dict[str, int]]] = {}
    all_commands = commands(folder)
    for k in range(count):
        number, out = k % len(all_commands), folder / "out"
        name, of = all_commands[number]
        arguments = [name, *of(out)]
        replaces = k // len(all_commands) % 2 == 1
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir()
        if replaces or number not in known:
            start = time.monotonic()
            _run(arguments)
            known.setdefault(number, (time.monotonic() - start, files_in(out, lambda s: s.st_size)))
        lasts_s, whole = known[number]
        if not replaces:
            shutil.rmtree(out)
            out.mkdir()
        before = files_in(out, lambda s: s.st_ino, hidden=True)
        after_s = _kill([*arguments, *(["--overwrite"] if replaces else [])], out, set(before), rng, lasts_s)
        left, words = _what_is_left(out, before, whole)
        code = _run([*arguments, "--overwrite"])
        strangers = [p.name for p in out.rglob(".*")]
        if left != "torn" and (code or strangers):
            left, words = "torn", f"the next run: exit code {code}, left {', '.join(strangers)}"
        yield name, after_s, left, words


def files_in(out: Path, of: Callable[[os.stat_result], int], *, hidden: bool = False) -> dict[str, int]:
    """Something of each file of a result; temporary ones are hidden or in a hidden folder, as exports into one that exists are."""
    names = {str(p.relative_to(out)): p for p in sorted(out.rglob("*")) if p.is_file()}
    return {n: of(p.stat()) for n, p in names.items() if hidden or not any(part[0] == "." for part in Path(n).parts)}


def _what_is_left(out: Path, before: dict[str, int], whole: dict[str, int]) -> tuple[str, str]:
    found, inodes = files_in(out, lambda s: s.st_size), files_in(out, lambda s: s.st_ino)
    if inodes == before:
        return ("old" if before else "nothing"), ""
    if before and not found:
        return "torn", "the old result is gone, the new one is not there"
    if set(found) != set(whole):
        return "torn", f"there are {', '.join(sorted(found))}"
    # Reports hold times that were measured, whose digits vary.
    odd = [n for n in found if abs(found[n] - whole[n]) > max(64, 0.05 * whole[n])]
    stale = [n for n in found if n in before and inodes[n] == before[n]]
    return (
        ("torn", f"not whole: {', '.join(odd)}; of the old result: {', '.join(stale)}")
        if odd or stale
        else ("whole", "")
    )


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
    for name, after_s, left, words in kill_many(folder, count, seed):
        found.append((name, left))
        if left == "torn":
            print(f"torn: {name} after {after_s:.3f} s: {words}", flush=True)
    print("| command | " + " | ".join((*KINDS, "kills")) + " |\n|---|" + "---|" * (len(KINDS) + 1))
    for name in (*dict.fromkeys(name for name, _ in found), "all"):
        counts = Counter(left for of, left in found if name in (of, "all"))
        print(f"| {name} | " + " | ".join(str(counts[kind]) for kind in KINDS) + f" | {sum(counts.values())} |")
    shutil.rmtree(folder, ignore_errors=True)
    return int(any(left == "torn" for _, left in found))
