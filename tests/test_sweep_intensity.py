"""Intensities of LiDAR returns reach the sweeps of every format that has them, row by row with their points."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from log2sim.errors import RecordError
from log2sim.logs.records import parse_pcd, read_sweep, sweep_of
from log2sim.logs.ros.messages import LidarTopic
from log2sim.logs.ros.sensors import sweep_from
from log2sim.logs.waymo.range_images import intensities_of
from log2sim.logs.waymo.segment import RangeImages

XYZ = np.array([[1.0, 2, 3], [np.nan, 0, 0], [4, 5, 6]], np.float32)


def test_rows_that_are_dropped_take_their_intensity_with_them() -> None:
    sweep = sweep_of(XYZ, 0, None, "lidar", intensity=np.array([7, 8, 9], np.uint8))
    np.testing.assert_array_equal(sweep.intensity, np.array([7, 9], np.float32))
    assert sweep.intensity is not None
    assert sweep.intensity.dtype == np.float32


def test_what_is_no_strength_is_unknown() -> None:
    sweep = sweep_of(np.ones((4, 3)), 0, None, "lidar", intensity=np.array([-1.0, np.inf, np.nan, 0.5]))
    np.testing.assert_array_equal(sweep.intensity, np.array([np.nan, np.nan, np.nan, 0.5], np.float32))


def test_files_with_four_columns_and_with_named_columns(tmp_path: Path) -> None:
    rows = np.column_stack([XYZ, [0.1, 0.2, 0.3]]).astype("<f4")
    (tmp_path / "a.bin").write_bytes(rows.tobytes())
    (tmp_path / "b.bin").write_bytes((rows * [1, 1, 1, 0]).astype("<f4").tobytes())
    np.savez(tmp_path / "a.npz", xyz_m=XYZ, intensity=np.array([1, 2, 3], np.uint8))
    np.savez(tmp_path / "b.npz", xyz_m=XYZ)
    np.testing.assert_allclose(read_sweep(tmp_path / "a.bin", 0).intensity, [0.1, 0.3], rtol=1e-6)
    np.testing.assert_array_equal(read_sweep(tmp_path / "a.npz", 0).intensity, [1, 3])
    assert read_sweep(tmp_path / "b.bin", 0).intensity is None
    assert read_sweep(tmp_path / "b.npz", 0).intensity is None


def test_a_column_of_another_length_is_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", xyz_m=XYZ, intensity=np.zeros(2))
    with pytest.raises(RecordError, match="intensity has the shape"):
        read_sweep(tmp_path / "a.npz", 0)


def test_a_field_of_a_pcd_file() -> None:
    layout = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")])
    rows = np.array([(1, 2, 3, 40), (4, 5, 6, 50)], layout)
    header = (
        b"VERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH 2\nHEIGHT 1\n"
        b"POINTS 2\nDATA binary\n"
    )
    xyz, offset, intensity = parse_pcd(header + rows.tobytes(), 0, 100)
    assert xyz.shape == (2, 3)
    assert offset is None
    np.testing.assert_array_equal(intensity, [40, 50])


def test_a_field_of_a_point_cloud_message() -> None:
    rows = np.array([(1, 2, 3, 7), (0, 0, 0, 8), (4, 5, 6, 9)], [(n, "<f4") for n in "xyz"] + [("reflectivity", "<u2")])
    fields = [SimpleNamespace(name=n, offset=4 * k, datatype=7, count=1) for k, n in enumerate("xyz")]
    fields.append(SimpleNamespace(name="reflectivity", offset=12, datatype=4, count=1))
    message = SimpleNamespace(
        height=1, width=3, point_step=14, row_step=42, is_bigendian=False, fields=fields,
        data=np.frombuffer(rows.tobytes(), np.uint8),
    )  # fmt: skip
    sweep = sweep_from(message, 0, 1e8, LidarTopic(topic="points"), "here")
    np.testing.assert_array_equal(sweep.intensity, [7, 9])


def test_the_second_channel_of_range_images() -> None:
    image = np.zeros((2, 3, 4), np.float32)
    image[0, 1], image[1, 2] = [5.0, 0.25, 0, 0], [6.0, 0.75, 0, 0]
    np.testing.assert_array_equal(intensities_of(RangeImages((image,), None)), np.array([0.25, 0.75], np.float32))
    assert intensities_of(RangeImages((image[..., :1],), None)) is None
