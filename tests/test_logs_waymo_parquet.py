"""Waymo, version 2: parquet components of a synthetic world, incomplete and damaged ones, and the recorded poses."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from conftest import SHARED
from log_encoders import waymo, waymo_parquet
from log_encoders.world import world_log

from log2sim.datatypes import Log
from log2sim.errors import LogError
from log2sim.logs.opening import open_log
from log2sim.logs.waymo.parquet_reader import read_poses

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
