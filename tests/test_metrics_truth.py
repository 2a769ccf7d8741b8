"""Labels of a log as truth: what is visible, how fast it is, where the ego is."""

from __future__ import annotations

import numpy as np
import pytest

from log2sim.datatypes import Labels, Lidar, Log, Stream, Sweep
from log2sim.errors import RecordError
from log2sim.evaluation.metrics.truth import image_shares, is_static, speed_along, truth_from_log
from log2sim.geometry import Camera, PoseTrack, apply, inverse, rotation_from_rpy, transform

NS = 1_000_000_000
STEP_NS = NS // 10
T0_NS = 1_700_000_000 * NS
FRAMES = 15
EGO_MPS = 10.0
# x right, y down, z forward of the camera along the ego's y left, z up, x forward.
EGO_R_CAM = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
CAMERA = Camera(
    "front", 800, 400, np.array([[400.0, 0, 400], [0, 400, 200], [0, 0, 1]]), "ego", transform(EGO_R_CAM, [0, 0, 1.5])
)
LIDAR = Lidar("top", "ego", transform(rotation_from_rpy(0, 0, 0.3), [0.5, 0, 2.0]))
CAR = np.array([4.0, 2.0, 1.5])


def make_log(centers, points_per_box, *, frame="lidar", broken=(), visible=None, ego_mps=EGO_MPS):
    """A log driving along +x with static cars at `centers`, each with so many points, spread over the sweep's time."""
    t_ns = T0_NS + STEP_NS * np.arange(FRAMES)
    pose_t = T0_NS + STEP_NS * np.arange(-1, FRAMES + 2)
    x = ego_mps * (pose_t - T0_NS) / NS
    ego = PoseTrack(pose_t, transform(np.eye(3), np.stack([x, 0 * x, 0 * x], -1)))
    rng = np.random.default_rng(0)

    def read_sweep(i):
        if i in broken:
            raise RecordError(f"sweep {i} is broken")
        inside = [c + (rng.random((n, 3)) - 0.5) * CAR * 0.99 for c, n in zip(centers, points_per_box)]
        points = np.concatenate([*inside, rng.uniform([-60, -60, 300], 500, (500, 3))])
        stamps = t_ns[i] + rng.integers(-STEP_NS // 2, STEP_NS // 2, len(points))
        if frame == "map":
            return Sweep(int(t_ns[i]), points, "map")
        poses, _ = log.map_T_sensor("top", stamps)
        return Sweep(int(t_ns[i]), apply(inverse(poses), points).astype(np.float32), "lidar", stamps)

    count = len(centers)
    labels = Labels(
        t_ns=np.repeat(t_ns, count),
        track_id=np.tile([f"car{k}" for k in range(count)], FRAMES),
        category=np.full(count * FRAMES, "car"),
        center_m=np.tile(np.asarray(centers, dtype=float), (FRAMES, 1)),
        size_m=np.tile(CAR, (count * FRAMES, 1)),
        yaw_rad=np.zeros(count * FRAMES),
        visible=visible,
    )
    log = Log(
        name="made",
        format="test",
        cameras={"front": CAMERA},
        lidars={"top": LIDAR},
        streams={
            "front": Stream("front", t_ns, lambda i: pytest.fail("truth needs no image")),
            "top": Stream("top", t_ns, read_sweep),
        },
        ego=ego,
        labels=labels,
        reference_camera="front",
    )
    return log


@pytest.mark.parametrize("frame", ["lidar", "map"])
def test_visible_needs_points_and_the_camera(frame):
    # Ahead with points, ahead with one point too few, behind the camera.
    log = make_log([[60, 0, 0.75], [60, 8, 0.75], [-20, 0, 0.75]], [20, 19, 200], frame=frame)
    visible = {a.id: float(a.waypoints.visible.mean()) for a in truth_from_log(log).others}
    assert visible == {"car0": 1.0, "car1": 0.0, "car2": 0.0}


def test_visibility_that_the_log_states_is_taken_and_no_sweep_read():
    stated = np.arange(FRAMES) < 5
    log = make_log([[60, 0, 0.75]], [0], visible=stated, broken=range(FRAMES))
    truth = truth_from_log(log)
    assert truth.others[0].waypoints.visible.tolist() == stated.tolist()
    assert truth.provenance["unreadable_sweeps"] == 0


def test_the_ego_is_its_box_center_with_its_speed():
    ego = truth_from_log(make_log([[60, 0, 0.75]], [40])).ego
    assert ego.waypoints.x_m == pytest.approx(1.4 + np.arange(FRAMES))
    assert ego.waypoints.z_m == pytest.approx(0.8)
    assert ego.waypoints.speed_mps == pytest.approx(EGO_MPS)
    assert ego.rear_axle_offset_m == 1.4


def test_image_share_by_distance_across_the_border_matches_sampling():
    # Second method: the share of a dense sampling of the outline, taken pixel by pixel on a wider image.
    cv2 = pytest.importorskip("cv2")
    cam_T_map = inverse(CAMERA.mount_T_cam)
    pad = 3000
    for y in (11.0, 12.0, 13.0):
        center, size, yaw = np.array([12.0, y, 1.0]), np.array([4.5, 1.9, 1.6]), 0.4
        signs = np.array([[a, b, c] for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)]) / 2
        corners = apply(transform(rotation_from_rpy(0, 0, yaw), center), signs * size)
        in_cam = apply(cam_T_map, corners)
        uv = (in_cam[:, :2] / in_cam[:, 2:]) * 400 + [400, 200] + pad
        canvas = np.zeros((400 + 2 * pad, 800 + 2 * pad), dtype=np.uint8)
        cv2.fillConvexPoly(canvas, cv2.convexHull(uv.astype(np.float32)).astype(np.int32), 1)
        expected = canvas[pad : pad + 400, pad : pad + 800].sum() / canvas.sum()
        share = image_shares(CAMERA, cam_T_map, center[None], size[None], np.array([yaw]))[0]
        assert 0.02 < share < 0.98
        assert share == pytest.approx(expected, abs=0.02)


def test_a_box_beside_the_camera_is_hardly_in_its_image():
    shares = image_shares(
        CAMERA,
        inverse(CAMERA.mount_T_cam),
        np.array([[0.5, 2.5, 1.0], [-10.0, 0, 1.0], [30.0, 0, 1.0]]),
        np.tile(CAR, (3, 1)),
        np.zeros(3),
    )
    assert shares[0] < 0.2
    assert shares[1:].tolist() == [0.0, 1.0]


def test_speed_of_steady_and_reversing_motion_is_exact_and_of_noise_small():
    t = np.arange(20) / 10
    heading = np.full(20, 2.0)
    way = np.stack([np.cos(heading), np.sin(heading)], -1)
    assert speed_along(t, 7 * t[:, None] * way, heading) == pytest.approx(7.0)
    assert speed_along(t, -2 * t[:, None] * way, heading) == pytest.approx(-2.0)
    assert speed_along(np.array([0.0, 1.0]), np.array([[0.0, 0], [3, 0]]), np.zeros(2)) == pytest.approx(3.0)
    assert speed_along(np.zeros(1), np.zeros((1, 2)), np.zeros(1)).tolist() == [0.0]
    noise = np.random.default_rng(0).normal(0, 0.05, (2000, 2))
    assert np.std(speed_along(np.arange(2000) / 10, noise, np.zeros(2000))) == pytest.approx(
        0.05 / 0.1 / np.sqrt(10), rel=0.1
    )


def test_static_is_what_neither_reaches_nor_drifts():
    t = np.arange(30) / 10
    noise = np.random.default_rng(0).normal(0, 0.05, (30, 2))
    assert is_static(t, noise)
    assert not is_static(t, noise + np.stack([t, 0 * t], -1))
    assert not is_static(t[:5], np.stack([t[:5], 0 * t[:5]], -1))
    assert not is_static(t[:1], noise[:1])
