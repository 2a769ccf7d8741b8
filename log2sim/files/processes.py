"""Work shared out over processes that are forked from this one."""

from __future__ import annotations

import gc
import multiprocessing
import os
import pickle
import signal
import sys
import threading
import traceback
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection, wait
from typing import Any, TypeVar

from log2sim.errors import Log2SimError
from log2sim.files.stages import LIMIT_VARIABLE, usable_threads

Task = TypeVar("Task")
Out = TypeVar("Out")

# Results that wait for an earlier one, for each process: more would fill the memory while one of them is slow.
AHEAD = 4


def default_jobs() -> int:
    """Return how many processes a run uses that is told nothing: the usable cores, and one where it cannot be forked.

    Forked processes have the log, its readers and the networks at once; others would need a second to import all that, and would
    run scripts again that do not ask for `__name__`. A fork has the thread alone that calls it, so that it must not come
    from another than the first; the libraries of macOS do not survive it, and daemons, such as workers of Dask, must have no children.
    """
    alone = threading.current_thread() is threading.main_thread() and not multiprocessing.current_process().daemon
    return usable_threads() if sys.platform == "linux" and alone else 1


def map_in_processes(work: Callable[[Task], Out], tasks: Iterable[Task], jobs: int) -> Generator[Out, None, None]:
    """Yield what `work` makes of each task, in their order.

    `tasks`: each is asked for when a process has nothing to do, so that it may depend on the results so far. `jobs`:
    processes; with 1 all is done in this one. Raises `Log2SimError` when a process ended before it had a result, and whatever
    `work` raises. No process is left then, nor when this one is interrupted; should it be killed, they end with what they do.
    """
    if jobs == 1:
        yield from map(work, tasks)
        return
    rest, given, next_out = enumerate(tasks), 0, 0
    running: dict[Connection, int] = {}
    done: dict[int, Out] = {}
    with _forked(work, jobs) as workers:
        while True:
            for connection in [c for c in workers if c not in running]:
                task = next(rest, None) if given - next_out < AHEAD * jobs else None
                if task is not None:
                    running[connection], given = task[0], task[0] + 1
                    connection.send(task[1])
            if next_out in done:
                yield done.pop(next_out)
                next_out += 1
                continue
            if not running:
                return
            for ready in wait(list(running)):
                assert isinstance(ready, Connection)
                done[running.pop(ready)] = _receive(ready, workers[ready])


@contextmanager
def in_background(work: Callable[[], Out], jobs: int) -> Iterator[Callable[[], Out]]:
    """Do `work` in a process of its own while the block runs; what is given waits for it and returns what it returned.

    With one of `jobs` it is done in this process when it is asked for. Raises as `map_in_processes`; no process is left
    after the block.
    """
    if jobs == 1:
        yield work
        return
    with _forked(lambda _: work(), 1) as workers:
        ((connection, process),) = workers.items()
        connection.send(None)
        yield lambda: _receive(connection, process)


@contextmanager
def _forked(work: Callable[[Any], Any], jobs: int) -> Iterator[dict[Connection, Any]]:
    """Within the block forked processes do `work`, each known by the end of its pipe; OpenCV's threads, which a fork lacks, end before."""
    cv2: Any = sys.modules.get("cv2")
    threads = cv2.getNumThreads() if cv2 else 0
    context, workers = multiprocessing.get_context("fork"), dict[Connection, Any]()
    try:
        try:
            if cv2:
                cv2.setNumThreads(1)
            for _ in range(jobs):
                ours, theirs = context.Pipe()
                process = context.Process(target=_serve, args=(work, theirs, [*workers, ours]), daemon=True)
                with warnings.catch_warnings():
                    # Python 3.12 warns of other threads, such as those that draw progress; nothing that they may hold is used.
                    warnings.simplefilter("ignore", DeprecationWarning)
                    process.start()
                workers[ours] = process
                theirs.close()
        finally:
            if cv2:
                cv2.setNumThreads(threads)
        yield workers
    finally:
        for process in workers.values():
            process.kill()
        for connection, process in workers.items():  # which free their memory at the same time
            process.join()
            connection.close()


def _serve(work: Callable[[Any], Any], connection: Connection, not_mine: list[Connection]) -> None:
    """Answer tasks until the process that sends them is gone; it alone is interrupted, and ends this one."""
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    os.environ[LIMIT_VARIABLE] = "1"
    gc.freeze()  # a collection would write to, and so copy, all the memory that is shared with the sender
    for other in not_mine:  # or nobody would notice that the sender is gone
        other.close()
    try:
        while True:
            task = connection.recv()
            try:
                answer = (True, work(task))
            except Exception as error:
                error.add_note("".join(traceback.format_exception(error)))
                answer = (False, error)
            # An error that cannot be pickled, or read again, is sent as its text.
            try:
                content = pickle.dumps(answer, protocol=5)
                if not answer[0]:
                    pickle.loads(content)
            except Exception:
                content = pickle.dumps((False, RuntimeError(f"{type(answer[1]).__name__}: {answer[1]}")))
            connection.send_bytes(content)
    except (EOFError, OSError):
        os._exit(0)


def _receive(connection: Connection, process: Any) -> Any:
    try:
        succeeded, value = pickle.loads(connection.recv_bytes())
    except (EOFError, OSError):
        process.join()
        raise Log2SimError(
            f"a process of this run ended (exit code {process.exitcode}); if its memory did not suffice, use fewer with --jobs"
        ) from None
    if not succeeded:
        raise value
    return value
