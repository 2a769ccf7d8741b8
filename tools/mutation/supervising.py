"""Workers that are forked from a warm process, one after the other, and what each input came to."""

from __future__ import annotations

import importlib
import multiprocessing
import os
import pkgutil
import shutil
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

import log2sim
from mutation.bases import KINDS, LOGS, SCENARIO, XOSC, write_base
from mutation.damages import ALL, Damage, Mutation, Place, damage
from mutation.running import (
    Outcome,
    Ran,
    Watch,
    Watched,
    commands_for,
    judge,
    measured,
    prepare_process,
    run_commands,
    variant_of,
)

# Of 48 inputs four are scenarios and two OpenSCENARIO files, the rest logs in turn.
CYCLE = (*LOGS, SCENARIO, *LOGS, SCENARIO, *LOGS, SCENARIO, SCENARIO, XOSC, XOSC)
INPUTS_PER_WORKER = 1000
TIME_LIMIT_S = 40.0
Runner = Callable[[str, Path, Path, int, Watched], Ran]


@dataclass(frozen=True)
class Row:
    """One input: how it was damaged and what came of it."""

    seed: int
    index: int
    kind: str
    damage: str
    visible: bool
    verdict: str
    reason: str
    seconds: float = 0.0
    peak_bytes: int = 0

    @property
    def replay(self) -> str:
        return f"{self.seed}:{self.index}"


class Harness:
    """The sound inputs of the kinds that are asked for, and a place for one damaged input at a time."""

    def __init__(self, folder: Path, kinds: Sequence[str] = KINDS, mutations: Sequence[Mutation] = ALL) -> None:
        self.folder, self.mutations, self.outside = folder, mutations, folder / "outside"
        self.bases = {kind: write_base(kind, folder / "sound" / kind.replace(" ", "-")) for kind in kinds}
        self._sound: dict[str, Outcome] = {}

    def run_one(self, seed: int, index: int, watch: Watch, runner: Runner) -> Row:
        """Damage, run and judge one input in this process."""
        kind = kind_of(index)
        path, _, name, done = self.make(seed, index)
        out, variant = self.case(index) / "out", variant_of(index)
        sound, before = self._sound_outcome(kind, variant), self._files_outside()
        os.chdir(self.case(index))
        watch.allow(read=[path.parent if path.is_file() else path, *done.allowed], write=[out])
        ran = runner(kind, path, out, variant, watch.watching)
        changed = {name for name, _ in before ^ self._files_outside()}
        ran.outside += [*watch.found, *(f"made or changed outside: {name}" for name in sorted(changed))]
        verdict, reason = judge(ran, sound, visible=done.visible)
        return Row(
            seed, index, kind, f"{name}: {done.what}", done.visible, verdict, reason, ran.seconds, ran.peak_bytes
        )

    def _files_outside(self) -> set[tuple[str, int]]:
        """Names and times of what lies beside the input."""
        return {(p.name, p.lstat().st_mtime_ns) for p in self.outside.iterdir()}

    def case(self, index: int) -> Path:
        """The folder of a damaged input and of what is made of it."""
        return self.folder / "case" / str(index)

    def make(self, seed: int, index: int) -> tuple[Path, Place, str, Damage]:
        """Lay out a damaged input; the same seed and index give the same one."""
        kind = kind_of(index)
        # A folder of its own for each, as readers may remember files by their path.
        case, sound = self.case(index), self.bases[kind]
        shutil.rmtree(case.parent, ignore_errors=True)
        shutil.rmtree(self.outside, ignore_errors=True)
        self.outside.mkdir(parents=True)
        (self.outside / "canary").write_text('{"canary": 1}')
        top = self.folder / "sound" / kind.replace(" ", "-")
        shutil.copytree(top, case / "input")
        path = case / "input" / sound.relative_to(top)
        place = Place(path, sound, self.outside)
        name, done = damage(np.random.default_rng([seed, index]), place, self.mutations)
        return path, place, name, done

    def _sound_outcome(self, kind: str, variant: int) -> Outcome:
        """What the last of the same commands leaves of the sound input."""
        out = self.folder / "sound-out"
        command = commands_for(kind, self.bases[kind], out, variant)[-1]
        key = " ".join(map(str, command))
        if key not in self._sound:
            # A run that was late and stopped leaves its folder.
            shutil.rmtree(out, ignore_errors=True)
            self._sound[key] = run_commands(kind, self.bases[kind], out, [command])[0]
            if self._sound[key].code:
                raise RuntimeError(f"a sound input of kind '{kind}' fails: {self._sound[key]}")
        return self._sound[key]


def kind_of(index: int) -> str:
    return CYCLE[index % len(CYCLE)]


def indices(count: int, only: Sequence[str] = (), start: int = 0) -> Iterator[int]:
    """The first so many indices, of these kinds."""
    found, index = 0, start
    while found < count:
        if not only or kind_of(index) in only:
            yield index
            found += 1
        index += 1


def run_many(
    harness: Harness,
    seed: int,
    numbers: Sequence[int],
    *,
    runner: Runner = measured,
    time_limit_s: float = TIME_LIMIT_S,
) -> Iterator[Row]:
    """Run inputs in forked workers; one that hangs or dies costs its input and a new worker."""
    import_everything()
    todo = list(numbers)
    while todo:
        batch = todo[:INPUTS_PER_WORKER]
        done = 0
        for row in _run_batch(harness, seed, batch, runner, time_limit_s):
            done += 1
            yield row
        todo = todo[done:]


def _run_batch(harness: Harness, seed: int, batch: Sequence[int], runner: Runner, time_limit_s: float) -> Iterator[Row]:
    """Rows of a worker until it has done all, or has been ended."""
    fork = multiprocessing.get_context("fork")
    receive, send = fork.Pipe(duplex=False)
    sys.stdout.flush()
    worker = fork.Process(target=_work, args=(harness, seed, batch, runner, send), daemon=True)
    worker.start()
    send.close()
    try:
        for index in batch:
            late = not receive.poll(time_limit_s)
            try:
                row = None if late else receive.recv()
            except EOFError:
                row = None
            if isinstance(row, str):
                raise RuntimeError(f"the harness itself failed: {row}")
            if row is not None:
                yield row
                continue
            if late:
                worker.kill()
            worker.join()
            reason = (
                f"not ended after {time_limit_s:.0f} s" if late else f"the process ended with status {worker.exitcode}"
            )
            _, _, name, done = harness.make(seed, index)
            verdict = "hang" if late else "crash"
            yield Row(seed, index, kind_of(index), f"{name}: {done.what}", done.visible, verdict, reason, time_limit_s)
            return
    finally:
        receive.close()
        worker.kill()
        worker.join()


def _work(harness: Harness, seed: int, batch: Sequence[int], runner: Runner, send: Connection) -> None:
    """Run a batch in a new process."""
    silent = os.open(os.devnull, os.O_RDWR)
    os.dup2(silent, 2)  # what libraries in C print
    os.dup2(silent, 0)
    watch = Watch()
    try:
        for index in batch:
            send.send(harness.run_one(seed, index, watch, runner))
    except BaseException as error:
        send.send(f"{type(error).__name__}: {error}")
    finally:
        os._exit(0)


def import_everything() -> None:
    """Import all modules of the package, so that no worker has to."""
    prepare_process()
    for module in pkgutil.walk_packages(log2sim.__path__, "log2sim."):
        if not module.name.endswith("__main__") and ".carla" not in module.name:
            importlib.import_module(module.name)
