"""Sweep files of a log: .npz, .npy, .bin and .pcd; their size is checked before anything is allocated."""

from __future__ import annotations

import io
import lzma
import struct
import tokenize
import zipfile
import zlib
from pathlib import Path
from typing import IO, Any, Literal

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Sweep
from log2sim.errors import RecordError
from log2sim.logs.images import read_bytes
from log2sim.logs.pcd import parse_pcd
from log2sim.logs.pose_checks import MAX_POSITION_M
from log2sim.logs.stamps import checked_offset_ns

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

# Times of points relative to the stamp of their sweep, ns; None when the file has none.
Offset = NDArray[np.int64] | None
# How strong returns are; None when the file does not tell.
Intensity = NDArray[Any] | None


def read_sweep(path: Path, t_ns: int, frame: Literal["lidar", "map"] = "lidar") -> Sweep:
    """Read a sweep; rows that are not finite are dropped.

    Raises
    ------
    RecordError
        When it is missing, truncated, too large or not of the layout that its suffix promises; names file and stamp.
    """
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

    Intensities (N,) of any type of numbers become float32; those that cannot be, NaN.

    Raises
    ------
    ValueError
        For times of points farther from the stamp than `checked_offset_ns` allows.
    """
    # False for NaN. Mostly all points are possible, which their least and greatest coordinate tell in a tenth of the time.
    if len(xyz_m) and not (xyz_m.min() >= -MAX_POSITION_M and xyz_m.max() <= MAX_POSITION_M):
        possible = (np.abs(xyz_m) <= MAX_POSITION_M).all(axis=1)
        xyz_m = xyz_m[possible]
        offset_ns = None if offset_ns is None else offset_ns[possible]
        intensity = None if intensity is None else intensity[possible]
    point_ns = None if offset_ns is None else t_ns + checked_offset_ns(offset_ns)
    return Sweep(t_ns, xyz_m, frame, point_ns, compensated_ns, None if intensity is None else _strengths(intensity))


def _strengths(values: NDArray[Any]) -> NDArray[np.float32]:
    """Return intensities (N,) as float32, NaN where they are negative or not finite."""
    with np.errstate(over="ignore", invalid="ignore"):
        strengths = values.astype(np.float32)
        return np.where(np.isfinite(strengths) & (strengths >= 0), strengths, np.float32(np.nan))


def _parse(suffix: str, data: bytes, t_ns: int) -> tuple[NDArray[Any], Offset, Intensity]:
    if suffix == ".bin":
        if len(data) % 16:
            raise ValueError(f"{len(data)} bytes, expected four float32 (x, y, z, intensity) a point")
        _check_count(len(data) // 16)
        rows = np.frombuffer(data, "<f4").reshape(-1, 4)
        return rows[:, :3], None, rows[:, 3] if rows[:, 3].any() else None
    if suffix == ".npy":
        return _points(_read_npy(io.BytesIO(data), "the array")), None, None
    if suffix == ".npz":
        return _parse_npz(data)
    if suffix == ".pcd":
        return parse_pcd(data, t_ns, MAX_SWEEP_POINTS)
    raise ValueError(f"unknown suffix '{suffix}', expected .npz, .npy, .bin or .pcd")


def _parse_npz(data: bytes) -> tuple[NDArray[Any], Offset, Intensity]:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        names = archive.namelist()
        if "xyz_m.npy" not in names:
            raise ValueError(
                f"no array 'xyz_m' in it, only {', '.join(n.removesuffix('.npy') for n in names[:9]) or 'none'}"
            )
        with archive.open("xyz_m.npy") as member:
            xyz = _points(_read_npy(member, "xyz_m"))
        columns = {}
        for name in ("t_offset_ns", "intensity"):
            if f"{name}.npy" in names:
                with archive.open(f"{name}.npy") as member:
                    columns[name] = _read_npy(member, name)
    offset, intensity = columns.get("t_offset_ns"), columns.get("intensity")
    if offset is not None and (offset.dtype.kind not in "iu" or offset.shape != (len(xyz),)):
        raise ValueError(f"t_offset_ns is {offset.dtype} {offset.shape}, expected whole numbers ({len(xyz)},)")
    if intensity is not None and intensity.shape != (len(xyz),):
        raise ValueError(f"intensity has the shape {intensity.shape}, expected ({len(xyz)},)")
    return xyz, None if offset is None else checked_offset_ns(offset), intensity


def _points(array: NDArray[Any]) -> NDArray[Any]:
    if array.dtype.kind != "f" or array.ndim != 2 or array.shape[1] < 3:
        raise ValueError(f"points are {array.dtype} {array.shape}, expected floating point (N, 3)")
    return array[:, :3]


def _read_npy(stream: IO[bytes], what: str) -> NDArray[Any]:
    """Read one .npy array whose header was checked before its data are allocated; never unpickles."""
    version = np.lib.format.read_magic(stream)
    length = stream.read(2 if version == (1, 0) else 4)
    if int.from_bytes(length, "little") > MAX_NPY_HEADER_BYTES:
        raise ValueError(f"{what} has a header of more than {MAX_NPY_HEADER_BYTES} bytes")
    header = io.BytesIO(length + stream.read(int.from_bytes(length, "little")))
    read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
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
