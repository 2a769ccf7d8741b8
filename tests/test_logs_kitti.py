"""KITTI readers: the calibration chain, the Mercator poses, the labels, on made-up and on recorded drives."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from log_encoders import kitti
from log_encoders.world import make_world

from log2sim.datatypes import Log
from log2sim.errors import LogError
from log2sim.geometry import apply, yaw_of
from log2sim.logs.opening import open_log

LABELS = (
    "0 -1 DontCare -1 -1 -10 1 1 9 9 -1000 -1000 -1000 -10 -1 -1 -1\n"
    "1 5 Van 0 1 -1.8 1 2 30 20 2.0 1.8 4.4 -4.5 1.8 13.4 -1.6\n"
    "2 6 Person_sitting 0 2 -1.8 1 2 30 20 1.2 0.6 0.8 2 1.8 9 0\n"
)


@cache
def short_world() -> Log:
    """Four frames."""
    return make_world(duration_s=0.35)


@pytest.fixture
def raw(tmp_path: Path) -> Path:
    return kitti.encode_raw(short_world(), tmp_path / "raw")


@pytest.fixture
def tracking(tmp_path: Path) -> Path:
    folder = kitti.encode_tracking(short_world(), tmp_path / "tracking", 7)
    (folder / "training" / "label_02" / "0007.txt").write_text(LABELS)
    return folder


def test_the_chain_of_matrices_gives_the_mounts_of_the_world(raw: Path) -> None:
    log = open_log(raw)
    camera, known = log.cameras["image_02"], short_world().cameras["front"]
    np.testing.assert_allclose(camera.K, known.K, atol=1e-6)
    np.testing.assert_allclose(camera.mount_T_cam, known.mount_T_cam, atol=1e-9)
    lidar = short_world().lidars["top"]
    np.testing.assert_allclose(log.lidars["velodyne"].mount_T_lidar, lidar.mount_T_lidar, atol=1e-9)


def test_both_layouts_have_the_same_rig_and_poses(raw: Path, tracking: Path) -> None:
    a, b = open_log(raw, format="kitti"), open_log(tracking, format="kitti-tracking")
    np.testing.assert_allclose(a.cameras["image_02"].mount_T_cam, b.cameras["image_02"].mount_T_cam, atol=1e-9)
    np.testing.assert_allclose(a.lidars["velodyne"].mount_T_lidar, b.lidars["velodyne"].mount_T_lidar, atol=1e-9)
    np.testing.assert_allclose(a.ego.map_T_ego, b.ego.map_T_ego, atol=1e-9)
    assert b.streams["image_02"].t_ns.tolist() == [0, 100_000_000, 200_000_000, 300_000_000]
    assert any("no stamps" in note for note in b.notes)


def test_labels_become_boxes_in_the_map(tracking: Path) -> None:
    log = open_log(tracking)
    labels = log.labels
    assert labels.category.tolist() == ["car", "pedestrian"]
    assert labels.kind.tolist() == ["Van", "Person_sitting"]
    assert labels.occlusion.tolist() == [1, 2]
    assert labels.never_labeled == ("bicycle",)
    assert labels.t_ns.tolist() == [100_000_000, 200_000_000]
    np.testing.assert_allclose(labels.size_m[0], [4.4, 1.8, 2.0])
    map_T_cam, _ = log.map_T_sensor("image_02", labels.t_ns[:1])
    expected = apply(map_T_cam[0] @ kitti.CAM_T_RECT, np.array([[-4.5, 1.8 - 1.0, 13.4]]))
    np.testing.assert_allclose(labels.center_m[:1], expected, atol=1e-9)
    # rotation_y = -1.6 points along the camera's axis, so the van drives in the ego's direction but for 0.03 rad and the mount.
    ego_yaw = yaw_of(log.ego.at(labels.t_ns[:1])[0])
    assert abs(labels.yaw_rad[0] - ego_yaw[0]) < 0.08
    assert log.image_labels["image_02"].box_px.tolist() == [[1, 2, 30, 20], [1, 2, 30, 20]]


def test_a_raw_drive_takes_the_labels_of_its_tracking_sequence_at_its_own_stamps(raw: Path, tracking: Path) -> None:
    """Both fixtures are one drive, so both have the same boxes, each at the stamps that it knows."""
    drive = next(raw.glob("*/*_sync"))
    (drive / "label_02.txt").unlink()
    plain = open_log(raw, format="kitti")
    assert (plain.labels, plain.ignored_regions) == (None, {})
    (drive / "label_02.txt").write_text(LABELS)
    a, b = open_log(raw, format="kitti"), open_log(tracking, format="kitti-tracking")
    np.testing.assert_allclose(a.labels.center_m, b.labels.center_m, atol=1e-9)
    np.testing.assert_allclose(a.labels.yaw_rad, b.labels.yaw_rad, atol=1e-12)
    assert a.labels.track_id.tolist() == ["5", "6"]
    stamps = a.streams["image_02"].t_ns
    assert a.labels.t_ns.tolist() == stamps[[1, 2]].tolist()
    assert a.ignored_regions["image_02"].t_ns.tolist() == stamps[[0]].tolist()
    assert a.labels.cameras == ("image_02",)
    assert a.digest != plain.digest
    (drive / "image_02" / "data" / f"{0:010d}.png").unlink()
    assert open_log(raw, format="kitti").labels.t_ns.tolist() == stamps[[1, 2]].tolist()
    edit(drive / "label_02.txt", "2 6 Person", "9 6 Person")
    with pytest.raises(LogError, match=r"label_02.txt: frame 9, but .*timestamps.txt has 4 lines"):
        open_log(raw, format="kitti")


def edit(file: Path, old: str, new: str) -> None:
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, 1))


@pytest.mark.parametrize(
    ("file", "old", "new", "words"),
    [
        ("calib_cam_to_cam.txt", "P_rect_02: ", "P_rect_02: -", "positive focal"),
        ("calib_cam_to_cam.txt", "P_rect_02", "P_rect_09", "no entry 'P_rect_02'"),
        ("calib_imu_to_velo.txt", "\nT: ", "\nT: nan ", "expected 3 finite"),
        ("calib_imu_to_velo.txt", "\nT: ", "\nT: 1 2 3\nT: ", "entry 'T' occurs twice"),
        ("2011_09_26_drive_0001_sync/oxts/data/0000000002.txt", "e+01", "x", "0000000002.txt, line 1"),
        ("2011_09_26_drive_0001_sync/image_02/timestamps.txt", "2023", "yesterday", "timestamps.txt, line 1"),
        ("2011_09_26_drive_0001_sync/oxts/timestamps.txt", "", "", "record 3 has none"),
    ],
)
def test_a_fault_of_a_drive_names_its_file(raw: Path, file: str, old: str, new: str, words: str) -> None:
    if not old:  # the last stamp
        old = (raw / "2011_09_26" / file).read_text().splitlines()[-1]
    edit(raw / "2011_09_26" / file, old, new)
    with pytest.raises(LogError, match=Path(file).name) as caught:
        open_log(raw)
    assert words in str(caught.value)


@pytest.mark.real
def test_the_recorded_drive_opens_with_its_real_stamps(real_data: Path) -> None:
    log = open_log(real_data / "kitti_raw")
    assert json.dumps(log.streams["image_02"].t_ns[:1].tolist()) == "[1317042272345808896]"
    assert log.streams["image_02"].read(0).shape == (375, 1242, 3)
    sweep = log.streams["velodyne"].read(0)
    assert np.ptp(sweep.t_ns) == pytest.approx(0.1033e9, rel=0.01)
    near = np.linalg.norm(sweep.xyz_m[:, :2], axis=1) < 12
    heights = apply(log.lidars["velodyne"].mount_T_lidar, sweep.xyz_m[near])[:, 2]
    assert abs(np.median(heights[heights < 0.4])) < 0.1


@pytest.mark.parametrize(
    "line",
    [
        "3 7 Spaceship 0 0",
        "3 7 Car 0 0 0 1 2 30 20 1.5",
        "3 7 Car 0 0 x 1 2 30 20 1 1 1 1 1 1 1",
        "2" * 30 + " 7 Car" + " 1" * 14,
        "3 7 Car" + " 1" * 17,
    ],
)
def test_a_damaged_label_line_is_left_out_and_counted(tracking: Path, line: str) -> None:
    file = tracking / "training" / "label_02" / "0007.txt"
    before = open_log(tracking)
    file.write_text(file.read_text() + line + "\n")
    log = open_log(tracking)
    assert log.labels.track_id.tolist() == before.labels.track_id.tolist()
    (note,) = set(log.notes) - set(before.notes)
    assert note.startswith(f"1 of 4 rows of labels are damaged and left out, first: {file}, line 4: ")
