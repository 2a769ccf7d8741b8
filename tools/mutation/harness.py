"""Damaged inputs, one at a time: which commands are run on them, and what came of it."""

from __future__ import annotations

import os
import shutil
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mutation.bases import KINDS, LOGS, SCENARIO, WITHOUT_LABELS, XOSC, write_base
from mutation.damages import Damage, Place, damage
from mutation.watching import MEMORY_BYTES, Outcome, Ran, in_a_process, run_commands, warm_up

# Of 48 inputs four are scenarios and two OpenSCENARIO files, the rest logs in turn.
CYCLE = (*LOGS, SCENARIO, *LOGS, SCENARIO, *LOGS, SCENARIO, SCENARIO, XOSC, XOSC)
EXPORTS = ("openscenario", "carla", "csv", "scenarionet", "commonroad", "osi", "mcap")
TIME_LIMIT_S = 40.0
# Exit codes that the README documents for something that is wrong with an input or with what was asked of it.
REFUSALS = (2, 3, 4, 6)
GOOD = {
    "refused": "one message and a documented exit code",
    "told": "a result, and a line on the terminal or in the report that a sound run does not have",
    "no effect": "the same result as without the damage",
    "plausible": "another result without a word; the damage is none that a program can see, see damages.py",
}
BAD = {
    "swallowed": "another result without a word, though the damage can be seen",
    "crash": "an internal error, a traceback, a signal or an undocumented exit code",
    "hang": "not ended within the time limit",
    "memory": "more than 2 GiB",
    "outside": "a file read or written outside of the input and --out, a process or a socket",
    "torn": "files at --out though the command failed, or temporary ones",
}


@dataclass(frozen=True)
class Row:
    """One input: how it was damaged and what came of it."""

    index: int
    kind: str
    damage: str
    visible: bool
    verdict: str
    reason: str
    seconds: float
    peak_bytes: int


def commands_for(kind: str, path: Path, out: Path, index: int) -> list[list[object]]:
    """What a user runs on such an input; the last one makes the result that is judged."""
    variant = zlib.crc32(str(index).encode())  # does not repeat with the order of the kinds
    if kind in LOGS:
        detector = "lidar:vehicle" if kind in WITHOUT_LABELS else ("labels", "lidar:labels")[variant // 4 % 2]
        looks: Sequence[list[object]] = ([["inspect", path]], [["validate", path]], [], [])[variant % 4]
        # Neither the user's cache nor other processes: both are outside of what the watch allows.
        return [
            *looks,
            ["reconstruct", path, "--detector", detector, "--no-cache", "--jobs", 1, "--out", out / "s.json", "--report", out / "r.json"],
        ]  # fmt: skip
    if kind == XOSC:
        return [["import", path, "--out", out / "s.json"]]
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


class Harness:
    """The sound inputs of the kinds that are asked for, and a place for one damaged input at a time."""

    def __init__(self, folder: Path, seed: int, kinds: Sequence[str] = KINDS) -> None:
        self.folder, self.seed, self.outside = folder, seed, folder / "outside"
        self._tops = {kind: folder / "sound" / kind.replace(" ", "-") for kind in kinds}
        self._bases = {kind: write_base(kind, top) for kind, top in self._tops.items()}
        self._sound: dict[str, Outcome] = {}
        warm_up()

    def run(self, index: int) -> Row:
        """Damage, run and judge one input; the same seed and index give the same one."""
        kind = kind_of(index)
        path, name, done = self.make(index)
        out = path.parents[len(path.relative_to(self.folder / "case").parts) - 1] / "out"
        sound, before = self._sound_outcome(kind, index), self._files_outside()
        os.chdir(self.folder / "case")
        commands = commands_for(kind, path, out, index)
        ran, why = in_a_process(lambda: run_commands(kind, path, out, commands, done.allowed), TIME_LIMIT_S)
        ran = ran or Ran(killed=why, seconds=TIME_LIMIT_S)
        changed = sorted({f"made or changed outside: {name}" for name, _ in before ^ self._files_outside()})
        verdict, reason = judge(ran, sound, changed, visible=done.visible)
        return Row(index, kind, f"{name}: {done.what}", done.visible, verdict, reason, ran.seconds, ran.peak_bytes)

    def make(self, index: int) -> tuple[Path, str, Damage]:
        """Lay out a damaged input."""
        top, sound = self._tops[kind_of(index)], self._bases[kind_of(index)]
        for folder in (self.folder / "case", self.outside):
            shutil.rmtree(folder, ignore_errors=True)
        self.outside.mkdir(parents=True)
        (self.outside / "canary").write_text('{"canary": 1}')
        shutil.copytree(top, self.folder / "case/input")
        path = self.folder / "case/input" / sound.relative_to(top)
        name, done = damage(np.random.default_rng([self.seed, index]), Place(path, sound, self.outside))
        return path, name, done

    def _files_outside(self) -> set[tuple[str, int]]:
        """Names and times of what lies beside the input."""
        return {(p.name, p.lstat().st_mtime_ns) for p in self.outside.iterdir()}

    def _sound_outcome(self, kind: str, index: int) -> Outcome:
        """What the last of the same commands leaves of the sound input."""
        path, out = self._bases[kind], self.folder / "sound-out"
        command = commands_for(kind, path, out, index)[-1]
        key = " ".join(map(str, command))
        if key not in self._sound:
            ran, why = in_a_process(lambda: run_commands(kind, path, out, [command]), 10 * TIME_LIMIT_S)
            if ran is None or ran.outcomes[0].code:
                raise RuntimeError(f"a sound input of kind '{kind}' fails: {ran or why}")
            self._sound[key] = ran.outcomes[0]
        return self._sound[key]


def kind_of(index: int) -> str:
    return CYCLE[index % len(CYCLE)]


def judge(ran: Ran, sound: Outcome, changed: Sequence[str], *, visible: bool) -> tuple[str, str]:
    """Return the class and the reason in one line.

    The result that counts is that of the last command, which makes a scenario or a file of one; what inspect and validate say is no
    word of it.
    """
    if outside := [*ran.outside, *changed]:
        return "outside", "; ".join(outside[:3])
    if ran.killed:
        return "hang" if ran.killed.startswith("not ended") else "crash", ran.killed
    for outcome in ran.outcomes:
        own = [line for line in outcome.errors.splitlines() if line.startswith("log2sim: ")]
        if any(word in outcome.errors for word in ("MemoryError", "bad_alloc", "Insufficient memory")):
            return "memory", f"{outcome.command}: {outcome.errors[:200]}"
        broken = len(own) != 1 or "internal error" in outcome.errors or "Traceback" in outcome.errors
        if outcome.code and (outcome.code not in REFUSALS or broken):
            return "crash", f"{outcome.command}: exit code {outcome.code}: {outcome.errors[-300:].strip()}"
        if outcome.left:
            return "torn", f"{outcome.command}: left {', '.join(outcome.left[:5])}"
    if ran.peak_bytes > MEMORY_BYTES:
        return "memory", f"{ran.peak_bytes / 2**20:.0f} MiB"
    last = ran.outcomes[-1]
    if last.code:
        return "refused", f"{last.command}: {own[0]}"
    if last.content == sound.content:
        return "no effect", ""
    new = sorted(last.told - sound.told)
    return ("told", new[0]) if new else ("swallowed" if visible else "plausible", "")
