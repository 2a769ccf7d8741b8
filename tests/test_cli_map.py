"""The command that maps the ground of a log."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
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


def test_what_cannot_be_written_is_said_before_any_work(tiny_folder: Path, tmp_path: Path) -> None:
    (tmp_path / "m.pgw").write_text("mine")
    for arguments, words in (
        (("--out", tmp_path / "m.bmp"), ".tif"),
        (("--out", tmp_path / "m.png"), "m.pgw: exists already"),
        (("--out", tmp_path / "a.png", "--layer", "colour"), "color, intensity, height"),
        (("--out", tmp_path / "a.png", "--cell", "0"), "cell_m"),
    ):
        ran = run("map", tiny_folder, *arguments)
        assert ran.code == 2
        assert words in ran.err
    assert names(tmp_path) == ["m.pgw"]


@pytest.mark.slow
def test_a_plot_and_a_page_take_a_map_as_background(tiny_folder: Path, tiny_scenario: Path, tmp_path: Path) -> None:
    ground = tmp_path / "m.png"
    assert run("map", tiny_folder, "--out", ground, "--cell", "0.1", "--quiet").out == ""
    assert run("plot", tiny_scenario, "--out", tmp_path / "plain.png").code == 0
    assert run("plot", tiny_scenario, "--out", tmp_path / "p.png", "--background", ground).code == 0
    assert (tmp_path / "p.png").stat().st_size > 1.2 * (tmp_path / "plain.png").stat().st_size
    assert run("view", tiny_scenario, "--out", tmp_path / "v.html", "--background", ground).code == 0
    assert "data:image/webp;base64," in (tmp_path / "v.html").read_text()
    ran = run("view", tiny_scenario, "--out", tmp_path / "w.html", "--background", tmp_path / "plain.png")
    assert ran.code == 3
    assert "plain.pgw" in ran.err
