"""CommonRoad files: what they hold, and what CommonRoad's own reader, schema and collision checker say of them."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from export_worlds import ROOT, circling, straight, world
from peer_checks import commonroad_finds, overlaps

from log2sim.datatypes import Scenario
from log2sim.export.exporters import export
from log2sim.geometry import wrap_angle

SAMPLE = ROOT / "samples" / "crossing" / "truth.json"


def written(scenario: Scenario, folder: Path) -> tuple[ElementTree.Element, dict[str, dict[str, str]]]:
    """The document, and the rows of agents.csv by agent."""
    table, file = sorted(export(scenario, "commonroad", folder), key=lambda f: f.suffix)
    with table.open(newline="", encoding="utf-8") as opened:
        rows = {row["agent"]: row for row in csv.DictReader(opened)}
    return ElementTree.parse(file).getroot(), rows


def test_ids_lead_back_to_the_agents(tmp_path: Path) -> None:
    root, rows = written(Scenario.load(SAMPLE), tmp_path)
    for row in rows.values():
        (element,) = (e for e in root if e.get("id") == row["commonroad_id"])
        assert element.tag == row["role"].replace("planning problem", "planningProblem")
    assert {e.get("id") for e in root.iter() if "bstacle" in e.tag} <= {row["commonroad_id"] for row in rows.values()}


def test_lanes_keep_their_height(tmp_path: Path) -> None:
    """Flat maps out of sloping recordings: CommonRoad/commonroad-scenario-designer#34."""
    ego = straight("ego", speed=10.0, t_s=np.linspace(0.0, 3.0, 31))
    w = ego.waypoints
    uphill = replace(ego, waypoints=replace(w, z_m=5.0 + 0.1 * w.x_m + ego.size_m[2] / 2))
    root, _ = written(world(uphill), tmp_path)
    points = [
        (float(p.findtext("x") or "nan"), float(p.findtext("z") or "nan"))
        for p in root.iterfind("lanelet/leftBound/point")
    ]
    x, z = np.array([(x, z) for x, z in points if 1.0 < x < 29.0]).T
    np.testing.assert_allclose(z, 5.0 + 0.1 * x, atol=0.05)


@pytest.mark.peers
def test_commonroad_reads_the_sample_as_it_is(tmp_path: Path) -> None:
    """Its schema has no complaint, its reader finds every pose, the ego's end is a goal reached, all lanes are valid."""
    scenario = Scenario.load(SAMPLE)
    found, boxes, rows = commonroad_finds(scenario, tmp_path)
    assert found["complaints"] == []
    assert found["arrived"]
    assert all(found["lanelets_valid"])
    assert all(found["ego_on_lanelet"])
    for agent in scenario.others:
        obstacle = found["obstacles"][rows[agent.id]["commonroad_id"]]
        at = agent.at(0.1 * np.arange(len(boxes)))
        poses = np.array(obstacle["poses"])
        np.testing.assert_allclose(poses[:, :2], np.stack([at.x_m, at.y_m], -1), atol=1e-8)
        np.testing.assert_allclose(wrap_angle(poses[:, 2] - at.yaw_rad), 0.0, atol=1e-8)
        np.testing.assert_allclose(poses[:, 3], at.speed_mps, atol=1e-8)
        assert obstacle["size"] == pytest.approx(agent.size_m[:2])


@pytest.mark.peers
def test_commonroads_collision_checker_agrees(tmp_path: Path) -> None:
    """The ego turns through a crossing car, past a parked one that it scratches, and behind one that comes late."""
    crossing = straight("crossing", start=(2.0, 11.0), speed=3.0)
    parked = replace(straight("parked", start=(13.6, 3.5), speed=0.0, yaw=0.4), static=True)
    late = straight("late", start=(4.0, 12.0), speed=0.5, t_s=np.array([2.05, 3.0]))
    scenario = world(circling(), crossing, parked, late)
    found, boxes, _ = commonroad_finds(scenario, tmp_path)
    expected = overlaps(scenario, boxes)
    assert 3 < len(expected) < len(boxes) - 3
    assert found["collisions"] == expected
    assert set(found["complaints"]) == {
        "Element 'exact': [facet 'maxInclusive'] The value '21' is greater than the maximum value allowed ('0')."
    }  # the schema knows nobody who enters late; its reader and checker do
