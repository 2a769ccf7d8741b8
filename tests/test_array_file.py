"""Arrays that wait in a file: they come back as they were, and short logs need no file."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from log2sim.datatypes import Measurements, Obstacles, Rays
from log2sim.files.arrays import (
    ArrayFile,
    ArrayList,
    DiskBackedMap,
    StoredArray,
    array_lengths,
    join_arrays,
    take_arrays,
)
from log2sim.perception.first_pass import ObstacleList

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
        assert sum(a.nbytes for a in kept_things._near.values()) <= 2 * 24
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
        kept_things.put_away()
        assert len(kept_things._far) == waiting, round
    assert kept_things[0][0] == 3
