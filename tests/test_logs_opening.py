"""Opening a log reads its index, calibration and poses; images and sweeps are read on request."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import EntryPoints
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from worlds import tiny_log

from log2sim import registry
from log2sim.datatypes import Log
from log2sim.errors import LogError, RecordError
from log2sim.geometry import NS_PER_S, PoseTrack
from log2sim.logs.native.writer import write_log
from log2sim.logs.opening import open_log
from log2sim.logs.stamps import strictly_increasing
from log2sim.logs.summary import summarize

SWEEP_SUFFIXES = (".bin", ".npz", ".npy", ".pcd", ".gz")
_listeners: list[list[str]] = []


def _hook(event: str, arguments: tuple[Any, ...]) -> None:
    if event == "open" and isinstance(arguments[0], str):
        for listener in _listeners:
            listener.append(arguments[0])


sys.addaudithook(_hook)


@contextmanager
def opened_files() -> Iterator[list[str]]:
    """Names of the files that are opened within the block, by any library."""
    names: list[str] = []
    _listeners.append(names)
    try:
        yield names
    finally:
        _listeners.remove(names)


def pandaset(root: Path) -> Path:
    """A sequence of two sweeps whose files hold no table."""
    import simplejpeg

    pose = {"position": {"x": 0.0, "y": 0.0, "z": 0.0}, "heading": {"w": 1.0, "x": 0.0, "y": 0.0, "z": 0.0}}
    for folder in ("lidar", "camera/front_camera", "annotations/cuboids"):
        (root / folder).mkdir(parents=True)
    for folder in ("lidar", "camera/front_camera"):
        (root / folder / "poses.json").write_text(json.dumps([pose] * 2))
        (root / folder / "timestamps.json").write_text(json.dumps([1.5e9, 1.5e9 + 0.1]))
    (root / "camera/front_camera/intrinsics.json").write_text(json.dumps({"fx": 50, "fy": 50, "cx": 30, "cy": 20}))
    for k in range(2):
        image = simplejpeg.encode_jpeg(np.zeros((40, 60, 3), np.uint8))
        (root / f"camera/front_camera/{k:02d}.jpg").write_bytes(image)
        (root / f"lidar/{k:02d}.pkl.gz").write_bytes(b"no table")
        (root / f"annotations/cuboids/{k:02d}.pkl.gz").write_bytes(b"no table")
    return root


def test_a_native_log_opens_without_its_images_and_sweeps(tmp_path: Path) -> None:
    write_log(tiny_log(observe=False, duration_s=0.3)[0], tmp_path / "log")
    with opened_files() as names:
        log = open_log(tmp_path / "log")
    assert any(name.endswith("index.csv") for name in names)
    assert not [name for name in names if name.endswith((*SWEEP_SUFFIXES, ".jpg", ".png"))]
    with opened_files() as names:
        log.streams["top"].read(1)
    assert [Path(name).name for name in names if name.endswith(SWEEP_SUFFIXES)] == ["000001.npz"]


def test_a_pandaset_sequence_opens_without_sweeps_and_cuboids_and_names_a_bad_one_when_it_is_used(
    tmp_path: Path,
) -> None:
    root = pandaset(tmp_path / "007")
    with opened_files() as names:
        log = open_log(root)
    assert any(name.endswith("poses.json") for name in names)
    assert not [name for name in names if name.endswith(".gz")]
    # Without readable points the PandarGT has the stamps of the other LiDAR.
    np.testing.assert_array_equal(log.streams["pandargt"].t_ns, log.streams["pandar64"].t_ns)
    with pytest.raises(RecordError, match=r"lidar/00\.pkl\.gz"):
        log.streams["pandar64"].read(0)
    with pytest.raises(LogError, match=r"cuboids/00\.pkl\.gz"):
        _ = log.labels


@pytest.mark.real
@pytest.mark.parametrize("path", ["kitti_raw", "pandaset/002"])
def test_a_recorded_log_opens_without_its_sweeps(real_data: Path, path: str) -> None:
    with opened_files() as names:
        open_log(real_data / path)
    assert names
    assert not [name for name in names if name.endswith(SWEEP_SUFFIXES)]


def test_installed_packages_are_listed_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_log(tiny_log(observe=False, duration_s=0.3)[0], tmp_path / "log")
    asked, real = [], registry.installed

    def installed(kind: str) -> EntryPoints:
        asked.append(kind)
        return real(kind)

    monkeypatch.setattr(registry, "installed", installed)
    assert open_log(tmp_path / "log").format == "log2sim"
    assert asked == ["log"]


def test_stamps_far_from_all_others_are_left_out() -> None:
    stamps = np.array([3, 1, 0, 2, 2, 9], dtype=np.int64) * 10**8 + 1_700_000_000 * NS_PER_S
    stamps[[2, 5]] = 0, np.iinfo(np.int64).max
    rows, notes = strictly_increasing(stamps, "a")
    assert rows.tolist() == [1, 3, 0]
    assert notes[0] == "a: 2 of 6 records have stamps more than 1000000 s off the others, first 0; left out"
    assert len(notes) == 3
    assert strictly_increasing(stamps[:0], "a")[0].tolist() == []


def test_a_pose_of_another_time_does_not_hinder_a_summary() -> None:
    log, _ = tiny_log()
    assert log.ego is not None
    usual = summarize(log)["ego"]
    ego = PoseTrack(np.append(0, log.ego.t_ns), np.concatenate([log.ego.map_T_ego[:1], log.ego.map_T_ego]))
    found = summarize(log.changed(ego=ego))["ego"]
    assert found["records"] == usual["records"] + 1
    assert found["distance_m"] == pytest.approx(usual["distance_m"], abs=0.02)
    assert found["top_speed_mps"] == pytest.approx(usual["top_speed_mps"], rel=0.05)


def test_a_changed_log_leaves_what_is_deferred_unread() -> None:
    def unread() -> Any:
        raise AssertionError("was read")

    log = Log("a", "log2sim", {}, {}, {}, labels=unread, notes=unread)
    changed = log.changed(name="b", ground_z_ego_m=0.5)
    assert (changed.name, changed.ground_z_ego_m, changed.format, log.name) == ("b", 0.5, "log2sim", "a")
    with pytest.raises(AssertionError, match="was read"):
        _ = changed.labels
    with pytest.raises(TypeError, match="no field nam"):
        log.changed(nam="b")


@pytest.mark.slow
def test_a_folder_of_several_formats_says_which_else_it_holds(tmp_path: Path) -> None:
    log, _ = tiny_log()
    write_log(log, tmp_path / "logs/a")
    pandaset(tmp_path / "logs/007")
    opened = open_log(tmp_path / "logs")
    other = {"log2sim": "pandaset", "pandaset": "log2sim"}[opened.format]
    assert f"holds logs of other formats, too: {other}; --format chooses one" in opened.notes[0]
    assert open_log(tmp_path / "logs", format=other).format == other


@pytest.mark.parametrize("part", ["lidar", "lidar/00.pkl.gz", "camera/front_camera/00.jpg"])
def test_who_gives_a_part_of_a_log_is_told_its_folder(part: str, tmp_path: Path) -> None:
    root = pandaset(tmp_path / "007")
    with pytest.raises(LogError, match=re.escape(f"{root}, which it is in, holds logs of the format 'pandaset'")):
        open_log(root / part)


@pytest.mark.parametrize(
    ("file", "value", "expected"),
    [
        ("timestamps", 1e300, "a stamp in seconds below"),
        ("poses", {"x": 1e300, "y": 0.0, "z": 0.0}, "finite numbers up to"),
    ],
)
def test_numbers_that_no_place_or_time_has_are_refused(file: str, value: Any, expected: str, tmp_path: Path) -> None:
    root = pandaset(tmp_path / "007")
    path = root / f"lidar/{file}.json"
    rows = json.loads(path.read_text())
    rows[1] = value if file == "timestamps" else rows[1] | {"position": value}
    path.write_text(json.dumps(rows))
    with pytest.raises(LogError, match=rf"{file}\.json.*record 1: .*expected {expected}"):
        open_log(root)
