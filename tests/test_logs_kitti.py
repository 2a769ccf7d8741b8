"""KITTI readers: the calibration chain, the Mercator poses, the labels, made-up and recorded drives, and single frames."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from log_encoders import kitti
from log_encoders.world import make_world

from log2sim.config import Config
from log2sim.datatypes import Log
from log2sim.errors import LogError
from log2sim.evaluation.detection.detect_log import detect_log
from log2sim.evaluation.detection.evaluation import DetectionOptions, evaluate_boxes
from log2sim.geometry import apply, inverse, points_in_box, project, rotation_from_rpy, transform, yaw_of
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
    assert labels.never_labeled == ("bicycle", "motorcycle")
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


K = np.array([[700.0, 0, 600], [0, 700, 180], [0, 0, 1]])
# x right, y down, z forward of the level camera 0 along the LiDAR's -y, -z, x.
LEVEL_R_VELO = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
TILT = rotation_from_rpy(0.1, 0.0, 0.0)
CAR = np.array([1.5, 1.8, 4.2])  # height, width, length as in label files
HEIGHT_M = 2.4


def numbers(values):
    return " ".join(repr(float(v)) for v in np.ravel(values))


def write_frame(folder, index, cars, *, turn=0.0, imu=None, tilt=TILT, dont_care=True):
    """Cars at (x, z, rotation) of the level camera on a road `HEIGHT_M` below the LiDAR, which is turned and tilted a bit."""
    for name in ("velodyne", "calib", "label_2", "image_2"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(index)
    rect_T_velo = transform(LEVEL_R_VELO @ rotation_from_rpy(0.01, -0.02, turn), [0.05, -0.1, -0.3])
    ground_m = HEIGHT_M - 0.1  # y of the road in the camera's axes
    x, z = rng.uniform(-30, 30, 20_000), rng.uniform(-30, 60, 20_000)
    points, lines = [np.stack([x, np.full_like(x, ground_m), z], axis=1)], []
    for k, (x_m, z_m, rotation) in enumerate(cars):
        h, w, length = CAR
        local = rng.uniform(-0.5, 0.5, (300, 3)) * [length, h, w] * 0.98
        c, s = np.cos(rotation), np.sin(rotation)
        around = np.stack(
            [c * local[:, 0] + s * local[:, 2], local[:, 1] - h / 2, c * local[:, 2] - s * local[:, 0]], 1
        )
        points.append(around + np.array([x_m, ground_m, z_m]))
        kind = ("Car", "Van", "Pedestrian")[k % 3]
        lines.append(f"{kind} 0.00 {k % 3} 0.0 1 2 30 40 {numbers(CAR)} {x_m} {ground_m} {z_m} {rotation}")
    if dont_care:
        lines.append("DontCare -1 -1 -10 5 6 70 80 -1 -1 -1 -1000 -1000 -1000 -10")
    velo = apply(inverse(rect_T_velo), np.concatenate(points))
    np.column_stack([velo, np.zeros(len(velo))]).astype("<f4").tofile(folder / "velodyne" / f"{index:06d}.bin")
    P = np.column_stack([K @ tilt, K @ [0.06, 0.0, 0.003]])
    entries = {"P2": P, "R0_rect": np.eye(3), "Tr_velo_to_cam": rect_T_velo[:3]}
    entries |= {} if imu is None else {"Tr_imu_to_velo": imu[:3]}
    (folder / "calib" / f"{index:06d}.txt").write_text("".join(f"{k}: {numbers(v)}\n" for k, v in entries.items()))
    (folder / "label_2" / f"{index:06d}.txt").write_text("\n".join(lines) + "\n")
    cv2.imwrite(str(folder / "image_2" / f"{index:06d}.png"), np.zeros((360, 1200, 3), np.uint8))
    return P


FRAMES = {
    0: [(2.0, 15.0, 0.4), (-4.0, 22.0, -1.5)],
    3: [(0.0, 30.0, 3.0)],
    4: [],
    7: [(5.0, 12.0, 1.0), (-6.0, 18.0, 0.0)],
}


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("object")
    for index, cars in FRAMES.items():
        write_frame(folder / "training", index, cars, turn=0.02 * index, imu=np.eye(4))
    return folder


def test_labels_of_every_frame_fit_its_points_and_its_picture(root: Path) -> None:
    log = open_log(root)
    assert (log.name, log.format) == ("kitti-object-training", "kitti-object")
    assert [len(log.streams["velodyne"].t_ns), len(log.labels.t_ns)] == [4, 5]
    assert log.labels.kind.tolist() == ["Car", "Van", "Car", "Car", "Van"]
    assert log.labels.occlusion.tolist() == [0, 1, 0, 0, 1]
    assert len(set(log.labels.track_id)) == 5
    camera = log.cameras["image_02"]
    np.testing.assert_allclose(camera.K, K, atol=1e-9)
    row = 0
    for index, (number, cars) in enumerate(FRAMES.items()):
        sweep = log.streams["velodyne"].read(index)
        map_T_cam, known = log.map_T_sensor("image_02", sweep.stamp_ns)
        assert known.all()
        P = np.column_stack([K @ TILT, K @ [0.06, 0.0, 0.003]])
        for x_m, z_m, _ in cars:
            labels = log.labels
            assert labels.t_ns[row] == sweep.stamp_ns == log.streams["velodyne"].t_ns[index], number
            box = labels.center_m[row], labels.size_m[row], labels.yaw_rad[row]
            inside = points_in_box(sweep.xyz_m, *box, margin_m=0.01)
            assert inside.sum() >= 300
            np.testing.assert_allclose(labels.size_m[row], CAR[[2, 1, 0]])
            uvw = P @ [x_m, HEIGHT_M - 0.1 - CAR[0] / 2, z_m, 1.0]
            uv, _ = project(camera, apply(inverse(map_T_cam[0]), box[0][None]))
            np.testing.assert_allclose(uv[0], uvw[:2] / uvw[2], atol=0.1)
            row += 1
    np.testing.assert_allclose(log.labels.center_m[:, 2] - log.labels.size_m[:, 2] / 2, log.ground_z_ego_m, atol=1e-9)
    assert log.ignored_regions["image_02"].box_px.tolist() == [[5, 6, 70, 80]] * 4
    assert log.notes[0].startswith("single frames")
    assert len(log.notes) == 1


def test_its_labels_as_detector_are_perfect_by_kittis_rules(root: Path) -> None:
    log = open_log(root)
    found = detect_log(log, Config().changed(detect={"name": "lidar:labels"})).found
    assert len(found.t_ns) == 4
    result = evaluate_boxes(found, log, DetectionOptions("kitti"))
    assert (result["sweeps"], result["sweeps_without_labels"]) == (4, 0)
    rows = {
        r["objects"]: r
        for r in result["classes"]["car"]["figures"]
        if r["match"] == {"measure": "iou_3d", "limit": 0.7}
    }
    assert result["occlusion_known"]
    # Vans are ignored.
    assert [rows[name]["truths"] for name in ("all", "easy", "moderate")] == [3, 2, 3]
    assert rows["all"]["ap_r40"] == rows["easy"]["ap_r40"] == 1
    assert rows["all"]["false_positives"] == 0
