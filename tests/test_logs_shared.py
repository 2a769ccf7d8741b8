"""What several readers share: times of a spinning LiDAR, files named by numbers, notes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from log2sim.logs.records import list_numbered_files
from log2sim.logs.stamps import (
    compute_scan_offset_ns,
    compute_turn_share,
    count_words,
    defer_notes,
    note_left_out,
    select_spaced,
)


@pytest.mark.parametrize("start_deg", [180.0, 144.0, 0.0, -179.0])
def test_the_share_of_a_turn_grows_clockwise_from_its_start(start_deg: float) -> None:
    share = np.linspace(0.001, 0.999, 50)
    azimuth = np.radians(start_deg) - 2 * np.pi * share
    xy = 7.0 * np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)
    np.testing.assert_allclose(compute_turn_share(xy, np.radians(start_deg)), share, atol=1e-12)


def test_a_turn_starts_and_ends_behind_the_lidar() -> None:
    offset_ns = compute_scan_offset_ns(np.array([[-1.0, 0.0], [0.0, 1.0], [1.0, 0.0], [-1.0, -0.0]]), 100)
    assert offset_ns.tolist() == [-100, -75, -50, 0]


def test_of_two_rows_of_a_track_that_are_too_near_the_first_is_kept() -> None:
    t_ns = np.array([0, 5, 15, 16, 26])
    assert select_spaced(t_ns, np.array(["a", "b", "b", "b", "a"]), 11).tolist() == [0, 1, 3, 4]


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


def test_kinds_that_are_left_out_are_counted_by_reason() -> None:
    notes: list[str] = []
    note_left_out([], {"sign"}, notes)
    assert notes == []
    note_left_out(iter(["ufo", "cone", "sign", "sign", "animal"]), {"sign", "cone", "animal"}, notes)
    assert notes == [
        "labels left out because they are no road users: sign (2), animal (1), cone (1)",
        "labels left out because their kind is not known: ufo (1)",
    ]
    assert count_words(()) == ""


def test_deferred_notes_have_what_reading_adds() -> None:
    notes = ["first"]
    read = defer_notes(notes, lambda: notes.append("second"))
    assert notes == ["first"]
    assert read() == ("first", "second")
