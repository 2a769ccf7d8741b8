"""Numbers as text states them: in ASCII digits, as data files and their standards write them.

Python itself also takes "1_000" and the digits of all scripts, which no writer of a log means.
"""

from __future__ import annotations


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
