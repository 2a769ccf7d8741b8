"""Waymo, version 1: a synthetic world written by the schema, damaged files, the recorded frame, and the parts of the format."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import SHARED
from log_encoders import waymo
from log_encoders.waymo import Ranges, laser_message, record
from log_encoders.world import labels_at, world_log

from log2sim.config import Config
from log2sim.datatypes import Log
from log2sim.errors import LogError
from log2sim.geometry import apply, box_iou, inverse, project, project_boxes, rotation_from_rpy, transform, wrap_angle
from log2sim.logs.opening import open_log
from log2sim.logs.waymo.messages import RecordFile, WireError, crc32c, masked_crc32c
from log2sim.logs.waymo.range_images import points_of, read_range_images, row_inclinations, turn_of
from log2sim.logs.waymo.reader import READER, camera_of
from log2sim.logs.waymo.segment import CameraCalibration, LaserCalibration, RangeImages
from log2sim.pipeline import reconstruct


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


LASER = LaserCalibration(np.eye(4), np.array([-0.3, -0.1, 0.0, 0.05]), (0.0, 0.0))


@pytest.mark.parametrize(
    ("message_", "crc"),
    [
        (bytes(32), 0x8A9136AA),
        (b"\xff" * 32, 0x62A8AB43),
        (bytes(range(32)), 0x46DD794E),
        (bytes(range(31, -1, -1)), 0x113FDB5C),
        (bytes.fromhex("01c00000000000000000000000000000140000000000040000000014000000182800000000000000"
                       "0200000000000000"), 0xD9963A56),
        (b"123456789", 0xE3069283),
    ],
)  # fmt: skip
def test_the_crc_is_that_of_rfc_3720(message_: bytes, crc: int) -> None:
    """Vectors of RFC 3720, B.4, and the check value of the catalog of CRC parameters."""
    assert crc32c(message_) == crc


def records_file(path: Path, *parts: bytes) -> Path:
    path.write_bytes(b"".join(parts))
    return path


@pytest.mark.parametrize("cut", [1, 4, 7, 20, 23, 24])
def test_a_truncated_last_record_alone_is_kept_out(tmp_path: Path, cut: int) -> None:
    whole_file = record(b"one") + record(b"second!!")
    file = RecordFile(records_file(tmp_path / "a", whole_file[:-cut]))
    assert [file.read(k, "") for k in range(len(file.spans))] == [b"one"]
    assert cut == 24 or ("record 1 at offset 19" in file.notes[0] and "truncated" in file.notes[0])
    assert len(file.notes) == (cut != 24)


def test_a_damaged_length_keeps_out_what_cannot_be_found(tmp_path: Path) -> None:
    whole_file = bytearray(record(b"one") + record(b"second") + record(b"third"))
    wrong_crc = whole_file.copy()
    wrong_crc[19 + 9] ^= 1
    file = RecordFile(records_file(tmp_path / "a", bytes(wrong_crc)))
    assert [file.read(k, "") for k in range(2)] == [b"one", b"third"]
    assert "record 1 at offset 19: the CRC of its length is wrong; left out" in file.notes[0]
    wrong_length = whole_file.copy()
    wrong_length[19 + 1] = 200
    file = RecordFile(records_file(tmp_path / "b", bytes(wrong_length)))
    assert len(file.spans) == 1
    assert "it and what follows are left out" in file.notes[0]


def test_a_record_that_claims_too_much_is_refused_before_it_is_read(tmp_path: Path) -> None:
    length = struct.pack("<Q", 1 << 40)
    path = records_file(tmp_path / "a", length + struct.pack("<I", masked_crc32c(length)))
    with path.open("r+b") as file:
        file.truncate((1 << 40) + 16)  # a sparse file
    with pytest.raises(LogError, match="more than the"):
        RecordFile(path)


def test_rows_look_where_the_schema_says() -> None:
    """From the top beam down."""
    np.testing.assert_array_equal(row_inclinations(LASER, 4), [0.05, 0.0, -0.1, -0.3])
    even = LaserCalibration(np.eye(4), np.zeros(0), (-0.5, 0.3))
    np.testing.assert_allclose(row_inclinations(even, 4), [0.2, 0.0, -0.2, -0.4])
    with pytest.raises(WireError, match="5 rows, the calibration 4 beams"):
        row_inclinations(LASER, 5)


def range_image(points: dict[tuple[int, int], float], shape: tuple[int, int] = (4, 8)) -> np.ndarray:
    image = np.full((*shape, 4), -1.0, np.float32)
    for place, reach in points.items():
        image[(*place, 0)] = reach
    return image


def test_both_returns_become_points_and_pixels_without_return_do_not() -> None:
    first, second = range_image({(1, 4): 20.0, (1, 0): 10.0, (2, 2): 0.0}), range_image({(1, 3): 8.0, (0, 0): np.nan})
    laser = read_range_images(laser_message(1, Ranges([first, second])))
    assert len(laser.returns) == 2
    assert laser.poses is None
    xyz, turn, _ = points_of(laser, LASER, np.eye(4))
    a = np.pi / 8
    np.testing.assert_allclose(
        xyz,
        [[-10 * np.cos(a), 10 * np.sin(a), 0], [20 * np.cos(a), -20 * np.sin(a), 0], [8 * np.cos(a), 8 * np.sin(a), 0]],
        atol=1e-5,
    )
    np.testing.assert_allclose(turn, [0.5 / 8, 4.5 / 8, 3.5 / 8])


def test_points_are_taken_through_the_poses_of_their_pixels() -> None:
    """At 10 m/s and turning, far from the world's zero: in the lidar's frame at the one pose, to the 4 mm of float32."""
    rng = np.random.default_rng(2)
    mount = transform(rotation_from_rpy(0.01, -0.02, 2.5), [1.4, 0.1, 2.1])
    laser = LaserCalibration(mount, LASER.inclinations_rad, (0, 0))
    image = range_image({(r, c): float(rng.uniform(3, 70)) for r in range(4) for c in range(8)})
    place = np.array([-25211.3, 42391.1, -160.6])
    angles, moved = rng.normal(0, 0.02, (8, 3)) + np.array([0, 0, 1.9]), rng.normal(0, 0.5, (8, 3))
    world_T_vehicle = transform(rotation_from_rpy(*angles.T), place + moved)
    poses = np.broadcast_to(np.concatenate([angles, place + moved], axis=1), (4, 8, 6)).astype(np.float32)
    xyz, turn, _ = points_of(RangeImages((image,), poses), laser, world_T_vehicle[3])
    own, _, _ = points_of(RangeImages((image,), None), laser, world_T_vehicle[3])
    column = np.round(turn * 8 - 0.5).astype(int)
    expected = apply(inverse(world_T_vehicle[3] @ mount), apply(world_T_vehicle[column] @ mount, own))
    assert np.abs(xyz - own).max() > 0.3
    np.testing.assert_allclose(xyz, expected, atol=0.004)
    np.testing.assert_allclose(xyz[column == 3], own[column == 3], atol=0.004)


@pytest.fixture(scope="module")
def recorded_cloud() -> np.ndarray:
    """A recorded cloud (N, 3) in the vehicle's frame: the first 59 158 points are pixels of the TOP LiDAR, row by row."""
    import lzma

    path = SHARED / "data" / "waymo" / "openpcdet_waymo_0004.npy.xz"
    if not path.is_file():
        pytest.skip("the recorded cloud is not beside this checkout (../shared/data/waymo)")
    with lzma.open(path) as file:
        return np.load(file)[:, :3].astype(np.float64)


# The mount of the TOP LiDAR in the recorded frame, which is of another segment.
TOP_MOUNT = transform(rotation_from_rpy(0.0, 0.0, np.radians(148.0)), [1.43, 0.0, 2.184])


@pytest.mark.real
def test_a_recorded_cloud_survives_a_range_image(recorded_cloud: np.ndarray) -> None:
    """A recorded cloud, sorted into the pixels of the TOP LiDAR's layout by the schema, is decoded to within half a pixel."""
    rows, columns, low, high = 200, 2650, -0.4, 0.12
    laser = LaserCalibration(TOP_MOUNT, np.linspace(low, high, rows), (0.0, 0.0))
    own = apply(inverse(TOP_MOUNT), recorded_cloud)
    reach = np.linalg.norm(own, axis=1)
    inclination = np.arcsin(own[:, 2] / reach)
    seen = (inclination > low) & (inclination < high)
    row = rows - 1 - np.round((inclination - low) / (high - low) * (rows - 1)).astype(int)
    column = np.floor(turn_of(recorded_cloud, laser) * columns).astype(int)
    image = np.full((rows, columns, 4), -1.0, np.float32)
    image[row[seen], column[seen], 0] = reach[seen]
    decoded, _, _ = points_of(read_range_images(laser_message(1, Ranges([image]))), laser, np.eye(4))
    last = {(r, c): k for k, r, c in zip(np.flatnonzero(seen), row[seen], column[seen])}
    source = np.array([last[place] for place in zip(*np.nonzero(image[..., 0] > 0))])
    off = np.linalg.norm(decoded - own[source], axis=1) / reach[source]
    assert len(decoded) > 50_000
    assert off.max() <= np.hypot(np.pi / columns, (high - low) / (rows - 1) / 2) * 1.001


def test_segments_are_in_the_order_of_their_names_without_the_suffix(tmp_path: Path) -> None:
    for name in ("a", "a-b", "a+b"):
        (tmp_path / f"{name}.tfrecord").touch()
    assert READER.sequences(tmp_path) == sorted(["a", "a-b", "a+b"])
