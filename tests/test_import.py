"""`log2sim import`: what an export wrote comes back, what others wrote is read with care."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from command_line import names, run
from export_paths import agent, bend, line, scenario

from log2sim.datatypes import Scenario
from log2sim.errors import ScenarioError
from log2sim.export import xml_text
from log2sim.export.exporters import Options, export
from log2sim.export.openscenario.read import load
from log2sim.geometry import wrap_angle

SAMPLE = Path(__file__).resolve().parents[1] / "samples" / "crossing" / "truth.json"
WORLDS = {
    "sample": Scenario.load(SAMPLE),
    "late, early, once": scenario(
        agent(bend(turn_rad=7.0)),
        agent(line(5.0, 6), "late", first_s=1.3, color={"rgb": [1, 2, 255], "name": "blue"}, confidence=0.25),
        agent([[3.0, 4.0]], "once", first_s=0.7, yaw_rad=-3.1, category="pedestrian", rear_axle_offset_m=0.0),
        agent(np.full((4, 2), [9.0, -4.0]), "$t\u00e4nding <&>", yaw_rad=3.1, static=True, category="other"),
        agent(line(), "back", yaw_rad=np.pi, category="bicycle"),
        duration_s=12.5,
        name="a $name with \"marks\" & \u4e2d",
    ),
    "far away": scenario(agent(bend() + np.array([4.0e6, -5.0e6]), ground_m=9000.0)),
}  # fmt: skip


@pytest.mark.matrix
@pytest.mark.parametrize("revision", ["1.0", "1.1", "1.2"])
@pytest.mark.parametrize("world", WORLDS)
def test_a_scenario_comes_back_within_a_micrometer(world: str, revision: str, tmp_path: Path) -> None:
    before = WORLDS[world]
    export(before, "openscenario", tmp_path, Options(revision=revision))
    after = load(tmp_path / "scenario.xosc")
    for key in ("name", "t0_ns", "duration_s", "map"):
        assert getattr(after, key) == getattr(before, key)
    assert len(after.agents) == len(before.agents)
    for a, b in zip(before.agents, after.agents):
        for key in ("id", "category", "static", "confidence"):
            assert getattr(a, key) == getattr(b, key)
        assert a.color == b.color
        np.testing.assert_allclose(b.size_m, a.size_m, atol=1e-6)
        assert b.rear_axle_offset_m == pytest.approx(a.rear_axle_offset_m, abs=1e-6)
        v, w = a.waypoints, b.waypoints
        np.testing.assert_array_equal(v.observed, w.observed)
        np.testing.assert_allclose(w.t_s, v.t_s, atol=1e-9)
        for key in ("x_m", "y_m", "z_m"):
            np.testing.assert_allclose(getattr(w, key), getattr(v, key), atol=2e-6)
        assert np.abs(wrap_angle(w.yaw_rad - v.yaw_rad)).max() < 1e-8
        assert np.all((w.yaw_rad >= -np.pi) & (w.yaw_rad < np.pi))
        for key in ("speed_mps", "sigma_xy_m"):
            np.testing.assert_allclose(getattr(w, key), getattr(v, key), atol=1e-4)


FOREIGN = """<?xml version="1.0"?>
<OpenSCENARIO><FileHeader revMajor="1" revMinor="1" date="2024-01-01T00:00:00" author="x" description="theirs"/>
<ParameterDeclarations><ParameterDeclaration name="y" parameterType="double" value="2.5"/></ParameterDeclarations>
<CatalogLocations/><RoadNetwork/>
<Entities>
 <ScenarioObject name="Ego"><Vehicle name="v" vehicleCategory="car"><BoundingBox><Center x="1.5" y="0" z="0.9"/>
  <Dimensions width="2" length="5" height="1.8"/></BoundingBox><Performance maxSpeed="1" maxAcceleration="1" maxDeceleration="1"/>
  <Properties/></Vehicle></ScenarioObject>
 <ScenarioObject name="cone"><MiscObject mass="1" miscObjectCategory="obstacle" name="c"><BoundingBox>
  <Center x="0" y="0" z="0.4"/><Dimensions width="0.4" length="0.4" height="0.8"/></BoundingBox><Properties/></MiscObject></ScenarioObject>
</Entities>
<Storyboard><Init><Actions><Private entityRef="cone"><PrivateAction><TeleportAction><Position>
  <WorldPosition x="20" y="$y" z="0" h="1"/></Position></TeleportAction></PrivateAction></Private></Actions></Init>
 <Story name="s"><Act name="a"><ManeuverGroup name="g" maximumExecutionCount="1"><Actors selectTriggeringEntities="false">
  <EntityRef entityRef="Ego"/></Actors><Maneuver name="m"><Event name="e" priority="overwrite"><Action name="f"><PrivateAction>
  <RoutingAction><FollowTrajectoryAction><Trajectory name="t" closed="false"><Shape><Polyline>
   <Vertex time="0"><Position><WorldPosition x="0" y="0"/></Position></Vertex>
   <Vertex time="1"><Position><WorldPosition x="0" y="4"/></Position></Vertex>
   <Vertex time="2"><Position><WorldPosition x="0" y="8"/></Position></Vertex>
  </Polyline></Shape></Trajectory><TimeReference><Timing domainAbsoluteRelative="absolute" offset="0.5" scale="2"/></TimeReference>
  <TrajectoryFollowingMode followingMode="position"/></FollowTrajectoryAction></RoutingAction></PrivateAction></Action></Event>
 </Maneuver></ManeuverGroup></Act></Story><StopTrigger/></Storyboard></OpenSCENARIO>
"""


def test_a_file_of_others_is_read_headings_that_nobody_wrote_follow_the_way(tmp_path: Path) -> None:
    (tmp_path / "theirs.xosc").write_text(FOREIGN)
    world = load(tmp_path / "theirs.xosc")
    ego, cone = world.agents
    assert (world.name, world.duration_s, ego.id, ego.category) == ("theirs", 4.5, "ego", "car")
    np.testing.assert_allclose(ego.waypoints.t_s, [0.5, 2.5, 4.5])
    np.testing.assert_allclose(ego.waypoints.yaw_rad, np.pi / 2)
    np.testing.assert_allclose(ego.waypoints.y_m, [1.5, 5.5, 9.5])
    np.testing.assert_allclose(ego.waypoints.z_m, 0.9)
    np.testing.assert_allclose(ego.waypoints.speed_mps, 2.0)
    assert (cone.category, cone.static, cone.waypoints.y_m[0]) == ("other", True, 2.5)
    assert cone.size_m == (0.4, 0.4, 0.8)


@pytest.mark.parametrize(
    ("find", "put", "message"),
    [
        ("<OpenSCENARIO>", "<OpenDRIVE>", "not valid XML"),
        ('<Timing domainAbsoluteRelative="absolute" offset="0.5" scale="2"/>', "<None/>", "entity 'Ego': .* no <Timing>"),
        ('domainAbsoluteRelative="absolute"', 'domainAbsoluteRelative="relative"', "absolute domain"),
        ('time="1"', "", "Vertex time is 'None', expected a finite number"),
        ('time="1"', 'time="nan"', "Vertex time is 'nan'"),
        ('<WorldPosition x="0" y="4"/>', '<LanePosition roadId="1" laneId="-1" s="0"/>', "no <WorldPosition>"),
        ('value="2.5"', 'value="two"', "WorldPosition y is 'two'"),
        ('y="$y"', 'y="$z"', "'\\$z' is no parameter"),
        ('entityRef="cone"', 'entityRef="cane"', "entity 'cone': has neither a trajectory nor a position"),
        ('<Dimensions width="0.4" length="0.4" height="0.8"/>', "", "entity 'cone': no <BoundingBox>"),
        ('width="2" length="5"', 'width="-2" length="5"', "width"),
        ("<Entities>", "<Entities><!-- x --><Entitles/>", None),
        (FOREIGN[FOREIGN.index("<Entities>") : FOREIGN.index("<Storyboard>")], "<Entities/>", "hold no <ScenarioObject>"),
        ('<?xml version="1.0"?>', '<?xml version="1.0"?><!DOCTYPE a [<!ENTITY b SYSTEM "file:///etc/passwd">]>', "type declaration"),
    ],
)  # fmt: skip
def test_what_cannot_be_read_says_where_and_what(find: str, put: str, message: str | None, tmp_path: Path) -> None:
    assert find in FOREIGN
    (tmp_path / "bad.xosc").write_text(FOREIGN.replace(find, put, 1))
    if message is None:
        assert len(load(tmp_path / "bad.xosc").agents) == 2
        return
    with pytest.raises(ScenarioError, match=message) as raised:
        load(tmp_path / "bad.xosc")
    assert str(raised.value).startswith(str(tmp_path / "bad.xosc"))


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("log2sim_map", "[", "expected the map that an export writes"),
        ("log2sim_map", '{"offset_m": [1, 2]}', "three numbers"),
        ("log2sim_origin_m", "1 2", "three numbers"),
        ("log2sim_t0_ns", "9" * 400, "expected nanoseconds"),
        ("log2sim_projection", "+proj=nonsense", "is no projection|is no PROJ"),
    ],
)
def test_parameters_that_were_spoiled_are_named(name: str, value: str, message: str, tmp_path: Path) -> None:
    export(scenario(agent(line())), "openscenario", tmp_path)
    tree = xml_text.read(tmp_path / "scenario.xosc")
    holder = tree.find("ParameterDeclarations")
    for old in [p for p in holder if p.get("name") == name]:
        holder.remove(old)
    xml_text.element("ParameterDeclaration", holder, name=name, parameterType="string", value=value)
    xml_text.write(tree, tmp_path / "bad.xosc")
    with pytest.raises(ScenarioError, match=message):
        load(tmp_path / "bad.xosc")


def test_no_file_a_folder_a_bomb_and_a_giant_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for path, message in ((tmp_path / "none.xosc", "no such file"), (tmp_path, "is a folder")):
        ran = run("import", path, "--out", tmp_path / "x.json")
        assert ran.code == 3
        assert message in ran.line
    (tmp_path / "deep.xosc").write_text("<a>" * 10_000)
    with pytest.raises(ScenarioError, match="nest deeper than"):
        load(tmp_path / "deep.xosc")
    (tmp_path / "strange.xosc").write_text('<?xml version="1.0" encoding="klingon"?><a/>')
    with pytest.raises(ScenarioError, match="not valid XML: unknown encoding"):
        load(tmp_path / "strange.xosc")
    monkeypatch.setattr(xml_text, "SIZE_LIMIT_BYTES", 1000)
    (tmp_path / "big.xosc").write_text(FOREIGN)
    with pytest.raises(ScenarioError, match="more than the 1000 that it may have"):
        load(tmp_path / "big.xosc")
    assert names(tmp_path) == ["big.xosc", "deep.xosc", "strange.xosc"]
