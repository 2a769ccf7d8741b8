"""ScenarioNet files: what their users complained about elsewhere, and MetaDrive's own replay."""

from __future__ import annotations

import io
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from export_worlds import RADIUS_M, REAR_M, ROOT, SPEED_MPS, circling, moved, straight, world
from peer_checks import metadrive_replays

from log2sim.datatypes import CATEGORIES, Scenario
from log2sim.errors import ScenarioError
from log2sim.export.exporters import export
from log2sim.geometry import NS_PER_S

SAMPLE = ROOT / "samples" / "crossing" / "truth.json"


class OnlyArrays(pickle.Unpickler):
    """Admits what every version of NumPy has under the same name, and nothing else."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) != ("numpy", "ndarray"):
            raise pickle.UnpicklingError(f"{module}.{name} is no plain value")
        return np.ndarray


def load(file: Path) -> Any:
    return OnlyArrays(io.BytesIO(file.read_bytes())).load()


def described(scenario: Scenario, folder: Path) -> dict[str, Any]:
    files = export(scenario, "scenarionet", folder)
    (own,) = (f for f in files if f.name.startswith("sd_"))
    description: dict[str, Any] = load(own)
    return description


def test_files_need_no_module_of_ours_nor_a_version_of_numpy(tmp_path: Path) -> None:
    """Pickles that need their author's modules: motional/nuplan-devkit#67; NumPy 2 renamed its own."""
    for file in export(Scenario.load(SAMPLE), "scenarionet", tmp_path):
        load(file)
        assert str(tmp_path).encode() not in file.read_bytes()


def test_arrays_can_be_written_to_once_loaded(tmp_path: Path) -> None:
    """MetaDrive moves the origin to the ego in place."""
    position = described(world(circling()), tmp_path)["tracks"]["ego"]["state"]["position"]
    position[..., :2] -= 1.0


def test_tables_name_the_file(tmp_path: Path) -> None:
    export(world(circling(), name="a b/ä"), "scenarionet", tmp_path)
    assert load(tmp_path / "dataset_mapping.pkl") == {"sd_log2sim_1_a_b_.pkl": ""}
    summary = load(tmp_path / "dataset_summary.pkl")["sd_log2sim_1_a_b_.pkl"]
    assert summary["object_summary"]["ego"]["moving_distance"] == pytest.approx(
        3.0 * SPEED_MPS / RADIUS_M * np.hypot(RADIUS_M, REAR_M), rel=1e-3
    )
    assert summary["number_summary"]["num_moving_objects_each_type"] == {"VEHICLE": 1}


def test_steps_are_equal_though_waypoints_are_not(tmp_path: Path) -> None:
    """A stated rate that was not the real one: sungyeonparkk/NuPlanQA#3."""
    described_ = described(world(straight("ego", speed=7.0)), tmp_path)
    np.testing.assert_allclose(described_["metadata"]["ts"], 0.1 * np.arange(31), atol=1e-12)
    np.testing.assert_allclose(described_["tracks"]["ego"]["state"]["position"][:, 0], 0.7 * np.arange(31), atol=1e-9)


def test_stamps_lead_back_to_the_log(tmp_path: Path) -> None:
    """Asked for in valeoai/ScenarioMax#3. The scenario starts when its ego does."""
    late = straight("ego", t_s=np.array([0.5, 1.0, 2.0]))
    metadata = described(world(late), tmp_path)["metadata"]
    assert metadata["t0_ns"] == 1_700_000_000_123_456_789 + NS_PER_S // 2
    assert metadata["timestamps_ns"].dtype == np.int64
    assert set(np.diff(metadata["timestamps_ns"]).tolist()) == {NS_PER_S // 10}


def test_velocity_agrees_with_the_poses(tmp_path: Path) -> None:
    """Replay with poses and wrong velocities: Emerge-Lab/PufferDrive#392. On a circle the center slips sideways."""
    state = described(world(circling()), tmp_path)["tracks"]["ego"]["state"]
    speed = np.linalg.norm(state["velocity"], axis=1)
    np.testing.assert_allclose(speed, SPEED_MPS * np.hypot(1.0, REAR_M / RADIUS_M), rtol=1e-3)
    driven = (state["position"][2:] - state["position"][:-2])[:, :2] / 0.2
    np.testing.assert_allclose(state["velocity"][1:-1], driven, atol=0.01)


def test_velocity_points_where_the_agent_heads(tmp_path: Path) -> None:
    """Velocities 90 degrees off the heading: motional/nuplan-devkit#222. Reversing is along the heading too."""
    back = straight("back", yaw=2.0, speed=-3.0, start=(20.0, 0.0))
    tracks = described(world(straight("ego", yaw=-1.0), back), tmp_path)["tracks"]
    for name, speed in (("ego", 5.0), ("back", -3.0)):
        state = tracks[name]["state"]
        along = np.cos(state["heading"]) * state["velocity"][:, 0] + np.sin(state["heading"]) * state["velocity"][:, 1]
        np.testing.assert_allclose(along, speed, atol=1e-9)


def test_uneven_waypoints_give_no_speed_spikes(tmp_path: Path) -> None:
    """Speeds above 50 m/s out of differences: metadriverse/scenarionet#13, nutonomy/nuscenes-devkit#359."""
    t = np.array([0.0, 1e-6, 0.1, 0.100001, 2.0])
    state = described(world(straight("ego", speed=9.0, t_s=t)), tmp_path)["tracks"]["ego"]["state"]
    np.testing.assert_allclose(np.linalg.norm(state["velocity"], axis=1), 9.0, atol=1e-9)


def test_length_is_along_the_heading(tmp_path: Path) -> None:
    """Length and width swapped: metadriverse/scenarionet#68; given apart: metadriverse/metadrive#411."""
    state = described(world(straight("ego")), tmp_path)["tracks"]["ego"]["state"]
    assert [set(state[k].tolist()) for k in ("length", "width", "height")] == [{4.4}, {1.8}, {1.6}]


def test_no_class_is_dropped(tmp_path: Path) -> None:
    """Unmapped classes whose tracks were gone: metadriverse/scenarionet#102."""
    others = [straight(f"{c}-1", c, start=(0.0, 5.0 * k + 5)) for k, c in enumerate(CATEGORIES)]
    tracks = described(world(straight("ego"), *others), tmp_path)["tracks"]
    assert {t["metadata"]["category"]: t["type"] for t in tracks.values()} == {
        "car": "VEHICLE", "truck": "VEHICLE", "bus": "VEHICLE", "motorcycle": "CYCLIST", "cyclist": "CYCLIST",
        "bicycle": "CYCLIST", "pedestrian": "PEDESTRIAN", "other": "OTHER",
    }  # fmt: skip


def test_what_lives_between_two_steps_is_kept_and_the_rest_named(tmp_path: Path) -> None:
    """Dropped in silence elsewhere: metadriverse/scenarionet#102."""
    short = straight("short", start=(0.0, 9.0), t_s=np.array([0.53, 0.56]))
    early = straight("early", start=(0.0, 9.0), t_s=np.array([0.0, 0.1]))
    ego = straight("ego", t_s=np.array([0.4, 1.0, 2.0]))
    file = described(world(ego, short, early), tmp_path)
    assert file["tracks"]["short"]["state"]["valid"].tolist() == [k in (1, 2) for k in range(17)]
    assert file["metadata"]["left_out"] == {"early": "not alive at any step of the ego"}


def test_values_are_zero_where_not_valid(tmp_path: Path) -> None:
    late = straight("late", start=(0.0, 9.0), t_s=np.array([1.0, 1.5, 2.0]))
    state = described(moved(world(straight("ego"), late), 40.0, 7.0), tmp_path)["tracks"]["late"]["state"]
    np.testing.assert_array_equal(np.flatnonzero(state["valid"]), np.arange(10, 21))
    assert all(not values[~state["valid"]].any() for values in state.values())


def test_a_shift_of_the_origin_is_stored(tmp_path: Path) -> None:
    """Recentered without a way back: metadriverse/scenarionet#103. What is left is exact in float32 readers."""
    near, far = world(circling()), moved(world(circling()), 5_407_123.25, -690_333.5)
    a, b = described(near, tmp_path / "a"), described(far, tmp_path / "b")
    assert b["metadata"]["position_offset_m"] == [5_407_000.0, -690_000.0, 0.0]
    assert a["metadata"]["position_offset_m"] == [0.0, 0.0, 0.0]
    back = b["tracks"]["ego"]["state"]["position"] + b["metadata"]["position_offset_m"]
    np.testing.assert_allclose(
        back - a["tracks"]["ego"]["state"]["position"], [[5_407_123.25, -690_333.5, 0]] * 31, atol=1e-6
    )
    assert np.abs(b["tracks"]["ego"]["state"]["position"]).max() < 1000
    polyline = b["map_features"]["lane-1"]["polyline"] + b["metadata"]["position_offset_m"]
    first = far.agents[0].waypoints
    assert np.hypot(polyline[:, 0] - first.x_m[0], polyline[:, 1] - first.y_m[0]).min() < 0.5


def test_every_vehicle_drives_on_a_lane(tmp_path: Path) -> None:
    """MetaDrive's map needs lanes: the ego's and its follower's, one across it, and those of the junction."""
    follower, crossing = straight("follower", start=(-9.0, 0.2)), straight("crossing", start=(8.0, -6.0), yaw=np.pi / 2)
    scenario = world(straight("ego"), follower, crossing, straight("walker", "pedestrian", start=(0.0, 30.0)))
    features = described(scenario, tmp_path)["map_features"].values()
    assert {f["inferred_from"] for f in features} == {"paths"}
    assert {f["junction"] for f in features} == {None, "junction-1"}
    middles = np.concatenate([f["polyline"] for f in features])
    assert all(np.linalg.norm(np.diff(f["polyline"], axis=0), axis=1).max() < 1.001 for f in features)
    for agent in scenario.agents[:3]:
        w = agent.waypoints
        assert np.hypot(middles[:, 0, None] - w.x_m, middles[:, 1, None] - w.y_m).min(axis=0).max() < 0.6
        np.testing.assert_allclose(middles[:, 2], 0.0, atol=1e-9)  # on the ground, half a height below the boxes


def test_a_standing_ego_has_a_lane_under_it(tmp_path: Path) -> None:
    (lane,) = described(world(straight("ego", speed=0.0, yaw=1.0)), tmp_path)["map_features"].values()
    direction = lane["polyline"][-1] - lane["polyline"][0]
    assert np.arctan2(direction[1], direction[0]) == pytest.approx(1.0)


def test_a_scenario_without_ego_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match="no agent 'ego'"):
        export(world(straight("car-1")), "scenarionet", tmp_path / "out")


def test_endless_scenarios_are_refused_before_memory_is_taken(tmp_path: Path) -> None:
    endless = straight("ego", t_s=np.array([0.0, 1e12]), speed=0.0)
    with pytest.raises(ScenarioError, match="cut the scenario into parts"):
        export(world(endless), "scenarionet", tmp_path / "out")


@pytest.mark.peers
@pytest.mark.parametrize("make", ["sample", "closed form", "far", "late and short"])
def test_metadrive_replays_every_waypoint(make: str, tmp_path: Path) -> None:
    """MetaDrive's `ScenarioEnv` shows every agent where the scenario has it, at every step and at no other."""
    late = straight("late", start=(0.0, 9.0), t_s=np.array([1.0, 1.5, 2.0]))
    scenario = {
        "sample": Scenario.load(SAMPLE),
        "closed form": world(
            circling(), straight("bus", "bus", start=(0.0, 30.0)), straight("bike", "cyclist", start=(0.0, -30.0))
        ),
        "far": moved(world(circling(), straight("car", start=(30.0, 0.0))), 5_407_123.25, -690_333.5),
        "late and short": world(
            straight("ego"), late, straight("walker", "pedestrian", start=(0.0, -9.0), t_s=np.array([0.2, 0.9]))
        ),
    }[make]
    assert metadrive_replays(scenario, tmp_path) < 1e-4


def test_agents_keep_color_and_confidence(tmp_path: Path) -> None:
    red = replace(straight("ego"), color={"rgb": [200, 10, 10], "name": "red"}, confidence=0.75)
    metadata = described(world(red), tmp_path)["tracks"]["ego"]["metadata"]
    assert metadata["color"] == {"rgb": [200, 10, 10], "name": "red"}
    assert metadata["confidence"] == 0.75
