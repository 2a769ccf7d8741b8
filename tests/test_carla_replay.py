"""CARLA as the simulator of a replay, against a stand-in of its server that speaks the client's own types."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from carla_courses import SIZES, agent, left_turn, of
from command_line import run
from plain_settings import AGENTS_ALONE

from log2sim import Config, open_log, reconstruct
from log2sim.datatypes import Scenario
from log2sim.errors import ConfigError, MissingExtra
from log2sim.export.exporters import export
from log2sim.simulation.policy import Controls
from log2sim.simulation.result import Replay
from log2sim.simulation.runner import replay

pytest.importorskip("carla", reason="CARLA's client is not installed (extra 'carla')")

import carla
import carla_server
from carla_server import Client

from log2sim.simulation.carla import player
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


@pytest.mark.slow
@pytest.mark.real
@pytest.mark.parametrize("log", ["sample", "pandaset", "kitti_tracking"])
def test_reconstructed_logs_are_followed_in_carla(log: str, server: Client, request: pytest.FixtureRequest) -> None:
    folder = SAMPLE.parent if log == "sample" else request.getfixturevalue("real_data") / log
    made = reconstruct(open_log(folder), Config.load(detect={"name": "labels"}, **AGENTS_ALONE)).scenario
    metrics = in_carla(made).metrics
    assert metrics["cross_track_max_m"] < 0.3
    assert metrics["cross_track_rms_m"] < 0.05


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


def test_exact_agents_are_shown_where_they_are_stored(server: Client) -> None:
    sample = Scenario.load(SAMPLE)
    replayed = in_carla(sample, mode="exact")
    assert replayed.metrics["cross_track_max_m"] < 1e-6
    for one in replayed.agents:
        for row in range(1, len(one) - 1) if one.driver == "exact" else ():
            x, y, *_ = server.world.seen[row - 1]["hero" if one.id == "ego" else one.id]
            assert math.hypot(one.x_m[row] - x, one.y_m[row] + y) < 0.003


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


@pytest.mark.parametrize("change", [{"ACCEL_MPS2": 2.5}, {"BRAKE_MPS2": 18.0}, {"LAG_S": 0.3}, {"DRAG_1PM": 0.02}])
def test_pedals_and_lags_need_not_be_as_assumed(
    server: Client, change: dict[str, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in change.items():
        monkeypatch.setattr(carla_server, name, value)
    metrics = in_carla(Scenario.load(SAMPLE)).metrics
    assert metrics["cross_track_max_m"] < 0.3
    assert metrics["along_track_rms_m"] < 0.3


def test_left_is_left(server: Client) -> None:
    (ego,) = in_carla(of(left_turn())).agents
    assert ego.steer_rad.max() > 0.1
    steer = [c.control.steer for _, _, c in server.orders if type(c).__name__ == "ApplyVehicleControl"]
    assert min(steer) < -0.1
    assert max(steer) < 0.1


def test_steering_is_a_share_of_full_lock_and_pedals_of_full_pedal(server: Client) -> None:
    """What arrives at the wheels of CARLA's bicycle is the curvature that was asked for, whatever the asset's wheelbase."""
    turning = left_turn()
    in_carla(of(replace(turning, size_m=(3.9, 1.8, 1.6))))
    late = [c.control for k, _, c in server.orders if type(c).__name__ == "ApplyVehicleControl" and k > 70]
    wheelbase = 0.6 * SIZES["vehicle.citroen.c3"][0]
    share = 0.9 - 0.1 * (6.0 * 3.6 - 20.0) / 40.0  # of the steering curve, at 21.6 km/h
    wheels = [-c.steer * share * math.radians(70.0) for c in late[:15]]
    assert np.median(wheels) == pytest.approx(math.atan(wheelbase / 12.0), rel=0.05)
    assert all(c.throttle == 0 or c.brake == 0 for c in late)


def test_agents_come_go_and_leap(server: Client) -> None:
    t = np.arange(0.0, 14.01, 0.1)
    leaping = agent("leaping", t, 5.0 * t + 40.0 * (t >= 5.0), 0.0, 0.0, 5.0)
    late = agent("late", [11.5, 12.0, 13.0], [0.0, 2.5, 7.5], 30.0, 0.0, 5.0)
    early = agent("early", [0.0, 1.0], [0.0, 1.3], 60.0, 0.0, 1.3, category="pedestrian", size_m=(0.6, 0.6, 1.8))
    replayed = in_carla(of(leaping, late, early))
    assert replayed.metrics["cross_track_max_m"] < 0.3
    assert replayed.metrics["along_track_rms_m"] < 0.3
    for one in (leaping, late, early):
        at = [(k + 1) * 0.05 for k, seen in enumerate(server.world.seen) if one.id in seen]
        assert (at[0], at[-1]) == pytest.approx((one.waypoints.t_s[0] + 0.05, one.waypoints.t_s[-1]))
    assert server.world.actors == {}


def test_far_from_the_origin_is_the_same(server: Client) -> None:
    parked = agent("parked", [0.0, 6.0], 4.6e5 + 20.0, 5.41e6, 0.5, 0.0, static=True)
    near, far = in_carla(of(left_turn())), in_carla(of(left_turn(at=(4.6e5, 5.41e6)), parked))
    np.testing.assert_allclose(far.agents[0].x_m - 4.6e5, near.agents[0].x_m, atol=1e-3)
    np.testing.assert_allclose(far.agents[0].y_m - 5.41e6, near.agents[0].y_m, atol=1e-3)
    assert max(abs(v) for seen in server.world.seen for at in seen.values() for v in at[:2]) < 1000


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


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["pid", "exact"])
def test_reactive_agents_react_in_carla(server: Client, mode: str) -> None:
    """carla#8637: who follows an ego that stops does not drive into it, and is shown where it is stored."""
    t = np.arange(0.0, 8.01, 0.1)
    ego, behind = (agent(name, t, x + 6.0 * t, 0.0, 0.0, 6.0) for name, x in (("ego", 15.0), ("behind", 0.0)))
    replayed = in_carla(of(ego, behind), ego=lambda seen: Controls(-4.0, 0.0), agents="reactive", mode=mode)
    assert replayed.metrics["collisions"] == []
    last = replayed.agent("behind")
    assert last.driver == "reactive"
    assert last.x_m[-1] < replayed.agent("ego").x_m[-1]
    for row in range(1, len(last)):
        assert server.world.seen[row - 1]["behind"][0] == pytest.approx(last.x_m[row], abs=0.02)


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


def test_a_long_step_is_refused(server: Client) -> None:
    with pytest.raises(ConfigError, match=r"dt: 0\.2 s, carla takes at most 0\.1 s"):
        in_carla(of(left_turn()), dt_s=0.2)
    assert server.world.applied == []


def test_no_server_is_said_with_what_to_do() -> None:
    with pytest.raises(ConfigError, match=r"CARLA: no CARLA server answers at 127\.0\.0\.1:1 within 0\.5 s"):
        in_carla(of(left_turn()), host=CarlaSimulator(CarlaServer(port=1, timeout_s=0.5)))


def test_without_the_client_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "carla", None)
    with pytest.raises(MissingExtra, match="a replay in CARLA needs the extra 'carla'"):
        in_carla(of(left_turn()))


def test_the_command_replays_in_carla(server: Client, tmp_path: Path) -> None:
    words = ("--simulator", "carla", "--host", "far", "--port", "2003", "--map", "Town04", "--dt", "0.05")
    server.world.road = carla.Map("flat", FLAT)
    ran = run("replay", SAMPLE, *words, "--out", tmp_path / "replay.json", "--strict")
    assert ran.code == 0, ran.err
    assert server.address == ("far", 2003)
    assert server.loaded == ["Town04"]
    assert Replay.load(tmp_path / "replay.json").model == "carla"


@pytest.mark.parametrize("words", [("--host", "far"), ("--port", "2003"), ("--map", "Town04")])
def test_options_of_carla_without_it_are_refused(words: tuple[str, str]) -> None:
    ran = run("replay", SAMPLE, *words)
    assert (ran.code, ran.out) == (2, "")
    assert "are for --simulator carla" in ran.line


def test_a_server_gets_a_moment_to_answer_and_then_its_time_to_work(server: Client) -> None:
    assert player.connect(carla, "127.0.0.1", 2000, 60.0).timeout_s == 60.0


def test_an_unknown_simulator_lists_the_known(tmp_path: Path) -> None:
    assert run("replay", SAMPLE, "--simulator", "carlo").line == (
        "log2sim: unknown simulator 'carlo' (did you mean 'carla'?); known: own, carla"
    )
    ran = run("replay", SAMPLE, "--simulator", "carla", "--map", tmp_path / "no.xodr")
    assert ran.code == 2
    assert ran.line.endswith("no.xodr: no such file")


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
