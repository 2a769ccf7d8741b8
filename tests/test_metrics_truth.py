"""Labels of a log as truth: what is visible, how fast it is, where the ego is."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from log2sim.datatypes import Labels, Lidar, Log, Scenario, Stream, Sweep
from log2sim.errors import ConfigError, LogError, RecordError
from log2sim.evaluation.metrics.evaluator import evaluate
from log2sim.evaluation.metrics.truth import (
    PointGrid,
    convex_hull,
    image_shares,
    is_static,
    nearest_record,
    speed_along,
    truth_from_log,
    with_points,
)
from log2sim.geometry import Camera, PoseTrack, apply, inverse, points_in_box, rotation_from_rpy, transform

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


def share_visible(truth):
    return {a.id: float(a.waypoints.visible.mean()) for a in truth.others}


@pytest.mark.parametrize("frame", ["lidar", "map"])
def test_visible_needs_points_and_the_camera(frame):
    # Ahead with points, ahead with one point too few, behind the camera.
    log = make_log([[60, 0, 0.75], [60, 8, 0.75], [-20, 0, 0.75]], [20, 19, 200], frame=frame)
    assert share_visible(truth_from_log(log)) == {"car0": 1.0, "car1": 0.0, "car2": 0.0}


def test_only_cameras_that_were_used_see():
    log = make_log([[60, 0, 0.75], [-20, 0, 0.75]], [40, 40])
    to_rear = transform(rotation_from_rpy(0, 0, np.pi) @ EGO_R_CAM, [0, 0, 1.5])
    rear = replace(CAMERA, name="rear", mount_T_cam=to_rear)
    streams = {**log.streams, "rear": replace(log.streams["front"], name="rear")}
    log = replace(log, cameras={"front": CAMERA, "rear": rear}, streams=streams)
    assert share_visible(truth_from_log(log)) == {"car0": 1.0, "car1": 1.0}
    assert share_visible(truth_from_log(log, cameras=["rear"])) == {"car0": 0.0, "car1": 1.0}
    with pytest.raises(ConfigError, match="did you mean 'rear'"):
        truth_from_log(log, cameras=["raer"])


def test_points_of_all_lidars_are_added():
    log = make_log([[60, 0, 0.75]], [10])
    second = replace(log.streams["top"], name="second")
    log = replace(log, lidars={"top": LIDAR, "second": LIDAR}, streams={**log.streams, "second": second})
    assert share_visible(truth_from_log(log)) == {"car0": 1.0}


def test_visibility_that_the_log_states_is_taken_and_no_sweep_read():
    stated = np.arange(FRAMES) < 5
    log = make_log([[60, 0, 0.75]], [0], visible=stated, broken=range(FRAMES))
    truth = truth_from_log(log)
    assert truth.others[0].waypoints.visible.tolist() == stated.tolist()
    assert truth.provenance["unreadable_sweeps"] == 0


def test_points_are_counted_beside_what_the_log_states_and_in_a_truth_of_its_own():
    """By label and by sweep, in cars that stand."""
    log = make_log([[60, 0, 0.75], [60, 8, 0.75]], [40, 3], visible=np.tile([False, True], FRAMES))
    assert truth_from_log(log).others[0].waypoints.lidar_points is None
    truth = truth_from_log(log, points=True)
    assert [a.waypoints.lidar_points.tolist() for a in truth.others] == [[40.0] * FRAMES, [3.0] * FRAMES]
    assert [a.waypoints.visible.tolist() for a in truth.others] == [[False] * FRAMES, [True] * FRAMES]
    ends = [replace(a, waypoints=replace(a.waypoints, lidar_points=None).take([0, -1])) for a in truth.others]
    again = with_points(replace(truth, agents=(truth.ego, *ends)), replace(log, labels=None))
    assert [a.waypoints.lidar_points.tolist() for a in again.others] == [[40.0, 40.0], [3.0, 3.0]]
    found = evaluate(truth, log)
    assert (found["coverage"]["hit"], found["coverage"]["hit_recall"], found["counts"]["truth_ticks"]) == (15, 1.0, 15)
    assert Scenario.from_dict(truth.to_dict()).others[0].waypoints.lidar_points.tolist() == [40.0] * FRAMES


def test_either_side_may_be_a_file_and_the_truth_a_log(tmp_path):
    log = make_log([[60, 0, 0.75]], [40])
    truth = truth_from_log(log)
    truth.save(tmp_path / "s.json")
    expected = evaluate(truth, log)
    assert expected["recall"] == 1.0
    assert evaluate(tmp_path / "s.json", log) == expected
    assert evaluate(str(tmp_path / "s.json"), tmp_path / "s.json")["recall"] == 1.0
    assert evaluate(SimpleNamespace(scenario=truth), truth)["recall"] == 1.0
    with pytest.raises(TypeError, match="first"):
        evaluate(log, truth)


def test_an_unreadable_sweep_is_counted_and_the_rest_goes_on():
    truth = truth_from_log(make_log([[60, 0, 0.75]], [40], broken=(3,)))
    assert truth.provenance["unreadable_sweeps"] == 1
    assert np.flatnonzero(~truth.others[0].waypoints.visible).tolist() == [3]


def test_progress_runs_to_the_last_sweep():
    seen = []
    truth_from_log(make_log([[60, 0, 0.75]], [40]), progress=lambda done, total: seen.append((done, total)))
    assert seen == [(k + 1, FRAMES) for k in range(FRAMES)]


def test_the_ego_is_its_box_center_with_its_speed():
    ego = truth_from_log(make_log([[60, 0, 0.75]], [40])).ego
    assert ego.waypoints.x_m == pytest.approx(1.4 + np.arange(FRAMES))
    assert ego.waypoints.z_m == pytest.approx(0.8)
    assert ego.waypoints.speed_mps == pytest.approx(EGO_MPS)
    assert ego.rear_axle_offset_m == 1.4


def test_truth_is_a_scenario_that_reads_back_and_matches_itself(tmp_path):
    truth = truth_from_log(make_log([[40, 0, 0.75], [20, 6, 0.75]], [40, 40]))
    truth.save(tmp_path / "truth.json")
    again = type(truth).load(tmp_path / "truth.json")
    result = evaluate(again, truth, max_range_m=40)
    assert (result["recall"], result["precision"], result["position_rmse_m"]) == (1.0, 1.0, 0.0)
    assert all(a.static for a in truth.others)
    assert truth.t0_ns == T0_NS


def test_rows_in_any_order_and_twice_give_the_same_truth():
    log = make_log([[40, 0, 0.75], [20, 6, 0.75]], [40, 40], visible=np.ones(2 * FRAMES, dtype=bool))
    order = np.random.default_rng(0).permutation(np.r_[0 : 2 * FRAMES, 0:5])
    columns = {k: v[order] for k, v in vars(log.labels).items() if isinstance(v, np.ndarray)}
    mixed = truth_from_log(replace(log, labels=Labels(**columns)))
    assert mixed.to_dict() == truth_from_log(log).to_dict()


def test_a_log_without_labels_is_refused():
    with pytest.raises(LogError, match="no labeled 3D boxes"):
        truth_from_log(replace(make_log([[60, 0, 0.75]], [40]), labels=None))


def test_a_log_of_roadside_sensors_has_no_ego():
    log = make_log([[60, 0, 0.75]], [40], frame="map")
    fixed = replace(CAMERA, mount="map")
    truth = truth_from_log(replace(log, ego=None, cameras={"front": fixed}))
    assert truth.ego is None
    assert share_visible(truth) == {"car0": 1.0}


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


def test_a_barrel_lens_sees_more():
    # The pinhole's border lies at y = x; k1 < 0 pulls points inwards, so a box beyond it is seen.
    barrel = replace(CAMERA, distortion_model="brown", distortion=(-0.2, 0.0, 0.0, 0.0))
    box = np.array([[20.0, 21.5, 1.0]]), np.array([[1.0, 1.0, 1.0]]), np.zeros(1)
    to_cam = inverse(CAMERA.mount_T_cam)
    assert image_shares(CAMERA, to_cam, *box)[0] < 0.1
    assert image_shares(barrel, to_cam, *box)[0] > 0.9


def test_hull_of_a_square_with_points_inside_and_on_its_border():
    square = np.array([[0.0, 0], [2, 0], [2, 2], [0, 2]])
    hull = convex_hull(np.concatenate([square, [[1.0, 1], [1, 0], [0.5, 1.5]]]))
    assert sorted(hull.tolist()) == sorted(square.tolist())


def test_points_in_the_grid_equal_a_full_search():
    rng = np.random.default_rng(0)
    points = rng.uniform([-30, -30, -2], [30, 30, 2], (20_000, 3))
    grid = PointGrid(points)
    for _ in range(50):
        center, size = rng.uniform(-35, 35, 3) * [1, 1, 0.05], rng.uniform(0.5, 12, 3)
        yaw = rng.uniform(-3, 3)
        assert grid.count(center, size, yaw) == points_in_box(points, center, size, yaw).sum()
    assert PointGrid(np.zeros((0, 3))).count(np.zeros(3), CAR, 0.0) == 0


def test_nearest_records_of_a_stream_out_of_order():
    index, near = nearest_record(np.array([300, 100, 200]) * NS // 1000, np.array([90, 160, 299, 450]) * NS // 1000)
    assert index.tolist() == [1, 2, 0, 0]
    assert near.tolist() == [True, True, True, False]


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


@pytest.mark.slow
@pytest.mark.real
def test_recorded_labels_have_the_points_that_a_full_search_finds(real_data):
    from log2sim.evaluation.metrics.truth import points_in_labels
    from log2sim.logs.opening import open_log

    log = open_log(real_data / "kitti_tracking")
    counts, unreadable = points_in_labels(log, log.labels)
    assert unreadable == 0
    (name,) = log.lidars
    for i in (0, 40):
        sweep = log.streams[name].read(i)
        stamps = np.full(len(sweep.xyz_m), sweep.stamp_ns) if sweep.t_ns is None else sweep.t_ns
        points = apply(log.map_T_sensor(name, stamps)[0], sweep.xyz_m)
        rows = np.flatnonzero(log.labels.t_ns == log.streams["image_02"].t_ns[i])
        assert len(rows) >= 3
        for k in rows:
            box = log.labels.center_m[k], log.labels.size_m[k], log.labels.yaw_rad[k]
            # Points that share a pose within a millisecond may cross a face of the box.
            assert counts[k] == pytest.approx(points_in_box(points, *box).sum(), rel=0.02, abs=2)
