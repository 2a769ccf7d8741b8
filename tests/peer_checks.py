"""Checks of exported files by software of others, which runs in environments of its own (tools/peers.sh)."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
from export_worlds import ROOT, peer

from log2sim.datatypes import Scenario
from log2sim.export.exporters import export
from log2sim.geometry import NS_PER_S, rectangle_iou, wrap_angle

SCRIPTS = ROOT / "tests" / "peers"


def metadrive_replays(scenario: Scenario, folder: Path) -> float:
    """The largest distance in m between MetaDrive's replay and the scenario, over all agents and steps.

    Everybody is there when the scenario has them and at no other time, but for agents of category other.
    """
    run = peer("metadrive")
    export(scenario, "scenarionet", folder)
    steps = json.loads(run(SCRIPTS / "metadrive_replay.py", folder))
    worst = 0.0
    for agent in scenario.agents:
        at = agent.at(0.1 * np.arange(len(steps)))
        shown = np.array([step.get(agent.id, [np.nan] * 5) for step in steps])
        np.testing.assert_array_equal(np.isfinite(shown[:, 0]), at.valid & (agent.category != "other"))
        if agent.category != "other":
            worst = max(worst, float(np.nanmax(np.hypot(shown[:, 0] - at.x_m, shown[:, 1] - at.y_m))))
            assert np.nanmax(np.abs(wrap_angle(shown[:, 2] - at.yaw_rad))) < 1e-5
    return worst


def commonroad_finds(scenario: Scenario, folder: Path) -> tuple[dict[str, Any], np.ndarray, dict[str, dict[str, str]]]:
    """What CommonRoad's software finds, the ego's [x, y, yaw, length, width] at every step, and agents.csv by agent."""
    run = peer("commonroad")
    export(scenario, "commonroad", folder)
    with (folder / "agents.csv").open(newline="", encoding="utf-8") as opened:
        rows = {row["agent"]: row for row in csv.DictReader(opened)}
    ego = scenario.ego
    assert ego is not None
    at = ego.at(np.arange(ego.waypoints.t_s[0], ego.waypoints.t_s[-1] + 1e-6, 0.1))
    boxes = np.stack([at.x_m, at.y_m, at.yaw_rad, *np.broadcast_arrays(*ego.size_m[:2], at.x_m)[:2]], axis=-1)
    (folder / "ego.json").write_text(json.dumps(boxes.tolist()))
    (file,) = folder.glob("*.xml")
    return json.loads(run(SCRIPTS / "commonroad_read.py", file, folder / "ego.json")), boxes, rows


def overlaps(scenario: Scenario, boxes: np.ndarray) -> list[int]:
    """Steps at which the ego's box shares ground with another's, by clipping polygons."""
    steps = []
    for k, (x, y, yaw, length, width) in enumerate(boxes):
        own = [x, y, length, width, yaw]
        states = [(a, a.at(a.waypoints.t_s[:1] if a.static else 0.1 * k)) for a in scenario.others]
        others = [[s.x_m[0], s.y_m[0], *a.size_m[:2], s.yaw_rad[0]] for a, s in states if s.valid[0]]
        steps += [k] if any(rectangle_iou(own, other)[0] > 0 for other in others) else []
    return steps


def omega_prime_has_everybody(scenario: Scenario, folder: Path) -> None:
    """Omega-prime's validation passes, and its table has every agent where the scenario has it."""
    run = peer("omega_prime")
    (file,) = export(scenario, "osi", folder)
    rows = json.loads(run(SCRIPTS / "omega_prime_read.py", file))
    assert {row[0] for row in rows} <= set(range(1, len(scenario.agents) + 1))
    for number, agent in enumerate(scenario.agents, start=1):
        own = np.array([row[1:] for row in rows if row[0] == number], dtype=float)
        if agent.static and agent.category == "other":  # stationary objects, which it does not read
            assert len(own) == 0
            continue
        at = agent.at((own[:, 0] - scenario.t0_ns) / NS_PER_S, margin_s=1e-4)
        np.testing.assert_allclose(own[:, 1:3], np.stack([at.x_m, at.y_m], -1), atol=1e-5)
        np.testing.assert_allclose(wrap_angle(own[:, 3] - at.yaw_rad), 0.0, atol=1e-5)
