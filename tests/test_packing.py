"""Dataclasses of arrays as bytes: what comes back is the same bit for bit, and what nobody packed is an error."""

from __future__ import annotations

import hashlib
import json
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from log2sim.files.packing import pack, unpack


@dataclass
class Row:
    name: str
    values: Any
    rest: Any = None


numbers = st.one_of(
    st.none(), st.booleans(), st.integers(-(2**60), 2**60), st.floats(allow_nan=False), st.text(max_size=4)
)
# Half of a pair is no letter, and NumPy drops zeros at the end.
letters = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=3)
columns = st.sampled_from(["<f8", "<f4", "<i8", "|u1", "|b1", "<U3"]).flatmap(
    lambda kind: arrays(
        np.dtype(kind), st.tuples(st.integers(0, 3), st.integers(1, 3)), elements=letters if kind == "<U3" else None
    )
)
values = st.recursive(
    numbers | columns,
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.tuples(inner, inner)
        | st.dictionaries(st.tuples(st.text(max_size=2), st.integers(0, 5)), inner, max_size=2)
        | st.builds(Row, st.text(max_size=3), inner)
    ),
    max_leaves=8,
)


def same(a: Any, b: Any) -> bool:
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes())
    if isinstance(a, Row):
        return same(vars(a), vars(b))
    if isinstance(a, dict):
        return list(a) == list(b) and all(same(a[k], b[k]) for k in a)
    if isinstance(a, (list, tuple)):
        return type(a) is type(b) and len(a) == len(b) and all(map(same, a, b))
    return type(a) is type(b) and bool(a == b)


@settings(max_examples=60, deadline=None)
@given(values)
def test_values_come_back_bit_for_bit(value: Any) -> None:
    content = pack(value)
    assert same(unpack(content, (Row,)), value)
    for wrong in (content[:-1], content + b"\0", b"PK\3\4" * 9, b""):
        with pytest.raises(ValueError, match=r"\w"):
            unpack(wrong, (Row,))


def sealed(text: Any, body: bytes = b"") -> bytes:
    """Bytes with a right check sum, whatever is in them."""
    described = json.dumps(text).encode()
    rest = described + body
    return struct.pack("<8s16sI", b"l2spack1", hashlib.blake2b(rest, digest_size=16).digest(), len(described)) + rest


@pytest.mark.parametrize(
    "content",
    [
        sealed({"array": ["<f8", 2**40]}),
        sealed({"array": ["<f8", 2**62, 4]}),
        sealed({"array": ["<f8", -1]}),
        sealed({"array": ["|O", 1]}, bytes(8)),
        sealed({"array": ["<U1000000000", 1]}),
        sealed({"array": ["<U1", 1]}, b"\xff" * 4),
        sealed({"array": ["<U1", 1]}, b"\x00\xd8\0\0"),
        sealed({"array": ["<U1", 1]}, b"\xff\xdf\0\0"),
        sealed({"array": ["no type", 1]}),
        sealed({"of": "Popen", "fields": {}}),
        sealed({"of": "Row", "fields": {"other": 1}}),
        sealed({"pairs": [[[], 1]]}),
        sealed(7, b"more"),
        struct.pack("<8s16sI", b"l2spack1", hashlib.blake2b(b"", digest_size=16).digest(), 9),
    ],
)
def test_a_right_check_sum_does_not_make_wrong_bytes_right(content: bytes) -> None:
    with pytest.raises(ValueError, match=r"\w"):
        unpack(content, (Row,))


def test_letters_beside_halves_of_pairs_are_texts() -> None:
    letters = np.array(["\ud7ff", "\ue000", "\U0010ffff"])
    assert unpack(pack(letters), ()).tolist() == letters.tolist()


def test_what_holds_references_is_not_packed() -> None:
    for value in (np.array([object()]), object(), {"a": {1, 2}}):
        with pytest.raises(TypeError):
            pack(value)
