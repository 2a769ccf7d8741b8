"""Files of logs that are missing, twice, no files at all, or state what cannot be: each is told or refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from log_encoders import kitti, kitti_object, nuscenes, pandaset
from log_encoders.world import make_world

from log2sim.datatypes import Log
from log2sim.errors import LogError, RecordError
from log2sim.export.xml_text import require_number
from log2sim.files.documents import parse_float, parse_int
from log2sim.logs.checks import drop_impossible_labels, problems_of
from log2sim.logs.native.reader import read_csv_table
from log2sim.logs.opening import open_log

Encode = Callable[[Log, Path], Path]


@cache
def short_world() -> Log:
    return make_world(duration_s=0.35)


@pytest.fixture
def encoded(tmp_path: Path) -> Callable[[Encode], Path]:
    return lambda encode: encode(short_world(), tmp_path / "log")


def encode_nuscenes(log: Log, folder: Path) -> Path:
    return nuscenes.encode_world(replace(log), folder)


@pytest.mark.parametrize(
    ("encode", "missing", "words"),
    [
        (kitti.encode_tracking, "*/velodyne/*/000001.bin", "velodyne: 1 of 4 records are missing, first number 000001"),
        (kitti.encode_tracking, "*/image_02/*/000003.png", "image_02: 1 of 4 records are missing, first number 000003"),
        (kitti_object.encode, "*/velodyne/000002.bin", "1 of 4 images have no sweep, first number 000002"),
        (
            pandaset.encode,
            "annotations/cuboids/01.pkl.gz",
            "annotations/cuboids: 1 of 3 files are missing, first number 01",
        ),
    ],
)
def test_records_that_are_not_there_are_told(
    encoded: Callable[[Encode], Path], encode: Encode, missing: str, words: str
) -> None:
    log = encoded(encode)
    assert not any("missing" in note or "no sweep" in note for note in open_log(log).notes)
    next(log.glob(missing)).unlink()
    assert words in open_log(log).notes


@pytest.mark.parametrize("text", ["1_000", "\u0663", "1\u0660", "\uff11", "0x10", "", "1,5"])
def test_only_ascii_digits_make_a_number(tmp_path: Path, text: str) -> None:
    for parse in (parse_float, parse_int):
        with pytest.raises(ValueError):
            parse(text)
    with pytest.raises(LogError):
        require_number(text, "here")
    table = tmp_path / "t.csv"
    for kind in ("int", "float"):
        table.write_text(f't_ns\n1\n"{text}"\n', encoding="utf-8")
        with pytest.raises(LogError, match="line 3, field 't_ns'"):
            read_csv_table(table, {"t_ns": kind})


@pytest.mark.parametrize(
    ("column", "value", "row_is_kept"),
    [("size_m", 1e308, False), ("size_m", -1.0, False), ("center_m", 2e9, False), ("size_m", 900.0, True)],
)
def test_labels_of_no_object_are_left_out_and_told(column: str, value: float, row_is_kept: bool) -> None:
    log = short_world()
    assert log.labels is not None
    assert drop_impossible_labels(log).notes == log.notes
    assert drop_impossible_labels(log).labels is log.labels
    changed = getattr(log.labels, column).copy()
    changed[2, 0] = value
    labels = replace(log.labels, **{column: changed})
    checked = drop_impossible_labels(log.changed(labels=labels))
    words = "1 label left out: no object is so large or so far away, or it has no size"
    assert (words in checked.notes) == (not row_is_kept)
    assert checked.labels is not None
    assert len(checked.labels.t_ns) == len(labels.t_ns) - (not row_is_kept)
    assert checked.labels.track_id.tolist() == np.delete(labels.track_id, [] if row_is_kept else [2]).tolist()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("value", [1e308, np.nan, np.inf, -1e7])
def test_lenses_that_bend_without_limit_are_impossible(value: float) -> None:
    log = short_world()
    camera = replace(log.cameras["front"], distortion_model="brown", distortion=(0.1, value, 0.0, 0.0))
    ((message, is_impossible),) = problems_of(log.changed(cameras={"front": camera}), "front")
    assert is_impossible
    assert "its distortion has the coefficient" in message


def test_a_png_whose_header_is_damaged_does_not_size_the_camera(encoded: Callable[[Encode], Path]) -> None:
    log = encoded(kitti.encode_tracking)
    size_px = open_log(log).cameras["image_02"].width_px
    first = next(log.glob("*/image_02/*/000000.png"))
    data = bytearray(first.read_bytes())
    data[18] ^= 1
    first.write_bytes(data)
    opened = open_log(log)
    assert opened.cameras["image_02"].width_px == size_px
    with pytest.raises(RecordError, match="the check sum of the PNG header is wrong"):
        opened.streams["image_02"].read(0)


def test_key_frames_that_are_missing_are_told(encoded: Callable[[Encode], Path]) -> None:
    log = encoded(encode_nuscenes)
    assert not any("key frames" in note for note in open_log(log).notes)
    path = log / "v1.0-mini" / "sample.json"
    samples = json.loads(path.read_text())
    path.write_text(json.dumps([samples[0], *samples[2:]]))
    words = f"sample.json: 1 of the {len(samples)} key frames of the scene are missing"
    assert words in open_log(log).notes
