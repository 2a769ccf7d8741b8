"""Decode ROS messages by their published definitions, for ROS 1 and for CDR.

The definitions are those that rosbags comes with, not those in the bag: rosbags compiles definitions to Python code, and a log
must not make log2sim run any. A topic whose own definition has other fields is not decoded.
"""

from __future__ import annotations

import re
import threading
from functools import cache
from typing import Any

from log2sim.errors import MissingExtra, RecordError
from log2sim.logs.ros import livox
from log2sim.logs.ros.bag import ENCODINGS, Bag, Topic
from log2sim.logs.ros.containers import one_line

_TF_MESSAGE = "geometry_msgs/TransformStamped[] transforms\n"
# ROS 1 called it so before tf2.
ALIASES = {"tf/msg/tfMessage": "tf2_msgs/msg/TFMessage"}
_FIELD = re.compile(r"^\s*[\w/<>=]+(?:\[[<>=\d]*\])?\s+(?P<name>[A-Za-z]\w*)\s*(?P<constant>=)?")
PLAIN_CDR = (b"\0\0", b"\0\1")
_COMPILING = threading.Lock()


def decode(bag: Bag, topic: Topic, i: int) -> Any:
    """Decode message `i` of a topic; `RecordError` where it is damaged."""
    return decode_bytes(topic, bag.read(topic, i), bag.where(topic, i))


def decode_bytes(topic: Topic, raw: bytes, where: str) -> Any:
    """Decode the bytes of a message; `RecordError`, beginning with `where`, when they are damaged."""
    if topic.encoding == "cdr" and raw[:2] not in PLAIN_CDR:
        raise RecordError(f"{where}: encapsulation {raw[:2].hex() or 'missing'}, only plain CDR (0000, 0001) is read")
    store = typestore(topic.encoding)
    kind = ALIASES.get(topic.msgtype, topic.msgtype)
    try:
        # rosbags compiles a type when it first meets it.
        with _COMPILING:
            return store.deserialize_ros1(raw, kind) if topic.encoding == "ros1" else store.deserialize_cdr(raw, kind)
    except Exception as problem:  # rosbags raises whatever its compiled code runs into
        raise RecordError(f"{where}: not a readable {topic.msgtype}: {one_line(problem)}") from None


def find_layout_problem(topic: Topic) -> str | None:
    """Say why messages of a topic cannot be decoded; None when they can."""
    if topic.encoding not in ENCODINGS:
        return f"its messages are encoded as '{topic.encoding}', only ros1 and cdr are read"
    if topic.msgtype in livox.TYPES:
        expected = livox.FIELDS
    else:
        expected = [
            name for name, _ in typestore(topic.encoding).fielddefs[ALIASES.get(topic.msgtype, topic.msgtype)][1]
        ]
    found = definition_fields(topic.definition)
    if topic.definition and found != expected:
        return f"its definition of {topic.msgtype} has the fields {', '.join(found)}, expected {', '.join(expected)}"
    return None


def definition_fields(definition: str) -> list[str]:
    """Names of the fields of the first message of a definition text."""
    names = []
    for line in definition.partition("\n====")[0].splitlines():
        match = _FIELD.match(line.partition("#")[0])
        if match and not match["constant"]:
            names.append(match["name"])
    return names


@cache
def typestore(encoding: str) -> Any:
    """Definitions that rosbags comes with, for ROS 1 (Noetic) or ROS 2 (Humble)."""
    try:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError:
        raise MissingExtra("reading ROS bags and MCAP files", "ros") from None
    if encoding != "ros1":
        return get_typestore(Stores.ROS2_HUMBLE)
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg(_TF_MESSAGE, "tf2_msgs/msg/TFMessage"))
    return store
