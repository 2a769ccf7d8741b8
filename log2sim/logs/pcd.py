"""PCD files (Point Cloud Library, version 0.7), ASCII and binary."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import NS_PER_S
from log2sim.logs.stamps import MAX_TIME_S, checked_offset_ns

MAX_HEADER_BYTES = 16 * 1024
# Each takes some 80 bytes while it is parsed.
MAX_ASCII_VALUES = 20_000_000
TIME_FIELDS = ("t_offset_ns", "offset", "t", "timestamp")
INTENSITY_FIELDS = ("intensity", "reflectivity", "reflectance")


def parse_pcd(
    data: bytes, t_ns: int, limit_points: int
) -> tuple[NDArray[Any], NDArray[np.int64] | None, NDArray[Any] | None]:
    """Parse points (N, 3), their times (N,) int64 ns relative to the stamp and their intensities (N,); None without such a field.

    A time field is `t_offset_ns`, `offset` or `t` (relative to the stamp) or `timestamp` (absolute); whole numbers are
    nanoseconds, floating-point numbers seconds.

    Raises
    ------
    ValueError
        When the header or the data do not follow the format.
    """
    header, body = _read_header(data)
    layout = _layout(header)
    count = _points(header, limit_points)
    encoding = header["DATA"][0].lower()
    if encoding == "binary":
        if len(body) < count * layout.itemsize:
            raise ValueError(f"truncated: {len(body)} of {count * layout.itemsize} bytes")
        rows = np.frombuffer(body, layout, count)
    elif encoding == "ascii":
        rows = _parse_ascii(body, layout, count)
    else:
        raise ValueError(
            f"DATA {encoding} is not supported; convert it to binary (pcl_convert_pcd_ascii_binary IN OUT 1)"
        )
    xyz = np.stack([rows[k] for k in ("x", "y", "z")], axis=1)
    field = next((f for f in TIME_FIELDS if f in (layout.names or ())), None)
    offset_ns = None if field is None else _offset_ns(rows[field], t_ns, absolute=field == "timestamp")
    strength = find_intensity_field(layout)
    return xyz, offset_ns, None if strength is None else rows[strength]


def find_intensity_field(layout: np.dtype[Any]) -> str | None:
    """Find the field of the points' intensities, one number each; None where there is none."""
    named = {name.lower(): name for name in layout.names or () if layout[name].shape == ()}
    return next((named[name] for name in INTENSITY_FIELDS if name in named), None)


def _read_header(data: bytes) -> tuple[dict[str, list[str]], bytes]:
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
    return header, data[start:]


def _layout(header: dict[str, list[str]]) -> np.dtype[Any]:
    names, sizes, kinds = header["FIELDS"], header["SIZE"], header["TYPE"]
    counts = header.get("COUNT", ["1"] * len(names))
    if not len(names) == len(sizes) == len(kinds) == len(counts) <= 64:
        raise ValueError("PCD header: FIELDS, SIZE, TYPE and COUNT differ in length")
    spec: list[tuple[str, str, tuple[int, ...]]] = []
    for k, (name, size, kind, count) in enumerate(zip(names, sizes, kinds, counts)):
        code = {"F": "f", "I": "i", "U": "u"}.get(kind.upper())
        if (
            code is None
            or size not in ("1", "2", "4", "8")
            or (code == "f" and size in ("1", "2"))
            or not count.isdigit()
        ):
            raise ValueError(f"PCD header: field '{name}' has TYPE {kind} SIZE {size} COUNT {count}")
        if int(count) > 4096:
            raise ValueError(f"PCD header: field '{name}' has COUNT {count}")
        # Padding fields are all called "_", so names are made unique by their index.
        unique = name if names.index(name) == k and name != "_" else f"_{k}"
        spec.append((unique, f"<{code}{size}", () if count == "1" else (int(count),)))
    for axis in ("x", "y", "z"):
        if axis not in names:
            raise ValueError(f"PCD header: no field '{axis}'")
    for name, _, shape in spec:
        if shape and name in ("x", "y", "z", *TIME_FIELDS):
            raise ValueError(f"PCD header: field '{name}' has COUNT {shape[0]}, expected 1")
    return np.dtype(spec)


def _points(header: dict[str, list[str]], limit_points: int) -> int:
    words = header.get("POINTS") or [str(int(header["WIDTH"][0]) * int(header["HEIGHT"][0]))]
    count = int(words[0])
    if not 0 <= count <= limit_points:
        raise ValueError(f"{count} points, more than the {limit_points} that a sweep may have")
    return count


def _parse_ascii(body: bytes, layout: np.dtype[Any], count: int) -> NDArray[Any]:
    widths = [int(np.prod(layout[name].shape, dtype=int)) for name in layout.names or ()]
    if count * sum(widths) > MAX_ASCII_VALUES:
        raise ValueError(
            f"{count * sum(widths)} values as text, more than the {MAX_ASCII_VALUES} that are read; convert it to binary"
        )
    words = body.split(maxsplit=count * sum(widths))[: count * sum(widths)]
    if len(words) != count * sum(widths):
        raise ValueError(f"truncated: {len(words)} of {count * sum(widths)} values")
    table = np.array(words, dtype="S32").reshape(count, sum(widths))
    rows = np.zeros(count, layout)
    for name, width, start in zip(layout.names or (), widths, np.cumsum([0, *widths])):
        if width == 1 and not name.startswith("_"):
            rows[name] = table[:, start].astype(layout[name])
    return rows


def _offset_ns(values: NDArray[Any], t_ns: int, *, absolute: bool) -> NDArray[np.int64]:
    if values.dtype.kind in "iu":
        return checked_offset_ns(values, t_ns if absolute else 0)
    seconds = values.astype(np.float64)
    seconds = np.where(np.isfinite(seconds), seconds, 0.0)
    if np.abs(seconds).max(initial=0.0) > MAX_TIME_S:
        raise ValueError(f"a point has the time {np.abs(seconds).max():g} s, expected at most {MAX_TIME_S:g}")
    return checked_offset_ns(np.round((seconds - (t_ns / NS_PER_S if absolute else 0.0)) * NS_PER_S))
