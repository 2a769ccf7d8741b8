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
from command_line import names, run
from export_worlds import REAR_M, ROOT, circling, moved, peer, straight, world

from log2sim import open_log
from log2sim.datatypes import Log, Scenario, Stream
from log2sim.errors import ConfigError, RecordError, ScenarioError
from log2sim.export.exporters import Options, export
from log2sim.export.viewers import (
    MAX_IMAGE_PX,
    MAX_SWEEP_POINTS,
    CameraFrame,
    ThinnedSweep,
    agent_steps,
    viewer_records,
)
from log2sim.geometry import NS_PER_S, Camera, apply, box_corners, inverse, points_in_box

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


def test_who_is_gone_is_no_longer_shown(tmp_path: Path) -> None:
    """Every update deletes all before, so that scrubbing back and forth shows the same."""
    late = straight("late", start=(0.0, 9.0), t_s=np.array([1.0, 1.5, 2.0]))
    updates = on("/agents", written(world(straight("ego"), late), tmp_path))
    assert [k for k, (_, u) in enumerate(updates) if "late" in {e.id for e in u.entities}] == list(range(10, 21))
    assert all(u.deletions[0].type == u.deletions[0].ALL for _, u in updates)


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


def test_messages_are_in_order_of_time(scenario: Scenario, log: Log, tmp_path: Path) -> None:
    found = written(scenario, tmp_path, log)
    assert [t for t, _, _ in found] == sorted(t for t, _, _ in found)
    assert {topic.split("/")[1] for _, topic, _ in found} == {"agents", "paths", "tf", "camera", "lidar"}


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


def test_wide_pictures_are_made_smaller_with_their_calibration(scenario: Scenario, log: Log) -> None:
    """The same picture at four times the size shows boxes at the same places, in pixels of the smaller one."""
    camera = log.cameras["front"]
    K = camera.K * [[4], [4], [1]]
    K[:2, 2] += 1.5  # the middle of the first pixel is (0, 0) at every size
    wide = replace(camera, width_px=4 * camera.width_px, height_px=4 * camera.height_px, K=K)
    stream = log.streams["front"]
    big = replace(stream, read=lambda i: np.repeat(np.repeat(stream.read(i), 4, axis=0), 4, axis=1))
    both = [
        next(viewer_records(scenario, replace(log, cameras={"front": c}, lidars={}, streams={"front": s})))
        for c, s in ((wide, big), (camera, stream))
    ]
    a, b = both
    assert isinstance(a, CameraFrame)
    assert isinstance(b, CameraFrame)
    assert a.camera.width_px == MAX_IMAGE_PX
    factor = np.array([896, 520]) / [MAX_IMAGE_PX, a.camera.height_px]
    for (agent, line), (other, same) in zip(a.outlines, b.outlines, strict=True):
        assert agent is other
        np.testing.assert_allclose((line + 0.5) * factor - 0.5, same, atol=1e-6)


@pytest.mark.parametrize(
    ("model", "given", "named", "count"),
    [
        ("none", (), "", 0),
        ("brown", (0.1, 0.01, 0.0, 0.0), "plumb_bob", 5),
        ("brown", (0.1,) * 8, "rational_polynomial", 8),
        ("fisheye", (0.1, 0.0, 0.0, 0.0), "kannala_brandt", 4),
    ],
)
def test_lenses_have_foxgloves_names(model: str, given: tuple[float, ...], named: str, count: int) -> None:
    foxglove = pytest.importorskip("log2sim.export.foxglove", exc_type=ImportError)
    camera = Camera("c", 64, 48, np.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]]), "ego", np.eye(4), model, given)
    found = {topic: m for _, topic, m in foxglove.record_messages(CameraFrame(0, camera, None, b"", ()), np.zeros(3))}
    calibration = found["/camera/c/calibration"]
    assert (calibration.distortion_model, len(calibration.D)) == (named, count)
    assert list(calibration.K) == [50, 0, 32, 0, 50, 24, 0, 0, 1]
    assert list(calibration.P) == [50, 0, 32, 0, 0, 50, 24, 0, 0, 0, 1, 0]


def test_a_record_that_cannot_be_read_is_named_and_the_rest_goes_on(
    scenario: Scenario, log: Log, tmp_path: Path
) -> None:
    stream = log.streams["front"]

    def read(i: int) -> Any:
        if i == 1:
            raise RecordError("front/000010.jpg: not a JPEG")
        return stream.read(i)

    broken = replace(log, streams={**log.streams, "front": replace(stream, read=read)})
    found = written(scenario, tmp_path, broken)
    ((_, warning),) = on("/log", found)
    assert (warning.name, warning.message) == ("front", "front/000010.jpg: not a JPEG")
    assert len(on("/camera/front/image", found)) == len(on("/camera/front_left/image", found)) - 1


def test_sweeps_are_thinned_and_put_into_the_map_at_their_points_own_time(scenario: Scenario, log: Log) -> None:
    """A sensor that turns while it drives sees a wall straight only if every point has its own pose."""
    sweep = log.streams["lidar_top"].read(0)
    many = replace(
        sweep, xyz_m=np.tile(sweep.xyz_m, (5, 1)), t_ns=None if sweep.t_ns is None else np.tile(sweep.t_ns, 5)
    )
    stream = replace(log.streams["lidar_top"], t_ns=log.streams["lidar_top"].t_ns[:1], read=lambda _: many)
    cloud = next(viewer_records(scenario, replace(log, streams={"lidar_top": stream})))
    assert isinstance(cloud, ThinnedSweep)
    assert len(cloud.points_map) <= MAX_SWEEP_POINTS < len(many.xyz_m)
    assert many.t_ns is not None
    step = -(-len(many.xyz_m) // MAX_SWEEP_POINTS)
    poses, _ = log.map_T_sensor("lidar_top", many.t_ns[::step])
    expected = (poses[7] @ [*many.xyz_m[7 * step], 1])[:3]
    np.testing.assert_allclose(cloud.points_map[7], expected, atol=1e-3)  # poses hold for half a millisecond


def test_a_log_of_another_time_is_refused(scenario: Scenario, log: Log, tmp_path: Path) -> None:
    pytest.importorskip("mcap_protobuf")
    late = replace(scenario, t0_ns=scenario.t0_ns + 10**15)
    with pytest.raises(ConfigError, match="no picture and no sweep between"):
        export(late, "mcap", tmp_path / "out", Options(log=log))
    assert names(tmp_path) == []


def test_stamps_before_1970_are_refused(tmp_path: Path) -> None:
    pytest.importorskip("mcap_protobuf")
    with pytest.raises(ScenarioError, match="before 1970"):
        export(replace(world(circling()), t0_ns=-(10**15)), "mcap", tmp_path / "out")


def test_the_command_opens_the_log(tiny_folder: Path, tmp_path: Path) -> None:
    pytest.importorskip("mcap_protobuf")
    ran = run("export", tiny_folder / "truth.json", "--to", "mcap", "--out", tmp_path, "--log", tiny_folder)
    assert ran.code == 0, ran.err
    (file,) = tmp_path.iterdir()
    assert any(topic.startswith("/camera/") for _, topic, _ in messages(file))
    assert (
        run("export", tiny_folder / "truth.json", "--to", "mcap", "--out", tmp_path, "--log", tmp_path / "no").code == 3
    )


Rows = list[tuple[str, int | None, dict[str, Any]]]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Callable[..., str], Path, Path]:
    """Rerun's command, and the sample with its log as recording, written twice."""
    python = peer("rerun")
    out = tmp_path_factory.mktemp("rerun")
    for folder in ("a", "b"):
        python(
            "-W",
            "error",
            "-m",
            "log2sim",
            "export",
            SAMPLE / "truth.json",
            "--to",
            "rerun",
            "--out",
            out / folder,
            "--log",
            SAMPLE,
        )
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
def test_rerun_projects_as_the_camera_does(recorded: tuple[Callable[..., str], Path, Path]) -> None:
    """Pose and intrinsics, which Rerun stores column by column, take a point of the map to its pixel."""
    python, file, _ = recorded
    rows: Rows = json.loads(python(ROOT / "tests" / "peers" / "rerun_read.py", file, "/cameras/front_left"))
    log = open_log(SAMPLE)
    t_ns, pose = next((t, v) for _, t, v in rows if t is not None and "Transform3D:mat3x3" in v)
    (lens,) = (v for _, _, v in rows if "Pinhole:image_from_camera" in v)
    rotation = np.reshape(pose["Transform3D:mat3x3"][0], (3, 3)).T
    K = np.reshape(lens["Pinhole:image_from_camera"][0], (3, 3)).T
    map_T_cam = log.map_T_sensor("front_left", t_ns)[0][0]
    np.testing.assert_allclose(rotation, map_T_cam[:3, :3], atol=1e-6)
    np.testing.assert_allclose(pose["Transform3D:translation"][0], map_T_cam[:3, 3], atol=1e-5)
    np.testing.assert_allclose(K, log.cameras["front_left"].K, rtol=1e-6)
    assert lens["Pinhole:resolution"][0] == [896.0, 520.0]


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


@pytest.mark.peers
def test_rerun_shows_nobody_after_the_end_of_its_life(tmp_path: Path) -> None:
    python = peer("rerun")
    late = straight("late", start=(0.0, 9.0), t_s=np.array([1.0, 1.5, 2.0]))
    scenario = world(straight("ego"), late)
    scenario.save(tmp_path / "s.json")
    python("-m", "log2sim", "export", tmp_path / "s.json", "--to", "rerun", "--out", tmp_path / "out")
    rows: Rows = json.loads(
        python(ROOT / "tests" / "peers" / "rerun_read.py", tmp_path / "out" / "world.rrd", "/agents/late")
    )
    cleared = [t for _, t, v in rows if t is not None and any("Clear" in key for key in v)]
    assert cleared == [scenario.t0_ns + 21 * NS_PER_S // 10]
    assert [t for _, t, v in rows if "Boxes3D:half_sizes" in v] == [
        scenario.t0_ns + k * NS_PER_S // 10 for k in range(10, 21)
    ]


@pytest.mark.peers
def test_rerun_opens_the_mcap_file(scenario: Scenario, log: Log, tmp_path: Path) -> None:
    pytest.importorskip("mcap_protobuf")
    (file,) = export(scenario, "mcap", tmp_path, Options(log=log))
    python = peer("rerun")
    report = python("-m", "rerun", "mcap", "check", file)
    assert "/camera/front/boxes" in report
    assert all(" ok " in f" {line} " for line in report.splitlines() if "/camera/" in line or "/lidar/" in line)


def test_who_comes_after_the_last_step_is_shown_at_it() -> None:
    late, once = straight("late", t_s=[1.06, 1.09]), straight("once", t_s=[1.09])
    steps = agent_steps(world(straight("ego", t_s=[0.0, 1.0]), late, once))
    assert [np.flatnonzero(m.valid).tolist() for _, m in steps.moves] == [list(range(11)), [10], [10]]
    steps = agent_steps(world(straight("ego", t_s=[0.0, 0.02]), straight("late", t_s=[0.05, 0.08])))
    assert [m.valid.tolist() for _, m in steps.moves] == [[True], [True]]
