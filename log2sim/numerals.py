"""Numbers as text states them: in ASCII digits, as data files and their standards write them; arrays in one line.

Python itself also takes "1_000" and the digits of all scripts, which no writer of a log means.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np

MAX_SHOWN = 100
"""Letters of a value that `short_repr` shows."""


def is_plain(text: str) -> bool:
    """Return whether a text has nothing in it that Python, but no format of files, takes for a part of a number."""
    return text.isascii() and "_" not in text


def parse_float(text: str) -> float:
    """Parse a number; it may be infinite or NaN.

    Raises
    ------
    ValueError
        For any other text.
    """
    if not is_plain(text):
        raise ValueError(f"could not convert string to float: {text[:40]!a}")
    return float(text)


def parse_int(text: str) -> int:
    """Parse a whole number.

    Raises
    ------
    ValueError
        For any other text.
    """
    if not is_plain(text):
        raise ValueError(f"invalid whole number: {text[:40]!a}")
    return int(text)


def short_repr(value: Any) -> str:
    """Return a dataclass in one line, as its `__repr__`: arrays by shape and type, long values by their count.

    What a field defers is not read for it.
    """
    parts = (f"{f.name}={_short(vars(value).get(f.name))}" for f in fields(value) if f.repr)
    return f"{type(value).__name__}({', '.join(parts)})"


def _short(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"<{value.shape} {value.dtype}>"
    if callable(value):
        return "..."
    if isinstance(value, (tuple, list, Mapping)) and len(value) > 1:
        text = repr(value) if all(isinstance(v, (str, int, float, type(None))) for v in value) else ""
        return text if 0 < len(text) <= MAX_SHOWN else f"<{len(value)} entries>"
    return repr(value)
