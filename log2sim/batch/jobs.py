"""Logs of a batch as they are sent to workers: small, since the settings are in the folder of the batch."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

from log2sim.batch.discovery import FoundLog

MAX_NAME_CHARS = 80
"""Of a folder; file systems take 255 bytes, and temporary names are longer."""
HASH_DIGITS = 8
_SAFE = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._-]*")
_UNSAFE_CHARS = re.compile(r"[^A-Za-z0-9._-]+")


@dataclass(frozen=True)
class Job:
    """One run of one log.

    Attributes
    ----------
    out : str
        Folder of the batch, absolute.
    token : str
        Of the batch; a folder of that name without it is another one.
    name : str
        Of the folder for the log.
    log : str
        `FoundLog.id`.
    path : str
        What `open_log` takes, absolute.
    format, sequence : str
    cache : bool
        Whether detections in pictures are kept, and taken from earlier runs.
    attempts : int
        1 at the first run.
    """

    out: str
    token: str
    name: str
    log: str
    path: str
    format: str
    sequence: str
    cache: bool = True
    attempts: int = 1


def make_jobs(logs: Sequence[FoundLog], out: Path, token: str, *, cache: bool = True) -> list[Job]:
    """Return a job for each log, with a name for its folder that no other has and that any file system takes."""
    plain = [_plain_name(log.id) for log in logs]
    # Some file systems do not tell upper from lower case.
    count = Counter(name.lower() for name in plain)
    names = [
        name if name == log.id and count[name.lower()] == 1 else f"{name}-{_hash(f'{log.format}:{log.id}')}"
        for log, name in zip(logs, plain)
    ]
    return [
        Job(str(out.absolute()), token, name, log.id, str(log.path.absolute()), log.format, log.sequence, cache)
        for log, name in zip(logs, names)
    ]


def _plain_name(text: str) -> str:
    """Return a text with letters, digits, "._-" alone, no dot in front, and of a limited length."""
    if len(text) <= MAX_NAME_CHARS and _SAFE.fullmatch(text):
        return text
    return _UNSAFE_CHARS.sub("_", text).strip("._-")[-MAX_NAME_CHARS:] or "log"


def _hash(text: str) -> str:
    return sha256(text.encode("utf-8", "surrogateescape")).hexdigest()[:HASH_DIGITS]
