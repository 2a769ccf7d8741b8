"""What several readers share: times of a spinning LiDAR, files named by numbers, notes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from log2sim.logs.records import list_numbered_files
from log2sim.logs.stamps import (
    compute_turn_share,
)


@pytest.mark.parametrize("start_deg", [180.0, 144.0, 0.0, -179.0])
def test_the_share_of_a_turn_grows_clockwise_from_its_start(start_deg: float) -> None:
    share = np.linspace(0.001, 0.999, 50)
    azimuth = np.radians(start_deg) - 2 * np.pi * share
    xy = 7.0 * np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)
    np.testing.assert_allclose(compute_turn_share(xy, np.radians(start_deg)), share, atol=1e-12)


def test_files_are_ordered_by_number_and_other_names_are_left_out(tmp_path: Path) -> None:
    largest = np.iinfo(np.int64).max
    names = [
        "10.pkl.gz",
        "9.pkl.gz",
        "x9.pkl.gz",
        "8.gz",
        "7.PNG",
        f"{largest}.png",
        f"{largest + 1}.png",
        f"{'9' * 99}.png",
    ]
    for name in names:
        (tmp_path / name).touch()
    assert list(list_numbered_files(tmp_path, (".pkl.gz", ".png"))) == [7, 9, 10, largest]
    assert list_numbered_files(tmp_path / "none", (".png",)) == {}
