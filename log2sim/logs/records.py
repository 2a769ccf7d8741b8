"""Files of a log: images, sweeps, PCD, their sizes known before anything is decoded; damaged data as errors."""

from __future__ import annotations

import io
import lzma
import struct
import threading
import tokenize
import zipfile
import zlib
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO, Any, Literal

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Log, Stream, Sweep
from log2sim.datatypes.log import ROTATION_TOLERANCE
from log2sim.errors import Log2SimError, LogError, RecordError
from log2sim.files.images import decode_image, image_size
from log2sim.files.inputs import read_file
from log2sim.geometry import NS_PER_S, Array, rotation_from_quaternion, transform
from log2sim.logs.stamps import MAX_TIME_S, checked_offset_ns

# Farther than any place on Earth is from the origin of a map.
MAX_POSITION_M = 1e9


def find_not_unit(q: Array) -> NDArray[np.intp]:
    """Find the rows of quaternions (N, 4) whose norm is not 1 within `ROTATION_TOLERANCE`, or not finite."""
    with np.errstate(over="ignore", invalid="ignore"):
        return np.flatnonzero(~(np.abs(np.linalg.norm(q, axis=1) - 1) <= ROTATION_TOLERANCE))


def checked_poses(q: Array, position: Array, where: Callable[[int], str]) -> Array:
    """Build poses (N, 4, 4) of quaternions (N, 4), scalar first, and positions (N, 3), m.

    Raises `LogError` for one that is not finite, farther from the origin than any place on Earth, or has no unit quaternion;
    begins with `where` of its row.
    """
    bad = np.union1d(find_not_unit(q), np.flatnonzero(~(np.abs(position) <= MAX_POSITION_M).all(axis=1)))
    if len(bad):
        k, expected = int(bad[0]), f"expected finite numbers up to {MAX_POSITION_M:g} and a unit quaternion"
        raise LogError(f"{where(k)}: position {position[k].tolist()}, quaternion {q[k].tolist()}, {expected}")
    return transform(rotation_from_quaternion(q), position)


MAX_DIGITS = 19


def list_numbered_files(folder: Path, suffixes: tuple[str, ...]) -> dict[int, Path]:
    """Return the files of a folder by the number that is their name (of a frame, or a stamp), in the order of the numbers; others are left out.

    `folder`: may be absent: there are no files then. `suffixes`: in lower case, such as ".jpg" or ".pkl.gz".
    """
    found = {}
    for path in list_files(folder, suffixes):
        word = path.name[: -next(len(s) for s in suffixes if path.name.lower().endswith(s))]
        # More digits are no int64, and converting many of them takes long.
        if word.isdecimal() and len(word) <= MAX_DIGITS and int(word) <= np.iinfo(np.int64).max:
            found[int(word)] = path
    return dict(sorted(found.items()))


def list_folders(path: Path) -> list[Path]:
    """Return the folders in a folder, sorted; none where it cannot be read or is none."""
    try:
        return sorted(p for p in path.iterdir() if p.is_dir())
    except OSError:
        return []


def list_files(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    """Return the files of a folder with one of some suffixes, sorted; none where there is no such folder."""
    if not folder.is_dir():
        return []
    return sorted(p for p in folder.iterdir() if p.name.lower().endswith(suffixes))


class FolderReader:
    """What readers of formats that are folders have in common: they find sequences by name, with what each is opened by."""

    suffixes: tuple[str, ...] = ()

    def find(self, path: Path) -> Mapping[str, Any]:
        """Find the sequences at a folder."""
        raise NotImplementedError

    def matches(self, path: Path) -> bool:
        """Return whether the folder is a sequence or holds some."""
        return bool(self.find(path))

    def sequences(self, path: Path) -> list[str]:
        """Return the names of the sequences, sorted."""
        return sorted(self.find(path))


MAX_REASON_CHARACTERS = 300


@contextmanager
def translate_parser_errors(where: str, error: type[LogError]) -> Iterator[None]:
    """Turn what is no `Log2SimError` into an `error` of one line that begins with `where`.

    Lack of memory and interrupts pass: they say nothing about the data. NumPy's warnings of numbers that are too large or not
    finite are silent within, since the checks that follow decide what such numbers mean.
    """
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            yield
    except (Log2SimError, MemoryError):
        raise
    except Exception as problem:
        lines = str(problem).strip().splitlines()
        name = "" if isinstance(problem, ValueError) else f"{type(problem).__name__}: "
        reason = f"{name}{lines[0] if lines else ''}"[:MAX_REASON_CHARACTERS].removesuffix(": ")
        raise error(f"{where}: {reason or type(problem).__name__}") from problem


# Of the sweeps or rows that were read last: all that the stages before and after the first pass share of a log of some 100 sweeps.
MAX_KEPT_BYTES = 256 * 1024 * 1024


@dataclass(frozen=True, eq=False)
class OfLog:
    """A function that reads something of an opened log; one that is sent to another process opens the log there.

    `of`: the name of a stream and of its field, or "" and the name of a field of the log.
    """

    read: Callable[..., Any]
    reopen: Callable[[], Log]
    of: tuple[str, str]

    def __call__(self, *index: int) -> Any:
        """Read it."""
        return self.read(*index)

    def __reduce__(self) -> Any:
        """Leave out the reader, which holds open files and locks."""
        return _open_for, (self.reopen, self.of)


def _open_for(reopen: Callable[[], Log], of: tuple[str, str]) -> Callable[..., Any]:
    stream, name = of
    if name in ("read", "encoded"):
        reading: Callable[[int], Any] = getattr(reopen().streams[stream], name)
        return reading
    return lambda: getattr(reopen().streams[stream] if stream else reopen(), name)


def guard_log(log: Log, where: str, reopen: Callable[[], Log]) -> Log:
    """Return the log of a reader with its streams guarded, and with labels, notes and stamps that are guarded when they are read.

    The sweeps that were read last are kept, up to `MAX_KEPT_BYTES`. `where`: its path, for errors. `reopen`: opens it in another
    process that has been sent the log, or what was made of it; it can be pickled, and opens it once. Raises `LogError` for poses
    of the ego that are not finite, or farther from the origin of the map than any place on Earth.
    """
    if log.ego is not None:
        wrong = np.flatnonzero(~(np.abs(log.ego.map_T_ego) <= MAX_POSITION_M).all(axis=(1, 2)))
        if len(wrong):
            position = ", ".join(f"{v:.6g}" for v in log.ego.map_T_ego[wrong[0], :3, 3])
            raise LogError(
                f"{where}: the position of the ego at stamp {log.ego.t_ns[wrong[0]]} is {position}, expected finite numbers up to "
                f"{MAX_POSITION_M:g} m; {len(wrong)} of {len(log.ego.t_ns)} poses are so"
            )

    def guarded(of: Log | Stream, name: str, what: str) -> Callable[[], Any]:
        def reading() -> Any:
            with translate_parser_errors(f"{where}: {what}", LogError):
                return getattr(of, name)

        return OfLog(reading, reopen, (of.name if isinstance(of, Stream) else "", name))

    sweeps: OrderedDict[tuple[str, int], tuple[Sweep, int]] = OrderedDict()  # those read last, with their bytes
    lock = threading.Lock()

    def guarded_stream(stream: Stream) -> Stream:
        def record(read: Callable[[int], Any], i: int) -> Any:
            with translate_parser_errors(f"{where}: record {i} of '{stream.name}' cannot be read", RecordError):
                return read(i)

        def read_or_keep(i: int) -> Any:
            with lock:
                if (stream.name, i) in sweeps:
                    sweeps.move_to_end((stream.name, i))
                    return sweeps[stream.name, i][0]
            found = record(stream.read, i)
            if isinstance(found, Sweep):
                size = sum(column.nbytes for column in vars(found).values() if isinstance(column, np.ndarray))
                with lock:
                    sweeps[stream.name, i] = found, size
                    while sum(bytes_of for _, bytes_of in sweeps.values()) > MAX_KEPT_BYTES:
                        sweeps.popitem(last=False)
            return found

        name, t_ns = stream.name, guarded(stream, "t_ns", f"the stamps of '{stream.name}' cannot be read")
        encoded = None if stream.encoded is None else OfLog(partial(record, stream.encoded), reopen, (name, "encoded"))
        return Stream(name, t_ns, OfLog(read_or_keep, reopen, (name, "read")), encoded)

    return log.changed(
        streams={name: guarded_stream(stream) for name, stream in log.streams.items()},
        labels=guarded(log, "labels", "the labels cannot be read"),
        notes=guarded(log, "notes", "cannot be read"),
        ground_z_ego_m=guarded(log, "ground_z_ego_m", "the height of the road cannot be read"),
    )


MAX_IMAGE_BYTES = 256 * 1024 * 1024


def image_stream(name: str, t_ns: NDArray[np.int64], files: list[Path], size_px: tuple[int, int]) -> Stream:
    """Stream of the F image files of a camera at stamps (F,); its calibration is for `size_px`, width and height."""

    def encoded(i: int) -> bytes:
        return read_bytes(files[i], int(t_ns[i]), MAX_IMAGE_BYTES)

    def read(i: int) -> NDArray[np.uint8]:
        return decode_image(encoded(i), f"{files[i]} (stamp {t_ns[i]})", size_px)

    return Stream(name, t_ns, read, encoded)


def first_image_size(files: list[Path]) -> tuple[int, int]:
    """Width and height in px of image files, from the headers of the first and the last readable one.

    Where these differ, one of them is damaged, and the next that has either size decides.
    """
    found = list[tuple[int, int]]()
    for file in (files[0], *files[:0:-1]):
        try:
            found.append(image_size(read_bytes(file, 0, MAX_IMAGE_BYTES), str(file)))
        except RecordError:
            continue
        if found.count(found[-1]) > 1:
            return found[-1]
    if not found:
        raise LogError(f"{files[0].parent}: none of its {len(files)} images can be read")
    return found[0]


def read_bytes(path: Path, t_ns: int, limit_bytes: int) -> bytes:
    """Read the file of one record; `RecordError` when it is missing, no regular file or larger than `limit_bytes`."""
    missing = "cannot be read: No such file or directory"
    return read_file(path, limit_bytes, RecordError, where=f"{path} (stamp {t_ns})", missing=missing)


MAX_HEADER_BYTES = 16 * 1024
# Each takes some 80 bytes while it is parsed.
MAX_ASCII_VALUES = 20_000_000
TIME_FIELDS = ("t_offset_ns", "offset", "t", "timestamp")
INTENSITY_FIELDS = ("intensity", "reflectivity", "reflectance")
PCD_TYPES = ("f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8")
# Times of points relative to the stamp of their sweep, ns, and how strong returns are; None when the file does not tell.
Offset = NDArray[np.int64] | None
Intensity = NDArray[Any] | None


def parse_pcd(data: bytes, t_ns: int) -> tuple[NDArray[Any], Offset, Intensity]:
    """Parse points (N, 3), their times (N,) int64 ns relative to the stamp and their intensities (N,); None without such a field.

    A time field is `t_offset_ns`, `offset` or `t` (relative to the stamp) or `timestamp` (absolute); whole numbers are
    nanoseconds, floating-point numbers seconds. Raises `ValueError` when the header or the data do not follow the format.
    """
    header: dict[str, list[str]] = {}
    start = 0
    while "DATA" not in header:
        end = data.find(b"\n", start, MAX_HEADER_BYTES)
        if end < 0:
            raise ValueError("no PCD header that ends with DATA")
        words = data[start:end].decode("ascii", "replace").split()
        if words and not words[0].startswith("#"):
            header[words[0].upper()] = words[1:]
        start = end + 1
    for key in ("FIELDS", "SIZE", "TYPE", "DATA"):
        if not header.get(key):
            raise ValueError(f"PCD header lacks {key}")
    layout, body = _layout(header), data[start:]
    words = header.get("POINTS") or [str(int(header["WIDTH"][0]) * int(header["HEIGHT"][0]))]
    count = int(words[0])
    _check_count(count)
    encoding = header["DATA"][0].lower()
    if encoding == "binary":
        if len(body) < count * layout.itemsize:
            raise ValueError(f"truncated: {len(body)} of {count * layout.itemsize} bytes")
        rows = np.frombuffer(body, layout, count)
    elif encoding == "ascii":
        widths = [int(np.prod(layout[name].shape, dtype=int)) for name in layout.names or ()]
        if count * sum(widths) > MAX_ASCII_VALUES:
            raise ValueError(
                f"{count * sum(widths)} values as text, more than the {MAX_ASCII_VALUES} that are read; convert it to binary"
            )
        cells = body.split(maxsplit=count * sum(widths))[: count * sum(widths)]
        if len(cells) != count * sum(widths):
            raise ValueError(f"truncated: {len(cells)} of {count * sum(widths)} values")
        table = np.array(cells, dtype="S32").reshape(count, sum(widths))
        rows = np.zeros(count, layout)
        for name, width, start in zip(layout.names or (), widths, np.cumsum([0, *widths])):
            if width == 1 and not name.startswith("_"):
                rows[name] = table[:, start].astype(layout[name])
    else:
        advice = "convert it to binary (pcl_convert_pcd_ascii_binary IN OUT 1)"
        raise ValueError(f"DATA {encoding} is not supported; {advice}")
    xyz = np.stack([rows[k] for k in ("x", "y", "z")], axis=1)
    field = next((f for f in TIME_FIELDS if f in (layout.names or ())), None)
    offset_ns = None if field is None else _offset_ns(rows[field], t_ns if field == "timestamp" else 0)
    strength = find_intensity_field(layout)
    return xyz, offset_ns, None if strength is None else rows[strength]


def find_intensity_field(layout: np.dtype[Any]) -> str | None:
    """Find the field of the points' intensities, one number each; None where there is none."""
    named = {name.lower(): name for name in layout.names or () if layout[name].shape == ()}
    return next((named[name] for name in INTENSITY_FIELDS if name in named), None)


def _layout(header: dict[str, list[str]]) -> np.dtype[Any]:
    names, sizes, kinds = header["FIELDS"], header["SIZE"], header["TYPE"]
    counts = header.get("COUNT", ["1"] * len(names))
    if not len(names) == len(sizes) == len(kinds) == len(counts) <= 64:
        raise ValueError("PCD header: FIELDS, SIZE, TYPE and COUNT differ in length")
    spec: list[tuple[str, str, tuple[int, ...]]] = []
    for k, (name, size, kind, count) in enumerate(zip(names, sizes, kinds, counts)):
        code = kind.lower()
        if f"{code}{size}" not in PCD_TYPES or not count.isdigit() or int(count) > 4096:
            raise ValueError(f"PCD header: field '{name}' has TYPE {kind} SIZE {size} COUNT {count}")
        if count != "1" and name in ("x", "y", "z", *TIME_FIELDS):
            raise ValueError(f"PCD header: field '{name}' has COUNT {count}, expected 1")
        # Padding fields are all called "_", so names are made unique by their index.
        unique = name if names.index(name) == k and name != "_" else f"_{k}"
        spec.append((unique, f"<{code}{size}", () if count == "1" else (int(count),)))
    for axis in ("x", "y", "z"):
        if axis not in names:
            raise ValueError(f"PCD header: no field '{axis}'")
    return np.dtype(spec)


def _offset_ns(values: NDArray[Any], begin_ns: int) -> NDArray[np.int64]:
    if values.dtype.kind in "iu":
        return checked_offset_ns(values, begin_ns)
    with np.errstate(invalid="ignore"):  # damaged bytes may be signaling NaNs
        seconds = values.astype(np.float64)
    seconds = np.where(np.isfinite(seconds), seconds, 0.0)
    if np.abs(seconds).max(initial=0.0) > MAX_TIME_S:
        raise ValueError(f"a point has the time {np.abs(seconds).max():g} s, expected at most {MAX_TIME_S:g}")
    return checked_offset_ns(np.round((seconds - begin_ns / NS_PER_S) * NS_PER_S))


MAX_SWEEP_POINTS = 20_000_000
MAX_SWEEP_BYTES = 1024 * 1024 * 1024

# Headers of points have some hundred bytes; NumPy would read what they declare, up to 4 GiB.
MAX_NPY_HEADER_BYTES = 10_000
# More columns than x, y, z and what sensors measure with them.
MAX_COLUMNS = 64
# What NumPy and zipfile raise for damaged files.
PARSER_ERRORS = (
    ValueError, TypeError, KeyError, IndexError, OverflowError, EOFError, OSError, RuntimeError, SyntaxError,
    struct.error, tokenize.TokenError, zipfile.BadZipFile, zlib.error, lzma.LZMAError,
)  # fmt: skip


def read_sweep(path: Path, t_ns: int, frame: Literal["lidar", "map"] = "lidar") -> Sweep:
    """Read a sweep; `RecordError` when it is missing, truncated, too large or not of the layout that its suffix promises."""
    data = read_bytes(path, t_ns, MAX_SWEEP_BYTES)
    try:
        xyz, offset_ns, intensity = _parse(path.suffix.lower(), data, t_ns)
        return sweep_of(xyz, t_ns, offset_ns, frame, intensity=intensity)
    except PARSER_ERRORS as error:
        raise RecordError(f"{path} (stamp {t_ns}): not a readable sweep: {error}") from None


def sweep_of(
    xyz_m: NDArray[Any],
    t_ns: int,
    offset_ns: Offset,
    frame: Literal["lidar", "map"],
    compensated_ns: int | None = None,
    intensity: Intensity = None,
) -> Sweep:
    """Build a `Sweep` of the rows of points (N, 3) that are finite and can be on Earth, with stamps `t_ns` + `offset_ns` (N,).

    Intensities (N,) of any type of numbers become float32, NaN where they are negative or not finite. Raises `ValueError` for times
    of points farther from the stamp than `checked_offset_ns` allows.
    """
    # False for NaN. Mostly all points are possible, which their least and greatest coordinate tell in a tenth of the time.
    if len(xyz_m) and not (xyz_m.min() >= -MAX_POSITION_M and xyz_m.max() <= MAX_POSITION_M):
        possible = (np.abs(xyz_m) <= MAX_POSITION_M).all(axis=1)
        xyz_m = xyz_m[possible]
        offset_ns, intensity = (None if column is None else column[possible] for column in (offset_ns, intensity))
    point_ns = None if offset_ns is None else t_ns + checked_offset_ns(offset_ns)
    strengths: NDArray[np.float32] | None = None
    if intensity is not None:
        with np.errstate(over="ignore", invalid="ignore"):
            cast = intensity.astype(np.float32)
            strengths = np.where(np.isfinite(cast) & (cast >= 0), cast, np.float32(np.nan))
    return Sweep(t_ns, xyz_m, frame, point_ns, compensated_ns, strengths)


def _parse(suffix: str, data: bytes, t_ns: int) -> tuple[NDArray[Any], Offset, Intensity]:
    if suffix == ".bin":
        if len(data) % 16:
            raise ValueError(f"{len(data)} bytes, expected four float32 (x, y, z, intensity) a point")
        _check_count(len(data) // 16)
        rows = np.frombuffer(data, "<f4").reshape(-1, 4)
        return rows[:, :3], None, rows[:, 3] if rows[:, 3].any() else None
    if suffix == ".npy":
        return _sweep_points(_read_npy(io.BytesIO(data), "the array")), None, None
    if suffix == ".pcd":
        return parse_pcd(data, t_ns)
    if suffix != ".npz":
        raise ValueError(f"unknown suffix '{suffix}', expected .npz, .npy, .bin or .pcd")
    arrays = {}
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        names = [name.removesuffix(".npy") for name in archive.namelist()]
        if "xyz_m.npy" not in archive.namelist():
            raise ValueError(f"no array 'xyz_m' in it, only {', '.join(names[:9]) or 'none'}")
        for name in ("xyz_m", "t_offset_ns", "intensity"):
            if f"{name}.npy" in archive.namelist():
                with archive.open(f"{name}.npy") as member:
                    arrays[name] = _read_npy(member, name)
    xyz, offset, intensity = _sweep_points(arrays["xyz_m"]), arrays.get("t_offset_ns"), arrays.get("intensity")
    if offset is not None and (offset.dtype.kind not in "iu" or offset.shape != (len(xyz),)):
        raise ValueError(f"t_offset_ns is {offset.dtype} {offset.shape}, expected whole numbers ({len(xyz)},)")
    if intensity is not None and intensity.shape != (len(xyz),):
        raise ValueError(f"intensity has the shape {intensity.shape}, expected ({len(xyz)},)")
    return xyz, None if offset is None else checked_offset_ns(offset), intensity


def _sweep_points(array: NDArray[Any]) -> NDArray[Any]:
    if array.dtype.kind != "f" or array.ndim != 2 or array.shape[1] < 3:
        raise ValueError(f"points are {array.dtype} {array.shape}, expected floating point (N, 3)")
    return array[:, :3]


_HEADER_LOCK = threading.Lock()
"""NumPy parses headers with `ast`, whose depth counter threads share in CPython before 3.13: two at once raise SystemError."""


def _read_npy(stream: IO[bytes], what: str) -> NDArray[Any]:
    """Read one .npy array whose header was checked before its data are allocated; never unpickles."""
    version = np.lib.format.read_magic(stream)
    length = stream.read(2 if version == (1, 0) else 4)
    if int.from_bytes(length, "little") > MAX_NPY_HEADER_BYTES:
        raise ValueError(f"{what} has a header of more than {MAX_NPY_HEADER_BYTES} bytes")
    header = io.BytesIO(length + stream.read(int.from_bytes(length, "little")))
    read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    with _HEADER_LOCK:
        shape, fortran, dtype = read_header(header)
    columns = shape[1] if len(shape) == 2 else 1
    if dtype.kind not in "fiu" or len(shape) not in (1, 2) or not 0 <= columns <= MAX_COLUMNS:
        raise ValueError(f"{what} is {str(dtype)[:40]} {shape}, expected numbers, (N, 3) or (N,)")
    _check_count(shape[0])
    size = shape[0] * columns * dtype.itemsize
    if size > MAX_SWEEP_BYTES:
        raise ValueError(f"{what} has {size} bytes, more than the {MAX_SWEEP_BYTES} that it may have")
    data = stream.read(size)
    if len(data) != size:
        raise ValueError(f"{what} is truncated: {len(data)} of {size} bytes")
    return np.frombuffer(data, dtype).reshape(shape, order="F" if fortran else "C")


def _check_count(points: int) -> None:
    if not 0 <= points <= MAX_SWEEP_POINTS:
        raise ValueError(f"{points} points, more than the {MAX_SWEEP_POINTS} that a sweep may have")
