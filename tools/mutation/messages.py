"""Damage to the messages of a ROS log, which is written anew with all lengths and indexes right."""

from __future__ import annotations

import shutil
import struct
from dataclasses import fields, is_dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from log_encoders import ros

from mutation.bases import small_world
from mutation.damage import Damage, Mutation, Place, pick

STYLES = {".bag": ros.Style(container="bag"), ".mcap": ros.Style(), ".db3": ros.Style(container="db3")}
FLOATS = (np.nan, np.inf, -np.inf, 1e308, -1e308)
INTEGERS = (0, 1, -1, 2**31 - 1, -(2**31), 2**32 - 1, 2**16 - 1)
WORDS = ("", "x", "/" * 500, "../..", "\u0663", "base_link", "map")


@cache
def sound_messages(container: str) -> tuple[ros.Message, ...]:
    return tuple(ros.Maker(small_world(), STYLES[container]))


def change_message(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    """A value of a message is extreme, or a topic has messages missing, twice, or of another time."""
    messages = list(sound_messages(file.suffix))
    topics = sorted({m[2] for m in messages})
    topic = topics[rng.integers(len(topics))]
    of_topic = [k for k, m in enumerate(messages) if m[2] == topic]
    at = of_topic[rng.integers(len(of_topic))]
    kind = int(rng.integers(8))
    if kind <= 4:
        changed = _changed(rng, messages[at][4])
        if changed is None:
            return None
        message, words, visible = changed
        messages[at] = (*messages[at][:4], message)
        words = f"{topic}: {words}"
    elif kind == 5:
        gone = of_topic if rng.random() < 0.5 else of_topic[1:]
        messages = [m for k, m in enumerate(messages) if k not in gone]
        words, visible = f"{topic}: {len(gone)} messages are gone", False
    elif kind == 6:
        messages.insert(at, messages[at])
        words, visible = f"{topic}: a message occurs twice", False
    else:
        stamp = int(pick(rng, (0, 2**62, 1)))
        messages[at] = (stamp, stamp, *messages[at][2:])
        words, visible = f"{topic}: a message was recorded at {stamp}", False
    if not messages:
        return None
    target = file if file == place.input else file.parent
    anew = place.outside.parent / "anew"
    shutil.rmtree(anew, ignore_errors=True)  # of a try that failed
    try:
        written = ros.write(iter(messages), anew, "world", STYLES[file.suffix])
    except (struct.error, OverflowError, ValueError):
        return None  # more than the type of the field holds
    shutil.rmtree(target) if target.is_dir() else target.unlink()
    shutil.move(written, target)
    return Damage(words, visible)


def _changed(rng: np.random.Generator, message: Any) -> tuple[Any, str, bool] | None:
    """A message in which one value, at any depth, is another."""
    names = [f.name for f in fields(message) if not f.name.startswith("__")]
    name = names[rng.integers(len(names))]
    old = getattr(message, name)
    if isinstance(old, list) and old and is_dataclass(old[0]):
        at = int(rng.integers(len(old)))
        inner = _changed(rng, old[at])
        return None if inner is None else (
            replace(message, **{name: [*old[:at], inner[0], *old[at + 1 :]]}), f"{name}[{at}].{inner[1]}", inner[2]
        )  # fmt: skip
    if is_dataclass(old):
        inner = _changed(rng, old)
        return None if inner is None else (replace(message, **{name: inner[0]}), f"{name}.{inner[1]}", inner[2])
    value, visible = _other_value(rng, old)
    if value is None:
        return None
    # Small counters and flags of types that cannot hold an extreme value are left as they are.
    return replace(message, **{name: value}), f"{name} is {str(value)[:30]!r}", visible


def _other_value(rng: np.random.Generator, old: Any) -> tuple[Any, bool]:
    if isinstance(old, bool):
        return not old, False
    if isinstance(old, float):
        return FLOATS[rng.integers(len(FLOATS))], True
    if isinstance(old, int):
        return INTEGERS[rng.integers(len(INTEGERS))], False
    if isinstance(old, str):
        return WORDS[rng.integers(len(WORDS))], False
    if isinstance(old, np.ndarray) and old.dtype.kind == "f" and len(old):
        values = old.copy()
        values[int(rng.integers(len(old)))] = FLOATS[rng.integers(len(FLOATS))]
        return values, True
    if isinstance(old, np.ndarray) and old.dtype == np.uint8 and len(old):
        return (old[: len(old) // 2], True) if rng.random() < 0.5 else (old[:0], True)
    return None, False


MESSAGES = (Mutation(change_message, tuple(STYLES), 14.0),)
