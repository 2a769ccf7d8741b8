"""Digest of a log: SHA-256 over its index and over names and sizes of its records."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from pathlib import Path


def digest_of(texts: Iterable[str], files: Iterable[Path]) -> str:
    """SHA-256 over calibration and index texts and over names and sizes of the records."""
    value = hashlib.sha256()
    for text in texts:
        value.update(text.encode())
    for file in files:
        size = file.stat().st_size if file.exists() else -1
        value.update(f"{file.parent.name}/{file.name} {size}\n".encode())
    return value.hexdigest()
