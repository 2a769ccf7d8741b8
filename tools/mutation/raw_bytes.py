"""Damage to the bytes of a file, whatever its format."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mutation.damage import Damage, Mutation, Place
from mutation.text_lines import TEXT, cut_is_visible

# Every byte of the records is under a check sum.
CHECKED = (".npz", ".gz", ".png", ".tfrecord")
# Lengths, an index at the end, or an end mark: a file that ends too early can be told.
ENDED = (*CHECKED, ".json", ".xosc", ".jpg", ".feather", ".parquet", ".bag", ".mcap", ".db3", ".npy", ".pcd")
MAX_CHANGED = 16
BLOWN = (0, 1, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 0x10000000)


def flip_bytes(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    data = bytearray(file.read_bytes())
    if not data:
        return None
    # The first bytes hold headers, which a draw over the whole file would hardly ever hit.
    end = len(data) if rng.random() < 0.6 else min(len(data), 256)
    count = int(rng.integers(1, MAX_CHANGED))
    where = rng.integers(end, size=count)
    for k in where:
        data[k] ^= 1 << int(rng.integers(8))
    file.write_bytes(data)
    return Damage(f"{count} bits flipped, first at {where[0]}", file.name.endswith(CHECKED))


def cut_file(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    data = file.read_bytes()
    if len(data) < 2:
        return None
    keep = (
        int(rng.integers(1, len(data))) if rng.random() < 0.8 else len(data) - int(rng.integers(1, min(len(data), 20)))
    )
    file.write_bytes(data[:keep])
    words = f"cut to {keep} of {len(data)} bytes"
    if file.name.endswith(ENDED):
        return Damage(words, not data[keep:].isspace())
    if file.suffix == ".bin":
        return Damage(words, keep % 4 != 0)
    return Damage(words, file.suffix in TEXT and cut_is_visible(data, keep))


def insert_bytes(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    data = file.read_bytes()
    at, count = int(rng.integers(len(data) + 1)), int(rng.integers(1, 65))
    file.write_bytes(data[:at] + rng.bytes(count) + data[at:])
    return Damage(f"{count} bytes inserted at {at}", _length_shows(file, count, at < len(data)))


def delete_bytes(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    data = file.read_bytes()
    if len(data) < 2:
        return None
    at = int(rng.integers(len(data)))
    count = int(rng.integers(1, min(65, len(data) - at + 1)))
    file.write_bytes(data[:at] + data[at + count :])
    return Damage(f"{count} bytes deleted at {at}", _length_shows(file, count, True))


def repeat_bytes(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    data = file.read_bytes()
    if len(data) < 2:
        return None
    at = int(rng.integers(len(data)))
    count = int(rng.integers(1, min(4096, len(data) - at + 1)))
    file.write_bytes(data[: at + count] + data[at : at + count] + data[at + count :])
    return Damage(f"{count} bytes at {at} repeated", _length_shows(file, count, at + count < len(data)))


def zero_bytes(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    data = bytearray(file.read_bytes())
    if len(data) < 2:
        return None
    at = int(rng.integers(len(data)))
    count = min(int(rng.integers(1, 4096)), len(data) - at)
    data[at : at + count] = bytes(count)
    file.write_bytes(data)
    return Damage(f"{count} bytes at {at} are zero", file.name.endswith(CHECKED))


def blow_up_integer(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    """Replace what may be a length or count, an integer below a million, by an extreme one."""
    data = bytearray(file.read_bytes())
    starts = [
        k for k in range(0, min(len(data), 4096) - 4) if 0 < int.from_bytes(data[k : k + 4], "little") < 1_000_000
    ]
    if file.suffix in TEXT or not starts:
        return None
    at, value = starts[rng.integers(len(starts))], BLOWN[rng.integers(len(BLOWN))]
    data[at : at + 4] = value.to_bytes(4, "little")
    file.write_bytes(data)
    return Damage(f"the integer at {at} is {value}", file.name.endswith(CHECKED))


def replace_content(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    contents = {
        "nothing": b"", "one zero": b"\0", "spaces": b" \n" * 50, "noise": rng.bytes(2000), "zeros": bytes(3000),
        "a page": b"<!DOCTYPE html><html><body>404 Not Found</body></html>",
        "a git-lfs pointer": b"version https://git-lfs.github.com/spec/v1\noid sha256:" + b"0" * 64 + b"\nsize 123456\n",
    }  # fmt: skip
    name = list(contents)[rng.integers(len(contents))]
    file.write_bytes(contents[name])
    return Damage(f"holds {name}", not (file.suffix in (".bin", ".txt") and not contents[name].strip()))


def _length_shows(file: Path, count: int, within: bool) -> bool:
    """Whether bytes more or less can be told; appended ones may be room for growth."""
    if file.suffix == ".bin":
        return count % 4 != 0
    return within and file.name.endswith(CHECKED)


RAW = (
    Mutation(flip_bytes, weight=3.0), Mutation(cut_file, weight=2.0), Mutation(insert_bytes), Mutation(delete_bytes),
    Mutation(repeat_bytes), Mutation(zero_bytes), Mutation(blow_up_integer), Mutation(replace_content),
)  # fmt: skip
