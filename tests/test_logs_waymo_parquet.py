"""Waymo, version 2: parquet components of a synthetic world, incomplete and damaged ones, and the recorded poses."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import SHARED
from log_encoders import waymo, waymo_parquet
from log_encoders.world import world_log

from log2sim.datatypes import Log
from log2sim.errors import LogError, RecordError
from log2sim.geometry import apply
from log2sim.logs.opening import open_log
from log2sim.logs.waymo.parquet_reader import read_poses
from log2sim.perception.lidar.cloud import sweep_to_map

pyarrow = pytest.importorskip("pyarrow")


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The same world in both versions."""
    folder = tmp_path_factory.mktemp("waymo")
    return waymo.encode(world_log(), folder / "v1"), waymo_parquet.encode(world_log(), folder / "v2")


@pytest.fixture
def root(both: tuple[Path, Path], tmp_path: Path) -> Path:
    """A copy of version 2 to be spoiled."""
    return Path(shutil.copytree(both[1], tmp_path / "v2"))


def rewrite(file: Path, **changes: object) -> None:
    """Replace, add or (None) drop columns, named by the end of their names, of a parquet file."""
    from pyarrow import parquet

    table = parquet.read_table(file)
    for end, values in changes.items():
        name = next(n for n in table.column_names if n.endswith(end))
        place = table.column_names.index(name)
        table = table.remove_column(place) if values is None else table.set_column(place, name, pyarrow.array(values))
    parquet.write_table(table, file)


def component(root: Path, name: str) -> Path:
    return next((root / name).glob("*.parquet"))


def test_both_versions_are_the_same_log(both: tuple[Path, Path]) -> None:
    first, second = map(open_log, both)
    assert (first.format, second.format) == ("waymo", "waymo-parquet")
    assert first.name == second.name
    assert set(first.notes) == set(second.notes)
    assert first.ego is not None
    assert second.ego is not None
    np.testing.assert_array_equal(first.ego.t_ns, second.ego.t_ns)
    np.testing.assert_allclose(first.ego.map_T_ego, second.ego.map_T_ego, atol=1e-12)
    for name, stream in first.streams.items():
        np.testing.assert_array_equal(stream.t_ns, second.streams[name].t_ns)
    for i in (0, 7):
        np.testing.assert_array_equal(first.streams["FRONT"].read(i), second.streams["FRONT"].read(i))
        a, b = (log.streams["LIDAR_TOP"].read(i) for log in (first, second))
        np.testing.assert_array_equal(a.xyz_m, b.xyz_m)
        np.testing.assert_array_equal(a.t_ns, b.t_ns)
    assert same_labels(first, second)
    np.testing.assert_allclose(first.image_labels["FRONT"].box_px, second.image_labels["FRONT"].box_px)
    for name in ("K", "mount_T_cam"):
        np.testing.assert_allclose(getattr(first.cameras["FRONT"], name), getattr(second.cameras["FRONT"], name))
    assert first.details == second.details


def same_labels(first: Log, second: Log) -> bool:
    assert first.labels is not None
    assert second.labels is not None
    columns = ("t_ns", "track_id", "category", "center_m", "size_m", "yaw_rad")
    return all(np.array_equal(getattr(first.labels, c), getattr(second.labels, c)) for c in columns)


def test_sensors_may_be_named_instead_of_numbered(both: tuple[Path, Path], root: Path) -> None:
    names = {1: "FRONT"}
    for part in ("camera_image", "camera_calibration", "projected_lidar_box"):
        from pyarrow import parquet

        numbers = parquet.read_table(component(root, part)).column("key.camera_name").to_pylist()
        rewrite(component(root, part), camera_name=[names[n] for n in numbers])
    log = open_log(root)
    np.testing.assert_array_equal(log.streams["FRONT"].t_ns, open_log(both[0]).streams["FRONT"].t_ns)
    assert len(log.image_labels["FRONT"].t_ns) == len(open_log(both[0]).image_labels["FRONT"].t_ns)


def test_without_poses_of_pixels_points_are_as_measured(both: tuple[Path, Path], root: Path) -> None:
    """A partial download: the poses of the vehicle serve in their place, to a few mm at 6 m/s."""
    shutil.rmtree(root / "lidar_pose")
    log, whole = open_log(root), open_log(both[1])
    assert any("poses of the pixels are missing" in note for note in log.notes)
    sweep, expected = log.streams["LIDAR_TOP"].read(4), whole.streams["LIDAR_TOP"].read(4)
    assert sweep.compensated_ns is None
    assert np.abs(sweep.xyz_m - expected.xyz_m).max() > 0.2
    mapped = sweep_to_map(log, "LIDAR_TOP", sweep, compensate=True)
    assert mapped is not None
    map_T_lidar = whole.map_T_sensor("LIDAR_TOP", expected.stamp_ns)[0][0]
    np.testing.assert_allclose(mapped[0], apply(map_T_lidar, expected.xyz_m), atol=0.02)


@pytest.mark.parametrize("gone", ["camera_image", "lidar", "lidar_box", "projected_lidar_box", "stats"])
def test_a_component_that_was_not_downloaded_is_missing_alone(root: Path, gone: str) -> None:
    shutil.rmtree(root / gone)
    log = open_log(root)
    assert ("FRONT" in log.streams) == (gone != "camera_image")
    assert ("LIDAR_TOP" in log.streams) == (gone != "lidar")
    assert (log.labels is None) == (gone == "lidar_box")
    assert list(log.image_labels) == ([] if gone in ("projected_lidar_box", "camera_image") else ["FRONT"])


@pytest.mark.parametrize(
    ("part", "changes", "words"),
    [
        ("vehicle_pose", {"transform": [[1.0] * 16] * 10}, "none of its 10 rows is a rigid pose"),
        ("vehicle_pose", {"transform": None}, "no column '[VehiclePoseComponent].world_from_vehicle.transform'"),
        ("camera_calibration", {"f_u": [0.0]}, "row 0: expected finite intrinsics"),
        ("lidar_calibration", {"transform": [[0.0] * 16]}, "row 0: expected a rigid extrinsic"),
        ("camera_image", {"pose_timestamp": ["a"] * 10}, "pose_timestamp"),
    ],
)
def test_an_index_that_does_not_fit_is_refused_in_one_line(
    root: Path, part: str, changes: dict[str, object], words: str
) -> None:
    rewrite(component(root, part), **changes)
    with pytest.raises(LogError) as caught:
        open_log(root)
    assert part in str(caught.value)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_calibration_is_named(root: Path) -> None:
    shutil.rmtree(root / "lidar_calibration")
    with pytest.raises(LogError, match=r"lidar_calibration.*no such file"):
        open_log(root)


def test_a_sweep_that_does_not_fit_is_its_own_error(root: Path) -> None:
    shapes = [[20, 360, 4]] * 4 + [[20, 361, 4]] + [[20, 360, 4]] * 5
    rewrite(component(root, "lidar"), **{"return1.shape": pyarrow.array(shapes, pyarrow.list_(pyarrow.int32(), 3))})
    log = open_log(root)
    with pytest.raises(RecordError, match=r"lidar.*row 4: a range image has 28800 values, expected 20 x 361 x 4"):
        log.streams["LIDAR_TOP"].read(4)
    assert len(log.streams["LIDAR_TOP"].read(5).xyz_m) > 1000


def test_rows_of_other_frames_are_left_out_with_a_note(root: Path) -> None:
    from pyarrow import parquet

    stamps = parquet.read_table(component(root, "camera_image")).column("key.frame_timestamp_micros").to_pylist()
    rewrite(component(root, "camera_image"), timestamp_micros=[stamps[0] + 1, *stamps[1:]])
    log = open_log(root)
    assert len(log.streams["FRONT"].t_ns) == len(stamps) - 1
    assert f"camera_image: 1 of {len(stamps)} rows of no frame and sensor left out" in log.notes


def test_a_second_lidar_has_its_own_rows(tmp_path: Path) -> None:
    segment = waymo.segment_of(world_log())
    laser = waymo.Laser(np.eye(4), np.zeros(0), (-0.5, 0.5))
    image = waymo.Ranges([np.full((6, 8, 4), 5.0, np.float32)])
    frames = [replace(frame, lasers={2: image, **frame.lasers}) for frame in segment.frames[:3]]
    log = open_log(waymo_parquet.write(replace(segment, lasers={**segment.lasers, 2: laser}, frames=frames), tmp_path))
    assert list(log.lidars) == ["LIDAR_TOP", "LIDAR_FRONT"]
    assert len(log.streams["LIDAR_FRONT"].read(2).xyz_m) == 48
    assert len(log.streams["LIDAR_TOP"].read(2).xyz_m) > 1000


@pytest.fixture(scope="module")
def recorded_poses() -> Path:
    found = sorted((SHARED / "data" / "waymo" / "v2_testdata").glob("vehicle_pose__*.parquet"))
    if not found:
        pytest.skip("the recorded poses are not beside this checkout (../shared/data/waymo)")
    return found[0]


@pytest.mark.real
def test_recorded_poses_are_read(recorded_poses: Path) -> None:
    """Single precision in the file: rotations are made exact, 199 frames 100 ms apart while the vehicle comes to a stop."""
    stamps_us, poses, notes = read_poses(recorded_poses)
    assert len(poses) == 199
    assert notes == []
    assert np.all(np.abs(np.diff(stamps_us) - 100_000) < 200)
    rotations = np.stack(poses)[:, :3, :3]
    np.testing.assert_allclose(
        rotations @ np.swapaxes(rotations, 1, 2), np.broadcast_to(np.eye(3), (199, 3, 3)), atol=1e-12
    )
    speed = np.linalg.norm(np.diff(np.stack(poses)[:, :3, 3], axis=0), axis=1) / 0.1
    assert 1.0 < speed.max() < 3.0


@pytest.mark.real
def test_recorded_poses_alone_are_no_log(recorded_poses: Path, tmp_path: Path) -> None:
    (tmp_path / "vehicle_pose").mkdir()
    shutil.copy(recorded_poses, tmp_path / "vehicle_pose" / "segment.parquet")
    with pytest.raises(LogError, match="199 frames with neither images nor range images"):
        open_log(tmp_path)


def test_a_file_with_one_sensor_after_the_other_is_read_as_well(tmp_path: Path) -> None:
    from pyarrow import parquet

    segment = waymo.segment_of(world_log())
    laser = waymo.Laser(np.eye(4), np.zeros(0), (-0.5, 0.5))
    image = waymo.Ranges([np.full((6, 8, 4), 5.0, np.float32)])
    frames = [replace(frame, lasers={**frame.lasers, 2: image}) for frame in segment.frames[:3]]
    two = replace(segment, lasers={**segment.lasers, 2: laser}, frames=frames)
    by_frame, by_sensor = (waymo_parquet.write(two, tmp_path / name) for name in ("frames", "sensors"))
    table = parquet.read_table(component(by_sensor, "lidar"))
    parquet.write_table(table.sort_by("key.laser_name"), component(by_sensor, "lidar"))
    one, other = map(open_log, (by_frame, by_sensor))
    for name, stream in one.streams.items():
        for i in (2, 0, 1):
            a, b = stream.read(i), other.streams[name].read(i)
            np.testing.assert_array_equal(*((a, b) if name == "FRONT" else (a.xyz_m, b.xyz_m)))


def test_labels_of_no_frame_are_counted(root: Path) -> None:
    from pyarrow import parquet

    for name, told in (
        ("lidar_box", "labels are damaged or of no frame"),
        ("projected_lidar_box", "boxes in images of 'FRONT' are"),
    ):
        before = set(open_log(root).notes)
        stamps = parquet.read_table(component(root, name)).column("key.frame_timestamp_micros").to_pylist()
        rewrite(component(root, name), timestamp_micros=[stamps[0] + 1, stamps[1] + 1, *stamps[2:]])
        (note,) = (n for n in open_log(root).notes if told in n)
        assert note.startswith("2 ")
        assert note not in before
