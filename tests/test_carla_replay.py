"""CARLA as the simulator of a replay, against a stand-in of its server that speaks the client's own types."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from carla_courses import SIZES, agent, left_turn, of
from command_line import run

from log2sim.datatypes import Scenario
from log2sim.errors import ConfigError
from log2sim.export.exporters import export
from log2sim.simulation.policy import Controls
from log2sim.simulation.result import Replay
from log2sim.simulation.runner import replay

pytest.importorskip("carla", reason="CARLA's client is not installed (extra 'carla')")

import carla
import carla_server
from carla_server import Client

from log2sim.simulation.carla.simulator import CarlaServer, CarlaSimulator

SAMPLE = Path(__file__).resolve().parents[1] / "samples" / "crossing" / "truth.json"


@pytest.mark.parametrize(
    ("ours", "theirs", "own"),
    [
        (carla_server.Client, carla.Client, set()),
        (carla_server.World, carla.World, set()),
        (carla_server.Actor, carla.Vehicle, {"put", "center", "advance"}),
        (carla_server.Blueprint, carla.ActorBlueprint, set()),
        (carla_server.Library, carla.BlueprintLibrary, set()),
    ],
)
def test_the_stand_in_answers_to_nothing_that_the_client_lacks(ours: type, theirs: type, own: set[str]) -> None:
    invented = {n for n, v in vars(ours).items() if callable(v) and not n.startswith("_")} - set(dir(theirs)) - own
    assert invented == set()


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Client:
    """A server that answers instead of a real one."""
    client = Client(SIZES)
    monkeypatch.setattr(carla, "Client", client)
    return client


def in_carla(scenario: Scenario, **options: Any) -> Replay:
    return replay(scenario, **{"dt_s": 0.05, "host": CarlaSimulator(), **options})


def test_vehicles_follow_in_carla_as_in_the_shim(server: Client) -> None:
    """carla#1425: a physics that the controllers do not know, with other axles and pedals; cross-track at most 0.3 m."""
    sample = Scenario.load(SAMPLE)
    there, here = in_carla(sample), replay(sample, dt_s=0.05, model="kinematic")
    assert there.metrics["cross_track_max_m"] < 0.3
    assert there.metrics["cross_track_rms_m"] < here.metrics["cross_track_rms_m"] + 0.05
    assert there.metrics["along_track_rms_m"] < here.metrics["along_track_rms_m"] + 0.1
    assert there.metrics["new_collisions"] == here.metrics["new_collisions"] == 0
    assert there.model == "carla"
    for one, other in zip(there.agents, here.agents):
        assert (one.id, one.driver) == (other.id, other.driver)
        assert one.model == ("carla" if other.model == "kinematic" else other.model)
        np.testing.assert_array_equal(one.t_s, other.t_s)
        np.testing.assert_array_equal(one.z_m, other.z_m)


def test_what_is_stored_is_what_carla_shows(server: Client) -> None:
    sample = Scenario.load(SAMPLE)
    replayed = in_carla(sample)
    for one in replayed.agents:
        role = "hero" if one.id == "ego" else one.id
        if one.driver == "static":
            assert all(c[role] == server.world.seen[0][role] for c in server.world.seen[:-1])
            continue
        for row in range(1, len(one) - 1):  # after tick k - 1 the world is at step k
            x, y, _, yaw = server.world.seen[row - 1][role]
            assert (one.x_m[row], one.y_m[row]) == pytest.approx((x, -y), abs=2e-5)
            assert (
                math.remainder(one.yaw_rad[row] + yaw, 2 * math.pi) == pytest.approx(0, abs=1e-5)
                or one.model == "point"
            )


def test_a_push_in_carla_is_noticed_and_driven_back(server: Client) -> None:
    """The loop is closed: states come from CARLA and not from a model of ours."""
    t = np.arange(0.0, 8.01, 0.1)
    tick = server.world.tick

    def ticking() -> int:
        count = tick()
        if count == 40:
            (car,) = server.world.actors.values()
            x, y, z, yaw = car.pose
            car.pose = (x, y + 1.0, z, yaw)  # to the right
        return count

    server.world.tick = ticking  # type: ignore[method-assign]
    (ego,) = in_carla(of(agent("ego", t, 8.0 * t, 0.0, 0.0, 8.0))).agents
    assert ego.y_m[40] == pytest.approx(-1.0, abs=0.05)
    assert np.abs(ego.y_m[-20:]).max() < 0.2


@pytest.mark.parametrize("at", [(0.0, 0.0), (4.6e5, 300.0), (4.6e5, 5.41e6)])
def test_the_road_of_an_export_is_under_the_agents(at: tuple[float, float], server: Client, tmp_path: Path) -> None:
    made = of(left_turn(at=at))
    export(made, "carla", tmp_path)
    in_carla(made, host=CarlaSimulator(CarlaServer(opendrive=tmp_path / "road.xodr")))
    for seen in server.world.seen[:-1]:
        x, y, z, _ = seen["hero"]
        road = server.world.road.get_waypoint(carla.Location(x, y, z)).transform.location
        assert math.hypot(road.x - x, road.y - y) < 0.3


def test_a_policy_drives_the_ego_in_carla(server: Client) -> None:
    """carla#8637: something that interacts, put into a recorded scene."""
    sample = Scenario.load(SAMPLE)
    driven = in_carla(sample, ego=lambda seen: Controls(-3.0, 0.0)).agent("ego")
    assert driven.driver == "policy"
    assert driven.speed_mps[-1] == 0
    assert driven.speed_mps[0] > 0.5
    assert np.hypot(driven.x_m[-1] - driven.x_m[0], driven.y_m[-1] - driven.y_m[0]) < 1.0


@pytest.mark.parametrize("problem", [KeyboardInterrupt, RuntimeError("time-out of 60000ms")])
def test_the_world_is_left_as_it_was(server: Client, problem: Any) -> None:
    tick = server.world.tick

    def ticking() -> int:
        if server.world.ticks == 7:
            raise problem
        return tick()

    server.world.tick = ticking  # type: ignore[method-assign]
    with pytest.raises(KeyboardInterrupt if problem is KeyboardInterrupt else ConfigError):
        in_carla(Scenario.load(SAMPLE))
    assert server.world.actors == {}
    assert server.world.applied == [(True, pytest.approx(0.05)), (False, None)]


def test_no_server_is_said_with_what_to_do() -> None:
    with pytest.raises(ConfigError, match=r"CARLA: no CARLA server answers at 127\.0\.0\.1:1 within 0\.5 s"):
        in_carla(of(left_turn()), host=CarlaSimulator(CarlaServer(port=1, timeout_s=0.5)))


def test_the_command_replays_in_carla(server: Client, tmp_path: Path) -> None:
    words = ("--simulator", "carla", "--host", "far", "--port", "2003", "--map", "Town04", "--dt", "0.05")
    server.world.road = carla.Map("flat", FLAT)
    ran = run("replay", SAMPLE, *words, "--out", tmp_path / "replay.json", "--strict")
    assert ran.code == 0, ran.err
    assert server.address == ("far", 2003)
    assert server.loaded == ["Town04"]
    assert Replay.load(tmp_path / "replay.json").model == "carla"


# A road so wide that all of the sample stands on it.
FLAT = """<?xml version="1.0"?>
<OpenDRIVE>
 <header revMajor="1" revMinor="7" name="flat" version="1" north="0" south="0" east="0" west="0"/>
 <road name="all" length="400" id="1" junction="-1">
  <planView><geometry s="0" x="-200" y="0" hdg="0" length="400"><line/></geometry></planView>
  <lanes><laneOffset s="0" a="100" b="0" c="0" d="0"/><laneSection s="0">
   <center><lane id="0" type="none" level="false"/></center>
   <right>LANES</right>
  </laneSection></lanes>
 </road>
</OpenDRIVE>
""".replace(
    "LANES",
    "".join(
        f'<lane id="-{k}" type="driving" level="false"><width sOffset="0" a="20" b="0" c="0" d="0"/></lane>'
        for k in range(1, 11)
    ),
)
