"""Damage to feather and parquet tables, SQLite databases and TFRecords that are whole as files."""

from __future__ import annotations

import sqlite3
import struct
from pathlib import Path
from typing import Any

import numpy as np

from log2sim.logs.waymo.tfrecord import masked_crc32c
from mutation.damage import Damage, Mutation, Place, pick

EXTREMES: dict[str, tuple[Any, ...]] = {
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
        value = pick(rng, EXTREMES[group]) if kind < 2 else None
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
