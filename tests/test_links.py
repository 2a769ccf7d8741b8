"""Paths and links of a log stay in its folders, unless links are followed."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest
from command_line import run
from log_encoders import argoverse, kitti, kitti_object, native, nuscenes, pandaset, ros, waymo, waymo_parquet
from log_encoders.world import world_log

from log2sim.datatypes import Log
from log2sim.errors import LogError
from log2sim.files.inputs import inside
from log2sim.logs.opening import open_log


@pytest.fixture
def log_folder(tmp_path: Path) -> Path:
    """A log folder with a sibling whose name begins alike."""
    root = tmp_path / "log"
    (root / "images").mkdir(parents=True)
    (root / "images" / "0.png").write_bytes(b"x")
    (tmp_path / "log-secret").mkdir()
    (tmp_path / "log-secret" / "key").write_bytes(b"y")
    return root


@pytest.mark.parametrize(
    "relative",
    [
        "..",
        "../log-secret/key",
        "images/../../log-secret/key",
        "../log/../log-secret/key",
        "/etc/passwd",
        "images/" + "../" * 40,
    ],
)
def test_paths_that_leave_a_log_are_refused(log_folder: Path, relative: str) -> None:
    with pytest.raises(LogError, match=r"^front\.csv row 3: path .* leaves the log folder; use a path relative"):
        inside(log_folder, relative, "front.csv row 3")


def test_symbolic_links_may_stay_inside_but_not_leave(log_folder: Path) -> None:
    (log_folder / "same").symlink_to(log_folder / "images")
    assert inside(log_folder, "same/0.png", "log.json") == log_folder / "images" / "0.png"
    (log_folder / "out").symlink_to(log_folder.parent / "log-secret")
    (log_folder / "key").symlink_to("../log-secret/key")
    for relative in ("out/key", "out", "key", "images/../out/key"):
        with pytest.raises(LogError, match="leaves the log folder"):
            inside(log_folder, relative, "log.json")


# How a log is written, and which of its files becomes a link.
FORMATS: dict[str, tuple[Callable[[Log, Path], Path], str]] = {
    "log2sim": (native.encode, "front/*.jpg"),
    "kitti": (kitti.encode_raw, "*/*/image_02/data/*"),
    "kitti-tracking": (kitti.encode_tracking, "*/velodyne/*/*"),
    "kitti-object": (kitti_object.encode, "*/label_2/*"),
    "pandaset": (pandaset.encode, "lidar/poses.json"),
    "argoverse2": (argoverse.encode, "sensors/lidar/*.feather"),
    "waymo-parquet": (waymo_parquet.encode, "vehicle_pose/*.parquet"),
    "ros": (lambda log, folder: ros.encode_as(log, folder, ros.Style("bag")).parent, "*.bag"),
    "ros database": (lambda log, folder: ros.encode_as(log, folder, ros.Style("db3")), "*.db3"),
    "nuscenes poses": (nuscenes.encode_world, "v1.0-mini/ego_pose.json"),
    "waymo": (lambda log, folder: waymo.encode(log, folder).parent, "*.tfrecord"),
    "log2sim manifest": (native.encode, "log.json"),
}


@pytest.mark.matrix
@pytest.mark.parametrize("name", FORMATS)
def test_a_link_to_another_file_needs_the_option_in_every_format(tmp_path: Path, name: str) -> None:
    encode, pattern = FORMATS[name]
    path = encode(world_log(), tmp_path / "base")
    file = sorted(path.glob(pattern))[0]
    secret = tmp_path / f"secret{file.suffix}"
    os.replace(file, secret)
    file.symlink_to(secret)
    with pytest.raises(LogError, match=r"leaves the log folder.*pass --follow-links"):
        open_log(path)
    assert open_log(path, follow_links=True).streams
    alias = tmp_path / "alias" / path.name
    alias.parent.mkdir()
    alias.symlink_to(path)
    file.unlink()
    os.replace(secret, file)
    assert open_log(alias).streams


def test_the_option_of_the_command_line(tmp_path: Path) -> None:
    path = pandaset.encode(world_log(), tmp_path / "base")
    stamps = path / "lidar" / "timestamps.json"
    os.replace(stamps, tmp_path / "secret.json")
    stamps.symlink_to(tmp_path / "secret.json")
    refused = run("inspect", path)
    assert refused.code == 3
    assert "pass --follow-links" in refused.line
    assert run("inspect", path, "--follow-links").code == 0
