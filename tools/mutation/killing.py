"""Ends commands by SIGKILL at random moments and looks at what is left.

After each a result at --out is whole or not there, and where one was there before it is the old or the new one. The same
command once more then succeeds, and nothing of the dead one is left.
"""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from command_line import run

from mutation.bases import write_base
from mutation.watching import FORK, warm_up

# After the first file appears, results are renamed within so long: moments of half of the kills.
WRITING_S = 0.05
POLL_S = 0.0003
KINDS = ("nothing", "old", "whole", "torn")


def commands(folder: Path) -> list[Callable[[Path], list[object]]]:
    """The commands that write, each with its smallest input; all results are in the folder that it gets."""
    from worlds import tiny_toml

    log, scenario = write_base("native", folder / "log"), write_base("scenario", folder / "scenario")
    scene = folder / "scene.toml"
    scene.write_text(tiny_toml(duration_s=0.3), encoding="utf-8")
    return [
        lambda out: ["reconstruct", log, "--detector", "labels", "--out", out / "s.json", "--report", out / "r.json", "--topdown", out / "t.png"],
        lambda out: ["replay", scenario, "--out", out / "r.json"],
        lambda out: ["convert", log, "--out", out / "log"],
        lambda out: ["synth", scene, "--out", out / "log"],
        lambda out: ["export", scenario, "--to", "openscenario", "--out", out / "x"],
        lambda out: ["export", scenario, "--to", "csv", "--out", out / "x"],
        lambda out: ["edit", scenario, "--speed", "ego=1.1", "--out", out / "e.json"],
        lambda out: ["evaluate", scenario, "--truth", scenario, "--out", out / "m.json", "--plot", out / "m.png"],
    ]  # fmt: skip


def kill_many(folder: Path, count: int, seed: int = 0) -> Iterator[tuple[str, str, str]]:
    """Kill runs of the commands in turn; every other one has the result of an earlier run to replace.

    Yields the name, one of `KINDS`, and what is wrong.
    """
    warm_up()
    rng = np.random.default_rng(seed)
    known: dict[int, tuple[float, dict[str, int]]] = {}
    all_commands, out = commands(folder), folder / "out"
    for k in range(count):
        number, arguments = k % len(all_commands), all_commands[k % len(all_commands)](out)
        replaces = k // len(all_commands) % 2 == 1
        _empty(out)
        if replaces or number not in known:
            start = time.monotonic()
            _started(arguments).join()
            known.setdefault(number, (time.monotonic() - start, files_in(out, lambda s: s.st_size)))
        if not replaces:
            _empty(out)
        before = files_in(out, lambda s: s.st_ino, hidden=True)
        _kill([*arguments, *(["--overwrite"] if replaces else [])], out, set(before), rng, known[number][0])
        left, words = _what_is_left(out, before, known[number][1])
        again = _started([*arguments, "--overwrite"])
        again.join()
        strangers = [p.name for p in out.rglob(".*")]
        if left != "torn" and (again.exitcode or strangers):
            left, words = "torn", f"the next run: exit code {again.exitcode}, left {', '.join(strangers)}"
        yield str(arguments[0]), left, words


def _empty(folder: Path) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()


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
    words = f"not whole: {', '.join(odd)}; of the old result: {', '.join(stale)}"
    return ("torn", words) if odd or stale else ("whole", "")


def _kill(arguments: list[object], out: Path, before: set[str], rng: np.random.Generator, lasts_s: float) -> None:
    """Run a command and kill it, at a random moment or soon after it began to write."""
    start, waits_for_writing = time.monotonic(), rng.random() < 0.5
    moment_s = float(rng.uniform(0.0, WRITING_S if waits_for_writing else 1.1 * lasts_s))
    process = _started(arguments)
    begun = None if waits_for_writing else start
    while process.is_alive():
        now = time.monotonic()
        if begun is None and any(p.name not in before and p.suffix != ".lock" for p in out.iterdir()):
            begun = now
        if begun is not None and now - begun >= moment_s:
            process.kill()
        time.sleep(POLL_S)
    process.join()


def _started(arguments: list[object]) -> Any:
    """A command in a process of its own, without a sound."""
    process = FORK.Process(target=lambda: os._exit(run(*arguments).code), daemon=False)
    process.start()
    return process
