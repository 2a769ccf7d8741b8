"""Only regular files are read, and never more of them than a limit; everywhere a log, scenario or setting is opened."""

from __future__ import annotations

import os
import signal
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from log2sim.config import Config
from log2sim.errors import ConfigError, LogError, RecordError, ScenarioError
from log2sim.export.xml_text import read as read_xml
from log2sim.files import inputs
from log2sim.files.documents import read_json
from log2sim.files.inputs import TooLargeError, open_regular, read_bytes, read_file, read_text
from log2sim.logs.arrow import ParquetRows, read_columns
from log2sim.logs.kitti.labels import read_text as read_kitti_text
from log2sim.logs.native.reader import read_csv_table
from log2sim.logs.nuscenes.tables import scan_records
from log2sim.logs.pandaset.unpickle import read_pickled_table
from log2sim.logs.records import read_image, read_sweep
from log2sim.logs.ros.bag import open_container
from log2sim.logs.ros.containers import ChunkedFile
from log2sim.logs.waymo.tfrecord import RecordFile, starts_like_tfrecord
from log2sim.perception.detect import ssd_mobilenet
from log2sim.perception.detect.onnx_detector import load_model
from log2sim.perception.detect3d.network import load_network
from log2sim.simulation.carla import player
from log2sim.synth.returns import lidar_model
from log2sim.synth.scene import load_scene

pytestmark = pytest.mark.skipif(os.name == "nt", reason="no named pipes there")
READERS: dict[str, tuple[str, type[Exception], Callable[[Path], Any]]] = {
    "json": ("a.json", LogError, read_json),
    "scenario": ("a.json", ScenarioError, lambda p: read_json(p, ScenarioError)),
    "config": ("a.toml", ConfigError, lambda p: Config.load(p)),
    "xosc": ("a.xosc", ScenarioError, read_xml),
    "image": ("a.png", RecordError, lambda p: read_image(p, 0, 4, 4)),
    "sweep": ("a.npz", RecordError, lambda p: read_sweep(p, 0)),
    "table": ("a.csv", LogError, lambda p: read_csv_table(p, {"t_ns": "int"})),
    "pickle": ("a.pkl.gz", RecordError, read_pickled_table),
    "feather": ("a.feather", LogError, lambda p: read_columns(p, {"t": "int"})),
    "parquet": ("a.parquet", LogError, lambda p: len(ParquetRows(p, {"t": "int"}))),
    "tables": ("a.json", LogError, lambda p: list(scan_records(p, "token", ["a"]))),
    "kitti": ("a.txt", LogError, read_kitti_text),
    "bag": ("a.bag", OSError, open_container),
    "chunks": ("a.bag", OSError, ChunkedFile),
    "tfrecord": ("a.tfrecord", LogError, RecordFile),
    "scene": ("a.toml", ConfigError, load_scene),
    "lidar model": ("a.toml", ConfigError, lambda p: lidar_model(str(p))),
}


@pytest.fixture(autouse=True)
def hang_is_a_failure() -> Iterator[None]:
    def stop(*_: object) -> None:
        raise AssertionError("it hangs")

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(10)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.mark.parametrize("name", READERS)
def test_a_named_pipe_is_refused_at_once(tmp_path: Path, name: str) -> None:
    file, error, read = READERS[name]
    os.mkfifo(tmp_path / file)
    with pytest.raises(error, match="is a named pipe, expected a regular file") as problem:
        read(tmp_path / file)
    assert "\n" not in str(problem.value)


@pytest.mark.parametrize("name", READERS)
def test_a_device_that_never_ends_is_refused(tmp_path: Path, name: str) -> None:
    file, error, read = READERS[name]
    (tmp_path / file).symlink_to("/dev/zero")
    with pytest.raises(error, match="is a device, expected a regular file"):
        read(tmp_path / file)


def test_a_pipe_is_no_tfrecord(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.tfrecord")
    assert not starts_like_tfrecord(tmp_path / "a.tfrecord")


def test_folders_and_sockets_are_refused(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r": cannot be read: is a folder, expected a regular file$"):
        read_file(tmp_path, 10, LogError)
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(os.path.relpath(tmp_path / "s"))
        with pytest.raises(LogError, match="is a socket"):
            read_file(tmp_path / "s", 10, LogError)


def test_a_file_is_read_up_to_the_limit(tmp_path: Path) -> None:
    path = tmp_path / "a"
    for size in (0, 1, 9, 10):
        path.write_bytes(b"x" * size)
        assert read_bytes(path, 10) == b"x" * size
    path.write_bytes(b"x" * 11)
    with pytest.raises(TooLargeError, match="11 bytes, more than the 10 that it may have"):
        read_bytes(path, 10)


def test_a_file_that_grows_while_it_is_read_is_not_read_beyond_the_limit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"x" * 5)
    read_counts = []

    class Growing:
        """A file of which more is there at each reading, as of a device, though its size is 5."""

        def __enter__(self) -> Growing:
            self.file = open_regular(path, buffering=0)
            return self

        def __exit__(self, *_: object) -> None:
            self.file.close()

        def fileno(self) -> int:
            return self.file.fileno()

        def read(self, count: int) -> bytes:
            read_counts.append(min(count, 7))
            return b"y" * read_counts[-1]

    monkeypatch.setattr(inputs, "open_regular", lambda path, buffering: Growing())
    with pytest.raises(TooLargeError, match="101 bytes, more than the 100"):
        read_bytes(path, 100)
    assert sum(read_counts) == 101


def test_what_became_a_pipe_after_it_was_looked_at_does_not_hang(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_bytes(b"x")
    os.mkfifo(tmp_path / "pipe")
    regular = os.stat(tmp_path / "file")
    monkeypatch.setattr(inputs.os, "stat", lambda path: regular)
    with pytest.raises(OSError, match="is a named pipe"):
        open_regular(tmp_path / "pipe")


def test_a_refused_file_leaves_no_descriptor_open(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    before = len(os.listdir("/proc/self/fd")) if Path("/proc/self/fd").is_dir() else 0
    for _ in range(20):
        with pytest.raises(OSError, match="named pipe"):
            open_regular(tmp_path / "pipe")
    assert before == (len(os.listdir("/proc/self/fd")) if before else 0)


def test_text_that_is_no_utf8_and_a_zero_byte_in_a_name_are_errors_of_one_line(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"\xff")
    with pytest.raises(ConfigError, match="a: not a text in UTF-8"):
        read_text(tmp_path / "a", 10, ConfigError)
    with pytest.raises(ConfigError, match="cannot be read"):
        read_text(str(tmp_path / "a\0b"), 10, ConfigError)
    with pytest.raises(ConfigError, match="none: not there"):
        read_text(tmp_path / "none", 10, ConfigError, missing="not there")


def test_regular_files_are_read_from_several_threads(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"abc" * 1000)
    found: list[bytes] = []
    threads = [threading.Thread(target=lambda: found.append(read_bytes(tmp_path / "a", 5000))) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == [b"abc" * 1000] * 4


@pytest.mark.parametrize("load", [load_model, load_network])
def test_a_model_that_is_no_regular_file_is_refused_at_once(tmp_path: Path, load: Callable[[Path], object]) -> None:
    os.mkfifo(tmp_path / "pipe.onnx")
    (tmp_path / "empty.onnx").write_bytes(b"")
    for name, words in (
        ("pipe.onnx", "cannot be read: is a named pipe, expected a regular file"),
        ("empty.onnx", "0 bytes; expected"),
        ("no.onnx", "no such file"),
    ):
        with pytest.raises(ConfigError, match=words):
            load(tmp_path / name)
    with pytest.raises(ConfigError, match="is a device"):
        load(Path("/dev/zero"))


def test_weights_that_are_no_regular_file_are_refused_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "models").mkdir()
    os.mkfifo(tmp_path / "models" / "frozen_inference_graph.pb")
    monkeypatch.setattr(
        "importlib.util.find_spec", lambda name: SimpleNamespace(submodule_search_locations=[str(tmp_path)])
    )
    with pytest.raises(ConfigError, match="is a named pipe"):
        ssd_mobilenet.graph_bytes()


def test_the_player_of_carla_reads_regular_files_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(player.ReplayError, match="is no regular file"):
        player.load_data(tmp_path / "pipe")
    monkeypatch.setattr(player, "MAX_TEXT_BYTES", 10)
    (tmp_path / "long").write_text("[1, 2, 3, 4]")
    with pytest.raises(player.ReplayError, match="has more than 10 bytes"):
        player.load_data(tmp_path / "long")
