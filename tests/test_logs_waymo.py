"""Waymo, version 1: a synthetic world with exact truth written by the schema, damaged files, and the recorded frame."""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import SHARED
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from log_encoders import waymo
from log_encoders.world import labels_at, world_log
from typer.testing import CliRunner

from log2sim.cli import app
from log2sim.config import Config
from log2sim.datatypes import Log, Stream
from log2sim.errors import ConfigError, LogError, RecordError
from log2sim.geometry import Camera, apply, box_iou, inverse, points_in_box, project, project_boxes, wrap_angle
from log2sim.logs.opening import open_log
from log2sim.logs.waymo import reader, tfrecord
from log2sim.logs.waymo.messages import WireError
from log2sim.logs.waymo.reader import PACIFICA, camera_of, ego_vehicle_of
from log2sim.logs.waymo.segment import CameraCalibration, LaserCalibration
from log2sim.pipeline import reconstruct

START_BYTES = 12


@pytest.fixture(scope="module")
def world() -> Log:
    return world_log()


@pytest.fixture(scope="module")
def segment(world: Log) -> waymo.Segment:
    return waymo.segment_of(world)


@pytest.fixture(scope="module")
def path(world: Log, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return waymo.encode(world, tmp_path_factory.mktemp("waymo"))


@pytest.fixture(scope="module")
def log(path: Path) -> Log:
    return open_log(path)


def write(segment: waymo.Segment, path: Path) -> Path:
    path.write_bytes(b"".join(waymo.record(waymo.frame_message(segment, frame)) for frame in segment.frames))
    return path


def changed(segment: waymo.Segment, change: Callable[[waymo.Frame], None], *chosen: int) -> waymo.Segment:
    """A segment of which some frames are changed copies."""
    frames = list(segment.frames)
    for k in chosen:
        frames[k] = replace(frames[k], images=dict(frames[k].images), lasers=dict(frames[k].lasers))
        change(frames[k])
    return replace(segment, frames=frames)


def problem_of(stream: Stream, i: int) -> str:
    """Why a record cannot be read; empty when it can."""
    try:
        stream.read(i)
    except RecordError as error:
        return str(error)
    return ""


def true_points(world: Log, k: int) -> np.ndarray:
    """Points (N, 3) of a sweep of the world in its map, and their times."""
    sweep = world.streams["top"].read(k)
    poses = world.map_T_sensor("top", sweep.t_ns)[0]
    return np.einsum("nij,nj->ni", poses[:, :3, :3], sweep.xyz_m) + poses[:, :3, 3]


def test_points_lie_where_they_were_measured(world: Log, log: Log) -> None:
    """Both returns, while the ego turns at 6 m/s: to the 4 mm of poses in single precision 42 km from the world's zero."""
    from scipy.spatial import cKDTree

    for k in (0, 4):
        sweep, source = log.streams["LIDAR_TOP"].read(k), world.streams["top"].read(k)
        assert sweep.compensated_ns == sweep.stamp_ns == log.streams["LIDAR_TOP"].t_ns[k]
        map_T_lidar = log.map_T_sensor("LIDAR_TOP", sweep.compensated_ns)[0][0]
        off, nearest = cKDTree(true_points(world, k)).query(apply(map_T_lidar, sweep.xyz_m))
        assert len(np.unique(nearest)) == len(sweep.xyz_m) == len(source.xyz_m)
        assert off.max() < 0.005
        # The synthetic columns are timed by their ends, half a column after their middles.
        assert np.abs(sweep.t_ns - source.t_ns[nearest]).max() < 0.51 * waymo.PERIOD_NS / 360


def test_boxes_are_where_the_lidar_saw_them(world: Log, log: Log) -> None:
    assert log.labels is not None
    assert world.labels is not None
    for track in ("car", "parked", "walker"):
        rows = np.flatnonzero(log.labels.track_id == track)
        assert len(rows) >= 9
        assert np.all(np.diff(log.labels.t_ns[rows]) > 0)
        center, size, yaw = labels_at(world.labels, log.labels.t_ns[rows], track)
        np.testing.assert_allclose(log.labels.center_m[rows], center, atol=0.01)
        np.testing.assert_allclose(log.labels.size_m[rows], np.tile(size, (len(rows), 1)))
        np.testing.assert_allclose(wrap_angle(log.labels.yaw_rad[rows] - yaw), 0, atol=1e-3)
    assert set(log.labels.category) == {"car", "pedestrian"}
    assert "labels left out because they are no road users: sign (10)" in log.notes


def test_a_box_holds_the_points_that_were_measured_at_its_time(log: Log) -> None:
    """All points on and around an object lie in its box."""
    assert log.labels is not None
    sweep = log.streams["LIDAR_TOP"].read(5)
    xyz = apply(log.map_T_sensor("LIDAR_TOP", sweep.stamp_ns)[0][0], sweep.xyz_m)
    rows = np.flatnonzero(np.abs(log.labels.t_ns - sweep.stamp_ns) < waymo.PERIOD_NS / 2)
    assert len(rows) == 3
    for row in rows:
        box = log.labels.center_m[row], log.labels.size_m[row], float(log.labels.yaw_rad[row])
        above = xyz[:, 2] > 0.1
        inside = points_in_box(xyz[above], *box, margin_m=0.04)
        near = points_in_box(xyz[above], *box, margin_m=0.5)
        assert inside.sum() >= 5
        assert inside.sum() == near.sum()


def test_poses_are_kept_at_the_stamps_of_frames_and_images(world: Log, log: Log) -> None:
    assert log.ego is not None
    assert world.ego is not None
    assert log.map.offset_m == tuple(waymo.WORLD_OFFSET_M)
    assert set(log.streams["LIDAR_TOP"].t_ns.tolist()) <= set(log.ego.t_ns.tolist())
    np.testing.assert_allclose(log.ego.map_T_ego, world.ego.at(log.ego.t_ns)[0], atol=1e-9)


def test_images_are_stamped_in_the_middle_of_their_exposure(world: Log, log: Log) -> None:
    np.testing.assert_allclose(log.streams["FRONT"].t_ns, world.streams["front"].t_ns, atol=300)
    image = log.streams["FRONT"].read(3)
    assert image.shape == (300, 480, 3)
    assert log.reference_camera == "FRONT"
    assert np.abs(image.astype(int) - world.streams["front"].read(3)).mean() < 4
    assert log.streams["FRONT"].encoded is not None
    assert log.streams["FRONT"].encoded(3)[:2] == b"\xff\xd8"


def test_labels_of_images_are_those_around_the_projected_boxes(log: Log) -> None:
    assert log.labels is not None
    labels, camera = log.image_labels["FRONT"], log.cameras["FRONT"]
    assert list(log.image_labels) == ["FRONT"]
    assert len(labels.t_ns) >= 20
    assert "labels of images are the 3D labels projected into them" in log.notes
    row = int(np.flatnonzero(log.labels.track_id == "parked")[0])
    t_ns = int(log.streams["FRONT"].t_ns[0])
    cam_T_map = inverse(log.map_T_sensor("FRONT", t_ns)[0][0])
    one = slice(row, row + 1)
    box = project_boxes(
        log.labels.center_m[one], log.labels.size_m[one], log.labels.yaw_rad[one], camera, cam_T_map
    ).box_px
    np.testing.assert_allclose(box_iou(box, labels.box_px[labels.t_ns == t_ns]).max(), 1.0, atol=0.01)


def test_labels_drawn_in_images_serve_where_none_are_projected(segment: waymo.Segment, tmp_path: Path) -> None:
    drawn = [
        waymo.Box("x", 2, np.array([100.0, 50.0]), np.array([20.0, 60.0])),
        waymo.Box("y", 3, np.ones(2), np.ones(2)),
    ]
    frame = replace(segment.frames[0], projected={})
    body = waymo.whole(1, 1) + b"".join(waymo.message(2, waymo.label_message(box)) for box in drawn)
    data = waymo.frame_message(segment, frame) + waymo.message(8, body)
    (tmp_path / "a.tfrecord").write_bytes(waymo.record(data))
    log = open_log(tmp_path / "a.tfrecord")
    np.testing.assert_array_equal(log.image_labels["FRONT"].box_px, [[90, 20, 110, 80]])
    assert log.image_labels["FRONT"].category.tolist() == ["pedestrian"]
    assert "labels of images are the boxes drawn in them" in log.notes


@pytest.mark.parametrize(
    ("read", "told"),
    [
        ("read_box", "1 labels are damaged or of no frame"),
        ("read_camera_labels", "1 boxes in images of 'FRONT' are damaged"),
    ],
)
def test_damaged_labels_are_counted(path: Path, monkeypatch: pytest.MonkeyPatch, read: str, told: str) -> None:
    sound, calls = getattr(reader, read), []

    def broken(*arguments: object) -> object:
        calls.append(arguments)
        if len(calls) == 1:
            raise WireError("cut")
        return sound(*arguments)

    monkeypatch.setattr(reader, read, broken)
    assert sum(note.startswith(told) for note in open_log(path).notes) == 1


def test_zones_without_labels_are_counted(segment: waymo.Segment, tmp_path: Path) -> None:
    frames = [waymo.frame_message(segment, frame) for frame in segment.frames[:3]]
    zone = waymo.message(7, waymo.fixed64(1, 1.0) * 3 + waymo.fixed64(2, 2.0) * 3)
    path = tmp_path / "a.tfrecord"
    path.write_bytes(b"".join(waymo.record(data) for data in (frames[0] + 2 * zone, frames[1], frames[2] + zone)))
    assert "2 of 3 frames have zones in which objects are not labeled" in open_log(path).notes


def test_a_camera_looks_along_its_x_axis() -> None:
    """Closed form: u = f (-y / x), v = f (-z / x) with OpenCV's lens on both, in the data set's axes."""
    rng = np.random.default_rng(5)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    vehicle_T_camera = np.eye(4)
    vehicle_T_camera[:3, :3], vehicle_T_camera[:3, 3] = turn * np.linalg.det(turn), [1.5, 0.2, 2.0]
    f_u, f_v, c_u, c_v, k1, k2, p1, p2, k3 = lens = np.array(
        [2045.0, 2040, 950, 630, 0.04, -0.33, 0.001, -0.0016, 0.02]
    )
    camera = camera_of("FRONT", CameraCalibration(lens, vehicle_T_camera, 1920, 1280, 2), [], 1)
    p = rng.uniform([5, -2, -1.2], [60, 2, 1.2], (50, 3))
    x, y = -p[:, 1] / p[:, 0], -p[:, 2] / p[:, 0]
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = f_u * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + c_u
    v = f_v * (y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)) + c_v
    uv, _ = project(camera, apply(inverse(camera.mount_T_cam), apply(vehicle_T_camera, p)))
    np.testing.assert_allclose(uv, np.stack([u, v], axis=1), atol=1e-6)


@pytest.mark.parametrize(
    ("number", "direction"), [(0, None), (1, "down"), (2, "right"), (3, "up"), (4, "left"), (5, None)]
)
def test_rolling_shutters_are_read_as_the_schema_says(
    segment: waymo.Segment, tmp_path: Path, number: int, direction: str | None
) -> None:
    camera = segment.cameras[1][0]
    one = replace(segment, cameras={1: (camera, number)}, frames=segment.frames[:1])
    shutter = open_log(write(one, tmp_path / "a.tfrecord")).cameras["FRONT"].rolling_shutter
    assert (shutter and shutter.direction) == direction
    if shutter:
        assert shutter.readout_s == pytest.approx(2 * waymo.HALF_EXPOSED_S - waymo.SHUTTER_S, abs=1e-6)


def test_short_range_lidars_share_the_frame_and_have_no_times(segment: waymo.Segment, tmp_path: Path) -> None:
    mount = waymo.transform(waymo.rotation_from_rpy(0, 0, 1.0), np.array([4.0, 0.0, 0.7]))
    image = np.full((5, 8, 4), 6.0, np.float32)
    one = replace(
        segment, lasers=segment.lasers | {2: waymo.Laser(mount, np.zeros(0), (-1.5, 0.5))}, frames=segment.frames[:1]
    )
    one = changed(one, lambda frame: frame.lasers.update({2: waymo.Ranges([image])}), 0)
    log = open_log(write(one, tmp_path / "a.tfrecord"))
    assert list(log.lidars) == ["LIDAR_TOP", "LIDAR_FRONT"]
    sweep = log.streams["LIDAR_FRONT"].read(0)
    assert sweep.t_ns is None
    assert sweep.compensated_ns == log.streams["LIDAR_TOP"].t_ns[0]
    np.testing.assert_allclose(np.linalg.norm(sweep.xyz_m, axis=1), 6.0, rtol=1e-6)
    assert np.degrees(np.arcsin(sweep.xyz_m[:, 2].max() / 6)) == pytest.approx(np.degrees(0.3), abs=1e-4)
    assert "no times of points of the short-range LiDARs" in log.notes


def test_opening_reads_neither_pictures_nor_points(
    segment: waymo.Segment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    big = waymo.Ranges([np.random.default_rng(0).normal(size=(64, 200, 4)).astype(np.float32)])
    path = write(changed(segment, lambda f: f.lasers.update({1: big}), *range(10)), tmp_path / "a.tfrecord")
    read: list[int] = []
    read_at = tfrecord.read_at
    monkeypatch.setattr(tfrecord, "read_at", lambda file, at, size: read.append(size) or read_at(file, at, size))
    monkeypatch.setattr(tfrecord.RecordFile, "read", None)
    log = open_log(path)
    assert len(log.streams["LIDAR_TOP"].t_ns) == 10
    assert sum(read) < 10 * 30_000 < path.stat().st_size
    before = len(read)
    assert log.labels is not None
    assert len(log.image_labels["FRONT"].t_ns)
    assert len(read) > before


def test_a_folder_of_files_is_several_sequences(segment: waymo.Segment, tmp_path: Path) -> None:
    for name in ("b", "a"):
        write(replace(segment, name=name, frames=segment.frames[:1]), tmp_path / f"segment-{name}.tfrecord")
    with pytest.raises(ConfigError, match=r"holds 2 sequences.*segment-a, segment-b"):
        open_log(tmp_path)
    assert open_log(tmp_path, sequence="segment-b").name == "waymo-b"
    assert open_log(tmp_path / "segment-a.tfrecord").name == "waymo-a"


def test_a_truncated_file_keeps_all_whole_frames(path: Path, log: Log, tmp_path: Path) -> None:
    data = path.read_bytes()
    (tmp_path / "a.tfrecord").write_bytes(data[:-100])
    cut = open_log(tmp_path / "a.tfrecord")
    np.testing.assert_array_equal(cut.streams["LIDAR_TOP"].t_ns, log.streams["LIDAR_TOP"].t_ns[:-1])
    assert any("record 9" in note and "truncated" in note for note in cut.notes)
    np.testing.assert_array_equal(cut.streams["LIDAR_TOP"].read(8).xyz_m, log.streams["LIDAR_TOP"].read(8).xyz_m)


def test_validate_tells_what_was_kept_out(path: Path, tmp_path: Path) -> None:
    cut = tmp_path / "cut.tfrecord"
    cut.write_bytes(path.read_bytes()[:-100])
    told = CliRunner().invoke(app, ["validate", str(cut)]).output
    assert re.search(r"note: .*cut\.tfrecord: record 9 at offset \d+ is truncated", told), told


def test_a_damaged_frame_loses_its_own_records_only(path: Path, tmp_path: Path) -> None:
    data = bytearray(path.read_bytes())
    middle = data.index(b"\xff\xd8\xff", len(data) // 2)
    data[middle + 500] ^= 1
    (tmp_path / "a.tfrecord").write_bytes(data)
    log = open_log(tmp_path / "a.tfrecord")
    records = [(stream, i) for stream in log.streams.values() for i in range(len(stream.t_ns))]
    problems = [problem for stream, i in records if (problem := problem_of(stream, i))]
    assert len(problems) == 2
    for problem in problems:
        assert re.search(r"a\.tfrecord \(record \d, stamp \d+ us\): damaged: the CRC of its \d+ bytes", problem)
        assert "\n" not in problem


def test_frames_without_a_use_are_kept_out_with_a_note(segment: waymo.Segment, tmp_path: Path) -> None:
    whole = [waymo.frame_message(segment, frame) for frame in segment.frames[:6]]
    stretched = replace(segment.frames[1], world_T_vehicle=2 * segment.frames[1].world_T_vehicle)
    whole[1] = waymo.frame_message(segment, stretched)
    whole[2] = waymo.frame_message(replace(segment, name="other"), segment.frames[2])
    whole[3] = b"no frame at all"
    whole[4] = b""
    path = tmp_path / "a.tfrecord"
    path.write_bytes(b"".join(map(waymo.record, whole)))
    log = open_log(path)
    assert len(log.streams["LIDAR_TOP"].t_ns) == 2
    assert any(note.startswith("4 of 6 records left out; record 1: no rigid pose") for note in log.notes)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "no usable frame; the file is empty"),
        (waymo.record(b""), "timestamp_micros is None"),
        (
            waymo.record(waymo.message(1, waymo.message(2, waymo.whole(1, 1)))),
            "calibration of camera 1: expected 9 finite",
        ),
        (
            waymo.record(waymo.message(1, waymo.message(3, waymo.whole(1, 1)))),
            "calibration of LiDAR 1: expected a rigid",
        ),
        (waymo.record(waymo.whole(2, 5)) + b"x", "no rigid pose"),
    ],
)
def test_a_file_without_a_usable_frame_is_refused_in_one_line(tmp_path: Path, data: bytes, words: str) -> None:
    (tmp_path / "a.tfrecord").write_bytes(data)
    with pytest.raises(LogError) as caught:
        open_log(tmp_path / "a.tfrecord", format="waymo")
    assert "a.tfrecord" in str(caught.value)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_segment_with_pictures_alone_has_no_lidar(segment: waymo.Segment, tmp_path: Path) -> None:
    log = open_log(write(changed(segment, lambda frame: frame.lasers.clear(), *range(10)), tmp_path / "a.tfrecord"))
    assert not log.lidars
    assert list(log.streams) == ["FRONT"]
    assert log.labels is not None
    assert "the frames hold no range images: there are no sweeps" in log.notes


def test_a_segment_without_pictures_takes_the_middle_of_the_turn(segment: waymo.Segment, tmp_path: Path) -> None:
    log = open_log(write(changed(segment, lambda frame: frame.images.clear(), *range(10)), tmp_path / "a.tfrecord"))
    assert not log.cameras
    assert log.reference_camera is None
    starts = np.array([frame.stamp_us * 1000 for frame in segment.frames])
    np.testing.assert_array_equal(log.streams["LIDAR_TOP"].t_ns, starts + waymo.PERIOD_NS // 2)
    assert any("is missing there: the middle of the LiDAR's turn is assumed" in note for note in log.notes)


def test_a_pose_that_is_not_that_of_the_front_image_is_told(segment: waymo.Segment, tmp_path: Path) -> None:
    def move(frame: waymo.Frame) -> None:
        moved = frame.images[1].world_T_vehicle.copy()
        moved[0, 3] += 0.5
        frame.images[1] = replace(frame.images[1], world_T_vehicle=moved)

    log = open_log(write(changed(segment, move, 3), tmp_path / "a.tfrecord"))
    assert any("up to 0.50 m from that of the FRONT image" in note for note in log.notes)
    assert log.ego is not None
    pose, _ = log.ego.at(log.streams["LIDAR_TOP"].t_ns[3])
    np.testing.assert_allclose(pose[0, :3, 3] + waymo.WORLD_OFFSET_M, segment.frames[3].world_T_vehicle[:3, 3])


def test_a_sensor_without_calibration_is_left_out_with_a_note(segment: waymo.Segment, tmp_path: Path) -> None:
    log = open_log(write(replace(segment, lasers={}), tmp_path / "a.tfrecord"))
    assert not log.lidars
    assert "LIDAR_TOP: 10 sweeps left out: no calibration of this LiDAR" in log.notes
    with pytest.raises(LogError, match="neither images nor range images"):
        open_log(write(replace(segment, lasers={}, cameras={}), tmp_path / "b.tfrecord"))


def test_a_range_image_that_does_not_fit_is_the_error_of_its_sweep(segment: waymo.Segment, tmp_path: Path) -> None:
    odd = waymo.Ranges([np.ones((3, 360, 4), np.float32)])
    log = open_log(write(changed(segment, lambda frame: frame.lasers.update({1: odd}), 4), tmp_path / "a.tfrecord"))
    with pytest.raises(RecordError, match=r"record 4, LIDAR_TOP .*3 rows, the calibration 20 beams"):
        log.streams["LIDAR_TOP"].read(4)
    assert len(log.streams["LIDAR_TOP"].read(3).xyz_m) > 1000


def test_the_ego_is_as_long_as_its_lidars_are_apart() -> None:
    def lasers(front_m: float, rear_m: float) -> dict[int, LaserCalibration]:
        places = {2: front_m, 5: rear_m}
        return {
            k: LaserCalibration(waymo.transform(np.eye(3), [x, 0, 0.6]), np.zeros(0), (0, 0)) for k, x in places.items()
        }

    assert ego_vehicle_of(lasers(4.07, -1.155)) is PACIFICA
    assert ego_vehicle_of({}) is PACIFICA
    shorter = ego_vehicle_of(lasers(3.7, -1.0))
    assert shorter.size_m[0] == pytest.approx(4.7)
    assert shorter.rear_axle_offset_m == pytest.approx(1.35)


@pytest.fixture(scope="module")
def small(segment: waymo.Segment, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    tiny = replace(segment, frames=segment.frames[:2])
    return write(tiny, tmp_path_factory.mktemp("small") / "a.tfrecord").read_bytes()


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_a_damaged_file_is_read_or_refused(small: bytes, tmp_path: Path, data: st.DataObject) -> None:
    """Whatever is overwritten or cut, with valid checksums or not: a log or one of the errors of logs."""
    damaged = bytearray(small)
    for _ in range(data.draw(st.integers(1, 5))):
        # Most of the file are pictures and ranges: half of the places are in the calibration and the poses before them.
        at = data.draw(st.one_of(st.integers(0, 1500), st.integers(0, len(damaged) - 1)))
        damaged[at] = data.draw(st.sampled_from([0, 1, 2, 127, 128, 255, damaged[at] ^ 4]))
    damaged = damaged[: data.draw(st.sampled_from([len(damaged), len(damaged), len(damaged) // 2, 40]))]
    if data.draw(st.booleans()):
        damaged = bytearray(waymo.record(bytes(damaged[START_BYTES : START_BYTES + 8000])))
    path = tmp_path / "a.tfrecord"
    path.write_bytes(damaged)
    with suppress(LogError):
        log = open_log(path, format="waymo")
        assert log.labels is None or len(log.labels.t_ns) >= 0
        for stream in log.streams.values():
            stream.read(0)


@pytest.fixture(scope="module")
def recorded() -> Log:
    path = SHARED / "data" / "waymo" / "pvps_data_one_frame.tfrecord"
    if not path.is_file():
        pytest.skip("the recorded frame is not beside this checkout (../shared/data/waymo)")
    return open_log(path)


@pytest.mark.real
def test_the_recorded_frame_has_its_cameras_and_labels(recorded: Log) -> None:
    assert recorded.labels is not None
    assert not recorded.lidars
    assert list(recorded.cameras) == ["FRONT", "FRONT_LEFT", "FRONT_RIGHT", "SIDE_LEFT", "SIDE_RIGHT"]
    assert {c: s.read(0).shape for c, s in recorded.streams.items()} == {
        c: (camera.height_px, camera.width_px, 3) for c, camera in recorded.cameras.items()
    }
    kinds, counts = np.unique(recorded.labels.kind, return_counts=True)
    assert dict(zip(kinds.tolist(), counts.tolist())) == {"cyclist": 1, "pedestrian": 12, "vehicle": 37}
    assert "labels left out because they are no road users: sign (25)" in recorded.notes
    assert all(c.rolling_shutter and c.rolling_shutter.direction == "right" for c in recorded.cameras.values())
    assert recorded.map.offset_m == (-25000.0, 42000.0, 0.0)


@pytest.mark.real
def test_the_recorded_boxes_project_onto_their_projected_labels(recorded: Log) -> None:
    """The vehicle stands still: our projection of 3D labels through lens and mounts is the data set's own, but for moving ones."""
    assert recorded.labels is not None
    overlaps: list[float] = []
    for name, camera in recorded.cameras.items():
        given_px = recorded.image_labels[name].box_px
        t_ns = int(recorded.streams[name].t_ns[0])
        cam_T_map = inverse(recorded.map_T_sensor(name, t_ns)[0][0])
        found = project_boxes(
            recorded.labels.center_m, recorded.labels.size_m, recorded.labels.yaw_rad, camera, cam_T_map
        )
        overlaps += box_iou(given_px, found.box_px[found.valid]).max(axis=1).tolist()
    assert len(overlaps) == 40
    assert np.median(overlaps) > 0.97
    assert min(overlaps) > 0.8
    assert isinstance(recorded.cameras["FRONT"], Camera)


@pytest.mark.real
def test_the_recorded_frame_is_reconstructed_from_its_labels(recorded: Log) -> None:
    """One moment without LiDAR: objects are placed by the road that the cameras see, the near ones to about a meter."""
    scenario = reconstruct(recorded, Config.load(detect={"name": "labels"})).scenario
    assert recorded.labels is not None
    assert scenario.ego is not None
    at = {agent.id: np.array([agent.waypoints.x_m[0], agent.waypoints.y_m[0]]) for agent in scenario.agents}
    ego = at.pop("ego")
    near = [place for place in at.values() if np.linalg.norm(place - ego) < 30.0]
    off = [np.linalg.norm(recorded.labels.center_m[:, :2] - place, axis=1).min() for place in near]
    assert len(near) >= 10
    assert np.median(off) < 1.5


@pytest.mark.slow
def test_the_scenario_is_that_of_the_world_itself(world: Log, log: Log) -> None:
    """Written in the format and read again, by pictures with LiDAR and by LiDAR alone."""
    for detector in ("labels", "lidar:labels"):
        ours, theirs = (
            {agent.id: agent for agent in reconstruct(of, Config.load(detect={"name": detector})).scenario.agents}
            for of in (log, world)
        )
        assert set(ours) == set(theirs)
        for name, agent in theirs.items():
            t_s = agent.waypoints.t_s[[0, -1]]
            for axis in ("x_m", "y_m"):
                # Where a scenario begins differs by the stamps of the first tick.
                np.testing.assert_allclose(
                    getattr(ours[name].at(t_s, margin_s=0.1), axis), getattr(agent.at(t_s), axis), atol=0.15
                )
