"""Damage that is seen in the stamps and calibrations of a log is told in a line each, and sound logs get none."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import run
from log_encoders import kitti, kitti_object, nuscenes, pandaset
from log_encoders.world import make_world
from plain_settings import AGENTS_ALONE, AGENTS_ONLY
from worlds import tiny_log

from log2sim.config import Config
from log2sim.datatypes import ImageRegions, Log, Stream
from log2sim.errors import LogError, RecordError
from log2sim.export.xml_text import require_number
from log2sim.files.documents import parse_float, parse_int
from log2sim.geometry import NS_PER_S, Camera, PoseTrack
from log2sim.logs.checks import drop_impossible_labels, list_calibration_problems, list_time_problems, problems_of
from log2sim.logs.excerpt import cut_log
from log2sim.logs.native.reader import read_csv_table
from log2sim.logs.native.writer import write_log
from log2sim.logs.opening import open_log, validate_log
from log2sim.plan import select_sensors

LABELS = Config.load(detect={"name": "labels"}, **AGENTS_ALONE)


@cache
def sound() -> Log:
    return tiny_log(duration_s=4.0)[0]


def moved(t_ns: np.ndarray, seconds: float) -> np.ndarray:
    return t_ns + round(seconds * NS_PER_S)


def with_stamps(log: Log, name: str, t_ns: np.ndarray) -> Log:
    stream = Stream(name, t_ns, log.streams[name].read)
    return log.changed(streams={**log.streams, name: stream})


CLOCKS = {
    18.0: "GPS time against UTC",
    -37.0: "TAI against UTC",
    7200.0: "2 h, a time zone",
    -19800.0: "5.5 h, a time zone",
    -315964782.0: "seconds since 1980, as of GPS, against Unix time",
    2208988800.0: "seconds since 1900, as of NTP, against Unix time",
}


@pytest.mark.parametrize("seconds", CLOCKS)
def test_poses_of_another_clock_are_named_with_the_clock(seconds: float) -> None:
    log = sound()
    log = log.changed(ego=PoseTrack(moved(log.ego.t_ns, seconds + 0.05), log.ego.map_T_ego))
    (problem,) = list_time_problems(log)
    assert problem.startswith("the ego poses are from ")
    assert f"do not overlap (the difference is {abs(seconds):.5g}"[:35] in problem
    assert problem.endswith(f": {CLOCKS[seconds]}?)")
    with pytest.raises(LogError, match=r"tiny: the ego poses are from .* they do not overlap .*--poses lidar"):
        select_sensors(log, LABELS)


@pytest.mark.parametrize(
    ("factor", "words"), [(1000, "differ by 1000"), (10**6, "ms against ns"), (10**9, "s against ns")]
)
def test_stamps_of_other_units_are_recognized(factor: int, words: str) -> None:
    t_ns = sound().ego.t_ns
    small = np.unique(t_ns // factor)
    log = sound().changed(ego=PoseTrack(small, sound().ego.map_T_ego[: len(small)]))
    assert words in list_time_problems(log)[0]


@pytest.mark.parametrize("name", ["front", "top"])
def test_a_sensor_of_another_clock_is_named(name: str) -> None:
    log = with_stamps(sound(), name, moved(sound().streams[name].t_ns, 18.0))
    problems = list_time_problems(log)
    kind = "frames" if name == "front" else "sweeps"
    assert any(p.startswith(f"the {kind} of '{name}' are from") and "GPS time against UTC?" in p for p in problems)


@pytest.mark.parametrize(
    ("keep", "words"), [(slice(0, 21), "ends 2.0 s before"), (slice(20, None), "begins 1.9 s after")]
)
def test_a_reference_camera_that_covers_only_a_part_is_told(keep: slice, words: str) -> None:
    log = with_stamps(sound(), "front", sound().streams["front"].t_ns[keep]).changed(image_labels={})
    (problem,) = list_time_problems(log)
    assert problem.startswith(f"the reference camera 'front' {words} other sensors: a run of its ticks lasts ")
    assert problem.endswith(("2.0 s of the 4.0 s of the log", "1.9 s of the 3.9 s of the log"))


@pytest.mark.parametrize("lost", ["all", "some"])
def test_boxes_of_no_frame_are_counted(lost: str) -> None:
    log = sound()
    boxes = log.image_labels["front"]
    rows = np.arange(len(boxes.t_ns)) < (len(boxes.t_ns) if lost == "all" else 3)
    t_ns = np.where(rows, boxes.t_ns + 30_000_000, boxes.t_ns)
    regions = ImageRegions(t_ns[:5], boxes.box_px[:5])
    problems = list_time_problems(
        log.changed(image_labels={"front": replace(boxes, t_ns=t_ns)}, ignored_regions={"front": regions})
    )
    first = t_ns[rows].min()
    count = f"{rows.sum()} of {len(rows)} boxes in images of 'front' are at stamps of no frame, first {first}"
    assert problems[0] == count + ("; the nearest is 30 ms off" if lost == "all" else "")
    assert problems[1].startswith(f"{min(5, rows.sum())} of 5 ignored regions in images of 'front'")


# what is changed, words of the line, whether it is refused
CALIBRATIONS: dict[str, tuple[Callable[[Camera], dict[str, Any]], str, bool]] = {
    "fx in mm": (lambda c: {"K": c.K * np.array([[0.01, 1, 1], [1, 1, 1], [1, 1, 1]])}, "its focal length fx is ", True),
    "fy": (lambda c: {"K": c.K * np.array([[1, 1, 1], [1, 1e3, 1], [1, 1, 1]])}, "its focal length fy is ", True),
    "cx beside": (lambda c: {"K": c.K + np.array([[0, 0, 1000.0], [0, 0, 0], [0, 0, 0]])}, "its principal point cx is 1239.5 px, 759.5 px outside", False),
    "cx in widths": (lambda c: {"K": c.K * np.array([[1, 1, 1 / 480], [1, 1, 1], [1, 1, 1]])}, "its principal point cx is ", False),
    "cy above": (lambda c: {"K": c.K - np.array([[0, 0, 0], [0, 0, 300.0], [0, 0, 0]])}, "its principal point cy is ", False),
    "cy far": (lambda c: {"K": c.K + np.array([[0, 0, 0], [0, 0, -1e5], [0, 0, 0]])}, "its principal point cy is ", True),
    "mount in mm": (lambda c: {"mount_T_cam": c.mount_T_cam + 1700 * np.eye(4, k=3)}, "its mounting is 1701", True),
    "half folded": (lambda c: {"distortion_model": "brown", "distortion": (-1.6, 0.0, 0.0, 0.0)}, "of the pixels have no ray", True),
    "corners folded": (lambda c: {"distortion_model": "brown", "distortion": (-0.55, 0.0, 0.0, 0.0)}, "of the pixels have no ray", False),
}  # fmt: skip


@pytest.mark.parametrize("name", CALIBRATIONS)
def test_a_calibration_that_no_camera_has_is_named_by_its_field(name: str) -> None:
    change, words, refused = CALIBRATIONS[name]
    log = sound()
    front = replace(log.cameras["front"], **change(log.cameras["front"]))
    log = log.changed(cameras={**log.cameras, "front": front}, calibrations={"front": "calib.txt"})
    (problem,) = list_calibration_problems(log)
    assert problem.startswith("calib.txt, camera 'front': ")
    assert words in problem
    if refused:
        with pytest.raises(LogError) as caught:
            select_sensors(log, LABELS)
        assert str(caught.value) == problem
    else:
        assert select_sensors(log, LABELS).cameras == ("front",)
    # Told, too, where the camera is not used.
    assert select_sensors(log, Config.load(detect={"name": "lidar:vehicle"})).cameras == ()


@pytest.mark.slow
def test_reconstruct_inspect_and_validate_tell_the_same(log_folder: Path, tmp_path: Path) -> None:
    boxes = log_folder / "labels/boxes_2d.csv"
    lines = boxes.read_text().split("\n")
    lines[1] = str(int(lines[1].split(",")[0]) + 40_000_000) + "," + lines[1].split(",", 1)[1]
    lines[2] = lines[2].rsplit(",", 2)[0]
    boxes.write_text("\n".join(lines))
    total = len(lines) - 2
    moved_box = f"1 of {total - 1} boxes in images of 'front' are at stamps of no frame, first {lines[1].split(',')[0]}"
    cut_row = (
        f"1 of {total} rows of labels are damaged and left out, first: {boxes}, line 3: 5 fields, the header has 7"
    )
    told = {moved_box, cut_row}
    report = tmp_path / "r.json"
    command = f"reconstruct {log_folder} --out {tmp_path}/s.json --report {report} --detector labels"
    ran = run(command, *AGENTS_ONLY)
    assert ran.code == 0
    assert {f"note: {line}" for line in told} <= set(ran.out.splitlines())
    assert told <= set(json.loads(report.read_text())["log"]["notes"])
    assert told <= set(json.loads(run("inspect", log_folder, "--json").out)["notes"])
    ran = run("validate", log_folder)
    assert ran.code == 3
    assert all(line in ran.err for line in told)


def test_of_a_part_of_a_log_no_label_is_kept_that_is_far_from_it() -> None:
    log = sound()
    once = log.labels.t_ns[log.labels.track_id == log.labels.track_id[0]][0]
    rows = np.flatnonzero((log.labels.track_id != log.labels.track_id[0]) | (log.labels.t_ns == once))
    columns = {
        k: v[rows] for k, v in vars(log.labels).items() if isinstance(v, np.ndarray) and len(v) == len(log.labels.t_ns)
    }
    part = cut_log(log.changed(labels=replace(log.labels, **columns)), start_s=2.5, stop_s=3.0)
    assert log.labels.track_id[0] not in part.labels.track_id
    assert list_time_problems(part) == []


def test_no_pose_at_the_ticks_of_a_run_is_told_by_its_reason(tiny_folder: Path, tmp_path: Path) -> None:
    """The first half of the poses is lost, and the run takes the first ticks."""
    log = open_log(tiny_folder)
    later = log.ego.t_ns > log.streams["front"].t_ns[0] + NS_PER_S // 2
    part = log.changed(ego=PoseTrack(log.ego.t_ns[later], log.ego.map_T_ego[later]))
    write_log(part, tmp_path / "log")
    ran = run(f"reconstruct {tmp_path}/log --out {tmp_path}/s.json --detector labels --stop 0.1 --quiet")
    assert ran.code == 4
    assert "the ego poses are from 17" in ran.line
    assert "no ego poses" not in ran.line


Encode = Callable[[Log, Path], Path]


@cache
def short_world() -> Log:
    return make_world(duration_s=0.35)


@pytest.fixture
def encoded(tmp_path: Path) -> Callable[[Encode], Path]:
    return lambda encode: encode(short_world(), tmp_path / "log")


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
    unread, checked, whole = (drop_impossible_labels(log.changed(labels=labels, format="log2sim")) for _ in range(3))
    words = "1 label left out: no object is so large or so far away, or it has no size"
    assert words not in unread.notes  # labels that nobody asks for are not read
    assert checked.labels is not None
    assert (words in checked.notes) == (not row_is_kept)
    assert (words in validate_log(whole)) == (not row_is_kept)
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
    log = encoded(nuscenes.encode_world)
    assert not any("key frames" in note for note in open_log(log).notes)
    path = log / "v1.0-mini" / "sample.json"
    samples = json.loads(path.read_text())
    path.write_text(json.dumps([samples[0], *samples[2:]]))
    words = f"sample.json: 1 of the {len(samples)} key frames of the scene are missing"
    assert words in open_log(log).notes
