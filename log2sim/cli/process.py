"""The process of a command: signals that end it as Ctrl-C does, and output that nobody can read."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import TextIO

ENDING_SIGNALS = ("SIGTERM", "SIGHUP")
SIGNAL_CODE = 128
"""A shell adds the number of the signal to this as the exit code: 143 for SIGTERM."""


class Ended:
    """Which signal ended the process.

    Attributes
    ----------
    signal : int
        0 while there was none.
    """

    signal = 0


@contextmanager
def ending_by_signals() -> Iterator[Ended]:
    """Within the block SIGTERM and SIGHUP raise `KeyboardInterrupt`, so that all that is cleaned up then is cleaned up.

    Signals that are ignored, as `nohup` does with SIGHUP, stay so. Other threads than the first get no signals.
    """
    ended = Ended()

    def end(number: int, frame: FrameType | None) -> None:
        ended.signal = number
        raise KeyboardInterrupt

    numbers = [getattr(signal, name) for name in ENDING_SIGNALS if hasattr(signal, name)]
    before = {}
    if threading.current_thread() is threading.main_thread():
        before = {n: signal.signal(n, end) for n in numbers if signal.getsignal(n) == signal.SIG_DFL}
    try:
        yield ended
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class TolerantStream:
    """A stream of text that drops what cannot be written: closed, full, or of characters that it cannot show."""

    def __init__(self, stream: TextIO | None) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> object:
        """Return whatever else the stream has."""
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write a text, with escapes for characters that the stream cannot show."""
        try:
            if self._stream is not None:
                encoding = self._stream.encoding or "utf-8"
                self._stream.write(text.encode(encoding, "backslashreplace").decode(encoding))
        except (OSError, ValueError):  # ValueError: it is closed
            self._give_up()
        return len(text)

    def flush(self) -> None:
        """Write what waits to be written."""
        try:
            if self._stream is not None:
                self._stream.flush()
        except (OSError, ValueError):
            self._give_up()

    def isatty(self) -> bool:
        """Return whether somebody looks at it."""
        return self._stream is not None and not self._stream.closed and self._stream.isatty()

    def _give_up(self) -> None:
        """Write nowhere from now on; Python would try again to write what waits when it ends, and fail."""
        stream, self._stream = self._stream, None
        if stream is None:
            return
        try:
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, stream.fileno())
            os.close(nowhere)
        except (OSError, ValueError):
            return


def fill_closed_descriptors() -> None:
    """Let the standard streams that are closed lead nowhere: a file opened next would get the number, and what libraries print."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest number that is free


@contextmanager
def tolerating_lost_output() -> Iterator[None]:
    """Within the block what cannot be printed changes nothing else."""
    fill_closed_descriptors()
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = TolerantStream(sys.stdout), TolerantStream(sys.stderr)
    try:
        yield
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        sys.stdout, sys.stderr = before
