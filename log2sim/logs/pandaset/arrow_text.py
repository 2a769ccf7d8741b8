"""Text columns of Arrow (pandas 3 keeps text in them), decoded from their buffers without pyarrow."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Type of the offsets by the name of the type: where each text starts in the bytes of all.
OFFSETS = {"string": "<i4", "large_string": "<i8"}
MAX_TEXTS = 10_000_000


def decode_text(kind: str, length: int, start: int, buffers: Sequence[bytes | bytearray | None]) -> NDArray[Any]:
    """Decode an array of text.

    Parameters
    ----------
    kind : {"string", "large_string"}
    length, start : int
        Number of texts, and how many texts of the buffers come before them.
    buffers : sequence of bytes or None
        One bit a text that says whether it is there (None: all are), offsets, UTF-8 bytes.

    Returns
    -------
    (N,) object
        Texts; NaN where there is none, as in the text columns of pandas.

    Raises
    ------
    ValueError
        When the buffers do not hold what they should.

    Notes
    -----
    Arrow columnar format, "variable-size binary layout"; bits are numbered from the least significant one.
    """
    if kind not in OFFSETS:
        raise ValueError(f"ArrowStringArray of type '{kind}', expected {' or '.join(OFFSETS)}")
    if not all(isinstance(n, int) and n >= 0 for n in (length, start)) or len(buffers) != 3:
        raise ValueError("an ArrowStringArray has no length or not three buffers")
    there, offsets, data = (None if b is None else np.frombuffer(b, np.uint8) for b in buffers)
    if length > MAX_TEXTS:
        raise ValueError(f"an ArrowStringArray of {length} texts, more than the {MAX_TEXTS} that a column may have")
    if not length:
        return np.empty(0, dtype=object)
    if offsets is None or len(offsets) < (start + length + 1) * np.dtype(OFFSETS[kind]).itemsize:
        raise ValueError(f"an ArrowStringArray of {length} texts has too few offsets")
    ends = offsets.view(OFFSETS[kind])[start : start + length + 1].astype(np.int64)
    text = b"" if data is None else data.tobytes()
    if ends[0] < 0 or ends[-1] > len(text) or (np.diff(ends) < 0).any():
        raise ValueError("offsets of an ArrowStringArray leave its text")
    cells = np.full(length, np.nan, dtype=object)
    for row in np.flatnonzero(_presence(there, start, length)):
        cells[row] = text[ends[row] : ends[row + 1]].decode()
    return cells


def _presence(bits: NDArray[np.uint8] | None, start: int, length: int) -> NDArray[np.bool_]:
    if bits is None:
        return np.ones(length, dtype=bool)
    if len(bits) * 8 < start + length:
        raise ValueError("an ArrowStringArray does not say of each text whether it is there")
    return np.unpackbits(bits, bitorder="little")[start : start + length].astype(bool)
