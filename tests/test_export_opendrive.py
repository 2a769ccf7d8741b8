"""The road under a scenario: along every path within 1 cm, walked by an integrator of its own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from export_paths import UTM, agent, bend, line, scenario
from export_readers import Sampled, distance, play, roads

from log2sim.datatypes import Agent, MapFrame, Scenario
from log2sim.export.exporters import Options, export
from log2sim.export.roads.reference_line import fit
from log2sim.geometry import Array

SAMPLE = Path(__file__).resolve().parents[1] / "samples" / "crossing" / "truth.json"


def eight(count: int = 300) -> Array:
    angle = np.linspace(0.0, 2 * np.pi, count)
    return np.column_stack([30 * np.sin(angle), 15 * np.sin(2 * angle)])


def there_and_back() -> Agent:
    """Forward 20 m, then back 8 m along an arc, facing forward all the while."""
    back = bend(12.0, 0.7, 30) * [-1, 1] + np.array([20.0, 0.0])
    xy = np.concatenate([line(20.0, 41), back[1:]])
    yaw = np.concatenate([np.zeros(41), -np.linspace(0.0, 0.7, 30)[1:]])
    return agent(xy, yaw_rad=yaw)


def creeping() -> Agent:
    """1 m at 2 cm/s, with half a millimeter of noise."""
    xy = line(1.0, 500) + np.random.default_rng(0).normal(0.0, 5e-4, (500, 2))
    return agent(xy, yaw_rad=0.0)


PATHS = {
    "straight": agent(line()),
    "turn": agent(bend()),
    "s": agent(np.column_stack([np.linspace(0, 60, 200), 3 * np.sin(np.linspace(0, 60, 200) / 8)])),
    "crossing itself": agent(eight()),
    "loops": agent(bend(9.0, 13.0, 500)),
    "reversing": agent(line(), yaw_rad=np.pi),
    "there and back": there_and_back(),
    "creeping": creeping(),
    "standing": agent(np.zeros((20, 2)) + np.array([3.0, 4.0]), yaw_rad=0.3),
    "standing and trembling": agent(np.random.default_rng(1).normal(0.0, 0.003, (50, 2)), yaw_rad=0.3),
    "one waypoint": agent([[3.0, 4.0]], yaw_rad=-3.0),
    "12 cm": agent(line(0.12, 5)),
    "stopping between": agent(np.concatenate([line(10.0, 21), np.full((30, 2), [10.0, 0.0]), bend()[1:] + np.array([10.0, 0.0])]), yaw_rad=None),
    "far away": agent(bend() + np.array([4.0e6, -5.0e6])),
}  # fmt: skip
PATHS["stopping between"] = agent(
    np.column_stack([PATHS["stopping between"].waypoints.x_m, PATHS["stopping between"].waypoints.y_m]),
    yaw_rad=np.concatenate([np.zeros(51), np.linspace(0.0, np.pi / 2, 60)[1:]]),
)


def network(folder: Path, world: Scenario) -> list[Sampled]:
    export(world, "openscenario", folder, overwrite=True)
    return roads(folder / "road.xodr", 0.05)


@pytest.fixture(scope="module", params=PATHS)
def driven(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """The name of a path and the folder of its export."""
    folder = tmp_path_factory.mktemp("driven")
    export(scenario(PATHS[request.param]), "openscenario", folder)
    return request.param, folder


def path_of(a: Agent, folder: Path) -> Array:
    """The agent's path (N, 2) on the axes of the files: every waypoint, and the straight way from one to the next."""
    w = a.waypoints
    t = np.unique(np.concatenate([w.t_s, np.linspace(w.t_s[0], w.t_s[-1], 1000)]))
    offset = ElementTree.parse(folder / "road.xodr").find("header/offset")
    shift = np.array([float(offset.attrib[k]) for k in "xy"]) - UTM.offset_m[:2]
    return np.column_stack([np.interp(t, w.t_s, w.x_m), np.interp(t, w.t_s, w.y_m)]) - shift


def test_the_ego_drives_within_1_cm_of_the_reference_line_and_of_the_middle_of_its_lane(
    driven: tuple[str, Path],
) -> None:
    """Where it passes a place twice the middle is between both ways."""
    name, folder = driven
    limit = {"loops": 0.3, "there and back": 0.05, "crossing itself": 0.02}.get(name, 0.01)
    found = roads(folder / "road.xodr", 0.05)
    path = path_of(PATHS[name], folder)
    for lines in ([r.line[:, :2] for r in found], [r.centers[-1][:, :2] for r in found]):
        apart = np.min([distance(path, each) for each in lines], axis=0)
        assert apart.max() <= limit
        assert apart.max() > 0 or name in ("standing", "one waypoint")  # the walker and the fit are not the same code


def test_a_circle_becomes_arcs_of_its_curvature() -> None:
    """But for the ends, where a smoothing spline has data on one side only."""
    found, stations = fit(bend(15.0, np.pi / 2, 200))
    np.testing.assert_allclose(found.pieces[:, 5], 1 / 15, rtol=0.08)
    assert found.length_m == pytest.approx(15 * np.pi / 2, abs=0.01)
    np.testing.assert_allclose(stations, np.linspace(0, found.length_m, 200), atol=0.01)


def test_the_road_rises_with_the_ground_under_the_ego(tmp_path: Path) -> None:
    z = 100.0 + 2.0 * np.sin(np.linspace(0.0, 60.0, 121) / 20.0)
    (road,) = network(tmp_path, scenario(agent(line(60.0, 121), ground_m=z)))
    on = (road.line[:, 0] >= 0) & (road.line[:, 0] <= 60)
    np.testing.assert_allclose(road.line[on, 2], 100.0 + 2.0 * np.sin(road.line[on, 0] / 20.0), atol=0.03)


def test_who_drives_beside_the_ego_has_a_lane_of_the_same_road(tmp_path: Path) -> None:
    ego, beside = agent(line(60.0, 61)), agent(line(40.0, 41, start=(5.0, 3.4)), "beside")
    found = network(tmp_path, scenario(ego, beside))
    assert [sorted(r.centers) for r in found] == [[-1], [-2, -1], [-1]]
    (both,) = (r for r in found if len(r.centers) == 2)
    on = (both.line[:, 0] > 20) & (both.line[:, 0] < 30)
    np.testing.assert_allclose(both.centers[-1][on, 1], 3.425, atol=0.01)  # both give way to each other by 2.5 cm
    np.testing.assert_allclose(both.centers[-2][on, 1], -0.025, atol=0.01)
    first, _, last = (r.road for r in found)
    for road, tag, lane in ((first, "successor", "-2"), (last, "predecessor", "-2")):
        assert road.find(f"link/{tag}").attrib["elementType"] == "road"
        assert road.find(f"lanes/laneSection/right/lane/link/{tag}").attrib["id"] == lane


def test_who_turns_off_makes_a_junction_and_is_within_its_lanes(tmp_path: Path) -> None:
    leaving = agent(np.concatenate([line(30.0, 31), bend()[1:] + np.array([30.0, 0.0])]), "leaving", yaw_rad=np.concatenate([np.zeros(31), np.linspace(0, np.pi / 2, 60)[1:]]))  # fmt: skip
    found = network(tmp_path, scenario(agent(line(60.0, 61)), leaving))
    root = ElementTree.parse(tmp_path / "road.xodr").getroot()
    (junction,) = root.findall("junction")
    assert len({c.attrib["incomingRoad"] for c in junction.iterfind("connection")}) == 1
    assert len(junction.findall("connection")) == 2
    path = path_of(leaving, tmp_path)
    assert np.min([distance(path, r.centers[-1][:, :2]) for r in found], axis=0).max() <= 0.3


def link_of(road: ElementTree.Element, tag: str) -> dict[str, str]:
    link = road.find(f"link/{tag}")
    return {} if link is None else dict(link.attrib)


@pytest.mark.parametrize("made", ["leaving", "crossing", "beside", "oncoming", "sample"])
def test_linked_lanes_meet_without_gap_or_kink(made: str, tmp_path: Path) -> None:
    """Positions, widths and headings at both sides of every link, walked by the reader of the tests, and links lead back."""
    turn = agent(np.concatenate([line(30.0, 31), bend()[1:] + np.array([30.0, 0.0])]), "leaving", yaw_rad=np.concatenate([np.zeros(31), np.linspace(0, np.pi / 2, 60)[1:]]))  # fmt: skip
    others = {"leaving": turn, "crossing": agent(line(40.0, 41, 1.2, (30.0, -20.0)), "crossing"), "beside": agent(line(40.0, 41, start=(5.0, 3.9)), "beside"), "oncoming": agent(line(40.0, 41, np.pi, (50.0, 4.4)), "oncoming")}  # fmt: skip
    world = Scenario.load(SAMPLE) if made == "sample" else scenario(agent(line(60.0, 61)), others[made])
    found = {r.road.attrib["id"]: r for r in network(tmp_path, world)}
    met = 0
    for road in found.values():
        link = link_of(road.road, "successor")
        if link.get("elementType") != "road":
            continue
        other = found[link["elementId"]]
        point = {"start": 0, "end": -1}[link["contactPoint"]]
        for lane in road.road.iterfind("lanes/laneSection/*/lane"):
            if lane.find("link/successor") is None:
                continue
            own, linked = int(lane.attrib["id"]), int(lane.find("link/successor").attrib["id"])
            one, two = road.centers[own], other.centers[linked]
            assert road.widths[own][-1] == pytest.approx(other.widths[linked][point], abs=1e-3)
            np.testing.assert_allclose(one[-1], two[point], atol=0.005)
            ahead = [np.arctan2(*(p[1] - p[0])[1::-1]) for p in (one[-2:], two[:2] if point == 0 else two[:-3:-1])]
            assert abs(np.angle(np.exp(1j * (ahead[1] - ahead[0])))) < 0.02
            met += 1
        back = link_of(other.road, "successor" if point else "predecessor")
        assert back["elementId"] == (
            road.road.attrib["id"] if back["elementType"] == "road" else road.road.attrib["junction"]
        )
    assert met > 0


def test_lanes_that_lead_opposite_ways_are_one_road_where_both_are(tmp_path: Path) -> None:
    """With lane ids on both sides of the line between them, and linked with what goes on of the longer one."""
    back = agent(line(30.0, 31, np.pi, (45.0, 3.6)), "back")
    found = {r.road.attrib["id"]: r for r in network(tmp_path, scenario(agent(line(90.0, 91)), back))}
    (both,) = (r for r in found.values() if len(r.centers) == 2)
    assert set(both.centers) == {1, -1}
    on = (both.line[:, 0] > 16) & (both.line[:, 0] < 44)
    middles = {id: center[on, 1] for id, center in both.centers.items()}
    ahead = min(middles, key=lambda id: middles[id].mean())
    np.testing.assert_allclose(middles[ahead], 0.0, atol=0.06)
    np.testing.assert_allclose(middles[-ahead], 3.6, atol=0.06)
    assert 29 < float(both.road.attrib["length"]) < 32
    for tag in ("predecessor", "successor"):
        other = found[both.road.find(f"link/{tag}").attrib["elementId"]]
        assert set(other.centers) == {-1}
        linked = {id: both.road.find(f".//lane[@id='{id}']/link/{tag}") is not None for id in both.centers}
        assert linked == {ahead: True, -ahead: False}


def test_the_sample_s_two_way_roads_have_their_lanes_in_one_road_and_lose_no_link(tmp_path: Path) -> None:
    """Every link of the scenario's lanes is in the file: from road to road, or through a connecting road."""
    world = Scenario.load(SAMPLE)
    found = network(tmp_path, world)
    assert sorted(len(r.centers) for r in found if r.road.attrib["junction"] == "-1")[-4:] == [2, 2, 2, 2]
    links = 0
    for r in found:
        if r.road.attrib["junction"] == "-1":
            continue
        for tag in ("predecessor", "successor"):
            link = r.road.find(f"link/{tag}").attrib
            (other,) = (o for o in found if o.road.attrib["id"] == link["elementId"])
            lane = int(r.road.find(f"lanes/laneSection/right/lane/link/{tag}").attrib["id"])
            there, here = {"start": 0, "end": -1}[link["contactPoint"]], {"predecessor": 0, "successor": -1}[tag]
            np.testing.assert_allclose(other.centers[lane][there], r.centers[-1][here], atol=0.005)
            leaving = (lane < 0) == (link["contactPoint"] == "end")
            assert leaving == (tag == "predecessor")
            links += 1
    assert links == sum(len(a.predecessors) + len(a.successors) for a in world.map_features.lanes if a.junction)


# What users of OpenDRIVE players complain about, by the issue that tells it.


@pytest.mark.parametrize(
    "projection",
    [
        UTM.projection,
        "+proj=utm +zone=56 +south +ellps=WGS84 +units=m +no_defs +type=crs",
        "+proj=tmerc +lat_0=49.0069 +lon_0=8.4037 +k=1 +x_0=0 +y_0=0 +ellps=WGS84 +units=m +no_defs",
        "+proj=merc +R=6378137 +lon_0=8.4228 +k_0=0.6559 +x_0=0 +y_0=-4117000.7 +units=m +no_defs",
        "+proj=aeqd +R=6371000 +lat_0=1.29 +lon_0=103.78 +x_0=0 +y_0=0 +units=m +no_defs",
    ],
)
def test_the_geo_reference_gives_latitude_and_longitude_in_the_words_of_esmini(projection: str, tmp_path: Path) -> None:
    """A position of the road's file has within 1 mm the place that PROJ computes from the scenario."""
    from pyproj import Geod, Proj

    offset = (456000.0, 5428000.0, 100.0) if "utm" in projection else (0.0, 0.0, 0.0)
    world = scenario(agent(bend() + np.array([25_300.0, 0.0])), map=MapFrame(projection=projection, offset_m=offset))
    export(world, "openscenario", tmp_path)
    header = ElementTree.parse(tmp_path / "road.xodr").find("header")
    words = dict(word.partition("=")[::2] for word in header.findtext("geoReference").split())
    known = "a axis b ellps k k_0 lat_0 lon_0 lon_wrap over pm proj units vunits x_0 y_0 datum geoidgrids zone towgs84"
    assert {w.removeprefix("+") for w in words} <= set(known.split())
    assert {"+lat_0", "+lon_0"} <= set(words)
    shift = np.array([float(header.find("offset").attrib[k]) for k in "xy"])
    (_, x, y, *_), *_ = play(tmp_path / "scenario.xosc")["ego"].vertices
    own = Proj(header.findtext("geoReference"))(x + shift[0], y + shift[1], inverse=True)
    to_scenario = shift - offset[:2]
    truth = Proj(projection)(x + to_scenario[0] + offset[0], y + to_scenario[1] + offset[1], inverse=True)
    assert Geod(ellps="WGS84").inv(*own, *truth)[2] < 1e-3
    assert abs(own[1]) > 1


def users_map(folder: Path, world: Scenario, projection: str | None, offset: tuple[float, float, float] | None) -> Path:
    """A road that another tool could have made."""
    export(world, "openscenario", folder)
    tree = ElementTree.parse(folder / "road.xodr")
    header = tree.find("header")
    for child in list(header):
        header.remove(child)
    if projection is not None:
        ElementTree.SubElement(header, "geoReference").text = projection
    if offset is not None:
        ElementTree.SubElement(header, "offset", {**dict(zip("xyz", map(str, offset))), "hdg": "0"})
    tree.write(folder / "mine.xodr", encoding="utf-8")
    return folder / "mine.xodr"


def test_a_map_in_another_projection_has_the_agents_where_they_are_on_earth(tmp_path: Path) -> None:
    """Against PROJ, point by point, and headings by a step of one meter on the ellipsoid's plane."""
    from pyproj import Transformer

    from log2sim.export.openscenario.read import load

    other = "+proj=tmerc +lat_0=49 +lon_0=8.4 +k=1 +x_0=0 +y_0=0 +ellps=WGS84 +units=m +geoidgrids=egm96_15.gtx +vunits=m +no_defs"
    world = scenario(agent(bend(), rear_axle_offset_m=0.0))
    mine = users_map(tmp_path / "a", world, other, (0.0, 0.0, 100.0))
    export(world, "openscenario", tmp_path / "b", Options(map=mine))
    to_other = Transformer.from_crs(
        "EPSG:32632", "+proj=tmerc +lat_0=49 +lon_0=8.4 +k=1 +ellps=WGS84 +units=m", always_xy=True
    )
    expected = np.column_stack(to_other.transform(*(bend() + UTM.offset_m[:2]).T))
    played = play(tmp_path / "b" / "scenario.xosc")["ego"]
    np.testing.assert_allclose(played.vertices[:, 1:3], expected, atol=1e-3)
    direction = np.gradient(expected, axis=0)
    np.testing.assert_allclose(played.vertices[2:-2, 4], np.unwrap(np.arctan2(*direction.T[::-1]))[2:-2], atol=2e-3)
    back = load(tmp_path / "b" / "scenario.xosc").agents[0].waypoints
    np.testing.assert_allclose(np.column_stack([back.x_m, back.y_m]), bend(), atol=1e-4)


def test_the_sample_s_roads_hold_every_vehicle_that_moves(tmp_path: Path) -> None:
    world = replace(Scenario.load(SAMPLE))
    found = network(tmp_path, world)
    centers = [c[:, :2] for r in found for c in r.centers.values()]
    for a in world.agents:
        if not a.static and a.category != "pedestrian":
            xy = np.column_stack([a.waypoints.x_m, a.waypoints.y_m])
            assert np.min([distance(xy, c) for c in centers], axis=0).max() <= 3.5 / 2
