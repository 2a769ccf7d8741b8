"""OpenSCENARIO files: what is written, revision by revision, read by a simple player that is not ours."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from command_line import names, run
from export_paths import agent, bend, line, scenario
from export_readers import Entity, play, roads, trigger_s

from log2sim.datatypes import CATEGORIES, Scenario
from log2sim.errors import ConfigError, ScenarioError
from log2sim.export.exporters import Options, export
from log2sim.export.openscenario import write as openscenario
from log2sim.export.xml_text import escaped, unescaped, unique_names
from log2sim.geometry import wrap_angle

SAMPLE = Path(__file__).resolve().parents[1] / "samples" / "crossing" / "truth.json"
REVISIONS = ("1.0", "1.1", "1.2")
BODIES = ("Vehicle", "Pedestrian")


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


def test_the_file_says_its_revision_and_the_time_of_the_log(revision: str, tmp_path: Path) -> None:
    written(tmp_path, guest(), revision)
    header = ElementTree.parse(tmp_path / "scenario.xosc").find("FileHeader").attrib
    assert f"{header['revMajor']}.{header['revMinor']}" == revision
    assert header["date"] == "2023-11-14T22:13:20"


def test_an_unknown_revision_lists_the_known(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"--revision 2\.0: .* 1\.0, 1\.1, 1\.2"):
        export(guest(), "openscenario", tmp_path / "out", Options(revision="2.0"))
    assert names(tmp_path) == []


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


def test_in_1_0_who_comes_late_waits_out_of_sight_since_scenariorunner_knows_no_spawning(tmp_path: Path) -> None:
    entities = written(tmp_path, guest(), "1.0")
    assert ElementTree.parse(tmp_path / "scenario.xosc").find(".//EntityAction") is None
    z = [float(p.attrib["z"]) for p in entities["guest"].init.iter("WorldPosition")]
    assert z == [-510.0]
    events = entities["guest"].events
    assert [trigger_s(events[k]) for k in ("enters", "follows", "leaves")] == pytest.approx([1.0, 1.0, 2.0])
    heights = [float(events[k].find(".//TeleportAction//WorldPosition").attrib["z"]) for k in ("enters", "leaves")]
    assert heights == [0.0, -510.0]


def test_nobody_starts_in_another_who_does_not_in_the_log(revision: str, tmp_path: Path) -> None:
    """Three cars that appear one after the other at one spot would wait in one another."""
    queue = [agent(line(8.0, 11, start=(0.0, 5.0)), f"car {k}", first_s=0.5 + 2.0 * k) for k in range(3)]
    entities = written(tmp_path, scenario(agent(line()), *queue), revision)
    heights = [float(e.init.find(".//WorldPosition").attrib["z"]) for e in entities.values() if e.init is not None]
    assert len(heights) == (4 if revision == "1.0" else 1)
    assert min(np.diff(sorted(heights)), default=10.0) > 1.6
    overlapping = agent(line(start=(1.0, 0.5)), "twin")
    written(tmp_path, scenario(agent(line()), overlapping), revision)


def test_a_writer_that_would_put_agents_into_one_another_is_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(openscenario, "start_poses", lambda parts, revision: np.zeros((len(parts), 4)))
    with pytest.raises(ScenarioError, match="agents 'ego' and 'guest' would overlap at the start"):
        export(guest(), "openscenario", tmp_path / "out")
    assert names(tmp_path) == []


@pytest.mark.parametrize("category", CATEGORIES)
def test_every_category_becomes_an_entity_with_box_and_reference_point(category: str, tmp_path: Path) -> None:
    """metadriverse/scenarionet#102: classes without a counterpart silently dropped whole tracks."""
    entities = written(tmp_path, scenario(agent(line(), "a", category=category, rear_axle_offset_m=0.4)))
    body = entities["a"].body
    assert body.tag == ("Pedestrian" if category == "pedestrian" else "Vehicle")
    assert body.find("BoundingBox/Center").attrib == {"x": "0.4", "y": "0", "z": "0.8"}
    assert len(entities["a"].vertices) == 31


def test_axles_stand_within_the_box_and_the_front_one_before_the_rear(tmp_path: Path) -> None:
    for offset_m in (1.4, 0.0, -0.5):
        entities = written(tmp_path, scenario(agent(line(), rear_axle_offset_m=offset_m)))
        axles = entities["ego"].body.find("Axles")
        rear, front = (float(axles.find(k).attrib["positionX"]) for k in ("RearAxle", "FrontAxle"))
        assert rear == 0.0
        assert 0 < front < 4.6


def test_a_color_is_told_as_players_read_it(revision: str, tmp_path: Path) -> None:
    """ScenarioRunner plays 1.0 and splits at commas; esmini prints an error for everything but hexadecimal digits."""
    from log2sim.export.openscenario.read import load

    red = agent(line(), color={"rgb": [200, 10, 0], "name": "red"})
    expected = "200,10,0" if revision == "1.0" else "#C80A00"
    assert written(tmp_path, scenario(red), revision)["ego"].properties()["color"] == expected
    assert load(tmp_path / "scenario.xosc").agents[0].color == {"rgb": [200, 10, 0], "name": "red"}
    assert "color" not in written(tmp_path, scenario(agent(line())))["ego"].properties()


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


def test_ids_become_unique_names_and_stay_known(tmp_path: Path) -> None:
    ids = ["a b", "a_b", "A_B", "../x", "<&\"'>", "$ego", "ego::1", "\u00e4\u4e2d", "new\nline", "%41"]
    entities = written(tmp_path, scenario(*(agent(line(), name) for name in ids)))
    assert len({n.lower() for n in entities}) == len(ids)
    assert all(n.isascii() and not set(n) & set(" /:$<&\"'\n") for n in entities)
    assert [unescaped(e.properties()["log2sim.id"]) for e in entities.values()] == ids


def test_names_and_text_survive_their_escape() -> None:
    texts = ["", "plain", "100 % $x ${1+1}", "\x00\x1f\ufffe", "%24"]
    assert [unescaped(escaped(t)) for t in texts] == texts
    assert unescaped(escaped("\ud800 alone")) == "? alone"
    assert unescaped("%ff") == "\ufffd"
    assert all("$" not in escaped(t) and escaped(t).isascii() for t in texts)
    assert unique_names(["x" * 200, "x" * 200]) == ["x" * 60, "x" * 60 + "_2"]


def test_an_agent_seen_once_is_there_for_a_moment(revision: str, tmp_path: Path) -> None:
    """tier4/scenario_simulator_v2 PR#1229: incomplete observations made scenarios fail."""
    once = agent([[3.0, 4.0]], "once", yaw_rad=0.5, first_s=0.7)
    vertices = written(tmp_path, scenario(agent(line()), once), revision)["once"].vertices
    np.testing.assert_allclose(vertices[:, 0], [0.7, 0.701], atol=1e-9)
    np.testing.assert_array_equal(vertices[0, 1:], vertices[1, 1:])


def test_an_agent_whose_log_began_before_the_scenario_starts_where_it_is_at_0_s(revision: str, tmp_path: Path) -> None:
    early = agent(line(), first_s=-1.05, rear_axle_offset_m=0.0)
    start = written(tmp_path, scenario(early), revision)["ego"].init.find(".//WorldPosition").attrib
    assert float(start["x"]) == pytest.approx(10.5)


# What users of OpenSCENARIO players complain about, by the issue that tells it (shared list, "what users ask for").


def test_esmini_199_a_car_that_stands_keeps_its_heading_whatever_its_position_does(tmp_path: Path) -> None:
    jitter = np.random.default_rng(0).normal(0.0, 0.02, (40, 2))
    entities = written(tmp_path, scenario(agent(jitter, yaw_rad=1.0)))
    np.testing.assert_allclose(entities["ego"].vertices[:, 4], 1.0, atol=1e-8)


def test_esmini_226_every_position_has_all_its_angles(revision: str, tmp_path: Path) -> None:
    written(tmp_path, guest(), revision)
    positions = list(ElementTree.parse(tmp_path / "scenario.xosc").iter("WorldPosition"))
    assert positions
    assert all(set(p.attrib) == set("xyzhpr") for p in positions)
    assert all(p.attrib["p"] == p.attrib["r"] == "0" for p in positions)


def test_esmini_21_a_reversing_car_is_not_turned_around(revision: str, tmp_path: Path) -> None:
    """A negative speed at the start makes esmini add half a turn and ScenarioRunner stop."""
    entities = written(tmp_path, scenario(agent(line(heading_rad=np.pi), yaw_rad=0.0)), revision)
    assert float(entities["ego"].init.find(".//AbsoluteTargetSpeed").attrib["value"]) >= 0
    np.testing.assert_array_equal(entities["ego"].vertices[:, 4], 0.0)


def test_a_heading_across_pi_goes_on_and_never_jumps_by_a_turn(tmp_path: Path) -> None:
    circle = agent(bend(10.0, 5 * np.pi, 300))
    heading = written(tmp_path, scenario(circle))["ego"].vertices[:, 4]
    assert np.abs(np.diff(heading)).max() < 0.1
    assert heading[-1] - heading[0] == pytest.approx(5 * np.pi, abs=0.1)


def test_scenario_runner_418_no_name_switches_to_left_handed_axes(tmp_path: Path) -> None:
    written(tmp_path, replace(guest(), name="CARLA: town"))
    description = ElementTree.parse(tmp_path / "scenario.xosc").find("FileHeader").attrib["description"]
    assert not description.startswith("CARLA:")


def test_scenario_runner_1047_an_agent_starts_where_and_as_its_trajectory_does(tmp_path: Path) -> None:
    for entity in written(tmp_path, Scenario.load(SAMPLE)).values():
        start = entity.init.find(".//WorldPosition").attrib
        np.testing.assert_allclose([float(start[k]) for k in "xyzh"], entity.vertices[0, 1:], atol=1e-9)


def test_scenario_runner_806_nothing_is_relative(revision: str, tmp_path: Path) -> None:
    written(tmp_path, guest(), revision)
    kinds = {child.tag for p in ElementTree.parse(tmp_path / "scenario.xosc").iter("Position") for child in p}
    assert kinds == {"WorldPosition"}


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


def test_esmini_590_the_vehicle_is_placed_by_its_rear_axle_on_the_ground(tmp_path: Path) -> None:
    world = scenario(agent(line(heading_rad=np.pi / 2), rear_axle_offset_m=1.4, ground_m=2.0))
    np.testing.assert_allclose(written(tmp_path, world)["ego"].vertices[0, 1:], [0.0, -1.4, 2.0, np.pi / 2], atol=1e-6)


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


def test_esmini_461_triggers_have_no_edge_to_wait_for(revision: str, tmp_path: Path) -> None:
    """What holds from the start never rises."""
    written(tmp_path, guest(), revision)
    conditions = list(ElementTree.parse(tmp_path / "scenario.xosc").iter("Condition"))
    assert {c.attrib["conditionEdge"] for c in conditions} == {"none"}
    act = ElementTree.parse(tmp_path / "scenario.xosc").find(".//Act/StartTrigger//SimulationTimeCondition").attrib
    expected = (
        {"rule": "greaterThan", "value": "-0.000001"} if revision == "1.0" else {"rule": "greaterOrEqual", "value": "0"}
    )
    assert act == expected


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


def test_osc_generator_17_every_agent_follows_a_trajectory(tmp_path: Path) -> None:
    """And #2, esmini#608: recordings as trajectories, not as maneuvers that resemble them."""
    entities = written(tmp_path, Scenario.load(SAMPLE))
    assert all(e.events["follows"].find(".//FollowTrajectoryAction") is not None for e in entities.values())


def test_metadrive_716_agents_stand_on_the_road_that_goes_with_them(tmp_path: Path) -> None:
    """autoware_universe PR#13232: heights other than the map's; nuscenes-devkit#1033: heights that were dropped."""
    slope = 100.0 + 0.05 * np.linspace(0.0, 30.0, 31)
    entities = written(tmp_path, scenario(agent(line(), ground_m=slope, rear_axle_offset_m=0.0)))
    (road,) = roads(tmp_path / "road.xodr")
    for _, x, _, z, _ in entities["ego"].vertices[2:-2]:
        k = int(np.argmin(np.abs(road.line[:, 0] - x)))
        assert z == pytest.approx(road.line[k, 2], abs=0.02)


def test_a_box_labeled_back_to_front_is_named(tmp_path: Path) -> None:
    turned = agent(line(), "turned", yaw_rad=np.pi, speed_mps=np.full(31, 5.0))
    with pytest.raises(ScenarioError, match=r"agent 'turned': goes backward on 30\.0 of 30\.0 m"):
        export(scenario(agent(line()), turned), "openscenario", tmp_path / "out")
    export(scenario(agent(line(), yaw_rad=np.pi, speed_mps=np.full(31, -5.0))), "openscenario", tmp_path / "out")


def test_the_command_notes_agents_that_stand_in_one_another(tmp_path: Path) -> None:
    world = scenario(agent(line()), agent(line(), "twin"))
    world.save(tmp_path / "scenario.json")
    ran = run("export", tmp_path / "scenario.json", "--to", "openscenario", "--out", tmp_path / "out")
    assert ran.code == 0
    assert "note: agents 'ego' and 'twin' overlap by 100% at 0 s" in ran.out
