"""Only regular files are read, and never more of them than a limit; everywhere a log, scenario or setting is opened."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from log2sim.config import Config
from log2sim.errors import ConfigError, LogError, RecordError, ScenarioError
from log2sim.export.xml_text import read as read_xml
from log2sim.files.documents import read_json
from log2sim.files.inputs import TooLargeError, read_bytes
from log2sim.logs.arrow import ParquetRows, read_columns
from log2sim.logs.kitti.labels import read_text as read_kitti_text
from log2sim.logs.native.reader import read_csv_table
from log2sim.logs.nuscenes.scene import scan_records
from log2sim.logs.pandaset.unpickle import read_pickled_table
from log2sim.logs.records import image_stream, read_sweep
from log2sim.logs.ros.bag import open_container
from log2sim.logs.ros.containers import ChunkedFile
from log2sim.logs.waymo.messages import RecordFile
from log2sim.synth.returns import lidar_model
from log2sim.synth.scene import load_scene

pytestmark = pytest.mark.skipif(os.name == "nt", reason="no named pipes there")
READERS: dict[str, tuple[str, type[Exception], Callable[[Path], Any]]] = {
    "json": ("a.json", LogError, read_json),
    "scenario": ("a.json", ScenarioError, lambda p: read_json(p, ScenarioError)),
    "config": ("a.toml", ConfigError, lambda p: Config.load(p)),
    "xosc": ("a.xosc", ScenarioError, read_xml),
    "image": ("a.png", RecordError, lambda p: image_stream("a", np.zeros(1, np.int64), [p], (4, 4)).read(0)),
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


def test_a_file_is_read_up_to_the_limit(tmp_path: Path) -> None:
    path = tmp_path / "a"
    for size in (0, 1, 9, 10):
        path.write_bytes(b"x" * size)
        assert read_bytes(path, 10) == b"x" * size
    path.write_bytes(b"x" * 11)
    with pytest.raises(TooLargeError, match="11 bytes, more than the 10 that it may have"):
        read_bytes(path, 10)
