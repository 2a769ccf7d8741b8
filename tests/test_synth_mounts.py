"""Sensors at the roadside: poses in the map, from scene file to log."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from worlds import PARKED, tiny_log, tiny_scene

from log2sim.datatypes import Scenario
from log2sim.geometry import apply, box_corners, inverse
from log2sim.logs.opening import open_log
from log2sim.synth.actors import MovingScene
from log2sim.synth.raycast import EGO, cast_sweep
from log2sim.synth.scene import load_scene, scene_from_table
from log2sim.synth.synthesis import synthesize, write_synthetic

SAMPLE = Path(__file__).resolve().parents[1] / "samples" / "scenes" / "roadside.toml"
POLE: dict[str, Any] = {
    "name": "pole",
    "mount": "map",
    "position_m": [10.0, -6.0, 3.6],
    "yaw_deg": 90.0,
    "pitch_deg": -31.25,
    "channels": 16,
    "elevation_deg": [-15.0, 15.0],
    "range_m": 150.0,
    "noise_m": 0.0,
    "dropout": 0.0,
    "resolution_m": 0.0,
}


def in_map(scene: Any, index: int = 0) -> tuple[np.ndarray, np.ndarray]:
    moving, spec = MovingScene.of(scene), scene.lidar[index]
    result = cast_sweep(spec, moving, scene.start_ns + 500_000_000, np.random.default_rng(0))
    log, _ = synthesize(scene, observe=False)
    poses, valid = log.map_T_sensor(spec.name, result.sweep.t_ns)
    assert valid.all()
    xyz = result.sweep.xyz_m.astype(float)
    return np.einsum("nij,nj->ni", poses[:, :3, :3], xyz) + poses[:, :3, 3], result.hit


def test_a_roadside_sensor_sees_the_ego_and_a_sensor_on_the_ego_does_not() -> None:
    table = {"ego": {"waypoints": [[4.0, 0.0, 3.0], [24.0, 0.0, 3.0]], "poses": "poses"}}
    log, _ = tiny_log([PARKED], **table, observe=False)
    scene = tiny_scene(
        [PARKED], **table, lidar=[*[s.model_dump(exclude_defaults=True) for s in tiny_scene().lidar], POLE]
    )
    assert log.ego is not None
    points, hit = in_map(scene, 1)
    on_ego = points[hit == EGO]
    assert len(on_ego) > 20
    ego = MovingScene.of(scene).ego_body
    assert ego is not None
    local = apply(inverse(ego.at(0.45).map_T_agent()[0]), on_ego)
    assert np.all(np.abs(local) <= np.array(ego.spec.box_m) / 2 + 0.3)  # it drives on during the sweep
    assert np.all(in_map(scene, 0)[1] != EGO)


def test_pictures_of_a_roadside_camera_show_labels_where_the_boxes_project() -> None:
    scene = load_scene(SAMPLE)
    short = scene.model_copy(update={"duration_s": 0.3, "lidar": ()})
    log, truth = synthesize(short)
    labels, camera = log.image_labels["roadside_camera"], log.cameras["roadside_camera"]
    assert log.ego is None
    assert truth.ego is None
    assert camera.mount == "map"
    assert len(labels.t_ns) >= 4
    pose, valid = log.map_T_sensor("roadside_camera", labels.t_ns)
    assert valid.all()
    hits = 0
    for t_ns, box in zip(labels.t_ns, labels.box_px):
        for agent in truth.agents:
            state = agent.at((t_ns - truth.t0_ns) / 1e9)
            center = [[state.x_m[0], state.y_m[0], state.z_m[0]]]
            p = apply(inverse(pose[0]), box_corners(center, agent.size_m, state.yaw_rad)[0])
            if p[:, 2].min() < 0.5:
                continue
            uv = p[:, :2] / p[:, 2:] * camera.K[0, 0] + camera.K[:2, 2]
            hits += bool(np.all(box[:2] >= uv.min(0) - 1.5) and np.all(box[2:] <= uv.max(0) + 1.5))
    assert hits >= len(labels.t_ns)


def test_a_roadside_log_is_written_and_read_back_with_its_mounts(tmp_path: Path) -> None:
    table = {
        "name": "pole",
        "duration_s": 0.3,
        "lidar": [{**POLE, "azimuth_step_deg": 1.0}],
        "agent": [{**PARKED, "pose": [10.0, 2.0, 0.0]}],
    }
    write_synthetic(scene_from_table(table), tmp_path / "log")
    log = open_log(tmp_path / "log")
    assert log.ego is None
    assert log.lidars["pole"].mount == "map"
    pose = log.lidars["pole"].mount_T_lidar
    assert np.allclose(pose[:3, 3] - pose[:3, 3].round(6), 0, atol=1e-6)
    assert pose[2, 0] == pytest.approx(np.sin(np.deg2rad(-31.25)), abs=1e-9)
    truth = Scenario.load(tmp_path / "log" / "truth.json")
    assert [a.id for a in truth.agents] == ["parked"]
    assert log.labels is not None
    assert set(log.labels.t_ns) == set(log.streams["pole"].t_ns)
