"""OpenLABEL documents: where their boxes are, what reads them back, and what the schema says."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import run
from export_worlds import ROOT, peer, straight, world

from log2sim import open_log
from log2sim.datatypes import MapFrame, Scenario
from log2sim.export.exporters import Options, export
from log2sim.geometry import apply, box_corners, inverse, project, wrap_angle

SAMPLE = ROOT / "samples" / "crossing"


def written(scenario: Scenario, folder: Path, **options: Any) -> dict[str, Any]:
    (file,) = export(scenario, "openlabel", folder, Options(**options))
    return dict(json.loads(file.read_text())["openlabel"])


def test_a_box_stands_where_its_agent_is_in_coordinates_of_the_projection(tmp_path: Path) -> None:
    scenario = replace(world(straight("ego"), straight("b", yaw=2.0)), map=MapFrame(offset_m=(5000.0, -3000.0, 100.0)))
    found = written(scenario, tmp_path)
    (uid,) = (key for key, value in found["objects"].items() if value["name"] == "b")
    for frame in found["frames"].values():
        t_s = (int(frame["frame_properties"]["timestamp"]) - scenario.t0_ns) / 1e9
        (cuboid,) = frame["objects"][uid]["object_data"]["cuboid"]
        x, y, z, qx, qy, qz, qw, *size = cuboid["val"]
        expected = [5000 + 5 * t_s * np.cos(2.0), -3000 + 5 * t_s * np.sin(2.0), 100.8]
        np.testing.assert_allclose([x, y, z], expected, atol=2e-6)
        assert (qx, qy, 2 * np.arctan2(qz, qw)) == pytest.approx((0.0, 0.0, 2.0), abs=1e-6)
        assert size == [4.4, 1.8, 1.6]
        # The ego frame is on the ground below the rear axle.
        pose = np.array(frame["frame_properties"]["transforms"]["ego_to_map"]["transform_src_to_dst"]["matrix4x4"])
        np.testing.assert_allclose(pose.reshape(4, 4)[:3, 3], [5000 + 5 * t_s - 1.3, -3000, 100], atol=2e-6)


def test_boxes_in_pictures_are_around_the_corners_of_the_cuboids(tmp_path: Path) -> None:
    log, scenario = open_log(SAMPLE), Scenario.load(SAMPLE / "truth.json")
    found = written(scenario, tmp_path, log=log)
    checked = 0
    for frame in found["frames"].values():
        for uid, entry in frame["objects"].items():
            for box in entry["object_data"].get("bbox", []):
                camera = log.cameras[box["coordinate_system"]]
                stamp = int(frame["frame_properties"]["streams"][camera.name]["stream_properties"]["timestamp"])
                agent = scenario[found["objects"][uid]["name"]]
                assert agent.id != "ego"
                at = agent.at((stamp - scenario.t0_ns) / 1e9)
                corners = box_corners([at.x_m[0], at.y_m[0], at.z_m[0]], agent.size_m, at.yaw_rad)[0]
                uv, _ = project(camera, apply(inverse(log.map_T_sensor(camera.name, stamp)[0][0]), corners))
                if (
                    not np.isfinite(uv).all()
                    or uv.min() < 0
                    or (uv.max(axis=0) > [camera.width_px, camera.height_px]).any()
                ):
                    continue
                x, y, width, height = box["val"]
                low, high = np.array([x - width / 2, y - height / 2]), np.array([x + width / 2, y + height / 2])
                np.testing.assert_allclose([low, high], [uv.min(axis=0), uv.max(axis=0)], atol=0.02)
                checked += 1
    assert checked > 50


def test_a_log_with_the_document_as_labels_has_the_agents_of_the_scenario(tmp_path: Path) -> None:
    scenario = Scenario.load(SAMPLE / "truth.json")
    written(scenario, tmp_path / "out", log=open_log(SAMPLE))
    ran = run(
        "convert", SAMPLE, "--labels", tmp_path / "out/openlabel.json", "--cameras", "front", "-o", tmp_path / "log"
    )
    assert ran.code == 0, ran.line
    labels = open_log(tmp_path / "log").labels
    assert labels is not None
    ids = [agent.id for agent in scenario.agents]
    assert {ids[int(uid) - 1] for uid in labels.track_id} == set(ids)
    for uid in np.unique(labels.track_id):
        rows, agent = labels.track_id == uid, scenario.agents[int(uid) - 1]
        at = agent.at((labels.t_ns[rows] - scenario.t0_ns) / 1e9)
        np.testing.assert_allclose(labels.center_m[rows], np.stack([at.x_m, at.y_m, at.z_m], -1), atol=1e-5)
        np.testing.assert_allclose(wrap_angle(labels.yaw_rad[rows] - at.yaw_rad), 0, atol=1e-6)
        assert set(labels.category[rows]) == {agent.category}


@pytest.mark.peers
@pytest.mark.parametrize("with_log", [True, False])
def test_the_schema_has_no_complaint(with_log: bool, tmp_path: Path) -> None:
    check = peer("openlabel")
    written(Scenario.load(SAMPLE / "truth.json"), tmp_path, **({"log": open_log(SAMPLE)} if with_log else {}))
    found = json.loads(check(ROOT / "tests/peers/openlabel_check.py", tmp_path / "openlabel.json"))
    assert found == {"complaints": []}
