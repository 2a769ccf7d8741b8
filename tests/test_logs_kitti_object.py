"""The KITTI object layout: frames with their own calibration become one log in which labels fit points and pictures."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from log2sim import open_log
from log2sim.config import Config
from log2sim.evaluation.detection.detect_log import detect_log
from log2sim.evaluation.detection.evaluation import DetectionOptions, evaluate_boxes
from log2sim.geometry import apply, inverse, points_in_box, project, rotation_from_rpy, transform

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
