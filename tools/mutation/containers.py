"""Damage within arrays, archives, pickles and images, whose check sums are right again afterwards."""

from __future__ import annotations

import builtins
import gzip
import io
import os
import pickle
import struct
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from mutation.damage import Damage, Mutation, Place, pick

EXTREMES = (np.nan, np.inf, -np.inf, 1e308, -1e30, 1e9)
BOMB_BYTES = 300_000_000
HUGE = (65_535, 65_500, 30_000)
HEADERS = (
    "{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000, 3), }",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (-1, 3), }",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (3, 4611686018427387905), }",
    "{'descr': '|O', 'fortran_order': False, 'shape': (4, 3), }",
    "{'descr': '|V1000000', 'fortran_order': False, 'shape': (100000, 3), }",
    "{'descr': [('x', '<f8'), ('y', '<f8'), ('z', '<f8')], 'fortran_order': False, 'shape': (4,), }",
    "{'descr': '<U500000', 'fortran_order': False, 'shape': (1000, 3), }",
    "{'descr': '<f8', 'fortran_order': True, 'shape': (4, 3, 2, 1), }",
    "{'descr': '<f8', 'fortran_order': 7, 'shape': '4', }",
    "{'descr': '<f8', 'shape': (4, 3), }",
    "__import__('os').mkdir('pwned')",
    "(" * 500 + ")" * 500,
    "{'descr': '<f8', 'fortran_order': False, 'shape': (4, 3)",
    "\0\n\t" * 30,
)


class Payload:
    """What runs a function when it is unpickled."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.made_by = function, arguments

    def __reduce__(self) -> Any:
        return self.made_by


def npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def npy_with_header(header: str, data: bytes) -> bytes:
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", min(len(header), 65535)) + header.encode()[:65535] + data


def archive(members: list[tuple[str, bytes]], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as file:
        for name, data in members:
            file.writestr(name, data)
    return stream.getvalue()


def change_arrays(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    """Other values, types, shapes and members; whatever is compressed stays consistent."""
    with np.load(file) as loaded:
        arrays = {name: loaded[name] for name in loaded.files}
    name = list(arrays)[rng.integers(len(arrays))]
    array = arrays[name].copy()
    members = {k: npy(v) for k, v in arrays.items()}
    kind = int(rng.integers(9))
    if kind == 0 and array.dtype.kind == "f":
        value = EXTREMES[rng.integers(len(EXTREMES))]
        rows = rng.random(len(array)) < rng.choice([0.001, 0.3, 1.0])
        array[rows] = value
        members[name], words, visible = (
            npy(array),
            f"{rows.sum()} rows of {name} are {value}",
            bool(rows.sum() > len(array) / 2),
        )
    elif kind == 1 and array.dtype.kind == "i":
        value = int(pick(rng, (np.iinfo(array.dtype).max, np.iinfo(array.dtype).min, 10**9 + 1)))
        array[int(rng.integers(len(array)))] = min(value, np.iinfo(array.dtype).max)
        members[name], words, visible = npy(array), f"a value of {name} is {value}", abs(value) > 10**9
    elif kind == 2:
        dtype = str(pick(rng, ("f2", "i8", "u1", "c16", "?", "U10", "O", "M8[ns]", "f16", ">f4")))
        members[name], words, visible = (
            npy(array.astype(dtype)),
            f"{name} is of type {dtype}",
            dtype not in ("f2", "f16", ">f4", "i8"),
        )
    elif kind == 3:
        other = (array[:0], array[:-1], array[..., None], np.concatenate([array] * 2), array[:1])[int(rng.integers(5))]
        members[name], words, visible = (
            npy(other),
            f"{name} is {other.shape}",
            other.shape[1:] != array.shape[1:] or len(arrays) > 1,
        )
    elif kind == 4:
        del members[name]
        words, visible = f"{name} is missing", name == "xyz_m"
    elif kind == 5:
        header = HEADERS[rng.integers(len(HEADERS))]
        members[name], words, visible = (
            npy_with_header(header, array.tobytes()),
            f"{name} has the header {header[:60]!r}",
            True,
        )
    elif kind == 6:
        target = place.outside / "pwned"
        data = pickle.dumps(Payload(os.mkdir, str(target)))
        members[name], words, visible = (
            npy_with_header(HEADERS[3], data),
            f"{name} is a pickle that makes a folder",
            True,
        )
    elif kind == 7:
        zeros = npy_with_header(HEADERS[0], b"") + bytes(BOMB_BYTES)
        members[name], words, visible = zeros, f"{name} unpacks to {BOMB_BYTES} zeros", True
    else:
        members[name], words, visible = rng.bytes(300), f"{name} is noise", True
    file.write_bytes(archive([(f"{k}.npy", v) for k, v in members.items()]))
    return Damage(words, visible)


def change_archive(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    """Other compressions, an encrypted bit, a member twice, names that lead elsewhere."""
    data = bytearray(file.read_bytes())
    with zipfile.ZipFile(io.BytesIO(data)) as loaded:
        members = [(i.filename, loaded.read(i)) for i in loaded.infolist()]
    kind = int(rng.integers(6))
    if kind == 0:
        method = int(pick(rng, (zipfile.ZIP_STORED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)))
        file.write_bytes(archive(members, method))
        return Damage(f"compressed by method {method}", False)
    if kind == 1:
        data = bytearray(archive(members, int(pick(rng, (zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)))))
        at = len(data) // 3
        data[at] ^= 0xFF
        file.write_bytes(data)
        return Damage("compressed otherwise, a byte inverted", True)
    if kind == 2:
        for mark, offset in ((b"PK\1\2", 8), (b"PK\3\4", 6)):
            at = data.find(mark)
            data[at + offset] |= 1
        file.write_bytes(data)
        return Damage("its first member is encrypted", True)
    if kind == 3:
        method = int(rng.integers(1, 100))
        for mark, offset in ((b"PK\1\2", 10), (b"PK\3\4", 8)):
            at = data.find(mark)
            data[at + offset : at + offset + 2] = method.to_bytes(2, "little")
        file.write_bytes(data)
        return Damage(f"its first member states the method {method}", method != 8)
    if kind == 4:
        name = str(pick(rng, ("../../pwned.npy", "/tmp/pwned.npy", "xyz_m.npy/", "a" * 60_000)))
        file.write_bytes(archive([(name, b"x"), *members]))
        return Damage(f"has a member {name[:30]}", False)
    at = data.rfind(b"PK\5\6")
    data[at + 8 : at + 12] = b"\xff\xff\xff\xff"
    file.write_bytes(data)
    return Damage("states 65535 members", False)


def change_table_pickle(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    """Payloads, deep nesting, and tables with other columns, types and values."""
    import pandas

    table = pandas.read_pickle(file)
    kind = int(rng.integers(10))
    column = table.columns[rng.integers(len(table.columns))]
    words, visible = f"column {column}", True
    target = str(place.outside / "pwned")
    payloads = (Payload(os.mkdir, target), Payload(os.system, f"touch {target}"), Payload(builtins.eval, f"open({target!r}, 'w')"),
                Payload(builtins.open, target, "w"), Payload(np.load, target), [Payload(os.mkdir, target), table])  # fmt: skip
    if kind == 0:
        data = pickle.dumps(payloads[rng.integers(len(payloads))])
        words = "a pickle that runs a function"
    elif kind == 1:
        data, words = (
            b"\x80\x04" + b"(" * 100_000 + b"."
            if rng.random() < 0.5
            else b"\x80\x04" + b"]" + b"]a" * 5 + b"\x85" * 100_000 + b".",
            "deeply nested pickle",
        )
    elif kind == 2:
        data, words = b"\x80\x04\x8e" + (2**62).to_bytes(8, "little") + b"abc.", "a pickle of 4 EiB"
    elif kind == 3 and len(table):
        table[column] = table[column].astype(object)
        table.loc[table.index[int(rng.integers(len(table)))], column] = str(pick(rng, ("x", "")))
        data, words = pickle.dumps(table), f"{column} holds a word"
        visible = column not in ("uuid", "label") and "attributes" not in column
    elif kind == 4 and table[column].dtype.kind == "f" and len(table):
        value = EXTREMES[rng.integers(len(EXTREMES))]
        table.loc[table.index[int(rng.integers(len(table)))], column] = value
        # Points that are not finite are misses; a cuboid has no such value.
        data, words, visible = (
            pickle.dumps(table),
            f"{column} holds {value}",
            "cuboids" in str(file) and "rider" not in column,
        )
    elif kind == 5:
        data, words = pickle.dumps(table.drop(columns=[column])), f"{column} is missing"
        visible = not column.startswith(("attributes", "cuboids", "camera", "i", "stationary"))
    elif kind == 6:
        data, words, visible = pickle.dumps(table.iloc[:0]), "has no rows", False
    elif kind == 7:
        other = pick(rng, (table.to_dict(), table.values, [1, 2], None, "text", table[column]))
        data, words = pickle.dumps(other), f"is a {type(other).__name__}"
    elif kind == 8:
        data, words, visible = (
            pickle.dumps(pandas.concat([table, table])),
            "each row occurs twice",
            "cuboids" in str(file),
        )
    else:
        data, words = bytes(BOMB_BYTES), f"{BOMB_BYTES} zeros"
    file.write_bytes(gzip.compress(data, 1))
    return Damage(words, visible)


def change_image(rng: np.random.Generator, file: Path, place: Place) -> Damage | None:
    """Sizes that need gigabytes, other sizes, and files of other kinds of images."""
    import cv2

    image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    height, width = image.shape[:2]
    kind = int(rng.integers(6))
    huge = HUGE[rng.integers(len(HUGE))]
    if kind <= 1:
        file.write_bytes(_with_size(file.read_bytes(), huge, huge))
        return Damage(f"states {huge} x {huge} pixels", True)
    if kind == 2:
        size = int(pick(rng, (0, 1, 2)))
        file.write_bytes(_with_size(file.read_bytes(), size, height))
        return Damage(f"states a width of {size}", True)
    if kind == 3:
        suffix = str(pick(rng, (".bmp", ".tiff", ".webp", ".png", ".jpg", ".ppm", ".jp2", ".hdr")))
        data = cv2.imencode(suffix, image.astype(np.float32) if suffix == ".hdr" else image)[1].tobytes()
        file.write_bytes(data)
        return Damage(f"is a {suffix} image", False)
    if kind == 4:
        texts = (
            f"P6 {huge} {huge} 255\n",
            f"P1 {huge} {huge}\n",
            f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {huge} +X {huge}\n",
            "GIF89a\xff\xff\xff\xff",
        )
        file.write_bytes(texts[rng.integers(len(texts))].encode("latin-1") + bytes(100))
        return Damage("is another image format that states a huge size", True)
    other = (image[: height // 2], cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), image[::2, ::2], image.transpose(1, 0, 2))[
        int(rng.integers(4))
    ]
    file.write_bytes(cv2.imencode(file.suffix, np.ascontiguousarray(other))[1].tobytes())
    return Damage(f"is {other.shape}", other.shape[:2] != (height, width))


def _with_size(data: bytes, width: int, height: int) -> bytes:
    """An image file that states another size: the header of PNG with its check sum, or of JPEG."""
    if data[:4] == b"\x89PNG":
        header = b"IHDR" + struct.pack(">II", width, height) + data[24:29]
        return data[:12] + header + struct.pack(">I", zlib.crc32(header)) + data[33:]
    at = next((data.find(bytes([0xFF, m])) for m in (0xC0, 0xC2, 0xC1) if data.find(bytes([0xFF, m])) > 0), -1)
    return data if at < 0 else data[: at + 5] + struct.pack(">HH", height, width) + data[at + 9 :]


CONTAINERS = (
    Mutation(change_arrays, (".npz",), 8.0), Mutation(change_archive, (".npz",), 4.0),
    Mutation(change_table_pickle, (".pkl.gz",), 10.0), Mutation(change_image, (".png", ".jpg"), 3.0),
)  # fmt: skip
