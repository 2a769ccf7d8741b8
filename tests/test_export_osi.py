"""OSI traces, read back with betterosi and, where it is there, by omega-prime's own validation."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from export_worlds import REAR_M, ROOT, circling, straight, world
from peer_checks import omega_prime_has_everybody

from log2sim.datatypes import Agent, MapFrame, Scenario
from log2sim.export.exporters import export
from log2sim.geometry import wrap_angle

betterosi = pytest.importorskip("betterosi")
SAMPLE = ROOT / "samples" / "crossing" / "truth.json"


def frames(scenario: Scenario, folder: Path) -> list[Any]:
    (file,) = export(scenario, "osi", folder)
    return list(betterosi.read(file, return_ground_truth=True))


def named(truth: Any) -> dict[str, Any]:
    """The objects of a frame by the id that they have in the scenario."""
    return {o.source_reference[0].identifier[0]: o for o in (*truth.moving_object, *truth.stationary_object)}


def test_every_agent_is_where_the_scenario_has_it(tmp_path: Path) -> None:
    scenario = Scenario.load(SAMPLE)
    read = frames(scenario, tmp_path)
    objects = [named(truth) for truth in read]
    for agent in scenario.agents:
        at = agent.at(0.1 * np.arange(len(read)))
        base = [found[agent.id].base for found in objects]
        np.testing.assert_allclose(
            [[b.position.x, b.position.y, b.position.z] for b in base],
            np.stack([at.x_m, at.y_m, at.z_m], -1),
            atol=1e-9,
        )
        np.testing.assert_allclose(wrap_angle([b.orientation.yaw for b in base] - at.yaw_rad), 0.0, atol=1e-9)
        assert (base[0].dimension.length, base[0].dimension.width, base[0].dimension.height) == agent.size_m


def test_every_frame_has_what_omega_prime_demands(tmp_path: Path) -> None:
    frame = MapFrame(49.0, 8.4, 110.0, "+proj=utm +zone=32", (456_000.0, 5_428_000.0, 12.0))
    scenario = replace(world(straight("car-1", start=(0.0, 9.0)), straight("ego")), map=frame)
    for truth in frames(scenario, tmp_path):
        assert (truth.version.version_major, truth.version.version_minor) == (3, 8)
        assert truth.proj_string == "+proj=utm +zone=32"
        offset = truth.proj_frame_offset
        assert (offset.position.x, offset.position.y, offset.position.z, offset.yaw) == (
            456_000.0,
            5_428_000.0,
            12.0,
            0.0,
        )
        host = next(o for o in truth.moving_object if o.id == truth.host_vehicle_id)
        assert host.source_reference[0].identifier == ["ego", "car"]
        assert len({o.id.value for o in truth.moving_object}) == 2


def test_velocity_and_acceleration_are_those_of_the_center(tmp_path: Path) -> None:
    """On a circle both are known: speed w r, acceleration w2 r towards the middle, with r to the box center."""
    r, w = np.hypot(12.0, REAR_M), 6.0 / 12.0
    for truth in frames(world(circling()), tmp_path)[2:-2]:
        base = named(truth)["ego"].base
        position, velocity, acceleration = (
            np.array([v.x, v.y]) for v in (base.position, base.velocity, base.acceleration)
        )
        np.testing.assert_allclose(velocity, w * np.array([-position[1], position[0]]), atol=0.01)
        np.testing.assert_allclose(acceleration, -(w**2) * position, atol=0.05)
        assert np.linalg.norm(acceleration) == pytest.approx(w**2 * r, rel=0.01)


@pytest.mark.peers
@pytest.mark.parametrize("make", ["sample", "late"])
def test_omega_prime_accepts_the_trace(make: str, tmp_path: Path) -> None:
    """Its validation passes, and its table has every agent where the scenario has it."""
    late: Agent = straight("late", "bus", start=(0.0, 9.0), t_s=np.array([1.0, 1.5, 2.0]))
    scenario = Scenario.load(SAMPLE) if make == "sample" else world(circling(), late)
    omega_prime_has_everybody(scenario, tmp_path)
