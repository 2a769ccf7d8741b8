"""Unpickler of PandaSet's tables: old and new pandas files, text in Arrow's buffers, nothing but tables."""

from __future__ import annotations

import gzip
import os
import pickle
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest

from log2sim.errors import RecordError
from log2sim.logs.pandaset import unpickle
from log2sim.logs.pandaset.unpickle import read_pickled_table


def frame_columns() -> dict[str, object]:
    return {
        "x": [1.5, 2.5, np.nan],
        "t": [1.5e9, 1.5e9 + 0.1, 1.5e9],
        "d": np.array([0, 1, 0]),
        "flag": [True, False, True],
        "word": np.array(["a", np.nan, "ü"], dtype=object),
    }


@pytest.mark.parametrize("name", ["plain.pkl", "packed.pkl.gz"])
@pytest.mark.parametrize("strings", [False, True])
def test_a_table_of_todays_pandas_is_read_without_it(tmp_path: Path, name: str, strings: bool) -> None:
    pandas = pytest.importorskip("pandas")
    table = pandas.DataFrame(frame_columns())
    if strings:
        table["word"] = table["word"].astype("str")
    table.to_pickle(tmp_path / name)
    columns = read_pickled_table(tmp_path / name)
    assert set(columns) == set(table.columns)
    for key in ("x", "t", "d", "flag"):
        np.testing.assert_array_equal(columns[key], table[key].to_numpy())
    assert [columns["word"][0], columns["word"][2]] == ["a", "ü"]


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_every_pickle_protocol_is_read(tmp_path: Path, protocol: int) -> None:
    pandas = pytest.importorskip("pandas")
    table = pandas.DataFrame({"x": np.arange(4.0), "y": np.arange(4.0) * 2, "d": np.arange(4)})
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(table, protocol=protocol))
    if protocol == 2:
        # Bytes were stored through a codec then; that is a call which a table does not need.
        with pytest.raises(RecordError, match="_codecs"):
            read_pickled_table(tmp_path / "a.pkl")
        return
    columns = read_pickled_table(tmp_path / "a.pkl")
    for key in "xyd":
        np.testing.assert_array_equal(columns[key], table[key])


class Bomb:
    def __reduce__(self) -> tuple:
        return os.system, ("touch exploded",)


def memo_bomb() -> bytes:
    return b"\x80\x04]r" + struct.pack("<I", 2**31 - 1) + b"."


def byte_bomb() -> bytes:
    return b"\x80\x05" + pickle.BYTEARRAY8 + struct.pack("<Q", 2**40) + b"."


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (pickle.dumps(Bomb()), "system, which a table does not need"),
        (pickle.dumps({"a": 1}), "holds a dict, expected a DataFrame"),
        (pickle.dumps(np.zeros(3)), "holds a"),
        (b"\x80\x04c__builtin__\neval\n(S'1'\ntR.", "eval, which a table does not need"),
        (memo_bomb(), "holds a list"),
        (byte_bomb(), "truncated"),
        (b"", "not a pickled table"),
        (b"hello", "not a pickled table"),
        (gzip.compress(b"\0" * 3_000_000), "unpacks to more than"),
        (gzip.compress(os.urandom(1000))[:-100], "truncated"),
        (pickle.dumps(Path("/tmp/x")), "which a table does not need"),
    ],
)
def test_anything_but_a_table_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, data: bytes, words: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "x.pkl").write_bytes(data)
    with pytest.raises(RecordError, match=r"x\.pkl") as caught:
        read_pickled_table(tmp_path / "x.pkl", limit_bytes=2_000_000)
    assert words in str(caught.value)
    assert not (tmp_path / "exploded").exists()


@pytest.mark.parametrize("part", [slice(None), slice(-4), slice(40), slice(11)])
def test_either_library_unpacks_the_same_and_refuses_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, part: slice
) -> None:
    pandas, isal_zlib = pytest.importorskip("pandas"), pytest.importorskip("isal.isal_zlib")
    path, found = tmp_path / "x.pkl.gz", list[object]()
    pandas.DataFrame({"x": np.random.default_rng(0).normal(size=2000)}).to_pickle(path)
    path.write_bytes(path.read_bytes()[part])
    for library, error in ((zlib, zlib.error), (isal_zlib, isal_zlib.IsalError)):
        monkeypatch.setattr(unpickle, "decompressobj", library.decompressobj)
        monkeypatch.setattr(unpickle, "GzipError", error)
        try:
            found.append(read_pickled_table(path)["x"].tolist())
        except RecordError as problem:
            found.append(str(problem))
    assert found[0] == found[1]
    assert isinstance(found[0], list) is (part == slice(None))
