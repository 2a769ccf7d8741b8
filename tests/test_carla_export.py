"""The export for CARLA: data in CARLA's frame, and the script's conversation with a stand-in of the server.

Names of users' complaints that a test answers stand beside it, as repository#issue.
"""

from __future__ import annotations

import importlib.util
import json
import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from carla_courses import SIZES, agent, left_turn, of

from log2sim.datatypes import CATEGORIES, Agent, Scenario
from log2sim.export.exporters import Options, export
from log2sim.geometry import wrap_angle
from log2sim.simulation import reference as follower
from log2sim.simulation.carla.data import BY_CATEGORY, controller_data, nearest_assets
from log2sim.simulation.carla.player import CarlaActor, SampledTrajectory, VehicleController, main
from log2sim.simulation.vehicles.vehicle import VehicleState, parameters_for

SAMPLE = Path(__file__).resolve().parents[1] / "samples" / "crossing" / "truth.json"


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return Scenario.load(SAMPLE)


def written(scenario: Scenario, folder: Path, mode: str | None = None) -> tuple[Path, dict[str, Any]]:
    """The data file of an export, and what is in it."""
    export(scenario, "carla", folder, Options(mode=mode), overwrite=True)
    path = folder / "scenario_carla.json"
    return path, json.loads(path.read_text(encoding="utf-8"))


# ---- the data


def test_data_are_in_the_left_handed_frame_in_degrees(scenario: Scenario, tmp_path: Path) -> None:
    """scenario_runner#418, #1047: mirrored logs drive on the wrong side."""
    _, data = written(scenario, tmp_path)
    for logged, entry in zip(scenario.agents, data["agents"]):
        w, course = logged.waypoints, SampledTrajectory(entry["exact"])
        assert data["offset_m"] == [0, 0, 0]
        for k in (0, len(w) // 3, len(w) - 1):
            x, y, z, yaw_deg = course.at(float(w.t_s[k]), "x_m", "y_m", "z_m", "yaw_deg")
            k = 0 if logged.static else k
            np.testing.assert_allclose([x, -y, z + logged.size_m[2] / 2], [w.x_m[k], w.y_m[k], w.z_m[k]], atol=1e-4)
            assert abs(wrap_angle(-math.radians(yaw_deg) - w.yaw_rad[k])) < 1e-5


def test_every_category_has_assets_and_the_nearest_comes_first() -> None:
    for category in CATEGORIES:
        for size in ((0.7, 0.7, 1.8), (4.2, 1.8, 1.5), (9.0, 2.6, 3.2)):
            some = replace(left_turn(), category=category, size_m=size)
            assets = nearest_assets(some)
            distances = [math.dist(a["size_m"], size) for a in assets]
            assert distances == sorted(distances)
            assert distances[0] == min(math.dist(s, size) for s in BY_CATEGORY[category].values())
            for a in assets:
                np.testing.assert_allclose(np.array(a["size_m"]) - size, a["error_m"], atol=6e-4)


def test_the_script_runs_without_log2sim_and_without_the_client(scenario: Scenario, tmp_path: Path) -> None:
    written(scenario, tmp_path)
    command = [sys.executable, "-I", "-S", str(tmp_path / "replay_carla.py")]
    table = subprocess.run([*command, "--table"], capture_output=True, text=True, check=True)
    assert table.stdout.splitlines()[1].split()[0] == "ego"
    without = subprocess.run(command, capture_output=True, text=True, check=False)
    assert without.returncode == 5
    assert without.stderr.startswith("replay_carla: CARLA's Python client is needed: pip install carla")


@pytest.mark.parametrize("text", ["", "[]", '{"format": "log2sim-carla", "version": 99}'])
def test_data_of_something_else_are_refused(text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """carla#7767: silent on a bad path."""
    assert main(["--data", str(tmp_path / "none.json")]) == 3
    assert "none.json: cannot be read" in capsys.readouterr().err
    (tmp_path / "x.json").write_text(text)
    assert main(["--data", str(tmp_path / "x.json")]) == 3
    assert capsys.readouterr().err.startswith(f"replay_carla: {tmp_path / 'x.json'}: ")


# ---- the controller

GAINS = SimpleNamespace(**controller_data())


def test_the_script_follows_as_the_shim_does() -> None:
    """The scalar controller against log2sim.simulation.reference, over 300 steps of random states."""
    rng = np.random.default_rng(3)
    dt = 0.02
    one, parameters = np.ones(1), parameters_for([left_turn()])
    wheelbase, lock = float(parameters.wheelbase_m[0]), float(parameters.max_steer_rad[0])
    limits = (float(parameters.max_throttle_mps2[0]), float(parameters.max_brake_mps2[0]), math.tan(lock) / wheelbase)
    memory, own = follower.ControllerMemory.fresh(1), VehicleController(GAINS, *limits)
    empty = {f: np.zeros(1) for f in VehicleState.__dataclass_fields__}
    for k in range(300):
        speed = 0.0 if k % 10 == 0 else rng.normal(4, 5)
        x, y, yaw = rng.normal(0, 1, 3)
        row = np.array(
            [*rng.normal(0, 1, 2), yaw + rng.normal(0, 0.2), rng.normal(4, 4), rng.normal(0, 2), rng.normal(0, 0.1)]
        )
        row = np.append(row, [rng.choice([-1.0, 1.0]), float(k % 4 == 0)])
        given = {"x_m": x * one, "y_m": y * one, "yaw_rad": yaw * one, "speed_mps": speed * one}
        controls, memory = follower.follow_vehicles(
            row[:, None], VehicleState(**{**empty, **given}), memory, parameters, dt
        )
        pedal, curvature, reverse = own.step(row.tolist(), (x, y, yaw), speed, dt)
        assert pedal == pytest.approx(controls.pedal_mps2[0], abs=1e-9)
        assert math.atan(wheelbase * curvature) == pytest.approx(controls.steer_rad[0], abs=1e-9)
        assert reverse == controls.reverse[0]


# ---- the conversation, with the client's own types


@pytest.fixture
def carla() -> ModuleType:
    if importlib.util.find_spec("carla") is None:
        pytest.skip("CARLA's client is not installed (extra 'carla')")
    import carla

    return carla


@pytest.fixture
def play(carla: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Exports a scenario and runs the script against a stand-in; returns exit code and stand-in."""
    from carla_server import Client

    def playing(
        scenario: Scenario, *words: str, ground: str = "log", prepare: Any = None, road: Any = None
    ) -> tuple[int, Any]:
        path, _ = written(scenario, tmp_path / "out")
        client = Client(SIZES, road)
        if prepare is not None:
            prepare(client)
        monkeypatch.setattr(carla, "Client", client)
        words = tuple(str(path.with_name("road.xodr")) if w == "ROAD" else w for w in words)
        return main(["--data", str(path), "--pace", "0", "--ground", ground, *words]), client

    return playing


def drift_m(client: Any, agent: Agent, role: str, dt_s: float, begin_s: float = 0.0) -> np.ndarray:
    """Distances between where the box was in CARLA and where the log has it, at all ticks at which the agent is there."""
    at = [(k, seen[role]) for k, seen in enumerate(client.world.seen) if role in seen]
    logged = agent.at(begin_s + np.array([k for k, _ in at]) * dt_s)
    there = np.array([c[:2] for _, c in at])
    return np.hypot(there[:, 0] - logged.x_m, -there[:, 1] - logged.y_m)


def test_exact_agents_are_where_the_log_has_them_at_every_tick(play: Any, scenario: Scenario) -> None:
    """carla#5190, #5615, #968, #8636: the box itself, whatever the origin of the asset, at every tick and without drift."""
    code, client = play(scenario, "--mode", "exact")
    assert code == 0
    for logged in scenario.agents:
        role = "hero" if logged.id == "ego" else logged.id
        assert drift_m(client, logged, role, 0.05).max() < 0.003
        for k, seen in enumerate(client.world.seen):
            state = logged.at(k * 0.05)
            assert seen[role][2] + logged.size_m[2] / 2 == pytest.approx(state.z_m[0], abs=1e-3)
            assert abs(wrap_angle(-seen[role][3] - state.yaw_rad[0])) < 2e-3


def test_a_left_turn_of_the_log_is_a_left_turn_in_carla(play: Any) -> None:
    """scenario_runner#418, #1047: steering to the left is negative, and yaw falls."""
    _, client = play(of(left_turn()), "--mode", "pid")
    steer = [c.control.steer for _, _, c in client.orders if type(c).__name__ == "ApplyVehicleControl"]
    assert min(steer) < -0.1
    assert max(steer) < 0.1
    yaw = [seen["hero"][3] for seen in client.world.seen]
    assert math.degrees(yaw[-1] - yaw[0]) == pytest.approx(-90, abs=3)


def test_with_physics_on_velocities_are_seen_and_poses_still_exact(play: Any) -> None:
    """carla#3145: without physics a server reports no velocity."""
    turning, speeds = left_turn(), []

    def watch(client: Any) -> None:
        tick = client.world.tick

        def ticking() -> int:
            count = int(tick())
            speeds.extend(math.hypot(v.x, v.y) for v in (a.get_velocity() for a in client.world.actors.values()))
            return count

        client.world.tick = ticking

    _, client = play(of(turning), "--physics", prepare=watch)
    assert min(speeds) > 5.0
    assert drift_m(client, turning, "hero", 0.05).max() < 0.05


def test_a_leap_of_the_log_is_not_driven(play: Any) -> None:
    t = np.arange(0.0, 4.01, 0.1)
    leaping = agent("ego", t, 5.0 * t + 40.0 * (t >= 2.0), 0.0, 0.0, 5.0)
    for mode in ("exact", "pid"):
        _, client = play(of(leaping), "--mode", mode, "--dt", "0.02")
        at = np.array([seen["hero"][0] for seen in client.world.seen])
        beside = 5.0 * np.arange(len(at)) * 0.02 + 40.0 * (np.arange(len(at)) >= 100)
        assert np.abs(at - beside).max() < 0.1
        velocities = [c.velocity.x for _, _, c in client.orders if type(c).__name__ == "ApplyTargetVelocity"]
        assert max(velocities) < 5.5


def test_inputs_are_shares_of_full_pedal_and_of_the_lock_that_is_left_at_speed(carla: ModuleType) -> None:
    from carla_server import Actor, Blueprint, share

    spawned = carla.Transform()
    body = CarlaActor(
        carla,
        {"max_throttle_mps2": 6.0, "max_brake_mps2": 10.0},
        Actor(1, Blueprint("vehicle.audi.a2"), (4.0, 1.8, 1.5), spawned),
        spawned,
    )
    for speed, curvature, pedal in ((0.0, 0.1, 3.0), (10.0, -0.03, -2.0), (30.0, 0.004, 9.0), (-2.0, 0.0, -20.0)):
        control = body.control(pedal, curvature, speed, False)
        wheels = control.steer * share(abs(speed) * 3.6) * math.radians(70.0)
        assert math.tan(wheels) / body.wheelbase_m == pytest.approx(curvature, abs=1e-6)
        assert control.throttle == pytest.approx(min(max(pedal / 6.0, 0.0), 1.0))
        assert control.brake == pytest.approx(min(max(-pedal / 10.0, 0.0), 1.0))
        assert control.reverse == (speed < 0)
    assert body.control(1.0, 0.0, 0.0, True).reverse


def test_walkers_walk(play: Any, scenario: Scenario) -> None:
    """metadrive#716: on their soles, which are not at the origin of a walker's actor; shown at the speed of the log."""
    for mode in ("exact", "pid"):
        _, client = play(scenario, "--mode", mode)
        orders = [
            c for _, r, c in client.orders if r == "pedestrian_crossing" and type(c).__name__ == "ApplyWalkerControl"
        ]
        speeds = [c.control.speed for c in orders]
        logged = next(a for a in scenario.agents if a.id == "pedestrian_crossing")
        assert np.mean(speeds) == pytest.approx(np.mean(np.abs(logged.waypoints.speed_mps)), abs=0.05)


def test_settings_are_restored_and_actors_gone_after_ctrl_c(
    play: Any, scenario: Scenario, capsys: pytest.CaptureFixture[str]
) -> None:
    code, client = play(scenario, prepare=lambda client: setattr(client.world, "stop_at", 7))
    assert code == 130
    assert client.world.actors == {}
    assert client.world.applied[0] == (True, pytest.approx(0.05))
    assert client.world.applied[-1] == (False, None)
    assert "stopped; the agents are removed" in capsys.readouterr().err


def test_a_server_without_the_asset_gets_the_next_one_or_a_clear_error(
    play: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    second = nearest_assets(left_turn())[1]["blueprint"]
    code, _ = play(
        of(left_turn()), prepare=lambda client: setattr(client.world.library, "sizes", {second: SIZES[second]})
    )
    assert code == 0
    capsys.readouterr()
    code, _ = play(of(left_turn()), prepare=lambda client: setattr(client.world.library, "sizes", {}))
    assert code == 4
    assert "agent 'ego': this server has none of vehicle.toyota.prius" in capsys.readouterr().err


def test_no_server_is_said_in_one_line(carla: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, _ = written(of(left_turn()), tmp_path)
    assert main(["--data", str(path), "--port", "1", "--timeout", "0.5"]) == 3
    error = capsys.readouterr().err
    assert error.startswith("replay_carla: no CARLA server answers at 127.0.0.1:1 within 0.5 s")
    assert "--host and --port" in error


# ---- maps

ROAD = """<?xml version="1.0"?>
<OpenDRIVE>
 <header revMajor="1" revMinor="7" name="line" version="1" north="0" south="0" east="0" west="0">
  <geoReference><![CDATA[+proj=tmerc +lat_0=49 +lon_0=8]]></geoReference>
 </header>
 <road name="east" length="200" id="1" junction="-1">
  <planView><geometry s="0" x="-100" y="0" hdg="0.3" length="200"><line/></geometry></planView>
  <elevationProfile><elevation s="0" a="2" b="0.01" c="0" d="0"/></elevationProfile>
  <lanes><laneOffset s="0" a="1.75" b="0" c="0" d="0"/><laneSection s="0">
   <center><lane id="0" type="none" level="false"/></center>
   <right><lane id="-1" type="driving" level="false"><width sOffset="0" a="3.5" b="0" c="0" d="0"/></lane></right>
  </laneSection></lanes>
 </road>
</OpenDRIVE>
"""


def along_the_road(sideways_m: float = 0.0) -> Agent:
    """A car on the road above, which goes off at 0.3 rad to the left of east and up by 1 %."""
    t = np.arange(0.0, 4.01, 0.1)
    s = 20.0 + 8.0 * t
    x = -100.0 + s * np.cos(0.3) - sideways_m * np.sin(0.3)
    made = agent("ego", t, x, s * np.sin(0.3) + sideways_m * np.cos(0.3), 0.3, 8.0)
    return replace(made, waypoints=replace(made.waypoints, z_m=2.0 + 0.01 * s + 0.8))


def test_a_world_is_made_from_opendrive_and_heights_are_its_roads(play: Any, tmp_path: Path) -> None:
    """carla#9235, metadrive#716, autoware_universe#13232: a car of a log whose heights are off stands on the map's road."""
    (tmp_path / "road.xodr").write_text(ROAD)
    driving = along_the_road()
    sunk = replace(driving, waypoints=replace(driving.waypoints, z_m=driving.waypoints.z_m - 3.0))
    code, client = play(of(sunk), "--opendrive", str(tmp_path / "road.xodr"), ground="map")
    assert code == 0
    assert client.loaded == [ROAD]
    heights = [seen["hero"][2] for seen in client.world.seen]
    assert heights == pytest.approx(
        np.interp(np.arange(len(heights)) * 0.05, driving.waypoints.t_s, driving.waypoints.z_m) - 0.8, abs=0.01
    )


def test_positions_of_the_data_are_those_of_carlas_own_map(carla: ModuleType, tmp_path: Path) -> None:
    """The lane's center, as CARLA reads OpenDRIVE, runs through the boxes of a car that drives on it: frames agree."""
    _, data = written(of(along_the_road()), tmp_path)
    road, course = carla.Map("line", ROAD), data["agents"][0]["exact"]
    for x, y, z, yaw in zip(course["x_m"], course["y_m"], course["z_m"], course["yaw_deg"]):
        lane = road.get_waypoint(carla.Location(x, y, z)).transform
        assert math.hypot(lane.location.x - x, lane.location.y - y) < 0.01
        assert lane.location.z == pytest.approx(z, abs=0.01)
        assert (lane.rotation.yaw - yaw + 180) % 360 - 180 == pytest.approx(0, abs=0.1)


@pytest.mark.parametrize("name", ["truth", "turn", "hill"])
def test_carla_reads_the_exported_road_with_the_ego_in_a_lane(
    name: str, carla: ModuleType, scenario: Scenario, tmp_path: Path
) -> None:
    """The ego's path lies within the lane that is nearest, at its height, heading its way."""
    made = {"truth": scenario, "turn": of(left_turn(at=(3e5, 5e6))), "hill": of(along_the_road())}[name]
    _, data = written(made, tmp_path)
    assert_on_a_lane(carla, data, tmp_path / data["road"])


def assert_on_a_lane(carla: ModuleType, data: dict[str, Any], road_path: Path) -> None:
    """The rear axle of the ego at all logged moments against the lane that `carla.Map` has there."""
    road, ego = carla.Map("road", road_path.read_text(encoding="utf-8")), data["agents"][0]
    course = SampledTrajectory(ego["exact"])
    for t_s in ego["exact"]["t_s"]:
        x, y, z, yaw = course.place(t_s)
        there = road.get_waypoint(carla.Location(x, y, z))
        lane = there.transform
        assert math.hypot(lane.location.x - x, lane.location.y - y) < there.lane_width / 2
        assert lane.location.z == pytest.approx(z, abs=0.05)
        turned = math.remainder(math.radians(lane.rotation.yaw) - yaw, 2 * math.pi)
        # The box's center does not move along its heading in a turn; where roads cross, the nearest lane may be the other road's.
        assert abs(turned) < 0.3 or there.is_junction
