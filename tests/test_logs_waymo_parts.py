"""Waymo: checksums, records, the wire format and range images, each against its description."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from conftest import SHARED
from log_encoders.waymo import Ranges, laser_message, record

from log2sim.errors import LogError
from log2sim.geometry import apply, inverse, rotation_from_rpy, transform
from log2sim.logs.waymo.messages import RecordFile, WireError, crc32c, masked_crc32c
from log2sim.logs.waymo.range_images import points_of, read_range_images, row_inclinations, turn_of
from log2sim.logs.waymo.segment import LaserCalibration, RangeImages

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
    xyz, turn = points_of(laser, LASER, np.eye(4))
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
    xyz, turn = points_of(RangeImages((image,), poses), laser, world_T_vehicle[3])
    own, _ = points_of(RangeImages((image,), None), laser, world_T_vehicle[3])
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
    decoded, _ = points_of(read_range_images(laser_message(1, Ranges([image]))), laser, np.eye(4))
    last = {(r, c): k for k, r, c in zip(np.flatnonzero(seen), row[seen], column[seen])}
    source = np.array([last[place] for place in zip(*np.nonzero(image[..., 0] > 0))])
    off = np.linalg.norm(decoded - own[source], axis=1) / reach[source]
    assert len(decoded) > 50_000
    assert off.max() <= np.hypot(np.pi / columns, (high - low) / (rows - 1) / 2) * 1.001
