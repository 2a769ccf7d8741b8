"""Progress: what is being done, as bars on a terminal, as plain lines elsewhere, and nothing with --quiet."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from log2sim.cli.options import is_quiet
from log2sim.visualization.progress import OPENING, VALIDATING, describe_stage

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

LINE_EVERY_S = 5.0
# Shown on a terminal alone: elsewhere what is wrong with the log is to be the only line.
ON_TERMINALS = (OPENING, VALIDATING)
# Called as `report(stage, done, total)`; a total of 0 says that the length of the stage is not known.
Report = Callable[[str, int, int], None]


@contextmanager
def progress() -> Iterator[Report]:
    """Yield a function `report_progress(stage, done, total)`; with a total of 0 the length of the stage is not known."""
    if is_quiet.get():
        yield lambda stage, done, total: None
    elif sys.stderr.isatty():
        with _bars() as report_progress:
            yield report_progress
    else:
        last, current = [time.monotonic()], [""]

        def report_line(stage: str, done: int, total: int) -> None:
            if stage in ON_TERMINALS:
                return
            now = time.monotonic()
            begins, current[0] = stage != current[0], stage
            if (done == total if total else begins) or now - last[0] >= LINE_EVERY_S:
                last[0] = now
                count = f": {done} of {total}" if total else ""
                sys.stderr.write(f"{describe_stage(stage)}{count}\n")

        yield report_line


class Bars:
    """A bar for each stage of a run; a stage ends when the next one begins."""

    def __init__(self, display: Progress) -> None:
        self._display = display
        self._tasks: dict[str, TaskID] = {}
        self._current: str | None = None

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Show how far a stage is."""
        if stage != self._current:
            self._end_current()
            self._current = stage
            if stage in self._tasks:
                self._display.reset(self._tasks[stage])
        if stage not in self._tasks:
            self._tasks[stage] = self._display.add_task(describe_stage(stage), total=total or None)
        self._display.update(self._tasks[stage], completed=done, total=total or None)

    def _end_current(self) -> None:
        """Fill the bar of a stage that ends, and take that of a stage of unknown length away: it would go on moving."""
        task = self._tasks.get(self._current or "")
        if task is None:
            return
        total = self._display.tasks[self._display.task_ids.index(task)].total
        if total is not None:
            self._display.update(task, completed=total)
        else:
            self._display.remove_task(task)
            del self._tasks[self._current or ""]


@contextmanager
def _bars() -> Iterator[Report]:
    from rich import progress as rich
    from rich.console import Console
    from rich.text import Text

    class Count(rich.ProgressColumn):
        """How many of how many, where that is known."""

        def render(self, task: rich.Task) -> Text:
            return Text("" if task.total is None else f"{task.completed:.0f} of {task.total:.0f}")

    left = rich.TextColumn("{task.description}"), rich.BarColumn(bar_width=20)
    columns = (*left, Count(), rich.TimeElapsedColumn(), rich.TimeRemainingColumn())
    # What is printed meanwhile goes where it was meant to go, not to this console.
    console = Console(stderr=True)
    with rich.Progress(
        *columns, console=console, transient=True, redirect_stdout=False, redirect_stderr=False
    ) as display:
        yield Bars(display)
