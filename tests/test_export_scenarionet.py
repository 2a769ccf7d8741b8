"""ScenarioNet files: what their users complained about elsewhere, and MetaDrive's own replay."""

from __future__ import annotations

import io
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from export_worlds import RADIUS_M, REAR_M, ROOT, SPEED_MPS, circling, moved, straight, world
from peer_checks import metadrive_replays

from log2sim.datatypes import Scenario
from log2sim.export.exporters import export

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


def test_velocity_agrees_with_the_poses(tmp_path: Path) -> None:
    """Replay with poses and wrong velocities: Emerge-Lab/PufferDrive#392. On a circle the center slips sideways."""
    state = described(world(circling()), tmp_path)["tracks"]["ego"]["state"]
    speed = np.linalg.norm(state["velocity"], axis=1)
    np.testing.assert_allclose(speed, SPEED_MPS * np.hypot(1.0, REAR_M / RADIUS_M), rtol=1e-3)
    driven = (state["position"][2:] - state["position"][:-2])[:, :2] / 0.2
    np.testing.assert_allclose(state["velocity"][1:-1], driven, atol=0.01)


def test_what_lives_between_two_steps_is_kept_and_the_rest_named(tmp_path: Path) -> None:
    """Dropped in silence elsewhere: metadriverse/scenarionet#102."""
    short = straight("short", start=(0.0, 9.0), t_s=np.array([0.53, 0.56]))
    early = straight("early", start=(0.0, 9.0), t_s=np.array([0.0, 0.1]))
    ego = straight("ego", t_s=np.array([0.4, 1.0, 2.0]))
    file = described(world(ego, short, early), tmp_path)
    assert file["tracks"]["short"]["state"]["valid"].tolist() == [k in (1, 2) for k in range(17)]
    assert file["metadata"]["left_out"] == {"early": "not alive at any step of the ego"}


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
