"""One damaged record is a `RecordError`, in every format and whatever its parser raises; nothing else ends a run."""

from __future__ import annotations

import io
import lzma
import tokenize
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from log_encoders.world import world_log
from mutation.damages import npy

from log2sim.datatypes import Log, Stream
from log2sim.errors import RecordError
from log2sim.logs.records import MAX_NPY_HEADER_BYTES, guard_log, list_numbered_files, read_sweep
from log2sim.logs.stamps import compute_turn_share

RAISED = [
    ValueError("odd"), TypeError("odd"), OverflowError("too large"), KeyError("x"), IndexError(), AttributeError("odd"),
    tokenize.TokenError("EOF in multi-line statement", (1, 0)), zipfile.BadZipFile("bad"), lzma.LZMAError("bad"),
    NotImplementedError("compression type 99"), RuntimeError("encrypted"), RecursionError("deep"), AssertionError(), OSError(5, "I/O"),
    ZeroDivisionError("by zero"), np.linalg.LinAlgError("singular"), UnicodeDecodeError("utf-8", b"\xff", 0, 1, "bad"),
]  # fmt: skip


STAMP_NS = 1_700_000_000_000_000_000


def raising(problem: BaseException) -> Callable[[int], Any]:
    def read(i: int) -> Any:
        raise problem

    return read


def with_front(read: Callable[[int], Any]) -> Log:
    log = world_log()
    stream = Stream("front", log.streams["front"].t_ns, read, read)
    return guard_log(replace(log, streams={**log.streams, "front": stream}), "folder", world_log)


@pytest.mark.parametrize("problem", RAISED, ids=lambda p: type(p).__name__)
def test_whatever_a_parser_raises_is_a_record_error_of_one_line(problem: Exception) -> None:
    front = with_front(raising(problem)).streams["front"]
    for read in (front.read, front.encoded):
        assert read is not None
        with pytest.raises(RecordError, match=r"^folder: record 2 of 'front' cannot be read: \S") as found:
            read(2)
        assert "\n" not in str(found.value)
        assert found.value.__cause__ is problem


def npz(method: int = zipfile.ZIP_DEFLATED, **members: bytes) -> bytearray:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as archive:
        for name, content in members.items():
            archive.writestr(f"{name}.npy", content)
    return bytearray(stream.getvalue())


def header(text: str, version: bytes = b"\x01\x00") -> bytes:
    size = len(text).to_bytes(2 if version == b"\x01\x00" else 4, "little")
    return b"\x93NUMPY" + version + size + text.encode()


POINTS = npy(np.arange(12.0).reshape(4, 3))


def encrypted() -> bytes:
    data = npz(xyz_m=POINTS)
    for mark, flags in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        data[data.index(mark) + flags] |= 1
    return bytes(data)


def broken_member(method: int) -> bytes:
    data = npz(method, xyz_m=POINTS * 30)
    begin = data.index(b"xyz_m.npy") + len("xyz_m.npy")
    data[begin + 8 : begin + 40] = bytes(32)
    return bytes(data)


WIDE = "{'descr': '|V400000000', 'fortran_order': False, 'shape': (3, 3), }"
BOMB = header("{'descr': '<f8', 'fortran_order': False, 'shape': (20000000, 64), }") + bytes(1000)


BROKEN_SWEEPS: dict[str, tuple[str, bytes, str]] = {
    "unbalanced header": (".npy", header("{'descr': '<f8', 'shape': (4, 3"), "not a readable sweep"),
    "header with a bad token": (".npy", header("{'descr': '<f8', 'shape': (4, 3)?, \\\n"), "not a readable sweep"),
    "void type": (".npz", bytes(npz(xyz_m=header(WIDE) + bytes(100))), "expected numbers"),
    "wide text": (".npz", bytes(npz(xyz_m=header(WIDE.replace("|V", "<U")) + bytes(100))), "expected numbers"),
    "record type": (".npy", npy(np.zeros(3, dtype=[("x", "f4"), ("y", "f4", 9999)])), "expected numbers"),
    "10 GB": (".npz", bytes(npz(xyz_m=BOMB)), "more than the"),
    "header of 4 GB": (".npz", bytes(npz(xyz_m=header("", b"\x02\x00")[:8] + b"\xff" * 4 + bytes(10**6))), f"more than {MAX_NPY_HEADER_BYTES}"),
    "negative shape": (".npy", header("{'descr': '<f8', 'fortran_order': False, 'shape': (-4, 3), }") + bytes(96), "points"),
    "encrypted": (".npz", encrypted(), "encrypted"),
    "broken lzma": (".npz", broken_member(zipfile.ZIP_LZMA), "not a readable sweep"),
    "broken bzip2": (".npz", broken_member(zipfile.ZIP_BZIP2), "not a readable sweep"),
    "unknown compression": (".npz", bytes(npz(xyz_m=POINTS)).replace(b"\x14\x00\x00\x00\x08\x00", b"\x14\x00\x00\x00\x63\x00"), "not a readable sweep"),
}  # fmt: skip


@pytest.mark.parametrize("name", BROKEN_SWEEPS)
def test_broken_sweep_files_are_record_errors_without_much_memory(tmp_path: Path, name: str) -> None:
    import tracemalloc

    suffix, content, words = BROKEN_SWEEPS[name]
    path = tmp_path / f"s{suffix}"
    path.write_bytes(content)
    tracemalloc.start()
    with pytest.raises(RecordError, match=words):
        read_sweep(path, STAMP_NS)
    peak_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak_bytes < 20_000_000


@pytest.mark.parametrize("start_deg", [180.0, 144.0, 0.0, -179.0])
def test_the_share_of_a_turn_grows_clockwise_from_its_start(start_deg: float) -> None:
    share = np.linspace(0.001, 0.999, 50)
    azimuth = np.radians(start_deg) - 2 * np.pi * share
    xy = 7.0 * np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)
    np.testing.assert_allclose(compute_turn_share(xy, np.radians(start_deg)), share, atol=1e-12)


def test_files_are_ordered_by_number_and_other_names_are_left_out(tmp_path: Path) -> None:
    largest = np.iinfo(np.int64).max
    names = [
        "10.pkl.gz",
        "9.pkl.gz",
        "x9.pkl.gz",
        "8.gz",
        "7.PNG",
        f"{largest}.png",
        f"{largest + 1}.png",
        f"{'9' * 99}.png",
    ]
    for name in names:
        (tmp_path / name).touch()
    assert list(list_numbered_files(tmp_path, (".pkl.gz", ".png"))) == [7, 9, 10, largest]
    assert list_numbered_files(tmp_path / "none", (".png",)) == {}


XYZ = np.array([[1.0, 2, 3], [np.nan, 0, 0], [4, 5, 6]], np.float32)


def test_files_with_four_columns_and_with_named_columns(tmp_path: Path) -> None:
    rows = np.column_stack([XYZ, [0.1, 0.2, 0.3]]).astype("<f4")
    (tmp_path / "a.bin").write_bytes(rows.tobytes())
    (tmp_path / "b.bin").write_bytes((rows * [1, 1, 1, 0]).astype("<f4").tobytes())
    np.savez(tmp_path / "a.npz", xyz_m=XYZ, intensity=np.array([1, 2, 3], np.uint8))
    np.savez(tmp_path / "b.npz", xyz_m=XYZ)
    np.testing.assert_allclose(read_sweep(tmp_path / "a.bin", 0).intensity, [0.1, 0.3], rtol=1e-6)
    np.testing.assert_array_equal(read_sweep(tmp_path / "a.npz", 0).intensity, [1, 3])
    assert read_sweep(tmp_path / "b.bin", 0).intensity is None
    assert read_sweep(tmp_path / "b.npz", 0).intensity is None


def pcd(fields: str, types: str, sizes: str, counts: str, points: str, rows: np.ndarray) -> bytes:
    lines = (f"FIELDS {fields}", f"SIZE {sizes}", f"TYPE {types}", f"COUNT {counts}", f"POINTS {points}", "DATA binary")
    return "\n".join(lines).encode() + b"\n" + rows.tobytes()


XYZT = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]


def timed(kind: str, t: float) -> np.ndarray:
    rows = np.zeros(2, dtype=[*XYZT, ("t", kind)])
    rows["t"] = t
    return rows


ODD_PCD = {
    "axis of no column": pcd("x y z", "F F F", "4 4 4", "0 1 1", "2", np.zeros(2, XYZT)),
    "axis of two columns": pcd("x y z", "F F F", "4 4 4", "2 1 1", "2", np.zeros(4, XYZT)),
    "time of two columns": pcd("x y z t", "F F F F", "4 4 4 4", "1 1 1 2", "2", np.zeros(9, XYZT)),
    "points overflow": pcd("x y z", "F F F", "4 4 4", "1 1 1", "9" * 400, np.zeros(2, XYZT)),
    "points of 5000 digits": pcd("x y z", "F F F", "4 4 4", "1 1 1", "9" * 5000, np.zeros(2, XYZT)),
    "absolute time at the end of uint64": pcd(
        "x y z timestamp", "F F F U", "4 4 4 8", "1 1 1 1", "2", timed("<u8", 2**64 - 1)
    ),
    "seconds without end": pcd("x y z t", "F F F F", "4 4 4 8", "1 1 1 1", "2", timed("<f8", 1e300)),
    "width without height": b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 2\nDATA binary\n" + bytes(24),
    "much text": b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS 20000000\nDATA ascii\n" + b"1 " * 100,
}  # fmt: skip


@pytest.mark.parametrize("name", ODD_PCD)
def test_odd_headers_of_pcd_files_are_record_errors(tmp_path: Path, name: str) -> None:
    (tmp_path / "s.pcd").write_bytes(ODD_PCD[name])
    with pytest.raises(RecordError, match="not a readable sweep"):
        read_sweep(tmp_path / "s.pcd", STAMP_NS)
