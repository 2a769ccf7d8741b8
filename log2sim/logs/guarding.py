"""One place where whatever a parser raises on damaged data becomes an error that names the record or the log."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import numpy as np

from log2sim.datatypes import Log, Stream
from log2sim.errors import Log2SimError, LogError, RecordError
from log2sim.logs.pose_checks import MAX_POSITION_M

T = TypeVar("T")
MAX_REASON_CHARACTERS = 300


@contextmanager
def translate_parser_errors(where: str, error: type[LogError]) -> Iterator[None]:
    """Turn what is no `Log2SimError` into an `error` of one line that begins with `where`.

    Lack of memory and interrupts pass: they say nothing about the data. NumPy's warnings of numbers that are too large or not
    finite are silent within, since the checks that follow decide what such numbers mean.
    """
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            yield
    except (Log2SimError, MemoryError):
        raise
    except Exception as problem:
        lines = str(problem).strip().splitlines()
        name = "" if isinstance(problem, ValueError) else f"{type(problem).__name__}: "
        reason = f"{name}{lines[0] if lines else ''}"[:MAX_REASON_CHARACTERS].removesuffix(": ")
        raise error(f"{where}: {reason or type(problem).__name__}") from problem


def guard_log(log: Log, where: str) -> Log:
    """Return the log with its streams guarded, and with labels, notes and stamps that are guarded when they are read.

    Parameters
    ----------
    log : Log
        As a reader returns it.
    where : str
        Its path, for errors.

    Raises
    ------
    LogError
        For poses of the ego that are not finite, or farther from the origin of the map than any place on Earth.
    """
    _require_possible_poses(log, where)
    return log.changed(
        streams={name: _guarded_stream(stream, where) for name, stream in log.streams.items()},
        labels=_guarded(lambda: log.labels, f"{where}: the labels cannot be read"),
        notes=_guarded(lambda: log.notes, f"{where}: cannot be read"),
    )


def _require_possible_poses(log: Log, where: str) -> None:
    if log.ego is None:
        return
    wrong = np.flatnonzero(~(np.abs(log.ego.map_T_ego) <= MAX_POSITION_M).all(axis=(1, 2)))
    if len(wrong):
        position = ", ".join(f"{v:.6g}" for v in log.ego.map_T_ego[wrong[0], :3, 3])
        raise LogError(
            f"{where}: the position of the ego at stamp {log.ego.t_ns[wrong[0]]} is {position}, expected finite numbers up to "
            f"{MAX_POSITION_M:g} m; {len(wrong)} of {len(log.ego.t_ns)} poses are so"
        )


def _guarded_stream(stream: Stream, where: str) -> Stream:
    """Return a stream whose records are returned or raise `RecordError`."""
    stamps = _guarded(lambda: stream.t_ns, f"{where}: the stamps of '{stream.name}' cannot be read")
    encoded = stream.encoded
    return Stream(
        stream.name,
        stamps,
        _guarded_record(stream, stream.read, where),
        None if encoded is None else _guarded_record(stream, encoded, where),
    )


def _guarded_record(stream: Stream, read: Callable[[int], T], where: str) -> Callable[[int], T]:
    def guarded(i: int) -> T:
        with translate_parser_errors(f"{where}: record {i} of '{stream.name}' cannot be read", RecordError):
            return read(i)

    return guarded


def _guarded(read: Callable[[], Any], where: str) -> Callable[[], Any]:
    def guarded() -> Any:
        with translate_parser_errors(where, LogError):
            return read()

    return guarded
