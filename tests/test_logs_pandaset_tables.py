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


def arrow_strings(kind: str, length: object, start: object, buffers: list[object]) -> bytes:
    """A pickled table of one text column as pandas 3 writes it where pyarrow is installed; made without either."""

    def lines(*parts: object) -> bytes:
        return b"".join(p if isinstance(p, bytes) else pickle.dumps(p, protocol=3)[2:-1] for p in parts)

    def named(module: str, name: str) -> bytes:
        return f"c{module}\n{name}\n".encode()

    def called(function: bytes, *arguments: bytes) -> bytes:
        return lines(function, b"(", *arguments, b"tR")

    def buffer(data: object) -> bytes:
        if data is None:
            return lines(None)
        raw = pickle.BINBYTES + struct.pack("<I", len(data)) + data if isinstance(data, bytes) else lines(data)
        return called(named("pyarrow.lib", "py_buffer"), called(named("builtins", "bytearray"), raw))

    def texts(kind: str, length: object, start: object, buffers: list[object]) -> bytes:
        of_kind = called(named("pyarrow.lib", "type_for_alias"), lines(kind))
        state = lines(b"(", of_kind, length, 0, start, b"](", *map(buffer, buffers), b"e", b"]", None, b"t")
        array = called(named("pyarrow.lib", "_restore_array"), state)
        return lines(named("pandas.arrays", "ArrowStringArray"), b")\x81", b"}(", "_pa_array", array, b"ub")

    names = called(
        named("pandas.core.indexes.base", "_new_Index"),
        named("pandas", "Index"),
        lines(b"}(", "data", texts("large_string", 1, 0, [None, struct.pack("<2q", 0, 4), b"word"]), b"u"),
    )
    place = called(named("builtins", "slice"), lines(0), lines(1), lines(1))
    block = called(named("pandas._libs.internals", "_unpickle_block"), texts(kind, length, start, buffers), place)
    manager = called(
        named("pandas.core.internals.managers", "BlockManager"),
        lines(b"(", block, b"t"),
        lines(b"](", names, b"e"),
    )
    return lines(b"\x80\x04", named("pandas", "DataFrame"), b")\x81", b"}(", "_mgr", manager, b"ub.")


OFFSETS_OF_THREE = struct.pack("<4i", 0, 1, 1, 3)


def test_text_in_arrow_buffers_is_read_without_pyarrow(tmp_path: Path) -> None:
    """ "a", nothing, "ü"; then the same without the first."""
    there, text = bytes([0b101]), "aü".encode()
    for start in (0, 1):
        data = arrow_strings("string", 3 - start, start, [there, OFFSETS_OF_THREE, text])
        (tmp_path / "a.pkl").write_bytes(data)
        words = read_pickled_table(tmp_path / "a.pkl")["word"]
        assert [w if isinstance(w, str) else None for w in words] == ["a", None, "ü"][start:]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("string_view", 3, 0, [None, OFFSETS_OF_THREE, b"abc"]), "ArrowStringArray of type 'string_view'"),
        (("string", 4, 0, [None, OFFSETS_OF_THREE, b"abc"]), "ArrowStringArray of 4 texts has too few offsets"),
        (("string", 2**40, 0, [None, OFFSETS_OF_THREE, b"abc"]), "more than the"),
        (("string", -1, 0, [None, OFFSETS_OF_THREE, b"abc"]), "ArrowStringArray has no length"),
        (("string", 3, 0, [None, OFFSETS_OF_THREE, b"ab"]), "leave its text"),
        (("string", 3, 0, [None, struct.pack("<4i", 0, 2, 1, 3), b"abc"]), "leave its text"),
        (("string", 3, 0, [b"", OFFSETS_OF_THREE, b"abc"]), "whether it is there"),
        (("string", 3, 0, [None, OFFSETS_OF_THREE]), "not three buffers"),
        (("string", 3, 0, [None, 2**40, b"abc"]), "has no data"),
        (("string", 3, 0, [None, OFFSETS_OF_THREE, b"\xff\xfe\xfd"]), "utf-8"),
    ],
)
def test_damaged_text_in_arrow_buffers_is_refused(tmp_path: Path, arguments: tuple, words: str) -> None:
    (tmp_path / "a.pkl").write_bytes(arrow_strings(*arguments))
    with pytest.raises(RecordError, match=r"a\.pkl: not a pickled table") as caught:
        read_pickled_table(tmp_path / "a.pkl")
    assert words in str(caught.value)


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
