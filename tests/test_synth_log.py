"""Synthetic logs: records and truth agree."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from worlds import CAR, WALKER, tiny_log, tiny_scene

from log2sim.datatypes import Scenario
from log2sim.errors import ConfigError
from log2sim.geometry import NS_PER_S, apply, inverse
from log2sim.synth.actors import MovingScene
from log2sim.synth.raycast import GROUND, cast_sweep
from log2sim.synth.synthesis import write_synthetic


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
