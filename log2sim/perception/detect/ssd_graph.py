"""Reader of frozen TensorFlow 1 graphs by the protobuf wire format, without TensorFlow.

Field numbers are those of TensorFlow's graph.proto, node_def.proto, attr_value.proto and tensor.proto.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

VARINT, FIXED64, BYTES, FIXED32 = 0, 1, 2, 5
TENSOR_DTYPES: dict[int, type] = {1: np.float32, 2: np.float64, 3: np.int32, 4: np.uint8, 9: np.int64, 10: np.bool_}


@dataclass(frozen=True)
class Node:
    """One operation of a graph.

    Attributes
    ----------
    name : str
    op : str
    inputs : tuple of str
        Names of nodes, without output numbers.
    attributes : dict of str to bytes
        Undecoded AttrValue messages.
    """

    name: str
    op: str
    inputs: tuple[str, ...]
    attributes: dict[str, bytes]

    def integers(self, key: str) -> list[int]:
        """Read a list of integers, such as strides; empty when the attribute is absent."""
        for number, _, value in fields(self.attributes.get(key, b"")):
            if number == 1:
                return [i for n, wire, v in fields(value) if n == 3 for i in packed_integers(wire, v)]
        return []

    def text(self, key: str) -> str:
        """Read a string, such as the kind of padding; "" when the attribute is absent."""
        return next((bytes(v).decode() for n, _, v in fields(self.attributes.get(key, b"")) if n == 2), "")

    def tensor(self, key: str) -> NDArray[Any] | None:
        """Read a constant; None when the attribute is absent or holds no numbers."""
        return next((read_tensor(v) for n, _, v in fields(self.attributes.get(key, b"")) if n == 8), None)


def read_graph(data: bytes) -> dict[str, Node]:
    """Read all nodes of a GraphDef by name.

    Raises
    ------
    ValueError
        When the bytes are no such message.
    """
    nodes = [read_node(value) for number, wire, value in fields(data) if number == 1 and wire == BYTES]
    return {node.name: node for node in nodes}


def read_node(data: bytes) -> Node:
    """Read one NodeDef."""
    name, op, inputs, attributes = "", "", [], {}
    for number, _, value in fields(data):
        if number == 1:
            name = bytes(value).decode()
        elif number == 2:
            op = bytes(value).decode()
        elif number == 3:
            inputs.append(bytes(value).decode().lstrip("^").split(":")[0])
        elif number == 5:
            entry = {n: bytes(v) for n, _, v in fields(value)}
            attributes[entry[1].decode()] = entry.get(2, b"")
    return Node(name, op, tuple(inputs), attributes)


def fields(data: bytes) -> Iterator[tuple[int, int, Any]]:
    """Yield field number, wire type and value (int or bytes) of each field of one message."""
    at, end = 0, len(data)
    while at < end:
        key, at = varint(data, at)
        wire = key & 7
        if wire == VARINT:
            value, at = varint(data, at)
            yield key >> 3, wire, value
            continue
        if wire == BYTES:
            length, at = varint(data, at)
        elif wire in (FIXED64, FIXED32):
            length = 8 if wire == FIXED64 else 4
        else:
            raise ValueError(f"wire type {wire} at byte {at}: not a protobuf message")
        if at + length > end:
            raise ValueError(f"field {key >> 3} at byte {at} ends behind its message")
        yield key >> 3, wire, data[at : at + length]
        at += length


def varint(data: bytes, at: int) -> tuple[int, int]:
    """Read an unsigned integer of seven bits a byte, lowest first, and return it and where it ends."""
    value = shift = 0
    while at < len(data) and shift < 70:
        byte = data[at]
        value |= (byte & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if byte < 0x80:
            return value, at
    raise ValueError(f"integer at byte {at} does not end")


def packed_integers(wire: int, value: Any) -> list[int]:
    """Read the signed integers of a repeated field, packed or single."""
    if wire == VARINT:
        return [signed(value)]
    out, at = [], 0
    while at < len(value):
        number, at = varint(value, at)
        out.append(signed(number))
    return out


def signed(value: int) -> int:
    """Convert an unsigned 64-bit integer to the signed one of the same bits (two's complement)."""
    return value - (1 << 64) if value >> 63 else value


def read_tensor(data: bytes) -> NDArray[Any] | None:
    """Read a TensorProto as an array; None for types that hold no numbers (strings)."""
    kind, shape, content, values = 0, [], b"", []
    for number, wire, value in fields(data):
        if number == 1:
            kind = value
        elif number == 2:
            shape = [read_dimension(v) for n, _, v in fields(value) if n == 2]
        elif number == 4:
            content = value
        elif number == 5:
            values += list(struct.unpack(f"<{len(value) // 4}f", value))
        elif number in (7, 10, 11):
            values += packed_integers(wire, value)
    dtype = TENSOR_DTYPES.get(kind)
    if dtype is None:
        return None
    if len(content):
        return np.frombuffer(content, dtype).reshape(shape)
    # The format leaves out repeats of the last value.
    count = int(np.prod(shape, dtype=np.int64))
    if len(values) > count:
        raise ValueError(f"{len(values)} values for a tensor of shape {shape}")
    padded = values + (values[-1:] or [0]) * (count - len(values))
    return np.array(padded, dtype).reshape(shape)


def read_dimension(data: bytes) -> int:
    """Read the size of one dimension."""
    return next((signed(value) for number, _, value in fields(data) if number == 1), 0)
