"""Intensities of LiDAR returns reach the sweeps of every format that has them, row by row with their points."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from log2sim.logs.records import read_sweep

XYZ = np.array([[1.0, 2, 3], [np.nan, 0, 0], [4, 5, 6]], np.float32)


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
