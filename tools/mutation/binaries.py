"""Damage to the bytes of a file, whatever its format."""

from __future__ import annotations

import builtins
import gzip
import io
import os
import pickle
import shutil
import sqlite3
import struct
import zipfile
import zlib
from dataclasses import fields, is_dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from log_encoders import ros

from log2sim.logs.waymo.tfrecord import masked_crc32c
from mutation.bases import small_world
from mutation.damage import Damage, Mutation, Place, files_below, pick
from mutation.texts import TEXT, cut_is_visible

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


EXTREMES = (np.nan, np.inf, -np.inf, 1e308, -1e30, 1e9)
BOMB_BYTES = 300_000_000
HUGE = (65_535, 65_500, 30_000)
HEADERS = (
    "{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000, 3), }",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (-1, 3), }",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (3, 4611686018427387905), }",
    "{'descr': '|O', 'fortran_order': False, 'shape': (4, 3), }",
    "{'descr': '|V1000000', 'fortran_order': False, 'shape': (100000, 3), }",
    "{'descr': [('x', '<f8'), ('y', '<f8'), ('z', '<f8')], 'fortran_order': False, 'shape': (4,), }",
    "{'descr': '<U500000', 'fortran_order': False, 'shape': (1000, 3), }",
    "{'descr': '<f8', 'fortran_order': True, 'shape': (4, 3, 2, 1), }",
    "{'descr': '<f8', 'fortran_order': 7, 'shape': '4', }",
    "{'descr': '<f8', 'shape': (4, 3), }",
    "__import__('os').mkdir('pwned')",
    "(" * 500 + ")" * 500,
    "{'descr': '<f8', 'fortran_order': False, 'shape': (4, 3)",
    "\0\n\t" * 30,
)


class Payload:
    """What runs a function when it is unpickled."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.made_by = function, arguments

    def __reduce__(self) -> Any:
        return self.made_by


def npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def npy_with_header(header: str, data: bytes) -> bytes:
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", min(len(header), 65535)) + header.encode()[:65535] + data


def archive(members: list[tuple[str, bytes]], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as file:
        for name, data in members:
            file.writestr(name, data)
    return stream.getvalue()


def change_arrays(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    """Other values, types, shapes and members; whatever is compressed stays consistent."""
    with np.load(file) as loaded:
        arrays = {name: loaded[name] for name in loaded.files}
    name = list(arrays)[rng.integers(len(arrays))]
    array = arrays[name].copy()
    members = {k: npy(v) for k, v in arrays.items()}
    kind = int(rng.integers(9))
    if kind == 0 and array.dtype.kind == "f":
        value = EXTREMES[rng.integers(len(EXTREMES))]
        rows = rng.random(len(array)) < rng.choice([0.001, 0.3, 1.0])
        array[rows] = value
        members[name], words, visible = (
            npy(array),
            f"{rows.sum()} rows of {name} are {value}",
            bool(rows.sum() > len(array) / 2),
        )
    elif kind == 1 and array.dtype.kind == "i":
        value = int(pick(rng, (np.iinfo(array.dtype).max, np.iinfo(array.dtype).min, 10**9 + 1)))
        array[int(rng.integers(len(array)))] = min(value, np.iinfo(array.dtype).max)
        members[name], words, visible = npy(array), f"a value of {name} is {value}", abs(value) > 10**9
    elif kind == 2:
        dtype = str(pick(rng, ("f2", "i8", "u1", "c16", "?", "U10", "O", "M8[ns]", "f16", ">f4")))
        members[name], words, visible = (
            npy(array.astype(dtype)),
            f"{name} is of type {dtype}",
            dtype not in ("f2", "f16", ">f4", "i8"),
        )
    elif kind == 3:
        other = (array[:0], array[:-1], array[..., None], np.concatenate([array] * 2), array[:1])[int(rng.integers(5))]
        members[name], words, visible = (
            npy(other),
            f"{name} is {other.shape}",
            other.shape[1:] != array.shape[1:] or len(arrays) > 1,
        )
    elif kind == 4:
        del members[name]
        words, visible = f"{name} is missing", name == "xyz_m"
    elif kind == 5:
        header = HEADERS[rng.integers(len(HEADERS))]
        members[name], words, visible = (
            npy_with_header(header, array.tobytes()),
            f"{name} has the header {header[:60]!r}",
            True,
        )
    elif kind == 6:
        target = place.outside / "pwned"
        data = pickle.dumps(Payload(os.mkdir, str(target)))
        members[name], words, visible = (
            npy_with_header(HEADERS[3], data),
            f"{name} is a pickle that makes a folder",
            True,
        )
    elif kind == 7:
        zeros = npy_with_header(HEADERS[0], b"") + bytes(BOMB_BYTES)
        members[name], words, visible = zeros, f"{name} unpacks to {BOMB_BYTES} zeros", True
    else:
        members[name], words, visible = rng.bytes(300), f"{name} is noise", True
    file.write_bytes(archive([(f"{k}.npy", v) for k, v in members.items()]))
    return Damage(words, visible)


def change_archive(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    """Other compressions, an encrypted bit, a member twice, names that lead elsewhere."""
    data = bytearray(file.read_bytes())
    with zipfile.ZipFile(io.BytesIO(data)) as loaded:
        members = [(i.filename, loaded.read(i)) for i in loaded.infolist()]
    kind = int(rng.integers(6))
    if kind == 0:
        method = int(pick(rng, (zipfile.ZIP_STORED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)))
        file.write_bytes(archive(members, method))
        return Damage(f"compressed by method {method}", False)
    if kind == 1:
        data = bytearray(archive(members, int(pick(rng, (zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)))))
        at = len(data) // 3
        data[at] ^= 0xFF
        file.write_bytes(data)
        return Damage("compressed otherwise, a byte inverted", True)
    if kind == 2:
        for mark, offset in ((b"PK\1\2", 8), (b"PK\3\4", 6)):
            at = data.find(mark)
            data[at + offset] |= 1
        file.write_bytes(data)
        return Damage("its first member is encrypted", True)
    if kind == 3:
        method = int(rng.integers(1, 100))
        for mark, offset in ((b"PK\1\2", 10), (b"PK\3\4", 8)):
            at = data.find(mark)
            data[at + offset : at + offset + 2] = method.to_bytes(2, "little")
        file.write_bytes(data)
        return Damage(f"its first member states the method {method}", method != 8)
    if kind == 4:
        name = str(pick(rng, ("../../pwned.npy", "/tmp/pwned.npy", "xyz_m.npy/", "a" * 60_000)))
        file.write_bytes(archive([(name, b"x"), *members]))
        return Damage(f"has a member {name[:30]}", False)
    at = data.rfind(b"PK\5\6")
    data[at + 8 : at + 12] = b"\xff\xff\xff\xff"
    file.write_bytes(data)
    return Damage("states 65535 members", False)


def change_table_pickle(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    """Payloads, deep nesting, and tables with other columns, types and values."""
    import pandas

    table = pandas.read_pickle(file)
    kind = int(rng.integers(10))
    column = table.columns[rng.integers(len(table.columns))]
    words, visible = f"column {column}", True
    target = str(place.outside / "pwned")
    payloads = (Payload(os.mkdir, target), Payload(os.system, f"touch {target}"), Payload(builtins.eval, f"open({target!r}, 'w')"),
                Payload(builtins.open, target, "w"), Payload(np.load, target), [Payload(os.mkdir, target), table])  # fmt: skip
    if kind == 0:
        data = pickle.dumps(payloads[rng.integers(len(payloads))])
        words = "a pickle that runs a function"
    elif kind == 1:
        data, words = (
            b"\x80\x04" + b"(" * 100_000 + b"."
            if rng.random() < 0.5
            else b"\x80\x04" + b"]" + b"]a" * 5 + b"\x85" * 100_000 + b".",
            "deeply nested pickle",
        )
    elif kind == 2:
        data, words = b"\x80\x04\x8e" + (2**62).to_bytes(8, "little") + b"abc.", "a pickle of 4 EiB"
    elif kind == 3 and len(table):
        table[column] = table[column].astype(object)
        table.loc[table.index[int(rng.integers(len(table)))], column] = str(pick(rng, ("x", "")))
        data, words = pickle.dumps(table), f"{column} holds a word"
        visible = column not in ("uuid", "label") and "attributes" not in column
    elif kind == 4 and table[column].dtype.kind == "f" and len(table):
        value = EXTREMES[rng.integers(len(EXTREMES))]
        table.loc[table.index[int(rng.integers(len(table)))], column] = value
        # Points that are not finite are misses; a cuboid has no such value.
        data, words, visible = (
            pickle.dumps(table),
            f"{column} holds {value}",
            "cuboids" in str(file) and "rider" not in column,
        )
    elif kind == 5:
        data, words = pickle.dumps(table.drop(columns=[column])), f"{column} is missing"
        visible = not column.startswith(("attributes", "cuboids", "camera", "i", "stationary"))
    elif kind == 6:
        data, words, visible = pickle.dumps(table.iloc[:0]), "has no rows", False
    elif kind == 7:
        other = pick(rng, (table.to_dict(), table.values, [1, 2], None, "text", table[column]))
        data, words = pickle.dumps(other), f"is a {type(other).__name__}"
    elif kind == 8:
        data, words, visible = (
            pickle.dumps(pandas.concat([table, table])),
            "each row occurs twice",
            "cuboids" in str(file),
        )
    else:
        data, words = bytes(BOMB_BYTES), f"{BOMB_BYTES} zeros"
    file.write_bytes(gzip.compress(data, 1))
    return Damage(words, visible)


def change_image(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    """Sizes that need gigabytes, other sizes, and files of other kinds of images."""
    import cv2

    image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    height, width = image.shape[:2]
    kind = int(rng.integers(6))
    huge = HUGE[rng.integers(len(HUGE))]
    if kind <= 1:
        file.write_bytes(_with_size(file.read_bytes(), huge, huge))
        return Damage(f"states {huge} x {huge} pixels", True)
    if kind == 2:
        size = int(pick(rng, (0, 1, 2)))
        file.write_bytes(_with_size(file.read_bytes(), size, height))
        return Damage(f"states a width of {size}", True)
    if kind == 3:
        suffix = str(pick(rng, (".bmp", ".tiff", ".webp", ".png", ".jpg", ".ppm", ".jp2", ".hdr")))
        data = cv2.imencode(suffix, image.astype(np.float32) if suffix == ".hdr" else image)[1].tobytes()
        file.write_bytes(data)
        return Damage(f"is a {suffix} image", False)
    if kind == 4:
        texts = (
            f"P6 {huge} {huge} 255\n",
            f"P1 {huge} {huge}\n",
            f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {huge} +X {huge}\n",
            "GIF89a\xff\xff\xff\xff",
        )
        file.write_bytes(texts[rng.integers(len(texts))].encode("latin-1") + bytes(100))
        return Damage("is another image format that states a huge size", True)
    other = (image[: height // 2], cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), image[::2, ::2], image.transpose(1, 0, 2))[
        int(rng.integers(4))
    ]
    file.write_bytes(cv2.imencode(file.suffix, np.ascontiguousarray(other))[1].tobytes())
    return Damage(f"is {other.shape}", other.shape[:2] != (height, width))


def _with_size(data: bytes, width: int, height: int) -> bytes:
    """An image file that states another size: the header of PNG with its check sum, or of JPEG."""
    if data[:4] == b"\x89PNG":
        header = b"IHDR" + struct.pack(">II", width, height) + data[24:29]
        return data[:12] + header + struct.pack(">I", zlib.crc32(header)) + data[33:]
    at = next((data.find(bytes([0xFF, m])) for m in (0xC0, 0xC2, 0xC1) if data.find(bytes([0xFF, m])) > 0), -1)
    return data if at < 0 else data[: at + 5] + struct.pack(">HH", height, width) + data[at + 9 :]


CONTAINERS = (
    Mutation(change_arrays, (".npz",), 8.0), Mutation(change_archive, (".npz",), 4.0),
    Mutation(change_table_pickle, (".pkl.gz",), 10.0), Mutation(change_image, (".png", ".jpg"), 3.0),
)  # fmt: skip


EXTREME_VALUES: dict[str, tuple[Any, ...]] = {
    "f": (np.nan, np.inf, -np.inf, 1e308, -1e30),
    "i": (2**63 - 1, -(2**63), 2**31 - 1, -1),
}
ENDLESS = "WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n) SELECT x AS id, 1 AS topic_id, x AS timestamp, x'00' AS data FROM n"


def change_cells(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    """One cell, or a whole column, is extreme or null, of another type, or gone."""
    import pyarrow

    table = _read(file)
    if not table.num_rows:
        return None
    name = table.column_names[rng.integers(table.num_columns)]
    column, at = table[name], int(rng.integers(table.num_rows))
    where = table.column_names.index(name)
    kind = int(rng.integers(6))
    if kind <= 2:
        group = "f" if pyarrow.types.is_floating(column.type) else "i" if pyarrow.types.is_integer(column.type) else ""
        if not group and kind < 2:
            return None
        values = column.to_pylist()
        value = pick(rng, EXTREME_VALUES[group]) if kind < 2 else None
        values[at] = value
        try:
            changed = pyarrow.array(values, column.type)
        except (pyarrow.ArrowInvalid, OverflowError):
            return None  # more than the type holds
        table = table.set_column(where, name, changed)
        # Points may be misses; a measure of -1 may be one.
        words, visible = f"{name}[{at}] is {value}", value != -1 and "lidar" not in str(file.parent.name)
    elif kind == 3:
        table, words, visible = table.drop_columns([name]), f"{name} is missing", "num_interior" not in name
    elif kind == 4:
        table = table.set_column(where, name, pyarrow.array([str(v)[:20] for v in column.to_pylist()]))
        words, visible = f"{name} holds text", "uuid" not in name and column.type != pyarrow.string()
    else:
        table, words, visible = table.set_column(where, name, pyarrow.nulls(table.num_rows)), f"{name} is null", True
    _write(table, file)
    return Damage(words, visible)


def change_rows(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    import pyarrow

    table = _read(file)
    if table.num_rows < 2:
        return None
    at = int(rng.integers(table.num_rows))
    kinds = {
        "removed": pyarrow.concat_tables([table.slice(0, at), table.slice(at + 1)]),
        "occurs twice": pyarrow.concat_tables([table.slice(0, at + 1), table.slice(at)]),
        "and all others are removed": table.slice(0, 0),
        "and all others are in reverse order": table.take(pyarrow.array(range(table.num_rows - 1, -1, -1))),
    }
    words = list(kinds)[rng.integers(len(kinds))]
    _write(kinds[words], file)
    return Damage(f"row {at} {words}", False)


def _read(file: Path) -> Any:
    import pyarrow.feather
    import pyarrow.parquet

    # Read from bytes: a file that is mapped must not be written over.
    data = pyarrow.BufferReader(file.read_bytes())
    return pyarrow.feather.read_table(data) if file.suffix == ".feather" else pyarrow.parquet.read_table(data)


def _write(table: Any, file: Path) -> None:
    import pyarrow.feather
    import pyarrow.parquet

    if file.suffix == ".feather":
        pyarrow.feather.write_feather(table, file, compression="lz4")
    else:
        pyarrow.parquet.write_table(table, file)


def change_database(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    kinds = (
        ("messages are an endless view", f"ALTER TABLE messages RENAME TO old; CREATE VIEW messages AS {ENDLESS}", True),
        ("topics are an endless view", "ALTER TABLE topics RENAME TO old; CREATE VIEW topics AS WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL "
         "SELECT x + 1 FROM n) SELECT x AS id, 'a' AS name, 'b' AS type, 'cdr' AS serialization_format, '' AS offered_qos_profiles FROM n", True),
        ("there are no messages", "DELETE FROM messages", True),
        ("there are no topics", "DELETE FROM topics", True),
        ("a topic is missing", "DELETE FROM topics WHERE id = (SELECT id FROM topics LIMIT 1 OFFSET {row})", True),
        ("the types are unknown", "UPDATE topics SET type = 'x/msg/Y'", True),
        ("a type is another", "UPDATE topics SET type = (SELECT type FROM topics LIMIT 1) WHERE id = (SELECT id FROM topics LIMIT 1 OFFSET {row})", True),
        ("a name is a number", "UPDATE topics SET name = 5.5 WHERE id = (SELECT id FROM topics LIMIT 1 OFFSET {row})", True),
        ("a message is text", "UPDATE messages SET data = 'text' WHERE id = (SELECT id FROM messages LIMIT 1 OFFSET {row})", True),
        ("a message is null", "UPDATE messages SET data = CAST(NULL AS BLOB) WHERE id = (SELECT id FROM messages LIMIT 1 OFFSET {row})", True),
        ("a message is empty", "UPDATE messages SET data = x'' WHERE id = (SELECT id FROM messages LIMIT 1 OFFSET {row})", True),
        ("a message has 500 MB of zeros", "UPDATE messages SET data = zeroblob(500000000) WHERE id = (SELECT id FROM messages LIMIT 1 OFFSET {row})", True),
        ("a message is half", "UPDATE messages SET data = substr(data, 1, length(data) / 2) WHERE id = (SELECT id FROM messages LIMIT 1 OFFSET {row})", True),
        ("a stamp is text", "UPDATE messages SET timestamp = 'x' WHERE id = (SELECT id FROM messages LIMIT 1 OFFSET {row})", False),
        ("a message is gone", "DELETE FROM messages WHERE id = (SELECT id FROM messages LIMIT 1 OFFSET {row})", False),
        ("a message is another topic's", "UPDATE messages SET topic_id = 1 + topic_id WHERE id = (SELECT id FROM messages LIMIT 1 OFFSET {row})", False),
        ("there is no table of messages", "DROP TABLE messages", True),
        ("a trigger", "CREATE TRIGGER t AFTER INSERT ON messages BEGIN DELETE FROM topics; END", False),
    )  # fmt: skip
    words, statements, visible = kinds[rng.integers(len(kinds))]
    row = int(rng.integers(4))
    connection = sqlite3.connect(file)
    try:
        connection.execute("PRAGMA writable_schema = ON")
        connection.executescript(statements.replace("{row}", str(row)))
        connection.commit()
    except sqlite3.Error:
        return None
    finally:
        connection.close()
    return Damage(f"{words} (row {row})", visible)


def change_records(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    """Records of a TFRecord file with right check sums: damaged messages, records that are gone, twice or exchanged."""
    records = _records(file.read_bytes())
    at = int(rng.integers(len(records)))
    kind = int(rng.integers(7))
    if kind <= 2:
        data = bytearray(records[at])
        for _ in range(int(rng.integers(1, 8))):
            # Near the begin, as tags and lengths of the outer messages stand there.
            data[int(rng.integers(len(data) if rng.random() < 0.5 else min(len(data), 400)))] = int(rng.integers(256))
        records[at], words, visible = bytes(data), f"bytes of record {at} changed", False
    elif kind == 3:
        cut = int(rng.integers(len(records[at])))
        records[at], words, visible = records[at][:cut], f"record {at} cut to {cut} bytes", True
    elif kind == 4:
        del records[at]
        words, visible = f"record {at} is gone", False
    elif kind == 5:
        records.insert(at, records[at])
        words, visible = f"record {at} occurs twice", True
    else:
        records.reverse()
        words, visible = "records in reverse order", False
    lengths = [struct.pack("<Q", len(record)) for record in records]
    if rng.random() < 0.1:
        lengths[0] = struct.pack("<Q", int(pick(rng, (2**64 - 1, 2**62, 2**33, 0))))
        words, visible = "the first record states another length", True
    file.write_bytes(
        b"".join(
            length + struct.pack("<I", masked_crc32c(length)) + record + struct.pack("<I", masked_crc32c(record))
            for length, record in zip(lengths, records)
        )
    )
    return Damage(words, visible)


def _records(data: bytes) -> list[bytes]:
    records, at = [], 0
    while at < len(data):
        length = int.from_bytes(data[at : at + 8], "little")
        records.append(data[at + 12 : at + 12 + length])
        at += length + 16
    return records


STORED = (
    Mutation(change_cells, (".feather", ".parquet"), 10.0), Mutation(change_rows, (".feather", ".parquet"), 2.0),
    Mutation(change_database, (".db3",), 12.0), Mutation(change_records, (".tfrecord",), 10.0),
)  # fmt: skip


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


# Layouts whose records are named by their stamps, and nothing else names them.
NAMED_BY_STAMPS = ("sensors",)


def remove_file(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    if file == place.input:
        return None
    file.unlink()
    others = [f for f in files_below(place.input) if f.parent == file.parent and f.suffix == file.suffix]
    inner = file.relative_to(place.input)
    optional = inner.parts[0] in NAMED_BY_STAMPS or "label" in str(inner)
    return Damage("is missing", bool(others) and not optional)


def exchange_files(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    others = [f for f in files_below(place.input) if f.parent == file.parent and f.suffix == file.suffix and f != file]
    if not others:
        return None
    other = others[rng.integers(len(others))]
    one, two = file.read_bytes(), other.read_bytes()
    file.write_bytes(two)
    if rng.random() < 0.5:
        other.write_bytes(one)
        return Damage(f"exchanged with {other.name}", False)
    return Damage(f"holds what {other.name} holds", False)


def rename_file(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    if file == place.input:
        return None
    name = str(
        pick(rng, ("9" * 30 + file.suffix, "-1" + file.suffix, "x" + file.suffix, file.stem, ".hidden" + file.suffix))
    )
    file.rename(file.with_name(name))
    return Damage(f"is called {name}", False)


def replace_by_folder(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    file.unlink()
    file.mkdir()
    return Damage("is a folder", True)


def replace_by_pipe(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    file.unlink()
    os.mkfifo(file)
    return Damage("is a named pipe", True)


def replace_by_device(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    target = str(
        pick(rng, ("/dev/zero", "/dev/null", "/dev/urandom", "/dev/tty", "/proc/self/mem", "/proc/self/environ"))
    )
    file.unlink()
    file.symlink_to(target)
    # A log that is one file is what the user named.
    return Damage(f"links to {target}", True, (Path(target),) if file == place.input else ())


def link_outside(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    """To a sound file of another name, which no log may read unless links are followed."""
    target = place.outside / f"secret{file.suffix}"
    if not target.exists():
        shutil.copyfile(file, target)
    file.unlink()
    file.symlink_to(target)
    # A log that is one file is what the user named.
    return Damage("links to a file outside", file != place.input, (target,) if file == place.input else ())


def link_to_same_name(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    """To its like of a sound copy, as data sets are laid out."""
    inner = file.relative_to(place.input) if file != place.input else Path()
    target = place.sound / inner
    file.unlink()
    file.symlink_to(target)
    return Damage("links to its sound copy", False, (target,))


def link_in_loop(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    file.unlink()
    if rng.random() < 0.5:
        file.symlink_to(file.name)
    else:
        file.symlink_to("nothing-there")
    return Damage("is a link to itself or to nothing", True)


def link_folder(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    """A folder that links to one above it, or to another one outside."""
    folder = file.parent
    if file == place.input or folder == place.input:
        return None
    shutil.rmtree(folder)
    target = Path("..") if rng.random() < 0.5 else place.outside
    folder.symlink_to(target)
    return Damage(f"its folder links to {'the one above' if target == Path('..') else 'one outside'}", False)


def add_strange_files(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    """Files that file managers and archives leave behind, and a loop of folders."""
    if file == place.input:
        return None
    (file.parent / ".DS_Store").write_bytes(b"\0\0\0\1Bud1")
    (file.parent / f"._{file.name}").write_bytes(b"\0\5\x16\7")
    (file.parent / "Thumbs.db").write_bytes(b"")
    (file.parent / "loop").symlink_to("..")
    return Damage("strange files beside it", False)


def forbid_reading(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    if os.geteuid() == 0:
        return None  # who may read everything
    file.chmod(0)
    return Damage("may not be read", True)


def grow_hugely(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    """Eight GiB that take no place on the disk."""
    os.truncate(file, 8 * 1024**3)
    return Damage("has 8 GiB", True)


FILES = (
    Mutation(remove_file, weight=2.0), Mutation(exchange_files), Mutation(rename_file), Mutation(replace_by_folder, weight=0.5),
    Mutation(replace_by_pipe), Mutation(replace_by_device), Mutation(link_outside), Mutation(link_to_same_name, weight=0.5),
    Mutation(link_in_loop, weight=0.5), Mutation(link_folder, weight=0.5), Mutation(add_strange_files, weight=0.3),
    Mutation(forbid_reading, weight=0.5), Mutation(grow_hugely, weight=0.5),
)  # fmt: skip
