"""OpenSCENARIO files: what is written, revision by revision, read by a simple player that is not ours."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from command_line import run
from export_paths import agent, bend, line, scenario
from export_readers import Entity, play, trigger_s

from log2sim.datatypes import CATEGORIES, Scenario
from log2sim.errors import ConfigError
from log2sim.export.exporters import Options, export
from log2sim.geometry import wrap_angle

SAMPLE = Path(__file__).resolve().parents[1] / "samples" / "crossing" / "truth.json"
REVISIONS = ("1.0", "1.1", "1.2")


@pytest.fixture(params=REVISIONS)
def revision(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def written(folder: Path, world: Scenario, revision: str = "1.2") -> dict[str, Entity]:
    export(world, "openscenario", folder, Options(revision=revision), overwrite=True)
    return play(folder / "scenario.xosc")


def guest(**changes: object) -> Scenario:
    """An ego for 4 s and a car that is there from 1 s to 2 s only."""
    there = agent(line(8.0, 11, start=(0.0, 5.0)), "guest", first_s=1.0, **changes)
    return scenario(agent(line(20.0, 41)), there)


def test_a_player_shows_the_box_of_every_waypoint(revision: str, tmp_path: Path) -> None:
    world = Scenario.load(SAMPLE)
    entities = written(tmp_path, world, revision)
    for a in world.agents:
        w = a.waypoints
        played = np.array([entities[a.id].box_at(t) for t in w.t_s])
        assert np.abs(played[:, :3] - np.column_stack([w.x_m, w.y_m, w.z_m])).max() < 1e-5
        assert np.abs(wrap_angle(played[:, 3] - w.yaw_rad)).max() < 1e-8
        size = entities[a.id].body.find("BoundingBox/Dimensions").attrib
        np.testing.assert_allclose([float(size[k]) for k in ("length", "width", "height")], a.size_m, atol=1e-6)


@pytest.mark.parametrize("revision", ["1.1", "1.2"])
def test_who_comes_late_is_added_and_who_leaves_early_is_deleted(revision: str, tmp_path: Path) -> None:
    """esmini#695: vehicles stayed after their end; esmini#211: the action names its entity, not what it does."""
    entities = written(tmp_path, guest(), revision)
    events = entities["guest"].events
    assert entities["guest"].init is None
    assert list(events) == ["enters", "follows", "leaves"]
    added = events["enters"].find("Action/GlobalAction/EntityAction")
    assert added.attrib == {"entityRef": "guest"}
    assert float(added.find("AddEntityAction/Position/WorldPosition").attrib["x"]) == pytest.approx(-1.4)
    assert events["leaves"].find("Action/GlobalAction/EntityAction/DeleteEntityAction") is not None
    assert [trigger_s(events[k]) for k in events] == pytest.approx([1.0, 1.0, 2.0])
    assert entities["ego"].init is not None
    assert list(entities["ego"].events) == ["follows", "stops"]


@pytest.mark.parametrize("category", CATEGORIES)
def test_every_category_becomes_an_entity_with_box_and_reference_point(category: str, tmp_path: Path) -> None:
    """metadriverse/scenarionet#102: classes without a counterpart silently dropped whole tracks."""
    entities = written(tmp_path, scenario(agent(line(), "a", category=category, rear_axle_offset_m=0.4)))
    body = entities["a"].body
    assert body.tag == ("Pedestrian" if category == "pedestrian" else "Vehicle")
    assert body.find("BoundingBox/Center").attrib == {"x": "0.4", "y": "0", "z": "0.8"}
    assert len(entities["a"].vertices) == 31


def test_an_external_ego_has_a_place_a_speed_and_a_controller_and_no_trajectory(revision: str, tmp_path: Path) -> None:
    """The conventions of esmini's ExternalController, and of ScenarioRunner's external_control in 1.0."""
    followed = written(tmp_path, guest(), revision)
    export(guest(), "openscenario", tmp_path, Options(revision=revision, ego="external"), overwrite=True)
    ego, guest_ = (play(tmp_path / "scenario.xosc")[name] for name in ("ego", "guest"))
    assert len(ego.vertices) == 0
    assert not ego.events
    np.testing.assert_array_equal(guest_.vertices, followed["guest"].vertices)
    assert ego.init.find(".//WorldPosition").attrib == followed["ego"].init.find(".//WorldPosition").attrib
    assert float(ego.init.find(".//AbsoluteTargetSpeed").attrib["value"]) == pytest.approx(5.0)
    root = ElementTree.parse(tmp_path / "scenario.xosc").getroot()
    assert len(list(root.iter("ControllerAction"))) == 1
    if revision == "1.0":
        (module,) = ego.init.iterfind(".//AssignControllerAction/Controller/Properties/Property")
        assert module.attrib == {"name": "module", "value": "external_control"}
        overridden = ego.init.find(".//OverrideControllerValueAction")
        assert {node.attrib["active"] for node in overridden} == {"false"}
        assert len(overridden) == 6
    else:
        properties = ego.node.find("ObjectController/Controller/Properties")
        assert {p.attrib["name"]: p.attrib["value"] for p in properties}["esminiController"] == "ExternalController"
        activated = ego.init.find(".//ControllerAction/ActivateControllerAction")
        assert activated.attrib == {"longitudinal": "true", "lateral": "true"}


def test_an_external_ego_has_to_be_there_on_wheels_from_the_start(tmp_path: Path) -> None:
    late, walker = agent(line(), first_s=1.0), agent(line(), category="pedestrian")
    for world in (scenario(agent(line(), "car-1")), scenario(late), scenario(walker)):
        with pytest.raises(ConfigError, match="--ego external"):
            export(world, "openscenario", tmp_path, Options(ego="external"))
    with pytest.raises(ConfigError, match="has no such option"):
        export(scenario(agent(line())), "csv", tmp_path, Options(ego="external"))
    scenario(agent(line())).save(tmp_path / "s.json")
    result = run("export", tmp_path / "s.json", "--to", "openscenario", "--ego", "external", "--out", tmp_path / "out")
    assert result.code == 0
    assert len(play(tmp_path / "out" / "scenario.xosc")["ego"].vertices) == 0
    scenario(agent(line(), "external")).save(tmp_path / "named.json")
    result = run("export", tmp_path / "named.json", "--to", "csv", "--ego", "external", "--out", tmp_path / "csv")
    assert result.code == 0


# What users of OpenSCENARIO players complain about, by the issue that tells it (shared list, "what users ask for").


def test_scenario_runner_reads_1_0_and_wants_the_trajectory_right_under_the_action(tmp_path: Path) -> None:
    for revision, path in (
        ("1.0", "Trajectory"),
        ("1.1", "TrajectoryRef/Trajectory"),
        ("1.2", "TrajectoryRef/Trajectory"),
    ):
        written(tmp_path, guest(), revision)
        actions = list(ElementTree.parse(tmp_path / "scenario.xosc").iter("FollowTrajectoryAction"))
        assert actions
        assert all(a.find(f"{path}/Shape/Polyline/Vertex") is not None for a in actions)


@pytest.mark.parametrize("east_m", [1e4, 4.56e5, 5e7])
def test_esmini_174_far_from_the_origin_float32_keeps_half_a_millimeter(east_m: float, tmp_path: Path) -> None:
    near, far = (scenario(agent(bend() + np.array([x, -x / 3]))) for x in (0.0, east_m))
    vertices = written(tmp_path, far)["ego"].vertices[:, 1:4]
    assert np.abs(vertices.astype(np.float32) - vertices).max() <= 0.0005
    shape = written(tmp_path, near)["ego"].vertices[:, 1:3]
    np.testing.assert_allclose(vertices[:, :2] - vertices[0, :2], shape - shape[0], atol=3e-6)


def test_esmini_642_times_are_absolute_and_on_every_vertex(revision: str, tmp_path: Path) -> None:
    """esmini#121, #773: no offset, no scale; ScenarioRunner#803, scenariogeneration#104, #40: never without times."""
    entities = written(tmp_path, guest(), revision)
    root = ElementTree.parse(tmp_path / "scenario.xosc")
    assert root.find(".//TimeReference/None") is None
    timings = [t.attrib for t in root.iter("Timing")]
    assert timings == [{"domainAbsoluteRelative": "absolute", "scale": "1", "offset": "0"}] * 2
    for entity in entities.values():
        assert np.all(np.diff(entity.vertices[:, 0]) > 0)


def test_esmini_320_who_stays_stops_at_the_last_vertex_and_the_scenario_ends(revision: str, tmp_path: Path) -> None:
    entities = written(tmp_path, guest(), revision)
    stop = entities["ego"].events["stops"]
    assert trigger_s(stop) == pytest.approx(4.0)
    assert stop.find(".//AbsoluteTargetSpeed").attrib == {"value": "0"}
    end = ElementTree.parse(tmp_path / "scenario.xosc").find("Storyboard/StopTrigger")
    assert trigger_s_of(end) == pytest.approx(4.0)


def trigger_s_of(trigger: ElementTree.Element) -> float:
    holder = ElementTree.Element("Event")
    trigger.tag = "StartTrigger"
    holder.append(trigger)
    return trigger_s(holder)


def test_scenario_runner_966_no_vertex_is_added_or_lost_and_positions_are_exact(tmp_path: Path) -> None:
    """Denser vertices than the log's made ScenarioRunner's follower worse."""
    world = Scenario.load(SAMPLE)
    entities = written(tmp_path, world)
    assert {n: len(e.vertices) for n, e in entities.items()} == {a.id: len(a.waypoints) for a in world.agents}
    modes = ElementTree.parse(tmp_path / "scenario.xosc").iter("TrajectoryFollowingMode")
    assert {m.attrib["followingMode"] for m in modes} == {"position"}
