"""Synthetic logs: records and truth agree."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from worlds import CAR, PARKED, WALKER, tiny_log, tiny_scene

from log2sim.datatypes import Scenario
from log2sim.errors import ConfigError
from log2sim.geometry import NS_PER_S, apply, box_corners, inverse
from log2sim.synth.actors import EgoMotion, MovingScene
from log2sim.synth.raycast import GROUND, cast_sweep
from log2sim.synth.synthesis import write_synthetic
from log2sim.synth.truth import FrameVisibility, LidarVisibility, visible_at

WALL = {"center": [25.0, 0.0], "size_m": [2.0, 120.0, 8.0]}


def test_points_of_a_turning_lidar_on_a_moving_ego_lie_on_the_agents_at_their_own_time() -> None:
    scene = tiny_scene(gnss={"position_sigma_m": 0.0})
    log, truth = tiny_log(noise_m=0.0)
    moving, spec = MovingScene.of(scene), scene.lidar[0]
    result = cast_sweep(spec, moving, int(log.streams["top"].t_ns[5]), np.random.default_rng(0))
    t_ns = result.sweep.t_ns
    assert t_ns is not None
    poses = moving.ego.map_T_ego_ns(t_ns) @ log.lidars["top"].mount_T_lidar
    points = np.einsum("nij,nj->ni", poses[:, :3, :3], result.sweep.xyz_m.astype(float)) + poses[:, :3, 3]
    assert np.abs(points[result.hit == GROUND, 2]).max() < 0.05
    for index, actor in enumerate(moving.actors):
        rows = np.flatnonzero(result.hit == index)
        assert len(rows) > 20, actor.spec.id
        state = actor.at((t_ns[rows] - scene.start_ns) / NS_PER_S)
        local = apply(inverse(state.map_T_agent()), points[rows])
        # Noise, 2 cm, only moves points along their rays.
        assert np.all(np.abs(local) <= np.array(actor.spec.box_m) / 2 + 0.1)
    assert truth.t0_ns == scene.start_ns


def test_from_a_fast_turning_ego_a_wall_is_flat_when_every_point_has_its_own_pose() -> None:
    curve = {"waypoints": [[0, 0, 12.0], [12, 0, 12.0], [16, 12, 12.0]], "rounding_m": 25.0}
    log, _ = tiny_log([], ego=curve, building=[WALL], noise_m=0.0, observe=False)
    sweep = log.streams["top"].read(6)
    scene = tiny_scene([], ego=curve)
    poses = EgoMotion(scene.ego, scene.start_ns).map_T_ego_ns(sweep.t_ns) @ log.lidars["top"].mount_T_lidar
    points = np.einsum("nij,nj->ni", poses[:, :3, :3], sweep.xyz_m.astype(float)) + poses[:, :3, 3]
    wall = points[points[:, 2] > 0.3]
    assert len(wall) > 200
    assert np.abs(wall[:, 0] - 24.0).max() < 1e-3
    at_end = apply(poses[-1], sweep.xyz_m)[points[:, 2] > 0.3]
    assert np.abs(at_end[:, 0] - 24.0).max() > 0.2  # so the test would notice


def test_visible_takes_an_unoccluded_third_half_a_box_in_the_image_and_twenty_points() -> None:
    scene = tiny_scene()
    unoccluded = np.array([0.9, 0.3, 0.9, 0.9])
    inside = np.array([0.6, 1.0, 0.4, 1.0])
    t_ns = np.array([scene.start_ns])
    frames = {"front": [FrameVisibility(scene.start_ns, unoccluded, inside, np.zeros((4, 4)))]}
    visible = visible_at(t_ns, frames, {"top": LidarVisibility(t_ns, np.array([[20, 50, 50, 19]]))}, 4)
    assert visible.tolist() == [[True, False, False, False]]


def test_a_sweep_ends_at_its_stamp_and_takes_its_share_of_a_turn() -> None:
    log, _ = tiny_log(observe=False)
    stream = log.streams["top"]
    sweep = stream.read(3)
    assert sweep.stamp_ns == stream.t_ns[3]
    assert sweep.t_ns.max() <= sweep.stamp_ns
    assert sweep.stamp_ns - sweep.t_ns.min() == pytest.approx(0.1 * 120 / 360 * NS_PER_S, rel=0.05)
    assert np.isfinite(sweep.xyz_m).all()


def test_truth_agrees_with_the_waypoints_and_stands_on_the_ground() -> None:
    _, truth = tiny_log(observe=False)
    car = next(a for a in truth.agents if a.id == "car")
    t = car.waypoints.t_s
    # The waypoints guide the rear axle, the truth is the center of the box.
    assert np.allclose(car.waypoints.x_m, 16.0 + 4.0 * t + 0.3 * 4.4, atol=1e-6)
    assert np.allclose(car.waypoints.z_m, 0.75)
    parked = next(a for a in truth.agents if a.id == "parked")
    assert parked.static
    assert np.all(parked.waypoints.speed_mps == 0)
    assert np.allclose(parked.waypoints.yaw_rad, np.deg2rad(10))
    assert truth.ego is not None
    assert np.allclose(truth.ego.waypoints.x_m, 3.0 * t + 1.4, atol=1e-6)


def test_the_same_seed_gives_the_same_bytes_and_another_seed_other_noise() -> None:
    first, truth = tiny_log(seed=3, observe=False)
    again, _ = tiny_log(seed=3, observe=False)
    other, other_truth = tiny_log(seed=4, observe=False)
    again.streams["top"].read(5)  # the order of reading must not matter
    for name in ("top", "front"):
        a, b, c = (log.streams[name].read(2) for log in (first, again, other))
        if name == "top":
            a, b, c = a.xyz_m, b.xyz_m, c.xyz_m
        assert np.array_equal(a, b)
        assert a.shape != c.shape or not np.array_equal(a, c)
    for agent, same in zip(truth.agents, other_truth.agents):
        assert np.array_equal(agent.waypoints.x_m, same.waypoints.x_m)


def test_who_is_hidden_behind_a_truck_is_not_visible() -> None:
    truck = {"id": "truck", "category": "truck", "size_m": [7.0, 2.4, 3.0], "pose": [12.0, 0.0, 0.0]}
    behind = {**PARKED, "id": "behind", "pose": [22.0, 0.0, 0.0]}
    aside = {**PARKED, "id": "aside", "pose": [18.0, 5.0, 0.0]}
    log, truth = tiny_log([truck, behind, aside], ego={"waypoints": [[-5, 0, 1], [5, 0, 1]]})
    seen = {a.id: a.waypoints.visible for a in truth.agents}
    assert seen["ego"] is None
    assert seen["truck"] is not None
    assert seen["truck"].all()
    assert seen["aside"] is not None
    assert seen["aside"].all()
    assert seen["behind"] is not None
    assert not seen["behind"].any()
    labels = log.image_labels["front"]
    assert len(labels.t_ns) == 2 * len(log.streams["front"].t_ns)


def test_a_2d_label_lies_within_the_projected_box_and_fills_most_of_it() -> None:
    log, truth = tiny_log([PARKED])
    labels, camera = log.image_labels["front"], log.cameras["front"]
    agent = truth.others[0]
    for t_ns, box in zip(labels.t_ns, labels.box_px):
        pose, _ = log.map_T_sensor("front", t_ns)
        state = agent.at((t_ns - truth.t0_ns) / NS_PER_S)
        corners = box_corners([[state.x_m[0], state.y_m[0], state.z_m[0]]], agent.size_m, state.yaw_rad)[0]
        p = apply(inverse(pose[0]), corners)
        uv = p[:, :2] / p[:, 2:] * camera.K[0, 0] + camera.K[:2, 2]
        low, high = uv.min(0), uv.max(0)
        assert np.all(box[:2] >= low - 1.0)
        assert np.all(box[2:] <= high + 1.5)
        assert np.prod(box[2:] - box[:2]) > 0.7 * np.prod(high - low)


def test_an_empty_street_has_a_log_and_a_truth_of_the_ego_alone() -> None:
    log, truth = tiny_log([], duration_s=0.2)
    assert [a.id for a in truth.agents] == ["ego"]
    assert log.labels is None
    assert len(log.image_labels["front"].t_ns) == 0


def test_buildings_stop_rays() -> None:
    log, _ = tiny_log([], building=[WALL], noise_m=0.0, observe=False)
    xyz = log.streams["top"].read(0).xyz_m
    assert xyz[:, 0].max() < 25.0
    assert (xyz[:, 2] > 0.3).any()


@pytest.mark.slow
def test_an_image_shows_the_car_in_its_color() -> None:
    green = {**PARKED, "color": [20, 200, 40], "pose": [9.0, 0.0, 90.0]}
    log, _ = tiny_log([green])
    image = log.streams["front"].read(0)
    assert image.shape == (300, 480, 3)
    assert image.dtype == np.uint8
    u0, v0, u1, v1 = log.image_labels["front"].box_px[0].astype(int)
    blue, lime, red = (image[v0:v1, u0:u1, k].astype(int) for k in range(3))
    assert (lime > np.maximum(blue, red) + 40).mean() > 0.2
    outside = image[:, : max(u0 - 20, 1)].astype(int)
    assert (outside[..., 1] > np.maximum(outside[..., 0], outside[..., 2]) + 40).mean() < 0.01


def test_measured_poses_are_off_by_about_the_noise_that_was_asked_for() -> None:
    log, truth = tiny_log(observe=False, gnss={"position_sigma_m": 0.05, "angle_sigma_deg": 0.1}, duration_s=60.0)
    scene = tiny_scene(duration_s=60.0)
    assert log.ego is not None
    exact = EgoMotion(scene.ego, scene.start_ns).map_T_ego_ns(log.ego.t_ns)
    error = log.ego.map_T_ego[:, :3, 3] - exact[:, :3, 3]
    assert 0.025 < error.std() < 0.08
    assert truth.duration_s == 60.0


def test_a_written_log_holds_its_truth_and_nothing_is_replaced_unasked(tmp_path: Path) -> None:
    scene = tiny_scene([CAR, WALKER], duration_s=0.3)
    out = tmp_path / "log"
    write_synthetic(scene, out, seed=1)
    first = {p.relative_to(out): p.read_bytes() for p in sorted(out.rglob("*")) if p.is_file()}
    truth = Scenario.load(out / "truth.json")
    assert {a.id for a in truth.agents} == {"ego", "car", "walker"}
    with pytest.raises(ConfigError, match="exists already"):
        write_synthetic(scene, out, seed=1)
    write_synthetic(scene, out, seed=1, overwrite=True)
    assert first == {p.relative_to(out): p.read_bytes() for p in sorted(out.rglob("*")) if p.is_file()}
    stranger = tmp_path / "mine"
    stranger.mkdir()
    (stranger / "thesis.txt").write_text("years of work", encoding="utf-8")
    with pytest.raises(ConfigError, match="no log folder"):
        write_synthetic(scene, stranger, overwrite=True)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["log", "mine"]
