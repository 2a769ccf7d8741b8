"""Arrays as columns of a table, and in a temporary file, so that a long log takes no more memory than a short one."""

from __future__ import annotations

import os
import tempfile
import threading
import weakref
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable, Iterator, MutableMapping, Sequence
from dataclasses import dataclass
from typing import Any, BinaryIO, Generic, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray


class Columns:
    """Base of frozen dataclasses whose fields are columns: arrays with one row a thing, None for one that is not known."""

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(next(iter(vars(self).values())))

    def take(self, index: Any) -> Self:
        """Take the rows at `index`: integers, a slice or a mask."""
        return type(self)(**{name: None if v is None else v[index] for name, v in vars(self).items()})

    @property
    def nbytes(self) -> int:
        """Return the memory that the columns take."""
        return sum(v.nbytes for v in vars(self).values() if v is not None)

    @classmethod
    def join(cls, parts: Sequence[Self]) -> Self:
        """Concatenate one or more sets; a column is known if it is of all."""
        tables = [vars(part) for part in parts]
        columns = {name: [table[name] for table in tables] for name in tables[0]}
        return cls(**{k: None if any(v is None for v in c) else np.concatenate(c) for k, c in columns.items()})


# Arrays of short logs never leave the memory.
MEMORY_BYTES = 64 * 2**20


@dataclass(frozen=True, eq=False, slots=True)
class StoredArray:
    """An array in the file of an `ArrayFile`."""

    file: ArrayFile
    offset: int  # of its first byte
    shape: tuple[int, ...]
    dtype: np.dtype[Any]

    def read(self) -> NDArray[Any]:
        """Read the array, a new one each time, which cannot be written to."""
        return self.file.read(self)


class ArrayFile:
    """Keep arrays: the first ones in memory, and those beyond `memory_bytes` in a file; safe to share between threads.

    The file has no name, and the system removes it when the process ends in whatever way. It lies in the folder of temporary
    files, which the environment variable TMPDIR names.
    """

    def __init__(self, memory_bytes: int | None = None) -> None:
        self.memory_bytes = MEMORY_BYTES if memory_bytes is None else memory_bytes
        self._kept = 0
        self._size = 0
        self._file: BinaryIO | None = None
        self._lock = threading.Lock()

    def __reduce__(self) -> tuple[Any, ...]:
        """Return an empty one for other processes; an `ArrayList` takes its arrays along."""
        return ArrayFile, (self.memory_bytes,)

    def keep(self, array: NDArray[Any]) -> NDArray[Any] | StoredArray:
        """Return the array itself while there is room for it in memory, else what reads it from the file.

        Raises `OSError` where the folder of temporary files has no room.
        """
        with self._lock:
            if self._kept + array.nbytes <= self.memory_bytes or not array.nbytes:
                self._kept += array.nbytes
                return array
            if self._file is None:
                self._file = tempfile.TemporaryFile(prefix="log2sim-", buffering=0)  # noqa: SIM115  # closed with this
                weakref.finalize(self, self._file.close)
            offset = self._size
            data = np.ascontiguousarray(array).data.cast("B")
            while len(data):
                written = os.pwrite(self._file.fileno(), data, self._size)
                data, self._size = data[written:], self._size + written
        return StoredArray(self, offset, array.shape, array.dtype)

    def read(self, stored: StoredArray) -> NDArray[Any]:
        """Read an array of this file."""
        assert self._file is not None
        size = stored.dtype.itemsize * int(np.prod(stored.shape))
        data = b""
        while len(data) < size:
            more = os.pread(self._file.fileno(), size - len(data), stored.offset + len(data))
            if not more:
                raise OSError("a temporary file of log2sim is shorter than it was written")
            data = data + more if data else more
        return np.frombuffer(data, stored.dtype).reshape(stored.shape)


class ArrayList(Sequence[NDArray[Any]]):
    """Arrays of which some are in a file; each is read when it is asked for, and not kept."""

    __slots__ = ("items",)

    def __init__(self, items: Iterable[NDArray[Any] | StoredArray]) -> None:
        self.items = tuple(items)

    def __reduce__(self) -> tuple[Any, ...]:
        """Return a copy for other processes that holds the arrays themselves."""
        return ArrayList, (tuple(self),)

    def __len__(self) -> int:
        """Return how many there are."""
        return len(self.items)

    def __getitem__(self, index: Any) -> Any:
        """Return one array, or an `ArrayList` of those of a slice."""
        if isinstance(index, slice):
            return ArrayList(self.items[index])
        item = self.items[index]
        return item.read() if isinstance(item, StoredArray) else item


class SupportsNbytes(Protocol):
    """An object that states its memory."""

    @property
    def nbytes(self) -> int:
        """Return the bytes that it takes."""
        ...


Key = TypeVar("Key", bound=Hashable)
Value = TypeVar("Value", bound=SupportsNbytes)


class DiskBackedMap(MutableMapping[Key, Value], Generic[Key, Value]):
    """A mapping with values made of arrays: the most recently used ones are in memory, the others in a file.

    `to_arrays`, `from_arrays`: convert a value to arrays and back. `memory_bytes`: limit of the values in memory; the one used last
    always stays. `changing`: whether values change while they are in memory; others are written once. A changed value is appended
    to the file. `rounds`: values that were used in so many rounds before stay in memory, whatever they take; `spill` ends a round.
    """

    def __init__(
        self,
        to_arrays: Callable[[Value], Sequence[NDArray[Any]]],
        from_arrays: Callable[..., Value],
        memory_bytes: int,
        *,
        changing: bool = False,
        rounds: int = 0,
    ) -> None:
        self._to_arrays, self._from_arrays = to_arrays, from_arrays
        self.memory_bytes, self._changing = memory_bytes, changing
        self._rounds, self._round = rounds, 0
        self._used: dict[Key, int] = {}
        self._file = ArrayFile(0)
        self._loaded: OrderedDict[Key, Value] = OrderedDict()
        self._sizes: dict[Key, int] = {}  # of those in memory, as last measured
        self._total = 0
        self._stored: dict[Key, list[NDArray[Any] | StoredArray]] = {}

    def __getitem__(self, key: Key) -> Value:
        """Return a value, which is loaded if it is not in memory."""
        if key not in self._loaded:
            stored = self._stored.pop(key) if self._changing else self._stored[key]
            self._put(key, self._from_arrays(*(a.read() if isinstance(a, StoredArray) else a for a in stored)))
        self._loaded.move_to_end(key)
        self._used[key] = self._round
        return self._loaded[key]

    def __setitem__(self, key: Key, value: Value) -> None:
        """Store a value."""
        self._stored.pop(key, None)
        self._put(key, value)

    def __delitem__(self, key: Key) -> None:
        """Delete a value."""
        if self._stored.pop(key, None) is None and key not in self._loaded:
            raise KeyError(key)
        self._loaded.pop(key, None)
        self._used.pop(key, None)
        self._total -= self._sizes.pop(key, 0)

    def __iter__(self) -> Iterator[Key]:
        """Iterate over the keys, those in the file first."""
        return iter([*(k for k in self._stored if k not in self._loaded), *self._loaded])

    def __len__(self) -> int:
        """Return the number of values."""
        return len(self._stored.keys() | self._loaded.keys())

    def spill(self) -> None:
        """End a round: write to the file what exceeds the limit, as values may have grown since they were returned."""
        self._round += 1
        self._sizes = {key: value.nbytes for key, value in self._loaded.items()}
        self._total = sum(self._sizes.values())
        self._make_room()

    def _put(self, key: Key, value: Value) -> None:
        self._total += value.nbytes - self._sizes.get(key, 0)
        self._loaded[key], self._sizes[key] = value, value.nbytes
        self._loaded.move_to_end(key)
        self._used[key] = self._round
        self._make_room()

    def _make_room(self) -> None:
        while self._total > self.memory_bytes and len(self._loaded) > 1:
            key, value = next(iter(self._loaded.items()))
            if self._used[key] > self._round - self._rounds:
                return
            del self._loaded[key], self._used[key]
            self._total -= self._sizes.pop(key)
            if key not in self._stored:
                self._stored[key] = [self._file.keep(a) for a in self._to_arrays(value)]


def take_arrays(arrays: Sequence[NDArray[Any]], rows: Iterable[int]) -> Sequence[NDArray[Any]]:
    """Return some of several arrays, without reading those that are in a file."""
    if isinstance(arrays, ArrayList):
        return ArrayList(arrays.items[k] for k in rows)
    return tuple(arrays[k] for k in rows)


def array_lengths(arrays: Sequence[NDArray[Any]]) -> list[int]:
    """Return how many rows each of several arrays has, without reading those that are in a file."""
    items = arrays.items if isinstance(arrays, ArrayList) else arrays
    return [item.shape[0] for item in items]


def join_arrays(parts: Iterable[Sequence[NDArray[Any]]]) -> Sequence[NDArray[Any]]:
    """Return the arrays of several sequences in one, without reading those that are in a file."""
    parts = list(parts)
    if any(isinstance(part, ArrayList) for part in parts):
        return ArrayList(item for part in parts for item in (part.items if isinstance(part, ArrayList) else part))
    return tuple(array for part in parts for array in part)
