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
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from log_encoders.world import world_log
from test_logs_contract import ENCODERS

from log2sim.datatypes import Log, Stream
from log2sim.errors import LogError, RecordError
from log2sim.files import plugins
from log2sim.logs.opening import open_log
from log2sim.logs.records import MAX_NPY_HEADER_BYTES, guard_log, read_sweep, translate_parser_errors

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
    return guard_log(replace(log, streams={**log.streams, "front": stream}), "folder")


@pytest.mark.parametrize("problem", RAISED, ids=lambda p: type(p).__name__)
def test_whatever_a_parser_raises_is_a_record_error_of_one_line(problem: Exception) -> None:
    front = with_front(raising(problem)).streams["front"]
    for read in (front.read, front.encoded):
        assert read is not None
        with pytest.raises(RecordError, match=r"^folder: record 2 of 'front' cannot be read: \S") as found:
            read(2)
        assert "\n" not in str(found.value)
        assert found.value.__cause__ is problem


@pytest.mark.parametrize("problem", [KeyboardInterrupt(), MemoryError(), SystemExit(3)], ids=lambda p: type(p).__name__)
def test_interrupts_and_lack_of_memory_pass(problem: BaseException) -> None:
    with pytest.raises(type(problem)) as found:
        with_front(raising(problem)).streams["front"].read(0)
    assert found.value is problem


def test_our_own_errors_keep_their_words() -> None:
    with pytest.raises(RecordError, match=r"^a\.png: truncated$"):
        with_front(raising(RecordError("a.png: truncated"))).streams["front"].read(0)


def test_what_is_deferred_stays_deferred_and_is_guarded() -> None:
    def labels() -> Any:
        raise OverflowError("int too large")

    log = guard_log(world_log().changed(labels=labels), "folder")
    with pytest.raises(LogError, match=r"^folder: the labels cannot be read: OverflowError: int too large"):
        _ = log.labels


def test_an_opening_that_fails_is_a_log_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = ENCODERS["log2sim"].encode(world_log(), tmp_path / "base")

    def broken(*_: object) -> Any:
        raise OverflowError("int too large to convert to float")

    monkeypatch.setattr(type(plugins.load("log", "log2sim")), "open", broken)
    with pytest.raises(LogError, match="cannot be read as format 'log2sim': OverflowError: int too large"):
        open_log(path)


def test_numbers_beyond_every_type_do_not_warn() -> None:
    with translate_parser_errors("here", RecordError):
        np.array([1e300]).astype(np.int64)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Path, Path]]:
    """Folder and path of the world in each format, written when first asked for."""
    return {name: (base := tmp_path_factory.mktemp(f"flip-{name}") / "base", base) for name in ENCODERS}


SUPPRESSED = [HealthCheck.function_scoped_fixture, HealthCheck.too_slow]


@pytest.mark.matrix
@pytest.mark.parametrize("name", ENCODERS)
@settings(max_examples=4, deadline=None, suppress_health_check=SUPPRESSED)
@given(data=st.data())
def test_flipped_bytes_of_any_file_end_no_reading(
    written: dict[str, tuple[Path, Path]], name: str, data: st.DataObject
) -> None:
    read_damaged(written, name, data)


@pytest.mark.slow
@pytest.mark.parametrize("name", ENCODERS)
@settings(max_examples=100, deadline=None, suppress_health_check=SUPPRESSED)
@given(data=st.data())
def test_many_flipped_bytes_of_any_file_end_no_reading(
    written: dict[str, tuple[Path, Path]], name: str, data: st.DataObject
) -> None:
    read_damaged(written, name, data)


def read_damaged(written: dict[str, tuple[Path, Path]], name: str, data: st.DataObject) -> None:
    base, path = written[name]
    if not base.exists():
        path = ENCODERS[name].encode(world_log(), base)
        written[name] = base, path
    files = sorted(f for f in base.rglob("*") if f.is_file())
    file = data.draw(st.sampled_from(files), label="file")
    sound = file.read_bytes()
    damaged = bytearray(sound)
    for _ in range(data.draw(st.integers(1, 3))):
        # Headers are at the beginning.
        k = data.draw(st.integers(0, len(damaged) - 1) | st.integers(0, min(len(damaged) - 1, 300)))
        damaged[k] = data.draw(st.integers(0, 255))
    file.write_bytes(damaged)
    try:
        read_all(path, name)
    finally:
        file.write_bytes(sound)


def read_all(path: Path, name: str) -> None:
    """Open a log and read all of it; a `LogError` refuses the log, a `RecordError` one record."""
    try:
        log = open_log(path, format=name)
        _ = log.labels, log.notes
    except LogError as problem:
        return require_one_line(problem)
    for stream in log.streams.values():
        for i in (0, len(stream.t_ns) - 1):
            try:
                stream.read(i)
            except RecordError as problem:
                require_one_line(problem)


def require_one_line(problem: LogError) -> None:
    assert "\n" not in str(problem)


def npz(method: int = zipfile.ZIP_DEFLATED, **members: bytes) -> bytearray:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as archive:
        for name, content in members.items():
            archive.writestr(f"{name}.npy", content)
    return bytearray(stream.getvalue())


def npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


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


def test_the_methods_of_zip_are_read_when_they_are_sound(tmp_path: Path) -> None:
    pytest.importorskip("bz2")
    for method in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2):
        (tmp_path / "s.npz").write_bytes(npz(method, xyz_m=POINTS))
        assert read_sweep(tmp_path / "s.npz", 0).xyz_m.shape == (4, 3)


@pytest.mark.parametrize(
    "offset",
    [
        np.array([0, 0, 0, np.iinfo(np.int64).max]),
        np.array([0, 0, 0, np.iinfo(np.int64).min]),
        np.array([0, 0, 0, np.iinfo(np.uint64).max], dtype=np.uint64),
        np.array([0, 0, 0, 1_000_000_001]),
        np.array([0, -1_000_000_001, 0, 0], dtype=np.int64),
    ],
    ids=["int64 max", "int64 min", "uint64 max", "late", "early"],
)
def test_times_of_points_beyond_a_second_of_the_stamp_refuse_the_sweep(tmp_path: Path, offset: np.ndarray) -> None:
    (tmp_path / "s.npz").write_bytes(npz(xyz_m=POINTS, t_offset_ns=npy(offset)))
    with pytest.raises(RecordError, match=r"s\.npz .*the time of a point is .* s off the stamp of its sweep"):
        read_sweep(tmp_path / "s.npz", STAMP_NS)


@pytest.mark.parametrize("kind", ["<i4", "<i8", "<u4", "<u8", "<i2"])
def test_times_of_points_up_to_a_second_are_kept_in_every_type(tmp_path: Path, kind: str) -> None:
    low = 0 if kind[1] == "u" else -30_000
    high = 30_000 if kind.endswith("2") else 1_000_000_000
    offset = np.array([low, 0, 1, high], dtype=kind)
    (tmp_path / "s.npz").write_bytes(npz(xyz_m=POINTS, t_offset_ns=npy(offset)))
    sweep = read_sweep(tmp_path / "s.npz", STAMP_NS)
    assert sweep.t_ns is not None
    assert (sweep.t_ns - STAMP_NS).tolist() == [low, 0, 1, high]


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


@pytest.mark.parametrize("kind", ["<u8", "<i8"])
def test_absolute_whole_times_of_pcd_files_are_exact(tmp_path: Path, kind: str) -> None:
    rows = timed(kind, 0)
    rows["t"] = [STAMP_NS - 3, STAMP_NS + 1_000_000_000]
    data = pcd("x y z timestamp", f"F F F {kind[1].upper()}", "4 4 4 8", "1 1 1 1", "2", rows)
    (tmp_path / "s.pcd").write_bytes(data)
    sweep = read_sweep(tmp_path / "s.pcd", STAMP_NS)
    assert sweep.t_ns is not None
    assert (sweep.t_ns - STAMP_NS).tolist() == [-3, 1_000_000_000]
