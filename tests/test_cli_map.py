"""The command that maps the ground of a log."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import tifffile
from command_line import names, run


def test_a_png_comes_with_its_place_and_says_what_is_left_out(tiny_folder: Path, tmp_path: Path) -> None:
    ran = run("map", tiny_folder, "--out", tmp_path / "m.png", "--cell", "0.1")
    assert ran.code == 0, ran.err
    assert names(tmp_path) == ["m.pgw", "m.png"]
    picture = cv2.imread(str(tmp_path / "m.png"), cv2.IMREAD_UNCHANGED)
    assert picture[picture[..., 3] > 0][:, :3].std() > 5
    assert "without --scenario only agents with labels are left out" in ran.out
    assert "m.png: " in ran.out


def test_heights_as_geotiff_with_a_scenario(tiny_folder: Path, tiny_scenario: Path, tmp_path: Path) -> None:
    out = tmp_path / "h.tif"
    ran = run("map", tiny_folder, "--scenario", tiny_scenario, "--out", out, "--layer", "height", "--cell", "0.2")
    assert ran.code == 0, ran.err
    assert names(tmp_path) == ["h.tif"]
    heights = tifffile.imread(out)
    assert abs(float(np.nanmedian(heights))) < 0.05
    assert "without --scenario" not in ran.out
