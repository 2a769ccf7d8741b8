"""What the three container formats of ROS recordings have in common: channels, and messages that are found by number."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

MAX_MESSAGE_BYTES = 256 * 1024 * 1024
MAX_NAME_CHARACTERS = 256
MAX_MESSAGES = 20_000_000
"""In one file; the index of as many takes half a gigabyte."""


@dataclass(frozen=True)
class Channel:
    """Messages of one topic and type in one file.

    Attributes
    ----------
    topic : str
    msgtype : str
        Such as "sensor_msgs/msg/Image".
    encoding : str
        "ros1", "cdr", or another that is not decoded.
    definition : str
        Text of the message definition; empty where the file holds none.
    compression : str
        Of each message by itself: "" or "zstd".
    """

    topic: str
    msgtype: str
    encoding: str
    definition: str = ""
    compression: str = ""


@dataclass(frozen=True, eq=False)
class Entries:
    """Index of the messages of a file, in the order in which they lie there; M is their number.

    Attributes
    ----------
    channel : (M,) int32
        Index into the channels.
    t_ns : (M,) int64
        When the recorder received the message.
    chunk : (M,) int32
        Index into the chunks; -1 for a message outside of chunks.
    place : (M,) int64
        Where it begins: a byte of its chunk or file, or a row of a database.
    """

    channel: NDArray[np.int32]
    t_ns: NDArray[np.int64]
    chunk: NDArray[np.int32]
    place: NDArray[np.int64]


class Container(Protocol):
    """One file of a recording; `message` may be called from several threads at once."""

    path: Path
    channels: list[Channel]
    entries: Entries
    notes: list[str]

    def message(self, k: int, limit_bytes: int | None = None) -> bytes:
        """Read message `k`, or its first `limit_bytes`; raise one of `sweeps.PARSER_ERRORS` where it is damaged.

        With a limit, chunks are unpacked only as far as needed, and their checksums are not checked; reading messages in
        their order is then fastest.
        """


class EntryList:
    """Index under construction, in blocks of numpy arrays."""

    def __init__(self) -> None:
        self._blocks: list[tuple[NDArray[np.int64], ...]] = []
        self._rows: list[tuple[int, int, int, int]] = []
        self.count = 0

    def add(self, channel: int, t_ns: int, chunk: int, place: int) -> None:
        """Append one message."""
        self._grow(1)
        if not 0 <= t_ns < 1 << 63:
            raise ValueError(f"the recorder's stamp is {t_ns}, no time in ns")
        self._rows.append((channel, t_ns, chunk, place))

    def add_block(self, channel: int, t_ns: NDArray[np.int64], chunk: int, place: NDArray[np.int64]) -> None:
        """Append messages of one channel that lie in one chunk."""
        self._grow(len(t_ns))
        self._blocks.append((np.full(len(t_ns), channel), t_ns, np.full(len(t_ns), chunk), place))

    def entries(self) -> Entries:
        """Return the index, ordered by chunk and place."""
        rows = np.array(self._rows, dtype=np.int64).reshape(-1, 4)
        columns = [np.concatenate([rows[:, c], *(b[c] for b in self._blocks)]) for c in range(4)]
        order = np.lexsort((columns[3], columns[2]))
        channel, t_ns, chunk, place = (column[order] for column in columns)
        return Entries(channel.astype(np.int32), t_ns, chunk.astype(np.int32), place)

    def _grow(self, count: int) -> None:
        self.count += count
        if self.count > MAX_MESSAGES:
            raise ValueError(f"more than the {MAX_MESSAGES} messages that a file may have")


@lru_cache(maxsize=4096)
def printable(text: str) -> str:
    """Return a name of a recording in one line that can be shown, whatever a damaged file has in its place."""
    return "".join(c if c.isprintable() else "?" for c in text[:MAX_NAME_CHARACTERS])


def one_line(problem: Exception) -> str:
    """Return the text of an error as one line of printable characters."""
    return printable(" ".join(str(problem).split())) or type(problem).__name__


def normalized_type(name: str) -> str:
    """Name of a message type as ROS 2 writes it: "sensor_msgs/Image" becomes "sensor_msgs/msg/Image"."""
    parts = printable(name).split("/")
    return f"{parts[0]}/msg/{parts[1]}" if len(parts) == 2 else "/".join(parts)


def checked_size(size_bytes: int) -> int:
    """Return the size of a message; `ValueError` when it is more than a message may have."""
    if not 0 <= size_bytes <= MAX_MESSAGE_BYTES:
        raise ValueError(f"{size_bytes} bytes, more than the {MAX_MESSAGE_BYTES} that a message may have")
    return size_bytes
