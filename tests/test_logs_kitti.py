"""KITTI readers: the calibration chain, the Mercator poses, the labels, on made-up and on recorded drives."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from log2sim.errors import LogError
from log2sim.geometry import apply, inverse, project, rotation_from_rpy, yaw_of
from log2sim.logs.kitti.labels import EGO_T_IMU
from log2sim.logs.opening import open_log

FRAMES = 4
R_VELO = rotation_from_rpy(0.01, -0.02, 0.03)
R_CAM = rotation_from_rpy(-np.pi / 2, 0.005, -np.pi / 2 + 0.01).T
R_RECT = rotation_from_rpy(0.004, -0.003, 0.002)
T_VELO, T_CAM = np.array([-0.8, 0.3, -0.8]), np.array([0.01, -0.08, -0.27])
P2 = np.array([[700.0, 0, 30, 45.0], [0, 700, 20, 0.2], [0, 0, 1, 0.003]])


def numbers(values: np.ndarray) -> str:
    return " ".join(f"{v:.12e}" for v in np.asarray(values).ravel())


def oxts_line(k: int) -> str:
    return numbers(np.array([49.0 + 1e-5 * k, 8.4 + 2e-5 * k, 110.0 + 0.1 * k, 0.01, -0.02, 0.7 + 0.1 * k, *range(24)]))


def stamp(k: float) -> str:
    return f"2011-09-26 13:04:32.{round(k * 100_000_000) + 123_456_789:09d}"


def write_image(path: Path) -> None:
    import simplejpeg

    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(simplejpeg.encode_jpeg(np.full((40, 60, 3), 90, np.uint8), colorspace="BGR"))


def write_points(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.array([[10, 0, 0, 1], [0, 10, 0, 1], [0, -10, 0, 1]], dtype=np.float32).tofile(path)


@pytest.fixture
def raw(tmp_path: Path) -> Path:
    date = tmp_path / "2011_09_26"
    drive = date / "2011_09_26_drive_0001_sync"
    for k in range(FRAMES):
        write_image(drive / "image_02" / "data" / f"{k:010d}.jpg")
        write_points(drive / "velodyne_points" / "data" / f"{k:010d}.bin")
        (drive / "oxts" / "data").mkdir(parents=True, exist_ok=True)
        (drive / "oxts" / "data" / f"{k:010d}.txt").write_text(oxts_line(k) + "\n")
    for name in (
        "image_02/timestamps",
        "oxts/timestamps",
        *(f"velodyne_points/timestamps{e}" for e in ("", "_start", "_end")),
    ):
        shift = {"_start": -0.5, "_end": 0.5}.get(name.removeprefix("velodyne_points/timestamps"), 0)
        lines = (stamp(k + 1 + shift) for k in range(FRAMES))
        (drive / f"{name}.txt").write_text("\n".join(lines) + "\n")
    (date / "calib_imu_to_velo.txt").write_text(f"calib_time: x\nR: {numbers(R_VELO)}\nT: {numbers(T_VELO)}\n")
    (date / "calib_velo_to_cam.txt").write_text(f"calib_time: x\nR: {numbers(R_CAM)}\nT: {numbers(T_CAM)}\n")
    (date / "calib_cam_to_cam.txt").write_text(
        f"calib_time: x\nS_rect_02: 60 40\nR_rect_00: {numbers(R_RECT)}\nP_rect_02: {numbers(P2)}\n"
    )
    return tmp_path


@pytest.fixture
def tracking(tmp_path: Path) -> Path:
    base = tmp_path / "training"
    for k in range(FRAMES):
        write_image(base / "image_02" / "0007" / f"{k:06d}.png")
        write_points(base / "velodyne" / "0007" / f"{k:06d}.bin")
    for name in ("oxts", "calib", "label_02"):
        (base / name).mkdir()
    (base / "oxts" / "0007.txt").write_text("\n".join(oxts_line(k) for k in range(FRAMES)) + "\n")
    (base / "calib" / "0007.txt").write_text(
        f"P2: {numbers(P2)}\nR_rect {numbers(R_RECT)}\nTr_velo_cam {numbers(np.c_[R_CAM, T_CAM])}\n"
        f"Tr_imu_velo {numbers(np.c_[R_VELO, T_VELO])}\n"
    )
    (base / "label_02" / "0007.txt").write_text(
        "0 -1 DontCare -1 -1 -10 1 1 9 9 -1000 -1000 -1000 -10 -1 -1 -1\n"
        "1 5 Van 0 1 -1.8 1 2 30 20 2.0 1.8 4.4 -4.5 1.8 13.4 -1.6\n"
        "2 6 Person_sitting 0 2 -1.8 1 2 30 20 1.2 0.6 0.8 2 1.8 9 0\n"
    )
    return tmp_path


def test_a_point_lands_where_the_chain_of_matrices_puts_it(raw: Path) -> None:
    """P_rect R_rect T_cam_velo T_velo_imu, multiplied out with plain 4x4 matrices, against our mounts and our camera."""
    log = open_log(raw)
    point_ego = np.array([[12.0, 1.5, 0.8], [20.0, -4.0, 1.0]])
    homogeneous = np.c_[point_ego - EGO_T_IMU[:3, 3], np.ones(2)].T
    velo_T_imu, cam_T_velo, rect = np.eye(4), np.eye(4), np.eye(4)
    velo_T_imu[:3] = np.c_[R_VELO, T_VELO]
    cam_T_velo[:3] = np.c_[R_CAM, T_CAM]
    rect[:3, :3] = R_RECT
    pixels = P2 @ rect @ cam_T_velo @ velo_T_imu @ homogeneous
    camera = log.cameras["image_02"]
    uv, _ = project(camera, apply(inverse(camera.mount_T_cam), point_ego))
    np.testing.assert_allclose(uv, (pixels[:2] / pixels[2]).T, atol=1e-6)
    point_velo = (velo_T_imu @ homogeneous)[:3].T
    np.testing.assert_allclose(apply(log.lidars["velodyne"].mount_T_lidar, point_velo), point_ego, atol=1e-9)


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
    baseline = np.linalg.solve(P2[:, :3], P2[:, 3])
    expected = apply(map_T_cam[0], np.array([[-4.5, 1.8 - 1.0, 13.4]]) + baseline)
    np.testing.assert_allclose(labels.center_m[:1], expected, atol=1e-9)
    # rotation_y = -1.6 points along the camera's axis, so the van drives in the ego's direction but for 0.03 rad and the mount.
    ego_yaw = yaw_of(log.ego.at(labels.t_ns[:1])[0])
    assert abs(labels.yaw_rad[0] - ego_yaw[0]) < 0.08
    assert log.image_labels["image_02"].box_px.tolist() == [[1, 2, 30, 20], [1, 2, 30, 20]]


def test_a_raw_drive_takes_the_labels_of_its_tracking_sequence_at_its_own_stamps(raw: Path, tracking: Path) -> None:
    """Both fixtures are one drive, so both have the same boxes, each at the stamps that it knows."""
    drive = next(raw.glob("*/*_sync"))
    plain = open_log(raw, format="kitti")
    assert (plain.labels, plain.ignored_regions) == (None, {})
    (drive / "label_02.txt").write_text((tracking / "training" / "label_02" / "0007.txt").read_text())
    a, b = open_log(raw, format="kitti"), open_log(tracking, format="kitti-tracking")
    np.testing.assert_allclose(a.labels.center_m, b.labels.center_m, atol=1e-9)
    np.testing.assert_allclose(a.labels.yaw_rad, b.labels.yaw_rad, atol=1e-12)
    assert a.labels.track_id.tolist() == ["5", "6"]
    stamps = a.streams["image_02"].t_ns
    assert a.labels.t_ns.tolist() == stamps[[1, 2]].tolist()
    assert a.ignored_regions["image_02"].t_ns.tolist() == stamps[[0]].tolist()
    assert a.labels.cameras == ("image_02",)
    assert a.digest != plain.digest
    (drive / "image_02" / "data" / f"{0:010d}.jpg").unlink()
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
        ("calib_cam_to_cam.txt", "P_rect_02: 7", "P_rect_02: 0", "positive focal"),
        ("calib_cam_to_cam.txt", "P_rect_02", "P_rect_09", "no entry 'P_rect_02'"),
        ("calib_imu_to_velo.txt", "T: -8", "T: nan -8", "expected 3 finite"),
        ("calib_imu_to_velo.txt", "T: -8", "T: 1 2 3\nT: -8", "entry 'T' occurs twice"),
        ("2011_09_26_drive_0001_sync/oxts/data/0000000002.txt", "4.9", "x", "0000000002.txt, line 1"),
        ("2011_09_26_drive_0001_sync/image_02/timestamps.txt", "2011-09-26", "yesterday", "timestamps.txt, line 1"),
        ("2011_09_26_drive_0001_sync/oxts/timestamps.txt", stamp(4), "", "record 3 has none"),
    ],
)
def test_a_fault_of_a_drive_names_its_file(raw: Path, file: str, old: str, new: str, words: str) -> None:
    if "focal" in words:
        old, new = numbers(P2[0]), numbers(np.array([-700.0, 0, 30, 45]))
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
