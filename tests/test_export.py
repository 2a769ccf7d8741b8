"""What every export format has to keep: a contract over all built-in formats, and the command."""

from __future__ import annotations

import csv
import importlib.util
import sys
from dataclasses import fields, replace
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest
from command_line import names, run

from log2sim.datatypes import Scenario
from log2sim.errors import ConfigError, MissingExtra, ScenarioError, install_command
from log2sim.export.exporters import Options, export, formats
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


def test_a_format_says_what_it_loses_and_which_options_it_has(name: str) -> None:
    exporter = plugins.load("export", name)
    assert exporter.loses
    assert set(exporter.options) <= {f.name for f in fields(Options)}


def test_a_format_refuses_a_scenario_without_agents(name: str, scenario: Scenario, tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match="no agents"):
        export(replace(scenario, agents=()), name, tmp_path / "out")
    assert names(tmp_path) == []


def test_a_format_names_the_agent_whose_time_does_not_increase(name: str, scenario: Scenario, tmp_path: Path) -> None:
    agent = scenario.agents[0]
    t_s = agent.waypoints.t_s.copy()
    t_s[3] = t_s[2]
    broken = replace(agent, waypoints=replace(agent.waypoints, t_s=t_s))
    with pytest.raises(ScenarioError, match=r"agent 'ego': waypoints\.t_s does not increase at index 3"):
        export(replace(scenario, agents=(broken, *scenario.agents[1:])), name, tmp_path / "out")
    assert names(tmp_path) == []


def test_a_format_takes_ids_that_are_no_file_names(name: str, scenario: Scenario, tmp_path: Path) -> None:
    odd = replace(scenario.agents[1], id="../ä <&>\"' 1")
    files = export(replace(scenario, agents=(scenario.agents[0], odd)), name, tmp_path / "out")
    assert all(f.resolve().is_relative_to(tmp_path / "out") for f in files)
    assert names(tmp_path) == ["out"]


def test_a_name_that_no_file_can_hold_is_refused(scenario: Scenario, tmp_path: Path) -> None:
    """JSON can write half of a surrogate pair, which is no text."""
    odd = replace(scenario.agents[1], id="bus \ud83d")
    with pytest.raises(ScenarioError, match=r"id 'bus \\ud83d': holds half a surrogate pair"):
        export(replace(scenario, agents=(scenario.agents[0], odd)), "csv", tmp_path / "out")


@pytest.mark.parametrize("projection", ["+proj=utm +zone=32 \ud83d", "+proj=utm\x0b+zone=32", "\uffff"])
def test_a_projection_that_no_file_can_hold_is_refused(projection: str, scenario: Scenario, tmp_path: Path) -> None:
    odd = replace(scenario, map=replace(scenario.map, projection=projection))
    with pytest.raises(ScenarioError, match=r"map\.projection .* no XML file can; write a PROJ string"):
        export(odd, "openscenario", tmp_path / "out")
    lines = replace(scenario, map=replace(scenario.map, projection="PROJCRS[\n  1]"))
    assert export(lines, "openscenario", tmp_path / "out")


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


def test_an_option_that_a_format_lacks_is_refused(scenario: Scenario, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"--mode: format 'csv' has no such option"):
        export(scenario, "csv", tmp_path / "out", Options(mode="pid"))


def test_the_table_holds_every_waypoint(scenario: Scenario, tmp_path: Path) -> None:
    (file,) = export(scenario, "csv", tmp_path)
    with file.open(newline="", encoding="utf-8") as opened:
        rows = list(csv.DictReader(opened))
    for agent in scenario.agents:
        own = [r for r in rows if r["id"] == agent.id]
        np.testing.assert_array_equal([float(r["x_m"]) for r in own], agent.waypoints.x_m)
        np.testing.assert_array_equal([r["observed"] == "1" for r in own], agent.waypoints.observed)
        assert {float(r["width_m"]) for r in own} == {agent.size_m[1]}


@pytest.mark.parametrize("to", ["csv", "commonroad"])
def test_a_spreadsheet_runs_no_id(to: str, scenario: Scenario, tmp_path: Path) -> None:
    ids = ['=HYPERLINK("http://a.b","c")', "@SUM(1)", "+1+cmd|'x'!A1", "-2+3", "\t=1+1", "-12", "+1.5", "a=1"]
    agents = [replace(a, id=i) for a, i in zip(scenario.others * 2, ids)]
    export(replace(scenario, agents=(scenario.ego, *agents)), to, tmp_path)
    with (tmp_path / "agents.csv").open(newline="", encoding="utf-8") as opened:
        cells = {cell for row in csv.reader(opened) for cell in row}
    assert cells >= {f"'{i}" for i in ids[:5]} | set(ids[5:])
    assert not cells & set(ids[:5])


def test_the_command_names_what_it_wrote(tmp_path: Path) -> None:
    ran = run("export", SAMPLE, "--to", "csv", "--out", tmp_path / "out")
    assert ran.code == 0
    assert ran.out == f"{tmp_path / 'out' / 'agents.csv'}: written\n"


def test_an_unknown_format_lists_the_known(tmp_path: Path) -> None:
    ran = run("export", SAMPLE, "--to", "cvs", "--out", tmp_path / "out")
    assert ran.code == 2
    assert ran.line == f"log2sim: unknown export format 'cvs' (did you mean 'csv'?); known: {', '.join(formats())}"
    assert names(tmp_path) == []


def test_a_folder_that_exists_may_be_a_file_system_of_its_own(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    folder, move = tmp_path / "mounted", Path.replace

    def within(source: Path, target: Path) -> Path:
        if source.is_relative_to(folder) != target.is_relative_to(folder):
            raise OSError(18, "Invalid cross-device link")
        return move(source, target)

    folder.mkdir()
    monkeypatch.setattr(Path, "replace", within)
    assert run("export", SAMPLE, "--to", "csv", "--out", folder).code == 0
    assert (names(tmp_path), names(folder)) == (["mounted"], ["agents.csv"])


def test_a_file_where_the_folder_should_be_is_named(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("mine")
    ran = run("export", SAMPLE, "--to", "csv", "--out", tmp_path / "out")
    assert ran.code == 2
    assert "is a file; give the name of a folder" in ran.line
    assert (tmp_path / "out").read_text() == "mine"
    below = run("export", SAMPLE, "--to", "csv", "--out", tmp_path / "out" / "deeper")
    assert below.code == 2
    assert "out is a file and not a folder" in below.line


def test_what_each_format_loses_stands_in_the_readme() -> None:
    """`python tools/formats_table.py` writes it."""
    spec = importlib.util.spec_from_file_location("formats_table", ROOT / "tools" / "formats_table.py")
    assert spec is not None
    assert spec.loader is not None
    tool = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(tool)
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert tool.with_table(readme) == readme
    assert tool.table().count("\n") == 2 + len(plugins.BUILT_IN["export"])


def test_a_writer_that_fails_leaves_nothing_behind(
    scenario: Scenario, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Failing:
        options: tuple[str, ...] = ()
        loses = "everything"

        def write(self, scenario: Scenario, folder: Path, options: Options) -> None:
            (folder / "half").write_text("written")
            raise ScenarioError("agent 'x': cannot be held")

    monkeypatch.setattr(plugins, "load", lambda kind, name: Failing())
    with pytest.raises(ScenarioError, match="agent 'x'"):
        export(scenario, "failing", tmp_path / "out")
    assert names(tmp_path) == []


def test_third_parties_add_formats_by_entry_points(
    scenario: Scenario, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    theirs = EntryPoint("theirs", "log2sim.export.csv_table:EXPORTER", "log2sim.export")
    monkeypatch.setattr(plugins, "installed", lambda kind: [theirs] if f"log2sim.{kind}" == theirs.group else [])
    assert formats()[-1] == "theirs"
    assert [f.name for f in export(scenario, "theirs", tmp_path / "out")] == ["agents.csv"]
