"""What viewers are shown of a scenario and its log: MCAP with Foxglove's messages, and Rerun's recordings."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from export_worlds import REAR_M, ROOT, circling, moved, peer, world

from log2sim import open_log
from log2sim.datatypes import Log, Scenario, Stream
from log2sim.export.exporters import Options, export
from log2sim.export.viewers import MAX_SWEEP_POINTS
from log2sim.geometry import NS_PER_S, apply, box_corners, inverse, points_in_box

SAMPLE = ROOT / "samples" / "crossing"


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return Scenario.load(SAMPLE / "truth.json")


@pytest.fixture(scope="module")
def log() -> Log:
    """The sample log with every tenth record only."""
    whole = open_log(SAMPLE)

    def every_tenth(stream: Stream) -> Stream:
        return replace(stream, t_ns=stream.t_ns[::10], read=lambda i: stream.read(10 * i))

    return replace(whole, streams={name: every_tenth(stream) for name, stream in whole.streams.items()})


def messages(file: Path) -> list[tuple[int, str, Any]]:
    """When, where and what, as the reader of the `mcap` package and the schemas within the file have it."""
    decoder = pytest.importorskip("mcap_protobuf.decoder")
    from mcap.reader import make_reader

    with file.open("rb") as opened:
        reader = make_reader(opened, decoder_factories=[decoder.DecoderFactory()])
        return [
            (m.message.log_time, m.channel.topic, m.decoded_message)
            for m in reader.iter_decoded_messages(log_time_order=False)
        ]


def written(scenario: Scenario, folder: Path, log: Log | None = None) -> list[tuple[int, str, Any]]:
    pytest.importorskip("mcap_protobuf")
    pytest.importorskip("foxglove_schemas_protobuf")
    (file,) = export(scenario, "mcap", folder, Options(log=log))
    return messages(file)


def on(topic: str, found: list[tuple[int, str, Any]]) -> list[tuple[int, Any]]:
    return [(t_ns, message) for t_ns, where, message in found if where == topic]


def test_boxes_are_where_the_scenario_has_them(scenario: Scenario, tmp_path: Path) -> None:
    updates = on("/agents", written(scenario, tmp_path))
    assert [t for t, _ in updates] == [scenario.t0_ns + k * NS_PER_S // 10 for k in range(53)]
    for agent in scenario.agents:
        at = agent.at(0.1 * np.arange(53))
        for k, (_, update) in enumerate(updates):
            (entity,) = (e for e in update.entities if e.id == agent.id)
            pose, size = entity.cubes[0].pose, entity.cubes[0].size
            assert (pose.position.x, pose.position.y, pose.position.z) == pytest.approx(
                (at.x_m[k], at.y_m[k], at.z_m[k]), abs=1e-9
            )
            assert 2 * np.arctan2(pose.orientation.z, pose.orientation.w) == pytest.approx(at.yaw_rad[k], abs=1e-9)
            assert (size.x, size.y, size.z) == agent.size_m


def test_the_egos_frame_is_its_rear_axle_on_the_ground(tmp_path: Path) -> None:
    for _, frame in on("/tf", written(world(circling()), tmp_path)):
        assert (frame.parent_frame_id, frame.child_frame_id) == ("map", "ego")
        assert np.hypot(frame.translation.x, frame.translation.y) == pytest.approx(
            12.0, abs=1e-3
        )  # it drives that circle
        assert frame.translation.z == pytest.approx(0.0, abs=1e-9)


def test_large_coordinates_are_taken_off_and_named(tmp_path: Path) -> None:
    from_mcap = pytest.importorskip("mcap.reader")
    found = written(moved(world(circling()), 456_789.125, 5_428_123.25), tmp_path)
    first = on("/agents", found)[0][1].entities[0].cubes[0].pose.position
    with (tmp_path / "world.mcap").open("rb") as opened:
        (about,) = (m.metadata for m in from_mcap.make_reader(opened).iter_metadata() if m.name == "log2sim")
    offset = json.loads(about["position_offset_m"])
    assert (first.x + offset[0], first.y + offset[1]) == pytest.approx((456_801.125, 5_428_123.25 + REAR_M), abs=1e-6)
    assert max(abs(first.x), abs(first.y)) < 8192


def test_pictures_have_the_stamps_of_the_log_and_lines_around_the_agents(
    scenario: Scenario, log: Log, tmp_path: Path
) -> None:
    """Corners projected by OpenCV into the picture are ends of the lines that are drawn for them."""
    found = written(scenario, tmp_path, log)
    images, boxes = on("/camera/front/image", found), on("/camera/front/boxes", found)
    assert [t for t, _ in images] == [t for t in log.streams["front"].t_ns.tolist() if t <= scenario.t0_ns + 5.2e9]
    camera = log.cameras["front"]
    for (t_ns, image), (_, drawn) in zip(images, boxes, strict=True):
        assert cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_COLOR).shape == (520, 896, 3)
        cam_T_map = inverse(log.map_T_sensor("front", t_ns)[0][0])
        by_name = {text.text: line for text, line in zip(drawn.texts, drawn.points)}
        assert "ego" not in by_name
        for agent in scenario.others:
            at = agent.at((t_ns - scenario.t0_ns) / NS_PER_S)
            corners = apply(cam_T_map, box_corners([at.x_m[0], at.y_m[0], at.z_m[0]], agent.size_m, at.yaw_rad)[0])
            pixels = cv2.projectPoints(corners, np.zeros(3), np.zeros(3), camera.K, None)[0][:, 0]
            whole = np.all((corners[:, 2] > 1) & (pixels >= 0).all(axis=1) & (pixels < [896, 520]).all(axis=1))
            if whole:
                ends = np.array([[p.x, p.y] for p in by_name[agent.id].points])
                apart = np.linalg.norm(pixels[:, None] - ends, axis=2).min(axis=1)
                assert apart.max() < 1e-6


def test_points_lie_on_what_the_lidar_saw(scenario: Scenario, log: Log, tmp_path: Path) -> None:
    """Beams end on parked cars and not in the air around them; hardly any below the ground."""
    clouds = [cloud for _, cloud in on("/lidar/lidar_top", written(scenario, tmp_path, log))]
    assert [f.name for f in clouds[0].fields] == ["x", "y", "z"]
    each = [np.frombuffer(cloud.data, "<f4").reshape(-1, 3).astype(float) for cloud in clouds]
    assert all(1000 < len(points) <= MAX_SWEEP_POINTS for points in each)
    points = np.concatenate(each)
    assert np.percentile(points[:, 2], 1) > -0.15
    high = points[points[:, 2] > 0.25]
    for name in ("car_parked", "truck_parked", "car_parked_north"):
        agent = next(a for a in scenario.agents if a.id == name)
        w, size = agent.waypoints, np.array(agent.size_m)
        center = np.array([w.x_m[0], w.y_m[0], w.z_m[0]])
        inside, around = (points_in_box(high, center, size, w.yaw_rad[0], margin).sum() for margin in (0.1, 0.5))
        assert inside >= 50
        assert around - inside < 0.1 * inside


Rows = list[tuple[str, int | None, dict[str, Any]]]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Callable[..., str], Path, Path]:
    """Rerun's command, and the sample with its log as recording, written twice."""
    python = peer("rerun")
    out = tmp_path_factory.mktemp("rerun")
    for folder in ("a", "b"):
        export = f"export {SAMPLE}/truth.json --to rerun --out {out / folder} --log {SAMPLE}"
        python(*f"-W error -m log2sim {export}".split())
    return python, out / "a" / "crossing.rrd", out / "b" / "crossing.rrd"


@pytest.mark.peers
def test_rerun_verifies_its_recording_and_finds_the_same_data_again(
    recorded: tuple[Callable[..., str], Path, Path],
) -> None:
    python, first, second = recorded
    python("-m", "rerun", "rrd", "verify", first)
    python("-m", "rerun", "rrd", "compare", first, second)


@pytest.mark.peers
def test_rerun_has_every_box_at_every_step(recorded: tuple[Callable[..., str], Path, Path], scenario: Scenario) -> None:
    python, file, _ = recorded
    rows: Rows = json.loads(python(ROOT / "tests" / "peers" / "rerun_read.py", file, "/agents/"))
    for agent in scenario.agents:
        own = sorted((t, v) for entity, t, v in rows if entity == f"/agents/{agent.id}" and t is not None)
        at = agent.at((np.array([t for t, _ in own]) - scenario.t0_ns) / NS_PER_S)
        assert len(own) == 53
        centers = np.array([v["Boxes3D:centers"][0] for _, v in own])
        turns = np.array([v["Boxes3D:quaternions"][0] for _, v in own])
        np.testing.assert_allclose(centers, np.stack([at.x_m, at.y_m, at.z_m], -1), atol=1e-5)
        np.testing.assert_allclose(np.sin(2 * np.arctan2(turns[:, 2], turns[:, 3]) - at.yaw_rad), 0.0, atol=1e-5)
        np.testing.assert_allclose(own[0][1]["Boxes3D:half_sizes"][0], np.array(agent.size_m) / 2, atol=1e-6)


@pytest.mark.peers
def test_rerun_has_pictures_with_lines_and_points(recorded: tuple[Callable[..., str], Path, Path]) -> None:
    python, file, _ = recorded
    log = open_log(SAMPLE)

    def read(prefix: str) -> Rows:
        rows: Rows = json.loads(python(ROOT / "tests" / "peers" / "rerun_read.py", file, prefix))
        return rows

    pictures = [t for entity, t, v in read("/cameras/front/") if entity == "/cameras/front/boxes"]
    assert len(pictures) == len(log.streams["front"].t_ns)
    assert {e for e, _, _ in read("/cameras/front")} == {
        f"/cameras/front{k}" for k in ("", "/boxes", "_left", "_left/boxes", "_right", "_right/boxes")
    }
    sweeps = read("/lidar/lidar_top")
    assert sorted(t for _, t, _ in sweeps if t is not None) == log.streams["lidar_top"].t_ns.tolist()
    assert all(0 < len(v["Points3D:positions"]) <= MAX_SWEEP_POINTS for _, _, v in sweeps)
