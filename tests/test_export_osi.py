"""OSI traces, read back with betterosi and, where it is there, by omega-prime's own validation."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from export_worlds import REAR_M, ROOT, circling, moved, straight, world
from peer_checks import omega_prime_has_everybody

from log2sim.datatypes import CATEGORIES, Agent, MapFrame, Scenario
from log2sim.export.exporters import export
from log2sim.geometry import NS_PER_S, wrap_angle

betterosi = pytest.importorskip("betterosi")

SAMPLE = ROOT / "samples" / "crossing" / "truth.json"


def frames(scenario: Scenario, folder: Path) -> list[Any]:
    (file,) = export(scenario, "osi", folder)
    return list(betterosi.read(file, return_ground_truth=True))


def named(truth: Any) -> dict[str, Any]:
    """The objects of a frame by the id that they have in the scenario."""
    return {o.source_reference[0].identifier[0]: o for o in (*truth.moving_object, *truth.stationary_object)}


def test_the_file_is_named_by_the_standards_rule(tmp_path: Path) -> None:
    (file,) = export(world(circling(), name="über 1"), "osi", tmp_path)
    assert re.fullmatch(r"20231114T221320Z_gt_\d{3}_\d{3}_31__ber_1\.osi", file.name)


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


def test_stamps_are_those_of_the_log_to_the_nanosecond(tmp_path: Path) -> None:
    stamps = [t.timestamp.seconds * NS_PER_S + t.timestamp.nanos for t in frames(world(straight("ego")), tmp_path)]
    assert stamps == [1_700_000_000_123_456_789 + k * NS_PER_S // 10 for k in range(31)]


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


def test_large_coordinates_keep_their_digits(tmp_path: Path) -> None:
    """Large coordinates were an unsolved ask: OpenSimulationInterface/open-simulation-interface#478."""
    first = named(frames(moved(world(circling()), 456_789.125, 5_428_123.25), tmp_path)[0])["ego"].base.position
    assert (first.x, first.y) == pytest.approx((456_801.125, 5_428_123.25 + REAR_M), abs=1e-9)


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


def test_orientation_excludes_minus_pi(tmp_path: Path) -> None:
    """OSI's range is open below, ours above."""
    first = named(frames(world(straight("ego", yaw=np.pi)), tmp_path)[0])["ego"]
    assert first.base.orientation.yaw == np.pi


def test_agents_are_there_in_their_life_only(tmp_path: Path) -> None:
    late = straight("late", start=(0.0, 9.0), t_s=np.array([1.0, 1.5, 2.0]))
    short = straight("short", start=(0.0, -9.0), t_s=np.array([0.53, 0.56]))
    read = frames(world(straight("ego"), late, short), tmp_path)
    assert [k for k, truth in enumerate(read) if "late" in named(truth)] == list(range(10, 21))
    assert [k for k, truth in enumerate(read) if "short" in named(truth)] == [5, 6]


def test_every_category_has_a_type_that_is_not_unknown(tmp_path: Path) -> None:
    others = [straight(c, c, start=(0.0, 5.0 * k + 5)) for k, c in enumerate(CATEGORIES)]
    cone = replace(straight("cone", "other", start=(0.0, -5.0), speed=0.0), static=True)
    truth = frames(world(straight("ego"), *others, cone), tmp_path)[0]
    found, kind = named(truth), betterosi.MovingObject.Type
    assert {c: found[c].type for c in ("car", "pedestrian", "other")} == {
        "car": kind.VEHICLE,
        "pedestrian": kind.PEDESTRIAN,
        "other": kind.OTHER,
    }
    types = {c: found[c].vehicle_classification.type.name for c in ("truck", "bus", "cyclist", "bicycle")}
    assert types == {"truck": "HEAVY_TRUCK", "bus": "BUS", "cyclist": "BICYCLE", "bicycle": "BICYCLE"}
    assert [o.source_reference[0].identifier[0] for o in truth.stationary_object] == ["cone"]


def test_the_rear_axle_is_behind_the_center_and_near_the_ground(tmp_path: Path) -> None:
    to_rear = named(frames(world(circling()), tmp_path)[0])["ego"].vehicle_attributes.bbcenter_to_rear
    assert to_rear.x == -REAR_M
    assert -0.8 < to_rear.z < 0.0


def test_colors_are_shares_of_one(tmp_path: Path) -> None:
    red = replace(straight("ego"), color={"rgb": [255, 51, 0], "name": "red"})
    rgb = named(frames(world(red), tmp_path)[0])["ego"].color_description.rgb
    assert (rgb.red, rgb.green, rgb.blue) == (1.0, 0.2, 0.0)


@pytest.mark.peers
@pytest.mark.parametrize("make", ["sample", "late"])
def test_omega_prime_accepts_the_trace(make: str, tmp_path: Path) -> None:
    """Its validation passes, and its table has every agent where the scenario has it."""
    late: Agent = straight("late", "bus", start=(0.0, 9.0), t_s=np.array([1.0, 1.5, 2.0]))
    scenario = Scenario.load(SAMPLE) if make == "sample" else world(circling(), late)
    omega_prime_has_everybody(scenario, tmp_path)
