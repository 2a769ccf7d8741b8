"""Dataclasses of arrays as bytes and back, without pickle: bytes that a stranger wrote become numbers and texts, or an error."""

from __future__ import annotations

import hashlib
import json
import math
import struct
from collections.abc import Collection, Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

MAGIC = b"l2spack1"
DIGEST_BYTES = 16
# Magic, check sum of the rest, length of the JSON text that says what the arrays behind it are.
_HEAD = struct.Struct("<8s16sI")
# Numbers and texts; nothing that holds a reference.
KINDS, MAX_ITEM_BYTES = "biufU", 1024


def pack(value: Any) -> bytes:
    """Return None, numbers, texts, arrays, and lists, tuples, mappings and dataclasses of them as bytes."""
    text, arrays = _described(value)
    rest = b"".join([text, *(array.tobytes() for array in arrays)])
    return _HEAD.pack(MAGIC, _digest(rest), len(text)) + rest


def digest_of(value: Any) -> str:
    """Return a digest of what `pack` takes."""
    text, arrays = _described(value)
    found = hashlib.blake2b(text, digest_size=DIGEST_BYTES)
    for array in arrays:
        found.update(array.tobytes() if array.dtype.kind == "U" else array.data)
    return found.hexdigest()


def _described(value: Any) -> tuple[bytes, list[NDArray[Any]]]:
    """Describe a value as JSON, and list the arrays in it."""
    arrays: list[NDArray[Any]] = []

    def described(item: Any) -> Any:
        if item is None or isinstance(item, (bool, int, float, str)):
            return item
        if isinstance(item, np.generic):
            return item.item()
        if isinstance(item, np.ndarray):
            if item.dtype.kind not in KINDS:
                raise TypeError(f"an array of {item.dtype} cannot be packed")
            arrays.append(np.asarray(item, order="C"))
            return {"array": [item.dtype.str, *item.shape]}
        if is_dataclass(item) and not isinstance(item, type):
            return {
                "of": type(item).__name__,
                "fields": {f.name: described(getattr(item, f.name)) for f in fields(item)},
            }
        if isinstance(item, Mapping):
            return {"pairs": [[described(key), described(part)] for key, part in item.items()]}
        if isinstance(item, list):
            return [described(part) for part in item]
        if isinstance(item, Sequence):
            return {"tuple": [described(part) for part in item]}
        raise TypeError(f"a {type(item).__name__} cannot be packed")

    return json.dumps(described(value), separators=(",", ":")).encode(), arrays


def unpack(content: bytes, classes: Collection[type]) -> Any:
    """Return what `pack` made bytes of; all dataclasses in it are among `classes`.

    Raises `ValueError` for whatever `pack` did not write; no number in it is believed before the length agrees with it.
    """
    try:
        magic, digest, length = _HEAD.unpack_from(content)
        rest = memoryview(content)[_HEAD.size :]
        if magic != MAGIC or digest != _digest(rest) or length > len(rest):
            raise ValueError("not packed by log2sim, or damaged")
        reader = _Reader(rest[length:], {of.__name__: of for of in classes})
        value = reader.value(json.loads(bytes(rest[:length])))
        if reader.left:
            raise ValueError("more bytes than arrays")
        return value
    except (struct.error, KeyError, TypeError, AttributeError, RecursionError, OverflowError) as problem:
        raise ValueError(f"not what was packed: {problem!r}") from None


class _Reader:
    """Values of descriptions, whose arrays follow one another."""

    def __init__(self, left: memoryview, classes: Mapping[str, type]) -> None:
        self.left, self._classes = left, classes

    def value(self, item: Any) -> Any:
        if isinstance(item, list):
            return [self.value(part) for part in item]
        if not isinstance(item, dict):
            return item
        if "array" in item:
            return self._array(*item["array"])
        if "tuple" in item:
            return tuple(self.value(part) for part in item["tuple"])
        if "pairs" in item:
            return {self.value(key): self.value(part) for key, part in item["pairs"]}
        return self._classes[item["of"]](**{name: self.value(part) for name, part in item["fields"].items()})

    def _array(self, kind: str, *shape: int) -> NDArray[Any]:
        dtype = np.dtype(kind)
        if dtype.kind not in KINDS or not 0 < dtype.itemsize <= MAX_ITEM_BYTES or any(n < 0 for n in shape):
            raise ValueError(f"no array of {kind} {shape}")
        count = math.prod(shape)
        if count * dtype.itemsize > len(self.left):
            raise ValueError("fewer bytes than arrays")
        here, self.left = self.left[: count * dtype.itemsize], self.left[count * dtype.itemsize :]
        array = np.frombuffer(here, dtype, count).reshape(shape).copy()
        if dtype.kind == "U":
            # Letters that Unicode has, none of them half of a pair.
            code = np.ascontiguousarray(array).reshape(-1).view(np.uint32)
            if not ((code <= 0x10FFFF) & ~((code >= 0xD800) & (code < 0xE000))).all():
                raise ValueError("letters that Unicode does not have")
        return array


def _digest(content: bytes | memoryview) -> bytes:
    return hashlib.blake2b(content, digest_size=DIGEST_BYTES).digest()
