"""OpenSCENARIO and OpenDRIVE files judged by software that we did not write; see tools/peers.sh."""

from __future__ import annotations

import csv
import json
import os
import subprocess
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from export_readers import play
from export_worlds import ROOT, peer

from log2sim import Config, open_log, reconstruct
from log2sim.datatypes import Scenario
from log2sim.export.exporters import Options, export
from log2sim.geometry import wrap_angle

pytestmark = [pytest.mark.peers, pytest.mark.slow]
SAMPLE = ROOT / "samples" / "crossing"
PEERS = Path(os.environ.get("LOG2SIM_PEERS", ROOT / ".peers"))
REVISIONS = ("1.0", "1.1", "1.2")
QC_CONFIG = """<Config><Param name="InputFile" value="{file}"/><CheckerBundle application="{bundle}">
<Param name="resultFile" value="result.xqar"/></CheckerBundle></Config>
"""
# A check of OpenDRIVE 1.8, which is skipped for 1.7; those of OpenSCENARIO have rules for 1.2 only.
NOT_APPLICABLE = {"check_asam_xodr_junctions_connection_one_link_to_incoming"}


@pytest.fixture(scope="module", params=["truth", "sample", "pandaset", "kitti"])
def world(request: pytest.FixtureRequest) -> Scenario:
    """The sample's truth, and what is reconstructed from the sample and from recorded logs; where anybody is to judge it."""
    if not PEERS.is_dir() and "LOG2SIM_ESMINI" not in os.environ:
        pytest.skip("no software of others is there: `bash tools/peers.sh` sets it up")
    if request.param == "truth":
        return Scenario.load(SAMPLE / "truth.json")
    if request.param == "sample":
        return reconstruct(open_log(SAMPLE), Config.load(detect={"name": "labels"})).scenario
    data: Path = request.getfixturevalue("real_data")
    if request.param == "pandaset":
        return reconstruct(open_log(data / "pandaset"), Config.load(detect={"name": "labels"})).scenario
    model = request.getfixturevalue("yolox_model")
    return reconstruct(open_log(data / "kitti_raw"), Config.load(detect={"name": str(model)})).scenario


@pytest.fixture(scope="module")
def folders(world: Scenario, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """An export by revision."""
    found = {revision: tmp_path_factory.mktemp(revision) for revision in REVISIONS}
    for revision, folder in found.items():
        export(world, "openscenario", folder, Options(revision=revision))
    return found


def tool(environment: str, name: str) -> Path:
    path = PEERS / environment / "bin" / name
    if not path.exists():
        pytest.skip(f"{name} is not there: `bash tools/peers.sh {environment}` makes it")
    return path


def judged(kind: str, file: Path, folder: Path) -> tuple[list[str], dict[str, str]]:
    """Issues and the state of each check out of the result of an ASAM checker, whose exit code says nothing."""
    binary, bundle = tool("qc", f"qc_{kind}"), {"openscenario": "xoscBundle", "opendrive": "xodrBundle"}[kind]
    (folder / "config.xml").write_text(QC_CONFIG.format(file=file, bundle=bundle))
    subprocess.run([binary, "-c", "config.xml"], cwd=folder, check=True, capture_output=True)
    result = ElementTree.parse(folder / "result.xqar").getroot()
    states = {c.attrib["checkerId"]: c.attrib["status"] for c in result.iter("Checker")}
    return [i.attrib["description"] for i in result.iter("Issue")], states


@pytest.mark.parametrize("revision", REVISIONS)
def test_asam_s_checker_finds_nothing_in_the_scenario(revision: str, folders: dict[str, Path], tmp_path: Path) -> None:
    issues, states = judged("openscenario", folders[revision] / "scenario.xosc", tmp_path)
    assert issues == []
    assert states["check_asam_xosc_xml_valid_schema"] == "completed"
    if revision == "1.2":
        assert set(states.values()) == {"completed"}


def test_asam_s_checker_finds_nothing_in_the_road(folders: dict[str, Path], tmp_path: Path) -> None:
    issues, states = judged("opendrive", folders["1.2"] / "road.xodr", tmp_path)
    assert issues == []
    assert {name for name, state in states.items() if state != "completed"} <= NOT_APPLICABLE
    assert len(states) > 20


def test_asam_s_checkers_would_find_something(folders: dict[str, Path], tmp_path: Path) -> None:
    for name, kind, find, put in (
        ("scenario.xosc", "openscenario", "entityRef=", "entityReef="),
        ("road.xodr", "opendrive", "<planView>", "<planVue>"),
    ):
        text = (folders["1.2"] / name).read_text().replace(find, put, 1)
        (tmp_path / name).write_text(text.replace("</planView>", "</planVue>", 1) if kind == "opendrive" else text)
        assert judged(kind, tmp_path / name, tmp_path)[0]


def test_carla_s_lanes_hold_every_vehicle(world: Scenario, folders: dict[str, Path], tmp_path: Path) -> None:
    """Within half a lane's width, and the ego's path within the heights of its lane; CARLA knows the lanes that follow."""
    offset = ElementTree.parse(folders["1.2"] / "road.xodr").find("header/offset")
    shift = np.zeros(3) if offset is None else np.array([float(offset.attrib[k]) for k in "xyz"]) - world.map.offset_m
    for a in world.agents:
        if a.static or a.category not in ("car", "truck", "bus"):
            continue
        t = np.linspace(a.waypoints.t_s[0], a.waypoints.t_s[-1], 200)
        state = a.at(t)
        points = np.column_stack([state.x_m, state.y_m, state.z_m - a.size_m[2] / 2]) - shift
        (tmp_path / "points.json").write_text(json.dumps(points.tolist()))
        found = json.loads(peer("carla")(ROOT / "tests/peers/carla_lanes.py", folders["1.2"] / "road.xodr", tmp_path / "points.json"))  # fmt: skip
        if np.hypot(*(points[-1] - points[0])[:2]) > 2.0:
            assert found["over_edge_m"] <= 0.1, a.id
        if a.id == "ego":
            assert found["above_m"] <= 0.1


def test_netconvert_reads_the_road_without_a_warning(folders: dict[str, Path], tmp_path: Path) -> None:
    """But for turns that are sharper than 9 m in radius, which vehicles drove."""
    command = [
        tool("sumo", "netconvert"),
        "--geometry.min-radius",
        "3",
        "--opendrive-files",
        folders["1.2"] / "road.xodr",
        "-o",
        tmp_path / "net.xml",
    ]
    ran = subprocess.run(command, capture_output=True, text=True)
    assert (ran.returncode, ran.stdout.strip(), ran.stderr) == (0, "Success.", "")
    net = ElementTree.parse(tmp_path / "net.xml").getroot()
    assert len(net.findall("edge/lane")) >= 3
    ends = {c.attrib["to"] for c in net.iterfind("connection")}
    junctions = ElementTree.parse(folders["1.2"] / "road.xodr").getroot().findall("junction")
    assert len(ends) >= len(junctions)


@pytest.mark.parametrize("revision", REVISIONS)
def test_scenariogeneration_reads_the_same_vertices(revision: str, folders: dict[str, Path], tmp_path: Path) -> None:
    file = folders[revision] / "scenario.xosc"
    peer("scenariogeneration")(ROOT / "tests/peers/scenariogeneration_read.py", file, tmp_path / "read.json")
    found = json.loads((tmp_path / "read.json").read_text())
    own = play(file)
    assert found["entities"] == list(own)
    for name, entity in own.items():
        np.testing.assert_allclose(found["vertices"][name], entity.vertices, atol=1e-9)


def test_esmini_plays_every_waypoint(world: Scenario, folders: dict[str, Path], tmp_path: Path) -> None:
    """Positions at vertices within 1 mm, headings within half of what the yaw rate turns in a step."""
    binary = os.environ.get("LOG2SIM_ESMINI")
    if not binary:
        pytest.skip("LOG2SIM_ESMINI does not name an esmini binary")
    step_s = 0.001
    command = [binary, "--osc", folders["1.2"] / "scenario.xosc", "--headless", "--fixed_timestep", str(step_s), "--csv_logger", "log.csv"]  # fmt: skip
    subprocess.run(command, cwd=tmp_path, check=True, capture_output=True)
    played = esmini_states(tmp_path / "log.csv")
    for name, entity in play(folders["1.2"] / "scenario.xosc").items():
        states = played[name]
        for t, *pose in entity.vertices[:-1]:
            k = int(np.argmin(np.abs(states[:, 0] - t)))
            expected = np.array([np.interp(states[k, 0], entity.vertices[:, 0], c) for c in entity.vertices[:, 1:].T])
            assert np.hypot(*(states[k, 1:3] - expected[:2])) <= 1e-3, (name, t, pose)
            rate = np.abs(np.gradient(entity.vertices[:, 4], entity.vertices[:, 0])).max()
            assert abs(wrap_angle(states[k, 4] - expected[3])) <= rate * step_s / 2 + 1e-3


def esmini_states(file: Path) -> dict[str, np.ndarray]:
    """Time, x, y, z, heading (N, 5) by entity out of esmini's CSV log, whose columns come in groups "#1 ...", "#2 ..."."""
    with file.open(newline="", encoding="utf-8") as opened:
        rows = [[cell.strip() for cell in row] for row in csv.reader(opened)]
    start = next(k for k, row in enumerate(rows) if any("TimeStamp" in cell for cell in row))
    header = rows[start]
    found: dict[str, list[list[float]]] = {}
    for row in rows[start + 1 :]:
        t = float(row[next(k for k, cell in enumerate(header) if "TimeStamp" in cell)])
        for k, cell in enumerate(header[: len(row)]):
            if "Entit" in cell and "Name" in cell and row[k]:
                group = header[k].split()[0]
                keys = ("Position_X", "Position_Y", "Position_Z", "Heading")
                at = [next(j for j, c in enumerate(header) if c.startswith(group + " ") and key in c) for key in keys]
                found.setdefault(row[k], []).append([t, *(float(row[j]) for j in at)])
    return {name: np.array(values) for name, values in found.items()}


def test_asam_s_checker_finds_nothing_in_variations_and_their_distribution(tmp_path: Path) -> None:
    from benchmarks.tag_worlds import traffic

    from log2sim.scenarios.logical import Base, write_openscenario
    from log2sim.scenarios.tagging import find_tags

    world = next(w.scenario for w in map(traffic, range(20)) if any(g.tag == "cut_in" for g in find_tags(w.scenario)))
    tag = next(g for g in find_tags(world) if g.tag == "cut_in")
    base = Base.of(
        world,
        {
            "agent": tag.agent,
            "other": tag.other,
            "t_s": tag.t_s,
            "start_s": tag.start_s,
            "end_s": tag.end_s,
            "tag": tag.tag,
        },
    )
    ids = [a.id for a in base.scenario.agents]
    write_openscenario(base, [dict.fromkeys(ids, (1.0 + 0.1 * k, 0.5 * k)) for k in range(4)], tmp_path / "out")
    for name in ("scenario.xosc", "variations.xosc"):
        issues, states = judged("openscenario", tmp_path / "out" / name, tmp_path)
        assert issues == []
        assert states["check_asam_xosc_xml_valid_schema"] == "completed"
    # Every parameter that is given values is declared and used.
    roots = [ElementTree.parse(tmp_path / "out" / name).getroot() for name in ("scenario.xosc", "variations.xosc")]
    declared = {p.attrib["name"] for p in roots[0].iter("ParameterDeclaration")}
    used = {v[1:] for e in roots[0].iter() for v in e.attrib.values() if v.startswith("$")}
    given = {p.attrib["parameterRef"] for p in roots[1].iter("ParameterAssignment")}
    assert len(given) == 2 * len(ids)
    assert given == used <= declared
    assert len(list(roots[1].iter("ParameterValueSet"))) == 4
