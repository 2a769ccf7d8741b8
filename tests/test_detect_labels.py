"""Boxes of the log as detections: projection, motion between stamps, occlusion, and no use of ids."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from log2sim.datatypes import Detections, Frame, ImageLabels, Labels, Log
from log2sim.geometry import Camera, transform
from log2sim.perception.detect.detectors import create_detector

# Looks along map x from the origin, 1000 px focal length.
CAM_AXES = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
K = np.array([[1000.0, 0, 500], [0, 1000.0, 300], [0, 0, 1]])
CAMERA = Camera("front", 1000, 600, K, "map", transform(CAM_AXES, np.zeros(3)))
SECOND = 1_000_000_000
CAR = (4.0, 2.0, 1.5)


def log_with(*rows: tuple[int, str, tuple[float, float, float], tuple[float, float, float]], **more: Any) -> Log:
    """A log with labels (stamp, category, center, size), heading along x, ids all alike."""
    labels = Labels(
        np.array([r[0] for r in rows], dtype=np.int64),
        np.array(["same"] * len(rows)),
        np.array([r[1] for r in rows]),
        np.array([r[2] for r in rows], dtype=np.float64).reshape(-1, 3),
        np.array([r[3] for r in rows], dtype=np.float64).reshape(-1, 3),
        np.zeros(len(rows)),
        more.pop("visible", None),
    )
    return Log("made", "log2sim", {"front": CAMERA}, {}, {}, labels=labels, **more)


def detect(log: Log, t_ns: int = 0) -> Detections:
    frame = Frame(CAMERA, t_ns, lambda: pytest.fail("the picture must not be decoded"))
    return create_detector("labels", log).detect(frame)


def test_box_of_a_car_ahead_is_that_of_its_nearest_face() -> None:
    found = detect(log_with((0, "car", (22.0, 0, 0), CAR)))
    # The rear face stands at 20 m: 2 m wide and 1.5 m high are 100 px and 75 px.
    assert found.box_px == pytest.approx(np.array([[450, 262.5, 550, 337.5]]))
    assert found.category.tolist() == ["car"]
    assert found.score.tolist() == [1.0]


def test_car_partly_behind_the_camera_keeps_its_visible_part() -> None:
    # Its right side lies 3 m to the left and leaves the picture (500 px at the left border) nearer than 6 m.
    found = detect(log_with((0, "car", (4.0, 4.0, 0), (12.0, 2.0, 1.5))))
    assert found.box_px[0, 0] == 0
    assert found.box_px[0, 2] == pytest.approx(500 - 1000 * 3 / 10)
    # It enters the view at 6 m, where its right side is 0.75 m up and down.
    assert found.box_px[0, [1, 3]] == pytest.approx([300 - 125, 300 + 125])


@pytest.mark.parametrize(
    ("center", "size"),
    [((-20, 0, 0), CAR), ((20, 40, 0), CAR), ((500, 0, 0), CAR), ((0, 0, 0), (4.0, 4.0, 4.0))],
    ids=["behind", "beside", "too small", "around the camera"],
)
def test_boxes_out_of_sight_are_dropped(center: tuple[float, float, float], size: tuple[float, float, float]) -> None:
    assert len(detect(log_with((0, "car", center, size)))) == 0


def test_box_moves_to_the_stamp_of_the_frame_without_ids() -> None:
    # Two cars in opposite directions, in another order at the second stamp, and one that is new there.
    rows = [
        (0, "car", (22.0, 3.0, 0), CAR),
        (0, "car", (32.0, -3.0, 0), CAR),
        (SECOND // 10, "car", (31.0, -3.0, 0), CAR),
        (SECOND // 10, "car", (23.0, 3.0, 0), CAR),
        (SECOND // 10, "pedestrian", (15.0, 0.0, 0), (0.6, 0.6, 1.8)),
    ]
    found = detect(log_with(*rows), SECOND // 25)
    # At 0.04 s the rear of the left car is at 20.4 m, that of the right one at 29.6 m; inner sides are 2 m off.
    assert found.category.tolist() == ["car", "car"]
    assert found.box_px[0, 2] == pytest.approx(500 - 1000 * 2 / 24.4)
    assert found.box_px[0, 0] == pytest.approx(500 - 1000 * 4 / 20.4)
    assert found.box_px[1, 2] == pytest.approx(500 + 1000 * 4 / 29.6)


@pytest.mark.parametrize("speed_mps", [0.0, 30.0])
def test_boxes_with_a_stamp_each_come_once_and_at_the_time_of_the_frame(speed_mps: float) -> None:
    rng = np.random.default_rng(3)
    rows = []
    for lane, y in enumerate((-6.0, -2.0, 2.0, 6.0)):
        for sweep in range(12):
            t_s = 0.1 * sweep + 0.02 * lane + rng.uniform(0, 0.015)
            rows.append((round(t_s * SECOND), "car", (22.0 + speed_mps * t_s, y, 0.0), CAR))
    found = detect(log_with(*rows), SECOND // 2)
    assert len(found) == 4
    rear_m = 20.0 + speed_mps * 0.5
    lowest = np.sort(found.box_px[:, 3])
    assert lowest == pytest.approx(np.full(4, 300 + 1000 * 0.75 / rear_m), abs=1e-3)


def test_boxes_of_the_frame_come_before_projected_ones() -> None:
    labels = ImageLabels(np.array([0, 0, SECOND]), np.array([[1.0, 2, 30, 40], [5, 5, 7, 50], [9, 9, 99, 99]]),
                         np.array(["cyclist", "car", "car"]))  # fmt: skip
    log = log_with((0, "bus", (20.0, 4.0, 0), CAR), image_labels={"front": labels})
    found = detect(log)
    assert (found.category.tolist(), found.box_px.tolist()) == (["cyclist"], [[1, 2, 30, 40]])
