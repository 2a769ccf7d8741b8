"""Files written whole or not at all, limits; the cache folder; arrays that wait in a file."""

from __future__ import annotations

import json
import os
import pickle
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from log2sim.datatypes import Measurements, Obstacles, Rays
from log2sim.errors import ConfigError, LogError, ScenarioError
from log2sim.files import documents
from log2sim.files.arrays import (
    ArrayFile,
    ArrayList,
    DiskBackedMap,
    StoredArray,
    array_lengths,
    join_arrays,
    take_arrays,
)
from log2sim.files.cache import DIGITS, DiskCache
from log2sim.files.documents import read_json, replaced, write_json
from log2sim.perception.first_pass import ObstacleList


def test_a_file_appears_whole(tmp_path: Path) -> None:
    target = tmp_path / "new" / "folder" / "result.json"
    with replaced(target) as temporary:
        assert temporary.parent == target.parent
        assert temporary.suffix == ".json"
        temporary.write_text("half")
        assert not target.exists()
        temporary.write_text("whole")
    assert target.read_text() == "whole"
    assert os.listdir(target.parent) == ["result.json"]


def test_two_writers_do_not_meet(tmp_path: Path) -> None:
    target = tmp_path / "result.json"
    with replaced(target) as first, replaced(target) as second:
        assert first != second
        first.write_text("first")
        second.write_text("second")
    assert target.read_text() == "first"  # the outer block ends last
    assert os.listdir(tmp_path) == ["result.json"]


TEXTS = st.text(st.characters(exclude_categories=["Cs"]))
DOCUMENTS = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**63) | st.floats(allow_nan=False, allow_infinity=False) | TEXTS,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(TEXTS, inner, max_size=4),
    max_leaves=20,
)


@given(value=DOCUMENTS)
@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_document_is_read_as_it_was_written(tmp_path: Path, value: object) -> None:
    write_json(tmp_path / "a.json", value)
    read = read_json(tmp_path / "a.json")
    assert read == value
    assert repr(read) == repr(value)  # not 1 for 1.0 or True, not 0.0 for -0.0
    assert os.listdir(tmp_path) == ["a.json"]


def test_too_large_a_file_is_not_even_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.json"
    path.write_text(json.dumps([0] * 100))
    monkeypatch.setattr(documents, "JSON_LIMIT_BYTES", path.stat().st_size)
    assert len(read_json(path)) == 100
    monkeypatch.setattr(documents, "JSON_LIMIT_BYTES", path.stat().st_size - 1)
    monkeypatch.setattr(Path, "read_text", lambda *_, **__: pytest.fail("read before its size was looked at"))
    with pytest.raises(ScenarioError, match=r"a\.json: 300 bytes, more than the 299"):
        read_json(path, ScenarioError)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b'{"a": 1,\n "b" 2}', r"not valid JSON at line 2, column 6"),
        (b"\xff\xfe{}", r"not valid JSON: .*utf-8"),
        (b'{"a": {"b": [1, 2, {"c": 1e400}]}}', r"a\.b\[2\]\.c is 1e400, expected a finite number"),
        (b"[[0, -Infinity]]", r"\[0\]\[1\] is -Infinity"),
        (b"NaN", r"the document is NaN"),
        (b"[NaN", r"a number is NaN"),
        (b"[NaN, " + b"[" * 100_000, r"a number is NaN"),
        (b"[" * 100_000, r"not valid JSON"),
        (b"1" * 5000, r"a number is 1+, expected a finite number"),
        (b'{"a": [' + b"1" * 400 + b"]}", r"a\[0\] is 1+, expected a finite number"),
    ],
    ids=[
        "syntax",
        "encoding",
        "overflow",
        "infinity",
        "nan",
        "nan and cut",
        "nan and deep",
        "deep",
        "many digits",
        "no float64",
    ],
)
def test_what_is_wrong_with_a_json_file_is_named(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "a.json"
    path.write_bytes(content)
    with pytest.raises(LogError, match=message) as caught:
        read_json(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert len(str(caught.value)) < 400 + len(str(path))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"a": 1, "b": {"a": 2}, "a": 3}', "a key occurs twice in one object, first 'a'"),
        ('[{"x": [1], "x": [1]}, {"y": 1, "y": 2, "y": 3}]', "3 keys occur twice in one object, first 'x'"),
        ('{"\\u0061": 1, "a": 2}', "first 'a'"),
    ],
)
def test_keys_that_stand_twice_are_told_with_their_number(tmp_path: Path, text: str, message: str) -> None:
    """Which of the two is meant, no program can tell."""
    path = tmp_path / "a.json"
    path.write_text(text)
    with pytest.raises(ScenarioError, match=message):
        read_json(path, ScenarioError)


ROOT = Path(__file__).resolve().parents[1]


def name(k: int, group: str = "model.1234") -> str:
    return f"{group}.{k:015x}{k % 16:x}"


def files(folder: Path) -> list[Path]:
    return sorted(p for p in folder.rglob("*") if p.is_file())


def test_the_entries_that_were_not_used_for_longest_are_dropped(tmp_path: Path) -> None:
    cache = DiskCache(tmp_path, max_bytes=16 * 1000)
    same_folder = [name(16 * k) for k in range(10)]  # a share of 1000 bytes
    old = time.time() - 10 * 3600
    for k, entry in enumerate(same_folder[:9]):
        assert cache.put(entry, b"x" * 100)
        os.utime(tmp_path / "0" / entry, (old + 60 * k, old + 60 * k))
    assert cache.get(same_folder[0]) is not None  # which is a use
    cache.put(same_folder[9], b"x" * 200)
    cache.finish({})
    kept = [entry for entry in same_folder if cache.get(entry) is not None]
    assert kept == [same_folder[0], *same_folder[3:]]  # 900 bytes


def test_the_limit_holds_over_all_folders_and_while_a_run_goes_on(tmp_path: Path) -> None:
    cache = DiskCache(tmp_path, max_bytes=160_000)
    for k in range(1000):
        cache.put(name(k), b"x" * 1000)
    assert sum(p.stat().st_size for p in files(tmp_path)) <= 160_000 * (1 + 1 / 16) + 16 * 1000
    assert all(any((tmp_path / digit).iterdir()) for digit in DIGITS)
    cache.finish({"found": 3})
    assert sum(size for _, size in DiskCache(tmp_path).usage().values()) <= 160_000
    assert cache.last_run == {"found": 3}


def test_a_full_disk_costs_one_remark_and_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device", str(tmp_path))

    cache = DiskCache(tmp_path)
    monkeypatch.setattr(os, "replace", full)
    assert not cache.put(name(1), b"x")
    assert cache.problem == f"{tmp_path}: No space left on device"
    with pytest.raises(ConfigError, match="limit of the cache cannot be kept"):
        DiskCache(tmp_path).set_limit(5)
    assert files(tmp_path) == []


def test_processes_share_a_folder_that_is_too_small_for_them(tmp_path: Path) -> None:
    code = (
        "import sys; from pathlib import Path; from log2sim.files.cache import DiskCache\n"
        "cache = DiskCache(Path(sys.argv[1]), max_bytes=16 * 4000)\n"
        "for k in range(400):\n"
        "    entry, content = f'model.{k % 40 * 16:016x}', bytes([k % 40]) * 1000\n"
        "    found = cache.get(entry)\n"
        "    assert found in (None, content), (entry, found[:9])\n"
        "    cache.put(entry, content)\n"
        "cache.finish({})\n"
        "assert cache.problem is None, cache.problem\n"
    )
    running = [subprocess.Popen([sys.executable, "-c", code, tmp_path], cwd=ROOT) for _ in range(2)]
    assert [process.wait() for process in running] == [0, 0]
    cache = DiskCache(tmp_path, max_bytes=16 * 4000)
    cache.put(name(0), b"")
    cache.finish({})
    assert 0 < sum(size for _, size in cache.usage().values()) <= 4000


DTYPES = (np.float32, np.float64, np.int64, np.uint8)


@settings(max_examples=30, deadline=None)
@given(
    st.lists(st.tuples(st.sampled_from(DTYPES), st.integers(0, 9), st.integers(0, 3)), max_size=8), st.integers(0, 300)
)
def test_arrays_come_back_as_they_were(kinds: list[Any], memory_bytes: int) -> None:
    arrays = [np.arange(rows * columns).reshape(rows, columns).astype(dtype) for dtype, rows, columns in kinds]
    file = ArrayFile(memory_bytes)
    kept = ArrayList([file.keep(array) for array in arrays])
    assert len(kept) == len(arrays)
    for array, back in zip(arrays, kept, strict=True):
        assert (back.dtype, back.shape) == (array.dtype, array.shape)
        np.testing.assert_array_equal(back, array)
    assert array_lengths(kept) == array_lengths(arrays) == [len(array) for array in arrays]
    in_memory = sum(item.nbytes for item in kept.items if isinstance(item, np.ndarray))
    assert in_memory <= memory_bytes
    assert in_memory == sum(a.nbytes for a in arrays) or any(isinstance(item, StoredArray) for item in kept.items)


def test_rows_are_taken_and_joined_unread() -> None:
    file = ArrayFile(0)
    kept = ArrayList([file.keep(np.array([k])) for k in range(5)])
    some = take_arrays(kept, [3, 1])
    joined = join_arrays([some, (np.array([9]),)])
    assert all(isinstance(item, StoredArray) for item in some.items)  # type: ignore[attr-defined]
    assert [int(a[0]) for a in joined] == [3, 1, 9]
    assert [int(a[0]) for a in kept[1:3]] == [1, 2]
    assert isinstance(take_arrays((np.zeros(1),), [0]), tuple)


def test_measurements_keep_their_points_through_take_and_join() -> None:
    rows = Measurements.empty()
    points = [np.full((k + 1, 4), float(k)) for k in range(3)]
    columns = {k: np.repeat(v, 3, axis=0) if isinstance(v, np.ndarray) else v for k, v in vars(rows).items()}
    columns = {k: np.zeros((3, *v.shape[1:]), v.dtype) if isinstance(v, np.ndarray) else v for k, v in columns.items()}
    full = Measurements(**{**columns, "cluster": tuple(points)})
    stored = full.stored(ArrayFile(0))
    again = Measurements.join([stored.take([2, 0]), stored.take(np.array([False, True, False]))])
    assert [c.tolist() for c in again.cluster] == [points[k].tolist() for k in (2, 0, 1)]


@pytest.mark.parametrize("memory_bytes", [0, 3000, 10**7])
@pytest.mark.parametrize("with_rays", [True, False])
def test_obstacles_come_back_as_they_were(memory_bytes: int, with_rays: bool) -> None:
    rng = np.random.default_rng(4)
    kept, given_ = ObstacleList(ArrayFile(memory_bytes)), []
    for k in range(6):
        xyz = rng.normal(size=(20 + k, 3)).astype(np.float32)
        sensor, number = rng.normal(size=(2, 3)).astype(np.float32), (np.arange(20 + k) % 2).astype(np.uint8)
        rays = Rays(xyz + 1, xyz[:, 0], number, sensor, sensor * 2) if with_rays else None
        given_.append(
            Obstacles(
                k, np.ones(3) * k, xyz, xyz[:, 1], sensor[0], rays, sensor if k % 2 else None, number if k % 2 else None
            )
        )
        kept.append(given_[-1])
    kept.append(None)
    assert [o is None for o in kept] == [False] * 6 + [True]
    assert kept[-1] is None
    for one, other in zip(given_, kept[:6], strict=True):
        assert one.stamp_ns == other.stamp_ns
        for name in ("origin", "xyz", "t_s", "sensor", "viewpoints", "seen_from"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
        assert (other.free is None) is (one.free is None)
        for name in ("end", "t_s", "sensor", "position", "velocity_mps") if with_rays else ():
            np.testing.assert_array_equal(getattr(one.free, name), getattr(other.free, name))


@pytest.mark.parametrize("memory_bytes", [0, 10_000])
def test_arrays_go_along_to_other_processes(memory_bytes: int) -> None:
    file = ArrayFile(memory_bytes)
    arrays = [np.arange(40.0), np.ones((3, 2), dtype=np.uint8)]
    copy = pickle.loads(pickle.dumps(ArrayList([file.keep(array) for array in arrays])))
    for array, back in zip(arrays, copy, strict=True):
        np.testing.assert_array_equal(back, array)
        assert back.dtype == array.dtype


@settings(max_examples=30, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 5), st.sampled_from(["add", "read", "forget"])), max_size=40), st.booleans())
def test_a_map_on_disk_is_a_dictionary_whatever_waits_in_its_file(steps: list[tuple[int, str]], changing: bool) -> None:
    """Two of the arrays have room; those of one that changes are changed in place, and grow."""
    kept_things: DiskBackedMap[int, np.ndarray] = DiskBackedMap(lambda a: [a], np.array, 2 * 24, changing=changing)
    known: dict[int, np.ndarray] = {}
    for key, step in steps:
        if step == "forget":
            assert (kept_things.pop(key, None) is None) == (known.pop(key, None) is None)
        elif key not in known or step == "add":
            known[key] = kept_things[key] = np.arange(3.0) + len(known)
        elif changing:
            kept_things[key][0] += 1
            known[key] = kept_things[key].copy()
        assert sum(a.nbytes for a in kept_things._loaded.values()) <= 2 * 24
        assert set(kept_things) == set(known)
        assert len(kept_things) == len(known)
    for key, array in known.items():
        np.testing.assert_array_equal(kept_things[key], array)
    with pytest.raises(KeyError):
        kept_things[9]


def test_what_was_just_used_stays_in_memory() -> None:
    kept_things: DiskBackedMap[int, np.ndarray] = DiskBackedMap(lambda a: [a], np.array, 0, changing=True, rounds=2)
    for key in range(3):
        kept_things[key] = np.zeros(3)
    for round, waiting in ((1, 0), (2, 2), (3, 2)):
        kept_things[0][0] += 1
        kept_things.spill()
        assert len(kept_things._stored) == waiting, round
    assert kept_things[0][0] == 3
