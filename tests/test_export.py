"""What every export format has to keep: a contract over all built-in formats, and the command."""

from __future__ import annotations

import csv
import sys
from dataclasses import replace
from pathlib import Path

import formats_table
import numpy as np
import pytest
from command_line import names, run

from log2sim.datatypes import Scenario
from log2sim.errors import ConfigError, MissingExtra, install_command
from log2sim.export.exporters import export, formats
from log2sim.files import plugins

ROOT = Path(__file__).resolve().parents[1]
SAMPLE = ROOT / "samples" / "crossing" / "truth.json"


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return Scenario.load(SAMPLE)


@pytest.fixture(params=formats())
def name(request: pytest.FixtureRequest, scenario: Scenario, tmp_path_factory: pytest.TempPathFactory) -> str:
    """Every format whose packages are installed."""
    try:
        export(scenario, request.param, tmp_path_factory.mktemp("probe"))
    except MissingExtra as missing:
        pytest.skip(str(missing))
    return str(request.param)


def test_a_format_writes_files_into_the_folder_and_nothing_beside_it(
    name: str, scenario: Scenario, tmp_path: Path
) -> None:
    files = export(scenario, name, tmp_path / "out")
    assert files
    assert all(f.is_file() and f.stat().st_size > 0 for f in files)
    assert list(files) == sorted(p for p in (tmp_path / "out").rglob("*") if p.is_file())
    assert names(tmp_path) == ["out"]


@pytest.mark.matrix
def test_a_format_writes_the_same_bytes_again(name: str, scenario: Scenario, tmp_path: Path) -> None:
    if name == "rerun":
        pytest.skip("Rerun draws ids for what it stores; that the data are the same is tested with its own comparison")
    first, second = (export(scenario, name, tmp_path / k) for k in ("a", "b"))
    assert [f.read_bytes() for f in first] == [f.read_bytes() for f in second]


@pytest.mark.matrix
def test_a_format_does_not_replace_files_unasked(name: str, scenario: Scenario, tmp_path: Path) -> None:
    export(scenario, name, tmp_path / "out")
    with pytest.raises(ConfigError, match="exists already"):
        export(scenario, name, tmp_path / "out")
    export(scenario, name, tmp_path / "out", overwrite=True)
    assert names(tmp_path) == ["out"]


def test_a_format_takes_ids_that_are_no_file_names(name: str, scenario: Scenario, tmp_path: Path) -> None:
    odd = replace(scenario.agents[1], id="../ä <&>\"' 1")
    files = export(replace(scenario, agents=(scenario.agents[0], odd)), name, tmp_path / "out")
    assert all(f.resolve().is_relative_to(tmp_path / "out") for f in files)
    assert names(tmp_path) == ["out"]


@pytest.mark.parametrize(
    ("to", "module"),
    [
        ("osi", "betterosi"),
        ("mcap", "mcap_protobuf.writer"),
        ("mcap", "foxglove_schemas_protobuf.SceneUpdate_pb2"),
        ("rerun", "rerun"),
    ],
)
def test_a_missing_package_names_its_extra(
    to: str, module: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for loaded in [name for name in sys.modules if name.startswith("log2sim.export.foxglove")]:
        monkeypatch.delitem(sys.modules, loaded)
    monkeypatch.delattr("log2sim.export.foxglove", raising=False)
    monkeypatch.setitem(sys.modules, module, None)
    ran = run("export", SAMPLE, "--to", to, "--out", tmp_path / "out")
    assert ran.code == 5
    assert f"needs the extra '{to}': {install_command(to)}" in ran.line
    assert names(tmp_path) == []


def test_the_table_holds_every_waypoint(scenario: Scenario, tmp_path: Path) -> None:
    (file,) = export(scenario, "csv", tmp_path)
    with file.open(newline="", encoding="utf-8") as opened:
        rows = list(csv.DictReader(opened))
    for agent in scenario.agents:
        own = [r for r in rows if r["id"] == agent.id]
        np.testing.assert_array_equal([float(r["x_m"]) for r in own], agent.waypoints.x_m)
        np.testing.assert_array_equal([r["observed"] == "1" for r in own], agent.waypoints.observed)
        assert {float(r["width_m"]) for r in own} == {agent.size_m[1]}


def test_what_each_format_loses_stands_in_the_cookbook() -> None:
    """`python tools/formats_table.py` writes it."""
    page = formats_table.PAGE.read_text(encoding="utf-8")
    assert formats_table.with_table(page) == page
    assert formats_table.table().count("\n") == 2 + len(plugins.BUILT_IN["export"])
