"""Files of logs that are missing, twice, no files at all, or state what cannot be: each is told or refused."""

from __future__ import annotations

import json
import os
import re
import shutil
import zlib
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from log_encoders import kitti, kitti_object, native, nuscenes, pandaset, ros, waymo, waymo_parquet
from log_encoders.world import make_world

from log2sim.datatypes import Log, Scenario, Sweep
from log2sim.errors import LogError, RecordError, ScenarioError
from log2sim.export.exporters import Options, export
from log2sim.export.openscenario.read import load
from log2sim.export.xml_text import require_number
from log2sim.files.documents import parse_float, parse_int
from log2sim.geometry import PoseTrack
from log2sim.logs.checks import problems_of, without_impossible_labels
from log2sim.logs.native.reader import read_csv_table
from log2sim.logs.opening import open_log
from log2sim.logs.records import guard_log, sweep_of
from log2sim.perception.lidar.cloud import assemble_cloud

Encode = Callable[[Log, Path], Path]


@cache
def short_world() -> Log:
    return make_world(duration_s=0.35)


@pytest.fixture
def encoded(tmp_path: Path) -> Callable[[Encode], Path]:
    return lambda encode: encode(short_world(), tmp_path / "log")


def encode_db3(log: Log, folder: Path) -> Path:
    return ros.encode_as(log, folder, ros.Style(container="db3"))


def encode_nuscenes(log: Log, folder: Path) -> Path:
    return nuscenes.encode_world(replace(log), folder)


@pytest.mark.matrix
@pytest.mark.parametrize(
    ("encode", "name"),
    [
        (encode_db3, "metadata.yaml"),
        (encode_db3, "*.db3"),
        (encode_nuscenes, "v1.0-mini/log.json"),
        (encode_nuscenes, "v1.0-mini/scene.json"),
        (encode_nuscenes, "v1.0-mini/ego_pose.json"),
        (waymo.encode, "*.tfrecord"),
        (native.encode, "log.json"),
    ],
    ids=["metadata", "database", "small table", "scenes", "large table", "tfrecord", "manifest"],
)
def test_a_file_that_links_out_of_the_log_is_refused(
    encoded: Callable[[Encode], Path], tmp_path: Path, encode: Encode, name: str
) -> None:
    log = encoded(encode)
    root = log.parent if log.is_file() else log
    file = next(root.glob(name))
    target = tmp_path / f"secret{file.suffix}"
    shutil.move(file, target)
    file.symlink_to(target)
    with pytest.raises(LogError, match=r"is a link that leaves the log folder, to .*; pass --follow-links"):
        open_log(root)
    assert open_log(root, follow_links=True).streams


def test_pipes_in_the_place_of_labels_are_no_missing_labels(encoded: Callable[[Encode], Path]) -> None:
    log = encoded(kitti_object.encode)
    label = log / "training" / "label_2" / "000002.txt"
    label.unlink()
    os.mkfifo(label)
    with pytest.raises(LogError, match=r"000002\.txt: cannot be read: is a named pipe"):
        open_log(log)
    label.unlink()
    assert open_log(log).labels is not None  # test splits have no labels


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


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda table: np.repeat(np.arange(len(table)), 2),
            "3 cuboids left out: their sweep has another one of the same uuid",
        ),
        ("dimensions.z", "1 cuboids left out: a side of them is 0 or less"),
    ],
)
def test_cuboids_that_stand_twice_or_are_flat_are_told(
    encoded: Callable[[Encode], Path], change: Callable[[object], np.ndarray] | str, words: str
) -> None:
    pandas = pytest.importorskip("pandas")
    log = encoded(pandaset.encode)
    assert words not in open_log(log).notes
    path = log / "annotations" / "cuboids" / "00.pkl.gz"
    table = pandas.read_pickle(path)
    if isinstance(change, str):
        table.loc[0, change] = -1.0
    else:
        table = table.iloc[change(table)]
    table.to_pickle(path)
    assert words in open_log(log).notes


def test_a_sweep_whose_sensors_are_words_is_a_record_error(encoded: Callable[[Encode], Path]) -> None:
    pandas = pytest.importorskip("pandas")
    log = encoded(pandaset.encode)
    path = log / "lidar" / "00.pkl.gz"
    table = pandas.read_pickle(path)
    table["d"] = table["d"].astype(object)
    table.loc[0, "d"] = "x"
    table.to_pickle(path)
    with pytest.raises(RecordError, match="then t and d are float64, float64 and object, expected numbers"):
        open_log(log).streams["pandar64"].read(0)


def test_a_scanner_without_the_angles_of_its_beams_is_told(encoded: Callable[[Encode], Path]) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    log = encoded(waymo_parquet.encode)
    path = next((log / "lidar_calibration").iterdir())
    words = "the calibration lacks the inclinations of the TOP LiDAR's beams"
    assert not any(words in note for note in open_log(log).notes)
    table = parquet.read_table(path)
    parquet.write_table(table.drop_columns([n for n in table.column_names if n.endswith("inclination.values")]), path)
    assert any(words in note for note in open_log(log).notes)


@pytest.mark.parametrize("value", [np.nan, np.inf, -1e300])
def test_an_ego_nowhere_on_earth_is_refused(value: float) -> None:
    log = short_world()
    assert log.ego is not None
    poses = log.ego.map_T_ego.copy()
    poses[3, 1, 3] = value
    with pytest.raises(
        LogError, match=rf"^here: the position of the ego at stamp {log.ego.t_ns[3]} is .* 1 of \d+ poses"
    ):
        guard_log(log.changed(ego=PoseTrack(log.ego.t_ns, poses)), "here")


@pytest.mark.filterwarnings("error")
def test_points_nowhere_on_earth_are_dropped() -> None:
    xyz = np.array([[1.0, 2.0, 3.0], [1e300, 0.0, 0.0], [0.0, np.nan, 0.0], [0.0, 0.0, -2e9], [4.0, 5.0, 6.0]])
    sweep = sweep_of(xyz, 0, np.arange(5), "lidar")
    np.testing.assert_array_equal(sweep.xyz_m, xyz[[0, 4]])
    assert sweep.t_ns is not None
    np.testing.assert_array_equal(sweep.t_ns, [0, 4])


@pytest.mark.filterwarnings("error")
def test_points_high_above_the_range_are_left_out_of_a_cloud() -> None:
    log = short_world()
    stamp = int(log.streams["top"].t_ns[1])
    sound = log.streams["top"].read(1).xyz_m.astype(np.float64)
    high = np.concatenate([sound, [[5.0, 0.0, 8e8], [5.0, 1.0, -8e8]]])
    clouds = [
        assemble_cloud(
            log,
            {"top": Sweep(stamp, xyz, "lidar", None)},
            origin=np.array([30.0, -20.0, 0.0]),
            ground_z=0.0,
            max_range_m=60.0,
        )
        for xyz in (sound, high)
    ]
    assert clouds[0] is not None
    assert clouds[1] is not None
    np.testing.assert_array_equal(clouds[1].xyz, clouds[0].xyz)
    np.testing.assert_array_equal(clouds[1].height, clouds[0].height)


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


@given(st.integers(-(10**40), 10**40))
def test_whole_numbers_are_parsed(value: int) -> None:
    assert parse_int(str(value)) == value


@given(st.floats(allow_nan=False))
def test_numbers_are_parsed(value: float) -> None:
    assert parse_float(repr(value)) == value


@pytest.mark.parametrize(
    ("column", "value", "row_is_kept"),
    [("size_m", 1e308, False), ("size_m", -1.0, False), ("center_m", 2e9, False), ("size_m", 900.0, True)],
)
def test_labels_of_no_object_are_left_out_and_told(column: str, value: float, row_is_kept: bool) -> None:
    log = short_world()
    assert log.labels is not None
    assert without_impossible_labels(log).notes == log.notes
    assert without_impossible_labels(log).labels is log.labels
    changed = getattr(log.labels, column).copy()
    changed[2, 0] = value
    labels = replace(log.labels, **{column: changed})
    checked = without_impossible_labels(log.changed(labels=labels))
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
    problems = list(problems_of(log.changed(cameras={"front": camera}), "front"))
    assert [p.is_impossible for p in problems] == [True]
    assert "its distortion has the coefficient" in problems[0].message


@pytest.mark.parametrize("width_px", [0, 10_000_000])
def test_a_first_image_of_an_impossible_size_does_not_size_the_camera(
    encoded: Callable[[Encode], Path], width_px: int
) -> None:
    log = encoded(kitti.encode_tracking)
    size_px = open_log(log).cameras["image_02"].width_px
    first = next(log.glob("*/image_02/*/000000.png"))
    data = bytearray(first.read_bytes())
    data[16:20] = width_px.to_bytes(4, "big")
    data[29:33] = zlib.crc32(data[12:29]).to_bytes(4, "big")
    first.write_bytes(data)
    opened = open_log(log)
    assert opened.cameras["image_02"].width_px == size_px
    with pytest.raises(RecordError, match=rf"{width_px}x300 px, expected 1 to \d+ px"):
        opened.streams["image_02"].read(0)
    assert opened.streams["image_02"].read(1).shape == (300, size_px, 3)


@pytest.mark.parametrize("field", [3, 5, 10, 13, 16])
def test_label_lines_with_numbers_beyond_all_are_left_out(encoded: Callable[[Encode], Path], field: int) -> None:
    log = encoded(kitti.encode_tracking)
    path = next(log.glob("*/label_02/*.txt"))
    lines = path.read_text().splitlines()
    words = lines[1].split()
    words[field] = "-1e308"
    path.write_text("\n".join([lines[0], " ".join(words), *lines[2:]]) + "\n")
    assert any("line 2" in note and "not finite, or larger than" in note for note in open_log(log).notes)


def test_a_word_in_an_entry_that_may_be_missing_is_refused(encoded: Callable[[Encode], Path]) -> None:
    log = encoded(kitti_object.encode)
    path = log / "training" / "calib" / "000000.txt"
    sound = path.read_text()
    path.write_text(sound.replace("Tr_imu_to_velo: ", "Tr_imu_to_velo: x"))
    with pytest.raises(LogError, match="entry 'Tr_imu_to_velo': 0 numbers, expected 12 finite ones"):
        open_log(log)
    path.write_text(f"calib_time: 09-Jan-2012\n{sound}")
    assert open_log(log).streams


def test_images_without_times_of_their_exposure_are_told(encoded: Callable[[Encode], Path]) -> None:
    pyarrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    log = encoded(waymo_parquet.encode)
    assert not any("times of their exposure" in note for note in open_log(log).notes)
    path = next((log / "camera_image").iterdir())
    table = parquet.read_table(path)
    name = next(n for n in table.column_names if n.endswith("camera_trigger_time"))
    values = table[name].to_pylist()
    table = table.set_column(table.column_names.index(name), name, pyarrow.array([values[0], np.nan, *values[2:]]))
    parquet.write_table(table, path)
    words = f"FRONT: 1 of {len(values)} images without the times of their exposure: those of their poses are taken"
    assert words in open_log(log).notes


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


@pytest.mark.parametrize(
    "line", ["2011-09-26", "2011-09-26 13", "2011-09-26 13:02", "2011-09-26 13:02:2", "13:02:25.9"]
)
def test_a_stamp_that_is_cut_is_no_stamp(encoded: Callable[[Encode], Path], line: str) -> None:
    log = encoded(kitti.encode_raw)
    path = next(log.glob("*/*/image_02/timestamps.txt"))
    path.write_text("\n".join([line, *path.read_text().splitlines()[1:]]) + "\n")
    with pytest.raises(LogError, match=r"timestamps\.txt, line 1: .*, expected YYYY-MM-DD HH:MM:SS"):
        open_log(log)


@pytest.mark.parametrize("field", [2, 3, 5, 29])
def test_a_record_of_the_imu_with_a_number_beyond_all_is_refused(encoded: Callable[[Encode], Path], field: int) -> None:
    log = encoded(kitti.encode_tracking)
    path = next(log.glob("*/oxts/*.txt"))
    lines = path.read_text().splitlines()
    words = lines[2].split()
    words[field] = "-9223372036854775808"
    path.write_text("\n".join([*lines[:2], " ".join(words), *lines[3:]]) + "\n")
    with pytest.raises(LogError, match="line 3: expected 30 finite numbers"):
        open_log(log)


@pytest.mark.parametrize("rest", ["Tr_im", "Tr_imu_to_velo:"])
def test_a_calibration_that_ends_within_a_key_is_refused(encoded: Callable[[Encode], Path], rest: str) -> None:
    log = encoded(kitti_object.encode)
    path = log / "training" / "calib" / "000000.txt"
    sound = path.read_text()
    path.write_text(sound.partition("Tr_imu_to_velo")[0] + rest)
    with pytest.raises(LogError, match=r"nothing follows 'Tr_im.*'; expected numbers"):
        open_log(log)
    path.write_text(f"\n{sound}\n\n")
    assert open_log(log).streams


def test_sweeps_that_end_before_they_face_forward_are_told(encoded: Callable[[Encode], Path]) -> None:
    log = encoded(kitti.encode_raw)
    assert open_log(log).notes == ()
    path = next(log.glob("*/*/velodyne_points/timestamps_end.txt"))
    lines = path.read_text().splitlines()
    path.write_text("\n".join([lines[0], *lines]) + "\n")
    assert any("3 of 4 sweeps face forward at a stamp before their start or after" in n for n in open_log(log).notes)


@pytest.mark.parametrize("number", [0, 3])
def test_one_image_of_another_size_does_not_size_the_camera(encoded: Callable[[Encode], Path], number: int) -> None:
    log = encoded(kitti.encode_tracking)
    file = next(log.glob(f"*/image_02/*/{number:06d}.png"))
    cv2.imwrite(str(file), np.zeros((75, 240, 3), np.uint8))
    opened = open_log(log)
    assert (opened.cameras["image_02"].width_px, opened.cameras["image_02"].height_px) == (480, 300)
    with pytest.raises(RecordError, match="240x75 px, the calibration is for 480x300"):
        opened.streams["image_02"].read(number)


@pytest.mark.parametrize("text", ["NaN", "11\u0661", "1 0", "102"])
def test_marks_of_an_openscenario_file_are_0_and_1(tiny_scenario: Path, tmp_path: Path, text: str) -> None:
    export(Scenario.load(tiny_scenario), "openscenario", tmp_path / "x", Options())
    file = next((tmp_path / "x").glob("*.xosc"))
    sound = file.read_text(encoding="utf-8")
    file.write_text(re.sub(r'(log2sim\.observed" value=")[01]+', rf"\g<1>{text}", sound, count=1), encoding="utf-8")
    with pytest.raises(ScenarioError, match=r"property log2sim\.observed is .*, expected 0 and 1 alone"):
        load(file)


def test_key_frames_that_are_missing_are_told(encoded: Callable[[Encode], Path]) -> None:
    log = encoded(encode_nuscenes)
    assert not any("key frames" in note for note in open_log(log).notes)
    path = log / "v1.0-mini" / "sample.json"
    samples = json.loads(path.read_text())
    path.write_text(json.dumps([samples[0], *samples[2:]]))
    words = f"sample.json: 1 of the {len(samples)} key frames of the scene are missing"
    assert words in open_log(log).notes


@pytest.mark.parametrize("text", ["-9223372036854775808", "1e7"])
def test_headings_of_an_openscenario_file_are_radians(tiny_scenario: Path, tmp_path: Path, text: str) -> None:
    export(Scenario.load(tiny_scenario), "openscenario", tmp_path / "x", Options())
    file = next((tmp_path / "x").glob("*.xosc"))
    sound = file.read_text(encoding="utf-8")
    file.write_text(re.sub(r' h="[^"]+"', f' h="{text}"', sound), encoding="utf-8")
    with pytest.raises(ScenarioError, match=r"WorldPosition h is .*, expected radians"):
        load(file)


def test_calibrations_without_an_imu_are_told(encoded: Callable[[Encode], Path]) -> None:
    log = encoded(kitti_object.encode)
    assert not any("Tr_imu_to_velo" in note for note in open_log(log).notes)
    path = log / "training" / "calib" / "000001.txt"
    path.write_text("".join(line for line in path.read_text().splitlines(keepends=True) if "imu" not in line))
    count = len(list(path.parent.iterdir()))
    words = f"1 of {count} calibrations have no entry 'Tr_imu_to_velo', first 000001.txt"
    assert any(note.startswith(words) for note in open_log(log).notes)
