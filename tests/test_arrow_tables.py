"""Feather and parquet files as NumPy columns: every kind, limits before allocation, damaged files, single rows."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from damaged_bytes import damaged, quick, result_or_refusal
from hypothesis import given
from hypothesis import strategies as st

from log2sim.errors import LogError, RecordError
from log2sim.logs.arrow import read_columns

pa = pytest.importorskip("pyarrow")
feather = pytest.importorskip("pyarrow.feather")
parquet = pytest.importorskip("pyarrow.parquet")

KINDS = {
    "half": "float", "single": "float", "gaps": "float", "count": "int", "flag": "bool", "name": "text", "code": "text",
    "picture": "bytes", "pose": "floats", "scan": "floats", "ids": "ints",
}  # fmt: skip


def table(rows: int = 5) -> Any:
    """Rows 0..N-1; every value follows from its row."""
    n = np.arange(rows)
    return pa.table(
        {
            "half": pa.array(n.astype(np.float16)),
            "single": pa.array(n.astype(np.float32) / 3),
            "gaps": pa.array([None if k % 3 == 1 else k + 0.5 for k in n]),
            "count": pa.array((n * 3).astype(np.uint16)),
            "flag": pa.array(n % 2 == 0),
            "name": pa.array([None if k == 2 else f"é{k}" for k in n]).dictionary_encode(),
            "code": pa.array(n.astype(np.int8)),
            "picture": pa.array([bytes([k % 256]) * (k + 1) for k in n.tolist()]),
            "pose": pa.FixedSizeListArray.from_arrays(pa.array(np.arange(rows * 4) / 7), 4),
            "scan": pa.array([None if k == 3 else [k / 2] * k for k in n.tolist()], pa.list_(pa.float32())),
            "ids": pa.array([list(range(k % 3)) for k in n.tolist()], pa.large_list(pa.int16())),
        }
    )


def write(path: Path, what: Any, **options: Any) -> Path:
    if path.suffix == ".parquet":
        parquet.write_table(what, path, **options)
    else:
        feather.write_feather(what, path, **options)
    return path


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("a.parquet", {}),
        ("a.parquet", {"row_group_size": 2, "compression": "zstd"}),
        ("a.feather", {"compression": "lz4"}),
        ("a.feather", {"compression": "zstd", "chunksize": 2}),
        ("a.feather", {"compression": "uncompressed"}),
    ],
)
def test_every_kind_of_column_comes_back(tmp_path: Path, name: str, options: dict[str, Any]) -> None:
    columns = read_columns(write(tmp_path / name, table(), **options), KINDS)
    n = np.arange(5)
    assert list(columns) == list(KINDS)
    assert columns["half"].dtype == np.float32
    np.testing.assert_array_equal(columns["half"], n)
    np.testing.assert_array_equal(columns["single"], n.astype(np.float32) / 3)
    np.testing.assert_array_equal(columns["gaps"], [0.5, np.nan, 2.5, 3.5, np.nan])
    assert columns["count"].dtype == np.int64
    np.testing.assert_array_equal(columns["count"], n * 3)
    assert columns["flag"].tolist() == [True, False, True, False, True]
    assert columns["name"].tolist() == ["é0", "é1", None, "é3", "é4"]
    assert columns["code"].tolist() == ["0", "1", "2", "3", "4"]
    assert columns["picture"][3] == b"\x03\x03\x03\x03"
    np.testing.assert_allclose(columns["pose"], np.arange(20).reshape(5, 4) / 7)
    assert columns["scan"][3] is None
    assert [len(s) for s in columns["scan"][[0, 1, 2, 4]]] == [0, 1, 2, 4]
    np.testing.assert_array_equal(columns["scan"][4], np.full(4, 2.0, np.float32))
    assert [i.tolist() for i in columns["ids"]] == [[], [0], [0, 1], [], [0]]


@pytest.mark.parametrize("name", ["a.feather", "a.parquet"])
@pytest.mark.parametrize(
    ("column", "kind", "words"),
    [
        ("nothing", "int", "no column 'nothing'; expected nothing, found half, single"),
        ("single", "int", "column 'single': is float with 0 missing values, expected whole numbers"),
        ("name", "float", "column 'name': is string, expected numbers"),
        ("single", "text", "expected text"),
        ("name", "bytes", "expected bytes"),
        ("count", "floats", "expected a list of numbers a row"),
        ("code", "bool", "expected true or false"),
    ],
)
def test_another_content_is_named_with_file_and_column(
    tmp_path: Path, name: str, column: str, kind: str, words: str
) -> None:
    path = write(tmp_path / name, table())
    with pytest.raises(RecordError, match=r"a\.\w+: ") as caught:
        read_columns(path, {column: kind}, error=RecordError)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_false_size_of_a_compressed_buffer_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "a.feather", pa.table({"x": pa.array(np.zeros(1000))}), compression="lz4")
    data = path.read_bytes()
    at = data.index(struct.pack("<q", 8000))
    path.write_bytes(data[:at] + struct.pack("<q", 2**50) + data[at + 8 :])
    with pytest.raises(LogError, match=r"a\.feather: unpacks to 1125899906842624 bytes, more than"):
        read_columns(path, {"x": "float"})


@pytest.mark.parametrize("name", ["a.feather", "a.parquet"])
@quick
@given(data=st.data())
def test_a_damaged_file_is_an_error_or_a_table(tmp_path: Path, name: str, data: st.DataObject) -> None:
    path = write(tmp_path / name, table(), compression="zstd")
    path.write_bytes(data.draw(damaged(path.read_bytes())))
    columns = result_or_refusal(lambda: read_columns(path, KINDS), LogError, str(path))
    assert columns is None or len({len(values) for values in columns.values()}) == 1
